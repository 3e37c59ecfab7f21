"""Light reflected within a lamp: Snell and Fresnel by vectors, energy, and what concentric spheres do with it."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from test_lamp_files import FIELD, ONE, TWO

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.optics.interface import reflectance, refract
from caustic_cli.optics.lamp import emissions, through
from caustic_cli.optics.lamp_ghosts import ENDS, ghosts, refracted
from caustic_cli.optics.lamp_side import Hemisphere, PolarSide
from caustic_cli.scene.lamp import Chip, Goal, Lamp
from caustic_cli.studies.lamp import lamp_image

CASES = {
    "point": (Lamp(), ONE),
    "chip": (Lamp(Chip("rectangle", (1.0, 2.0), reflectance=0.8)), ONE),
    "two surfaces": (Lamp(Chip("disc", (1.0, 2.0), reflectance=0.5), surfaces=2, inner=3.0), TWO),
    "flat": (Lamp(Chip("rectangle", (1.0, 2.0), reflectance=0.5), inner=5.0, flat=0.8), ONE),
}


def rays_of(lamp, count=40_000):
    """Rays of its chip."""
    (rays,) = emissions(lamp.chip, count, 1)
    return rays


def shares(parts):
    """Sums of tensors by name."""
    return {name: float(part.sum()) for name, part in parts.items()}


@pytest.mark.parametrize("outwards", [True, False])
def test_vectors_are_refracted_as_in_the_frame_of_the_surface(outwards):
    rng = np.random.default_rng(4)
    p, q, a, b = (torch.from_numpy(c) for c in rng.uniform(-0.8, 0.8, (4, 500)))
    d = torch.stack([a, b, torch.ones_like(a)], 1)
    d = d / d.norm(dim=1, keepdim=True)
    normal = torch.stack([-p, -q, torch.ones_like(p)], 1)
    normal = normal / normal.norm(dim=1, keepdim=True)
    facing = (d * normal).sum(1) > 0.05
    n = 1.49 if outwards else 1.0 / 1.49
    out, passes, c, s = refract(tuple(d.T), p, q, n)
    indices = (1.49, 1.0) if outwards else (1.0, 1.49)
    for sign in (1.0, -1.0):  # whichever way the normal points
        found, back, r = refracted(d, sign * normal, *indices)
        ok = facing & passes
        assert ok.sum() > 200 and (not outwards or (facing & ~passes).any())
        torch.testing.assert_close(found[ok], torch.stack(out, 1)[ok], rtol=0, atol=1e-12)
        torch.testing.assert_close(r[ok], reflectance("exact", c, s, n)[ok], rtol=0, atol=1e-12)
        assert (r[facing & ~passes] == 1.0).all()
        torch.testing.assert_close((back * normal).sum(1), -(d * normal).sum(1), rtol=0, atol=1e-12)
        torch.testing.assert_close(torch.linalg.cross(back, normal), torch.linalg.cross(d, normal), rtol=0, atol=1e-12)


@pytest.mark.parametrize("case", CASES)
def test_what_was_lost_by_reflection_is_followed_and_no_energy_is_lost(case):
    lamp, values = CASES[case]
    rays = rays_of(lamp)
    with torch.no_grad():
        first, found = through(lamp, FIELD, rays, values), ghosts(lamp, FIELD, values, rays, np.random.default_rng(1))
    booked, lost = shares(first.lost), shares(found.lost)
    for cause in ("inner_fresnel", "outer_fresnel", "total_internal_reflection"):
        assert booked[cause] + lost.get(cause, 0.0) == pytest.approx(0.0, abs=1e-12)
    assert float(found.power.sum()) + math.fsum(lost.values()) == pytest.approx(0.0, abs=1e-12)
    assert all(lost[cause] >= 0.0 for cause in ENDS) and lost["unfollowed"] < 2e-5
    assert (lost["chip"] > 0) == (case != "point") and float(found.power.sum()) > 0.005
    direction = torch.stack(found.direction, 1)
    torch.testing.assert_close(direction.norm(dim=1), torch.ones(len(direction), dtype=torch.float64))
    r = torch.stack(found.point, 1).norm(dim=1)
    assert float(r.min()) > 8.0  # where it leaves the outer surface


@pytest.mark.parametrize("chip", [0.0, 0.6])
def test_two_concentric_spheres_reflect_as_a_plate_does(chip):
    """Of light from the centre, at normal incidence: T = (1 - R) / (1 + R) passes both surfaces after all reflections and the rest
    returns to the chip, which sends back a part of it."""
    lamp = Lamp(Chip("disc", (1e-3, 1e-3), reflectance=chip))
    rays = rays_of(lamp, 130_000)
    with torch.no_grad():
        first = through(lamp, FIELD, rays, FIELD.sphere(12.0))
        found = ghosts(lamp, FIELD, FIELD.sphere(12.0), rays, np.random.default_rng(1))
    r = ((1.49 - 1.0) / (1.49 + 1.0)) ** 2
    passes = (1.0 - r) / (1.0 + r)
    expected = passes / (1.0 - chip * (1.0 - passes))
    assert float(first.power.sum() + found.power.sum()) == pytest.approx(expected, abs=8e-4)
    lost = shares(found.lost)
    # What the chip absorbs; a hair misses its edge
    assert lost["chip"] + lost["board"] == pytest.approx(1.0 - expected, abs=8e-4) and lost["base"] < 1e-4


def test_a_path_within_the_lens_meets_the_inner_surface_where_it_lies():
    lamp = Lamp()
    generator = torch.Generator().manual_seed(3)
    o = 12.0 * torch.nn.functional.normalize(torch.rand(400, 3, dtype=torch.float64, generator=generator) - 0.4, dim=1).abs()
    d = torch.nn.functional.normalize(4.4 * torch.rand(400, 3, dtype=torch.float64, generator=generator) - o, dim=1)
    most = torch.full((400,), 30.0, dtype=torch.float64)
    exact = Hemisphere(lamp.inner).met_from_glass(o, d, most)
    searched = PolarSide(FIELD, FIELD.sphere(lamp.inner)).met_from_glass(o, d, most)
    met = torch.isfinite(exact) & torch.isfinite(searched)
    assert met.sum() > 100 and (torch.isfinite(exact) & ~met).float().mean() < 0.05  # short chords are missed
    torch.testing.assert_close(searched[met], exact[met], rtol=0, atol=1e-9)


def test_an_image_with_ghosts_has_all_light_and_one_without_does_not_pay():
    goal = Goal((6000.0, 6000.0), 2000.0)
    lamp = CASES["chip"][0]
    found = lamp_image(Lamp(lamp.chip, ghosts=True), goal, FIELD, ONE, (20, 20), rays=40_000)
    without = lamp_image(lamp, goal, FIELD, ONE, (20, 20), rays=40_000)
    for image in (found, without):
        assert image.image.sum() + math.fsum(image.lost.values()) == pytest.approx(1.0, abs=1e-12)
    assert "board" in found.lost and not {*ENDS} & {*without.lost} and found.rays == without.rays
    assert found.lost["inner_fresnel"] == pytest.approx(0.0, abs=1e-12) and found.image.sum() > without.image.sum()


def test_a_reflectance_is_between_none_and_all():
    with pytest.raises(InputError, match="must be 0 to 1"):
        Chip(reflectance=1.5)


def test_effects_of_a_lamp_by_the_command_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    given = ["--lamp", "15", "--angles", "100x60", "--chip", "1", "--quiet"]
    assert cli.run(["design", "uniform", *given, "-o", "dark"]) == 0
    assert cli.run(["design", "uniform", *given, "--chip-reflectance", "0.7", "-o", "white"]) == 0
    found = {}
    for name, more in (("dark", []), ("dark", ["--effects", "ghosts"]), ("white", []), ("white", ["--effects", "none"])):
        capfd.readouterr()
        assert cli.run(["render", name, "--rays", "40000", *more, "-o", "a.png", "--json", "--quiet"]) == 0
        found[name, *more] = json.loads(capfd.readouterr().out)
    for figures in found.values():
        assert figures["of_source"] + math.fsum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    alone, ghosted, white, none = found.values()
    assert "board" not in alone["lost"] and "board" not in none["lost"]
    assert ghosted["lost"]["chip"] > white["lost"]["chip"] > 0.0
    assert white["of_source"] > ghosted["of_source"] > alone["of_source"] > 0.75
    capfd.readouterr()
    assert cli.run(["render", "white", "--rays", "10000", "--explain", "-o", "a.png"]) == 0
    said = capfd.readouterr().out
    assert "ghosts" in said and "on:" in said and "reflects 0.7" in said
    assert cli.run(["render", "dark", "--effects", "diffraction", "-o", "b.png"]) == 2
    assert "none, auto or ghosts" in capfd.readouterr().err
    assert not Path("b.png").exists()
