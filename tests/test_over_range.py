"""Networks over ranges of scene parameters: gradients, sampling, resuming, a lens for each value, refusals, the studies."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image

from caustic_cli import cli
from caustic_cli.config.design import build_options, build_stages
from caustic_cli.config.settings import build_scene
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.designer import Designer
from caustic_cli.inverse.parametrisation import Architecture, parametrise
from caustic_cli.inverse.range_training import BATCH, RangeAdam, RangeObjective
from caustic_cli.inverse.scene_parameters import EVALUATED, Range, Ranges
from caustic_cli.io.files import is_ours
from caustic_cli.kinds.network_range import NetworkOverRange
from caustic_cli.project import checkpoint
from caustic_cli.project.completion import complete
from caustic_cli.studies import architectures
from caustic_cli.studies.report import write
from caustic_cli.workflow import architectures as grid
from caustic_cli.workflow import comparison
from caustic_cli.workflow.lens import load

#: A small design over a range.
TINY = ["--network", "dense", "--network-width", "8", "--resolution", "24", "--control", "12", "--rays", "4000"]
TINY += ["--quiet", "--threads", "1"]
THROWS = Ranges((Range("throw", 250.0, 350.0),))


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()


def run(capfd, *arguments, code=0) -> dict:
    """What a command says as JSON, or its error line."""
    assert cli.run([*map(str, arguments), *(["--json"] if code == 0 else [])]) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err


def designer(over: Ranges = THROWS, source: dict | None = None, **options) -> Designer:
    """A bright disc on 20 x 20 pixels, from 9 x 9 control points."""
    said = ", ".join(f"{one.key}={one.low:g}:{one.high:g}" for one in over.each)
    stage = {"control": [9, 9], "rays": 3000, "apron": 1}
    given = {
        "screen": {"resolution": [20, 20]},
        "lens": {"control": [9, 9]},
        "design": {
            "network": "dense",
            "optimizer": "adam",
            "network_width": 6,
            "over": said,
            "stages": [stage],
            "dtype": "float64",
        },
    }
    full = complete(given | ({"source": source} if source else {}), 1.0)
    scene = build_scene(full)
    target = torch.from_numpy(comparison.disc(scene, full.target.size))
    own = build_options(full)
    own = replace(own, parametrisation=replace(own.parametrisation, **options))
    return Designer(NetworkOverRange(scene, target, build_stages(full), own, ranges=over))


# the network


@pytest.mark.parametrize("network", ["dense", "sparse"])
@pytest.mark.parametrize("preconditioner", ["none", "laplacian"])
def test_a_batch_of_inputs_is_each_of_them_by_itself(network, preconditioner):
    low = torch.linspace(3.0, 4.0, 30, dtype=torch.float64).view(6, 5)
    module = parametrise(low, low + 1.0, network, initial="random", preconditioner=preconditioner, inputs=2, degree=(2, 1))
    inputs = torch.tensor([[-1.0, 0.3], [0.0, 0.0], [0.7, 1.0]], dtype=torch.float64)
    whole = module(inputs).detach()
    assert whole.shape == (3, 6, 5)
    for row, one in zip(inputs, whole, strict=True):
        torch.testing.assert_close(module(row[None])[0].detach(), one, rtol=0, atol=1e-6)  # float32 sums in another order
    torch.testing.assert_close(module().detach(), whole[1], rtol=0, atol=1e-6)  # none are zeros
    assert float((whole[0] - whole[2]).abs().max()) > 1e-3


@pytest.mark.parametrize("activation", ["tanh", "relu", "silu", "sine"])
def test_a_dense_network_of_any_shape_by_hand(activation):
    act = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, 0), "silu": lambda x: x / (1 + np.exp(-x)), "sine": np.sin}[activation]
    low = torch.full((4, 3), 2.0, dtype=torch.float64)
    module = parametrise(low, low + 2.0, "dense", initial="random", seed=5, inputs=1, architecture=Architecture(3, 7, activation))
    w, b, seen = [[p.detach().numpy() for p in part] for part in (module.weights, module.biases, [module.seen])]
    assert [p.shape for p in w] == [(7,), (7, 7), (7, 7), (12, 7)]
    x = w[0] + b[0] + seen[0][:, 0] * 0.6
    for weights, biases in zip(w[1:], b[1:], strict=True):
        x = weights @ act(x) + biases
    expected = 2.0 + (1.0 + np.tanh(x.astype(float))).reshape(4, 3)
    np.testing.assert_allclose(module(torch.tensor([[0.6]]))[0].detach(), expected, rtol=0, atol=2e-6)


def test_zero_last_begins_at_the_start_whatever_the_inputs():
    low = torch.full((6, 6), 2.0, dtype=torch.float64)
    start = 2.5 + torch.rand(6, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    module = parametrise(
        low,
        low + 2.0,
        "dense",
        start=start,
        initial="zero-last",
        preconditioner="laplacian",
        inputs=1,
        architecture=Architecture(2, 5),
    )
    torch.testing.assert_close(module(torch.tensor([[-1.0], [1.0]])).detach(), start.expand(2, 6, 6), rtol=0, atol=1e-12)
    assert bool((module.weights[1] != 0).all()) and bool((module.seen != 0).all())


# the loss over a range


def stepped(made: Designer) -> RangeAdam:
    """Adam on the first stage, before its first step, with parameters that are nothing in particular."""
    module = made.problem.parametrised(0, None)
    generator = torch.Generator().manual_seed(2)
    module.double()
    for p in module.parameters():
        p.data += 0.05 * torch.randn(p.shape, generator=generator, dtype=torch.float64)
    objective = made.objective(0, module)
    assert isinstance(objective, RangeObjective)
    return RangeAdam(objective, module, 1e-3)


SCENES = {
    "throw": (THROWS, None),
    "source": (
        Ranges((Range("source.z", -80.0, -40.0), Range("source.x", -2.0, 4.0))),
        {"type": "point", "position": [[1.0, 0.0, -60.0]]},
    ),
    "tilted": (THROWS, {"type": "plane", "tilt": [10.0, 4.0]}),
}


@pytest.mark.parametrize("case", SCENES)
def test_gradients_of_the_mean_loss_pass_the_taylor_test(case):
    """|L(p + h q) - L(p - h q) - 2 h <q, dL/dp>| falls with h^3 along a random direction of all parameters."""
    adam = stepped(designer(*SCENES[case]))
    z, judge = adam._objective_here()
    e = judge(z.detach())
    z.backward(e.gradient)
    parameters = list(adam.heights.parameters())
    assert all(p.grad is not None and float(p.grad.abs().max()) > 0 for p in parameters)  # the inputs' weights among them
    generator = torch.Generator().manual_seed(3)
    ways = [torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in parameters]
    slope = sum(float((w * p.grad).sum()) for w, p in zip(ways, parameters, strict=True))
    before, rest, sizes = [p.data.clone() for p in parameters], [], []

    def loss(h: float) -> float:
        for p, at, way in zip(parameters, before, ways, strict=True):
            p.data = at + h * way
        moved, same = adam._objective_here()
        return same(moved.detach()).loss

    for h in (4e-4, 2e-4, 1e-4):
        rest.append(abs(loss(h) - loss(-h) - 2 * h * slope))
        sizes.append(abs(2 * h * slope))
    assert max(r / s for r, s in zip(rest, sizes, strict=True)) < 2e-2
    assert rest[-1] / sizes[-1] < 1e-3
    assert rest[2] < rest[0]


@pytest.mark.parametrize("case", ["source", "tilted"])
def test_the_loss_is_the_mean_over_lenses_in_their_own_scenes(case):
    """Each, made from nothing, says what the moved objective says; the screen of tilted light stays on it."""
    made = designer(*SCENES[case])
    adam = stepped(made)
    objective, z = adam.over, adam._objective_here()[0].detach()
    e, found = objective(z, 0), []
    for k, (row, heights) in enumerate(zip(objective.values(0).tolist(), z, strict=True)):
        scene = objective.ranges.scene(made.scene, row)
        if case == "source":
            assert scene.source.positions[0] == pytest.approx((row[1], 0.0, row[0]), abs=1e-12)
        else:
            x, y, z = scene.source.axis
            assert scene.screen.shift == pytest.approx((row[0] * x / z, row[0] * y / z), rel=1e-12)
        fresh = made.problem.on_rays(scene, 0, made.field(0), made.problem.target, 3000)
        fresh = fresh.moved(scene, objective.at(0)[k].samplers[0])
        found.append(fresh(heights))
        assert torch.equal(found[-1].gradient / BATCH, e.gradient[k])
    assert e.loss == pytest.approx(np.mean([one.loss for one in found]), rel=1e-14)
    assert len({one.loss for one in found}) == BATCH


def test_draws_are_stratified_repeatable_and_new_every_iteration():
    both = Ranges((Range("throw", 250.0, 350.0), Range("source.z", -80.0, -40.0)))
    for iteration in range(20):
        values = both.sampled(7, iteration, BATCH)
        assert np.array_equal(values, both.sampled(7, iteration, BATCH))
        assert not np.array_equal(values, both.sampled(7, iteration + 1, BATCH))
        assert not np.array_equal(values, both.sampled(8, iteration, BATCH))
        for column, one in zip(values.T, both.each, strict=True):
            parts = np.floor((column - one.low) / (one.high - one.low) * BATCH)
            assert sorted(parts) == list(range(BATCH))
    scaled = both.scaled([[250.0, -40.0], both.middle])
    assert torch.equal(scaled, torch.tensor([[-1.0, 1.0], [0.0, 0.0]], dtype=torch.float64))
    assert both.evaluation_points()[0] == (250.0, -60.0) and len(both.evaluation_points()) == 2 * len(EVALUATED) - 1
    assert [s.screen.z for s in THROWS.ends(designer().scene)] == [250.0, 350.0]


def test_a_few_iterations_help_all_over_the_range():
    made = designer()
    state = made.initial_state()
    done = made.run(state, iterations=30)
    losses = [row[2] for row in done.history]
    assert np.mean(losses[-5:]) < 0.8 * losses[0]
    ends = [made.problem.heights_at(made, done, values) for values in ((250.0,), (350.0,))]
    assert float((ends[0] - ends[1]).abs().max()) > 1e-4


# from the command line


def tensors(project) -> dict:
    held = checkpoint.load(Path(project) / "checkpoints.h5")
    s = held.state
    found = {f"{group}.{k}": v for group in ("parameters", "optimizer") for k, v in getattr(s, group).items()}
    return found | {"heights": s.heights, "history": torch.tensor([row[:4] for row in s.history])}


def test_twenty_iterations_are_eight_and_twelve_bitwise(capfd):
    over = [*TINY, "--over", "throw=250:350"]
    run(capfd, "design", "blob.png", *over, "--iterations", 20, "-o", "whole")
    run(capfd, "design", "blob.png", *over, "--iterations", 8, "-o", "parts")
    figures = run(capfd, "design", "--resume", "parts", "--iterations", 20, "--quiet", "--threads", 1)
    a, b = tensors("whole"), tensors("parts")
    assert a.keys() == b.keys() and "parameters.seen" in a and figures["iterations"] == 20
    assert all(torch.equal(a[name], b[name]) for name in a)
    run(capfd, "design", "blob.png", *over, "--iterations", 20, "--seed", 1, "-o", "other")
    assert not torch.equal(tensors("other")["heights"], a["heights"])


def test_a_lens_for_each_value(capfd):
    figures = run(capfd, "design", "blob.png", *TINY, "--over", "throw=250:350", "--iterations", 25, "-o", "z")
    assert [row["throw"] for row in figures["over"]] == [250.0, 275.0, 300.0, 325.0, 350.0]
    assert all(row["relative_rms"] > 0 and row["noise"] < row["relative_rms"] for row in figures["over"])
    middle = figures["over"][2]
    assert middle["relative_rms"] == middle["middle_relative_rms"]
    text = Path("z/project.toml").read_text()
    assert 'over = "throw=250:350"' in text and 'initial = "zero-last"' in text

    plain = load("z")
    assert torch.equal(plain.heights, load("z", "throw=300").heights) and plain.scene.screen.z == 300.0
    lenses = {throw: load("z", f"throw={throw}") for throw in (250, 275, 275.001, 350)}
    assert [lens.scene.screen.z for lens in lenses.values()] == [250.0, 275.0, 275.001, 350.0]
    whole = float((lenses[250].heights - lenses[350].heights).abs().max())
    step = float((lenses[275].heights - lenses[275.001].heights).abs().max())
    assert whole > 1e-4 and 0 < step < 1e-3 * whole  # continuous: 1e-5 of the range, and float32 weights

    shown = run(capfd, "render", "z", "--at", "throw=350", "--rays", 20000, "--effects", "none", "--quiet", "-o", "far.png")
    assert shown["relative_rms"] == pytest.approx(figures["over"][4]["relative_rms"], rel=0.2)
    assert run(capfd, "render", "z", "--rays", 20000, "--effects", "none", "--quiet")["relative_rms"] != shown["relative_rms"]
    written = run(capfd, "export", "z", "--at", "throw=350", "--format", "lighttools", "--quiet")
    assert written["file"] == "z-throw-350.npz"
    with np.load("z-throw-350.npz") as archive:
        assert archive["z_screen"] == 350.0
        np.testing.assert_allclose(archive["control_points"][..., 2], lenses[350].heights, rtol=0, atol=1e-12)
    run(capfd, "gradmap", "z", "--at", "throw=250", "--rays", 5000, "--quiet", "-o", "near.png")
    assert run(capfd, "render", "z", "--at", "throw=350", "--rays", 20000, "--effects", "none", "-o", "far.png") == shown  # reused

    for at, sentence in {
        "throw=249": "--at throw must be 250 to 350 mm, as trained, got 249",
        "throw=nan": "--at throw must be finite numbers of mm",
        "source.z=-60": "--at: 'source.z' is not a key; known are throw",
        "300": "--at must be KEY=VALUE",
    }.items():
        for command in ("render", "export", "gradmap"):
            err = run(capfd, command, "z", "--at", at, "--quiet", code=2)
            assert sentence in err and len(err.splitlines()) == 1
    assert "needs a project" in run(capfd, "render", "z-throw-350.npz", "--at", "throw=300", "--quiet", code=2)
    run(capfd, "design", "blob.png", *TINY, "--iterations", 1, "-o", "one")
    assert "--over" in run(capfd, "render", "one", "--at", "throw=300", "--quiet", code=2)


def test_source_places_take_their_middle_and_may_be_said_so(capfd):
    figures = run(
        capfd, "design", "blob.png", *TINY, "--source", "point", "--over", "source.z=-80:-40,throw=280:320", "--iterations", 2
    )
    assert len(figures["over"]) == 9 and load("blob.caustic").scene.source.positions == ((0.0, 0.0, -60.0),)
    far = load("blob.caustic", "source.z=-80")
    assert far.scene.source.positions == ((0.0, 0.0, -80.0),) and far.scene.screen.z == 300.0
    made = complete(
        {
            "source": {"type": "point", "position": [[0.0, 0.0, -60.0]]},
            "design": {"network": "sparse", "optimizer": "adam", "over": "source.z=-80:-40"},
        },
        1.0,
    )
    assert made.design.preconditioner == "laplacian" and "network_width" not in made.design


REFUSED = {
    "reversed": ("throw=350:250", [], "the range must ascend"),
    "empty": ("throw=300:300", [], "the range must ascend"),
    "one value": ("throw=300", [], "must be KEY=LOW:HIGH"),
    "nan": ("throw=nan:300", [], "throw must be finite numbers"),
    "inf": ("throw=250:inf", [], "throw must be finite numbers"),
    "words": ("throw=near:far", [], "throw must be finite numbers"),
    "unknown": ("trow=250:350", [], "'trow' is not a key; known are throw, source.x"),
    "twice": ("throw=250:350,throw=1:2", [], "every key once"),
    "too far": ("throw=250:1e13", [], "-1e+12 to 1e+12"),
    "within the lens": ("throw=2:350", [], "must lie behind the lens"),
    "no source place": ("source.z=-80:-40", [], "--source point, of one place, or grid, got the plane"),
    "behind the lens": ("source.z=-80:40", ["--source", "point"], "must lie before the lens"),
    "two places": (
        "source.z=-80:-40",
        ["--source", "point", "--source-position", "0,0,-50", "--source-position", "1,0,-50"],
        "of one place",
    ),
    "another throw": ("throw=250:350", ["--throw", "280"], "must be the middle of --over throw, 300 mm"),
    "another place": (
        "source.z=-80:-40",
        ["--source", "point", "--source-position", "0,0,-50"],
        "must have the middle of --over where that names it, 0,0,-60, got 0,0,-50",
    ),
    "no network": ("throw=250:350", ["--network", "none"], "--over needs a network, which gives a lens for every value: --network"),
    "lbfgs": ("throw=250:350", ["--optimizer", "lbfgs"], "a network needs optimizer adam"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_trained_over_is_refused_in_a_line(capfd, case):
    over, more, sentence = REFUSED[case]
    err = run(capfd, "design", "blob.png", "--network", "dense", "--over", over, *more, "--quiet", code=2)
    assert sentence in err and len(err.splitlines()) == 1 and not Path("blob.caustic").exists()


def test_a_value_said_twice_is_refused():
    with pytest.raises(InputError, match="every key once, got throw twice"):
        Ranges.parse("throw=250:350").values("throw=300,throw=310")


def test_contradictions_of_networks_are_refused():
    with pytest.raises(InputError, match="leaves the inputs of a network without any effect"):
        designer(initial="zero")
    with pytest.raises(InputError, match=r"belong to \[design\] network dense, got sparse"):
        complete_options = {"design": {"network": "sparse", "optimizer": "adam", "activation": "relu"}}
        build_options(complete(complete_options, 1.0))
    with pytest.raises(InputError, match="network_layers must be a whole number 1 to 16"):
        Architecture(0)
    counted = complete({"design": {"network": "dense", "optimizer": "adam", "preconditioner": "laplacian"}}, 1.0).design
    assert (counted.initial, counted.start) == ("zero-last", "transport")
    assert complete({}, 1.0).design.initial == "zero"
    with pytest.raises(InputError, match="start only with"):
        complete({"design": {"network": "dense", "optimizer": "adam", "start": "transport"}}, 1.0)


# the grid of architectures


@pytest.fixture
def few(monkeypatch):
    """Four networks, six iterations."""
    for name, values in {
        "LAYERS": (1, 2),
        "WIDTHS": (4, 8),
        "ACTIVATIONS": ("tanh",),
        "RATES": (1e-3,),
        "FREE_RATES": (1e-2,),
        "OUTPUTS": ("laplacian",),
    }.items():
        monkeypatch.setattr(grid, name, values)
    monkeypatch.setattr(grid, "PIXELS", 16)
    monkeypatch.setattr(grid, "CONTROL", 9)


def test_the_grid_is_trained_alike_and_repeats(few, tmp_path):
    told = []
    studies = [
        architectures.run_architectures(grid.candidates(None, "cpu"), seconds=100.0, progress=lambda *s: told.append(s))
        for _ in range(2)
    ]
    rows = studies[0].rows
    assert len(rows) == 2 * 5 and {row["iterations"] for row in rows} == {3, 6}
    assert [row["error"] for row in rows] == [row["error"] for row in studies[1].rows]  # errors repeat; times do not
    assert {(row["layers"], row["width"]) for row in rows} == {(1, 4), (1, 8), (2, 4), (2, 8), (None, None)}
    by_hand = {(1, 4): 8 + 81 * 5, (2, 8): 16 + 72 + 81 * 9, (None, None): 81}
    assert all(row["parameters"] == by_hand.get((row["layers"], row["width"]), row["parameters"]) for row in rows)
    assert all(0 <= row["noise"] < row["error"] == row["worst"] for row in rows)
    assert told[-1] == (10, 10) and "no network" in studies[0].advice
    paths = write(studies[0], tmp_path / "out")
    assert [p.name for p in paths] == ["networks.csv", "networks.json", "networks.png"]
    assert all(is_ours(p) for p in paths[1:]) and np.asarray(Image.open(paths[2])).std() > 10
    with paths[0].open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)


def test_a_time_limit_ends_the_study_after_a_whole_round(few):
    study = architectures.run_architectures(grid.candidates(None, "cpu"), seconds=1e-6)
    assert {row["iterations"] for row in study.rows} == {3} and len(study.rows) == 5


def test_over_a_range_one_lens_for_all_and_networks_alone_stand_beside(few, capfd):
    run(capfd, "design", "blob.png", *TINY, "--over", "throw=250:350", "--iterations", 3, "-o", "z")
    found = run(
        capfd, "convergence", "z", "--study", "design", "--networks", "--rays", 5000, "--threads", 1, "--quiet", "-o", "out"
    )
    last = [row for row in found["rows"] if row["iterations"] == 6]
    assert [row["inputs"] for row in last] == ["range"] * 5 + ["none", "alone"]
    assert all(row["worst"] >= row["error"] > 0 for row in last) and "one lens for the whole range" in found["advice"]
    assert last[-1]["parameters"] == len(EVALUATED) * last[-2]["parameters"]
    for more, sentence in ((["--study", "rays"], "--networks belongs to --study design"), (["--repeats", "2"], "--repeats has no")):
        assert sentence in run(capfd, "convergence", "--study", "design", "--networks", *more, "--quiet", code=2)


def test_a_candidate_that_fails_is_left_out_by_name(few):
    made = grid.candidates(None, "cpu")

    def fail(_):
        raise CausticError("out of light")

    made[1].reach = fail
    study = architectures.run_architectures(made, seconds=100.0)
    assert list(study.about["failed"].values()) == ["out of light"] and len(study.rows) == 2 * 4


def test_a_grid_whose_networks_all_fail_is_an_error(few):
    """Though free heights beside them do not."""
    made = grid.candidates(None, "cpu")

    def fail(_):
        raise CausticError("out of light")

    for one in made:
        if one.about["network"] == "dense":
            one.reach = fail
    with pytest.raises(CausticError, match="none of the networks could be trained: out of light"):
        architectures.run_architectures(made, seconds=100.0)
