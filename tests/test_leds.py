"""Arrays with a source behind every lenslet: their light, their stray light, their designs, their brightnesses."""

import json
import math
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import dblquad

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse.lenslets import initial_array, lenslets
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.image import Image
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.project.project import Project
from caustic_cli.scene import Disc, Lens, Light, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.lens import array_control
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import behind_lenslets
from caustic_cli.studies.brightness import brightness
from caustic_cli.studies.stray import stray_light
from caustic_cli.workflow.lens import Lens as Designed

LED = Points(((0.0, 0.0, -7.0),), intensity="lambertian")


def led_scene(source=LED, array=(2, 1), spans=8, **lens) -> Scene:
    """Lenslets of 6 mm, 2 mm thick, with a source each."""
    control = tuple(array_control(spans * k + 3, 3, k) for k in array)
    made = Lens((6.0 * array[0], 6.0 * array[1]), control=control, array=array, min_thickness=0.5, **lens)
    made = replace(made, offset=replace(made.offset, thickness=2.0))
    lit = behind_lenslets(source, Light(), made.cells.centres, made.pupil)
    return Scene(lit, made, Screen((60.0, 50.0), 80.0, (24, 20)))


def bumps(scene: Scene, seed=1, size=0.05) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return 2.0 + size * torch.from_numpy(rng.uniform(-1, 1, scene.lens.control))


def shown(scene: Scene, heights: torch.Tensor, rays: int, seed: int = 0) -> Image:
    return expose(scene, HeightField.of(scene.lens), heights, rays_of(scene, "sobol", rays, seed), None, torch.float64)


@pytest.mark.parametrize("source", [LED, Disc((0.2, 0.0, -7.0), (1.0, 1.0)), Points.grid((0.0, 0.0, -7.0), (1.0, 1.0), (3, 3))])
def test_one_behind_every_lenslet(source):
    """Displaced to the centres, in the order of the lenslets, all with the cone of the one that needs the widest."""
    scene = led_scene(source, (3, 2))
    members = scene.source.members
    expected = [(x + source.centre[0], y) for x in (-6.0, 0.0, 6.0) for y in (-3.0, 3.0)]
    np.testing.assert_allclose([one.centre[:2] for one in members], expected, atol=1e-12)
    assert scene.source.by_lenslet and not scene.source.in_turn and scene.source.fractions == pytest.approx([1 / 6] * 6)
    assert len({one.cone for one in members}) == 1
    assert members[0].cone == pytest.approx(max(math.degrees(replace(m, cone=None).cone_over(scene.pupil)) for m in members))
    for one in lenslets(scene):
        assert one.scene.source.centre[:2] == pytest.approx((source.centre[0], 0.0)) and one.share == pytest.approx(1 / 6)
    given = led_scene(replace(source, cone=20.0)).source.members
    assert [one.cone for one in given] == pytest.approx([20.0, 20.0])


@pytest.mark.parametrize(
    ("source", "count", "words"),
    [
        (PlaneWave(), 4, "the plane, which is at infinity"),
        (Disc(angle=0.5), 4, "the disc, which is at infinity"),
        (Points(((0.0, 0.0, -7.0), (1.0, 0.0, -7.0))), 4, "2 points"),
        (LED, 65, "64 lenslets"),
        (Gaussian((1.0, 1.0), 633.0), 4, "the laser beam, which is at infinity"),
        (Measured(RaySet(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones(1)), (0.0, 0.0, -7.0)), 4, "rays of a file"),
    ],
)
def test_sources_that_cannot_stand_there(source, count, words):
    with pytest.raises(InputError, match=words):
        behind_lenslets(source, Light(), [(float(k), 0.0) for k in range(count)], led_scene().pupil)


def test_the_light_of_all_is_the_sum_of_each():
    """To rounding: each with the rays that it has among all."""
    scene = led_scene(array=(2, 2))
    heights = bumps(scene)
    whole = shown(scene, heights, 4 * 5000)
    each = [shown(one, heights, 5000, k) for k, one in enumerate(scene.by_source)]
    total = sum(part * one.image for part, one in zip(scene.source.fractions, each, strict=True))
    np.testing.assert_allclose(whole.image.numpy(), total.numpy(), rtol=0, atol=1e-14)
    assert float(whole.image.sum()) + math.fsum(whole.lost.values()) == pytest.approx(1.0, abs=1e-9)


def test_stray_light_is_not_lost():
    """What misses a source's own lenslet but not the array is the Lambertian light on its neighbour, and it is traced."""
    scene = replace(led_scene(replace(LED, cone=90.0), fresnel="none"), screen=Screen((1000.0, 1000.0), 80.0, (20, 20)))
    heights = bumps(scene, size=0.0)
    (one, _), (alone, _) = scene.by_source, lenslets(scene)
    whole = shown(one, heights, 1 << 16)
    own = expose(alone.scene, alone.field, alone.of(heights), rays_of(alone.scene, "sobol", 1 << 16), None, torch.float64)
    on_neighbour = dblquad(lambda y, x: 49.0 / (math.pi * (49.0 + x * x + y * y) ** 2), 3.0, 9.0, -3.0, 3.0)[0]
    assert own.lost["missed_lens"] - whole.lost["missed_lens"] == pytest.approx(on_neighbour, rel=2e-3)
    for image in (whole, own):
        assert float(image.image.sum()) + math.fsum(image.lost.values()) == pytest.approx(1.0, abs=1e-9)
    fallen, seen = stray_light(scene, HeightField.of(scene.lens), heights, 1 << 16)
    assert fallen == pytest.approx(on_neighbour, rel=2e-3)
    assert 0.6 * fallen < seen < fallen  # the rest leaves through the sides of the array
    assert seen < float(whole.image.sum() - own.image.sum())  # with what enters its own lenslet and leaves through the next
    through = 1.0 - whole.lost["missed_lens"] - whole.lost["missed_surface"]
    assert through > 1.0 - own.lost["missed_lens"] - own.lost["missed_surface"] + 0.9 * on_neighbour


def test_mirrored_pictures_give_mirrored_surfaces():
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 24), np.linspace(-1.0, 1.0, 20), indexing="ij")
    goal = 0.2 + np.exp(-4.0 * ((x - 0.4) ** 2 + (y + 0.3) ** 2))
    scene = led_scene(replace(LED, cone=40.0), spans=16)
    heights = initial_array(scene, [goal, goal[::-1].copy()], scene.lens.control, 32).heights
    np.testing.assert_allclose(heights.numpy(), heights.numpy()[::-1], atol=2e-4)
    assert float(heights.max() - heights.min()) > 0.3
    image = shown(scene, heights, 1 << 17).image.numpy()
    assert np.linalg.norm(image - image[::-1]) < 0.1 * np.linalg.norm(image)


def test_a_planted_brightness_is_found():
    """From images with stray light in them, exactly."""
    scene, planted = led_scene(array=(2, 2)), np.array([1.0, 0.0, 0.35, 0.7])
    basis = np.stack([shown(one, bumps(scene), 4000).image.numpy().ravel() for one in scene.by_source], -1)
    found = brightness(basis, basis @ planted)
    np.testing.assert_allclose(found.brightness, planted, rtol=0, atol=1e-10)
    assert found.error < 1e-10 and found.residual < 1e-10


# The program

ARRAY = "--array 2x1 --lens-size 12x6 --thickness 2 --throw 80 --picture-size 30"
EACH = "--source point --source-position 0,0,-8 --intensity lambertian --source-each"
SMALL = "--quality draft --resolution 20 --iterations 2 --quiet --threads 2"


def run(line: str, capfd) -> tuple[int, str, str]:
    code = cli.run(shlex.split(line))
    return code, *capfd.readouterr()


@pytest.fixture(scope="module")
def leds(tmp_path_factory):
    """A directory with an array that shows a spot on the left and one on the right, by a source each."""
    directory = tmp_path_factory.mktemp("leds")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(directory)
        x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 16)] * 2, indexing="ij")
        left, right = (np.exp(-6.0 * ((x - a) ** 2 + y**2)) + 0.02 for a in (-0.5, 0.5))
        np.save("sheet.npy", np.concatenate([left, right], 0))
        np.save("goal.npy", left + 0.4 * right)
        assert cli.run(shlex.split(f"design sheet.npy --sheet {ARRAY} --control 83x43 {EACH} {SMALL} -o p.caustic")) == 0
        yield directory


def test_a_design_with_a_source_each(leds, monkeypatch):
    monkeypatch.chdir(leds)
    project = Project.open("p.caustic")
    assert "each = true" in (leds / "p.caustic" / "project.toml").read_text() and not project.settings.source.also
    assert len(project.scene().source.members) == 2
    lens = Designed.of(project)
    mirrored = lens.heights - lens.heights.flip(0)
    assert float(mirrored.abs().max()) < 0.05 * float(lens.heights.max() - lens.heights.min())


def test_a_sheet_in_the_light_of_one_disc(leds, monkeypatch):
    """Stages that compare lenslets, without the blur as a convolution."""
    monkeypatch.chdir(leds)
    line = f"design sheet.npy --sheet {ARRAY} --source disc --source-position 0,0,-40 --control 23 {SMALL} -o one.caustic"
    assert cli.run(shlex.split(line)) == 0
    project = Project.open("one.caustic")
    assert all(stage.lenslets and not stage.spread for stage in project.settings.design.stages)


def test_brightness_and_stray_light(leds, monkeypatch, capfd):
    monkeypatch.chdir(leds)
    code, out, err = run("render p.caustic --want goal.npy --rays 2e5 --json --force --quiet", capfd)
    found = json.loads(out)
    level = np.array(found["want"]["brightness"])
    assert code == 0 and err == "" and level.shape == (2, 1)
    assert level[0, 0] == 1.0 and level[1, 0] == pytest.approx(0.4, abs=0.05)
    assert found["want"]["kkt_residual"] < 1e-10 and 0.0 < found["stray"]["on_screen"] < 0.1
    assert "stray light" in run("render p.caustic --rays 1e5 -o other.png", capfd)[1]


def test_other_light_and_going_on(leds, monkeypatch, capfd):
    """A plane wave or one sun is for all lenslets; another place is each source's, and a design goes on."""
    monkeypatch.chdir(leds)
    project = Project.open("p.caustic")
    assert not project.scene({"source.type": "plane"}).source.by_lenslet
    assert project.scene({"source.type": "disc", "source.angle": 0.5}).source.kind == "disc"
    nearer = project.scene({"source.position": [[0.0, 0.0, -6.0]]}).source.members
    assert [one.centre for one in nearer] == [(-3.0, 0.0, -6.0), (3.0, 0.0, -6.0)]
    assert run("design --resume p.caustic --iterations 3 --quiet", capfd)[0] == 0
    assert len(Project.open("p.caustic").scene().source.members) == 2


def test_an_archive_has_them(leds, monkeypatch, capfd):
    """The same image, as one of several sources."""
    monkeypatch.chdir(leds)
    assert run("export p.caustic --format lighttools -o lens.npz --quiet", capfd)[0] == 0
    of_project, of_archive = (
        json.loads(run(f"render {name} --rays 1e5 --json --quiet -o {k}.png", capfd)[1])
        for k, name in enumerate(("p.caustic", "lens.npz"))
    )
    assert of_archive["lost"]["missed_lens"] == pytest.approx(of_project["lost"]["missed_lens"], abs=2e-3)
    assert of_archive["on_screen"] == pytest.approx(of_project["on_screen"], rel=1e-2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--source plane --source-each", "--source-each belongs to --source point, grid or disc"),
        ("--source-angle 0.5 --source-each", "--source-each has no meaning for a disc at infinity"),
        ("--source gaussian --waist 1 --wavelengths 633 --source-each", "--source-each belongs to"),
        (f"{EACH} --mirror", "--source-each is for lenses"),
        (f"{EACH} --array 1", "--source-each needs --array"),
        (f"{EACH} --array 9", "--source-each is for arrays of up to 64 lenslets, got 81"),
        (f"{EACH} --waves on", "--waves on is not for --source-each"),
    ],
)
def test_refusals(options, words, leds, monkeypatch, capfd):
    monkeypatch.chdir(leds)
    code, _, err = run(f"design goal.npy {ARRAY} {options} -o q.caustic --force", capfd)
    assert code == 2 and words in err and len(err.strip().splitlines()) == 1, err


@pytest.mark.parametrize(
    ("first", "words"),
    [
        ('type = "plane"\neach = true\n', "which is at infinity"),
        ('type = "point"\neach = true\nposition = [[0, 0, -8], [1, 0, -8]]\n', "2 points"),
        ('type = "point"\neach = true\n[[source]]\ntype = "point"\n', "needs one"),
    ],
)
def test_refusals_of_a_file(first, words, leds, monkeypatch, capfd):
    monkeypatch.chdir(leds)
    (leds / "c.toml").write_text(f"[[source]]\n{first}")
    code, _, err = run(f"design goal.npy {ARRAY} --config c.toml -o q.caustic --force", capfd)
    assert code == 2 and words in err and len(err.strip().splitlines()) == 1, err
