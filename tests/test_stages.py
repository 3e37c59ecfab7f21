"""The stages of a trace as kernels, each against plain torch: values, adjoints and odd cases.

Bounds.  Both sides round differently, some 1e-16 per operation: values agree to 1e-13 of the largest, gradients to 1e-12 of their
norm.
"""

from __future__ import annotations

import pytest
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.interface import reflectance, reflectances, refract
from caustic_cli.optics.kernels import refraction
from caustic_cli.optics.kernels.grid import GridSurface
from caustic_cli.optics.kernels.refraction import interact
from caustic_cli.optics.kernels.splat import splat_rays
from caustic_cli.optics.kernels.transfer import land
from caustic_cli.optics.polarisation import polarisation_vector, s_fraction
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Screen

RAYS = 1500
SCREEN = Screen((6.0, 4.0), 40.0, (31, 20), shift=(0.3, -0.2))
TILTED = Screen((6.0, 4.0), 40.0, (31, 20), tilt=(20.0, -35.0), shift=(1.0, 2.0))
FILTERS = [
    Filter("cosine", (3, 3)),
    Filter("cosine", (1, 5)),
    Filter("cosine", (11, 3)),
    Filter("gaussian", (3, 3), (0.01, 0.02)),
    Filter("gaussian", (5, 3), (0.0, 2.6e-6)),
    Filter("gaussian", (3, 7), (0.3, 30.0)),
    Filter("cosine", (5, 1)),
]


def numbers(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def directions(seed: int, tilt: float = 0.3, count: int = RAYS) -> list[torch.Tensor]:
    dx, dy = tilt * numbers(seed, 2, count).clamp(-2.0, 2.0)
    return [dx, dy, torch.sqrt(1.0 - dx * dx - dy * dy)]


def flat(out) -> list[torch.Tensor]:
    """Tensors of a nested result."""
    return [out] if isinstance(out, torch.Tensor) else [t for part in out for t in flat(part)]


# Stages by name: (inputs, kernel, reference), functions of the inputs.


def plain_interact(d, g, power, *, eta, fresnel, field=None):
    t, passes, c, s = refract(d, *g, eta)
    if field is not None and fresnel == "exact":
        (rs, rp), part = reflectances(c, s, eta), s_fraction(field, d, (-g[0], -g[1], 1.0))
        lost = part * rs + (1.0 - part) * rp
    else:
        length = torch.sqrt(1.0 + g[0] ** 2 + g[1] ** 2)
        lost = reflectance(fresnel, c / length, s / length, eta)
    return t, torch.where(passes, power * (1.0 - lost), torch.zeros_like(power)), passes


def interaction(constant: bool = False, polarised: bool = False, **options):
    d = [] if constant else directions(1)
    field = directions(5) if polarised and not constant else []
    along = {"field": (0.6, 0.8, 0.0)} if polarised and constant else {}

    def by(function):
        def called(*ray):
            ray = list(ray)
            d_ = (0.0, 0.0, 1.0) if constant else tuple(ray[:3])
            gx, gy, power = ray[len(d) : len(d) + 3]
            e = {"field": tuple(ray[-3:])} if field else along
            return function(d_, (gx, gy), power, **options, **e)

        return called

    inputs = [*d, *(0.4 * numbers(2, 2, RAYS)), numbers(3, RAYS).abs(), *field]
    return inputs, by(interact), by(plain_interact)


def plain_land(o, d, point, axes, forward):
    along, up, normal = axes
    away = sum((p - c) * n for p, c, n in zip(point, o, normal, strict=True))
    speed = sum(c * n for c, n in zip(d, normal, strict=True))
    arrives = forward * speed > PARALLEL
    path = away / torch.where(arrives, speed, torch.ones_like(speed))
    on_way = arrives & (path > 0)
    path = torch.where(on_way, path, torch.zeros_like(path))
    r = [c + path * v - p for c, v, p in zip(o, d, point, strict=True)]
    x, y = (sum(c * a for c, a in zip(r, axis, strict=True)) for axis in (along, up))
    return x, y, on_way


def landing(screen: Screen, forward: float = 1.0, wild: bool = False):
    point, axes = (*screen.shift, forward * screen.z), screen.axes
    d = directions(1, 0.3)
    d[2] = forward * d[2]
    if wild:
        d = list(numbers(4, 3, RAYS))
        d = [c / torch.sqrt(sum(v * v for v in d)) for c in d]
    return (
        [*numbers(2, 3, RAYS), *d],
        lambda *r: land(r[:3], r[3:], point, axes, forward),
        lambda *r: plain_land(r[:3], r[3:], point, axes, forward),
    )


def splatting(filter: Filter):
    inputs = [2.2 * numbers(1, RAYS), 1.5 * numbers(2, RAYS), numbers(3, RAYS)]
    return inputs, lambda *r: splat_rays(*r, SCREEN, filter), lambda *r: splat(*r, SCREEN, filter)


def gridded(degree=(3, 2)):
    spaces, half = tuple(SplineSpace.uniform(n, p) for n, p in zip((12, 16), degree, strict=True)), (2.0, 1.5)
    u, v = torch.rand(37, dtype=torch.float64), torch.linspace(0.0, 1.0, 41, dtype=torch.float64)
    evaluate = HeightField(spaces, half).prepare(Sample(u, v, torch.tensor(1.0), True), torch.float64)
    return [numbers(1, 12, 16)], GridSurface(spaces, half, u, v), lambda h: tuple(t.reshape(-1) for t in evaluate(h))


CASES = {
    **{
        f"refract, {f}, eta {eta}": (interaction, {"eta": eta, "fresnel": f})
        for f in ("none", "schlick", "exact")
        for eta in (1.5, 1.0 / 1.5)
    },
    **{
        f"refract, {f}, plane wave": (interaction, {"constant": True, "eta": 1.5, "fresnel": f})
        for f in ("none", "schlick", "exact")
    },
    "refract, no other medium": (interaction, {"eta": 1.0, "fresnel": "exact"}),
    "polarised": (interaction, {"polarised": True, "eta": 1.5, "fresnel": "exact"}),
    "polarised, out of air": (interaction, {"polarised": True, "eta": 0.7, "fresnel": "exact"}),
    "polarised, plane wave": (
        interaction,
        {"constant": True, "polarised": True, "eta": 1.5, "fresnel": "exact"},
    ),
    "land": (landing, {"screen": SCREEN}),
    "land, tilted": (landing, {"screen": TILTED}),
    "land, back": (landing, {"screen": TILTED, "forward": -1.0}),
    "land, wild": (landing, {"screen": TILTED, "wild": True}),
    **{f"splat, {f.kind} {f.size} {f.alpha}": (splatting, {"filter": f}) for f in FILTERS},
    "grid": (gridded, {}),
    "grid, degree 10": (gridded, {"degree": (10, 10)}),
}


@pytest.fixture(params=CASES)
def case(request):
    make, options = CASES[request.param]
    return make(**options)


def differentiable(out) -> list[torch.Tensor]:
    return [t for t in flat(out) if t.dtype != torch.bool]


def test_values(case):
    inputs, kernel, reference = case
    for a, b in zip(flat(kernel(*inputs)), flat(reference(*inputs)), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        if a.dtype == torch.bool:
            assert torch.equal(a, b)
        else:
            assert float((a - b).abs().max()) <= 1e-13 * float(b.abs().max())


def test_gradients(case):
    inputs, kernel, reference = case
    gradients = []
    for function in (kernel, reference):
        leaves = [t.clone().requires_grad_() for t in inputs]
        outs = differentiable(function(*leaves))
        loss = sum((numbers(10 + k, *t.shape) * t).sum() for k, t in enumerate(outs))
        gradients.append(torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True))
    for a, b in zip(*gradients, strict=True):
        assert bool(torch.isfinite(a).all())
        assert float((a - b).norm()) <= 1e-12 * float(b.norm()) + 1e-20


def test_each_derivative_alone(case):
    """What one input's derivative is does not depend on whether others are wanted."""
    inputs, kernel, _ = case
    leaves = [t.clone().requires_grad_() for t in inputs]
    by = [numbers(10 + k, *t.shape) for k, t in enumerate(differentiable(kernel(*leaves)))]
    together = torch.autograd.grad(differentiable(kernel(*leaves)), leaves, by)
    for k, leaf in enumerate(leaves):
        outs = differentiable(kernel(*(leaf if i == k else t for i, t in enumerate(inputs))))
        touched = [(o, y) for o, y in zip(outs, by, strict=True) if o.requires_grad]
        (alone,) = torch.autograd.grad([o for o, _ in touched], leaf, [y for _, y in touched])
        torch.testing.assert_close(alone, together[k], rtol=0, atol=0)


def test_torch_func(case):
    inputs, kernel, _ = case

    def called(*t):
        return tuple(differentiable(kernel(*t)))

    outs, pull = torch.func.vjp(called, *inputs)
    by = tuple(numbers(10 + k, *t.shape) for k, t in enumerate(outs))
    leaves = [t.clone().requires_grad_() for t in inputs]
    for a, b in zip(pull(by), torch.autograd.grad(called(*leaves), leaves, by), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("count", [0, 1, 127, 129, 513])
@pytest.mark.parametrize("name", [name for name, (make, _) in CASES.items() if make is not gridded])
def test_few_rays(name, count):
    """None, one, and a few more or less than a batch or a row of them."""
    make, options = CASES[name]
    inputs, kernel, reference = make(**options)
    leaves = [t[:count].clone().requires_grad_() for t in inputs]
    outs, expected = flat(kernel(*leaves)), flat(reference(*(t[:count] for t in inputs)))
    for a, b in zip(outs, expected, strict=True):
        torch.testing.assert_close(a.detach(), b, rtol=1e-12, atol=1e-12)
    outs = [o for o in outs if o.requires_grad]
    gradients = torch.autograd.grad(outs, leaves, [torch.ones_like(o) for o in outs], allow_unused=True, materialize_grads=True)
    assert all(bool(torch.isfinite(g).all()) and g.shape == (count,) for g in gradients)


def test_two_threads_give_the_same(case):
    inputs, kernel, _ = case
    results = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            leaves = [t.clone().requires_grad_() for t in inputs]
            outs = differentiable(kernel(*leaves))
            results.append([*(o.detach() for o in outs), *torch.autograd.grad(sum(o.sum() for o in outs), leaves)])
    finally:
        torch.set_num_threads(1)
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13 * float(b.abs().max()))


@pytest.mark.parametrize(
    "options",
    [
        {"fresnel": "schlick"},
        {"fresnel": "exact"},
        {"fresnel": "exact", "field": (0.6, 0.8, 0.0)},
        {"fresnel": "none"},
    ],
    ids=str,
)
@pytest.mark.parametrize("eta", [1.5, 0.7])
def test_light_against_the_normal(eta, options):
    """The same as in the scene turned over, z -> -z, where it runs along the normal: d_z, E_z and the slopes change sign."""
    options = {"eta": eta} | options
    d, g, power = directions(1), list(0.4 * numbers(2, 2, RAYS)), numbers(3, RAYS).abs()
    d[2] = -d[2]
    results = []
    for turned in (False, True):
        leaves = [t.clone().requires_grad_() for t in (*d, *g, power)]
        dx, dy, dz, gx, gy, p = leaves
        if turned:
            (tx, ty, tz), after, passes = plain_interact((dx, dy, -dz), (-gx, -gy), p, **options)
            tz = -tz
        else:
            (tx, ty, tz), after, passes = interact((dx, dy, dz), (gx, gy), p, **options)
        loss = sum((numbers(10 + k, RAYS) * t).sum() for k, t in enumerate((tx, ty, tz, after)))
        results.append(([t.detach() for t in (tx, ty, tz, after)], passes, torch.autograd.grad(loss, leaves)))
    (values, passes, gradients), (values_, passes_, gradients_) = results
    assert torch.equal(passes, passes_)
    assert bool(passes.any())
    for a, b in zip(values, values_, strict=True):
        assert float((a - b).abs().max()) <= 1e-13 * float(b.abs().max())
    for a, b in zip(gradients, gradients_, strict=True):
        assert float((a - b).norm()) <= 1e-12 * float(b.norm())


def test_total_reflection_passes_nothing_and_stays_finite():
    gx = torch.tensor([0.0, 0.8, 0.95, 5.0, 1e3], dtype=torch.float64)  # of index 1.5 the critical slope is 0.894
    for fresnel in ("none", "schlick", "exact"):
        leaves = [t.clone().requires_grad_() for t in (gx, 0.0 * gx, torch.ones_like(gx))]
        t, after, passes = interact((0.0, 0.0, 1.0), leaves[:2], leaves[2], eta=1.5, fresnel=fresnel, field=None)
        assert passes.tolist() == [True, True, False, False, False]
        assert after.detach()[2:].tolist() == [0.0, 0.0, 0.0]
        gradients = torch.autograd.grad(sum(c.sum() for c in t) + after.sum(), leaves)
        assert all(bool(torch.isfinite(v).all()) for v in (*t, *gradients))
        assert gradients[2][2:].tolist() == [0.0, 0.0, 0.0]


def test_directions_are_of_unit_length_and_power_is_kept_without_losses():
    (*d, gx, gy, power), _, _ = interaction(eta=1.5, fresnel="none")
    t, after, passes = interact(tuple(d), (gx, gy), power, eta=1.5, fresnel="none")
    length = sum(c * c for c in t)[passes]
    assert not bool(passes.all())
    torch.testing.assert_close(length, torch.ones_like(length), rtol=0, atol=1e-14)
    assert torch.equal(after, torch.where(passes, power, torch.zeros_like(power)))


def test_without_power_nothing_is_lost():
    (*d, gx, gy, power), _, _ = interaction(eta=1.5, fresnel="exact")
    leaves = [gx.requires_grad_(), gy.requires_grad_()]
    _, after, _ = interact(tuple(d), leaves, torch.zeros_like(power), eta=1.5, fresnel="exact")
    assert not bool(after.any())
    assert not any(bool(g.any()) for g in torch.autograd.grad(after.sum(), leaves))


def test_polarised_light_in_normal_incidence_is_any_light():
    """Without a plane of incidence half of the light counts as s-polarised, and nothing is divided by zero."""
    none, one = torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    results = []
    for field in (None, polarisation_vector(30.0, (0.0, 0.0, 1.0)), tuple(one * c for c in (0.6, 0.8, 0.0))):
        leaves = [t.clone().requires_grad_() for t in (none, none, one)]
        t, after, _ = interact((0.0, 0.0, 1.0), leaves[:2], leaves[2], eta=1.5, fresnel="exact", field=field)
        results.append([after.detach(), *torch.autograd.grad(after.sum() + t[0].sum(), leaves)])
    assert float(results[0][0][0]) == pytest.approx(0.96, rel=1e-15)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-15, atol=0)


def test_a_field_that_losses_do_not_heed_has_no_derivative():
    (*d, gx, gy, power), _, _ = interaction(eta=1.5, fresnel="none")
    field = [c.requires_grad_() for c in directions(5)]
    for fresnel in ("none", "schlick"):
        t, after, _ = interact(tuple(d), (gx, gy), power, eta=1.5, fresnel=fresnel, field=tuple(field))
        assert not any(c.requires_grad for c in (*t, after))


def test_an_upright_plane_loses_no_digits():
    """Along z a ray keeps its x and y exactly, however far the screen is."""
    x, y, z = numbers(1, 3, RAYS)
    px, py, on_way = land((x, y, z), (0.0, 0.0, 1.0), (0.0, 0.0, 1e6), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 1.0)
    assert bool(on_way.all())
    assert torch.equal(px, x)
    assert torch.equal(py, y)


def test_rays_that_never_arrive_stay_where_they_are():
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    dz = torch.tensor([1.0, -1.0, 0.0, 1e-10, float("nan")], dtype=torch.float64, requires_grad=True)
    o = [torch.full((5,), c, dtype=torch.float64, requires_grad=True) for c in (2.0, 3.0, 4.0)]
    for z, forward, arrive in ((10.0, 1.0, [0]), (-10.0, 1.0, []), (-10.0, -1.0, [1]), (4.0, 1.0, [])):
        x, y, on_way = land(o, (0.1, 0.2, dz), (0.0, 0.0, z), axes, forward)
        assert on_way.nonzero().flatten().tolist() == arrive
        away = ~on_way & torch.isfinite(dz)
        assert bool((x.detach()[away] == 2.0).all())
        assert bool((y.detach()[away] == 3.0).all())
        gradients = torch.autograd.grad((x + y)[:4].sum(), [*o, dz])
        assert all(bool(torch.isfinite(g[:4]).all()) for g in gradients)
        assert gradients[0].tolist() == [1.0] * 4 + [0.0]


@pytest.mark.parametrize("filter", [Filter(), *FILTERS], ids=str)
def test_splat_conserves_power(filter):
    (x, y, weight), _, _ = splatting(filter)
    x[:4] = torch.tensor([float("nan"), float("inf"), -1e300, 2.9], dtype=torch.float64)
    x.requires_grad_()
    image, off = splat_rays(x, y, weight, SCREEN, filter)
    expected, off_ = splat(x, y, weight, SCREEN, filter)
    assert float((image.sum() + off).detach()) == pytest.approx(float(weight.sum()), rel=1e-12)
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-13 * float(expected.detach().abs().max()))
    torch.testing.assert_close(off, off_, rtol=1e-13, atol=0)
    (gradient,) = torch.autograd.grad((image * numbers(1, *image.shape)).sum(), x)
    assert bool(torch.isfinite(gradient).all())
    assert gradient[:3].tolist() == [0.0, 0.0, 0.0]


def test_a_bincount_has_no_derivative_by_the_landing_points():
    x, y, weight = (t.requires_grad_() for t in splatting(Filter())[0])
    by = numbers(1, *SCREEN.resolution)
    pairs = []
    for function in (splat_rays, splat):
        image, off = function(x, y, weight, SCREEN, Filter())
        loss = (by * image).sum() + 0.3 * off
        pairs.append(torch.autograd.grad(loss, (x, y, weight), allow_unused=True, materialize_grads=True))
    for a, b in zip(*pairs, strict=True):
        assert torch.equal(a, b)


def test_numbers_and_tensors_share_one_compiled_kernel():
    for options in ({"constant": True}, {}, {"polarised": True}):
        inputs, kernel, _ = interaction(**options, eta=1.5, fresnel="exact")
        leaves = [t.requires_grad_() for t in inputs]
        t, after, _ = kernel(*leaves)
        (sum(c.sum() for c in t) + after.sum()).backward()
    for kernel in refraction.REFRACT.kernels:
        assert len(kernel.signatures) == 1


def test_a_second_derivative_is_refused():
    (*d, gx, gy, power), _, _ = interaction(eta=1.5, fresnel="none")
    gx.requires_grad_()
    t, _, _ = interact(tuple(d), (gx, gy), power, eta=1.5, fresnel="none")
    (first,) = torch.autograd.grad((t[0] * t[0]).sum(), gx, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()
