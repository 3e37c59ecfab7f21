"""The picture through every exported file: read back by SciPy and by this file's own readers, traced by the closed form of a single
refracting surface, and compared with what the export says of itself."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.interpolate import RectBivariateSpline
from test_export import make, read_stl
from test_roundtrip import grid_of, hermite, read_zemax, step_field

from caustic_cli.errors import InputError
from caustic_cli.export import FORMATS
from caustic_cli.export.lattice import LATTICES, triangles
from caustic_cli.export.reading import of_patches, of_points
from caustic_cli.export.surface import sample_grid, samplings
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.facets import FacetSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Offset
from caustic_cli.studies.picture_error import MARGIN
from caustic_cli.workflow.export import Exporter, accuracy_words

RAYS = 900  # along each side: noise adds half a per cent to an error


@pytest.fixture(scope="module")
def lens():
    """A lens of rough relief whose picture is its own image, but for a random tenth."""
    scene, field, heights = make(control=(40, 40), size=(10.0, 10.0), relief=2e-4)
    scene = replace(scene, screen=replace(scene.screen, resolution=(48, 48)))
    image = own_image(scene, *surface(field, heights))
    return scene, field, heights, image * np.random.default_rng(8).uniform(0.8, 1.2, image.shape)


def rays(half, seed):
    """Stratified points of the aperture (N,), mm."""
    random = np.random.default_rng(seed)
    u, v = ((np.arange(RAYS)[shape] + random.uniform(size=(RAYS, RAYS))) / RAYS for shape in (np.s_[:, None], np.s_[None, :]))
    return ((2 * u - 1) * half[0]).ravel(), ((2 * v - 1) * half[1]).ravel()


def surface(field, heights, seed=5):
    """x, y, z, zx, zy of a spline at the rays."""
    x, y = rays(field.half_size, seed)
    return x, y, *(t.numpy() for t in field.at(heights, torch.from_numpy(x), torch.from_numpy(y)))


def own_image(scene, x, y, z, gx, gy):
    """Fraction of the rays on every pixel [i, j], by M(x) = x + (n - S) / (n |g|^2 + S) (z_screen - f) g; without Fresnel losses,
    which hardly vary over these slopes."""
    n, g2 = scene.lens.index, gx * gx + gy * gy
    s = np.sqrt(1 - (n * n - 1) * g2)
    reach = (n - s) / (n * g2 + s) * (scene.screen.z - z)
    edges = [np.linspace(-h, h, k + 1) for h, k in zip(scene.screen.half_size, scene.screen.resolution, strict=True)]
    return np.histogram2d(x + reach * gx, y + reach * gy, edges)[0] / x.size


def own_error(scene, target, *traced):
    image = own_image(scene, *traced)
    a, b = image / image.mean(), target / target.mean()
    return float(np.sqrt(np.mean((a - b) ** 2)))


def bicubic(x, y, z, seed):
    px, py = rays((-x[0], -y[0]), seed)
    spline = RectBivariateSpline(x, y, z, kx=3, ky=3, s=0)
    return px, py, *(spline.ev(px, py, dx=a, dy=b) for a, b in ((0, 0), (1, 0), (0, 1)))


def patches(x, y, z, zx, zy, zxy, seed):
    """The bicubic Hermite patches of a grid with derivatives, z up to a constant, at the rays."""
    px, py = rays((-x[0], -y[0]), seed)
    (i, s), (j, t) = (
        (k := np.clip(np.searchsorted(lines, at, "right") - 1, 0, len(lines) - 2), (at - lines[k]) / (lines[1] - lines[0]))
        for lines, at in ((x, px), (y, py))
    )
    wide, high = x[1] - x[0], y[1] - y[0]

    def basis(t, width):
        values = (1 + 2 * t) * (1 - t) ** 2, t * t * (3 - 2 * t), width * t * (1 - t) ** 2, width * t * t * (t - 1)
        slopes = 6 * t * (t - 1), -6 * t * (t - 1), width * (1 - t) * (1 - 3 * t), width * t * (3 * t - 2)
        return values, tuple(d / width for d in slopes)

    (bx, dx), (by, dy) = basis(s, wide), basis(t, high)

    def total(across, along):
        found = 0.0
        for a in (0, 1):
            for b in (0, 1):
                at = i + a, j + b
                found = found + across[a] * (along[b] * z[at] + along[2 + b] * zy[at])
                found = found + across[2 + a] * (along[b] * zx[at] + along[2 + b] * zxy[at])
        return found

    return px, py, 5.0 + total(bx, by), total(dx, by), total(bx, dy)


def mode(path):
    with Image.open(path) as image:
        return image.mode


def read_ply(path):
    raw = path.read_bytes()
    head, data = raw.split(b"end_header\n", 1)
    count = int(head.split(b"element vertex ")[1].split()[0])
    return np.frombuffer(data, "<f8", 3 * count).reshape(count, 3)


def read_back(path, format, field, seed):
    """The surface in a file at the rays, by readers that share nothing with the writers."""
    if format in ("lighttools", "step"):
        if format == "step":
            read, net, _ = step_field(path, field.half_size)
            return surface(read, net, seed)
        with np.load(path) as data:
            spaces = [SplineSpace(int(p), torch.from_numpy(data[f"knots_{k}"])) for p, k in zip(data["degrees"], "uv", strict=True)]
            net = torch.from_numpy(data["control_points"][..., 2].copy())
            return surface(HeightField(tuple(spaces), field.half_size), net, seed)
    if format == "zemax":
        return patches(*read_zemax(path), seed)
    if format == "heightmap":
        said = json.loads(path.with_name(path.name + ".json").read_text())
        with Image.open(path) as image:
            z = said["z_of_zero"] + said["mm_per_count"] * np.asarray(image, float)[::-1].T
        return bicubic(*(np.linspace(-h, h, n) for h, n in zip(field.half_size, z.shape, strict=True)), z, seed)
    if format in ("csv", "xyz"):
        points = np.loadtxt(path, delimiter="," if format == "csv" else None, skiprows=1 if format == "csv" else 0)
    elif format == "stl":
        points = np.unique(read_stl(path)["corners"].reshape(-1, 3).astype(float), axis=0)
    elif format == "ply":
        points = read_ply(path)
    elif format == "3mf":
        with zipfile.ZipFile(path) as archive:
            model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
        points = np.array([[float(vertex.get(c)) for c in "xyz"] for vertex in model.iter() if vertex.tag.endswith("}vertex")])
    else:
        points = np.array([line.split()[1:] for line in path.read_text().splitlines() if line.startswith("v ")], float)
    return bicubic(*grid_of(points[points[:, 2] > 0]), seed)


@pytest.mark.parametrize("format", [name for name in FORMATS if name not in ("gcode", "mitsuba", "phase")])
def test_default_files_keep_the_picture_and_say_so(tmp_path, lens, format):
    scene, field, heights, target = lens
    path = tmp_path / f"lens{FORMATS[format][0]}"
    found = Exporter(scene, field, heights, target).write(path, format)
    own = own_error(scene, target, *surface(field, heights, 7))
    read = own_error(scene, target, *read_back(path, format, field, 7))
    assert 0.05 < own < 0.5  # so that an error can be seen
    assert found["lens_error"] == pytest.approx(own, rel=0.02) and found["error"] == pytest.approx(read, rel=0.02)
    assert found["keeps_picture"] and read <= MARGIN * own * 1.01 and found["error_by"] == "rays"
    assert "keep_it" not in found and f"{found['error']:.4f}" in accuracy_words(found)


@pytest.mark.parametrize(("format", "least"), [("stl", 1.1), ("csv", 1.1), ("step", 1.1), ("lighttools", 1.0)])
def test_a_file_that_is_too_small_warns_and_names_formats_that_keep_the_picture(tmp_path, lens, format, least):
    scene, field, heights, target = lens
    most = {"stl": 1_040_000, "csv": 12_000, "step": 40_000, "lighttools": 125_000}[format]
    path = tmp_path / f"lens{FORMATS[format][0]}"
    found = Exporter(scene, field, heights, target, most=most).write(path, format)
    assert path.stat().st_size <= most
    read = own_error(scene, target, *read_back(path, format, field, 7))
    assert found["error"] == pytest.approx(read, rel=0.05)
    if format == "lighttools":  # the spline is in the archive whatever the cloud
        assert found["keeps_picture"] and found["cloud_error"] > 1.1 * found["error"]
        return
    assert found["error"] > least * found["lens_error"] and not found["keeps_picture"]
    assert set(found["keep_it"]) == {"lighttools", "step", "heightmap"} - {format}
    assert "warning: this file does not keep the picture; ⟨format⟩ " in accuracy_words(found)


def test_the_smallest_file_that_keeps_the_picture_is_chosen(tmp_path, lens):
    """The next smaller grid does not keep it."""
    scene, field, heights, target = lens
    exporter = Exporter(scene, field, heights, target)
    chosen = exporter.write(tmp_path / "lens.csv", "csv")["samples"]
    counts = [c if isinstance(c, tuple) else (37 * c + 1,) * 2 for c in samplings(field.spaces, 1e6)]
    at = counts.index(tuple(chosen))
    assert 0 < at < len(counts) - 1
    smaller = exporter.write(tmp_path / "less.csv", "csv", samples=counts[at - 1])
    assert not smaller["keeps_picture"] and (tmp_path / "less.csv").stat().st_size < (tmp_path / "lens.csv").stat().st_size


def test_sixteen_bits_are_taken_where_they_keep_the_picture(tmp_path, lens):
    scene, field, heights, target = lens
    exporter = Exporter(scene, field, heights, target)
    exporter.write(tmp_path / "a.tif", "heightmap")
    assert mode(tmp_path / "a.tif") == "I;16"  # a relief of half a micrometre
    tall = heights + 0.3 * torch.linspace(-1.0, 1.0, 40, dtype=torch.float64)[:, None] ** 2
    flat = Exporter(scene, field, tall, own_image(scene, *surface(field, tall)))
    found = flat.write(tmp_path / "b.tif", "heightmap")
    assert mode(tmp_path / "b.tif") == "F" and found["keeps_picture"]
    coarse = flat.write(tmp_path / "b.png", "heightmap")
    assert not coarse["keeps_picture"] and coarse["error"] > 1.2 * found["error"]


@pytest.mark.parametrize("format", ["stl", "mitsuba"])
def test_round_lenses_are_judged_through_facets(tmp_path, lens, format):
    scene, field, heights, _ = lens
    scene = replace(scene, lens=replace(scene.lens, aperture="circle"))
    exporter = Exporter(scene, field, heights, None)
    fine = exporter.write(tmp_path / f"a{FORMATS[format][0]}", format, samples=(301, 301))
    coarse = exporter.write(tmp_path / f"b{FORMATS[format][0]}", format, samples=(75, 75))
    assert fine["lens_error"] is None and 0 < fine["error"] < 0.5 * coarse["error"]
    assert format == "mitsuba" or fine["facet_error"] > fine["error"]


@pytest.mark.parametrize("format", ["lighttools", "step", "stl", "heightmap"])
def test_moulds_and_mirrors_are_judged_where_they_stand(tmp_path, lens, format):
    """The surface of a mould is that of its lens, turned."""
    scene, field, heights, target = lens
    if format != "lighttools":
        found = Exporter(scene, field, heights, target).write(tmp_path / f"m{FORMATS[format][0]}", format, mould=True)
        assert found["keeps_picture"]
    mirror = replace(
        scene,
        lens=replace(scene.lens, mirror=True, z_in=0.0, offset=Offset(0.0)),
        screen=replace(scene.screen, z=-300.0),
    )
    exporter = Exporter(mirror, field, heights - heights.mean(), None)
    found = exporter.write(tmp_path / f"r{FORMATS[format][0]}", format)
    assert found["keeps_picture"] and found["error"] < 0.01


def test_waves_judge_what_waves_designed(tmp_path):
    scene, field, heights = make(control=(24, 24), size=(4.0, 4.0), relief=5e-5)
    scene = replace(scene, screen=replace(scene.screen, size=(6.0, 6.0), resolution=(32, 32)))
    target = own_image(scene, *surface(field, heights))
    exporter = Exporter(scene, field, heights, target, waves=True)
    found = exporter.write(tmp_path / "a.stl", "stl", samples=(93, 93))
    assert found["error_by"] == "waves" and found["noise"] is None
    assert found["keeps_picture"] and found["facet_error"] > found["error"]
    assert "of the wave image" in accuracy_words(found)


# the surfaces as read


def test_patches_through_exact_derivatives_are_the_surface():
    _, field, heights = make(control=(23, 19))
    on, between = (sample_grid(field, heights, s) for s in (1, (20, 15)))
    for grid, low, high in ((on, 0.0, 1e-12), (between, 1e-6, 1e-1)):
        read = of_patches(grid, grid.z, grid.zx, grid.zy, grid.zxy)
        assert low <= read.largest_deviation(field, heights) <= high
        few = np.random.default_rng(2).uniform(-1, 1, (40, 2)) * field.half_size
        expected = hermite(grid.x, grid.y, grid.z, grid.zx, grid.zy, grid.zxy, few)
        for a, b in zip(read.surface.at(read.heights, *torch.from_numpy(few.T.copy())), expected, strict=True):
            assert np.abs(a.numpy() - b).max() < 1e-11


@pytest.mark.parametrize("shape", [(31, 24), (5, 4), (4, 3)])
def test_points_are_read_as_scipy_reads_them(shape):
    _, field, heights = make(control=(12, 11))
    grid = sample_grid(field, heights, shape)
    read = of_points(grid.x, grid.y, grid.z)
    spline = RectBivariateSpline(grid.x, grid.y, grid.z, kx=min(3, shape[0] - 1), ky=min(3, shape[1] - 1), s=0)
    x, y = np.random.default_rng(3).uniform(-1, 1, (2, 500)) * np.array(field.half_size)[:, None]
    found = read.surface.at(read.heights, torch.from_numpy(x), torch.from_numpy(y))
    for values, (a, b) in zip(found, ((0, 0), (1, 0), (0, 1)), strict=True):
        assert np.abs(values.numpy() - spline.ev(x, y, dx=a, dy=b)).max() < 1e-10


@pytest.mark.parametrize("round", [False, True])
def test_facets_are_those_of_the_mesh(round):
    """Height and slope at points inside of every triangle, which the triangle's own corners give."""
    _, field, heights = make(control=(9, 9), size=(10.0, 10.0), relief=0.1)
    lattice = LATTICES["circle" if round else "rectangle"]
    one = lattice.patch(field, heights, (14, 14))
    faces = triangles(one.points)
    corners = one.points.reshape(-1, 3)[faces]
    weights = np.array([0.4, 0.35, 0.25])
    at = np.einsum("c,fck->fk", weights, corners)
    read = lattice.facets(one.points).surface
    z, gx, gy = (t.numpy() for t in read.at(None, torch.from_numpy(at[:, 0].copy()), torch.from_numpy(at[:, 1].copy())))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inside = np.hypot(at[:, 0], at[:, 1]) < 4.4 if round else np.full(len(at), True)
    same = np.abs(z - at[:, 2]) < 1e-12
    assert same[inside].mean() > (0.9 if round else 0.999) and np.abs(z - at[:, 2])[inside].max() < 2e-2
    assert np.abs(gx + normal[:, 0] / normal[:, 2])[same].max() < 1e-10
    assert np.abs(gy + normal[:, 1] / normal[:, 2])[same].max() < 1e-10
    for k, most in enumerate(read.slope_bounds(None)):
        assert np.abs(normal[:, k] / normal[:, 2]).max() <= 1.001 * most


def test_a_turned_facet_surface_is_the_half_turn():
    _, field, heights = make(control=(9, 8))
    one = LATTICES["rectangle"].patch(field, heights, (14, 11))
    read = FacetSurface(one.points, normals=one.normals)
    x, y = (torch.from_numpy(c) for c in np.random.default_rng(4).uniform(-3.0, 3.0, (2, 200)))
    for a, b, sign in zip(read.turned().at(None, x, y), read.at(None, x, -y), (-1, -1, 1), strict=True):
        assert float((a - sign * b).abs().max()) < 1e-12


def test_smoothed_normals_are_closer_than_facets():
    """Of a parabola: between points h apart a facet's slope is c h / sqrt(12) off in the mean, an interpolated normal hardly."""
    _, field, _ = make(control=(24, 24), size=(10.0, 10.0), degree=(2, 2))
    x, y = field.control_xy()
    heights = field.interpolated(5.0 - 0.005 * (x[:, None] ** 2 + 0.0 * y[None, :]))
    one, c, h = LATTICES["rectangle"].patch(field, heights, (51, 51)), 0.01, 10.0 / 50
    px, py = (torch.from_numpy(v) for v in np.random.default_rng(6).uniform(-4.5, 4.5, (2, 20_000)))
    own = field.at(heights, px, py)[1]
    flat = (LATTICES["rectangle"].facets(one.points).surface.at(None, px, py)[1] - own).square().mean().sqrt()
    given = (LATTICES["rectangle"].facets(one.points, one.normals).surface.at(None, px, py)[1] - own).square().mean().sqrt()
    assert float(flat) == pytest.approx(c * h / 12**0.5, rel=0.02) and float(given) < 1e-3 * float(flat)
    smooth = LATTICES["circle"].smooth(one.points)
    assert smooth.read_as == "facets with smoothed normals"


@pytest.mark.parametrize("size", ["20", "x", "-5MB", "1e9999MB", "5 TB", "0MB"])
def test_sizes_that_are_none_are_refused(size):
    from caustic_cli.commands.options import size_in_bytes  # noqa: PLC0415

    with pytest.raises(InputError, match="like 20MB"):
        size_in_bytes("--max-size", size)
    assert size_in_bytes("--max-size", "1.5 GB") == 1_500_000_000 and size_in_bytes("--max-size", "20000") == 20_000
