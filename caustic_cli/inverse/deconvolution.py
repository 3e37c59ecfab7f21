"""The light that, spread by an extended source's image, comes closest to a picture, and how close any light can come.

    minimise  |y - b|^2 / 2,    y = S K x,    x >= 0,    mean(y) = mean(b) = 1

K convolves with the source's image, S looks at the screen alone: b is the picture on it, x light on the screen and around it, from
where it still reaches the screen.  Accelerated projected gradients with restarts (Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009;
O'Donoghue and Candes, Found. Comput. Math. 15, 2015); the constraint's multiplier c is added to b and follows mean(y).

Every x and every nu give a bound: with w = K^T S^T 1 and N pixels,

    |y - b|^2 / 2 >= nu . b - |nu|^2 / 2 - N max_i (K^T S^T nu)_i / w_i

whatever the light, which nu = b + c - y makes tight where x is optimal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.spread import Convolution

#: Iterations until the light is returned, which is still smooth then, and for the least error; how often that is looked at.
SMOOTH_STEPS, MOST_STEPS, LOOK = 60, 3000, 50
#: Iterations times cells that are worth their time, about a second, and least iterations.
WORK, LEAST_STEPS = 3e7, 300
#: Cells of a pixel, along each axis, that light may be told apart by; finer ones take long.
FINEST = 2
#: Part of the least error to which its bound comes before the iterations end.
TIGHT = 0.02
#: Light of which no more than this part, rounding, reaches the screen does not count.
REACHES = 1e-9


@dataclass(frozen=True, eq=False)
class Deconvolved:
    """light: (n + 2 a, m + 2 b), relative irradiance of pixels on the screen and around it; beside: (a, b); error: relative RMS
    between the picture and the best light found, spread, each over its own mean on the screen; bound: no light comes closer; kept:
    the part of that light which is spread onto the screen."""

    light: np.ndarray
    beside: tuple[int, int]
    error: float
    bound: float
    kept: float


def deconvolved(target: np.ndarray, spread: Convolution, steps: int | None = None) -> Deconvolved:
    """The best light behind a source's spread.

    Args:
        target: (n, m), not negative, not all zero, any scale.
        spread: of the source on the target's pixels.
        steps: iterations; None for as many as a second is enough for.
    """
    cut, b = spread.cut, torch.from_numpy(target / target.mean())
    pixels = tuple(n // cut for n in spread.beside)
    around = (spread.beside[1],) * 2 + (spread.beside[0],) * 2

    def cells(v: Tensor) -> Tensor:
        return torch.nn.functional.pad(v.repeat_interleave(cut, 0).repeat_interleave(cut, 1), around)

    def seen(x: Tensor) -> Tensor:
        return spread(x) / cut**2

    def back(v: Tensor) -> Tensor:  # the adjoint, times cut^2: the step of the gradient on cells
        return spread.whole(cells(v), adjoint=True)

    steps = steps or int(min(MOST_STEPS, max(LEAST_STEPS, WORK / cells(b).numel())))
    reach = back(torch.ones_like(b))
    near = reach > REACHES
    x = cells(b)
    ahead, t, c, light, kept, least, bound = x, 1.0, 0.0, None, 1.0, math.inf, 0.0
    for k in range(1, steps + 1):
        y = seen(ahead)
        moved = torch.where(near, (ahead + back(b + c - y)).clamp_min(0.0), 0.0)
        c += 0.5 * (1.0 - float(y.mean()))
        if float(((ahead - moved) * (moved - x)).sum()) > 0.0:
            t = 1.0
        after = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * t * t))
        ahead, x, t = moved + (t - 1.0) / after * (moved - x), moved, after
        if k == min(SMOOTH_STEPS, steps):
            n, m = (s // cut for s in x.shape)
            light = x.reshape(n, cut, m, cut).mean((1, 3)).numpy()
            kept = float(seen(x).sum() * cut**2 / x.sum())
        if k % LOOK == 0 or k == steps:
            y = seen(x)
            y = y / y.mean()
            nu = b + c - y
            dual = float((nu * b).sum() - 0.5 * nu.square().sum() - b.numel() * (back(nu)[near] / reach[near]).max())
            least = min(least, float((y - b).square().mean().sqrt()))
            bound = max(bound, math.sqrt(max(0.0, 2.0 * dual / b.numel())))
            if light is not None and bound > (1.0 - TIGHT) * least:
                break
    return Deconvolved(light, pixels, least, bound, kept)
