"""Points, grids and discs on the command line and in project.toml; a design that changes its source on the way."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.config.design import build_stages
from caustic_cli.errors import InputError
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene import Disc, Offset, Points

TINY = [
    "--resolution",
    "24",
    "--control",
    "12",
    "--rays",
    "4000",
    "--quiet",
    "--threads",
    "1",
    "--lens-size",
    "5",
    "--throw",
    "150",
]
SCHEDULE = """
[source]
type = "grid"
position = [0, 0, -40]
size = [4, 4]
grid = [3, 3]
[lens]
control = [12, 12]
[[design.stages]]
source = "point"
rays = 4000
iterations = 3
[[design.stages]]
rays = 4500
iterations = 4
"""


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()


def run(capfd, *arguments, code=0):
    assert cli.run([*map(str, arguments), "--json"]) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


@pytest.mark.parametrize(
    "source",
    [
        ["--source", "point"],
        ["--source", "point", "--source-position", "1,-1,-40", "--cone", "30"],
        ["--source", "grid", "--source-grid", "2x3", "--source-size", "1"],
        ["--source", "disc", "--source-size", "2x1"],
        ["--source-angle", "0.5"],
    ],
)
def test_every_source_designs_renders_and_exports(capfd, source):
    figures = run(capfd, "design", "blob.png", *source, *TINY, "--iterations", "8")
    history = Project.open("blob.caustic").load().state.history
    assert history[-1][2] < history[0][2]
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    again = run(capfd, "render", "blob.caustic", "--rays", "40000", "--quiet", "--threads", "1", "--force")
    assert again["relative_rms"] == pytest.approx(figures["relative_rms"], rel=0.05)
    assert cli.run(["export", "blob.caustic", "--format", "lighttools", "-o", "lens.npz", "--quiet"]) == 0
    with np.load("lens.npz", allow_pickle=False) as file:
        assert str(file["source_type"]) == ("disc" if source == ["--source-angle", "0.5"] else source[1])
        far = "--source-angle" in source
        assert file["source_positions"].shape[1] == 3 and len(file["source_positions"]) == (0 if far else len(file["source_power"]))
        assert file["source_power"].sum() == pytest.approx(1.0)
        assert float(file["cone_half_angle"]) > 0
    capfd.readouterr()
    assert cli.run(["gradmap", "blob.caustic", "--control", "5,5", "--rays", "20000", "--check", "--quiet", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["maps"][0]["check"]["relative_error"] < 1e-4


def test_render_with_another_source(capfd):
    run(capfd, "design", "blob.png", *TINY, "--iterations", "3")
    plane = run(capfd, "render", "blob.caustic", "--rays", "40000", "--quiet", "-o", "a.png", "--npy", "a.npy")
    far = run(
        capfd,
        "render",
        "blob.caustic",
        "--rays",
        "40000",
        "--quiet",
        "-o",
        "b.png",
        "--npy",
        "b.npy",
        "--source",
        "point",
        "--source-position",
        "0,0,-1e6",
    )
    near = run(
        capfd,
        "render",
        "blob.caustic",
        "--rays",
        "40000",
        "--quiet",
        "-o",
        "c.png",
        "--source-position",
        "0,0,-60",
        "--source",
        "disc",
    )  # light that diverges this much lands elsewhere
    assert far["relative_rms"] == pytest.approx(plane["relative_rms"], rel=0.02)
    assert near["on_screen"] < 0.5 * far["on_screen"]
    a, b = np.load("a.npy"), np.load("b.npy")
    assert np.linalg.norm(a / a.sum() - b / b.sum()) / np.linalg.norm(a / a.sum()) < 0.05
    assert settings.read(Path("blob.caustic/project.toml"))["source"]["type"] == "plane"  # the project stays as it was


def test_a_design_changes_its_source_and_resumes_inside_any_stage(capfd):
    Path("schedule.toml").write_text(SCHEDULE)
    base = ["design", "blob.png", "--config", "schedule.toml", "--resolution", "24", "--quiet", "--threads", "1"]
    run(capfd, *base, "-o", "whole.caustic")
    whole = Project.open("whole.caustic").load().state
    assert [row[1] for row in whole.history] == [0] * 3 + [1] * 4
    for stop in (2, 5):
        run(capfd, *base, "-o", f"{stop}.caustic", "--iterations", stop)
        run(capfd, "design", "--resume", f"{stop}.caustic", "--iterations", 7, "--quiet", "--threads", "1")
        state = Project.open(f"{stop}.caustic").load().state
        assert [row[:4] for row in state.history] == [row[:4] for row in whole.history]
        assert bool((state.heights == whole.heights).all())


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--source", "moon"], "--source must be one of plane, point, grid, disc, gaussian, measured, rays, got 'moon'"),
        (["--source", "point", "--source-position", "1,2"], "--source-position must be 3 numbers separated by commas"),
        (
            ["--wavelengths", "abc"],
            "--wavelengths must be wavelengths in nm, each with a weight or without, like 450:2,550, got 'abc'",
        ),
        (["--source", "point", "--source-position", "0,0,5"], "--source-position must lie before the lens"),
        (["--source", "grid", "--source-position", "0,0,-5", "--source-position", "1,0,-5"], "is its centre, one"),
        (["--source", "point", "--cone", "95"], "--cone must be"),
        (["--source", "grid", "--source-grid", "5000"], "--source-grid must be"),
        (["--source", "disc", "--source-angle", "-1"], "--source-angle must be"),
    ],
)
def test_bad_sources_are_one_line(capfd, arguments, message):
    err = run(capfd, "design", "blob.png", *arguments, "--quiet", code=2)
    assert message in err and "\n" not in err
    assert not Path("blob.caustic").exists()


def test_the_first_sphere_allows_for_the_light_s_divergence():
    base = {"lens": {"size": [10.0, 10.0]}, "screen": {"z": 300.0}}
    plane = complete(base, 1.0).lens.radius[0]
    assert plane == pytest.approx(Offset.for_magnification((3.0, 3.0), 1.5443, 300.0, 5.0).radius[0])
    far = complete({**base, "source": {"type": "point", "position": [[0.0, 0.0, -1e7]]}}, 1.0).lens.radius[0]
    assert far == pytest.approx(plane, rel=1e-3)
    near = complete({**base, "source": {"type": "point", "position": [[0.0, 0.0, -50.0]]}}, 1.0).lens.radius[0]
    assert -60 < near < -30  # it must gather what parallel light would need spread
    close = complete({**base, "source": {"type": "point", "position": [[0.0, 0.0, -1.0]]}}, 1.0).lens.radius[0]
    assert close == pytest.approx(-1.25 * np.hypot(5, 5))


def test_what_a_section_says_is_what_is_built():
    said = {"type": "point", "position": [[0, 0, -5.0], [1, 0, -6.0]], "powers": [1.0, 3.0], "power": 2.0}
    full = complete({"source": said}, 1.0)
    source = settings.build_source(full.source)
    assert isinstance(source, Points) and source.powers == (0.5, 1.5) and source.positions[1] == (1, 0, -6.0)
    assert isinstance(settings.build_source(complete({"source": {"type": "disc"}}, 1.0).source), Disc)
    assert settings.build_source(full.source, type="plane").power == 2.0


def test_render_to_a_tolerance(capfd):
    run(capfd, "design", "blob.png", *TINY, "--iterations", "3")
    render = ["render", "blob.caustic", "--quiet", "--threads", "1", "-o", "a.png", "--force", "--rays", "4000"]
    truth = run(capfd, *render[:-2], "--rays", "2e6", "--npy", "truth.npy", "--seed", "5")
    for tolerance in (0.05, 0.01):
        figures = run(capfd, *render, "--tolerance", tolerance, "--npy", "a.npy")
        image, exact = np.load("a.npy"), np.load("truth.npy")
        error = np.sqrt(np.mean((image - exact) ** 2)) / exact.mean()
        assert figures["error_estimate"] <= tolerance
        assert error == pytest.approx(figures["error_estimate"], rel=0.25)
        assert figures["rays"] <= figures["rays_traced"] < 3 * figures["rays"]
        assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert figures["relative_rms"] == pytest.approx(truth["relative_rms"], rel=0.01)


@pytest.mark.parametrize("tolerance", ["0", "-1", "nan", "100"])
def test_a_tolerance_has_to_be_possible(capfd, tolerance):
    assert "--tolerance must be" in run(capfd, "render", "blob.caustic", "--tolerance", tolerance, code=2)


def test_a_stage_of_a_plane_wave_may_have_a_source_that_stands_somewhere(capfd):
    plane = SCHEDULE.replace('type = "grid"', 'type = "plane"').replace("position = [0, 0, -40]", "")
    Path("schedule.toml").write_text(plane)
    run(capfd, "design", "blob.png", "--config", "schedule.toml", "--resolution", "24", "--start", "offset", "--quiet")
    run(capfd, "render", "blob.caustic", "--rays", "4000", "--quiet")
    Path("schedule.toml").write_text(plane.replace('"point"', '"moon"'))
    assert run(capfd, "design", "blob.png", "--config", "schedule.toml", "-o", "x", code=2) == (
        "caustic: [[design.stages]] source must be one of plane, point, grid, disc, gaussian, measured, rays, got 'moon'"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--source-position", "0,0,-50"], "--source-position belongs to --source point, grid, disc or rays, got plane"),
        (["--source", "point", "--source-size", "2"], "--source-size belongs to --source grid or disc, got point"),
        (["--source", "disc", "--source-grid", "5"], "--source-grid belongs to --source grid, got disc"),
        (["--source", "grid", "--source-angle", "1"], "--source-angle belongs to --source disc, got grid"),
        (["--source-angle", "1", "--cone", "20"], "--cone has no meaning for a disc at infinity"),
    ],
)
def test_options_that_the_source_would_ignore_are_refused(capfd, options, message):
    assert message in run(capfd, "design", "blob.png", *options, *TINY, code=2)
    assert not Path("blob.caustic").exists()
    run(capfd, "design", "blob.png", *TINY, "--iterations", "1")
    assert message in run(capfd, "render", "blob.caustic", *options, code=2)


def test_an_option_may_be_meant_for_the_source_of_a_stage(capfd):
    Path("schedule.toml").write_text(SCHEDULE.replace('type = "grid"', 'type = "plane"').replace("position = [0, 0, -40]", ""))
    run(
        capfd,
        "design",
        "blob.png",
        "--config",
        "schedule.toml",
        "--resolution",
        "24",
        "--source-position",
        "0,0,-40",
        "--start",
        "offset",
        "--quiet",
    )
    project = Project.open("blob.caustic")
    assert project.settings.source.type == "plane"
    assert build_stages(project.settings)[0].source == Points(((0.0, 0.0, -40.0),))


def test_a_refusal_names_no_file_that_was_never_written(capfd):
    assert run(capfd, "design", "blob.png", "--source", "point", "--source-position", "0,0,5", *TINY, code=2).startswith(
        "caustic: --source-position must lie before the lens"
    )


@pytest.mark.parametrize("type", ["point", "grid"])
@pytest.mark.parametrize("power", [0.0, -1.0, float("inf")])
def test_a_bad_power_is_named_as_the_key_it_is(type, power):
    with pytest.raises(InputError, match=r"\[source\] power must be"):
        complete({"source": {"type": type, "power": power}}, 1.0)


def test_a_tolerance_out_of_reach_is_refused_as_soon_as_it_is_foreseen(capfd):
    run(capfd, "design", "blob.png", *TINY, "--iterations", "1")
    began = time.monotonic()
    assert "requires more than 1e+11 rays" in run(
        capfd, "render", "blob.caustic", "--rays", "4000", "--tolerance", "1e-9", "--quiet", "--threads", "1", code=1
    )
    assert time.monotonic() - began < 20  # and not after the 1e11 rays, hours
