"""The page for the shop: its limits, and the command that writes it."""

import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest
from test_export import make

from caustic_cli import cli
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.optics.scattering import scattered
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.studies import shop_page
from caustic_cli.studies.manufacture import _landings


@pytest.mark.parametrize("width", [0.5, 2.0])
def test_a_bump_of_the_limit_moves_light_by_a_pixel(width):
    scene = make()[0]
    found = shop_page.limits(scene)
    height = 1e-3 * next(h * width / w for w, h in found["bumps_um"].items())  # heights are in proportion to widths
    x = np.linspace(-5.0, 5.0, 401)
    field, plain = HeightField.through(np.full((401, 401), 5.0), (5.0, 5.0))
    _, bumpy = HeightField.through(5.0 + height * np.sin(math.pi * x / width)[:, None] * np.ones(401), (5.0, 5.0))
    moved = [
        (a.origin[0] - b.origin[0]).abs().max()
        for a, b in zip(_landings(scene, field, plain, 0, 0.0), _landings(scene, field, bumpy, 0, 0.0), strict=True)
    ]
    assert float(max(moved)) == pytest.approx(min(scene.screen.pixel), rel=0.03)


def test_roughness_at_the_limit_scatters_a_hundredth():
    scene = make()[0]
    sigma = 1e-6 * shop_page.limits(scene)["roughness_nm"]
    assert scattered(sigma, scene.lens.index - 1.0, scene.light.mean) == pytest.approx(shop_page.SCATTERED)


def test_the_page(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_lighttools("lens.npz", *make(relief=0.005))
    order = "render lens.npz --rays 20000 --effects none --shop shop.html --json"
    assert cli.run(shlex.split(order)) == 0
    found = json.loads(capfd.readouterr().out)["shop"]
    text = Path("shop.html").read_text()
    for words in ("blank", "must not be rounded off", "test card", "10 x 10 mm", "refractive index 1.5443"):
        assert words in text
    assert "⟨" not in text and "$" not in text and "http" not in text
    assert found["page"] == "shop.html" and Path(found["card"]).stat().st_size > 1000
    assert cli.run(shlex.split("render lens.npz --rays 20000 --shop .")) == 2
    assert capfd.readouterr().err.count("\n") == 1
    Path("shop.html").write_text("mine")
    assert cli.run(shlex.split(order)) == 2  # not overwritten
    assert Path("shop.html").read_text() == "mine"
