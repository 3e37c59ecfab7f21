"""Blur by an extended source: the largest source that leaves a picture sharp, and changes of the geometry that reduce the blur.

Notation
    sigma   contrast of the picture: standard deviation of its irradiance over its mean, on the screen
    e       relative RMS error due to the blur
    f       factor by which the image of the source must shrink relative to the picture for e <= SHARP sigma

The width of the image of a source is the throw times the angle that the source subtends at the lens, whatever the magnification and
the lens; that of the picture is proportional to both.  So the following are equivalent: f times the magnification or the width of
the lens, 1 / f times the throw or the source, or details f times as coarse.  e is that of the optimum (`deconvolution`) for a lens
designed for the source, and that of the blurred picture for one designed for collimated light.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from caustic_cli.inverse.deconvolution import deconvolved
from caustic_cli.inverse.reachability import largest_magnification
from caustic_cli.inverse.source_limits import source_spread
from caustic_cli.optics.spread import MOST_CUT, Convolution, Spread
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import PlaneWave, Scene
from caustic_cli.scene.sources.disc import SUN

#: RMS error of a picture that counts as sharp, in parts of its contrast: 20 dB below it.
SHARP = 0.1
#: Bisections of the bracket, at first of ratio 2, to 5 %; and most doublings to find it.
HALVINGS, DOUBLINGS = 4, 7
#: Iterations of a deconvolution, whose error is then within a few per cent of the least.
STEPS = 80
#: Approximate number of pixels along an axis for the search: a relevant blur is wider than these.
MOST_PIXELS = 256


def advice(scene: Scene, target: np.ndarray, picture: tuple[float, float], field: HeightField, heights: torch.Tensor) -> str:
    """Advice about the extent of the source of a finished lens: a sentence, or an empty string.

    Args:
        target: (n, m) on the scene's screen; picture: its width and height, mm; heights: (n, m) mm.
    """
    sigma = float(target.std() / target.mean()) if target.mean() > 0 else 0.0
    if sigma == 0 or scene.source.apart or scene.screen.curved or any(scene.screen.tilt):
        return ""
    if scene.source.extended:
        spread = source_spread(scene, field, heights)
        return "" if spread is None else _of_blur(scene, target, picture, spread, SHARP * sigma)
    if not scene.source.collimated:
        return ""
    throw, pixel = abs(scene.screen.z - scene.lens.offset.thickness), scene.screen.pixel
    cut = max(1, min(MOST_CUT, MOST_CUT * MOST_PIXELS // max(target.shape)))  # work in proportion to the pixels of a large screen
    least = 2.0 * min(pixel) / cut  # a narrower disc is no wider than its cells
    width = _largest_satisfying(lambda w: _blurred(target, disc(w).on(pixel, cut)) <= SHARP * sigma, least, 0.5 * min(picture))
    if width is None:
        return ""
    angle = math.degrees(width / throw)
    return f"the picture stays sharp (contrast reduced by a tenth) for sources of up to {angle:.2g} degrees; the sun has {SUN:g}"


def disc(width: float) -> Spread:
    """The image of a uniform disc of this width on the screen, mm."""
    return Spread((0.5 * width, 0.5 * width), ((0.0, 0.0, 1.0),), 0.0)


def required_reduction(target: np.ndarray, pixel: tuple[float, float], spread: Spread, error: float) -> float | None:
    """Factor by which a spread must shrink for the deconvolution error to be at most `error` relative RMS; None beyond
    2^DOUBLINGS."""
    parts = _largest_satisfying(
        lambda part: deconvolved(target, scaled_spread(spread, part).on(pixel, 1), STEPS).error <= error, 0.5**DOUBLINGS, 1.0
    )
    return None if parts is None else 1.0 / parts


def scaled_spread(spread: Spread, part: float) -> Spread:
    """A spread scaled by the factor `part`."""
    return replace(
        spread,
        half=tuple(part * h for h in spread.half),
        shifts=tuple((part * x, part * y, power) for x, y, power in spread.shifts),
        frame=tuple(part * f for f in spread.frame),
    )


def _of_blur(scene: Scene, target: np.ndarray, picture: tuple[float, float], spread: Spread, error: float) -> str:
    """Advice on changes that make a blurred picture sharp."""
    times = [max(1, n // MOST_PIXELS) for n in target.shape]
    n, m = (n - n % k for n, k in zip(target.shape, times, strict=True))
    coarse = target[:n, :m].reshape(n // times[0], times[0], m // times[1], times[1]).mean((1, 3))
    f = required_reduction(coarse, (scene.screen.pixel[0] * times[0], scene.screen.pixel[1] * times[1]), spread, error)
    if f is None or f <= 1.0:
        return ""
    lens = scene.lens
    middle, throw = lens.offset.thickness, scene.screen.z - lens.offset.thickness  # the blur is proportional to the latter
    mag, ways = picture[0] * lens.array[0] / lens.size[0], []

    def reached(wanted: float, z: float) -> bool:
        """Whether a magnification can be reached onto a screen at z."""
        other = replace(scene, source=PlaneWave(), screen=replace(scene.screen, z=z))
        most = largest_magnification(other, [wanted / mag * p for p in picture])
        return most is None or most >= wanted

    if reached(f * mag, scene.screen.z):
        ways.append(f"⟨+mag⟩ {f * mag:.2g} instead of {mag:.2g}")
    if abs(throw) / f > 2.0 * (middle - lens.z_in) and reached(mag, middle + throw / f):
        ways.append(f"⟨+throw⟩ {abs(middle + throw / f):.3g} instead of {abs(scene.screen.z):.3g} mm")
    ways.append(f"a lens of {f * lens.size[0]:.3g} mm")
    if not scene.source.distant:
        ways.append(f"a source {f:.2g} times smaller or farther away")
    ways.append(f"a picture whose details are {f:.2g} times as coarse")
    return (
        f"the source blurs this picture; it would be sharp (contrast reduced by a tenth) with {', '.join(ways[:-1])}, or {ways[-1]}"
    )


def _blurred(target: np.ndarray, spread: Convolution) -> float:
    """Relative RMS error of a picture that is convolved with a spread."""
    around = torch.from_numpy(target / target.mean()).repeat_interleave(spread.cut, 0).repeat_interleave(spread.cut, 1)
    a, b = spread.beside
    seen = spread(torch.nn.functional.pad(around, (b, b, a, a))).numpy() / spread.cut**2
    return float(np.sqrt(np.mean((seen / seen.mean() - target / target.mean()) ** 2)))


def _largest_satisfying(holds: Callable[[float], bool], least: float, most: float) -> float | None:
    """The largest number up to `most` that satisfies a monotone predicate, bracketed by doubling from `least` and refined by
    bisection; None if `least` does not."""
    if not holds(least):
        return None
    low, high = least, 2.0 * least
    while high < most and holds(high):
        low, high = high, 2.0 * high
    if high >= most:
        if holds(most):
            return most
        high = most
    for _ in range(HALVINGS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
