"""What the light is, wherever it comes from: wavelengths, polarisation, unit of power, and whether colours are told apart."""

from __future__ import annotations

from dataclasses import dataclass

from caustic_cli.config.table import check
from caustic_cli.errors import InputError

#: Dominant wavelengths of the primaries of sRGB (IEC 61966-2-1), nm: what stands for red, green and blue.
RGB = (611.4, 549.1, 464.3)
#: Most wavelengths of one source: each is traced.
MAX_WAVELENGTHS = 99


@dataclass(frozen=True)
class Light:
    """Quality of a source's light.

    Args:
        polarisation: direction of linear polarisation in the x-y plane, degrees from +x; None for unpolarised light.
        wavelengths: nm; empty for light of the one wavelength at which the lens' index is given.
        weights: part of the power at each wavelength, any scale; empty for equal parts.
        tracked: unpolarised light is traced as two polarisations, for the exit to know what the entrance did to each.
        color: the wavelengths are red, green and blue, and the image is kept apart for each.
        unit: of the source's power, W, radiant power, or lm, luminous flux.
    """

    polarisation: float | None = None
    wavelengths: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    tracked: bool = False
    color: bool = False
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
    def parts(self) -> tuple[float, ...]:
        """Part of the power at each wavelength; they sum to 1."""
        weights = self.weights or (1.0,) * len(self.wavelengths)
        return tuple(w / sum(weights) for w in weights)
