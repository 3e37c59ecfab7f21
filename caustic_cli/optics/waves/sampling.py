"""How finely light is sampled on its way from lens to screen, and what that takes.

Notation, along one axis
    W, S        widths that light covers on the plane behind the lens and that are watched on the screen, mm
    n, dx       samples across W and their distance, n dx = W
    N, dX       samples of the transform, N > n, and their distance on the screen, dX = lambda L / (N dx)

The phase of the transformed field has the slope k X / L at the place whose light lands at X.  So n = W S / (lambda L) samples just
hold what lands within S, and the screen's samples reach over S = lambda L / dx: both grids follow from lens and screen.  The field
on the screen is that of an aperture W and is held by samples lambda L / W apart.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TypeVar

from scipy.fft import next_fast_len

from caustic_cli.errors import CausticError

#: What is watched, in parts of screen and light; N over n; least samples across the light, so many diffraction widths are watched.
BEYOND, FINER, LEAST = 1.06, 1.08, 128
#: Samples of the transform to a pixel, at least: a pixel a few samples wide is off by the square of their distance over its width.
A_PIXEL = 6.0
#: Most samples along an axis; bytes that one piece of a transform may take in any case, and in parts of the free memory.
MOST, PIECE, OF_FREE = 1 << 17, 1 << 30, 0.3
#: How often a piece is in memory at a time.
COPIES = 2


#: A count, or a length.
Number = TypeVar("Number", int, float)


class NoWaveImage(CausticError):
    """A scene whose light has no wave image, or none that can be made."""


@dataclass(frozen=True)
class Sampling:
    """Samples of the light on the plane behind the lens and of its transform, of each axis.

    low: of the light there, mm; step: dx; count: n; padded: N; middle: of what is watched on the screen, mm; distance: L, mm.
    """

    low: tuple[float, float]
    step: tuple[float, float]
    count: tuple[int, int]
    padded: tuple[int, int]
    middle: tuple[float, float]
    distance: float

    @classmethod
    def of(
        cls,
        light: tuple,
        landing: tuple,
        pixel: tuple[float, float],
        distance: float,
        wavelengths: tuple[float, ...],
        finer: float = 1.0,
    ) -> Sampling:
        """Samples that are enough at every wavelength.

        Args:
            light: lows and highs of the light behind the lens, mm; landing: of what is watched on the screen, mm.
            pixel: widths, mm; wavelengths: mm; finer: than is needed by so many times along each axis of both planes.

        Raises:
            NoWaveImage: more than MOST.
        """
        short, long = min(wavelengths), max(wavelengths)
        low, step, count, padded, middle = [], [], [], [], []
        for k in (0, 1):
            width = light[1][k] - light[0][k]
            seen = BEYOND * max(landing[1][k] - landing[0][k], 1e-12)
            n = max(LEAST, math.ceil(finer * width * seen / (short * distance)))
            most = max(FINER * n * finer, A_PIXEL * finer * long * distance * n / (width * pixel[k]))
            if most > MOST:
                raise NoWaveImage(
                    f"a wave image of this scene needs {most:,.0f} samples along an axis, where {MOST:,} can be had,"
                    f" and {8 * most * most / 2**30:,.0f} GiB: a smaller lens or screen, or a longer throw, needs"
                    " fewer"
                )
            low.append(light[0][k])
            step.append(width / n)
            count.append(n)
            padded.append(_even(math.ceil(most)))
            middle.append(0.5 * (landing[0][k] + landing[1][k]))
        return cls(_pair(low), _pair(step), _pair(count), _pair(padded), _pair(middle), distance)

    def spacing(self, wavelength: float) -> tuple[float, float]:
        """dX and dY on the screen at a wavelength in mm."""
        return _pair([wavelength * self.distance / (n * d) for n, d in zip(self.padded, self.step, strict=True)])

    def first(self, wavelength: float) -> tuple[float, float]:
        """X and Y of the screen's first sample at a wavelength in mm, so that all of them lie evenly about the middle."""
        spacing = self.spacing(wavelength)
        return _pair([m - 0.5 * (n - 1) * d for m, n, d in zip(self.middle, self.padded, spacing, strict=True)])

    def pieces(self, wide: int) -> int:
        """In how many pieces the transform has to be made, of numbers of `wide` bytes, where they are put together from blocks."""
        return min(self.padded[1], math.ceil(COPIES * wide * self.count[0] * self.padded[1] / max(PIECE, OF_FREE * memory_free())))

    @property
    def samples(self) -> int:
        """Of the transform."""
        return self.padded[0] * self.padded[1]


def _pair(values: list[Number]) -> tuple[Number, Number]:
    """One value for each axis."""
    x, y = values
    return x, y


def _even(n: int) -> int:
    """The next even length whose transform is fast."""
    n = next_fast_len(n + n % 2)
    while n % 2:
        n = next_fast_len(n + 1)
    return n


def memory_free() -> int:
    """Bytes of memory that are free, or a generous guess where the system does not say."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return 1 << 33
