"""Optical efficiency: initial surfaces for near and off-axis sources, reachability, the loss, the Pareto front."""

from __future__ import annotations

import json
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse import initial_surface, reachability
from caustic_cli.inverse.incidence import incident
from caustic_cli.inverse.initial_surface import InitialSurface, first_surface
from caustic_cli.inverse.losses import Loss
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.reachability import largest_magnification, refuse_unreachable
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.kinds import surface
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.workflow import tradeoff


def blob(n: int = 48) -> np.ndarray:
    """A bright disc beside the middle."""
    x = np.linspace(-1.0, 1.0, n)
    return ((x[:, None] - 0.1) ** 2 + (x[None, :] + 0.15) ** 2 < 0.2).astype(float)


def close_by(at=(0.0, 0.0, -5.0), **lens) -> Scene:
    """The thesis' table D.4: a half sphere of light 3 mm before the lens."""
    made = {"size": (10.0, 10.0), "z_in": -2.0, "index": 1.5, "control": (80, 80), "height_range": (-60.0, 60.0)} | lens
    return Scene(Points((at,), cone=90.0), Lens(offset=Offset(3.0, (-8.9, -8.9)), **made), Screen((40.0, 40.0), 25.0, (48, 48)))


def beside(at) -> Scene:
    lens = Lens(control=(80, 80), offset=Offset(5.0, (200.0, 200.0)), height_range=(-60.0, 60.0), min_thickness=1.0)
    return Scene(Points((at,)), lens, Screen((38.0, 38.0), 300.0, (48, 48)))


def traced(scene: Scene, first: InitialSurface, target: np.ndarray):
    """Its image's error, and the part of the light on the lens that it holds."""
    image = expose(scene, HeightField.of(scene.lens), first.heights, rays_of(scene, "stratified", 100_000, 3))
    return relative_rms(image.image.numpy(), target), float(image.image.sum()) / (1.0 - image.lost["missed_lens"]), image


def foreseen(scene: Scene, first: InitialSurface, target: np.ndarray) -> float:
    """The part of the light on the lens that comes to the screen, as first surfaces are compared by."""
    grid = initial_surface._Grid.of(scene, target, 96)
    x, y = (torch.from_numpy(c.ravel().copy()) for c in np.meshgrid(grid.x, grid.y, indexing="ij"))
    z = HeightField.of(scene.lens).at(first.heights, x, y)[0].view(len(grid.x), len(grid.y)).numpy()
    return grid.efficiency(np.where(z < grid.floor + 1e-3, grid.floor, z))  # where it is cut off, to rounding


# First surfaces


@pytest.mark.parametrize("fixed", [True, False])
def test_a_half_sphere_of_light_before_the_lens(fixed):
    """Table D.4: four fifths of what meets the lens come to the screen, and the picture stands already."""
    scene, target = close_by(), blob()
    first = first_surface(scene, target, HeightField.of(scene.lens), 96, fixed)
    assert foreseen(scene, first, target) > 0.75 and (not fixed or first.middle == 3.0)
    assert float(first.heights.min()) >= scene.lens.z_in
    error, kept, image = traced(scene, first, target)
    entrance = 1.0 - image.lost["missed_lens"]
    assert kept == pytest.approx(0.95 * foreseen(scene, first, target), abs=0.04)  # which is behind the entrance's own reflection
    assert kept * entrance > 0.35 and error < 0.7
    assert sum(image.lost.values()) + float(image.image.sum()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("at", "least"), [((20.0, 0.0, -50.0), 0.75), ((0.0, -20.0, -20.0), 0.6), ((8.0, 6.0, -25.0), 0.6)])
def test_a_source_beside_the_axis_has_a_prism_in_its_first_surface(at, least):
    scene, target = beside(at), blob()
    first = first_surface(scene, target, HeightField.of(scene.lens), 96)
    error, kept, _ = traced(scene, first, target)
    assert error < 0.6 and kept > least and kept == pytest.approx(0.95 * foreseen(scene, first, target), abs=0.04)
    heights = first.heights.numpy()
    slope = [float(np.diff(heights, axis=axis).mean()) * (heights.shape[axis] - 1) / 10.0 for axis in (0, 1)]
    for s, x in zip(slope, at[:2], strict=True):  # light from +x that has to go straight on leaves a surface that rises to +x
        assert abs(s) < 0.05 if x == 0 else s * x > 0.1 * abs(x) / abs(at[2])


def test_a_surface_that_would_reach_below_the_lens_is_cut_at_its_least_thickness():
    scene = close_by(min_thickness=0.4)
    first = first_surface(scene, blob(), HeightField.of(scene.lens), 64, True)
    z = first.heights.numpy()
    assert z.min() == pytest.approx(-1.6, abs=1e-12) and (z == z.min()).mean() > 0.1 and z[40, 40] > 2.5


def test_a_cut_surface_is_refined_on_more_cells_as_far_as_time_allows():
    """Where a surface is cut off it gets no light, on any number of cells; a cut that rings between cells let some in, for 0.53."""
    scene, target = close_by(min_thickness=0.4, control=(160, 160)), blob()
    field = HeightField.of(scene.lens)
    whole, hurried = (first_surface(scene, target, field, 128, True, seconds) for seconds in (math.inf, 0.0))
    assert traced(scene, whole, target)[0] < 0.43 < traced(scene, hurried, target)[0] < 0.5  # on 128 cells, and on 91


def test_light_that_comes_through_the_sides_does_not_count():
    """The exit's corner under a source beside the axis sees it only through the lens' side."""
    scene = beside((20.0, 0.0, -20.0))
    x = np.linspace(-5.0, 5.0, 41)
    light, directions = incident(scene, x, x, np.full((41, 41), 6.0))
    entry = x[:, None] - 6.0 * directions[0] / directions[2]
    outside = 0.5 * (entry[1:, :1] + entry[:-1, :1])[:, 0] > 5.3
    assert outside.any() and (light[outside] == 0).all() and (light[~outside][:-3] > 0).all()
    power = light.sum() * 0.25**2
    flat = torch.full((80, 80), 6.0, dtype=torch.float64)
    rays = expose(scene, HeightField.of(scene.lens), flat, rays_of(scene, "stratified", 400_000))
    cone = scene.source.cone_over(scene.lens.pupil)
    per_angle = 1.0 / (4.0 * math.pi * math.sin(cone / 2.0) ** 2)
    lost = rays.lost
    met = 1.0 - lost["missed_lens"] - lost["missed_surface"]
    assert power * per_angle == pytest.approx(met, rel=0.15)  # but for the entrance's reflection


# Scenes without a way


@pytest.mark.parametrize(
    "scene",
    [
        Scene(PlaneWave(), Lens(), Screen((30.0, 30.0), 300.0, (48, 48), shift=(2000.0, 0.0))),
        Scene(Points(((0.0, 0.0, -50.0),)), Lens(index=1.05), Screen((30.0, 30.0), 100.0, (48, 48), shift=(0.0, 90.0))),
        Scene(Disc((0.0, 0.0, -10.0), (2.0, 2.0), cone=5.0), Lens(), Screen((30.0, 30.0), 100.0, (48, 48), shift=(-300.0, 0.0))),
        Scene(Disc(angle=2.0), Lens(), Screen((30.0, 30.0), 60.0, (48, 48), shift=(-300.0, 0.0))),
    ],
)
def test_a_picture_out_of_reach_is_refused(scene):
    with pytest.raises(InputError, match="no light can be refracted to the picture: it would have to be deflected by at least"):
        refuse_unreachable(scene, blob())
    refuse_unreachable(replace(scene, screen=replace(scene.screen, shift=(0.0, 0.0))), blob())


def test_the_points_of_a_source_are_searched_a_few_at_a_time(monkeypatch):
    """The same angle whatever the size of a block, in memory that does not grow with the number of points."""
    screen = Screen((30.0, 30.0), 100.0, (48, 48), shift=(400.0, 0.0))

    def refused(points: int) -> tuple[str, int]:
        """What is said of a grid of points x points, and the bytes that it takes."""
        grid = Points.grid((0.0, 0.0, -20.0), (2.0, 1.0), (points, points), intensity="lambertian")
        tracemalloc.start()
        with pytest.raises(InputError, match="deflected by at least") as error:
            refuse_unreachable(Scene(grid, Lens(aperture="circle"), screen), blob())
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return str(error.value), most

    said, most = zip(*map(refused, (4, 16)), strict=True)
    assert most[1] < 1.1 * most[0] < 2e8
    monkeypatch.setattr(reachability, "PAIRS", 1 << 40)
    whole = refused(4)
    monkeypatch.setattr(reachability, "PAIRS", 1)
    assert refused(4)[0] == whole[0] == said[0] and refused(4)[1] < 0.2 * whole[1]


def test_light_that_misses_the_lens_is_refused():
    scene = Scene(Points(((30.0, 0.0, -20.0),), cone=20.0), Lens(), Screen((30.0, 30.0), 300.0, (48, 48)))
    with pytest.raises(InputError, match="none of its light falls on the lens"):
        refuse_unreachable(scene, blob())


def test_the_largest_turn_is_that_of_refraction():
    """A plane wave turns by less than arccos(1 / n): pictures on either side of that."""
    for degrees, refused in ((47.0, False), (49.0, True)):
        shift = 1000.0 * math.tan(math.radians(degrees))
        scene = Scene(PlaneWave(), Lens(index=1.5, size=(1.0, 1.0)), Screen((0.1, 0.1), 1000.0, (48, 48), shift=(shift, 0.0)))
        if refused:
            with pytest.raises(InputError, match=r"less than 48\.2"):
                refuse_unreachable(scene, blob())
        else:
            refuse_unreachable(scene, blob())


def test_the_largest_magnification_is_not_known_of_a_picture_across_its_lens():
    """No width of a tall picture is within a long lens' reach right before it."""
    scene = Scene(PlaneWave(), Lens((100.0, 10.0)), Screen((120.0, 120.0), 30.0, (12, 12)))
    assert largest_magnification(scene, (10.0, 100.0)) is None
    assert largest_magnification(scene, (100.0, 10.0)) > 1.0


def test_nothing_is_solved_for_a_picture_out_of_reach(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Image.fromarray((255 * blob()).astype(np.uint8)).save("blob.png")
    monkeypatch.setattr(surface, "first_surface", lambda *args: pytest.fail("solved for nothing"))
    assert cli.run(["design", "blob.png", "--screen-shift", "2000,0", "--resolution", "32"]) == 2
    assert "no light can be refracted to the picture" in capfd.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["blob.png"]


# The loss


def test_light_counts_what_does_not_reach_the_screen():
    """All of it on the screen; by its distance beside it; lost in the lens in full."""
    loss, shape = Loss("light", torch.ones(9, 8, dtype=torch.float64), 0.0, 2), (9, 8)
    entering = torch.full((), 0.8, dtype=torch.float64)
    for (i, j), expected in {(4, 3): 0.5, (2, 2): 0.5, (1, 3): 0.75, (0, 3): 1.0, (8, 6): 1.0}.items():
        image = torch.zeros(shape, dtype=torch.float64)
        image[i, j] = 0.4
        assert (float(loss(image, entering, entering=entering)) * 72) ** 2 == pytest.approx(expected, abs=1e-14)
        assert (float(loss(image, 0.5 * entering)) * 72) ** 2 == pytest.approx(2.0 * expected - 1.0, abs=1e-14)


@pytest.mark.parametrize("source", [PlaneWave(), Points(((1.0, 0.0, -15.0),), cone=60.0)])
def test_the_objective_knows_the_light_on_the_lens(source):
    lens = Lens(size=(4.0, 4.0), control=(8, 8), offset=Offset(3.0, (-6.0, -6.0)))
    scene = Scene(source, lens, Screen((6.0, 6.0), 20.0, (24, 24)))
    field = HeightField.of(lens)
    heights = 3.0 + 0.05 * torch.randn(8, 8, dtype=torch.float64)
    target, rays = torch.from_numpy(blob(24)), rays_of(scene, "stratified", 60_000, 5)
    objective = Objective(scene, field, rays, target, "light", LossImage(Filter("cosine", (3, 3)), apron=3), dtype=torch.float64)
    seen = objective(heights)
    image = expose(scene, field, heights, rays, Filter("cosine", (3, 3)), screen=scene.screen.grown((3, 3)))
    fade = np.minimum.outer(*(2 * [np.clip(np.minimum(np.arange(1, 31), np.arange(30, 0, -1)) - 1, 0, 3) / 3.0]))
    expected = 1.0 - float((image.image.numpy() * fade).sum()) / (1.0 - image.lost["missed_lens"])
    assert (seen.loss * 900) ** 2 == pytest.approx(expected, rel=1e-9)
    step = torch.zeros_like(heights)
    step[2, 5] = 1e-5
    slope = (objective(heights + step).loss - objective(heights - step).loss) / 2e-5
    assert float(seen.gradient[2, 5]) == pytest.approx(slope, rel=2e-3)


# The front


def test_study_of_light(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tradeoff, "PARTS", (1.0, 1.8))
    monkeypatch.setattr(tradeoff, "NEAR_WEIGHTS", (0.0, 10.0))
    Image.fromarray((255 * blob()).astype(np.uint8)).save("blob.png")
    assert (
        cli.run(
            [
                "design",
                "blob.png",
                "--source",
                "point",
                "--source-position",
                "0,0,-5",
                "--cone",
                "80",
                "--throw",
                "25",
                "--mag",
                "2",
                "--resolution",
                "32",
                "--quality",
                "draft",
                "--iterations",
                "1",
                "--waves",
                "off",
                "--quiet",
            ]
        )
        == 0
    )
    capfd.readouterr()
    assert cli.run(["convergence", "blob.caustic", "--study", "light", "--seconds", "0.2", "--json", "--quiet"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["error_by"] == "rays"
    assert [p.rsplit("/", 1)[-1] for p in found["files"]] == ["light.csv", "light.json", "light.png"]
    rows = found["rows"]
    assert len({r["thickness"] for r in rows}) == 2 and {r["loss"] for r in rows} == {"rms", "rms + 10 light"}
    for row in rows:
        better = [r for r in rows if r["on_screen"] >= row["on_screen"] and r["error"] <= row["error"] and r is not row]
        assert row["front"] == (not better)
        assert 0 < row["on_screen"] < 1 and row["noise"] < 0.2 * row["error"]
    front = sorted((r["on_screen"], r["error"]) for r in rows if r["front"])
    assert len(front) >= 2 and found["advice"].startswith(f"{len(front)} lenses are on the Pareto front")


def test_study_of_light_from_infinity_varies_the_weight_alone(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Image.fromarray((255 * blob()).astype(np.uint8)).save("blob.png")
    assert (
        cli.run(
            ["design", "blob.png", "--resolution", "32", "--quality", "draft", "--iterations", "1", "--waves", "off", "--quiet"]
        )
        == 0
    )
    capfd.readouterr()
    assert cli.run(["convergence", "blob.caustic", "--study", "light", "--seconds", "0.05", "--json", "--quiet"]) == 0
    rows = json.loads(capfd.readouterr().out)["rows"]
    assert len({r["thickness"] for r in rows}) == 1 and len({r["weight"] for r in rows}) == len(rows) >= 5
    assert cli.run(["convergence", "--study", "light", "--seconds", "0"]) == 2
    assert "--seconds must be" in capfd.readouterr().err
