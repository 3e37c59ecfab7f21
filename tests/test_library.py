"""The library: ten lines design, render and export; what it makes is what the command line makes; nothing is written unasked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import begun

import caustic_cli
from caustic_cli import cli, design, load, render, trace
from caustic_cli.config import keywords
from caustic_cli.errors import CausticError, InputError
from caustic_cli.project.project import Project
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.schema.table import TABLE, options_of
from caustic_cli.workflow import design as workflow

SMALL = {"lens": {"size": [2.0, 2.0]}, "screen": {"z": 60.0, "resolution": [32, 32]}}


@pytest.fixture(autouse=True)
def _quick(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def picture() -> np.ndarray:
    """A bright disc beside the middle, [i, j]."""
    x = np.linspace(-1.0, 1.0, 48)
    return ((x[:, None] - 0.2) ** 2 + (x[None, :] + 0.1) ** 2 < 0.3).astype(float)


@pytest.fixture(scope="module")
def lens():
    return design(picture(), mag=2, settings=SMALL, quality="draft", waves="off")


def test_nothing_is_written_unless_asked(lens, tmp_path):
    lens.render(1e4)
    assert lens.figures["relative_rms"] < 0.3 and lens.figures["on_screen"] > 0.9
    assert list(tmp_path.iterdir()) == []


def test_the_library_designs_what_the_command_line_designs(lens, capfd):
    np.save("blob.npy", picture())
    arguments = [
        "blob.npy",
        "--mag",
        "2",
        "--lens-size",
        "2",
        "--throw",
        "60",
        "--resolution",
        "32",
        "--quality",
        "draft",
        "--waves",
        "off",
        "--quiet",
        "--json",
        "--threads",
        "1",
    ]
    assert cli.run(["design", *arguments]) == 0
    said = json.loads(capfd.readouterr().out)
    there = load("blob.caustic")
    assert torch.equal(there.heights, lens.heights)
    assert said["relative_rms"] == lens.figures["relative_rms"] == there.figures["relative_rms"]
    assert np.array_equal(there.target, lens.target)


def test_a_saved_lens_is_a_project(lens, capfd):
    lens.save("saved.caustic")
    again = load("saved.caustic")
    assert torch.equal(again.heights, lens.heights) and again.figures == lens.figures
    with pytest.raises(InputError, match="holds a design already"):
        lens.save("saved.caustic")
    lens.save("saved.caustic", force=True)
    assert cli.run(["render", "saved.caustic", "--rays", "1e4", "--quiet", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["rays"] > 9000
    assert cli.run(["design", "--resume", "saved.caustic", "--quiet"]) == 0
    replace(load("saved.caustic"), provenance={"device": "cuda"}).save("copy.caustic")
    load("copy.caustic").save("another.caustic")
    assert load("another.caustic").provenance == {"device": "cuda"}


def test_a_render_is_of_its_own_rays(lens):
    image, figures = lens.render(rays=5e4, seed=3)
    assert image.shape == (32, 32) and image.sum() == pytest.approx(figures["on_screen"], abs=1e-12)
    lens.save("lens.caustic")
    assert np.array_equal(render("lens.caustic", 5e4, seed=3).image, image)
    assert not np.array_equal(lens.render(rays=5e4, seed=4).image, image)


def test_exports_by_suffix(lens):
    for name in ("lens.step", "lens.stl", "lens.npz"):
        assert lens.export(name).stat().st_size > 1000
    archive = load("lens.npz")
    assert torch.allclose(archive.heights, lens.heights, atol=1e-12) and archive.target is None
    with pytest.raises(InputError, match="cannot be saved as a project"):
        archive.save("no.caustic")
    with pytest.raises(InputError, match=r"lens\.jpg: its suffix is not that of a format"):
        lens.export("lens.jpg")


def test_the_surface_has_its_slopes(lens):
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 7), np.linspace(-0.9, 0.9, 5), indexing="ij")
    z, zx, zy = lens.surface(x, y)
    step = 1e-5
    assert z.shape == (7, 5)
    np.testing.assert_allclose((lens.surface(x + step, y)[0] - lens.surface(x - step, y)[0]) / (2 * step), zx, atol=1e-7)
    np.testing.assert_allclose((lens.surface(x, y + step)[0] - lens.surface(x, y - step)[0]) / (2 * step), zy, atol=1e-7)
    with pytest.raises(InputError, match="points must lie on the aperture"):
        lens.surface(1.01, 0.0)


@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.5, 0.0, -30.0),))])
def test_a_trace_is_differentiable(source):
    scene = Scene(source, Lens(size=(4.0, 4.0), offset=Offset(3.0, (40.0, 40.0))), Screen((8.0, 8.0), 60.0, (16, 16)))
    heights = (3.0 + 1e-3 * torch.randn(7, 8, dtype=torch.float64)).requires_grad_()
    weights = torch.randn(16, 16, dtype=torch.float64)

    def value(net: torch.Tensor) -> torch.Tensor:
        return (trace(scene, net, rays=20_000) * weights).sum()

    (gradient,) = torch.autograd.grad(value(heights), heights)
    step = torch.zeros_like(heights)
    step[3, 4] = 1e-6
    with torch.no_grad():
        slope = float(value(heights + step) - value(heights - step)) / 2e-6
    assert float(gradient[3, 4]) == pytest.approx(slope, rel=1e-3)
    assert trace(scene, heights, 1000).sum() <= 1.0


def test_progress_and_sections(lens):
    told, lines = [], []
    made = design(
        torch.from_numpy(picture()),
        source={"type": "disc", "position": [0, 0, -40.0], "size": [1.0, 1.0]},
        mag=2,
        settings=SMALL | {"design": {"iterations": 3}},
        quality="draft",
        waves="off",
        on_progress=lambda *step: told.append(step),
        on_message=lines.append,
    )
    assert [step[2] for step in told] == [1, 2, 3] and all(step[3] == 3 for step in told)
    assert made.scene.source.kind == "disc" and made.figures["iterations"] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"picture": np.zeros((4, 4))}, "picture must be a file, or a 2-D array"),
        ({"picture": np.ones(4)}, "picture must be a file, or a 2-D array"),
        ({"picture": np.full((4, 4), np.nan)}, "picture must be a file, or a 2-D array"),
        ({"picture": "nowhere.png"}, "nowhere.png: no such file"),
        ({"source": "lamp"}, r"\[source\] type must be one of"),
        ({"settings": {"lens": {"sizes": [1, 2]}}}, "did you mean size"),
        ({"settings": {"lens": {"size": [1, -2]}}}, r"\[lens\] size"),
        ({"settings": {"glass": {}}}, r"\[glass\] is not a section"),
        ({"rays": 0.5}, "rays must be a whole number"),
        ({"resolutoin": 24}, "resolutoin is not a keyword of design; did you mean resolution"),
        ({"moon": 1}, "moon is not a keyword of design; keywords are named like the options of caustic design"),
        ({"resolution": "fine"}, "resolution must be a pair"),
        ({"lens_size": [1.0, -2.0]}, r"\[lens\] size"),
        ({"settings": {"lens": 5}}, "lens must be a section"),
        ({"source": [{"type": "plane"}]}, "source must be a type or a section"),
        ({"source": {"type": "disc"}, "settings": {"source": [{"type": "point"}]}}, "source must be a type or a section"),
        ({"lens_aperture": "circle", "settings": {"lens": [{}]}}, r"\[lens\] is a list of tables"),
        ({"color": True}, r"\[target\] color needs the file of a picture"),
        ({"index_range": [1.4, 1.6]}, r"\[lens\] index_range belongs to \[lens\] gradient free"),
        ({"element": [{"type": "lamp", "z": 20.0}]}, r"\[\[element\]\] type must be one of"),
    ],
)
def test_what_is_wrong_is_said_in_the_library_s_terms(arguments, message):
    with pytest.raises(InputError, match=message) as error:
        design(**{"picture": picture(), "mag": 2, "waves": "off"} | arguments)
    assert "--" not in str(error.value)
    assert isinstance(error.value, CausticError) and list(Path().iterdir()) == []


def test_every_setting_is_a_keyword():
    """By the name of its option, or by section and key: with its default it passes the checks of its type."""
    known = keywords.keywords("design")
    of_tables = [path for path in TABLE if path.rpartition(".")[0] in ("element", "design.stages")]
    named = {*TABLE}.difference(of_tables, ["elements", "screen.size"])  # screen_size stands for both of its paths
    assert set(known.values()) == named | {"element", "design.stages"}
    for path, row in TABLE.items():
        if row.option and path != "elements":
            assert known[row.option.name[2:].replace("-", "_")] == path
    usual = {name: TABLE[path].default for name, path in known.items() if path in TABLE and TABLE[path].default is not None}
    given = keywords.checked(keywords.from_keywords("design", usual), {}, "here")
    assert len(given) > 40 and all(given[path] == TABLE[path].default for path in given)
    rows = list(options_of("render"))
    assert set(keywords.keywords("render").values()) == {path for row in rows for path in (row.path, *row.speaks_for)}


def test_keywords_say_what_sections_say(monkeypatch):
    """By option's name, by section and key, or in a section; a single number for both axes, or with the picture's aspect."""
    monkeypatch.setattr(workflow, "_run", begun)
    by_sections = {"lens": {"size": [2.0, 2.0], "control": [9, 9], "z_in": 0.1}, "screen": {"resolution": [24, 24], "z": 60.0}}
    sections = {**by_sections, "target": {"encoding": "linear"}, "element": [{"z": 20.0}], "design": {"network": "none"}}
    first = design(picture(), settings=sections, waves="off").project.settings
    second = design(
        torch.from_numpy(picture()),
        lens_size=2,
        control=np.int64(9),
        lens_z_in=0.1,
        resolution=24,
        throw=60,
        linear=True,
        sheet=False,
        element=[{"z": 20.0}],
        network=None,
        waves="off",
    ).project.settings
    assert second.target["sheet"] is False and "sheet" not in first.target
    assert second.changed(target=first.target) == first


@pytest.mark.parametrize("network", ["sparse", "dense"])
def test_a_network_is_trained_by_adam_whatever_it_is_asked_by(network, monkeypatch):
    """By an option, a configuration, a keyword or a section; an optimiser given at the same place is kept."""
    monkeypatch.setattr(workflow, "_run", begun)
    np.save("blob.npy", picture())
    small = {"resolution": 24, "lens_size": 2, "throw": 60, "control": 7}
    Path("c.toml").write_text(f"[design]\nnetwork = '{network}'\n[lens]\ncontrol = [7, 7]\n")
    assert cli.run(["design", "blob.npy", "--config", "c.toml", "--resolution", "24", "--quiet"]) == 0
    made = [Project.open("blob.caustic").settings]
    made += [
        design(picture(), **small, **by).project.settings
        for by in ({"network": network}, {"settings": {"design": {"network": network}}})
    ]
    assert all(one.design.optimizer == "adam" for one in made)
    with pytest.raises(InputError, match="optimizer"):
        design(picture(), **small, network=network, optimizer="lbfgs")


def test_an_angle_is_of_a_disc_whatever_it_is_given_by(monkeypatch):
    monkeypatch.setattr(workflow, "_run", begun)
    small = {"resolution": 24, "lens_size": 2, "throw": 60, "control": 7}
    for by in ({"source_angle": 0.5}, {"settings": {"source": {"angle": 0.5}}}):
        assert design(picture(), **small, **by).project.settings.source.type == "disc"


def test_a_render_under_another_light(lens, capfd):
    """As the command line renders the project, of a lens in memory and of its project; unknown keywords are named."""
    lens.save("lens.caustic")
    options = ["--source", "point", "--screen-shift", "1,0", "--rays", "5e4", "--seed", "3", "--quiet", "--npy", "image.npy"]
    assert cli.run(["render", "lens.caustic", *options, "--threads", "1"]) == 0
    for one in (lens, "lens.caustic"):
        image = render(one, 5e4, seed=3, source="point", screen_shift=[1, 0]).image
        np.testing.assert_allclose(image, np.load("image.npy"), rtol=0, atol=1e-12)
    assert np.array_equal(load("lens.caustic", source="point", screen_shift=[1, 0]).render(5e4, seed=3).image, image)
    assert lens.render(1e4, source_angle=0.5).figures["on_screen"] > 0.5
    for wrong, words in (
        ({"screen_titl": [0, 20]}, "did you mean screen_tilt"),
        ({"resolution": 24}, "resolution is not a keyword of render, which keeps the lens"),
        ({"efects": "none"}, "did you mean effects"),
    ):
        with pytest.raises(InputError, match=words):
            render(lens, 1e4, **wrong)
    lens.export("lens.npz")
    with pytest.raises(InputError, match="an archive's source is fixed"):
        render("lens.npz", 1e4, source="point")


def test_the_door_is_light():
    """The package itself loads nothing: --help has to answer at once."""
    assert set(caustic_cli.__all__) == {"Lens", "Render", "__version__", "design", "load", "render", "spread", "trace"}
    with pytest.raises(AttributeError, match="no attribute 'lens'"):
        _ = caustic_cli.lens
    assert (Path(caustic_cli.__file__).parent / "py.typed").exists()


def test_details_converge_sooner_without_the_laplacian():
    """A picture of independent pixels, from the same start in as many iterations."""
    picture = np.random.default_rng(2).uniform(0.5, 1.5, (32, 32))
    small = {"mag": 2, "margin": 0.0, "lens_size": [2, 2], "throw": 60, "resolution": [32, 32]}
    both = [design(picture, preconditioner=p, waves="off", iterations=8, **small).figures for p in ("none", "laplacian")]
    assert both[0]["relative_rms"] < 0.8 * both[1]["relative_rms"]
