"""Rays of a file as a light source: against the sources that they were drawn from, whole, in parts, and on the command line."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from rayfiles import cone_of, lighttools, tm25, zemax
from test_emission import LENS, heights, scene

from caustic_cli import cli, load, render
from caustic_cli.config import settings
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.optics.bounds import bounds_of
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.measured import coarse_words, coarseness, irradiance
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene import Disc, Lens, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.studies.retrace import converge

AT = (0.5, -0.5, -30.0)
#: The same light as rays and as the source that they are drawn from.
KNOWN = {
    "point": (RaySet(*cone_of(400_000, 15.0)), Points((AT,), (2.0,), 15.0)),
    "disc": (RaySet(*cone_of(400_000, 15.0, (3.0, 1.0), 1, True)), Disc(AT, (3.0, 1.0), 2.0, 15.0)),
}


def measured(rays, **options) -> Measured:
    return Measured(rays, **{"position": AT, "power": 2.0} | options)


def drawn(source, rays=10**9, seed=0, lens=LENS):
    (state,) = rays_of(scene(source, lens), "stratified", rays, seed).chunks(10**9)
    return state


@pytest.mark.parametrize("name", KNOWN)
def test_what_it_says_of_itself(name):
    rays, known = KNOWN[name]
    source = measured(rays)
    assert (source.kind, source.distant, source.apart, source.sharp, source.power) == ("rays", False, False, False, 2.0)
    assert source.centre == pytest.approx(known.centre, abs=0.02) and source.nearest == AT[2]
    assert source.extent == pytest.approx(known.extent, abs=0.01) and source.rays.count == 400_000
    assert source.blur(0.0, 100.0) == pytest.approx(known.blur(0.0, 100.0), abs=0.02)
    assert source.apparent_angle(0.0) == pytest.approx(known.apparent_angle(0.0), abs=0.05)
    assert source.pointlike().centre == source.centre and source.extent_words(0.0)


@cache
def exactly(name):
    """The image of a known source, by many rays."""
    known = KNOWN[name][1]
    return expose(scene(known), HeightField.of(LENS), heights(LENS), rays_of(scene(known), "stratified", 4_000_000))


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.parametrize("part", [1.0, 0.3])
def test_the_image_is_that_of_the_source_it_was_drawn_from(name, part):
    """In units of the noise that the file's rays leave: every pixel's variance is its power times that of a ray."""
    rays, exact = KNOWN[name][0], exactly(name)
    z, field = heights(LENS), HeightField.of(LENS)
    count = int(part * rays.count)
    found = expose(scene(measured(rays)), field, z, rays_of(scene(measured(rays)), "stratified", count))
    assert found.rays <= count and (part == 1.0 or found.rays == count)
    each = (1.0 - found.lost["missed_lens"]) / found.rays
    lit = exact.image > 20 * each
    score = (found.image - exact.image)[lit] / torch.sqrt(exact.image[lit] * each)
    assert int(lit.sum()) > 50 and 0.2 < float(score.pow(2).mean()) < 1.6  # an even part is better than a random one
    assert found.lost["missed_lens"] == pytest.approx(exact.lost["missed_lens"], abs=4e-3)


@pytest.mark.parametrize("rays", [10**9, 100_000, 7])
def test_the_energy_balance_closes(rays):
    positions, directions, flux = cone_of(200_001, 50.0, (2.0, 2.0), 3)
    flux = flux * np.random.default_rng(0).exponential(size=len(flux))
    directions[::7] *= -1.0
    source = measured(RaySet(positions, directions, flux))
    sampler = rays_of(scene(source), "stratified", rays, 5)
    for chunk in (1 << 20, 1000):
        image = expose(scene(source), HeightField.of(LENS), heights(LENS), sampler, chunk=chunk)
        assert abs(float(image.image.sum()) + math.fsum(image.lost.values()) - 1.0) < 1e-12
    assert sampler.count == min(rays, len(drawn(source).power))
    shares = [c.power.sum() + c.lost["missed_lens"] for c in sampler.chunks(1000)]
    assert float(sum(shares)) == pytest.approx(1.0, abs=1e-12)


def test_light_that_misses_is_counted():
    rays = RaySet(np.zeros((4, 3)), [[0, 0, 1], [0, 0, -1], [1, 0, 0], [1, 0, 1]], [1, 2, 3, 4])
    state = drawn(measured(rays, position=(0.0, 0.0, -30.0)))
    assert state.power.tolist() == pytest.approx([0.1]) and state.lost["missed_lens"] == pytest.approx(0.9)
    assert (float(state.origin[0]), float(state.origin[1]), state.origin[2]) == (0.0, 0.0, 0.0)


def test_a_turned_bundle_of_parallel_rays_is_a_tilted_plane_wave():
    """Wider than the lens, which receives the part of its cross section that the tilted aperture cuts out."""
    tilt, wide = (25.0, -30.0), 24.0
    across = np.random.default_rng(0).uniform(-0.5 * wide, 0.5 * wide, (400_000, 3)) * [1, 1, 0]
    rays = RaySet(across, np.broadcast_to([0.0, 0.0, 1.0], across.shape), np.ones(len(across)))
    x, y = (60.0 * c / PlaneWave(tilt=tilt).axis[2] for c in PlaneWave(tilt=tilt).axis[:2])
    screen = Screen((24.0, 24.0), 60.0, (12, 12), tilt=tilt, shift=(x, y))
    field, z = HeightField.of(LENS), heights(LENS)
    here, known = (
        Scene(source, LENS, screen) for source in (measured(rays, position=(0.0, 0.0, -40.0), tilt=tilt), PlaneWave(tilt=tilt))
    )
    found, exact = (expose(one, field, z, rays_of(one, "grid", 10**6)) for one in (here, known))
    part = math.prod(LENS.size) * known.source.axis[2] / wide**2
    assert float(found.image.sum()) + math.fsum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)
    assert found.lost["missed_lens"] == pytest.approx(1.0 - part, abs=3e-3)
    each = 1.0 / len(across)
    lit = part * exact.image > 20 * each
    score = (found.image - part * exact.image)[lit] / torch.sqrt(part * exact.image[lit] * each)
    assert int(lit.sum()) > 30 and 0.5 < float(score.pow(2).mean()) < 1.5


def test_a_part_is_even_and_changes_with_the_seed():
    source = measured(KNOWN["point"][0])
    every, some, other = drawn(source), drawn(source, 20_000), drawn(source, 20_000, 1)
    assert len(some.power) == 20_000 and len(set(some.power.tolist())) == 1
    assert not torch.equal(some.origin[0], other.origin[0])
    again = drawn(source, 20_000)
    assert torch.equal(some.origin[0], again.origin[0])
    count = [np.histogram2d(s.origin[0], s.origin[1], 20, [[-5, 5], [-4, 4]], weights=s.power)[0] for s in (every, some)]
    error = np.sqrt(((count[1] - count[0]) ** 2).mean()) / count[0].mean()
    assert error < 0.5 / math.sqrt(20_000 / 400)  # half of what a random part would have


def test_rays_of_other_powers_are_drawn_as_often_as_they_carry():
    positions, directions, _ = cone_of(100_000, 9.0)
    bright = directions[:, 0] > 0
    source = measured(RaySet(positions, directions, np.where(bright, 3.0, 1.0)), position=(0.0, 0.0, -30.0))
    some = drawn(source, 10_000)
    assert float((some.direction[0] > 0).double().mean()) == pytest.approx(0.75, abs=5e-3)


def test_bounds_hold_for_the_very_rays():
    source = measured(KNOWN["disc"][0])
    here = scene(source)
    state = drawn(source)
    lean = float(torch.atan2(torch.hypot(state.direction[0], state.direction[1]), state.direction[2]).max())
    assert bounds_of(here, HeightField.of(LENS), heights(LENS)).incidence == pytest.approx(lean, rel=1e-12)
    plan = compile_plan(here, HeightField.of(LENS), heights(LENS))
    assert plan["source-size"].on and plan["intersection"].on and not plan["diffraction"].on
    with pytest.raises(NoWaveImage, match="contains no phase"):
        wave_image(here, HeightField.of(LENS), heights(LENS))


def test_how_many_rays_a_picture_takes():
    rays = KNOWN["point"][0]
    here = Scene(measured(rays), LENS, Screen((40.0, 32.0), 100.0, (200, 160)))
    noise, wanted = coarseness(here)
    met = len(drawn(measured(rays)).power)
    assert noise == pytest.approx(math.sqrt(200 * 160 / met)) and wanted == pytest.approx(400_000 * (noise / 0.1) ** 2, abs=1)
    assert "the ray file is coarse for 200 x 160 pixels: its 400,000 rays leave" in coarse_words(here)
    assert f"would take {math.ceil(wanted / 1e5) * 1e5:,.0f} to leave 10%" in coarse_words(here)
    assert coarse_words(scene(measured(rays))) is None and coarse_words(scene(Points((AT,)))) is None
    field, z = HeightField.of(LENS), heights(LENS)
    one = expose(here, field, z, rays_of(here, "grid", 10**9)).image
    fresh = RaySet(*cone_of(400_000, 15.0, (0, 0), 77))
    two = expose(here, field, z, rays_of(Scene(measured(fresh), LENS, here.screen), "grid", 10**9)).image
    error = float((one - two).square().mean().sqrt() / math.sqrt(2) / one.mean())
    on_screen = float(one.sum()) / (met / 400_000)  # of the rays that meet the lens, which the noise counts on
    assert error == pytest.approx(noise / math.sqrt(on_screen), rel=0.05)


def test_a_tolerance_beyond_the_file_is_refused():
    here = scene(measured(KNOWN["point"][0]))
    field, z = HeightField.of(LENS), heights(LENS)
    assert converge(here, field, z, 0.2, rays=4000).error <= 0.2
    with pytest.raises(CausticError, match=r"tolerance 0.001 requires more rays than the file holds, 400,000"):
        converge(here, field, z, 1e-3, rays=4000)


@pytest.mark.parametrize("name", KNOWN)
def test_the_light_of_a_first_surface(name):
    """Rays' irradiance on the exit against the source's own, by its rays."""
    rays, known = KNOWN[name]
    lens = Lens(size=(10.0, 8.0), control=(20, 20), index=1.5)
    x, y = np.linspace(-5, 5, 65), np.linspace(-4, 4, 53)
    found = irradiance(scene(measured(rays), lens), x, y, 5.0)
    state = drawn(known, 4_000_000, lens=lens)
    inside = [c / 1.5 for c in state.direction[:2]]
    way = 5.0 / torch.sqrt(1 - inside[0] ** 2 - inside[1] ** 2)
    at = [o + way * c for o, c in zip(state.origin[:2], inside, strict=True)]
    exact = np.histogram2d(*at, (x, y), weights=state.power)[0] * (1 - 0.04)
    assert found.sum() == pytest.approx(exact.sum(), rel=0.01)
    inner = (slice(12, -12), slice(12, -12))
    assert np.abs(found[inner] / found[inner].mean() - exact[inner] / exact[inner].mean()).mean() < 0.05
    target = np.ones((16, 16))
    screen = Screen((30.0, 30.0), 100.0, (16, 16))
    surface, other = (
        first_surface(Scene(source, lens, screen), target, HeightField.of(lens), 32).heights for source in (measured(rays), known)
    )
    assert float((surface - other - (surface - other).mean()).abs().max()) < 0.1 * float(other.max() - other.min())


def test_rays_that_converge_have_no_first_surface_but_an_image():
    p = np.random.default_rng(0).uniform(-3, 3, (1000, 3)) * [1, 1, 0]
    source = measured(RaySet(p, np.array([0.0, 0.0, 100.0]) - p, np.ones(1000)), position=(0.0, 0.0, -20.0))
    assert source.centre == pytest.approx((0.0, 0.0, 80.0), abs=1e-6)
    here = scene(source)
    with pytest.raises(InputError, match="its rays meet at z = 80 mm, not before the lens"):
        first_surface(here, np.ones((20, 16)), HeightField.of(LENS))
    found = expose(here, HeightField.of(LENS), heights(LENS), rays_of(here, "grid", 10**6))
    assert float(found.image.sum()) > 0.85


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda: scene(measured(RaySet(np.array([[0.0, 0.0, 40.0]]), [[0, 0, 1]], [1]))), "must lie before the lens"),
        (lambda: drawn(measured(RaySet(np.zeros((1, 3)), [[1, 0, 0.1]], [1]))), "none of its 1 rays meets the lens"),
        (lambda: measured(RaySet(np.zeros((1, 3)), [[0, 0, -1]], [1])), "no ray that carries light towards"),
        (lambda: measured(KNOWN["point"][0], power=0.0), "power"),
        (lambda: rays_of(scene(measured(KNOWN["point"][0])), "halton", 9), "sampler"),
        (lambda: settings.build_source(complete({"source": {"type": "rays"}}, 1.0).source), "must be a ray file"),
    ],
)
def test_impossible_ones_are_refused(what, message):
    with pytest.raises(InputError, match=message):
        what()


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()


def run(capfd, *arguments, code=0):
    assert cli.run([*map(str, arguments), "--json", "--threads", "1"]) == code
    out, err = capfd.readouterr()
    return (json.loads(out), err) if code == 0 else err.strip()


def test_a_file_turned_on_the_command_line(here, capfd):
    """The screen stands square to its light; the exported lens has the same light, and a render of another direction another."""
    Path("beam.tm25ray").write_bytes(tm25(*cone_of(60_000, 6.0)))
    light = ["--source", "rays", "--source-file", "beam.tm25ray", "--source-tilt", "20,0"]
    made, _ = run(capfd, "design", "blob.png", "--resolution", "24", "--control", "12", "--quality", "draft", *light, "-o", "p")
    settings_ = Path("p/project.toml").read_text()
    assert "tilt = [20.0, 0.0]" in settings_ and f"shift = [0.0, {-300.0 * math.tan(math.radians(20.0))!r}"[:20] in settings_
    assert made["on_screen"] > 0.4 * (1.0 - made["lost"]["missed_lens"])
    assert cli.run(["export", "p", "--format", "lighttools", "-o", "p.npz"]) == 0 and capfd.readouterr()
    own, _ = run(capfd, "render", "p", "-o", "a.png")
    same, _ = run(capfd, "render", "p.npz", "--source-file", "beam.tm25ray", "-o", "b.png")
    straight, _ = run(capfd, "render", "p", "--source-tilt", "0,0", "-o", "c.png")
    assert same["on_screen"] == pytest.approx(own["on_screen"], abs=1e-3) and straight["on_screen"] < 0.1 * own["on_screen"]
    assert "80 degrees" in run(capfd, "render", "p", "--source-tilt", "70,60", "-o", "d.png", code=2)


@pytest.mark.parametrize(("form", "name"), [(tm25, "led.tm25ray"), (zemax, "LED.SDF"), (lighttools, "led.txt")])
def test_a_design_from_a_file_stands_alone(here, capfd, form, name):
    Path(name).write_bytes(form(*cone_of(30_000, 12.0, (0.4, 0.4))))
    base = [
        "design",
        "blob.png",
        "--resolution",
        "24",
        "--control",
        "12",
        "--rays",
        "6000",
        "--iterations",
        "8",
        "--source",
        "rays",
        "--source-file",
        name,
        "--source-position",
        "0,0,-40",
    ]
    figures, err = run(capfd, *base)
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert figures["rays"] < 30_000 and "the ray file is coarse for 24 x 24 pixels: its 30,000 rays" in err
    project = Project.open("blob.caustic")
    kept = f"source{Path(name).suffix.lower()}"
    assert project.settings.source.file == kept and project.settings.source.position == ((0, 0, -40),)
    assert Path("blob.caustic", kept).read_bytes() == Path(name).read_bytes()
    history = project.load().state.history
    assert history[-1][2] < history[0][2]
    _, err = run(capfd, *base)
    assert "was designed from the same picture with the same options" in err
    Path(name).unlink()
    again, _ = run(capfd, "render", "blob.caustic", "--rays", "1e6", "--force")
    assert again["relative_rms"] == pytest.approx(figures["relative_rms"], rel=1e-3)
    run(capfd, "design", "--resume", "blob.caustic", "--iterations", 10)
    disc, _ = run(capfd, "render", "blob.caustic", "--rays", "40000", "-o", "disc.png", "--source", "disc", "--source-size", "0.4")
    assert disc["on_screen"] > 0.3


def test_an_archive_is_read_back_with_its_rays(here, capfd):
    """Which it does not contain: with them it gives the same image, other rays are refused, and a start needs none."""
    Path("led.tm25ray").write_bytes(tm25(*cone_of(5000, 12.0)))
    Path("other.dat").write_bytes(zemax(*cone_of(5000, 12.0, (0, 0), 1)))
    small = ("--resolution", "24", "--control", "12", "--rays", "2000", "--iterations", "1")
    run(capfd, "design", "blob.png", *small, "--source", "rays", "--source-file", "led.tm25ray", "-o", "p")
    lens = load("p")
    lens.export("lens.npz")
    image = lens.render(2000, seed=1).image
    for name in ("led.tm25ray", "p/source.tm25ray"):
        assert np.array_equal(render("lens.npz", 2000, seed=1, source_file=name).image, image)
    found, _ = run(capfd, "render", "lens.npz", "--rays", "2000", "--source", "rays", "--source-file", "led.tm25ray")
    assert found["on_screen"] > 0.05
    run(capfd, "design", "blob.png", *small, "--start", "lens.npz", "-o", "q")
    load("q").export("plane.npz")
    for archive, arguments, words in (
        ("lens.npz", (), "lens.npz: its source is a ray file, which an archive does not contain: --source-file names it"),
        ("lens.npz", ("--source-file", "other.dat"), "--source-file holds other rays than those of its source"),
        ("lens.npz", ("--source-file", "blob.png"), "blob.png: is not a ray file"),
        ("lens.npz", ("--source-file", "led.tm25ray", "--screen-shift", "1,0"), "--screen-shift: an archive's source is fixed"),
        ("plane.npz", ("--source-file", "led.tm25ray"), "belongs to an archive whose source is a ray file"),
        ("plane.npz", ("--source", "rays"), "--source: an archive's source is fixed"),
    ):
        assert words in run(capfd, "render", archive, *arguments, code=2)


def test_another_file_is_another_design(here, capfd):
    Path("led.dat").write_bytes(zemax(*cone_of(5000, 12.0)))
    base = [
        "design",
        "blob.png",
        "--resolution",
        "24",
        "--control",
        "12",
        "--rays",
        "2000",
        "--iterations",
        "2",
        "--source",
        "rays",
        "--source-file",
        "led.dat",
    ]
    run(capfd, *base)
    render = ["render", "blob.caustic", "-o", "a.png", "--source", "rays", "--source-file", "other.dat"]
    Path("other.dat").write_bytes(zemax(*cone_of(5000, 8.0)))
    one, _ = run(capfd, *render)
    Path("other.dat").write_bytes(zemax(*cone_of(5000, 4.0)))
    two, _ = run(capfd, *render)
    assert one["rays"] != two["rays"]
    Path("led.dat").write_bytes(zemax(*cone_of(5000, 12.0, (0, 0), 1)))
    assert "holds a design already" in run(capfd, *base, code=2)
    Path("blob.caustic/source.dat").write_bytes(b"\x89PNG")
    assert "is not a ray file" in run(capfd, "render", "blob.caustic", code=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--source", "rays"], "[source] file of type rays must be a ray file"),
        (["--source", "rays", "--source-file", "none.dat"], "none.dat: no such file"),
        (["--source", "rays", "--source-file", "cut.dat"], "cut.dat: is 10,203 bytes, but its header and"),
        (["--source", "rays", "--source-file", "far.dat"], "--source-file: none of its 357 rays meets the lens"),
        (
            ["--source", "rays", "--source-file", "led.dat", "--source-position", "0,0,1"],
            "--source-position must lie before the lens",
        ),
        (
            ["--source", "rays", "--source-file", "led.dat", "--source-position", "0,0,-9", "--source-position", "0,0,-8"],
            "one [x, y, z]",
        ),
        (["--source", "rays", "--source-file", "led.dat", "--cone", "3"], "--cone belongs to --source"),
        (["--source", "rays", "--source-file", "led.dat", "--waves", "on"], "--waves on: a ray file contains no phase"),
        (["--source", "point", "--source-file", "led.dat"], "--source-file belongs to --source plane, disc, measured or rays"),
    ],
)
def test_bad_files_are_one_line(here, capfd, arguments, message):
    Path("led.dat").write_bytes(zemax(*cone_of(357, 12.0)))
    Path("cut.dat").write_bytes(zemax(*cone_of(357, 12.0))[:-1])
    p, d, f = cone_of(357, 2.0)
    Path("far.dat").write_bytes(zemax(p + np.array([100.0, 0.0, 0.0]), d, f))
    err = run(capfd, "design", "blob.png", *arguments, code=2).replace("caustic: ", "")
    line = [row for row in err.splitlines() if "compil" not in row and "solving" not in row]
    assert len(line) == 1 and message in line[0]
    assert not Path("blob.caustic").exists()
