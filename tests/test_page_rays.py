"""The rays of a file on the interactive page: the page shows the source from which they were drawn, with the noise that it says."""

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from rayfiles import cone_of, tm25
from test_direction import heights
from test_page import BEHIND, BROWSER, FRONTED, MIRROR, SQUARE, by_node, traced

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export import page
from caustic_cli.export.page import MOST, write_page
from caustic_cli.export.page.light_field import FINE, NOISE, grouped, light_field
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Disc, PlaneWave
from caustic_cli.scene.screen import Screen
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies.metrics import relative_rms

PLACE, CONE = (1.0, -2.0, -40.0), 20.0
#: A chip from which rays are drawn, and the same as a source of its own.
CHIP = Disc(PLACE, (1.0, 1.0), cone=CONE)
NODE = pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js to run the page's functions")


@pytest.fixture(autouse=True)
def few_cells(monkeypatch):
    """As many as pictures of these few pixels need."""
    monkeypatch.setattr(page, "CELLS", (256,))
    monkeypatch.setattr(page, "FEWER", (128,))


def drawn(count: int, seed: int = 1, size: float = 1.0) -> Measured:
    """Rays of CHIP, or of one of another size, as a file has them."""
    return Measured(RaySet(*cone_of(count, CONE, (size, size), seed, lambertian=True)), PLACE)


def through(count: int, towards: float, width: float, seed: int = 1) -> Measured:
    """Rays even over a rectangle about the pupil that go to, or come from, an even disc of a width in the plane z = towards."""
    rng, (rx, ry), z = np.random.default_rng(seed), SQUARE.lens.half_size, SQUARE.lens.pupil.z
    x, y, a, phi = rng.random((4, count)) * np.array([2.0, 2.0, 1.0, 2.0 * np.pi])[:, None]
    x, y, r = 1.1 * rx * (x - 1.0), 1.1 * ry * (y - 1.0), 0.5 * width * np.sqrt(a)
    way = math.copysign(1.0, towards - z) * np.stack([r * np.cos(phi) - x, r * np.sin(phi) - y, np.full(count, towards - z)], 1)
    way /= np.linalg.norm(way, axis=1)[:, None]
    return Measured(RaySet(np.stack([x, y, np.full(count, z)], 1) - 20.0 * way, way, np.ones(count)), (0.0, 0.0, 0.0))


def image(scene, z, rays: int = 300_000, seed: int = 0) -> np.ndarray:
    return expose(scene, HeightField.of(scene.lens), z, rays_of(scene, "stratified", rays, seed)).image.numpy()


def paged(path: Path, scene, z) -> np.ndarray:
    write_page(path, scene, HeightField.of(scene.lens), z)
    assert path.stat().st_size < MOST
    return by_node(path, scene.screen.z)


ROUND = replace(SQUARE, lens=replace(SQUARE.lens, size=(10.0, 10.0), aperture="circle", fresnel="exact"))
SCENES = {
    "a lens": SQUARE,
    "a round lens": ROUND,
    "both sides": FRONTED,
    "a mirror": replace(SQUARE, lens=MIRROR, screen=replace(SQUARE.screen, z=-60.0)),
    "the far field": replace(SQUARE, screen=Screen((500.0, 400.0), 1000.0, (40, 32), far=True)),
    "a lens behind": BEHIND,
}


@NODE
@pytest.mark.parametrize("name", SCENES)
def test_the_page_shows_the_source_of_the_rays(name, tmp_path):
    """Not what the rays themselves would show, nor a picture that is mirrored, a pixel aside or of another source."""
    scene, z = SCENES[name], heights(0.01)
    file = replace(scene, source=drawn(200_000))
    wanted, found = image(replace(scene, source=CHIP), z), paged(tmp_path / "page.html", file, z)
    lit, again = (wanted > 0.2 * wanted.mean()).mean(), image(replace(scene, source=CHIP), z, seed=9)
    noise = math.hypot(light_field(file).noise / math.sqrt(lit), relative_rms(again, wanted))
    assert wanted.sum() > 0.1 and found.sum() == pytest.approx(wanted.sum(), rel=0.02)
    assert relative_rms(found, wanted) < 1.5 * noise < 0.15
    other = image(replace(scene, source=replace(CHIP, position=(-1.0, -2.0, -40.0))), z)
    for another in (image(file, z, 200_000), other, found[::-1], found[:, ::-1], np.roll(found, 1, 0), np.roll(found, 1, 1)):
        assert relative_rms(another, wanted) > 2.0 * relative_rms(found, wanted)


@NODE
def test_the_noise_of_the_picture_is_what_the_page_says(tmp_path):
    """By pages of eight files of one source."""
    z, pages, said = heights(0.01), [], 0.0
    for seed in range(8):
        file = replace(SQUARE, source=drawn(60_000, seed))
        pages.append(paged(tmp_path / "page.html", file, z))
        said = light_field(file).noise
    mean = np.mean(pages, 0)
    lit = mean > 0.3 * mean.mean()
    measured = math.sqrt(float(np.mean((np.std(pages, 0, ddof=1)[lit] / mean[lit]) ** 2)))
    assert measured == pytest.approx(said, rel=0.3)
    assert f"{said:.1%} of noise" in (tmp_path / "page.html").read_text("utf-8")


@NODE
@pytest.mark.parametrize("towards, width", [(-40.0, 1.5), (15.0, 1.0), (-1e7, 2e5)])
def test_light_that_spreads_converges_or_is_nearly_parallel(towards, width, tmp_path):
    """By a render of forty times as many rays."""
    z, scene = heights(0.01), replace(SQUARE, screen=replace(SQUARE.screen, z=50.0, size=(30.0, 30.0), resolution=(24, 24)))
    file = replace(scene, source=through(100_000, towards, width))
    found = paged(tmp_path / "page.html", file, z)
    wanted = image(replace(scene, source=through(4_000_000, towards, width, 2)), z, 10**7)
    lit = (wanted > 0.2 * wanted.mean()).mean()
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.015)
    assert relative_rms(found, wanted) < 0.06 / math.sqrt(lit)
    for another in (found[::-1], np.roll(found, 1, 0), np.roll(found, 1, 1)):
        assert relative_rms(another, wanted) > 2.0 * relative_rms(found, wanted)


@NODE
def test_a_file_among_several_sources(tmp_path):
    z, none = heights(0.01), ((), ())
    wave = PlaneWave(2.0, tilt=(5.0, 0.0))
    several = [replace(SQUARE, source=Several((wave, one), (none, none))) for one in (drawn(200_000), CHIP)]
    found, wanted = paged(tmp_path / "page.html", several[0], z), image(several[1], z)
    assert relative_rms(found, wanted) < 0.05 < relative_rms(found, image(replace(SQUARE, source=wave), z))
    held = json.loads(re.search(r'id="data">(.*?)</script>', (tmp_path / "page.html").read_text("utf-8"), re.S)[1])
    assert held["still"] and sum(light["weight"] for light in held["lights"]) < 1.0  # rays that miss the lens


def test_points_of_a_file_stand_where_its_light_is():
    """Quantisation does not move them: rays of a point have one, within a millionth of a pixel."""
    file = replace(SQUARE, source=drawn(5_000, size=0.0))
    (point,) = light_field(file).points
    assert np.abs(np.array(point.position) - PLACE).max() < 1e-6
    assert max(SQUARE.screen.pixel) > 1.0  # mm


@pytest.mark.parametrize("towards", [-40.0, 25.0])
def test_the_points_send_the_power_of_the_rays_along_their_ways(towards):
    field = light_field(replace(SQUARE, source=through(50_000, towards, 2.0)))
    u = (torch.arange(400, dtype=torch.float64) + 0.5) / 400
    u, v = (c.reshape(-1) for c in torch.meshgrid(u, u, indexing="ij"))
    (rx, ry), total = SQUARE.lens.half_size, 0.0
    for point in field.points:
        rays = point.through(u, v)
        power = float(rays.power.sum()) * 4.0 * rx * ry / 400**2
        assert power == pytest.approx(point.part, rel=0.01)
        total += power
        way = (towards - SQUARE.lens.pupil.z) / rays.direction[2]
        x, y = (o + way * d for o, d in zip(rays.origin[:2], rays.direction[:2], strict=True))
        assert float(x.std() + y.std()) < 0.05  # all to, or from, one point of the disc
        assert float(torch.hypot(x.mean(), y.mean())) < 1.0
        assert bool((rays.direction[2] > 0).all())
    assert total == pytest.approx(1.0 / 1.1**2, rel=0.01)  # of all rays, the part that meets the lens


def test_groups_are_as_fine_as_asked_for_and_as_many_as_needed():
    """n points of a line of length L in k equal parts have the standard deviation L / sqrt(12) k."""
    line = np.stack([np.linspace(0.0, 8.0, 4096), np.zeros(4096)], 1)
    groups = grouped(line, np.ones(4096), 1000, 8.0 / math.sqrt(12.0) / 16.0 * 1.001)
    assert len(groups) == 16 and {len(g) for g in groups} == {256}
    assert np.array_equal(np.sort(np.concatenate(groups)), np.arange(4096))
    assert len(grouped(line, np.ones(4096), 5, FINE)) == 5
    assert len(grouped(np.zeros((7, 2)), np.ones(7), 5, FINE)) == 1


def test_few_rays_are_averaged_over_more_of_the_lens_and_are_noisier():
    few, many = (light_field(replace(SQUARE, source=drawn(n))) for n in (1_000, 600_000))
    assert few.noise > 2.0 * NOISE and many.noise == pytest.approx(NOISE, rel=0.01) and few.sigma > many.sigma
    assert many.blur < 1.2 * FINE


def test_the_page_says_how_far_aberrations_displace_light():
    """Slopes a x^3 beside those to a point: over x in [-R, R], the root mean square derivative of what no point explains, which is
    a (x^3 - 3 R^2 x / 5), is sqrt(0.96) a R^2; a R^2 is the same along both axes, and the displacement larger along y."""
    file, (rx, ry) = through(100_000, -40.0, 0.0), SQUARE.lens.half_size
    at, way = file.rays.positions + 20.0 * file.rays.directions, file.rays.directions / file.rays.directions[:, 2:]
    bent = way + 0.02 * at**3 / np.array([rx, ry, math.inf]) ** 2
    field = light_field(replace(SQUARE, source=replace(file, rays=RaySet(at - 20.0 * bent, bent, file.rays.flux))))
    pixel = SQUARE.screen.pixel[1] / (SQUARE.screen.z - SQUARE.lens.pupil.z)  # as an angle
    displaced = 2.0 * ry * field.sigma * math.sqrt(0.96) * 0.02 / pixel
    assert 0.5 < displaced == pytest.approx(math.sqrt(field.blur**2 - FINE**2), rel=0.05)
    assert f"by about {field.blur:.1f} pixels" in field.words


def test_rays_that_miss_the_lens_are_refused(tmp_path):
    aside = replace(SQUARE, source=replace(drawn(100), position=(500.0, 0.0, -40.0)))
    with pytest.raises(InputError, match="none of its 100 rays meets the lens"):
        write_page(tmp_path / "page.html", aside, HeightField.of(SQUARE.lens), heights(0.01))


def test_a_render_by_a_ray_file_writes_a_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()
    Path("led.tm25ray").write_bytes(tm25(*cone_of(20_000, 12.0, (0.5, 0.5), lambertian=True)))
    light = ["--source", "rays", "--source-file", "led.tm25ray", "--source-position", "0,0,-60"]
    small = ["--resolution", "32", "--quality", "draft", "--iterations", "2", "--waves", "off", "--threads", "1", "--quiet"]
    assert cli.run(["design", "blob.png", *small, *light, "-o", "led.caustic"]) == 0
    assert cli.run(["render", "led.caustic", "--rays", "1e4", "--html", "led.html", "--quiet"]) == 0
    text = Path("led.html").read_text("utf-8")
    assert "The light of the ray file is held as" in text and "The screen moves on this page" in text


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
@pytest.mark.parametrize("source", [drawn(100_000), through(100_000, 15.0, 1.0)], ids=["spreading", "converging"])
def test_the_graphics_processor_shows_them_as_the_processor_does(source, tmp_path):
    scene, z = replace(SQUARE, source=source), heights(0.01)
    wanted = paged(tmp_path / "page.html", scene, z)
    write_page(tmp_path / "page.html", scene, HeightField.of(scene.lens), z, wanted)
    found, said = traced(tmp_path / "page.html", "", "gpu", tmp_path / "profile")
    assert relative_rms(found.reshape(wanted.shape), wanted) < 0.005 and said < 0.005
