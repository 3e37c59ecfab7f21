"""The image of an extended source through a point of the lens, against rays of the tracer through a plane facet there, and closed
forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from caustic_cli.inverse.source_image import CUT, _cut, _matrices, source_images
from caustic_cli.inverse.source_limits import etendue_limit, performance_limits
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.coherent import Mode
from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.spread import point_source
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Component, Disc, FoldMirror, FreeForm, Lens, Offset, Scene, Screen, SecondTarget
from caustic_cli.scene.gradient import Gradient
from caustic_cli.studies.metrics import relative_rms

SUN, CHIP = Disc(angle=1.5), Disc((0.3, -0.2, -40.0), (3.0, 2.0))
LENS = Lens((4.0, 4.0), control=(8, 8), offset=Offset(3.0, (math.inf, math.inf)))
SCREEN = Screen((20.0, 20.0), 60.0, (32, 32))
PLAIN = Scene(SUN, LENS, SCREEN)
x = np.linspace(-1.0, 1.0, 8)
ENTRANCE = FreeForm(-0.15 * (x[:, None] ** 2 + 0.7 * x[None, :] ** 2 + 0.2 * x[:, None] * x[None, :]), (3, 3))
BEHIND = Component(20.0, (24.0, 24.0), 7.0, (60.0, -80.0))
SCENES = {
    "bare": PLAIN,
    "far": replace(PLAIN, screen=replace(SCREEN, far=True)),
    "tilted sphere": replace(PLAIN, screen=replace(SCREEN, tilt=(20.0, -10.0), radius=(70.0, 70.0))),
    "sun at an angle": replace(PLAIN, source=replace(SUN, tilt=(12.0, -7.0))),
    "lens behind": replace(PLAIN, elements=(BEHIND,)),
    "lens behind, shifted screen": replace(PLAIN, elements=(BEHIND,), screen=replace(SCREEN, shift=(2.0, -1.0))),
    "curved mirror behind": replace(PLAIN, elements=(FoldMirror(30.0, (60.0, 60.0), tilt=(40.0, 0.0), radius=(-200.0, math.inf)),)),
    "lens in front": replace(PLAIN, elements=(Component(-9.0, (14.0, 14.0), 3.0, (80.0, -80.0)),)),
    "curved entrance": replace(PLAIN, lens=replace(LENS, entrance=ENTRANCE)),
    "graded index": replace(PLAIN, lens=replace(LENS, gradient=Gradient("radial", (-0.01, 0.0004)))),
    "all of them": replace(
        PLAIN,
        lens=replace(LENS, entrance=ENTRANCE, gradient=Gradient("axial", (0.02,))),
        elements=(Component(-9.0, (14.0, 14.0), 3.0, (80.0, -80.0)), BEHIND),
    ),
}


def traced(scene, at, slopes):
    """Landing point (2,) of light from the source's centre through the exit at (x, y), mm, where that is a plane of these slopes,
    and its derivatives (2, 2) by the source's point, by central differences."""
    field, z = HeightField.of(scene.lens), scene.lens.offset.thickness
    gx, gy = field.control_xy()
    heights = z + slopes[0] * (gx - at[0])[:, None] + slopes[1] * (gy - at[1])[None, :]
    system, goal = System.of(scene, field), torch.tensor(at, dtype=torch.float64)

    def landing(dx, dy):
        source = scene.source
        if source.distant:
            c = math.sqrt(1.0 - dx * dx - dy * dy)
            point = tuple(c * v for v in turned_about(source.axis, dx / c, dy / c))
        else:
            point = tuple(a + b for a, b in zip(source.centre, (dx, dy, 0.0), strict=True))
        mode, uv = Mode(scene, point, 1.0), torch.full((2,), 0.5, dtype=torch.float64)

        def left(uv):
            end = Tracer(system, mode.through(uv[:1], uv[1:], 1.0)).ends({EXIT: heights})[0].state.expanded()
            return torch.stack([c.squeeze() for c in end.full(end.origin)[:2]])

        for _ in range(8):  # until it leaves the lens there
            here = left(uv)
            if float((here - goal).abs().max()) < 1e-8:
                break
            by = torch.stack([(left(uv + 1e-5 * e) - here) / 1e-5 for e in torch.eye(2, dtype=torch.float64)], -1)
            uv = uv - torch.linalg.solve(by, here - goal)
        else:
            pytest.fail("no ray leaves the lens there")
        state = Tracer(system, mode.through(uv[:1], uv[1:], 1.0)).land({EXIT: heights}, scene.screen)[0].expanded()
        assert float(state.power) > 0.0
        return np.array([float(c.squeeze()) for c in state.full(state.origin)[:2]])

    step = 1e-3 if scene.source.distant else 1e-2
    columns = [(landing(*(step * e)) - landing(*(-step * e))) / (2.0 * step) for e in np.eye(2)]
    return landing(0.0, 0.0), np.stack(columns, -1)


@pytest.mark.parametrize("source", [SUN, CHIP], ids=["sun", "chip"])
@pytest.mark.parametrize("name", SCENES)
def test_the_image_is_that_of_traced_rays(name, source):
    scene = SCENES[name] if name == "sun at an angle" else replace(SCENES[name], source=source)
    for part, slopes in ((0.0, (0.12, -0.07)), (0.7, (-0.06, 0.1))):
        where, found = traced(scene, (part * 2.0, part * 2.0), slopes)
        # A mirror image of a round source looks the same: the images are compared by M M^T.
        u, v = where - np.array(scene.screen.shift)  # rays land at distances from the axis
        (image,), _ = _matrices(scene, np.array([part]), [np.array([u]), np.array([v])])
        np.testing.assert_allclose(image @ image.T, found @ found.T, rtol=0.0, atol=2e-4 * np.abs(found @ found.T).max())


def space(d):
    """Of a translation, mm."""
    return np.array([[1.0, d], [0.0, 1.0]])


def surface(radius, before, behind):
    """Of a refraction between media of these indices."""
    return np.array([[1.0, 0.0], [(before - behind) / (radius * behind), before / behind]])


def test_the_image_behind_a_rod_is_that_of_its_abcd_matrix():
    """SELFOC: the direction of light that leaves the axis at the end of a rod of length t is that in front of it over cos(g t)."""
    g, thickness = 0.12, 6.0
    rod = replace(LENS, offset=replace(LENS.offset, thickness=thickness), gradient=Gradient("selfoc", (g,)))
    (image,), _ = _matrices(replace(PLAIN, lens=rod), np.zeros(1), [np.zeros(1)] * 2)
    np.testing.assert_allclose(image, (SCREEN.z - thickness) / math.cos(g * thickness) * np.eye(2), rtol=2e-5)


def test_the_image_behind_a_lens_is_that_of_its_abcd_matrix():
    """A thick lens: translations and two refractions from the exit to the screen; B of their product, mm per direction sine."""
    first, n, (r1, r2) = LENS.offset.thickness, BEHIND.index, BEHIND.radius
    thick = surface(r2, n, 1.0) @ space(BEHIND.thickness) @ surface(r1, 1.0, n)
    whole = space(SCREEN.z - BEHIND.z - BEHIND.thickness) @ thick @ space(BEHIND.z - first)
    (image,), _ = _matrices(replace(PLAIN, elements=(BEHIND,)), np.zeros(1), [np.zeros(1)] * 2)
    np.testing.assert_allclose(np.abs(image), abs(whole[0, 1]) * np.eye(2), rtol=1e-5, atol=1e-5)


def test_there_is_no_image_where_it_depends_on_what_is_designed():
    sides = replace(PLAIN, second_target=SecondTarget())
    behind = replace(PLAIN, elements=(replace(BEHIND, free="front"),))
    assert source_images(PLAIN) and source_images(replace(PLAIN, elements=(BEHIND,)))
    assert not source_images(sides) and not source_images(behind)


def test_there_is_no_image_where_apertures_cut_the_source():
    """What a narrow lens lets pass is a part of the source for much of the light."""
    open_, wide = replace(PLAIN, elements=(BEHIND,)), [np.linspace(-3.0, 3.0, 5)] * 2
    assert _cut(open_, wide) == 0.0
    hole = replace(BEHIND, size=(0.6, 0.6))
    assert _cut(replace(open_, elements=(hole,)), wide) > CUT and not source_images(replace(open_, elements=(hole,)))


def test_there_is_no_image_of_a_lens_imaged_onto_the_screen():
    """There its slopes do not move light."""
    first, second = LENS.offset.thickness, Component(90.0, (24.0, 24.0), 7.0, (70.0, -70.0))
    n, (r1, r2) = second.index, second.radius
    thick = surface(r2, n, 1.0) @ space(second.thickness) @ surface(r1, 1.0, n) @ space(second.z - first)
    conjugate = second.z + second.thickness - thick[0, 1] / thick[1, 1]
    at, nearer = (replace(PLAIN, elements=(second,), screen=Screen((4.0, 4.0), z, (32, 32))) for z in (conjugate, 0.8 * conjugate))
    assert not source_images(at) and source_images(nearer)


# Limits


@pytest.mark.parametrize("name", ["lens behind", "curved mirror behind", "lens in front", "curved entrance", "graded index"])
def test_no_lens_is_better_than_the_bound(name):
    """The picture that a lens throws of a point: its own image of the sun is no closer to it than the bound."""
    scene = replace(SCENES[name], source=replace(SUN, angle=1.0), screen=Screen((14.0, 14.0), SCREEN.z, (48, 48)))
    scene = replace(scene, lens=replace(scene.lens, control=(19, 19)))
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    bumps = torch.cos(2.0 * x)[:, None] * torch.cos(1.5 * y + 0.4)[None, :]
    heights = scene.lens.offset.thickness - 0.03 * (x[:, None] ** 2 + y[None, :] ** 2) + 0.03 * bumps
    point = replace(scene, source=point_source(scene))
    target = expose(point, field, heights, rays_of(point, "sobol", 1 << 17)).image.numpy()
    image = expose(scene, field, heights, rays_of(scene, "sobol", 1 << 17)).image.numpy()
    error, limits = relative_rms(image, target), performance_limits(scene, target, 300)
    assert 0.4 * error < limits.error < error


# Etendue


def test_the_etendue_behind_a_lens_is_that_of_its_abcd_matrix():
    """Of a small exit with a small screen: dX = A dx + B dq, so that the integral of dx dq over both is their areas over B^2."""
    first, n, (r1, r2), side = LENS.offset.thickness, BEHIND.index, BEHIND.radius, 2.0
    thick = surface(r2, n, 1.0) @ space(BEHIND.thickness) @ surface(r1, 1.0, n)
    b = (space(SCREEN.z - BEHIND.z - BEHIND.thickness) @ thick @ space(BEHIND.z - first))[0, 1]
    small = replace(PLAIN, source=Disc(angle=40.0), lens=replace(LENS, size=(side, side)), elements=(BEHIND,))
    small = replace(small, screen=replace(SCREEN, size=(6.0, 6.0)))
    given = side**2 * math.pi * math.sin(math.radians(20.0)) ** 2
    assert 0.99 < etendue_limit(small) / (side**2 * 36.0 / b**2 / given) < 1.06
    assert 3.6 < etendue_limit(replace(small, screen=replace(SCREEN, size=(12.0, 12.0)))) / etendue_limit(small) < 4.1


@pytest.mark.parametrize("name", [name for name, scene in SCENES.items() if scene.elements])
def test_no_more_light_arrives_than_etendue_allows(name):
    """Of spheres, one of which sends most of the light to the screen: below the limit, and not far below."""
    scene = replace(SCENES[name], source=Disc(angle=12.0), screen=replace(SCENES[name].screen, size=(6.0, 6.0)))
    limit, best = etendue_limit(scene), 0.0
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    for curvature in (-0.06, -0.03, 0.0, 0.03):
        heights = scene.lens.offset.thickness + 0.5 * curvature * (x[:, None] ** 2 + y[None, :] ** 2)
        best = max(best, float(expose(scene, field, heights, rays_of(scene, "sobol", 1 << 14)).image.sum()))
    assert 0.4 * limit < best < limit <= 1.0
