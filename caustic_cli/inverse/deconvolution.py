"""Non-negative deconvolution of a picture by the image of an extended source, with a duality bound on the least possible error.

    minimise  |y - b|^2 / 2,    y = S K x,    x >= 0,    mean(y) = mean(b) = 1

K is the convolution with the source's image and S the restriction to the screen: b is the picture on the screen, x the irradiance
on the screen and on the margin from which light is still spread onto it.  Accelerated projected gradients with restarts (Beck and
Teboulle, SIAM J. Imaging Sci. 2, 2009; O'Donoghue and Candes, Found. Comput. Math. 15, 2015); the multiplier c of the mean
constraint is added to b and updated by mean(y).

Weak duality gives a lower bound for every nu: with w = K^T S^T 1 and N pixels,

    |y - b|^2 / 2 >= nu . b - |nu|^2 / 2 - N max_i (K^T S^T nu)_i / w_i

for any x, which is tight for nu = b + c - y at the optimum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.spread import Convolution

#: Iterations after which x is returned (early stopping keeps it smooth) and of the search for the least error; interval of its
#: checks.
SMOOTH_STEPS, MOST_STEPS, LOOK = 60, 3000, 50
#: Budget of iterations times cells, about a second, and least number of iterations.
WORK, LEAST_STEPS = 3e7, 300
#: Most cells per pixel along each axis.
FINEST = 2
#: Relative gap between error and bound at which the iterations end.
TIGHT = 0.02
#: Cells of which no more than this fraction, rounding, reaches the screen are left out.
REACHES = 1e-9


@dataclass(frozen=True, eq=False)
class Deconvolved:
    """Result of a deconvolution.

    light: (n + 2 a, m + 2 b), relative irradiance on the pixels of the screen and of a margin around it; beside: that margin (a,
    b), pixels; error: relative RMS between the picture and the best solution found, blurred, each over its own mean on the screen;
    bound: lower bound of that error for any light; kept: fraction of `light` that the blur leaves on the screen.
    """

    light: np.ndarray
    beside: tuple[int, int]
    error: float
    bound: float
    kept: float


def deconvolved(target: np.ndarray, spread: Convolution, steps: int | None = None) -> Deconvolved:
    """The irradiance that, blurred by an extended source, is closest to a picture.

    Args:
        target: (n, m), not negative, not all zero, any scale.
        spread: convolution with the source's image on the target's pixels.
        steps: iterations; None for about a second of them.
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
