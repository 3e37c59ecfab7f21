"""Spectrum, polarisation and unit of power of the light, whatever its source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.loading import OnDemand
from caustic_cli.schema.table import check

if TYPE_CHECKING:
    from caustic_cli.scene.spectrum import Measure

spectra = OnDemand("caustic_cli.scene.spectrum")

#: Dominant wavelengths of the sRGB primaries (IEC 61966-2-1), nm, which represent red, green and blue.
RGB = (611.4, 549.1, 464.3)
#: Largest number of wavelengths of one source: each takes a trace.
MAX_WAVELENGTHS = 99
#: Wavelengths that represent a continuous spectrum: as traced through a dispersive glass, and in the verdict on a wave image, where
#: they are more than 2 nm from those of a standard or fine design and give the error of 51 within 0.7 %
#: (`tests/benchmarks/wavelengths.py`).
RAY_NODES, WAVE_NODES = 5, 12


@dataclass(frozen=True)
class Light:
    """Spectrum and polarisation of a source's light.

    Raises:
        InputError: a value is out of range, or the numbers of wavelengths and weights do not match.
    """

    #: Direction of linear polarisation in the x-y plane, degrees from +x; None for unpolarised light.
    polarisation: float | None = None
    #: nm; empty for monochromatic light at the wavelength of the lens' index.
    wavelengths: tuple[float, ...] = ()
    #: Relative power at each wavelength; empty for equal power.
    weights: tuple[float, ...] = ()
    #: Unpolarised light is traced as two orthogonal polarisations, since the entrance transmits s and p differently.
    tracked: bool = False
    #: The wavelengths are red, green and blue, and the image has a channel for each, the power of its light.
    color: bool = False
    #: Unit of the source's power: W (radiant flux) or lm (luminous flux).
    unit: str = "W"
    #: A continuous spectrum as its detector weights it, of which the wavelengths are samples; None for light of those wavelengths
    #: alone, and for white light that nothing is said about.
    measure: Measure | None = None
    #: Luminous efficacy of radiation, lm/W; None where nothing is said about its spectrum.
    efficacy: float | None = None

    def __post_init__(self):
        check("source.power_unit", self.unit)
        if self.polarisation is not None:
            check("source.polarisation", self.polarisation)
        if len(self.wavelengths) > MAX_WAVELENGTHS:
            raise InputError(f"⟨source.wavelengths⟩ must be at most {MAX_WAVELENGTHS}, got {len(self.wavelengths)}")
        check("source.wavelengths", self.wavelengths)
        if self.weights and len(self.weights) != len(self.wavelengths):
            raise InputError(
                f"⟨source.weights⟩ must be one for each of the {len(self.wavelengths)} wavelengths, got {len(self.weights)}"
            )
        check("source.weights", self.weights)
        if self.weights and not sum(self.weights) > 0:
            raise InputError("⟨source.weights⟩ must not all be 0")
        if self.color and len(self.wavelengths) != len(RGB):
            raise InputError(
                f"⟨source.wavelengths⟩ of a coloured picture are three, red, green and blue, got {len(self.wavelengths)}"
            )
        if self.color:
            self.primaries  # noqa: B018 - refuses wavelengths that mix no colours

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects on rays that it causes."""
        return frozenset(() if self.polarisation is None else {"polarisation"})

    @cached_property
    def primaries(self) -> np.ndarray:
        """X, Y, Z of a unit of power in each colour channel, as the columns of a matrix, see `spectrum.primaries`."""
        return spectra.primaries(self.wavelengths)

    @property
    def channels(self) -> tuple[int | None, ...]:
        """Colour channel of the image that each wavelength belongs to; None for all without colours."""
        return tuple(k if self.color else None for k in range(len(self.wavelengths)))

    @property
    def planes(self) -> tuple[int, ...]:
        """Leading dimensions of an image: (3,), its colour channels, or ()."""
        return (len(RGB),) if self.color else ()

    @property
    def states(self) -> tuple[float | None, ...]:
        """Angles of the linear polarisations that it is the even mixture of, degrees: two of natural light that is tracked."""
        return (0.0, 90.0) if self.tracked and self.polarisation is None else (self.polarisation,)

    @cached_property
    def continuum(self) -> Measure | None:
        """The continuous spectrum that the wave image is of: its own, or that of white light; None for spectral lines."""
        return self.measure or (None if self.wavelengths else spectra.measure_of())

    def lines(self, wavelengths: tuple[float, ...] = ()) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Wavelengths of its wave image, nm, and the fraction of the light that each represents.

        wavelengths: those to take instead: of its own lines, with equal powers, or of those that represent its continuous spectrum,
        each for its share of that.
        """
        if (whole := self.continuum) is None:
            return (
                (wavelengths, (1.0 / len(wavelengths),) * len(wavelengths)) if wavelengths else (self.wavelengths, self.fractions)
            )
        if not wavelengths:
            return whole.rule(WAVE_NODES)
        parts = dict(zip(sorted(wavelengths), whole.weights_at(np.array(sorted(wavelengths))).tolist(), strict=True))
        return wavelengths, tuple(parts[w] for w in wavelengths)

    @cached_property
    def white(self) -> tuple[float, float, float] | None:
        """Tristimulus values X, Y, Z, with Y = 1, of its light on a white screen; None for light without colour: nothing is said
        about its spectrum, it has spectral lines, or is measured by its power."""
        return None if self.measure is None or self.measure.detector != "eye" else self.measure.white

    def colours_of(self, wavelengths: tuple[float, ...]) -> tuple[tuple[float, float, float] | None, ...]:
        """Tristimulus values, with Y = 1, of the light that each of its wavelengths, nm, represents; None without colour."""
        if self.white is None or self.measure is None:
            return (None,) * len(wavelengths)
        found = dict(zip(sorted(wavelengths), self.measure.colours_at(np.array(sorted(wavelengths))).tolist(), strict=True))
        return tuple((x, y, z) for x, y, z in map(found.__getitem__, wavelengths))

    @property
    def mean(self) -> float:
        """Mean wavelength, nm, as its detector sees it."""
        if (whole := self.continuum) is not None:
            return whole.mean
        return math.fsum(w * p for w, p in zip(self.wavelengths, self.fractions, strict=True))

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fraction of the light at each wavelength, as its detector sees it; they sum to 1."""
        weights = self.weights or (1.0,) * len(self.wavelengths)
        return tuple(w / sum(weights) for w in weights)
