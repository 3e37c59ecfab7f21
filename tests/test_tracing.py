"""The whole path: closed forms, the energy balance, symmetries, precision, and derivatives of the image."""

import gc
import math
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as fwd
from helpers import looked_up_in, pairwise
from scipy.interpolate import BSpline

from caustic_cli.errors import InputError
from caustic_cli.optics.rays import LOSSES, RayState, RayStatus
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SAMPLERS, Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.schema.table import TABLE

FRESNEL = TABLE["lens.fresnel"].choices

pytestmark = pytest.mark.usefixtures("kernels")

FILTERS = (Filter(), Filter("gaussian", (3, 5), (1.0, 0.2)), Filter("cosine", (5, 3)))


def scene_of(fresnel: str = "exact", control=(9, 7), degree=(3, 2), screen=(12.0, 9.0), resolution=(16, 11), index=1.5) -> Scene:
    """A 10 x 8 mm lens 3 mm thick, 60 mm before a screen somewhat larger than its footprint."""
    lens = Lens((10.0, 8.0), 0.0, index, control, degree, offset=Offset(3.0), fresnel=fresnel)
    return Scene(PlaneWave(), lens, Screen(screen, 60.0, resolution))


def heights_of(scene: Scene, bumps: float, seed: int = 0) -> torch.Tensor:
    """Random heights of standard deviation `bumps` mm about the thickness."""
    g = torch.Generator().manual_seed(seed)
    return 3.0 + bumps * torch.randn(scene.lens.control, generator=g, dtype=torch.float64)


def single_sample(kind: str, shape: tuple[int, int], seed: int = 0):
    (sample,) = Sampler(kind, shape, seed).chunks()
    return sample


def land(scene: Scene, heights: torch.Tensor, sample, dtype=torch.float64) -> RayState:
    """Rays on the screen, (N,): by the stages of the device's backend."""
    (state,) = Tracer(System.of(scene, HeightField.of(scene.lens)), sample, dtype, track=True).land({EXIT: heights}, scene.screen)
    return state


def place(state: RayState, sample) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays landed, in the shape of their sample."""
    return state.origin[0].view(sample.shape), state.origin[1].view(sample.shape)


def closed_form(scene: Scene, heights: torch.Tensor, u: np.ndarray, v: np.ndarray):
    """M(x0) = x0 + (n - S) / (n |g|^2 + S) (z_screen - f) g (erratum E1) over pairs u, v, and S^2; with SciPy's splines."""
    (rx, ry), (p, q), n = scene.lens.half_size, scene.lens.degree, scene.lens.index
    knots = [s.knots.numpy() for s in HeightField.of(scene.lens).spaces]
    along = [BSpline(t, np.eye(len(t) - k - 1), k) for t, k in zip(knots, (p, q), strict=True)]
    f = np.einsum("ki,ij,kj->k", along[0](u), heights.numpy(), along[1](v))
    gx = np.einsum("ki,ij,kj->k", along[0](u, 1), heights.numpy(), along[1](v)) / (2 * rx)
    gy = np.einsum("ki,ij,kj->k", along[0](u), heights.numpy(), along[1](v, 1)) / (2 * ry)
    g2 = gx * gx + gy * gy
    square = 1 - (n * n - 1) * g2
    s = np.sqrt(np.maximum(square, 0))
    factor = (n - s) / (n * g2 + s) * (scene.screen.z - f)
    return (2 * u - 1) * rx + factor * gx, (2 * v - 1) * ry + factor * gy, square


SURFACES = [((3, 3), 1.5443, 0.2), ((1, 4), 1.5, 0.3), ((7, 5), 2.4, 0.1), ((3, 3), 1.5, 1.0)]


@pytest.mark.parametrize("kind", ["lines", "stratified"])
@pytest.mark.parametrize(("degree", "index", "bumps"), SURFACES)
def test_landing_points_are_the_closed_form(kind, degree, index, bumps):
    """1e-10 mm after 300 mm: slopes carry 1e-15, times the throw, divided by S > 0.03 twice.  The last case reflects a part."""
    lens = Lens((10.0, 8.0), 0.0, index, (12, 10), degree, offset=Offset(3.0))
    scene = Scene(PlaneWave(), lens, Screen((20.0, 20.0), 300.0, (10, 10)))
    checked = 0
    for seed in range(3):
        heights = heights_of(scene, bumps, seed)
        sample = single_sample(kind, (40, 30), seed)
        u, v = (
            (a.reshape(-1).numpy() for a in torch.meshgrid(sample.u, sample.v, indexing="ij"))
            if sample.tensor
            else (sample.u.numpy(), sample.v.numpy())
        )
        x, y, square = closed_form(scene, heights, u, v)
        landing = land(scene, heights, sample)
        status = landing.statuses().numpy()
        clear = np.abs(square) > 1e-3
        np.testing.assert_array_equal(status[clear], np.where(square > 0, RayStatus.OK, RayStatus.TOTAL_INTERNAL_REFLECTION)[clear])
        keep = clear & (square > 0)
        np.testing.assert_allclose(landing.origin[0].numpy()[keep], x[keep], rtol=0, atol=1e-10)
        np.testing.assert_allclose(landing.origin[1].numpy()[keep], y[keep], rtol=0, atol=1e-10)
        checked += int(keep.sum())
        assert bumps < 1 or int((~keep).sum()) > 100
    assert checked > 1000


def test_flat_lens_is_a_window():
    """Light goes straight on: a picture of the aperture; Fresnel's two surfaces take R, then (1 - R) R."""
    scene = scene_of()
    sample = single_sample("lines", (20, 15))
    landing = land(scene, heights_of(scene, 0.0), sample)
    x, y = place(landing, sample)
    torch.testing.assert_close(x, (10 * sample.u - 5)[:, None].expand(20, 15), rtol=0, atol=1e-12)
    torch.testing.assert_close(y, (8 * sample.v - 4)[None, :].expand(20, 15), rtol=0, atol=1e-12)
    r = 0.04  # ((1.5 - 1) / (1.5 + 1))^2
    assert float(landing.leaving) == pytest.approx((1 - r) ** 2, rel=1e-13)
    assert float(landing.lost["fresnel"]) == pytest.approx(r + (1 - r) * r, rel=1e-13)


@pytest.mark.parametrize("slope", [0.1, -0.4, 0.75, 1.2])
def test_prism_by_trigonometry(slope):
    """A plane exit surface turns every ray by b - a, n sin a = sin b, and loses what Fresnel and Schlick say about a and b.

    A slope of 1.2 is beyond the critical one of 0.894.
    """
    index, a = 1.5, math.atan(slope)
    for kind in FRESNEL:
        scene = scene_of(kind, index=index)
        x, y = HeightField.of(scene.lens).control_xy()
        heights = 9.0 + slope * x[:, None] + 0 * y
        sample = single_sample("uniform", (13, 11))
        landing = land(scene, heights, sample)
        r0 = 0.0 if kind == "none" else 0.04
        if slope > 1:
            assert bool((landing.statuses() == RayStatus.TOTAL_INTERNAL_REFLECTION).all())
            assert float(landing.lost["total_internal_reflection"]) == pytest.approx(1 - r0, rel=1e-13)
            assert not landing.power.any()
            continue
        b = math.asin(index * math.sin(a))
        start = 10 * sample.u - 5
        torch.testing.assert_close(landing.origin[0], start + (51 - slope * start) * math.tan(b - a), rtol=0, atol=1e-11)
        torch.testing.assert_close(landing.origin[1], 8 * sample.v - 4, rtol=0, atol=1e-12)
        exact = 0.5 * ((math.sin(a - b) / math.sin(a + b)) ** 2 + (math.tan(a - b) / math.tan(a + b)) ** 2)
        reflected = {"none": 0.0, "exact": exact, "schlick": r0 + (1 - r0) * (1 - math.cos(b)) ** 5}[kind]
        assert float(landing.leaving) == pytest.approx((1 - r0) * (1 - reflected), rel=1e-12)
        assert float(landing.lost["fresnel"]) == pytest.approx(r0 + (1 - r0) * reflected, rel=1e-12, abs=1e-15)


def test_concave_sphere_spreads_light_by_the_magnification():
    """rho = (n - 1) (z_screen - z_lens) / (mag - 1), table 6.1: paraxial, so the aperture is small (third order: 1e-5)."""
    for mag in (0.5, 3.0, 5.0, -1.0):
        offset = Offset.for_magnification((mag, mag), 1.5, 300.0, 3.0)
        lens = Lens((0.4, 0.4), 0.0, 1.5, (30, 30), (3, 3), offset=offset)
        scene = Scene(PlaneWave(), lens, Screen((5.0, 5.0), 300.0, (10, 10)))
        x, y = (a.numpy() for a in HeightField.of(lens).control_xy())
        heights = torch.from_numpy(offset.thickness + offset.sag(x[:, None], y[None, :]))
        sample = single_sample("grid", (16, 16))
        landed = place(land(scene, heights, sample), sample)
        # away from the rim, where the knots crowd: control points on the sphere shift the spline in height only
        x, y = (mag * 0.2 * (2 * at - 1)[1:-1] for at in (sample.u, sample.v))
        torch.testing.assert_close(landed[0][1:-1], x[:, None].expand(14, 16), rtol=0, atol=3e-5)
        torch.testing.assert_close(landed[1][:, 1:-1], y[None, :].expand(16, 14), rtol=0, atol=3e-5)


LENSES = {"gentle": 0.02, "off the screen": 0.4, "totally reflecting": 1.3}


@pytest.mark.parametrize(("kind", "f", "fresnel", "surface"), pairwise(SAMPLERS, FILTERS, FRESNEL, [*LENSES]))
def test_energy(kind, f, fresnel, surface):
    """Image + all losses = emitted power to 1e-12, and every loss that should occur does."""
    scene = scene_of(fresnel)
    heights = heights_of(scene, LENSES[surface])
    profile = torch.linspace(0, 1, 12, dtype=torch.float64).view(4, 3)
    for p in (None, looked_up_in(profile)):
        exposure = expose(scene, HeightField.of(scene.lens), heights, Sampler(kind, (26, 21), 5, p), f, chunk=200)
        assert set(exposure.lost) == set(LOSSES)
        assert float(exposure.image.sum()) + sum(exposure.lost.values()) == pytest.approx(1.0, abs=1e-12)
        assert exposure.leaving == pytest.approx(float(exposure.image.sum()) + exposure.lost["off_screen"], abs=1e-12)
        assert float(exposure.image.min()) >= 0
        assert all(value >= 0 for value in exposure.lost.values())
        assert exposure.rays == 546
        assert float(exposure.image.sum()) > (0.03 if surface == "totally reflecting" else 0.3)
        assert (exposure.lost["fresnel"] > 0.05) == (fresnel != "none")
        assert (exposure.lost["off_screen"] > 0.2) == (surface != "gentle")
        assert (exposure.lost["total_internal_reflection"] > 0.1) == (surface == "totally reflecting")


@pytest.mark.parametrize("fresnel", FRESNEL)
def test_energy_ray_by_ray_in_float32(fresnel):
    """The account closes to the rounding of float32 sums over 546 rays, too: 1e-5."""
    scene = scene_of(fresnel)
    sampler = Sampler("lines", (26, 21))
    exposure = expose(scene, HeightField.of(scene.lens), heights_of(scene, 1.3), sampler, FILTERS[2], torch.float32)
    assert float(exposure.image.sum()) + sum(exposure.lost.values()) == pytest.approx(1.0, abs=1e-5)
    assert exposure.image.dtype == torch.float64


def test_status_tells_what_became_of_a_ray():
    """The surface crosses the screen's plane: light beyond it never arrives, steep light never leaves, the rest does."""
    scene = replace(scene_of(), screen=Screen((12.0, 9.0), 3.3, (16, 11)))
    heights = heights_of(scene, 1.0, seed=3)
    sample = single_sample("stratified", (40, 40))
    landing = land(scene, heights, sample)
    x, y = sample.u.numpy(), sample.v.numpy()
    square = closed_form(scene, heights, x, y)[2]
    space_u, space_v = HeightField.of(scene.lens).spaces
    z = ((space_u.matrix(sample.u) @ heights) * space_v.matrix(sample.v)).sum(1).numpy()
    expected = np.where(
        square <= 0, RayStatus.TOTAL_INTERNAL_REFLECTION, np.where(z >= 3.3, RayStatus.AWAY_FROM_SCREEN, RayStatus.OK)
    )
    np.testing.assert_array_equal(landing.statuses().numpy(), expected)
    assert min(np.bincount(expected, minlength=3)) > 100
    assert bool(((landing.power > 0) == (landing.statuses() == RayStatus.OK)).all())
    total = landing.power.sum() + sum(landing.lost.values())
    assert float(total) == pytest.approx(1.0, abs=1e-12)


def test_a_lens_that_reaches_the_screen_is_refused():
    scene = scene_of()
    heights = heights_of(scene, 0.1)
    heights[4, 4] = 61.0
    with pytest.raises(InputError, match="must lie behind the lens, whose surface reaches 61 mm, got 60 mm"):
        expose(scene, HeightField.of(scene.lens), heights, Sampler("grid", (4, 4)))


def test_a_screen_at_another_distance_is_obeyed_or_refused():
    """`expose(screen=...)` must not collect at one distance what was traced to another."""
    scene = scene_of()
    field, heights, sampler = HeightField.of(scene.lens), heights_of(scene, 0.1), Sampler("grid", (20, 20))
    elsewhere = replace(scene.screen, z=30.0)
    expected = expose(replace(scene, screen=elsewhere), field, heights, sampler).image
    assert not torch.equal(expected, expose(scene, field, heights, sampler).image)
    try:
        image = expose(scene, field, heights, sampler, screen=elsewhere).image
    except InputError:
        return
    torch.testing.assert_close(image, expected)


def test_wider_and_finer_screens_see_the_same_light():
    scene = scene_of()
    field, heights, sampler = HeightField.of(scene.lens), heights_of(scene, 0.1), Sampler("lines", (50, 50))
    image = expose(scene, field, heights, sampler).image
    wide = expose(scene, field, heights, sampler, screen=scene.screen.grown((3, 2))).image
    torch.testing.assert_close(wide[3:-3, 2:-2], image, rtol=0, atol=1e-14)
    fine = expose(scene, field, heights, sampler, screen=replace(scene.screen, resolution=(32, 22))).image
    torch.testing.assert_close(fine.view(16, 2, 11, 2).sum((1, 3)), image, rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", SAMPLERS)
def test_exposure_does_not_depend_on_chunks(kind):
    """Only the order of the sums changes."""
    scene = scene_of()
    field, heights = HeightField.of(scene.lens), heights_of(scene, 0.4)
    whole, cut = (expose(scene, field, heights, Sampler(kind, (31, 29), 2), FILTERS[2], chunk=c) for c in (10**6, 97))
    torch.testing.assert_close(cut.image, whole.image, rtol=0, atol=1e-15)
    assert cut.lost == pytest.approx(whole.lost, abs=1e-14)


def test_a_tracer_and_its_arrays_are_gone_when_it_is_let_go(no_collector):
    """Arrays of every chunk stayed until the garbage collector came by: 0.8 GB an evaluation at 1000 x 1000 pixels."""
    scene = scene_of()
    tracer = Tracer(System.of(scene, HeightField.of(scene.lens)), single_sample("grid", (30, 20)))
    tracer.expose({EXIT: heights_of(scene, 0.01)}, scene.screen, Filter())
    left = weakref.ref(tracer)
    del tracer
    assert left() is None


@pytest.fixture
def no_collector():
    gc.disable()
    yield
    gc.enable()


def test_exposure_does_not_depend_on_threads():
    """Blocks of rays with images of their own are added at the end: only the order of the sums changes."""
    scene = scene_of()
    field, heights = HeightField.of(scene.lens), heights_of(scene, 0.4)
    exposures = {}
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            samplers = (Sampler(kind, (31, 29), 2) for kind in ("lines", "uniform"))
            exposures[threads] = [expose(scene, field, heights, s, FILTERS[2]) for s in samplers]
    finally:
        torch.set_num_threads(1)
    for one, three in zip(*exposures.values(), strict=True):
        torch.testing.assert_close(three.image, one.image, rtol=0, atol=1e-15)
        assert three.lost == pytest.approx(one.lost, abs=1e-14)


@pytest.mark.parametrize("kind", ["lines", "stratified"])
def test_float32_landing_error(kind, kernels):
    """A bound by counting roundings of size eps = 2^-24.

    A slope is a sum of control heights over knot distances: each of height, basis value and product is rounded.  Refraction adds
    four roundings of numbers near 1, times the slope.  The throw multiplies both.  Heights enter relative to their mean: the
    thickness of 3000 mm would cost 1e4 times more (hard case 4).  The kernels know float64 alone.
    """
    lens = Lens((10.0, 8.0), 0.0, 1.5, (30, 25), (3, 3), offset=Offset(3000.0))
    scene, field = Scene(PlaneWave(), lens, Screen((30.0, 30.0), 3300.0, (10, 10))), HeightField.of(lens)
    sample = single_sample(kind, (60, 60))
    heights = 3000.0 + 0.02 * torch.randn(30, 25, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    exact, rounded = land(scene, heights, sample), land(scene, heights, sample, torch.float32)
    assert bool((exact.statuses() == RayStatus.OK).all())
    assert torch.equal(exact.statuses(), rounded.statuses())
    (x, y), (x_rounded, y_rounded) = exact.origin[:2], rounded.origin[:2]
    if kernels == "fused":
        assert x_rounded.dtype == torch.float64
        assert torch.equal(x, x_rounded)
        assert torch.equal(y, y_rounded)
        return
    assert x_rounded.dtype == torch.float32
    eps, sag, knot_distance = 2.0**-24, float((heights - 3000.0).abs().max()), 8.0 / 22
    slope_error = 3 * eps * 2 * sag / knot_distance
    bound = 300.0 * (slope_error + 4 * eps * field.slope_bound(heights)) + 4 * eps * float(x.abs().max())
    worst = max(float((x - x_rounded).abs().max()), float((y - y_rounded).abs().max()))
    assert bound < 1e-4  # mm: a thousandth of a pixel of 0.1 mm
    assert bound / 20 < worst < bound


def test_mirrored_heights_give_the_mirrored_image():
    """To rounding, on a grid of rays that is its own mirror image, however many cells it has."""
    scene = scene_of()
    field, heights = HeightField.of(scene.lens), heights_of(scene, 0.3)
    sampler, f = Sampler("grid", (30, 44)), FILTERS[2]
    image = expose(scene, field, heights, sampler, f).image
    assert float((image - image.flip(0)).abs().max()) > 1e-3
    for axis in (0, 1):
        mirrored = expose(scene, field, heights.flip(axis), sampler, f).image
        torch.testing.assert_close(mirrored, image.flip(axis), rtol=0, atol=1e-13)


def test_exchanging_x_and_y_transposes_the_image():
    scene = scene_of()
    turned = Scene(
        scene.source, replace(scene.lens, size=(8.0, 10.0), control=(7, 9), degree=(2, 3)), Screen((9.0, 12.0), 60.0, (11, 16))
    )
    heights = heights_of(scene, 0.3)
    image = expose(scene, HeightField.of(scene.lens), heights, Sampler("grid", (32, 64)), Filter("cosine", (5, 3))).image
    other = expose(turned, HeightField.of(turned.lens), heights.T, Sampler("grid", (64, 32)), Filter("cosine", (3, 5))).image
    torch.testing.assert_close(other.T, image, rtol=0, atol=1e-14)


@pytest.mark.parametrize("factor", [0.01, 7.3, 1e4])
def test_scaling_every_length_changes_nothing(factor):
    """Thesis ch. 6: slopes, and so the image, are free of the unit of length (alpha is stored per pixel)."""
    scene = scene_of()
    lens = replace(scene.lens, size=(10 * factor, 8 * factor), offset=Offset(3.0 * factor))
    screen = Screen((12.0 * factor, 9.0 * factor), 60.0 * factor, (16, 11))
    scaled = Scene(scene.source, lens, screen)
    heights, sampler = heights_of(scene, 0.3), Sampler("lines", (30, 44))
    for f in FILTERS[1:]:
        image = expose(scene, HeightField.of(scene.lens), heights, sampler, f)
        other = expose(scaled, HeightField.of(lens), heights * factor, sampler, f)
        torch.testing.assert_close(other.image, image.image, rtol=0, atol=1e-13)
        assert other.lost == pytest.approx(image.lost, abs=1e-13)


def exposed(scene: Scene, sampler: Sampler, f: Filter):
    """heights -> image and power leaving the lens, differentiable, float64."""
    (sample,) = sampler.chunks()
    tracer = Tracer(System.of(scene, HeightField.of(scene.lens)), sample)

    def both(heights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        part = tracer.expose({EXIT: heights}, scene.screen, f)
        return part.image, part.leaving

    return both


def image_of(scene: Scene, sampler: Sampler, f: Filter):
    """heights -> image, differentiable, float64."""
    both = exposed(scene, sampler, f)
    return lambda heights: both(heights)[0]


@pytest.mark.parametrize("kind", ["lines", "uniform"])
@pytest.mark.parametrize("fresnel", FRESNEL)
def test_gradcheck_of_the_image(kind, fresnel):
    """Reverse and forward mode against finite differences, with rays lost on the way and off the screen.

    The screen is near, so that steep rays land on it: where Fresnel's losses change fast.
    """
    scene = scene_of(fresnel, (5, 4), (3, 2), (11.0, 9.0), (5, 4))
    scene = replace(scene, screen=replace(scene.screen, z=10.0))
    heights = heights_of(scene, 1.1, seed=2).requires_grad_()
    landing = land(scene, heights.detach(), single_sample(kind, (6, 5), 1))
    assert int((landing.statuses() == RayStatus.OK).sum()) > 15
    assert int((landing.statuses() == RayStatus.TOTAL_INTERNAL_REFLECTION).sum()) > 1
    both = exposed(scene, Sampler(kind, (6, 5), 1), Filter("cosine", (3, 3)))
    if fresnel == "none":  # the power that leaves the lens is constant then
        assert torch.autograd.gradcheck(lambda h: both(h)[0], (heights,), eps=1e-7, atol=1e-6, rtol=1e-5, check_forward_ad=True)
    else:
        assert float(torch.autograd.grad(both(heights)[1], heights)[0].abs().max()) > 1e-3
        assert torch.autograd.gradcheck(both, (heights,), eps=1e-7, atol=1e-6, rtol=1e-5, check_forward_ad=True)


@pytest.mark.parametrize("f", FILTERS[1:], ids=lambda f: f.kind)
@pytest.mark.parametrize("bumps", [0.1, 2.5])
def test_forward_and_reverse_mode_are_transposes(f, bumps):
    """<y, J v> = <J' y, v> to 1e-11 relative, also where a good part of the light is totally reflected."""
    scene = scene_of()
    image = image_of(scene, Sampler("lines", (26, 21)), f)
    heights = heights_of(scene, bumps).requires_grad_()
    y = torch.randn(scene.screen.resolution, dtype=torch.float64)
    (reverse,) = torch.autograd.grad(image(heights), heights, y)
    assert bool(torch.isfinite(reverse).all())
    for seed in range(3):
        v = torch.randn(heights.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        with fwd.dual_level():
            jv = fwd.unpack_dual(image(fwd.make_dual(heights.detach(), v))).tangent
        left, right = float((y * jv).sum()), float((reverse * v).sum())
        assert abs(left) > 1e-3
        assert left == pytest.approx(right, rel=1e-11)


@pytest.mark.parametrize("fresnel", FRESNEL)
def test_taylor_remainder_is_of_order_two(fresnel):
    """By regression over steps small against a pixel, with the C1 filter: 2 to 0.05."""
    scene = scene_of(fresnel)
    image = image_of(scene, Sampler("stratified", (26, 21)), FILTERS[2])
    heights, v = heights_of(scene, 0.2).requires_grad_(), heights_of(scene, 1.0, seed=9) - 3.0
    y = torch.randn(scene.screen.resolution, dtype=torch.float64)
    value = (y * image(heights)).sum()
    slope = float((torch.autograd.grad(value, heights)[0] * v).sum())
    steps = np.logspace(-6, -3.5, 9)
    with torch.no_grad():
        rest = [abs(float((y * image(heights + h * v)).sum() - value) - h * slope) for h in steps]
    assert np.polyfit(np.log(steps), np.log(rest), 1)[0] == pytest.approx(2.0, abs=0.05)


def test_moving_one_control_point_of_a_flat_lens_only_redistributes_light():
    """Thesis 6.1: the image's derivative is a mountain in a valley that sums to zero.

    Exactly, without Fresnel; with it, too, for its slope at normal incidence is zero.
    """
    for fresnel in FRESNEL:
        scene = scene_of(fresnel)
        image = image_of(scene, Sampler("grid", (64, 64)), FILTERS[2])
        v = torch.zeros(scene.lens.control, dtype=torch.float64)
        v[4, 3] = 1.0
        with fwd.dual_level():
            derivative = fwd.unpack_dual(image(fwd.make_dual(heights_of(scene, 0.0), v))).tangent
        assert abs(float(derivative.sum())) < 1e-13
        assert float(derivative.max()) > 0.01  # per mm: convex, it gathers light in the middle
        assert divmod(int(derivative.argmax()), 11) in ((7, 5), (8, 5))
        assert float(derivative.min()) < -0.005
        for axis in (0, 1):  # the control point stands in the middle of the lens
            torch.testing.assert_close(derivative.flip(axis), derivative, rtol=0, atol=1e-13)
