"""The fused CPU kernels against the plain-torch reference: every precision, filter, size, loss and odd case.

Bounds.  float64: both sides round differently, some 1e-15 per operation, and a landing point 300 mm away is worth 1e-13 of a
pixel, so values agree to 1e-12 and gradients to 1e-11 of their norm.  float32: the kernels are float64 whatever is asked for; plain
torch's rays are compared with theirs, to 1e-5.
"""

from __future__ import annotations

import time

import numba
import numpy as np
import pytest
import torch
from helpers import pairwise

from caustic_cli.commands import console
from caustic_cli.inverse import transport
from caustic_cli.inverse.wave_objective import WaveObjective
from caustic_cli.optics.backends import backend_for, plain
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.frames import IDENTITY
from caustic_cli.optics.kernels import ahead, banded, fields, fused, multigrid, pixels, random_points, refraction, spline
from caustic_cli.optics.kernels import filter_weights as kernel_shares
from caustic_cli.optics.kernels.fused_functions import PlaneKernel
from caustic_cli.optics.kernels.jit import njit
from caustic_cli.optics.kernels.threads import ALL, on_threads
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen
from caustic_cli.workflow import compilation

FILTERS = [
    Filter(),
    *(Filter("cosine", (v, w)) for v, w in ((3, 3), (1, 5), (11, 3), (15, 15))),
    *(
        Filter("gaussian", (v, w), (a, b))
        for v, w, a, b in (
            (3, 3, 0.0, 0.0),
            (3, 3, 2.6e-6, 1e-4),
            (3, 5, 0.01, 0.02),
            (11, 11, 0.03, 0.001),
            (5, 11, 0.3, 1.9),
            (3, 3, 2.1, 30.0),
            (3, 7, 100.0, 700.0),
            (1, 3, 1.0, 1.0),
        )
    ),
]
SCREEN = Screen((6.0, 4.0), 40.0, (31, 20))
ACCOUNT = ("fresnel", "total_internal_reflection", "off_screen")


def scene(fresnel: str = "exact", degree=(3, 2)) -> Scene:
    return Scene(PlaneWave(), Lens(size=(4.0, 3.0), control=(12, 16), degree=degree, fresnel=fresnel), SCREEN)


def heights(shape=(12, 16), rough: float = 0.02, seed: int = 0) -> torch.Tensor:
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return 5.0 + rough * noise


def exposures(scene: Scene, z: torch.Tensor, filter: Filter, kind: str, dtype=torch.float64, rays: int = 1500):
    """(image, leaving, lost) by kernel and by reference, differentiable, of the same rays."""
    field = HeightField.of(scene.lens)
    (sample,) = Sampler.of_size(kind, rays, seed=3).chunks()
    tracer = Tracer(System.of(scene, field), sample, dtype)
    part = tracer.expose({EXIT: z}, scene.screen, filter)
    yield part.image, part.leaving, entries(part.lost)
    with plain():
        (landing,) = Tracer(System.of(scene, field), sample, dtype).land({EXIT: z}, scene.screen)
    image, off = splat(*landing.origin[:2], landing.power, scene.screen, filter)
    lost = entries(landing.lost)
    yield image, landing.leaving, {**lost, "off_screen": lost["off_screen"] + float(off.detach())}


def entries(lost) -> dict[str, float]:
    """An account in numbers, with what a path may leave out because it is 0."""
    return dict.fromkeys(ACCOUNT, 0.0) | {k: float(torch.as_tensor(v).detach()) for k, v in lost.items()}


@pytest.mark.parametrize(
    ("filter", "fresnel", "kind"), pairwise(FILTERS, ["none", "schlick", "exact"], ["lines", "stratified"]), ids=str
)
def test_value_and_gradient_in_float64(filter, fresnel, kind):
    pull = torch.randn(SCREEN.resolution, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    results = []
    z = heights().requires_grad_()
    for image, leaving, lost in exposures(scene(fresnel), z, filter, kind):
        value = (image * pull).sum() + 0.3 * leaving
        gradient = torch.autograd.grad(value, z)[0] if value.requires_grad else torch.zeros_like(z)
        results.append((image.detach(), float(leaving.detach()), lost, gradient))
    (image, leaving, lost, gradient), (image_, leaving_, lost_, gradient_) = results
    torch.testing.assert_close(image, image_, rtol=0, atol=1e-12 * float(image_.max()))
    assert leaving == pytest.approx(leaving_, rel=1e-12)
    assert lost == pytest.approx(lost_, abs=1e-13)
    assert float((gradient - gradient_).norm()) <= 1e-11 * float(gradient_.norm()) + 1e-300


@pytest.mark.parametrize("rough", [0.02, 0.5])
@pytest.mark.parametrize("kind", ["lines", "stratified"])
@pytest.mark.parametrize("filter", FILTERS[1:], ids=str)
def test_forward_mode_is_the_transpose_of_reverse_mode(filter, kind, rough):
    """<y, J v> = <J' y, v>; with rough 0.5 some rays are totally reflected and some miss the screen."""
    field = HeightField.of(scene().lens)
    (sample,) = Sampler.of_size(kind, 1500, seed=3).chunks()
    tracer = Tracer(System.of(scene(), field), sample)
    assert tracer.fused is not None
    z, v = heights(rough=rough), heights(seed=7) - 5.0
    y = torch.randn(SCREEN.resolution, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    with torch.autograd.forward_ad.dual_level():
        part = tracer.expose({EXIT: torch.autograd.forward_ad.make_dual(z, v)}, SCREEN, filter)
        image = torch.autograd.forward_ad.unpack_dual(part.image).tangent
        leaving = torch.autograd.forward_ad.unpack_dual(part.leaving).tangent
    forward = float((y * image).sum() + 0.3 * leaving)
    z.requires_grad_()
    part = tracer.expose({EXIT: z}, SCREEN, filter)
    (gradient,) = torch.autograd.grad((y * part.image).sum() + 0.3 * part.leaving, z)
    scale = float((y.abs() * image.abs()).sum() + 0.3 * leaving.abs())
    assert scale > 1e-4
    assert abs(forward - float((gradient * v).sum())) <= 1e-12 * scale


@pytest.mark.parametrize("kind", ["lines", "stratified"])
@pytest.mark.parametrize("filter", [f for f in FILTERS if f.reach != (0, 0)], ids=str)
def test_plain_torch_in_float32_against_float64(filter, kind, monkeypatch):
    """Rounding slopes to float32 moves a ray by some 1e-6 pixels here: image and gradient within 1e-5 of their norm.

    The gradient of a Gaussian much narrower than a pixel turns over within 1 / sqrt(alpha) of one: 3e-4 there.
    """
    bound, results = 1e-5 if max(filter.alpha) <= 2.0 else 3e-4, []
    pull = torch.linspace(-1, 1, 31 * 20, dtype=torch.float64).view(31, 20) ** 2
    for dtype, by in ((torch.float32, "torch"), (torch.float64, "")):
        monkeypatch.setenv("CAUSTIC_KERNELS", by)
        z = heights().requires_grad_()
        image = next(exposures(scene(), z, filter, kind, dtype))[0]
        results.append((image.detach(), torch.autograd.grad((image * pull).sum(), z)[0]))
    for a, b in zip(*results, strict=True):
        assert float((a - b).norm()) <= bound * float(b.norm())


@pytest.mark.parametrize("kind", ["lines", "stratified"])
def test_kernels_asked_for_float32_give_float64(kind):
    """The same numbers, to the last bit."""
    results = []
    for dtype in (torch.float32, torch.float64):
        z = heights().requires_grad_()
        image, leaving, lost = next(exposures(scene(), z, Filter("cosine", (3, 3)), kind, dtype))
        results.append((image.detach(), torch.autograd.grad((image * image).sum() + leaving, z)[0], lost))
    (image, gradient, lost), (image_, gradient_, lost_) = results
    assert image.dtype == gradient.dtype == torch.float64
    assert torch.equal(image, image_)
    assert torch.equal(gradient, gradient_)
    assert lost == lost_


@pytest.mark.parametrize("height", [5.5, 8.0, 40.0])
@pytest.mark.parametrize("rough", [0.0, 0.02, 0.3, 2.0])
def test_hard_surfaces_are_finite_and_agree(rough, height):
    """Flat, rough, mostly reflecting; the screen touching the surface: nothing but finite numbers, and the reference's."""
    s = Scene(PlaneWave(), scene().lens, Screen((6.0, 4.0), height, (31, 20)))
    z, results = heights(rough=rough).requires_grad_(), []
    for image, leaving, lost in exposures(s, z, Filter("cosine", (3, 3)), "lines"):
        (gradient,) = torch.autograd.grad(image.sum() + (image * image).sum() + leaving, z)
        assert bool(torch.isfinite(image).all()) and bool(torch.isfinite(gradient).all())
        assert float(image.detach().sum()) + sum(lost.values()) == pytest.approx(1.0, abs=1e-12)
        results.append((image.detach(), gradient, lost))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-12)
    assert float((results[0][1] - results[1][1]).norm()) <= 1e-10 * float(results[1][1].norm()) + 1e-15
    assert results[0][2] == pytest.approx(results[1][2], abs=1e-13)


def test_landing_on_borders():
    """Rays a rounding error from a pixel's border, on the frame's border, and in the ghost pixels, by both paths."""
    pixel = SCREEN.pixel[0]
    for shift in (0.0, 1e-17, -1e-17, 1e-16, -1e-16, 0.5 * pixel, 1.5 * pixel, 3.0 - pixel, 3.0, 3.0 + pixel, -3.0, 3.2):
        for filter in (Filter(), Filter("cosine", (3, 3)), Filter("gaussian", (5, 3), (0.3, 0.3))):
            at = torch.tensor([0.5 + shift / 4.0, 0.5], dtype=torch.float64)
            space = SplineSpace.uniform(4, 3)
            share = torch.tensor(0.25, dtype=torch.float64)
            kernel = PlaneKernel((space, space), (2.0, 1.5), at, at, True, share)
            image, _, lost = kernel(torch.zeros(4, 4, dtype=torch.float64), 1.5, "none", 10.0, SCREEN, filter)
            x, y = (2.0 * at - 1.0) * 2.0, (2.0 * at - 1.0) * 1.5
            grid = [t.reshape(-1) for t in torch.meshgrid(x, y, indexing="ij")]
            expected, off = splat(*grid, torch.full((4,), 0.25, dtype=torch.float64), SCREEN, filter)
            torch.testing.assert_close(image, expected, rtol=0, atol=1e-14)
            assert float(lost["off_screen"]) == pytest.approx(float(off), abs=1e-14)


def test_points_on_knots_are_evaluated_in_the_right_span():
    """Scattered rays exactly on knots, repeated ones too, and at both ends: the plain-torch surface, to rounding."""
    knots = torch.tensor([0, 0, 0, 0, 0.25, 0.5, 0.5, 0.5, 0.75, 1, 1, 1, 1], dtype=torch.float64)
    space = SplineSpace(3, knots)
    u = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0, 0.5 - 1e-16, 0.1], dtype=torch.float64)
    field = HeightField((space, space), (2.0, 2.0))
    net = heights((9, 9), 0.05)
    share = torch.full((7,), 1.0 / 7.0, dtype=torch.float64)
    kernel = PlaneKernel(field.spaces, field.half_size, u, u.flip(0).contiguous(), False, share)
    sample = next(Sampler("uniform", (7, 1)).chunks())
    sample = type(sample)(u, u.flip(0).contiguous(), False, share)
    sag, *slopes = field.prepare(sample, torch.float64)(net - 5.0)
    eta = Lens().index
    with plain():
        reference = backend_for("cpu")
    out = reference.interact((0.0, 0.0, 1.0), slopes, share, eta=eta, reflects=False, fresnel="exact")
    at = (2 * u - 1) * 2.0, (2 * u.flip(0) - 1) * 2.0, sag
    x, y, on_way = reference.land(at, out.direction, (0.0, 0.0, 35.0), IDENTITY, 1.0)
    assert bool(on_way.all())
    expected, _ = splat(x, y, out.power, SCREEN, Filter("cosine", (5, 5)))
    image, _, _ = kernel(net - 5.0, eta, "exact", 35.0, SCREEN, Filter("cosine", (5, 5)))
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-13)


def test_the_number_of_blocks_changes_rounding_only():
    """More threads than rows, one thread: sums in another order."""
    before, images = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 64):
            torch.set_num_threads(threads)
            images.append(next(exposures(scene(), heights(), Filter("cosine", (3, 3)), "lines", rays=900))[0])
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=1e-15)
    torch.testing.assert_close(images[0], images[2], rtol=0, atol=1e-15)


def test_series_and_recursion_meet():
    """On either side of the borders between formulas the shares are the same function."""
    for border in (4 * kernel_shares.SMALL / 9, kernel_shares.MODERATE):
        a, b = (
            next(exposures(scene(), heights(), Filter("gaussian", (3, 3), (alpha, alpha)), "lines"))[0]
            for alpha in (border * (1 - 1e-12), border * (1 + 1e-12))
        )
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_first_run_compiles_what_designs_and_renders_use(dtype):
    """A kernel that is called in another way than it was compiled ahead for would be compiled again, half a minute each time."""
    for part in ahead.PARTS:
        ahead.compile_part(part)
    kernels = [fused.forward, fused.backward, pixels.sums, spline.evaluate, spline.pull_back, banded._contract, banded._spread]
    kernels += [spline.pull_coefficients, refraction.REFRACT.kernels[0], random_points.scatter]
    kernels += [multigrid.aggregate, multigrid.sweep]
    kernels += [getattr(fields, name) for name in ("make_field", "on_pixels", "widen", "weigh", "make_pull")]
    by_degree = [fields.displace, fields.pull_displacement]  # compiled for each, ahead for cubics
    names = {f"{k.__module__.rpartition('.')[2]}.{k.__name__}" for k in kernels + by_degree}
    assert {name for name, _ in ahead.PARTS.values()} <= names
    compiled = [list(kernel.signatures) for kernel in kernels]
    for kind, rays in (("lines", 900), ("stratified", 1500), ("uniform", 900), ("uniform", 1)):
        image, *_ = next(exposures(scene("schlick"), heights().requires_grad_(), FILTERS[-1], kind, dtype, rays))
        image.sum().backward()
    transport.solve(np.ones((8, 8)), np.ones((64, 64)), (1.0, 1.0), (1.0, 1.0))
    of = scene(), HeightField.of(scene().lens), heights(rough=0.0)
    wave_image(*of[:2], of[2].requires_grad_()).image.sum().backward()
    WaveObjective(*of, torch.ones(scene().screen.resolution, dtype=torch.float64), "rms", wavelengths=(550.0,))(of[2].detach())
    assert [list(kernel.signatures) for kernel in kernels] == compiled


def test_compilation_is_spoken_of_where_something_is_compiled(monkeypatch):
    """Once a block; not for what is compiled already, nor for what is slow but compiles nothing."""
    monkeypatch.setattr(compilation, "PATIENCE", 0.05)
    said = []
    say = console.ConsoleReporter(False)
    monkeypatch.setattr(say, "say", said.append)
    slow = numba.njit(lambda x: np.cos(np.sin(x)) + np.ones(3).sum())
    with compilation.announce_compilation(say, "compiling"):
        time.sleep(0.1)
        assert said == []
        for x in (1.0, 1, 1j, np.float32(1.0)):  # four signatures
            slow(x)
    assert said == ["compiling"]
    with compilation.announce_compilation(say, "again"):
        slow(2.0)
        time.sleep(0.1)
    assert said == ["compiling"]


@njit(entry=True)
def _numbered(k, pair, factor, refused):
    if on_threads(k, len(pair[0]), (pair, factor, refused)):
        return
    if k == refused:
        raise MemoryError
    pair[0][k] = factor * k
    pair[1][k] = 1.0


def test_a_kernel_calls_itself_with_every_number_and_says_when_a_call_failed():
    numbers, ones = np.zeros(1000), np.zeros(1000)
    _numbered(ALL, (numbers, ones), 0.5, -2)
    np.testing.assert_array_equal(numbers, 0.5 * np.arange(1000))
    assert ones.all()
    _numbered(ALL, (np.zeros(0), ones), 0.5, -2)
    with pytest.raises(MemoryError):
        _numbered(ALL, (numbers, ones), 0.5, 700)


def test_threads_are_not_those_of_tbb():
    """Whose parallel loops start more slowly the more of them there were; numba takes it first where it is installed."""
    next(exposures(scene("schlick"), heights(), FILTERS[0], "lines"))
    assert numba.threading_layer() in ("omp", "workqueue")
