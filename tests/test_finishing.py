"""Finishing: what sanding, polishing, coating and printing make of a surface, against closed forms, and the correction for it."""

import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from test_export import make

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.part import part_of
from caustic_cli.io.archive import open_archive
from caustic_cli.optics import finishing
from caustic_cli.optics.scattering import scattered
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.studies.manufacture import wall_and_stock
from caustic_cli.workflow.finishing import Workpiece, deviation, said
from caustic_cli.workflow.lens import load
from caustic_cli.workflow.machining import cut_surface, form_deviation
from caustic_cli.workflow.outputs.finish import _words

HALF = (5.0, 4.0)
LINES = [np.linspace(-r, r, n) for r, n in zip(HALF, (257, 201), strict=True)]
INSIDE = torch.linspace(-2.5, 2.5, 201, dtype=torch.float64)


def rippled(f, depth=1e-3):
    """A ripple of frequency f, 1/mm, along x on a toric surface."""
    x, y = LINES[0][:, None], LINES[1][None, :]
    return HeightField.through(depth * np.cos(2 * np.pi * f * x) + 0.02 * x * x - 0.01 * y * y + 0.0 * y + 5.0, HALF)


def finish(steps, field, heights):
    """`finishing.finished` of a surface as it is."""
    relief = finishing.Relief(field.on_grid(heights, finishing.points(steps, field)).numpy(), field.half_size)
    return finishing.finished(steps, relief, field)


def amplitude(field, heights, f):
    """Of the ripple along the axis."""
    z = field.at(heights, INSIDE, 0.0 * INSIDE, [(0, 0)])[0].numpy()
    x = INSIDE.numpy()
    basis = np.stack([np.cos(2 * np.pi * f * x), np.ones_like(x), x * x], 1)
    return float(np.linalg.lstsq(basis, z, rcond=None)[0][0])


@pytest.mark.parametrize("f", [0.4, 1.0, 2.2])
@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("polished:3", lambda f: math.exp(-0.003 * f * math.pi * 0.5 / 0.0196349540849)),  # pi E / p of 0.5 MPa at 19.6 kPa
        ("coated:8", lambda f: math.exp(-((2 * math.pi * f) ** 4) * 0.008**3 * 0.03 * 60 / (3 * 0.3) * 1000)),
        ("polished:1+coated:3", None),
    ],
)
def test_ripples_shrink_as_the_closed_forms_say(f, text, left):
    steps = finishing.parse(text)
    field, heights = rippled(f)
    now, after = finish(steps, field, heights)
    expected = left(f) if left else float(finishing.transfer(steps, np.array(f)))
    assert amplitude(now, after, f) == pytest.approx(1e-3 * expected, abs=2e-6)
    x = INSIDE
    flat = replace(field), HeightField.through(0.02 * LINES[0][:, None] ** 2 - 0.01 * LINES[1] ** 2 + 5.0, HALF)[1]
    gone, curve = finish(steps, *flat)
    off = gone.at(curve, x, 0.0 * x, [(0, 0)])[0] - 0.02 * x * x - 5.0
    assert float(off.abs().max()) < 1e-9  # curvature is kept


@pytest.mark.parametrize("text", ["polished:2", "coated:8", "sanded:2000+polished:1"])
def test_the_correction_is_undone_by_the_finish(text):
    steps = finishing.parse(text)
    field, heights = rippled(0.7)
    made = finishing.corrected(steps, field, heights)
    assert amplitude(*made, 0.7) > 1.02e-3
    now, after = finish(steps, *made)
    left = float(finishing.transfer(steps, np.array(0.7)))
    lost = finishing.LEFT**2 / (left**2 + finishing.LEFT**2)
    assert amplitude(now, after, 0.7) == pytest.approx(1e-3 * (1 - lost), rel=0.01)
    plain = finish(steps, field, heights)
    assert amplitude(*plain, 0.7) < 0.97e-3


def test_a_printer_has_steps_and_a_coat_levels_them():
    field, heights = rippled(0.2, 0.02)
    now, after = finish(finishing.parse("printed:20,100"), field, heights)
    middles = torch.from_numpy((np.arange(-20, 20) + 0.5) * 0.1)
    z = now.at(after, middles, torch.full_like(middles, 0.05), [(0, 0)])[0].numpy() / 0.02
    assert np.abs(z - np.rint(z)).max() < 0.02  # a spline through steps
    true = field.at(heights, middles, torch.full_like(middles, 0.05), [(0, 0)])[0].numpy() / 0.02
    assert np.abs(z - true).max() <= 0.7  # half a layer and what the grid's points are off the middles

    def steep(text):
        surface, control = finish(finishing.parse(text), field, heights)
        g = surface.at(control, INSIDE, 0.0 * INSIDE, [(1, 0)])[0] - field.at(heights, INSIDE, 0.0 * INSIDE, [(1, 0)])[0]
        return float(g.square().mean().sqrt())

    assert steep("printed:20,100,5") < 0.1 * steep("printed:20,100")


def test_roughness_is_left_by_paper_and_removed_by_polish_and_coat():
    sanded, polished, coated = (
        finishing.roughness(finishing.parse(text)) for text in ("sanded:400", "sanded:400,2000+polished:5", "sanded:400+coated:5")
    )
    assert 0.02 < sanded.slope < 0.1 and sanded.height == pytest.approx(35e-3 / 70)
    assert scattered(sanded.height, 0.5, 550.0) > 0.99 and scattered(polished.height, 0.5, 550.0) < 1e-3
    assert polished.slope < finishing.SMOOTH < sanded.slope and coated.slope < finishing.SMOOTH


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "sanded"),
        ("polished", "polished:UM"),
        ("polished:0", "0.01 to 1000"),
        ("polished:nan", "0.01 to 1000"),
        ("coated:1,2", "coated:UM"),
        ("sanded:401", "P400"),
        ("sanded:400,,800", "P400"),
        ("printed:50", "printed:LAYER,PIXEL"),
        ("lapped:5", "lapped:5"),
        ("polished:5+milled:a.nc", "comes first"),
        ("polished:5+", "''"),
    ],
)
def test_what_is_no_finish_is_refused(text, words):
    with pytest.raises(InputError, match=re.escape(words)) as refused:
        finishing.parse(text)
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_pixels_that_the_grid_cannot_hold_are_refused():
    with pytest.raises(InputError, match="at least"):
        finish(finishing.parse("printed:10,1"), *rippled(0.2))


# the commands


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A small design that is corrected for a polish."""
    place = tmp_path_factory.mktemp("finish")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        write_blob()
        order = "design blob.png --mag 2 --resolution 24 --waves off --finish polished:10 --rays 20000 -o a.caustic --quiet"
        assert cli.run(shlex.split(order)) == 0
    return place / "a.caustic"


def rendered(capfd, order):
    assert cli.run(shlex.split(f"render {order} --rays 100000 --effects none --json --force")) == 0
    return json.loads(capfd.readouterr().out)


def test_a_design_is_corrected_for_its_finish(project, tmp_path, monkeypatch, capfd):
    """The finished part is nearer to the designed surface than one that was not corrected; the exported surface is the part."""
    monkeypatch.chdir(tmp_path)
    capfd.readouterr()
    figures = rendered(capfd, f"{project} --report")
    own, report = figures["finish"], figures["report"]
    assert own["steps"] == "polished:10" and own["roughness"] == 0.0
    assert cli.run(shlex.split(f"export {project} --format lighttools --tolerance 0 -o part.npz --quiet")) == 0
    capfd.readouterr()
    lens, (_, field, heights, *_) = load(project), open_archive("part.npz", None)
    off = finish(finishing.parse("polished:10"), lens.field, lens.heights)
    x = torch.linspace(-4.0, 4.0, 101, dtype=torch.float64)

    def away(field, heights):
        z = field.at(heights, x, 0.5 * x, [(0, 0)])[0] - lens.field.at(lens.heights, x, 0.5 * x, [(0, 0)])[0]
        return 1e3 * float(z.std())

    made = lens.made
    assert torch.allclose(field.at(heights, x, x, [(0, 0)])[0], made[0].at(made[1], x, x, [(0, 0)])[0], atol=1e-9)
    assert away(*made) > 0.01  # µm
    heights = {which: wall_and_stock(lens.scene, *s)["stock_height_mm"] for which, s in (("made", made), ("finished", off))}
    assert report["stock_height_mm"] == pytest.approx(heights["made"], abs=1e-9) != pytest.approx(heights["finished"], abs=1e-9)
    assert own["rms_um"] < 0.3 * away(*off)
    again = rendered(capfd, "part.npz --finish polished:10")["finish"]
    assert again["nominal_error"] is None and again["rms_um"] > own["rms_um"]  # off the part, not off the design


def test_finishes_are_compared(project, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("caustic_cli.workflow.finishing.LADDER", ("polished:1", "coated:20"))
    found = rendered(capfd, f"{project} --finish list -o a.png")["finishes"]
    assert [row["finish"] for row in found] == ["as designed", "polished:1", "coated:20"]
    assert found[0]["error"] <= found[1]["low"] <= found[1]["error"] <= found[1]["high"] < found[2]["error"]


def test_an_error_that_is_unknown_is_said():
    assert said(0.1234) == "0.1234"
    assert "no wave image" in said(None)
    row = {"finish": "a", "error": None, "error_by": "waves", "low": 0.2, "high": 0.3, "slope_rms": 0.1, "scattered": 0.5}
    assert "no wave image" in _words(row) and "scatters 50%" in _words(row)
    assert _words(row | {"low": None, "high": None}) == "slopes off by RMS 0.1"


def test_a_milled_part_is_finished(tmp_path, monkeypatch, capfd):
    """As --cut traces it; a coat levels its scallops."""
    monkeypatch.chdir(tmp_path)
    scene, field, heights = make(control=(8, 8), relief=0.005)
    write_lighttools("lens.npz", scene, field, heights)
    write_gcode("lens.nc", part_of("gcode", scene, field, heights), Milling(scallop=0.01))
    cut = form_deviation(cut_surface(Path("lens.nc"), scene, field), field, heights, scene.lens.opening)
    milled = rendered(capfd, "lens.npz --finish milled:lens.nc")["finish"]
    assert milled["slope_rms"] == pytest.approx(cut["cut_slope_rms"], rel=0.05)
    lens = load("lens.npz")
    coated = deviation(Workpiece(lens, "milled:lens.nc+coated:20").finished(), lens)
    assert coated["slope_rms"] < 0.1 * milled["slope_rms"]


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ("design blob.png --finish milled:lens.nc", "no program yet"),
        ("design blob.png --finish polished:-1", "--finish polished:-1"),
        ("render PROJECT --finish milled:none.nc", "none.nc"),
        ("render PROJECT --finish rubbed:1", "sanded:GRIT"),
        ("render PROJECT --finish polished:1 --cut a.nc", "--cut goes without --finish"),
    ],
)
def test_bad_orders_are_refused(project, tmp_path, monkeypatch, capfd, order, words):
    monkeypatch.chdir(tmp_path)
    write_blob()
    assert cli.run(shlex.split(order.replace("PROJECT", str(project)))) == 2
    err = capfd.readouterr().err
    assert words in err and err.count("\n") == 1
