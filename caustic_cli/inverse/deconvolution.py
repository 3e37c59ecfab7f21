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

which is tight for nu = b + c - y at the optimum.  Before it is reached, t is the height of a few peaks.  These are cut off at any
level t: with the excess e_i >= 0 above it at cell i, d_j the largest excess of the cells whose image reaches pixel j has
K^T S^T d >= e w, so that nu - d takes the place of nu.

If no more light than s may fall beside the screen, relative to that on it, then for every price m > 0 of such light t is
max_i ((K^T S^T nu)_i - m (1 - w_i)) / w_i, and N m s more is subtracted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.spread import Convolution

#: Iterations after which x is returned, since early stopping keeps it smooth; interval of the checks for the least error.
SMOOTH_STEPS, LOOK = 60, 50
#: Budget of iterations times cells for the bound alone, a few seconds, and least number of iterations.
BOUND_WORK, BOUND_STEPS = 2e8, 100
#: Most cells per pixel along each axis.
FINEST = 2
#: Level at which peaks are cut off, as a fraction of the highest, see the module.
CUT = 0.5
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
    all_of_it = [_Light.of(b, spread)]
    light, kept, least, bound = np.zeros_like(target), 1.0, math.inf, 0.0
    for k, ((x,), c) in enumerate(itertools.islice(_iterates(b, all_of_it), steps), 1):
        if k == min(SMOOTH_STEPS, steps):
            n, m = (s // cut for s in x.shape)
            light = x.reshape(n, cut, m, cut).mean((1, 3)).numpy()
            kept = float(_seen([x], all_of_it).sum() * cut**2 / x.sum())
        if k % LOOK == 0 or k == steps:
            error, below = _error_and_bound(b, [x], c, all_of_it)
            least, bound = min(least, error), max(bound, below)
            if k >= SMOOTH_STEPS and _tight(least, bound):
                break
    return Deconvolved(light, tuple(n // cut for n in spread.beside), least, bound, kept)


@dataclass(frozen=True, eq=False)
class Blur:
    """One of several images of a source: convolutions with it, from coarse to fine cells, and the light that has it."""

    levels: tuple[Convolution, ...]
    #: (n, m) pixels of the screen around which it is the image of light, None for all of it.
    where: Tensor | None = None


def error_bound(target: np.ndarray, blurs: Sequence[Blur], most: int, price: float = 0.0, beside: float = math.inf) -> float:
    """Lower bound of the relative RMS error of any sum of irradiances, each blurred by one of these.

    Args:
        target: as of `deconvolved`.
        blurs: of as many levels each; light of which no blur is that of its place may have any, if it reaches only dark pixels.
        most: iterations at each level, of which large pictures get fewer.
        price, beside: most light beside the screen, relative to that on it, and the price of it that is tried, see the module; the
            largest bound of several prices is the tightest.
    """
    b, bound = torch.from_numpy(target / target.mean()), 0.0
    before: tuple[list[_Light], list[Tensor], float] | None = None
    elsewhere = all(blur.where is not None for blur in blurs)
    for spreads in zip(*(blur.levels for blur in blurs), strict=True):
        steps = int(min(most, max(BOUND_STEPS, BOUND_WORK / sum(_cells(b, spread).numel() for spread in spreads))))
        lights = [_Light.of(b, spread, blur.where) for spread, blur in zip(spreads, blurs, strict=True)]
        quick, least, bound = [light.single() for light in lights], math.inf, 0.0
        for k, (x, c) in enumerate(itertools.islice(_iterates(b.float(), quick, LEAST_REACH, price, before), steps), 1):
            if k % LOOK == 0 or k == steps:
                exact = [v.double() for v in x]
                error, below = _error_and_bound(b, exact, c, lights, price, beside if price > 0.0 else 0.0, elsewhere)
                least, bound = min(least, error), max(bound, below)
                if _tight(least, bound):
                    break
        before = lights, x, c
    return bound


def _tight(error: float, bound: float) -> bool:
    """Whether further iterations have nothing to find."""
    return bound > (1.0 - TIGHT) * error or error < NO_ERROR


@dataclass(frozen=True, eq=False)
class _Light:
    """Light of one blur on cells of one size."""

    spread: Convolution
    #: w, the fraction of a cell's light on the screen; 0 where there is no such light.
    reach: Tensor

    @classmethod
    def of(cls, b: Tensor, spread: Convolution, where: Tensor | None = None) -> _Light:
        """That on and around a screen of pixels b (n, m), within `where`, if that is given."""
        reach = _back(torch.ones_like(b), spread)
        if where is not None:
            beside = (spread.beside[1],) * 2 + (spread.beside[0],) * 2
            wide = where.to(b).repeat_interleave(spread.cut, 0).repeat_interleave(spread.cut, 1)
            reach = reach * torch.nn.functional.pad(wide[None, None], beside, mode="replicate")[0, 0]
        return cls(spread, torch.where(reach > REACHES, reach, 0.0))

    def single(self) -> _Light:
        """The same in single precision."""
        return replace(self, spread=Convolution(self.spread.kernel.float(), self.spread.cut), reach=self.reach.float())

    def begun(self, b: Tensor, before: tuple[Convolution, Tensor] | None, count: int) -> Tensor:
        """Irradiance to begin with: of `count` lights that look like b, or one on coarser cells."""
        if before is None:
            return torch.where(self.reach > 0.0, _cells(b, self.spread) / count, 0.0)
        coarse, x = before
        finer = self.spread.cut // coarse.cut
        x = x.repeat_interleave(finer, 0).repeat_interleave(finer, 1)
        (n, m), (fine_n, fine_m) = x.shape, self.reach.shape
        more_n, more_m = (fine_n - n) // 2, (fine_m - m) // 2  # negative where the margin is narrower
        return torch.nn.functional.pad(x, (more_m, more_m, more_n, more_n))


def _iterates(
    b: Tensor,
    lights: Sequence[_Light],
    least: float = 1.0,
    price: float = 0.0,
    before: tuple[Sequence[_Light], Sequence[Tensor], float] | None = None,
) -> Iterator[tuple[list[Tensor], float]]:
    """x of each light and c after each iteration for a picture b (n, m) of mean 1.

    least: of the divisor w of the steps, in whose metric they are gradients: 1 leaves little light around the screen, less than 1
    converges sooner there; price: of light beside the screen; before: lights, x and c on coarser cells.
    """
    count = len(lights)
    metric = [light.reach.clamp_min(least) for light in lights]
    coarse = [None] * count if before is None else [(old.spread, v) for old, v in zip(*before[:2], strict=True)]
    x = [light.begun(b, old, count) for light, old in zip(lights, coarse, strict=True)]
    ahead, t, c = x, 1.0, 0.0 if before is None else before[2]
    while True:
        y = _seen(ahead, lights)
        moved = [
            torch.where(
                light.reach > 0.0,
                (a + (_back(b + c - y, light.spread) - price * (1.0 - light.reach)) / (count * w)).clamp_min(0.0),
                0.0,
            )
            for a, light, w in zip(ahead, lights, metric, strict=True)
        ]
        c += 0.5 * (1.0 - float(y.mean()))
        if math.fsum(float((w * (a - m) * (m - v)).sum()) for a, m, v, w in zip(ahead, moved, x, metric, strict=True)) > 0.0:
            t = 1.0
        after = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * t * t))
        ahead = [m + (t - 1.0) / after * (m - v) for m, v in zip(moved, x, strict=True)]
        x, t = moved, after
        yield x, c


def _error_and_bound(
    b: Tensor,
    x: list[Tensor],
    c: float,
    lights: Sequence[_Light],
    price: float = 0.0,
    beside: float = 0.0,
    elsewhere: bool = False,
) -> tuple[float, float]:
    """Relative RMS error of the blurred irradiances x, and the lower bound by their nu; elsewhere: other light may reach dark
    pixels."""
    y = _seen(x, lights)
    nu = b + c - y
    nu, y = nu - nu.mean(), y / y.mean()
    error, bound = float((y - b).square().mean().sqrt()), 0.0
    heights = [
        torch.where(light.reach > 0.0, (_back(nu, light.spread) - price * (1.0 - light.reach)) / light.reach, -math.inf)
        for light in lights
    ]
    beside_all = torch.where(b > 0.0, -math.inf, nu) if elsewhere else torch.full_like(nu, -math.inf)
    highest = max(float(height.max()) for height in (*heights, beside_all))
    for level in (highest, CUT * highest):
        cut = (beside_all - level).clamp_min(0.0)
        if level < highest:
            for height, light in zip(heights, lights, strict=True):
                cut = torch.maximum(cut, _largest((height - level).clamp_min(0.0), light.spread))
        without = nu - cut
        above, size = float((without * b).sum()) - b.numel() * (level + price * beside), float(without.norm())
        if above > 0.0 and size > 0.0:
            bound = max(bound, above / (size * math.sqrt(b.numel())))
    return error, bound


def _largest(excess: Tensor, spread: Convolution) -> Tensor:
    """The largest excess, on cells, within reach of each pixel of the screen."""
    (n, m), (a, b), cut = spread.kernel.shape, spread.beside, spread.cut
    pool = torch.nn.functional.max_pool2d
    wide = pool(pool(excess[None, None], (n, 1), 1, (n // 2, 0)), (1, m), 1, (0, m // 2))
    return pool(wide[..., a : wide.shape[-2] - a, b : wide.shape[-1] - b], cut)[0, 0]


def _seen(x: Sequence[Tensor], lights: Sequence[_Light]) -> Tensor:
    """The image S K x, (n, m)."""
    return torch.stack([light.spread(one) / light.spread.cut**2 for one, light in zip(x, lights, strict=True)]).sum(0)


def _cells(v: Tensor, spread: Convolution) -> Tensor:
    """An image (n, m) on the cells of the screen and around it."""
    around = (spread.beside[1],) * 2 + (spread.beside[0],) * 2
    return torch.nn.functional.pad(v.repeat_interleave(spread.cut, 0).repeat_interleave(spread.cut, 1), around)


def _back(v: Tensor, spread: Convolution) -> Tensor:
    """The adjoint of the blur, K^T S^T v, times the cells per pixel: the step of the gradient on cells."""
    return spread.whole(_cells(v, spread), adjoint=True)
