"""Spectrum, polarisation and unit of power of the light, whatever its source."""

from __future__ import annotations

from dataclasses import dataclass

from caustic_cli.errors import InputError
from caustic_cli.schema.table import check

#: Dominant wavelengths of the sRGB primaries (IEC 61966-2-1), nm, which represent red, green and blue.
RGB = (611.4, 549.1, 464.3)
#: Largest number of wavelengths of one source: each takes a trace.
MAX_WAVELENGTHS = 99


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
    #: The wavelengths are red, green and blue, and the image has a channel for each.
    color: bool = False
    #: Unit of the source's power: W (radiant flux) or lm (luminous flux).
    unit: str = "W"

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

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects on rays that it causes."""
        return frozenset(() if self.polarisation is None else {"polarisation"})

    @property
    def channels(self) -> tuple[int | None, ...]:
        """Colour channel of the image that each wavelength belongs to; None for all without colours."""
        return tuple(k if self.color else None for k in range(len(self.wavelengths)))

    @property
    def planes(self) -> tuple[int, ...]:
        """Leading dimensions of an image: (3,), its colour channels, or ()."""
        return (len(RGB),) if self.color else ()

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fraction of the power at each wavelength; they sum to 1."""
        weights = self.weights or (1.0,) * len(self.wavelengths)
        return tuple(w / sum(weights) for w in weights)
