"""Ray transfer to a plane: the landing points of straight rays, with adjoint.

Rays are float64 components, see `stage`; the reference is `backends.reference`.

Notation, a ray from o in direction d, a plane through p with unit vectors a (along), b (up) and n (normal)
    v       d . n; the ray reaches the plane where v > PARALLEL
    k       (p - o) . n / v, length of the path; the ray is on its way where it arrives and k > 0, and k is 0 where it is not
    r       (o - p) + k d
    x, y    r . a and r . b

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

from typing import NamedTuple

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import load, ray_stage, store, store_flags
from caustic_cli.optics.tolerances import PARALLEL

OX, OY, OZ, DX, DY, DZ, ON_WAY, X, Y, BY_OX, BY_OY, BY_OZ, BY_DX, BY_DY, BY_DZ, ROWS = range(16)

Vector = tuple[float, float, float]


class TargetPlane(NamedTuple):
    """The target plane: p, a, b and n by components."""

    px: float
    py: float
    pz: float
    ax: float
    ay: float
    az: float
    bx: float
    by: float
    bz: float
    nx: float
    ny: float
    nz: float

    @classmethod
    def of(cls, point: Vector, axes: tuple[Vector, Vector, Vector], forward: float = 1.0) -> TargetPlane:
        """By a point, unit vectors along its x and y, and its normal; forward: -1 for light that arrives against this."""
        along, up, (x, y, z) = axes
        return cls._make([float(c) for vector in (point, along, up, (forward * x, forward * y, forward * z)) for c in vector])


@njit(inline="always", **FAST)
def _path(ox, oy, oz, dx, dy, dz, plane):
    """k, 1 / v, and whether the ray is on its way."""
    nx, ny, nz = plane.nx, plane.ny, plane.nz
    return _length((plane.px - ox) * nx + (plane.py - oy) * ny + (plane.pz - oz) * nz, dx * nx + dy * ny + dz * nz)


@njit(inline="always", **FAST)
def _length(away, speed):
    arrives = speed > PARALLEL
    over = 1.0 / (speed if arrives else 1.0)
    k = away * over
    on_way = arrives & (k > 0.0)
    return k if on_way else 0.0, over, on_way


@njit(inline="always", **FAST)
def arrive(ox, oy, oz, dx, dy, dz, plane):
    """x and y of one ray, and whether it is on its way."""
    k, _, on_way = _path(ox, oy, oz, dx, dy, dz, plane)
    rx, ry, rz = (ox - plane.px) + k * dx, (oy - plane.py) + k * dy, (oz - plane.pz) + k * dz
    return rx * plane.ax + ry * plane.ay + rz * plane.az, rx * plane.bx + ry * plane.by + rz * plane.bz, on_way


@njit(inline="always", **FAST)
def pull(ox, oy, oz, dx, dy, dz, plane, x, y):
    """Adjoint of `arrive`: derivatives by o and d, from those by x and y."""
    k, over, on_way = _path(ox, oy, oz, dx, dy, dz, plane)
    # x and y
    rx, ry, rz = x * plane.ax + y * plane.bx, x * plane.ay + y * plane.by, x * plane.az + y * plane.bz
    # r
    by_k = rx * dx + ry * dy + rz * dz
    # k
    by_away = by_k * over if on_way else 0.0
    by_ox, by_oy, by_oz = rx - by_away * plane.nx, ry - by_away * plane.ny, rz - by_away * plane.nz
    return by_ox, by_oy, by_oz, k * by_ox, k * by_oy, k * by_oz


# Of an upright screen at a height: products with its plane's zeros and ones would take time, since the compiler must keep them.


@njit(inline="always", **FAST)
def arrive_upright(ox, oy, oz, dx, dy, dz, height):
    """`arrive`."""
    k, _, on_way = _length(height - oz, dz)
    return ox + k * dx, oy + k * dy, on_way


@njit(inline="always", **FAST)
def pull_upright(ox, oy, oz, dx, dy, dz, height, x, y):
    """Adjoint of `arrive_upright`; its derivatives by o_x and o_y are those by x and y."""
    k, over, on_way = _length(height - oz, dz)
    by_oz = -(x * dx + y * dy) * over if on_way else 0.0
    return x, y, by_oz, k * x, k * y, k * by_oz


@njit(inline="always", **FAST)
def _land(v, start, count, ray, plane, _given, out):
    """x, y and whether the ray is on its way, from o and d."""
    (x, y), on_way = out
    for i in range(6):
        load(ray[i], start, count, v[i])
    for j in range(count):
        x_, y_, arrives = arrive(v[OX, j], v[OY, j], v[OZ, j], v[DX, j], v[DY, j], v[DZ, j], plane)
        v[X, j], v[Y, j], v[ON_WAY, j] = x_, y_, 1.0 if arrives else 0.0
    store(v[X], start, count, x)
    store(v[Y], start, count, y)
    store_flags(v[ON_WAY], start, count, on_way)


@njit(inline="always", **FAST)
def _land_adjoint(v, start, count, ray, plane, given, out):
    """Derivatives by o and d, from those by x and y."""
    for i in range(6):
        load(ray[i], start, count, v[i])
    load(given[0], start, count, v[X])
    load(given[1], start, count, v[Y])
    for j in range(count):
        v[BY_OX, j], v[BY_OY, j], v[BY_OZ, j], v[BY_DX, j], v[BY_DY, j], v[BY_DZ, j] = pull(
            v[OX, j], v[OY, j], v[OZ, j], v[DX, j], v[DY, j], v[DZ, j], plane, v[X, j], v[Y, j]
        )
    for i in range(6):
        store(v[BY_OX + i], start, count, out[i])


LAND = ray_stage(_land, _land_adjoint, ROWS, 2)


def land(origin, direction, point: Vector, axes: tuple[Vector, Vector, Vector], forward: float):
    """Intersections of rays with a plane.

    Args:
        origin, direction: by components, each a tensor (N,) float64 or a number for all rays, at least one of them a tensor.
        point: of the plane, where its coordinates are 0.
        axes: unit vectors along its x and y, and its normal.
        forward: 1 for rays that arrive with d . normal > 0, -1 for those that arrive against it.

    Returns:
        x, y: (N,) in the plane; of rays that are not on their way to it those of their origin, and meaningless.
        on_way: (N,) bool.
    """
    return LAND(TargetPlane.of(point, axes, forward), *origin, *direction)
