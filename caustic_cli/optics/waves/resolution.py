"""What diffraction lets a lens show: the width over which it blurs, how many details that leaves, and which light is meant.

The phase of a lens of local magnification M, thrown over L, blurs a point over about sqrt(lambda L M): the geometric mean of the
Fresnel scale and what M makes of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

#: nm: the wavelength at which light without one is judged, and the band of white light.
GREEN, BAND = 550.0, (450.0, 650.0)
#: Wavelengths that stand for white light in an image.
WHITE_LINES = 6
#: Diffraction matters where it widens what source and pixel blur anyway by more than this part.
WIDENED = 0.05


def white(count: int) -> tuple[float, ...]:
    """Wavelengths, nm, for white light: the middles of so many equal parts of its band."""
    low, high = BAND
    return tuple(low + (k + 0.5) * (high - low) / count for k in range(count))


def diffraction_blur(wavelength: float, throw: float, magnification: float) -> float:
    """sqrt(lambda L M), mm, of a wavelength in nm."""
    return math.sqrt(wavelength * 1e-6 * abs(throw) * abs(magnification))


@dataclass(frozen=True)
class Resolution:
    """Widths, mm on the screen, over which diffraction and the source blur, of a pixel, and of the picture; the lens' width and the
    screen's pixels across the picture."""

    diffraction: float
    source: float
    pixel: float
    picture: float
    lens: float

    @property
    def blur(self) -> float:
        """Of diffraction and source."""
        return math.hypot(self.diffraction, self.source)

    @property
    def widened(self) -> float:
        """By what part diffraction widens what source and pixel blur anyway."""
        without = math.hypot(self.source, self.pixel)
        return math.hypot(self.diffraction, without) / without - 1.0

    @property
    def matters(self) -> bool:
        """Whether rays alone would show too much."""
        return self.widened > WIDENED

    @property
    def wanted(self) -> int:
        """Details across the picture that the pixels can show."""
        return max(1, round(self.picture / self.pixel))

    @property
    def resolvable(self) -> int:
        """Details across the picture that light carries, at most a pixel each."""
        return max(1, min(self.wanted, round(self.picture / self.blur))) if self.blur > 0 else self.wanted

    def lens_for_all(self) -> float | None:
        """Width of a lens, mm, at the same throw and magnification that would carry all details; None where the source forbids."""
        room = (self.pixel * self.wanted / self.picture) if self.picture > 0 else 0.0
        if room <= 0 or self.resolvable >= self.wanted:
            return None
        # The picture grows with the lens, the blurs do not.
        return self.lens * self.blur * self.wanted / self.picture

    def sentence(self) -> str:
        """What light carries here."""
        n = self.resolvable
        text = (f"light carries about {n} x {n} details here (diffraction {self.diffraction:.2g} mm, source {self.source:.2g} mm,"
                f" pixel {self.pixel:.2g} mm)")
        larger = self.lens_for_all()
        return text + (f"; a lens of {larger:.2g} mm would carry {self.wanted}" if larger else "")
