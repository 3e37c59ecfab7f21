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
from operator import mul

import numpy as np
import torch

from caustic_cli.errors import alternatives
from caustic_cli.inverse.deconvolution import deconvolved
from caustic_cli.inverse.reachability import largest_magnification
from caustic_cli.inverse.source_image import source_images
from caustic_cli.inverse.source_limits import SHIFTS
from caustic_cli.optics.spread import MOST_CUT, Convolution, Spread
from caustic_cli.scene import Disc, PlaneWave, Scene
from caustic_cli.scene.sources.section import SUN
from caustic_cli.schema.table import TABLE

#: RMS error of a picture that counts as sharp, in parts of its contrast: 20 dB below it.
SHARP = 0.1
#: Bisections of the bracket, at first of ratio 2, to 5 %; and most doublings to find it.
HALVINGS, DOUBLINGS = 4, 7
#: Cosine between light and a screen's normal from which on the screen counts as square to the light.
SQUARE = 0.999
#: Iterations of a deconvolution, whose error is then within a few per cent of the least.
STEPS = 80
#: Approximate number of pixels along an axis for the search: a relevant blur is wider than these.
MOST_PIXELS = 256


def advice(scene: Scene, target: np.ndarray, picture: tuple[float, float]) -> str:
    """Advice about the extent of the source for a lens: a sentence, or an empty string.

    On a tilted or curved screen, over which the image of the source varies, it is for that at its middle.

    Args:
        target: (n, m) on the scene's screen; picture: its width and height, mm.
    """
    sigma = float(target.std() / target.mean()) if target.mean() > 0 else 0.0
    if sigma == 0:
        return ""
    if scene.source.extended:
        spread = _image(scene)
        return "" if spread is None else _of_blur(scene, target, picture, spread, SHARP * sigma)
    one = _image(replace(scene, source=Disc(angle=1.0))) if scene.source.collimated else None
    if one is None:
        return ""
    width, pixel = 2.0 * min(one.reach()), scene.screen.pixel  # of an image of one degree
    cut = max(1, min(MOST_CUT, MOST_CUT * MOST_PIXELS // max(target.shape)))  # work in proportion to the pixels of a large screen
    least = 2.0 * min(pixel) / cut  # a narrower disc is no wider than its cells
    angle = _largest_satisfying(
        lambda angle: _blurred(target, scaled_spread(one, angle).on(pixel, cut)) <= SHARP * sigma,
        least / width,
        0.5 * min(picture) / width,
    )
    if angle is None:
        return ""
    return f"the picture stays sharp (contrast reduced by a tenth) for sources of up to {angle:.2g} degrees; the sun has {SUN:g}"


def _image(scene: Scene) -> Spread | None:
    """The image of the source at the middle of the screen by light through the middle of the lens; None without one, with several,
    or where it is wider than the screen, or images elsewhere differ much from it, as for a source right before a lens."""
    middle, whole = source_images(scene, middle=True), source_images(scene)
    if len(middle) != 1 or not whole or max(middle[0].reach()) > max(scene.screen.size):
        return None
    return middle[0] if max(whole[0].reach()) > (1.0 - SHIFTS) * max(middle[0].reach()) else None


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

    def reached(wanted: float, z: float, width: float = lens.size[0]) -> bool:
        """Whether a magnification is accepted and can be reached by a lens of this width onto a screen at z; unknown among other
        elements, through which the width of an image is not the throw times the angle of the source."""
        if scene.unfolded.elements:
            return False
        wider = width / lens.size[0]
        sized = replace(lens, size=(wider * lens.size[0], wider * lens.size[1]))
        other = replace(scene, source=PlaneWave(tilt=scene.source.tilt), lens=sized, screen=replace(scene.screen, z=z))
        most = largest_magnification(other, [wider * wanted / mag * p for p in picture])
        return TABLE["mag"].low <= wanted <= TABLE["mag"].high and (most is None or most >= wanted)

    higher, nearer = float(f"{f * mag:.2g}"), float(f"{middle + throw / f:.3g}")  # as they are named
    larger = float(f"{f * lens.size[0]:.3g}")
    if reached(higher, scene.screen.z):
        ways.append(f"⟨+mag⟩ {higher:g} instead of {mag:.2g}")
    in_room = scene.source.oblique and abs(sum(map(mul, scene.undeviated, scene.screen.axes[2]))) < SQUARE
    if not in_room and not scene.screen.far and abs(throw) / f > 2.0 * (middle - lens.z_in) and reached(mag, nearer):
        ways.append(f"⟨+throw⟩ {abs(nearer):g} instead of {abs(scene.screen.z):.3g} mm")
    if larger * max(1.0, mag) <= TABLE["lens.size"].high and reached(mag, scene.screen.z, larger):
        ways.append(f"a lens of {larger:g} mm")
    if not scene.source.distant:
        ways.append(f"a source {f:.2g} times smaller or farther away")
    ways.append(f"a picture whose details are {f:.2g} times as coarse")
    return f"the source blurs this picture; it would be sharp (contrast reduced by a tenth) with {alternatives(ways)}"


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
