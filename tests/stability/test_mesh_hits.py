"""Triangle meshes: rays along edges, through vertices, along diagonals, parallel to triangles. None may slip through."""

import numpy as np
import pytest
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.mesh import TriangleMesh
from caustic_cli.optics.surfaces.heightfield import HeightField

FIELD = HeightField((SplineSpace.uniform(7, 3), SplineSpace.uniform(6, 2)), (1.0, 1.0))
HEIGHTS = 2.0 + 0.3 * torch.rand(7, 6, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
PARTS = 3


def mesh() -> TriangleMesh:
    return TriangleMesh(FIELD, HEIGHTS, PARTS, PARTS)


def grid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices: x (a,), y (b,), z (a, b)."""
    m = mesh()
    lines = [np.concatenate([(b[:-1, None] + np.diff(b)[:, None] * np.arange(PARTS) / PARTS).ravel(), b[-1:]]) for b in m._breaks]
    return *lines, m._vertices


def triangles() -> np.ndarray:
    x, y, z = grid()
    p = np.stack(np.broadcast_arrays(x[:, None], y[None, :], z), -1)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[:-1, 1:], p[1:, 1:]
    return np.concatenate([np.stack([a, b, c], -2).reshape(-1, 3, 3), np.stack([d, c, b], -2).reshape(-1, 3, 3)])


def moller_trumbore(o: np.ndarray, d: np.ndarray, dtype) -> np.ndarray:
    """Whether each ray meets any triangle: the textbook's test, strict at u, v >= 0, u + v <= 1."""
    t = triangles().astype(dtype)
    e1, e2 = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    hit = np.zeros(len(o), bool)
    for k, (a, b) in enumerate(zip(o.astype(dtype), d.astype(dtype), strict=True)):
        p = np.cross(b[None], e2)
        inverse = 1 / (e1 * p).sum(1)
        s = a[None] - t[:, 0]
        u = (s * p).sum(1) * inverse
        q = np.cross(s, e1)
        v = (b[None] * q).sum(1) * inverse
        hit[k] = ((u >= 0) & (v >= 0) & (u + v <= 1)).any()
    return hit


def meet(o: np.ndarray, d: np.ndarray, recursive: bool) -> tuple[np.ndarray, np.ndarray]:
    args = [torch.from_numpy(np.ascontiguousarray(c)) for c in (*o.T, *d.T)]
    t, status, _ = mesh().intersect(*args, recursive=recursive)
    return t.numpy(), status.numpy() == 0


def aimed(points: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Rays from below through these points, tilted at random, or straight up."""
    rng = np.random.default_rng(3)
    d = np.concatenate([0.05 * rng.standard_normal((len(points), 2)), np.ones((len(points), 1))], 1)
    if kind == "upright":
        d[:, :2] = 0.0
    return points - points[:, 2:] * d, d


@pytest.mark.parametrize("recursive", [True, False])
def test_nothing_slips_between_triangles(recursive, compare):
    """Through vertices, along both kinds of edges and diagonals; naive: Moller and Trumbore's test in float32."""
    x, y, z = grid()
    p = np.stack(np.broadcast_arrays(x[:, None], y[None, :], z), -1)
    parts = [p[1:-1, 1:-1]]
    for share in (0.1, 0.3, 0.6):
        parts += [
            share * p[1:-2, 1:-1] + (1 - share) * p[2:-1, 1:-1],
            share * p[1:-1, 1:-2] + (1 - share) * p[1:-1, 2:-1],
            share * p[2:-1, 1:-2] + (1 - share) * p[1:-2, 2:-1],
        ]
    points = np.concatenate([part.reshape(-1, 3) for part in parts])
    missed, plain = 0, 0
    for kind in ("tilted", "upright"):
        o, d = aimed(points, kind)
        t, hit = meet(o, d, recursive)
        missed += (~hit | (np.abs(o[:, 2] + np.where(hit, t, 0.0) * d[:, 2] - points[:, 2]) > 1e-12)).sum()
        plain += (~moller_trumbore(o, d, np.float32)).sum()
    assert len(points) > 1000
    compare(
        "mesh: rays through vertices and along edges", "part of the rays that slip through", plain / len(points) / 2, missed, 0.0
    )


@pytest.mark.parametrize("recursive", [True, False])
def test_along_grid_lines_and_parallel_to_triangles(recursive):
    """Rays in the planes of the grid lines, and level ones beside a flat part: a hit or none, never NaN, both searches alike."""
    x, y, _ = grid()
    o, d = [], []
    for j in range(1, len(y) - 1):
        for slope in (0.2, 1.0, 5.0):
            o.append((-0.99, y[j], 1.0)), d.append((1.0, 0.0, slope))
            o.append((x[j % len(x)], -0.99, 1.0)), d.append((0.0, 1.0, slope))
    rows = triangles()
    for t in rows[:: max(1, len(rows) // 60)]:  # in the plane of a triangle, across its middle
        along = t[1] - t[0]
        o.append(t.mean(0) - 0.5 * along), d.append(along)
    o, d = np.array(o), np.array(d)
    t, hit = meet(o, d, recursive)
    assert len(o) > 100 and hit.sum() > 20
    assert np.isfinite(t[hit]).all() and not np.isnan(t).any()
    other = meet(o, d, not recursive)
    assert (other[1] == hit).all() and np.array_equal(other[0][hit], t[hit])


def test_a_flat_mesh_met_at_its_own_level():
    """Level triangles at z = 2 and rays that end or begin there."""
    flat = TriangleMesh(FIELD, torch.full((7, 6), 2.0, dtype=torch.float64), 2, 2)
    x = torch.linspace(-1.0, 1.0, 41, dtype=torch.float64)
    none = torch.zeros_like(x)
    t, status, _ = flat.intersect(x, none, none, none, none, none + 1.0)
    assert bool((status == 0).all()) and float((t - 2.0).abs().max()) < 1e-15
    t, status, _ = flat.intersect(x, none, none + 2.0, none + 1.0, none, none)
    assert not bool(torch.isnan(t).any())
