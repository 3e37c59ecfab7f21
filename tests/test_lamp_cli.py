"""Lamps by the command line: design, render, export, photometric files, and what is refused."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import caustic_cli
from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.lamp import lamp_mesh
from caustic_cli.inverse import lamp as inverse
from caustic_cli.io.photometry import Photometry, read_photometry, write_ies, write_ldt
from caustic_cli.io.picture import read_picture
from caustic_cli.optics.lamp import uncoated_limit
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.project.project import Project
from caustic_cli.scene.lamp import Goal, Lamp
from caustic_cli.studies import verify
from caustic_cli.studies.lamp_report import density
from caustic_cli.studies.photometry import intensity_table
from caustic_cli.studies.verify import compare
from caustic_cli.workflow import lamp as workflow
from caustic_cli.workflow.lamp import LampDesign

ROAD = ["--lamp", "15", "--throw", "8m", "--picture-size", "30mx10m", "--quiet"]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    """A project of a street lamp."""
    path = tmp_path_factory.mktemp("lamp") / "road.caustic"
    assert cli.run(["design", "uniform", *ROAD, "-o", str(path)]) == 0
    return path


def figures_of(capfd, *arguments):
    """The figures that a command prints."""
    capfd.readouterr()
    assert cli.run([*arguments, "--json", "--quiet"]) == 0
    return json.loads(capfd.readouterr().out)


def refused(capfd, *arguments):
    """The one line with which a command refuses its arguments."""
    capfd.readouterr()
    assert cli.run(list(arguments)) == 2
    said = capfd.readouterr()
    (line,) = said.err.splitlines()
    assert not said.out and "Traceback" not in line
    return line


# Design and render


def test_a_lamp_is_a_project_that_render_judges_by_independent_rays(road, capfd):
    designed = figures_of(capfd, "design", "uniform", *ROAD, "-o", str(road))  # nothing to do
    figures = figures_of(capfd, "render", str(road), "--rays", "40000", "--seed", "7", "-o", "seen.png", "--npy", "seen.npy")
    for found in (designed, figures):
        assert found["of_source"] + math.fsum(found["lost"].values()) == pytest.approx(1.0, abs=1e-12)
        assert 0.8 < found["of_source"] < found["uncoated_limit"]
    assert figures["of_source"] == pytest.approx(designed["of_source"], abs=0.01)
    assert figures["of_source"] != designed["of_source"]  # other rays
    assert designed["relative_rms"] < 0.4 and designed["uniformity"] > 0.4
    seen = np.load("seen.npy")
    assert list(seen.shape) == figures["pixels"] and seen.sum() == pytest.approx(figures["of_source"], abs=1e-12)
    with Image.open("seen.png") as image:
        assert image.size == tuple(figures["pixels"])
    assert {path.name for path in road.iterdir()} >= {"project.toml", "checkpoints.h5", "render.png", "target.npy"}


def test_the_table_names_all_light(road, capfd):
    assert cli.run(["render", str(road), "--rays", "10000", "-o", "a.png"]) == 0
    said = capfd.readouterr().out
    for words in ("on target", "of all light", "relative RMS error", "outer fresnel", "least wall"):
        assert words in said


def test_a_render_is_repeated_to_the_byte_and_recognised(road, capfd):
    for name in ("a", "b"):
        assert cli.run(["render", str(road), "--rays", "20000", "-o", f"{name}.png", "--npy", f"{name}.npy", "--quiet"]) == 0
    assert Path("a.npy").read_bytes() == Path("b.npy").read_bytes()
    capfd.readouterr()
    assert cli.run(["render", str(road), "--rays", "20000", "-o", "a.png", "--npy", "a.npy"]) == 0
    assert "is up to date" in capfd.readouterr().err


def test_a_design_in_the_far_field_tells_its_peak_and_its_angles(capfd):
    far = ["--lamp", "15", "--screen", "far", "--angles", "100x60", "--index", "1.49"]
    figures = figures_of(capfd, "design", "disc", *far, "-o", "far")
    assert figures["peak_candela"] > 300 and len(figures["beam_angles"]) == 2
    settings = Project.open("far").settings
    assert settings.lamp.angles == (100.0, 60.0) and settings.lens.index == 1.49 and "z" not in settings.screen
    capfd.readouterr()
    assert cli.run(["render", "far", "--rays", "5000", "-o", "x.png"]) == 0
    assert "cd per 1000 lm" in capfd.readouterr().out


def test_a_lamp_may_stand_beside_its_picture(capfd):
    given = ["--lamp", "15", "--throw", "8m", "--picture-size", "16mx8m", "--screen-shift", "0,3m", "--lamp-inner", "2"]
    assert cli.run(["design", "uniform", *given, "-o", "beside"]) == 0
    assert "turned by 83 to reach the nearest edge" in capfd.readouterr().err
    figures = figures_of(capfd, "render", "beside", "--rays", "20000", "-o", "a.png", "--npy", "a.npy")
    assert figures["of_source"] > 0.75
    assert Project.open("beside").settings.screen.shift == (0.0, 3000.0)
    seen = np.load("a.npy").sum(0)
    assert seen[: len(seen) // 2].sum() == pytest.approx(0.5 * seen.sum(), rel=0.15)  # either half of the picture is lit


def test_a_chip_of_any_shape_is_designed_for(capfd):
    for shape in ("rectangle", "disc"):
        given = ["--chip", "1x0.5", "--chip-shape", shape, "--glass", "PMMA", "-o", shape]
        figures = figures_of(capfd, "design", "uniform", *ROAD[:-1], *given)
        assert figures["of_source"] > 0.75
        chip = LampDesign.of(Project.open(shape)).lamp.chip
        assert (chip.shape, chip.size) == (shape, (1.0, 0.5))


@pytest.mark.parametrize("flip", ["", "x", "y", "xy"])
def test_the_light_lies_as_the_picture_says(flip, capfd):
    picture = np.zeros((8, 8))
    picture[1:5, 1:7], picture[5:7, 1:3] = 1.0, 3.0  # an L, of two shades
    np.save("l.npy", picture)
    more = ["--flip", flip] if flip else []
    assert cli.run(["design", "l.npy", *ROAD[:4], "--picture-size", "14m", "--lamp-inner", "3", *more, "-o", "l", "--quiet"]) == 0
    figures = figures_of(capfd, "render", "l", "--rays", "100000", "-o", "l.png", "--npy", "seen.npy")
    assert figures["uniformity"] is None and figures["of_source"] > 0.7
    turned = picture[::-1] if "x" in flip else picture
    turned = turned[:, ::-1] if "y" in flip else turned
    seen = np.load("seen.npy")
    at = np.ix_(*(((np.arange(n) + 0.5) / n * 8).astype(int) for n in seen.shape))
    fits = [np.corrcoef(t[at].ravel(), seen.ravel())[0, 1] for t in (turned, turned[::-1], turned[:, ::-1], turned.T)]
    assert fits[0] > 0.7 and fits[0] > max(fits[1:]) + 0.1


def test_two_surfaces_are_designed_rendered_and_exported(capfd):
    figures = figures_of(capfd, "design", "uniform", *ROAD[:-1], "--lamp-surfaces", "2", "--chip", "0.5", "-o", "two")
    assert figures["of_source"] > 0.8 and figures["least_wall"] > 1.0
    found = LampDesign.of(Project.open("two"))
    assert found.values.shape == (2, 11, 11) and found.lamp.inner == 2.0
    seen = figures_of(capfd, "render", "two", "--rays", "20000", "-o", "two.png")
    assert seen["of_source"] == pytest.approx(figures["of_source"], abs=0.02)
    vertices, faces = lamp_mesh(found.lamp, found.field, found.values, (40, 90))
    a, b, c = vertices[faces].transpose(1, 0, 2)
    assert float((np.cross(a, b) * c).sum()) > 0
    assert figures_of(capfd, "export", "two", "--format", "ldt")["flux"] > 800.0
    text = Path("two/project.toml").read_text()
    Path("two/project.toml").write_text(text.replace("surfaces = 2", "surfaces = 1"))
    assert "holds no lamp" in refused(capfd, "render", "two", "-o", "two.png")


def test_an_edited_project_is_rendered_as_it_says(road, capfd):
    text = (road / "project.toml").read_text()
    assert "chip = [0.0, 0.0]" in text and "[source]" not in text
    other = road.parent / "edited.caustic"
    other.mkdir()
    for file in road.iterdir():
        (other / file.name).write_bytes(file.read_bytes())
    (other / "project.toml").write_text(text.replace("chip = [0.0, 0.0]", "chip = [2.0, 2.0]"))
    one, two = (figures_of(capfd, "render", str(p), "--rays", "40000", "-o", f"{p.stem}.png") for p in (road, other))
    assert two["of_source"] < one["of_source"]  # a wider chip


def test_a_project_edited_beyond_its_lens_is_refused(road, capfd):
    other = road.parent / "thin.caustic"
    other.mkdir()
    for file in road.iterdir():
        (other / file.name).write_bytes(file.read_bytes())
    text = (road / "project.toml").read_text()
    for old, new, words in (
        ("inner = 4.0", "inner = 9.0", "the free-form surface comes within"),
        ("radius = 15.0", "radius = -1.0", "radius must be"),
        ("radius = 15.0", "radius = nan", "radius must be a number"),
        ("chip = [0.0, 0.0]", "chip = [0.0, 1.0]", "two sizes above 0 mm"),
        ("chip = [0.0, 0.0]", "chop = [0.0, 0.0]", "is not a key; did you mean chip"),
        ("[screen]", "[screen]\ntilt = [0.0, 10.0]", "tilt is not a setting of a lamp"),
        ("size = [30000.0", "size = [0.0", "size"),
    ):
        assert old in text
        (other / "project.toml").write_text(text.replace(old, new))
        assert words in refused(capfd, "render", str(other), "-o", "x.png"), old
    assert not Path("x.png").exists()


def test_an_interrupted_design_goes_on_after_its_last_complete_stage(road, capfd, monkeypatch):
    stages = []
    refine = inverse.refine

    def interrupted(objective, values, iterations, on_iteration):
        stages.append(len(stages))
        if len(stages) == 2:
            raise KeyboardInterrupt
        return refine(objective, values, iterations, on_iteration)

    monkeypatch.setattr(inverse, "refine", interrupted)
    assert cli.run(["design", "uniform", *ROAD, "-o", "half"]) == 130
    capfd.readouterr()
    assert Project.open("half").load().state.stage == 1 and not Path("half/render.png").exists()
    figures = figures_of(capfd, "design", "--resume", "half")
    assert len(stages) == 3 and Path("half/render.png").is_file()
    one, other = (Project.open(path).load() for path in ("half", road))
    assert torch.equal(one.state.heights, other.state.heights)
    assert figures["iterations"] == len(one.state.history) == other.results["iterations"]
    again = figures_of(capfd, "design", "--resume", "half")
    assert len(stages) == 3 and again["of_source"] == figures["of_source"]


def test_the_same_command_goes_on_with_an_interrupted_design(capfd, monkeypatch):
    def interrupted(*_arguments, **_more):
        raise KeyboardInterrupt

    with monkeypatch.context() as other:
        other.setattr(LampDesign, "evaluated", interrupted)
        assert cli.run(["design", "uniform", *ROAD, "-o", "half"]) == 130
    capfd.readouterr()
    with monkeypatch.context() as other:
        other.setattr(inverse, "refine", interrupted)  # all stages are done
        assert figures_of(capfd, "design", "uniform", *ROAD, "-o", "half")["of_source"] > 0.8


def test_lamps_are_designed_rendered_and_exported_from_python(road):
    lamp = caustic_cli.design("uniform", lamp=15, throw=8000, picture_size=[30000, 10000])
    assert isinstance(lamp, LampDesign) and torch.equal(lamp.values, caustic_cli.load(road).values)
    image, figures = caustic_cli.render(lamp, 20_000, seed=3)
    assert image.sum() == pytest.approx(figures["of_source"]) == pytest.approx(0.84, abs=0.03)
    assert caustic_cli.render(road, 20_000, seed=3).figures["of_source"] == figures["of_source"]
    assert lamp.export("a.step").read_text().startswith("ISO-10303-21") and lamp.export("b.obj", samples=(9, 20)).is_file()
    for what, words in (
        (lambda: lamp.export("a.dat"), "format is needed"),
        (lambda: caustic_cli.load(road, source="disc"), "has no other light or screen"),
        (lambda: caustic_cli.design("uniform", lamp=15, device="cuda", angles=[60, 60]), "on the CPU"),
        (lambda: caustic_cli.design("uniform", lamp=15, movie="a.gif", angles=[60, 60]), "is for a lens before its light"),
    ):
        with pytest.raises(InputError, match=words):
            what()


# Refusals


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--lamp", "15"], "--picture-size on a screen, or --angles in the far field"),
        (["--lamp", "15", "--screen", "far"], "needs --angles"),
        (["--lamp", "15", "--screen", "floor:1m", "--angles", "60"], "of a lamp must be far"),
        (["--lamp", "15", "--angles", "60", "--throw", "2m"], "leave out its distance"),
        (["--lamp", "15", "--angles", "60", "--screen-shift", "0,1m"], "leave out its distance, its size and its shift"),
        (["--lamp", "15", "--angles", "200"], "at most 178"),
        (["--lamp", "0", "--angles", "60"], "--lamp must be"),
        (["--lamp", "nan", "--angles", "60"], "--lamp"),
        (["--lamp", "15", "--angles", "60", "--lamp-inner", "14.5"], "must be greater than --lamp-inner and --lamp-wall"),
        (["--lamp", "15", "--angles", "60", "--chip", "9x9"], "[lamp] inner must be greater than the radius of the chip"),
        (["--lamp", "6", "--angles", "60", "--lamp-inner", "4"], "--lamp of"),
        (["--lamp", "15", "--angles", "60", "--lamp-surfaces", "3"], "--lamp-surfaces must be"),
        (["--lamp", "15", "--angles", "60", "--chip-shape", "star"], "--chip-shape must be"),
        (["--lamp", "15", "--angles", "60", "--lamp-flange", "2"], "needs the thickness --lamp-base"),
        (["--lamp", "15", "--angles", "60", "--mag", "3"], "--mag is not a setting of a lamp"),
        (["--lamp", "15", "--angles", "60", "--source", "disc"], "--source is not a setting of a lamp"),
        (["--lamp", "15", "--angles", "60", "--lens-size", "20"], "--lens-size is not a setting of a lamp"),
        (["--lamp", "15", "--angles", "60", "--movie", "a.gif"], "--movie is for a lens before its light"),
        (["--lamp", "15", "--angles", "60", "--error", "0.1"], "--error is for a lens before its light"),
        (["--lamp", "15", "--angles", "60", "--plan"], "--plan is for a lens before its light"),
        (["--lamp", "15", "--angles", "60", "--device", "cuda"], "cuda"),
        (["--lamp", "15", "--angles", "60", "--dtype", "float32"], "--dtype is not a setting of a lamp"),
        (["--chip", "1"], "--chip belongs to a lamp, which --lamp makes"),
        (["--angles", "60"], "--angles belongs to a lamp"),
        (["--lamp", "15", "--picture-size", "3m", "--throw", "-1m"], "distance"),
        (["--lamp", "15", "--picture-size", "3m", "--throw", "29"], "must be 2 times --lamp or more"),
        (["--lamp", "15", "--picture-size", "3mx1cm"], "at most 100 times as long as wide"),
    ],
)
def test_a_design_that_is_none_is_refused_in_one_line(given, words, capfd):
    assert words in refused(capfd, "design", "uniform", "--quiet", *given)
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["render", "--effects", "absorption"], "--effects of a lamp must be none, auto or ghosts"),
        (["render", "--screen-at", "100"], "--screen-at is for a lens before its light"),
        (["render", "--source", "disc"], "--source is for a lens before its light"),
        (["render", "--html", "a.html"], "--html is for a lens before its light"),
        (["render", "--verify", "mitsuba"], "not installed"),
        (["export"], "a --format is needed"),
        (["export", "-o", "a.dat"], "a --format is needed"),
        (["export", "--format", "heightmap"], "a lamp's surface is none of that"),
        (["export", "--format", "phase"], "step and lighttools as a solid, zemax as a Polygon Object"),
        (["export", "--format", "step", "--samples", "9"], "--samples belongs to stl, ply, obj, 3mf"),
        (["export", "--format", "gcode"], "a lamp's surface is none of that"),
        (["export", "--format", "stl", "--mould"], "--mould is for a lens before its light"),
        (["export", "--format", "ies", "--samples", "9"], "--samples belongs to stl, ply, obj, 3mf"),
        (["export", "--format", "stl", "--samples", "1"], "2 to 4000 rings"),
        (["export", "--format", "stl,ply", "-o", "a.stl"], "--out names one file"),
        (["gradmap", "--reconstruction", "bincount"], "the derivative of an image needs gaussian or cosine"),
        (["gradmap", "--control", "3,99"], "--control must be I,J"),
        (["gradmap", "--at", "throw=300"], "--at is for a lens before its light"),
        (["convergence"], "makes a lamp"),
        (["design", "--resume", "--iterations", "9"], "--iterations is for a lens before its light"),
        (["design", "--resume", "--movie", "a.gif"], "--movie is for a lens before its light"),
    ],
)
def test_what_a_lamp_has_not_is_refused_in_one_line(command, words, road, capfd, monkeypatch):
    monkeypatch.setattr(verify, "find_spec", lambda name: None)
    name, *options = command
    assert words in refused(capfd, name, str(road), *options)


def test_of_several_formats_none_is_written_where_one_is_refused(road, capfd):
    before = set(Path().iterdir())
    assert "a lamp's surface is none of that" in refused(capfd, "export", str(road), "--format", "ldt,gcode")
    assert set(Path().iterdir()) == before


def test_a_lens_has_no_photometric_file(capfd):
    small = ["--resolution", "32", "--control", "20", "--rays", "4000", "--iterations", "1", "--waves", "off", "--quiet"]
    assert cli.run(["design", "disc", *small]) == 0  # a picture by its name, of a lens as well
    assert "must be one of lighttools" in refused(capfd, "export", "disc.caustic", "--format", "ies")


def test_pictures_by_name_give_way_to_files():
    assert read_picture("uniform").irradiance().tolist() == [[1.0, 1.0], [1.0, 1.0]]
    disc = read_picture("disc").irradiance()
    assert disc.mean() == pytest.approx(math.pi / 4, abs=1e-5) and disc.max() == 1.0
    assert 0.005 < ((disc > 0) & (disc < 1)).sum() / (disc > 0).sum() < 0.02  # the edge, not a staircase
    Image.new("L", (3, 5), 200).save("disc", "PNG")
    assert read_picture("disc").irradiance_shape == (3, 5)


# Solids


def test_the_mesh_is_closed_oriented_and_has_the_volume_of_its_surfaces():
    lamp, field = Lamp(inner=4.0, radius=15.0), PolarField.uniform((8, 8))
    vertices, faces = lamp_mesh(lamp, field, field.sphere(10.0), (60, 240))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    seen = {tuple(edge) for edge in edges.tolist()}
    assert len(seen) == len(edges) and all((b, a) in seen for a, b in seen)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    volume = float((np.cross(a, b) * c).sum() / 6.0)
    assert volume == pytest.approx(2.0 / 3.0 * math.pi * (10.0**3 - 4.0**3), rel=1e-3)
    assert vertices[:, 2].min() == 0.0 and vertices[:, 2].max() == pytest.approx(10.0)


@pytest.mark.parametrize("format", ["stl", "ply", "obj", "3mf"])
def test_solids_are_written_and_repeated(format, road, capfd):
    figures = figures_of(capfd, "export", str(road), "--format", format, "--samples", "20x60")
    path = Path(figures["file"])
    assert path.stat().st_size == figures["bytes"] > 1000
    first = path.read_bytes()
    assert cli.run(["export", str(road), "--format", format, "--samples", "20x60", "--force", "--quiet"]) == 0
    assert path.read_bytes() == first
    if format == "stl":
        assert int.from_bytes(first[80:84], "little") == 2 * (60 + 19 * 120) + 120
    if format == "obj":
        assert first.count(b"\nv ") == 2 * (1 + 20 * 60)


def test_a_polygon_object_is_a_closed_solid_with_a_group_for_each_surface(road, capfd):
    figures = figures_of(capfd, "export", str(road), "--format", "zemax", "--samples", "20x60")
    comment, *lines = Path(figures["file"]).read_text().splitlines()
    assert figures["file"].endswith(".pob") and comment.startswith("!") and "0 inner surface, 1 outer surface, 2 foot" in comment
    vertices = np.array([line.split()[1:] for line in lines if line[0] == "V"], dtype=float)
    triangles = np.array([line.split()[1:] for line in lines if line[0] == "T"], dtype=int)
    assert len(vertices) + len(triangles) == len(lines) and list(vertices[:, 0]) == list(range(1, len(vertices) + 1))
    faces, (kind, group) = triangles[:, :3] - 1, triangles[:, 3:].T
    ways = [tuple(way) for way in np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()]
    assert len(set(ways)) == len(ways) and {(b, a) for a, b in ways} == set(ways)
    assert not kind.any() and set(group) == {0, 1, 2}
    inner = np.linalg.norm(vertices[np.unique(faces[group == 0]), 1:], axis=1)
    assert inner == pytest.approx(4.0, abs=1e-6)  # the hemisphere


def test_lighttools_has_the_step_file(road, capfd):
    for name in ("step", "lighttools"):
        figures_of(capfd, "export", str(road), "--format", name, "-o", f"{name}.step")
    one, other = (Path(f"{name}.step").read_text().split("DATA;")[1] for name in ("step", "lighttools"))
    assert one == other


def test_a_foot_is_part_of_the_solid_and_a_step_file_is_repeated(road, capfd):
    other = road.parent / "foot.caustic"
    other.mkdir()
    for file in road.iterdir():
        (other / file.name).write_bytes(file.read_bytes())
    text = (road / "project.toml").read_text()
    (other / "project.toml").write_text(text.replace("[lamp]", "[lamp]\nbase = 1.5\nflange = 2.0"))
    assert figures_of(capfd, "export", str(other), "--format", "obj", "--samples", "20x60")["file"] == "foot.obj"
    heights = [float(line.split()[3]) for line in Path("foot.obj").read_text().splitlines() if line.startswith("v ")]
    assert min(heights) == -1.5
    figures = figures_of(capfd, "export", str(other), "--format", "step")
    first = Path("foot.step").read_bytes()
    assert figures["bytes"] == len(first) and first.count(b"ADVANCED_FACE") == 8
    assert cli.run(["export", str(other), "--format", "step", "--force", "--quiet"]) == 0
    assert Path("foot.step").read_bytes() == first


def test_a_scene_for_mitsuba_lies_beside_its_meshes(road, capfd):
    figures = figures_of(capfd, "export", str(road), "--format", "mitsuba", "--samples", "20x60")
    assert [Path(file).is_file() for file in (figures["file"], *figures["beside"])] == [True] * 4
    assert figures["file"] == "road.xml" and "road-outer.ply" in Path("road.xml").read_text()


@pytest.mark.parametrize("agree", [True, False])
def test_a_comparison_with_mitsuba_decides_the_exit_status(agree, road, capfd, monkeypatch):
    asked = []

    def found(scene, lamp, goal, field, values, pixels, rays, seed):
        asked.append(rays)
        assert scene.is_file()
        image = np.random.default_rng(1).uniform(1.0, 2.0, (9, *pixels)) / 1e4
        decision = compare(image[:8], image[8], image[8] / 1e5, rays, 0.0, {"mitsuba": "3", "variant": "none"})
        return replace(decision, figures=decision.figures | {"agree": agree})

    monkeypatch.setattr(workflow, "verify_lamp", found)
    monkeypatch.setattr(verify, "find_spec", lambda name: True)
    status = cli.run(["render", str(road), "--verify", "mitsuba", "--rays", "50000", "-o", "a.png"])
    assert status == (0 if agree else 1) and asked == [50000] and Path("a-verify.png").is_file()
    assert ("agree" if agree else "DISAGREE") in capfd.readouterr().out


@pytest.mark.parametrize("goal", [Goal((3000.0, 1000.0), 2000.0), Goal((120.0, 40.0))])
def test_the_illuminance_of_a_report_is_flux_over_area_or_solid_angle(goal):
    """Of all of 1000 lm: lux times square metres, or candela times steradians."""
    image = np.random.default_rng(2).uniform(size=(60, 20))
    image *= 0.8 / image.sum()
    area = 3.0 if not goal.far else math.radians(120.0) * 2.0 * math.sin(math.radians(20.0))
    assert float((density(goal, image) * goal.shares((60, 20)) * area).sum()) == pytest.approx(800.0)


def size_of(path):
    """Width and height of an image."""
    with Image.open(path) as image:
        return image.size


def test_a_report_is_drawn_by_design_and_render(road, capfd, monkeypatch):
    figures = figures_of(capfd, "render", str(road), "--rays", "20000", "--report", "-o", "a.png")
    assert size_of("a-report.png") == (1500, 800)
    assert figures["peak_candela"] > 500.0 and len(figures["beam_angles"]) == len(figures["field_angles"]) == 2
    assert all(field > beam > 30.0 for beam, field in zip(figures["beam_angles"], figures["field_angles"], strict=True))
    assert figures["beam_angles"][0] > figures["beam_angles"][1]  # the road is long along x
    monkeypatch.setenv("CAUSTIC_EFFORT", "test report=True lamp_stages=((300,5000,2,0.1),(300,5000,2,0.1))")
    assert cli.run(["design", "uniform", "--lamp", "15", "--angles", "120x60", "-o", "far", "--quiet"]) == 0
    assert size_of("far/report.png") == (1500, 800)


# Photometry


def test_a_sphere_about_a_point_has_the_intensity_of_its_lambertian_chip():
    field = PolarField.uniform((8, 8))
    table = intensity_table(Lamp(), field, field.sphere(12.0), (5.0, 30.0), rays=200_000)
    assert table.flux == pytest.approx(1000.0 * uncoated_limit(Lamp()), rel=1e-9)
    expected = uncoated_limit(Lamp()) * 1000.0 / math.pi * np.cos(np.radians(table.angles[:17]))
    np.testing.assert_allclose(table.values[:, :17], np.broadcast_to(expected, (12, 17)), rtol=0.03, atol=1.0)
    assert table.values[:, 20:].max() == 0.0
    assert table.full_angle(0.5, 0) == pytest.approx(120.0, abs=2.0)
    assert float(table.solid_angles.sum()) * 12 == pytest.approx(4.0 * math.pi)


@pytest.mark.parametrize("format", ["ies", "ldt"])
def test_photometric_files_hold_the_light_of_the_lamp(format, road, capfd):
    figures = figures_of(capfd, "export", str(road), "--format", format)
    light = read_photometry(Path(figures["file"]))
    lamp = LampDesign.of(Project.open(road))
    table = intensity_table(lamp.lamp, lamp.field, lamp.values, rays=40_000)
    assert light.values.shape == (72, 181) and light.lumens == 1000.0
    np.testing.assert_array_equal(light.planes, table.planes)
    np.testing.assert_array_equal(light.angles, table.angles)
    error = light.values - table.values
    assert float(np.sqrt((error**2).mean())) < 1e-5 * float(np.sqrt((table.values**2).mean()))
    leaving = 1000.0 * (1.0 - sum(part for name, part in lamp.figures["lost"].items() if name != "elsewhere"))
    assert figures["flux"] == pytest.approx(leaving, rel=0.01)
    assert light.diameter == pytest.approx(2.0 * lamp.figures["greatest_radius"], rel=1e-3)
    assert all(len(line) <= 132 for line in Path(figures["file"]).read_text("latin-1").splitlines())


def test_an_ies_file_has_the_lines_of_the_standard():
    light = Photometry(np.array([0.0, 90.0, 180.0, 270.0]), np.array([0.0, 90.0, 180.0]), np.arange(12.0).reshape(4, 3))
    write_ies(Path("a.ies"), light)
    lines = Path("a.ies").read_text("ascii").splitlines()
    assert lines[0] == "IES:LM-63-2019" and "TILT=NONE" in lines
    after = lines[lines.index("TILT=NONE") + 1 :]
    assert after[0].split() == ["1", "1000", "1", "3", "5", "1", "2", "0", "0", "0"]
    assert after[2:4] == ["0 90 180", "0 90 180 270 360"]
    assert [line.split() for line in after[4:]] == [[str(3 * p + k) for k in range(3)] for p in (0, 1, 2, 3, 0)]


def test_an_ldt_file_has_the_lines_of_the_format():
    values = np.array([[3.0, 1.0, 0.0]] * 4)
    light = Photometry(np.arange(4) * 90.0, np.array([0.0, 90.0, 180.0]), values, lumens=500.0, diameter=30.0, height=15.0)
    write_ldt(Path("a.ldt"), light)
    lines = Path("a.ldt").read_text("latin-1").splitlines()
    assert lines[1:7] == ["3", "0", "4", "90", "3", "90"]
    assert lines[12:15] == ["30", "0", "15"] and lines[25:27] == ["1", "1"] and lines[28] == "500"
    assert len(lines) == 26 + 6 + 10 + 4 + 3 + 12
    assert lines[42:49] == ["0", "90", "180", "270", "0", "90", "180"]
    assert lines[49:52] == ["6", "2", "0"]  # candela per 1000 lm
    np.testing.assert_allclose(read_photometry(Path("a.ldt")).values, values)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"IES:LM-63-2019\n", "TILT=NONE"),
        (b"IES:LM-63-2019\nTILT=INCLUDE\n1", "TILT=NONE"),
        (b"IES:LM-63-2019\nTILT=NONE\n1 1000 1 3 2 1 2 0 0 0\n1 1 0\n0 90 180\n0 360\n1 2", "ends early"),
        (b"IES:LM-63-2019\nTILT=NONE\n1 1000 1 3 2 2 2 0 0 0\n1 1 0\n", "not of type C"),
        (b"IES:LM-63-2019\nTILT=NONE\n1 1000 1 9e9 2 1 2 0 0 0\n1 1 0\n", "at most 2000"),
        (b"IES:LM-63-2019\nTILT=NONE\n1 x\n", "damaged"),
        (b"a\n1\n4\n", "damaged"),
        (b"a\n1\n7\n5\n1\n6\n", "symmetry 7"),
        (b"\x00" * 4000, "damaged"),
    ],
)
def test_damaged_photometric_files_are_refused_in_one_line(content, words):
    Path("a.ies").write_bytes(content)
    with pytest.raises(InputError) as error:
        read_photometry(Path("a.ies"))
    assert words in str(error.value) and "\n" not in str(error.value)


def test_the_values_of_a_checkpoint_are_those_of_r(road):
    lamp = LampDesign.of(Project.open(road))
    least, greatest = lamp.field.extent(lamp.values)
    assert lamp.lamp.inner + lamp.lamp.wall < least < greatest < 16.0
    x, y, z = lamp.field.points(lamp.values, torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    assert float(x) == float(y) == 0.0 and least <= float(z) <= greatest


def test_a_map_of_the_derivative_agrees_with_central_differences(road, capfd):
    asked = ["gradmap", str(road), "--rays", "1e5", "--check", "-o", "map.png", "--npy", "map.npy"]
    (found,) = figures_of(capfd, *asked)["maps"]
    change = np.load("map.npy")
    assert found["control"] == [9, 9] and found["check"]["relative_error"] < 1e-6
    lit = np.argwhere(change != 0)
    assert 10 < len(lit) < change.size  # under the basis function alone
    assert abs(found["sum"]) < 1e-2 * np.abs(change).sum()  # light is moved, and a little of it reflected
