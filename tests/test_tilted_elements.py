"""Tilted light among other lenses and mirrors: where it goes by closed forms, where the screen then stands, and designs for it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli, load
from caustic_cli.inverse.lens_space import undeviated_ray
from caustic_cli.inverse.projection import FarProjection, stretching_surface
from caustic_cli.inverse.relay import RelayedScreen
from caustic_cli.inverse.scene_parameters import Range, Ranges
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.screen_shape import shape_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.project.completion import complete
from caustic_cli.scene import Component, FoldMirror, Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.screen import FOCAL

THICKNESS, INDEX, ANGLE, THROW = 6.0, 1.5, 10.0, 300.0
SINE, COSINE = math.sin(math.radians(ANGLE)), math.cos(math.radians(ANGLE))
#: Cosine and tangent of the refracted light in the plate, and its way in it, mm.
REFRACTED = math.asin(SINE / INDEX)
SLOWER, TANGENT = math.cos(REFRACTED), math.tan(REFRACTED)
PLATE = Component(60.0, (60.0, 60.0), THICKNESS, index=INDEX)
FOLD = FoldMirror(100.0, (90.0, 90.0), tilt=(45.0, 0.0))
LENS = Lens((10.0, 10.0), offset=Offset(5.0))
#: Where light at ANGLE lands that a parallel plate has displaced on its way, mm.
BESIDE = (THROW - THICKNESS) * SINE / COSINE + THICKNESS * TANGENT


def scene(*elements: Component, tilt=(ANGLE, 0.0)) -> Scene:
    return Scene(PlaneWave(tilt=tilt), LENS, Screen((30.0, 30.0), THROW), elements=elements)


def test_a_plate_shifts_the_light_by_the_difference_of_the_tangents():
    (x, y), (p, q, along) = undeviated_ray(scene(PLATE))
    assert (x, y) == pytest.approx((0.0, -BESIDE), abs=1e-9)
    assert (p, q) == pytest.approx((0.0, -SINE / COSINE * along), abs=1e-12)


def test_behind_a_mirror_the_light_is_on_the_other_side_of_the_folded_axis():
    """By reflection in space: behind a mirror about x, y of the frame is reversed, and nothing else."""
    for tilt, flips in (((ANGLE, 0.0), (1, -1)), ((0.0, ANGLE), (1, -1)), ((7.0, 5.0), (1, -1))):
        straight, folded = (undeviated_ray(scene(*e, tilt=tilt)) for e in ((), (FOLD,)))
        for a, b, sign in zip(straight[0], folded[0], flips, strict=True):
            assert b == pytest.approx(sign * a, abs=1e-9)
        lit = scene(FOLD, tilt=tilt).undeviated
        length = math.sqrt(sum(c * c for c in folded[1]))
        assert lit == pytest.approx([c / length for c in folded[1]], abs=1e-12)


def test_a_plate_in_front_leaves_light_through_the_middle_of_the_lens_as_it_is():
    before = replace(PLATE, z=-20.0)
    (x, y), _ = undeviated_ray(scene(before))
    assert (x, y) == pytest.approx((0.0, -THROW * SINE / COSINE), abs=1e-6)


def test_the_screen_seen_from_the_lens_is_that_about_the_chief_ray():
    """Derivatives through a plate of light at an angle on a screen square to it, by its ways in air and glass."""
    turned = Screen((30.0, 30.0), THROW, shift=(0.0, shift()), tilt=(ANGLE, 0.0))
    seen = RelayedScreen(replace(scene(PLATE), screen=turned), 5.0)
    air, glass = (THROW - 5.0 - THICKNESS) / COSINE, THICKNESS / SLOWER
    a, b = seen.first_order
    assert b[0] == pytest.approx(air + glass / INDEX, rel=1e-5)
    assert b[1] == pytest.approx(COSINE * (air / COSINE**2 + glass / (INDEX * SLOWER**2)), rel=1e-5)
    assert a == pytest.approx([1.0, COSINE], rel=1e-6)
    aim = np.array([[3.0, -4.0]]), np.array([[1.0, 2.0]])
    at = np.array([[2.0, -3.0]]), np.array([[0.5, 4.0]]), np.full((1, 2), 5.1)
    toward = np.stack(seen.directions_to(*seen.project(*aim))(*at))
    landed = seen.landing(at, tuple(toward / np.linalg.norm(toward, axis=0)))
    assert landed[0] == pytest.approx(aim[0], abs=1e-5) and landed[1] == pytest.approx(aim[1] + shift(), abs=1e-5)
    assert seen.lean(1.5) == pytest.approx([0.0, 0.0], abs=1e-9)  # the light goes there by itself


def shift() -> float:
    """Of the screen's centre, where light through the middle of an exit at 5 mm lands, mm."""
    return -((THROW - 5.0 - THICKNESS) * SINE / COSINE + THICKNESS * TANGENT)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_range_of_throws_moves_the_screen_along_the_light():
    """Behind a plate, too: as light goes that is traced through it."""
    over, middle = (
        Ranges((Range("throw", 250.0, 350.0),)),
        replace(scene(PLATE), screen=Screen((30.0, 30.0), THROW, shift=(0.0, -BESIDE))),
    )
    for z in (250.0, 350.0):
        moved = over.scene(middle, [z])
        assert moved.screen.z == z
        assert moved.screen.shift == pytest.approx(undeviated_ray(moved)[0], abs=1e-9)


def test_an_element_has_room_for_the_light_where_it_meets_it():
    """By default: behind a lens by the paraxial refraction at its back."""

    def sizes(elements: list[dict], **more) -> list[tuple[float, float]]:
        given = {"source": {"tilt": [2.0, 0.0], **more}, "screen": {"z": 300.0}, "element": {"list": elements}}
        return [element.size for element in complete(given, 1.0).elements]

    convex = {"z": 60.0, "thickness": 8.0, "radius": [math.inf, -120.0], "index": 1.5}
    plates = [convex, {"z": 180.0, "thickness": 1.0, "index": 1.5}]
    upright = complete({"source": {"tilt": [0.0, 0.0]}, "screen": {"z": 300.0}, "element": {"list": plates}}, 1.0).elements
    slope = math.tan(math.radians(2.0))
    first = 60.0 * slope
    back = first + 8.0 * slope / 1.5
    second = back + (180.0 - 68.0) * (slope - 0.5 * back / 120.0)
    for one, plain, beside in zip(sizes(plates), upright, (first, second), strict=True):
        assert one[0] == plain.size[0]
        assert one[1] - plain.size[1] == pytest.approx(2.0 * beside, rel=5e-3)


def design(*options: str) -> int:
    return cli.run(["design", "blob.png", "--waves", "off", "--quality", "draft", "--resolution", "24", "-o", "p", *options])


@pytest.mark.parametrize(
    ("elements", "at"),
    [
        (("lens z=60 thickness=6 index=1.5",), (0.0, -BESIDE)),
        (("mirror z=100 tilt=45,0",), (0.0, THROW * SINE / COSINE)),
        (("lens z=60 thickness=5 radius=120,-120 index=1.5",), None),
    ],
    ids=["plate", "mirror", "lens"],
)
def test_designs_in_tilted_light(in_tmp, capfd, elements, at):
    """The screen stands where the light goes, and the lens is about as good as without the elements."""
    write_blob()
    assert design("--source-tilt", f"{ANGLE:g},0", "--json") == 0
    alone = json.loads(capfd.readouterr().out)
    assert design("--source-tilt", f"{ANGLE:g},0", "--json", "--force", *(w for e in elements for w in ("--element", e))) == 0
    made = json.loads(capfd.readouterr().out)
    screen = load("p").scene.screen
    if at:
        assert screen.shift == pytest.approx(at, abs=1e-6)
        assert abs(screen.tilt[0]) == pytest.approx(ANGLE, abs=1e-4)
    assert made["error"] < 1.3 * alone["error"] + 0.01
    assert made["on_screen"] > 0.85 * alone["on_screen"]


@pytest.mark.parametrize("elements", [(), (PLATE,), (FOLD,)], ids=["alone", "plate", "mirror"])
@pytest.mark.parametrize("tilt", [(ANGLE, 0.0), (0.0, ANGLE), (7.0, 5.0)])
def test_a_far_screen_stands_where_light_lands_that_nothing_deflects(elements, tilt):
    """A plane exit leaves the light as it is, and an ideal lens of the focal length F sends it F tan(angle) aside."""
    own = [{"type": "mirror" if e is FOLD else "lens", "z": e.z, "size": e.size} for e in elements]
    own = [
        {**o, **({"tilt": e.tilt} if e is FOLD else {"thickness": THICKNESS, "index": INDEX})}
        for o, e in zip(own, elements, strict=True)
    ]
    given = {"source": {"tilt": list(tilt)}, "screen": {"z": FOCAL, "far": True}, "element": {"list": own}}
    placed = complete(given, 1.0).screen
    straight = PlaneWave(tilt=tilt).axis
    signs = (1, -1 if FOLD in elements else 1)
    assert placed.shift == pytest.approx([s * FOCAL * c / straight[2] for s, c in zip(signs, straight, strict=False)], abs=1e-3)
    far = Screen((30.0, 30.0), FOCAL, (5, 5), tilt=tuple(placed.tilt), shift=tuple(placed.shift), far=True)
    lit = replace(scene(*elements, tilt=tilt), screen=far)
    field = HeightField.of(lit.lens)
    picture = expose(lit, field, torch.full(field.shape, 5.0, dtype=torch.float64), rays_of(lit, "stratified", 1000)).image
    assert float(picture[2, 2]) > 0.7
    assert float(picture[2, 2]) == pytest.approx(float(picture.sum()), rel=1e-6)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (60.0, -170.0)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_far_field_is_linear_about_the_middle_of_the_screen(shift, side):
    """Direction cosines and their derivatives there, by finite differences of directions to points of a tilted far screen."""
    screen = Screen((30.0, 30.0), side * FOCAL, tilt=(10.0, -20.0), shift=shift, far=True)
    seen = FarProjection(screen, 5.0, side)
    step = 1e-3 * np.array([[0.0, 1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, -1.0]])
    ahead = FOCAL * np.stack(seen.directions_to(*seen.project(*step))(0.0, 0.0, 0.0))[:2]
    assert np.linalg.norm(ahead[:, 0]) < FOCAL
    assert np.stack(seen.project(*step))[:, 0] == pytest.approx(ahead[:, 0], abs=1e-9)
    assert seen.linear == pytest.approx(np.stack([ahead[:, 1] - ahead[:, 2], ahead[:, 3] - ahead[:, 4]], 1) / 2e-3, abs=1e-6)


def test_a_far_picture_is_as_good_as_one_nearby_in_the_same_light(in_tmp, capfd):
    """Without a slope that would turn the light: 0.35 on the way back to the axis."""
    write_blob()
    made = []
    for throw in ("900", "inf"):
        assert design("--source-tilt", f"{ANGLE:g},0", "--throw", throw, "--json", "--force") == 0
        made.append(json.loads(capfd.readouterr().out)["error"])
    lens = load("p")
    across = np.diff(np.asarray(lens.heights.detach()), axis=1).mean() * (lens.heights.shape[1] - 1) / lens.scene.lens.size[1]
    assert abs(across) < 0.02
    assert made[1] < 1.1 * made[0]


@pytest.mark.parametrize("far", [False, True])
def test_the_quadratic_surface_stretches_the_lens_onto_the_screen_in_tilted_light(far):
    """A plane wave over a square has, through a quadratic surface, an even square as its image, to first order."""
    z = FOCAL if far else THROW
    screen = Screen((90.0, 60.0), z, (60, 60), tilt=(ANGLE, 0.0), shift=(0.0, -z * SINE / COSINE), far=far)
    lit = replace(scene(), lens=replace(LENS, size=(10.0, 10.0), control=(12, 12)), screen=replace(screen, size=(60.0, 40.0)))
    field = HeightField.of(lit.lens)
    x, y = (c.numpy() for c in field.control_xy())
    heights = torch.from_numpy(stretching_surface(lit, x, y))
    picture = expose(replace(lit, screen=screen), field, heights, rays_of(lit, "stratified", 10_000)).image.numpy()
    for axis, wide in enumerate((60.0, 40.0)):
        along, c = picture.sum(1 - axis), (np.arange(60) + 0.5) * screen.pixel[axis]
        mean = along @ c / along.sum()
        # The sides of the lens take a tenth of the light, along y.
        assert math.sqrt(along @ (c - mean) ** 2 / along.sum()) == pytest.approx(
            wide / math.sqrt(12.0), rel=0.04 if axis == 0 else 0.12
        )


def test_a_decentred_far_picture_behind_a_mirror_is_that_of_the_straight_scene():
    """Traced along the folded axis, and seen in the mirror: a plane lens sends all light to one place off the middle."""
    far = Screen((60.0, 60.0), 1000.0, (20, 20), shift=(7.5, 190.0), tilt=(-ANGLE, 0.0), far=True)
    folded = replace(scene(FOLD), screen=far)
    images = []
    for one in (folded, folded.unfolded):
        field = HeightField.of(one.lens)
        flat = torch.full([s.n for s in field.spaces], 5.0, dtype=torch.float64)
        images.append(expose(one, field, flat, rays_of(one, "stratified", 2000, 0)).image.numpy())
    assert images[0].sum() > 0.5
    assert np.abs(images[0] - images[1]).max() < 1e-3
    x, y = ((images[0].sum(axis) @ (3.0 * np.arange(20) - 28.5)) / images[0].sum() for axis in (1, 0))
    beside = 190.0 - 1000.0 * SINE / COSINE
    assert (x, y) == pytest.approx((-7.5, -beside * COSINE), abs=1.6)


@pytest.mark.parametrize(
    ("element", "towards"),
    [
        (None, (0.0, -SINE, COSINE)),
        ("lens z=60 thickness=6 index=1.5", (0.0, -SINE, COSINE)),
        ("mirror z=100 tilt=45,0", (0.0, SINE, COSINE)),
    ],
    ids=["alone", "plate", "mirror"],
)
def test_a_far_picture_stands_in_the_direction_of_the_light(in_tmp, capfd, element, towards):
    """In its middle light lands that the lens does not deviate, which tilted light before a prism would not be."""
    write_blob()
    elements = () if element is None else ("--element", element)
    assert design("--source-tilt", f"{ANGLE:g},0", "--throw", "inf", "--json", *elements) == 0
    made = json.loads(capfd.readouterr().out)
    screen = load("p").scene.screen
    away = 1e6 * np.array(towards)[:, None]
    there = shape_of(screen).coordinates(away, np.array(screen.centre), screen.axes)
    assert np.abs(there).max() < 2e-3  # mrad: tilts are kept to 1e-4 degrees
    assert made["error"] < 0.2
