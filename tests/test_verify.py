"""The comparison of --verify: noise alone agrees, every real fault does not; and Mitsuba itself, where it is installed."""

import importlib.util
import json
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_export import make

from caustic_cli import cli
from caustic_cli.errors import CausticError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mitsuba import write_mitsuba
from caustic_cli.export.mitsuba_screen import viewed
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.screen_shape import points_in_space
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Disc, Light, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.screen import Sags
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies import verify

RAYS = 400_000
SOURCES = [
    PlaneWave(),
    PlaneWave(profile=np.array([[1.0, 2.0], [0.5, 3.0]])),
    Points(((1.0, -0.5, -60.0),)),
    Points.grid((0.0, 0.0, -80.0), (2.0, 3.0), (2, 3), intensity="lambertian"),
    Disc((0.5, 0.0, -60.0), (2.0, 3.0)),
    Disc((0.0, 0.0, -60.0), intensity="uniform", cone=4.0),
    Disc(angle=0.5),
]
NAMES = ["plane", "profile", "point", "grid", "disc", "disc with a cone", "sun"]


def scene_with(source):
    """A small lens that throws all it gets on a coarse screen."""
    scene, field, heights = make(control=(9, 8), size=(10.0, 8.0), relief=0.004)
    size = (38.4, 30.0) if isinstance(source, PlaneWave) or getattr(source, "angle", None) else (110.0, 90.0)
    return Scene(source, scene.lens, Screen(size, 300.0, (16, 12))), field, heights


def counts(picture, seed: int, rays: int = RAYS):
    """Independent rays on a picture: image and squares, parts of the power."""
    image = np.random.default_rng(seed).multinomial(rays, [*(picture / picture.sum() * 0.9).ravel(), 0.1])[:-1]
    image = image.reshape(picture.shape)
    return image / rays, image / rays**2


def picture():
    x, y = np.mgrid[0:30, 0:24]
    return 0.2 + np.exp(-((x - 11) ** 2 + (y - 9) ** 2) / 40.0) + 0.5 * (x > 20)


def judged(of_mitsuba, of_render):
    renders = np.array([counts(of_render, k, 16 * RAYS)[0] for k in range(4)])
    return verify.compare(renders, *counts(of_mitsuba, 99), RAYS)


def test_noise_agrees():
    decision = judged(picture(), picture())
    assert decision.agree
    assert 0.8 < decision.figures["z_mean_square"] < 1.1 and decision.figures["pixels"] > 500
    assert decision.figures["relative_rms_beyond_noise"] < 0.5 * decision.figures["noise_rms"]
    assert decision.z.shape == picture().shape


@pytest.mark.parametrize(
    "fault",
    [lambda a: a[::-1], lambda a: a[:, ::-1], lambda a: np.roll(a, 1, 0), lambda a: a**1.1, lambda a: a + 0.5 * np.eye(30, 24)],
)
def test_faults_do_not(fault):
    assert not judged(picture(), fault(picture())).agree


def test_even_light_which_correlates_with_nothing_agrees():
    even, agreed = np.ones((60, 40)), 0
    for seed in range(0, 200, 5):
        renders = np.array([counts(even, seed + k, 16 * RAYS)[0] for k in range(4)])
        agreed += verify.compare(renders, *counts(even, seed + 4), RAYS).agree
    assert agreed >= 38


def test_light_that_is_missing_is_noticed():
    image, squares = counts(picture(), 99)
    renders = np.array([counts(picture(), k, 16 * RAYS)[0] for k in range(4)])
    assert not verify.compare(0.98 * renders, image, squares, RAYS).agree


def test_few_rays_take_pixels_together_and_too_few_say_so():
    few, squares = counts(picture(), 5, 9000)
    renders = np.array([counts(picture(), k, RAYS)[0] for k in range(4)])
    decision = verify.compare(renders, few, squares, 9000)
    assert decision.agree and decision.figures["pixel_side"] == 2
    assert np.isnan(decision.z).any() or decision.figures["pixels"] == 15 * 12
    few, squares = counts(picture(), 5, 20)
    with pytest.raises(CausticError, match="rays"):
        verify.compare(renders, few, squares, 20)


@pytest.mark.parametrize("source", SOURCES, ids=NAMES)
def test_its_own_rays_carry_the_power_that_ours_do(source):
    """Another sampling of the same source: as much of it enters the lens."""
    scene, field, heights = scene_with(source)
    carried = 0.0
    for start, direction, share in verify.sample_rays(scene, RAYS, np.random.default_rng(0)):
        assert np.allclose(np.linalg.norm(direction, axis=0), 1)
        x, y = start[:2] + direction[:2] * (scene.lens.z_in - start[2]) / direction[2]
        inside = (abs(x) <= scene.lens.half_size[0]) & (abs(y) <= scene.lens.half_size[1])
        carried += share[inside].sum() / RAYS
    lost = expose(scene, field, heights, rays_of(scene, "stratified", 200_000)).lost["missed_lens"]
    assert carried == pytest.approx(1 - lost, abs=4e-3)


def test_without_mitsuba_one_line_says_so(monkeypatch):
    monkeypatch.setattr(verify, "find_spec", lambda name: None)
    assert "pip install" in verify.unsupported(make()[0])


def test_other_reflections_are_refused(monkeypatch):
    monkeypatch.setattr(verify, "find_spec", lambda name: True)
    scene = make()[0]
    assert not verify.unsupported(scene)
    assert "Fresnel reflection is exact" in verify.unsupported(replace(scene, lens=replace(scene.lens, fresnel="none")))


class InItsPlace:
    """Mitsuba's part of the comparison by this program's own trace, of the scenes that are written for it: what is compared is then
    how they are placed, indexed, weighted and binned."""

    __version__, LogLevel = "none", SimpleNamespace(Error=0)

    def __init__(self, scene, field, heights):
        self.lens, self.indices = (scene, field, heights), []

    def set_log_level(self, level):
        pass

    def variant(self):
        return "llvm"

    def load_file(self, path, optimize):
        text = Path(path).read_text()
        index = re.search(r'int_ior" value="([^"]+)"', text)
        self.indices += [float(index[1])] if index else []
        return SimpleNamespace(shapes=list, index=float(index[1]) if index else None)

    def follow(self, _mi, world, _shapes, surfaces, start, direction, _rng):
        scene, field, heights = self.lens
        scene = scene if world.index is None else replace(scene, lens=replace(scene.lens, index=world.index, glass=None))
        assert surfaces[-1].name == "screen" and [s.name for s in surfaces[:-1]] == (
            ["mirror"] if scene.lens.mirror else [e.name for e in System.of(scene).elements]
        )
        system = System.of(scene, field)
        ends = [torch.from_numpy(np.ascontiguousarray(c)) for c in (*start, *direction)]
        rays = RayState(tuple(ends[:3]), tuple(ends[3:]), torch.ones(len(ends[0]), dtype=torch.float64))
        (out,) = Tracer(system, rays)({EXIT: heights})
        out = out.expanded()
        receiver = Receiver.of(system, scene.screen)
        o, d = (np.stack([c.numpy() for c in v]) for v in ((*out.origin[:2], out.origin[2] + out.datum), out.direction))
        normal = np.array(receiver.axes[2])
        t = (np.array(receiver.middle) @ normal - normal @ o) / (normal @ d)
        if scene.screen.far:
            t = np.full_like(t, 1e9)
        elif scene.screen.rounded:  # where |o + t d - c| = |R|, next to the screen
            away = o - (np.array(receiver.middle) + scene.screen.radius[0] * normal)[:, None]
            b, c = (away * d).sum(0), (away * away).sum(0) - scene.screen.radius[0] ** 2
            t = -b + np.sign(t + b) * np.sqrt(np.maximum(b * b - c, 0.0))
        return *(o + t * d), np.where(t > 0, out.power.numpy(), 0.0)


def leaning(scene):
    return replace(scene, screen=replace(scene.screen, tilt=(12.0, -20.0), shift=(3.0, 1.5)))


def reflecting(scene):
    return replace(scene, lens=replace(scene.lens, mirror=True), screen=replace(scene.screen, z=-300.0, size=(60.0, 50.0)))


def oblique(source, mirror=False):
    """A change of the scene to light at an angle, and to a screen square to it or to the light that a mirror reflects."""

    def changed(scene):
        scene = reflecting(scene) if mirror else scene
        side, (x, y, z) = scene.lens.interaction.side, (300.0 * c for c in source.axis)
        screen = replace(scene.screen, z=side * z, tilt=tuple(side * angle for angle in source.tilt), shift=(x, y))
        return replace(scene, source=source, screen=screen)

    return changed


OBLIQUE = {
    "20 degrees": oblique(PlaneWave(tilt=(20.0, 0.0))),
    "40 degrees": oblique(PlaneWave(tilt=(-30.0, 28.0))),
    "60 degrees": oblique(PlaneWave(tilt=(0.0, 60.0))),
    "sun": oblique(Disc(angle=0.5333, tilt=(0.0, -40.0))),
    "mirror at 45 degrees": oblique(PlaneWave(tilt=(0.0, 45.0)), mirror=True),
}


def dispersing(scene):
    light = Light(wavelengths=(450.0, 550.0, 650.0), weights=(1.0, 2.0, 1.0))
    return replace(scene, lens=replace(scene.lens, glass="N-SF11", index=1.78), light=light)


def on_screen(**changes):
    """A change of the scene's screen."""
    return lambda scene: replace(scene, screen=replace(scene.screen, **changes))


def of_lens(**changes):
    """A change of the scene's lens."""
    return lambda scene: replace(scene, lens=replace(scene.lens, **changes))


def lit_by(source, size=(110.0, 90.0)):
    """A change of the scene's source, with a screen of this size."""
    return lambda scene: replace(scene, source=source, screen=replace(scene.screen, size=size))


class Ring(Points):
    """A type of source from outside, with the rays of points."""

    emission = "point"


def of_file(count=100_000):
    """Rays of a small disc, of unequal flux."""
    rng = np.random.default_rng(3)
    start = np.stack([*rng.uniform(-1.0, 1.0, (2, count)), np.zeros(count)], -1)
    ways = np.stack([*(rng.standard_normal((2, count)) * [[0.1], [0.08]]), np.ones(count)], -1)
    return Measured(RaySet(start, ways, rng.uniform(0.2, 1.0, count)), (0.0, 0.0, -60.0))


ALONE = ((), ())
LED = Disc((0.5, 0.0, -60.0), (2.0, 3.0), 0.7)
FAR = {"far": True, "z": 1000.0, "size": (120.0, 100.0)}
#: What lies beyond a clear lens and a plane screen, and beyond the sources of other programs.
BEYOND = {
    "sphere": on_screen(radius=(-200.0, -200.0)),
    "leaning sphere": on_screen(radius=(150.0, 150.0), tilt=(10.0, 5.0), shift=(2.0, -1.0)),
    "far field": on_screen(**FAR),
    "leaning far field": on_screen(**FAR, tilt=(2.0, -3.0), shift=(8.0, 5.0)),
    "far field of a mirror": lambda scene: on_screen(far=True, z=-1000.0, size=(200.0, 160.0))(reflecting(scene)),
    "absorption": of_lens(absorption=0.05),
    "several sources": lit_by(Several((PlaneWave(), PlaneWave(2.0, tilt=(2.0, 0.0)), LED), (ALONE,) * 3)),
    "ray file": lit_by(of_file()),
    "type from outside": lit_by(Ring(((0.0, 0.0, -60.0), (1.0, 0.0, -60.0)), kind="ring")),
    "laser beam": lit_by(Gaussian((3.0, 2.5), 633.0), (38.4, 30.0)),
    "M^2 of a laser": lit_by(Gaussian((3.0, 2.5), 633.0, -400.0, 20.0), (38.4, 30.0)),
}


@pytest.mark.parametrize(
    "how",
    [leaning, reflecting, dispersing, lambda scene: leaning(dispersing(scene)), *OBLIQUE.values(), *BEYOND.values()],
)
def test_scenes_are_written_and_compared_as_they_are(how, tmp_path, monkeypatch):
    """Tilted and shifted screens, mirrors, several wavelengths and light at an angle, by a trace in place of Mitsuba's; a lens that
    leans differs."""
    scene, field, heights = scene_with(PlaneWave())
    scene = how(scene)
    monkeypatch.setattr(verify, "find_spec", lambda name: True)
    assert not verify.unsupported(scene)
    other = InItsPlace(scene, field, heights)
    monkeypatch.setitem(sys.modules, "mitsuba", other)
    monkeypatch.setattr(verify, "choose_variant", lambda: "none")
    monkeypatch.setattr(verify, "follow", other.follow)
    paths = [tmp_path / f"{k}.xml" for k in range(len(scene.bands))]
    for path, band in zip(paths, scene.bands, strict=True):
        write_mitsuba(path, band.scene, field, heights, (17, 17), dark=True)
    found = verify.verify(paths, scene, field, heights, RAYS)
    assert found.agree, found.figures
    if not scene.lens.mirror:
        assert other.indices == pytest.approx([band.scene.lens.index for band in scene.bands], rel=1e-6)
    other.lens = scene, field, heights + 0.03 * field.control_xy()[0][:, None]
    assert not verify.verify(paths, scene, field, heights, RAYS).agree


def corners(text: str, name: str) -> np.ndarray:
    """Corners of a rectangle of a file, (4, 3), by its transformations, one after the other."""
    steps = re.search(rf'id="{name}">.*?<transform name="to_world">(.*?)</transform>', text, re.S)[1]
    points = np.array([(x, y, 0.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    for kind, rest in re.findall(r"<(\w+) (.*?)/>", steps):
        v = {key: float(value) for key, value in re.findall(r'(\w+)="([^"]+)"', rest)}
        if kind == "scale":
            points = points * [v.get("x", 1.0), v.get("y", 1.0), v.get("z", 1.0)]
        elif kind == "translate":
            points = points + np.array([v.get("x", 0.0), v.get("y", 0.0), v.get("z", 0.0)])
        else:
            axis = [v.get("x", 0.0), v.get("y", 0.0), v.get("z", 0.0)]
            points = Rotation.from_rotvec(np.radians(v["angle"]) * np.array(axis)).apply(points)
    return points


def test_a_leaning_screen_is_written_as_it_leans(tmp_path):
    scene, field, heights = scene_with(PlaneWave())
    scene = leaning(scene)
    write_mitsuba(tmp_path / "a.xml", scene, field, heights, (17, 17), dark=True)
    points = corners((tmp_path / "a.xml").read_text(), "screen")
    hx, hy = scene.screen.half_size
    x, y = (c.ravel() for c in np.meshgrid([-hx, hx], [-hy, hy], indexing="ij"))
    wanted = np.stack(points_in_space(scene.screen, x, y), -1)
    order = [np.lexsort(np.round(p, 6).T) for p in (points, wanted)]
    assert np.allclose(points[order[0]], wanted[order[1]], atol=1e-6)


@pytest.mark.parametrize("how", [oblique(PlaneWave(2.0, tilt=(-30.0, 28.0))), oblique(PlaneWave(tilt=(0.0, 45.0)), mirror=True)])
def test_the_emitter_of_a_tilted_wave_lights_the_aperture(tmp_path, how):
    """It is square to the beam and before the lens, covers the aperture, and has its power there."""
    scene, field, heights = scene_with(PlaneWave())
    scene = how(scene)
    write_mitsuba(tmp_path / "a.xml", scene, field, heights, (17, 17))
    text, axis = (tmp_path / "a.xml").read_text(), np.array(scene.source.axis)
    points = corners(text, "light")
    assert points[:, 2].max() < scene.pupil.z and np.ptp(points @ axis) < 1e-6
    edges = points[1] - points[0], points[2] - points[0]
    x, y = (c * r for c, r in zip(np.meshgrid([-1, 1], [-1, 1]), scene.pupil.half_size, strict=True))
    for point in np.stack([x, y, np.full((2, 2), scene.pupil.z)], -1).reshape(4, 3):
        for edge in edges:
            assert -1e-6 <= (point - points[0]) @ edge / (edge @ edge) <= 1 + 1e-6
    radiance = float(re.search(r'name="radiance" value="([^"]+)"', text)[1])
    assert radiance * scene.pupil.aperture.area * axis[2] == pytest.approx(scene.source.power, rel=1e-6)


# Mitsuba itself

SAG = on_screen(sags=Sags(4.0 * np.outer(np.sin(np.linspace(-2, 2, 20)), np.cos(np.linspace(-1, 1, 16))), (38.4, 30.0)))
ROUGH = of_lens(roughness=0.01)


@pytest.fixture(scope="module")
def mitsuba():
    """Skips unless it is installed and works; its own warnings are its own."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("Mitsuba is not installed")
    try:
        return verify.choose_variant()
    except CausticError as error:
        pytest.skip(str(error))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "source",
    [*SOURCES, *OBLIQUE.values(), leaning, reflecting, lambda scene: leaning(dispersing(scene)), *BEYOND.values(), SAG, ROUGH],
    ids=[*NAMES, *OBLIQUE, "leaning screen", "mirror", "three wavelengths", *BEYOND, "measured screen", "rough"],
)
def test_mitsuba_agrees(mitsuba, tmp_path, source, capsys):
    if callable(source):
        scene, field, heights = scene_with(PlaneWave())
        scene = source(scene)
    else:
        scene, field, heights = scene_with(source)
    paths = [tmp_path / f"{k}.xml" for k in range(len(scene.bands))]
    for path, band in zip(paths, scene.bands, strict=True):
        write_mitsuba(path, band.scene, field, heights, (129, 129), dark=True)
    decision = verify.verify(paths, scene, field, heights, RAYS // 2)
    with capsys.disabled():
        print(
            f"\n  {scene.source.label}: mean Z^2 {decision.figures['z_mean_square']:.3f},"
            f" light {decision.figures['on_screen']:.5f} and {decision.figures['on_screen_render']:.5f}",
            end="",
        )
    assert decision.agree, decision.figures
    verify.write_panels(tmp_path / "verify.png", decision, scene.screen.half_size)
    assert (tmp_path / "verify.png").read_bytes()[1:4] == b"PNG"


UNEVEN = np.array([[1.0, 2.0, 0.2], [0.5, 3.0, 1.0]])
TABLE = Distribution((0.0, 10.0, 25.0, 60.0), (1.0, 1.5, 0.2, 0.1))
#: What is exported with emitters of its own: each with the least lead of the correlation in the right orientation.
EXPORTED = {
    **{name: (OBLIQUE[name], 0.05) for name in ("40 degrees", "mirror at 45 degrees")},
    "profile": (lit_by(PlaneWave(profile=UNEVEN), (38.4, 30.0)), 0.05),
    "tilted profile": (oblique(PlaneWave(profile=UNEVEN, tilt=(-30.0, 28.0))), 0.05),
    "Lambertian points": (
        lit_by(Points(((1.0, -0.5, -20.0), (0.0, 0.0, -25.0)), (1.0, 2.0), intensity="lambertian"), (300.0, 250.0)),
        0.005,
    ),
    "table": (lit_by(Points(((1.0, -0.5, -20.0),), intensity=TABLE), (300.0, 250.0)), 0.05),
    "picture of a disc": (
        lit_by(Disc((0.0, 0.0, -60.0), (9.0, 6.0), brightness=np.array([[1.0, 0.0], [0.2, 0.0]])), (160.0, 130.0)),
        0.05,
    ),
    "uniform disc": (lit_by(Disc((0.5, 0.0, -60.0), (4.0, 3.0), intensity="uniform"), (160.0, 130.0)), -0.01),
    "disc with a cone": (lit_by(Disc((3.0, 0.0, -60.0), (2.0, 3.0), cone=4.0), (160.0, 130.0)), 0.0),
    "line": (lit_by(Disc((0.5, 0.0, -60.0), (4.0, 0.0))), -0.01),
    "wavelengths": (dispersing, 0.05),
    **{name: (BEYOND[name], 0.005) for name in ("sphere", "far field", "leaning far field", "far field of a mirror")},
    "several sources": (BEYOND["several sources"], -0.01),
    "rough": (of_lens(roughness=0.02), -0.01),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", EXPORTED)
def test_mitsuba_renders_what_is_exported(mitsuba, tmp_path, name):
    """By its own light tracer, emitters and camera: the picture that is printed, neither flipped nor turned; of several scenes
    their sum."""
    import mitsuba as mi  # noqa: PLC0415

    scene, field, heights = scene_with(PlaneWave())
    how, lead = EXPORTED[name]
    scene = how(scene)
    (w, h), n = scene.screen.size, 16
    scene = replace(scene, screen=replace(scene.screen, resolution=(n, round(n * h / w))))
    write_mitsuba(tmp_path / "a.xml", scene, field, heights, (129, 129))
    mi.set_variant(mitsuba if "rgb" in mitsuba else "scalar_rgb")  # its tracer of light runs with every LLVM
    files = sorted(tmp_path.glob("*.xml"))
    assert len(files) == len(scene.bands)
    seen = sum(np.array(mi.render(mi.load_file(str(file), optimize=False), spp=1200))[::-1, :, 0].T for file in files)
    power = np.pi * viewed(scene).pixel[0] ** 2 * seen
    ours = expose(scene, field, heights, rays_of(scene, "stratified", 400_000)).image.numpy()
    ours = scene.source.power * ours.reshape(-1, *scene.screen.resolution).sum(0)
    assert power.sum() == pytest.approx(ours.sum(), rel=0.03)
    like = [np.corrcoef(power.ravel(), a.ravel())[0, 1] for a in (ours, ours[::-1], ours[:, ::-1], ours[::-1, ::-1])]
    assert like[0] > 0.9 and like[0] > max(like[1:]) + lead


@pytest.mark.filterwarnings("ignore")
def test_mitsuba_notices_another_index(mitsuba, tmp_path):
    scene, field, heights = scene_with(PlaneWave())
    write_mitsuba(tmp_path / "lens.xml", scene, field, heights, (129, 129), dark=True)
    other = replace(scene, lens=replace(scene.lens, index=scene.lens.index + 0.01))
    assert not verify.verify([tmp_path / "lens.xml"], other, field, heights, RAYS).agree


@pytest.mark.filterwarnings("ignore")
def test_the_command(mitsuba, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_lighttools("lens.npz", *scene_with(PlaneWave()))
    code = cli.run(shlex.split("render lens.npz --rays 2e5 --verify mitsuba --json --quiet"))
    out, err = capfd.readouterr()
    assert (code, err) == (0, "")
    assert json.loads(out)["verify"]["agree"] and (tmp_path / "verify.png").is_file()
