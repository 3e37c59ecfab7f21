"""Plane waves from any direction: kernel, energy, start, wave image and screen, each against an independent way."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from scipy.ndimage import gaussian_filter

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.beam import Beam
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.interface import interact, slopes_inside
from caustic_cli.optics.misalignment import Misalignment, landing_points
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose, tracers
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Disc, Lens, PlaneWave, Scene, Screen
from caustic_cli.scene.screen import tilt_to, tilted
from caustic_cli.studies.independent_rays import sample_rays
from caustic_cli.studies.metrics import relative_rms

FILTER = Filter("cosine", (3, 3))
TILTS = [(20.0, 0.0), (30.0, -25.0), (0.0, -60.0)]


def scene(tilt, throw: float = 60.0, wide: float = 36.0, pixels: int = 30, **lens) -> Scene:
    """A screen square to the light, `throw` mm along it from the lens' origin."""
    lens = Lens(**{"size": (10.0, 12.0), "z_in": -1.0, "control": (9, 8), "degree": (3, 4), "index": 1.5} | lens)
    x, y, z = (throw * c for c in tilted(tilt)[2])
    return Scene(PlaneWave(tilt=tilt), lens, Screen((wide, wide), z, (pixels, pixels + 4), tilt=tilt, shift=(x, y)))


def heights(rough: float = 0.03, seed: int = 0) -> torch.Tensor:
    return 4.0 + rough * torch.randn((9, 8), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def reference(scene: Scene, beam: Beam, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Image and power behind the lens in plain torch, differentiable."""
    field, n = HeightField.of(scene.lens), scene.lens.index
    sag, *slopes = (c.reshape(beam.sample.shape) for c in field.prepare(beam.sample, torch.float64)(z))
    direction, power = beam.rays(sag - scene.lens.z_in, slopes, n, scene.lens.fresnel)
    out = interact(direction, slopes, power, eta=n, reflects=False, fresnel=scene.lens.fresnel)
    to = Receiver.on_axis(scene.screen, (0.0, 0.0, 1.0))
    at = [c.expand(sag.shape) - m for c, m in zip((*beam.points(), sag), to.middle, strict=True)]
    on = lambda vector, e: sum(v * c for v, c in zip(vector, e, strict=True))  # noqa: E731
    t = -on(at, to.axes[2]) / on(out.direction, to.axes[2])
    shift = scene.screen.shift
    x, y = (on(at, e) + t * on(out.direction, e) + s for e, s in zip(to.axes, shift, strict=False))
    return splat(x.reshape(-1), y.reshape(-1), out.power.reshape(-1), scene.screen, FILTER)[0], out.power.sum()


@pytest.mark.parametrize("kind", ["lines", "stratified"])
@pytest.mark.parametrize(
    ("tilt", "fresnel", "rough"), [(TILTS[0], "exact", 0.03), (TILTS[1], "schlick", 0.03), (TILTS[2], "exact", 0.6)]
)
def test_value_and_gradient_of_the_kernel(tilt, fresnel, rough, kind):
    """Against the reference; with rough 0.6 some rays are totally reflected."""
    lit, z = scene(tilt, fresnel=fresnel), heights(rough).requires_grad_()
    (beam,) = rays_of(lit, kind, 1500, seed=3).pencils()
    traced = Tracer(System.of(lit, HeightField.of(lit.lens)), beam)
    assert type(traced.fused).__name__ == "BeamImage"
    pull = torch.randn(lit.screen.resolution, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    part, results = traced.expose({EXIT: z}, lit.screen, FILTER), []
    for image, leaving in ((part.image, part.leaving), reference(lit, beam, z)):
        results += [image.detach(), leaving.detach(), torch.autograd.grad((image * pull).sum() + 0.3 * leaving, z)[0]]
    image, leaving, gradient, image_, leaving_, gradient_ = results
    assert (float(part.lost["total_internal_reflection"]) > 0) == (rough > 0.1)
    torch.testing.assert_close(image, image_, rtol=0, atol=1e-10 * float(image_.max()))
    assert float(leaving) == pytest.approx(float(leaving_), rel=1e-10)
    assert float((gradient - gradient_).norm()) <= 1e-9 * float(gradient_.norm())


@pytest.mark.parametrize("round", [False, True])
@pytest.mark.parametrize("tilt", TILTS)
def test_energy_and_image_are_those_of_rays_from_the_entrance(tilt, round):
    """Rays through the entrance, intersected one by one, are the independent measure; some leave through the sides."""
    lit = scene(tilt, **({"size": (10.0, 10.0), "aperture": "circle"} if round else {}))
    field, z = HeightField.of(lit.lens), heights()
    ours = expose(lit, field, z, rays_of(lit, "grid", 400_000), FILTER)
    assert float(ours.image.sum()) + sum(ours.lost.values()) == pytest.approx(1.0, abs=1e-12)
    system, image, lost = System.of(lit, field), 0.0, {}
    for state in rays_of(lit, "sobol", 1 << 18).chunks():
        part = Tracer(system, state).collect(Tracer(system, state)({EXIT: z}), lit.screen, FILTER)
        image, lost = image + part.image, {name: lost.get(name, 0.0) + float(v) for name, v in part.lost.items()}
    assert lost["missed_surface"] > 0.05
    for name, value in lost.items():
        assert ours.lost[name] == pytest.approx(value, abs=1e-3)
    assert float((ours.image - image).norm()) < 6e-3 * float(image.norm())


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


@pytest.mark.parametrize("tilt", [(0.0, 40.0), (-50.0, 20.0)])
def test_wave_image(tilt):
    """Blurred to the width of diffraction, it is the ray image; it is worse by rays along the axis."""
    lit = scene(tilt, 300.0, 20.0, 96, size=(10.0, 10.0), z_in=0.0, control=(24, 24), degree=(3, 3))
    field = HeightField.of(lit.lens)
    x, y = (c.numpy() for c in field.control_xy())
    x, y = np.meshgrid(x, y, indexing="ij")
    z = torch.from_numpy(5.0 - 0.001 * (x**2 + y**2) + 0.004 * np.sin(0.9 * x + 0.5) * np.cos(0.7 * y))
    light = wave_image(lit, field, z, wavelengths=(540.0, 550.0, 560.0)).image.numpy()
    rays = expose(lit, field, z, rays_of(lit, "grid", 400_000)).image.numpy()
    assert light.sum() == pytest.approx(rays.sum(), rel=3e-3)
    blurred = [gaussian_filter(image, 2.0) for image in (light, rays)]
    assert np.linalg.norm(blurred[0] - blurred[1]) < 0.02 * np.linalg.norm(blurred[1])


@pytest.mark.parametrize(("tilt", "most"), [((0.0, 0.0), 0.12), ((20.0, 0.0), 0.14), ((0.0, -40.0), 0.16)])
def test_start_by_transport(tilt, most):
    """A smooth picture on a screen square to the light is nearly reached by the first surface; a screen across the axis is not."""
    lit = scene(tilt, 300.0, 36.0, 60, size=(10.0, 10.0), z_in=0.0, control=(103, 103), degree=(3, 3))
    lit = replace(lit, screen=replace(lit.screen, resolution=(60, 60)), lens=replace(lit.lens, offset=Lens().offset))
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 60)] * 2, indexing="ij")
    target = np.exp(-3.0 * ((x - 0.1) ** 2 + (y + 0.2) ** 2)) * (np.maximum(abs(x), abs(y)) < 0.8)
    field = HeightField.of(lit.lens)
    z = first_surface(lit, target, field, 200).heights
    image = expose(lit, field, z, rays_of(lit, "stratified", 400_000)).image.numpy()
    assert relative_rms(image, target * image.sum() / target.sum()) < most


def turned(screen: Screen) -> tuple[Screen, Screen]:
    """The same rectangle with its normal against the light, turned over about its x axis, and with its x axis along its y."""
    x, y, z = screen.axes
    over = replace(screen, tilt=tilt_to(x, (-z[0], -z[1], -z[2])))
    return over, replace(screen, tilt=tilt_to(y, z), resolution=screen.resolution[::-1], size=screen.size[::-1])


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


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def design(*options: str) -> int:
    return cli.run(["design", "blob.png", "--waves", "off", "--quality", "draft", "--resolution", "24", "-o", "p", *options])


def test_design_and_render(in_tmp, capfd):
    """The screen stands square to the light and on it; power and error are those of a render by other rays."""
    write_blob()
    assert design("--source-tilt", "30,0", "--json") == 0
    made = json.loads(capfd.readouterr().out)
    project = (in_tmp / "p" / "project.toml").read_text()
    assert "tilt = [30.0, 0.0]" in project and f"shift = [0.0, {-300.0 * math.tan(math.radians(30.0))!r}"[:24] in project
    assert made["error"] < 0.2 and made["lost"]["missed_surface"] > 0.05
    assert cli.run(["render", "p", "--json", "--rays", "100000", "-o", "image.png"]) == 0
    seen = json.loads(capfd.readouterr().out)
    assert seen["relative_rms"] == pytest.approx(made["relative_rms"], abs=0.05)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--source-tilt", "85,0"), "-80 to 80"),
        (("--source-tilt", "70,60"), "within 80 degrees"),
        (("--source-tilt", "20,0", "--mirror"), "one lens with a flat entrance"),
        (("--source-tilt", "20,0", "--array", "2"), "one lens with a flat entrance"),
        (("--source-tilt", "20,0", "--robust", "t.toml"), "--robust"),
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
    for command in (["export", "p", "--format", "mitsuba", "-o", "scene.xml"], ["render", "p", "--html", "p.html"]):
        assert cli.run(command) == 2
        assert "tilted" in capfd.readouterr().err.splitlines()[-1]
    assert cli.run(["export", "p", "--format", "stl", "-o", "p.stl"]) == 0


def test_an_archive_holds_the_direction(tmp_path):
    lit = scene(TILTS[1])
    write_lighttools(tmp_path / "a.npz", lit, HeightField.of(lit.lens), heights())
    source = open_archive(tmp_path / "a.npz")[0].source
    assert source.tilt == TILTS[1] and source.axis == lit.source.axis


def test_grazing_light_is_refused():
    with pytest.raises(InputError, match="80 degrees"):
        PlaneWave(tilt=(60.0, 75.0))
