"""Spectra of light sources, the eye and other detectors, and the wavelengths and weights that represent them.

Notation
    lambda     wavelength, nm
    S(lambda)  spectral power per nm, relative; linear between the wavelengths of a table, 0 outside
    V(lambda)  luminous efficiency of the photopic eye, the second of the colour-matching functions
    w(lambda)  density of a measure, S V for the eye and S for a meter of power, with the integral 1

The tables beside this module are those of CIE 15:2018, ISO/CIE 11664-1 and 11664-2, and ASTM G173-03; the first line of each names
its source.

A wave image varies with the wavelength like a band-limited function, with a correlation length of some tens of nanometres: equally
spaced wavelengths resolve it with the fewest.  Of the default flame by an eye, 7 of them give the error of 46 within 0.2 %, where a
Gauss rule, whose nodes crowd where there is little light, needs 17 for 1 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from caustic_cli.errors import InputError, alternatives, near

FOLDER = Path(__file__).parent / "spectra"
#: Built-in spectra, and what they are.
BUILT_IN = {
    "equal": "equal power per nm, 380 to 780 nm",
    "daylight": "CIE standard illuminant D65",
    "sun": "sunlight at air mass 1.5, ASTM G173-03 global tilt",
    "led-3000": "warm white LED, CIE LED-B2",
    "led-4000": "neutral white LED, CIE LED-B3",
    "led-6500": "cold white LED, CIE LED-B5",
    "halogen": "incandescent lamp of 2856 K, CIE standard illuminant A",
}
#: What light is measured by: V(lambda), or power whatever its wavelength.
DETECTORS = ("eye", "power")
#: Range of visible light, nm.
VISIBLE = (380.0, 780.0)
#: Range of the nodes for the eye, which sees 0.1 % of the light of equal energy outside, nm.
SEEN = (400.0, 700.0)
#: Range of white light of equal energy where power is measured, nm.
BAND = (450.0, 650.0)
#: Largest luminous efficacy of radiation, lm/W: K_m as in CIE 15:2018, which rounds 683.002.
K_M = 683.0
#: Wavelengths of a table, and their range, nm.
MOST_ROWS = 10_000
WAVELENGTHS = (100.0, 20_000.0)
#: Share of the power in visible light below which a spectrum counts as invisible.
INVISIBLE = 0.01
#: Most wavelengths of a rule.
MOST_NODES = 128
#: Least area of the triangle of three wavelengths in the chromaticity diagram, doubled, for which they mix colours; sRGB has 0.22.
LEAST_GAMUT = 0.01
#: Share of the light at either end of a spectrum that takes no wavelength of its own.
TAIL = 0.01
#: Least width of a range, nm.
TINY = 1e-9
#: Intervals of the discretisation over the whole range, at least, and Gauss-Legendre points of each.
INTERVALS, POINTS = 400, 8
#: Share of the light that counts as none.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The spectrum of a source, linear between its wavelengths and 0 outside.

    Raises:
        InputError: a condition is violated, or there is no power at all.
    """

    #: For messages: that of a built-in spectrum, or a file.
    name: str
    #: (k,) nm, ascending.
    wavelengths: np.ndarray
    #: (k,) relative power per nm, not negative.
    power: np.ndarray

    def __post_init__(self):
        wavelengths, power = (np.array(v, dtype=np.float64) for v in (self.wavelengths, self.power))
        if wavelengths.ndim != 1 or power.shape != wavelengths.shape or not 2 <= len(wavelengths) <= MOST_ROWS:
            raise InputError(
                f"must have 2 to {MOST_ROWS:,} wavelengths and a power for each, got {wavelengths.size:,} and {power.size:,}"
            )
        low, high = WAVELENGTHS
        if not (np.isfinite(wavelengths) & (wavelengths >= low) & (wavelengths <= high)).all():
            raise InputError(f"must have wavelengths of {low:g} to {high:g} nm")
        steps = np.diff(wavelengths)
        if not (steps > 0).all():
            k = int(np.argmin(steps > 0))
            what = "twice" if steps[k] == 0 else f"and then {wavelengths[k + 1]:g} nm"
            raise InputError(f"must have ascending wavelengths, each once, got {wavelengths[k]:g} nm {what}")
        if not (np.isfinite(power) & (power >= 0) & (power <= 1e300)).all():
            raise InputError("must have powers that are finite, at least 0 and at most 1e300")
        if not power.any():
            raise InputError("must have power at some wavelength")
        for key, value in (("wavelengths", wavelengths), ("power", power)):
            value.flags.writeable = False
            object.__setattr__(self, key, value)

    def at(self, wavelengths: np.ndarray) -> np.ndarray:
        """S relative to its largest value, at wavelengths in nm."""
        return np.interp(wavelengths, self.wavelengths, self.power / self.power.max(), 0.0, 0.0)


@cache
def _table(name: str) -> np.ndarray:
    """Rows of one of the tables beside this module."""
    path = FOLDER / f"{name}.csv"
    lines = path.read_text(encoding="ascii").splitlines()[2:]  # a comment and the names of the columns
    return np.array([[float(cell) for cell in line.split(",")] for line in lines])


@cache
def built_in(name: str) -> Spectrum:
    """A built-in spectrum; case does not matter.

    Raises:
        InputError: there is none of that name.
    """
    name = name.casefold()
    if name not in BUILT_IN:
        raise InputError(f"{name!r} is no spectrum{near(name, BUILT_IN)}, or the name of a .csv file")
    if name == "equal":
        return Spectrum(name, np.array(VISIBLE), np.ones(2))
    return Spectrum(name, *_table(name).T)


def tristimulus(wavelengths: np.ndarray) -> np.ndarray:
    """Colour-matching functions x, y and z of the CIE 1931 2-degree observer, (n, 3), at wavelengths (n,) nm: linear between those
    of the table, 360 to 830 nm in steps of 1 nm, 0 outside."""
    at, *columns = _table("observer").T
    return np.stack([np.interp(wavelengths, at, c, 0.0, 0.0) for c in columns], axis=-1)


def primaries(wavelengths: Sequence[float]) -> np.ndarray:
    """X, Y, Z of a unit of power at each of three wavelengths, nm, as the columns of a matrix (3, 3), without the factor K_m.

    Raises:
        InputError: their chromaticities are nearly on a line, or the eye sees one of them not at all, so that they mix no picture.
    """
    found = tristimulus(np.asarray(wavelengths, dtype=float)).T
    with np.errstate(invalid="ignore"):
        gamut = abs(float(np.linalg.det(found / found.sum(0))))
    if not gamut >= LEAST_GAMUT:
        said = ", ".join(f"{w:g}" for w in wavelengths)
        raise InputError(f"⟨source.wavelengths⟩ {said} nm mix too few colours for a picture: a red, a green and a blue are needed")
    return found


def luminous_efficiency(wavelengths: np.ndarray) -> np.ndarray:
    """V, (n,), at wavelengths (n,) nm."""
    return tristimulus(wavelengths)[..., 1]


def luminous_efficacy(spectrum: Spectrum) -> float:
    """Luminous efficacy of radiation, K_m times the integral of S V over that of S, lm/W.

    The power is that within the wavelengths of the spectrum's own table, and radiation outside is not counted: for the sun 280 to
    4000 nm, nearly all of it, but for halogen and daylight 300 to 780 nm, which leaves out most of the heat of an incandescent
    lamp.
    """
    x, weights = _quadrature(_knots(spectrum, *spectrum.wavelengths[[0, -1]]))
    s = spectrum.at(x) * weights
    return float(K_M * (s @ luminous_efficiency(x)) / s.sum())


def white_point(spectrum: Spectrum) -> tuple[float, float, float]:
    """Tristimulus values X, Y, Z of the source for the CIE 1931 2-degree observer, with Y = 1.

    Raises:
        InputError: it has no visible light.
    """
    x, weights = _quadrature(_knots(spectrum, *spectrum.wavelengths[[0, -1]]))
    xyz = (spectrum.at(x) * weights) @ tristimulus(x)
    if not xyz[1] > 0:
        raise InputError(f"{spectrum.name}: has no visible light")
    large, luminous, small = (xyz / xyz[1]).tolist()
    return large, luminous, small


@dataclass(frozen=True, eq=False)
class Measure:
    """A spectrum as a detector weights it: a density w over wavelength.

    It is restricted to 400 to 700 nm for the eye, and to 380 to 780 nm for power, since pictures are for visible light, for which
    glasses and plastics are made and specified; the infrared of the sun must not move the wavelengths for which a lens is designed,
    nor a thousandth of the visible light take one of its few nodes.  The exception is a source of which less
    than 1% of the power is visible, an infrared lamp, measured by power: it keeps its own range.

    Raises:
        InputError: an unknown detector, or there is no power that it measures.
    """

    #: Of the source.
    spectrum: Spectrum
    #: eye or power.
    detector: str = "eye"

    def __post_init__(self):
        if self.detector not in DETECTORS:
            raise InputError(f"the detector must be {alternatives(DETECTORS)}, got {self.detector!r}")
        if not self._total > 0:
            low, high = SEEN
            raise InputError(f"{self.spectrum.name}: has no power that the eye sees, {low:g} to {high:g} nm")

    @cached_property
    def range(self) -> tuple[float, float]:
        """Shortest and longest wavelength with any density, nm."""
        knots = self._knots
        full = np.flatnonzero(self._integrals)
        return float(knots[full[0]]), float(knots[full[-1] + 1])

    @cached_property
    def mean(self) -> float:
        """Mean wavelength, nm."""
        x, weights = self._points
        return float(x @ weights)

    @cached_property
    def spread(self) -> float:
        """Standard deviation of the wavelength, nm."""
        x, weights = self._points
        return float(np.sqrt((x - self.mean) ** 2 @ weights))

    def density(self, wavelengths: np.ndarray) -> np.ndarray:
        """w, 1/nm, at wavelengths in nm."""
        low, high = self._knots[[0, -1]]
        return np.where((wavelengths >= low) & (wavelengths <= high), self._measured(wavelengths) / self._total, 0.0)

    def nodes(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """n wavelengths, nm, ascending, that represent the spectrum, and their weights, as of `weights_at`.

        They are the mean wavelengths of n equal parts of the range that has all but TAIL of the light at either end; fewer where a
        part is dark.

        Raises:
            InputError: n is not 1 to MOST_NODES.
        """
        if not 1 <= n <= MOST_NODES:
            raise InputError(f"the number of wavelengths must be 1 to {MOST_NODES}, got {n}")
        x, weights = self._points
        sums = np.cumsum(weights)
        low, high = x[np.searchsorted(sums, (TAIL, 1.0 - TAIL))]
        part = np.clip((x - low) / max(high - low, TINY) * n, 0, n - 1).astype(int)
        whole = np.bincount(part, weights, n)
        at = np.bincount(part, weights * x, n)[whole > ROUNDING] / whole[whole > ROUNDING]
        return at, self.weights_at(at)

    def rule(self, n: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """`nodes` as numbers."""
        wavelengths, weights = self.nodes(n)
        return tuple(wavelengths.tolist()), tuple(weights.tolist())

    def weights_at(self, wavelengths: np.ndarray) -> np.ndarray:
        """Weights (n,) of given wavelengths (n,) nm, ascending: the share of the light whose nearest wavelength each is.

        Raises:
            InputError: the wavelengths do not ascend.
        """
        at = np.asarray(wavelengths, dtype=np.float64)
        if at.ndim != 1 or not len(at) or not np.isfinite(at).all() or not (np.diff(at) > 0).all():
            raise InputError("wavelengths must be finite and ascend")
        weights = np.maximum(np.diff(self._cumulative(0.5 * (at[1:] + at[:-1])), prepend=0.0, append=1.0), 0.0)
        return weights / weights.sum()

    @cached_property
    def white(self) -> tuple[float, float, float]:
        """Tristimulus values of all its light for the CIE 1931 2-degree observer, with Y = 1."""
        x, y, z = self._tristimulus_up_to(self._knots[-1:])[0]
        return float(x / y), 1.0, float(z / y)

    def colours_at(self, wavelengths: np.ndarray) -> np.ndarray:
        """Tristimulus values (n, 3), with Y = 1, of the light nearest to each of given wavelengths (n,) nm, ascending.

        Weighted by `weights_at` for the eye they add up to `white`.  Where there is no light they are those of the wavelength, or 0
        if that is invisible.
        """
        at = np.asarray(wavelengths, dtype=np.float64)
        ends = np.concatenate([self._knots[:1], 0.5 * (at[1:] + at[:-1]), self._knots[-1:]])
        xyz = np.diff(self._tristimulus_up_to(ends), axis=0)
        xyz = np.where(xyz[:, 1:2] > 0, xyz, tristimulus(at))
        return np.divide(xyz, xyz[:, 1:2], out=np.zeros_like(xyz), where=xyz[:, 1:2] > 0)

    def _cumulative(self, at: np.ndarray) -> np.ndarray:
        """Integral of w up to wavelengths, exact."""
        return self._up_to(self._measured, at) / self._total

    def _tristimulus_up_to(self, at: np.ndarray) -> np.ndarray:
        """Integrals (n, 3) of S times the colour-matching functions up to wavelengths (n,) nm, exact."""

        def of(column: int) -> Callable[[np.ndarray], np.ndarray]:
            return lambda x: self.spectrum.at(x) * tristimulus(x)[..., column]

        return np.stack([self._up_to(of(column), at) for column in range(3)], -1)

    def _up_to(self, function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
        """Integral, up to wavelengths (n,) nm, of a polynomial between the knots."""
        knots = self._knots
        sums = np.concatenate([[0.0], np.cumsum(_integrals(function, knots[:-1], knots[1:]))])
        at = np.clip(at, knots[0], knots[-1])
        k = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
        return sums[k] + _integrals(function, knots[k], at)

    def _measured(self, x: np.ndarray) -> np.ndarray:
        """S V or S."""
        s = self.spectrum.at(x)
        return s * luminous_efficiency(x) if self.detector == "eye" else s

    @cached_property
    def _knots(self) -> np.ndarray:
        """Wavelengths between which w is a polynomial, of degree 2 at most: those of both tables, nm."""
        spectrum, (low, high) = self.spectrum, SEEN if self.detector == "eye" else VISIBLE
        first, last = spectrum.wavelengths[[0, -1]]
        if self.detector == "power":
            everything, visible = (
                _integrals(spectrum.at, k[:-1], k[1:]).sum() if len(k := _knots(spectrum, *limits)) > 1 else 0.0
                for limits in ((first, last), (low, high))
            )
            low, high = (low, high) if visible >= INVISIBLE * everything else (first, last)
        return _knots(spectrum, low, high)

    @cached_property
    def _integrals(self) -> np.ndarray:
        """Integrals of S V or S between the knots."""
        knots = self._knots
        return _integrals(self._measured, knots[:-1], knots[1:])

    @cached_property
    def _total(self) -> float:
        return float(self._integrals.sum())

    @cached_property
    def _points(self) -> tuple[np.ndarray, np.ndarray]:
        """A fine discretisation: wavelengths and weights with the sum 1, those without weight left out."""
        x, weights = _quadrature(self._knots)
        weights = weights * self._measured(x)
        return x[weights > 0], weights[weights > 0] / weights.sum()


def luminous(wavelengths: tuple[float, ...], weights: tuple[float, ...] = ()) -> tuple[tuple[float, ...], float]:
    """Relative luminous flux (n,) of spectral lines (n,) nm with relative powers (n,), equal where none are given, and the luminous
    efficacy of all, lm/W."""
    power = np.array(weights or (1.0,) * len(wavelengths))
    seen = luminous_efficiency(np.array(wavelengths)) * power
    return tuple(seen.tolist()), float(K_M * seen.sum() / power.sum()) if power.any() else 0.0


def measure_of(spectrum: Spectrum | str = "equal", detector: str = "eye") -> Measure:
    """A spectrum, or a built-in one by its name, as a detector weights it.

    Equal energy measured by power is the white light of 450 to 650 nm by which earlier versions of this program judged.

    Raises:
        InputError: there is no such spectrum, or no power that the detector measures.
    """
    return _built_in_measure(spectrum, detector) if isinstance(spectrum, str) else Measure(spectrum, detector)


@cache
def _built_in_measure(name: str, detector: str) -> Measure:
    found = built_in(name)
    if (found.name, detector) == ("equal", "power"):
        found = Spectrum(found.name, np.array(BAND), np.ones(2))
    return Measure(found, detector)


def _knots(spectrum: Spectrum, low: float, high: float) -> np.ndarray:
    """Wavelengths of a spectrum and of the observer within a range, and the ends of what the spectrum has of it; none where they
    are apart."""
    low, high = max(low, spectrum.wavelengths[0]), min(high, spectrum.wavelengths[-1])
    if low >= high:
        return np.empty(0)
    inside = np.concatenate([spectrum.wavelengths, _table("observer")[:, 0]])
    return np.unique(np.concatenate([[low, high], inside[(inside > low) & (inside < high)]]))


def _integrals(function, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Integrals of polynomials of degree 3 at most, by two Gauss-Legendre points."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return half * (function(middle - half / np.sqrt(3.0)) + function(middle + half / np.sqrt(3.0)))


def _quadrature(knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre points and weights over the range of knots, none across one of them, nm."""
    parts = np.ceil(np.diff(knots) / ((knots[-1] - knots[0]) / INTERVALS) - 1e-9).astype(int).clip(1)
    width = np.repeat(np.diff(knots) / parts, parts)
    place = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    x, weights = np.polynomial.legendre.leggauss(POINTS)
    low = np.repeat(knots[:-1], parts) + place * width
    return (low[:, None] + 0.5 * width[:, None] * (1.0 + x)).ravel(), (0.5 * width[:, None] * weights).ravel()
