"""An extended source that shifts the image: the image of its middle, convolved with its own shape.

Light of a source point beside the middle that leaves the lens at the same point lands shifted by (S_x dx, S_y dy), nearly alike for
all of the lens.  How nearly is measured on the outermost points: `error` is the most by which light lands elsewhere than so
shifted, `usual` what most of it keeps below.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from scipy.fft import next_fast_len
from scipy.spatial import cKDTree
from torch import Tensor

from caustic_cli.optics.emission.base import Illuminated
from caustic_cli.optics.emission.coherent import Mode, central_mode, outermost_modes
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Scene

#: The part of light that is most of it.
MOST = 0.8
#: Points along each axis of the pupil whose light says how a source shifts the image.
POINTS = 33
#: Cells of an image in the half axes of an ellipse that are aimed at, and into how many a pixel is cut at most for that.  Light is
#: taken to be in the middle of its cell: with 6 in a half axis that is wrong by 0.02 relative RMS, with 24 by 0.001.
CELLS, MOST_CUT = 16.0, 4
#: Points of an ellipse: least along an axis, and to a cell of an image.
LEAST, A_CELL = 64, 6

#: How often points of the pupil are corrected until light of another mode leaves the lens where the middle's does.
CORRECTIONS = 3
#: Where the light of a point of the source lands that passes points (N,) of the pupil: X, Y, mm, its power, and where it leaves the
#: lens, mm.
Landing = Callable[[Mode, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Spread:
    """half: half axes of the ellipse over which a point of the image is spread, mm, 0 for points; shifts: of the source's positions
    on the screen (dx, dy), mm, and their parts of the power; error, usual: see above; brightness: of the source over its frame,
    (n, m) [i, j], None if even over the ellipse; frame: half widths of that on the screen, mm, negative where it is mirrored."""

    half: tuple[float, float]
    shifts: tuple[tuple[float, float, float], ...]
    error: float
    usual: float = 0.0
    brightness: np.ndarray | None = None
    frame: tuple[float, float] = (0.0, 0.0)

    def reach(self) -> tuple[float, float]:
        """How far it spreads, mm."""
        x, y = (max(abs(s[k]) for s in self.shifts) + self.half[k] for k in (0, 1))
        return x, y

    def on(self, pixel: tuple[float, float], most: int = MOST_CUT) -> Convolution:
        """The same on an image of such pixels, mm, that are cut into a divisor of `most` along each axis if they are too wide."""
        cut = _cut(min((h for h in self.half if h > 0), default=max(self.reach()) / 2.0), pixel, most)
        return Convolution(torch.from_numpy(self.kernel((pixel[0] / cut, pixel[1] / cut))), cut)

    def parts_on(self, pixel: tuple[float, float], places: list[tuple[float, float]], most: int = MOST_CUT) -> list[Convolution]:
        """The same of parts of every position: of all that is nearest to each of these points of its frame, [-1, 1]^2, about it.

        Their kernels are of one shape; their sums are their parts of the whole times the number of parts.
        """
        cut = _cut(min(h for h in self.half if h > 0) / math.sqrt(len(places)), pixel, most)
        cell = (pixel[0] / cut, pixel[1] / cut)
        kernels = [self.kernel(cell, (places, k)) for k in range(len(places))]
        a, b = (max(kernel.shape[axis] for kernel in kernels) for axis in (0, 1))  # odd, as each is
        alike = [np.pad(k, [((n - m) // 2,) * 2 for n, m in zip((a, b), k.shape, strict=True)]) for k in kernels]
        return [Convolution(torch.from_numpy(kernel), cut) for kernel in alike]

    def kernel(self, cell: tuple[float, float], part: tuple[list[tuple[float, float]], int] | None = None) -> np.ndarray:
        """Part of the light of a cell that each cell about it gets: (2 a + 1, 2 b + 1), of sum 1, not negative.

        Points of the ellipse are shared out linearly among cells, which widens it; its half axes are less by so much that its
        second moments stay what they are.  part: see `parts_on`, points and the number of one.
        """
        if self.brightness is None:
            rx, ry = (math.sqrt(max(0.0, h * h - 2.0 / 3.0 * w * w)) for h, w in zip(self.half, cell, strict=True))
            half = rx, ry
            x, y = _even_disc(half, cell)
            light = np.full(len(x), 1.0 / len(x))
        else:
            half = self.frame
            x, y, light = _bright(self.brightness, half, cell)
        dx, dy, power = np.array(self.shifts if part is None else ((0.0, 0.0, 1.0),)).T
        power = power / power.sum()
        if part is not None:
            places, k = np.array(part[0]), part[1]
            mine = cKDTree(places).query(np.stack([x, y], 1))[1] == k
            x, y, light = x[mine] - places[k, 0], y[mine] - places[k, 1], light[mine] * len(places)
        x, y = (h / w * c for h, w, c in zip(half, cell, (x, y), strict=True))
        # A part of the source may lie farther from its own point than the source from its middle.
        a, b = (
            max(math.ceil(r / w), math.ceil(float(np.abs(d).max() / w + np.abs(c).max(initial=0.0)))) + 1
            for r, w, d, c in zip(self.reach(), cell, (dx, dy), (x, y), strict=True)
        )
        at_x, at_y = (d[:, None] / w + c + n for d, c, w, n in ((dx, x, cell[0], a), (dy, y, cell[1], b)))
        i, j = np.floor(at_x).astype(int), np.floor(at_y).astype(int)
        found = np.zeros((2 * a + 2) * (2 * b + 2))
        for p in (0, 1):
            for q in (0, 1):
                weight = power[:, None] * light * np.abs(1 - p - (at_x - i)) * np.abs(1 - q - (at_y - j))
                found += np.bincount(((i + p) * (2 * b + 2) + j + q).ravel(), weight.ravel(), len(found))
        return found.reshape(2 * a + 2, 2 * b + 2)[:-1, :-1]


def _bright(picture: np.ndarray, half: tuple[float, float], cell: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of [-1, 1]^2, even within every pixel of a picture of brightness and many to a cell, and their parts of its light."""
    fine = [math.ceil(A_CELL * 2.0 * abs(h) / (w * n)) for h, w, n in zip(half, cell, picture.shape, strict=True)]
    light = picture.repeat(max(1, fine[0]), 0).repeat(max(1, fine[1]), 1)
    x, y = ((np.arange(n) + 0.5) * (2.0 / n) - 1.0 for n in light.shape)
    lit = light > 0
    i, j = np.nonzero(lit)
    return x[i], y[j], light[lit] / light.sum()


def _cut(fine: float, pixel: tuple[float, float], most: int) -> int:
    """Into how many cells a pixel is cut along each axis for what is so fine, mm: a divisor of `most`, whose cells make up each."""
    wanted = min(MOST_CUT, CELLS * max(pixel) / fine) if fine > 0 else 1.0
    return next((k for k in range(1, most) if most % k == 0 and k >= wanted), most)


def _even_disc(half: tuple[float, float], cell: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Even points of the unit disc, so close that an ellipse of these half axes has many in each cell; the middle of none."""
    if max(half) == 0:
        return np.zeros(1), np.zeros(1)
    n = max(LEAST, math.ceil(A_CELL * max(2.0 * h / w for h, w in zip(half, cell, strict=True))))
    line = (np.arange(n) + 0.5) * (2.0 / n) - 1.0
    x, y = (c.ravel() for c in np.meshgrid(line, line, indexing="ij"))
    inside = x * x + y * y <= 1.0
    return x[inside], y[inside]


@dataclass(frozen=True, eq=False)
class Convolution:
    """A kernel (2 a + 1, 2 b + 1) for images whose pixels are cut into `cut` along each axis."""

    kernel: Tensor
    cut: int
    _spectra: dict = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def beside(self) -> tuple[int, int]:
        """Cut pixels beside the screen, whole pixels of them, whose light reaches it."""
        a, b = (self.cut * math.ceil((n // 2) / self.cut) for n in self.kernel.shape)
        return a, b

    def __call__(self, image: Tensor) -> Tensor:
        """An image on cut pixels, with those beside, (a, b) -> that on the screen's pixels alone; differentiable."""
        (n, m), (a, b) = image.shape, self.beside
        found = self.whole(image)[a : n - a, b : m - b]
        n, m = (s // self.cut for s in found.shape)
        return found.reshape(n, self.cut, m, self.cut).sum((1, 3))

    def whole(self, image: Tensor, adjoint: bool = False) -> Tensor:
        """An image convolved with the kernel, dark beyond its frame; adjoint: with the kernel turned round."""
        reach = tuple(n // 2 for n in self.kernel.shape)
        shape = tuple(next_fast_len(n + r, real=True) for n, r in zip(image.shape, reach, strict=True))
        spectrum = self._spectrum(shape, image)
        found = torch.fft.irfft2(torch.fft.rfft2(image, s=shape) * (spectrum.conj() if adjoint else spectrum), s=shape)
        return found[: image.shape[0], : image.shape[1]]

    def _spectrum(self, shape: tuple[int, int], like: Tensor) -> Tensor:
        key = shape, like.dtype, like.device
        if key not in self._spectra:
            padded = like.new_zeros(shape)
            n, m = self.kernel.shape
            padded[:n, :m] = self.kernel
            self._spectra[key] = torch.fft.rfft2(torch.roll(padded, (-(n // 2), -(m // 2)), (0, 1)))
        return self._spectra[key]


def spread_at(scene: Scene, field: HeightField, heights: Tensor) -> Spread | None:
    """How an extended source spreads the image of its middle on the screen of a scene whose lens has these heights (n, m) mm; None
    where it does not."""
    system, parameters = System.of(scene, field), {EXIT: heights.detach().double()}

    def landing(mode: Mode, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        tracer = Tracer(system, mode.through(u, v, system.before.index_at(None)))
        state, left = tracer.land(parameters, scene.screen)[0].expanded(), tracer.last(parameters).state.expanded()
        return *state.full(state.origin)[:2], state.power, *left.full(left.origin)[:2]

    return spread_of(system, landing, heights.device)


@torch.no_grad()
def spread_of(lit: Illuminated, landing: Landing, device: str | torch.device = "cpu") -> Spread | None:
    """How an extended source spreads the image of its middle; None where it is none, or its light misses or lies in depth.

    Raises:
        as `landing`.
    """
    source, outer, centre = lit.source, outermost_modes(lit), central_mode(lit)
    if source.rays is not None or len(source.members) > 1:
        return None
    if not outer or (not source.distant and float(np.ptp(source.points()[0][:, 2])) > 0):
        return None
    line = torch.linspace(0.0, 1.0, POINTS, dtype=torch.float64, device=device)
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    (x, y, power, at_x, at_y), moved = landing(centre, u, v), []
    for mode in outer:
        through_u, through_v = u, v
        for _ in range(CORRECTIONS):
            *_, left_x, left_y = landing(mode, through_u, through_v)
            through_u = through_u - (left_x - at_x) / (2.0 * lit.pupil.half_size[0])
            through_v = through_v - (left_y - at_y) / (2.0 * lit.pupil.half_size[1])
        to_x, to_y, arriving, *_ = landing(mode, through_u, through_v)
        within = ((through_u - 0.5).abs() <= 0.5) & ((through_v - 0.5).abs() <= 0.5)
        lit_too = (power > 0) & (arriving > 0) & within
        if not bool(lit_too.any()):
            return None
        moved.append([(to_x - x)[lit_too], (to_y - y)[lit_too]])
    # Shifts in proportion to the place on the source, by the outermost along each axis, and what departs from that.
    slope = []
    for k in (0, 1):
        (up, down), (high, low) = outer[2 * k : 2 * k + 2], moved[2 * k : 2 * k + 2]
        apart = up.position[k] - down.position[k]
        slope.append(float(high[k].mean() - low[k].mean()) / apart if apart else 0.0)
    off = torch.cat(
        [
            torch.hypot(*(m[k] - slope[k] * (mode.position[k] - centre.position[k]) for k in (0, 1)))
            for mode, m in zip(outer, moved, strict=True)
        ]
    )
    error, usual = float(off.max()), float(torch.quantile(off, MOST))
    sx, sy = slope
    frame = sx * source.frame[0], sy * source.frame[1]
    if source.distant:
        sine = math.sin(source.half_angle)
        return Spread((abs(sx) * sine, abs(sy) * sine), ((0.0, 0.0, 1.0),), error, usual, source.brightness, frame)
    places = tuple(
        (float(slope[0] * (p[0] - centre.position[0])), float(slope[1] * (p[1] - centre.position[1])), float(part))
        for p, part in zip(*source.points(), strict=True)
    )
    ex, ey = source.extent
    return Spread((abs(sx) * ex, abs(sy) * ey), places, error, usual, source.brightness, frame)
