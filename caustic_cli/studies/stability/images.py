"""Difficult cases of what rays leave on the screen."""

from __future__ import annotations

import math

import numpy as np
import torch

from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen
from caustic_cli.studies.stability.case import Case

SCREEN = Screen((4.0, 4.0), 20.0, (16, 16))
#: Of the fold: a lens of degree 4 along x, whose surface z = A x^2 + B x^4 lands in a cusp, and its screen.
FOLDED = Lens(size=(2.0, 2.0), control=(5, 2), degree=(4, 1), index=1.5, fresnel="none")
FAR, COLUMNS = Screen((1.2, 4.0), 40.0, (24, 2)), 24
A, B = -0.03, 0.02


def one_pixel(millions: int) -> tuple[float, float]:
    """A pixel that holds all but a million unit weights, and a million rays after them."""
    more = 1_000_000
    weights = torch.ones(1, more + 1, dtype=torch.float32)
    weights[0, 0] = (millions - 1.0) * more
    naive = float(np.add.accumulate(weights.numpy()[0], dtype=np.float32)[-1])
    image, _ = splat(*[torch.full_like(weights, 0.1)] * 2, weights, SCREEN, Filter())
    whole = millions * more
    return abs(naive / whole - 1.0), abs(float(image.sum()) / whole - 1.0)


def borders(size: int) -> tuple[float, float]:
    """Rays on the borders of pixels and of the frame, a rounding beside them, and far outside, under a filter of this size."""
    half, pixel = SCREEN.half_size[0], SCREEN.pixel[0]
    edges = [-half, half, pixel - half, half - pixel, 0.0, pixel, 1.5 * pixel, half + pixel]
    beside = [float(np.nextafter(e, s * 1e9)) for e in edges for s in (1, -1)]
    x, y = (torch.tensor(a.ravel()).view(1, -1) for a in np.meshgrid(*[[*edges, *beside, 1e4, -1e30, math.inf, math.nan]] * 2))
    one, filter = torch.ones_like(x), Filter("cosine", (size, size))
    image, off = splat(x, y, one, SCREEN, filter)
    inside = (x.abs() < half) & (y.abs() < half)
    beyond = splat(x[inside].view(1, -1), y[inside].view(1, -1), one[inside].view(1, -1), SCREEN, filter)[1]
    naive = float(beyond) / int(inside.sum())  # shares beyond the frame, given to the pixels that remain
    return naive, abs(float(image.sum()) + float(off) - x.numel()) / x.numel()


def fold_heights() -> torch.Tensor:
    """Control heights (5, 2) of the fold, mm, exact."""
    greville = HeightField.of(FOLDED).spaces[0].greville
    at = 2.0 * greville - 1.0
    matrix = HeightField.of(FOLDED).spaces[0].matrix(greville)
    return torch.linalg.solve(matrix, A * at**2 + B * at**4)[:, None].expand(5, 2).contiguous()


def fold_landing(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray at x lands, and dX/dx, by the closed form of a plane wave."""
    z, g, gg = A * x**2 + B * x**4, 2 * A * x + 4 * B * x**3, 2 * A + 12 * B * x**2
    n = FOLDED.index
    s = np.sqrt(1.0 - (n * n - 1.0) * g * g)
    m = (n * n - 1.0) / (1.0 + n * s)
    dm = n * (n * n - 1.0) * g / s * m / (1.0 + n * s)
    return x + (FAR.z - z) * m * g, 1.0 + (FAR.z - z) * (m + dm * g) * gg - m * g * g


def fold_powers() -> np.ndarray:
    """Power of every column of pixels (COLUMNS,): the lengths of x that land there, from all crossings of its edges."""
    edges = np.linspace(-0.6, 0.6, COLUMNS + 1)
    x = np.linspace(-1.0, 1.0, 4000)  # an even number: no point lies on an edge
    at = fold_landing(x)[0]
    cuts = [x[0], x[-1]]
    for e in edges:
        for k in np.nonzero((at[:-1] - e) * (at[1:] - e) < 0)[0]:
            low, high = x[k], x[k + 1]
            for _ in range(60):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if (fold_landing(middle)[0] - e) * (at[k] - e) > 0 else (low, middle)
            cuts.append(0.5 * (low + high))
    ends = np.sort(cuts)
    column = np.searchsorted(edges, fold_landing(0.5 * (ends[1:] + ends[:-1]))[0]) - 1
    inside = (column >= 0) & (column < COLUMNS)
    return np.bincount(column[inside], np.diff(ends)[inside] / 2.0, COLUMNS)


def fold(rays: int) -> tuple[float, float]:
    """Where the map from lens to screen folds, the irradiance 1 / |det| is infinite, but the power of a pixel is not."""
    field = HeightField.of(FOLDED)
    found = expose(Scene(PlaneWave(), FOLDED, FAR), field, fold_heights(), Sampler("grid", (rays, 2)), Filter()).image
    exact, x = fold_powers(), np.linspace(-1.0, 1.0, 200_001)
    stretch = fold_landing(x)[1]
    folds = np.nonzero(stretch[:-1] * stretch[1:] < 0)[0]
    naive = 1.0 / np.abs(stretch[folds]).min() * FAR.pixel[0] / 2.0 - exact.max()  # the irradiance there times the pixel
    return float(naive), float(np.abs(found.sum(1).numpy() - exact).max())


def lenslet_borders(count: int) -> tuple[float, float]:
    """A grid of rays, of which every tenth lies on a border between lenslets: each is traced by one of them."""
    net = torch.full((3 * count + 1, 3 * count + 1), Lens().offset.thickness, dtype=torch.float64)
    lens = Lens(size=(4.0, 4.0), control=tuple(net.shape), array=(count, count), fresnel="none")
    u = np.linspace(0.0, 1.0, 10 * count + 1)[:, None] * count
    naive = float(((np.arange(count) <= u) & (u <= np.arange(count) + 1)).sum() / len(u)) ** 2 - 1.0  # both neighbours have them
    rays = Sampler("grid", (10 * count, 10 * count))
    image = expose(Scene(PlaneWave(), lens, Screen((8.0, 8.0), 50.0, (9, 9))), HeightField.of(lens), net, rays, Filter())
    return naive, abs(float(image.image.sum()) + sum(image.lost.values()) - 1.0)


CASES = (
    # sums of whole numbers below 2^53 are exact in float64; one rounding of the quotient follows
    Case("1e8 unit weights into one pixel", "the pixel, relative", "a sum in float32 stops at 2^24", 1e-12, one_pixel, (100,)),
    # some thousand additions, each rounded by 1e-16
    Case("landing on borders of pixels", "power, relative", "shares beyond the frame are lost", 1e-12, borders, (3, 7)),
    # two edges of a pixel, each met by up to three branches, and half a ray of 20,000 at each crossing: 6 / 40,000
    Case("folds", "power of a pixel", "1 / |det| is infinite there", 1.5e-4, fold, (20_000,)),
    # 10,000 additions of 1e-4, each rounded by 1e-16
    Case("borders between lenslets", "power, relative", "both neighbours have the ray", 1e-12, lenslet_borders, (3, 10)),
)
