"""What finishing does to a surface: sanding, polishing, coating, and the steps of a printer, on a grid over the aperture.

Sanding and polishing, a step that removes z on average with a pad of plane-strain modulus E pressed by p: an elastic half-space in
full contact with a ripple of amplitude a and frequency f presses on it by pi E f a more than on the mean (Johnson, Contact
Mechanics, 13.2), and removal is proportional to pressure (Preston), so that

    da/dz = -pi E f a / p,    T(f) = exp(-f z s),    s = pi E / p.

The half-space does not resist bending, so T(0) = 1; a ripple deeper than 1 / (s f) loses contact in its valleys and is rounded off
less than this.  A coat of thickness h levels by surface tension before it cures (Orchard, Appl. Sci. Res. A 11, 451, 1963):

    T(f) = exp(-(2 pi f)^4 h^3 c),    c = sigma t / (3 eta),

where it covers the relief and has the index of the part.  A printed part has steps of its layers and of its pixels, which a coat
levels likewise.  Roughness that a step leaves or finds is levelled by T at its own frequency, 1 / (2 pi correlation length).

Constants are those of ordinary workshops and known to factors of `UNSURE`, which `stronger` and `weaker` steps take into account.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy import fft
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import GridSpline, SplineSpace
from caustic_cli.optics.surfaces.base import Surface
from caustic_cli.optics.surfaces.heightfield import HeightField

#: s of a cloth or felt pad (E of 0.5 MPa at 20 kPa), and of abrasive paper on a rubber block (2 MPa), 1/mm per mm.
CLOTH, BLOCK = 80.0, 310.0
#: c of a varnish: 0.03 N/m for a minute, at 0.3 Pa s; mm.
LEVELLING = 2000.0
#: Factors within which these are known.
UNSURE, UNSURE_LEVELLING = 2.0, 4.0
#: Median grain, µm, of abrasive papers P240 to P2500 (FEPA, ISO 6344-3).
GRAINS = {240: 58.5, 280: 52.2, 320: 46.2, 360: 40.5, 400: 35.0, 500: 30.2, 600: 25.8, 800: 21.8, 1000: 18.3, 1200: 15.3}
GRAINS |= {1500: 12.6, 2000: 10.3, 2500: 8.4}
#: RMS roughness and correlation length that a paper leaves, in grains: Ra of 0.4 µm by P400, within a factor of two.
ROUGH, CORRELATED = 1 / 70.0, 0.5
#: Slope below which roughness does not show: it displaces light by a hundredth of a millimetre a metre away.
SMOOTH = 1e-5
#: Points of the grid along an axis: least, most, and for what a tool left; to a knot span of the surface, to a printer's pixel.
LEAST_POINTS, MOST_POINTS, TOOLED, A_SPAN, A_PIXEL = 513, 2049, 1025, 2, 4
#: Half width of the riser of a step, pixels.
RISER = 1e-3
#: What a correction leaves: T^2 / (T^2 + LEFT^2) of each frequency; relief grows 1 / (2 LEFT) times at most.
LEFT = 0.03
#: Degree of the polynomials in x and y that finishing does not change, and which are not corrected.
KEPT = 2
#: Ranges of what is removed, of a coat, of layers and of pixels, µm.
REMOVED, COAT, LAYER, PIXEL = (0.01, 1000.0), (0.1, 200.0), (0.1, 1000.0), (1.0, 1000.0)
#: What finishes are written as.
FORMS = "sanded:GRIT[,GRIT...], polished:UM, coated:UM, printed:LAYER,PIXEL[,COAT] (µm) or milled:FILE, joined by +"


class ResidualRoughness(NamedTuple):
    """RMS height and correlation length, mm; slopes have a standard deviation of `slope` along an axis."""

    height: float = 0.0
    length: float = 1.0

    @property
    def slope(self) -> float:
        """Of a Gaussian correlation."""
        return math.sqrt(2.0) * self.height / self.length


@dataclass(frozen=True)
class Finish:
    """One step."""

    #: As it was given.
    text: str
    #: Of a program that cut one part, which therefore cannot be corrected for.
    program: str = ""

    def transfer(self, f: np.ndarray) -> np.ndarray:
        """What remains of a ripple of frequency f, 1/mm."""
        return np.ones_like(f)

    def shaped(self, z: np.ndarray, spacing: tuple[float, float]) -> np.ndarray:
        """Heights (n, m), mm, on a grid of this spacing, mm, beside the filter."""
        return z

    def exactly(self, relief: Relief) -> tuple[HeightField, Tensor] | None:
        """The surface that it makes of one, and its control heights, where no grid holds it."""
        return None

    def left(self, before: ResidualRoughness) -> ResidualRoughness:
        """The roughness after it."""
        f = np.array(1.0 / (2.0 * math.pi * before.length))
        return before._replace(height=before.height * float(self.transfer(f)))

    def by(self, strength: float) -> Finish:
        """The same with constants at the end of what is known of them, for 1 the stronger, for -1 the weaker one."""
        return self


@dataclass(frozen=True, kw_only=True)
class Pad(Finish):
    """Sanded or polished: removes `depth` mm by a pad of `stiffness` s; leaves `rough` of its own, or levels what there is."""

    depth: float
    stiffness: float
    rough: ResidualRoughness | None = None

    def transfer(self, f: np.ndarray) -> np.ndarray:
        return np.exp(-f * self.depth * self.stiffness)

    def left(self, before: ResidualRoughness) -> ResidualRoughness:
        return super().left(before) if self.rough is None else self.rough

    def by(self, strength: float) -> Finish:
        return replace(self, stiffness=self.stiffness * UNSURE**strength)


@dataclass(frozen=True, kw_only=True)
class Coat(Finish):
    """A coat of `depth` mm."""

    depth: float
    levelling: float = LEVELLING

    def transfer(self, f: np.ndarray) -> np.ndarray:
        return np.exp(-((2.0 * math.pi * f) ** 4) * self.depth**3 * self.levelling)

    def by(self, strength: float) -> Finish:
        return replace(self, levelling=self.levelling * UNSURE_LEVELLING**strength)


@dataclass(frozen=True, kw_only=True)
class Printed(Finish):
    """Steps of `layer` mm over pixels of `pixel` mm."""

    layer: float
    pixel: float

    def shaped(self, z: np.ndarray, spacing: tuple[float, float]) -> np.ndarray:
        """Each pixel at its middle's height, rounded to layers."""
        middles = []
        for n, step in zip(z.shape, spacing, strict=True):
            x = (np.arange(n) - 0.5 * (n - 1)) * step
            at = (np.floor(x / self.pixel) + 0.5) * self.pixel
            middles.append(np.clip(np.rint(at / step + 0.5 * (n - 1)), 0, n - 1).astype(int))
        return self.layer * np.rint(z[np.ix_(*middles)] / self.layer)

    def exactly(self, relief: Relief) -> tuple[HeightField, Tensor]:
        """Terraces that are flat up to RISER pixels from their edges: a spline between points would make lenses of the edges."""
        middles, spaces = [], []
        for r in relief.half_size:
            inner = np.arange(math.floor(-r / self.pixel) + 1, math.ceil(r / self.pixel)) * self.pixel
            edges = np.concatenate([[-r], inner, [r]])
            middles.append(np.clip((np.floor(0.5 * (edges[1:] + edges[:-1]) / self.pixel) + 0.5) * self.pixel, -r, r))
            sides = (inner[:, None] + RISER * self.pixel * np.array([-1.0, 1.0])).ravel()
            knots = np.concatenate([[0.0, 0.0], 0.5 * (sides / r + 1.0), [1.0, 1.0]])
            spaces.append(SplineSpace(1, torch.from_numpy(knots)))
        z = self.layer * np.rint(relief.at(*middles) / self.layer)
        return HeightField((spaces[0], spaces[1]), relief.half_size), torch.from_numpy(z.repeat(2, 0).repeat(2, 1))


def parse(text: str) -> tuple[Finish, ...]:
    """The steps of a finish, as in FORMS, in their order.

    Raises:
        InputError: it is not written so.
    """
    steps: list[Finish] = []
    for word in (w.strip() for w in text.split("+")):
        name, _, values = word.partition(":")
        if name not in STEPS or not values:
            raise InputError(f"⟨finish⟩ {text!r}: must be {FORMS}, got {word!r}")
        steps += STEPS[name](word, values)
    if any(step.program for step in steps[1:]):
        raise InputError(f"⟨finish⟩ {text!r}: milled comes first, since other steps follow what the tool leaves")
    return tuple(steps)


def _lengths(word: str, values: str, *ranges: tuple[float, float], optional: int = 0) -> list[float]:
    """Lengths, mm, from µm."""
    given = values.split(",")
    if not len(ranges) - optional <= len(given) <= len(ranges):
        raise InputError(f"⟨finish⟩ {word}: must be {FORMS}")
    found = []
    for value, (low, high) in zip(given, ranges, strict=False):
        try:
            one = float(value)
        except ValueError:
            one = math.nan
        if not low <= one <= high:
            raise InputError(f"⟨finish⟩ {word}: must be {low:g} to {high:g} µm, got {value!r}")
        found.append(1e-3 * one)
    return found


def _sanded(word: str, values: str) -> list[Finish]:
    steps: list[Finish] = []
    for grit in values.split(","):
        grain = GRAINS.get(int(grit)) if grit.isdecimal() else None
        if grain is None:
            raise InputError(f"⟨finish⟩ {word}: a grit must be one of P{', P'.join(map(str, GRAINS))} without P, got {grit!r}")
        left = ResidualRoughness(1e-3 * grain * ROUGH, 1e-3 * grain * CORRELATED)
        steps.append(Pad(f"sanded:{grit}", depth=1e-3 * grain, stiffness=BLOCK, rough=left))
    return steps


def _printed(word: str, values: str) -> list[Finish]:
    layer, pixel, *coat = _lengths(word, values, LAYER, PIXEL, COAT, optional=1)
    return [Printed(word, layer=layer, pixel=pixel), *(Coat(word, depth=depth) for depth in coat)]


#: Name -> a function of the word and its values.
STEPS: dict[str, Callable[[str, str], list[Finish]]] = {
    "sanded": _sanded,
    "polished": lambda word, values: [Pad(word, depth=_lengths(word, values, REMOVED)[0], stiffness=CLOTH)],
    "coated": lambda word, values: [Coat(word, depth=_lengths(word, values, COAT)[0])],
    "printed": _printed,
    "milled": lambda word, values: [Finish(word, values)],  # its surface takes the place of the lens'
}


def transfer(steps: tuple[Finish, ...], f: np.ndarray) -> np.ndarray:
    """What remains of a ripple of frequency f, 1/mm, after all steps."""
    return np.prod([step.transfer(f) for step in steps], axis=0)


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights `z` (n, m), mm, on an equidistant grid over an aperture of these half widths, its borders included."""

    z: np.ndarray
    half_size: tuple[float, float]
    lines: tuple[np.ndarray, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        lines = (np.linspace(-r, r, n) for r, n in zip(self.half_size, self.z.shape, strict=True))
        object.__setattr__(self, "lines", tuple(lines))

    @property
    def spacing(self) -> tuple[float, float]:
        """Of the grid, mm."""
        return self.lines[0][1] - self.lines[0][0], self.lines[1][1] - self.lines[1][0]

    def filtered(self, factor: Callable[[np.ndarray], np.ndarray]) -> Relief:
        """With each frequency f, 1/mm, multiplied by factor(f), but for polynomials of degree KEPT.

        Beyond its borders the relief is continued by reflection in its end points, which keeps heights and slopes.
        """
        kept, beyond = self._smooth(), [n // 2 for n in self.z.shape]
        wide = np.pad(self.z - kept, [(n, n) for n in beyond], mode="reflect", reflect_type="odd")
        for axis, n in enumerate(beyond):
            rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n // 2) + 0.5) / (n // 2))
            fade = np.concatenate([rise, np.ones(wide.shape[axis] - 2 * len(rise)), rise[::-1]])
            wide *= np.expand_dims(fade, 1 - axis)
        fx, fy = (fft.fftfreq(n, step) for n, step in zip(wide.shape, self.spacing, strict=True))
        spectrum = fft.rfft2(wide, workers=torch.get_num_threads())
        spectrum *= factor(np.hypot(fx[:, None], np.abs(fy[: spectrum.shape[1]])[None, :]))
        out = fft.irfft2(spectrum, wide.shape, workers=torch.get_num_threads())
        return Relief(kept + out[beyond[0] : -beyond[0], beyond[1] : -beyond[1]], self.half_size)

    def _smooth(self) -> np.ndarray:
        """Least-squares polynomial of degree KEPT along either axis, by orthonormal ones."""
        bases = [np.linalg.qr(np.vander(np.linspace(-1, 1, n), KEPT + 1))[0] for n in self.z.shape]
        return bases[0] @ (bases[0].T @ self.z @ bases[1]) @ bases[1].T

    @classmethod
    def of(cls, surface: Surface[None], half_size: tuple[float, float], shape: tuple[int, int]) -> Relief:
        """Of a surface without control heights, at so many points along x and y."""
        lines = (torch.linspace(-r, r, n, dtype=torch.float64) for r, n in zip(half_size, shape, strict=True))
        x, y = (c.reshape(-1) for c in torch.meshgrid(*lines, indexing="ij"))
        return cls(surface.at(None, x, y)[0].view(shape).numpy(), half_size)

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The spline through it on grid lines x (a,), y (b,), mm: (a, b)."""
        return GridSpline(*self.lines, self.z)(x, y)

    def on(self, field: HeightField) -> tuple[HeightField, Tensor]:
        """The spline that interpolates it at the Greville abscissae of a surface, and its control heights (n, m), mm."""
        x, y = (c.numpy() for c in field.control_xy())
        return field, field.interpolated(torch.from_numpy(self.at(x, y)))


def points(steps: tuple[Finish, ...], field: HeightField) -> tuple[int, int]:
    """Points of the grid along x and y: some to each knot span and to each pixel of a printer, within limits; TOOLED for what a
    tool left.

    Raises:
        InputError: the pixels of a printer are too fine for this lens.
    """
    pixel = min((step.pixel for step in steps if isinstance(step, Printed)), default=math.inf)
    found = []
    for n, r in zip(field.shape, field.half_size, strict=True):
        wanted = TOOLED if any(step.program for step in steps) else max(A_SPAN * n, A_PIXEL * 2.0 * r / pixel)
        found.append(int(min(max(wanted, LEAST_POINTS), MOST_POINTS)) // 2 * 2 + 1)
        if 2.0 * r / pixel > (MOST_POINTS - 1) / A_PIXEL:
            least = 1e3 * A_PIXEL * 2.0 * r / (MOST_POINTS - 1)
            raise InputError(f"⟨finish⟩: pixels must be at least {least:.3g} µm on this lens, got {1e3 * pixel:g} µm")
    return found[0], found[1]


def printer(text: str) -> tuple[float, float] | None:
    """Layers and pixels, mm, of the printer among the steps of a finish; None without one."""
    return next(((step.layer, step.pixel) for step in parse(text) if isinstance(step, Printed)), None) if text else None


def finished(steps: tuple[Finish, ...], relief: Relief, like: HeightField) -> tuple[HeightField, Tensor]:
    """The surface after all steps: on a net with all details where a printer or a tool left some, else on that of the lens, `like`;
    relief: before the steps, at so many `points`."""
    for step in steps:
        before, relief = relief, Relief(step.shaped(relief.z, relief.spacing), relief.half_size).filtered(step.transfer)
    if (exact := steps[-1].exactly(before)) is not None:
        return exact
    detailed = any(step.program or isinstance(step, Printed) for step in steps)
    return HeightField.through(relief.z, relief.half_size) if detailed else relief.on(like)


def roughness(steps: tuple[Finish, ...]) -> ResidualRoughness:
    """What the steps leave of it, on a surface that was smooth."""
    rough = ResidualRoughness()
    for step in steps:
        rough = step.left(rough)
    return rough


def refuse_program(steps: tuple[Finish, ...]) -> None:
    """Refuse a step that is a program, which cuts one part.

    Raises:
        InputError: there is one.
    """
    for step in steps:
        if step.program:
            raise InputError(f"⟨finish⟩ {step.text}: is how one part was cut, and a design has no program yet")


def corrected(steps: tuple[Finish, ...], field: HeightField, heights: Tensor) -> tuple[HeightField, Tensor]:
    """The surface to be made so that these steps turn it into the given one, as far as they leave its details; on the same net."""

    def factor(f: np.ndarray) -> np.ndarray:
        t = transfer(steps, f)
        return t * (1.0 + LEFT * LEFT) / (t * t + LEFT * LEFT)

    relief = Relief(field.on_grid(heights, points((), field)).numpy(), field.half_size)
    return relief.filtered(factor).on(field)
