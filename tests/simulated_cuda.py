"""The CUDA kernels in numba's simulator, each against plain torch: values, gradients, and sums in another order.

`test_cuda.py` runs this file in a process of its own with NUMBA_ENABLE_CUDASIM=1, which numba reads as it is loaded.

Bounds.  Both sides round differently, some 1e-16 per operation: values agree to 1e-12 of the largest, gradients to 1e-11.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numba
import pytest
import torch

from caustic_cli.optics.backends import plain
from caustic_cli.optics.backends.cuda import Cuda
from caustic_cli.optics.backends.reference import Torch
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.kernels.cuda import launch, sums
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen

assert numba.config.ENABLE_CUDASIM, "these tests need NUMBA_ENABLE_CUDASIM=1"

RAYS = 100
SCREEN = Screen((6.0, 4.0), 40.0, (31, 20), shift=(0.3, -0.2))
FILTERS = [
    Filter(),
    Filter("cosine", (3, 3)),
    Filter("cosine", (1, 5)),
    Filter("gaussian", (5, 3), (0.0, 2.6e-6)),
    Filter("gaussian", (3, 7), (0.3, 30.0)),
]


def numbers(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def directions(seed: int, count: int = RAYS) -> list[torch.Tensor]:
    dx, dy = 0.3 * numbers(seed, 2, count).clamp(-2.0, 2.0)
    return [dx, dy, torch.sqrt(1.0 - dx * dx - dy * dy)]


def real(out) -> list[torch.Tensor]:
    """Tensors of float64 of a nested result."""
    if isinstance(out, torch.Tensor):
        return [out] if out.dtype == torch.float64 else []
    return [t for part in out for t in real(part)]


def apart(ones: list[torch.Tensor], others: list[torch.Tensor]) -> float:
    """Largest difference over the largest value: of each array, and of numbers, which may be sums that cancel, over that of all."""
    largest = [o.abs().max() for o in others]
    sizes = [size if o.ndim else max(largest) for size, o in zip(largest, others, strict=True)]
    return max(float((a - b).abs().max() / s.clamp_min(1e-300)) for a, b, s in zip(ones, others, sizes, strict=True))


def gradients(function, inputs) -> list[torch.Tensor]:
    leaves = [v.clone().requires_grad_() for v in inputs]
    outputs = real(function(*leaves))
    total = sum((numbers(7 + k, *t.shape) * t).sum() for k, t in enumerate(outputs) if t.requires_grad)
    found = torch.autograd.grad(total, leaves, allow_unused=True)
    return [torch.zeros_like(v) if g is None else g for g, v in zip(found, leaves, strict=True)]


def compare(by_kernel, by_torch, inputs) -> None:
    """Value and gradient of one function done by both."""
    assert apart(real(by_kernel(*inputs)), real(by_torch(*inputs))) < 1e-12
    assert apart(gradients(by_kernel, inputs), gradients(by_torch, inputs)) < 1e-11


@pytest.fixture
def launched(monkeypatch):
    """Runs a function with other numbers of threads: rays come in another order, and meet at the same pixels at other times."""

    def run(function):
        out = []
        for threads, blocks in ((8, 2), (1, 1), (3, 5), (16, 1)):
            monkeypatch.setattr(launch, "THREADS", threads)
            monkeypatch.setattr(launch, "BLOCKS", blocks)
            out.append(function())
        return out

    return run


def same(runs) -> None:
    """Bitwise equality of all runs' tensors."""
    first, *others = runs
    for other in others:
        assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


# Sums.


@pytest.mark.parametrize("size", [1e-300, 3e-9, 1.0, 1.0 - 2e-16, 4.0, 7e12, 1e300])
def test_sums_fit_64_bits(size):
    """The bound: a sum as large as it can be keeps its sign, and a unit is 2^-61 of it at most."""
    unit = sums.unit_of(torch.tensor(size, dtype=torch.float64))
    up, down = (float(v) for v in unit)
    assert up * down == 1.0
    if size > 2.0**-938:  # below, units are as small as numbers go
        assert 2.0**61 <= size * up <= 2.0**62
    terms = [size] + [0.0] * 100
    total = sum(sums.units(t, up) for t in terms)
    assert 0 <= total <= 2**62 < 2**63 - 2**40
    assert total * down == pytest.approx(size, rel=2**-50)


def test_sums_of_cancelling_terms():
    terms = numbers(1, 5000) * 10.0 ** numbers(2, 5000)
    unit = sums.unit_of(terms.abs().sum())
    total = sum(sums.units(float(t), float(unit[0])) for t in terms)
    exact = sum(map(lambda t: int(t * 2**80), (float(t) for t in terms))) / 2**80
    assert abs(total * float(unit[1]) - exact) <= len(terms) * 2.0**-62 * float(terms.abs().sum())
    backwards = sum(sums.units(float(t), float(unit[0])) for t in terms.flip(0))
    assert total == backwards


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_sums_without_a_bound_are_nan(wrong):
    unit = sums.unit_of(torch.tensor(wrong))
    assert sums.units(wrong, float(unit[0])) == 0
    assert torch.isnan(sums.value_of(torch.tensor([3]), unit)).all()


def test_sums_of_nothing():
    assert sums.unit_of(torch.zeros((), dtype=torch.float64)).tolist() == [1.0, 1.0]


# The stages.


@pytest.mark.parametrize("filter", FILTERS, ids=lambda f: f"{f.kind}-{f.size}")
def test_splat(filter, launched):
    x, y, weight = 2.2 * numbers(1, RAYS), 1.5 * numbers(2, RAYS), numbers(3, RAYS)
    by = [lambda *r, one=one: one.splat(*r, SCREEN, filter) for one in (Cuda(), Torch())]
    compare(*by, (x, y, weight))
    same(launched(lambda: [*by[0](x, y, weight), *gradients(by[0], (x, y, weight))]))


@pytest.mark.parametrize("fresnel", ["none", "schlick", "exact"])
@pytest.mark.parametrize("eta, polarised", [(1.5, False), (1 / 1.5, False), (1.5, True)])
def test_stages_refract(fresnel, eta, polarised):
    field = directions(5) if polarised else []
    slopes = 0.2 * numbers(2, 2, RAYS).clamp(-2.0, 2.0)  # d . N > 0: the reference takes no other
    inputs = [*directions(1), *slopes, numbers(3, RAYS).abs(), *field]

    def by(backend):
        def called(dx, dy, dz, gx, gy, power, *e):
            options = {"eta": eta, "reflects": False, "fresnel": fresnel, "polarised": e or None}
            return backend.interact((dx, dy, dz), (gx, gy), power, **options)

        return called

    assert eta < 1 or not by(Torch())(*inputs).passes.all()
    compare(by(Cuda()), by(Torch()), inputs)


def test_stages_mirror():
    inputs = [*directions(1), *(0.4 * numbers(2, 2, RAYS))]

    def by(backend):
        return lambda dx, dy, dz, gx, gy: (
            backend.interact((dx, dy, dz), (gx, gy), torch.ones_like(gx), eta=1.0, reflects=True, fresnel="none").direction
        )

    compare(by(Cuda()), by(Torch()), inputs)


def test_stages_mirror_of_one_direction():
    """Components that are numbers for all rays."""
    slopes = tuple(0.4 * numbers(2, 2, RAYS))
    options = {"eta": 1.0, "reflects": True, "fresnel": "none"}
    one, other = (b.interact((0.0, 0.0, 1.0), slopes, torch.ones(RAYS), **options).direction for b in (Cuda(), Torch()))
    assert apart(one, other) < 1e-14


@pytest.mark.parametrize("forward", [1.0, -1.0])
def test_stages_land(forward):
    screen = Screen((6.0, 4.0), 40.0, (31, 20), tilt=(20.0, -35.0), shift=(1.0, 2.0))
    inputs, point = [*numbers(2, 3, RAYS), *numbers(4, 3, RAYS)], (*screen.shift, forward * screen.z)
    by = [lambda *r, one=one: one.land(r[:3], r[3:], point, screen.axes, forward) for one in (Cuda(), Torch())]
    on_way = [b(*inputs)[2] for b in by]
    assert torch.equal(*on_way) and 0 < int(on_way[0].sum()) < RAYS
    compare(*by, inputs)


# The surface.


def lens(control=(7, 9), degree=(3, 4), bump: float = 2e-3):
    """A lens that throws an image, with bumps, and its heights (n, m) mm."""
    scene = Scene(PlaneWave(), Lens(control=control, degree=degree), Screen((36.0, 36.0), resolution=(25, 20)))
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    offset = Offset.for_magnification((3, 3), scene.lens.index, scene.screen.z, 5.0)
    heights = offset.thickness + torch.from_numpy(offset.sag(x[:, None].numpy(), y[None, :].numpy()))
    return scene, field, heights + bump * numbers(0, *control)


@pytest.mark.parametrize("kind", ["lines", "stratified"])
def test_surface_at_a_sample(kind, launched):
    _, field, heights = lens()
    (sample,) = Sampler(kind, (12, 9), seed=3).chunks(1 << 12)
    by = [one.spline_on(field, sample, torch.float64) for one in (Cuda(), Torch())]
    compare(*by, (heights,))
    same(launched(lambda: [*by[0](heights), *gradients(by[0], (heights,))]))


@pytest.mark.parametrize("degree", [(1, 1), (2, 5)])
def test_surface_at_points(degree):
    _, field, heights = lens(degree=degree)
    x, y = 5.0 * (2.0 * torch.rand(2, RAYS, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 1.0)
    by = [lambda h, one=one: one.spline_at(field, h, x, y) for one in (Cuda(), Torch())]
    compare(*by, (heights,))


def test_surface_beyond_its_edge():
    """The bound of the gradient's sums grows with the powers there."""
    _, field, heights = lens(degree=(3, 5))
    x, y = torch.linspace(-9.0, 14.0, 50, dtype=torch.float64), torch.linspace(20.0, -7.0, 50, dtype=torch.float64)
    by = [lambda h, one=one: one.spline_at(field, h, x, y) for one in (Cuda(), Torch())]
    compare(*by, (heights,))


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("steep", [False, True])
def test_surface_met_by_rays(side, steep, launched):
    """Newton hits; steep: rays that may meet the surface more than once, whose first root is isolated before."""
    _, field, heights = lens(bump=0.3 if steep else 2e-3)
    count = 40 if steep else RAYS
    x, y = 3.0 * numbers(11, 2, count)
    dx, dy, dz = directions(12, count)
    inputs = [heights, x, y, 5.0 - side * (20.0 + numbers(13, count).abs()), dx, dy, side * dz]
    by = [lambda h, *r, one=one: one.intersect_spline(field, h, r[:3], r[3:], side) for one in (Cuda(), Torch())]
    found = [b(*inputs).valid for b in by]
    assert torch.equal(*found) and 5 < int(found[0].sum()) < count
    if steep:
        slopes = field.slope_bounds(heights)
        assert (slopes[0] * dx.abs() + slopes[1] * dy.abs() >= dz).any()
    compare(*by, inputs)
    if not steep:
        same(launched(lambda: [*real(by[0](*inputs)), *gradients(by[0], inputs)]))


def test_surface_met_by_no_ray():
    _, field, heights = lens()
    rays = [torch.zeros(3, dtype=torch.float64) for _ in range(3)]
    away = [torch.zeros(3, dtype=torch.float64)] * 2 + [-torch.ones(3, dtype=torch.float64)]
    by = [lambda h, one=one: one.intersect_fixed(field, rays, away)(h) for one in (Cuda(), Torch())]
    assert not by[0](heights).valid.any()
    assert all(float(g.abs().max()) == 0.0 for g in gradients(by[0], (heights,)))


def test_surface_at_nothing_and_met_by_nothing():
    _, field, heights = lens()
    none = torch.zeros(0, dtype=torch.float64)
    leaf = heights.clone().requires_grad_()
    assert all(t.shape == (0,) for t in Cuda().spline_at(field, leaf, none, none))
    assert Cuda().intersect_spline(field, leaf, (none, none, none), (none, none, none), 1.0).valid.shape == (0,)
    image, outside = Cuda().splat(none, none, none, SCREEN, FILTERS[1])
    assert float(image.abs().sum()) == float(outside) == 0.0


# A whole trace by one kernel.


def traced(scene: Scene, field, kind: str, rays: int):
    """By the kernels and by plain torch: a function of heights to image, power and losses."""
    (chunk,) = rays_of(scene, kind, rays, 3).chunks(1 << 12)

    def by(context):
        def called(heights):
            with context():
                tracer = Tracer(System.of(scene, field), chunk)
                assert (tracer.fused is None) == (context is plain)
                out = tracer.expose({"exit": heights}, scene.screen, called.filter)
            called.lost = {name: float(value) for name, value in out.lost.items()}
            return out.image, out.leaving

        return called

    return by


def check_trace(scene, field, heights, kind, filters, launched, monkeypatch) -> dict:
    """Image, power, losses and derivatives of a trace by one kernel; gives the losses with the last filter."""
    monkeypatch.setenv("CAUSTIC_KERNELS", "cuda")
    by = traced(scene, field, kind, RAYS)
    kernel, reference = by(nullcontext), by(plain)
    for filter in filters:
        kernel.filter = reference.filter = filter
        compare(kernel, reference, (heights,))
        for name, value in reference.lost.items():
            assert kernel.lost.get(name, 0.0) == pytest.approx(value, abs=1e-13)
        image, _ = kernel(heights)
        assert float(image.sum()) + sum(kernel.lost.values()) == pytest.approx(1.0, abs=1e-12)
    same(launched(lambda: [*kernel(heights), *gradients(kernel, (heights,))]))
    return kernel.lost


@pytest.mark.parametrize("kind", ["lines", "stratified"])
def test_plane_image(kind, launched, monkeypatch):
    scene, field, heights = lens()
    check_trace(scene, field, heights, kind, FILTERS[:3], launched, monkeypatch)


def test_plane_image_by_taylor(monkeypatch):
    """The remainder of first order is of second: (f(h + e d) - f(h) - e <g, d>) / e^2 does not depend on e."""
    monkeypatch.setenv("CAUSTIC_KERNELS", "cuda")
    scene, field, heights = lens()
    kernel = traced(scene, field, "lines", 100)(nullcontext)
    kernel.filter, along = Filter("cosine", (5, 5)), numbers(5, *heights.shape)
    by_image = numbers(6, *scene.screen.resolution)
    leaf = heights.clone().requires_grad_()
    image = kernel(leaf)[0]
    slope = float((torch.autograd.grad((image * by_image).sum(), leaf)[0] * along).sum())
    moved = (float(((kernel(heights + e * along)[0] - image.detach()) * by_image).sum()) for e in (2e-5, 1e-5))
    remainders = [m - e * slope for m, e in zip(moved, (2e-5, 1e-5), strict=True)]
    assert abs(remainders[0]) < 0.05 * abs(2e-5 * slope)
    assert remainders[0] / remainders[1] == pytest.approx(4.0, rel=0.1)


def test_plane_image_with_losses(launched, monkeypatch):
    """Total reflection, Fresnel losses and light beside the screen."""
    scene, field, heights = lens(bump=0.8)
    lost = check_trace(scene, field, heights, "lines", FILTERS[1:2], launched, monkeypatch)
    assert min(lost["total_internal_reflection"], lost["fresnel"], lost["off_screen"]) > 1e-3


@pytest.mark.parametrize("round_", [False, True])
def test_ray_image(round_, launched, monkeypatch):
    """Newton hits of a point's rays, and those that leave by the lens' side."""
    scene, field, heights = lens()
    scene = Scene(Points(((1.0, -2.0, -12.0),)), replace(scene.lens, aperture="circle" if round_ else "rectangle"), scene.screen)
    lost = check_trace(scene, field, heights, "stratified", FILTERS[:2], launched, monkeypatch)
    assert lost["missed_surface"] > 0.1
