"""Arrays of lenslets: their splines, their start, their losses, the brightness of their sources, their files."""

import itertools
import json
import re
import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image
from scipy.interpolate import BSpline

import caustic_cli as caustic
from caustic_cli import cli
from caustic_cli.errors import CausticError, InputError
from caustic_cli.export.mesh import closed_mesh
from caustic_cli.export.step import write_step
from caustic_cli.inverse.lenslets import array_objective, assemble, initial_array, lenslets
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.target import tiles
from caustic_cli.optics.bspline import SplineSpace, open_knots
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Disc, Lens, Light, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.lens import array_control
from caustic_cli.scene.light import RGB
from caustic_cli.studies.brightness import brightness
from caustic_cli.studies.retrace import retrace
from caustic_cli.workflow.outputs import illumination


def array_scene(array=(3, 2), spans=5, degree=(3, 2), profile=None, **lens) -> Scene:
    control = tuple(k * (spans + p - 1) + 1 for k, p in zip(array, degree, strict=True))
    made = Lens((9.0, 6.0), control=control, degree=degree, array=array, fresnel="none", **lens)
    return Scene(PlaneWave(1.0, profile), made, Screen((24.0, 20.0), 200.0, (30, 25)))


def bumps(scene: Scene, seed=1, size=0.02) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return 5.0 + size * torch.from_numpy(rng.uniform(-1, 1, scene.lens.control))


# Splines


@pytest.mark.parametrize(("degree", "parts", "spans"), [(1, 3, 4), (2, 4, 3), (3, 5, 6), (5, 2, 1)])
def test_each_part_of_the_knots_is_a_spline_of_its_own(degree, parts, spans):
    space = SplineSpace.uniform(parts * (spans + degree - 1) + 1, degree, parts)
    own, net = open_knots(spans + degree, degree).numpy(), np.random.default_rng(2).normal(size=space.n)
    u = np.linspace(0.0, 1.0, 41)
    for k in range(parts):
        part = BSpline(own, net[k * (spans + degree - 1) :][: spans + degree], degree)
        at = torch.from_numpy((k + np.clip(u, 1e-9, 1 - 1e-9)) / parts)
        for order in (0, 1):
            found = space.matrix(at, order).numpy() @ net / parts**order
            np.testing.assert_allclose(found, part(np.clip(u, 1e-9, 1 - 1e-9), order), rtol=1e-6, atol=1e-6)


def test_one_part_is_the_lens_of_always():
    for n, p in ((4, 3), (50, 3), (9, 1)):
        inner = torch.linspace(0.0, 1.0, n - p + 1, dtype=torch.float64)
        assert torch.equal(open_knots(n, p), torch.cat([inner.new_zeros(p), inner, inner.new_ones(p)]))


@pytest.mark.parametrize("lenslets_along", [2, 3, 7])
def test_control_points_that_an_array_can_have(lenslets_along):
    for n, p in itertools.product((4, 31, 100), (1, 2, 3)):
        fits = array_control(n, p, lenslets_along)
        assert fits >= n
        assert SplineSpace.uniform(fits, p, lenslets_along).n == fits == array_control(fits, p, lenslets_along)
        with pytest.raises(InputError, match="side by side"):
            open_knots(fits + 1, p, lenslets_along)


# Lenslets


def test_lenslets_together_throw_the_image_of_the_array():
    """The same rays, cell by cell, through the whole and through each lenslet in its own frame, under an uneven beam."""
    profile = np.random.default_rng(5).uniform(0.5, 1.0, (6, 4))
    scene = array_scene(profile=profile)
    heights, each = bumps(scene), 12
    field = HeightField.of(scene.lens)
    whole = expose(scene, field, heights, rays_of(scene, "grid", each * each * 6), None, torch.float64)
    parts = lenslets(scene)
    total = sum(
        one.share
        * expose(one.scene, one.field, one.of(heights), rays_of(one.scene, "grid", each * each), None, torch.float64).image
        for one in parts
    )
    assert sum(one.share for one in parts) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(total.numpy(), whole.image.numpy(), atol=1e-12)
    assert float(whole.image.sum()) > 0.5


def test_shares_of_a_profile_whose_cells_straddle_borders():
    """The part of a beam on each lenslet, from cells of a fifth of the array: by hand along each axis."""
    scene = array_scene(profile=np.outer([1.0, 2.0, 3.0, 4.0, 5.0], [1.0, 1.0]))
    along = np.array([1 + 2 * 2 / 3, 2 / 3 + 3 + 4 / 3, 4 * 2 / 3 + 5]) / 15.0
    assert [one.share for one in lenslets(scene)] == pytest.approx(list(np.repeat(along, 2) / 2), rel=1e-12)


def test_lenslets_whose_borders_can_meet_do():
    scene = array_scene()
    net, rng = bumps(scene), np.random.default_rng(3)
    parts = [one.of(net) + float(rng.normal()) for one in lenslets(scene)]
    made = assemble(parts, scene.lens.array)
    assert made.gap < 1e-14
    difference = made.heights - net
    assert float(difference.max() - difference.min()) < 1e-13
    parts[0] = parts[0] + torch.linspace(0.0, 1e-3, parts[0].shape[1], dtype=torch.float64)
    assert 1e-4 < assemble(parts, scene.lens.array).gap < 1e-3


def test_shares_of_a_point_nearby():
    """The solid angles of the lenslets, seen from the point."""
    scene = replace(array_scene(), source=Points(((1.0, -0.5, -12.0),)))
    found = {one.middle: one.share for one in lenslets(scene)}
    at = np.linspace(-1.5, 1.5, 201)
    by_hand = {}
    for mx, my in found:
        x, y = np.meshgrid(mx + at - 1.0, my + at + 0.5, indexing="ij")
        by_hand[mx, my] = float(((12.0 + scene.lens.z_in) / (x * x + y * y + (12.0 + scene.lens.z_in) ** 2) ** 1.5).mean())
    total = sum(by_hand.values())
    assert list(found.values()) == pytest.approx([part / total for part in by_hand.values()], rel=2e-3)


@pytest.mark.parametrize(
    ("source", "far", "most"),
    [
        (PlaneWave(), False, 0.1),
        (PlaneWave(), True, 0.1),
        (Points(((1.0, -2.0, -40.0),)), False, 0.1),
        (Disc((0.0, 0.0, -40.0), (0.1, 0.1)), False, 0.1),
    ],
    ids=["plane", "far field", "point", "disc"],
)
def test_the_initial_surface_of_an_array(source, far, most):
    """In a plane wave, in the far field, and in light nearby, which crosses borders of lenslets within the glass."""
    x = np.linspace(-1.0, 1.0, 32)
    goal = np.exp(-3.0 * (x[:, None] ** 2 + (x[None, :] - 0.2) ** 2)) + 0.2
    control = tuple(array_control(n, 3, 2) for n in (60, 60))
    lens = Lens((8.0, 8.0), index=1.5, control=control, array=(2, 2), fresnel="none")
    scene = Scene(source, lens, Screen((24.0, 24.0), 120.0, (32, 32), far=far))
    heights = initial_array(scene, [goal], control, 64).heights
    error = retrace(scene, HeightField.of(lens), heights, goal, rays=400_000)[1]["relative_rms"]
    assert error < most, error


def test_gradient_of_the_loss_of_an_array():
    """Taylor: the remainder falls with the square of the step, also along control points that two or four lenslets share."""
    scene = array_scene()
    heights, goals = bumps(scene), np.random.default_rng(8).uniform(0.1, 1.0, (6, 30, 25))
    filter = Filter("cosine", (5, 5))

    def one(k, part):
        rays = rays_of(part.scene, "grid", 900)
        return Objective(part.scene, part.field, rays, torch.from_numpy(goals[k]), "rms", LossImage(filter), dtype=torch.float64)

    loss = array_objective(lenslets(scene), one)
    shared = torch.zeros_like(heights)
    shared[7, :] = shared[:, 6] = 1.0  # rows of the first borders
    along = bumps(scene, 4, 1.0) - 5.0
    here = loss(heights)
    for direction in (along, along * shared):
        slope = float((here.gradient * direction).sum())
        steps = np.array([4e-5, 2e-5, 1e-5])
        left = [abs(loss(heights + h * direction).loss - here.loss - h * slope) for h in steps]
        order = np.polyfit(np.log(steps), np.log(left), 1)[0]
        assert order == pytest.approx(2.0, abs=0.15), left
    assert here.loss == pytest.approx(np.sqrt(np.mean([one.objective(heights[one.where]).loss ** 2 for one in loss.members])))


def hat(n=40):
    x = np.linspace(-1, 1, n)
    return (np.hypot(*np.meshgrid(x, x)) < 0.75).astype(float)


def gauss(n, moved=0.0):
    """A beam, over the aperture, that falls to 80 % in its corners; moved: in parts of the aperture."""
    u = (np.arange(n) + 0.5) / n - 0.5
    return np.exp(np.log(0.8) * ((u[:, None] - moved) ** 2 + u**2) / 0.5)


def test_an_uneven_and_wandering_beam_changes_little():
    """A single lens prints the beam on the picture; three by three lenslets average over it, by rays of their own."""
    lens = Lens((6.0, 6.0), control=(52, 52), array=(3, 3), fresnel="none")
    scene = Scene(PlaneWave(), lens, Screen((18.0, 18.0), 300.0, (40, 40)))
    single = replace(scene, lens=replace(lens, array=(1, 1)))
    heights = initial_array(scene, [hat()], lens.control, 96).heights
    alone = initial_array(single, [hat()], lens.control, 96).heights
    change = []
    for made, net in ((scene, heights), (single, alone)):
        seen = []
        for profile in (np.ones((120, 120)), gauss(120, 1.0 / 6.0)):
            lit = replace(made, source=PlaneWave(1.0, profile))
            image = retrace(lit, HeightField.of(made.lens), net, None, rays=400_000, noise=False)[0].image.numpy()
            seen.append(image / image.sum())
        change.append(np.linalg.norm(seen[1] - seen[0]) / np.linalg.norm(seen[0]))
    assert change[0] < 0.035 and change[1] > 2.0 * change[0], change


# Brightness


def test_brightness_is_the_best_of_all_active_sets():
    rng, checked = np.random.default_rng(6), 0
    for _ in range(20):
        basis, goal = rng.uniform(0, 1, (12, 4)), rng.uniform(0, 1, 12) * (rng.random(12) < 0.5) + 0.01
        found, best = brightness(basis, goal), np.inf
        for on in itertools.product((False, True), repeat=4):
            b = np.linalg.lstsq(basis[:, on], goal, rcond=None)[0]
            if (b >= 0).all():
                best = min(best, np.linalg.norm(basis[:, on] @ b - goal))
        assert np.linalg.norm(basis @ found.brightness - goal) == pytest.approx(best, rel=1e-12)
        assert (found.brightness >= 0).all() and found.residual < 1e-13
        checked += int((found.brightness == 0).any())
    assert checked > 5


def test_brightness_of_lenslets_that_throw_the_same():
    """The same picture twice, one without light, one of far less: still a solution, to 1e-10."""
    rng = np.random.default_rng(7)
    one, other = rng.uniform(0, 1, (2, 300))
    found = brightness(np.stack([one, other, one, 0 * one, 1e-9 * rng.uniform(0, 1, 300)], -1), 2 * one + 3 * other)
    assert found.residual < 1e-10 and found.error < 1e-10 and found.brightness[3] == 0.0
    assert found.brightness[0] + found.brightness[2] == pytest.approx(2.0) and found.brightness[1] == pytest.approx(3.0)


@pytest.mark.parametrize("basis", [np.zeros((6, 2)), np.eye(6)[:, :2]], ids=["no light", "light elsewhere"])
def test_brightness_that_nothing_comes_closer_with_is_refused(basis):
    with pytest.raises(CausticError, match="no image has light where it is wanted"):
        brightness(basis, np.eye(6)[5])


# The program


def run(line: str, capfd) -> tuple[int, str, str]:
    code = cli.run(shlex.split(line))
    return code, *capfd.readouterr()


@pytest.fixture(scope="module")
def arrays(tmp_path_factory):
    """A directory with an array of one picture, one of a sheet of 2 x 2 quadrants, and a single lens."""
    directory = tmp_path_factory.mktemp("arrays")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(directory)
        write_blob()
        sheet = np.zeros((48, 48), np.uint8)
        for i, j in itertools.product((0, 1), repeat=2):
            sheet[24 * i + 12 * i :, 24 * j + 12 * j :][:12, :12] = 255
        Image.fromarray(np.ascontiguousarray(sheet.T[::-1])).save("sheet.png")
        goal = np.zeros((24, 24), np.uint8)
        goal[:12, :12], goal[12:, 12:] = 255, 102
        Image.fromarray(np.ascontiguousarray(goal.T[::-1])).save("goal.png")
        common = "--resolution 32 --iterations 2 --quality draft --quiet --threads 2"
        assert cli.run(shlex.split(f"design blob.png --array 2x3 --control 101x151 {common}")) == 0
        assert cli.run(shlex.split(f"design sheet.png --linear --sheet --array 2 --control 133 {common}")) == 0
        assert cli.run(shlex.split(f"design blob.png -o single.caustic --resolution 24 --start offset --control 8 {common}")) == 0
        yield directory


def test_a_design_of_an_array(arrays, monkeypatch):
    monkeypatch.chdir(arrays)
    lens = caustic.load("blob.caustic")
    assert lens.scene.lens.array == (2, 3) and lens.figures["on_screen"] > 0.85
    for space, parts in zip(lens.field.spaces, (2, 3), strict=True):
        values, counts = np.unique(space.knots.numpy(), return_counts=True)
        assert values[counts == 3] == pytest.approx(np.arange(1, parts) / parts)


def test_brightness_for_a_wanted_illumination(arrays, monkeypatch, capfd):
    monkeypatch.chdir(arrays)
    code, out, err = run("render sheet.caustic --want goal.png --rays 2e5 --effects none --json --force --quiet", capfd)
    want = json.loads(out)["want"]
    level = np.array(want["brightness"])
    assert code == 0 and level.shape == (2, 2) and want["kkt_residual"] < 1e-10
    assert level[0, 0] == 1.0 and level[1, 1] == pytest.approx(0.4, abs=0.03) and max(level[0, 1], level[1, 0]) < 0.05
    assert want["error"] < 0.35 and err == ""
    assert "KKT residual" in run("render sheet.caustic --want goal.png --rays 2e5 --effects none", capfd)[1]
    with Image.open("sheet.caustic/wanted.png") as image:
        assert image.size == (32, 32)


def test_brightness_of_each_colour(arrays, monkeypatch, tmp_path):
    """Two lenslets with images of their own, beside each other but for a common column: each colour is solved by itself."""
    own = replace(caustic.load(arrays / "sheet.caustic").scene.lens, array=(2, 1))
    light = Light(wavelengths=RGB, weights=(1.0, 2.0, 1.0), color=True)
    scene = replace(caustic.load(arrays / "sheet.caustic").scene, lens=own, light=light)
    left, right = np.zeros((8, 6)), np.zeros((8, 6))
    left[:4], right[4:] = 1.0 / 24, 1.0 / 24
    parts = np.array([0.25, 0.5, 0.25])[:, None, None]
    images = [(0.4, 0.4 * parts * left), (0.6, 0.6 * parts * right)]
    monkeypatch.setattr(illumination, "_images", lambda rendering: iter(images))
    output = illumination.Illumination(tmp_path / "goal.png")
    asked = np.array([[0.5, 0.0], [0.25, 1.0], [1.0, 0.5]])
    output.target = sum(asked[:, k, None, None] * images[k][1] for k in (0, 1))
    place = SimpleNamespace(beside=lambda name: tmp_path / name)
    found = output.write(SimpleNamespace(scene=scene, place=place, lens=SimpleNamespace(encoding="srgb")))["want"]
    assert np.array(found["brightness"]) == pytest.approx(asked[:, :, None]) and found["error"] < 1e-12
    assert found["power"] == pytest.approx(float((parts[:, :, 0] * asked * [0.4, 0.6]).sum()))
    with Image.open(tmp_path / "wanted.png") as image:
        assert image.mode == "RGB"


def test_brightness_is_what_a_profile_of_the_beam_does(arrays, monkeypatch):
    """The whole array under a beam of the brightnesses throws the image that the lenslets' own make."""
    monkeypatch.chdir(arrays)
    lens = caustic.load("sheet.caustic")
    level = np.array([[1.0, 0.2], [0.0, 0.5]])
    beam = replace(lens.scene, source=PlaneWave(1.0, level))
    whole = retrace(beam, lens.field, lens.heights, None, rays=400_000, noise=False)[0].image.numpy()
    parts = [
        one.share * retrace(one.scene, one.field, one.of(lens.heights), None, rays=100_000, noise=False)[0].image.numpy()
        for one in lenslets(lens.scene)
    ]
    sum_of = np.tensordot(level.ravel() / (level.mean()), parts, 1)
    assert np.linalg.norm(sum_of - whole) / np.linalg.norm(whole) < 0.03


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("render single.caustic --want goal.png", "--array"),
        ("render blob.caustic --want none.png --force", "none.png"),
        ("design blob.png --sheet --force", "--array"),
        ("design blob.png --array 2 --aperture circle", "rectangle"),
        ("design blob.png --array 2 --control 40", "41 x 41"),
        ("design blob.png --array 2 --start offset", "--start"),
        ("design sheet.png --array 5 --sheet", "same size"),
        ("design goal.png --array 2 --sheet", "black all over"),
        ("design blob.png --array 0 --force", "--array"),
    ],
)
def test_refusals(line, said, arrays, monkeypatch, capfd):
    monkeypatch.chdir(arrays)
    code, _, err = run(line, capfd)
    assert code == 2 and said in err and len(err.strip().splitlines()) == 1, err


def test_an_image_by_light_that_the_array_was_not_designed_for(arrays, monkeypatch, capfd):
    """That of a point far away is a plane wave's."""
    monkeypatch.chdir(arrays)
    line = "render blob.caustic --rays 40000 --quiet --json --threads 1"
    plane, far = (run(f"{line} -o {n}.png {o}", capfd) for n, o in (("a", ""), ("b", "--source point --source-position 0,0,-1e6")))
    assert plane[0] == far[0] == 0, far[2]
    assert json.loads(far[1])["relative_rms"] == pytest.approx(json.loads(plane[1])["relative_rms"], rel=0.05)


def test_tiles_are_in_the_order_of_lenslets():
    light = np.arange(4 * 6, dtype=float).reshape(4, 6) + 1.0
    found = tiles(light, (2, 3))
    assert [t[0, 0] for t in found] == [1.0, 3.0, 5.0, 13.0, 15.0, 17.0] and found[0].shape == (2, 2)


# Files


def test_step_of_an_array_is_one_closed_shell(tmp_path):
    """Every edge bounds two faces, once each way; the face has a ridge at every border, and poles are the heights."""
    scene = array_scene()
    write_step(tmp_path / "array.step", scene, HeightField.of(scene.lens), bumps(scene))
    text = (tmp_path / "array.step").read_text()
    uses = re.findall(r"ORIENTED_EDGE\('',\*,\*,(#\d+),\.([TF])\.\)", text)
    edges = set(re.findall(r"^(#\d+)=EDGE_CURVE", text, re.M))
    assert len(edges) == 12 and sorted(uses) == sorted((e, way) for e in edges for way in "TF")
    assert text.count("CLOSED_SHELL") == text.count("MANIFOLD_SOLID_BREP") == 1 and text.count("=ADVANCED_FACE") == 6
    (surface,) = re.findall(r"=B_SPLINE_SURFACE_WITH_KNOTS\(.*", text)
    assert "(4,1,1,1,1,3,1,1,1,1,3,1,1,1,1,4),(3,1,1,1,1,2,1,1,1,1,3)" in surface


def test_step_of_an_array_in_opencascade(tmp_path):
    control = pytest.importorskip("OCP.STEPControl")
    from OCP.BRepCheck import BRepCheck_Analyzer  # noqa: PLC0415
    from OCP.TopAbs import TopAbs_ShapeEnum  # noqa: PLC0415

    scene = array_scene()
    write_step(tmp_path / "array.step", scene, HeightField.of(scene.lens), bumps(scene))
    reader = control.STEPControl_Reader()
    reader.ReadFile(str(tmp_path / "array.step"))
    reader.TransferRoots()
    shape = reader.OneShape()
    assert BRepCheck_Analyzer(shape).IsValid() and shape.ShapeType() == TopAbs_ShapeEnum.TopAbs_SOLID


@pytest.mark.parametrize("tolerance", [None, 1e-4])
def test_mesh_of_an_array_is_closed_and_has_its_ridges(tolerance):
    scene = array_scene()
    field, heights = HeightField.of(scene.lens), bumps(scene)
    vertices, faces = closed_mesh(scene, field, heights, **({"tolerance": tolerance} if tolerance else {}))[:2]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    for line in (-1.5, 1.5):
        assert (np.abs(vertices[:, 0] - line) < 1e-12).sum() > 10
    top = vertices[vertices[:, 2] > 2.0]
    x, y = (torch.from_numpy(np.ascontiguousarray(c, dtype=float)) for c in top.T[:2])
    off = field.at(heights, x, y, [(0, 0)])[0].numpy() - top[:, 2]
    assert np.abs(off).max() < 1e-12


def test_an_archive_of_an_array_is_the_same_lens(arrays, monkeypatch, capfd):
    monkeypatch.chdir(arrays)
    names = "step,stl,lighttools,mitsuba,zemax,heightmap,obj,ply,xyz,csv"
    code, out, _ = run(f"export blob.caustic --format {names} --json --quiet", capfd)
    assert code == 0 and len(json.loads(out)["exports"]) == 10
    lens, again = caustic.load("blob.caustic"), caustic.load("blob.npz")
    assert torch.equal(lens.heights, again.heights)
    images = [one.render(40_000, effects="none").image for one in (lens, again)]
    np.testing.assert_array_equal(*images)
