"""Tolerances: probability distributions of manufacturing and alignment errors of source, lens and screen.

An error is normally distributed, with standard deviation sigma, or uniformly within a half width; an error of two axes has one
width for each.  Errors are mutually independent.  Lengths are mm, angles degrees.

The form error is a random surface added to the exit: a Gaussian, isotropic field whose power spectral density is f^-exponent
between the frequencies 1 / longest and 1 / shortest, and 0 outside.  Waviness is a sine wave of random phase, as machining leaves
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.schema import checks

NORMAL, UNIFORM = "sigma", "half_width"
#: Least and largest number of Monte Carlo samples.
LEAST_DRAWS, MOST_DRAWS = 10, 100_000


@dataclass(frozen=True)
class Kind:
    """A kind of error: its axes ("" for a scalar), unit, largest accepted width, and meaning."""

    axes: tuple[str, ...]
    unit: str
    most: float
    help: str


XY, ABOUT = ("x", "y"), ("x", "y")
KINDS = {
    "index": Kind(("",), "", 0.5, "refractive index, at every wavelength alike"),
    "thickness": Kind(("",), "mm", 1e3, "centre thickness of the lens: the exit as a whole is shifted along the axis"),
    "throw": Kind(("",), "mm", 1e6, "distance of the screen, along the light"),
    "source_shift": Kind(XY, "mm", 1e6, "decentre of a source at a finite distance, or of the beam of a plane wave with a profile"),
    "source_distance": Kind(("",), "mm", 1e6, "axial shift of a source at a finite distance"),
    "source_size": Kind(("",), "", 0.25, "width of a disc or grid, as a fraction of itself"),
    "source_tilt": Kind(ABOUT, "degrees", 20.0, "direction of light from infinity: rotations about the x and y axes"),
    "lens_shift": Kind(XY, "mm", 1e4, "decentre of the lens, its entrance and exit together, in the light"),
    "lens_tilt": Kind(ABOUT, "degrees", 10.0, "rotations of the lens about the x and y axes through the centre of its entrance"),
    "screen_shift": Kind(XY, "mm", 1e6, "decentre of the screen"),
    "screen_tilt": Kind(ABOUT, "degrees", 20.0, "rotations of the screen about its own centre"),
    "wavelength": Kind(("",), "", 0.1, "of the light, as a fraction of itself, by which the index of a glass changes"),
    "aperture": Kind(("",), "", 0.5, "width of the lit part of the lens, as a fraction; a wider one changes nothing"),
    "roughness": Kind(("",), "", 0.1, "RMS slope, along either axis, of the exit's microfacets in addition to the scene's own"),
}


@dataclass(frozen=True)
class Tolerance:
    """An error: its name in KINDS; distribution, NORMAL or UNIFORM; width, sigma or half width along each of its axes.

    Raises:
        InputError: a width is negative or too large, or their number is wrong.
    """

    name: str
    distribution: str
    width: tuple[float, ...]

    def __post_init__(self):
        kind, where = KINDS[self.name], f"[{self.name}] {self.distribution}"
        if len(self.width) != len(kind.axes):
            raise InputError(
                f"{where} must be {'a number' if len(kind.axes) == 1 else 'a pair [x, y]'}, got {len(self.width)} numbers"
            )
        most = kind.most * (1.0 if self.distribution == NORMAL else 3.0)
        for width in self.width:
            checks.number(where, width, 0.0, most)


@dataclass(frozen=True)
class FormError:
    """A random form error."""

    #: mm, over all realisations.
    rms: float
    #: Of its two-dimensional power spectral density.
    exponent: float = 2.0
    #: Its range of spatial wavelengths, mm, longest None for the lens' larger side.
    longest: float | None = None
    shortest: float = 1.0

    def __post_init__(self):
        checks.number("[form_error] rms", self.rms, 0.0, 1.0)
        checks.number("[form_error] exponent", self.exponent, 0.0, 10.0)
        checks.number("[form_error] shortest", self.shortest, 0.0, 1e6, open_low=True)
        if self.longest is not None:
            checks.number("[form_error] longest", self.longest, 0.0, 1e6, open_low=True)
            if not self.longest > self.shortest:
                raise InputError(f"[form_error] longest must exceed shortest, {self.shortest:g} mm, got {self.longest:g} mm")


@dataclass(frozen=True)
class Waviness:
    """A sine wave of this amplitude and period, mm, with wave vector along `direction`, degrees from +x."""

    amplitude: float
    period: float
    direction: float = 0.0

    def __post_init__(self):
        checks.number("[waviness] amplitude", self.amplitude, 0.0, 1.0)
        checks.number("[waviness] period", self.period, 0.0, 1e6, open_low=True)
        checks.number("[waviness] direction", self.direction, -360.0, 360.0)


@dataclass(frozen=True)
class Parameter:
    """One random variable of a tolerance study: its name, such as "lens_shift x"; error and axis; unit; distribution and width."""

    name: str
    error: str
    axis: int
    unit: str
    distribution: str
    width: float

    @property
    def sigma(self) -> float:
        """Standard deviation, in `unit`."""
        return self.width if self.distribution == NORMAL else self.width / math.sqrt(3.0)


@dataclass(frozen=True)
class Tolerances:
    """All errors, with the number of Monte Carlo samples and their seed.

    Raises:
        InputError: all widths are 0, an error is given twice, or a number is out of range.
    """

    errors: tuple[Tolerance, ...] = ()
    form: FormError | None = None
    waviness: Waviness | None = None
    draws: int = 200
    seed: int = 0

    def __post_init__(self):
        checks.whole("draws", self.draws, LEAST_DRAWS, MOST_DRAWS)
        checks.whole("seed", self.seed, 0, 2**31 - 1)
        names = [e.name for e in self.errors]
        if len(set(names)) < len(names):
            raise InputError(f"every error may be given once, got {', '.join(names)}")
        if not (self.parameters or self.surface):
            raise InputError("all widths are 0: at least one error must have a width above 0")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The random variables with a width above 0."""
        parameters = []
        for error in self.errors:
            kind = KINDS[error.name]
            for axis, (label, width) in enumerate(zip(kind.axes, error.width, strict=True)):
                if width > 0:
                    name = f"{error.name} {label}".strip()
                    parameters.append(Parameter(name, error.name, axis, kind.unit, error.distribution, width))
        return tuple(parameters)

    @property
    def surface(self) -> tuple[str, ...]:
        """Names of the errors of the surface itself, of which every sample has a new realisation."""
        form = ("form_error",) if self.form is not None and self.form.rms > 0 else ()
        return form + (("waviness",) if self.waviness is not None and self.waviness.amplitude > 0 else ())

    @property
    def shortest(self) -> float:
        """The shortest spatial wavelength of the surface's errors, mm; inf if there are none."""
        form = self.form.shortest if self.form is not None and self.form.rms > 0 else math.inf
        return min(form, self.waviness.period if self.waviness is not None and self.waviness.amplitude > 0 else math.inf)


def hypercube(parameters: tuple[Parameter, ...], draws: int, seed: int, purpose: int = 0) -> np.ndarray:
    """A Latin hypercube sample of the parameters, in their units: (draws, len(parameters)).

    purpose: different numbers give independent samples.
    """
    rng = np.random.default_rng([seed, purpose])
    columns = []
    for p in parameters:
        u = (rng.permutation(draws) + rng.random(draws)) / draws
        columns.append(p.width * (np.array([NormalDist().inv_cdf(v) for v in u]) if p.distribution == NORMAL else 2.0 * u - 1.0))
    return np.stack(columns, 1) if columns else np.zeros((draws, 0))
