"""Rays in batches, and rays from anywhere: hits against plain ray-by-ray searches, derivatives by heights, origin and direction.

f(t) = o_z + t d_z - Z(o_x + t d_x, o_y + t d_y), c = d_z - Z_x d_x - Z_y d_y, as in `intersection`.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch.autograd import forward_ad

from caustic_cli.optics import intersection
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.intersection import Status
from caustic_cli.optics.kernels import batches
from caustic_cli.optics.kernels.ray_intersections import RayIntersections, hits_of_rays
from caustic_cli.optics.kernels.surface import FusedSurface
from caustic_cli.optics.surfaces.heightfield import HeightField

HALF = (5.0, 4.0)


def surface(n=13, m=12, degrees=(3, 4), size=0.05, seed=0):
    """A field, its kernel's side, and heights around 2 mm."""
    field = HeightField((SplineSpace.uniform(n, degrees[0]), SplineSpace.uniform(m, degrees[1])), HALF)
    g = torch.Generator().manual_seed(seed)
    return field, FusedSurface(field.spaces, HALF), 2.0 + size * torch.randn(n, m, generator=g, dtype=torch.float64)


def fan(count, widest, seed=0, spread=1.0, z=0.0):
    """Origins over `spread` times the aperture at height z, and unit directions up to `widest` rad from +z."""
    r = torch.rand(4, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    theta, phi = widest * r[2].sqrt(), 2 * math.pi * r[3]
    origin = [(2 * r[0] - 1) * HALF[0] * spread, (2 * r[1] - 1) * HALF[1] * spread, torch.full((count,), z, dtype=torch.float64)]
    return origin, [torch.sin(theta) * torch.cos(phi), torch.sin(theta) * torch.sin(phi), torch.cos(theta)]


def hits_of(fused, origin, direction, radius=None):
    return RayIntersections(fused, (*origin[:2], float(origin[2][0])), direction, radius)


# batches


@pytest.mark.parametrize("degrees", [(1, 1), (1, 4), (3, 2), (7, 7), (10, 10), (12, 3)])
@pytest.mark.parametrize("widest, radius", [(0.01, None), (0.7, 3.5), (1.4, None)])
def test_batches_find_what_single_rays_find(degrees, widest, radius):
    _, fused, heights = surface(20, 17, degrees)
    rays = fan(20_000, widest)
    hits = hits_of(fused, *rays, radius)
    assert hits.batched
    together = [t.clone() for t in hits(heights)]
    status = torch.from_numpy(hits.find(heights)[1].copy())
    hits.batched = False
    alone = hits(heights)
    assert bool((status == torch.from_numpy(hits.find(heights)[1])).all())
    hit = status == Status.HIT
    assert 0.3 < float(hit.double().mean()) <= 1.0
    assert bool((together[0][~hit] == -1).all())
    dx, dy, dz = rays[1]
    cosine = (dz - alone[1] * dx - alone[2] * dy)[hit]
    close = 1e-14 / cosine.clamp_max(1.0)
    assert bool(((together[0] - alone[0])[hit].abs() <= close).all())
    for a, b in zip(together[1:], alone[1:], strict=True):
        assert bool(((a - b)[hit].abs() <= 20 * close).all())


def test_grazing_and_steep_rays_are_not_batched():
    """Where L >= d_z there may be several roots; the reference isolates the first."""
    field, fused, heights = surface(9, 8, (3, 3), 0.6)
    rays = fan(2000, 1.5)
    hits = hits_of(fused, *rays)
    near, found = map(torch.from_numpy, hits.find(heights))
    t, status = intersection.reference(field, heights, *rays)
    assert hits.batched
    assert bool((found == status).all())
    hit = status == Status.HIT
    torch.testing.assert_close(near[hit], t[hit], rtol=0, atol=1e-9)


@pytest.mark.parametrize("degrees", [(1, 2), (3, 3), (10, 10)])
@pytest.mark.parametrize("batched", [False, True])
def test_adjoint_of_batches(degrees, batched):
    """Against torch's own derivatives of one Newton step."""
    field, fused, heights = surface(14, 15, degrees)
    rays, g = fan(3000, 0.6), torch.Generator().manual_seed(1)
    hits = hits_of(fused, *rays)
    hits.batched = batched
    by = [torch.randn(3000, generator=g, dtype=torch.float64) for _ in range(3)]
    leaf = heights.clone().requires_grad_()
    (fast,) = torch.autograd.grad(hits(leaf), leaf, by)
    (plain,) = torch.autograd.grad(intersection.intersect_any(field, leaf, *rays, 1.0)[:3], leaf, by)
    assert float((fast - plain).norm() / plain.norm()) < 1e-12


def test_hits_depend_on_nothing_but_ray_and_heights():
    """Not on what was traced before, bit by bit; to a rounding, neither on the order of the rays nor on the number of threads."""
    _, fused, heights = surface(20, 17, (10, 10))
    origin, direction = fan(20_000, 0.5)
    hits = hits_of(fused, origin, direction)
    first = hits(heights)
    hits(heights + 1.0)
    for a, b in zip(first, hits(heights), strict=True):
        assert bool((a == b).all())
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3 - min(before, 2))
        again = hits(heights)
    finally:
        torch.set_num_threads(before)
    turn = torch.randperm(20_000, generator=torch.Generator().manual_seed(0))
    turned = hits_of(fused, [c[turn] for c in origin], [c[turn] for c in direction])(heights)
    for a, b, c in zip(first, again, turned, strict=True):
        assert float((a - b).abs().max()) < 1e-13  # a ray in a group of few is met alone
        assert float((a[turn] - c).abs().max()) < 1e-13


def test_rays_are_put_in_order_of_their_span_products():
    field, fused, _ = surface()
    (x, y, _), _ = fan(1000, 0.1)
    order, used = batches.order(
        (x * fused.scale[0] + 0.5).numpy(), (y * fused.scale[1] + 0.5).numpy(), fused.pieces.breaks_u, fused.pieces.breaks_v
    )
    at = [
        torch.searchsorted(s.breaks[1:-1], c / (2 * r) + 0.5, right=True)
        for s, c, r in zip(field.spaces, (x, y), HALF, strict=True)
    ]
    where = (at[0] * (len(fused.pieces.breaks_v) - 1) + at[1])[torch.from_numpy(order).long()]
    assert bool((where.diff() >= 0).all())
    assert len(where.unique()) == used


# rays from anywhere


def attached(field, heights, origin, direction, t):
    """One Newton step from the root t, by torch: its value and derivatives are those of the root."""
    x, y, z = (o + t * d for o, d in zip(origin, direction, strict=True))
    z_at, gx, gy = surface_at(field, heights, x, y)
    with torch.no_grad():
        c = direction[2] - gx * direction[0] - gy * direction[1]
    t = t - (z - z_at) / c
    x, y = (o + t * d for o, d in zip(origin[:2], direction[:2], strict=True))
    return t, *surface_at(field, heights, x, y)[1:]


def surface_at(field, heights, x, y):
    """Z, Z_x, Z_y, differentiable by x and y: Taylor's polynomials of second order around the points."""
    at, orders = (x.detach(), y.detach()), ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    z, zx, zy, *second = field.at(heights, *at, orders)
    xx, xy, yy = (s.detach() for s in second)
    ax, ay = x - at[0], y - at[1]
    return z + zx.detach() * ax + zy.detach() * ay, zx + xx * ax + xy * ay, zy + xy * ax + yy * ay


def test_hits_from_outside_are_the_first_ones():
    """Against a fine march from the ray's origin, through the aperture's prism."""
    field, fused, heights = surface(size=0.3)
    origin, direction = fan(200, 1.2, 2, spread=2.0, z=-3.0)
    t, gx, gy, found = hits_of_rays(fused, heights, origin, direction, side=1.0)
    s = torch.linspace(0, 1, 4001, dtype=torch.float64)
    agree, outside = 0, 0
    for k in range(200):
        way = s * (float(heights.max()) + 3.0) / direction[2][k]
        x, y, z = (o[k] + way * d[k] for o, d in zip(origin, direction, strict=True))
        inside = (x.abs() <= HALF[0]) & (y.abs() <= HALF[1])
        above = z - field.at(heights, x.clamp(-HALF[0], HALF[0]), y.clamp(-HALF[1], HALF[1]))[0] >= 0
        meets = (inside & above).nonzero()
        first = int(meets[0, 0]) if len(meets) else -1
        begins_above = first > 0 and not bool(inside[first - 1])
        expected = first >= 0 and not begins_above
        agree += expected == bool(found[k])
        if found[k] and expected:
            assert float(way[first - 1]) - 1e-9 <= float(t[k]) <= float(way[first]) + 1e-9
            outside += not bool(inside[0])
    assert agree > 194  # a march does not see a root within a step of the edge
    assert outside > 15
    assert bool((t[~found] == 0).all() and (gx[~found] == 0).all() and (gy[~found] == 0).all())
    x, y, z = (o + t * d for o, d in zip(origin, direction, strict=True))
    value, zx, zy = field.at(heights, x.clamp(-HALF[0], HALF[0]), y.clamp(-HALF[1], HALF[1]))
    assert float((z - value)[found].abs().max()) < 1e-13
    assert float((gx - zx)[found].abs().max()) + float((gy - zy)[found].abs().max()) < 1e-12


def test_a_long_way_off():
    """A plane, met after 300 mm by rays that start beyond its aperture: t = f(0) / -c."""
    field, fused, _ = surface()
    x, y = field.control_xy()
    heights = 3.0 + 0.1 * x[:, None] - 0.05 * y[None, :]
    (ax, ay, _), (dx, dy, dz) = fan(1000, 0.5, 3, spread=0.8)
    origin = [ax - 300 * dx, ay - 300 * dy, (3.0 + 0.1 * ax - 0.05 * ay) - 300 * dz]
    t, gx, gy, found = hits_of_rays(fused, heights, origin, (dx, dy, dz))
    assert bool(found.all())
    assert float(torch.hypot(origin[0], origin[1]).median()) > 50.0
    torch.testing.assert_close(t, torch.full_like(t, 300.0), rtol=1e-14, atol=0)
    torch.testing.assert_close(gx, torch.full_like(gx, 0.1), rtol=0, atol=1e-14)
    torch.testing.assert_close(gy, torch.full_like(gy, -0.05), rtol=0, atol=1e-14)


def test_where_the_aperture_ends():
    """A flat surface at height 2."""
    _, fused, heights = surface()
    heights = torch.full_like(heights, 2.0)
    one, none = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)

    def meets(x, z, dx, dz, **options):
        length = math.hypot(dx, dz)
        ray = (x * one, none, z * one), (dx / length * one, none, dz / length * one)
        t, _, _, found = hits_of_rays(fused, heights, *ray, **options)
        return round(float(t) / length, 9) if found else None

    assert meets(0.0, 0.0, 0.0, 1.0) == 2.0
    assert meets(3.5, 0.0, 0.0, 1.0) == 2.0
    assert meets(-6.0, 0.0, 2.0, 1.0) == 2.0
    assert meets(-7.0, 0.0, 0.5, 1.0) is None  # enters above it
    for z in (2.0, 3.0):
        assert meets(0.0, z, 0.0, 1.0) is None
    assert meets(0.0, 3.0, 0.0, -1.0) is None
    assert meets(0.0, 3.0, 0.0, -1.0, side=-1.0) == 1.0


def test_from_above_is_the_mirror_image():
    _, fused, heights = surface()
    (ox, oy, oz), (dx, dy, dz) = fan(500, 0.8, 4, spread=1.3, z=-1.0)
    below = hits_of_rays(fused, heights, (ox, oy, oz), (dx, dy, dz), side=1.0)
    above = hits_of_rays(fused, -heights, (ox, oy, -oz), (dx, dy, -dz), side=-1.0)
    assert bool(below[3].any()) and bool((below[3] == above[3]).all()) and bool((below[0] == above[0]).all())
    assert bool((below[1] == -above[1]).all()) and bool((below[2] == -above[2]).all())


@pytest.mark.parametrize("degrees, count", [((3, 4), 40), ((3, 4), 3000), ((10, 10), 3000)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_derivatives_by_heights_origin_and_direction(degrees, count, side):
    """Reverse mode against torch through one Newton step, the reference's forward mode, and central differences."""
    field, fused, heights = surface(degrees=degrees)
    origin, direction = fan(count, 0.7, 5, spread=1.3, z=-1.0)
    heights, origin[2], direction[2] = side * heights, side * origin[2], side * direction[2]
    g = torch.Generator().manual_seed(6)
    inputs = [heights, *origin, *direction]
    along = [torch.randn(c.shape, generator=g, dtype=torch.float64) for c in inputs]
    by = [torch.randn(count, generator=g, dtype=torch.float64) for _ in range(3)]

    def first_hits(h, *rays):
        return hits_of_rays(fused, h, rays[:3], rays[3:], side=side)

    leaves = [c.clone().requires_grad_() for c in inputs]
    *values, found = first_hits(*leaves)
    assert 20 < int(found.sum()) < count
    pulled = torch.autograd.grad(values, leaves, by)
    there = [c[found] for c in leaves[1:]]
    plain = torch.autograd.grad(
        attached(field, leaves[0], there[:3], there[3:], values[0].detach()[found]), leaves, [b[found] for b in by]
    )
    for a, b in zip(pulled, plain, strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-11
    with forward_ad.dual_level():
        dual = [forward_ad.make_dual(c, a) for c, a in zip(inputs, along, strict=True)]
        duals = field.intersect(dual[0], dual[1:4], dual[4:], side)[:3]
        tangents = [forward_ad.unpack_dual(d).tangent for d in duals]
    forward = float(sum((a * b).sum() for a, b in zip(by, tangents, strict=True)))
    assert float(sum((a * b).sum() for a, b in zip(pulled, along, strict=True))) == pytest.approx(forward, rel=1e-11)
    step = 1e-6
    up, down = (first_hits(*(c + s * a for c, a in zip(inputs, along, strict=True))) for s in (step, -step))
    both = up[3] & down[3] & found
    for tangent, a, b in zip(tangents, up, down, strict=False):
        torch.testing.assert_close(tangent[both], ((a - b) / (2 * step))[both], rtol=1e-6, atol=1e-5)
        assert float(tangent[~found].abs().sum()) == 0.0


def test_only_what_is_asked_for_is_differentiated():
    _, fused, heights = surface()
    origin, direction = fan(200, 0.5, 7)
    leaves = [heights.clone().requires_grad_(), *(c.clone().requires_grad_() for c in (*origin, *direction))]
    whole = torch.autograd.grad(hits_of_rays(fused, leaves[0], leaves[1:4], leaves[4:])[0].sum(), leaves)
    for k, leaf in enumerate(leaves):
        inputs = [c if c is leaf else c.detach() for c in leaves]
        (one,) = torch.autograd.grad(hits_of_rays(fused, inputs[0], inputs[1:4], inputs[4:])[0].sum(), leaf)
        assert bool((one == whole[k]).all())


def test_without_rays():
    _, fused, heights = surface()
    none = torch.zeros(0, dtype=torch.float64)
    t, gx, gy, found = hits_of_rays(fused, heights.requires_grad_(), (none,) * 3, (none,) * 3)
    assert len(t) == len(gx) == len(gy) == len(found) == 0
    (grad,) = torch.autograd.grad(t.sum(), heights)
    assert float(grad.abs().sum()) == 0.0
