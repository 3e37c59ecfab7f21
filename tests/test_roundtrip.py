"""Every exported file, read back by what is not ours where there is such a reader, and traced again.

The rays of a plane wave are sent through what was read with the closed form of a single refracting surface,
    M(x) = x + (n - S) / (n |g|^2 + S) (z_screen - f) g,    S = sqrt(1 - (n^2 - 1) |g|^2),
f and g being its height and slopes; they must land where the program's own tracer puts them.
"""

from __future__ import annotations

import math
import re
import sys
import types
import zipfile
from dataclasses import replace
from functools import partial
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from helpers import arguments, edges_of, read_step, step_in_opencascade
from scipy.interpolate import BSpline, CubicHermiteSpline, RectBivariateSpline
from test_export import CASES, make, signed_volume

from caustic_cli.errors import InputError
from caustic_cli.export import step
from caustic_cli.export.approximation import on_fewer_knots
from caustic_cli.export.heightmap import write_heightmap
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.lighttools_script import companions, write_script
from caustic_cli.export.mesh import closed_mesh
from caustic_cli.export.mitsuba import write_mitsuba
from caustic_cli.export.obj import write_obj
from caustic_cli.export.part import part_of
from caustic_cli.export.ply import write_ply
from caustic_cli.export.points import write_csv, write_xyz
from caustic_cli.export.step import write_step
from caustic_cli.export.stl import write_stl
from caustic_cli.export.surface import STEPS_PER_SPAN, sample_grid, second_derivative_bounds
from caustic_cli.export.threemf import write_3mf
from caustic_cli.export.zemax import write_zemax
from caustic_cli.io.archive import open_archive
from caustic_cli.io.files import is_ours
from caustic_cli.io.heightmaps import read_heightmap
from caustic_cli.io.surfaces import onto, read_surface
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Component, Disc, FreeForm, Light, Offset, PlaneWave, Points, Scene
from caustic_cli.scene.materials import nearest_index
from caustic_cli.scene.sources.several import Several

LIMIT = 1e-3  # mm on a screen 300 mm away
CASE = {"control": (22, 16), "size": (10.0, 8.0), "relief": 0.03}


@pytest.fixture(scope="module")
def lens():
    return make(**CASE)


@pytest.fixture(scope="module")
def rays(lens):
    """(x, y) on the lens, and where the program's tracer lands them."""
    scene, field, heights = lens
    u, v = np.random.default_rng(1).uniform(size=(2, 3000))
    sample = Sample(torch.as_tensor(u), torch.as_tensor(v), False, torch.tensor(1 / 3000, dtype=torch.float64))
    (landing,) = Tracer(System.of(scene, field), sample, track=True).land({EXIT: heights}, scene.screen)
    assert int(landing.statuses().sum()) == 0
    x, y = (2 * u - 1) * field.half_size[0], (2 * v - 1) * field.half_size[1]
    assert np.hypot(landing.origin[0].numpy() - x, landing.origin[1].numpy() - y).max() > 5  # mm: the lens does bend light
    return x, y, landing.origin[0].numpy(), landing.origin[1].numpy()


def off(scene, rays, f, gx, gy) -> float:
    """Largest landing-point error, mm, of rays through a surface of height f and slopes gx, gy."""
    x, y, lx, ly = rays
    n, g2 = scene.lens.index, gx * gx + gy * gy
    s = np.sqrt(1 - (n * n - 1) * g2)
    reach = (n - s) / (n * g2 + s) * (scene.screen.z - f)
    return float(np.hypot(x + reach * gx - lx, y + reach * gy - ly).max())


def through(x, y, z, rays):
    """Height and slopes at the rays of SciPy's bicubic spline through a grid."""
    spline = RectBivariateSpline(x, y, z, kx=3, ky=3, s=0)
    return [spline.ev(rays[0], rays[1], dx=a, dy=b) for a, b in ((0, 0), (1, 0), (0, 1))]


def say(capsys, name: str, error: float) -> None:
    with capsys.disabled():
        print(f"\n  {name}: landing-point error {error:.2g} mm", end="")


def grid_of(points):
    """x, y, z[i, j] of points that fill a rectangular grid in any order."""
    x, i = np.unique(points[:, 0], return_inverse=True)
    y, j = np.unique(points[:, 1], return_inverse=True)
    assert len(x) * len(y) == len(points) and len(np.unique(i * len(y) + j)) == len(points)
    z = np.empty((len(x), len(y)))
    z[i, j] = points[:, 2]
    return x, y, z


# grids


def read_zemax(path):
    """x, y ascending, and z, zx, zy, zxy (nx, ny) of a Grid Sag file, by its definition alone."""
    raw = path.read_bytes()
    assert raw.count(b"\n") == raw.count(b"\r\n")
    lines = [line for line in raw.decode().splitlines() if not line.startswith("!")]
    nx, ny, dx, dy, unit, xdec, ydec = (float(t) for t in lines[0].split())
    nx, ny = int(nx), int(ny)
    assert unit == xdec == ydec == 0 and min(nx, ny) >= 5
    table = np.array([line.split() for line in lines[1:]], float)
    assert table.shape == (nx * ny, 5) and not table[:, 4].any()
    x, y = (np.arange(nx) - (nx - 1) / 2) * dx, (np.arange(ny) - (ny - 1) / 2) * dy
    return x, y, *(table[:, k].reshape(ny, nx)[::-1].T for k in range(4))


def hermite(x, y, z, zx, zy, zxy, at):
    """Height and slopes at scattered points of the bicubic Hermite patches, by SciPy along x and then along y."""
    out = []
    for dx, dy in ((0, 0), (1, 0), (0, 1)):
        values = []
        for px, py in at:
            f, fy = CubicHermiteSpline(x, z, zx)(px, dx), CubicHermiteSpline(x, zy, zxy)(px, dx)
            values.append(CubicHermiteSpline(y, f, fy)(py, dy))
        out.append(np.array(values))
    return out


def test_zemax(tmp_path, lens, rays, capsys):
    scene, field, heights = lens
    write_zemax(tmp_path / "lens.dat", *lens)
    x, y, z, zx, zy, zxy = read_zemax(tmp_path / "lens.dat")
    vertex = float(field.at(heights, *torch.zeros(2, 1, dtype=torch.float64), [(0, 0)])[0])
    said = re.search(r"vertex (\S+) mm", (tmp_path / "lens.dat").read_text())
    assert float(said[1]) == vertex - scene.lens.z_in
    f, gx, gy = through(x, y, z, rays)
    error = off(scene, rays, f + vertex, gx, gy)
    say(capsys, "zemax, bicubic spline", error)
    assert error < LIMIT
    spline = RectBivariateSpline(x, y, z)
    for column, (a, b), scale in ((zx, (1, 0), 1), (zy, (0, 1), 1), (zxy, (1, 1), 10)):
        assert np.abs(spline(x, y, dx=a, dy=b) - column).max() < 1e-9 * scale
    few = tuple(r[:60] for r in rays)
    f, gx, gy = hermite(x, y, z, zx, zy, zxy, list(zip(*few[:2], strict=True)))
    error = off(scene, few, f + vertex, gx, gy)
    say(capsys, "zemax, Hermite patches", error)
    assert error < 1e-8


def test_zemax_refuses_fewer_than_five(tmp_path, lens):
    with pytest.raises(InputError, match="at least 5"):
        write_zemax(tmp_path / "lens.dat", *lens, samples=(4, 9))
    assert not list(tmp_path.iterdir())


def test_zemax_grids_are_even_though_knots_are_not(tmp_path):
    write_zemax(tmp_path / "lens.dat", *make(**CASES["uneven knots"]))
    x, *_ = read_zemax(tmp_path / "lens.dat")
    assert len(x) == 4 * 5 + 1 and x[0] == -5 and x[-1] == 5


def test_lighttools(tmp_path, lens, rays, capsys):
    write_lighttools(tmp_path / "lens.npz", *lens)
    with np.load(tmp_path / "lens.npz") as data:
        error = off(lens[0], rays, *through(data["x"], data["y"], data["z"], rays))
    say(capsys, "lighttools", error)
    assert error < LIMIT


@pytest.mark.parametrize(
    ("write", "suffix", "options"), [(write_csv, "csv", {"delimiter": ",", "skiprows": 1}), (write_xyz, "xyz", {})]
)
def test_points(tmp_path, lens, rays, capsys, write, suffix, options):
    path = tmp_path / f"lens.{suffix}"
    write(path, *lens)
    points = np.loadtxt(path, **options)
    grid = sample_grid(lens[1], lens[2], None)
    ordered = grid.points.reshape(*grid.z.shape, 3).swapaxes(0, 1).reshape(-1, 3)
    assert np.abs(points - ordered).max() <= 0.5e-7 * (1 + 1e-6)  # x fastest
    error = off(lens[0], rays, *through(*grid_of(points), rays))
    say(capsys, suffix, error)
    assert error < LIMIT
    assert is_ours(path) == (suffix == "xyz")
    assert suffix == "xyz" or path.read_text().startswith("x_mm,y_mm,z_mm\n")


# meshes


@pytest.mark.parametrize(("write", "suffix"), [(write_stl, "stl"), (write_ply, "ply"), (write_obj, "obj")])
def test_meshes(tmp_path, lens, rays, capsys, write, suffix):
    """The mesh's vertices, laid under a spline; a facet's own normal would be another matter."""
    trimesh = pytest.importorskip("trimesh")
    path, (scene, field, heights) = tmp_path / f"lens.{suffix}", lens
    # float32 corners: a grid half as fine as the default feels their rounding half as much, and still has every knot
    write(path, *lens, samples=tuple(2 * (n - 3) + 1 for n in field.shape) if suffix == "stl" else None)
    mesh = trimesh.load_mesh(path)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.is_volume and mesh.body_count == 1
    assert mesh.volume == pytest.approx(signed_volume(np.array(mesh.triangles)), rel=1e-6) and mesh.volume > 0
    inner = mesh.vertices[mesh.vertices[:, 2] > scene.lens.z_in]
    x, y, z = grid_of(inner)
    error = off(scene, rays, *through(x, y, z, rays))
    say(capsys, suffix, error)
    assert error < LIMIT
    if suffix != "stl":
        assert np.abs(z - sample_grid(field, heights, None).z).max() <= {"ply": 0.0, "obj": 0.5e-9}[suffix]
    assert is_ours(path)


def test_3mf_is_a_package_of_the_mesh(tmp_path, lens):
    """By the names of its core specification, with the vertices and triangles of an OBJ file; twice the same bytes."""
    path, core = tmp_path / "lens.3mf", "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    write_3mf(path, *lens, samples=(21, 31))
    first = path.read_bytes()
    write_3mf(path, *lens, samples=(21, 31))
    assert path.read_bytes() == first and is_ours(path)
    with zipfile.ZipFile(path) as package:
        assert package.testzip() is None and package.namelist()[0] == "[Content_Types].xml"
        relation = ElementTree.fromstring(package.read("_rels/.rels"))[0]
        types = {kind.get("Extension") for kind in ElementTree.fromstring(package.read("[Content_Types].xml"))}
        model = ElementTree.fromstring(package.read(relation.get("Target")[1:]))
    assert types == {"rels", "model"} and relation.get("Type").endswith("2013/01/3dmodel") and model.get("unit") == "millimeter"
    vertices = np.array([[float(v.get(axis)) for axis in "xyz"] for v in model.iter(f"{core}vertex")])
    faces = np.array([[int(t.get(f"v{k}")) for k in (1, 2, 3)] for t in model.iter(f"{core}triangle")])
    wanted, triangles = closed_mesh(*lens, samples=(21, 31))
    assert np.abs(vertices - wanted).max() <= 0.51e-9 and (faces == triangles).all()
    assert model.find(f"{core}build/{core}item").get("objectid") == model.find(f"{core}resources/{core}object").get("id")


@pytest.mark.parametrize("case", [*CASES.values(), CASE], ids=[*CASES, "fine"])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_chord_error_is_what_tolerance_asks(case, tolerance):
    """At random points of every triangle; and not by far finer than asked."""
    scene, field, heights = make(**case)
    vertices, faces = closed_mesh(scene, field, heights, tolerance=tolerance)
    corners = vertices[faces]
    corners = corners[(corners[..., 2] > scene.lens.z_in).all(1) & (np.ptp(corners[..., 2], axis=1) >= 0)]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    corners = corners[area > 1e-12]  # the walls stand upright
    rng = np.random.default_rng(2)
    weights = rng.dirichlet((1, 1, 1), len(corners))
    weights[:, :2] = np.where(rng.random((len(corners), 1)) < 0.5, 0.5, weights[:, :2])  # the middle of an edge is the worst
    weights[:, 2] = 1 - weights[:, 0] - weights[:, 1]
    points = np.einsum("ij,ijk->ik", weights, corners)
    exact = field.at(heights, *torch.as_tensor(points[:, :2].T.copy()), [(0, 0)])[0].numpy()
    error = np.abs(points[:, 2] - exact).max()
    assert len(points) >= 2 and error <= tolerance * (1 + 1e-6)
    if len(points) > 10_000:
        assert error > 0.1 * tolerance


def test_second_derivatives_stay_below_their_bounds(lens):
    _, field, heights = lens
    x, y = np.random.default_rng(3).uniform(-1, 1, (2, 20000))
    at = [torch.as_tensor(c * r) for c, r in zip((x, y), field.half_size, strict=True)]
    found = field.at(heights, *at, [(2, 0), (1, 1), (0, 2)])
    for values, bound in zip(found, second_derivative_bounds(field, heights), strict=True):
        assert 0.4 * bound < float(values.abs().max()) <= bound


@pytest.mark.parametrize("tolerance", [0.0, -1.0, float("nan"), 1e-30])
def test_refuses_absurd_tolerances(tolerance, lens):
    with pytest.raises(InputError, match="tolerance"):
        closed_mesh(*lens, tolerance=tolerance)
    with pytest.raises(InputError, match="one of them"):
        closed_mesh(*lens, samples=(9, 9), tolerance=1e-3)


# STEP


def step_surface(entities):
    """Degrees, poles (n, m, 3), knot vectors."""
    (body,) = (b for b in entities.values() if b.startswith("B_SPLINE_SURFACE_WITH_KNOTS"))
    _, p, q, net, *_, mu, mv, ku, kv, _ = arguments(body)
    poles = np.array([[arguments(entities[int(r[1:])])[1] for r in row] for row in net])
    return (p, q), poles, (np.repeat(ku, mu), np.repeat(kv, mv))


def test_step(tmp_path, lens, rays, capsys):
    scene, field, heights = lens
    assert write_step(tmp_path / "lens.step", *lens, tolerance=0.0) is None
    (p, q), poles, (tu, tv) = step_surface(read_step(tmp_path / "lens.step"))
    assert (poles[..., 2] == heights.numpy()).all() and (tu == field.spaces[0].knots.numpy()).all()
    assert (tv == field.spaces[1].knots.numpy()).all()
    x, y = (c.numpy() for c in field.control_xy())
    assert (poles[..., 0] == x[:, None]).all() and (poles[..., 1] == y).all()
    u, v = (0.5 * (c / r + 1) for c, r in zip(rays[:2], field.half_size, strict=True))
    columns = [BSpline.design_matrix(c, t, k) for c, t, k in ((u, tu, p), (v, tv, q))]
    slopes = [BSpline(t, np.eye(len(t) - k - 1), k)(c, 1) for c, t, k in ((u, tu, p), (v, tv, q))]
    net = poles[..., 2]
    f = np.einsum("ki,ij,kj->k", columns[0].toarray(), net, columns[1].toarray())
    gx = np.einsum("ki,ij,kj->k", slopes[0], net, columns[1].toarray()) / scene.lens.size[0]
    gy = np.einsum("ki,ij,kj->k", columns[0].toarray(), net, slopes[1]) / scene.lens.size[1]
    error = off(scene, rays, f, gx, gy)
    say(capsys, "step", error)
    assert error < 1e-9


def step_field(path, half):
    """The surface of a file as a height field, its poles at the Greville abscissae, and its control heights; and the poles."""
    (p, q), poles, (tu, tv) = step_surface(read_step(path))
    field = HeightField((SplineSpace(p, torch.as_tensor(tu)), SplineSpace(q, torch.as_tensor(tv))), half)
    return field, torch.from_numpy(poles[..., 2].copy()), poles


@pytest.mark.parametrize("half", [(5.0, 4.0), (0.05, 0.04), (500.0, 400.0)])
def test_step_rounds_to_nothing(tmp_path, half):
    """By default poles are rounded: by less than 0.1 nm, and by less than turns the surface by 2e-6."""
    random = np.random.default_rng(3)
    space = SplineSpace.uniform(40, 3)
    field, heights = HeightField((space, space), half), half[0] * (0.5 + 0.01 * torch.from_numpy(random.uniform(size=(40, 40))))
    scene, _, _ = make(**CASES["square"])
    scene = replace(scene, lens=replace(scene.lens, size=(2 * half[0], 2 * half[1])))
    write_step(tmp_path / "a.step", scene, field, heights)
    _, found, poles = step_field(tmp_path / "a.step", half)
    assert 0 < (found - heights).abs().max() <= 0.5e-7
    x, y = (c.numpy() for c in field.control_xy())
    assert max(np.abs(poles[..., 0] - x[:, None]).max(), np.abs(poles[..., 1] - y).max()) <= 0.5e-7
    exact = tmp_path / "b.step"
    write_step(exact, scene, field, heights, tolerance=0.0)
    assert (tmp_path / "a.step").stat().st_size < 0.8 * exact.stat().st_size


@pytest.mark.parametrize("limit", [0.3e6, 0.1e6])
def test_step_is_laid_on_fewer_knots(tmp_path, limit):
    """A file of limited size holds fewer poles, and they are those by which it is judged."""
    u, v = SplineSpace.uniform(90, 3), SplineSpace.uniform(80, 4)
    scene, field, _ = make(**CASES["square"])
    field = HeightField((u, v), field.half_size)
    x, y = field.control_xy()
    heights = 5 + 0.05 * torch.sin(2.0 * x)[:, None] * torch.cos(1.5 * y) + 1e-6 * torch.cos(40.0 * x)[:, None]
    choices = step.choices(scene, field, heights, limit)
    assert choices == sorted(choices, key=lambda c: c["poles"]) and choices[-1]["poles"] < 1.0
    write_step(tmp_path / "a.step", scene, field, heights, **choices[-1])
    read, found, _ = step_field(tmp_path / "a.step", field.half_size)
    assert 0.5 * limit < (tmp_path / "a.step").stat().st_size <= limit
    judged = step.readings(scene, field, heights, **choices[-1])["error"]()
    assert judged.samples == read.shape and (judged.heights == found).all()
    assert math.prod(read.shape) < 0.7 * math.prod(field.shape)
    assert 1e-8 < judged.largest_deviation(field, heights) < 1e-3


def test_step_within_a_tolerance(tmp_path):
    """The smaller the tolerance the more knots, up to the surface's own; and what cannot be is refused."""
    u, (scene, field, _) = SplineSpace.uniform(80, 3), make(**CASES["square"])
    field = HeightField((u, u), field.half_size)
    x, y = field.control_xy()
    heights, counts = 5 + 0.05 * torch.sin(2.0 * x)[:, None] * torch.cos(1.5 * y), []
    for tolerance in (1e-3, 1e-5, 1e-12):
        write_step(tmp_path / f"{tolerance}.step", scene, field, heights, tolerance=tolerance)
        read = step.readings(scene, field, heights, tolerance=tolerance)["error"]()
        assert step_field(tmp_path / f"{tolerance}.step", field.half_size)[0].shape == read.samples
        assert read.largest_deviation(field, heights) <= tolerance or read.samples == field.shape
        counts.append(read.samples[0])
    assert 4 <= counts[0] < counts[1] < counts[2] == 80
    for wrong in (-1e-3, math.nan, math.inf):
        with pytest.raises(InputError, match="tolerance"):
            write_step(tmp_path / "no.step", scene, field, heights, tolerance=wrong)


def test_fewer_knots_keep_folds():
    """A fold stays where it is, and what the fewer knots can hold comes back."""
    u, v = SplineSpace.uniform(61, 3, 2), SplineSpace.uniform(40, 3)
    field = HeightField((u, v), (2.0, 1.0))
    x, y = field.control_xy()
    folded = x.abs()[:, None] + (0.1 * y**3)[None, :]
    fewer, net = on_fewer_knots(field, folded, 800)
    assert math.prod(fewer.shape) <= 800 and (fewer.spaces[0].knots == 0.5).sum() == 3
    places = [torch.linspace(-r, r, 101, dtype=torch.float64) for r in field.half_size]
    px, py = (t.reshape(-1) for t in torch.meshgrid(*places, indexing="ij"))
    for a, b in zip(fewer.at(net, px, py), field.at(folded, px, py), strict=True):
        assert (a - b).abs().max() < 5e-3  # of slopes up to 1; a fold that is lost leaves all of them
    same = on_fewer_knots(field, folded, math.prod(field.shape))
    assert same[0] is field and same[1] is folded


def shaped(made, aperture: str, border: float):
    """The same lens with another outline."""
    scene, *rest = made
    return replace(scene, lens=replace(scene.lens, aperture=aperture, border=border)), *rest


OUTLINES = [("rectangle", 0.0), ("rectangle", 1.5), ("circle", 0.0), ("circle", 1.5)]


@pytest.mark.parametrize(
    ("case", "outline"),
    [
        *((case, OUTLINES[0]) for case in CASES.values()),
        *((CASES["square"], outline) for outline in OUTLINES[1:]),
        (CASES["non-square net and aperture"], OUTLINES[1]),
        (CASES["uneven knots"], OUTLINES[3]),
    ],
)
def test_step_is_closed(tmp_path, case, outline):
    """Every edge is used once each way, every reference exists, and the corners of every loop follow one another."""
    write_step(tmp_path / "lens.step", *shaped(make(**case), *outline))
    entities = read_step(tmp_path / "lens.step")
    sides, border = (2, 4)[outline[0] == "rectangle"], outline[1] > 0
    assert sum(body.startswith("EDGE_LOOP") for body in entities.values()) == 2 + sides + border * (sides + 2)
    assert edges_of(entities) == sides * (3 + 4 * border - border)


def test_step_in_opencascade(tmp_path, lens, rays, capsys):
    """Only where OpenCASCADE (cadquery-ocp) is installed: a valid solid, poles to the last bit, the volume, the rays."""
    pytest.importorskip("OCP.STEPControl", exc_type=ImportError)
    from OCP.Geom import Geom_BSplineSurface  # noqa: PLC0415
    from OCP.gp import gp_Pnt, gp_Vec  # noqa: PLC0415

    cases = [shaped(make(**CASES["square"]), *outline) for outline in OUTLINES]
    for k, made in enumerate([*cases, *(make(**case) for case in CASES.values()), lens]):
        scene, field, heights = made
        path = tmp_path / f"{k}.step"
        write_step(path, *made, tolerance=0.0)
        surfaces, volume = step_in_opencascade(path)
        (surface,) = (s for s in surfaces if isinstance(s, Geom_BSplineSurface))
        assert len(surfaces) == [6, 11, 4, 7, *[6] * 9][k]
        if k < len(cases):
            vertices, faces = closed_mesh(*made, samples=(201, 201))
            assert volume() == pytest.approx(signed_volume(vertices[faces]), rel=3e-5)
        net = np.array([[surface.Pole(i + 1, j + 1).Z() for j in range(field.shape[1])] for i in range(field.shape[0])])
        assert (net == heights.numpy()).all()
    found = []
    for x, y in zip(*rays[:2], strict=True):
        point, du, dv = gp_Pnt(), gp_Vec(), gp_Vec()
        surface.D1((x / field.half_size[0] + 1) / 2, (y / field.half_size[1] + 1) / 2, point, du, dv)
        found.append((point.Z(), du.Z() / du.X(), dv.Z() / dv.Y()))
    error = off(scene, rays, *np.array(found).T)
    say(capsys, "step in OpenCASCADE", error)
    assert error < 1e-9


# Mitsuba, LightTools


def test_mitsuba_meshes(tmp_path, lens, rays, capsys):
    trimesh = pytest.importorskip("trimesh")
    write_mitsuba(tmp_path / "lens.xml", *lens)
    root = ElementTree.fromstring((tmp_path / "lens.xml").read_text())
    shapes = {s.get("id"): s for s in root.iter("shape")}
    assert {"entrance", "exit", "sides", "screen", "light"} <= set(shapes)
    exit_ = trimesh.load(tmp_path / shapes["exit"].find("string").get("value"), process=False)
    error = off(lens[0], rays, *through(*grid_of(np.array(exit_.vertices)), rays))
    say(capsys, "mitsuba, exit mesh", error)
    assert error < LIMIT
    grid = sample_grid(lens[1], lens[2], None)
    assert np.abs(exit_.vertex_normals - grid.normals).max() < 1e-12
    sides = trimesh.load(tmp_path / shapes["sides"].find("string").get("value"), process=False)
    assert len(sides.faces) == 2 * (2 * sum(grid.z.shape) - 4)
    assert (np.einsum("ij,ij->i", sides.face_normals, sides.triangles_center * [1, 1, 0]) > 0).all()  # outward


def test_mitsuba_refuses_lights_it_has_not(tmp_path, lens):
    with pytest.raises(InputError, match="mitsuba"):
        write_mitsuba(tmp_path / "lens.xml", Scene(Disc(angle=0.5), lens[0].lens, lens[0].screen), *lens[1:])
    assert not list(tmp_path.iterdir())


class FakeLightTools:
    """Answers like the COM interface and remembers what it was told."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        def call(*arguments):
            self.calls.append((name, *arguments))
            if name == "GetMeshData":
                return 0, arguments[1]
            return ("FreeformEntity_3", 0) if name == "DbGet" else 0

        return call


@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.0, 1.0, -50.0), (2.0, 0.0, -60.0))), Disc(), Disc(angle=0.5)])
def test_the_lighttools_script_builds_this_lens(tmp_path, lens, rays, source, monkeypatch, capsys):
    scene = Scene(source, lens[0].lens, lens[0].screen)
    path = tmp_path / "lens.npz"
    write_lighttools(path, scene, *lens[1:])
    write_script(path, scene, *lens[1:])
    fake, client = FakeLightTools(), types.ModuleType("win32com.client")
    client.Dispatch = lambda name: fake
    package = types.ModuleType("win32com")
    package.client = client
    monkeypatch.setitem(sys.modules, "win32com", package)
    monkeypatch.setitem(sys.modules, "win32com.client", client)
    monkeypatch.setattr(sys, "argv", ["lens.py", "1e3"])
    script = companions(path)[0]
    exec(compile(script.read_text(), script, "exec"), {"__name__": "__main__", "__file__": str(script)})
    calls = {name: [c[1:] for c in fake.calls if c[0] == name] for name in {c[0] for c in fake.calls}}
    (front, rear) = calls["SetFreeformSurfacePoints"]
    assert "FrontSurface" in front[0] and {p[2] for row in front[1] for p in row} == {scene.lens.z_in}
    points = np.array(rear[1])
    assert points.shape == (*rear[2:], 3)
    error = off(scene, rays, *through(points[:, 0, 0], points[0, :, 1], points[..., 2], rays))
    say(capsys, "lighttools script", error)
    assert error < LIMIT
    sources = 2 if isinstance(source, Points) else 32 if source.kind == "disc" and not source.distant else 1
    assert len(calls["MakeSourceSurfaceCube"]) == len(calls["SetSourcePower"]) == sources
    assert {c[5:] for c in calls["MakeSourceSurfaceCube"]} == {(0, 0, 0, 0, 0, -1)}  # the face towards +z, which is its "right"
    assert sum(c[2] for c in calls["SetSourcePower"]) == pytest.approx(1.0)
    mesh = {c[1]: c[2] for c in calls["DbSet"]}
    assert (mesh["X_Dimension"], mesh["Y_Dimension"], mesh["Max_X_Bound"], mesh["Do_Noise_Reduction"]) == (64, 50, 19.2, "No")
    assert mesh["MaxProgress"] == 1000 and any("BeginAllSimulations" in c[0] for c in calls["Cmd"])
    assert np.load(tmp_path / "lens-lighttools.npy").shape == (64, 50)
    assert all(is_ours(p) for p in companions(path))


def scripted(tmp_path, monkeypatch, scene, field, heights):
    """What LightTools is told by the script of a scene, by the names of the calls; and the images that it writes."""
    write_lighttools(tmp_path / "lens.npz", scene, field, heights, samples=(9, 6))
    write_script(tmp_path / "lens.npz", scene, field, heights, samples=(9, 6))
    fake, client, package = FakeLightTools(), types.ModuleType("win32com.client"), types.ModuleType("win32com")
    client.Dispatch, package.client = (lambda name: fake), client
    monkeypatch.setitem(sys.modules, "win32com", package)
    monkeypatch.setitem(sys.modules, "win32com.client", client)
    monkeypatch.setattr(sys, "argv", ["lens.py", "1e3"])
    script = companions(tmp_path / "lens.npz")[0]
    exec(compile(script.read_text(), script, "exec"), {"__name__": "__main__", "__file__": str(script)})
    return {name: [c[1:] for c in fake.calls if c[0] == name] for name in {c[0] for c in fake.calls}}, np.load(
        tmp_path / "lens-lighttools.npy"
    )


def shone(calls) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles (N, 3) and widths (N, 2) of the sources, mm, and their powers (N,)."""
    at, cubes = np.array([c[2:] for c in calls["MoveVector"]]), calls["MakeSourceSurfaceCube"]
    return at, np.array([(wide, high) for _, high, wide, *_ in cubes]), np.array([c[2] for c in calls["SetSourcePower"]])


@pytest.mark.parametrize(
    ("source", "variances"),
    [
        (Disc((1.0, -2.0, -60.0), (4.0, 2.0)), (1.0, 0.25)),  # of an ellipse a^2 / 4 and b^2 / 4
        (Disc((1.0, -2.0, -60.0), (4.0, 0.0)), (1.0, 0.0)),
        (Disc((1.0, -2.0, -60.0), (4.0, 2.0), brightness=np.ones((100, 3))), (16.0 / 12.0, 4.0 / 12.0)),
        (PlaneWave(profile=np.ones((5, 70))), None),
    ],
)
def test_a_source_of_the_script_has_its_extent(tmp_path, lens, monkeypatch, source, variances):
    """Powers, centroids and variances of what shines are those of closed forms."""
    scene = replace(lens[0], source=source)
    half = scene.lens.half_size
    calls, _ = scripted(tmp_path, monkeypatch, scene, *lens[1:])
    at, size, power = shone(calls)
    assert power.sum() == pytest.approx(1.0) and len(power) <= 32 * 32
    for k, wanted in enumerate(variances or (half[0] ** 2 / 3.0, half[1] ** 2 / 3.0)):
        middle = (power * at[:, k]).sum()
        assert middle == pytest.approx(0.0 if source.distant else source.position[k], abs=1e-6)
        assert (power * ((at[:, k] - middle) ** 2 + size[:, k] ** 2 / 12.0)).sum() == pytest.approx(wanted, rel=5e-3, abs=1e-6)


def test_a_profile_of_the_script_is_where_it_is(tmp_path, lens, monkeypatch):
    """Also one of more cells than the script has, whose sums over equal parts are kept."""
    for light in (np.array([[1.0, 0.0, 2.0], [0.5, 3.0, 1.0]]), np.random.default_rng(1).random((96, 64))):
        calls, _ = scripted(tmp_path, monkeypatch, replace(lens[0], source=PlaneWave(2.0, light)), *lens[1:])
        at, _, power = shone(calls)
        (n, m), (rx, ry) = (min(k, 32) for k in light.shape), lens[0].lens.half_size
        i, j = np.floor((at[:, 0] / rx + 1.0) / 2.0 * n).astype(int), np.floor((at[:, 1] / ry + 1.0) / 2.0 * m).astype(int)
        found = np.zeros((n, m))
        found[i, j] = power
        sums = light.reshape(n, light.shape[0] // n, m, light.shape[1] // m).sum((1, 3))
        assert found == pytest.approx(2.0 * sums / sums.sum())


def test_the_script_runs_each_source_and_each_wavelength(tmp_path, lens, monkeypatch):
    light = Light(wavelengths=(450.0, 650.0), weights=(1.0, 3.0), unit="lm")
    sources = Several((PlaneWave(2.0), Disc((0.0, 0.0, -60.0), power=3.0)), ((light.wavelengths, light.weights),) * 2)
    scene, field, heights = lens
    scene = replace(scene, source=sources, light=light, lens=replace(scene.lens, glass="N-BK7"))
    scene = replace(scene, screen=replace(scene.screen, shift=(3.0, -1.5)))
    calls, image = scripted(tmp_path, monkeypatch, scene, field, heights)
    assert len(calls["NewV3D"]) == 4 and image.shape == (4, *scene.screen.resolution)
    powers = np.array([c[2] for c in calls["SetSourcePower"]])
    assert powers[:2] == pytest.approx([0.5, 1.5]) and powers[2:34].sum() == pytest.approx(0.75)
    assert powers[34:].sum() == pytest.approx(2.25)
    given = [c[2] for c in calls["DbSet"] if c[1] == "Refractive_Index"]
    assert given == pytest.approx([nearest_index("N-BK7", w) for w in (*light.wavelengths, *light.wavelengths)])
    assert [c[1:4] for c in calls["MakeDummyPlane"]] == [(3.0, -1.5, scene.screen.z)] * 4


def test_the_lighttools_script_builds_both_sides(tmp_path, lens, monkeypatch):
    """Their points are those of scipy's splines, by each side's own knots; a plane wave begins before all of the entrance."""
    scene, field, heights = lens
    rng = np.random.default_rng(2)
    knots = tuple(np.r_[[0.0] * (p + 1), np.sort(rng.random(6)), [1.0] * (p + 1)].tolist() for p in (3, 2))
    front = FreeForm(rng.uniform(-2.0, -1.2, (10, 9)), (3, 2), knots)
    scene = replace(scene, source=PlaneWave(), lens=replace(scene.lens, entrance=front, offset=Offset(12.0)))
    write_lighttools(tmp_path / "lens.npz", scene, field, heights + 8.0, samples=(31, 22))
    write_script(tmp_path / "lens.npz", scene, field, heights + 8.0, samples=(31, 22))
    script, block = companions(tmp_path / "lens.npz")
    monkeypatch.setattr(sys, "argv", ["lens.py"])
    held: dict = {"__name__": "script", "__file__": str(script)}
    exec(compile(script.read_text(), script, "exec"), held)
    archive = dict(np.load(tmp_path / "lens.npz", allow_pickle=False))
    fake = FakeLightTools()
    held["build_lens"](fake, archive, 1.5)
    held["build_source"](fake, fake, archive, 1.0)
    x, y = (np.linspace(-r, r, n) for r, n in zip(scene.lens.half_size, (31, 22), strict=True))
    over = zip((31, 22), knots, (3, 2), strict=True)
    u, v = (BSpline.design_matrix(np.linspace(0.0, 1.0, n), t, p).toarray() for n, t, p in over)
    goal = scene.lens.z_in + u @ front.heights @ v.T
    calls = {(c[0], c[1].rpartition("[")[2] if c[0].startswith("SetFree") else ""): c for c in fake.calls}
    found = np.array(calls["SetFreeformSurfacePoints", "FrontSurface]"][2])
    np.testing.assert_allclose(found[..., 2], goal, atol=1e-12)
    np.testing.assert_allclose(found[:, 0, 0], x, atol=1e-12)
    np.testing.assert_allclose(found[0, :, 1], y, atol=1e-12)
    assert calls["MoveVector", ""][5] <= goal.min() - 1.0
    words = block.read_text().split("restorePoints:")[1].splitlines()[3:]
    points = np.array(" ".join(words).partition(" 0 1 4 C")[0].split(), float).reshape(22, 31, 3).swapaxes(0, 1)
    np.testing.assert_allclose(points[..., 2], goal, atol=1e-12)


def test_the_lighttools_block_holds_the_points(tmp_path, lens):
    write_script(tmp_path / "lens.npz", *lens, samples=(9, 6))
    text = companions(tmp_path / "lens.npz")[1].read_text()
    blocks = re.findall(r"restorePoints:\nORAStartData;\n(.*?)\nORAEndData;\nORAReadForeignData;\n} restore(\w+):", text, re.S)
    assert [name for _, name in blocks] == ["Front", "Rear"]
    words = blocks[1][0].split()
    assert words[:10] == ["0", "0", "9", "6", "0", "0", "54", "0", "0", "0"]
    assert words[-8:] == ["1", "4", "CartesianMapper", "1", "0", "0", "0", "0"]
    points = np.array(words[10:-9], float).reshape(6, 9, 3)
    expected = sample_grid(lens[1], lens[2], (9, 6)).points.reshape(9, 6, 3).swapaxes(0, 1)
    assert (points == expected).all()


# all of them


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (write_lighttools, "a.npz"),
        (write_zemax, "a.dat"),
        (write_step, "a.step"),
        (write_stl, "a.stl"),
        (write_ply, "a.ply"),
        (write_obj, "a.obj"),
        (write_csv, "a.csv"),
        (write_xyz, "a.xyz"),
        (write_mitsuba, "a.xml"),
    ],
)
def test_bytes_repeat(tmp_path, write, name):
    made = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / name, *make())
        made.append({p.name: p.read_bytes() for p in (tmp_path / folder).iterdir()})
    assert made[0] == made[1] and made[0]


# and back


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize(("write", "name"), [(write_lighttools, "lens.npz"), (partial(write_step, tolerance=0.0), "lens.step")])
def test_the_spline_comes_back_to_the_last_bit(tmp_path, case, write, name):
    scene, field, heights = make(**case)
    write(tmp_path / name, scene, field, heights)
    again, net = read_surface(tmp_path / name, scene.lens.half_size)
    assert (net == heights).all() and again.half_size == field.half_size
    assert all((a.knots == b.knots).all() and a.degree == b.degree for a, b in zip(again.spaces, field.spaces, strict=True))
    assert onto(again, net, field).allclose(heights, rtol=1e-12)


def test_heights_on_the_knots_come_back(tmp_path, lens, rays, capsys):
    scene, field, heights = lens
    samples = tuple(STEPS_PER_SPAN * (n - 3) + 1 for n in field.shape)
    np.save(tmp_path / "z.npy", sample_grid(field, heights, samples).z)
    net = onto(*read_surface(tmp_path / "z.npy", scene.lens.half_size), field)
    assert (net - heights).abs().max() < 1e-9
    f, gx, gy = (t.numpy() for t in field.at(net, *map(torch.as_tensor, rays[:2])))
    error = off(scene, rays, f, gx, gy)
    say(capsys, "heights.npy", error)
    assert error < 1e-6


def test_readers_refuse(tmp_path, lens):
    half = lens[0].lens.half_size
    write_step(tmp_path / "lens.step", *lens)
    write_lighttools(tmp_path / "lens.npz", *lens)
    whole = (tmp_path / "lens.step").read_text()
    texts = {
        "no.step": "no step",
        "inch.step": whole.replace("(.MILLI.,", "($,"),
        "cut.step": whole[: len(whole) // 9],
        "bent.step": whole.replace("(-5.,-4.,", "(-5.1,-4.,", 1),
        "two.step": whole.replace("ENDSEC;\nEND", re.search(r"#\d+=B_SPLINE_SURFACE.*", whole)[0] + "\nENDSEC;\nEND"),
        "text.npz": "no archive",
        "lens.dxf": "no",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with np.load(tmp_path / "lens.npz") as data:
        arrays = dict(data)
    for name, change in {
        "shape.npz": {"control_points": arrays["control_points"][:-1]},
        "degree.npz": {"degrees": np.ones(3)},
        "nan.npz": {"control_points": arrays["control_points"] * np.nan},
    }.items():
        np.savez(tmp_path / name, **{**arrays, **change})
    np.save(tmp_path / "flat.npy", np.ones(5))
    names = [*texts, "other.npz", "shape.npz", "degree.npz", "nan.npz", "flat.npy", "missing.npz"]
    for name in names:
        with pytest.raises(InputError, match=name):
            read_surface(tmp_path / name, half)
    for name in ("lens.step", "lens.npz"):
        with pytest.raises(InputError, match="lens_size"):
            read_surface(tmp_path / name, (5.0, 5.0))


def test_a_height_map_of_many_points_is_read_back(tmp_path):
    """Rounding that falls together is no edit."""
    scene, field, heights = make(control=(259, 259), relief=0.02)
    write_heightmap(tmp_path / "z.png", part_of("heightmap", scene, field, heights))
    found, again = read_heightmap(tmp_path / "z.png", field.half_size)
    assert found.shape == field.shape
    x, y = (9.9 * torch.rand(500, generator=torch.Generator().manual_seed(k), dtype=torch.float64) - 4.95 for k in (0, 1))
    assert float((found.at(again, x, y)[0] - field.at(heights, x, y)[0]).abs().max()) < 2e-6


@pytest.mark.parametrize("name", ["tom&jerry.xml", 'a "b" <c>.xml'])
def test_mitsuba_files_of_any_name_are_xml(tmp_path, name):
    scene, field, heights = make()
    write_mitsuba(tmp_path / name, scene, field, heights)
    named = [e.get("value") for e in ElementTree.parse(tmp_path / name).iter("string") if e.get("name") == "filename"]
    assert named and all((tmp_path / n).is_file() for n in named)


def test_an_archive_stands_where_its_lens_did(tmp_path):
    """Another lens right behind a thin one is behind it."""
    scene, field, heights = make()
    thin = replace(scene, lens=replace(scene.lens, offset=Offset(1.0)), elements=(Component(3.0, (10.0, 10.0), 1.0),))
    write_lighttools(tmp_path / "lens.npz", thin, field, heights - heights.mean() + 1.0)
    assert open_archive(tmp_path / "lens.npz")[0].lens.offset.thickness == pytest.approx(1.0, abs=0.3)
