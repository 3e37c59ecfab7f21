"""Tilted and shifted screens, extended sources, large lenses, the energy balance, and scenes without a wave image."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from fields import slit
from test_lenses import GREEN, LAMBDA, flat, irradiance, scene_of, spline_of

from caustic_cli.errors import CausticError
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.coherent import modes
from caustic_cli.optics.spread import POINT
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import Imager, lines_of, wave_image
from caustic_cli.optics.waves.unsupported import receiver_of
from caustic_cli.scene import Disc, Light, PlaneWave, Points, Screen

DOUBLE = torch.float64


def wavy(scene, bump: float = 1e-3, spread: float = 60.0):
    """A gentle relief on a surface that spreads light."""
    field = HeightField.of(scene.lens)
    rx = scene.lens.half_size[0]
    return field, spline_of(
        field,
        lambda x, y: 2.0 + (x * x + y * y) / (2.0 * spread) + bump * torch.cos(4.0 * x / rx + y / rx) * torch.sin(3.0 * y / rx),
    )


def apart(a: np.ndarray, b: np.ndarray) -> float:
    """Relative RMS."""
    return math.sqrt(((a - b) ** 2).mean()) / b.mean()


# Tilted and shifted screens


def test_hardly_tilted():
    """A millionth of a degree: the upright image, by the other way of making it."""
    screen = Screen((1.6, 1.4), 42.0, (24, 20), shift=(0.2, -0.1))
    scene = scene_of(1.0, screen)
    field, heights = wavy(scene)
    upright = wave_image(scene, field, heights, finer=2.0, dtype=DOUBLE).image.numpy()
    tilted = wave_image(scene, field, heights, finer=2.0, dtype=DOUBLE, screen=replace(screen, tilt=(1e-6, -1e-6))).image.numpy()
    assert apart(tilted, upright) < 0.005


UPRIGHT, FLAT = (0.0, 0.0), (math.inf, math.inf)


@pytest.mark.parametrize(
    ("tilt", "radius"),
    [
        ((0.0, 60.0), FLAT),
        ((50.0, 0.0), FLAT),
        ((0.0, -30.0), FLAT),
        (UPRIGHT, (-2.5, -2.5)),
        (UPRIGHT, (2.0, math.inf)),
        ((0.0, 30.0), (6.0, 6.0)),
    ],
)
def test_slit_on_a_tilted_or_curved_screen(tilt, radius):
    """Fresnel's pattern at every point's own distance, on the area of the screen: 0.03 of the incident irradiance."""
    half = 0.4
    screen = Screen((3.0, 3.0), 32.0, (60, 60), tilt=tilt, radius=radius)
    scene = scene_of(2.0 * half, screen)
    field, heights = flat(scene)
    found = irradiance(wave_image(scene, field, heights, finer=3.0, dtype=DOUBLE), screen, 4.0 * half * half)
    fine = 4
    a, b = (0.75 * 2.0 * ((np.arange(60 * fine) + 0.5) / (60 * fine) - 0.5) * 2.0 for _ in range(2))
    u, v, n = (np.array(c) for c in screen.axes)
    r2 = sum(at**2 * math.isfinite(c) for c, at in zip(radius, (a[:, None], b[None, :]), strict=True))
    bend = min(radius, key=abs)
    s = bend - math.copysign(1.0, bend) * np.sqrt(bend**2 - r2) if math.isfinite(bend) else np.zeros((len(a), len(b)))
    x, y, z = (u[k] * a[:, None] + v[k] * b[None, :] + n[k] * s for k in range(3))
    sx, sy = np.gradient(s, a, b, edge_order=2)
    across = np.abs(n[2] - sx * u[2] - sy * v[2])
    exact = slit(x, half, LAMBDA, 30.0 + z) * slit(y, half, LAMBDA, 30.0 + z) * across
    exact = exact.reshape(60, fine, 60, fine).mean((1, 3))
    error = np.abs(found - exact)
    assert error.max() < 0.04 and math.sqrt((error**2).mean()) < 0.008


@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.0, 0.0, -30.0),))], ids=["plane", "point"])
def test_tilted_screen_catches_all(source):
    """To 5e-3, with what edges scatter beside it; a screen that leans catches as much as an upright one."""
    screen = Screen((6.0, 6.0), 32.0, (24, 24), tilt=(25.0, 35.0))
    scene = scene_of(0.8, screen, source)
    field, heights = wavy(scene)
    found = wave_image(scene, field, heights)
    assert float(found.image.sum()) == pytest.approx(found.leaving, rel=5e-3)


@pytest.mark.parametrize("radius", [FLAT, (-6.0, -6.0), (math.inf, 4.0)], ids=["plane", "sphere", "cylinder"])
@pytest.mark.parametrize("kind", ["plane", "point"])
def test_tilted_against_rays(kind, radius):
    """Where pixels are coarse the image of waves on a tilted or curved screen is that of rays."""
    source = PlaneWave() if kind == "plane" else Points(((1.0, 0.5, -60.0),))
    tilt = (-20.0, 30.0) if radius == FLAT else (10.0, 15.0)
    screen = Screen((5.0, 4.5), 42.0, (8, 7), tilt=tilt, radius=radius, shift=(0.2, -0.1))
    scene = scene_of(2.0, screen, source)
    field, heights = wavy(scene, 2e-3, 60.0)
    found = wave_image(scene, field, heights)
    rays = expose(scene, field, heights, rays_of(scene, "stratified", 100_000))
    assert apart(found.image.numpy(), rays.image.numpy()) < 0.04


def test_a_screen_aside_is_a_part_of_the_whole():
    """Pixels of a screen to the side are those of a larger one."""
    screen = Screen((2.4, 2.4), 42.0, (48, 48))
    scene = scene_of(1.0, screen)
    field, heights = wavy(scene)
    whole = wave_image(scene, field, heights, finer=2.0).image.numpy()
    part = wave_image(
        scene, field, heights, finer=2.0, screen=replace(screen, size=(0.8, 0.6), resolution=(16, 12), shift=(0.5, -0.35))
    ).image.numpy()
    assert np.abs(part - whole[26:42, 11:23]).max() < 0.02 * whole.max()


# Large lenses


def test_large_lens_is_rays():
    """A Fresnel scale of a tenth of a pixel: the ray image, to 1 % where its own noise is 0.3 %."""
    screen = Screen((14.0, 14.0), 102.0, (4, 4))
    scene = scene_of(6.0, screen)
    field, heights = wavy(scene, 0.01, 50.0)
    found = wave_image(scene, field, heights)
    rays = expose(scene, field, heights, rays_of(scene, "stratified", 200_000))
    assert math.sqrt(LAMBDA * 100.0 * 2.0) < 0.12 * screen.pixel[0]
    assert apart(found.image.numpy(), rays.image.numpy()) < 0.01
    assert rays.image.std() > 0.1 * rays.image.mean()


# Extended sources


def by_points(scene, field, heights, each: int):
    """The same by so many points of the source, each traced."""
    lines = lines_of(scene, field)
    imager = Imager.of(lines, {EXIT: heights}, receiver_of(lines[0].system, scene.screen))
    imager = replace(imager, spread=POINT, each=24)
    object.__setattr__(imager, "modes", lambda system: modes(system, each))
    return imager.expose(lines, {EXIT: heights})


@pytest.mark.parametrize("kind", ["sun", "disc", "grid"])
def test_spread_is_many_points(kind):
    """A convolution in place of a sum over points: 6 % relative RMS, of which 30 points leave about 4; its stated misplacement
    is below a quarter of a pixel."""
    source = {
        "sun": Disc(angle=0.53),
        "disc": Disc((0.1, -0.1, -400.0), (3.0, 2.0)),
        "grid": Points.grid((0.0, 0.0, -400.0), (3.0, 2.0), (4, 3)),
    }[kind]
    screen = Screen((2.0, 2.0), 42.0, (20, 20))
    scene = scene_of(1.0, screen, source)
    field, heights = wavy(scene)
    found = wave_image(scene, field, heights)
    points = by_points(scene, field, heights, 1 if kind == "grid" else 30)
    assert found.points == 1 and points.points >= 12
    assert 0.0 <= found.spread_error <= 0.25 * max(screen.pixel[0], 0.2)
    assert apart(found.image.numpy(), points.image.numpy()) < 0.06
    middle = source.pointlike() if kind != "grid" else Points(((0.0, 0.0, -400.0),))
    sharp = wave_image(replace(scene, source=middle), field, heights)
    assert apart(found.image.numpy(), sharp.image.numpy()) > 0.08
    assert found.image.min() > -0.01 * found.image.max()


def test_light_from_beside_a_small_screen():
    """A source whose image spreads farther than the screen is wide: what comes from beside it counts."""
    screen = Screen((0.3, 0.3), 42.0, (6, 6))
    scene = scene_of(1.0, screen, Disc(angle=1.5))
    field, heights = wavy(scene)
    found = wave_image(scene, field, heights)
    points = by_points(scene, field, heights, 30)
    assert found.points == 1
    assert float(found.image.sum()) == pytest.approx(float(points.image.sum()), rel=0.03)


def test_where_a_source_does_more_than_shift():
    """Points at several depths, or a lens that is strong for the source's extent: points are taken."""
    screen = Screen((2.0, 2.0), 42.0, (20, 20))
    depths = scene_of(1.0, screen, Points(((0.0, 0.0, -50.0), (0.3, 0.0, -60.0))))
    field, heights = wavy(depths)
    assert wave_image(depths, field, heights).points == 2
    wide = scene_of(1.0, replace(screen, size=(80.0, 80.0), resolution=(600, 600)), Disc((0.0, 0.0, -3.0), (4.0, 4.0)))
    lines = lines_of(wide, field)
    imager = Imager.of(lines, {EXIT: heights}, receiver_of(lines[0].system, wide.screen))
    assert imager.spread.error < imager.spread.half[0] and 1 < len(imager.modes(lines[0].system)) <= 24


def test_parts_of_a_source_are_spread():
    """A few points of a wide source, each spread by its part of it, agree with thrice as many; one convolution is off by more."""
    screen = Screen((6.0, 6.0), 42.0, (40, 40))
    scene = scene_of(1.0, screen, Disc(angle=6.0))
    field, heights = wavy(scene, 0.02)
    lines, at = lines_of(scene, field), {EXIT: heights}
    imager = Imager.of(lines, at, receiver_of(lines[0].system, screen))
    few, more, one = (replace(imager, each=n).expose(lines, at).image.numpy() for n in (6, 18, 0))
    assert apart(few, more) < 0.6 * apart(one, more)
    assert float(few.sum()) == pytest.approx(float(more.sum()), rel=3e-3)  # where the source's edge is spread beyond the screen


def test_spread_on_a_tilted_screen():
    """An extended source blurs a tilted screen too."""
    screen = Screen((2.0, 2.0), 42.0, (10, 10), tilt=(0.0, 20.0))
    scene = scene_of(1.0, screen, Disc(angle=0.8))
    field, heights = wavy(scene)
    found, sharp = (wave_image(s, field, heights).image.numpy() for s in (scene, replace(scene, source=PlaneWave())))
    rays = expose(scene, field, heights, rays_of(scene, "stratified", 200_000)).image.numpy()
    assert apart(found, rays) < 0.5 * apart(sharp, rays)


# Energy


SOURCES = {
    "plane": PlaneWave(),
    "profile": PlaneWave(1.0, np.array([[1.0, 2.0, 0.5], [0.2, 1.0, 3.0]])),
    "uniform": Points(((0.2, -0.1, -9.0),)),
    "lambertian": Points(((0.2, 0.1, -5.0),), cone=60.0, intensity="lambertian"),
    "narrow": Points(((0.0, 0.0, -10.0),), cone=2.0),
}


@pytest.mark.parametrize("aperture", ["rectangle", "circle"])
@pytest.mark.parametrize("source", SOURCES)
def test_leaving_is_what_rays_leave_with(source, aperture):
    """Fresnel's losses, light beside the exit, absorption: 1e-4 of the whole, 5e-4 where an edge lies within the pupil."""
    screen = Screen((2.0, 2.0), 32.0, (8, 8))
    scene = scene_of(1.0, screen, SOURCES[source], aperture=aperture, fresnel="exact", absorption=0.05)
    field, heights = wavy(scene, 1e-3)
    found = wave_image(scene, field, heights)
    rays = expose(scene, field, heights, rays_of(scene, "stratified", 200_000))
    # Cells of the light that a step of a profile cuts are one or the other.
    assert found.leaving == pytest.approx(
        rays.leaving, abs=1e-4 if source in ("plane", "profile") else 5e-4, rel=2e-3 if source == "profile" else 1e-3
    )
    assert float(found.image.sum()) + found.off_screen == pytest.approx(found.leaving, abs=1e-12)
    on = float(rays.image.sum())
    assert float(found.image.sum()) == pytest.approx(on, abs=(0.02 if source == "narrow" else 0.01) * max(on, found.leaving * 0.1))


# What no, or hardly any, wave image can be made of


def test_no_light():
    """Total reflection everywhere is said, not computed with."""
    screen = Screen((2.0, 2.0), 32.0, (8, 8))
    scene = scene_of(1.0, screen)
    field = HeightField.of(scene.lens)
    heights = spline_of(field, lambda x, y: 2.0 + 1.3 * x + 0.0 * y)
    with pytest.raises(CausticError, match="no light"):
        wave_image(scene, field, heights)


def test_partly_total_reflection():
    """A part of the aperture is dark; nothing is NaN, and what leaves is what rays leave with."""
    screen = Screen((30.0, 8.0), 12.0, (30, 8), shift=(-6.0, 0.0))
    scene = scene_of((0.4, 0.2), screen, control=(12, 4))
    field = HeightField.of(scene.lens)
    heights = spline_of(field, lambda x, y: 2.0 + 2.0 * (x + 0.2) ** 2 + 0.0 * y)
    scene = replace(scene, screen=screen)
    rays = expose(scene, field, heights, rays_of(scene, "stratified", 200_000))
    assert rays.lost["total_internal_reflection"] > 0.05
    try:
        found = wave_image(scene, field, heights)
    except CausticError as error:
        assert "rays cross" in str(error)  # at grazing angles intercepts leave the lens
        return
    assert bool(torch.isfinite(found.image).all())
    assert found.leaving == pytest.approx(rays.leaving, abs=0.01)


def test_a_surface_without_order_has_no_wave_image():
    """Of what is thrown wherever it likes no light comes from where a wavefront would have it: refused, and not NaN."""
    scene = scene_of(10.0, Screen((30.0, 30.0), 300.0, (20, 20)), control=(25, 25))
    heights = 6.0 * torch.rand(25, 25, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pytest.raises(CausticError, match="rays cross"):
        wave_image(scene, HeightField.of(scene.lens), heights)


def test_focus_before_the_screen():
    """Light that has crossed on its way lands where rays land."""
    screen = Screen((3.0, 3.0), 82.0, (12, 12))
    scene = scene_of(2.0, screen)
    field = HeightField.of(scene.lens)
    heights = spline_of(field, lambda x, y: 2.0 - (x * x + y * y) / 40.0 + 0.3 * x**3 / 4000.0)
    found = wave_image(scene, field, heights)
    rays = expose(scene, field, heights, rays_of(scene, "stratified", 200_000))
    assert apart(found.image.numpy(), rays.image.numpy()) < 0.15
    assert float(found.image.sum()) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("size", "wide", "pixels"),
    [
        ((1.0, 1.0), (1.0, 1.0), (2, 2)),
        ((4.0, 0.1), (5.0, 0.5), (50, 3)),
        ((0.5, 0.5), (4.0, 0.05), (64, 2)),
        ((1e-2, 2.0), (8.0, 2.5), (40, 12)),
    ],
)
def test_odd_shapes(size, wide, pixels):
    """Few pixels, slender lenses and screens: finite, not negative, no more than there is."""
    screen = Screen(wide, 42.0, pixels)
    scene = scene_of(size, screen)
    field, heights = flat(scene)
    found = wave_image(scene, field, heights)
    assert bool(torch.isfinite(found.image).all()) and float(found.image.min()) >= 0.0
    caught = [min(1.0, w / s) for s, w in zip(size, wide, strict=True)]
    if min(size) > 0.3:
        assert float(found.image.sum()) == pytest.approx(caught[0] * caught[1], abs=0.12)
    assert 0.0 < float(found.image.sum()) <= 1.0 + 1e-3


def test_screen_that_sees_no_light():
    """Far aside: nothing but what edges scatter."""
    screen = Screen((1.0, 1.0), 42.0, (10, 10), shift=(15.0, 0.0))
    scene = scene_of(1.0, screen)
    field, heights = wavy(scene)
    found = wave_image(scene, field, heights)
    assert bool(torch.isfinite(found.image).all())
    assert 0.0 <= float(found.image.sum()) < 1e-3
    assert found.leaving == pytest.approx(1.0, abs=1e-4)


def test_derivatives_are_finite_where_light_is_cut_off():
    """Light beside what is watched, beside the exit, and beyond a circle leaves no NaN behind."""
    screen = Screen((0.5, 0.5), 32.0, (8, 8), shift=(0.4, 0.0))
    scene = scene_of(1.0, screen, Points(((0.2, -0.1, -9.0),)), aperture="circle", light=Light(wavelengths=(GREEN,)))
    field, heights = wavy(scene)
    heights.requires_grad_()
    wave_image(scene, field, heights).image.square().sum().backward()
    assert bool(torch.isfinite(heights.grad).all()) and float(heights.grad.abs().max()) > 0
