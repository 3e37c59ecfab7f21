"""Plane waves from any direction, through lenses and off mirrors: kernel, energy, start, wave image and screen, each against an
independent way."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from scipy.interpolate import NdBSpline
from scipy.ndimage import gaussian_filter

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.inverse.projection import BeamProjection
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.beam import Beam
from caustic_cli.optics.effects import EFFECTS
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.interface import interact, slopes_inside
from caustic_cli.optics.misalignment import Misalignment, landing_points
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose, tracers
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Component, Disc, FoldMirror, FreeForm, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.screen import tilt_to, tilted
from caustic_cli.studies.gradmap import finite_difference, gradient_image
from caustic_cli.studies.independent_rays import sample_rays
from caustic_cli.studies.metrics import relative_rms

FILTER = Filter("cosine", (3, 3))
STEP = 1e-6
TILTS = [(20.0, 0.0), (30.0, -25.0), (0.0, -60.0)]


def scene(tilt, throw: float = 60.0, wide: float = 36.0, pixels: int = 30, **lens) -> Scene:
    """A screen square to the light, `throw` mm along it from the lens' origin, or along the light that a flat mirror reflects."""
    usual = {"size": (10.0, 12.0), "z_in": -1.0, "control": (9, 8), "degree": (3, 4), "index": 1.5, "offset": Offset(4.0)}
    lens = Lens(**usual | lens)
    side, (x, y, z) = lens.interaction.side, (throw * c for c in tilted(tilt)[2])
    lean = tuple(side * angle for angle in tilt)
    return Scene(PlaneWave(tilt=tilt), lens, Screen((wide, wide), side * z, (pixels, pixels + 4), tilt=lean, shift=(x, y)))


def unit(at: tuple[int, int]) -> torch.Tensor:
    """A change of one control height, and its opposite, (2, 9, 8)."""
    change = torch.zeros((2, 9, 8), dtype=torch.float64)
    change[:, *at] = torch.tensor([1.0, -1.0], dtype=torch.float64)
    return change


def heights(rough: float = 0.03, seed: int = 0) -> torch.Tensor:
    return 4.0 + rough * torch.randn((9, 8), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def reference(scene: Scene, beam: Beam, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Image and power behind the lens, or before the mirror, in plain torch, differentiable."""
    field, n, fresnel = HeightField.of(scene.lens), scene.lens.inside, scene.lens.interior.fresnel
    sag, *slopes = (c.reshape(beam.sample.shape) for c in field.prepare(beam.sample, torch.float64)(z))
    direction, power = beam.rays(sag - scene.pupil.z, slopes, n, fresnel)
    out = interact(direction, slopes, power, eta=n, reflects=scene.lens.mirror, fresnel=fresnel)
    to = Receiver.on_axis(scene.screen, (0.0, 0.0, 1.0))
    at = [c.expand(sag.shape) - m for c, m in zip((*beam.points(), sag), to.middle, strict=True)]
    on = lambda vector, e: sum(v * c for v, c in zip(vector, e, strict=True))  # noqa: E731
    t = -on(at, to.axes[2]) / on(out.direction, to.axes[2])
    x, y = (on(at, e) + t * on(out.direction, e) + s for e, s in zip(to.axes, to.at, strict=False))
    return splat(x.reshape(-1), y.reshape(-1), out.power.reshape(-1), scene.screen, FILTER)[0], out.power.sum()


@pytest.mark.parametrize("kind", ["lines", "stratified"])
@pytest.mark.parametrize(
    ("tilt", "fresnel", "rough", "mirror"),
    [
        (TILTS[0], "exact", 0.03, False),
        (TILTS[1], "schlick", 0.03, False),
        (TILTS[2], "exact", 0.6, False),
        ((0.0, 45.0), "exact", 0.03, True),
        (TILTS[1], "schlick", 0.3, True),
        ((-75.0, 0.0), "none", 0.03, True),
    ],
)
@pytest.mark.parametrize("faces", [True, False])
def test_value_and_gradient_of_the_kernel(tilt, fresnel, rough, mirror, kind, faces):
    """Against the reference; with rough 0.6 some rays are totally reflected.  The normal of the screen is along the light or, where
    it does not face it, within 90 degrees of it."""
    lit, z = scene(tilt, fresnel=fresnel, mirror=mirror), heights(rough).requires_grad_()
    if not faces:
        lit = replace(lit, screen=replace(lit.screen, tilt=(0.0, 0.0)))
    (beam,) = rays_of(lit, kind, 1500, seed=3).pencils()
    traced = Tracer(System.of(lit, HeightField.of(lit.lens)), beam)
    assert type(traced.fused).__name__ == "BeamImage"
    pull = torch.randn(lit.screen.resolution, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    part, results = traced.expose({EXIT: z}, lit.screen, FILTER), []
    for image, leaving in ((part.image, part.leaving), reference(lit, beam, z)):
        results += [image.detach(), leaving.detach(), torch.autograd.grad((image * pull).sum() + 0.3 * leaving, z)[0]]
    image, leaving, gradient, image_, leaving_, gradient_ = results
    assert (float(part.lost["total_internal_reflection"]) > 0) == (rough > 0.1 and not mirror)
    torch.testing.assert_close(image, image_, rtol=0, atol=1e-10 * float(image_.max()))
    assert float(leaving) == pytest.approx(float(leaving_), rel=1e-10)
    assert float((gradient - gradient_).norm()) <= 1e-9 * float(gradient_.norm())


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("round", [False, True])
@pytest.mark.parametrize("tilt", TILTS)
def test_energy_and_image_are_those_of_rays_from_the_entrance(tilt, round, mirror):
    """Rays through the entrance, intersected one by one, are the independent measure; some leave through the sides of a lens, and
    few miss a mirror, whose aperture lies on its surface."""
    lit = scene(tilt, mirror=mirror, **({"size": (10.0, 10.0), "aperture": "circle"} if round else {}))
    field, z = HeightField.of(lit.lens), heights()
    ours = expose(lit, field, z, rays_of(lit, "grid", 400_000), FILTER)
    assert float(ours.image.sum()) + sum(ours.lost.values()) == pytest.approx(1.0, abs=1e-12)
    system, image, lost = System.of(lit, field), 0.0, {}
    for state in rays_of(lit, "sobol", 1 << 18).chunks():
        part = Tracer(system, state).collect(Tracer(system, state)({EXIT: z}), lit.screen, FILTER)
        image, lost = image + part.image, {name: lost.get(name, 0.0) + float(v) for name, v in part.lost.items()}
    assert lost["missed_surface"] < 0.01 if mirror else lost["missed_surface"] > 0.05
    for name, value in lost.items():
        assert ours.lost[name] == pytest.approx(value, abs=1e-3)
    assert float((ours.image - image).norm()) < 6e-3 * float(image.norm())


def test_gradient_on_a_mirror_is_that_of_differences():
    """By the kernel and by `gradmap`, of one height away from the edge, which light crosses at its own height."""
    lit, z = scene((20.0, 45.0), mirror=True), heights().requires_grad_()
    field, rays, at = HeightField.of(lit.lens), rays_of(lit, "lines", 40_000), (4, 3)
    pull = torch.randn(lit.screen.resolution, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (beam,) = rays.pencils()
    image = Tracer(System.of(lit, field), beam).expose({EXIT: z}, lit.screen, FILTER).image
    (slope,), z = torch.autograd.grad((image * pull).sum(), z), z.detach()
    expected = finite_difference(lit, field, z, at, sampler=rays, filter=FILTER)
    own = gradient_image(lit, field, z, at, sampler=rays, filter=FILTER)
    assert float((own - expected).norm()) < 1e-6 * float(expected.norm())
    by_kernel = [expose(lit, field, z + h, rays, FILTER).image for h in STEP * unit(at)]
    assert float(slope[at]) == pytest.approx(float(((by_kernel[0] - by_kernel[1]) * pull).sum()) / (2.0 * STEP), rel=1e-5)


def traced(lit: Scene, z: torch.Tensor, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Image and sums of squares of the powers of random rays: Snell's law in vectors, Newton's method on SciPy's spline, the law of
    reflection and the plane of the screen, in NumPy alone."""
    lens, d, rng = lit.lens, np.array(lit.source.axis), np.random.default_rng(0)
    half = np.array(lens.half_size)
    sides = zip(half, lens.degree, z.shape, strict=True)
    knots = tuple(np.r_[[-h] * p, np.linspace(-h, h, n - p + 1), [h] * p] for h, p, n in sides)
    surface = NdBSpline(knots, z.numpy(), lens.degree)
    o, power, index = np.c_[rng.uniform(-half, half, (rays, 2)), np.full(rays, lit.pupil.z)], np.full(rays, 1.0 / rays), 1.0

    def through(normal, before, after):
        """Direction beyond a surface with a unit normal along the light, (N, 3), and the transmittance."""
        cosine = (d * normal).sum(-1, keepdims=True)
        beyond = np.sqrt(np.maximum(1.0 - (before / after) ** 2 * (1.0 - cosine**2), 0.0))
        s, p = ((a * cosine - b * beyond) / (a * cosine + b * beyond) for a, b in ((before, after), (after, before)))
        return before / after * (d - cosine * normal) + beyond * normal, 1.0 - 0.5 * (s**2 + p**2)[..., 0]

    if not lens.mirror:
        d, passed = through(np.array([[0.0, 0.0, 1.0]]), 1.0, index := lens.index)
        power = power * passed
    d = np.broadcast_to(d, o.shape)
    t = (4.0 - o[:, 2]) / d[:, 2]
    for last in (False,) * 6 + (True,):
        at = o + t[:, None] * d
        inside = (abs(at[:, :2]) <= half).all(1)
        on = np.clip(at[:, :2], -half, half)
        slope = [surface(on, nu=nu) for nu in ((1, 0), (0, 1))]
        if not last:
            t = t - (at[:, 2] - surface(on)) / (d[:, 2] - slope[0] * d[:, 0] - slope[1] * d[:, 1])
    normal = np.c_[-slope[0], -slope[1], np.ones(rays)] / np.sqrt(1.0 + slope[0] ** 2 + slope[1] ** 2)[:, None]
    if lens.mirror:
        d = d - 2.0 * (d * normal).sum(1)[:, None] * normal
    else:
        d, passed = through(normal, index, 1.0)
        power = power * passed
    x, y, across = map(np.array, lit.screen.axes)
    away = np.array([*lit.screen.shift, lit.screen.z]) - at
    landed = ((away @ across) / (d @ across))[:, None] * d - away
    counts = [
        np.histogram2d(landed @ x, landed @ y, lit.screen.resolution, [[-r, r] for r in lit.screen.half_size], weights=w * inside)[
            0
        ]
        for w in (power, power**2)
    ]
    return counts[0], counts[1]


@pytest.mark.parametrize(
    ("tilt", "mirror"),
    [((20.0, 0.0), False), ((0.0, -40.0), False), ((45.0, 48.0), False), ((0.0, 45.0), True), ((-30.0, 20.0), True)],
)
def test_an_independent_tracer_agrees(tilt, mirror):
    """Within its noise, at 20, 40 and 62 degrees: the mean square of the deviation of a pixel over its standard deviation."""
    lit, z = scene(tilt, wide=24.0 if mirror else 15.0, pixels=40, mirror=mirror), heights(0.06)
    image, squares = traced(lit, z, 300_000)
    ours = expose(lit, HeightField.of(lit.lens), z, rays_of(lit, "stratified", 20_000_000), Filter()).image.numpy()
    each = squares.sum() / image.sum()
    lit_by = ours > 25.0 * each
    deviation = (image - ours)[lit_by] / np.sqrt(ours[lit_by] * each)
    assert lit_by.sum() > 700, float((deviation**2).mean())
    assert 0.9 < float((deviation**2).mean()) < 1.1


def test_a_tilted_wave_is_a_wave_with_a_tilted_direction():
    """The tolerance of the direction turns rays that were sampled along the axis."""
    lit, z = scene(TILTS[1]), heights()
    straight = replace(lit, source=PlaneWave())
    field, errors = HeightField.of(lit.lens), Misalignment(source_tilt=TILTS[1])
    found = list(landing_points(straight, field, z, rays_of(straight, "grid", 40_000), errors))
    x, y, power = (torch.cat([getattr(part, name) for part in found]) for name in ("x", "y", "power"))
    other, off = splat(x, y, power, replace(lit.screen, shift=(0.0, 0.0)), FILTER)
    image = expose(lit, field, z, rays_of(lit, "grid", 40_000), FILTER).image
    assert float(off) < 1e-9
    assert float(other.sum()) == pytest.approx(float(image.sum()), rel=3e-3)
    assert float((other - image).norm()) < 0.02 * float(image.norm())


@pytest.mark.parametrize(
    "beside",
    [
        {"lens": {"gradient": Gradient("axial", (0.02,))}},
        {"lens": {"gradient": Gradient("radial", (-0.002,))}},
        {"lens": {"entrance": FreeForm(0.02 * np.random.default_rng(0).standard_normal((8, 8)), (3, 3))}},
        {"elements": (Component(30.0, (40.0, 40.0), radius=(60.0, 60.0), thickness=4.0, index=1.5),)},
        {"elements": (FoldMirror(50.0, (60.0, 60.0), tilt=(45.0, 0.0)),)},
    ],
    ids=["axial gradient", "radial gradient", "two sides", "another lens", "fold mirror"],
)
def test_light_at_an_angle_through_whatever_else_a_scene_has(beside):
    """It is that of a point far away, which is traced as light of a near source is."""
    lens = replace(scene((0.0, 0.0), z_in=0.0, offset=Offset(5.0)).lens, **beside.get("lens", {}))
    plain = Scene(PlaneWave(), lens, Screen((40.0, 40.0), 100.0, (20, 20)), elements=beside.get("elements", ()))
    field, z, images = HeightField.of(lens), 1.0 + heights(), []
    wave = PlaneWave(tilt=(8.0, -5.0))
    for source in (wave, Points((tuple(-1e6 * c for c in wave.axis),))):
        lit = replace(plain, source=source)
        found = expose(lit, field, z, rays_of(lit, "stratified", 400_000))
        assert float(found.image.sum()) + sum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)
        images.append(found.image.numpy() / (1.0 - found.lost["missed_lens"]))
    assert images[0].sum() == pytest.approx(images[1].sum(), rel=1e-3) and images[0].sum() > 0.3
    assert relative_rms(*images) < 0.03


@pytest.mark.parametrize(("tilt", "mirror"), [((0.0, 40.0), False), ((-50.0, 20.0), False), ((0.0, 45.0), True)])
def test_wave_image(tilt, mirror):
    """Blurred to the width of diffraction, it is the ray image; it is worse by rays along the axis."""
    more = {"mirror": mirror, "offset": Offset(5.0)}
    lit = scene(tilt, 300.0, 20.0, 96, size=(10.0, 10.0), z_in=0.0, control=(24, 24), degree=(3, 3), **more)
    field = HeightField.of(lit.lens)
    x, y = (c.numpy() for c in field.control_xy())
    x, y = np.meshgrid(x, y, indexing="ij")
    relief = -0.001 * (x**2 + y**2) + 0.004 * np.sin(0.9 * x + 0.5) * np.cos(0.7 * y)
    z = torch.from_numpy(5.0 + relief * (-0.35 if mirror else 1.0))
    light = wave_image(lit, field, z, wavelengths=(540.0, 550.0, 560.0)).image.numpy()
    rays = expose(lit, field, z, rays_of(lit, "grid", 400_000)).image.numpy()
    assert light.sum() == pytest.approx(rays.sum(), rel=3e-3)
    blurred = [gaussian_filter(image, 2.0) for image in (light, rays)]
    assert np.linalg.norm(blurred[0] - blurred[1]) < 0.02 * np.linalg.norm(blurred[1])


@pytest.mark.parametrize(
    ("tilt", "most", "mirror", "aperture"),
    [
        ((0.0, 0.0), 0.12, False, "rectangle"),
        ((20.0, 0.0), 0.14, False, "rectangle"),
        ((0.0, -40.0), 0.16, False, "rectangle"),
        ((0.0, -40.0), 0.16, False, "circle"),
        ((0.0, 0.0), 0.05, True, "rectangle"),
        ((45.0, 0.0), 0.06, True, "rectangle"),
        ((45.0, 0.0), 0.06, True, "circle"),
        ((30.0, -50.0), 0.1, True, "rectangle"),
        ((0.0, 75.0), 0.06, True, "rectangle"),
    ],
)
def test_start_by_transport(tilt, most, mirror, aperture):
    """A smooth picture on a screen square to the light is nearly reached by the first surface; a screen across the axis is not.
    From a round aperture, at most at twice the error, as in light along the axis."""
    more = {"mirror": mirror, "offset": Offset(5.0), "aperture": aperture}
    lit = scene(tilt, 300.0, 36.0, 60, size=(10.0, 10.0), z_in=0.0, control=(103, 103), degree=(3, 3), **more)
    lit = replace(lit, screen=replace(lit.screen, resolution=(60, 60)))
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 60)] * 2, indexing="ij")
    target = np.exp(-3.0 * ((x - 0.1) ** 2 + (y + 0.2) ** 2)) * (np.maximum(abs(x), abs(y)) < 0.8)
    field = HeightField.of(lit.lens)
    z = first_surface(lit, target, field, 200).heights
    image = expose(lit, field, z, rays_of(lit, "stratified", 400_000)).image.numpy()
    assert relative_rms(image, target * image.sum() / target.sum()) < most * (2.0 if aperture == "circle" else 1.0)


@pytest.mark.parametrize("mirror", [False, True])
def test_the_slope_of_a_plane_surface_sends_the_light_to_the_middle_of_the_screen(mirror):
    """By a twentieth of the way there, to first order."""
    lit = scene((20.0, -40.0), 300.0, 60.0, 30, size=(1.0, 1.0), mirror=mirror, offset=Offset(0.0), z_in=0.0)
    (x, y), lens = lit.screen.shift, lit.lens
    lit = replace(lit, screen=replace(lit.screen, shift=(x + 14.0, y - 9.0)))
    leans = BeamProjection(lit.screen, 0.0, lens.interaction.side, lit.source.axis).lean(lens.effective_index)
    field = HeightField.of(lens)
    at = zip(leans, field.control_xy(), ((-1, 1), (1, -1)), strict=True)
    z = sum(slope * c.reshape(shape) for slope, c, shape in at) + torch.zeros(field.shape, dtype=torch.float64)
    image = expose(lit, field, z + (0.0 if mirror else 0.1), rays_of(lit, "grid", 10_000), FILTER).image.numpy()
    i, j = np.indices(image.shape)
    middle = [
        float((k * image).sum() / image.sum() - 0.5 * (n - 1)) * w
        for k, n, w in zip((i, j), image.shape, lit.screen.pixel, strict=True)
    ]
    assert math.hypot(*middle) < 0.06 * math.hypot(14.0, 9.0)


def turned(screen: Screen) -> tuple[Screen, Screen]:
    """The same rectangle with its normal against the light, turned over about its x axis, and with its x axis along its y."""
    x, y, z = screen.axes
    over = replace(screen, tilt=tilt_to(x, (-z[0], -z[1], -z[2])))
    return over, replace(screen, tilt=tilt_to(y, z), resolution=screen.resolution[::-1], size=screen.size[::-1])


@pytest.mark.parametrize("mirror", [False, True])
def test_a_profile_is_that_over_the_aperture(mirror):
    """Whatever the angle: a flat lens throws it on a screen parallel to it, displaced, and a flat mirror, too."""
    profile = np.array([[1.0, 2.0, 0.5], [0.0, 3.0, 1.0]])
    lit = scene((30.0, -25.0), 20.0, 20.0, mirror=mirror, z_in=0.0, offset=Offset(0.0 if mirror else 1e-3), min_thickness=0.0)
    x, y, z = lit.source.axis
    reach = 30.0 / z
    lit = replace(
        lit,
        source=replace(lit.source, profile=profile),
        screen=Screen(lit.lens.size, 30.0 * lit.lens.interaction.side, profile.shape, shift=(reach * x, reach * y)),
    )
    flat = torch.full((9, 8), 0.0 if mirror else 1e-3, dtype=torch.float64)
    found = expose(lit, HeightField.of(lit.lens), flat, rays_of(lit, "stratified", 200_000), Filter())
    image = found.image.numpy()
    assert image.sum() + sum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)
    assert image / image.sum() == pytest.approx(profile / profile.sum(), abs=3e-3)


@pytest.mark.parametrize("kind", ["lines", "sobol"])
@pytest.mark.parametrize("source", [PlaneWave(), PlaneWave(tilt=TILTS[1]), Disc(angle=2.0, tilt=TILTS[1])])
def test_screens_in_any_plane(source, kind):
    """An image is that of the same rectangle with other axes, reordered."""
    lit = replace(scene(source.tilt), source=source)
    field, z = HeightField.of(lit.lens), heights()
    image, over, along = (
        expose(one, field, z, rays_of(one, kind, 40_000), FILTER).image
        for one in (lit, *(replace(lit, screen=screen) for screen in turned(lit.screen)))
    )
    for other in (over.flip(1), along.T.flip(0)):
        torch.testing.assert_close(image, other, rtol=0, atol=1e-12 * float(image.max()))


def test_wave_images_on_screens_in_any_plane():
    lit = scene((20.0, 0.0), 300.0, 20.0, 48, size=(10.0, 10.0), z_in=0.0, control=(24, 24), degree=(3, 3))
    lit = replace(lit, screen=replace(lit.screen, tilt=(5.0, 8.0)))
    field = HeightField.of(lit.lens)
    x, y = (c.numpy() for c in field.control_xy())
    z = torch.from_numpy(5.0 - 0.001 * (x[:, None] ** 2 + y[None, :] ** 2))
    image, over, along = (
        wave_image(replace(lit, screen=screen), field, z, wavelengths=(550.0,)).image
        for screen in (lit.screen, *turned(lit.screen))
    )
    for other in (over.flip(1), along.T.flip(0)):
        assert float((image - other).norm()) < 0.02 * float(image.norm())


def test_a_screen_along_the_light_is_refused():
    lit = scene((40.0, 0.0))
    with pytest.raises(InputError, match="parallel to the light"):
        replace(lit, screen=replace(lit.screen, tilt=(-50.0, 0.0)))


@pytest.mark.parametrize("angles", [(10.0, 20.0, 30.0), (-80.0, 170.0, 5.0), (90.0, 0.0, 30.0), (-90.0, 0.0, -140.0)])
def test_rotations_to_axes(angles):
    x, _, z = tilted(angles)
    assert tilt_to(x, z) == pytest.approx(angles, abs=1e-12)


@pytest.mark.parametrize("mirror", [False, True])
def test_effects_of_a_screen_are_told_from_its_place_in_the_light(mirror):
    """A screen square to tilted light and centred on it has no effects of its own; one in another place is moved there without."""
    lit = scene((30.0, 20.0), mirror=mirror)
    decided = [(effect, effect.decide(lit, None)) for effect in EFFECTS if effect.name in ("screen-tilt", "screen-shift")]
    assert [decision.on for _, decision in decided] == [False, False]
    (x, y), (a, b) = lit.screen.shift, lit.screen.tilt
    moved = replace(lit, screen=replace(lit.screen, shift=(x + 3.0, y), tilt=(a, b + 10.0)))
    for effect, _ in decided:
        assert effect.decide(moved, None).on
        moved = effect.without(moved)
    np.testing.assert_allclose(moved.screen.shift, lit.screen.shift, rtol=0, atol=1e-9)
    np.testing.assert_allclose(moved.screen.tilt, lit.screen.tilt, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "source",
    [
        Disc(angle=0.5333, tilt=(30.0, 20.0)),
        Disc(angle=40.0, tilt=(-30.0, 25.0)),
        Disc(angle=30.0, tilt=(40.0, -20.0), brightness=np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 5.0]])),
    ],
)
def test_a_tilted_disc_lights_the_aperture_by_the_cosine(source):
    """Moments of the directions against rays weighted one by one."""
    lit = replace(scene((0.0, 0.0)), source=source)
    drawn = [state.expanded() for state in rays_of(lit, "sobol", 1 << 17).chunks()]
    d = np.concatenate([torch.stack(state.full(state.direction)).numpy() for state in drawn], 1)
    power = np.concatenate([state.power.numpy() for state in drawn])
    assert power.sum() == pytest.approx(1.0, abs=1e-12) and np.abs(np.linalg.norm(d, axis=0) - 1.0).max() < 1e-12
    (_, other, weight), *_ = sample_rays(lit, 1 << 20, np.random.default_rng(0))
    for i, j in ((0, 0), (1, 1), (0, 1), (2, 2), (0, 2), (1, 2)):
        value = weight * other[i] * other[j]
        noise = value.std() / math.sqrt(len(weight)) + 2e-6
        assert (power * d[i] * d[j]).sum() == pytest.approx(value.mean(), abs=4.0 * noise)


def test_light_inside_obeys_snells_law():
    d = tilted((35.0, -20.0))[2]
    kx, ky = slopes_inside(d, 1.5)
    inside = np.array([kx, ky, 1.0]) / math.hypot(kx, ky, 1.0)
    assert 1.5 * inside[:2] == pytest.approx(d[:2], abs=1e-15)


def test_normal_incidence_is_untouched():
    """A tilt of 0 is the plane wave of old, with its own kernel."""
    lit = scene((0.0, 0.0))
    assert lit.source.collimated and lit.source.emission == "plane"
    traced = next(tracers(lit, HeightField.of(lit.lens), rays_of(lit, "lines", 100), torch.float64, 1 << 10))
    assert type(traced.fused).__name__ == "PlaneImage"


def written(*source: str) -> dict:
    """[source] of a file, and a second [[source]], each with these lines."""
    one = "\n".join(source)
    return settings.parse(f"[[source]]\n{one}\n[[source]]\n{one}\n", "a.toml")["source"]


@pytest.mark.parametrize("vector", [(0.0, 0.0, 2.0), (1.0, 0.0, 1.0), (-3.0, 40.0, 20.0)])
def test_a_direction_as_a_vector(vector):
    source = written(f"direction = {list(vector)}")
    for table in (source, *source["also"]):
        assert "direction" not in table
        assert PlaneWave(tilt=tuple(table["tilt"])).axis == pytest.approx(np.array(vector) / np.linalg.norm(vector), abs=1e-15)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["direction = [0, 0, 0]"], "z > 0"),
        (["direction = [0, 1, -1]"], "z > 0"),
        (["direction = [1, 0, 0]"], "within 80 degrees"),
        (["direction = [nan, 0, 1]"], "a number"),
        (["direction = [0, 0, inf]"], "finite"),
        (["direction = [[0, 0, 1], [0, 1, 1]]"], "one finite vector"),
        (["direction = [0, 1]"], "x, y, z"),
        (["direction = [0, 1, 1]", "tilt = [45, 0]"], "not both"),
    ],
)
def test_a_direction_that_is_none_is_refused(lines, words):
    with pytest.raises(InputError, match=words):
        written(*lines)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def design(*options: str) -> int:
    return cli.run(["design", "blob.png", "--waves", "off", "--quality", "draft", "--resolution", "24", "-o", "p", *options])


@pytest.mark.parametrize("mirror", [False, True])
def test_design_and_render(in_tmp, capfd, mirror):
    """The screen stands square to the light and on it; power and error are those of a render by other rays."""
    write_blob()
    assert design("--source-tilt", "30,0", "--json", *(["--mirror"] if mirror else [])) == 0
    made = json.loads(capfd.readouterr().out)
    project = (in_tmp / "p" / "project.toml").read_text()
    assert f"tilt = [{-30.0 if mirror else 30.0}, 0.0]" in project
    assert f"shift = [0.0, {-300.0 * math.tan(math.radians(30.0))!r}"[:24] in project
    assert made["error"] < 0.2 and (made["lost"]["missed_surface"] > 0.05) != mirror
    assert made["on_screen"] > (0.99 if mirror else 0.5)
    assert cli.run(["render", "p", "--json", "--rays", "100000", "-o", "image.png"]) == 0
    seen = json.loads(capfd.readouterr().out)
    assert seen["relative_rms"] == pytest.approx(made["relative_rms"], abs=0.05)


def test_a_lens_with_a_gradient(in_tmp, capfd):
    """Its start is that of a homogeneous lens, and its rays are traced through the gradient."""
    write_blob()
    few = ("--rays", "10000", "--iterations", "4")
    assert (
        design("--source-tilt", "20,0", "--gradient", "axial", "--gradient-terms", "0.01", *few, "--json", "--thickness", "2") == 0
    )
    made = json.loads(capfd.readouterr().out)
    assert made["error"] < 0.4 and made["on_screen"] > 0.7


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--source-tilt", "85,0"), "-80 to 80"),
        (("--source-tilt", "70,60"), "within 80 degrees"),
        (("--source-tilt", "20,0", "--source", "point"), "tilt"),
        (("--source-tilt", "20,0", "--source", "disc"), "disc with an angle"),
        (("--screen-tilt", "1,2,3,4"), "two or three angles"),
        (("--screen-tilt", "90,0"), "parallel to the light"),
        (("--source-tilt", "75,0", "--thickness", "30"), "sides"),
        (("--source-tilt", "nan,0"), "tilt"),
    ],
)
def test_nonsense_is_refused_in_a_line(in_tmp, capfd, options, words):
    write_blob()
    (in_tmp / "t.toml").write_text("[source_tilt]\nsigma = [0.1, 0.1]\n")
    assert design(*options) == 2
    error = capfd.readouterr().err
    assert words in error.splitlines()[-1] and "Traceback" not in error


def test_what_has_no_tilted_light_says_so(in_tmp, capfd):
    write_blob()
    assert design("--source-tilt", "20,0", "--quiet") == 0
    assert cli.run(["export", "p", "--format", "lighttools", "--script", "-o", "p.npz"]) == 2
    assert "--script" in capfd.readouterr().err.splitlines()[-1]
    assert cli.run(["export", "p", "--format", "mitsuba", "-o", "scene.xml"]) == 0
    assert cli.run(["export", "p", "--format", "zemax", "-o", "p.dat"]) == 0
    head = (in_tmp / "p.dat").read_text().split("\n", 8)
    assert any("light along (0, -0.342" in line for line in head)
    assert any("tilted about the fixed x axis by 20 degrees" in line for line in head)
    assert cli.run(["export", "p", "--format", "stl", "-o", "p.stl"]) == 0


@pytest.mark.parametrize("mirror", [False, True])
def test_an_archive_holds_the_direction(tmp_path, mirror):
    """And light meets the mirror in the plane of its edge, which is that of its base surface here."""
    lit = scene(TILTS[1], mirror=mirror, offset=Offset(4.0, (80.0, 80.0)), degree=(3, 3))
    x, y = (c.numpy() for c in HeightField.of(lit.lens).control_xy())
    field, z = HeightField.of(lit.lens), torch.from_numpy(lit.lens.offset.heights(x, y))
    write_lighttools(tmp_path / "a.npz", lit, field, field.interpolated(z))
    read = open_archive(tmp_path / "a.npz")[0]
    assert read.source.tilt == TILTS[1] and read.source.axis == lit.source.axis
    assert read.pupil.z == pytest.approx(lit.pupil.z, abs=1e-4 if mirror else 1e-12)


def test_grazing_light_is_refused():
    with pytest.raises(InputError, match="80 degrees"):
        PlaneWave(tilt=(60.0, 75.0))
