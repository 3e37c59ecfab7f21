"""Degrees 1 to 15, knots repeated up to the degree, points on the knots: against exact rational arithmetic.

Naive: the textbook's Cox-de Boor recursion, which divides 0 by 0 where knots repeat; and powers of the global variable, whose
coefficients cancel the more the higher the degree.
"""

import functools

import numpy as np
import pytest
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels.surface import FusedSurface, scattered_surface
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.studies.stability.splines import exact, heights_of, naive_basis, points, space

SHARE = torch.ones((), dtype=torch.float64)


@functools.cache
def exact_rows(p: int, kind: str) -> list[tuple[float, float, float]]:
    s = space(p, kind)
    return [exact(s, float(x), heights_of(s.n, p)) for x in points(s)]


@pytest.mark.parametrize("kind", ["even", "repeated"])
@pytest.mark.parametrize("p", range(1, 16))
def test_values_and_slopes(p, kind, dtype, compare):
    """By the reference and by the kernel's polynomials, along one axis of a surface that is a plane along the other."""
    s, flat = space(p, kind), SplineSpace.uniform(2, 1)
    u = points(s)
    v = torch.full_like(u, 0.3)
    heights = heights_of(s.n, p)
    value, slope, size = (torch.tensor(c, dtype=torch.float64) for c in zip(*exact_rows(p, kind), strict=True))
    span = s.span(u)  # a piece's polynomial rounds by its own largest slope: 1e9 where two knots are 1e-9 apart
    size = torch.stack([size[span == k].max() for k in span])
    net, half = heights[:, None].expand(s.n, 2).contiguous(), (0.5, 0.5)  # the aperture is 1 mm wide: slopes by u
    field = HeightField((s, flat), half)
    found = {
        "tensor": [a[:, 0] for a in field.prepare(Sample(u, v[:1], True, SHARE), dtype)(net.to(dtype))[:2]],
        "scattered": field.prepare(Sample(u, v, False, SHARE), dtype)(net.to(dtype))[:2],
        "kernel": scattered_surface(FusedSurface((s, flat), half), net, u.numpy(), v.numpy())[:2],
    }
    eps = torch.finfo(dtype).eps
    worst = 0.0
    for name, (z, zx) in found.items():
        assert bool(torch.isfinite(z).all() and torch.isfinite(zx).all()), name
        worst = max(
            worst, float((z.double() - value).abs().max()) / eps, float(((zx.double() - slope).abs() / (size + 1.0)).max()) / eps
        )
    numpy = np.float32 if dtype == torch.float32 else np.float64
    if kind == "repeated":
        naive = float(np.abs(naive_basis(s, u.numpy(), numpy) @ heights.numpy() - value.numpy()).max())
        compare("knots repeated up to the degree", "value and slope, roundings", naive, worst, 50.0 * (p + 1))
    else:
        powers = np.vander(u.numpy(), p + 1, increasing=True).astype(numpy)  # the last span's piece, in the global variable
        x = np.linspace(float(s.breaks[-2]), 1.0, p + 1)
        piece = np.linalg.solve(np.vander(x, increasing=True), [exact(s, float(a), heights)[0] for a in x]).astype(numpy)
        there = (u >= s.breaks[-2]).numpy()
        naive = float(np.abs((powers @ piece).astype(float) - value.numpy())[there].max()) / eps
        if p >= 7:
            compare("degrees up to 15", "value and slope, roundings", naive, worst, 50.0 * (p + 1))
        else:
            assert worst < 50.0 * (p + 1)


@pytest.mark.parametrize("p", [1, 4, 15])
@pytest.mark.parametrize("kind", ["even", "repeated"])
def test_derivatives_by_the_heights_are_the_transpose(p, kind, dtype):
    """A surface is linear in its heights: <y, S h> = <S' y, h>, whatever the knots; and the basis sums to 1."""
    s = space(p, kind)
    u = points(s)
    v = u.flip(0).contiguous()
    g = torch.Generator().manual_seed(p)
    heights = torch.rand(s.n, s.n, generator=g, dtype=torch.float64)
    by = torch.rand(2, len(u), generator=g, dtype=torch.float64).to(dtype)
    for call in (
        lambda h: HeightField((s, s), (1.0, 1.0)).prepare(Sample(u, v, False, SHARE), dtype)(h.to(dtype)),
        lambda h: scattered_surface(FusedSurface((s, s), (1.0, 1.0)), h, u.numpy(), v.numpy()),
    ):
        leaf = heights.clone().requires_grad_()
        z, zx, _ = call(leaf)
        (pulled,) = torch.autograd.grad((z * by[0]).sum() + 1e-3 * (zx * by[1]).sum(), leaf)
        forward = float((z.detach().double() * by[0]).sum() + 1e-3 * (zx.detach().double() * by[1]).sum())
        size = float((pulled.abs() * heights).sum())
        assert abs(float((pulled * heights).sum()) - forward) < 100 * (p + 1) * torch.finfo(dtype).eps * size
        ones = call(torch.ones_like(heights))
        assert float((ones[0] - 1.0).abs().max()) < 50 * (p + 1) * torch.finfo(dtype).eps
