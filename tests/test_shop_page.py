"""The page for the shop: its limits, and the command that writes it."""

import html
import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_export import make

from caustic_cli import cli
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.optics.scattering import scattered
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Component, FreeForm, Lens
from caustic_cli.scene.gradient import Gradient
from caustic_cli.studies import shop_limits
from caustic_cli.studies.manufacture import _landings, manufacture
from caustic_cli.studies.photograph.card import write_card
from caustic_cli.studies.shop_page import write_page
from caustic_cli.workflow.outputs.test_card import TestCard as Card


@pytest.mark.parametrize("width", [0.5, 2.0])
def test_a_bump_of_the_limit_moves_light_by_a_pixel(width):
    scene = make()[0]
    field, plain = HeightField.through(np.full((401, 401), 5.0), (5.0, 5.0))
    found = shop_limits.limits(scene, field, plain)
    height = 1e-3 * next(h * width / w for w, h in found["bumps_um"].items())  # heights are in proportion to widths
    x = np.linspace(-5.0, 5.0, 401)
    _, bumpy = HeightField.through(5.0 + height * np.sin(math.pi * x / width)[:, None] * np.ones(401), (5.0, 5.0))
    assert farthest((scene, plain), (scene, bumpy), field) == pytest.approx(min(scene.screen.pixel), rel=0.03)


def farthest(one: tuple, other: tuple, field: HeightField) -> float:
    """Largest distance along x, mm, between the landing points of rays that arrive in two scenes, each with its heights."""
    before, after = (_landings(scene, field, heights, 0, 0.0) for scene, heights in (one, other))
    both = [(a, b, (a.power > 0) & (b.power > 0)) for a, b in zip(before, after, strict=True)]
    return max(float((a.origin[0] - b.origin[0])[kept].abs().max()) for a, b, kept in both)


def waves(height: float, count: int) -> tuple[HeightField, torch.Tensor]:
    """Control values (count, count) of a sinusoid along x of this height and a half period of 1 mm, over 10 x 10 mm."""
    field = HeightField.of(Lens((10.0, 10.0), control=(count, count)))
    values = height * torch.sin(math.pi * field.control_xy()[0])[:, None].expand(count, count)
    return field, field.interpolated(values.contiguous())


SIDE = FreeForm(np.zeros((40, 40)), (3, 3))


@pytest.mark.parametrize("z", [40.0, -30.0])
def test_a_bump_of_the_limit_moves_light_by_a_pixel_through_other_lenses(z):
    scene, (field, sine) = make(control=(60, 60))[0], waves(1.0, 60)
    scene, plain = (
        replace(scene, elements=(Component(z, (30.0, 30.0), 8.0, (90.0, -90.0)),)),
        torch.full(field.shape, 5.0, dtype=torch.float64),
    )
    found = shop_limits.limits(scene, field, plain)
    bumpy = plain + 1e-3 * found["bumps_um"][1.0] * sine
    assert farthest((scene, plain), (scene, bumpy), field) == pytest.approx(min(scene.screen.pixel), rel=0.1)


def test_a_bump_of_the_limit_on_the_entrance_moves_light_by_a_pixel():
    scene, field, heights = make(relief=0.0)
    scene = replace(scene, lens=replace(scene.lens, entrance=SIDE))
    found = shop_limits.limits(scene, field, heights)
    (other,) = found["beside"]
    assert other["side"] == "entrance side" and other["maximum_slope"] == 0.0
    assert other["slope"] == pytest.approx(found["slope"], rel=0.1) and other["decentre_mm"] is None
    bumpy = FreeForm(waves(1e-3 * other["bumps_um"][1.0], 60)[1].numpy(), (3, 3))
    changed = replace(scene, lens=replace(scene.lens, entrance=bumpy))
    assert farthest((scene, heights), (changed, heights), field) == pytest.approx(min(scene.screen.pixel), rel=0.15)


def test_a_bump_of_the_index_moves_light_by_a_pixel():
    scene, field, _ = make()
    plain = torch.full(field.shape, 5.0, dtype=torch.float64)

    def with_bumps(height: float):
        values = scene.lens.index + waves(height, 60)[1].numpy()
        return replace(scene, lens=replace(scene.lens, gradient=Gradient("volume", volume=values)))

    found = shop_limits.limits(with_bumps(0.0), field, plain)
    assert found["slope"] == pytest.approx(shop_limits.limits(scene, field, plain)["slope"], rel=1e-4)
    moved = farthest((with_bumps(0.0), plain), (with_bumps(found["index_bumps"][1.0]), plain), field)
    assert moved == pytest.approx(min(scene.screen.pixel), rel=0.1)


@pytest.mark.parametrize(
    ("changes", "elements", "words"),
    [
        (
            {"gradient": Gradient("radial", (-1e-3, 2e-5))},
            (),
            ("n = 1.5443 - 0.001 r^2 + 2e-05 r^4, r in", "errors of the index"),
        ),
        ({"entrance": SIDE}, (), ("both sides free-form", "entrance side: bumps", "plane z = -0.5 mm")),
        ({}, (Component(40.0, (30.0, 30.0), 4.0),), ("a lens at +40.5 mm", "along the axis", "one side flat")),
    ],
    ids=["gradient index", "two sides", "other elements"],
)
def test_the_page_of_other_parts(changes, elements, words, tmp_path):
    scene, field, heights = make()
    scene = replace(scene, lens=replace(scene.lens, **changes), elements=elements)
    report = manufacture(scene, field, heights)
    write_page(tmp_path / "shop.html", "a part", scene, field, heights, report, "", (50.0, 40.0), 0)
    text = (tmp_path / "shop.html").read_text()
    assert not [part for part in words if part not in text] and "$" not in text and "the designer's program" in html.unescape(text)


@pytest.mark.parametrize(
    ("screen", "words", "card"),
    [
        ({"radius": (math.inf, 100.0)}, ("Print the test card", "rolled to its shape"), True),
        ({"radius": (100.0, 100.0)}, ("a sphere of radius 100 mm, its middle", "eight marks"), False),
        ({"z": 1000.0, "far": True}, ("so far away", "mrad", "eight marks"), False),
    ],
    ids=["cylinder", "sphere", "far field"],
)
def test_the_page_says_how_to_photograph_on_other_screens(screen, words, card, tmp_path):
    scene, field, heights = make()
    scene = replace(scene, screen=replace(scene.screen, **screen))
    assert Card.capability.supports(scene) == card
    size = write_card(tmp_path / "card.png", tmp_path / "card.csv", scene.screen) if card else None
    write_page(tmp_path / "shop.html", "a part", scene, field, heights, manufacture(scene, field, heights), "", size, 0)
    text = html.unescape((tmp_path / "shop.html").read_text())
    assert not [part for part in words if part not in text] and "$" not in text and ("test card" in text) == card


def test_roughness_at_the_limit_scatters_a_hundredth():
    scene, field, heights = make()
    sigma = 1e-6 * shop_limits.limits(scene, field, heights)["roughness_nm"]
    assert scattered(sigma, scene.lens.index - 1.0, scene.light.mean) == pytest.approx(shop_limits.SCATTERED)


def test_the_page(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_lighttools("lens.npz", *make(relief=0.005))
    order = "render lens.npz --rays 20000 --effects none --shop shop.html --json"
    assert cli.run(shlex.split(order)) == 0
    found = json.loads(capfd.readouterr().out)["shop"]
    text = Path("shop.html").read_text()
    for words in ("blank", "must not be rounded off", "test card", "10 x 10 mm", "refractive index 1.5443", "program tells"):
        assert words in text
    assert "⟨" not in text and "$" not in text and "http" not in text
    assert found["page"] == "shop.html" and Path(found["card"]).stat().st_size > 1000
    assert cli.run(shlex.split("render lens.npz --rays 20000 --shop .")) == 2
    assert capfd.readouterr().err.count("\n") == 1
    Path("shop.html").write_text("mine")
    assert cli.run(shlex.split(order)) == 2  # not overwritten
    assert Path("shop.html").read_text() == "mine"
