"""Ray transfer to a plane: the landing points of straight rays, with adjoint.

Rays are float64 components, see `stage`; the reference is `backends.reference`.

Notation, a ray from o in direction d, a plane through p with unit vectors a (along), b (up) and n (normal)
    v       d . n; the ray reaches the plane where forward v > PARALLEL, forward being 1, or -1 for light returned by a mirror
    k       (p - o) . n / v, length of the path; the ray is on its way where it arrives and k > 0, and k is 0 where it is not
    r       (o - p) + k d
    x, y    r . a and r . b

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

from typing import NamedTuple

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import Stage, here, load, store, store_flags
from caustic_cli.optics.tolerances import PARALLEL

OX, OY, OZ, DX, DY, DZ, K, OVER, ON_WAY, X, Y, BY_OX, BY_OY, BY_OZ, BY_DX, BY_DY, BY_DZ, ROWS = range(18)

Vector = tuple[float, float, float]


class TargetPlane(NamedTuple):
    """The target plane: p, a, b and n by components, and `forward`."""

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
    forward: float


@njit(inline="always", **FAST)
def _path(v, count, plane):
    """k, 1 / v, and 1 or 0 for whether the ray is on its way."""
    px, py, pz, nx, ny, nz, forward = plane.px, plane.py, plane.pz, plane.nx, plane.ny, plane.nz, plane.forward
    for j in range(count):
        speed = v[DX, j] * nx + v[DY, j] * ny + v[DZ, j] * nz
        away = (px - v[OX, j]) * nx + (py - v[OY, j]) * ny + (pz - v[OZ, j]) * nz
        arrives = forward * speed > PARALLEL
        over = 1.0 / (speed if arrives else 1.0)
        k = away * over
        on_way = arrives & (k > 0.0)
        v[K, j], v[OVER, j], v[ON_WAY, j] = k if on_way else 0.0, over, 1.0 if on_way else 0.0


@njit(inline="always", **FAST)
def reach_plane(v, count, plane):
    """x and y in X, Y, from o and d."""
    px, py, pz, ax, ay, az, bx, by, bz, _, _, _, _ = plane
    _path(v, count, plane)
    for j in range(count):
        k = v[K, j]
        rx, ry, rz = (v[OX, j] - px) + k * v[DX, j], (v[OY, j] - py) + k * v[DY, j], (v[OZ, j] - pz) + k * v[DZ, j]
        v[X, j], v[Y, j] = rx * ax + ry * ay + rz * az, rx * bx + ry * by + rz * bz


@njit(inline="always", **FAST)
def pull(v, count, plane):
    """Adjoint of `reach_plane`, from the derivatives in X, Y."""
    _, _, _, ax, ay, az, bx, by, bz, nx, ny, nz, _ = plane
    _path(v, count, plane)
    for j in range(count):
        k, x, y = v[K, j], v[X, j], v[Y, j]
        # x and y
        rx, ry, rz = x * ax + y * bx, x * ay + y * by, x * az + y * bz
        # r
        by_k = rx * v[DX, j] + ry * v[DY, j] + rz * v[DZ, j]
        # k
        by_away = by_k * v[OVER, j] if v[ON_WAY, j] > 0.0 else 0.0
        v[BY_OX, j], v[BY_OY, j], v[BY_OZ, j] = rx - by_away * nx, ry - by_away * ny, rz - by_away * nz
        v[BY_DX, j], v[BY_DY, j], v[BY_DZ, j] = k * v[BY_OX, j], k * v[BY_OY, j], k * v[BY_OZ, j]


@njit(inline="always", **FAST)
def _land(v, start, count, ray, plane, _given, out):
    """x, y and whether the ray is on its way, from o and d."""
    (x, y), on_way = out
    for i in range(6):
        load(ray[i], start, count, v[i])
    reach_plane(v, count, plane)
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
    pull(v, count, plane)
    for i in range(6):
        store(v[BY_OX + i], start, count, out[i])


LAND = Stage.of(_land, _land_adjoint, ROWS, 2)


def land(origin, direction, point: Vector, axes: tuple[Vector, Vector, Vector], forward: float, *, on=here):
    """Intersections of rays with a plane.

    Args:
        origin, direction: by components, each a tensor (N,) float64 or a number for all rays, at least one of them a tensor.
        point: of the plane, where its coordinates are 0.
        axes: unit vectors along its x and y, and its normal.
        forward: 1 for rays that arrive with d . normal > 0, -1 for those that arrive against it.
        on: what makes the stage one of the rays' device.

    Returns:
        x, y: (N,) in the plane; of rays that are not on their way to it those of their origin, and meaningless.
        on_way: (N,) bool.
    """
    plane = TargetPlane._make([*(float(c) for vector in (point, *axes) for c in vector), float(forward)])
    return on(LAND)(plane, *origin, *direction)
