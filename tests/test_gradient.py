"""Rays in media of varying index against closed forms, and their derivatives against finite differences and unrolled steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from caustic_cli.errors import CausticError, InputError
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.backends.reference import Torch
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.effects import Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.gradient import (
    Axial,
    FishEye,
    Luneburg,
    NextSurface,
    Radial,
    RayFlow,
    Selfoc,
    SplineIndex,
    flow,
    steps_for,
    transfer,
)
from caustic_cli.optics.gradient.integrator import WEIGHTS, drift, kick
from caustic_cli.optics.gradient.medium import GradientMedium
from caustic_cli.optics.media import Medium
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces import HeightField, Plane
from caustic_cli.optics.system import Element, System
from caustic_cli.optics.trace import Tracer, render
from caustic_cli.scene import Aperture, PlaneWave, Points, Screen
from caustic_cli.scene.gradient import Gradient

D = torch.float64


def real(*values) -> tuple[torch.Tensor, ...]:
    return torch.broadcast_tensors(*(torch.as_tensor(v, dtype=D) for v in values))


def launched(field, point, direction):
    """Momenta n d of rays."""
    n, length = field.index(point), sum(c * c for c in direction).sqrt()
    return tuple(n * c / length for c in direction)


def volume(shape, seed: int = 0, half_size=(5.0, 5.0), depth: float = 4.0) -> SplineIndex:
    generator = torch.Generator().manual_seed(seed)
    return SplineIndex(1.5 + 0.02 * torch.rand(shape, generator=generator, dtype=D), half_size, depth)


def medium(index: float, absorption: float, field) -> Medium:
    """Glass, with an index field or without."""
    return Medium(index, absorption) if field is None else GradientMedium(index, absorption, gradient=field)


def block(field, depth: float, index: float = 1.5, half: float = 5.0, absorption: float = 0.0) -> tuple[Element, Element]:
    """Both sides of a flat blank."""
    return (
        Element("entrance", Plane(), Aperture((half, half)), behind=medium(index, absorption, field)),
        Element("exit", Plane(), Aperture((half, half)), pose=Pose((0.0, 0.0, depth))),
    )


# Closed forms.


def test_the_pitch_of_a_selfoc_rod():
    """2 pi / g for rays near the axis, times n(x_0) / n_0 for those at x_0, by the steps that the trace takes of itself."""
    n0, g = 1.6, 0.3
    long = 2.25 * 2.0 * math.pi / g
    x, zero = real([0.5, -0.8, 1.0], 0.0)
    rod = System((PlaneWave(),), block(Selfoc(n0, g), long, n0, 2.0), (Screen((1.0, 1.0), long + 1.0),))
    out = Tracer(rod, RayState((x, zero, zero), (zero, zero, zero + 1.0), torch.ones_like(x)))({})[0]
    # a flat exit keeps p_x: x = x_0 cos(phase), p_x = -x_0 n_0 g sin(phase)
    phase = torch.atan2(-out.direction[0] / (x * n0 * g), out.origin[0] / x)
    pitch = long / (2.0 + phase / (2.0 * math.pi))
    exact = 2.0 * math.pi / g * (1.0 - (g * x) ** 2).sqrt()
    assert (pitch / exact - 1.0).abs().max() < 1e-6


def test_steep_rays_of_a_selfoc_rod_are_exact_ellipses():
    """q'' = -(n_0 g)^2 q across, at any angle; |p|^2 - n^2 stays 0."""
    field = Selfoc(1.6, 0.2)
    q = real([0.5, 1.0, 0.0], [0.0, -0.3, 1.2], 0.0)
    p = launched(field, q, real([0.5, 0.0, 0.3], [0.2, 0.4, 0.0], 1.0))
    t = torch.full((3,), 4.0, dtype=D)
    out, w = flow(field, None, q, p, t, 64, 6), 1.6 * 0.2
    for k in (0, 1):
        assert torch.allclose(out.point[k], q[k] * torch.cos(w * t) + p[k] / w * torch.sin(w * t), rtol=0, atol=1e-11)
    assert torch.allclose(out.point[2], p[2] * t, atol=1e-13)
    energy = sum(c * c for c in out.momentum) - field.at(out.point)[0]
    assert energy.abs().max() < 1e-11


def test_maxwells_fish_eye_images_every_point():
    """Rays from (0, 0, 0), on the rim about (0, 0, a), meet in (0, 0, 2 a) after the same optical path, pi n_0 a / 2."""
    field = FishEye(2.0, 3.0, (0.0, 0.0, 3.0))
    angle = torch.linspace(-1.2, 1.2, 25, dtype=D)
    d = (torch.sin(angle), 0.3 * torch.sin(angle), torch.cos(angle))
    d = tuple(c / sum(v * v for v in d).sqrt() for c in d)
    zero = torch.zeros_like(angle)

    def seen(points, vectors):
        return (points[0], points[1], points[2] - 6.0), vectors

    found = transfer(RayFlow(flow, field, None), (zero, zero, zero), d, NextSurface(Plane(), None, seen, 1.0))
    assert bool(found.found.all()) and found.steps > 4
    assert max(float(c.abs().max()) for c in found.point[:2]) < 3e-6  # 1e-7 of ways of up to 15 mm
    assert (found.path / (0.5 * math.pi * 2.0 * 3.0) - 1.0).abs().max() < 1e-6
    assert torch.allclose(found.direction[0], -d[0], atol=1e-6)  # circles: the chord's angle at either end


def test_a_fish_eyes_conjugate_of_a_point_within():
    """-a^2 q / |q|^2, counted from the centre: where two rays of one point cross again, another way than by focusing on a plane."""
    field, q = FishEye(1.5, 2.0), real([1.2, 1.2], 0.0, [0.0, 0.0])
    p = launched(field, q, real([0.0, 0.4], 0.0, 1.0))
    image = torch.tensor([-4.0 / 1.2, 0.0, 0.0], dtype=D)
    grid = torch.linspace(0.0, 12.0, 301, dtype=D)
    for k in (0, 1):
        ray = [c[k : k + 1] for c in (*q, *p)]
        out = flow(field, None, [c.expand(301) for c in ray[:3]], [c.expand(301) for c in ray[3:]], grid, 100, 4)
        t = grid[sum((c - i) ** 2 for c, i in zip(out.point, image, strict=True)).argmin()][None]
        for _ in range(5):  # the nearest point of the ray, by Newton's method
            end = flow(field, None, ray[:3], ray[3:], t, 200, 6)
            away = [float(i - c) for c, i in zip(end.point, image, strict=True)]
            t = t + sum(a * m for a, m in zip(away, end.momentum, strict=True)) / sum(m * m for m in end.momentum)
        assert math.hypot(*away) < 1e-8


def test_a_luneburg_lens_focuses_a_plane_wave_on_its_rim():
    """All rays pass the far end of the ball at tau = pi a / 2, with the same optical path from a plane before it."""
    a = 2.5
    field = Luneburg(a, (0.0, 0.0, a))
    x, y = (c.reshape(-1) for c in torch.meshgrid(*(torch.linspace(-1.6, 1.6, 9, dtype=D),) * 2, indexing="ij"))
    z = a - (a * a - x * x - y * y).sqrt()
    zero = torch.zeros_like(x)
    out = flow(field, None, (x, y, z), (zero, zero, zero + 1.0), torch.full_like(x, 0.5 * math.pi * a), 64, 6)
    for c, end in zip(out.point, (0.0, 0.0, 2.0 * a), strict=True):
        assert (c - end).abs().max() < 1e-9
    assert (out.path + z).std() < 1e-9


@pytest.mark.parametrize("order", WEIGHTS)
def test_the_order_of_the_methods(order):
    """By regression over steps, on the fish-eye; path lengths have it too."""
    field = FishEye(1.7, 2.0)
    q = real([1.0, -0.4], [0.2, 0.9], -0.5)
    p = launched(field, q, real([0.3, 0.1], 0.1, 1.0))
    t = torch.full((2,), 3.0, dtype=D)
    exact, steps = flow(field, None, q, p, t, 512, 6), [16, 32, 64, 128]

    def fitted(values) -> float:
        return -np.polyfit(np.log(steps), np.log(values), 1)[0]

    outs = [flow(field, None, q, p, t, n, order) for n in steps]
    for of in (lambda f: f.point[0], lambda f: f.momentum[2], lambda f: f.path, lambda f: f.length):
        found = fitted([float((of(out) - of(exact)).abs().max()) for out in outs])
        assert abs(found - order) < 0.35, (order, found)


def test_every_step_can_be_taken_back():
    field = volume((9, 8, 5))
    q, p = real([0.3, -2.0], [1.0, 2.0], 0.0), real([0.1, -0.2], [0.2, 0.0], 1.5)
    t = torch.tensor([2.0, 2.5], dtype=D)
    out = backend_for("cpu").flow(field, None, q, p, t, 7, 4)
    back = backend_for("cpu").flow(field, None, out.point, out.momentum, -t, 7, 4)
    assert max(float((a - b).abs().max()) for a, b in zip((*back.point, *back.momentum), (*q, *p), strict=True)) < 1e-13
    assert torch.allclose(back.path, -out.path, atol=1e-13) and torch.allclose(back.length, -out.length, atol=1e-13)


# Fields.


@pytest.mark.parametrize(
    "field",
    [
        Selfoc(1.6, 0.1),
        Radial(1.6, (-0.01, 2e-4)),
        Axial(1.5, (0.01, -2e-3)),
        FishEye(1.7, 9.0),
        Luneburg(8.0),
        volume((7, 6, 5)),
        volume((7, 6, 1)),
        volume((3, 2, 2)),
    ],
    ids=lambda f: type(f).__name__,
)
def test_the_force_is_half_the_gradient_of_the_square(field):
    generator = torch.Generator().manual_seed(3)
    q = [(4.0 * torch.rand(20, generator=generator, dtype=D) + o).requires_grad_() for o in (-2.0, -2.0, 0.0)]
    square, force = field.at(q)
    by_autograd = torch.autograd.grad(square.sum(), q, allow_unused=True)
    for f, g in zip(force, by_autograd, strict=True):
        assert torch.allclose(f, 0.5 * g if g is not None else torch.zeros_like(f), atol=1e-13)
    found = field.extremes((2.0, 2.0), 4.0)
    n = square.detach().sqrt()
    assert found.least <= float(n.min()) and float(n.max()) <= found.most
    assert float((sum(f.detach() ** 2 for f in force).sqrt() / n).max()) <= found.steepest


def test_a_volume_is_a_product_of_splines():
    """Against collocation matrices, within the box; beyond it along the tangent."""
    field = volume((7, 6, 5))
    u = torch.linspace(0.0, 1.0, 9, dtype=D)
    q = torch.meshgrid(10.0 * u - 5.0, 10.0 * u - 5.0, 4.0 * u, indexing="ij")
    by_matrix = torch.einsum("ai,bj,ck,ijk->abc", *(SplineSpace.uniform(n, 3).matrix(u) for n in (7, 6, 5)), field.coefficients)
    assert torch.allclose(field.index([c.reshape(-1) for c in q]).view(9, 9, 9), by_matrix, atol=1e-13)
    point = real([5.0, 6.0, 7.0], 1.0, 2.0)
    n = field.index(point)
    assert abs(float(n[2] - 2.0 * n[1] + n[0])) < 1e-13 and abs(float(n[1] - n[0])) > 1e-4


def test_what_is_no_field_is_refused():
    for kind, terms, values in (("selfoc", (), None), ("selfoc", (0.1, 0.2), None), ("radial", (), None), ("lens", (1.0,), None)):
        with pytest.raises(InputError, match="gradient"):
            Gradient(kind, terms, values)
    for wrong in (np.zeros((4, 4)), np.ones(4), np.full((4, 4), np.nan), np.ones((1, 4))):
        with pytest.raises(InputError, match="index_file"):
            Gradient("volume", (), wrong)
    with pytest.raises(InputError, match=r"0\.5"):
        Selfoc(1.5, 0.3).extremes((4.0, 4.0), 1.0)
    with pytest.raises(InputError, match="in front of"):
        System((PlaneWave(),), block(None, 4.0), object_space=GradientMedium(1.5, gradient=Axial(1.5, (0.1,))))


def test_rays_that_do_not_converge_are_refused():
    generator = torch.Generator().manual_seed(1)
    field, q = SplineIndex(1.5 + torch.rand((4, 4, 4), generator=generator, dtype=D), (0.01, 0.01), 0.01), real([1e-3], 0.0, 0.0)
    with pytest.raises(CausticError, match="converge"):
        steps_for(backend_for("cpu").flow, field, None, q, real([0.1], 0.0, 1.5), torch.full((1,), 5.0, dtype=D), 1e-15)


# The adjoint.


@pytest.mark.parametrize("shape", [(9, 8, 6), (9, 8, 1), (5, 3, 2)])
@pytest.mark.parametrize("order", [2, 4])
def test_kernel_reference_and_unrolled_steps_agree(shape, order):
    """Values and derivatives by coefficients, time and ray, of rays within the box and beyond it."""
    field, generator = volume(shape, 1), torch.Generator().manual_seed(2)
    spread = [10.5 * torch.rand(40, generator=generator, dtype=D) - 5.25 for _ in range(2)]
    p = [0.4 * torch.rand(40, generator=generator, dtype=D) - 0.2 for _ in range(2)]
    values = (
        field.coefficients,
        2.5 * torch.rand(40, generator=generator, dtype=D),
        *spread,
        0.5 * torch.rand(40, generator=generator, dtype=D),
        *p,
        torch.full((40,), 1.5, dtype=D),
    )

    def unrolled(_, c, q, p, t, steps, order):
        path, length, h = torch.zeros_like(t), torch.zeros_like(t), t / steps
        for _ in range(steps):
            for w in WEIGHTS[order]:
                q, path = drift(q, p, path, 0.5 * w * h)
                p, path, length = kick(field, c, q, p, path, length, w * h)
                q, path = drift(q, p, path, 0.5 * w * h)
        return q, p, path, length

    found = []
    for march in (unrolled, Torch().flow, backend_for("cpu").flow):
        c, t, *ray = leaves = [v.clone().requires_grad_() for v in values]
        q, p, path, length = march(field, c, tuple(ray[:3]), tuple(ray[3:]), t, 3, order)
        out = torch.stack([*q, *p, path, length])
        (out * torch.linspace(0.3, 1.7, out.numel(), dtype=D).view_as(out)).sum().backward()
        found.append([out.detach(), *(v.grad for v in leaves)])
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert float((a - b).abs().max()) <= 1e-12 * max(1.0, float(a.abs().max()))


FORMULAS = [Selfoc(1.6, 0.1), Radial(1.6, (-0.01, 2e-4)), Axial(1.5, (0.01, -2e-3))]


@pytest.mark.parametrize("field", FORMULAS, ids=lambda f: type(f).__name__)
def test_the_kernel_of_formulas_is_the_reference(field):
    generator = torch.Generator().manual_seed(2)
    values = [torch.rand(30, generator=generator, dtype=D) + o for o in (1.5, -0.5, -0.2, 0.0, -0.5, 0.0, 1.2)]
    found = []
    for march in (Torch().flow, backend_for("cpu").flow):
        t, *ray = leaves = [v.clone().requires_grad_() for v in values]
        q, p, path, length = march(field, None, tuple(ray[:3]), tuple(ray[3:]), t, 3, 4)
        out = torch.stack([*q, *p, path, length])
        (out * torch.linspace(0.3, 1.7, out.numel(), dtype=D).view_as(out)).sum().backward()
        found.append([out.detach(), *(v.grad for v in leaves)])
    for a, b in zip(*found, strict=True):
        assert float((a - b).abs().max()) <= 1e-12 * max(1.0, float(a.abs().max()))


def bumpy(source, tilt=(0.0, 0.0)):
    """A B-spline volume behind a flat entrance, a free-form exit, absorption, and 900 rays."""
    field, space = volume((8, 8, 4), 1), SplineSpace.uniform(8, 3)
    elements = (
        Element("entrance", Plane(), Aperture((5.0, 5.0)), behind=GradientMedium(1.5, 0.01, gradient=field)),
        Element("exit", HeightField((space, space), (5.0, 5.0)), Aperture((5.0, 5.0)), pose=Pose(tilt=tilt)),
    )
    system = System((source,), elements, (Screen((14.0, 14.0), 100.0, (8, 8)),))
    heights = 4.0 + 0.2 * torch.rand((8, 8), generator=torch.Generator().manual_seed(5), dtype=D)
    return system, field, heights, next(iter(rays_of(system, "stratified", 900).chunks()))


@pytest.mark.parametrize(
    ("source", "tilt"),
    [(PlaneWave(), (0.0, 0.0)), (Points(((0.5, 0.3, -40.0),)), (2.0, -1.0))],
    ids=["plane", "point"],
)
def test_taylor_through_the_system(source, tilt):
    """Of an image by index coefficients and by heights: the remainder is of second order; the light is accounted for."""
    system, field, heights, rays = bumpy(source, tilt)
    tracer, weights = Tracer(system, rays), torch.linspace(0.2, 1.9, 64, dtype=D).view(8, 8).sin()

    def value(c, h):
        return tracer.expose({"exit": h, "entrance.index": c}, system.screens[0], Filter("cosine", (3, 3)))

    c, h = field.coefficients.clone().requires_grad_(), heights.clone().requires_grad_()
    image = value(c, h)
    begun = (image.image * weights).sum()
    begun.backward()
    lost = sum(float(v) for v in image.lost.values())
    assert abs(float(image.image.detach().sum()) + lost - 1.0) < 1e-12
    generator = torch.Generator().manual_seed(7)
    for by, size in ((c, 2e-3), (h, 2e-2)):
        along = size * torch.randn(by.shape, generator=generator, dtype=D)
        slope, steps, rest = float((by.grad * along).sum()), (0.1, 0.03, 0.01, 0.003), []
        for e in steps:
            with torch.no_grad():
                moved = value(c + e * along, h) if by is c else value(c, h + e * along)
            rest.append(abs(float((moved.image * weights).sum() - begun.detach()) - e * slope))
        assert abs(np.polyfit(np.log(steps), np.log(rest), 1)[0] - 2.0) < 0.1, rest
        assert rest[-1] < 1e-2 * abs(steps[-1] * slope)


@pytest.mark.parametrize("field", [volume((9, 8, 6)), Selfoc(1.6, 0.3), FishEye(1.7, 4.0)], ids=lambda f: type(f).__name__)
def test_forward_mode_is_the_transpose_of_the_adjoint(field):
    """<y, J t> = <J' y, t> for random y and t, by all that an integration depends on."""
    generator = torch.Generator().manual_seed(3)

    def random(count):
        return [0.3 * torch.randn(40, generator=generator, dtype=D) for _ in range(count)]

    point, time = random(3), 1.5 + random(1)[0]
    inputs = [*point, *launched(field, point, [*random(2), torch.ones(40, dtype=D)]), time]
    tangents, y = random(7), random(8)
    c = None if field.shape is None else field.coefficients
    free = [] if c is None else [c]
    along = [0.1 * torch.randn(v.shape, generator=generator, dtype=D) for v in free]

    def ends(values):
        out = flow(field, values[7] if c is not None else None, values[:3], values[3:6], values[6], 4)
        return [*out.point, *out.momentum, out.path, out.length]

    leaves = [v.clone().requires_grad_() for v in (*inputs, *free)]
    pulled = torch.autograd.grad(ends(leaves), leaves, y)
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(v, t) for v, t in zip((*inputs, *free), (*tangents, *along), strict=True)]
        pushed = [forward_ad.unpack_dual(v).tangent for v in ends(duals)]
    left = sum(float((a * b).sum()) for a, b in zip(y, pushed, strict=True))
    right = sum(float((a * b).sum()) for a, b in zip(pulled, (*tangents, *along), strict=True))
    assert left == pytest.approx(right, rel=1e-11)


# In a system.


@pytest.mark.parametrize("fresnel", ["exact", "schlick"])
def test_a_volume_of_one_index_is_glass(fresnel):
    """The image, the losses and the paths of a homogeneous lens."""
    system, _, heights, _ = bumpy(Points(((0.5, 0.3, -40.0),)), (2.0, -1.0))
    made = []
    for gradient in (None, SplineIndex(torch.full((5, 5, 4), 1.5, dtype=D), (5.0, 5.0), 4.0)):
        behind = medium(1.5, 0.01, gradient)
        first = Element("entrance", Plane(), Aperture((5.0, 5.0)), behind=behind, fresnel=fresnel)
        last = Element("exit", system.elements[1].surface, Aperture((5.0, 5.0)), pose=Pose(tilt=(2.0, -1.0)), fresnel=fresnel)
        (image,) = render(System(system.sources, (first, last), system.screens), {"exit": heights}, 3000)
        made.append(image)
    assert torch.allclose(made[0].image, made[1].image, atol=1e-9)
    assert all(abs(made[0].lost[k] - made[1].lost[k]) < 1e-9 for k in made[0].lost)


def test_a_wavelength_scales_the_field():
    """A glass' other index at another wavelength: the way within is the same, refraction and path are not."""
    glass = "N-BK7"
    index = Medium(1.5, glass=glass).index_at(587.5618)
    _, back = block(None, 10.0)
    behind = GradientMedium(index, glass=glass, gradient=Radial(index, (-2e-3,)))
    elements = (Element("entrance", Plane(), Aperture((5.0, 5.0)), behind=behind), back)
    system = System((PlaneWave(),), elements, (Screen((9.0, 9.0), 12.0),))
    x, zero = real([1.0, 3.0], 0.0)
    rays = RayState((x, zero, zero), (zero, zero, zero + 1.0), torch.ones_like(x))
    d, blue = (Tracer(system, rays, wavelength=w)({})[0] for w in (587.5618, 440.0))
    ratio = Medium(1.5, glass=glass).index_at(440.0) / index
    assert torch.allclose(blue.origin[0], d.origin[0], atol=1e-12) and ratio > 1.005
    assert torch.allclose(blue.direction[0], ratio * d.direction[0], atol=1e-12)
    assert torch.allclose(blue.path, ratio * d.path, rtol=1e-12)


def test_ghosts_go_back_through_the_gradient():
    """An axial gradient turns no ray of a plane wave: the ghost has the reflectances at the index of each side."""
    elements = block(Axial(1.5, (0.05,)), 4.0)
    system = System((PlaneWave(),), elements, (Screen((9.0, 9.0), 12.0),))
    x, zero = real([1.0, 3.0], 0.0)
    rays = RayState((x, zero, zero), (zero, zero, zero + 1.0), torch.ones_like(x))
    straight, ghost = Tracer(system, rays, requests=Requests.to("ghosts"))({})
    front, back = ((n - 1.0) ** 2 / (n + 1.0) ** 2 for n in (1.5, 1.7))
    assert torch.allclose(straight.power, torch.full_like(x, (1 - front) * (1 - back)), atol=1e-12)
    assert torch.allclose(ghost.power, torch.full_like(x, (1 - front) * back * front * (1 - back)), atol=1e-9)
