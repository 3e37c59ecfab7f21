"""Exports: the archive LightTools users read and the STL solid, against SciPy, NumPy and each other."""

from __future__ import annotations

import re
import time
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, RectBivariateSpline

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.export import lighttools
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mesh import closed_mesh
from caustic_cli.export.stl import TRIANGLE, write_stl
from caustic_cli.export.surface import STEPS_PER_SPAN, sample_grid
from caustic_cli.export.zemax import write_zemax
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Component, FoldMirror, Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.gradient import Gradient

UNEVEN = (0.0, 0.0, 0.0, 0.0, 0.11, 0.2, 0.2, 0.55, 0.83, 1.0, 1.0, 1.0, 1.0)  # cubic, one double knot


def make(*, control=(20, 20), degree=(3, 3), size=(10.0, 10.0), knots=None, relief=0.02, seed=1, **source):
    """A scene and random control heights on a concave sphere."""
    lens = Lens(size=size, control=control, degree=degree, knots=knots, index=1.5443, z_in=-0.5, offset=Offset(5.0, (80.0, 80.0)))
    scene = Scene(PlaneWave(**source), lens, Screen((38.4, 30.0), 300.0, (64, 50)))
    field = HeightField.of(lens)
    x, y = field.control_xy()
    base = 5.0 + lens.offset.sag(x[:, None].numpy(), y[None, :].numpy())
    noise = torch.rand(field.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return scene, field, torch.as_tensor(base) + relief * (noise - 0.5)


CASES = {
    "square": {},
    "non-square net and aperture": {"control": (9, 17), "size": (6.0, 14.0)},
    "two degrees": {"control": (12, 7), "degree": (2, 5), "size": (12.0, 5.0)},
    "degree 10": {"control": (14, 11), "degree": (10, 10)},
    "uneven knots": {"control": (9, 9), "knots": (UNEVEN, UNEVEN)},
    "one span": {"control": (2, 4), "degree": (1, 3)},
}


@pytest.fixture(params=CASES.values(), ids=CASES.keys())
def case(request):
    return make(**request.param)


def load(path):
    """Every array of an archive, refusing pickles."""
    with np.load(path, allow_pickle=False) as archive:
        return dict(archive)


def scipy_surface(data, x, y, dx=0, dy=0):
    """z and its derivatives at all (x, y) from the archive's control points, knots and degrees alone, by SciPy."""
    rx, ry = data["lens_half_size"]
    net = data["control_points"][..., 2]
    across = BSpline(data["knots_u"], net, data["degrees"][0])(0.5 * (x / rx + 1), dx)  # (nx, m)
    z = BSpline(data["knots_v"], across.T, data["degrees"][1])(0.5 * (y / ry + 1), dy).T
    return z / (2 * rx) ** dx / (2 * ry) ** dy


# the grid


def test_default_grid_has_every_knot_and_the_borders(case):
    _, field, heights = case
    grid = sample_grid(field, heights)
    for lines, space, r in zip((grid.x, grid.y), field.spaces, field.half_size, strict=True):
        assert len(lines) == STEPS_PER_SPAN * (len(space.breaks) - 1) + 1
        assert set(((2 * space.breaks - 1) * r).tolist()) <= set(lines.tolist())
        assert lines[0] == -r and lines[-1] == r and (np.diff(lines) > 0).all()
    assert grid.z.shape == grid.zx.shape == grid.zy.shape == (len(grid.x), len(grid.y))
    assert all(a.dtype == np.float64 for a in (grid.x, grid.y, grid.z, grid.zx, grid.zy))
    corners = grid.z[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(corners, heights[[0, 0, -1, -1], [0, -1, 0, -1]], rtol=4e-16)


def test_equispaced_knots_give_the_size_the_manual_names():
    _, field, heights = make(control=(20, 31), degree=(3, 5))
    grid = sample_grid(field, heights)
    assert grid.z.shape == (4 * (20 - 3) + 1, 4 * (31 - 5) + 1)
    np.testing.assert_allclose(np.diff(grid.x), 10 / (len(grid.x) - 1), rtol=1e-12)


def test_asked_samples_are_equispaced(case):
    _, field, heights = case
    grid = sample_grid(field, heights, (7, 12))
    np.testing.assert_allclose(grid.x, np.linspace(-1, 1, 7) * field.half_size[0], atol=1e-14)
    np.testing.assert_allclose(grid.y, np.linspace(-1, 1, 12) * field.half_size[1], atol=1e-14)


@pytest.mark.parametrize("samples", [(1, 5), (5, 0), (20001, 5), (8000, 8000), (5.0, 5), 5000])
def test_refuses_absurd_samples(samples):
    _, field, heights = make()
    with pytest.raises(InputError, match="samples"):
        sample_grid(field, heights, samples)


def test_refuses_another_lens_heights():
    _, field, heights = make()
    with pytest.raises(InputError, match="shape"):
        sample_grid(field, heights[:-1])


# the LightTools archive


def test_archive_has_exactly_the_keys_of_the_manual(tmp_path, case):
    scene, field, heights = case
    write_lighttools(tmp_path / "lens.npz", scene, field, heights)
    data = load(tmp_path / "lens.npz")
    (n, m), (nx, ny) = field.shape, data["shape"]
    real = {
        "points": (nx * ny, 3), "normals": (nx * ny, 3), "x": (nx,), "y": (ny,), "z": (nx, ny),
        "lens_half_size": (2,), "z_in": (), "refractive_index": (), "screen_half_size": (2,), "z_screen": (),
        "source_positions": (0, 3), "source_power": (1,), "cone_half_angle": (), "control_points": (n, m, 3),
        "knots_u": (n + field.spaces[0].degree + 1,), "knots_v": (m + field.spaces[1].degree + 1,),
    }  # fmt: skip
    count = {"shape": (2,), "resolution": (2,), "degrees": (2,), "format_version": ()}
    text = {"source_type": "plane", "unit": "mm", "created_by": f"caustic {__version__}"}
    assert set(data) == set(real) | set(count) | set(text)
    for key, shape in real.items():
        assert data[key].shape == shape and data[key].dtype == np.float64, key
    for key, shape in count.items():
        assert data[key].shape == shape and data[key].dtype == np.int64, key
    for key, value in text.items():
        assert data[key].shape == () and data[key].dtype.kind == "U" and data[key].item() == value, key
    assert data["z_in"] == scene.lens.z_in and data["refractive_index"] == 1.5443 and data["z_screen"] == 300.0
    assert data["lens_half_size"].tolist() == [s / 2 for s in scene.lens.size]
    assert data["screen_half_size"].tolist() == [19.2, 15.0] and data["resolution"].tolist() == [64, 50]
    assert data["source_power"].tolist() == [1.0] and data["cone_half_angle"] == 0.0 and data["format_version"] == 1


def test_cloud_is_the_spline(tmp_path, case):
    scene, field, heights = case
    write_lighttools(tmp_path / "lens.npz", scene, field, heights, (23, 31))
    data = load(tmp_path / "lens.npz")
    cloud, normals = (data[k].reshape(23, 31, 3) for k in ("points", "normals"))
    x, y = data["x"], data["y"]
    assert (cloud[..., 0] == x[:, None]).all() and (cloud[..., 1] == y).all() and (cloud[..., 2] == data["z"]).all()
    assert np.abs(data["z"] - scipy_surface(data, x, y)).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-15)
    assert (normals[..., 2] > 0).all()
    slopes = -normals[..., :2] / normals[..., 2:]
    assert np.abs(slopes[..., 0] - scipy_surface(data, x, y, dx=1)).max() < 1e-12
    assert np.abs(slopes[..., 1] - scipy_surface(data, x, y, dy=1)).max() < 1e-12


def test_control_points_stand_at_the_greville_abscissae(tmp_path, case):
    """The spline of the control points' x is x itself: the reader can treat the net as a surface in space."""
    scene, field, heights = case
    write_lighttools(tmp_path / "lens.npz", scene, field, heights)
    data = load(tmp_path / "lens.npz")
    u = np.linspace(0, 1, 50)
    for axis, knots in enumerate(("knots_u", "knots_v")):
        line = np.moveaxis(data["control_points"], axis, 0)[:, 0, axis]
        r = data["lens_half_size"][axis]
        np.testing.assert_allclose(BSpline(data[knots], line, data["degrees"][axis])(u), (2 * u - 1) * r, atol=1e-12)
    assert (data["control_points"][..., 2] == heights.numpy()).all()


def test_bicubic_through_the_cloud_gives_the_designed_slopes_back(tmp_path):
    """formats.md 1.6: not-a-knot bicubic on a grid that holds every knot; an arbitrary grid as dense does not do it."""
    scene, field, heights = make(control=(30, 22), size=(10.0, 8.0))
    rng = np.random.default_rng(0)
    x, y = np.sort(rng.uniform(-5, 5, 200)), np.sort(rng.uniform(-4, 4, 200))
    worst = {}
    for samples in (None, (110, 80)):
        write_lighttools(tmp_path / "lens.npz", scene, field, heights, samples)
        data = load(tmp_path / "lens.npz")
        spline = RectBivariateSpline(data["x"], data["y"], data["z"], kx=3, ky=3, s=0)
        worst[samples] = max(np.abs(spline(x, y, dx=a, dy=b) - scipy_surface(data, x, y, a, b)).max() for a, b in ((1, 0), (0, 1)))
    assert worst[None] < 1e-9
    assert worst[110, 80] > 1e-4


def test_retraced_from_the_cloud_alone_light_lands_where_the_tracer_puts_it(tmp_path):
    """M(x) = x + (n - S) / (n |g|^2 + S) (z_screen - f) g with S = sqrt(1 - (n^2 - 1) |g|^2), in plain NumPy."""
    scene, field, heights = make(control=(28, 22), size=(10.0, 8.0), relief=0.05)
    write_lighttools(tmp_path / "lens.npz", scene, field, heights)
    data = load(tmp_path / "lens.npz")
    rng = np.random.default_rng(1)
    u, v = rng.uniform(size=(2, 2000))
    (rx, ry), n = data["lens_half_size"], float(data["refractive_index"])
    x, y = (2 * u - 1) * rx, (2 * v - 1) * ry
    cloud = data["points"].reshape(*data["shape"], 3)
    spline = RectBivariateSpline(cloud[:, 0, 0], cloud[0, :, 1], cloud[..., 2], kx=3, ky=3, s=0)
    f, gx, gy = spline.ev(x, y), spline.ev(x, y, dx=1), spline.ev(x, y, dy=1)
    g2 = gx * gx + gy * gy
    s = np.sqrt(1 - (n * n - 1) * g2)
    reach = (n - s) / (n * g2 + s) * (float(data["z_screen"]) - f)

    sample = Sample(torch.as_tensor(u), torch.as_tensor(v), False, torch.tensor(1 / 2000, dtype=torch.float64))
    (landing,) = Tracer(System.of(scene, field), sample, track=True).land({EXIT: heights}, scene.screen)
    assert int(landing.statuses().sum()) == 0
    spread = np.hypot(landing.origin[0].numpy() - x, landing.origin[1].numpy() - y)
    assert spread.max() > 5  # mm: the lens does bend light
    assert np.hypot(landing.origin[0].numpy() - (x + reach * gx), landing.origin[1].numpy() - (y + reach * gy)).max() < 1e-6


def test_a_large_net_is_rounded_and_packed_unless_exact_numbers_are_asked_for(tmp_path, monkeypatch):
    """By less than 0.05 nm, on all its knots, in a file of half the size; a small net is exact as it is."""
    scene, field, heights = make(control=(300, 200), relief=0.01)
    write_lighttools(tmp_path / "small.npz", scene, field, heights, 1)
    assert (load(tmp_path / "small.npz")["control_points"][..., 2] == heights.numpy()).all()
    monkeypatch.setattr(lighttools, "LARGE", 1000)
    write_lighttools(tmp_path / "a.npz", scene, field, heights, 1)
    write_lighttools(tmp_path / "b.npz", scene, field, heights, 1, tolerance=0.0)
    rounded, exact = load(tmp_path / "a.npz"), load(tmp_path / "b.npz")
    assert (exact["control_points"][..., 2] == heights.numpy()).all() and (exact["z"] == sample_grid(field, heights, 1).z).all()
    for key, most in (("control_points", 0.5e-7), ("points", 0.5e-7), ("z", 0.5e-7), ("normals", 1e-7)):
        assert 0 < np.abs(rounded[key] - exact[key]).max() <= most, key
    assert (rounded["points"][:, 2].reshape(rounded["z"].shape) == rounded["z"]).all()
    assert (tmp_path / "a.npz").stat().st_size < 0.6 * (tmp_path / "b.npz").stat().st_size
    _, read, again = open_archive(tmp_path / "a.npz")
    assert read.shape == field.shape and (again.numpy() == rounded["control_points"][..., 2]).all()
    with pytest.raises(InputError, match="must be 0, for exact numbers"):
        write_lighttools(tmp_path / "c.npz", scene, field, heights, tolerance=1e-3)


def test_archive_bytes_do_not_depend_on_the_day(tmp_path, monkeypatch):
    scene, field, heights = make()
    write_lighttools(tmp_path / "a.npz", scene, field, heights)
    later = time.struct_time((2031, 5, 6, 7, 8, 9, 1, 126, 0))
    monkeypatch.setattr(time, "localtime", lambda *_: later)
    write_lighttools(tmp_path / "b.npz", scene, field, heights)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert archive.testzip() is None


def test_archive_keeps_the_name_it_is_given(tmp_path):
    write_lighttools(tmp_path / "lens.dat", *make())
    assert [p.name for p in tmp_path.iterdir()] == ["lens.dat"]
    assert "points" in load(tmp_path / "lens.dat")


def test_archive_keeps_a_profile(tmp_path):
    profile = np.arange(6.0).reshape(2, 3)
    write_lighttools(tmp_path / "lens.npz", *make(profile=profile, power=2.5))
    data = load(tmp_path / "lens.npz")
    assert data["source_power"].tolist() == [2.5] and (data["source_profile"] == profile).all()


def test_a_refused_export_leaves_no_file(tmp_path):
    for write in (write_lighttools, write_stl):
        with pytest.raises(InputError):
            write(tmp_path / "lens.out", *make(), samples=(1, 1))
    with pytest.raises(InputError, match="cannot be written"):
        write_lighttools(tmp_path / "missing" / "lens.npz", *make())
    assert list(tmp_path.iterdir()) == []


# the STL solid


def read_stl(path):
    """Records of a binary STL, after checking its frame."""
    raw = path.read_bytes()
    count = int(np.frombuffer(raw, "<u4", 1, 80)[0])
    assert not raw.startswith(b"solid") and len(raw) == 84 + 50 * count
    return np.frombuffer(raw, TRIANGLE, count, 84)


def signed_volume(corners):
    return np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6


def exact_volume(data):
    """Integral of z - z_in over the aperture: a spline's is (mean of knot widths) . heights, exactly."""
    wu, wv = (
        (t[p + 1 :] - t[: -p - 1]) / (p + 1) for t, p in zip((data["knots_u"], data["knots_v"]), data["degrees"], strict=True)
    )
    area = 4 * data["lens_half_size"].prod()
    return area * (wu @ (data["control_points"][..., 2] - data["z_in"]) @ wv)


def test_stl_is_closed_and_faces_outward(tmp_path, case):
    """Every directed edge occurs once and its reverse once: watertight, manifold, consistently oriented."""
    scene, field, heights = case
    write_stl(tmp_path / "lens.stl", scene, field, heights)
    records = read_stl(tmp_path / "lens.stl")
    corners = records["corners"]
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)  # shared: equal to the last bit
    faces = index.reshape(-1, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = edges[:, 0] * len(vertices) + edges[:, 1]
    backward = edges[:, 1] * len(vertices) + edges[:, 0]
    assert len(np.unique(forward)) == len(forward) > 10
    assert (np.sort(forward) == np.sort(backward)).all()
    assert len(vertices) - len(edges) // 2 + len(faces) == 2  # Euler: one ball
    assert signed_volume(corners.astype(float)) > 0
    assert (records["attribute"] == 0).all()
    normal = np.cross(corners[:, 1].astype(float) - corners[:, 0], corners[:, 2].astype(float) - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(records["normal"], normal, atol=1e-6)
    top = corners[:, :, 2].min(1) > scene.lens.z_in
    assert (records["normal"][top, 2] > 0).all()
    assert top.sum() == 2 * (len(sample_grid(field, heights).x) - 1) * (len(sample_grid(field, heights).y) - 1)


def test_stl_encloses_the_lens(tmp_path):
    """Facets converge to the spline's own volume at second order in the step; float32 leaves 1e-7 of it."""
    scene, field, heights = make(control=(9, 17), size=(6.0, 14.0))
    write_lighttools(tmp_path / "lens.npz", scene, field, heights)
    volume = exact_volume(load(tmp_path / "lens.npz"))
    error = []
    for samples in ((31, 61), (61, 121)):
        vertices, faces = closed_mesh(scene, field, heights, samples)
        error.append(signed_volume(vertices[faces]) / volume - 1)
    assert abs(error[0]) < 1e-3
    assert error[0] / error[1] == pytest.approx(4, rel=0.1)
    write_stl(tmp_path / "lens.stl", scene, field, heights, (61, 121))
    assert signed_volume(read_stl(tmp_path / "lens.stl")["corners"].astype(float)) / volume - 1 == pytest.approx(error[1], abs=1e-6)


def test_stl_spans_the_lens(tmp_path):
    scene, field, heights = make(control=(9, 17), size=(6.0, 14.0))
    write_stl(tmp_path / "lens.stl", scene, field, heights)
    corners = read_stl(tmp_path / "lens.stl")["corners"].reshape(-1, 3)
    assert corners[:, :2].min(0).tolist() == [-3, -7] and corners[:, :2].max(0).tolist() == [3, 7]
    assert corners[:, 2].min() == -0.5
    assert corners[:, 2].max() == np.float32(sample_grid(field, heights).z.max())


def test_stl_reads_as_a_volume_in_trimesh(tmp_path, case):
    trimesh = pytest.importorskip("trimesh")
    scene, field, heights = case
    write_stl(tmp_path / "lens.stl", scene, field, heights, (20, 33))
    read = trimesh.load_mesh(tmp_path / "lens.stl")
    assert read.is_watertight and read.is_winding_consistent and read.is_volume and read.body_count == 1
    write_lighttools(tmp_path / "lens.npz", scene, field, heights)
    assert read.volume == pytest.approx(exact_volume(load(tmp_path / "lens.npz")), rel=1e-2)


def test_stl_repeats_to_the_byte(tmp_path):
    for name in ("a.stl", "b.stl"):
        write_stl(tmp_path / name, *make())
    assert (tmp_path / "a.stl").read_bytes() == (tmp_path / "b.stl").read_bytes()


def test_stl_refuses_what_float32_cannot_hold(tmp_path):
    """Knots 1e-9 apart are two grid lines to float64 and one to float32; an equispaced grid passes."""
    knots = (0.0, 0.0, 0.0, 0.0, 0.8, 0.8 + 1e-9, 1.0, 1.0, 1.0, 1.0)
    scene, field, heights = make(control=(6, 6), knots=(knots, knots))
    with pytest.raises(InputError, match="float32"):
        write_stl(tmp_path / "lens.stl", scene, field, heights)
    assert list(tmp_path.iterdir()) == []
    write_stl(tmp_path / "lens.stl", scene, field, heights, (30, 30))


def test_stl_refuses_a_surface_below_its_entrance(tmp_path):
    scene, field, heights = make()
    with pytest.raises(InputError, match="above the entrance"):
        write_stl(tmp_path / "lens.stl", scene, field, heights - 6.0)


def test_zemax_says_what_it_does_not_contain(tmp_path):
    """The grid is that of the surface alone, whatever the scene; comments say the rest, and the positions of round lenslets."""
    scene, field, heights = make(control=(28, 19), size=(10.0, 8.0))
    scene = replace(scene, screen=replace(scene.screen, z=1000.0))

    def lines(one, *surface):
        write_zemax(tmp_path / "a.dat", one, *(surface or (field, heights)), (9, 9))
        text = (tmp_path / "a.dat").read_text().splitlines()
        return [t for t in text if t.startswith("!")], [t for t in text if not t.startswith("!")]

    said, grid = lines(scene)
    for changes, words in (
        ({"screen": replace(scene.screen, far=True)}, "far field (afocal image space)"),
        ({"elements": (Component(60.0, (30.0, 30.0)),)}, "among other elements"),
        ({"elements": (FoldMirror(60.0, (80.0, 80.0), tilt=(45.0, 0.0)),)}, "which flat mirrors fold"),
        ({"lens": replace(scene.lens, gradient=Gradient("radial", (-1e-3,)))}, "- 0.001 r^2, r in mm from the axis"),
    ):
        comments, found = lines(replace(scene, **changes))
        assert found == grid and words in " ".join({*comments} - {*said})
    lens = replace(scene.lens, array=(3, 2), lenslets="round")
    (*_, comment), _ = lines(replace(scene, lens=lens), HeightField.of(lens), torch.full((28, 19), 5.0, dtype=torch.float64))
    radius, *centres = map(float, re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", comment.partition("radius")[2]))
    assert radius == pytest.approx(10.0 / 6.0)
    wanted = [(10 / 3 * (i - 1), 4 * (j - 0.5)) for i in range(3) for j in range(2)]
    assert np.reshape(centres, (-1, 2)) == pytest.approx(np.array(wanted))
