"""Files of the solid of a lamp: STEP, meshes, its foot, and its scene for Mitsuba with the comparison."""

import ast
import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from helpers import arguments, edges_of, read_step, step_in_opencascade
from rayfiles import zemax
from scipy.interpolate import BSpline

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.lamp import flange_radius, lamp_mesh, lamp_parts
from caustic_cli.export.lamp_mitsuba import FINE, companions, plane_of, write_lamp_mitsuba
from caustic_cli.export.lamp_step import nurbs, write_lamp_step
from caustic_cli.inverse.lamp import pixels_of, wanted
from caustic_cli.inverse.refractor_transport import source_directions
from caustic_cli.optics.lamp import ChipRays, PointGrid, chip_grids, emissions, land, through
from caustic_cli.optics.lamp_side import PolarSide
from caustic_cli.optics.surfaces.polarfield import PolarField, direction_of
from caustic_cli.project.project import Project
from caustic_cli.scene.lamp import Chip, Goal, Lamp
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.studies import lamp_verify
from caustic_cli.studies.lamp import lamp_figures
from caustic_cli.workflow.lamp import LampDesign

FIELD = PolarField.uniform((12, 9), (3, 4))


def bumpy(radius, seed):
    """Control values of r of a sphere with bumps."""
    noise = torch.randn(FIELD.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return FIELD.sphere(radius) * (0.05 * noise).exp()


ONE, TWO = bumpy(12.0, 0), torch.stack([bumpy(4.0, 1), bumpy(12.0, 0)])
#: Lamp, control values, and faces and edges of its solid.
CASES = {
    "ring": (Lamp(), ONE, 3, 4),
    "foot": (Lamp(base=1.5), ONE, 7, 12),
    "flange": (Lamp(base=1.0, flange=2.0), ONE, 8, 14),
    "two surfaces": (Lamp(surfaces=2, inner=3.0, base=1.5, flange=2.0), TWO, 8, 14),
    "flat": (Lamp(inner=5.0, flat=0.8), ONE, 5, 8),
    "flat, flange": (Lamp(inner=5.0, flat=0.8, base=1.0, flange=2.0), ONE, 8, 14),
}


def random_directions(count):
    """Coordinates (u, v) of the lit side, (N,) each."""
    u, v = 2.0 * torch.rand(2, count, dtype=torch.float64, generator=torch.Generator().manual_seed(7)) - 1.0
    lit = u * u + v * v < 1.0
    return u[lit], v[lit]


def surfaces_in(entities):
    """The rational surfaces of a file: degrees, homogeneous poles (N, M, 4), knots."""
    for body in entities.values():
        if not body.startswith("(BOUNDED_SURFACE"):
            continue
        parts = re.fullmatch(
            r"\(BOUNDED_SURFACE\(\)B_SPLINE_SURFACE(\(.*\))B_SPLINE_SURFACE_WITH_KNOTS(\(.*\))GEOMETRIC_REPRESENTATION_ITEM\(\)"
            r"RATIONAL_B_SPLINE_SURFACE(\(.*\))REPRESENTATION_ITEM\(''\)SURFACE\(\)\)",
            body,
        )
        (p, q, net, *_), (mu, mv, ku, kv, _) = arguments(parts[1]), arguments(parts[2])
        weights = ast.literal_eval(parts[3])
        poles = np.array([[arguments(entities[int(r[1:])])[1] for r in row] for row in net])
        weights = np.array(weights)[..., None]
        assert (weights > 0).all()
        yield (p, q), np.concatenate([poles * weights, weights], -1), (np.repeat(ku, mu), np.repeat(kv, mv))


def evaluated(surface, u, v):
    """Points (N, 3) of a rational surface over [0, 1]^2."""
    (p, q), net, (ku, kv) = surface
    bu, bv = BSpline.design_matrix(u, ku, p).toarray(), BSpline.design_matrix(v, kv, q).toarray()
    found = np.einsum("ai,aj,ijk->ak", bu, bv, net)
    return found[:, :3] / found[:, 3:]


# STEP


@pytest.mark.parametrize("case", CASES)
def test_the_surfaces_of_a_step_file_are_those_of_the_lamp(case, tmp_path):
    lamp, values, *_ = CASES[case]
    write_lamp_step(tmp_path / "a.step", lamp, FIELD, values)
    outer, *inner = surfaces_in(read_step(tmp_path / "a.step"))
    u, v = random_directions(2000)
    at = 0.5 * (u.numpy() + 1.0), 0.5 * (v.numpy() + 1.0)
    wanted = np.stack(FIELD.points(values if values.ndim == 2 else values[1], u, v), 1)
    assert np.abs(evaluated(outer, *at) - wanted).max() < 1e-12
    if lamp.flat is None:
        inside = np.stack(FIELD.points(FIELD.sphere(lamp.inner) if values.ndim == 2 else values[0], u, v), 1)
        assert np.abs(evaluated(inner[0], *at) - inside).max() < 1e-12
    assert len(inner) == (lamp.flat is None)
    moved = np.stack(FIELD.points(1.001 * (values if values.ndim == 2 else values[1]), u, v), 1)
    assert np.abs(evaluated(outer, *at) - moved).max() > 1e-3


def test_the_spline_has_the_degree_and_smoothness_that_its_product_has():
    spaces, poles, weights = nurbs(FIELD, ONE)
    assert [s.degree for s in spaces] == [5, 6] and poles.shape == (*(s.n for s in spaces), 3)
    for own, space in zip(FIELD.spaces, spaces, strict=True):
        breaks, times = torch.unique(space.knots, return_counts=True)
        assert breaks.tolist() == own.breaks.tolist() and times[1:-1].tolist() == [3] * (len(breaks) - 2)
    assert weights.min() > 0.5


@pytest.mark.parametrize("case", CASES)
def test_a_step_file_is_a_closed_shell(case, tmp_path):
    """Every edge is used once each way, the corners of every loop follow one another, and edges end where their curves do."""
    lamp, values, faces, edges = CASES[case]
    write_lamp_step(tmp_path / "a.step", lamp, FIELD, values)
    entities = read_step(tmp_path / "a.step")
    assert edges_of(entities) == edges
    assert sum(b.startswith("ADVANCED_FACE") for b in entities.values()) == faces


@pytest.mark.parametrize("case", CASES)
def test_step_in_opencascade(case, tmp_path):
    """Only where OpenCASCADE (cadquery-ocp) is installed: a valid solid, its volume, and its points."""
    pytest.importorskip("OCP.STEPControl", exc_type=ImportError)
    from OCP.Geom import Geom_BSplineSurface  # noqa: PLC0415

    lamp, values, faces, _ = CASES[case]
    write_lamp_step(tmp_path / "a.step", lamp, FIELD, values)
    surfaces, mass = step_in_opencascade(tmp_path / "a.step")
    assert len(surfaces) == faces
    assert mass() == pytest.approx(volume(*lamp_mesh(lamp, FIELD, values, (200, 800))), rel=1e-4)
    outer, *inner = [s for s in surfaces if isinstance(s, Geom_BSplineSurface)]
    assert len(inner) == (lamp.flat is None)
    u, v = random_directions(300)
    nets = (values, FIELD.sphere(lamp.inner)) if values.ndim == 2 else (values[1], values[0])
    for surface, net in zip((outer, *inner), nets, strict=False):
        points = [surface.Value(0.5 * (a + 1.0), 0.5 * (b + 1.0)) for a, b in zip(u.tolist(), v.tolist(), strict=True)]
        seen = np.array([(p.X(), p.Y(), p.Z()) for p in points])
        assert np.abs(seen - np.stack(FIELD.points(net, u, v), 1)).max() < 1e-9


# Meshes


def volume(vertices, faces):
    """Signed volume of a closed mesh."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6.0)


@pytest.mark.parametrize("case", CASES)
def test_meshes_are_closed_and_have_their_foot(case):
    lamp, values, *_ = CASES[case]
    vertices, faces = lamp_mesh(lamp, FIELD, values, (60, 240))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    seen = {tuple(edge) for edge in edges.tolist()}
    assert len(seen) == len(edges) and all((b, a) in seen for a, b in seen)
    assert vertices[:, 2].min() == -lamp.base and volume(vertices, faces) > 0


def test_a_foot_has_the_volume_of_its_cylinders():
    bare, foot, flange = Lamp(), Lamp(base=2.0), Lamp(base=2.0, flange=3.0)
    own, below, around = (volume(*lamp_mesh(lamp, FIELD, FIELD.sphere(10.0), (60, 960))) for lamp in (bare, foot, flange))
    assert below - own == pytest.approx(2.0 * math.pi * (10.0**2 - 4.0**2), rel=1e-4)
    assert around - own == pytest.approx(2.0 * math.pi * (13.0**2 - 4.0**2), rel=1e-4)
    assert flange_radius(flange, PolarSide(FIELD, FIELD.sphere(10.0))) == pytest.approx(13.0)


@pytest.mark.parametrize("base", [0.0, 2.0])
def test_the_cavity_below_a_flat_side_is_a_cylinder(base):
    lamp = Lamp(flat=0.5, base=base)
    solid, foot = 2.0 / 3.0 * math.pi * 10.0**3, base * math.pi * 10.0**2
    expected = solid + foot - math.pi * 4.0**2 * (0.5 + base)
    assert volume(*lamp_mesh(lamp, FIELD, FIELD.sphere(10.0), (60, 960))) == pytest.approx(expected, rel=2e-4)


def test_a_flange_without_thickness_is_refused():
    with pytest.raises(InputError, match="a flange needs the thickness"):
        Lamp(flange=1.0)
    with pytest.raises(InputError, match="must not be negative"):
        Lamp(base=-1.0)


# Mitsuba


ROAD = Goal((9000.0, 6000.0), 4000.0, (300.0, -500.0))


class InItsPlace:
    """Stands for Mitsuba: traces a lamp of its own by `optics.lamp`, rays from `verify_lamp`."""

    LogLevel, __version__ = SimpleNamespace(Error=0), "none"

    def __init__(self, lamp, goal, values):
        self.lamp, self.goal, self.values = lamp, goal, values

    def set_log_level(self, level):
        """Nothing to be silent about."""

    def load_file(self, path, optimize):
        """The scene, of which the shapes are asked."""
        assert not optimize
        self.shapes_in = re.findall(r'id="(\w+)"', Path(path).read_text())
        return SimpleNamespace(shapes=list)

    def follow(self, _mi, _world, _shapes, surfaces, start, direction, _rng):
        assert {one.name for one in surfaces} <= set(self.shapes_in)
        count = start.shape[1]
        rays = ChipRays(
            tuple(torch.from_numpy(c) for c in start), tuple(torch.from_numpy(c) for c in direction), torch.ones(count).double()
        )
        with torch.no_grad():
            light = through(self.lamp, FIELD, rays, self.values)
        x, y, ahead = land(self.goal, light)
        power = torch.where(ahead, light.power, 0.0 * x).numpy()
        return x.numpy() + self.goal.shift[0], y.numpy() + self.goal.shift[1], None, power


@pytest.mark.parametrize("chip", [Chip(), Chip("disc", (1.5, 1.0)), Chip("rectangle", (1.0, 2.0))])
def test_a_lamp_is_compared_and_another_one_differs(chip, tmp_path, monkeypatch):
    lamp, values = Lamp(chip), FIELD.sphere(12.0) * (0.5 * (bumpy(12.0, 0) / 12.0).log()).exp()

    def found(own, net):
        other = InItsPlace(own, ROAD, net)
        monkeypatch.setitem(sys.modules, "mitsuba", other)
        monkeypatch.setattr(lamp_verify, "follow", other.follow)
        write_lamp_mitsuba(tmp_path / "a.xml", lamp, ROAD, FIELD, values, (24, 16), (5, 20), dark=True)
        return lamp_verify.verify_lamp(tmp_path / "a.xml", lamp, ROAD, FIELD, values, (24, 16), 300_000)

    monkeypatch.setattr(lamp_verify, "choose_variant", lambda: "none")
    same = found(lamp, values)
    assert same.agree and 0.7 < same.figures["z_mean_square"] < 1.3, same.figures
    assert not found(replace(lamp, index=1.6), values).agree
    assert not found(lamp, values.flip(0)).agree


def test_mitsuba_agrees(tmp_path):
    """Only where Mitsuba is installed."""
    pytest.importorskip("mitsuba", exc_type=ImportError)
    lamp, values = Lamp(Chip("rectangle", (1.0, 2.0)), base=1.0, flange=2.0), bumpy(12.0, 0)
    cases = [(lamp, ROAD, values), (lamp, Goal((100.0, 60.0)), values), (Lamp(surfaces=2, inner=3.0), ROAD, TWO)]
    for own, goal, net in cases:
        write_lamp_mitsuba(tmp_path / "a.xml", own, goal, FIELD, net, (24, 16), FINE, dark=True)
        seen = plane_of(goal, own.radius)
        found = lamp_verify.verify_lamp(tmp_path / "a.xml", own, seen, FIELD, net, (24, 16), 100_000)
        assert found.agree and 0.8 < found.figures["z_mean_square"] < 1.2, found.figures


def test_the_far_field_is_seen_on_a_distant_plane():
    assert plane_of(ROAD, 15.0) is ROAD
    seen = plane_of(Goal((90.0, 170.0)), 15.0)
    assert seen.distance == 15000.0 and seen.size == pytest.approx((30000.0, 30000.0 * math.tan(math.radians(70.0))))


def test_the_scene_holds_closed_glass_and_a_chip_of_its_light(tmp_path):
    lamp = Lamp(Chip("disc", (2.0, 1.0)), base=1.0)
    write_lamp_mitsuba(tmp_path / "a.xml", lamp, ROAD, FIELD, ONE, (30, 20), (20, 60))
    root = ElementTree.fromstring((tmp_path / "a.xml").read_text())
    shapes = {shape.get("id"): shape for shape in root.iter("shape")}
    assert set(shapes) == {"inner", "outer", "foot", "screen", "light"}
    assert all(path.is_file() for path in companions(tmp_path / "a.xml"))
    radiance = float(shapes["light"].find("emitter/rgb").get("value"))
    assert radiance * math.pi * math.pi * 2.0 * 1.0 / 4.0 == pytest.approx(1.0)
    for (points, faces, normals), name in zip(lamp_parts(lamp, FIELD, ONE, (20, 60)), companions(tmp_path / "a.xml"), strict=True):
        assert name.read_bytes().count(b"property double nx") == (normals is not None)
        if normals is not None:  # out of the glass, as the triangles face
            a, b, c = points[faces].transpose(1, 0, 2)
            facing = np.cross(b - a, c - a)
            assert ((facing * normals[faces[:, 0]]).sum(1) > 0.9 * np.linalg.norm(facing, axis=1)).all()


# Tabulated chips

NARROW = Distribution((0.0, 20.0, 50.0, 90.0), (2.0, 1.8, 0.4, 0.0))


def mean_cosine(intensity):
    """Mean of cos(theta) over the light of a distribution, by quadrature."""
    theta = np.linspace(0.0, 0.5 * math.pi, 20_001)
    weight = intensity.relative(theta) * np.sin(theta)
    return float((weight * np.cos(theta)).sum() / weight.sum())


@pytest.mark.parametrize("size", [(0.0, 0.0), (2.0, 1.0)])
def test_the_light_of_a_tabulated_chip_has_its_intensity(size):
    chip = Chip("rectangle" if size[0] else "point", size, NARROW)
    wanted = mean_cosine(NARROW)
    rays = [emissions(chip, 40_000, 1), chip_grids(chip, 4, 40_000) if size[0] else []]
    for parts in map(list, rays):
        if parts:
            assert sum(float((part.power * part.direction[2]).sum()) for part in parts) == pytest.approx(wanted, abs=3e-3)
            assert sum(float(part.power.sum()) for part in parts) == pytest.approx(1.0)
            norm = torch.stack(parts[0].direction).norm(dim=0)
            torch.testing.assert_close(norm, torch.ones_like(norm))
    grids = PointGrid.of(FIELD, 40_000, chip.centre)
    cosine = sum(float((grid.power * direction_of(grid.u, grid.v)[2]).sum()) for grid in grids)
    assert cosine == pytest.approx(wanted, abs=1e-3)
    directions, power = source_directions(60, chip)
    assert float((power * directions[:, 2]).sum()) == pytest.approx(wanted, abs=3e-3)
    origin, direction = lamp_verify._of_chip(chip, 40_000, np.random.default_rng(1))
    assert direction[2].mean() == pytest.approx(wanted, abs=5e-3) and origin.shape == (3, 40_000)


def test_a_table_of_lamberts_law_is_no_table():
    angles = np.linspace(0.0, 90.0, 901)
    table = Chip(intensity=Distribution(tuple(angles), tuple(np.cos(np.radians(angles)).clip(0.0))))
    for one, other in zip(emissions(Chip(), 2000, 1), emissions(table, 2000, 1), strict=True):
        for a, b in zip(one.direction, other.direction, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=1e-3)


def test_a_tabulated_chip_is_designed_for_and_kept(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("led.csv").write_text("angle,intensity\n0,2\n20,1.8\n50,0.4\n90,0\n")
    given = ["--lamp", "15", "--angles", "100x60", "--quiet", "--json"]
    found = {}
    for name, more in (("table", ["--chip-intensity", "led.csv"]), ("law", [])):
        assert cli.run(["design", "uniform", *given, *more, "-o", name]) == 0
        found[name] = json.loads(capfd.readouterr().out)
    assert Path("table/chip.csv").read_bytes() == Path("led.csv").read_bytes()
    Path("led.csv").unlink()
    assert cli.run(["render", "table", "--rays", "40000", "-o", "a.png", "--json", "--quiet"]) == 0
    seen = json.loads(capfd.readouterr().out)
    assert seen["of_source"] == pytest.approx(found["table"]["of_source"], abs=0.01) and found["law"]["of_source"] > 0.8
    lamp = LampDesign.of(Project.open("table"))
    assert lamp.lamp.chip.intensity == NARROW
    one, other = (
        lamp_figures(replace(lamp.lamp, chip=chip), lamp.goal, lamp.field, lamp.values, *targets(lamp.goal), rays=40_000)[1]
        for chip in (lamp.lamp.chip, Chip())
    )
    assert one["interior_rms"] < 0.7 * other["interior_rms"]  # the lens is made for its chip
    assert cli.run(["export", "table", "--format", "mitsuba"]) == 2
    assert "obey Lambert's law" in capfd.readouterr().err


def measured(count=20_000):
    """Rays of a Lambertian chip of 1 x 0.6 mm half a millimetre above the board, of unequal flux."""
    rng = np.random.default_rng(4)
    sine, turn = np.sqrt(rng.uniform(size=count)), 2.0 * math.pi * rng.uniform(size=count)
    directions = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.sqrt(1.0 - sine * sine)], 1)
    positions = np.stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.3, 0.3, count), np.full(count, 0.5)], 1)
    kept = rng.uniform(0.5, 1.5, count)
    return RaySet(positions, directions, kept)


def test_the_rays_of_a_file_are_drawn_by_their_flux():
    rays = measured()
    chip = Chip.of_rays(rays)
    assert chip.size == pytest.approx((1.0, 0.6), abs=1e-2) and chip.reach == pytest.approx(math.hypot(0.5, 0.3, 0.5), abs=0.02)
    assert mean_cosine(chip.intensity) == pytest.approx(2.0 / 3.0, abs=0.01)  # Lambert's law, in classes of 5 degrees
    share = rays.flux / rays.flux.sum()
    for (part,) in (list(emissions(chip, 100_000, 1)), list(chip_grids(chip, 4, 100_000))):
        assert float(part.power.sum()) == pytest.approx(1.0) and float(part.origin[2].min()) == 0.5
        for k in range(3):
            mean = float((part.power * part.direction[k]).sum())
            assert mean == pytest.approx(float((share * rays.directions[:, k]).sum()), abs=6e-3)
    dark = replace(rays, directions=rays.directions * [1.0, 1.0, -1.0])
    with pytest.raises(InputError, match="light within 90 degrees"):
        Chip.of_rays(dark)


def test_a_chip_of_a_ray_file_is_designed_for_and_kept(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    rays = measured()
    Path("led.dat").write_bytes(zemax(rays.positions, rays.directions, rays.flux))
    given = ["--lamp", "15", "--angles", "100x60", "--chip-rays", "led.dat"]
    assert cli.run(["design", "uniform", *given, "--quiet", "--json", "-o", "led"]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert figures["of_source"] > 0.75 and figures["of_source"] + sum(figures["lost"].values()) == pytest.approx(1.0)
    assert Path("led/chip-rays.dat").read_bytes() == Path("led.dat").read_bytes()
    Path("led.dat").unlink()
    lamp = LampDesign.of(Project.open("led"))
    assert lamp.lamp.chip.shape == "rays" and len(lamp.lamp.chip.rays.flux) == 20_000
    assert cli.run(["export", "led", "--format", "ldt", "--quiet"]) == 0
    Path("led.dat").write_bytes(zemax(20.0 * rays.positions, rays.directions, rays.flux))
    for more, words in (([], "greater than the radius of the chip"), (["--chip", "1"], "leave out --chip")):
        assert cli.run(["design", "uniform", *given, *more, "--quiet"]) == 2
        assert words in capfd.readouterr().err


def targets(goal):
    """A uniform target on few pixels, twice."""
    return [wanted(goal, np.ones((2, 2)), pixels_of(goal, count)).numpy() for count in (600, 100)]
