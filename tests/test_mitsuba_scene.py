"""Scenes for Mitsuba beyond a clear lens: their files, and the shapes and pictures in them, by closed forms.

What Mitsuba makes of them is tested in test_verify.py, where it is installed.
"""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from test_verify import ALONE, BEYOND, FAR, LED, TABLE, UNEVEN, dispersing, lit_by, of_lens, on_screen, scene_with

from caustic_cli.errors import InputError
from caustic_cli.export.mitsuba import companions, write_mitsuba
from caustic_cli.export.mitsuba_screen import far_away
from caustic_cli.export.supported import EXPORT
from caustic_cli.optics.screen_shape import points_in_space
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Disc, PlaneWave, Points
from caustic_cli.scene.sources.several import Several

SCENES = {
    **{name: BEYOND[name] for name in ("sphere", "leaning sphere", "leaning far field", "several sources")},
    "wavelengths": dispersing,
    "profile": lit_by(PlaneWave(profile=UNEVEN)),
    "table": lit_by(Points(((0.0, 0.0, -20.0),), intensity=TABLE)),
    "picture of a disc": lit_by(Disc((0.0, 0.0, -60.0), brightness=UNEVEN)),
}


def written(tmp_path, how):
    scene, field, heights = scene_with(PlaneWave())
    scene = how(scene)
    write_mitsuba(tmp_path / "a.xml", scene, field, heights, (9, 9))
    return scene


def mesh(path):
    """Vertices (V, 3) and triangles (F, 3) of a PLY file of this program."""
    head, _, data = path.read_bytes().partition(b"end_header\n")
    words = head.decode().split("\n")
    count, faces = (int(next(w for w in words if w.startswith(f"element {name}")).split()[2]) for name in ("vertex", "face"))
    columns = sum(w.startswith("property double") for w in words)
    vertices = np.frombuffer(data, "<f8", count * columns).reshape(count, columns)[:, :3]
    triangles = np.frombuffer(data[8 * count * columns :], np.dtype([("n", "u1"), ("c", "<i4", 3)]), faces)
    return vertices, triangles["c"]


def float_map(path):
    """Rows of a portable float map, as they stand in it."""
    kind, size, order, data = path.read_bytes().split(b"\n", 3)
    assert kind == b"Pf" and float(order) < 0
    width, height = map(int, size.split())
    return np.frombuffer(data, "<f4").reshape(height, width)


@pytest.mark.parametrize("name", SCENES)
def test_its_files_are_those_that_are_announced(name, tmp_path):
    scene = written(tmp_path, SCENES[name])
    assert {*tmp_path.iterdir()} == {tmp_path / "a.xml", *companions(tmp_path / "a.xml", scene)}
    for file in tmp_path.glob("*.xml"):
        text = file.read_text()
        assert all((tmp_path / part.split('"')[0]).is_file() for part in text.split('"filename" value="')[1:])


@pytest.mark.parametrize("name", ["sphere", "leaning sphere"])
def test_a_curved_screen_is_where_it_is(name, tmp_path):
    scene = written(tmp_path, SCENES[name])
    points = mesh(tmp_path / "a-screen.ply")[0]
    n = math.isqrt(len(points))
    x, y = np.meshgrid(*(np.linspace(-h, h, n) for h in scene.screen.half_size), indexing="ij")
    assert points == pytest.approx(np.stack(points_in_space(scene.screen, x, y), -1).reshape(-1, 3), abs=1e-9)


@pytest.mark.parametrize("more", [{}, {"tilt": (2.0, -3.0), "shift": (8.0, 5.0)}])
def test_the_far_field_is_a_sphere_of_directions(more, tmp_path):
    """Direction cosines of its points along the axes of the screen are the pixels' places over F."""
    scene = written(tmp_path, on_screen(**FAR, **more))
    points = mesh(tmp_path / "a-screen.ply")[0]
    away = np.linalg.norm(points, axis=1)
    assert away == pytest.approx(far_away(scene), rel=1e-12)
    assert scene.lens.opening.reach / away[0] * 1000.0 < 2e-3 * min(scene.screen.pixel)
    q = points @ np.array(scene.screen.axes[:2]).T / away[:, None] * scene.screen.z
    for k, half in enumerate(scene.screen.half_size):
        middle = float(np.dot(scene.screen.centre, scene.screen.axes[k]))
        assert (q[:, k].min(), q[:, k].max()) == pytest.approx((middle - half, middle + half), abs=1e-6)
    assert (points[:, 2] > 0).all()


@pytest.mark.parametrize("packing", ["square", "hexagonal"])
def test_the_mask_of_round_lenslets_covers_what_is_between_them(packing, tmp_path):
    """All of the array but the circles, and nothing of these."""
    scene, _, _ = scene_with(PlaneWave())
    lens = replace(scene.lens, array=(3, 2), control=(28, 19), lenslets="round", packing=packing)
    scene, field = replace(scene, lens=lens), HeightField.of(lens)
    x, y = field.control_xy()
    heights = 5.0 + 0.01 * (x[:, None] + y[None, :] ** 2)
    write_mitsuba(tmp_path / "a.xml", scene, field, heights, (9, 9))
    assert tmp_path / "a-mask.ply" in companions(tmp_path / "a.xml", scene)
    vertices, faces = mesh(tmp_path / "a-mask.ply")
    (ax, ay), (bx, by), (cx, cy) = (vertices[faces[:, k], :2].T for k in range(3))
    areas = 0.5 * np.abs((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
    circles = math.prod(lens.array) * math.pi * lens.cells.radius**2
    assert areas.sum() == pytest.approx(math.prod(lens.size) - circles, rel=2e-4)
    assert (lens.clear.margin(*vertices[:, :2].T) < 2e-3 * lens.cells.radius).all()
    above = vertices[:, 2] - 5.0 - 0.01 * (vertices[:, 0] + vertices[:, 1] ** 2)
    assert (above > 0.0).all() and np.ptp(above) < 0.01


def test_pictures_hold_the_power_of_their_light(tmp_path):
    """Irradiance times area, rows from +y down; intensity over solid angles; and radiance of a disc over area and cone."""
    scene = written(tmp_path, lit_by(PlaneWave(2.0, UNEVEN)))
    light = float_map(tmp_path / "a-light.pfm")
    assert light == pytest.approx(light.mean() * UNEVEN.T[::-1] / UNEVEN.mean(), rel=1e-6)
    assert light.mean() * scene.pupil.aperture.area == pytest.approx(2.0, rel=1e-6)
    scene = written(tmp_path, lit_by(Disc((0.0, 0.0, -60.0), (4.0, 3.0), 2.0, brightness=UNEVEN)))
    light = float_map(tmp_path / "a-light.pfm")
    cone = math.sin(scene.source.cone_over(scene.pupil)) ** 2
    assert light.mean() * 12.0 * math.pi * cone == pytest.approx(2.0, rel=1e-6)
    scene = written(tmp_path, lit_by(Points(((0.0, 0.0, -20.0),), (2.0,), intensity=TABLE)))
    light, cone = float_map(tmp_path / "a-light.pfm"), scene.source.cone_over(scene.pupil)
    t = np.linspace(-1.0, 1.0, 2 * len(light) + 1)[1::2] * math.tan(cone * (1.0 + 1e-4))
    angle = np.arctan(np.hypot(t[:, None], t[None, :]))
    wanted = np.interp(np.degrees(angle), TABLE.angles, TABLE.values)
    assert light / light.max() == pytest.approx(wanted / wanted.max(), abs=1e-3)
    solid = (t[1] - t[0]) ** 2 * np.cos(angle) ** 3 * (angle <= cone)
    intensity = float((tmp_path / "a.xml").read_text().split('name="intensity" value="')[1].split('"')[0])
    assert (solid * light).sum() * intensity == pytest.approx(2.0, rel=1e-3)


@pytest.mark.parametrize("light", [None, UNEVEN])
def test_a_disc_that_is_not_lambertian_is_points_of_its_extent(light, tmp_path):
    """Its power, centroid and variances: of an ellipse a^2 / 4 and b^2 / 4, or of the cells of a picture."""
    scene = written(tmp_path, lit_by(Disc((1.0, -2.0, -60.0), (4.0, 2.0), 3.0, intensity="uniform", brightness=light)))
    text, cone = (tmp_path / "a.xml").read_text(), scene.source.cone_over(scene.pupil)
    places = re.findall(r'<translate x="([^"]+)" y="([^"]+)" z="-60"/></transform>\n  <rgb', text)
    at = np.array([[float(v) for v in place] for place in places])
    power = np.array([float(v) for v in re.findall(r'name="intensity" value="([^"]+)"', text)])
    power *= 4.0 * math.pi * math.sin(cone / 2.0) ** 2
    assert power.sum() == pytest.approx(3.0)
    cells = np.array([[1.0]]) if light is None else light
    for k, (half, place) in enumerate(((2.0, 1.0), (1.0, -2.0))):
        n, rows = cells.shape[k], cells.sum(1 - k) / cells.sum()
        middles = half * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
        mean = (rows * middles).sum()
        wanted = half**2 / 4.0 if light is None else (rows * ((middles - mean) ** 2 + (half / n) ** 2 / 3.0)).sum()
        found = (power * at[:, k]).sum() / 3.0
        assert found == pytest.approx(place + mean, abs=0.02 * half)
        assert (power * (at[:, k] - found) ** 2).sum() / 3.0 == pytest.approx(wanted, rel=0.03)


def test_the_scenes_of_several_sources_have_their_powers(tmp_path):
    """Each its own, however they are weighted against each other."""
    source = Several((PlaneWave(3.0), PlaneWave(2.0, tilt=(2.0, 0.0))), (ALONE,) * 2)
    scene = written(tmp_path, lit_by(source))
    for file, member in zip(("a.xml", "a-2.xml"), source.members, strict=True):
        radiance = float((tmp_path / file).read_text().split('name="radiance" value="')[1].split('"')[0])
        assert radiance * scene.pupil.aperture.area * member.axis[2] == pytest.approx(member.power, rel=1e-9)


def test_a_source_without_an_emitter_among_several_is_refused(tmp_path):
    with pytest.raises(InputError, match="disc"):
        written(tmp_path, lit_by(Several((LED, Disc(angle=0.5)), (ALONE,) * 2)))
    assert not any(tmp_path.iterdir())


def test_what_mitsuba_cannot_say_is_refused():
    assert not EXPORT["mitsuba"].supports(of_lens(absorption=0.1)(scene_with(PlaneWave())[0]))
