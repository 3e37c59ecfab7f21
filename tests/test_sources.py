"""What sources say of themselves, against hand values; no other file asks for their class; a source from outside."""

import ast
import math
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch
from test_export import make

import caustic_cli
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mitsuba import write_mitsuba
from caustic_cli.optics import emission
from caustic_cli.optics.bounds import bounds_of
from caustic_cli.optics.emission.near import Near
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.project.completion import complete
from caustic_cli.scene import (
    Aperture,
    CircularAperture,
    Disc,
    Lens,
    Offset,
    PlaneWave,
    Points,
    Pupil,
    Scene,
    Screen,
    Source,
    sources,
)
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.section import SourceType
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies import verify

PACKAGE = Path(caustic_cli.__file__).parent
INF = math.inf
#: Source: kind, collimated, distant, half angle (degrees), nearest, centre, power, extent, several, extended, apart, sharp.
FACTS = {
    "plane": (PlaneWave(2.0), ("plane", True, True, 0.0, -INF, (0, 0, -INF), 2.0, (0, 0), False, False, False, True)),
    "point": (
        Points(((1.0, 2.0, -5.0),), (3.0,)),
        ("point", False, False, 0.0, -5.0, (1, 2, -5), 3.0, (0, 0), False, False, False, True),
    ),
    "points": (
        Points(((0.0, 0.0, -5.0), (4.0, 0.0, -9.0)), (1.0, 3.0)),
        ("point", False, False, 0.0, -5.0, (3, 0, -8), 4.0, (0, 0), True, True, True, False),
    ),
    "grid": (
        Points.grid((1.0, 0.0, -5.0), (2.0, 4.0), (3, 2), 6.0),
        ("grid", False, False, 0.0, -5.0, (1, 0, -5), 6.0, (0, 0), True, True, False, False),
    ),
    "grid of one": (
        Points.grid((1.0, 0.0, -5.0), (2.0, 4.0), (1, 1)),
        ("grid", False, False, 0.0, -5.0, (1, 0, -5), 1.0, (0, 0), False, False, False, False),
    ),
    "disc": (
        Disc((1.0, 0.0, -8.0), (4.0, 3.0), 2.0),
        ("disc", False, False, 0.0, -8.0, (1, 0, -8), 2.0, (2, 1.5), False, True, False, False),
    ),
    "disc of no size": (
        Disc((1.0, 0.0, -8.0), (0.0, 0.0)),
        ("disc", False, False, 0.0, -8.0, (1, 0, -8), 1.0, (0, 0), False, False, False, False),
    ),
    "laser": (
        Gaussian((1.0, 1.0), 1000.0),
        ("gaussian", True, True, 0.0, -INF, (0, 0, -INF), 1.0, (0, 0), False, False, False, True),
    ),
    "focused laser": (
        Gaussian((1.0, 1.0), 1000.0, 50.0, 2.0, power=2.0),
        ("gaussian", False, True, 0.07893209471521968, -INF, (0, 0, -INF), 2.0, (0, 0), False, True, False, False),
    ),
    "sun": (Disc(angle=0.5, power=2.0), ("disc", False, True, 0.25, -INF, (0, 0, -INF), 2.0, (0, 0), False, True, False, False)),
}


@pytest.mark.parametrize("name", FACTS)
def test_the_facts_of_every_source(name):
    s, (kind, collimated, distant, half, nearest, centre, power, extent, several, extended, apart, sharp) = FACTS[name]
    assert isinstance(s, Source)
    assert (s.kind, s.collimated, s.distant, s.nearest) == (kind, collimated, distant, nearest)
    assert (s.several, s.extended, s.apart, s.sharp) == (several, extended, apart, sharp)
    assert s.half_angle == pytest.approx(math.radians(half)) and s.power == pytest.approx(power)
    assert s.centre == pytest.approx(centre) and s.extent == extent
    positions, parts = s.points()
    assert positions.shape == (len(parts), 3) and len(parts) == (0 if distant else len(s.powers))
    assert sum(s.powers) == pytest.approx(power)
    if not distant:
        assert parts.sum() == pytest.approx(1.0) and parts * power == pytest.approx(np.array(s.powers))
        assert positions[:, 2].max() == nearest


def test_positions_and_parts():
    positions, parts = FACTS["points"][0].points()
    assert positions.tolist() == [[0, 0, -5], [4, 0, -9]] and parts.tolist() == [0.25, 0.75]
    positions, parts = FACTS["disc"][0].points()
    assert positions.tolist() == [[1, 0, -8]] and parts.tolist() == [1.0]


def farthest(x: float, y: float) -> float:
    """Of the ellipse of the disc about (x, y), by brute force."""
    turn = np.linspace(0.0, 2.0 * math.pi, 1_000_001)
    return float(np.hypot(x + 2.0 * np.cos(turn), y + 1.5 * np.sin(turn)).max())


@pytest.mark.parametrize(
    ("name", "tangent", "round_"),
    [
        ("point", math.hypot(6, 6) / 5, (math.hypot(1, 2) + 5) / 5),
        ("points", math.hypot(5, 4) / 5, 1.0),  # the nearer; the other asks for hypot(9, 4) / 9, and for 9 / 9
        ("grid", math.hypot(7, 6) / 5, (math.hypot(2, 2) + 5) / 5),
        ("disc", farthest(6, 4) / 8, (3 + 5) / 8),  # of an ellipse whose axes are 2 and 1.5, its middle at (1, 0)
        ("disc of no size", math.hypot(6, 4) / 8, (1 + 5) / 8),
    ],
)
def test_the_cone_over_a_lens(name, tangent, round_):
    """Half size 5 x 4; round, of radius 5."""
    s = FACTS[name][0]
    assert math.tan(s.cone_over(Pupil(Aperture((5.0, 4.0)), 0.0))) == pytest.approx(tangent, rel=1e-8)
    assert math.tan(s.cone_over(Pupil(CircularAperture((5.0, 5.0)), 0.0))) == pytest.approx(round_, rel=1e-8)
    assert Disc(cone=30.0).cone_over(Pupil(Aperture((5.0, 4.0)), 0.0)) == pytest.approx(math.pi / 6)


def test_the_cone_of_a_disc_is_the_narrowest_that_covers_the_lens():
    """The LED of the preset: 1 mm across, 60 mm before a lens of 30 x 30 mm, half the diagonal of both together."""
    led = Disc((0.0, 0.0, -60.0), (1.0, 1.0))
    assert math.degrees(led.cone_over(Pupil(Aperture((15.0, 15.0)), 0.0))) == pytest.approx(19.894, abs=1e-3)
    cross = np.zeros((5, 5))
    cross[2, :] = cross[:, 2] = 1.0  # whose lit pixels do not reach the corners of their rectangle
    tangent = (np.hypot(15.5, 15.1) / 60.0, (15.0 + math.hypot(0.5, 0.1)) / 60.0)
    for found, shape in zip(tangent, (Aperture, CircularAperture), strict=True):
        one = replace(led, brightness=cross)
        assert math.tan(one.cone_over(Pupil(shape((15.0, 15.0)), 0.0))) == pytest.approx(found, rel=1e-8)


@pytest.mark.parametrize(
    "source", [Disc((3.0, -1.0, -9.0), (4.0, 1.0)), Disc((0.0, 0.0, -9.0), (0.0, 7.0)), Disc((0.0, 0.0, -2.0))]
)
@pytest.mark.parametrize("round_", [False, True])
def test_no_corner_of_a_lens_is_outside_the_cone_of_a_disc(source, round_):
    """Nor is any other cone that is narrower by 1e-6 wide enough: by brute force over both borders."""
    turn, edge = np.linspace(0.0, 2.0 * math.pi, 3601), np.linspace(-1.0, 1.0, 201)
    (ex, ey), (px, py, pz), (rx, ry) = source.extent, source.position, (5.0, 5.0 if round_ else 3.0)
    x, y = px + ex * np.cos(turn), py + ey * np.sin(turn)
    one = np.ones_like(edge)
    border = np.concatenate([[edge * rx, one * ry], [edge * rx, -one * ry], [one * rx, edge * ry], [-one * rx, edge * ry]], 1)
    border = np.stack([rx * np.cos(turn), ry * np.sin(turn)]) if round_ else border
    widest = float(np.hypot(x[:, None] - border[0], y[:, None] - border[1]).max())
    shape = CircularAperture if round_ else Aperture
    tangent = math.tan(source.cone_over(Pupil(shape((rx, ry)), 0.0))) * -pz
    assert widest <= tangent < widest * (1.0 + 1e-6)


#: Power of a source, its cone over a lens of 10 x 10 mm at z = 0, and the fraction that it is of all its light.
HALF, CORNER = (5.0, 5.0), math.atan(math.hypot(5.0, 5.0) / 20.0)
TABLE = Distribution((0.0, 60.0, 120.0), (1.0, 1.0, 0.0))


@pytest.mark.parametrize(
    ("source", "part", "words"),
    [
        (PlaneWave(), 1.0, "through the aperture"),
        (Disc(angle=0.5), 1.0, "through the aperture"),
        (Gaussian((10.0, 10.0), 500.0), math.erf(math.sqrt(0.5)) ** 2, "in the whole beam"),
        (Points(((0.0, 0.0, -20.0),)), 0.5 * (1.0 - math.cos(CORNER)), "in all directions, uniform"),
        (Points(((0.0, 0.0, -20.0),), cone=10.0), 1.0, "in its cone"),
        (Points(((0.0, 0.0, -20.0),), intensity="lambertian"), math.sin(CORNER) ** 2, "in all directions, Lambertian"),
        (Points(((0.0, 0.0, -20.0),), cone=10.0, intensity="lambertian"), math.sin(math.radians(10.0)) ** 2, "Lambertian"),
        (Points(((0.0, 0.0, -20.0),), cone=60.0, intensity=TABLE), None, "in all directions of its table"),
        (
            Several((PlaneWave(3.0), Points(((0.0, 0.0, -20.0),), (1.0,), intensity="lambertian"))),
            4.0 / (3.0 + 1.0 / math.sin(CORNER) ** 2),
            "by all sources",
        ),
    ],
)
def test_what_a_source_emits_in_all(source, part, words):
    if part is None:  # of the table, by brute force
        angles = np.radians((np.arange(120_000) + 0.5) / 1000.0)
        flux = np.interp(np.degrees(angles), TABLE.angles, TABLE.values) * np.sin(angles)
        part = flux[:60_000].sum() / flux.sum()
    found, said = source.emitted(Pupil(Aperture(HALF), 0.0))
    assert found == pytest.approx(part, rel=1e-8) and words in said


@pytest.mark.parametrize(
    ("name", "angle", "blur"),
    [
        ("plane", 0.0, 0.0),
        ("point", 0.0, 0.0),
        ("points", None, 0.0),
        ("grid", None, 100.0 * 4 / 5),
        ("grid of one", 0.0, 0.0),
        ("disc", 2.0 * math.degrees(math.atan(2 / 8)), 100.0 * 4 / 8),
        ("disc of no size", 0.0, 0.0),
        ("sun", 0.5, 100.0 * math.radians(0.5)),
    ],
)
def test_what_extent_does(name, angle, blur):
    s = FACTS[name][0]
    assert s.blur(0.0, 100.0) == pytest.approx(blur)
    if angle is not None:
        assert s.apparent_angle(0.0) == pytest.approx(angle)


def test_sources_without_their_extent():
    plane, point = FACTS["plane"][0], FACTS["point"][0]
    assert plane.pointlike() is plane and point.pointlike() is point
    sun = FACTS["sun"][0].pointlike()
    assert isinstance(sun, PlaneWave) and sun.power == 2.0
    assert FACTS["disc"][0].pointlike() == Points(((1.0, 0.0, -8.0),), (2.0,), None, "lambertian")
    assert FACTS["points"][0].pointlike() == Points(((3.0, 0.0, -8.0),), (4.0,))
    for s, _ in FACTS.values():
        assert not s.pointlike().extended
        assert s.extent_words(0.0)


def test_the_types_and_their_keys():
    assert sources.names() == ("plane", "point", "grid", "disc", "gaussian", "measured", "rays")
    assert sources.used_by("position") == ("point", "grid", "disc", "rays") and sources.used_by("profile") == ("plane",)
    assert sources.used_by("size") == ("grid", "disc") and sources.used_by("grid") == ("grid",)
    assert sources.used_by("polarisation") == ()  # of any light
    known = set(settings.SCHEMA["source"])
    for name in sources.names():
        assert {*sources.type_of(name).keys, *sources.COMMON} <= known
    with pytest.raises(
        InputError, match=r"\[source\] type must be one of plane, point, grid, disc, gaussian, measured, rays, got 'sun'"
    ):
        sources.type_of("sun")


def test_the_emission_of_every_source_is_known():
    for s, _ in FACTS.values():
        lens = Lens(size=(10.0, 8.0), control=(8, 7))
        assert emission.rays_of(Scene(s, lens, Screen((40.0, 32.0), 100.0)), "stratified", 100).count >= 80


def classes_asked_for(tree: ast.AST) -> set[str]:
    """Names in the second argument of every isinstance and issubclass, and in every pattern of a match."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("isinstance", "issubclass"):
            asked = node.args[1]
        elif isinstance(node, ast.MatchClass):
            asked = node.cls
        else:
            continue
        found |= {n.id for n in ast.walk(asked) if isinstance(n, ast.Name)} | {
            n.attr for n in ast.walk(asked) if isinstance(n, ast.Attribute)
        }
    return found


def test_the_reader_of_isinstance_sees_all_forms():
    text = "isinstance(a, Disc)\nisinstance(b.c, (PlaneWave, x))\nisinstance(d, Points | None)\nisinstance(e, scene.Ring)"
    assert {"Disc", "PlaneWave", "Points", "Ring"} <= classes_asked_for(ast.parse(text))


def test_no_other_file_asks_for_the_class_of_a_source():
    files = [p for p in PACKAGE.rglob("*.py") if p.parent not in (PACKAGE / "scene" / "sources", PACKAGE / "optics" / "emission")]
    assert len(files) > 90
    wrong = {
        str(p.relative_to(PACKAGE)): found
        for p in files
        if (found := classes_asked_for(ast.parse(p.read_text("utf-8"))) & {"PlaneWave", "Points", "Disc"})
    }
    assert not wrong


@dataclass(frozen=True)
class Ring(Source):
    """Points evenly around a circle: all that a type of source has to say."""

    middle: tuple[float, float, float]
    width: float
    power: float = 1.0
    count: int = 12

    kind = "ring"

    def points(self):
        turn = 2.0 * np.pi * np.arange(self.count) / self.count
        radius = self.width / 2.0
        positions = self.middle + np.stack([radius * np.cos(turn), radius * np.sin(turn), 0.0 * turn], -1)
        return positions, np.full(self.count, 1.0 / self.count)

    def pointlike(self):
        return Points((self.middle,), (self.power,))


@pytest.fixture
def ring(monkeypatch):
    """A type of source that the package does not know, registered for one test."""
    monkeypatch.setattr(sources, "_types", cache(partial(dict, sources._types())))
    monkeypatch.setattr(emission, "_makers", cache(partial(dict, emission._makers())))

    def build(table, profile):
        return Ring(tuple(table["position"][0]), table["size"][0], table["power"])

    sources.register(
        SourceType(
            "ring",
            "ring (of points)",
            ("position", "size"),
            build,
            lambda lens: {"position": [[0.0, 0.0, -20.0]], "size": [3.0, 3.0]},
        )
    )
    emission.register("ring", Near.of_size)


def test_a_source_from_outside(ring, kernels, tmp_path):
    """Through the registries alone: out of [source], into a plan, onto the screen, and out of every export in one sentence."""
    full = complete({"source": {"type": "ring", "power": 2.0}, "lens": {"control": [8, 7]}}, 1.0)
    assert full.source.position == ((0.0, 0.0, -20.0),) and full.design.stages[-1].sampler == "stratified"
    assert "intensity" not in full.source and 'type = "ring"' in settings.dump(full)
    source = settings.build_source(full.source)
    assert isinstance(source, Ring) and source.power == 2.0 and source.nearest == -20.0
    assert source.centre == pytest.approx((0.0, 0.0, -20.0)) and source.powers == pytest.approx((1 / 6,) * 12)
    settings.refuse_unused(full.source, ["source.size"])
    with pytest.raises(InputError, match="cone belongs to source point, grid or disc, got ring"):
        settings.refuse_unused(full.source, ["source.cone"])

    lens = Lens(size=(10.0, 8.0), control=(8, 7), index=1.5, offset=Offset(5.0, (-40.0, -40.0)))
    scene, field = Scene(source, lens, Screen((12.0, 12.0), 60.0, (20, 16))), HeightField.of(lens)
    x, y = field.control_xy()
    heights = 5.0 + torch.from_numpy(lens.offset.sag(x[:, None].numpy(), y[None, :].numpy()))
    exposure = expose(scene, field, heights, emission.rays_of(scene, "stratified", 30_000, seed=3))
    assert float(exposure.image.sum()) > 0.05
    assert float(exposure.image.sum()) + sum(exposure.lost.values()) == pytest.approx(1.0, abs=1e-12)
    grid = Points(tuple(map(tuple, source.points()[0])))  # the same as points that the package knows
    same = expose(
        Scene(grid, lens, scene.screen),
        field,
        heights,
        emission.rays_of(Scene(grid, lens, scene.screen), "stratified", 30_000, seed=3),
    )
    torch.testing.assert_close(exposure.image, same.image, rtol=1e-12, atol=1e-15)

    plan = compile_plan(scene, field, heights)
    assert plan["source-size"].on and plan.scene.source is source
    assert compile_plan(scene, field, heights, ()).scene.source == Points(((0.0, 0.0, -20.0),), (2.0,))
    steepest = math.atan((1.5 + math.hypot(5.0, 4.0)) / 20.0)  # never more
    assert 0.9 * steepest < bounds_of(scene, field, heights).incidence <= steepest
    for write, name in ((write_mitsuba, "lens.xml"), (write_lighttools, "lens.npz")):
        with pytest.raises(InputError, match="a type of source from outside the program cannot be written"):
            write(tmp_path / name, scene, field, heights)
    assert not list(tmp_path.iterdir())


def test_a_kind_that_others_do_not_know_is_refused_in_a_sentence(ring, monkeypatch):
    scene = Scene(Ring((0.0, 0.0, -20.0), 3.0), make()[0].lens, Screen((10.0, 10.0)))
    monkeypatch.setattr(verify, "find_spec", lambda name: True)
    assert not verify.unsupported(scene)  # its rays are those of its own emission
    power = sum(share.sum() for _, _, share in verify.sample_rays(scene, 1000, np.random.default_rng(0)))
    assert 0.0 < power <= 1000.0 * (1.0 + 1e-9)
    monkeypatch.delitem(emission._makers(), "ring")
    with pytest.raises(InputError, match="type ring has no rays"):
        emission.rays_of(scene, "stratified", 10)
