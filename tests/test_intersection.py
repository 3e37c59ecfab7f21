"""Rays against the height field: roots, first roots, misses, derivatives; reference and kernel alike."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import forward_ad

from caustic_cli.optics import intersection
from caustic_cli.optics.backends.reference import Torch
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.frames import IDENTITY
from caustic_cli.optics.intersection import Method, Status
from caustic_cli.optics.kernels.ray_intersections import RayIntersections
from caustic_cli.optics.kernels.surface import FusedSurface
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces import Plane
from caustic_cli.optics.surfaces.heightfield import HeightField


def bundle(x, y, z, dx, dy, dz):
    x, y, dx, dy, dz = (torch.as_tensor(a, dtype=torch.float64) for a in (x, y, dx, dy, dz))
    length = torch.sqrt(dx * dx + dy * dy + dz * dz)
    return RayState((x, y, z), (dx / length, dy / length, dz / length), torch.ones_like(x))


def field(n=9, m=8, degrees=(3, 2), half=(5.0, 4.0), repeat=False):
    spaces = [SplineSpace.uniform(n, degrees[0]), SplineSpace.uniform(m, degrees[1])]
    if repeat:
        spaces = [s.insert([0.5] * (s.degree - 1))[0] for s in spaces]
    return HeightField(tuple(spaces), half)


def bumpy(f, size, seed=0):
    return 2.0 + size * torch.randn(f.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def fan(count, widest, seed=0, half=(5.0, 4.0), z=0.0):
    g = torch.Generator().manual_seed(seed)
    u = torch.rand(5, count, generator=g, dtype=torch.float64)
    tangent, phi = torch.tan(widest * u[2]), 2 * math.pi * u[3]
    return bundle(
        (2 * u[0] - 1) * half[0], (2 * u[1] - 1) * half[1], z, tangent * torch.cos(phi), tangent * torch.sin(phi), torch.ones(count)
    )


def find_fused(f, heights, rays, start=None):
    hits = RayIntersections(FusedSurface(f.spaces, f.half_size), rays.origin, rays.direction, None)
    t, status = hits.find(heights, start)
    return torch.from_numpy(t), torch.from_numpy(status.astype(np.int64))


def find_plainly(f, heights, rays):
    return intersection.reference(f, heights, rays.origin, rays.direction)


FINDERS = {"reference": find_plainly, "kernel": find_fused}


@pytest.fixture(params=FINDERS)
def find(request):
    return FINDERS[request.param]


def along_rays(rays, t):
    return tuple(o + t * d for o, d in zip(rays.origin, rays.direction, strict=True))


def residual(f, heights, rays, t):
    x, y, z = along_rays(rays, t)
    return z - f.at(heights, x, y)[0]


@pytest.mark.parametrize("degrees", [(1, 1), (3, 2), (5, 5), (10, 10), (15, 2)])
@pytest.mark.parametrize("repeat", [False, True])
def test_hits_lie_on_the_surface(find, degrees, repeat):
    f = field(17, 16, degrees, repeat=repeat)
    heights, rays = bumpy(f, 0.05), fan(3000, 0.7)
    t, status = find(f, heights, rays)
    hit = status == Status.HIT
    assert 1000 < int(hit.sum()) < 3000
    assert not bool((status == Status.UNRESOLVED).any())
    x, y, _ = along_rays(rays, t)
    on = (x.abs() <= 5 + 1e-9) & (y.abs() <= 4 + 1e-9)
    assert bool(on[hit].all())
    assert float(residual(f, heights, rays, t)[hit & on].abs().max()) < 4e-15 * 4
    # What misses leaves by the side, below the surface.
    side = torch.minimum(*((r - o * d.sign()) / d.abs() for r, o, d in zip((5, 4), rays.origin, rays.direction, strict=False)))
    missed = status == Status.MISSED
    assert int(missed.sum()) > 10
    assert bool((residual(f, heights, rays, side * (1 - 1e-9))[missed] < 1e-7).all())


def test_kernel_and_reference_find_the_same():
    f = field()
    for size in (0.02, 0.3, 1.0):
        heights, rays = bumpy(f, size), fan(2000, 1.3, 1)
        (a, sa), (b, sb) = find_plainly(f, heights, rays), find_fused(f, heights, rays)
        assert bool((sa == sb).all())
        hit = sa == Status.HIT
        assert int(hit.sum()) > 100
        torch.testing.assert_close(a[hit], b[hit], rtol=0, atol=1e-9)  # grazing hits are ill conditioned


def first_by_marching(f, heights, rays, steps=20_001):
    """The first sign change on a fine grid of distances, from the values alone."""
    top = float(heights.max()) - rays.origin[2]
    s = torch.linspace(0, 1, steps, dtype=torch.float64)
    out = torch.full_like(rays.origin[0], math.inf)
    for k in range(len(rays.origin[0])):
        t = s * top / rays.direction[2][k]
        x, y = rays.origin[0][k] + t * rays.direction[0][k], rays.origin[1][k] + t * rays.direction[1][k]
        inside = (x.abs() <= f.half_size[0]) & (y.abs() <= f.half_size[1])
        value = rays.origin[2] + t * rays.direction[2][k] - f.at(heights, x.clamp(-5, 5), y.clamp(-4, 4))[0]
        above = (inside & (value >= 0)).nonzero()
        if len(above):
            out[k] = t[above[0, 0]]
    return out


def test_the_first_of_several_roots_is_found(find):
    """Hard case 2: grazing rays on a surface of slope 2 and more."""
    f = field(17, 16)
    heights, rays = bumpy(f, 0.8), fan(150, 1.45, 3)
    t, status = find(f, heights, rays)
    reference = first_by_marching(f, heights, rays)
    hit = status == Status.HIT
    both = hit & torch.isfinite(reference)
    step = (float(heights.max()) / rays.direction[2]) / 20_000
    assert int(both.sum()) > 60
    # a bump narrower than the march's step may be found that the march stepped over, never the other way round
    assert bool((t[both] <= reference[both] + 1e-9).all())
    assert float(((reference - t)[both] <= 1.01 * step[both]).double().mean()) > 0.97
    assert float((hit == torch.isfinite(reference)).double().mean()) > 0.97


def test_several_roots_do_occur_above():
    f = field(17, 16)
    slopes = f.slope_bounds(bumpy(f, 0.8))
    rays = fan(150, 1.45, 3)
    dx, dy, dz = rays.direction
    assert float(((slopes[0] * dx.abs() + slopes[1] * dy.abs()) > dz).double().mean()) > 0.5


@pytest.mark.parametrize("x, y", [(0.0, 0.0), (5.0, 4.0), (-5.0, 4.0), (5.0, 0.0), (1.25, -1.0)])
def test_a_plane_is_hit_where_geometry_says(find, x, y):
    f = field()
    gx, gy = f.control_xy()
    heights = 3.0 + 0.1 * gx[:, None] - 0.05 * gy[None, :]
    rays = bundle([x] * 3, [y] * 3, 0.0, [0.0, -0.02 * np.sign(x), 0.0], [0.0, 0.0, -0.03 * np.sign(y)], [1.0] * 3)
    t, status = find(f, heights, rays)
    assert bool((status == Status.HIT).all())
    exact = (3.0 + 0.1 * x - 0.05 * y) / (rays.direction[2] - 0.1 * rays.direction[0] + 0.05 * rays.direction[1])
    torch.testing.assert_close(t, exact, rtol=4e-15, atol=0)


def test_edges_knots_and_flat_surfaces(find):
    """Rays along knot lines, through their crossings, along the border; a surface whose hull has no thickness."""
    f = field()
    breaks = (2 * f.spaces[0].breaks - 1) * 5.0
    x = breaks.repeat(3)
    flat = torch.full(f.shape, 2.0, dtype=torch.float64)
    for heights in (flat, bumpy(f, 0.1)):
        for dx, dy in ((0.0, 0.0), (0.0, 0.2), (1e-300, 0.0), (-1e-17, 1e-17)):
            rays = bundle(x, torch.zeros_like(x), 0.0, torch.full_like(x, dx), torch.full_like(x, dy), torch.ones_like(x))
            t, status = find(f, heights, rays)
            leaves = (x == 5.0) & (dx > 0) | (x == -5.0) & (dx < 0)  # on the border, outward
            assert bool((status[~leaves] == Status.HIT).all())
            assert float(residual(f, heights, rays, t)[~leaves].abs().max()) < 1e-14


def test_a_surface_that_lies_on_the_floor_of_its_hull(find):
    """Every ray that lands there ends where its bracket begins."""
    f = field(20, 20)
    heights = torch.full(f.shape, 2.0, dtype=torch.float64)
    heights[15:, 15:] = 3.0
    rays = fan(500, 0.5, half=(1.0, 1.0))
    t, status = find(f, heights, rays)
    assert bool((status == Status.HIT).all())
    torch.testing.assert_close(t, 2.0 / rays.direction[2], rtol=4e-15, atol=0)


def test_what_cannot_hit_is_missed(find):
    f = field()
    rays = bundle([0.0, 6.0, 0.0, 4.9], [0.0, 0.0, 0.0, 0.0], 0.0, [0.0, 0.0, 1.0, 1.0], [0.0] * 4, [-1.0, 1.0, 0.0, 0.1])
    _, status = find(f, bumpy(f, 0.01), rays)
    assert status.tolist() == [Status.MISSED] * 4
    above = bundle([0.0], [0.0], 10.0, [0.0], [0.0], [1.0])
    assert find(f, bumpy(f, 0.01), above)[1].tolist() == [Status.MISSED]


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    size=st.sampled_from([0.0, 1e-9, 0.01, 0.3, 3.0]),
    p=st.integers(1, 6),
    widest=st.sampled_from([0.0, 0.3, 1.2, 1.57]),
)
def test_always_finite_and_on_the_surface(seed, size, p, widest):
    f = field(9, 8, (p, 2))
    heights, rays = bumpy(f, size, seed) + 4 * size, fan(64, widest, seed)
    results = [find(f, heights, rays) for find in FINDERS.values()]
    for t, status in results:
        assert bool(torch.isfinite(t).all())
        hit = status == Status.HIT
        assert bool((residual(f, heights, rays, t)[hit].abs() < 1e-12 * (1 + 8 * size)).all())
    assert bool((results[0][1] == results[1][1]).all())


def meet_fused(f, heights, rays):
    return RayIntersections(FusedSurface(f.spaces, f.half_size), rays.origin, rays.direction, None)(heights)


def meet_plainly(f, heights, rays):
    return intersection.intersect_any(f, heights, rays.origin, rays.direction, 1.0)[:3]


def meet_from_anywhere(f, heights, rays):
    return f.intersect(heights, rays.origin, rays.direction, 1.0)[:3]


@pytest.mark.parametrize("meet", [meet_plainly, meet_fused, meet_from_anywhere], ids=["reference", "kernel", "surface"])
def test_derivatives_by_the_implicit_function_theorem(meet):
    """Against central differences, in both modes (a kernel's forward mode is the reference's), on a surface steep enough to
    matter."""
    f = field()
    heights, rays = bumpy(f, 0.15), fan(40, 0.9, 5)
    status = intersection.find(f, heights, rays.origin, rays.direction)[1]
    g = torch.Generator().manual_seed(7)
    along = torch.randn(f.shape, generator=g, dtype=torch.float64)
    with forward_ad.dual_level():
        duals = (meet_plainly if meet is meet_fused else meet)(f, forward_ad.make_dual(heights, along), rays)
        tangents = [forward_ad.unpack_dual(t).tangent for t in duals]
    step = 1e-6
    up, down = meet(f, heights + step * along, rays), meet(f, heights - step * along, rays)
    hit = status == Status.HIT
    assert int(hit.sum()) > 20
    for tangent, a, b in zip(tangents, up, down, strict=True):
        torch.testing.assert_close(tangent[hit], ((a - b) / (2 * step))[hit], rtol=1e-6, atol=1e-7)
        assert float(tangent[~hit].abs().sum()) == 0.0
    by = [torch.randn(len(rays.origin[0]), generator=g, dtype=torch.float64) for _ in range(3)]
    leaf = heights.clone().requires_grad_()
    (pulled,) = torch.autograd.grad(meet(f, leaf, rays), leaf, by)
    assert float((pulled * along).sum()) == pytest.approx(
        float(sum((b * t).sum() for b, t in zip(by, tangents, strict=True))), rel=1e-11
    )


def test_derivatives_equal_those_of_unrolled_newton():
    """Newton's steps differentiated one by one tend to the implicit derivative, at the price of a graph a step long."""
    f = field()
    heights, rays = bumpy(f, 0.05), fan(30, 0.4, 5)
    leaf = heights.clone().requires_grad_()
    status = intersection.find(f, heights, rays.origin, rays.direction)[1]
    hit = status == Status.HIT
    t = torch.full_like(rays.origin[0], 2.0)
    for _ in range(8):
        z, zx, zy = f.at(leaf, rays.origin[0] + t * rays.direction[0], rays.origin[1] + t * rays.direction[1])
        t = t - (rays.origin[2] + t * rays.direction[2] - z) / (rays.direction[2] - zx * rays.direction[0] - zy * rays.direction[1])
    (unrolled,) = torch.autograd.grad(t[hit].sum(), leaf, retain_graph=True)
    (implicit,) = torch.autograd.grad(f.intersect(leaf, rays.origin, rays.direction, 1.0).t[hit].sum(), leaf)
    torch.testing.assert_close(implicit, unrolled, rtol=1e-11, atol=1e-12)


def test_numbers_that_all_rays_share_keep_their_digits():
    """Heights and directions as plain numbers give what tensors of them give: on a spline, on a plane, and landing."""
    f = field()
    heights, x, y = bumpy(f, 0.05), torch.linspace(-2, 2, 9, dtype=torch.float64), torch.full((9,), 0.3, dtype=torch.float64)
    numbers = -0.3, math.sin(0.1) / 3, math.sin(0.2)
    z, direction = numbers[0], (*numbers[1:], math.sqrt(1.0 - sum(c * c for c in numbers[1:])))
    spread = tuple(torch.full_like(x, c) for c in direction)
    for by_numbers, by_tensors in (
        (
            intersection.intersect_any(f, heights, (x, y, z), direction, 1.0),
            intersection.intersect_any(f, heights, (x, y, torch.full_like(x, z)), spread, 1.0),
        ),
        (Plane().intersect(None, (x, y, z), direction, 1.0), Plane().intersect(None, (x, y, torch.full_like(x, z)), spread, 1.0)),
        (
            Torch().land((x, y, z), direction, (0.0, 0.0, 40.0), IDENTITY, 1.0),
            Torch().land((x, y, torch.full_like(x, z)), spread, (0.0, 0.0, 40.0), IDENTITY, 1.0),
        ),
    ):
        for a, b in zip(by_numbers[:2], by_tensors[:2], strict=True):
            torch.testing.assert_close(
                torch.as_tensor(a, dtype=torch.float64).expand(9), torch.as_tensor(b).double().expand(9), rtol=4e-15, atol=4e-15
            )


# the three methods


@pytest.mark.parametrize("size", [0.05, 0.6])
def test_mesh_and_newton_agree_on_what_is_hit(size):
    f = field(17, 16)
    heights, rays = bumpy(f, size), fan(4000, 0.8 if size < 0.1 else 1.3, 4)
    exact, status = intersection.find(f, heights, rays.origin, rays.direction)
    hit = status == Status.HIT
    assert 1000 < int(hit.sum()) < 4000
    errors = []
    for parts in (4, 16):
        mesh, by_mesh = intersection.find(f, heights, rays.origin, rays.direction, Method("mesh", (parts, parts)))
        both, by_both = intersection.find(f, heights, rays.origin, rays.direction, Method("mesh+newton", (parts, parts)))
        assert float((by_mesh == status).double().mean()) > 0.98  # rays near the rim, and grazing ones, may differ
        met = hit & (by_both == Status.HIT)
        assert float((by_both == by_mesh).double().mean()) > 0.98
        same = (both - exact)[met].abs() < 1e-9
        assert float(same.double().mean()) > (0.999 if size < 0.1 else 0.98)
        assert float(residual(f, heights, rays, both)[met].abs().max()) < 1e-13
        errors.append(float((mesh - exact)[hit & (by_mesh == Status.HIT)].abs().median()))
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.25)


def test_the_derivative_at_a_mesh_hit_tends_to_the_implicit_one():
    f = field()
    heights, rays = bumpy(f, 0.05), fan(300, 0.4, 5)
    leaf, found = heights.clone().requires_grad_(), {}
    for name in ("newton", "mesh+newton", "mesh"):
        t, status = intersection.find(f, leaf, rays.origin, rays.direction, Method(name, (32, 32)))
        hit = status == Status.HIT
        t, gx, gy = intersection.attach(f, leaf, rays.origin, rays.direction, t, hit)
        (found[name],) = torch.autograd.grad((t + gx - 2 * gy)[hit].sum(), leaf)
    torch.testing.assert_close(found["mesh+newton"], found["newton"], rtol=1e-10, atol=1e-10)
    assert 0 < float((found["mesh"] - found["newton"]).norm() / found["newton"].norm()) < 1e-3
