"""Designs from beginning to end: the lens gets better, a resumed run is the run, the same seed the same bytes, signals."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import begun
from PIL import Image

from caustic_cli import cli
from caustic_cli.inverse import transport
from caustic_cli.inverse.designer import State
from caustic_cli.kinds import evaluation, surface
from caustic_cli.project import checkpoint
from caustic_cli.project.project import Project
from caustic_cli.workflow import design as workflow

TINY = ["--resolution", "24", "--control", "12", "--rays", "4000", "--quiet", "--threads", "1"]
#: A lens whose wave image takes a tenth of the time of one of 10 mm.
NARROW = ["--lens-size", "3", "--throw", "90"]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    """A fresh directory with a picture, few rays for the decision, and no report (its drawing takes most of the time)."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[0:24, 0:24]
    light = 40 + 200 * np.exp(-((x - 8) ** 2 + (y - 9) ** 2) / 30.0)
    Image.fromarray(light.astype(np.uint8)).save("blob.png")


def design(capfd, *arguments, code=0) -> dict:
    """Figures of `caustic design`, or its error line."""
    assert cli.run(["design", *map(str, arguments), "--json"]) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err


def load(project):
    return checkpoint.load(Path(project) / "checkpoints.h5")


def content(project) -> dict:
    """Everything a design is, but for the clock."""
    held = load(project)
    s = held.state
    tensors = {f"{group}.{k}": v for group in ("parameters", "optimizer") for k, v in getattr(s, group).items()}
    return {
        "heights": s.heights,
        **tensors,
        "counts": (s.stage, s.iteration, s.total),
        "reason": s.reason,
        "history": [row[:4] for row in s.history],
        "provenance": held.provenance,
        "knots": torch.cat([space.knots for space in held.spaces]),
        "results": {k: v for k, v in held.results.items() if k not in ("seconds", "accuracy_cost", "image", "project")},
    }


def assert_same(a: dict, b: dict) -> None:
    assert a.keys() == b.keys()
    for key, value in a.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == b[key].dtype and torch.equal(value, b[key]), key
        else:
            assert value == b[key], key


def exported(project) -> bytes:
    assert cli.run(["export", project, "-o", "lens.npz", "--force", "--quiet", "--samples", "9"]) == 0
    return Path("lens.npz").read_bytes()


def assert_same_files(a: str, b: str) -> None:
    assert (Path(a) / "render.png").read_bytes() == (Path(b) / "render.png").read_bytes()
    assert exported(a) == exported(b)


STAGES = """
[screen]
resolution = [24, 24]
[lens]
control = [12, 12]
[design]
optimizer = "{optimizer}"
{more}
""" + "".join(
    f"""
[[design.stages]]
control = [{net}, {net}]
rays = {rays}
blur = {blur}
apron = 2
iterations = 7
"""
    for net, rays, blur in ((7, 1500, 1.5), (7, 2000, 0.5), (12, 3000, 0.0))
)


def staged(name="c.toml", optimizer="lbfgs", more="") -> str:
    Path(name).write_text(STAGES.format(optimizer=optimizer, more=more))
    return name


# resume

KINDS = {
    "lbfgs": [],
    "lbfgs in double precision": ["--dtype", "float64"],
    "lbfgs by rms": ["--loss", "rms"],
    "adam": ["--optimizer", "adam"],
    "adam, sparse network": ["--network", "sparse"],
    "adam, dense network": ["--network", "dense"],
    "stages of lbfgs": ["--config", "lbfgs.toml"],
    "stages of adam": ["--config", "adam.toml"],
}


@pytest.mark.parametrize("kind", KINDS)
def test_twenty_iterations_are_ten_and_ten_bitwise(capfd, kind):
    staged("lbfgs.toml"), staged("adam.toml", "adam")
    options = [*(TINY if "--config" not in KINDS[kind] else ["--quiet", "--threads", "1"]), *KINDS[kind], "--seed", "5"]
    design(capfd, "blob.png", *options, "--iterations", 20, "-o", "whole")
    half = design(capfd, "blob.png", *options, "--iterations", 10, "-o", "parts")
    assert half["iterations"] == 10 and half["reason"] == "iterations"
    figures = design(capfd, "--resume", "parts", "--iterations", 20, "--quiet", "--threads", 1)
    assert figures["iterations"] == 20 == len(load("parts").state.history)
    assert_same(content("whole"), content("parts"))
    assert_same_files("whole", "parts")
    assert (Path("whole") / "project.toml").read_bytes() == (Path("parts") / "project.toml").read_bytes()


@pytest.mark.parametrize("optimizer", ["lbfgs", "adam"])
def test_resuming_at_and_beside_a_stage_boundary(capfd, optimizer):
    """Stages of 7, 7 and the rest: stops just before, at and just after each change of net."""
    config, options = staged(optimizer=optimizer), ["--quiet", "--threads", "1"]
    design(capfd, "blob.png", "--config", config, "--iterations", 16, "-o", "whole", *options)
    assert [row[1] for row in load("whole").state.history] == [0] * 7 + [1] * 7 + [2] * 2
    stops = (1, 6, 7, 8, 13, 14, 15, 16)
    design(capfd, "blob.png", "--config", config, "--iterations", stops[0], "-o", "parts", *options)
    for stop in stops[1:]:
        design(capfd, "--resume", "parts", "--iterations", stop, *options)
    assert_same(content("whole"), content("parts"))


def test_resume_finds_the_project_by_its_picture_and_goes_on(capfd):
    design(capfd, "blob.png", *TINY, "--iterations", 2)
    assert design(capfd, "--resume", "blob.png", "--iterations", 4, "--quiet")["iterations"] == 4
    assert design(capfd, "--resume", "blob.caustic", "--quiet")["iterations"] == 4  # nothing left: judged again
    assert len(load("blob.caustic").state.history) == 4


def test_a_finished_project_keeps_nothing_of_its_optimiser_and_goes_on_without(capfd):
    first = design(capfd, "blob.png", *TINY, "--waves", "off", "--quality", "draft")
    state = load("blob.caustic").state
    assert state.reason in workflow.DONE and not state.parameters and not state.optimizer
    more = design(capfd, "--resume", "blob.caustic", "--iterations", state.total + 5, "--quiet")
    assert more["relative_rms"] == pytest.approx(first["relative_rms"], rel=0.05)  # the judge's few rays are noisy
    held = load("blob.caustic").state
    assert held.reason == "no progress" or held.total == state.total + 5


def test_resume_takes_no_other_settings(capfd):
    design(capfd, "blob.png", *TINY, "--iterations", 1)
    before = (Path("blob.caustic") / "project.toml").read_bytes()
    for extra in (["--mag", 2], ["--seed", 0], ["--resolution", 30], ["--rays", 5000], ["--linear"], ["--quality", "draft"]):
        err = design(capfd, "--resume", "blob.caustic", "--iterations", 3, *extra, code=2)
        assert extra[0] in err and err.count("\n") == 1
    assert (Path("blob.caustic") / "project.toml").read_bytes() == before
    assert load("blob.caustic").state.total == 1


def test_fewer_iterations_than_done_lose_nothing(capfd):
    design(capfd, "blob.png", *TINY, "--iterations", 4)
    heights = load("blob.caustic").state.heights
    assert design(capfd, "--resume", "blob.caustic", "--iterations", 2, "--quiet")["iterations"] == 4
    assert torch.equal(load("blob.caustic").state.heights, heights)


# seeds


@pytest.mark.parametrize("options", [[], ["--network", "sparse"]])
def test_the_seed_decides_every_byte(capfd, options):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        design(capfd, "blob.png", *TINY, *options, "--iterations", 4, "--seed", seed, "-o", name)
    assert_same(content("a"), content("b"))
    assert_same_files("a", "b")
    assert (Path("a") / "render.png").read_bytes() != (Path("c") / "render.png").read_bytes()
    assert exported("a") != exported("c")


def test_render_repeats_and_follows_its_seed(capfd):
    design(capfd, "blob.png", *TINY, *NARROW, "--iterations", 2)
    images = []
    for seed in (1, 1, 2):
        assert cli.run(["render", "blob.caustic", "--rays", "5000", "--seed", str(seed), "--npy", "a.npy", "--quiet"]) == 0
        images.append((Path("a.npy").read_bytes(), (Path("blob.caustic") / "render.png").read_bytes()))
    assert images[0] == images[1] != images[2]


def test_threads_are_what_was_asked_for():
    """In a process of its own: the first design of a process must not differ from the next, whatever loads meanwhile."""
    program = f"""
import torch
from caustic_cli import cli
for name in "ab":
    assert cli.run(["design", "blob.png", *{TINY!r}, "--iterations", "3", "-o", name]) == 0
    assert torch.get_num_threads() == 1, torch.get_num_threads()
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert_same(content("a"), content("b"))


# progress


@pytest.mark.parametrize("kind", ["default", "rms", "staged"])
def test_a_design_improves_the_picture(capfd, kind):
    options = {"default": TINY, "rms": [*TINY, "--loss", "rms"], "staged": ["--config", staged(), "--quiet"]}[kind]
    first = design(capfd, "blob.png", *options, "--start", "offset", "--iterations", 1, "-o", "p")
    last = design(capfd, "--resume", "p", "--iterations", 60, "--quiet")
    assert last["relative_rms"] < 0.5 * first["relative_rms"]
    assert last["on_screen"] > 0.85  # the rest is reflected at the two surfaces
    assert last["ssim"] > first["ssim"] and last["psnr_db"] > first["psnr_db"]


@pytest.mark.parametrize("seen", ["nothing", "a wave image"])
def test_a_lens_that_lost_its_wave_image_is_not_compared_by_rays(seen):
    """Rays of a lens refined for waves say nothing of it: without its wave image its start, which has one, is kept."""
    light, rays = SimpleNamespace(halves=None), {"relative_rms": 0.3, "on_screen": 0.9, "noise": None}
    start = rays | {"wave_relative_rms": 0.2, "wave_on_screen": 0.9}
    state = State(heights=torch.ones(4, 4), start=torch.zeros(4, 4), reason="iterations")
    options, source = SimpleNamespace(loss="rms"), SimpleNamespace(parallel=True)
    found = object.__new__(evaluation.LensEvaluation)
    found.problem = SimpleNamespace(options=options, scene=SimpleNamespace(source=source), feasible=lambda _, z: z)
    found.designer = SimpleNamespace(initial_surface=lambda s: s.start, showing=lambda s, z: replace(s, heights=z), stages=[])
    found.refined, found.state = True, state
    found.rays, found.see = lambda z, noise=True: (None, rays), lambda *_: evaluation.Seen(None, light, start)
    found.light = light if seen == "a wave image" else None
    waves = {"wave_relative_rms": 0.1} if found.light else {"wave_relative_rms": None, "no_wave_image": "rays cross"}
    found.figures = rays | {"relative_rms": 0.1, "wave_on_screen": 0.9} | waves
    found.compare_with_start()
    kept = torch.equal(found.state.heights, state.start)
    assert kept == (seen == "nothing") and found.figures["wave_relative_rms"] == (0.2 if kept else 0.1)
    said = "iterations; it has no wave image any more, and its start is kept: rays cross"
    assert found.state.reason == (said if kept else "iterations")


def test_a_design_is_never_worse_than_its_start(capfd):
    """Steps far too long wreck a good start: it is kept, and the run still goes on from where the optimiser stands."""
    options = [*TINY[:2], "--control", "35", *TINY[4:], "--start", "transport", "--optimizer", "adam", "--lr", "0.5"]
    once = design(capfd, "blob.png", *options, "--iterations", 6, "-o", "once")
    words = re.fullmatch(
        r"iterations; its start was better and is kept: relative RMS error by (rays|waves) ([\d.]+), after the iterations ([\d.]+),"
        r" with ([\d.]+)% and ([\d.]+)% of the light on the screen",
        once["reason"],
    )
    assert words[1] == once["error_by"] and words[2] == f"{once['error']:.4f}" and float(words[2]) < float(words[3])
    assert float(words[4]) == pytest.approx(100 * once["wave_on_screen" if words[1] == "waves" else "on_screen"], abs=0.01)
    assert once["relative_rms"] == once["start_relative_rms"] and once["error"] == once["start_error"]
    state = load("once").state
    assert torch.equal(state.heights, state.start)
    design(capfd, "blob.png", *options, "--iterations", 12, "-o", "whole")
    design(capfd, "--resume", "once", "--iterations", 12, "--quiet", "--threads", 1)
    assert_same(content("whole"), content("once"))
    good = design(capfd, "blob.png", *TINY, "--start", "offset", "--iterations", 20, "-o", "good")
    assert good["relative_rms"] < 0.5 * good["start_relative_rms"] and "start" not in good["reason"]


def test_transport_begins_where_the_offset_ends(capfd):
    sphere = design(capfd, "blob.png", *TINY, "--start", "offset", "--waves", "off", "-o", "sphere")
    fine = ["--resolution", "24", "--control", "35", "--rays", "40000", "--waves", "off", "--quiet", "--threads", "1"]
    moved = design(capfd, "blob.png", *fine, "--iterations", 1, "-o", "moved")
    assert moved["relative_rms"] < 1.2 * sphere["relative_rms"]
    assert load("moved").state.history[0][2] < 0.7 * load("sphere").state.history[0][2]
    assert 'start = "transport"' in Path("moved/project.toml").read_text()


@pytest.mark.parametrize("converges", [True, False])
def test_a_transport_that_does_not_converge_is_said(capfd, converges, monkeypatch):
    if not converges:
        newton = transport._newton
        monkeypatch.setattr(transport, "_newton", lambda *args: newton(*args[:-1], 0))
    assert cli.run(["design", "blob.png", "--resolution", "24", "--start", "transport", "--waves", "off", "--iterations", "1"]) == 0
    assert ("of the light in wrong places" in capfd.readouterr().err) is not converges


def test_a_start_that_a_fixed_thickness_would_cut_is_lifted(capfd):
    Path("thin.toml").write_text("[lens]\nthickness = 0.0\nmin_thickness = 0.0\n")
    options = ["--resolution", "24", "--control", "35", "--rays", "40000", "--quiet", "--threads", "1", "--iterations", 1]
    thin = design(capfd, "blob.png", "--config", "thin.toml", *options, "-o", "thin")
    free = design(capfd, "blob.png", *options, "-o", "free")
    assert thin["start_relative_rms"] < 1.2 * free["start_relative_rms"]
    assert 0 < float(load("thin").state.heights.min()) < 0.1


@pytest.mark.parametrize(("said", "wall"), [((), 3.0), (("--min-thickness", 2), 2.0), (("--min-thickness", 4), 4.0)])
def test_the_wall_of_a_plate_is_what_was_said(capfd, said, wall):
    options = (
        "--lens-size",
        60,
        "--throw",
        600,
        "--resolution",
        24,
        "--rays",
        40_000,
        "--quiet",
        "--threads",
        1,
        "--iterations",
        1,
    )
    found = design(capfd, "blob.png", *options, *said, "--waves", "off")
    assert wall <= found["minimum_wall_mm"] < wall + 0.1


@pytest.mark.parametrize("limit, control, rays", [(5, 32, 40_000), (20, 48, 40_000), (90, 48, 256 * 24 * 24)])
def test_the_time_limit_chooses_the_quality(capfd, limit, control, rays, monkeypatch):
    monkeypatch.setattr(workflow, "_run", begun)
    design(capfd, "blob.png", "--resolution", "24", "--waves", "off", "--quiet", "--threads", "1", "--time-limit", limit, "-o", "p")
    stages = Project.open("p").settings.design.stages
    assert stages[-1].control == (control + 3, control + 3)
    assert stages[-1].rays == rays and len(stages) == {5: 1, 20: 2, 90: 2}[limit]


@pytest.mark.parametrize("limit, stages", [(20, 1), (90, 2)])
def test_a_source_with_an_extent_takes_longer(capfd, limit, stages, monkeypatch):
    monkeypatch.setattr(workflow, "_run", begun)
    sun = ("--source-angle", "0.533", "--resolution", "24", "--waves", "off", "--quiet", "--threads", "1")
    design(capfd, "blob.png", *sun, "--time-limit", limit, "-o", "p")
    assert len(Project.open("p").settings.design.stages) == stages


def test_lbfgs_never_goes_uphill_within_a_stage(capfd):
    design(capfd, "blob.png", "--config", staged(), "--iterations", 30, "--quiet", "-o", "p")
    rows, checked = load("p").state.history, 0
    for a, b in itertools.pairwise(rows):
        if a[1] == b[1]:
            assert b[2] <= a[2]
            checked += 1
    assert checked > 15


@pytest.mark.parametrize("network", ["none", "sparse", "dense"])
def test_adam_improves_the_loss(capfd, network):
    design(capfd, "blob.png", *TINY, "--optimizer", "adam", "--network", network, "--iterations", 25)
    losses = [row[2] for row in load("blob.caustic").state.history]
    assert losses[-1] < 0.97 * losses[0]


def test_the_two_losses_lead_to_different_lenses(capfd):
    for loss in ("rms", "rms-light"):
        design(capfd, "blob.png", *TINY, "--margin", 0, "--loss", loss, "--iterations", 3, "-o", loss)
    assert not torch.equal(load("rms").state.heights, load("rms-light").state.heights)


@pytest.mark.parametrize(("quality", "total"), [("draft", 115), ("standard", 200), ("fine", 360)])
def test_quality(capfd, quality, total):
    design(capfd, "blob.png", *TINY, "--quality", quality, "--start", "offset", "--waves", "off", "--iterations", 1)
    text = (Path("blob.caustic") / "project.toml").read_text()
    assert (
        sum(
            int(line.split("=")[1].split("#")[0])
            for line in text.split("[[design.stages]]", 1)[1].splitlines()
            if line.startswith("iterations")
        )
        == total
    )


def test_a_start_from_another_project_takes_its_lens_over(capfd):
    plain = design(capfd, "blob.png", *TINY, "--iterations", 40, "-o", "old")
    taken = design(capfd, "blob.png", "--config", one_stage(), "--start", "old", "--quiet", "--iterations", 1, "-o", "new")
    fresh = design(capfd, "blob.png", "--config", one_stage(), "--start", "offset", "--quiet", "--iterations", 1, "-o", "fresh")
    assert taken["relative_rms"] < 1.3 * plain["relative_rms"] < 0.7 * fresh["relative_rms"]


def one_stage(more="") -> str:
    Path("one.toml").write_text(
        "[screen]\nresolution = [24, 24]\n[lens]\ncontrol = [12, 12]\n"
        + more
        + "[[design.stages]]\ncontrol = [12, 12]\nrays = 4000\n"
    )
    return "one.toml"


def test_a_project_started_from_another_stands_on_its_own(capfd):
    """Its first surface is in its checkpoint: the other may be moved away."""
    design(capfd, "blob.png", *TINY, *NARROW, "--iterations", 2, "-o", "old")
    design(capfd, "blob.png", *TINY, *NARROW, "--start", "old", "--iterations", 2, "-o", "new")
    Path("old").rename("elsewhere")
    assert design(capfd, "--resume", "new", "--iterations", 3, "--quiet")["iterations"] == 3
    assert cli.run(["render", "new", "--rays", "1000", "--quiet"]) == 0


@pytest.mark.parametrize("options", [[], ["--optimizer", "adam"]])
def test_the_time_limit_ends_it(capfd, options):
    figures = design(capfd, "blob.png", *TINY, *NARROW, *options, "--iterations", 1_000_000, "--time-limit", 0.5)
    assert figures["reason"] in (["time limit"] if options else ["time limit", "no progress"])
    assert figures["iterations"] < 100_000  # none where the start alone takes longer, on a busy machine
    assert load("blob.caustic").state.total == figures["iterations"]
    assert cli.run(["render", "blob.caustic", "--rays", "1000", "--quiet"]) == 0


def test_a_time_limit_reaches_the_last_stage(capfd):
    """However short: a lens on a coarse net alone would not be the lens of project.toml."""
    design(capfd, "blob.png", *TINY, *NARROW, "--time-limit", 0.01)
    state = load("blob.caustic").state
    stages = Project.open("blob.caustic").settings.design.stages
    assert state.stage == len(stages) - 1 and tuple(state.heights.shape) == (12, 12)


# what cannot be done


def test_no_light_on_the_screen_is_said_and_ends_in_1(capfd):
    """Light through one corner of the aperture only, which --mag 3's surface throws far off a tiny screen."""
    profile = np.zeros((20, 20))
    profile[0, 0] = 1.0
    np.save("corner.npy", profile)
    Path("one.toml").write_text(
        "[source]\nprofile = 'corner.npy'\n[lens]\ncontrol = [12, 12]\nradius = [80.3, 80.3]\n"
        "[screen]\nsize = [2.0, 2.0]\nresolution = [24, 24]\n"
        "[[design.stages]]\ncontrol = [12, 12]\nrays = 4000\n"
    )
    err = design(capfd, "blob.png", "--config", "one.toml", "--start", "offset", "--quiet", code=1)
    assert err.startswith("caustic: ") and err.count("\n") == 1 and "no light reaches the screen" in err
    assert not (Path("blob.caustic") / "render.png").exists()


@pytest.mark.parametrize(
    ("section", "line"),
    [
        ("design", "loss = 'moon'"),
        ("design", "network = 'moon'"),
        ("design", "initial = 'moon'"),
        ("design", "preconditioner = 'moon'"),
        ("design", "optimizer = 'moon'"),
        ("design", "dtype = 'moon'"),
        ("[design.stages]", "sampler = 'moon'"),
        ("[design.stages]", "reconstruction = 'moon'"),
        ("lens", "fresnel = 'moon'"),
        ("target", "flip = 'moon'"),
        ("screen", "size = [0, 1]"),
        ("lens", "knots_u = [0, 1]"),
        ("design", "time_limit = nan"),
    ],
)
def test_a_word_that_means_nothing_is_refused_before_anything_is_made(capfd, section, line):
    Path("c.toml").write_text(f"[{section}]\n{line}\n")
    err = design(
        capfd, "blob.png", *(TINY[:4] + TINY[6:] if "stages" in section else TINY), "--iterations", 1, "--config", "c.toml", code=2
    )
    assert err.count("\n") == 1 and line.split()[0] in err, err
    assert not Path("blob.caustic").exists()


# signals


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_the_design_goes_on(capfd, number, status):
    arguments = [*TINY[:-3], "--threads", "1", "--optimizer", "adam", "--iterations", "100000000"]
    program = [sys.executable, "-m", "caustic_cli", "design", "blob.png", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            begun = Path("blob.caustic/checkpoints.h5")
            for _ in range(1200):
                if begun.exists() or process.poll() is not None:
                    break
                time.sleep(0.05)
            time.sleep(0.3)
            process.send_signal(number)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == status, err
    assert out == ""
    said = [line for line in err.splitlines() if line.startswith("caustic: ")]
    assert len(said) == 1 and "--resume" in said[0] and "Traceback" not in err
    state = load("blob.caustic").state
    assert state.total == len(state.history) and state.reason == "interrupted"
    assert f"{state.total} iterations" in said[0]
    assert sorted(p.name for p in Path("blob.caustic").iterdir()) == ["checkpoints.h5", "project.toml", "target.png"]

    total = state.total + 2
    assert design(capfd, "--resume", "blob.caustic", "--iterations", total, "--quiet", "--threads", 1)["iterations"] == total
    if number == signal.SIGINT:  # and where it was interrupted leaves no trace
        design(capfd, "blob.png", *TINY, "--optimizer", "adam", "--iterations", total, "-o", "whole")
        whole, parts = content("whole"), content("blob.caustic")
        assert_same({k: v for k, v in whole.items() if k != "provenance"}, {k: v for k, v in parts.items() if k != "provenance"})


def test_a_place_that_is_taken_is_refused_before_the_transport_is_solved(capfd, monkeypatch):
    design(capfd, "blob.png", *TINY, "--iterations", "1")
    monkeypatch.setattr(surface, "first_surface", lambda *args: pytest.fail("solved for nothing"))
    assert "holds a design already" in design(capfd, "blob.png", *TINY, code=2)
