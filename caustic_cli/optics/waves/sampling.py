"""Sampling of the field on the reference plane and on the screen.

Notation, along one axis
    W, S        width of the light on the reference plane, and width of the computed region on the screen, mm
    n, dx       number of samples across W, and their spacing, n dx = W
    N, dX       samples of the transform, N > n, and their spacing on the screen, dX = lambda L / (N dx)

The phase of the transformed field has the slope k X / L where its light lands at X.  By the sampling theorem n = W S / (lambda L)
samples represent the light that lands within S, and the samples on the screen cover S = lambda L / dx: both grids follow from lens
and screen.  The field on the screen is band-limited by the aperture W, with the Nyquist spacing lambda L / W.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TypeVar

from scipy.fft import next_fast_len

from caustic_cli.optics.waves.unsupported import NoWaveImage

#: Width of the computed region relative to screen and light; N over n; least number of samples across the light.
BEYOND, FINER, LEAST = 1.06, 1.08, 128
#: Least number of transform samples per pixel: the error of a pixel is the square of the spacing over its width.
A_PIXEL = 6.0
#: Largest number of samples along an axis; memory of a piece of a transform: least limit in bytes, and limit relative to free
#: memory.
MOST, PIECE, OF_FREE = 1 << 17, 1 << 30, 0.5


#: A count, or a length.
Number = TypeVar("Number", int, float)


@dataclass(frozen=True)
class Sampling:
    """Sample grids on the reference plane and of the transform, for each axis.

    low: lower edge of the light on the reference plane, mm; step: dx; count: n; padded: N; middle: centre of the computed region on
    the screen, mm; distance: L, mm.
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
        least: tuple[int, int] = (1, 1),
    ) -> Sampling:
        """Sufficient sampling for all wavelengths.

        Args:
            light: lower and upper limits of the light on the reference plane, mm.
            landing: of the computed region on the screen, mm.
            pixel: widths, mm.
            wavelengths: in the image space, mm.
            finer: oversampling factor along each axis of both planes.
            least: numbers of samples across the light, before oversampling.

        Raises:
            NoWaveImage: more than MOST samples are needed.
        """
        short, long = min(wavelengths), max(wavelengths)
        low, step, count, padded, middle = [], [], [], [], []
        for k in (0, 1):
            width = light[1][k] - light[0][k]
            seen = BEYOND * max(landing[1][k] - landing[0][k], 1e-12)
            n = max(LEAST, math.ceil(finer * least[k]), math.ceil(finer * width * seen / (short * distance)))
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
        """X and Y of the first screen sample at a wavelength in mm; the samples are centred on `middle`."""
        spacing = self.spacing(wavelength)
        return _pair([m - 0.5 * (n - 1) * d for m, n, d in zip(self.middle, self.padded, spacing, strict=True)])

    def pieces(self, wide: int) -> int:
        """Number of pieces of a transform computed by blocks, of numbers of `wide` bytes, that fit into memory."""
        return min(self.padded[1], math.ceil(wide * self.count[0] * self.padded[1] / max(PIECE, OF_FREE * memory_free())))

    @property
    def samples(self) -> int:
        """Number of samples of the transform."""
        return self.padded[0] * self.padded[1]


def _pair(values: list[Number]) -> tuple[Number, Number]:
    """One value for each axis."""
    x, y = values
    return x, y


def _even(n: int) -> int:
    """The next even length with a fast transform."""
    n = next_fast_len(n + n % 2)
    while n % 2:
        n = next_fast_len(n + 1)
    return n


def memory_free() -> int:
    """Free memory, bytes; an optimistic estimate where the operating system does not report it."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return 1 << 33
