"""How lenslets are packed: cells against the nearest centre, sections of splines, round lenslets, designs in hexagonal packing."""

import json
import math
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from scipy.interpolate import BSpline
from scipy.optimize import linear_sum_assignment

import caustic_cli as caustic
from caustic_cli import cli
from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.inverse.lenslets import SplineSection, array_objective, initial_array, lenslets, sampled
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, tracers
from caustic_cli.project.completion import complete
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen, equal_cells
from caustic_cli.scene.packing import ConvexAperture, cells_of
from caustic_cli.studies.retrace import retrace

SIZES = [((5, 5), (10.0, 10.0)), ((4, 3), (9.0, 7.0)), ((1, 2), (3.0, 4.0)), ((3, 1), (6.0, 5.0)), ((2, 7), (1.0, 2.7))]


def hexagonal(array=(3, 2), size=(9.0, 6.0), control=(48, 40), resolution=(30, 25), **lens) -> Scene:
    lens = {"packing": "hexagonal", "fresnel": "none"} | lens
    made = Lens(size, control=control, array=array, offset=Offset(5.0), **lens)
    return Scene(PlaneWave(), made, Screen((24.0, 20.0), 200.0, resolution))


def bumps(scene: Scene, seed=1, size=0.02) -> torch.Tensor:
    """A smooth random net."""
    rng = np.random.default_rng(seed)
    x, y = (torch.linspace(-1.0, 1.0, n, dtype=torch.float64) for n in scene.lens.control)
    terms = ((3.0 * rng.random() * x[:, None], 3.0 * rng.random() * y[None, :]) for _ in range(4))
    return 5.0 + size * sum(torch.sin(a + b) for a, b in terms)


# Cells


@pytest.mark.parametrize(("array", "size"), SIZES)
def test_a_hexagonal_cell_is_what_is_nearest_to_its_centre(array, size):
    cells, rng = cells_of("hexagonal", array, size), np.random.default_rng(3)
    at = (rng.random((2, 20_000)) - 0.5) * np.array(size)[:, None]
    far = np.hypot(*(at[:, None] - np.array(cells.centres).T[:, :, None]))
    assert (cells.number(*at) == far.argmin(0)).all()
    assert (cells.number(*map(torch.from_numpy, at)).numpy() == far.argmin(0)).all()
    for k in range(len(far)):
        inside = ConvexAperture((size[0] / 2, size[1] / 2), cells.outline(k)).contains(*at)
        assert (inside == (far.argmin(0) == k)).all()
    assert far.min(0)[np.hypot(*at) < 1e-9 + cells.radius / 9].max(initial=0.0) < 2 * cells.radius


@pytest.mark.parametrize("packing", ["square", "hexagonal"])
@pytest.mark.parametrize(("array", "size"), SIZES)
def test_cells_fill_the_array(packing, array, size):
    cells = cells_of(packing, array, size)
    areas = [ConvexAperture((size[0] / 2, size[1] / 2), cells.outline(k)).area for k in range(len(cells.centres))]
    assert math.fsum(areas) == pytest.approx(math.prod(size), rel=1e-12)
    assert len(areas) == math.prod(array)
    for x, y in cells.centres:  # round lenslets lie in the array and do not overlap
        assert abs(x) + cells.radius <= size[0] / 2 + 1e-12 and abs(y) + cells.radius <= size[1] / 2 + 1e-12
    apart = [math.dist(a, b) for k, a in enumerate(cells.centres) for b in cells.centres[:k]]
    assert min(apart, default=math.inf) >= 2 * cells.radius * (1 - 1e-12)


@pytest.mark.parametrize(("array", "size"), [*SIZES, ((6, 6), (10.0, 10.0))])
def test_cells_of_equal_area(array, size):
    cells, half = cells_of("hexagonal", array, size, equal=True), (size[0] / 2, size[1] / 2)
    outlines = [ConvexAperture(half, cells.outline(k)) for k in range(math.prod(array))]
    np.testing.assert_allclose([one.area for one in outlines], math.prod(size) / math.prod(array), rtol=1e-9)
    at = (np.random.default_rng(4).random((2, 20_000)) - 0.5) * np.array(size)[:, None]
    number = cells.number(*at)
    assert (cells.number(*map(torch.from_numpy, at)).numpy() == number).all()
    for k, one in enumerate(outlines):
        assert (one.contains(*at) == (number == k)).all()


@pytest.mark.parametrize(("array", "size"), [((3, 3), (10.0, 10.0)), ((4, 3), (9.0, 7.0))])
def test_they_are_the_assignment_of_least_cost(array, size):
    """Points to centres, equally many to each, by the sum of squares of the distances (linear programming)."""
    cells, each = cells_of("hexagonal", array, size, equal=True), 100
    lines = [(np.arange(n) + 0.5) * w / n - 0.5 * w for n, w in zip((10 * array[0], 10 * array[1]), size, strict=True)]
    x, y = (c.ravel() for c in np.meshgrid(*lines, indexing="ij"))
    centres = np.repeat(np.array(cells.centres), each, 0)
    points, places = linear_sum_assignment((x[:, None] - centres[:, 0]) ** 2 + (y[:, None] - centres[:, 1]) ** 2)
    same = cells.number(x, y)[points] == places // each
    assert same.mean() > 0.97  # but for points on borders; of the nearest centres 0.79 and 0.85
    near = cells_of("hexagonal", array, size).number(x, y)
    assert (near[points] == places // each).mean() < 0.9


@pytest.mark.parametrize("array", [(6, 5), (12, 12)])
def test_a_step_of_newtons_method_by_its_edges(array):
    """Against the dense equations by singular values, whose solution of the least norm has the mean 0."""
    cells = cells_of("hexagonal", array, (10.0, 10.0), equal=True)
    diagram, count = equal_cells._diagram(cells, np.zeros(math.prod(array))), math.prod(array)
    slope = np.zeros((count, count))
    for (k, q), length in diagram.borders.items():
        assert diagram.borders[q, k] == pytest.approx(length, rel=1e-9)
        by = 0.5 * length / math.dist(cells.centres[k], cells.centres[q])
        slope[k, k] += by
        slope[k, q] -= by
    change = diagram.areas.mean() - diagram.areas
    wanted = np.linalg.lstsq(slope, change, rcond=1e-10)[0]
    np.testing.assert_allclose(
        equal_cells._laplace(diagram.borders, cells.centres, change), wanted, atol=1e-9 * np.abs(wanted).max()
    )


@pytest.mark.parametrize("lenslets_", ["filled", "round"])
def test_light_of_hexagonal_lenslets_is_equal(lenslets_):
    parts = lenslets(hexagonal((3, 3), (9.0, 9.0), lenslets=lenslets_))
    assert [one.share for one in parts] == pytest.approx([1.0 / 9.0] * 9, rel=0.02)  # by subsamples of cells


def test_cells_inside_are_regular_hexagons():
    cells = cells_of("hexagonal", (5, 5), (11.0, 11.0))  # of a width of 2
    k = 2 * 5 + 2
    corners = np.array(cells.outline(k)) - cells.centres[k]
    assert len(corners) == 6
    np.testing.assert_allclose(np.hypot(*corners.T), 2.0 / math.sqrt(3.0), rtol=1e-12)
    area = ConvexAperture((5.5, 5.5), cells.outline(k)).area
    assert math.pi * cells.radius**2 / area == pytest.approx(math.pi / (2.0 * math.sqrt(3.0)), rel=1e-12)


def test_more_rows_than_fit():
    with pytest.raises(InputError, match="room for 6 hexagonally packed rows on 10 x 10 mm, got 7"):
        hexagonal((5, 7), (10.0, 10.0))
    assert hexagonal((5, 6), (10.0, 10.0)).lens.cells.radius == pytest.approx(10.0 / 11.0)


# Round lenslets


@pytest.mark.parametrize(("packing", "fill"), [("square", math.pi / 4), ("hexagonal", 20 * math.pi / 4 * (8 / 5.5) ** 2 / 64)])
def test_light_between_round_lenslets_is_absorbed(packing, fill):
    """Of a plane wave and of a point far away, what leaves the lens is the fill factor."""
    lens = Lens((8.0, 8.0), control=(25, 25), array=(5, 4) if packing == "hexagonal" else (4, 4), packing=packing, lenslets="round")
    lens = replace(lens, fresnel="none", offset=Offset(5.0))
    flat = torch.full(lens.control, 5.0, dtype=torch.float64)
    for source in (PlaneWave(), Points(((0.0, 0.0, -1e7),))):
        scene = Scene(source, lens, Screen((12.0, 12.0), 200.0, (40, 40)))
        image, _ = retrace(scene, HeightField.of(lens), flat, None, rays=400_000, noise=False)
        sent = 1.0 - image.lost["missed_lens"]
        assert image.image.sum() / sent == pytest.approx(fill, abs=0.003)
        assert image.lost["missed_surface"] / sent == pytest.approx(1.0 - fill, abs=0.003)


TILTED = PlaneWave(tilt=(6.0, -10.0))


@pytest.mark.parametrize("packing", ["square", "hexagonal"])
@pytest.mark.parametrize("source", [PlaneWave(), TILTED, Points(((1.0, -2.0, -40.0),))], ids=["plane", "tilted", "point"])
def test_round_lenslets_by_one_kernel(packing, source):
    """Image and losses against the stages of a trace, by the same rays of a plane wave and else by rays through the entrance,
    intersected one by one; the gradient against differences."""
    scene = hexagonal((4, 3), (8.0, 6.0), packing=packing, lenslets="round", control=(45, 37) if packing == "square" else (60, 45))
    x, y, along = source.axis if source is TILTED else (0.0, 0.0, 1.0)
    scene = replace(
        scene, source=source, screen=Screen((60.0, 60.0), 200.0, (30, 25), shift=(200.0 * x / along, 200.0 * y / along))
    )
    field, filter, same = HeightField.of(scene.lens), Filter("cosine", (3, 3)), source == PlaneWave()
    z, way = bumps(scene, size=0.01), bumps(scene, seed=2, size=1.0) - 5.0
    (traced,) = tracers(scene, field, rays_of(scene, "grid", 200_000), torch.float64, 1 << 20)
    assert traced.fused is not None
    part, system = traced.expose({EXIT: z}, scene.screen, filter), System.of(scene, field)
    assert float(part.image.sum()) + sum(map(float, part.lost.values())) == pytest.approx(1.0, abs=1e-12)
    (rays,) = rays_of(scene, "grid" if same else "sobol", 200_000).chunks()
    stages = Tracer(system, rays)
    seen = stages.collect(stages({EXIT: z}), scene.screen, filter)
    for name, value in seen.lost.items():
        assert float(part.lost.get(name, 0.0)) == pytest.approx(float(value), abs=1e-12 if same else 2e-3)
    assert float(part.lost["missed_surface"]) > 0.1
    assert float((part.image - seen.image).norm()) < (1e-10 if same else 1e-2) * float(seen.image.norm())
    pull = torch.linspace(-1.0, 1.0, 750, dtype=torch.float64).view(30, 25) ** 2

    def value(z):
        return (traced.expose({EXIT: z}, scene.screen, filter).image * pull).sum()

    (gradient,) = torch.autograd.grad(value(z.requires_grad_()), z)
    difference = (value(z.detach() + 1e-6 * way) - value(z.detach() - 1e-6 * way)) / 2e-6
    assert float((gradient * way).sum()) == pytest.approx(float(difference), rel=1e-4)


# Sections


@pytest.mark.parametrize(
    ("degree", "low", "high"), [(3, 0.25, 0.75), (2, 0.0, 0.375), (1, 0.125, 1.0), (3, 0.0, 1.0), (4, 0.5, 0.625)]
)
def test_a_section_is_the_same_spline(degree, low, high):
    whole = SplineSpace.uniform(8 + degree, degree)
    net = torch.from_numpy(np.random.default_rng(2).normal(size=whole.n))
    section = SplineSection.of(whole, low, high)
    own = net[section.where] if section.matrix is None else section.matrix @ net[section.where]
    at = np.linspace(0.0, 1.0, 33)
    expected = BSpline(whole.knots.numpy(), net.numpy(), degree)(low + (high - low) * np.clip(at, 1e-12, 1 - 1e-12))
    np.testing.assert_allclose(section.space.matrix(torch.from_numpy(at)) @ own, expected, atol=1e-9)
    assert (section.matrix is None) == (degree == 1 or (low, high) == (0.0, 1.0))


def test_lenslets_are_sections_of_the_surface():
    """Heights and slopes within each cell, and all of the light."""
    scene = hexagonal()
    net, field, rng = bumps(scene), HeightField.of(scene.lens), np.random.default_rng(4)
    parts = lenslets(scene)
    at = [torch.from_numpy((rng.random(2000) - 0.5) * w) for w in scene.lens.size]
    number = scene.lens.cells.number(*at)
    for k, one in enumerate(parts):
        x, y = (c[number == k] for c in at)
        u, v = x - one.middle[0], y - one.middle[1]
        assert len(x) > 100 and bool(one.scene.lens.clear.contains(u, v).all())
        for found, wanted in zip(one.field.at(one.of(net), u, v), field.at(net, x, y), strict=True):
            np.testing.assert_allclose(found, wanted, atol=1e-10)
    assert sum(one.share for one in parts) == pytest.approx(1.0, abs=1e-14)
    areas = [ConvexAperture(scene.lens.half_size, scene.lens.cells.outline(k)).area / 54.0 for k in range(6)]
    assert [one.share for one in parts] == pytest.approx(areas, rel=0.01)


def test_the_gradient_by_each_lenslet_is_that_of_finite_differences():
    scene = hexagonal((2, 2), (4.0, 4.0), (14, 14), (12, 12))
    net, rng = bumps(scene, size=0.01), np.random.default_rng(1)
    targets = [torch.from_numpy(rng.uniform(0.2, 1.0, (12, 12))) for _ in range(4)]
    how = LossImage(Filter("cosine", (5, 5)))

    def part(k, one):
        return Objective(one.scene, one.field, rays_of(one.scene, "grid", 4000), targets[k], "rms", how, dtype=torch.float64)

    loss = array_objective(lenslets(scene), part)
    found, along = loss(net), torch.from_numpy(rng.normal(size=net.shape))
    step = 1e-6
    slope = (loss(net + step * along).loss - loss(net - step * along).loss) / (2.0 * step)
    assert float((found.gradient * along).sum()) == pytest.approx(slope, rel=1e-3)


# Surfaces


def test_surfaces_that_can_meet_do():
    """Lenslets of one surface, raised at random, are that surface again."""
    scene = hexagonal((3, 2), (9.0, 6.0), (120, 90))
    net, rng = bumps(scene), np.random.default_rng(3)
    parts, field = lenslets(scene), HeightField.of(scene.lens)
    made = sampled(parts, [one.of(net) + float(rng.normal()) for one in parts], scene.lens, field)
    off = made.heights - net
    assert made.gap < 1e-11 and float(off.max() - off.min()) < 1e-11


@pytest.mark.parametrize(
    ("lenslets_", "source", "most"),
    [("filled", PlaneWave(), 0.12), ("round", PlaneWave(), 0.1), ("filled", Points(((1.0, -2.0, -40.0),)), 0.2)],
)
def test_the_initial_surface(lenslets_, source, most):
    """The picture by independent rays; a single lenslet's light, or none of the mask, would be far from it."""
    x = np.linspace(-1.0, 1.0, 32)
    goal = np.exp(-3.0 * (x[:, None] ** 2 + (x[None, :] - 0.2) ** 2)) + 0.2
    lens = Lens((8.0, 8.0), index=1.5, control=(180, 180), array=(2, 2), packing="hexagonal", lenslets=lenslets_, fresnel="none")
    scene = Scene(source, lens, Screen((24.0, 24.0), 120.0, (32, 32)))
    heights = initial_array(scene, [goal], (180, 180), 128).heights
    error = retrace(scene, HeightField.of(lens), heights, goal, rays=400_000)[1]["relative_rms"]
    assert error < most


# The default net


@pytest.mark.parametrize("packing", ["square", "hexagonal"])
@pytest.mark.parametrize("gaps", [0.0, 0.9])
def test_lenslets_have_the_spans_per_pixel_of_one_lens(packing, gaps):
    """As far as the largest net of the quality goes, whatever the picture, and a ray for each of them."""
    for array, pixels in (((2, 2), 40), ((3, 2), 60), ((5, 5), 100)):
        lens = {"array": list(array), "packing": packing}
        full = complete({"lens": lens, "screen": {"resolution": [pixels, pixels]}}, 1.0, gaps=gaps)
        stage = full.design.stages[-1]
        plan = current_effort().creased
        for n, k in zip(full.lens.control, array, strict=True):
            assert n - 3 >= min(plan.spans_per_pixel * pixels * k, plan.most_spans)
        assert list(stage.control) == list(full.lens.control) and stage.rays >= math.prod(full.lens.control)


@pytest.mark.parametrize("packing", ["square", "hexagonal"])
@pytest.mark.parametrize(
    "more",
    [{"source": {"type": "plane", "angle": 0.05}}, {"design": {"waves": "on"}}],
    ids=["disc at infinity", "waves"],
)
def test_so_have_lenslets_without_creases(packing, more):
    """Where blur or diffraction smooth creases, so that one lens has a coarse net."""
    for array in ((2, 2), (3, 2)):
        sections = {"screen": {"resolution": [60, 60]}, **more}
        one = complete(sections, 1.0)
        full = complete({**sections, "lens": {"array": list(array), "packing": packing}}, 1.0)
        for n, m, k in zip(full.lens.control, one.lens.control, array, strict=True):
            assert n - 3 >= k * (m - 3)


# The program


@pytest.fixture(scope="module")
def arrays(tmp_path_factory):
    """A directory with a hexagonal array, and one of round lenslets."""
    directory = tmp_path_factory.mktemp("packed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(directory)
        write_blob()
        common = "--packing hexagonal --control 99 --resolution 24 --iterations 1 --quality draft --quiet --threads 2"
        assert cli.run(shlex.split(f"design blob.png --array 2 {common}")) == 0
        assert cli.run(shlex.split(f"design blob.png --array 2x1 --lenslets round -o round.caustic --lens-size 2 {common}")) == 0
        yield directory


def test_a_design_in_hexagonal_packing(arrays, monkeypatch, capfd):
    monkeypatch.chdir(arrays)
    lens = caustic.load("blob.caustic")
    assert lens.scene.lens.packing == "hexagonal" and lens.scene.lens.pieces == (1, 1)
    assert lens.figures["on_screen"] > 0.8
    assert cli.run(shlex.split("render blob.caustic --rays 40000 --json --quiet --threads 2")) == 0
    assert json.loads(capfd.readouterr().out)["on_screen"] == pytest.approx(lens.figures["on_screen"], abs=0.01)
    assert "packing" in (arrays / "blob.caustic/project.toml").read_text()


def test_a_design_of_round_lenslets(arrays, monkeypatch):
    """Two of them in a row, of a square lens: half of its light, times pi / 4."""
    monkeypatch.chdir(arrays)
    lens = caustic.load("round.caustic")
    assert lens.scene.lens.clear.area == pytest.approx(2.0 * math.pi * 0.25)
    lit = lens.figures["on_screen"] / (1.0 - lens.figures["lost"]["fresnel"])
    assert lit < math.pi / 8.0 * 1.1


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("design blob.png --packing hexagonal", "--array"),
        ("design blob.png --lenslets round", "--array"),
        ("design blob.png --array 4x9 --packing hexagonal", "hexagonally packed rows"),
        ("design blob.png --array 2 --packing triangular", "hexagonal"),
        ("export round.caustic --format lighttools --script", "opaque mask"),
    ],
)
def test_refusals(line, said, arrays, monkeypatch, capfd):
    monkeypatch.chdir(arrays)
    code, err = cli.run(shlex.split(f"{line}")), capfd.readouterr().err
    assert code == 2 and said in err and len(err.strip().splitlines()) == 1, err
