"""Panels on the outside of a cylinder: one, or N equal sectors of a closed ring, each with its own relief.

Notation
    R_0, z_a    radius of the base cylinder, and height of its axis in a panel's coordinates, mm
    a, b        coordinates of a panel along the axis and across it
    theta       angle about the axis from a panel's vertex, b = (z - z_a) tan theta;  rho  distance from the axis
    d           half the angle of a sector, pi / N; sectors meet in the planes theta = +-d, the mitres

Panel k of a ring is turned by 2 d k about the axis, from z towards b.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.part import Part
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Aperture

#: Points along each axis at which slopes and edges are sampled.
SAMPLES = 401
#: Most secant iterations along a radius, their tolerance, mm, and the most that their derivative differs from a cylinder's.
STEPS, STILL, STEEPEST = 30, 1e-10, 4.0
#: Fewest panels of a ring: each is a height field, of less than half of the way around; and the most that a panel may be wider than
#: its sector, which the mitres cut off.
FEWEST, WIDER = 3, 1.1
#: Most panels, of a degree each.
MOST = 360

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]
Side = tuple[HeightField, Tensor]


@dataclass(frozen=True)
class BaseCylinder:
    """A base cylinder: the coordinate with curvature, 0 for x, 1 for y; R_0 and z_a, mm."""

    bent: int
    radius: float
    axis: float

    @classmethod
    def of(cls, part: Part, asked: str) -> BaseCylinder:
        """That of a part; asked: what needs it.

        Raises:
            InputError: the base surface is no cylinder that is convex on the outside.
        """
        lens, radii = part.lens, part.lens.offset.radius
        if part.kind != "lens" or sum(map(math.isinf, radii)) != 1 or min(radii) > 0:
            raise InputError(
                f"{asked} needs the outside of a cylinder, a lens of ⟨lens.radius⟩ -R,inf or inf,-R, and no mould, got radii"
                f" of {radii[0]:g} and {radii[1]:g} mm"
            )
        bent = int(math.isinf(radii[0]))
        return cls(bent, -radii[bent], lens.offset.thickness + radii[bent])

    def lens_xy(self, along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x and y of points (a, b)."""
        return (across, along) if self.bent == 0 else (along, across)

    def distance(self, height: Height, along: np.ndarray, theta: np.ndarray, about: float) -> np.ndarray:
        """Distance from the axis, (N,) mm, at which the radius at a (N,), mm, and theta (N,) meets the surface with these heights,
        NaN where there is none; about: a first distance, mm.

        f(b) = b cos(theta) - (z - z_a) sin(theta) = 0 by the secant method, begun with the derivative 1 / cos(theta) of a cylinder
        and kept within STEEPEST of it.
        """
        sine, cosine = np.sin(theta), np.cos(theta)
        across, found = about * sine, np.full(len(theta), np.nan)
        before, off_before = np.zeros_like(across), np.zeros_like(across)
        busy = np.arange(len(theta))
        for step in range(STEPS):
            if not len(busy):
                break
            b, c = across[busy], cosine[busy]
            found[busy] = height(*self.lens_xy(along[busy], b)) - self.axis
            off = b * c - found[busy] * sine[busy]
            with np.errstate(divide="ignore"):  # an infinite one is limited
                inverse = np.clip((b - before[busy]) / (off - off_before[busy]), c / STEEPEST, c * STEEPEST) if step else c
            before[busy], off_before[busy] = b, off
            move = off * inverse
            left = np.abs(move) > STILL  # not where it is NaN
            across[busy[left]] -= move[left]
            busy = busy[left]
        return np.hypot(across, found)


def refuse_number(panels: int) -> None:
    """Refuse a ring of this number of panels.

    Raises:
        InputError: they are too few or too many.
    """
    if not FEWEST <= panels <= MOST:
        raise InputError(f"⟨ring⟩ must have at least {FEWEST} panels and at most {MOST}, got {panels}")


def level(side: Side) -> Height:
    """Heights of a surface, which beyond its edges continues level."""
    field, heights = side

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        at = (torch.from_numpy(np.clip(c, -r, r)) for c, r in zip((x, y), field.half_size, strict=True))
        return field.at(heights, *at, [(0, 0)])[0].numpy()

    return height


@dataclass(frozen=True, eq=False)
class Panels:
    """Surfaces `sides` of the panels on a cylinder, in their order around it; half: of each along the axis, mm."""

    cylinder: BaseCylinder
    sides: tuple[Side, ...]
    half: float

    @classmethod
    def of(cls, part: Part, others: Sequence[Side] = (), asked: str = "⟨ring⟩") -> Panels:
        """The panel of a part, alone or with others of a closed ring.

        Raises:
            InputError: it is not on the outside of a cylinder, or the panels do not close.
        """
        cylinder = BaseCylinder.of(part, asked)
        found = cls(cylinder, ((part.field, part.heights), *others), part.lens.half_size[1 - cylinder.bent])
        if found.closed:
            if part.lens.aperture != Aperture.name or part.lens.border > 0:
                raise InputError("⟨ring⟩ is made of rectangular panels without ⟨lens.border⟩")
            found._refuse_open(part.lens.half_size[cylinder.bent])
        return found

    def _refuse_open(self, half: float) -> None:
        """Refuse panels that do not reach the mitres, or are cut off there.

        Raises:
            InputError: they leave gaps, or their pictures would lack their sides.
        """
        refuse_number(len(self.sides))
        reach = min(float(angle) for angle in self._edges(half))
        if not self.sector <= reach <= WIDER * self.sector:
            fitting = 2.0 * self.high * math.sin(self.sector)
            raise InputError(
                f"⟨ring⟩ of {len(self.sides)} panels: each has {2.0 * math.degrees(self.sector):.4g} degrees, and these reach"
                f" {2.0 * math.degrees(reach):.4g} around the axis; a ⟨lens.size⟩ of {fitting:.6g} mm across fits"
            )

    def _edges(self, half: float) -> list[float]:
        """Least angle of each panel's two edges at +-half mm across."""
        along, found = np.linspace(-self.half, self.half, SAMPLES), []
        for field, heights in self.unlike:
            for end in (-half, half):
                x, y = map(torch.from_numpy, self.cylinder.lens_xy(along, np.full(SAMPLES, end)))
                z = field.at(heights, x, y, [(0, 0)])[0].numpy()
                found.append(float(np.abs(np.arctan2(end, z - self.cylinder.axis)).min()))
        return found

    def distances(self, height: Height, theta: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Distances from the axis, mm, at which radii at angles (n,) from a vertex and places (m,) meet a surface: (n, m)."""
        turns, places = (c.ravel() for c in np.meshgrid(theta, along, indexing="ij"))
        return self.cylinder.distance(height, places, turns, self.cylinder.radius).reshape(len(theta), len(along))

    @property
    def closed(self) -> bool:
        """Whether it is a ring."""
        return len(self.sides) > 1

    @property
    def sector(self) -> float:
        """d, rad; of one panel by itself the most that a height field has."""
        return math.pi / len(self.sides) if self.closed else 0.5 * math.pi

    def angle(self, k: int) -> float:
        """Angle of panel k, rad."""
        return 2.0 * self.sector * k

    @cached_property
    def unlike(self) -> list[Side]:
        """The panels without repetitions."""
        return list({id(side[1]): side for side in self.sides}.values())

    @cached_property
    def _sampled(self) -> np.ndarray:
        """Distance from the axis, mm, angle, rad, and cosine of the normal to the radius, (3, N), of samples within the sectors."""
        found = []
        for field, heights in self.unlike:
            line = (torch.linspace(-r, r, SAMPLES, dtype=torch.float64) for r in field.half_size)
            x, y = (c.reshape(-1) for c in torch.meshgrid(*line, indexing="ij"))
            z, zx, zy = (c.numpy() for c in field.at(heights, x, y))
            across, leans = (x.numpy(), zx) if self.cylinder.bent == 0 else (y.numpy(), zy)
            up = z - self.cylinder.axis
            far = np.hypot(across, up)
            cosine = (up - across * leans) / (far * np.sqrt(1.0 + zx * zx + zy * zy))
            angle = np.abs(np.arctan2(across, up))
            found.append(np.stack([far, angle, cosine])[:, angle <= self.sector * (1.0 + 1e-9)])
        return np.concatenate(found, 1)

    @property
    def high(self) -> float:
        """Greatest distance of the surface from the axis, mm."""
        return float(self._sampled[0].max())

    @property
    def low(self) -> float:
        """Least distance of the surface from the axis, mm."""
        return float(self._sampled[0].min())

    @property
    def turn(self) -> float:
        """Greatest angle of a panel to its vertex, rad."""
        return float(self._sampled[1].max())

    @property
    def slope(self) -> float:
        """Largest slope against the cylinder.

        Raises:
            InputError: the relief overhangs.
        """
        least = float(self._sampled[2].min())
        if not least > 0:
            raise InputError("⟨path⟩ rotary: the relief is steeper than a tool along the radius reaches")
        return math.sqrt(1.0 / least**2 - 1.0)
