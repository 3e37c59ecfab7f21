"""Rays against the triangle mesh of a height field: brute force over all triangles, exact planes, edges, and lost rays.

Bounds.  Times of the order of 10, heights of the order of 1: a time is a handful of roundings of 1e-16 over the slope at which
the ray meets the triangle, so independent formulas agree to 1e-11 for all but grazing rays.  What must be the same bits (flat
and recursive, any number of blocks, one knot span or many) is compared as bits.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from parametric import Surface

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import mesh as kernel
from caustic_cli.optics.mesh import TriangleMesh, boxes_of, search, vertices_of
from caustic_cli.optics.surfaces.heightfield import HeightField

UNEVEN = torch.tensor([0, 0, 0, 0, 0.3, 0.3, 0.55, 0.55, 0.55, 0.9, 1, 1, 1, 1], dtype=torch.float64)
FIELDS = {
    "linear": ((SplineSpace.uniform(5, 1), SplineSpace.uniform(4, 1)), (3, 2)),
    "cubic": ((SplineSpace.uniform(9, 3), SplineSpace.uniform(6, 3)), (2, 3)),
    "quintic": ((SplineSpace.uniform(8, 5), SplineSpace.uniform(11, 5)), (4, 1)),
    "repeated": ((SplineSpace(3, UNEVEN), SplineSpace.uniform(7, 2)), (2, 2)),
    "mixed": ((SplineSpace.uniform(12, 1), SplineSpace(3, UNEVEN)), (1, 5)),
}
HALF = (2.0, 1.5)


def bumpy(name: str, rough: float = 0.3, seed: int = 0) -> TriangleMesh:
    spaces, parts = FIELDS[name]
    noise = torch.randn(spaces[0].n, spaces[1].n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return TriangleMesh(HeightField(spaces, HALF), rough * noise, *parts)


def lines_of(breaks: np.ndarray, n: int) -> np.ndarray:
    return np.append((breaks[:-1, None] + np.diff(breaks)[:, None] * np.arange(n) / n).ravel(), breaks[-1])


def parts_of(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grid lines and vertices."""
    return *(lines_of(b, n) for b, n in zip(mesh._breaks, mesh.shape, strict=True)), mesh._vertices


def sheet(x, y, gx, gy, z):
    """T at x, y."""
    i = np.clip(np.searchsorted(gx, x, side="right") - 1, 0, len(gx) - 2)
    j = np.clip(np.searchsorted(gy, y, side="right") - 1, 0, len(gy) - 2)
    a, b = (x - gx[i]) / (gx[i + 1] - gx[i]), (y - gy[j]) / (gy[j + 1] - gy[j])
    lower = z[i, j] + a * (z[i + 1, j] - z[i, j]) + b * (z[i, j + 1] - z[i, j])
    upper = z[i + 1, j + 1] + (1 - a) * (z[i, j + 1] - z[i + 1, j + 1]) + (1 - b) * (z[i + 1, j] - z[i + 1, j + 1])
    return np.where(a + b <= 1, lower, upper)


def stay(rays: np.ndarray, gx: np.ndarray, gy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times between which rays (6, N) are over the aperture, and not before 0."""
    start, end = np.zeros(rays.shape[1]), np.full(rays.shape[1], math.inf)
    for g, o, d in ((gx, rays[0], rays[3]), (gy, rays[1], rays[4])):
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = np.sort((np.array([[g[0]], [g[-1]]]) - o) / d, axis=0)
        over = (g[0] <= o) & (o <= g[-1])  # where d = 0 and the division has no answer
        start = np.maximum(start, np.where(d == 0, np.where(over, 0.0, math.inf), sides[0]))
        end = np.minimum(end, np.where(d == 0, np.where(over, math.inf, -math.inf), sides[1]))
    return np.where(end > start, start, 0.0), np.where(end > start, end, -1.0)  # -1: never over it


def brute(rays: np.ndarray, gx, gy, z, slack: float = 1e-9) -> np.ndarray:
    """Times of the hits of rays (6, N), over all triangles; inf without."""
    start, end = stay(rays, gx, gy)
    (x, y, h), (dx, dy, dh) = rays[:3], rays[3:]
    below = h + start * dh < sheet(x + start * dx, y + start * dy, gx, gy, z)
    best = np.full(rays.shape[1], math.inf)
    for i in range(len(gx) - 1):
        for j in range(len(gy) - 1):
            for up in (0, 1):
                corner = (gx[i + up], gy[j + up], z[i + up, j + up])
                by_x = (z[i + 1, j + up] - z[i, j + up]) / (gx[i + 1] - gx[i])
                by_y = (z[i + up, j + 1] - z[i + up, j]) / (gy[j + 1] - gy[j])
                with np.errstate(divide="ignore", invalid="ignore"):
                    t = (corner[2] + by_x * (x - corner[0]) + by_y * (y - corner[1]) - h) / (dh - by_x * dx - by_y * dy)
                    a, b = (x + t * dx - gx[i]) / (gx[i + 1] - gx[i]), (y + t * dy - gy[j]) / (gy[j + 1] - gy[j])
                    side = (a + b >= 1 - slack) if up else (a + b <= 1 + slack)
                    inside = side & (a >= -slack) & (a <= 1 + slack) & (b >= -slack) & (b <= 1 + slack) & (t >= start - slack)
                best = np.where(inside & (t < best), t, best)
    return np.where(below & (end > start), best, math.inf)


def found(mesh: TriangleMesh, rays: np.ndarray, recursive: bool = True):
    return [a.numpy() for a in mesh.intersect(*(torch.from_numpy(r) for r in rays), recursive=recursive)]


def on_vertices(xs, ys, z, rays, n=(1, 1), recursive=True, blocks=1):
    """The kernel on any vertices, with boxes around them."""
    rows, cols = len(xs) - 1, len(ys) - 1
    low, high = np.empty((rows, cols)), np.empty((rows, cols))
    for i in range(rows):
        for j in range(cols):
            part = z[i * n[0] : (i + 1) * n[0] + 1, j * n[1] : (j + 1) * n[1] + 1]
            low[i, j], high[i, j] = part.min() - 1e-13, part.max() + 1e-13
    xs, ys = np.ascontiguousarray(xs), np.ascontiguousarray(ys)  # another layout would compile the kernel again
    return search(np.ascontiguousarray(rays), (xs, ys), n, z, low, high, recursive, blocks)


def wide(rng: np.random.Generator, count: int, half=HALF) -> np.ndarray:
    """Rays from below, in and around the aperture, all the way to horizontal."""
    o = rng.uniform(-1.6, 1.6, (3, count)) * np.array([[half[0]], [half[1]], [0.5]]) - np.array([[0.0], [0.0], [0.6]])
    d = rng.standard_normal((3, count))
    d[2] = rng.choice([-0.1, 0.02, 0.2, 1.0], count) * abs(d[2])
    d[:, ::2] = (
        np.stack([rng.uniform(-half[k], half[k], (count + 1) // 2) for k in (0, 1)] + [rng.uniform(-0.5, 0.5, (count + 1) // 2)])
        - o[:, ::2]
    )  # half of them aimed at the surface
    return np.concatenate([o, d])


@pytest.mark.parametrize("name", FIELDS)
def test_same_as_brute_force(name):
    mesh = bumpy(name)
    rays = wide(np.random.default_rng(1), 4000)
    expected = brute(rays, *parts_of(mesh))
    for recursive in (True, False):
        t, status, tested = found(mesh, rays, recursive)
        assert ((status == kernel.HIT) == np.isfinite(t)).all()
        assert (np.isfinite(t) == np.isfinite(expected)).all()
        hit = np.isfinite(expected)
        assert 500 < hit.sum() < 3500
        assert abs(t[hit] - expected[hit]).max() < 1e-11 * (1 + expected[hit].max())
        assert (tested[hit] > 0).all()


@pytest.mark.parametrize("name", FIELDS)
def test_flat_recursive_and_any_number_of_blocks_give_the_same_bits(name):
    mesh = bumpy(name, seed=3)
    rays = wide(np.random.default_rng(2), 20_000)
    flat = found(mesh, rays, recursive=False)
    assert 2000 < (flat[1] == kernel.HIT).sum() < 18_000
    assert flat[2].max() > 10
    for blocks in (1, 2, 3, 7):
        other = search(rays, mesh._breaks, mesh.shape, mesh._vertices, mesh._low, mesh._high, True, blocks)
        for a, b in zip(flat, other, strict=True):
            assert (a == b).all()


def test_how_the_grid_is_cut_into_knot_spans_does_not_matter():
    """Eight lines in eight spans, or in one: the same cells, and the same bits."""
    rng = np.random.default_rng(4)
    z = 0.3 * rng.standard_normal((9, 9))
    rays = wide(rng, 20_000, (1.0, 1.0))
    one, spans = np.array([-1.0, 1.0]), np.linspace(-1, 1, 9)
    expected = on_vertices(one, one, z, rays, (8, 8))
    assert (expected[1] == kernel.HIT).sum() > 5000
    for xs, ys, n in ((spans, spans, (1, 1)), (spans[::2], one, (2, 8)), (one, spans[::4], (8, 4))):
        for recursive in (True, False):
            other = on_vertices(xs, ys, z, rays, n, recursive)
            assert (other[0] == expected[0]).all()
            assert (other[1] == expected[1]).all()


@pytest.mark.parametrize("name", FIELDS)
def test_no_ray_is_lost_at_lines_diagonals_and_vertices(name):
    """Rays steeper than the surface, through points on the mesh's edges: each crosses exactly once, and there."""
    mesh = bumpy(name, rough=0.02, seed=5)
    gx, gy, z = parts_of(mesh)
    rng = np.random.default_rng(6)
    count = 25_000
    i, j, s = rng.integers(1, len(gx) - 2, count), rng.integers(1, len(gy) - 2, count), rng.random(count)
    ends = {"x": (0, 0, 0, 1), "y": (0, 0, 1, 0), "diagonal": (1, 0, 0, 1), "vertex": (0, 0, 0, 0)}
    for kind, (a, b, c, d) in ends.items():
        start, stop = ((gx[i + m], gy[j + n], z[i + m, j + n]) for m, n in ((a, b), (c, d)))
        target = np.stack([p + s * (q - p) for p, q in zip(start, stop, strict=True)])
        for k, origin in enumerate(([0.1, -0.2, -2.0], [gx[2], gy[2], -2.0], [gx[1], gy[1], -300.0])):
            o = np.broadcast_to(np.array(origin)[:, None], target.shape)
            t, status, _ = found(mesh, np.concatenate([o, target - o]), recursive=k < 2)
            assert (status == kernel.HIT).all(), kind
            assert abs(t - 1.0).max() < 1e-12 * (1 if k < 2 else 100)


@pytest.mark.parametrize("turn", [1, -1])
def test_lines_of_x_and_y_crossed_at_one_time(turn):
    """Along y = x and y = -x both lines of a vertex are crossed at bitwise the same time, yet f may differ in its last bits: the
    piece between them, in a cell the path has no length in, can be the one where the sign changes."""
    rng = np.random.default_rng(13)
    xs = 1000.0 + np.arange(17)  # exact however they are cut into spans; where rays from afar cross them is rounded to 1e-13
    ys = np.sort(turn * xs)
    z = np.round(0.2 * rng.standard_normal((17, 17)) * 2.0**40) / 2.0**40  # so that rays from afar can meet a vertex exactly
    count = 20_000
    k, side = rng.integers(2, 15, count), rng.choice([-1, 1], count)
    far, speed = rng.uniform(900, 999, count), rng.uniform(1, 2, count)
    across = k if turn > 0 else 16 - k
    x = xs[k] - side * far
    rays = np.stack([x, turn * x, z[k, across] - 2 * far, side * speed, turn * side * speed, 2 * speed])
    t = (xs[k] - rays[0]) / rays[3]
    assert (t == (ys[across] - rays[1]) / rays[4]).all()
    below = []
    for lines, own, axis, net in ((ys, k, 1, z), (xs, across, 0, z.T)):  # along the line of x, and of y, between two vertices
        at = rays[axis] + t * rays[3 + axis]
        cell = np.searchsorted(lines, at, side="right") - 1
        height = net[own, cell] + (at - lines[cell]) * (net[own, cell + 1] - net[own, cell])
        below.append(rays[2] + t * rays[5] < height)
    assert min((below[0] & ~below[1]).sum(), (below[1] & ~below[0]).sum()) > 50
    expected = on_vertices(xs, ys, z, rays)
    assert (expected[1] == kernel.HIT).all()
    assert abs(expected[0] - t).max() < 1e-12
    for step in (1, 2, 4, 8, 16):
        for recursive in (True, False):
            for lines, n in ((ys[::step], step), (ys, 1)):
                assert (on_vertices(xs[::step], lines, z, rays, (step, n), recursive)[0] == expected[0]).all()


def test_a_ray_that_begins_on_the_mesh_has_left_it():
    mesh = bumpy("linear")
    gx, gy, z = parts_of(mesh)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(len(gx) - 1), np.arange(len(gy) - 1), indexing="ij"))
    zero = np.zeros(len(i))
    for d in ((0.1, 0.2, 1.0), (0.0, 0.0, 1.0), (0.3, 0.0, 0.1), (0.0, 0.1, 1.0)):
        t, status, tested = found(mesh, np.stack([gx[i], gy[j], z[i, j], *(zero + k for k in d)]))
        assert (t == 0).all() and (status == kernel.HIT).all() and (tested == 1).all()
    height = 0.5 * (z[0, 0] + z[0, 1])  # and on entering
    t, _, _ = found(mesh, np.array([[gx[0] - 1], [0.5 * (gy[0] + gy[1])], [height - 0.25], [1], [0], [0.25]]))
    assert t == pytest.approx(1.0, abs=1e-15)


@given(
    st.lists(st.integers(-3, 3), min_size=16, max_size=16),
    st.integers(0, 6),
    st.integers(0, 6),
    st.integers(-6, -4),
    st.tuples(st.integers(-5, 5), st.integers(-5, 5), st.integers(-1, 9)),
)
def test_whoever_begins_below_and_ends_above_has_crossed(heights, x, y, z, d):
    """Small whole numbers: rays along edges, diagonals and through vertices are the rule here, not the exception."""
    v = np.array(heights, dtype=float).reshape(4, 4)
    lines = np.array([0.0, 2.0, 4.0, 6.0])
    rays = np.array([[x], [y], [z], *([k] for k in d)], dtype=float)
    results = [on_vertices(lines, lines, v, rays, recursive=r) for r in (True, False)]
    results.append(on_vertices(lines[::3], lines[::3], v, rays, (3, 3)))
    assert all(other[:2] == results[0][:2] for other in results[1:])
    t = results[0][0][0]
    start, end = (a[0] for a in stay(rays, lines, lines))
    if d[0] == d[1] == 0:
        upright = (sheet(rays[0], rays[1], lines, lines, v)[0] - z) / d[2] if d[2] > 0 else math.inf
        assert t == pytest.approx(upright, rel=1e-15)
        return
    if not end > start:
        assert t == math.inf
        return
    times = np.linspace(start, min(t, end), 200)
    f = z + times * d[2] - sheet(*(o + times * s for o, s in ((x, d[0]), (y, d[1]))), lines, lines, v)
    assert f[0] < 0 and (f[1:] < 1e-12).all()  # not above before the hit, nor before leaving
    assert t == math.inf or abs(f[-1]) < 1e-12


def test_the_whole_numbers_cross_often():
    """What hypothesis draws above, in bulk: the search is not empty, and agrees with brute force wherever f changes sign."""
    rng = np.random.default_rng(7)
    lines, hits, lost = np.array([0.0, 2.0, 4.0, 6.0]), 0, 0
    for _ in range(60):
        v = rng.integers(-3, 4, (4, 4)).astype(float)
        rays = np.concatenate([rng.integers(0, 7, (2, 200)), rng.integers(-6, -3, (1, 200)), rng.integers(-5, 6, (3, 200))])
        rays[5] += 4
        rays = rays.astype(float)[:, (rays[3:5] != 0).any(0)]
        t, (_, end) = on_vertices(lines, lines, v, rays)[0], stay(rays, lines, lines)
        at_end = [o + end * d for o, d in zip(rays[:3], rays[3:], strict=True)]
        above = (at_end[2] - sheet(*at_end[:2], lines, lines, v) > 1e-9) & (end > 0)
        assert np.isfinite(t[above]).all()
        expected = brute(rays, lines, lines, v)
        assert (t[above] >= expected[above] - 1e-12).all()  # brute force also counts a mere touch
        hit = np.isfinite(t)
        x, y, z = (o[hit] + t[hit] * d[hit] for o, d in zip(rays[:3], rays[3:], strict=True))
        assert abs(z - sheet(x, y, lines, lines, v)).max() < 1e-13
        hits, lost = hits + np.isfinite(t).sum(), lost + np.isinf(t).sum()
    assert hits > 1000 and lost > 1000


def test_along_edges_and_parallel_to_triangles():
    """A roof z = 1 - |x| of 2 x 4 cells, with rays in the planes of its edges and of its triangles."""
    gx, gy = np.array([-1.0, 0.0, 1.0]), np.linspace(-1, 1, 5)
    roof = np.repeat(np.array([[0.0], [1.0], [0.0]]), 5, axis=1)
    cases = [  # ray, time
        ((0, -1, 0.5, 0, 1, 0.25), 2.0),  # along the ridge, meets it at its end
        ((0, -1, 0.5, 0, 1, 0.5), 1.0),
        ((-1, 0, -0.5, 1, 0, 1.5), 1.0),  # along a line of y, to the ridge
        ((-1, -1, -0.5, 1, 0.5, 1.0), 1.25),  # half a unit below the left side all the way, and out through the right one
        ((-1, 0.5, -0.25, 1, -0.5, 1.0), 1.125),
        ((1, -1, -0.25, -1, 0, 0.75), 9 / 7),
        ((1, 0, -0.25, -1, 0.5, -0.5), math.inf),
        ((0.5, 0.25, -1, 0, 0, 2), 0.75),
        ((0.0, 0.5, -1, 0, 0, 1), 2.0),
        ((1.0, 1.0, -1, 0, 0, 1), 1.0),
        ((1.0, -0.9, -1, 0, 1, 1), 1.0),
        ((-1.0, 0.3, -0.5, 0, -0.5, 0.5), 1.0),  # along the aperture's borders
        ((-0.5, -1, 0.25, 0, 1, 0.5), 0.5),
        ((-0.5, -1, 0.25, 1e-300, 1, 0.5), 0.5),
        ((0.5, 0.5, 0.0, 1e-320, 1e-320, 1), 0.5),
    ]
    rays = np.array([c[0] for c in cases], dtype=float).T
    for recursive in (True, False):
        t, _, _ = on_vertices(gx, gy, roof, rays, recursive=recursive)
        np.testing.assert_allclose(t, [c[1] for c in cases], rtol=1e-15)


def test_planes_give_the_exact_time():
    """Splines reproduce planes: whatever the degree, the time is (a x + b y + c - z) / (dz - a dx - b dy)."""
    rng = np.random.default_rng(8)
    for spaces, parts in FIELDS.values():
        field = HeightField(spaces, HALF)
        x, y = field.control_xy()
        for a, b, c in ((0.0, 0.0, 0.5), (0.3, -0.2, 0.1), (-1.0, 0.7, 3.0)):
            mesh = TriangleMesh(field, a * x[:, None] + b * y + c, *parts)
            count = 3000
            rays = np.concatenate(
                [rng.uniform(-1, 1, (2, count)), np.full((1, count), -6.0), rng.uniform(-0.4, 0.4, (2, count)), np.ones((1, count))]
            )
            rays[3, :200], rays[4, 100:300] = 0.0, 0.0
            expected = (a * rays[0] + b * rays[1] + c - rays[2]) / (rays[5] - a * rays[3] - b * rays[4])
            inside = (abs(rays[0] + expected * rays[3]) < HALF[0]) & (abs(rays[1] + expected * rays[4]) < HALF[1])
            t, status, _ = found(mesh, rays)
            assert ((status == kernel.HIT) == inside).all()
            assert 500 < inside.sum() < count
            assert abs(t[inside] / expected[inside] - 1.0).max() < 1e-14


def test_upright_rays():
    mesh = bumpy("cubic", seed=9)
    rng = np.random.default_rng(9)
    x, y = rng.uniform(-2, 2, 2000), rng.uniform(-1.5, 1.5, 2000)
    x[:3], y[:3] = (2.0, -2.0, 2.0), (1.5, -1.5, -1.5)
    height = sheet(x, y, *parts_of(mesh))
    one = np.ones_like(x)
    for dz in (1.0, 0.25, 1e-200):
        t, _, tested = found(mesh, np.stack([x, y, -3 * one, 0 * x, 0 * x, dz * one]))
        np.testing.assert_allclose(t * dz, height + 3, rtol=1e-14)
        assert (tested == 1).all()
    for z, dz in ((-3, 0.0), (-3, -1.0), (3, 1.0), (3, -1.0)):
        assert np.isinf(found(mesh, np.stack([x, y, z * one, 0 * x, 0 * x, dz * one]))[0]).all()


def test_errors_fall_with_the_square_of_the_cells():
    """The cap of a sphere, table D.3: mean z-error and t-error over the parts of a knot span, orders fitted."""
    space = SplineSpace.uniform(15, 3)
    field = HeightField((space, space), (5.0, 5.0))
    x, y = field.control_xy()
    heights = torch.sqrt(81 - x[:, None] ** 2 - y**2) - 9
    rng = np.random.default_rng(10)
    polar, turn = rng.uniform(0, 0.8, 5000), rng.uniform(0, 2 * math.pi, 5000)
    d = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])
    rays = np.concatenate([np.zeros((2, 5000)), np.full((1, 5000), -6.0), d])
    surface = Surface((space, space), heights[..., None])

    def z(t):
        u, v = (torch.from_numpy(0.5 + t * d[k] / 10.0) for k in (0, 1))
        return surface.evaluate(u, v)[..., 0].numpy()

    low, high = np.zeros(5000), 5.0 / np.maximum(abs(d[0]), abs(d[1])).clip(0.5)
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = -6.0 + middle * d[2] < z(middle)
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    errors, parts = [], [1, 2, 4, 8, 16, 32]
    for n in parts:
        t, status, _ = found(TriangleMesh(field, heights, n, n), rays)
        assert (status == kernel.HIT).all()
        errors.append([abs(-6.0 + t * d[2] - z(t)).mean(), abs(t - low).mean()])
    orders = np.polyfit(np.log(parts), np.log(errors), 1)[0]
    assert (abs(orders + 2) < 0.05).all(), orders
    assert errors[0][1] > 1e-3
    assert errors[-1][1] < 1e-4


def test_misses():
    mesh = bumpy("cubic", rough=0.05)
    up = [0.3, 0.2, 1.0]
    rays = {
        "leaves through the side below": [0, 0, -3, 1, 0.1, 0.1],
        "leaves downwards": [0, 0, -3, 1, 0.1, -1],
        "begins above": [0, 0, 1, *up],
        "begins above and comes down": [0, 0, 1, 0.3, 0.2, -1],
        "begins outside and goes away": [3, 0, -1, *up],
        "passes the corner": [3.0, 0.0, -1, -1, 1.5, 0.1],
        "enters above": [-4, 0, 0, 1, 0, 1],
        "enters above and comes down": [-4, 0, 3, 1, 0, -1],
        "upright outside": [2.1, 0, -1, 0, 0, 1],
        "beside, along the border": [2.1, 0, -1, 0, 1, 1],
        "level below": [0, 0, -3, 1, 0, 0],
        "no direction": [0, 0, -1, 0, 0, 0],
        "not a number": [0, 0, math.nan, *up],
        "nor a direction": [0, 0, -1, math.nan, 0, 1],
        "infinite": [math.inf, 0, -1, -math.inf, 0, 1],
    }
    for recursive in (True, False):
        t, status, _ = found(mesh, np.array(list(rays.values()), dtype=float).T, recursive)
        assert dict(zip(rays, status, strict=True)) == dict.fromkeys(rays, kernel.MISSED)
        assert np.isinf(t).all()
        t, _, _ = found(mesh, np.array([[0, 0, -3, *up], [-4, 0, -1.5, 1, 0, 0.5], [0, 0, -3, 0, 0, 1]], dtype=float).T, recursive)
        assert np.isfinite(t).all()
        assert t[1] > 2.0  # from outside, entering below


def test_the_first_of_several_crossings():
    """Shallow rays through hills, against marching in small steps."""
    mesh = bumpy("cubic", rough=0.8, seed=11)
    rng = np.random.default_rng(11)
    count, steps = 400, 20_000
    o = np.stack([rng.uniform(-2.2, 2.2, count), rng.uniform(-1.7, 1.7, count), rng.uniform(-1.2, 0, count)])
    turn = rng.uniform(0, 2 * math.pi, count)
    rays = np.concatenate([o, [np.cos(turn), np.sin(turn), rng.uniform(-0.1, 0.3, count)]])
    gx, gy, z = parts_of(mesh)
    start, end = stay(rays, gx, gy)
    t, status, _ = found(mesh, rays)
    hits = several = begun_above = 0
    for k in np.flatnonzero(end > start):
        times = np.linspace(start[k], end[k], steps)
        f = o[2, k] + times * rays[5, k] - sheet(*(rays[m, k] + times * rays[3 + m, k] for m in (0, 1)), gx, gy, z)
        if f[0] >= 0:
            begun_above += 1
            assert status[k] == kernel.MISSED
            continue
        crossings = np.flatnonzero((f[:-1] < 0) & (f[1:] >= 0))
        assert (status[k] == kernel.HIT) == (len(crossings) > 0)
        if len(crossings):
            hits, several = hits + 1, several + (len(crossings) > 1)
            assert times[crossings[0]] - 1e-12 <= t[k] <= times[crossings[0] + 1] + 1e-12
    assert hits > 100 and several > 15 and begun_above > 30


@pytest.mark.parametrize("name", FIELDS)
def test_vertices_lie_on_the_surface_and_in_the_boxes(name):
    (su, sv), (n_u, n_v) = FIELDS[name]
    heights = torch.randn(su.n, sv.n, generator=torch.Generator().manual_seed(12), dtype=torch.float64)
    z = vertices_of(su, sv, heights, n_u, n_v)
    u, v = (torch.from_numpy(lines_of(s.breaks.numpy(), n)) for s, n in ((su, n_u), (sv, n_v)))
    surface = Surface((su, sv), heights[..., None])
    expected = surface.evaluate(*torch.meshgrid(u, v, indexing="ij"))[..., 0]
    assert z.shape == expected.shape
    torch.testing.assert_close(z, expected, rtol=0, atol=1e-14)
    low, high = boxes_of(su, sv, heights)
    assert low.shape == (len(su.breaks) - 1, len(sv.breaks) - 1)
    narrow = 0
    for i, j in np.ndindex(*low.shape):
        part = z[i * n_u : (i + 1) * n_u + 1, j * n_v : (j + 1) * n_v + 1]
        assert low[i, j] <= part.min() and part.max() <= high[i, j]
        a, b = (int(s.span(s.breaks[k])) for s, k in ((su, i), (sv, j)))
        net = heights[a - su.degree : a + 1, b - sv.degree : b + 1]
        assert abs(low[i, j] - net.min()) < 1e-12 and abs(high[i, j] - net.max()) < 1e-12
        narrow += bool(low[i, j] > heights.min())
    assert narrow > 0


def test_at_least_one_part():
    spaces, _ = FIELDS["linear"]
    with pytest.raises(InputError, match="1 x 1"):
        TriangleMesh(HeightField(spaces, HALF), torch.zeros(5, 4), 1, 0)


def test_torch_keeps_its_threads():
    before = torch.get_num_threads()
    found(bumpy("linear"), np.array([[0.0], [0.0], [-3.0], [0.1], [0.0], [1.0]]))
    assert torch.get_num_threads() == before
