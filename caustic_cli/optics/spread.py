"""The point-spread function of an extended source: its image is that of a point source at its centre convolved with its shape.

Light from a source point at (dx, dy) from the centre that leaves the lens at the same point lands shifted by (S_x dx, S_y dy),
nearly independent of that point (shift invariance).  The deviation is measured for the outermost source points: `error` is its
maximum over the light, `usual` a quantile of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from caustic_cli.loading import OnDemand
from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.emission.base import Illuminated
from caustic_cli.optics.emission.coherent import Mode, central_mode, modes, offset, outermost_modes, spots
from caustic_cli.optics.emission.regular import RegularGrid
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import PlaneWave, Points, Scene, Source

spatial = OnDemand("scipy.spatial")
#: Quantile of the deviation that `usual` is.
MOST = 0.8
#: Points along each axis of the pupil at which the shifts are measured.
POINTS = 33
#: Desired number of cells per half axis of the ellipse, and largest subdivision of a pixel for that.  Light is assigned to the
#: centre of its cell: with 6 cells per half axis the error is 0.02 relative RMS, with 24 it is 0.001.
CELLS, MOST_CUT = 16.0, 4
#: Tolerated fraction of the deviation from one shift in a refinement, and most points that a source is sampled by to keep within
#: it: of the same number of rays each point has a part, and the lens fits their noise instead (a mirror in the sun, fraction 0.12:
#: 0.349 with nine points and 0.320 with one; a chip right before a lens, fraction 0.2: 0.717 with 24 and 0.694 with one).
EXACT, MOST_MODES = 0.2, 24
#: The same of a wave image: of the larger of diffraction blur and pixel, and most points, of which each position has at least so
#: many.
ALLOWED, EACH, LEAST_EACH = 0.25, 24, 4
#: Sample points of an ellipse: least number along an axis, and per cell.
LEAST, A_CELL = 64, 6

#: Iterations that move pupil points until the light of another mode leaves the lens at the same points as that of the central mode.
CORRECTIONS = 3
#: Light of a source point through points (N,) of the pupil -> landing points X, Y, mm, power, and points where it leaves the lens,
#: mm.
Landing = Callable[[Mode, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Spread:
    """The point-spread function of a source on the screen."""

    #: Half axes of its ellipse, mm, 0 for point sources.
    half: tuple[float, float]
    #: Images (dx, dy), mm, of the source's positions, with their fractions of the power.
    shifts: tuple[tuple[float, float, float], ...]
    #: See the module.
    error: float
    usual: float = 0.0
    #: Of the source over its frame, (n, m) [i, j], None if uniform over the ellipse.
    brightness: np.ndarray | None = None
    #: Half widths of the frame's image, mm, negative where it is mirrored.
    frame: tuple[float, float] = (0.0, 0.0)
    #: Of an image that is sheared (a, b): a point (x, y) of the image as given by the other fields lies at (x + a y, y + b x).
    skew: tuple[float, float] = (0.0, 0.0)
    #: Rotation or reflection of a round source about its centre before its image as given by the other fields.
    turn: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    #: Whether x and y are nearer to the y and x of a source that is not round: its parts cannot be told apart then.
    exchanged: bool = False

    @classmethod
    def of(cls, source: Source, by: np.ndarray, error: float = 0.0, usual: float = 0.0) -> Spread:
        """That of a source whose points land displaced by the matrix `by`, (2, 2): mm per mm, or per direction sine."""
        frame, half = source.frame, [math.sin(source.half_angle)] * 2 if source.distant else source.extent
        exchanged, turn = abs(by[0, 0] * by[1, 1]) < abs(by[0, 1] * by[1, 0]), np.eye(2)
        if exchanged and source.even and half[0] == half[1]:  # a round source looks the same turned: polar decomposition
            u, s, v = np.linalg.svd(by)
            by, turn, exchanged = (u * s) @ u.T, u @ v, False
        sx, sy = (float(c) for c in np.diag(by))
        skew = tuple(float(by[i, 1 - i]) / s if s else 0.0 for i, s in ((0, sy), (1, sx)))
        places: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 1.0),)
        if not source.distant:
            places = tuple(
                (sx * (x - source.centre[0]), sy * (y - source.centre[1]), float(part))
                for (x, y), part in zip(source.points()[0][:, :2].tolist(), source.points()[1], strict=True)
            )
        return cls(
            (abs(sx) * half[0], abs(sy) * half[1]),
            places,
            error,
            usual,
            source.brightness,
            (sx * frame[0], sy * frame[1]),
            (skew[0], skew[1]),
            ((float(turn[0, 0]), float(turn[0, 1])), (float(turn[1, 0]), float(turn[1, 1]))),
            bool(exchanged),
        )

    def reach(self) -> tuple[float, float]:
        """Radius of the point-spread function along x and y, mm."""
        x, y = (max(abs(s[k]) for s in self.shifts) + self.half[k] for k in (0, 1))
        return x + abs(self.skew[0]) * y, y + abs(self.skew[1]) * x

    def on(self, pixel: tuple[float, float], most: int = MOST_CUT) -> Convolution:
        """The convolution on an image with these pixels, mm, which are subdivided into a divisor of `most` along each axis if too
        wide."""
        cut = _cut(min((h for h in self.half if h > 0), default=max(self.reach()) / 2.0), pixel, most)
        return Convolution(torch.from_numpy(self.kernel((pixel[0] / cut, pixel[1] / cut))), cut)

    def convolutions(self, pixel: tuple[float, float], places: list[tuple[float, float]]) -> list[Convolution]:
        """The convolution `on` an image, or with each of the source's `parts_on` these places, if any are given; none for a point
        source."""
        if not max(self.reach()) > 0:
            return []
        return self.parts_on(pixel, places) if places else [self.on(pixel)]

    def parts_on(self, pixel: tuple[float, float], places: list[tuple[float, float]], most: int = MOST_CUT) -> list[Convolution]:
        """Convolutions with parts of the source: the Voronoi cells of these points of its frame, [-1, 1]^2, each about its point.

        All kernels have one shape; the sum of a kernel is its part's fraction of the power times the number of parts.
        """
        cut = _cut(min(h for h in self.half if h > 0) / math.sqrt(len(places)), pixel, most)
        places = [tuple(p) for p in np.array(places) @ np.array(self.turn).T]
        cell = (pixel[0] / cut, pixel[1] / cut)
        kernels = alike([self.kernel(cell, (places, k)) for k in range(len(places))])
        return [Convolution(torch.from_numpy(kernel), cut) for kernel in kernels]

    @property
    def points(self) -> int:
        """Number of points of the source whose blurs represent it: one if the blur varies little over it, or has no parts."""
        if self.exchanged:
            return 1
        each = math.ceil((self.usual / (EXACT * max(self.reach()))) ** 2)
        return 1 if each <= 1 or not min(self.half) > 0 else min(each, MOST_MODES)

    def rays(
        self, scene: Scene, sampler: str, count: int, most: int, seed: int, device: str | torch.device
    ) -> tuple[Scene, Rays | Sequence[Rays], list[Convolution]]:
        """Rays whose images are convolved with the blur: from the centre of the source, from each of separate points, or from
        several points over which the blur varies; with the scene to trace them in and the convolution for the image of each point,
        `most` as of `on`."""
        pixel = scene.screen.pixel
        if scene.source.apart:
            places = [Mode(scene, tuple(at), float(part)) for at, part in zip(*scene.source.points(), strict=True)]
            return scene, RegularGrid.of_modes(places, count, device), [POINT.on(pixel, most)] * len(places)
        if self.points == 1:
            scene = replace(scene, source=point_source(scene))
            return scene, rays_of(scene, sampler, count, seed, device), [self.on(pixel, most)]
        parts = self.parts_on(pixel, spots(scene.source, self.points), most)
        return scene, RegularGrid.of_modes(modes(scene, self.points), count, device), parts

    def _sheared(self, x: np.ndarray, y: np.ndarray, cell: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
        """Points (x, y), mm, with the skew, in cells."""
        return (x + self.skew[0] * y) / cell[0], (y + self.skew[1] * x) / cell[1]

    def kernel(self, cell: tuple[float, float], part: tuple[list[tuple[float, float]], int] | None = None) -> np.ndarray:
        """The discrete kernel on cells of this size, mm: (2 a + 1, 2 b + 1), non-negative, of sum 1.

        Sample points are distributed bilinearly to cells, which widens the ellipse; its half axes are reduced so that the second
        moments are preserved.  part: points and the index of one of them, see `parts_on`.
        """
        if self.brightness is None:
            rx, ry = (math.sqrt(max(0.0, h * h - 2.0 / 3.0 * w * w)) for h, w in zip(self.half, cell, strict=True))
            x, y = _even_disc((rx, ry), cell)
            half = math.copysign(rx, self.frame[0]), math.copysign(ry, self.frame[1])
            light = np.full(len(x), 1.0 / len(x))
        else:
            half = self.frame
            x, y, light = _bright(self.brightness, half, cell)
        dx, dy, power = np.array(self.shifts if part is None else ((0.0, 0.0, 1.0),)).T
        power = power / power.sum()
        if part is not None:
            places, k = np.array(part[0]), part[1]
            mine = spatial.cKDTree(places).query(np.stack([x, y], 1))[1] == k
            x, y, light = x[mine] - places[k, 0], y[mine] - places[k, 1], light[mine] * len(places)
        x, y = self._sheared(half[0] * x, half[1] * y, cell)
        dx, dy = self._sheared(dx, dy, cell)
        # A part of the source may extend farther from its own point than the source from its centre.
        a, b = (
            max(math.ceil(r / w), math.ceil(float(np.abs(d).max() + np.abs(c).max(initial=0.0)))) + 1
            for r, w, d, c in zip(self.reach(), cell, (dx, dy), (x, y), strict=True)
        )
        at_x, at_y = (d[:, None] + c + n for d, c, n in ((dx, x, a), (dy, y, b)))
        i, j = np.floor(at_x).astype(int), np.floor(at_y).astype(int)
        found = np.zeros((2 * a + 2) * (2 * b + 2))
        for p in (0, 1):
            for q in (0, 1):
                weight = power[:, None] * light * np.abs(1 - p - (at_x - i)) * np.abs(1 - q - (at_y - j))
                found += np.bincount(((i + p) * (2 * b + 2) + j + q).ravel(), weight.ravel(), len(found))
        return found.reshape(2 * a + 2, 2 * b + 2)[:-1, :-1]


def alike(kernels: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Kernels with an odd number of cells along each axis, padded to a common shape."""
    a, b = (max(kernel.shape[axis] for kernel in kernels) for axis in (0, 1))
    return [np.pad(k, [((n - m) // 2,) * 2 for n, m in zip((a, b), k.shape, strict=True)]) for k in kernels]


#: That of a point source.
POINT = Spread((0.0, 0.0), ((0.0, 0.0, 1.0),), 0.0)


def _bright(picture: np.ndarray, half: tuple[float, float], cell: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of [-1, 1]^2, uniform within every pixel of a brightness picture and several per cell, and their fractions of its
    light."""
    fine = [math.ceil(A_CELL * 2.0 * abs(h) / (w * n)) for h, w, n in zip(half, cell, picture.shape, strict=True)]
    light = picture.repeat(max(1, fine[0]), 0).repeat(max(1, fine[1]), 1)
    x, y = ((np.arange(n) + 0.5) * (2.0 / n) - 1.0 for n in light.shape)
    lit = light > 0
    i, j = np.nonzero(lit)
    return x[i], y[j], light[lit] / light.sum()


def _cut(fine: float, pixel: tuple[float, float], most: int) -> int:
    """Subdivision of a pixel along each axis that resolves a length `fine`, mm: a divisor of `most`."""
    wanted = min(MOST_CUT, CELLS * max(pixel) / fine) if fine > 0 else 1.0
    return next((k for k in range(1, most) if most % k == 0 and k >= wanted), most)


def _even_disc(half: tuple[float, float], cell: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Uniform points of the unit disc, dense enough for several points per cell of an ellipse of these half axes; (0, 0) for a
    point."""
    if max(half) == 0:
        return np.zeros(1), np.zeros(1)
    n = max(LEAST, math.ceil(A_CELL * max(2.0 * h / w for h, w in zip(half, cell, strict=True))))
    line = (np.arange(n) + 0.5) * (2.0 / n) - 1.0
    x, y = (c.ravel() for c in np.meshgrid(line, line, indexing="ij"))
    inside = x * x + y * y <= 1.0
    return x[inside], y[inside]


@dataclass(frozen=True, eq=False)
class Convolution:
    """Convolution with a kernel (2 a + 1, 2 b + 1) on images whose pixels are subdivided into `cut` cells along each axis."""

    kernel: Tensor
    cut: int
    _spectra: dict = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def beside(self) -> tuple[int, int]:
        """Cells around the screen that contribute to it, along x and y, a whole number of pixels."""
        a, b = (self.cut * math.ceil((n // 2) / self.cut) for n in self.kernel.shape)
        return a, b

    @property
    def of_even_pixels(self) -> Convolution:
        """The same for light that is even over each pixel, whose cells are whole pixels."""
        n, m = self.kernel.shape
        (a, b), more = self.beside, self.cut - 1  # all that light of a pixel reaches
        wide = torch.nn.functional.pad(self.kernel, (b - m // 2 + more,) * 2 + (a - n // 2 + more,) * 2)
        pairs = 1.0 - torch.arange(-more, self.cut).abs().to(wide) / self.cut  # of cells, by their distance
        found = torch.nn.functional.conv2d(wide[None, None], torch.outer(pairs, pairs)[None, None], stride=self.cut)
        return Convolution(found[0, 0], 1)

    def __call__(self, image: Tensor) -> Tensor:
        """An image on cells, with those around the screen, (a, b) -> the convolved image on the screen's pixels; differentiable."""
        (n, m), (a, b) = image.shape, self.beside
        found = self.whole(image)[a : n - a, b : m - b]
        n, m = (s // self.cut for s in found.shape)
        return found.reshape(n, self.cut, m, self.cut).sum((1, 3))

    def whole(self, image: Tensor, adjoint: bool = False) -> Tensor:
        """An image on cells convolved with the kernel, with zero padding; adjoint: with the point-reflected kernel."""
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


def point_source(scene: Scene) -> Source:
    """A point source at the centre of the extended one, or of several, with the same cone."""
    source, cone = scene.source, None if scene.source.distant else math.degrees(scene.source.cone_over(scene.lens.pupil))
    if len(source.members) > 1:
        return PlaneWave(source.power, tilt=source.tilt) if source.distant else Points((source.centre,), (source.power,), cone=cone)
    point = source.pointlike()
    return point if source.distant or point.cone is not None else replace(cast(Any, point), cone=cone)


def spread_at(scene: Scene, field: HeightField, heights: Tensor) -> Spread | None:
    """Point-spread function of a scene's source on its screen, for a lens with heights (n, m) mm; None if there is none."""
    return spread_of(System.of(scene, field), landing_of(scene, field, heights), heights.device)


def landing_of(scene: Scene, field: HeightField, heights: Tensor) -> Landing:
    """Where the light of a scene's source lands behind a lens with heights (n, m) mm."""
    system, parameters = System.of(scene, field), {EXIT: heights.detach().double()}

    def landing(mode: Mode, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        tracer = Tracer(system, mode.through(u, v, system.object_space.index_at(None)))
        state, left = tracer.land(parameters, scene.screen)[0].expanded(), tracer.ends(parameters)[0].state.expanded()
        return *state.full(state.origin)[:2], state.power, *left.full(left.origin)[:2]

    return landing


def spread_of(lit: Illuminated, landing: Landing, device: str | torch.device = "cpu") -> Spread | None:
    """Point-spread function of an extended source; None for other sources, for positions at several depths, or if light misses.

    Raises:
        as `landing`.
    """
    if lit.source.rays is not None or len(lit.source.members) > 1:
        return None
    found = displacements(lit, landing, device)
    return None if found is None else Spread.of(lit.source, *found)


def in_parts(lit: Illuminated, landing: Landing, shifts: bool, detail: float, device: str | torch.device) -> tuple[Spread, int]:
    """How a source is represented: the point-spread function of a mode, and the modes per position of the source, 0 for a single
    mode of the whole source.

    shifts: whether the image of a point may be one of its centre that is shifted; detail: of the image, mm.
    """
    if not outermost_modes(lit):
        return POINT, 0
    each = max(LEAST_EACH, EACH // max(1, len(lit.source.points()[0])))
    spread = spread_of(lit, landing, device) if shifts else None
    if spread is None:
        return POINT, each
    parts = (spread.error / (ALLOWED * detail)) ** 2
    each = 0 if parts <= 1.0 or spread.exchanged else min(each, math.ceil(parts))
    return (POINT if each and not max(spread.half) > 0 else spread), each


@torch.no_grad()
def displacements(lit: Illuminated, landing: Landing, device: str | torch.device = "cpu") -> tuple[np.ndarray, float, float] | None:
    """Displacement of landing points by that of the source's point, (2, 2), mm per mm or direction sine, and the largest deviation
    from it, mm, with its quantile MOST; as of `spread_of`."""
    source, outer, centre = lit.source, outermost_modes(lit), central_mode(lit)
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
    # Shift per displacement of the source point, by least squares over the outermost points, and the deviation from linearity.
    at = [offset(source, mode.position) for mode in outer]
    by = np.linalg.lstsq(np.array(at), np.array([[float(c.mean()) for c in m] for m in moved]), rcond=None)[0].T
    off = torch.cat([torch.hypot(*(m[i] - by[i] @ p for i in (0, 1))) for p, m in zip(at, moved, strict=True)])
    return by, float(off.max()), float(torch.quantile(off, MOST))
