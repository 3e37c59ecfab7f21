"""What the size of a chip allows a lamp, estimated before its design: blur, least error behind it, and etendue.

Every point of the free-form surface sees the chip under an angle of about its size over the distance, and sends an image of that
width to the target.  The error of every picture that is blurred so is bounded from below (`deconvolution`), and with its edges that
of one beside which little light falls.

Etendue is conserved: a Lambertian chip of area A has pi A.  The lens lies within the half ball of its greatest radius R, whose
area seen from an angle theta to the axis is pi R^2 (1 + cos theta) / 2, so that the target takes no more than the integral of this
over its solid angle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from caustic_cli.errors import at_most
from caustic_cli.inverse.deconvolution import FINEST, NO_ERROR, Blur, error_bound
from caustic_cli.inverse.lamp import directions_of, pixels_of, wanted
from caustic_cli.optics.spread import Spread
from caustic_cli.scene.lamp import Goal, Lamp

#: Pixels of the target.
PIXELS = 3000
#: Most light beside the picture, over that on it, for the error with its edges, prices of it that are tried (`error_bound`), and
#: least error of this kind that is told.
BESIDE, PRICES, LEAST_TOLD = 0.01, (0.1, 0.2, 0.4), 0.01


def etendue_limit(lamp: Lamp, goal: Goal) -> float:
    """Largest fraction of the chip's light that its lens can send to the target, by etendue; inf for a point, and for one
    that obeys another law than Lambert's."""
    width, height = lamp.chip.size
    if not width * height > 0 or lamp.chip.intensity is not None:
        return math.inf
    area = width * height * (1.0 if lamp.chip.shape == "rectangle" else 0.25 * math.pi)
    pixels = pixels_of(goal, PIXELS)
    cosine = directions_of(goal, pixels)[:, 2].numpy()
    if goal.far:
        solid = goal.solid_angle * goal.shares(pixels).reshape(-1)
    else:
        solid = math.prod(goal.size) / len(cosine) * cosine**3 / goal.distance**2
    return float((solid * 0.5 * math.pi * lamp.radius**2 * (1.0 + cosine)).sum()) / (math.pi * area)


def least_error(lamp: Lamp, goal: Goal, picture: np.ndarray, most: int, beside: float = math.inf) -> float:
    """Lower bound of the relative RMS error of a picture behind the chip's blur, on PIXELS pixels.

    Args:
        picture: as of `inverse.lamp.wanted`.
        most: iterations.
        beside: light that may fall beside it, relative to that on it: sharp edges cost light.
    """
    pixels = pixels_of(goal, PIXELS)
    pixel = (goal.size[0] / pixels[0], goal.size[1] / pixels[1])
    half = 0.5 * lamp.blur(goal) * min(lamp.chip.size) / max(lamp.chip.size)
    blur = Spread((half, half), ((0.0, 0.0, 1.0),), 0.0)
    density = wanted(goal, picture, pixels).numpy() / goal.shares(pixels)
    prices = (0.0,) if math.isinf(beside) else PRICES
    return max(error_bound(density, [Blur((blur.on(pixel, FINEST),))], most, price, beside) for price in prices)


def chip_limits(lamp: Lamp, goal: Goal, picture: np.ndarray, most: int) -> Iterator[str]:
    """Sentences for the user; none for a point."""
    if lamp.chip.shape == "point":
        return
    blur, border = (f"{length:.4g} {goal.unit}" for length in (lamp.blur(goal), lamp.border(goal)))
    yield f"the chip blurs the picture by {blur} or more, and its interior is what lies {border} within the edges"
    if len(np.unique(picture[picture > 0])) > 1 and (error := least_error(lamp, goal, picture, most)) > NO_ERROR:
        yield f"behind this blur, no picture has a relative RMS error of less than {at_most(error, 3)}"
    if (part := etendue_limit(lamp, goal)) < 1.0:
        yield f"by etendue, at most {part:.0%} of the light can reach the picture through a lens of this radius"
    elif (error := least_error(lamp, goal, picture, most, BESIDE)) > LEAST_TOLD:
        yield (
            f"with its edges, no picture has a relative RMS error of less than {at_most(error, 2)} behind this blur, unless more"
            f" than {BESIDE:.0%} of the light falls beside it"
        )
