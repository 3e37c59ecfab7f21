"""Ray sampling: points of the unit square (u, v), which is mapped to the lens' aperture (thesis 4.2.1).

Random numbers are hashes of (seed, dimension, ray index) (a counter-based generator), so a sample does not depend on its division
into chunks, on the device or on the number of threads, and any ray can be traced again individually.

    grid        centres of nu x nv equal cells
    lines       a grid whose columns and rows are each jittered within their cells: random rays with the tensor-product structure
                that makes a spline surface cheap to evaluate
    stratified  one uniformly distributed ray in each cell (the perturbed grid of 4.2.1, kept inside [0, 1]: erratum E9)
    uniform     independent, uniformly distributed rays
    sobol       a scrambled Sobol sequence (torch's), of low discrepancy
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.backends import backend_for
from caustic_cli.scene.aperture import UNBOUNDED, Aperture

#: Samplers with tensor-product structure, and all samplers.
TENSOR = ("grid", "lines")
SAMPLERS = (*TENSOR, "stratified", "uniform", "sobol")
#: Largest length of torch's Sobol sequence.
SOBOL_RAYS = 1 << 30
#: Largest value of `normal_numbers`, whose uniform numbers are at least 2^-33.
LARGEST_NORMAL = math.sqrt(66.0 * math.log(2.0))
_MASK = 0xFFFFFFFF


def _mix(x: Tensor) -> Tensor:
    """A 32-bit integer hash (C. Wellons' "lowbias32") of int64 tensors holding 32-bit values."""
    x = x ^ (x >> 16)
    x = (x * 0x7FEB352D) & _MASK
    x = x ^ (x >> 15)
    x = (x * 0x846CA68B) & _MASK
    return x ^ (x >> 16)


def random_numbers(seed: int, dimension: int, index: Tensor) -> Tensor:
    """Uniform numbers strictly inside (0, 1), float64, one for every int64 ray index: a pure function of its arguments."""
    low, high = index & _MASK, index >> 32
    return (_mix(_mix(low ^ key(seed, dimension)) + salt(dimension) + high & _MASK).double() + 0.5) * 2.0**-32


def normal_numbers(seed: int, index: Tensor) -> tuple[Tensor, Tensor]:
    """Two independent standard normal numbers, float64, for every int64 index (Box and Muller)."""
    radius = torch.sqrt(-2.0 * torch.log(random_numbers(seed, 0, index)))
    angle = 2.0 * math.pi * random_numbers(seed, 1, index)
    return radius * torch.cos(angle), radius * torch.sin(angle)


def key(seed: int, dimension: int) -> int:
    """Hash key of a seed and dimension, to be combined with a ray's index."""
    start = torch.tensor((seed * 0x9E3779B1 + dimension * 0x85EBCA77 + 1) & _MASK) ^ ((seed >> 16) & _MASK)
    return int(_mix(start))


def salt(dimension: int) -> int:
    """Additive constant that decorrelates the dimensions of one seed."""
    return 0x632BE5AB * (dimension + 1)


def stream(seed: int, name: str) -> int:
    """A seed for one purpose ("render", "stage 3"), independent of those for other purposes."""
    return zlib.crc32(f"{seed}/{name}".encode())


def numbers(
    kind: str, shape: tuple[int, int], seed: int, dimensions: int, start: int, stop: int, device: str | torch.device = "cpu"
) -> list[Tensor]:
    """Points of the unit cube for rays start..stop: `dimensions` tensors (stop - start,) float64.

    The first two dimensions are stratified in nu x nv cells, repeatedly if there are more rays than cells; the others are
    independent, or further dimensions of the Sobol sequence.
    """
    if kind == "sobol":
        if stop > SOBOL_RAYS:
            raise InputError(f"the sobol sampler has at most {SOBOL_RAYS} rays, got {stop}")
        engine = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed)
        points = _forwarded(engine, start).draw(stop - start, dtype=torch.float64)
        return [x.contiguous().to(device) for x in points.T]
    k, (nu, nv) = torch.arange(start, stop, device=device), shape
    if kind in TENSOR:
        cell, turn = k % (nu * nv), k // (nu * nv)
        i, j = cell // nv, cell % nv
        du = dv = torch.tensor(0.5, dtype=torch.float64, device=device)
        if kind == "lines":
            du, dv = random_numbers(seed, 0, turn * nu + i), random_numbers(seed, 1, turn * nv + j)
        first = [(i + du) / nu, (j + dv) / nv]
    else:
        first = backend_for(device).scatter(seed, start, stop, shape, kind == "stratified", device)
    return first + [random_numbers(seed, d, k) for d in range(2, dimensions)]


def _forwarded(engine: torch.quasirandom.SobolEngine, count: int) -> torch.quasirandom.SobolEngine:
    """A new engine advanced to point number `count`, like its own fast_forward, which takes `count` steps.

    The preceding point k is the shift plus, modulo 2, the sum of the direction numbers of the ones in the Gray code k ^ (k >> 1).
    """
    if count:
        gray = (count - 1) ^ ((count - 1) >> 1)
        for bit in range(engine.MAXBIT):
            if gray >> bit & 1:
                engine.quasi ^= engine.sobolstate[:, bit]
        engine.num_generated = count
    return engine


def scattered_points(
    seed: int, start: int, stop: int, shape: tuple[int, int], stratified: bool, device: str | torch.device
) -> list[Tensor]:
    """Random u, v (stop - start,) of rays start..stop, independent, or stratified in nu x nv cells, repeatedly."""
    k, (nu, nv) = torch.arange(start, stop, device=device), shape
    du, dv = random_numbers(seed, 0, k), random_numbers(seed, 1, k)
    if stratified:
        cell = k % (nu * nv)
        du, dv = (cell // nv + du) / nu, (cell % nv + dv) / nv
    return [du, dv]


@dataclass(frozen=True)
class Sample:
    """Some rays of a sampler: the points (u_k, v_k), or with `tensor` all pairs (u_a, v_b), in row-major order."""

    u: Tensor
    v: Tensor
    tensor: bool
    #: Fraction of the source's power of each ray, a scalar or of the shape of the ray grid.
    flux: Tensor

    @property
    def device(self) -> torch.device:
        """Where its points are."""
        return self.u.device

    @property
    def count(self) -> int:
        """Number of rays."""
        return math.prod(self.shape)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of everything traced from this sample: (len(u), len(v)) or (len(u),)."""
        return (len(self.u), len(self.v)) if self.tensor else (len(self.u),)


@dataclass(frozen=True, eq=False)
class Sampler:
    """A sampler of the aperture, evaluated in chunks."""

    #: One of SAMPLERS.
    kind: str
    #: Cells (nu, nv) along u and v; nu * nv rays.
    shape: tuple[int, int]
    #: Of the random kinds.
    seed: int = 0
    #: Relative irradiance over the aperture, a function of u and v that can be broadcast; or None (eq. 4.2.3, erratum E19).
    profile: Callable[[Tensor, Tensor], Tensor] | None = None
    #: Where the samples live.
    device: str | torch.device = "cpu"
    #: Of any half widths.
    aperture: Aperture = UNBOUNDED

    def __post_init__(self):
        if self.kind not in SAMPLERS:
            raise InputError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.kind!r}")

    @classmethod
    def of_size(cls, kind: str, rays: int, aspect: float = 1.0, **options) -> Sampler:
        """A sampler of about `rays` rays in nearly square cells, for an aperture of width / height `aspect`."""
        nu = max(1, round(math.sqrt(rays * aspect)))
        return cls(kind, (nu, max(1, round(rays / nu))), **options)

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.shape[0] * self.shape[1]

    @property
    def tensor(self) -> bool:
        """Whether its samples have tensor-product structure."""
        return self.kind in TENSOR

    def chunks(self, size: int = 1 << 20) -> Iterator[Sample]:
        """The rays in order, at most about `size` at a time; fluxes over all chunks sum to 1."""
        norm, even = 1.0 / self.count, self.profile is None and not self.aperture.round
        if not even:
            total = sum(float(self._irradiance(s).sum()) for s in self._points(size))
            if not total > 0:
                raise InputError("⟨source.profile⟩: it is black at every sampled point; use more rays")
            norm = 1.0 / total
        for s in self._points(size):
            flux = torch.tensor(norm, dtype=torch.float64) if even else norm * self._irradiance(s)
            yield Sample(s.u, s.v, s.tensor, flux.to(self.device))

    def _points(self, size: int) -> Iterator[Sample]:
        nu, nv = self.shape
        one = torch.ones((), dtype=torch.float64)
        if self.tensor:
            i, j = (torch.arange(k, device=self.device) for k in (nu, nv))
            du = dv = torch.tensor(0.5, dtype=torch.float64, device=self.device)
            if self.kind == "lines":
                du, dv = random_numbers(self.seed, 0, i), random_numbers(self.seed, 1, j)
            u, v = (i + du) / nu, (j + dv) / nv  # du, dv are float64
            rows = max(1, size // nv)
            for a in range(0, nu, rows):
                yield Sample(u[a : a + rows], v, True, one)
            return
        for a in range(0, self.count, size):
            u, v = numbers(self.kind, self.shape, self.seed, 2, a, min(a + size, self.count), self.device)
            yield Sample(u, v, False, one)

    def _irradiance(self, s: Sample) -> Tensor:
        u, v = 2.0 * s.u - 1.0, 2.0 * s.v - 1.0
        within = self.aperture.covers(u[:, None], v[None, :]) if s.tensor else self.aperture.covers(u, v)
        if self.profile is None:
            return within.double()
        return within * (self.profile(s.u[:, None], s.v[None, :]) if s.tensor else self.profile(s.u, s.v))
