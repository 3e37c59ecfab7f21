"""Angular distributions by a table and brightness by a picture: against closed forms and the sources that they are like."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image
from rayfiles import zemax
from scipy.integrate import quad
from test_emission import LENS, heights, rectangle, scene, whole

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mitsuba import write_mitsuba
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.io.archive import open_archive
from caustic_cli.io.intensities import parse_distribution
from caustic_cli.io.photometry import Photometry, write_ies, write_ldt
from caustic_cli.optics.bounds import bounds_of
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.brightness import points_by_brightness
from caustic_cli.optics.emission.coherent import Mode, modes, outermost_modes
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.project.project import Project
from caustic_cli.scene import Disc, Lens, Points, Scene, Screen
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.studies.independent_rays import sample_rays

AT = (0.5, -0.5, -12.0)
COSINE = Distribution(tuple(np.linspace(0, 90, 2001)), tuple(np.cos(np.radians(np.linspace(0, 90, 2001)))))
EVEN = Distribution((0.0, 90.0), (3.0, 3.0))
LED = Distribution((0.0, 10.0, 25.0, 60.0), (1.0, 2.0, 0.5, 0.0))
HOLLOW = Distribution((0.0, 20.0, 30.0, 40.0), (0.0, 0.0, 1.0, 0.0))
PICTURE = np.array([[0.0, 1.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.5, 0.5, 4.0]])


@pytest.mark.parametrize("given", [EVEN, LED, HOLLOW, COSINE], ids=["even", "led", "hollow", "cosine"])
@pytest.mark.parametrize("cone", [1e-6, 1e-3, 0.2, 0.7, math.pi / 2])
def test_flux_and_angles(given, cone):
    if given is HOLLOW and cone < math.radians(20):
        with pytest.raises(InputError, match=r"\[source\] intensity: there is no light within the cone of"):
            given.flux(cone)
        return
    ends = [a for a in np.radians(given.angles[:5]) if a < cone]
    exact = (
        sum(
            quad(lambda t: 2 * math.pi * given.relative(t) * math.sin(t), a, b, epsrel=1e-13)[0]
            for a, b in zip(ends, [*ends[1:], cone], strict=True)
        )
        if given is not COSINE
        else math.pi * math.sin(cone) ** 2
    )
    assert given.flux(cone) == pytest.approx(exact, rel=1e-10 if given is not COSINE else 1e-6)
    part = np.concatenate([[0.0, 1.0], np.random.default_rng(0).random(1000)])
    angle = given.angle_of(part, cone)
    assert angle.min() >= 0 and angle.max() <= cone * (1 + 1e-12)
    again = [given.flux(t) / given.flux(cone) if p > 1e-9 else p for t, p in zip(angle, part, strict=True)]
    assert np.abs(np.array(again) - part).max() < 1e-11


@pytest.mark.parametrize(("table", "word"), [(EVEN, "uniform"), (COSINE, "lambertian")])
@pytest.mark.parametrize("aimed", [True, False])
def test_a_table_of_a_known_distribution_is_it(table, word, aimed):
    for cone in (25.0, 70.0):
        one, two = (whole(Points((AT,), cone=cone, intensity=i, aimed=aimed), rays=10_000) for i in (table, word))
        torch.testing.assert_close(one.power, two.power, rtol=1e-6, atol=1e-12)
        torch.testing.assert_close(one.origin[0], two.origin[0], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "source",
    [
        Points((AT,), cone=70.0, intensity=LED),
        Points((AT,), intensity=LED),
        Points((AT,), cone=70.0, intensity=LED, aimed=False),
        Points((AT, (0.0, 0.0, -30.0)), (1.0, 2.0), intensity=HOLLOW),
        Disc(AT, (3.0, 2.0), intensity=LED),
        Disc(AT, (3.0, 2.0), brightness=PICTURE),
        Disc(AT, (3.0, 2.0), cone=15.0, brightness=PICTURE, intensity=LED),
        Disc(angle=3.0, brightness=PICTURE),
    ],
)
@pytest.mark.parametrize("kind", ["stratified", "sobol", "uniform"])
def test_the_energy_balance_closes(source, kind):
    here = scene(source)
    sampler = rays_of(here, kind, 8_000, 3)
    for chunk in (1 << 20, 777):
        image = expose(here, HeightField.of(LENS), heights(LENS), sampler, chunk=chunk)
        assert abs(float(image.image.sum()) + math.fsum(image.lost.values()) - 1.0) < 1e-12


def test_aimed_and_unaimed_light_of_a_table():
    """The part of a table's light that meets the lens, by either way of drawing it, and by an integral over the aperture."""
    aimed, spread = (Points((AT,), cone=70.0, intensity=LED, aimed=aimed) for aimed in (True, False))
    powers = [float(whole(source, rays=100_000).power.sum()) for source in (aimed, spread)]
    x, y = np.meshgrid(*((np.arange(800) + 0.5) / 800 * 2 * r - r for r in (5.0, 4.0)), indexing="ij")
    q = np.hypot(x - AT[0], y - AT[1]) / 12.0
    exact = (LED.relative(np.arctan(q)) / (1 + q * q) ** 1.5).sum() * (80 / 800**2) / 144 / LED.flux(math.radians(70.0))
    assert powers[0] == pytest.approx(exact, rel=1e-4) and powers[1] == pytest.approx(exact, rel=3e-3)
    assert powers[0] != pytest.approx(rectangle(5, 4, 12) / (4 * math.pi * math.sin(math.radians(35.0)) ** 2), rel=0.05)


def test_a_mode_s_light_is_that_of_the_rays():
    source = Points((AT,), cone=70.0, intensity=LED)
    u, v = (c.ravel() for c in torch.meshgrid(*(2 * [(torch.arange(300, dtype=torch.float64) + 0.5) / 300]), indexing="ij"))
    state = Mode(scene(source), AT, 1.0).through(u, v)
    assert float(state.power.mean()) * 80.0 == pytest.approx(float(whole(source, rays=200_000).power.sum()), rel=1e-3)


def test_the_first_surface_knows_the_table():
    lens = Lens(size=(10.0, 8.0), control=(20, 20), index=1.5)
    screen = Screen((30.0, 30.0), 100.0, (16, 16))
    found = {
        name: first_surface(Scene(Points((AT,), intensity=i), lens, screen), np.ones((16, 16)), HeightField.of(lens), 32)
        for name, i in (("cosine", COSINE), ("lambertian", "lambertian"), ("led", LED))
    }
    found = {name: first.heights for name, first in found.items()}
    span = float(found["cosine"].max() - found["cosine"].min())
    assert float((found["cosine"] - found["lambertian"]).abs().max()) < 1e-5 * span
    assert float((found["led"] - found["lambertian"]).abs().max()) > 1e-2 * span


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"0 1\n10 2\n5 1\n", "must have angles that ascend from 0"),
        (b"1 1\n10 2\n", "ascend from 0"),
        (b"0 1\n190 2\n", "at most 180"),
        (b"0 1\n", "must name 2 to 100,000 angles"),
        (b"0 1\n10 -2\n", "at least 0"),
        (b"0 0\n10 0\n", "must have light within 90 degrees"),
        (b"0 0\n95 0\n120 1\n180 0\n", "must have light within 90 degrees"),
        (b"0 1\n10 nan\n", "line 2 is '10 nan'"),
        (b"0 1\n10 1e999\n", "line 2"),
        (b"0 1 2\n10 1\n", "line 1 is '0 1 2'"),
        (b"angle,intensity\nangle,intensity\n0,1\n", "line 2"),
        (b"0,1\nten,1\n", "line 2 is 'ten,1'"),
        (b"0,x\n10,1\n", "line 1 is '0,x'"),
        (b"", "has no angles"),
        (b"\xff\xfe\x00", "is not text"),
        (b"0 1\n" * 100_001, "more than 100,000 angles"),
    ],
)
def test_tables_that_are_none(data, message):
    with pytest.raises(InputError) as error:
        parse_distribution(data, "led.csv")
    assert message in str(error.value) and str(error.value).startswith("led.csv: ") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "data",
    [
        b"0,1\n10,2\n60,0\n",
        b"\xef\xbb\xbfangle (deg);intensity\r\n0;1\r\n10;2\r\n\r\n60;0\r\n",
        b"# LED\n0\t1 # axis\n10\t2\n60\t0",
    ],
)
def test_ways_of_writing_a_table(data):
    assert parse_distribution(data, "led.csv") == Distribution((0.0, 10.0, 60.0), (1.0, 2.0, 0.0))


def test_points_of_a_picture():
    a, b = torch.rand(2, 200_000, dtype=torch.float64)
    x, y = points_by_brightness(PICTURE, a, b)
    count, _, _ = np.histogram2d(x, y, PICTURE.shape, [[-1, 1], [-1, 1]])
    part = PICTURE / PICTURE.sum()
    assert (count[PICTURE == 0] == 0).all()
    assert np.abs(count / len(a) - part).max() < 5e-3
    line = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
    a, b = (c.ravel() for c in torch.meshgrid(line, line, indexing="ij"))
    even, _, _ = np.histogram2d(*points_by_brightness(np.ones((5, 7)), a, b), 16, [[-1, 1], [-1, 1]])
    assert even.min() == even.max() == 16  # a white picture leaves even points where they are
    x, y = points_by_brightness(PICTURE, torch.tensor([0.0, 1.0]).double(), torch.tensor([0.0, 1.0]).double())
    assert x.tolist() == pytest.approx([-1.0, 1.0]) and y.tolist() == pytest.approx([-1 / 3, 1.0])


def test_what_a_disc_with_a_picture_says_of_itself():
    disc = Disc(AT, (4.0, 3.0), brightness=np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]]))  # x in -1..0, y in 0..1.5
    assert disc.centre == pytest.approx((0.0, 0.25, -12.0)) and disc.extent == pytest.approx((1.0, 1.5))
    assert disc.pointlike().centre == disc.centre and disc.points()[0].tolist() == [list(AT)]
    sun = Disc(angle=2.0, brightness=np.ones((2, 2)))
    assert sun.half_angle == pytest.approx(math.asin(math.sqrt(2) * math.sin(math.radians(1.0))))
    assert Disc(angle=2.0, brightness=np.pad(np.ones((2, 2)), 7)).half_angle < math.radians(0.2)
    bundle = whole(disc, rays=100_000)
    dz = torch.sqrt(1 - (bundle.direction[0] ** 2 + bundle.direction[1] ** 2) * 1.5**2)
    x, y = (bundle.origin[k] - 12.0 * bundle.direction[k] * 1.5 / dz for k in (0, 1))
    assert float(x.min()) >= -0.5 - 1e-9 and float(x.max()) <= 0.5 + 1e-9 and float(y.min()) >= -0.5 - 1e-9
    here = scene(sun)
    (state,) = rays_of(here, "uniform", 200_000).chunks()
    sine = math.sin(math.radians(1.0))
    assert float(state.direction[0].abs().max()) == pytest.approx(sine, rel=1e-4) and float(
        state.direction[0].square().mean()
    ) == pytest.approx(sine**2 / 3, rel=1e-2)
    lean = float(torch.hypot(*state.direction[:2]).max())
    assert lean <= math.sin(bounds_of(here, HeightField.of(LENS), heights(LENS)).incidence) * (1 + 1e-12)


@pytest.mark.parametrize(
    "source",
    [
        Disc(AT, (3.0, 2.0), brightness=PICTURE),
        Disc(angle=4.0, brightness=PICTURE),
        Disc(AT, (3.0, 2.0), brightness=PICTURE, intensity=LED, cone=50.0),
    ],
)
def test_rays_against_independent_ones(source):
    """The image against that of rays drawn in NumPy all over the cone, pixel by pixel in units of noise."""
    here = scene(source)
    field, z = HeightField.of(LENS), heights(LENS)
    found = expose(here, field, z, rays_of(here, "stratified", 10_000)).image
    lean = 0.04 if source.distant else 0.5
    rng, rays = np.random.default_rng(0), 200_000
    places = []
    for o, d, _ in sample_rays(here, rays, rng):
        way = -o[2] / d[2]
        places.append(np.concatenate([o[:2] + way * d[:2], d]))
    x, y, *d = np.concatenate(places, 1)
    inside = (np.abs(x) <= 5) & (np.abs(y) <= 4)
    (state,) = rays_of(here, "stratified", 200_000).chunks(10**9)
    ours = [
        np.histogram2d(a, b, 16, r, weights=w)[0]
        for a, b, r, w in (
            (state.origin[0], state.origin[1], [[-5, 5], [-4, 4]], state.power),
            (state.direction[0], state.direction[1], [[-lean, lean]] * 2, state.power),
        )
    ]
    theirs = [
        np.histogram2d(a[inside], b[inside], 16, r)[0] / rays
        for a, b, r in ((x, y, [[-5, 5], [-4, 4]]), (d[0], d[1], [[-lean, lean]] * 2))
    ]
    for one, two in zip(ours, theirs, strict=True):
        lit = two > 200 / rays
        score = (one - two)[lit] * np.sqrt(rays / two[lit])
        assert lit.sum() > 3 and (score**2).mean() < 2.5
    assert float(found.sum()) > 0


def test_a_source_as_points():
    disc = Disc(AT, (3.0, 2.0), brightness=PICTURE)
    found = modes(scene(disc), 400)
    assert sum(m.part for m in found) == pytest.approx(1.0) and {m.position[2] for m in found} == {AT[2]}
    mean = np.mean([m.position for m in found], 0)
    assert mean == pytest.approx(disc.centre, abs=0.02)
    assert len(outermost_modes(scene(disc))) == 4
    sun = modes(scene(Disc(angle=4.0, brightness=PICTURE)), 50)
    assert len(sun) == 50 and all(abs(sum(c * c for c in m.position) - 1) < 1e-12 for m in sun)


def test_what_goes_out_comes_back(tmp_path):
    lens = Lens(size=(10.0, 8.0), control=(8, 7), index=1.5)
    field, z = HeightField.of(lens), heights(lens)
    for source in (Points((AT,), intensity=LED), Disc(AT, (3.0, 2.0), brightness=PICTURE), Disc(angle=4.0, brightness=PICTURE)):
        write_lighttools(tmp_path / "lens.npz", scene(source, lens), field, z)
        again = open_archive(tmp_path / "lens.npz")[0].source
        assert again.intensity == source.intensity
        assert (again.brightness is None) == (source.brightness is None)
        assert source.brightness is None or (again.brightness == PICTURE).all()
    write_mitsuba(tmp_path / "lens.xml", scene(Disc(AT, intensity=LED), lens), field, z)
    powers = re.findall(r'name="intensity" value="([^"]+)"', (tmp_path / "lens.xml").read_text())
    assert len(powers) > 100  # a grid of points
    with pytest.raises(InputError, match="light from infinity has one direction"):
        write_mitsuba(tmp_path / "sun.xml", scene(Disc(angle=4.0), lens), field, z)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda: Disc(brightness=np.zeros((2, 2))), "not black all over"),
        (lambda: Disc(brightness=np.array([[1.0, math.nan]])), "finite"),
        (lambda: Disc(brightness=-np.ones((2, 2))), "not negative"),
        (lambda: Disc(angle=120.0, brightness=np.ones((2, 2))), "too wide for a picture"),
        (lambda: Points((AT,), intensity="blue"), "must be one of uniform, lambertian, or a .csv file, got 'blue'"),
    ],
)
def test_impossible_ones_are_refused(what, message):
    with pytest.raises(InputError, match=message):
        what()


def photometry(lopsided):
    """Light of a file whose planes differ by twice this part."""
    planes, angles = 90.0 * np.arange(4), 10.0 * np.arange(10)
    around = 1.0 + lopsided * np.cos(np.radians(planes))
    return Photometry(planes, angles, 300.0 * around[:, None] * np.cos(np.radians(angles)))


@pytest.mark.parametrize("write", [write_ies, write_ldt])
def test_a_photometric_file_symmetric_about_its_axis_is_a_distribution(write, tmp_path):
    path = tmp_path / f"led{write.__name__.replace('write_', '.')}"
    write(path, photometry(0.02))
    found = parse_distribution(path.read_bytes(), str(path))
    assert found.angles == tuple(10.0 * np.arange(10))
    np.testing.assert_allclose(found.values, 300.0 * np.cos(np.radians(found.angles)), rtol=1e-5, atol=1e-4)
    write(path, photometry(0.3))
    with pytest.raises(InputError, match="planes C differ by 30% of the peak"):
        parse_distribution(path.read_bytes(), str(path))
    with pytest.raises(InputError, match="a photometric file of type C"):
        parse_distribution(b"IES\nnothing", "led.ies")


def test_an_edge_of_a_symmetric_file_may_run_between_its_angles(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    light = photometry(0.0)
    values = np.where(light.angles < 45.0, 300.0, 0.0) * np.ones((4, 1))
    values[:, 4] = [300.0, 200.0, 250.0, 100.0]  # the part of a cell that is lit, by some rays
    write_ldt(Path("edge.ldt"), light._replace(values=values))
    found = parse_distribution(Path("edge.ldt").read_bytes(), "edge.ldt")
    assert found.values[4] == pytest.approx(212.5)
    values[1, 2] = 200.0
    write_ldt(Path("edge.ldt"), light._replace(values=values))
    with pytest.raises(InputError, match="planes C differ by"):
        parse_distribution(Path("edge.ldt").read_bytes(), "edge.ldt")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()
    Image.fromarray(np.array([[0, 255], [255, 255]], np.uint8)).save("die.png")
    Path("led.csv").write_text("angle,intensity\n0,1\n10,2\n60,0\n")
    write_ldt(Path("led.ldt"), photometry(0.0))
    Path("rays.dat").write_bytes(zemax(np.zeros((9, 3)), np.tile([0.0, 0.0, 1.0], (9, 1)), np.ones(9)))


def run(capfd, *arguments, code=0):
    assert cli.run([*map(str, arguments), "--json", "--quiet", "--threads", "1"]) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


@pytest.mark.parametrize(
    ("source", "kept"),
    [
        (["--source", "point", "--intensity", "led.csv"], {"intensity.csv": "led.csv"}),
        (["--source", "point", "--intensity", "led.ldt"], {"intensity.ldt": "led.ldt"}),
        (
            ["--source", "disc", "--source-file", "die.png", "--source-size", "1", "--intensity", "led.csv"],
            {"intensity.csv": "led.csv", "source.png": "die.png"},
        ),
        (["--source-angle", "1", "--source-file", "die.png"], {"source.png": "die.png"}),
        (["--source", "disc", "--intensity", "lambertian"], {}),
    ],
)
def test_designs_keep_their_files(here, capfd, source, kept):
    figures = run(
        capfd,
        "design",
        "blob.png",
        *source,
        "--resolution",
        "24",
        "--control",
        "12",
        "--rays",
        "4000",
        "--iterations",
        "5",
        "--waves",
        "off",
    )
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    for name, given in kept.items():
        assert Path("blob.caustic", name).read_bytes() == Path(given).read_bytes()
        Path(given).unlink()
    again = run(
        capfd, "render", "blob.caustic", "--rays", "40000", "--force", "--effects", "entrance,intersection,fresnel,source-size"
    )
    assert again["relative_rms"] == pytest.approx(figures["relative_rms"], rel=0.05)
    assert Project.open("blob.caustic").settings.source.intensity == (
        next((name for name in kept if name.startswith("intensity")), "lambertian" if "lambertian" in source else "uniform")
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--source", "point", "--intensity", "blue"],
            "--intensity must be one of uniform, lambertian, or a .csv file, got 'blue'",
        ),
        (["--source", "point", "--intensity", "none.csv"], "none.csv: no such file; a .csv of two columns is needed"),
        (["--source", "point", "--intensity", "die.png"], "die.png: is not text"),
        (["--intensity", "led.csv"], "--intensity belongs to --source point, grid or disc, got plane"),
        (["--source", "disc", "--source-file", "rays.dat"], "--source-file of a disc must be a picture"),
        (["--source", "disc", "--source-file", "none.png"], "none.png: no such file"),
        (["--source", "rays", "--source-file", "die.png"], "--source-file of type rays must be a ray file"),
    ],
)
def test_bad_ones_are_one_line(here, capfd, arguments, message):
    err = run(capfd, "design", "blob.png", *arguments, code=2)
    assert message in err and "\n" not in err
    assert not Path("blob.caustic").exists()
