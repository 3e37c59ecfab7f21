"""Programs for a mill with a rotary axis: a relief on the outside of a cylinder, by a ball that points to the axis of the part.

X0 is the middle of the part, X along the axis of the cylinder, A the angle about it, A0 at the vertex, and Z the distance of the
ball's tip from that axis, which is Z0; Y stays 0.  Directions are those of ISO 841, as if the tool moved around the part: at A it
is over Y = -Z sin A.  Passes run along X, in G94, and A turns between them alone.

Notation
    R_0, z_a    radius of the base cylinder, and height of its axis, mm;  R  radius of the ball
    a, b        coordinates along the axis and across it, b = (z - z_a) tan theta;  s = R_0 theta
    C(a, b)     height of the ball's centre above the plane (`offset`): no ball above it cuts into the part, from whatever side it
                comes, so that its surface also bounds the centres of balls that come along the radius
    rho         sqrt(b^2 + (C - z_a)^2), distance of the centre from the axis; the tip is at rho - R

At an angle theta the centre is at the b with b cos theta = (C - z_a) sin theta, found by a chord iteration with the derivative
1 / cos theta of a cylinder.  A linear move of A and Z is one of s and rho, in which moves are within a tolerance.  Passes a
distance s apart on the cylinder leave scallops as on a plane for s sqrt(1 + R / R_0), since both the ball and the cylinder are
convex.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from caustic_cli.errors import InputError
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.offset import BallOffset, shape_of
from caustic_cli.export.milling.paths import batches, raster, spacing, with_heights
from caustic_cli.export.milling.writer import (
    FIRST_MOVE,
    MOST_OVER,
    PATH_PART,
    Writer,
    begin,
    descend,
    digits_of,
    figures_of,
)
from caustic_cli.export.part import Part
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Aperture

#: Chord iterations, whose error falls by the slope of the relief each time, and their tolerance over the radius of the ball.
STEPS, STILL = 30, 1e-10
#: Points along each axis at which slopes and edges are sampled.
SAMPLES = 401


class _Cylinder:
    """The base cylinder of a part.

    Raises:
        InputError: the base surface is no cylinder that is convex on the side of the tool.
    """

    def __init__(self, part: Part):
        lens, radii = part.lens, part.lens.offset.radius
        if part.kind != "lens" or sum(map(math.isinf, radii)) != 1 or min(radii) > 0:
            raise InputError(
                "⟨path⟩ rotary needs the outside of a cylinder, a lens of ⟨lens.radius⟩ -R,inf or inf,-R, and no mould, got radii"
                f" of {radii[0]:g} and {radii[1]:g} mm"
            )
        #: The coordinate with curvature, 0 for x, 1 for y; R_0 and z_a.
        self.bent = int(math.isinf(radii[0]))
        self.radius = -radii[self.bent]
        self.axis = lens.offset.thickness - self.radius

    def lens_xy(self, along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x and y of points (a, b)."""
        return (across, along) if self.bent == 0 else (along, across)

    def program(self, points: np.ndarray) -> np.ndarray:
        """X, mm, A, degrees, and Z, mm, of points (a, s, Z), (m, 3): X, Y, Z is right-handed with X = y, Y = -x, or with x, y."""
        turn = np.degrees(points[:, 1] / self.radius) * (1.0 if self.bent == 0 else -1.0)
        return np.stack([points[:, 0], turn, points[:, 2]], -1)

    def shape(self, part: Part) -> tuple[float, float, float]:
        """Greatest distance of the surface from the axis, mm; greatest angle to the vertex, rad; largest slope against the
        cylinder."""
        half = part.lens.half_size
        x, y = (torch.linspace(-r, r, SAMPLES, dtype=torch.float64) for r in half)
        x, y = (c.reshape(-1) for c in torch.meshgrid(x, y, indexing="ij"))
        z, zx, zy = (c.numpy() for c in part.field.at(part.heights, x, y))
        across, leans = (x.numpy(), zx) if self.bent == 0 else (y.numpy(), zy)
        far = np.hypot(across, z - self.axis)
        cosine = (z - self.axis - across * leans) / (far * np.sqrt(1.0 + zx * zx + zy * zy))
        if not cosine.min() > 0:
            raise InputError("⟨path⟩ rotary: the relief is steeper than a tool along the radius reaches")
        slope = math.sqrt(1.0 / float(cosine.min()) ** 2 - 1.0)
        return float(far.max()), float(np.abs(np.arctan2(across, z - self.axis)).max()), slope


class RadialOffset:
    """Distances of the tip of a ball from the axis of a cylinder, where it comes along the radius; see the module."""

    def __init__(self, cylinder: _Cylinder, field: HeightField, heights: torch.Tensor, radius: float):
        self.cylinder, self.radius, self.offset = cylinder, radius, BallOffset(field, heights, radius)

    def __call__(self, along: np.ndarray, s: np.ndarray) -> np.ndarray:
        """(N,) mm at a, s (N,) mm; NaN where the ball does not touch the surface."""
        theta = s / self.cylinder.radius
        sine, cosine = np.sin(theta), np.cos(theta)
        across, height = (self.cylinder.radius + self.radius) * sine, np.full(len(s), np.nan)
        busy = np.arange(len(s))
        for _ in range(STEPS):
            if not len(busy):
                break
            found = self.offset(*self.cylinder.lens_xy(along[busy], across[busy])) + self.radius - self.cylinder.axis
            height[busy] = found
            move = (across[busy] * cosine[busy] - found * sine[busy]) * cosine[busy]
            left = np.abs(move) > STILL * self.radius  # not where it is NaN
            across[busy[left]] -= move[left]
            busy = busy[left]
        return np.hypot(across, height) - self.radius


def write_rotary(path: str | Path, part: Part, m: Milling, tolerance: float | None, unit: float, simple: bool) -> dict:
    """Write the program atomically; figures as of `gcode.write_gcode`, and turned_deg, to either side.

    Args:
        tolerance: of moves, mm; unit: of the program, mm; simple: no G0.

    Raises:
        InputError: the part is not the outside of a cylinder, or the stock is below its surface.
    """
    if m.roughing is not None:
        raise InputError("⟨roughing⟩ belongs to another ⟨path⟩ than rotary: a relief on a finished cylinder is shallow")
    cylinder = _Cylinder(part)
    _, _, _, concave = shape_of(part.field, part.heights)
    high, turn, slope = cylinder.shape(part)
    wider = math.sqrt(1.0 + m.tool_radius / cylinder.radius)
    step = m.step(concave, slope) / wider
    over = min(MOST_OVER * m.tool_radius, m.tool_radius * slope / math.sqrt(1.0 + slope * slope) + step)
    outline = Aperture((part.lens.half_size[1 - cylinder.bent] + over, cylinder.radius * turn + over))
    step = spacing("raster", outline, step)
    scallop = m.scallop_of(step * wider, concave, slope)
    tolerance = PATH_PART * scallop if tolerance is None else tolerance
    top = m.top(high)
    with atomic_file(path) as file:
        out = Writer(file, digits_of(tolerance / unit), unit, simple, letters="XAZ")
        out.start(*_head(part, cylinder, m, step, scallop, top, tolerance))
        begin(out, "ball", m.tool_radius, m.spindle, top + m.safe_height)
        offset, first = RadialOffset(cylinder, part.field, part.heights, m.tool_radius), True
        spans = (2.0 * r / (len(s.breaks) - 1) for s, r in zip(part.field.spaces, part.field.half_size, strict=True))
        move = min(FIRST_MOVE * m.tool_radius, *spans)
        for line in batches(raster(outline, step), move):
            points = cylinder.program(with_heights(line, offset, move, tolerance)) * [1.0, unit, 1.0]  # A has no unit of length
            if first:
                descend(out, points[0], top, m.plunge)
            first = False
            out.cut(points, m.feed)
        out.end(top + m.safe_height)
    turned = math.degrees(outline.half_size[1] / cylinder.radius)
    return figures_of(out, out.minutes, m.tool_radius, step, scallop, tolerance, top) | {"turned_deg": turned}


def _head(part: Part, cylinder: _Cylinder, m: Milling, step: float, scallop: float, top: float, tolerance: float) -> list[str]:
    """Header comments."""
    axis, across = ("y", "-x") if cylinder.bent == 0 else ("x", "y")
    return [
        f"({CREATED})",
        f"(part: {part.kind}, on a cylinder of radius {cylinder.radius:g} mm, with a rotary axis A about X)",
        f"(X0: the middle of the part; X is its {axis}, Y0 its axis, Y would be {across})",
        f"(Z0: the axis of the cylinder and of A, {cylinder.axis:.17g} mm is its z in other formats; X Z are of the tool's tip)",
        "(A: degrees from the vertex, as if the tool moved around the part: it is over Y = -Z sin A)",
        f"(rotary: axis along {axis} at z = {cylinder.axis:.17g} mm)",
        f"(blank: a cylinder or tube, outer radius at least {top:g} mm, or as it is)",
        f"(finishing: passes along X, step-over {step:.6g} mm on the cylinder, scallops up to {scallop:.3g} mm, moves within"
        f" {tolerance:.3g} mm)",
        f"(units: {'inches' if m.dialect.endswith('inch') else 'mm'} and degrees, F of moves along X and Z; comments in mm)",
    ]
