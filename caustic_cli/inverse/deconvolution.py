"""Non-negative deconvolution of a picture by the image of an extended source, with a duality bound on the least possible error.

    minimise  |y - b|^2 / 2,    y = S K x,    x >= 0,    mean(y) = mean(b) = 1

K is the convolution with the source's image and S the restriction to the screen: b is the picture on the screen, x the irradiance
on the screen and on the margin from which light is still spread onto it.  Accelerated projected gradients with restarts (Beck and
Teboulle, SIAM J. Imaging Sci. 2, 2009; O'Donoghue and Candes, Found. Comput. Math. 15, 2015); the multiplier c of the mean
constraint is added to b and updated by mean(y).  Where the image of the source differs over the lens and the screen, y is the sum
of several S K x.

Weak duality gives a lower bound for every nu: with w = K^T S^T 1 and N pixels, nu . y <= N t, t = max_i (K^T S^T nu)_i / w_i over
all K, for any x, and with the Cauchy-Schwarz inequality and nu less its mean, which changes nothing else,

    |y - b| >= (nu . b - N t) / |nu|

which is tight for nu = b + c - y at the optimum.  If no more light than s may fall beside the screen, relative to that on it, then
for every price m > 0 of such light t is max_i ((K^T S^T nu)_i - m (1 - w_i)) / w_i, and N m s more is subtracted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.spread import Convolution

#: Iterations after which x is returned, since early stopping keeps it smooth; interval of the checks for the least error.
SMOOTH_STEPS, LOOK = 60, 50
#: Budget of iterations times cells for the bound alone, a few seconds, and least number of iterations.
BOUND_WORK, BOUND_STEPS = 1e8, 100
#: Most cells per pixel along each axis.
FINEST = 2
#: Relative gap between error and bound at which the iterations end, and an error that is as good as none.
TIGHT, NO_ERROR = 0.02, 1e-3
#: Cells of which no more than this fraction, rounding, reaches the screen are left out.
REACHES = 1e-9
#: Least fraction of a cell's light on the screen by which steps are divided where the bound alone is asked for.
LEAST_REACH = 1e-4


@dataclass(frozen=True, eq=False)
class Deconvolved:
    """Result of a deconvolution."""

    #: (n + 2 a, m + 2 b), relative irradiance on the pixels of the screen and of a margin around it.
    light: np.ndarray
    #: That margin (a, b), pixels.
    beside: tuple[int, int]
    #: Relative RMS between the picture and the best solution found, blurred, each over its own mean on the screen.
    error: float
    #: Lower bound of that error for any light.
    bound: float
    #: Fraction of `light` that the blur leaves on the screen.
    kept: float


def deconvolved(target: np.ndarray, spread: Convolution, steps: int) -> Deconvolved:
    """The irradiance that, blurred by an extended source, is closest to a picture.

    Args:
        target: (n, m), not negative, not all zero, any scale.
        spread: convolution with the source's image on the target's pixels.
        steps: most iterations.
    """
    b, cut = torch.from_numpy(target / target.mean()), spread.cut
    light, kept, least, bound = np.zeros_like(target), 1.0, math.inf, 0.0
    for k, ((x,), c) in enumerate(itertools.islice(_iterates(b, [spread]), steps), 1):
        if k == min(SMOOTH_STEPS, steps):
            n, m = (s // cut for s in x.shape)
            light = x.reshape(n, cut, m, cut).mean((1, 3)).numpy()
            kept = float(_seen([x], [spread]).sum() * cut**2 / x.sum())
        if k % LOOK == 0 or k == steps:
            error, below = _error_and_bound(b, [x], c, [spread])
            least, bound = min(least, error), max(bound, below)
            if k >= SMOOTH_STEPS and _tight(least, bound):
                break
    return Deconvolved(light, tuple(n // cut for n in spread.beside), least, bound, kept)


def error_bound(
    target: np.ndarray, spreads: Sequence[Convolution], most: int, price: float = 0.0, beside: float = math.inf
) -> float:
    """Lower bound of the relative RMS error of any sum of irradiances, each blurred by one of these.

    Args:
        target: as of `deconvolved`.
        most: iterations, of which large pictures get fewer.
        price, beside: most light beside the screen, relative to that on it, and the price of it that is tried, see the module; the
            largest bound of several prices is the tightest.
    """
    b = torch.from_numpy(target / target.mean())
    steps = int(min(most, max(BOUND_STEPS, BOUND_WORK / sum(_cells(b, spread).numel() for spread in spreads))))
    least, bound = math.inf, 0.0
    for k, (x, c) in enumerate(itertools.islice(_iterates(b, spreads, LEAST_REACH, price), steps), 1):
        if k % LOOK == 0 or k == steps:
            error, below = _error_and_bound(b, x, c, spreads, price, beside if price > 0.0 else 0.0)
            least, bound = min(least, error), max(bound, below)
            if _tight(least, bound):
                break
    return bound


def _tight(error: float, bound: float) -> bool:
    """Whether further iterations have nothing to find."""
    return bound > (1.0 - TIGHT) * error or error < NO_ERROR


def _iterates(
    b: Tensor, spreads: Sequence[Convolution], least: float = 1.0, price: float = 0.0
) -> Iterator[tuple[list[Tensor], float]]:
    """x of each blur and c after each iteration for a picture b (n, m) of mean 1.

    least: of the divisor w of the steps, in whose metric they are gradients: 1 leaves little light around the screen, less than 1
    converges sooner there; price: of light beside the screen.
    """
    count = len(spreads)
    reach = [_back(torch.ones_like(b), spread) for spread in spreads]
    metric = [r.clamp_min(least) for r in reach]
    x = [_cells(b, spread) / count for spread in spreads]
    ahead, t, c = x, 1.0, 0.0
    while True:
        y = _seen(ahead, spreads)
        moved = [
            torch.where(r > REACHES, (a + (_back(b + c - y, spread) - price * (1.0 - r)) / (count * w)).clamp_min(0.0), 0.0)
            for a, spread, r, w in zip(ahead, spreads, reach, metric, strict=True)
        ]
        c += 0.5 * (1.0 - float(y.mean()))
        if math.fsum(float((w * (a - m) * (m - v)).sum()) for a, m, v, w in zip(ahead, moved, x, metric, strict=True)) > 0.0:
            t = 1.0
        after = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * t * t))
        ahead = [m + (t - 1.0) / after * (m - v) for m, v in zip(moved, x, strict=True)]
        x, t = moved, after
        yield x, c


def _error_and_bound(
    b: Tensor, x: list[Tensor], c: float, spreads: Sequence[Convolution], price: float = 0.0, beside: float = 0.0
) -> tuple[float, float]:
    """Relative RMS error of the blurred irradiances x, and the lower bound by their nu."""
    y = _seen(x, spreads)
    y = y / y.mean()
    error, nu, most = float((y - b).square().mean().sqrt()), b + c - y, -math.inf
    nu = nu - nu.mean()
    for spread in spreads:
        reach = _back(torch.ones_like(b), spread)
        near = reach > REACHES
        most = max(most, float(((_back(nu, spread) - price * (1.0 - reach))[near] / reach[near]).max()))
    above, size = float((nu * b).sum()) - b.numel() * (most + price * beside), float(nu.norm())
    return error, above / (size * math.sqrt(b.numel())) if above > 0.0 and size > 0.0 else 0.0


def _seen(x: Sequence[Tensor], spreads: Sequence[Convolution]) -> Tensor:
    """The image S K x, (n, m)."""
    return torch.stack([spread(one) / spread.cut**2 for one, spread in zip(x, spreads, strict=True)]).sum(0)


def _cells(v: Tensor, spread: Convolution) -> Tensor:
    """An image (n, m) on the cells of the screen and around it."""
    around = (spread.beside[1],) * 2 + (spread.beside[0],) * 2
    return torch.nn.functional.pad(v.repeat_interleave(spread.cut, 0).repeat_interleave(spread.cut, 1), around)


def _back(v: Tensor, spread: Convolution) -> Tensor:
    """The adjoint of the blur, K^T S^T v, times the cells per pixel: the step of the gradient on cells."""
    return spread.whole(_cells(v, spread), adjoint=True)
