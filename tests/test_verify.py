"""The comparison of --verify: noise alone agrees, every real fault does not; and Mitsuba itself, where it is installed."""

import importlib.util
import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
from test_export import make

from caustic_cli import cli
from caustic_cli.errors import CausticError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mitsuba import write_mitsuba
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Disc, PlaneWave, Points, Scene, Screen
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
    assert "fresnel" in verify.unsupported(replace(scene, lens=replace(scene.lens, fresnel="none")))


# Mitsuba itself


@pytest.fixture(scope="module")
def mitsuba():
    """Skips unless it is installed and works; its own warnings are its own."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("Mitsuba is not installed")
    try:
        return verify._choose_variant()
    except CausticError as error:
        pytest.skip(str(error))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("source", SOURCES, ids=NAMES)
def test_mitsuba_agrees(mitsuba, tmp_path, source, capsys):
    scene, field, heights = scene_with(source)
    write_mitsuba(tmp_path / "lens.xml", scene, field, heights, (129, 129), dark=True)
    decision = verify.verify(tmp_path / "lens.xml", scene, field, heights, RAYS // 2)
    with capsys.disabled():
        print(
            f"\n  {source.kind if hasattr(source, 'kind') else 'plane'}: mean Z^2 {decision.figures['z_mean_square']:.3f},"
            f" light {decision.figures['on_screen']:.5f} and {decision.figures['on_screen_render']:.5f}",
            end="",
        )
    assert decision.agree, decision.figures
    verify.write_panels(tmp_path / "verify.png", decision, scene)
    assert (tmp_path / "verify.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.filterwarnings("ignore")
def test_mitsuba_notices_another_index(mitsuba, tmp_path):
    scene, field, heights = scene_with(PlaneWave())
    write_mitsuba(tmp_path / "lens.xml", scene, field, heights, (129, 129), dark=True)
    other = replace(scene, lens=replace(scene.lens, index=scene.lens.index + 0.01))
    assert not verify.verify(tmp_path / "lens.xml", other, field, heights, RAYS).agree


@pytest.mark.filterwarnings("ignore")
def test_the_command(mitsuba, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_lighttools("lens.npz", *scene_with(PlaneWave()))
    code = cli.run(shlex.split("render lens.npz --rays 2e5 --verify mitsuba --json --quiet"))
    out, err = capfd.readouterr()
    assert (code, err) == (0, "")
    assert json.loads(out)["verify"]["agree"] and (tmp_path / "verify.png").is_file()
