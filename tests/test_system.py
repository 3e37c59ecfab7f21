"""Systems that no one-lens scene can say: against closed forms, against `sequential`, energy, and derivatives of every surface."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from parametric import Surface as ParametricSurface
from sequential import onto, walk
from torch.autograd import forward_ad

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.effects import EFFECTS, Requests
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.media import Medium
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces import HeightField, Plane, Sphere
from caustic_cli.optics.surfaces.nurbs import Nurbs
from caustic_cli.optics.system import Element, PlacedScreen, System
from caustic_cli.optics.trace import Tracer, render, trace
from caustic_cli.scene import Aperture, CircularAperture, Light, PlaneWave, Points, Screen

pytestmark = pytest.mark.usefixtures("kernels")

N, FLINT = 1.5, 1.7
GLASS, DENSE = Medium(N), Medium(FLINT)
FIELD = HeightField((SplineSpace.uniform(8, 3), SplineSpace.uniform(7, 2)), (5.0, 5.0))
WIDE = HeightField(FIELD.spaces, (9.0, 9.0))
FLAT = Aperture((5.0, 5.0))
SCREEN = Screen((30.0, 30.0), 60.0, (20, 20))


def parabola(field: HeightField, radius: float, height: float = 0.0) -> torch.Tensor:
    """Heights of z = height + r^2 / (2 radius), which a spline of degree 2 and more is exactly."""
    x, y = field.control_xy()
    at = [torch.linalg.inv(s.matrix(s.greville)) for s in field.spaces]
    return at[0] @ (height + (x[:, None] ** 2 + y[None, :] ** 2) / (2.0 * radius)) @ at[1].T


def bumpy(field: HeightField, size: float, seed: int) -> torch.Tensor:
    return size * torch.randn(field.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def in_numpy(surface, heights):
    """A surface as a function of NumPy points in its own frame."""
    return lambda x, y: surface.at(heights, *(torch.from_numpy(np.ascontiguousarray(c)) for c in (x, y)), ((0, 0),))[0].numpy()


def ray(x: float, y: float = 0.0, z: float = -1.0) -> RayState:
    """One ray along +z."""
    here, none = torch.tensor([x], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    return RayState((here, here * 0 + y, z), (none, none, none + 1.0), none + 1.0)


def biconvex(r1: float, r2: float, thickness: float, **options) -> tuple[System, dict]:
    back = Element("back", WIDE, Aperture((9.0, 9.0)), pose=Pose((0, 0, thickness)))
    elements = (Element("front", FIELD, FLAT, behind=GLASS), back)
    return System((PlaneWave(),), elements, (SCREEN,), **options), {"front": parabola(FIELD, r1), "back": parabola(WIDE, r2)}


# The six systems


def test_focal_length_of_a_biconvex_singlet():
    """1 / f = (n - 1) (1/R1 - 1/R2 + (n - 1) t / (n R1 R2)), by rays 1 um off the axis (third order: (h / f)^2 = 1e-9)."""
    for r1, r2, t in ((40.0, -60.0, 4.0), (25.0, -25.0, 8.0), (-30.0, 50.0, 2.0)):
        system, heights = biconvex(r1, r2, t)
        h = 1e-3
        (out,) = trace(system, ray(h), heights)
        power = (N - 1) * (1 / r1 - 1 / r2 + (N - 1) * t / (N * r1 * r2))
        focal = -h / float(out.direction[0] / out.direction[2])
        assert focal * power == pytest.approx(1.0, abs=1e-6)
        back = -float(out.origin[0] * out.direction[2] / out.direction[0])  # from where it leaves to the axis
        assert back * power == pytest.approx(1 - (N - 1) * t / (N * r1), abs=1e-6)


def prism_and_lens(apex: float = 12.0) -> tuple[System, dict]:
    """A wedge, its first side upright, then a planoconvex lens of 40 mm focal length."""
    elements = (
        Element("upright", Plane(), Aperture((3.0, 3.0)), behind=DENSE),
        Element("wedge", Plane(), Aperture((9.0, 9.0)), pose=Pose((0, 0, 4.0), (0.0, apex))),
        Element("front", WIDE, Aperture((9.0, 9.0)), behind=GLASS, pose=Pose((0, 0, 10.0))),
        Element("back", Plane(), Aperture((20.0, 20.0)), pose=Pose((0, 0, 14.0))),
    )
    return System((PlaneWave(),), elements, (Screen((40.0, 40.0), 50.0, (20, 20)),)), {"front": parabola(WIDE, 20.0)}


def test_a_lens_behind_a_prism():
    """The prism turns light by asin(n sin A) - A; a lens brings parallel light together at f tan of that, paraxially."""
    apex = 3.0
    system, heights = prism_and_lens(apex)
    turn = math.asin(FLINT * math.sin(math.radians(apex))) - math.radians(apex)
    rays = ray(0.0)
    behind = Tracer(system, rays).start
    direction = [float(torch.as_tensor(c)) for c in behind.direction]
    assert math.atan2(abs(direction[0]), direction[2]) == pytest.approx(turn, abs=1e-13)
    focus = 14.0 + 40.0 - 4.0 / N  # from the back side, of a lens that is flat there
    points = [Tracer(system, ray(x)).land(heights, Screen((1.0, 1.0), focus))[0].origin[0] for x in (-1e-3, 1e-3)]
    assert abs(float(points[0] - points[1])) < 2e-3 * 0.02
    assert abs(float(points[0])) == pytest.approx(40.0 * math.tan(turn), rel=0.01)


def test_a_folding_mirror_behind_a_lens():
    """Light that a mirror of 45 degrees turns to -x lands where it would have landed without, on a screen as far away."""
    front = Element("front", FIELD, FLAT, behind=GLASS)
    back = Element("back", Plane(), Aperture((9.0, 9.0)), pose=Pose((0, 0, 4.0)))
    mirror = Element("fold", Plane(), Aperture((30.0, 30.0)), "reflect", pose=Pose((0, 0, 20.0), (0.0, 45.0)))
    heights = {"front": parabola(FIELD, 30.0) + bumpy(FIELD, 0.02, 1)}
    straight = System((PlaneWave(),), (front, back), (Screen((30.0, 30.0), 60.0, (20, 20)),))
    turned = PlacedScreen(Screen((30.0, 30.0), 0.0, (20, 20)), Pose((-40.0, 0.0, 20.0), (0.0, -90.0)))
    folded = System((PlaneWave(),), (front, back, mirror), (turned,))
    assert folded.axis == pytest.approx((-1.0, 0.0, 0.0), abs=1e-15)
    (sample,) = Sampler("stratified", (20, 20), 1).chunks()
    (a,), (b,) = Tracer(straight, sample).land(heights, straight.screens[0]), Tracer(folded, sample).land(heights, turned)
    torch.testing.assert_close(b.origin[0].abs(), a.origin[0].abs(), rtol=0, atol=1e-11)
    torch.testing.assert_close(b.origin[1], a.origin[1], rtol=0, atol=1e-11)
    torch.testing.assert_close(b.power, a.power, rtol=0, atol=1e-15)
    (one,), (two,) = render(straight, heights, 4000), render(folded, heights, 4000)
    image = two.image if float((two.image - one.image).abs().sum()) < 1e-12 else two.image.flip(0)
    torch.testing.assert_close(image, one.image, rtol=0, atol=1e-14)


def doublet() -> tuple[System, dict]:
    """A cemented pair, then a singlet 15 mm behind: three media, five surfaces, four of them free."""

    def at(z):
        return Pose((0.0, 0.0, z))

    elements = (
        Element("one", FIELD, FLAT, behind=GLASS),
        Element("two", WIDE, Aperture((9.0, 9.0)), behind=DENSE, pose=at(5.0)),
        Element("three", WIDE, Aperture((9.0, 9.0)), pose=at(7.0)),
        Element("four", WIDE, Aperture((9.0, 9.0)), behind=GLASS, pose=at(22.0)),
        Element("five", Sphere(-70.0), CircularAperture((9.0, 9.0)), pose=at(26.0)),
    )
    heights = {
        "one": parabola(FIELD, 45.0),
        "two": parabola(WIDE, -40.0),
        "three": parabola(WIDE, -150.0),
        "four": parabola(WIDE, 90.0),
    }
    return System((PlaneWave(),), elements, (Screen((12.0, 12.0), 50.0, (20, 20)),)), heights


def test_two_lenses_in_line():
    """Height and angle of a ray 1 um off the axis, by matrices of paraxial optics with the index of every medium."""
    system, heights = doublet()
    vector = np.array([1e-3, 0.0])
    for radius, n_in, n_out, gap in (
        (45.0, 1.0, N, 5.0),
        (-40.0, N, FLINT, 2.0),
        (-150.0, FLINT, 1.0, 15.0),
        (90.0, 1.0, N, 4.0),
        (-70.0, N, 1.0, 0.0),
    ):
        vector = np.array([[1, gap], [0, 1]]) @ np.array([[1, 0], [(n_in - n_out) / (n_out * radius), n_in / n_out]]) @ vector
    (out,) = trace(system, ray(1e-3), heights)
    assert float(out.origin[0]) == pytest.approx(vector[0], rel=1e-7)
    assert float(out.direction[0] / out.direction[2]) == pytest.approx(vector[1], rel=1e-6)
    assert [m.index for m in system.media()] == [1.0, N, FLINT, 1.0, N, 1.0]


def tilted() -> tuple[System, dict]:
    """A lens turned about both axes and moved off the axis; its back is a B-spline too."""
    pose, behind = Pose((0.3, -0.2, 0.0), (8.0, -11.0)), Pose((0.3, -0.2, 5.0), (8.0, -11.0))
    elements = (
        Element("front", WIDE, Aperture((9.0, 9.0)), behind=GLASS, pose=pose),
        Element("back", HeightField(WIDE.spaces, (12.0, 12.0)), Aperture((12.0, 12.0)), pose=behind),
    )
    heights = {
        "front": parabola(WIDE, 35.0) + bumpy(WIDE, 0.02, 3),
        "back": parabola(elements[1].surface, -50.0) + bumpy(WIDE, 0.02, 4),
    }
    return System((PlaneWave(),), elements, (SCREEN,)), heights


@pytest.mark.parametrize(
    "make", [lambda: biconvex(40.0, -60.0, 4.0), prism_and_lens, doublet, tilted], ids=["biconvex", "prism", "two lenses", "tilted"]
)
def test_rays_against_an_independent_tracer(make):
    """Landing points to 1e-7 mm and optical path lengths to 1e-9: normals by differences across the knots of a quadratic leave
    that."""
    system, heights = make()
    (rx, ry), rng = system.pupil.half_size, np.random.default_rng(2)
    x, y = (rng.uniform(-0.4 * r, 0.4 * r, 60) for r in (rx, ry))
    z = system.pupil.z - 10.0
    t = torch.from_numpy
    state = RayState((t(x), t(y), z), (0.0, 0.0, 1.0), torch.ones(60, dtype=torch.float64))
    traced = Tracer(system, state, track=True)
    (out,), (landed,) = traced(heights), traced.land(heights, system.screens[0])
    indices = [m.index for m in system.media()]
    elements = []
    for k, e in enumerate(system.elements):
        what = ("reflect",) if e.reflects else (indices[k], indices[k + 1])
        elements.append((in_numpy(e.surface, heights.get(e.name)), e.pose.position, e.pose.tilt, *what))
    o, d, path = walk(np.stack([x, y, np.full(60, z)], 1), np.tile([0.0, 0.0, 1.0], (60, 1)), elements)
    assert bool((landed.statuses() == 0).all())
    found = np.stack([c.numpy() for c in landed.origin[:2]], 1)
    np.testing.assert_allclose(found, onto(o, d, (0, 0, system.screens[0].z)), atol=1e-7)
    np.testing.assert_allclose(out.path.numpy(), path, atol=1e-9)


def test_two_screens_at_once():
    """Rays are walked once; each screen has the image that it has alone, and an account that closes."""
    system, heights = biconvex(40.0, -60.0, 4.0)
    near, far = Screen((12.0, 12.0), 20.0, (16, 16)), Screen((12.0, 12.0), 90.0, (24, 24), (5.0, 0.0), (0.5, 0.0))
    both = render(System(system.sources, system.elements, (near, far)), heights, 3000)
    for screen, image in zip((near, far), both, strict=True):
        (alone,) = render(System(system.sources, system.elements, (screen,)), heights, 3000)
        assert torch.equal(alone.image, image.image)
        assert float(image.image.sum()) + sum(image.lost.values()) == pytest.approx(1.0, abs=1e-12)
    assert both[0].image.shape != both[1].image.shape


# Energy, effects, derivatives


SYSTEMS = {"biconvex": lambda: biconvex(40.0, -60.0, 4.0), "prism": prism_and_lens, "two lenses": doublet, "tilted": tilted}


def folded() -> tuple[System, dict]:
    """A lens, a B-spline mirror of 45 degrees, and a screen at its side."""
    elements = (
        Element("front", FIELD, FLAT, behind=Medium(N, 0.01), roughness=0.001),
        Element("back", WIDE, Aperture((9.0, 9.0)), pose=Pose((0, 0, 4.0))),
        Element(
            "fold", HeightField(FIELD.spaces, (12.0, 12.0)), Aperture((12.0, 12.0)), "reflect", pose=Pose((0, 0, 20.0), (0.0, 45.0))
        ),
    )
    heights = {
        "front": parabola(FIELD, 30.0),
        "back": parabola(WIDE, -45.0),
        "fold": bumpy(FIELD, 0.02, 5) + parabola(elements[2].surface, 400.0),
    }
    aside = PlacedScreen(Screen((20.0, 20.0), 0.0, (20, 20)), Pose((-40.0, 0, 20.0), (0, -90.0)))
    return System((PlaneWave(),), elements, (aside,)), heights


SYSTEMS["folded"] = folded


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.2, -0.1, -60.0),))], ids=["plane", "point"])
def test_energy_closes(name, source):
    """Image + losses = 1 to 1e-12, with ghosts, secondary intersections and polarisation too."""
    system, heights = SYSTEMS[name]()
    for light, requests in (
        (Light(), Requests()),
        (Light(30.0), Requests()),
        (Light(), Requests.to("ghosts", "secondary-intersection")),
    ):
        lit = System((source,), system.elements, system.screens, light)
        (image,) = render(lit, heights, 2000, Filter("cosine", (3, 3)), requests=requests)
        assert bool(torch.isfinite(image.image).all())
        assert float(image.image.sum()) + sum(image.lost.values()) == pytest.approx(1.0, abs=1e-12)
        assert float(image.image.sum()) > 0.05
        assert image.lost["fresnel"] > 0.02 * (1.0 - image.lost["missed_lens"])


def test_several_sources_and_wavelengths_add_up():
    """Two sources of powers 1 and 3 at two wavelengths: the sum of four images, weighted."""
    system, heights = biconvex(40.0, -60.0, 4.0)
    elements = tuple(
        Element(e.name, e.surface, e.aperture, behind=Medium(1.5, glass="N-BK7") if k == 0 else e.behind, pose=e.pose)
        for k, e in enumerate(system.elements)
    )
    light, point = Light(wavelengths=(450.0, 650.0), weights=(1.0, 2.0)), Points(((0.0, 1.0, -80.0),), (3.0,))
    (whole,) = render(System((PlaneWave(1.0), point), elements, (SCREEN,), light), heights, 1000)
    parts = 0.0
    for source, power in ((PlaneWave(1.0), 0.25), (point, 0.75)):
        for line, weight in ((450.0, 1 / 3), (650.0, 2 / 3)):
            (one,) = render(System((source,), elements, (SCREEN,), Light(wavelengths=(line,))), heights, 1000)
            parts = parts + power * weight * one.image
    torch.testing.assert_close(whole.image, parts, rtol=0, atol=1e-15)
    assert float(whole.image.sum()) + sum(whole.lost.values()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("stray", [False, True])
def test_gradients_of_every_surface(name, stray):
    """Taylor's remainder falls with the square of the step; reverse mode is the transpose of forward mode."""
    if stray and name not in ("biconvex", "tilted"):
        pytest.skip("a folded or cemented path's ghosts are tested for their energy")
    system, heights = SYSTEMS[name]()
    (sample,) = Sampler("stratified", (25, 20), 3).chunks()
    traced = Tracer(system, sample, requests=Requests.to("ghosts") if stray else Requests())
    screen, filter = system.screens[0], Filter("cosine", (9, 9))
    g = torch.Generator().manual_seed(1)
    by = torch.randn((20, 20), generator=g, dtype=torch.float64)
    for free in (*heights, None):  # each surface alone, then all together
        along = {k: (free in (k, None)) * torch.randn(h.shape, generator=g, dtype=torch.float64) for k, h in heights.items()}

        def value(p) -> torch.Tensor:
            part = traced.expose(p, screen, filter)
            return (part.image * by).sum() + 3.0 * part.leaving

        leaves = {k: h.clone().requires_grad_() for k, h in heights.items()}
        gradients = torch.autograd.grad(value(leaves), list(leaves.values()))
        slope = sum(float((a * b).sum()) for a, b in zip(gradients, along.values(), strict=True))
        with forward_ad.dual_level():
            dual = {k: forward_ad.make_dual(h, along[k]) for k, h in heights.items()}
            forward = float(forward_ad.unpack_dual(value(dual)).tangent)
        size = sum(float(a.norm() * b.norm()) for a, b in zip(gradients, along.values(), strict=True))
        assert abs(forward - slope) <= 1e-10 * size
        with torch.no_grad():
            here, steps = float(value(heights)), (2e-5, 1e-5, 5e-6)
            rest = [abs(float(value({k: h + e * along[k] for k, h in heights.items()})) - here - e * slope) for e in steps]
        orders = [math.log2(a / b) for a, b in pairwise(rest)]
        assert all(1.8 < o < 2.2 for o in orders) or max(rest) < 1e-9 * size * steps[0], (free, rest)


def test_polarised_light_through_two_surfaces():
    """Crossed polarisations average to what tracks both; a Brewster plate lets p pass whole."""
    brewster = math.degrees(math.atan(N))
    plate = tuple(
        Element(
            name,
            Plane(),
            Aperture((5.0, 5.0) if name == "in" else (30.0, 30.0)),
            behind=behind,
            pose=Pose((0.0, 0.0, z), (0.0, brewster)),
        )
        for name, behind, z in (("in", GLASS, 0.0), ("out", Medium(), 4.0))
    )
    for angle, passed in ((0.0, 1.0), (90.0, 1.0 - ((N * N - 1) / (N * N + 1)) ** 2)):
        system = System((PlaneWave(),), plate, (SCREEN,), Light(angle))
        (out,) = trace(system, ray(0.0), {})
        assert float(out.power) == pytest.approx(passed**2, rel=1e-12)


def test_ghosts_of_three_surfaces():
    """A plane-parallel plate behind another: the six pairs of surfaces return R^2 (1 - R)^k of the light."""
    elements = tuple(
        Element(f"{k}", Plane(), FLAT, behind=GLASS if k % 2 == 0 else Medium(), pose=Pose((0, 0, 3.0 * k))) for k in range(4)
    )
    system, r = System((PlaneWave(),), elements, (SCREEN,)), 0.04
    straight, *ghosts = trace(system, ray(0.0), {}, requests=Requests.to("ghosts"))
    assert float(straight.power) == pytest.approx((1 - r) ** 4, rel=1e-12)
    assert len(ghosts) == 6
    expected = [r * r * (1 - r) ** (4 + 2 * (j - i - 1)) for j in range(4) for i in range(j - 1, -1, -1)]
    assert [float(s.power) for s in ghosts] == pytest.approx(expected, rel=1e-12)


# Surfaces


def test_a_sphere_by_its_closed_form_is_the_general_search():
    """`Sphere.meet` against the search that any surface has, from both sides."""
    g = np.random.default_rng(0)
    for radius in (30.0, -22.0, 1e7):
        for side in (1.0, -1.0):
            o = [torch.from_numpy(g.uniform(-3, 3, 200)) for _ in range(2)] + [torch.full((200,), -side * 8.0, dtype=torch.float64)]
            lean = [torch.from_numpy(g.uniform(-0.3, 0.3, 200)) for _ in range(2)]
            d = [*lean, side * torch.sqrt(1 - lean[0] ** 2 - lean[1] ** 2)]
            sphere = Sphere(radius, reach=9.0)
            closed, searched = sphere.intersect(None, o, d, side), super(Sphere, sphere).intersect(None, o, d, side)
            both = closed.valid & searched.valid
            assert int(both.sum()) > 150
            for a, b in zip(closed[:3], searched[:3], strict=True):
                torch.testing.assert_close(a[both], b[both], rtol=0, atol=1e-12)


def test_nurbs_are_the_parametric_surface_and_b_splines_with_equal_weights():
    """Values and derivatives against `bspline.Surface`; a lens of equal weights is the B-spline's lens."""
    weights = 1.0 + 0.5 * torch.rand(FIELD.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    heights, surface = bumpy(FIELD, 0.3, 1), Nurbs(FIELD, weights)
    u, v = torch.rand(2, 50, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    x, y = 10.0 * u - 5.0, 10.0 * v - 5.0
    whole = ParametricSurface(FIELD.spaces, heights[..., None], weights)
    orders = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    for (a, b), found in zip(orders, surface.at(heights, x, y, orders), strict=True):
        torch.testing.assert_close(found, whole.evaluate(u, v, a, b)[:, 0] / 10.0 ** (a + b), rtol=1e-11, atol=1e-12)
    bounds = surface.slope_bounds(heights)
    assert all(float(s.abs().max()) <= b for s, b in zip(surface.at(heights, x, y)[1:], bounds, strict=True))

    def system(front):
        back = Element("back", Plane(), Aperture((9.0, 9.0)), pose=Pose((0, 0, 4.0)))
        return System((PlaneWave(),), (Element("front", front, FLAT, behind=GLASS), back), (SCREEN,))

    lens = {"front": parabola(FIELD, 40.0) + 0.05 * heights}
    (plain,), (equal,), (bent,) = (
        render(system(s), lens, 2000, Filter("cosine", (3, 3)))
        for s in (FIELD, Nurbs(FIELD, torch.full(FIELD.shape, 2.0)), surface)
    )
    torch.testing.assert_close(equal.image, plain.image, rtol=0, atol=1e-12)
    assert float((bent.image - plain.image).abs().sum()) > 1e-3
    assert float(bent.image.sum()) + sum(bent.lost.values()) == pytest.approx(1.0, abs=1e-12)


def test_gradient_of_a_nurbs():
    weights = 1.0 + 0.5 * torch.rand(FIELD.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    back = Element("back", Plane(), Aperture((9.0, 9.0)), pose=Pose((0, 0, 4.0)))
    system = System((PlaneWave(),), (Element("front", Nurbs(FIELD, weights), FLAT, behind=GLASS), back), (SCREEN,))
    heights, along = parabola(FIELD, 40.0), bumpy(FIELD, 1.0, 7)
    (sample,) = Sampler("stratified", (20, 20), 3).chunks()
    traced, by = Tracer(system, sample), torch.linspace(-1, 1, 400, dtype=torch.float64).view(20, 20) ** 2

    def value(h):
        return (traced.expose({"front": h}, SCREEN, Filter("cosine", (5, 5))).image * by).sum()

    leaf = heights.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    step = 1e-6
    difference = float(value(heights + step * along) - value(heights - step * along)) / (2 * step)
    assert float((gradient * along).sum()) == pytest.approx(difference, rel=1e-6)


def test_a_wavelength_at_every_medium():
    """A glass between two indices: Snell's law at each wavelength, and none where the medium has one index."""
    elements = (
        Element("in", Plane(), FLAT, behind=Medium(1.5, glass="N-SF11"), pose=Pose((0, 0, 0), (0.0, 20.0))),
        Element("out", Plane(), Aperture((30.0, 30.0)), behind=Medium(1.33), pose=Pose((0, 0, 5.0))),
    )
    system = System((PlaneWave(),), elements, (SCREEN,))
    for line in (450.0, 650.0, None):
        (out,) = trace(system, ray(0.0), {}, wavelength=line)
        n = elements[0].behind.index_at(line)
        inside = math.radians(20.0) - math.asin(math.sin(math.radians(20.0)) / n)
        assert abs(float(torch.as_tensor(out.direction[0]))) == pytest.approx(n * math.sin(inside) / 1.33, rel=1e-12)


def test_bad_systems_are_refused_in_a_sentence():
    with pytest.raises(InputError, match="at least one source"):
        System((), (Element("a", Plane(), FLAT),))
    with pytest.raises(InputError, match="unique names"):
        System((PlaneWave(),), (Element("a", Plane(), FLAT), Element("a", Plane())))
    with pytest.raises(InputError, match="must have an aperture"):
        System((PlaneWave(),), (Element("a", Plane()),))
    with pytest.raises(InputError, match="b must face the light"):
        System((PlaneWave(),), (Element("a", Plane(), FLAT), Element("b", Plane(), pose=Pose((0, 0, 5.0), (90.0, 0.0)))))
    with pytest.raises(InputError, match="heights must be"):
        render(biconvex(40.0, -60.0, 4.0)[0], {}, 10)
    with pytest.raises(InputError, match="refract, reflect"):
        Element("a", Plane(), interaction="absorb")
    assert len({effect.name for effect in EFFECTS}) == len(EFFECTS)


@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.0, 0.0, -50.0),))])
def test_an_absorbing_medium_in_front_of_the_pupil(source):
    """Powers are those on the pupil, so that a medium in front of a first plane element there absorbs nothing."""
    elements = (
        Element("in", Plane(), Aperture((5.0, 5.0)), behind=GLASS),
        Element("out", Plane(), Aperture((6.0, 6.0)), pose=Pose((0.0, 0.0, 4.0))),
    )
    clear = System((source,), elements, (Screen((20.0, 20.0), 100.0),))
    (without,), (image,) = (render(s, {}, 1000) for s in (clear, replace(clear, object_space=Medium(1.0, 0.1))))
    assert torch.equal(image.image, without.image) and image.lost == without.lost
