"""Lenses and folding mirrors beside the free-form lens: paraxial optics, folded axes, first surfaces, gradients, designs, files."""

import json
import math
import re
import sys
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import begun, write_blob
from PIL import Image
from rayfiles import cone_of, tm25
from scipy.ndimage import maximum_filter

from caustic_cli import cli, load
from caustic_cli.errors import InputError
from caustic_cli.export.bodies import CLOSE, bodies
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mesh import closed_mesh
from caustic_cli.inverse.incidence import incident
from caustic_cli.inverse.initial_surface import first_surface, sphere_net
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.relay import RelayedScreen
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.wave_objective import WaveObjective
from caustic_cli.io.archive import open_archive
from caustic_cli.kinds import problem_of
from caustic_cli.kinds.robust import RobustElements
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.frames import AxisSegment, Pose, rotate_to_global
from caustic_cli.optics.misalignment import Misalignment, landing_points
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces import HeightField, Sphere
from caustic_cli.optics.surfaces.facets import FacetSurface
from caustic_cli.optics.system import ENTRANCE, EXIT, PlacedScreen, System, split_heights
from caustic_cli.optics.trace import Tracer, expose, render
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene import Aperture, Component, FoldMirror, Lens, Light, Offset, PlaneWave, Points, Pupil, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.studies.effects import _row
from caustic_cli.studies.retrace import retrace

sys.path.insert(0, str(Path(__file__).parent / "independent"))
from photographs import lattice, leaving

PIXELS = 32
LENS = Lens((10.0, 10.0), control=(35, 35), offset=Offset(5.0), fresnel="none")
SCREEN = Screen((38.0, 38.0), 300.0, (PIXELS, PIXELS))
SCENE = Scene(PlaneWave(), LENS, SCREEN)
#: A long wave, whose images take a quarter of the samples.
INFRARED = Light(wavelengths=(1100.0,), weights=(1.0,))
FIELD = HeightField.of(LENS)


def thick(z: float, size: float = 12.0, radius=(60.0, -90.0), thickness: float = 4.0, index: float = 1.6, **more) -> Component:
    return Component(z, (size, size), thickness, radius, index, **more)


def mirror(z: float, tilt, radius: float = math.inf, size: float = 70.0) -> FoldMirror:
    return FoldMirror(z, (size, size), radius=(radius, math.inf), tilt=tilt)


def matrix(radius, thickness: float, index: float) -> np.ndarray:
    """Of a thick lens, vertex to vertex: (x, tangent) to (x, tangent), by its two refractions and the way between."""
    front, back = ((n - 1) / n if n == index else 1 - index for n in (index, 1.0))
    first = np.array([[1, 0], [-front / radius[0], 1 / index]])
    last = np.array([[1, 0], [-back / radius[1], index]])
    return last @ [[1, thickness], [0, 1]] @ first


def straight(distance: float) -> np.ndarray:
    return np.array([[1.0, distance], [0.0, 1.0]])


def paraxial_rays(scene: Scene, x: float, tangent: float) -> tuple[float, float]:
    """Where a ray close to the axis of a scene with a flat lens leaves its last element, counted there, and its tangent."""
    one = torch.ones(1, dtype=torch.float64)
    system = System.of(scene, FIELD)
    length = math.hypot(1.0, tangent)
    start = scene.in_front[0].z if scene.in_front else LENS.z_in
    rays = RayState((x * one, 0.0 * one, start * one), (tangent / length * one, 0.0 * one, one / length), one)
    (state,) = Tracer(system, rays)({EXIT: torch.full((35, 35), 5.0, dtype=torch.float64)})
    dx, _, dz = state.full(state.direction)
    last = scene.behind[-1].vertex("back") if scene.behind else 5.0
    return float(state.origin[0] + (last - state.origin[2] - state.datum) * dx / dz), float(dx / dz)


def test_a_thick_lens_has_the_focus_and_the_principal_planes_of_the_lens_makers_formula():
    radius, t, n = (60.0, -90.0), 4.0, 1.6
    scene = replace(SCENE, elements=(thick(-30.0, radius=radius, thickness=t, index=n),))
    power = (n - 1.0) * (1.0 / radius[0] - 1.0 / radius[1] + (n - 1.0) * t / (n * radius[0] * radius[1]))
    x, tangent = paraxial_rays(scene, 1e-4, 0.0)
    assert -tangent / 1e-4 == pytest.approx(power, rel=1e-8)
    # Back focus, counted from the last vertex through the plate of the free-form lens, brings the second principal plane.
    back = 1.0 / power * (1.0 - t * (n - 1.0) / (n * radius[0]))
    reached = back + x / tangent  # 0 where the ray would cross the axis, less what it has gone
    assert reached == pytest.approx(26.0 + 5.0 / LENS.index, rel=1e-7)


def test_two_lenses_in_line_are_their_system_matrix():
    one, two = thick(-40.0), thick(60.0, 25.0, (-70.0, 200.0), 6.0, 1.5)
    scene = replace(SCENE, elements=(one, two))
    plate = straight(5.0 / LENS.index)
    system = matrix((-70.0, 200.0), 6.0, 1.5) @ straight(55.0) @ plate @ straight(36.0) @ matrix((60.0, -90.0), 4.0, 1.6)
    for x, tangent in ((1e-4, 0.0), (0.0, 1e-5), (5e-5, -2e-6)):
        assert paraxial_rays(scene, x, tangent) == pytest.approx(tuple(system @ [x, tangent]), rel=1e-7, abs=1e-14)


def test_the_screen_seen_through_what_follows_is_that_of_the_matrix():
    two = thick(60.0, 25.0, (-70.0, 200.0), 6.0, 1.5)
    seen = RelayedScreen(replace(SCENE, elements=(two,)), 5.0)
    a, b = (straight(300.0 - 66.0) @ matrix((-70.0, 200.0), 6.0, 1.5) @ straight(55.0))[0]
    assert seen.first_order[0] == pytest.approx([a, a], rel=1e-6) and seen.first_order[1] == pytest.approx([b, b], rel=1e-6)
    u, v = np.array([[3.0, -4.0]]), np.array([[1.0, 2.0]])
    x, y, z = np.array([[2.0, -3.0]]), np.array([[0.5, 4.0]]), np.full((1, 2), 5.1)
    t = np.stack(seen.directions_to(u, v)(x, y, z))
    found = seen.intersections(tuple(c.ravel() for c in (x, y, z)), tuple(c.ravel() for c in t / np.linalg.norm(t, axis=0)))
    assert np.allclose(np.stack(found), [u.ravel(), v.ravel()], atol=1e-5)


def wavy(scale: float = 0.05) -> torch.Tensor:
    x, y = (c / 5.0 for c in FIELD.control_xy())
    return 5.0 + scale * (torch.cos(3.0 * x)[:, None] * torch.sin(2.0 * y + 0.4)[None, :] + 0.5 * (x[:, None] - y[None, :] ** 2))


@pytest.mark.parametrize(("tilt", "axis"), [((45.0, 0.0), 1), ((-40.0, 0.0), 1), ((0.0, 50.0), 0)])
@pytest.mark.parametrize("how", [{}, {"radius": (60.0, 60.0)}, {"tilt": (10.0, 20.0)}])
def test_a_folded_scene_has_the_image_of_the_straight_one_mirrored_in_the_plane_of_the_fold(tilt, axis, how):
    """A mirror that is turned about x mirrors y, and the other way round; a screen leans and is shifted in its own frame."""
    shift, lean = np.array([3.0, 1.0]), np.array(how.get("tilt", (0.0, 0.0)))
    screen = replace(SCREEN, shift=tuple(shift), **how)
    turned = replace(
        screen,
        shift=tuple(np.where(np.arange(2) == axis, -shift, shift)),
        tilt=tuple(np.where(np.arange(2) == 1 - axis, -lean, lean)) if axis == 1 else tuple(lean * [1.0, -1.0]),
    )
    rays = rays_of(SCENE, "stratified", 20_000, 1)
    plain = expose(replace(SCENE, screen=screen), FIELD, wavy(), rays, Filter("cosine", (3, 3)))
    folded = replace(SCENE, screen=turned, elements=(mirror(120.0, tilt),))
    found = expose(folded, FIELD, wavy(), rays, Filter("cosine", (3, 3)))
    assert torch.allclose(found.image.flip(axis), plain.image, atol=1e-9 * float(plain.image.max()))
    assert found.lost["off_screen"] == pytest.approx(plain.lost["off_screen"], abs=1e-9)


def test_two_mirrors_make_a_periscope_whose_picture_is_upright():
    rays = rays_of(SCENE, "stratified", 20_000, 1)
    plain = expose(SCENE, FIELD, wavy(), rays)
    system = System.of(replace(SCENE, elements=(mirror(100.0, (45.0, 0.0)), mirror(200.0, (-45.0, 0.0)))), FIELD)
    assert system.leg is not None and np.allclose(system.leg.frame, np.eye(3), atol=1e-15)
    assert np.allclose(system.leg.at(0.0, 0.0, 300.0), [0.0, 100.0, 200.0])
    scene = replace(SCENE, elements=(mirror(100.0, (45.0, 0.0)), mirror(200.0, (-45.0, 0.0))))
    assert torch.allclose(expose(scene, FIELD, wavy(), rays).image, plain.image, atol=1e-12)


TWO = mirror(90.0, (0.0, -50.0)), mirror(200.0, (40.0, 0.0))


@pytest.mark.parametrize("elements", [(mirror(120.0, (45.0, 0.0), size=12.0),), TWO])
@pytest.mark.parametrize("how", [{}, {"radius": (60.0, 60.0)}, {"tilt": (10.0, 20.0), "shift": (3.0, 1.0)}])
def test_a_scene_seen_in_its_flat_mirrors_has_a_straight_axis_and_the_same_image(elements, how):
    """Of light that misses a mirror, too: the first is smaller than the beam."""
    folded = replace(SCENE, screen=replace(SCREEN, **how), elements=elements)
    seen, rays = folded.unfolded, rays_of(SCENE, "stratified", 20_000, 1)
    assert not seen.elements and System.of(seen, FIELD).leg is None
    real, found = (expose(scene, FIELD, wavy(), rays, Filter("cosine", (3, 3))) for scene in (folded, seen))
    assert torch.allclose(found.image, real.image, atol=1e-12 * float(real.image.max()))
    assert found.lost == pytest.approx(real.lost, abs=1e-12)
    assert (found.lost["missed_surface"] > 0.001) == (len(elements) == 1)
    whole = Misalignment()
    (real,) = landing_points(seen, FIELD, wavy(), rays, whole)
    assert float(real.power.sum()) == pytest.approx(1.0 - found.lost["missed_surface"], abs=1e-12)


def test_only_flat_mirrors_are_seen_through():
    flat = mirror(90.0, (45.0, 0.0))
    for element in (
        thick(120.0, 25.0, thickness=6.0),
        mirror(120.0, (45.0, 0.0), radius=-500.0),
        replace(flat, z=120.0, free="front"),
    ):
        for elements in ((element,), (flat, element)):
            scene = replace(SCENE, elements=elements)
            assert scene.unfolded is scene


@cache
def straight_waves():
    """A scene without elements, its wave image, a picture, and what a design learns of another surface by it."""
    scene = replace(SCENE, light=INFRARED, screen=replace(SCREEN, shift=(3.0, 1.0)))
    goal = torch.rand(PIXELS, PIXELS, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    learnt = WaveObjective(scene, FIELD, wavy(), goal, "rms", dtype=torch.float64)(wavy(0.0501))
    return scene, wave_image(scene, FIELD, wavy()).image, goal, learnt


@pytest.mark.parametrize(("tilt", "axis"), [((45.0, 0.0), 1), ((0.0, -50.0), 0)])
def test_the_wave_image_behind_a_flat_mirror_is_that_of_the_straight_scene_mirrored(tilt, axis):
    """As the image of its rays; with it the loss that a design reduces, and its derivative, by the mirrored picture."""
    straight, one, goal, learnt = straight_waves()
    shift = np.array(straight.screen.shift)
    turned = replace(SCREEN, shift=tuple(np.where(np.arange(2) == axis, -shift, shift)))
    folded = replace(straight, screen=turned, elements=(mirror(120.0, tilt),))
    other = wave_image(folded, FIELD, wavy()).image
    assert torch.allclose(other.flip(axis), one, atol=1e-5 * float(one.max()))
    rays = expose(folded, FIELD, wavy(), rays_of(SCENE, "stratified", 200_000, 1)).image
    assert float((other - rays).norm() / rays.norm()) < 0.03
    assert float((other.flip(axis) - rays).norm() / rays.norm()) > 0.5
    found = WaveObjective(folded, FIELD, wavy(), goal.flip(axis), "rms", dtype=torch.float64)(wavy(0.0501))
    assert found.loss == pytest.approx(learnt.loss, rel=1e-6)
    first, second = (evaluation.gradients[EXIT] for evaluation in (learnt, found))
    assert float((first - second).norm()) < 1e-4 * float(first.norm())


def test_a_mirror_that_the_beam_exceeds_cuts_the_wave_image_as_it_cuts_the_rays():
    folded = replace(SCENE, light=INFRARED, elements=(mirror(120.0, (45.0, 0.0), size=12.0),))
    waves = wave_image(folded, FIELD, wavy())
    rays = expose(folded, FIELD, wavy(), rays_of(SCENE, "stratified", 200_000, 1))
    assert 1.0 - waves.leaving == pytest.approx(rays.lost["missed_surface"], rel=0.05) and rays.lost["missed_surface"] > 0.02
    assert float((waves.image - rays.image).norm() / rays.image.norm()) < 0.05


def test_a_lens_behind_focuses_a_square_beam_to_the_pattern_of_its_aperture():
    """Fraunhofer's: sin^2 of an aperture a along each axis, as wide as the wavelength times the focal length over a."""
    a, radius, length = 2.0, (60.0, -90.0), INFRARED.wavelengths[0] * 1e-6
    small = Lens((a, a), control=(8, 8), offset=Offset(5.0), fresnel="none")
    behind = thick(60.0, 6.0, radius)
    m = matrix(radius, behind.thickness, behind.index)
    focal, back = -1.0 / m[1, 0], -m[0, 0] / m[1, 0]
    half = 2.5 * length * focal / a
    screen = Screen((2.0 * half, 2.0 * half), 60.0 + behind.thickness + back, (25, 25))
    scene = Scene(PlaneWave(), small, screen, light=INFRARED, elements=(behind,))
    field = HeightField.of(small)
    found = wave_image(scene, field, torch.full(field.shape, 5.0, dtype=torch.float64), dtype=torch.float64)
    fine = (np.arange(25 * 40) + 0.5) / (25 * 40) * 2.0 - 1.0
    line = np.sinc(2.5 * fine).reshape(25, 40) ** 2
    line = line.sum(1) * (5.0 / (25 * 40))  # its integral over all x is 1
    expected = np.outer(line, line)
    assert np.abs(found.image.numpy() - expected).max() < 0.01 * expected.max()


LENSES = (thick(60.0, 40.0, (120.0, -120.0), 9.0),), (thick(60.0, 40.0, (70.0, -80.0), 14.0),)


@pytest.mark.parametrize("elements", [(thick(-30.0, 12.0, (150.0, math.inf)),), *LENSES, (mirror(100.0, (45.0, 0.0), -900.0),)])
def test_the_wave_image_through_other_elements_is_near_that_of_the_rays(elements):
    """As near as for the lens by itself, whose picture it turns over behind the second of the lenses."""
    apart = []
    for beside in ((), elements):
        scene = replace(SCENE, light=INFRARED, elements=beside)
        waves, rays = wave_image(scene, FIELD, wavy()), expose(scene, FIELD, wavy(), rays_of(scene, "stratified", 200_000, 1))
        assert waves.leaving == pytest.approx(float(rays.image.sum()), rel=0.01)
        apart.append(float((waves.image - rays.image).norm() / rays.image.norm()))
    assert apart[1] < 2.0 * apart[0] < 0.06


def test_paths_through_a_lens_behind_change_with_the_exit_as_a_new_trace_says():
    scene, target = replace(SCENE, light=INFRARED, elements=LENSES[0]), torch.from_numpy(picture())
    way = (wavy() - wavy().mean()) / wavy().std()
    there = wavy() + 3e-4 * way  # steeper by 1 %
    first, other = (WaveObjective(scene, FIELD, h, target, "rms") for h in (wavy(), there))
    before, linear, exact = first(wavy()).loss, first(there).loss, other(there).loss
    assert abs(exact - before) > 1e-3 * before and linear - before == pytest.approx(exact - before, rel=0.1)
    gradient = first(wavy()).gradient
    ends = [first(wavy() + sign * 1e-7 * way).loss for sign in (1, -1)]
    assert (ends[0] - ends[1]) / 2e-7 == pytest.approx(float((gradient * way).sum()), rel=0.02)


def test_errors_displace_the_image_behind_a_flat_mirror_as_that_of_the_straight_scene():
    errors = Misalignment(throw=2.0, lens_shift=(0.1, 0.2), lens_tilt=(0.3, 0.1), screen_shift=(0.4, 0.5), screen_tilt=(1.0, 2.0))
    rays = rays_of(SCENE, "stratified", 4_000, 1)
    folded = replace(SCENE, elements=(mirror(120.0, (45.0, 0.0)),)).unfolded
    (found,) = landing_points(folded, FIELD, wavy(), rays, errors)
    mirrored = replace(errors, screen_shift=(0.4, -0.5), screen_tilt=(-1.0, 2.0))
    (straight,) = landing_points(SCENE, FIELD, wavy(), rays, mirrored)
    assert torch.allclose(found.x, straight.x, atol=1e-9) and torch.allclose(found.y, -straight.y, atol=1e-9)
    near = errors.upright(folded).screen
    assert near.shift[1] == pytest.approx(-mirrored.upright(SCENE).screen.shift[1], abs=1e-9) and near.mirrored == (False, True)


ERRORS = Misalignment(
    index=0.01,
    thickness=0.1,
    throw=1.5,
    lens_shift=(0.3, -0.2),
    lens_tilt=(1.0, -2.0),
    source_shift=(0.1, 0.2),
    source_distance=-1.0,
    source_tilt=(0.3, -0.4),
    screen_shift=(0.2, 0.1),
    screen_tilt=(1.0, 0.5),
)
BESIDE = (thick(-20.0, 14.0, (80.0, math.inf)), thick(30.0, 20.0, thickness=5.0), mirror(70.0, (40.0, 0.0), -400.0, 60.0))


def in_the_room(scene: Scene, e: Misalignment) -> tuple[System, PlacedScreen]:
    """System and screen with these errors in the frame of the elements that keep their places."""
    plain, stand = (
        System.of(replace(scene, lens=replace(LENS, index=LENS.index + e.index)), FIELD),
        Pose((*e.lens_shift, 0.0), e.lens_tilt),
    )
    foot = rotate_to_global(stand, (0.0, 0.0, e.thickness - LENS.z_in))
    entrance = replace(stand, position=(*e.lens_shift, LENS.z_in))
    poses = {ENTRANCE: entrance, EXIT: replace(stand, position=tuple(a + b for a, b in zip(entrance.position, foot, strict=True)))}
    elements = tuple(replace(one, pose=poses.get(one.name, one.pose)) for one in plain.elements)
    leg = plain.leg or AxisSegment()
    screen = Pose(leg.at(*e.screen_shift, scene.screen.z + e.throw), e.screen_tilt, leg.frame)
    return replace(plain, elements=elements, lit=Pupil(Aperture((60.0, 60.0)), -30.0)), PlacedScreen(scene.screen, screen)


@pytest.mark.parametrize("elements", [BESIDE[:1], BESIDE[1:2], BESIDE[1:], BESIDE])
@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.5, -0.3, -80.0),))])
def test_a_lens_that_stands_otherwise_among_elements_is_so_in_the_room(source, elements):
    """The same rays, traced through turned and shifted surfaces in the frame of the other elements."""
    scene, e = replace(SCENE, source=source, screen=replace(SCREEN, z=120.0), elements=elements), ERRORS
    heights = LENS.offset.thickness + 0.01 * wavy() / wavy().abs().max()
    rays = rays_of(e.scene(scene), "stratified", 2000, 1)
    (seen,) = landing_points(scene, FIELD, heights, rays, e)
    system, frame = System.of(e.scene(scene), FIELD), e.frame(scene)
    (state,) = rays.chunks(10**6)
    if not isinstance(state, RayState):
        state = RayState.on_axis(state, system.pupil.half_size, system.pupil.z)
    state = e.directed(scene, e.scene(scene).source, state).expanded()
    origin, direction = state.full((*state.origin[:2], state.origin[2] + state.datum)), state.full(state.direction)
    origin = rotate_to_global(frame, (origin[0], origin[1], origin[2] - LENS.z_in))
    origin = [a + b for a, b in zip(origin, frame.position, strict=True)]
    direction = rotate_to_global(frame, direction)
    start = tuple(o - (40.0 + origin[2]) / direction[2] * d for o, d in zip(origin, direction, strict=True))
    room, screen = in_the_room(scene, e)
    landed = Tracer(room, RayState(start, direction, torch.ones_like(start[0]))).land({EXIT: heights}, screen)[0]
    both = (seen.power > 0) & (landed.power > 0)
    assert both.sum() > 500 and (seen.power[~both] == 0).all()
    for mine, other in zip((seen.x, seen.y), landed.origin[:2], strict=True):
        assert torch.allclose(mine[both], other[both], atol=1e-9)
    # nearly the same without tilts of the screen, and of parallel light behind lenses in front
    e = replace(e, screen_tilt=(0.0, 0.0), **({"source_tilt": (0.0, 0.0)} if scene.in_front and source.distant else {}))
    near = e.upright(scene)
    (exact,) = landing_points(scene, FIELD, heights, rays, e)
    (close,) = landing_points(near, FIELD, heights + e.thickness, rays_of(near, "stratified", 2000, 1), Misalignment())
    (plain,) = landing_points(scene, FIELD, heights, rays_of(scene, "stratified", 2000, 1), Misalignment())
    lit = (exact.power > 0) & (close.power > 0) & (plain.power > 0)
    off, without = (torch.hypot(one.x - exact.x, one.y - exact.y)[lit].mean() for one in (close, plain))
    assert off < 0.1 * without


def test_a_robust_design_moves_the_lens_among_the_elements(_here, capfd):
    Path("errors.toml").write_text(
        "[lens_shift]\nsigma = [0.2, 0.2]\n[source_tilt]\nsigma = [0.1, 0.1]\n[thickness]\nsigma = 0.05\n"
    )
    options = ("--element", FIELD_LENS, "--element", "lens z=60 radius=120,-120 free=back", "--robust", "errors.toml")
    run(capfd, "design", "one.png", *SMALL, *options, "--iterations", "1", "-o", "p")
    problem = problem_of(Project.open("p"))
    assert isinstance(problem, RobustElements)
    heights = problem.all_surfaces(load("p").heights)
    loss = problem.objective(len(problem.stages) - 1, heights)
    draws = [(m.objective.scene.mounting, m.added) for m in loss.members[1:]]
    for ((a, _), one), ((b, _), other) in (draws[:2], draws[2:]):
        assert a == (-b[0], -b[1]) and any(a)
        assert torch.equal(one, -other) and not one[0].any() and one[1].any()  # the lens' own thickness
    found, way = loss(heights), torch.randn(heights.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    step = 1e-5 * way
    change = (loss(heights + step).loss - loss(heights - step).loss) / 2.0
    assert change == pytest.approx(float((found.gradient * step).sum()), rel=0.03)


def test_a_folded_axis_is_that_of_the_reflected_ray():
    leg, normal = AxisSegment().folded(70.0, (35.0, 0.0)), np.array([0.0, -math.sin(math.radians(35)), math.cos(math.radians(35))])
    axis = np.array([0.0, 0.0, 1.0])
    assert np.allclose(leg.frame[2], axis - 2.0 * normal[2] * normal)
    assert np.allclose(leg.at(0.0, 0.0, 70.0), [0.0, 0.0, 70.0])
    assert np.linalg.det(np.array(leg.frame)) == pytest.approx(1.0)


def test_a_concave_mirror_focuses_at_half_its_radius():
    """Of rays close to the axis, square to the plane of incidence: the sagittal focus, f / cos."""
    hollow = mirror(50.0, (30.0, 0.0), radius=-200.0)
    at = 100.0 / math.cos(math.radians(30.0))
    seen = RelayedScreen(replace(SCENE, elements=(hollow,), screen=replace(SCREEN, z=50.0 + at)), 5.0)
    a, _ = seen.first_order
    assert abs(a[0]) < 1e-6  # parallel rays of any x meet there
    tangential = RelayedScreen(
        replace(SCENE, elements=(hollow,), screen=replace(SCREEN, z=50.0 + 100.0 * math.cos(math.radians(30)))), 5.0
    )
    assert abs(tangential.first_order[0][1]) < 1e-4  # and of any y


ALL = (
    thick(-30.0, 12.0, (80.0, -80.0), free="back"),
    thick(40.0, 20.0, (math.inf, -120.0), free="both"),
    mirror(110.0, (40.0, 0.0), radius=900.0, size=60.0),
)


def test_the_loss_has_the_gradients_of_all_surfaces_together():
    """Taylor's remainder along a direction in all of them falls with the square of the step; and each by central differences."""
    scene = replace(SCENE, elements=(*ALL[:2], replace(ALL[2], free="front")), lens=replace(LENS, fresnel="exact"))
    assert scene.free_surfaces == ("element-1-back", "element-2-front", "element-2-back", "element-3-front", "exit")
    nets = [sphere_net(e, side, FIELD) for e in scene.elements for side in e.free_sides]
    nets = torch.stack([*nets, wavy(0.01)])
    target = torch.ones(PIXELS, PIXELS, dtype=torch.float64)
    target[10:20, 8:24] = 3.0
    rays = rays_of(scene, "grid", 20_000)
    objective = Objective(
        scene, FIELD, rays, target, "rms-light", LossImage(Filter("cosine", (5, 5)), apron=6, oversample=1), dtype=torch.float64
    )
    found, generator = objective(nets), torch.Generator().manual_seed(3)
    assert found.gradient.shape == nets.shape and (found.gradient.abs().amax((1, 2)) > 0).all()
    ways = torch.randn(nets.shape, generator=generator, dtype=torch.float64)
    for k in range(len(nets)):
        way = torch.zeros_like(ways)
        way[k] = ways[k]
        ahead, behind = (objective(nets + s * 1e-6 * way).loss for s in (1, -1))
        assert float((found.gradient * way).sum()) == pytest.approx((ahead - behind) / 2e-6, rel=1e-3)
    slope = float((found.gradient * ways).sum())
    remainders = [abs(objective(nets + h * ways).loss - found.loss - h * slope) for h in (4e-6, 2e-6, 1e-6)]
    orders = np.log2(np.array(remainders[:-1]) / remainders[1:])
    assert (orders > 1.8).all(), (remainders, orders)


def test_designed_surfaces_trace_as_the_free_ones_and_as_the_spheres_that_they_began_as():
    scene = replace(SCENE, elements=ALL)
    nets = torch.stack([*(sphere_net(e, s, FIELD) for e in ALL for s in e.free_sides), wavy()])
    (free,) = render(System.of(scene, FIELD), dict(zip(scene.free_surfaces, nets, strict=True)), 20_000, kind="grid")
    fixed, exit = split_heights(scene, FIELD, nets)
    rays = rays_of(fixed, "grid", 20_000)
    found = expose(fixed, FIELD, exit, rays)
    assert torch.allclose(free.image, found.image, atol=1e-12) and free.lost == pytest.approx(found.lost, abs=1e-12)
    spheres = replace(scene, elements=tuple(replace(e, free="none") for e in ALL))
    smooth = Filter("cosine", (5, 5))
    a, b = (expose(s, FIELD, exit, rays, smooth).image for s in (fixed, spheres))
    assert float((a - b).abs().max()) < 1e-3 * float(b.max())  # a net of 35 points is that near a sphere


def picture() -> np.ndarray:
    u = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
    x, y = np.meshgrid(u, u, indexing="ij")
    light = 0.3 + np.exp(-((x - 0.2) ** 2 + (y + 0.1) ** 2) / 0.05) + 0.7 * np.exp(-((x + 0.35) ** 2 + (y - 0.3) ** 2) / 0.02)
    return light * (np.maximum(abs(x), abs(y)) < 0.78)


@pytest.mark.parametrize(
    ("source", "elements"),
    [
        (PlaneWave(), (thick(-30.0, 10.0, (120.0, math.inf), 3.0, 1.5),)),
        (Points(((0.0, 0.0, -150.0),)), (thick(-30.0, 10.0, (60.0, -60.0), 4.0, 1.5),)),
        (PlaneWave(), (thick(60.0, 26.0, (150.0, -150.0), 6.0, 1.5),)),
        (PlaneWave(), (thick(60.0, 30.0, (70.0, -70.0), 8.0, 1.6),)),  # which turns the image over
        (PlaneWave(), (mirror(120.0, (0.0, -45.0)),)),
        (PlaneWave(), (mirror(120.0, (45.0, 0.0), radius=-1500.0),)),
        (Points(((1.0, -0.5, -120.0),)), (mirror(90.0, (50.0, 0.0)), thick(150.0, 60.0, (400.0, math.inf), 8.0, 1.5))),
    ],
)
def test_first_surfaces_are_about_as_good_as_without(source, elements):
    """By a retrace, against that of the same picture and a plane wave without anything beside the lens."""

    def error(scene: Scene) -> float:
        found = first_surface(scene, picture(), FIELD, 96)
        return retrace(scene, FIELD, found.heights, picture(), rays=200_000, noise=False)[1]["relative_rms"]

    bare = error(SCENE)
    assert error(replace(SCENE, source=source, elements=elements)) < bare + 0.07 < 0.12


@pytest.mark.parametrize(
    "elements", [(thick(-30.0, 10.0, (60.0, -60.0), 4.0, 1.5),), (thick(60.0, 26.0, (150.0, -150.0), 6.0, 1.5),)]
)
def test_a_ray_file_lights_other_elements_as_its_source_does(elements):
    at = (0.0, 0.0, -150.0)
    scene = replace(SCENE, source=Points((at,), cone=4.0), elements=elements, screen=replace(SCREEN, resolution=(8, 8)))
    measured = replace(scene, source=Measured(RaySet(*cone_of(200_000, 4.0, seed=1)), at))
    surfaces = [first_surface(replace(s, screen=SCREEN), picture(), FIELD, 96).heights for s in (scene, measured)]
    images = [expose(s, FIELD, surfaces[0], rays_of(s, "stratified", 200_000)).image for s in (scene, measured)]
    relief = surfaces[0].std()
    assert (surfaces[0] - surfaces[1]).std() < 0.05 * relief and images[0].sum() > 0.2
    assert torch.allclose(*images, atol=5.0 * math.sqrt(float(images[0].max()) / 200_000))


def test_light_through_a_field_lens_is_that_of_traced_rays():
    """Power on cells of the exit, by counting rays; all that passes the entrance's aperture is there."""
    scene = replace(SCENE, source=Points(((0.5, 0.0, -90.0),)), elements=(thick(-25.0, 10.0, (40.0, -200.0)),))
    line = np.linspace(-5.0, 5.0, 21)
    light, directions = incident(scene, line, line, np.full((21, 21), 5.0))
    counted = counted_light(scene, line)
    bright = counted > 0.3 * counted.max()
    light, counted = light / light.sum(), counted / counted.sum()
    assert bright.sum() > 100 and np.abs(light[bright] / counted[bright] - 1.0).mean() < 0.05
    assert all(np.isfinite(c).all() for c in directions)


def counted_light(scene: Scene, line: np.ndarray) -> np.ndarray:
    """Power on cells of a plane exit, by counting rays."""
    found = []
    for rays in rays_of(scene, "stratified", 400_000, 2).chunks(1 << 20):
        (state,) = Tracer(System.of(scene, FIELD), rays)({EXIT: torch.full((35, 35), 5.0, dtype=torch.float64)})
        found.append(np.histogram2d(*(c.numpy() for c in state.origin[:2]), bins=[line, line], weights=state.power.numpy())[0])
    return np.sum(found, axis=0)


def test_light_is_bounded_by_all_apertures_before_the_lens():
    """Of diverging light a lens' second surface passes less than its first, of the same diameter."""
    led = Points(((0.0, 0.0, -80.0),), cone=9.0)
    scene = replace(SCENE, source=led, elements=(thick(-40.0, 8.0, (math.inf, -20.0), 8.0, 1.5, aperture="circle"),))
    line = np.linspace(-5.0, 5.0, 51)
    light, counted = incident(scene, line, line, np.full((51, 51), 5.0))[0], counted_light(scene, line)
    reached = maximum_filter(counted, 3) > 0.0
    assert 0.4 < reached.mean() < 0.7 and light[~reached].sum() < 1e-3 * light.sum()


def test_effects_know_of_all_glasses_and_apertures():
    glass = thick(-30.0, 8.0, (60.0, -90.0), glass="N-SF11", absorption=0.02)
    lens = replace(LENS, fresnel="exact")
    scene = replace(SCENE, lens=lens, elements=(glass, mirror(120.0, (45.0, 0.0))), light=Light(None, (450.0, 650.0)))
    plan = compile_plan(scene, FIELD, wavy())
    assert {"absorption", "dispersion", "fresnel", "missed-surface"} <= {*plan.simulated}
    image = expose(scene, FIELD, wavy(), rays_of(scene, "stratified", 20_000))
    lost = image.lost
    # both surfaces of both lenses reflect, at nearly normal incidence
    n, m = (sum(b.scene.at(w).elements[0].index for b, w in zip(scene.bands, (450.0, 650.0), strict=True)) / 2, lens.index)
    passed = (1 - ((n - 1) / (n + 1)) ** 2) ** 2 * (1 - ((m - 1) / (m + 1)) ** 2) ** 2
    assert 1.0 - lost["absorbed"] - lost["fresnel"] == pytest.approx(passed * math.exp(-0.02 * 4.0), rel=5e-3)
    assert float(image.image.sum()) + sum(lost.values()) == pytest.approx(1.0, abs=1e-12)
    narrow = replace(scene, elements=(replace(glass, size=(8.0, 8.0)), replace(scene.elements[1], size=(8.0, 8.0))))
    assert expose(narrow, FIELD, wavy(), rays_of(narrow, "stratified", 20_000)).lost["missed_surface"] > 0.1


def test_a_study_of_effects_leaves_out_what_other_elements_exclude():
    scene = replace(SCENE, elements=(thick(60.0, 26.0, (150.0, -150.0), 6.0, 1.5),))
    plan = compile_plan(scene, FIELD, wavy())
    asked = {one.name: k for k, one in enumerate(plan.effects) if one.name in ("gradient-index", "mirror", "absorption", "fresnel")}
    rows = {name: _row(plan, scene, FIELD, wavy(), 500, [1, 1], 0, torch.float64, k) for name, k in asked.items()}
    assert rows.pop("mirror") is None
    assert len(rows) == 3 and all(row is not None for row in rows.values())


@pytest.mark.parametrize("aperture", ["rectangle", "circle"])
def test_solids_are_closed_and_their_spheres_are_spheres(aperture):
    elements = (thick(-30.0, 12.0, (30.0, math.inf), aperture=aperture), mirror(110.0, (40.0, 0.0), radius=-500.0, size=40.0))
    scene = replace(SCENE, elements=elements)
    vertices, faces = closed_mesh(scene, FIELD, wavy(), (41, 41))
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    corners = vertices[faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    body, plate = bodies(scene)
    (own,) = (closed_mesh(SCENE, FIELD, wavy(), (41, 41)),)
    bare = own[0][own[1]]
    without = np.einsum("ij,ij->i", bare[:, 0], np.cross(bare[:, 1], bare[:, 2])).sum() / 6.0
    r, t = 6.0, 4.0
    if aperture == "circle":  # a cylinder less the cap that the sphere's front leaves of it, by the cap's formula
        sag = 30.0 - math.sqrt(900.0 - r * r)
        of_lens = math.pi * r * r * (t - sag) + math.pi * sag * (3 * r * r + sag * sag) / 6.0
        most = 40.0 * 40.0 * 3.0 * 1.3
        assert of_lens < volume - without < of_lens + most
    z = body.lens.entrance
    assert z is not None and plate.lens.entrance is not None
    field = HeightField(body.field.spaces, body.field.half_size)
    assert field.half_size == (6.0, 6.0)
    sphere, net = Sphere(30.0), torch.from_numpy(z.heights)
    spline = System.of(replace(scene, elements=(replace(elements[0], surfaces=(z, None)),))).elements[0].surface
    line = torch.linspace(-4.2, 4.2, 50, dtype=torch.float64)
    assert float((spline.at(None, line, 0.7 * line)[0] - sphere.at(None, line, 0.7 * line)[0]).abs().max()) <= CLOSE
    assert net.shape[0] >= 16
    # The mirror's plate leans as the mirror does: its corners lie behind its surface's plane by at most its thickness and sag.
    normal = np.array(plate.pose.axes[2])
    own = vertices[vertices[:, 2] > 60.0]
    depth = (own - np.array(plate.pose.position)) @ normal
    back = 3.0 + max(0.0, float(plate.lens.entrance.heights.max()))
    assert depth.min() > -1.0 and depth.max() == pytest.approx(back, abs=1e-9)


@pytest.fixture
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=200000")
    light = picture()
    Image.fromarray((255 * light / light.max()).astype(np.uint8).T[::-1]).save("one.png")


SMALL = ("--linear", "--resolution", "32", "--control", "35", "--rays", "40000", "--quiet", "--json")
FIELD_LENS = "lens z=-30 thickness=4 radius=150,inf glass=N-BK7"


def run(capfd, *arguments, code=0):
    assert cli.run(list(map(str, arguments))) == code, capfd.readouterr().err
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


def test_design_render_resume_and_files(_here, capfd):
    mirror_text = "mirror z=150 tilt=45,0"
    made = run(
        capfd, "design", "one.png", *SMALL, "--element", FIELD_LENS, "--element", mirror_text, "--iterations", "4", "-o", "p"
    )
    assert made["relative_rms"] < made["start_relative_rms"] < 0.4 and made["on_screen"] > 0.8
    settings = tomllib.loads(Path("p/project.toml").read_text())
    assert [e["type"] for e in settings["element"]] == ["lens", "mirror"]
    assert settings["element"][0]["radius"] == [150.0, math.inf] and settings["element"][0]["size"] == [10.0, 10.0]
    again = run(capfd, "render", "p", "--rays", "200000", "--effects", "fresnel", "--quiet", "--json")
    assert again["relative_rms"] == pytest.approx(made["relative_rms"], rel=0.05)
    lens = load("p")
    lens.export("lens.npz")
    scene, field, heights = open_archive("lens.npz")
    a, b = (
        expose(s, f, h, rays_of(s, "grid", 10_000)).image
        for s, f, h in ((scene, field, heights), (lens.scene, lens.field, lens.heights))
    )
    assert torch.allclose(a, b, atol=1e-12)
    lens.export("lens.step")
    text = Path("lens.step").read_text()
    assert text.count("MANIFOLD_SOLID_BREP") == 3 and text.count("B_SPLINE_SURFACE_WITH_KNOTS") == 5
    Path("t.toml").write_text("draws = 10\n[lens_shift]\nsigma = [0.2, 0.2]\n[source_tilt]\nsigma = [0.1, 0.1]\n")
    found = run(capfd, "render", "p", "--report", "--tolerances", "t.toml", "--rays", "20000", "--quiet", "--json")
    assert found["tolerances"]["sensitivities"][0]["adds"] > 0.01
    (z, zx, zy), report = lens.surface(*np.meshgrid(*[np.linspace(-5, 5, 101)] * 2, indexing="ij")), found["report"]
    assert report["minimum_wall_mm"] == pytest.approx(z.min() - lens.scene.lens.z_in, rel=1e-3)
    assert report["maximum_slope"] == pytest.approx(np.hypot(zx, zy).max(), rel=0.02) and report["sharpness_limit_mm"] is None
    run(capfd, "render", "p", "--html", "page.html", "--rays", "20000", "--quiet", "--force", "--json")
    assert '"rays":[{' in Path("page.html").read_text()
    run(capfd, "export", "p", "--format", "zemax", "--samples", "33", "--json", "--quiet")
    assert "among other elements" in Path("p.dat").read_text()


def test_a_flat_mirror_excludes_nothing_that_a_lens_has_by_itself(_here, capfd):
    """Neither page, report, tolerances, a grid for Zemax, studies, ray files nor designs that are robust or on the wave
    image."""
    flat = ("--element", "mirror z=150 tilt=45,0")
    Path("t.toml").write_text("draws = 40\n[index]\nsigma = 0.001\n")
    Path("led.tm25ray").write_bytes(tm25(*cone_of(20_000, 8.0, seed=1)))
    led = ("--source", "rays", "--source-file", "led.tm25ray", "--source-position", "0,0,-40")
    made = run(capfd, "design", "one.png", *SMALL, *led, *flat, "--iterations", "2", "-o", "led")
    assert made["relative_rms"] < 0.6 and made["on_screen"] > 0.7
    run(capfd, "design", "one.png", *SMALL, "--robust", "t.toml", *flat, "--iterations", "2", "-o", "robust")
    made = run(capfd, "design", "one.png", *SMALL, "--waves", "off", *flat, "--iterations", "2", "-o", "p")
    asked = ("--report", "--tolerances", "t.toml", "--html", "page.html", "--rays", "20000", "--effects", "fresnel")
    said = run(capfd, "render", "p", *asked, "--quiet", "--json")
    assert said["tolerances"]["nominal"]["relative_rms"] == pytest.approx(made["relative_rms"], rel=0.1) and said["report"]
    page = Path("page.html").read_text()
    assert "the edges of the mirrors" in page
    assert json.loads(re.search(r'"axes":(\[\[.*?\]\])', page)[1]) == [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    load("p").export("lens.dat")
    assert "flat mirrors fold" in Path("lens.dat").read_text()
    study = run(capfd, "convergence", "p", "--study", "intersection", "--repeats", "1", "--rays", "500", "--quiet", "--json")
    assert study
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("caustic_cli.workflow.design._run", begun)
        assert cli.run(["design", "one.png", *SMALL[:3], "--waves", "on", *flat, "--quiet", "-o", "w"]) == 0
    assert any(stage.get("waves") for stage in tomllib.loads(Path("w/project.toml").read_text())["design"]["stages"])


def test_an_archive_holds_the_glass_of_every_lens(tmp_path):
    """Whose index is another at each wavelength; one of them is given by its index."""
    lens = Lens((10.0, 10.0), control=(6, 6), glass="N-BK7", index=1.5168, offset=Offset(4.0))
    beside = thick(20.0), thick(30.0, glass="N-SF11")
    scene = Scene(PlaneWave(), lens, Screen((20.0, 20.0), 90.0, (8, 8)), Light(wavelengths=(450.0, 650.0)), elements=beside)
    field, heights = HeightField.of(lens), torch.full((6, 6), 4.0, dtype=torch.float64)
    write_lighttools(tmp_path / "a.npz", scene, field, heights, (9, 9))
    again, *of_exit = open_archive(tmp_path / "a.npz")
    assert [e.glass for e in again.elements] == [None, "N-SF11"]
    one, other = (expose(s, *of, rays_of(s, "grid", 900)).image for s, *of in ((scene, field, heights), (again, *of_exit)))
    assert torch.allclose(one, other, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--mirror",), "--mirror cannot be combined with --element"),
        (("--element", "lens z=60 free=front", "--collimate"), "--collimate"),
    ],
)
def test_what_other_elements_exclude_is_named_as_it_was_given(_here, capfd, options, words):
    assert words in run(capfd, "design", "one.png", *SMALL, "--element", FIELD_LENS, *options, code=2)
    Path("beside.toml").write_text("[[element]]\nz = -30.0\n")
    said = run(capfd, "design", "one.png", *SMALL, "--config", "beside.toml", "--mirror", code=2)
    assert "--mirror cannot be combined with [[element]]:" in said


def test_surfaces_of_two_lenses_are_shaped_together(_here, capfd, monkeypatch):
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=200000 source_cells=256")
    beside = ("--element", "lens z=60 thickness=6 radius=150,-150 index=1.5 size=26 free=both")
    fixed = ("--element", beside[1].removesuffix(" free=both"))
    one = run(capfd, "design", "one.png", *SMALL, *fixed, "--iterations", "8", "-o", "one")
    both = run(capfd, "design", "one.png", *SMALL, *beside, "--iterations", "8", "-o", "p")
    assert both["start_relative_rms"] == pytest.approx(one["start_relative_rms"], rel=0.02)
    assert both["relative_rms"] < 1.1 * one["relative_rms"] and both["relative_rms"] < 0.8 * both["start_relative_rms"]
    lens = load("p")
    assert lens.state is not None and lens.state.heights.shape == (3, 35, 35)
    assert lens.scene.elements[0].surfaces[0] is not None and torch.equal(lens.heights, lens.state.heights[-1])
    begun = torch.stack([sphere_net(lens.scene.elements[0], side, lens.field) for side in ("front", "back")])
    assert (lens.state.heights[:2] - begun).abs().amax((1, 2)).min() > 1e-6
    figures = run(capfd, "render", "p", "--rays", "400000", "--effects", "fresnel", "--quiet", "--json")
    assert figures["relative_rms"] == pytest.approx(both["relative_rms"], rel=0.06)
    longer = run(capfd, "design", "--resume", "p", "--iterations", "12", "--quiet", "--json")
    assert longer["iterations"] == 12 and longer["relative_rms"] < 1.02 * both["relative_rms"]
    (found,) = run(capfd, "gradmap", "p", "--check", "--rays", "40000", "--quiet", "--json")["maps"]
    assert found["largest"] > 0 and found["check"]["relative_error"] < 1e-3
    lens = load("p")
    lens.export("lens.npz")
    scene, field, heights = open_archive("lens.npz")
    a, b = (
        expose(s, f, h, rays_of(s, "grid", 10_000)).image
        for s, f, h in ((scene, field, heights), (lens.scene, lens.field, lens.heights))
    )
    assert torch.allclose(a, b, atol=1e-12)
    text = Path("p/project.toml").read_text()
    Path("p/project.toml").write_text(text.replace('free = "both"', 'free = "none"'))
    assert "free-form surface" in run(capfd, "render", "p", code=2)


@pytest.mark.parametrize("text", [FIELD_LENS, "mirror z=150 tilt=45,0"])
def test_mitsuba_traces_them(_here, capfd, text):
    pytest.importorskip("mitsuba")
    run(capfd, "design", "one.png", *SMALL, "--element", text, "--iterations", "2", "-o", "p")
    found = run(capfd, "render", "p", "--verify", "mitsuba", "--rays", "400000", "--quiet", "--json")["verify"]
    assert found["agree"] and 0.9 < found["z_mean_square"] < 1.1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("prism z=3", "must begin with lens or mirror"),
        ("lens", "⟨z⟩ must be given"),
        ("lens z", "must be KEY=VALUE"),
        ("lens zz=3", "zz is not a key; did you mean z?"),
        ("lens z=3 z=4", "says z twice"),
        ("lens z=three", "must be a number"),
        ("lens z=-30 radius=50", "two numbers separated by a comma"),
        ("lens z=-30 radius=5,inf", "must be at least"),
        ("lens z=-30 radius=50,-0", "non-zero"),
        ("lens z=-30 thickness=0.1 radius=30,-30", "glass at the rim"),
        ("lens z=-30 tilt=10,0", "is for mirrors"),
        ("lens z=-30 index=1.5 glass=BK7", "index or glass, not both"),
        ("lens z=-30 index=0.5", "greater than 1"),
        ("lens z=-30 glass=brass", "metal"),
        ("lens z=2", "in the order in which light reaches them"),
        ("lens z=-60", "⟨source.position⟩ must lie before"),
        ("lens z=299", "⟨screen.z⟩ must lie behind"),
        ("mirror z=150", "turn it about x or about y"),
        ("mirror z=150 tilt=45,45", "turn it about x or about y"),
        ("mirror z=150 tilt=45,0 thickness=3", "is for lenses"),
        ("mirror z=150 tilt=45,0 free=back", "its only surface"),
        ("mirror z=-60 tilt=45,0", "a rotated source"),
        ("lens z=-30 aperture=circle size=10x8", "its diameter"),
        ("lens z=30 free=top", "must be one of"),
    ],
)
def test_bad_elements_are_refused(_here, capfd, text, words):
    source = ("--source", "point", "--source-position", "0,0,-58")
    said = run(capfd, "design", "one.png", *SMALL[:-2], *source, "--element", text, code=2)
    assert len(said.splitlines()) == 1, said
    for mark, plain in (("⟨z⟩", "z"), ("⟨source.position⟩", ""), ("⟨screen.z⟩", "")):
        words = words.replace(mark, plain)
    assert words.strip() in said, said
    assert not Path("one.caustic").exists()


def test_a_mirror_sends_light_back_through_other_elements_and_is_refused(_here, capfd):
    said = run(capfd, "design", "one.png", *SMALL[:-2], "--element", FIELD_LENS, "--mirror", code=2)
    assert "sends light back" in said and len(said.splitlines()) == 1


#: A plane-parallel plate, 20 mm of index 1.6.
PLATE = Component(30.0, (60.0, 60.0), 20.0, index=1.6)


def plated(lens, heights=None):
    """Landing points behind PLATE and directions of a plane wave behind a lens, by the independent tracer."""
    made = SimpleNamespace(field=HeightField.of(lens), scene=replace(SCENE, lens=lens))
    x, y = lattice(made, 40)
    start, ahead = np.stack([x, y, 0.0 * x]), np.stack([0.0 * x, 0.0 * x, 1.0 + 0.0 * x])
    index = (lambda p: lens.index + 0.004 * p[2]) if lens.gradient is not None else lens.index
    point, ahead = leaving(made, heights, None, start, ahead, index)
    straight = (SCREEN.z - 20.0 - point[2]) / ahead[2]
    within = 20.0 / np.sqrt(1.6**2 - ahead[0] ** 2 - ahead[1] ** 2)
    return np.array([point[k] + (straight + within) * ahead[k] for k in (0, 1)]), ahead


@pytest.mark.parametrize("kind", ["gradient", "lenslets", "far field"])
def test_what_a_lens_has_it_has_beside_other_elements(kind):
    """Light lands where Snell's law at the exit and at both sides of a plate takes it, in the far field by its direction alone."""
    change = {"gradient": {"gradient": Gradient("axial", (0.004,))}, "lenslets": {"array": (2, 2)}}.get(kind, {})
    lens = replace(LENS, **change)
    screen = Screen((200.0, 200.0), 1000.0, (8, 8), far=True) if kind == "far field" else SCREEN
    scene, field = Scene(PlaneWave(), lens, screen, elements=(PLATE,)), HeightField.of(lens)
    x, y = field.control_xy()
    heights = 5.0 - 0.004 * (x[:, None] ** 2 + y**2) + 0.02 * torch.sin(x[:, None]) * torch.cos(0.7 * y)
    landing, ahead = plated(lens, heights)
    expected = 1e3 * ahead[:2] if kind == "far field" else landing
    rays = RayState.on_axis(_lattice_sample(40), lens.half_size, scene.pupil.z).expanded()
    found = Tracer(System.of(scene, field), rays).land({EXIT: heights}, screen)[0]
    at = np.array([np.asarray(c) for c in found.origin[:2]])
    assert np.abs(at - expected).max() < 5e-5 and expected.std() > 1.0


def _lattice_sample(count):
    """The same lattice as samples of the aperture, from 0 to 1."""
    u = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    u, v = (c.reshape(-1) for c in torch.meshgrid(u, u, indexing="ij"))
    return Sample(u, v, False, torch.ones_like(u))


def test_waves_in_the_far_field_do_not_notice_a_plate():
    """It delays and displaces them; their angles are those behind the lens alone."""
    screen = Screen((120.0, 120.0), 1000.0, (PIXELS, PIXELS), far=True)
    alone = Scene(PlaneWave(), LENS, screen, INFRARED)
    heights = wavy()
    one, other = (wave_image(scene, FIELD, heights).image for scene in (alone, replace(alone, elements=(PLATE,))))
    assert float((one - other * (one.sum() / other.sum())).norm() / one.norm()) < 1e-3
    assert float(other.sum() / one.sum()) == pytest.approx(1.0, abs=1e-3)


def test_a_screen_where_the_lens_is_imaged_is_refused():
    relay = thick(155.0, 30.0, (98.5, -98.5), 6.0, 1.5)  # of focal length 100 mm, about
    m = matrix((98.5, -98.5), 6.0, 1.5) @ straight(150.0)
    imaged = 161.0 - m[0, 1] / m[1, 1]
    with pytest.raises(InputError, match="conjugate to the lens"):
        _ = RelayedScreen(replace(SCENE, elements=(relay,), screen=replace(SCREEN, z=float(imaged))), 5.0).first_order


def test_a_scene_without_elements_is_as_it_was():
    scene = replace(SCENE, elements=())
    assert scene.pupil.z == LENS.z_in and scene.axial and not scene.joint and System.of(scene, FIELD).leg is None
    rays = next(iter(rays_of(scene, "lines", 4_000).chunks()))
    assert Tracer(System.of(scene, FIELD), rays).fused is not None


def test_measured_surfaces_stand_among_other_elements():
    """As the facets of an exported mesh, which have no splines: exports and simulated cuts are judged by them."""
    scene = replace(SCENE, elements=(thick(40.0), mirror(90.0, (0.0, 45.0))), screen=replace(SCREEN, z=150.0))
    x, y = np.meshgrid(np.linspace(-5.0, 5.0, 9), np.linspace(-5.0, 5.0, 9), indexing="ij")
    facets = FacetSurface(np.stack([x, y, np.full_like(x, 5.0)], -1))
    flat = torch.full(FIELD.shape, 5.0, dtype=torch.float64)
    images = [expose(scene, surface, flat, rays_of(scene, "grid", 4000)).image for surface in (facets, FIELD)]
    assert images[0].numpy() == pytest.approx(images[1].numpy(), abs=1e-7) and float(images[1].sum()) > 0.9


@pytest.mark.parametrize(
    ("far", "element", "width"),
    [
        # a picture of 30 mm at 300 mm by a lens of 10 mm: through nothing, a plate, a thin lens of 120 mm at 60 mm (X = 180 q - x)
        (False, {"type": "mirror", "tilt": [0.0, 45.0]}, 10.0 + 20.0 * 0.2),
        (False, {"radius": [math.inf, math.inf], "index": 1.5, "thickness": 6.0}, 14.0),
        (False, {"radius": [120.0, -120.0], "index": 1.5, "thickness": 8.0}, 2.0 * (5.0 + 60.0 * (15.0 + 5.0) / 180.0)),
        # a concave mirror of the same focal length, and one that diverges: X = 420 q + 3 x
        (False, {"type": "mirror", "tilt": [0.0, 45.0], "radius": [-240.0, math.inf]}, 2.0 * (5.0 + 60.0 * 20.0 / 180.0)),
        (False, {"type": "mirror", "tilt": [0.0, 45.0], "radius": [240.0, math.inf]}, 14.0),
        # directions of X / 300 behind the lens, X = 300 (q (1 - 60 / 120) - x / 120)
        (
            True,
            {"radius": [120.0, -120.0], "index": 1.5, "thickness": 8.0},
            2.0 * (5.0 + 60.0 * (15.0 / 300.0 + 5.0 / 120.0) / 0.5),
        ),
    ],
)
def test_an_element_is_as_wide_as_the_beam_that_makes_the_picture(far, element, width):
    given = {"lens": {"size": [10.0, 10.0]}, "target": {"size": [30.0, 30.0]}, "screen": {"z": 300.0, "far": far}}
    made = complete({**given, "element": {"list": [{"z": 60.0, **element}]}}, 1.0).elements[0]
    lean = math.cos(math.radians(max(made.tilt or (0.0, 0.0))))
    assert made.size == pytest.approx([1.2 * width / lean, 1.2 * width], rel=1e-6)


def test_a_default_lens_is_no_wider_than_its_thickness_lets_it_be():
    thin = {"z": 60.0, "radius": [60.0, -60.0], "index": 1.5, "thickness": 4.0}
    made = complete({"screen": {"z": 300.0}, "element": {"list": [thin]}}, 1.0).elements[0]
    edge = 4.0 - 2.0 * (60.0 - math.sqrt(60.0**2 - 0.5 * made.size[0] ** 2))
    assert 0.0 < edge < 1.0 and made.size[0] > 1.2 * 14.0


def test_a_far_picture_behind_a_lens_takes_all_light(tmp_path, monkeypatch, capfd):
    """By a lens of the default size: one as wide as an undeflected beam lost half of it."""
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png", 24, (11, 13), 6.0)
    lens = "lens z=60 thickness=8 radius=120,-120 index=1.5"
    options = ("--throw", "inf", "--resolution", "24", "--quality", "draft", "--waves", "off", "--control", "40")
    assert cli.run(["design", "blob.png", *options, "--element", lens, "--json", "--quiet"]) == 0
    made = json.loads(capfd.readouterr().out)
    index = load("blob.caustic").scene.lens.index
    transmitted = (0.96 * (1.0 - ((index - 1.0) / (index + 1.0)) ** 2)) ** 2  # by two surfaces each
    assert made["on_screen"] == pytest.approx(transmitted, abs=3e-3)


def test_a_lens_far_beyond_the_screen_is_not_refused_for_the_width_of_a_beam_there(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png", 24, (11, 13), 6.0)
    for lens, word in (("radius=30,-30", "thickness"), ("radius=300,-300 thickness=8", "screen")):
        assert cli.run(["design", "blob.png", "--element", f"lens z=1e9 {lens}", "--quiet"]) == 2
        said = capfd.readouterr().err
        assert said.count("\n") == 1 and "size" not in said and word in said
