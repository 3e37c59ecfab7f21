"""The map of a lens by neighbouring rays, against ABCD matrices, the exit's second derivatives, and renders with ghosts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from caustic_cli.optics import traced_map
from caustic_cli.optics.bounds import bounds_of
from caustic_cli.optics.effects import Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.resolution import Resolution, diffraction_blur, follows_from_exit, local_magnification
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Component, Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient

FLAT = Offset(4.0, (math.inf, math.inf))
LENS = Lens((1.0, 1.0), control=(12, 12), index=1.5, offset=FLAT)
PLAIN = Scene(PlaneWave(), LENS, Screen((6.0, 6.0), 80.0, (32, 32)))
RADIUS = 25.0
BEHIND = Component(20.0, (24.0, 24.0), 7.0, (60.0, -80.0))
BEFORE = Component(-12.0, (6.0, 6.0), 4.0, (90.0, math.inf))


def space(d):
    return np.array([[1.0, d], [0.0, 1.0]])


def surface(curvature, before, behind):
    return np.array([[1.0, 0.0], [(before - behind) * curvature / behind, before / behind]])


def thick(e):
    return surface(1.0 / e.radius[1], e.index, 1.0) @ space(e.thickness) @ surface(1.0 / e.radius[0], 1.0, e.index)


def exit_of(scene, curvature=-1.0 / RADIUS):
    """Field and heights of a paraboloid of this curvature on the exit, positive where its centre lies behind it."""
    field = HeightField.of(scene.lens)

    def squares(space, half):  # of a cubic spline that is x^2: its polar form at three knots
        a, b, c = (half * (2.0 * space.knots[k : k + space.n].double() - 1.0) for k in (1, 2, 3))
        return (a * b + a * c + b * c) / 3.0

    x2, y2 = map(squares, field.spaces, field.half_size)
    return field, scene.lens.offset.thickness + 0.5 * curvature * (x2[:, None] + y2[None, :])


#: Scenes with the ABCD matrices up to right behind the exit and on to the screen.
BARE = surface(-1.0 / RADIUS, 1.5, 1.0) @ space(4.0) @ surface(0.0, 1.0, 1.5)
TO_SCREEN = space(76.0)
G = 0.08  # of a SELFOC rod, 1/mm
ROD = np.array([[math.cos(4 * G), math.sin(4 * G) / G], [-G * math.sin(4 * G), math.cos(4 * G)]])
MATRICES = {
    "bare": (PLAIN, BARE, TO_SCREEN),
    "near": (replace(PLAIN, source=Points(((0.0, 0.0, -40.0),))), BARE @ space(40.0), TO_SCREEN),
    "behind": (replace(PLAIN, elements=(BEHIND,)), BARE, space(53.0) @ thick(BEHIND) @ space(16.0)),
    "before": (replace(PLAIN, elements=(BEFORE,)), BARE @ space(8.0) @ thick(BEFORE), TO_SCREEN),
    "rod": (
        replace(PLAIN, lens=replace(LENS, gradient=Gradient("selfoc", (G,)))),
        surface(-1.0 / RADIUS, 1.5, 1.0) @ ROD @ surface(0.0, 1.0, 1.5),
        TO_SCREEN,
    ),
}


@pytest.mark.parametrize("name", MATRICES)
def test_the_magnification_is_that_of_abcd_matrices(name):
    scene, to_exit, on = MATRICES[name]
    start = np.array([0.0, 1.0]) if not scene.source.distant else np.array([1.0, 0.0])
    left = to_exit @ start
    field, heights = exit_of(scene)
    found = traced_map.local_magnification(scene, field, heights)
    assert found == pytest.approx(abs((on @ left)[0] / left[0]), rel=3e-3)
    assert (local_magnification(scene, field, heights) == found) == (not follows_from_exit(scene))


@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.2, 0.0, -30.0),))])
def test_it_is_what_the_second_derivatives_of_the_exit_say(source):
    """Of a relief, near the axis."""
    scene = replace(PLAIN, source=source)
    field, heights = exit_of(scene, 0.01)
    x, y = field.control_xy()
    heights = heights + 2e-4 * torch.cos(9.0 * x)[:, None] * torch.cos(7.0 * y)[None, :]
    assert traced_map.local_magnification(scene, field, heights) == pytest.approx(
        local_magnification(scene, field, heights), rel=5e-3
    )


def test_tilted_light_is_magnified_by_one_behind_a_plate():
    scene = replace(PLAIN, source=PlaneWave(tilt=(20.0, 10.0)), screen=Screen((60.0, 60.0), 80.0, (32, 32)))
    assert local_magnification(scene, *exit_of(scene, 0.0)) == pytest.approx(1.0, abs=1e-9)


def test_the_blur_behind_elements_is_by_their_b():
    """Of diffraction, the geometric mean of sqrt(lambda B) and M times that, and of the sun, B times its angle."""
    scene, to_exit, on = MATRICES["behind"]
    scene = replace(scene, source=Disc(angle=0.5))
    assert traced_map.distance(scene) == pytest.approx(abs(on[0, 1]), rel=1e-6)
    field, heights = exit_of(scene)
    seen, left = Resolution.at(scene, field, heights), to_exit @ np.array([1.0, 0.0])
    magnification = abs((on @ left)[0] / left[0])
    assert seen.diffraction == pytest.approx(diffraction_blur(seen.wavelength, on[0, 1], magnification), rel=3e-3)
    assert seen.source == pytest.approx(abs(on[0, 1]) * math.radians(0.5), rel=1e-4)


def test_nothing_is_said_of_surfaces_without_heights():
    scene = replace(PLAIN, elements=(replace(BEHIND, free="front"),))
    field, heights = exit_of(scene)
    assert local_magnification(scene, field, heights) is None
    assert Resolution.at(scene, field, heights).diffraction > 0.0


WIDE = replace(PLAIN, lens=replace(LENS, size=(4.0, 4.0)), screen=Screen((8.0, 8.0), 60.0, (24, 24)))
GHOSTLY = {
    "tilted": replace(WIDE, source=PlaneWave(tilt=(8.0, 0.0)), screen=replace(WIDE.screen, shift=(0.0, -7.9))),
    "behind": replace(WIDE, elements=(Component(20.0, (24.0, 24.0), 7.0, (400.0, -400.0)),)),
}


@pytest.mark.parametrize("name", GHOSTLY)
@pytest.mark.parametrize("curvature", [0.0, -0.004, 0.02])
def test_what_ghosts_add_is_foreseen(name, curvature):
    """Against the image of the ghosts of many random rays: no less, up to what pixels hide, and no more than where all overlap."""
    scene = GHOSTLY[name]
    (field, heights), light = exit_of(scene, curvature), [0.0, 0.0]
    for rays in rays_of(scene, "stratified", 60_000, 1).chunks():
        tracer = Tracer(System.of(scene, field), rays, requests=Requests.to("ghosts"))
        direct, *ghosts = tracer({EXIT: heights})
        for k, states in enumerate(([direct], ghosts)):
            light[k] = light[k] + tracer.collect(states, scene.screen, Filter()).image
    image, stray = light
    added = float(stray.square().mean().sqrt() / image.mean())
    foreseen = bounds_of(scene, field, heights).ghost_error
    assert len(ghosts) == (1 if name == "tilted" else 6)
    assert added / 1.15 < foreseen < (1.5 if name == "tilted" else 2.0) * added
