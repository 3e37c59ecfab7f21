"""Orientation on a printer's plate: steps against true staircases, and what stands in a 3MF file."""

import json
import re
import shlex
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from helpers import write_blob
from test_export import make
from test_machine import mirrored

from caustic_cli import cli
from caustic_cli.export.printing import advised, placed
from caustic_cli.export.threemf import write_3mf

CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"


def staircase(lens, steps, points=1500):
    """RMS, mm, of what voxels of these steps along x, y, z, filled or not by their middles, are off the surface."""
    scene, field, heights = lens
    line = [np.linspace(-r, r, points) * 0.999 for r in scene.lens.half_size]
    x, y = (c.ravel() for c in np.meshgrid(*line, indexing="ij"))
    middle = [(np.floor(c / s) + 0.5) * s for c, s in zip((x, y), steps, strict=False)]
    middle = [np.clip(c, -r, r) for c, r in zip(middle, scene.lens.half_size, strict=True)]
    z = [field.at(heights, *(torch.from_numpy(c) for c in at), [(0, 0)])[0].numpy() for at in ((x, y), middle)]
    off = steps[2] * np.rint(z[1] / steps[2]) - z[0]
    return (off - off.mean()).std()


@pytest.mark.parametrize("printer", [(0.05, 0.05), (0.05, 0.003), (0.016, 0.04)])
def test_steps_are_those_of_a_true_staircase(printer):
    lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.1)
    found, (layer, plane) = advised(lens[0].lens, *lens[1:], printer), printer
    for name, steps in (("up", (plane, plane, layer)), ("edge-x", (layer, plane, plane)), ("edge-y", (plane, layer, plane))):
        assert found.steps[name] == pytest.approx(staircase(lens, steps), rel=0.1)
    assert found.advised == min(found.steps, key=found.steps.get) or printer == (0.05, 0.05)


@pytest.mark.parametrize("mirror", [False, True])
def test_the_part_stands_on_the_plate_and_is_not_mirrored(tmp_path, mirror):
    lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.02)
    if mirror:
        lens = (mirrored(lens[0]), *lens[1:])
    vertices = np.random.default_rng(0).normal(size=(9, 3))
    for name, axis in (("up", 2), ("edge-x", 0), ("edge-y", 1)):
        place = placed(name, vertices, lens[0].lens.cut_from)
        stands = np.column_stack([vertices, np.ones(len(vertices))]) @ place
        assert np.linalg.det(place[:3]) == pytest.approx(1.0) and stands[:, 2].min() == pytest.approx(0.0, abs=1e-12)
        face = -1.0 if mirror and name == "up" else 1.0  # the side of its light
        assert np.ptp(stands[:, 2] - face * vertices[:, axis]) < 1e-12


def test_a_file_holds_its_advice_and_its_place(tmp_path):
    lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.02)
    for orientation in (None, "advised"):
        said = write_3mf(tmp_path / "a.3mf", *lens, samples=(9, 9), printer=(0.05, 0.005), orientation=orientation)
        with zipfile.ZipFile(tmp_path / "a.3mf") as package:
            model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
        words = {m.get("name"): m.text for m in model.iter(f"{CORE}metadata")}
        assert words["Description"] == said["advice"] and said["advised"] in ("edge-x", "edge-y")
        place = model.find(f"{CORE}build/{CORE}item").get("transform")
        assert (place is None) == (orientation is None)
    place = np.array(place.split(), float).reshape(4, 3)
    vertices = np.array([[float(v.get(axis)) for axis in "xyz"] for v in model.iter(f"{CORE}vertex")] + [[0, 0, 0]])[:-1]
    size = np.ptp(vertices @ place[:3], axis=0)
    assert size[2] == pytest.approx({"edge-x": 10.0, "edge-y": 8.0}[said["advised"]])


def test_the_command_advises(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob()
    assert (
        cli.run(shlex.split("design blob.png --mag 2 --resolution 24 --waves off --rays 20000 --iterations 2 -o a.caustic -q")) == 0
    )
    capfd.readouterr()
    order = "export a.caustic --format 3mf --printer 50,5 --orientation advised --samples 21"
    assert cli.run(shlex.split(order)) == 0
    assert re.search(r"print it on edge, . upright: steps of the surface face up 14 µm RMS", capfd.readouterr().out)
    assert cli.run(shlex.split(f"{order} --force --json")) == 0
    found = json.loads(capfd.readouterr().out)["3mf"]
    assert found["orientation"] == found["advised"] and found["steps_um"]["up"] == pytest.approx(50 / 12**0.5, rel=0.05)
    for words in ("--printer 50", "--printer 50,0", "--orientation down", "--printer 50,a"):
        assert cli.run(shlex.split(f"export a.caustic --format 3mf {words}")) == 2
        err = capfd.readouterr().err
        assert words.split()[0] in err and err.count("\n") == 1
    assert cli.run(shlex.split("export a.caustic --format stl --printer 50,5")) == 2
    assert "--printer belongs to --format 3mf" in capfd.readouterr().err
    assert cli.run(shlex.split("export a.caustic --format gcode --pin 4")) == 2
    assert "--pin is of a lens with two free-form sides" in (err := capfd.readouterr().err) and err.count("\n") == 1
    assert not Path("a.nc").exists()


def test_the_printer_of_a_finish_is_advised_on(tmp_path, monkeypatch, capfd):
    """That of --printer comes first."""
    monkeypatch.chdir(tmp_path)
    write_blob()
    how = "--mag 2 --resolution 24 --waves off --rays 20000 --iterations 2 --finish printed:20,500+coated:5"
    assert cli.run(shlex.split(f"design blob.png {how} -o a.caustic -q")) == 0
    for more, layer in (("", 20.0), ("--printer 50,5", 50.0)):
        capfd.readouterr()
        assert cli.run(shlex.split(f"export a.caustic --format 3mf --samples 21 --json --force {more}")) == 0
        assert json.loads(capfd.readouterr().out)["3mf"]["steps_um"]["up"] == pytest.approx(layer / 12**0.5, rel=0.5)
