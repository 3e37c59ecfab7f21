"""The page of `caustic render --html`: what a browser traces from it is what `render` traces, and nothing else is in it."""

import base64
import json
import math
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from test_direction import heights
from test_direction import scene as at_angle

from caustic_cli import cli, load
from caustic_cli.export import page as pages
from caustic_cli.export.page import MOST, _coded, _lights, _onto, write_page
from caustic_cli.io.colorimetry import _into_gamut, rgb_matrix
from caustic_cli.io.files import is_ours
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Component, Disc, FoldMirror, FreeForm, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.screen import Sags
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.measured_beam import MeasuredBeam
from caustic_cli.scene.sources.several import Several, light_of_all, together
from caustic_cli.studies.metrics import relative_rms

#: Relative RMS by which page and render may differ; render's own noise is part of it.
ALIKE = 0.05
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
QUIET = ["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-quic"]
ENGINES = {"cpu": ["--disable-gpu"], "gpu": ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]}
#: Effects of rays: the wave image, which takes longer than all the rest, is none of what is compared.
RAYS = ["--effects", "source-size,entrance,intersection,missed-surface,fresnel,total-reflection"]
#: What is designed, small, and by its name.
DESIGNS = {
    "plane": [],
    "point": ["--source", "point", "--source-position", "0,0,-60"],
    "mirror": ["--mirror"],
    "round": ["--aperture", "circle"],
}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A directory with a project and its page for each of DESIGNS."""
    directory = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(directory)
        write_blob()
        small = ["--resolution", "64", "--quality", "draft", "--iterations", "3", "--waves", "off", "--threads", "1", "--quiet"]
        for name, given in DESIGNS.items():
            assert cli.run(["design", "blob.png", *small, *given, "-o", f"{name}.caustic"]) == 0
            assert cli.run(["render", f"{name}.caustic", "--rays", "1e5", *RAYS, "--html", f"{name}.html", "--quiet"]) == 0
    return directory


def rendered(home: Path, name: str, *options: str) -> np.ndarray:
    """The image by `caustic render`."""
    made = home / "rendered.npy"
    arguments = [
        "render",
        str(home / f"{name}.caustic"),
        "--rays",
        "2e6",
        "-o",
        str(home / "rendered.png"),
        "--npy",
        str(made),
        *RAYS,
    ]
    assert cli.run([*arguments, *options, "--quiet", "--force", "--threads", "2"]) == 0
    return np.load(made)


def browsed(page: Path, setting: str, engine: str, profile: Path) -> str:
    """The document after the page has traced a setting."""
    command = [str(BROWSER), "--headless=new", "--no-sandbox", *QUIET, *ENGINES[engine], f"--user-data-dir={profile}"]
    command += ["--virtual-time-budget=600000", "--dump-dom", f"{page.as_uri()}#engine={engine}&numbers&{setting}"]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout


def traced(page: Path, setting: str, engine: str, profile: Path) -> tuple[np.ndarray, float]:
    """The image that the page traces, in the order of a file, and the error that it says."""
    document = browsed(page, setting, engine, profile)
    found = re.search(r'<pre id="numbers"[^>]*data-engine="([^"]*)"[^>]*>([^<]*)<', document)
    assert found, re.search(r'<p id="failure".*?</p>', document, re.S)[0]
    if not found[1].startswith(engine):
        pytest.skip("this browser has no graphics processor that adds up floating-point numbers, not even in software")
    error = re.search(r'<dd id="rms">([0-9.]+)</dd>', document)
    return np.frombuffer(base64.b64decode(found[2]), dtype=np.float32).astype(float), float(error[1])


def leaning(distance: float, x: float, y: float) -> str:
    """The place of a source at a distance whose light to the lens' middle leans by angles along x and y, degrees."""
    way = np.array([math.tan(math.radians(x)), math.tan(math.radians(y)), 1.0])
    return ",".join(f"{c:.9g}" for c in -distance * way / np.linalg.norm(way))


CASES = {
    "plane": ("plane", "", []),
    "leaning light": (
        "plane",
        "throw=240&leanx=1.5&leany=-1",
        ["--screen-at", "240", "--source", "point", "--source-position", leaning(1e5, 1.5, -1.0)],
    ),
    "a point aside": ("point", "leanx=-2&leany=3&throw=330", ["--source-position", leaning(60.0, -2.0, 3.0), "--screen-at", "330"]),
    "a disc": ("point", "size=1.5", ["--source", "disc", "--source-size", "1.5", "--source-position", "0,0,-60"]),
    "mirror": ("mirror", "", []),
    "round": ("round", "", []),
}


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
@pytest.mark.parametrize(
    "case, engine", [(case, "cpu") for case in ("plane", "leaning light", "a disc", "mirror", "round")] + [("a point aside", "gpu")]
)
def test_a_browser_traces_what_render_traces(case, engine, home, tmp_path):
    name, setting, options = CASES[case]
    (image, said), wanted = traced(home / f"{name}.html", setting, engine, tmp_path), rendered(home, name, *options)
    image = image.reshape(wanted.shape)
    target = load(home / f"{name}.caustic").target
    assert relative_rms(image, wanted) < ALIKE < relative_rms(image, wanted[::-1])
    assert said == pytest.approx(relative_rms(image, target), abs=6e-4)
    if case not in ("leaning light", "a disc", "a point aside"):  # whose cones `render` widens until they cover the lens
        assert image.sum() == pytest.approx(wanted.sum(), rel=0.01)


def test_a_page_is_one_small_file_that_asks_for_nothing(home):
    for name in DESIGNS:
        page = home / f"{name}.html"
        text = page.read_text("utf-8")
        assert 50_000 < page.stat().st_size < MOST == 5_000_000
        assert is_ours(page)
        assert "default-src 'none'" in text
        own = text.replace(re.search(r'id="data">(.*?)</script>', text, re.S)[1], "")
        assert not re.findall(r"(?:src|href)\s*=|@import|url\(|https?:|fetch\(|XMLHttpRequest|import\(", own)


def test_a_hostile_name_is_text(home, tmp_path):
    lens, name = load(home / "plane.caustic"), "</title></script><script>alert(1)</script><img src=x onerror=alert(2)>@@data@@"
    pages = []
    for title in ("lens", name):
        path = tmp_path / "page.html"
        write_page(
            path,
            lens.scene,
            lens.field,
            lens.heights,
            lens.target,
            title=title,
            rows=[(title, title)],
            notes=[title],
            encoding=title,
        )
        pages.append(path.read_text("utf-8"))
    plain, hostile = (len(re.findall(r"<(?:/?script|/title|img)", page)) for page in pages)
    assert plain == hostile > 4
    held = json.loads(re.search(r'id="data">(.*?)</script>', pages[1], re.S)[1])
    assert held["title"] == held["encoding"] == name


def test_codes_are_the_values_to_half_a_step():
    values = np.random.default_rng(1).normal(size=(7, 5)).cumsum(0)
    coded = _coded(values)
    data = np.frombuffer(zlib.decompress(base64.b64decode(coded["data"])), dtype=np.uint8).astype(int)
    steps = (data[:35] + 256 * data[35:]).reshape(7, 5)
    codes = np.cumsum(np.cumsum(steps, axis=0), axis=1) % 65536
    assert np.abs(coded["low"] + coded["step"] * codes - values).max() <= 0.501 * coded["step"]


def test_a_fine_screen_is_averaged_down():
    image = np.random.default_rng(2).random((90, 60))
    coarse = _onto(image, Screen((3.0, 2.0), resolution=(40, 30)))
    assert coarse.shape == (40, 30) and coarse.sum() == pytest.approx(image.sum())
    assert _onto(image, Screen((3.0, 2.0), resolution=(30, 20))) == pytest.approx(image.reshape(30, 3, 20, 3).sum((1, 3)))


def test_the_same_again_is_no_work_and_others_files_stay(home, monkeypatch, capfd):
    monkeypatch.chdir(home)
    before = (home / "plane.html").stat().st_ino
    assert cli.run(["render", "plane.caustic", "--rays", "1e5", *RAYS, "--html", "plane.html"]) == 0
    assert "nothing to do" in capfd.readouterr().err and (home / "plane.html").stat().st_ino == before
    (home / "mine.html").write_text("<p>mine</p>")
    assert cli.run(["render", "plane.caustic", "--rays", "1e5", *RAYS, "--html", "mine.html"]) == 2
    assert "was not made by caustic" in capfd.readouterr().err and (home / "mine.html").read_text() == "<p>mine</p>"


def test_light_with_a_spectrum_is_in_colour(tmp_path, monkeypatch):
    """Every index has its colour, and all together are the white of the source; the wave image is that of wave.png."""
    monkeypatch.chdir(tmp_path)
    write_blob()
    given = ["--resolution", "32", "--control", "19", "--iterations", "1", "--waves", "off", "--threads", "1", "--quiet"]
    lamp = ["--spectrum", "led-3000", "--glass", "N-SF11", "--lens-size", "2", "--throw", "60", "--mag", "2"]
    assert cli.run(["design", "blob.png", *given, *lamp, "-o", "lamp"]) == 0
    command = ["render", "lamp", "--rays", "1e4", "--html", "lamp.html", "--npy", "lamp.npy", "--quiet"]
    assert cli.run([*command, "--effects", "dispersion,diffraction"]) == 0
    held = json.loads(re.search(r'id="data">(.*?)</script>', Path("lamp.html").read_text("utf-8"), re.S)[1])
    (light,) = held["lights"]
    indices, parts, colours = zip(*light["indices"], strict=True)
    assert len(set(indices)) == 5 and sum(parts) == pytest.approx(1.0)
    assert np.array(parts) @ np.array(colours) == pytest.approx((1.0, 1.0, 1.0), abs=1e-6)
    assert colours[0][2] > max(colours[0][:2]) and colours[-1][0] > max(colours[-1][1:])  # blue, ..., red
    planes = [part["low"] + part["step"] * unpacked(part) for part in held["wavesColour"]]
    scene = load("lamp").scene
    wanted = np.tensordot(rgb_matrix(scene.white), np.load("lamp-wave.npy"), 1)
    np.testing.assert_allclose(planes, wanted, rtol=0, atol=2e-5 * np.abs(wanted).max())


def unpacked(part: dict) -> np.ndarray:
    """The 16-bit codes of a grid of the page."""
    count = math.prod(part["shape"])
    data = np.frombuffer(zlib.decompress(base64.b64decode(part["data"])), np.uint8).astype(np.int64)
    steps = (data[:count] + 256 * data[count:]).reshape(part["shape"])
    return np.cumsum(np.cumsum(steps, 0), 1) & 65535


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's functions")
def test_the_page_keeps_colours_in_the_gamut_as_images_do():
    script = (Path(cli.__file__).parent / "export/page/page.js").read_text("utf-8")
    needed = [
        re.search(pattern, script, re.S | re.M)[0]
        for pattern in (r"^const LUMINANCE.*?;", r"^const clamped.*?;$", r"^function intoGamut.*?^}")
    ]
    colours = np.random.default_rng(0).uniform(-0.5, 2.0, (200, 3))
    program = "\n".join([*needed, f"console.log(JSON.stringify({colours.tolist()}.map(intoGamut)))"])
    found = json.loads(subprocess.run(["node", "-e", program], capture_output=True, text=True, check=True).stdout)
    np.testing.assert_allclose(found, _into_gamut(colours), rtol=0, atol=1e-6)


#: A page traced by Node.js, without its document: the image of a setting, float64 [i, j], in base64.
RUN = """
const document = { getElementById: (id) => ({ textContent: id === "data" ? DATA : "" }) };
SCRIPT
(async () => {
  const { cloud } = await unpacked(), beams = beamsOf(SETTING), steps = tracedHere(cloud, beams, SETTING.z, thinning(beams.length));
  for (let step = steps.next(); ; step = steps.next()) if (step.done) {
    console.log(Buffer.from(step.value.buffer).toString("base64"));
    break;
  }
})();
"""


def by_node(page: Path, z: float, lean: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """The image that the page's functions trace with the screen at z, (n_x, n_y)."""
    text = page.read_text("utf-8")
    data = re.search(r'id="data">(.*?)</script>', text, re.S)[1]
    script = re.search(r'("use strict";.*?)\nstart\(\)', text, re.S)[1]
    setting = json.dumps({"z": z, "leanX": lean[0], "leanY": lean[1], "size": None})
    program = RUN.replace("DATA", json.dumps(data)).replace("SETTING", setting).replace("SCRIPT", script)
    found = subprocess.run(["node"], input=program, capture_output=True, text=True, check=True).stdout
    return np.frombuffer(base64.b64decode(found), float).reshape(json.loads(data)["screen"]["resolution"])


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's functions")
@pytest.mark.parametrize(
    ("source", "mirror"),
    [
        (PlaneWave(tilt=(30.0, -25.0)), False),
        (PlaneWave(tilt=(0.0, 45.0)), True),
        (Disc(angle=5.0, tilt=(0.0, -60.0)), False),
        (Disc(angle=40.0, tilt=(30.0, 15.0)), False),  # of which the aperture receives unequal parts
    ],
)
def test_light_at_an_angle_is_traced_as_render_does(source, mirror, tmp_path):
    """On a screen square to it, and on one that moves along it, as the page's throw does."""
    lit = replace(at_angle(source.tilt, wide=30.0 if source.half_angle < 0.1 else 90.0, mirror=mirror), source=source)
    field, z = HeightField.of(lit.lens), heights(0.01)
    write_page(tmp_path / "page.html", lit, field, z)
    for way in (1.0,) if source.extended else (1.0, 0.8):
        x, y = (way * c for c in lit.screen.shift)
        there = replace(lit, screen=replace(lit.screen, z=way * lit.screen.z, shift=(x, y)))
        wanted = expose(there, field, z, rays_of(there, "stratified", 2_000_000)).image.numpy()
        found = by_node(tmp_path / "page.html", there.screen.z)
        assert found.sum() == pytest.approx(wanted.sum(), rel=0.01)
        assert relative_rms(found, wanted) < 1.3 * ALIKE < relative_rms(found, wanted[::-1])


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's functions")
def test_light_leans_from_its_own_direction(tmp_path):
    lit = at_angle((30.0, 0.0), wide=30.0)
    field, z = HeightField.of(lit.lens), heights(0.01)
    write_page(tmp_path / "page.html", lit, field, z)
    leaning = replace(lit, source=PlaneWave(tilt=(26.0, 0.0)))
    wanted = expose(leaning, field, z, rays_of(leaning, "stratified", 1_000_000)).image.numpy()
    found = by_node(tmp_path / "page.html", lit.screen.z, (0.0, 4.0))
    assert relative_rms(found, wanted) < ALIKE < relative_rms(found, by_node(tmp_path / "page.html", lit.screen.z))


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's functions")
@pytest.mark.parametrize(("wide", "most"), [(1.5, 0.5), (4.0, 0.25)])
def test_a_disc_in_focus_is_even(wide, most, tmp_path, monkeypatch):
    """A lens that images an even disc onto the screen, `wide` pixels across: the hardest of all pictures for a few points of it.

    2,000 points leave 0.005 and 0.03."""
    monkeypatch.setattr(pages, "CELLS", (256,))
    away, thickness, throw, pixels, n = 40.0, 1.0, 161.0, 12, 1.5
    apparent = away + thickness / n
    radius = (n - 1.0) / (1.0 / apparent + 1.0 / (throw - thickness))  # of a thin lens, paraxially
    size = wide * apparent / (throw - thickness)
    lens = Lens((1.0, 1.0), index=n, control=(12, 12), offset=Offset(thickness, (-radius, -radius)), fresnel="none")
    lit = Scene(Disc((0.0, 0.0, -away), (size, size), cone=3.0), lens, Screen((pixels, pixels), throw, (pixels, pixels)))
    field = HeightField.of(lens)
    z = torch.from_numpy(lens.offset.heights(*(c.numpy() for c in field.control_xy())))
    write_page(tmp_path / "page.html", lit, field, z)
    found = by_node(tmp_path / "page.html", throw)
    at = (np.arange(100 * pixels) + 0.5) / 100.0 - 0.5 * pixels
    disc = (np.hypot(at[:, None], at[None, :]) < 0.5 * wide).reshape(pixels, 100, pixels, 100).mean((1, 3))
    assert relative_rms(found, disc * found.sum() / disc.sum()) < most


def hollow(rough: float = 0.004) -> FreeForm:
    """An entrance on which every axis, sign and size matters: a tilted, astigmatic bowl with a relief."""
    x, y = (np.linspace(-1.0, 1.0, n) for n in (11, 10))
    bowl = 0.25 * x[:, None] ** 2 - 0.15 * y[None, :] ** 2 + 0.08 * x[:, None] - 0.05 * y[None, :]
    return FreeForm(bowl + rough * np.random.default_rng(3).standard_normal(bowl.shape), (3, 3))


SPREAD, NEAR = PlaneWave(tilt=(20.0, -12.0)), Points(((1.0, -2.0, -40.0),))
SQUARE = at_angle((0.0, 0.0))
FRONTED = replace(SQUARE, lens=replace(SQUARE.lens, entrance=hollow(), fresnel="exact", absorption=0.02))
ASLANT = at_angle(SPREAD.tilt, wide=44.0)
FAR = Screen((120.0, 96.0), 1000.0, (40, 32), far=True)
ASIDE = replace(FAR, tilt=(5.0, 3.0, 20.0), shift=(-60.0, -100.0))
BENT = replace(SQUARE.screen, size=(36.0, 33.0), shift=(1.0, -2.0), tilt=(12.0, -8.0))
WAVY = 1.5 * np.sin(np.linspace(-3.0, 2.0, 33))[:, None] * np.cos(np.linspace(-1.0, 3.0, 29))
UNEVEN = 0.2 + np.add.outer(np.arange(7.0) ** 2 / 36.0, np.arange(5.0) / 4.0)
PHASE = np.add.outer(30.0 * np.linspace(-1.0, 1.0, 60) ** 2, 12.0 * np.linspace(-1.0, 1.0, 50) ** 3)
MIRROR, ONE = replace(SQUARE.lens, mirror=True), (((), ()), ((), ()))
#: Scenes, and each with one of its parts left out or wrong, whose image is another.
BEYOND = {
    "free-form entrance": (FRONTED, replace(FRONTED, lens=replace(FRONTED.lens, entrance=None))),
    "free-form entrance, at an angle": (
        replace(ASLANT, lens=replace(ASLANT.lens, entrance=hollow())),
        replace(ASLANT, lens=replace(ASLANT.lens, entrance=hollow(0.0))),
    ),
    "free-form entrance, source nearby": (replace(FRONTED, source=NEAR), replace(FRONTED, source=Points(((-1.0, -2.0, -40.0),)))),
    "free-form entrance, round": (
        replace(FRONTED, lens=replace(FRONTED.lens, size=(10.0, 10.0), aperture="circle")),
        replace(FRONTED, lens=replace(FRONTED.lens, size=(10.0, 10.0))),
    ),
    "far field": (replace(SQUARE, screen=FAR), replace(SQUARE, screen=replace(FAR, far=False))),
    "far field, turned and at an angle": (
        replace(SQUARE, source=PlaneWave(tilt=(6.0, -4.0)), screen=ASIDE),
        replace(SQUARE, source=PlaneWave(tilt=(6.0, -4.0)), screen=replace(ASIDE, tilt=(5.0, 3.0))),
    ),
    "far field of both sides, source nearby": (
        replace(FRONTED, source=NEAR, screen=replace(FAR, size=(500.0, 400.0))),
        replace(FRONTED, source=Points(((1.0, -2.0, -50.0),)), screen=replace(FAR, size=(500.0, 400.0))),
    ),
    "far field, mirror": (
        replace(SQUARE, lens=replace(SQUARE.lens, mirror=True), screen=replace(FAR, z=-1000.0)),
        replace(SQUARE, lens=replace(SQUARE.lens, mirror=True), screen=replace(FAR, z=-1000.0, far=False)),
    ),
    "sphere": (replace(SQUARE, screen=replace(BENT, radius=(40.0, 40.0))), replace(SQUARE, screen=BENT)),
    "dome": (replace(SQUARE, source=NEAR, screen=replace(BENT, radius=(-30.0, -30.0))), replace(SQUARE, source=NEAR, screen=BENT)),
    "cylinder": (
        replace(SQUARE, screen=replace(BENT, radius=(25.0, math.inf))),
        replace(SQUARE, screen=replace(BENT, radius=(math.inf, 25.0))),
    ),
    "measured shape": (
        replace(SQUARE, screen=replace(BENT, sags=Sags(WAVY, BENT.size))),
        replace(SQUARE, screen=replace(BENT, sags=Sags(WAVY[::-1].copy(), BENT.size))),
    ),
    "laser beam": (
        replace(SQUARE, source=Gaussian((3.0, 5.0), 633.0, tilt=(4.0, -3.0))),
        replace(SQUARE, source=PlaneWave(tilt=(4.0, -3.0))),
    ),
    "laser beam with a curved wavefront, far field of both sides": (
        replace(FRONTED, source=Gaussian((0.02, 0.03), 633.0, waist_at=-250.0), screen=replace(FAR, size=(240.0, 200.0))),
        replace(FRONTED, source=Gaussian((3.0, 3.0), 633.0), screen=replace(FAR, size=(240.0, 200.0))),
    ),
    "measured beam, mirror": (
        replace(SQUARE, source=MeasuredBeam(PHASE, 10600.0, UNEVEN), lens=MIRROR, screen=replace(SQUARE.screen, z=-60.0)),
        replace(SQUARE, source=PlaneWave(), lens=MIRROR, screen=replace(SQUARE.screen, z=-60.0)),
    ),
    "plane waves, each with a profile": (
        replace(SQUARE, source=Several((PlaneWave(profile=UNEVEN), PlaneWave(tilt=(6.0, 0.0), profile=UNEVEN[::-1].copy())), ONE)),
        replace(SQUARE, source=Several((PlaneWave(), PlaneWave(tilt=(6.0, 0.0))), ONE)),
    ),
}


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's functions")
@pytest.mark.parametrize("name", BEYOND)
def test_whatever_a_scene_has_is_traced_as_render_does(name, tmp_path):
    """The image is that of `expose`, not one that is mirrored, a pixel aside or of a scene that differs in one thing."""
    scene, other = BEYOND[name]
    field, z = HeightField.of(scene.lens), heights(0.02 if scene.screen.far else 0.01)
    write_page(tmp_path / "page.html", scene, field, z)
    wanted, wrong = (expose(s, field, z, rays_of(s, "stratified", 300_000)).image.numpy() for s in (scene, other))
    found = by_node(tmp_path / "page.html", scene.screen.z)
    assert wanted.sum() > 0.2 and found.sum() == pytest.approx(wanted.sum(), rel=0.005)
    assert relative_rms(found, wanted) < ALIKE / 2
    for another in (wrong, wanted[::-1], wanted[:, ::-1], np.roll(wanted, 1, 0), np.roll(wanted, 1, 1)):
        assert relative_rms(another, wanted) > 2 * ALIKE


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
@pytest.mark.parametrize(
    "name", ["free-form entrance, at an angle", "far field of both sides, source nearby", "dome", "measured beam, mirror"]
)
def test_the_graphics_processor_traces_them_as_the_processor_does(name, tmp_path):
    scene, _ = BEYOND[name]
    field, z, page = HeightField.of(scene.lens), heights(0.01), tmp_path / "page.html"
    wanted = expose(scene, field, z, rays_of(scene, "stratified", 300_000)).image.numpy()
    write_page(page, scene, field, z, wanted)
    (image, said), document = traced(page, "", "gpu", tmp_path / "profile"), browsed(page, "", "cpu", tmp_path / "profile")
    assert relative_rms(image.reshape(wanted.shape), wanted) < ALIKE / 2 and said < ALIKE / 2
    assert bool(re.search(r'id="throw-control"[^>]* hidden', document)) == scene.screen.far


def test_sources_of_which_one_has_no_colour_are_shown_in_grey():
    """One lamp is seen by the eye, the other measured by its power: neither is coloured on the page."""
    tables = [{"type": "plane", "power": 1.0, "spectrum": "halogen", "detector": d} for d in ("eye", "power")]
    lens = Lens((2.0, 2.0), control=(9, 9), glass="N-SF11", index=1.7847)
    source = together((PlaneWave(1.0), PlaneWave(1.0)), [light_of_all(one) for one in tables])
    scene = Scene(source, lens, Screen((12.0, 12.0), 60.0, (24, 24)), light_of_all(tables[0] | {"also": tables[1:]}))
    assert scene.white is None and any(band.colour for band in scene.bands)
    assert all(colour is None for light in _lights(scene, {}) for _, _, colour in light["indices"])


#: Control points of a net of 2 x 2 lenslets like that of one.
ARRAYED = tuple(2 * n - 1 for n in SQUARE.lens.control)
#: Scenes whose light the page holds, each with one that differs in what makes it so.
BEHIND = replace(SQUARE, elements=(Component(12.0, (30.0, 30.0), 6.0, (120.0, -150.0), 1.6),))
WEAK = replace(SQUARE, elements=(Component(12.0, (30.0, 30.0), 6.0, (900.0, -900.0), 1.6),))
HELD = {
    "a lens behind": (BEHIND, SQUARE),
    "a lens behind, source nearby": (replace(BEHIND, source=NEAR), replace(SQUARE, source=NEAR)),
    "a lens before a mirror": (
        replace(BEHIND, elements=(*BEHIND.elements, FoldMirror(48.0, (60.0, 60.0), tilt=(45.0, 0.0)))),
        replace(SQUARE, elements=(FoldMirror(48.0, (60.0, 60.0), tilt=(45.0, 0.0)),)),
    ),
    "the sun and a lens behind": (replace(WEAK, source=Disc(angle=3.0)), replace(SQUARE, source=Disc(angle=9.0))),
    "a gradient index": (
        replace(SQUARE, lens=replace(SQUARE.lens, gradient=Gradient("radial", (2e-3,)))),
        replace(SQUARE, lens=replace(SQUARE.lens, gradient=Gradient("radial", (-2e-3,)))),
    ),
    "round lenslets": (
        replace(SQUARE, lens=replace(SQUARE.lens, array=(2, 2), control=ARRAYED, lenslets="round")),
        replace(SQUARE, lens=replace(SQUARE.lens, array=(2, 2), control=ARRAYED)),
    ),
}


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's functions")
@pytest.mark.parametrize("name", HELD)
def test_light_that_the_page_holds_lands_as_render_says(name, tmp_path):
    """On the screen, and on one that is farther away."""
    scene, other = HELD[name]
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    z = 5.0 + 0.02 * torch.sin(0.9 * x)[:, None] * torch.cos(0.7 * y + 0.3) - 0.002 * (x[:, None] ** 2 + y**2)
    write_page(tmp_path / "page.html", scene, field, z)
    assert (tmp_path / "page.html").stat().st_size < MOST
    rays = 1_600_000 if scene.source.half_angle else 400_000
    for farther in (0.0, 20.0):
        there = replace(scene, screen=replace(scene.screen, z=scene.screen.z + farther))
        wanted = expose(there, field, z, rays_of(there, "stratified", rays)).image.numpy()
        found = by_node(tmp_path / "page.html", there.screen.z)
        assert wanted.sum() > 0.2 and found.sum() == pytest.approx(wanted.sum(), rel=0.01)
        assert relative_rms(found, wanted) < ALIKE
    wrong = expose(other, field, z, rays_of(other, "stratified", 400_000)).image.numpy()
    assert relative_rms(wrong, wanted) > 2 * ALIKE
