"""Evaluation of a lamp by independent rays: where all light of the chip goes, and how well it fits the target.

All figures are fractions of the light that the chip emits.  Errors are corrected for the noise of the rays: with densities A and B
of two independent halves and T of the target, each divided by its mean, the mean of (A - T) (B - T) is the squared error without
bias (compare `studies.noise`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from torch import Tensor

from caustic_cli.effort import STANDARD
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.lamp import LOSSES, LampLight, emissions, land, least_wall, sides, through, uncoated_limit
from caustic_cli.optics.lamp_array import among
from caustic_cli.optics.lamp_ghosts import ghosts
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene import Screen
from caustic_cli.scene.lamp import Goal, Lamp

#: Rays of an evaluation.
RAYS = STANDARD.final_rays
#: The edge of the light is seen in a strip of this half width, degrees, about the vertical plane, in steps of latitude; and where
#: the intensity beneath it is taken.
STRIP, STEP, BELOW = 2.5, 0.1, 1.0
#: A pixel of a picture without shades counts as lit entirely if it has more than this part of the greatest density.
LIT = 0.999


class LampImage(NamedTuple):
    """Light on the target, fractions of that emitted.

    image: (n_x, n_y), on given pixels; coarse: on fewer of them, for their least value; halves: the image of either half of the
    rays; lost: by cause; rays: their number; rise: in the far field that within STRIP of the vertical plane, by latitude from -90
    to 90 degrees in steps of STEP, of zeros on a screen.
    """

    image: np.ndarray
    coarse: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]
    lost: dict[str, float]
    rays: int
    rise: np.ndarray


def traced(lamp: Lamp, field: PolarField, values: Tensor, rays: int, seed: int) -> Iterator[tuple[int, LampLight]]:
    """Light behind the lens of two independent halves of about `rays` rays of sum 1 each, in parts: number of the half, light."""
    for half in (0, 1):
        rng = np.random.default_rng(stream(seed, f"array {half}"))
        for part in emissions(lamp.chip, max(1, rays // 2), stream(seed, f"lamp {half}")):
            with torch.no_grad():
                lights = [through(lamp, field, part, values)]
                if lamp.ghosts:
                    lights.append(ghosts(lamp, field, values, part, rng))
                for light in lights:
                    yield half, light if lamp.count == 1 else among(lamp, field, values, light, rng)


def lamp_image(
    lamp: Lamp,
    goal: Goal,
    field: PolarField,
    values: Tensor,
    pixels: tuple[int, int],
    coarse: tuple[int, int] = (2, 2),
    rays: int = RAYS,
    seed: int = 0,
    also: Callable[[LampLight], None] = lambda light: None,
) -> LampImage:
    """Trace a lamp with about `rays` independent rays, each counted on the pixel where it lands; also: takes their light, too."""
    screens, splat = [Screen(goal.size, resolution=n) for n in (pixels, coarse)], backend_for("cpu").splat
    halves, fewer = torch.zeros(2, *pixels, dtype=torch.float64), torch.zeros(coarse, dtype=torch.float64)
    lost, count, rise = dict.fromkeys((*LOSSES, "elsewhere"), 0.0), 0, torch.zeros(round(180.0 / STEP), dtype=torch.float64)
    for half, light in traced(lamp, field, values, rays, seed):
        also(light)
        x, y, ahead = land(goal, light)
        arriving = torch.where(ahead, light.power, torch.zeros_like(light.power))
        image, outside = splat(x, y, arriving, screens[0], Filter())
        halves[half] += image
        fewer += 0.5 * splat(x, y, arriving, screens[1], Filter())[0]
        if goal.by_latitude:
            near = torch.where(x.abs() <= STRIP, 0.5 * arriving, torch.zeros_like(x))
            rise += torch.bincount(((y + 90.0) / STEP).long(), near, len(rise))
        for cause, power in light.lost.items():
            lost[cause] = lost.get(cause, 0.0) + 0.5 * float(power.sum())
        lost["elsewhere"] += 0.5 * float(outside + (light.power - arriving).sum())
        count += len(light.spare)
    one, other = halves.numpy()
    return LampImage(0.5 * (one + other), fewer.numpy(), (one, other), lost, count, rise.numpy())


def cut_off(rise: np.ndarray) -> float | None:
    """Angle, degrees, over which the intensity falls upwards from 90 % to 10 % of that below its uppermost steep edge; None without
    light there.

    rise: power by latitude, as of `LampImage`.  The edge is where it falls to half of its maximum; the intensity below it is the
    mean from BELOW to twice as far beneath, and an edge wider than that appears narrower.
    """
    latitude = (np.arange(len(rise)) + 0.5) * STEP - 90.0
    intensity = rise / np.cos(np.radians(latitude))
    if not intensity.any():
        return None
    edge = int(np.flatnonzero(intensity >= 0.5 * intensity.max())[-1])
    reach = round(BELOW / STEP)
    level = float(intensity[max(0, edge - 2 * reach) : max(1, edge - reach)].mean())
    if not level > 0:
        return None

    def last(part: float) -> float:
        k = int(np.flatnonzero(intensity >= part * level)[-1])
        above = intensity[k + 1] if k + 1 < len(intensity) else 0.0
        return float(latitude[k] + STEP * (intensity[k] - part * level) / (intensity[k] - above))

    return last(0.1) - last(0.9)


def relative_rms(
    halves: tuple[np.ndarray, np.ndarray], target: np.ndarray, where: np.ndarray, shares: np.ndarray
) -> tuple[float, float] | tuple[None, None]:
    """Root mean square of the deviation of the illuminance, or intensity, from that of the target over some pixels, each divided by
    its mean, corrected for noise, and its standard error, by the difference of the halves; None for no pixels.

    The standard deviation of the illuminance over its mean where the target is uniform.  shares: of the pixels, see `Goal.shares`.
    """
    if not where.any() or not all(half[where].sum() > 0 for half in halves):
        return None, None
    one, other, wanted = (part[where] / shares[where] for part in (*halves, target))
    wanted = wanted / wanted.mean()
    a, b = one / one.mean() - wanted, other / other.mean() - wanted
    square, noise = max(0.0, float((a * b).mean())), 0.5 * float(np.mean((a - b) ** 2))  # noise: of a and of b, squared
    error = math.sqrt((noise * noise + 2.0 * square * noise) / a.size)  # of the square, to first order in independent pixels
    return math.sqrt(square), min(math.sqrt(error), 0.5 * error / math.sqrt(square)) if square > 0 else math.sqrt(error)


def lamp_figures(
    lamp: Lamp,
    goal: Goal,
    field: PolarField,
    values: Tensor,
    target: np.ndarray,
    coarse: np.ndarray,
    *,
    shaded: bool = False,
    rays: int = RAYS,
    seed: int = 0,
    also: Callable[[LampLight], None] = lambda light: None,
) -> tuple[LampImage, dict[str, Any]]:
    """Figures of a lamp by independent rays.

    Args:
        also: as of `lamp_image`.
        target: (n_x, n_y) part of the light wanted on each pixel; coarse: the same on fewer pixels, for the uniformity.
        shaded: whether the picture has more shades than lit and dark: otherwise only pixels that are lit entirely are compared.

    Returns:
        the image, and of_source: light on the target; relative_rms: over all pixels of the picture; interior_rms: the same less a
        border, mm or degrees, see `Lamp.border`; noise and interior_noise: of either; uniformity: least over mean illuminance
        (intensity in the far field) on the coarse pixels within that border, None of a shaded picture; uncoated_limit; lost: by
        cause, with of_source of sum 1; in the far field cut_off, degrees, see there; least_wall and greatest_radius, mm; pixels;
        rays.
    """
    pixels, fewer = ((t.shape[0], t.shape[1]) for t in (target, coarse))
    found = lamp_image(lamp, goal, field, values, pixels, fewer, rays, seed, also)
    shares, border = goal.shares(pixels), lamp.border(goal)
    whole = relative_rms(found.halves, target, _compared(target, goal, shaded, 0.0), shares)
    interior = relative_rms(found.halves, target, _compared(target, goal, shaded, border), shares)
    uniformity = None if shaded else _least_over_mean(found.coarse, coarse, _compared(coarse, goal, False, border))
    return found, {
        "of_source": float(found.image.sum()),
        "relative_rms": whole[0],
        "noise": whole[1],
        "interior_rms": interior[0],
        "interior_noise": interior[1],
        "uniformity": uniformity,
        "border": lamp.border(goal),
        "border_unit": goal.unit,
        "uncoated_limit": uncoated_limit(lamp),
        "lost": found.lost,
        **({"cut_off": cut_off(found.rise)} if goal.by_latitude else {}),
        "least_wall": least_wall(lamp, field, values),
        "greatest_radius": field.extent(sides(values)[1])[1],
        "pixels": list(pixels),
        "rays": found.rays,
    }


def _compared(target: np.ndarray, goal: Goal, shaded: bool, border: float) -> np.ndarray:
    """Pixels of the picture, see `lamp_figures`, less a border, mm or degrees."""
    density = target / goal.shares((target.shape[0], target.shape[1]))
    lit = density > (0.0 if shaded else LIT * density.max())
    reach = [round(border / s * n) for s, n in zip(goal.size, target.shape, strict=True)]
    return minimum_filter(lit, [2 * r + 1 for r in reach], mode="constant", cval=False)


def _least_over_mean(image: np.ndarray, target: np.ndarray, where: np.ndarray) -> float | None:
    """Least over mean of image / target on some pixels; None where there is no light on them."""
    if not where.any() or not image[where].any():
        return None
    seen = image[where] / target[where]
    return float(seen.min() / seen.mean())
