"""Exports: the archive LightTools users read and the STL solid, against SciPy, NumPy and each other."""

from __future__ import annotations

import time
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline, RectBivariateSpline

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.export import FORMATS, lighttools, mesh, surface
from caustic_cli.export.accuracy import Deviation, of_bilinear, of_patches, of_spline, of_triangles
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mesh import closed_mesh, patch
from caustic_cli.export.stl import TRIANGLE, write_stl
from caustic_cli.export.surface import STEPS_PER_SPAN, sample_grid
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Component, Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.workflow import export

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


@pytest.mark.parametrize("samples", [(1, 5), (5, 0), (20001, 5), (8000, 8000), (5.0, 5), 5])
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


def test_a_large_spline_is_stored_on_fewer_knots_unless_the_exact_one_is_asked_for(tmp_path, monkeypatch):
    """Smooth heights on 100 x 90 points in an archive of at most 200 kB: the spline's part is half, its deviation as measured."""
    monkeypatch.setattr(lighttools, "USUAL_BYTES", 200_000)
    monkeypatch.setattr(surface, "USUAL_BYTES", 200_000)
    scene, field, heights = make(control=(100, 90), relief=0.0)
    x, y = field.control_xy()
    heights = heights + 1e-3 * torch.sin(9.0 * x[:, None]) * torch.cos(7.0 * y[None, :])
    off = write_lighttools(tmp_path / "a.npz", scene, field, heights)
    assert (tmp_path / "a.npz").stat().st_size < 200_000 and off.spline is not None
    n, m = off.spline.samples
    assert 0.4 < n * m * 24 / 100_000 <= 1.0
    _, fewer, read = open_archive(tmp_path / "a.npz")
    assert fewer.shape == (n, m)
    u, v = (torch.from_numpy(c) for c in np.random.default_rng(2).uniform(-5.0, 5.0, (2, 2000)))
    apart = float((fewer.at(read, u, v)[0] - field.at(heights, u, v)[0]).abs().max())
    assert 0.3 * off.spline.height < apart <= 1.2 * off.spline.height < 3e-4
    assert off.figures(scene)["spline"]["samples"] == [n, m]
    whole = write_lighttools(tmp_path / "b.npz", scene, field, heights, tolerance=0.0)
    assert whole.spline is None and torch.equal(open_archive(tmp_path / "b.npz")[2], heights)
    with pytest.raises(InputError, match="must be 0, for the exact spline"):
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


# how far samples are off, and how large a file is when nothing is said about them


def quadratic(c, control=(24, 24)):
    """A lens whose surface is 5 - c x^2 / 2."""
    scene, field, _ = make(control=control, degree=(2, 2))
    one = field.spaces[0]
    squares = (2.0 * field.half_size[0]) ** 2 * torch.stack(
        [(one.knots[k + 1] - 0.5) * (one.knots[k + 2] - 0.5) for k in range(one.n)]
    )  # the blossom of (x - 0)^2
    return scene, field, 5.0 - 0.5 * c * squares[:, None].expand(field.shape).contiguous()


def test_flat_triangles_are_as_far_off_as_a_parabola_says():
    """Between points h apart a chord of c x^2 / 2 is c h^2 / 8 off in its middle, its slope c h / sqrt(12) in the mean."""
    scene, field, heights = quadratic(0.01)
    points = patch(scene.lens, field, heights, (51, 41))
    found, h = of_triangles(points, field, heights), 10.0 / 50
    assert found.samples == (51, 41)
    assert 0.99 * 0.01 * h * h / 8 < found.height <= 0.01 * h * h / 8 * (1 + 1e-9)
    assert found.slope == pytest.approx(0.01 * h / 12**0.5, rel=0.01)
    shaded = of_triangles(points, field, heights, shaded=True)
    assert shaded.height == found.height and shaded.slope < 1e-4 * found.slope  # normals of a parabola are nearly linear
    grid = sample_grid(field, heights, (51, 41))
    assert of_bilinear(grid, field, heights).slope == pytest.approx(0.01 * h / 12**0.5, rel=0.01)


def test_splines_and_patches_are_off_where_knots_are_no_lines():
    _, field, heights = make(control=(23, 19))
    for lay, a_span in ((of_spline, 2), (of_patches, 1)):
        on = lay(sample_grid(field, heights, (a_span * 20 + 1, a_span * 16 + 1)), field, heights)
        between = lay(sample_grid(field, heights, (a_span * 20 - 2, a_span * 16 - 2)), field, heights)
        assert on.height < 1e-12 and on.slope < 1e-11
        assert between.height > 1e-6 and between.slope > 1e-5


def test_shift_is_that_of_traced_light():
    """What a slope's error moves light by, in pixels, beside a ray through both surfaces."""
    scene, field, heights = make(relief=0.01)
    tilt = 1e-5
    x, _ = field.control_xy()
    found = {}
    for name, net in (("designed", heights), ("read", heights + tilt * x[:, None])):
        u = torch.linspace(0.01, 0.99, 500, dtype=torch.float64)
        sample = Sample(u, u.flip(0), False, torch.tensor(1 / 500, dtype=torch.float64))
        (landing,) = Tracer(System.of(scene, field), sample, track=True).land({EXIT: net}, scene.screen)
        found[name] = torch.stack([landing.origin[0], landing.origin[1]])
    moved = float((found["read"] - found["designed"]).square().sum(0).mean().sqrt()) / min(scene.screen.pixel)
    assert Deviation("", (2, 2), 0.0, tilt).figures(scene)["shift_pixels"] == pytest.approx(moved, rel=0.02)


@pytest.mark.parametrize("format", ["lighttools", "zemax", "stl", "ply", "obj", "csv", "xyz", "heightmap", "mitsuba"])
@pytest.mark.parametrize("round", [False, True])
def test_default_files_keep_to_the_usual_size_and_say_how_far_they_are_off(tmp_path, monkeypatch, format, round):
    monkeypatch.setattr(surface, "USUAL_BYTES", 400_000)
    monkeypatch.setattr(mesh, "BESIDE", 50_000)
    scene, field, heights = make(control=(60, 60))
    if round:
        scene = replace(scene, lens=replace(scene.lens, aperture="circle"))
    file = tmp_path / f"lens{FORMATS[format][0]}"
    said = export.write(file, scene, field, heights, format)
    sizes = [f.stat().st_size for f in tmp_path.iterdir() if f.stem.split("-")[-1] not in ("sides", "holder")]
    assert max(sizes) <= 400_000
    assert max(sizes) > (20_000 if format == "heightmap" else 150_000)  # as many points as there is room for
    found = said.get("heightmap", said)
    assert 0 < found["height_error_mm"] < (1e-12 if format == "zemax" else 1e-2)  # whose patches end at the knots
    if format not in ("heightmap", "zemax"):
        finer = export.write(file, scene, field, heights, format, samples=tuple(2 * n for n in found["samples"]))
        assert finer["height_error_mm"] < found["height_error_mm"] and finer["shift_pixels"] < found["shift_pixels"]


@pytest.mark.parametrize("format", ["stl", "ply", "obj"])
def test_default_files_of_several_solids_keep_to_the_usual_size(tmp_path, monkeypatch, format):
    """All solids together, which would not fit if each had as many points as one alone."""
    monkeypatch.setattr(surface, "USUAL_BYTES", 400_000)
    monkeypatch.setattr(mesh, "BESIDE", 50_000)
    scene, field, heights = make(control=(60, 60))
    lenses = tuple(Component("lens", z, (12.0, 12.0), 4.0, (60.0, -90.0), 1.6) for z in (-40.0, -30.0, 60.0))
    file = tmp_path / f"lens.{format}"
    export.write(file, scene, field, heights, format)
    alone = file.stat().st_size
    export.write(file, replace(scene, elements=lenses), field, heights, format)
    assert alone > 250_000 and 200_000 < file.stat().st_size <= 400_000
