"""Lenses, windows and mirrors as waves: from an exact trace to the screen, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from fields import mean_around, mean_over, slit
from scipy.special import j1

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.media import Medium
from caustic_cli.optics.surfaces import HeightField, Plane, Sphere
from caustic_cli.optics.system import Element, System
from caustic_cli.optics.waves.image import Imager, Line, image_of, lines_of, wave_image
from caustic_cli.optics.waves.unsupported import receiver_of
from caustic_cli.scene import Aperture, CircularAperture, Lens, Light, Offset, PlaneWave, Points, Scene, Screen

GREEN = 550.0
LAMBDA = 5.5e-4
DOUBLE = torch.float64


def _lines_of(system: System) -> list[Line]:
    """Spectral lines of a system, source by source."""
    return [
        Line(wavelength, fraction * part, system.with_source(source), wavelength)
        for source, fraction in zip(system.sources, system.fractions, strict=True)
        for wavelength, part in zip(*system.light.lines(), strict=True)
    ]


def spline_of(field: HeightField, function) -> torch.Tensor:
    """Control heights of a function's interpolant at the Greville abscissae, (n, m) mm."""
    x, y = field.control_xy()
    a, b = (torch.linalg.inv(s.matrix(s.greville)) for s in field.spaces)
    return a @ function(x[:, None], y[None, :]) @ b.T


def scene_of(size, screen: Screen, source=None, control=(6, 6), aperture="rectangle", light=None, **options) -> Scene:
    lens = Lens(
        (size, size) if isinstance(size, float) else size,
        control=control,
        aperture=aperture,
        **({"fresnel": "none", "index": 1.5, "offset": Offset(2.0)} | options),
    )
    return Scene(source or PlaneWave(), lens, screen, light or Light(wavelengths=(GREEN,)))


def flat(scene: Scene, height: float = 2.0):
    field = HeightField.of(scene.lens)
    return field, torch.full(field.shape, height, dtype=DOUBLE)


def irradiance(found, screen: Screen, area: float) -> np.ndarray:
    """In parts of the light's even density over an area."""
    return found.image.detach().numpy() / (screen.pixel[0] * screen.pixel[1]) * area


def squares(screen: Screen, half, distance: float) -> np.ndarray:
    one = [
        mean_over(lambda x, h=h: slit(x, h, LAMBDA, distance), c - s, c + s, n, 8)
        for h, s, n, c in zip(half, screen.half_size, screen.resolution, screen.shift, strict=True)
    ]
    return one[0][:, None] * one[1][None, :]


def airy(screen: Screen, a: float, cone: float, wavelength: float) -> np.ndarray:
    """Airy's pattern of light that converges at the sine `cone` from a circle of radius a, in parts of the incident density."""

    def pattern(rho):
        x = np.maximum(2.0 * math.pi * cone / wavelength * rho, 1e-9)
        return (math.pi * a * cone / wavelength) ** 2 * (2.0 * j1(x) / x) ** 2

    return mean_around(pattern, screen.half_size[0], screen.resolution[0])


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.55, -0.3)])
def test_flat_window(shift):
    """Nothing but the aperture's own pattern, also on a screen aside; index and thickness change nothing."""
    screen = Screen((1.3, 1.3), 62.0, (50, 50), shift=shift)
    scene = scene_of(1.2, screen)
    field, heights = flat(scene)
    found = wave_image(scene, field, heights, finer=2.0, dtype=DOUBLE)
    exact = squares(screen, (0.6, 0.6), 60.0)
    error = np.abs(irradiance(found, screen, 1.44) - exact)
    assert error.max() < 0.02 and math.sqrt((error**2).mean()) < 0.004
    assert found.leaving == pytest.approx(1.0, abs=1e-9)
    assert float(found.image.sum()) == pytest.approx(exact.mean() * 1.69 / 1.44, abs=2e-3)


def test_point_source_through_a_window():
    """An aperture in a spherical wave: the pattern of a plane wave at the distance L h / (L + h), larger by (L + h) / h."""
    h, far = 40.0, 60.0
    mag = (far + h) / h
    screen = Screen((3.0, 3.0), far, (60, 60))
    thin = 1e-3  # of glass, whose aberrations a point sees
    scene = scene_of(1.2, screen, Points(((0.0, 0.0, -h),)), offset=Offset(thin))
    field, heights = flat(scene, thin)
    found = wave_image(scene, field, heights, finer=2.0, dtype=DOUBLE)
    small = replace(screen, size=(3.0 / mag, 3.0 / mag))
    exact = squares(small, (0.6, 0.6), far / mag) / mag**2
    density = found.leaving / 1.44
    error = np.abs(found.image.numpy() / (screen.pixel[0] ** 2) / density - exact) * mag**2
    assert error.max() < 0.02 and math.sqrt((error**2).mean()) < 0.004


@pytest.mark.parametrize("kind", ["biconvex", "plano-convex", "spline"])
def test_airy_pattern_at_a_focus(kind):
    """A lens of f = 50 mm at f / 31: Airy's pattern on the screen, 5e-3 of its peak, and a quarter wave off the focus it is not."""
    a, n, t = 0.8, 1.5, 1.0
    glass, free = Medium(n), Aperture((3.0, 3.0))
    stop = CircularAperture((a, a))
    if kind == "biconvex":
        r1, r2 = 50.0, -50.0
        elements = (
            Element("front", Sphere(r1), stop, behind=glass, fresnel="none"),
            Element("back", Sphere(r2), free, pose=Pose((0, 0, t)), fresnel="none"),
        )
    else:
        r1, r2 = math.inf, -25.0
        spline = HeightField((SplineSpace.uniform(8, 4),) * 2, (3.0, 3.0))
        back = Sphere(r2) if kind == "plano-convex" else spline
        elements = (
            Element("front", Plane(), stop, behind=glass, fresnel="none"),
            Element("back", back, free, pose=Pose((0, 0, t)), fresnel="none"),
        )
    heights = {} if kind != "spline" else {"back": spline_of(spline, lambda x, y: (x * x + y * y) / (2.0 * r2))}
    power = (n - 1) * (1 / r1 - 1 / r2 + (n - 1) * t / (n * r1 * r2))
    focus = t + (1 - (n - 1) * t / (n * r1)) / power
    width = LAMBDA / (2.0 * a * power)
    screen = Screen((7 * width, 7 * width), focus, (21, 21))
    system = System((PlaneWave(),), elements, (screen,), Light(wavelengths=(GREEN,)))
    found = image_of(_lines_of(system), heights, screen, dtype=DOUBLE)
    area = math.pi * a * a
    exact = airy(screen, a, a * power, LAMBDA)
    assert np.abs(irradiance(found, screen, area) - exact).max() < 5e-3 * exact.max()
    off = replace(screen, z=focus + 0.5 * LAMBDA / (a * power) ** 2)  # a quarter wave at the edge
    beside = image_of(_lines_of(system), heights, off, dtype=DOUBLE)
    assert 0.70 < float(beside.image.max() / found.image.max()) < 0.90


def test_cylinder():
    """A B-spline that curves along x alone: (sin x / x)^2 across its line, Fresnel's pattern along it."""
    half, f, n = (0.8, 0.5), 60.0, 1.5
    width = LAMBDA * f / (2.0 * half[0])
    screen = Screen((9 * width, 1.4), f + 2.0, (27, 20))
    scene = scene_of((2 * half[0], 2 * half[1]), screen)
    field = HeightField.of(scene.lens)
    r = (n - 1.0) * f
    heights = spline_of(field, lambda x, y: 2.0 - x * x / (2.0 * r) + 0.0 * y)
    found = wave_image(scene, field, heights, dtype=DOUBLE)
    rx, ry = screen.half_size
    across = mean_over(lambda x: np.sinc(x / width) ** 2, -rx, rx, 27, 8) * 2.0 * half[0] / width
    along = mean_over(lambda y: slit(y, half[1], LAMBDA, f), -ry, ry, 20, 8)
    error = np.abs(irradiance(found, screen, 4.0 * half[0] * half[1]) - across[:, None] * along[None, :])
    assert error.max() < 0.01 * across.max()


def test_mirror_and_lens():
    """A mirror of half the radius of a plano-convex lens of index 2: the same focus, the same pattern."""
    f, size = 60.0, 1.6
    width = LAMBDA * f / size
    patterns = []
    for mirror in (True, False):
        z = -f if mirror else f + 2.0
        screen = Screen((18 * width, 11 * width), z, (54, 33))
        scene = scene_of(
            size, screen, mirror=mirror, index=2.0, offset=Offset(0.0 if mirror else 2.0), **({"z_in": -100.0} if mirror else {})
        )
        field = HeightField.of(scene.lens)
        r = 2.0 * f if mirror else f
        heights = spline_of(field, lambda x, y, r=r, m=mirror: (0.0 if m else 2.0) - ((x - 0.1) ** 2 + y * y) / (2.0 * r))
        patterns.append(wave_image(scene, field, heights, dtype=DOUBLE))
    a, b = (p.image.numpy() for p in patterns)
    assert np.abs(a - b).max() < 5e-3 * b.max()
    assert patterns[0].leaving == pytest.approx(1.0, abs=1e-5) and patterns[1].leaving == pytest.approx(1.0, abs=1e-5)
    middle = (b.sum(1) * (np.arange(54) - 26.5)).sum() / b.sum() * width / 3.0
    assert middle == pytest.approx(0.1, abs=0.2 * width)  # the axis of the lens is where its surface has its top


def test_dispersion_changes_the_focus():
    """Each colour is sharp at its own paraxial focus and a circle of confusion elsewhere."""
    size, r = 2.0, 30.0
    lights = (450.0, 650.0)
    screen = Screen((0.4, 0.4), 60.0, (20, 20))
    scene = scene_of(size, screen, glass="N-F2", light=Light(wavelengths=lights))
    field = HeightField.of(scene.lens)
    heights = spline_of(field, lambda x, y: 2.0 - (x * x + y * y) / (2.0 * r))
    focus = {line.wavelength: 2.0 + r / (line.system.media()[1].index - 1.0) for line in lines_of(scene, field)}
    assert focus[650.0] - focus[450.0] > 1.0
    peaks = {
        (a, b): float(wave_image(scene, field, heights, wavelengths=(a,), screen=replace(screen, z=focus[b])).image.max())
        for a in lights
        for b in lights
    }
    assert peaks[450.0, 450.0] > 1.7 * peaks[450.0, 650.0]
    assert peaks[650.0, 650.0] > 1.7 * peaks[650.0, 450.0]
    both = wave_image(scene, field, heights, screen=replace(screen, z=focus[450.0]))
    assert float(both.image.max()) == pytest.approx(0.5 * (peaks[450.0, 450.0] + peaks[650.0, 450.0]), rel=0.02)


def test_sources_of_a_system_are_watched_where_their_light_goes():
    """Two points so far apart that light of either misses the other's half of the screen: the sum of the two alone."""
    field = HeightField((SplineSpace.uniform(6, 3),) * 2, (1.0, 1.0))
    elements = (
        Element("front", Plane(), Aperture((0.5, 0.5)), behind=Medium(1.5)),
        Element("back", field, Aperture((1.5, 1.5)), pose=Pose((0, 0, 0.5))),
    )
    screen = Screen((6.0, 2.0), 30.0, (60, 20))
    heights = {"back": spline_of(field, lambda x, y: -(x * x + y * y) / 40.0)}
    points = [Points(((x, 0.0, -30.0),), (power,)) for x, power in ((2.0, 1.0), (-2.0, 3.0))]
    system = System(tuple(points), elements, (screen,), Light(wavelengths=(GREEN,)))
    found = image_of(_lines_of(system), heights, screen, dtype=DOUBLE)
    alone = [image_of(_lines_of(replace(system, sources=(p,))), heights, screen, dtype=DOUBLE) for p in points]
    both = 0.25 * alone[0].image + 0.75 * alone[1].image
    torch.testing.assert_close(found.image, both, rtol=1e-9, atol=1e-12)
    assert found.leaving == pytest.approx(0.25 * alone[0].leaving + 0.75 * alone[1].leaving)
    assert found.points == 2
    assert float(found.image[30:].sum()) == pytest.approx(3.0 * float(found.image[:30].sum()), rel=0.01)  # each has its half


# Derivatives by heights


def taylor(lines, heights: dict, screen, seed: int = 1, steps=(3.2e-5, 1.6e-5, 8e-6)) -> list[float]:
    """Orders of what the derivative of a weighted image leaves, along a random change of all heights; and of the smallest step, the
    part of the change that it leaves."""
    imager = Imager.of(lines, heights, receiver_of(lines[0].system, screen), exact=True)
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(imager.receiver.resolution, generator=generator, dtype=DOUBLE)

    def loss(at):
        return (imager.expose(lines, at, DOUBLE).image * weights).sum()

    free = {k: h.clone().requires_grad_() for k, h in heights.items()}
    value = loss(free)
    value.backward()
    along = {k: torch.randn(h.shape, generator=generator, dtype=DOUBLE) for k, h in heights.items()}
    slope = sum(float((free[k].grad * along[k]).sum()) for k in heights)
    left = []
    with torch.no_grad():
        for step in steps:
            up = float(loss({k: h + step * along[k] for k, h in heights.items()}) - value)
            left.append(abs(up - step * slope))
    orders = [math.log(a / b) / math.log(steps[0] / steps[1]) for a, b in pairwise(left)]
    return [*orders, left[-1] / abs(steps[-1] * slope)]


SOURCES = {
    "plane": PlaneWave(),
    "point": Points(((0.1, -0.2, -20.0),)),
    "lambertian": Points(((0.2, 0.1, -12.0),), cone=50.0, intensity="lambertian"),
}


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("losses", ["none", "exact"])
def test_taylor_of_a_lens(source, losses):
    """What is left falls with the square of the step, of power and path that change as intercepts move."""
    field = HeightField((SplineSpace.uniform(6, 3),) * 2, (1.5, 1.5))
    elements = (
        Element("front", Plane(), Aperture((0.2, 0.2)), behind=Medium(1.5), fresnel=losses),
        Element("back", field, Aperture((1.5, 1.5)), fresnel=losses, pose=Pose((0, 0, 0.5))),
    )
    screen = Screen((3.5, 3.0), 30.0, (12, 12))
    system = System((SOURCES[source],), elements, (screen,), Light(wavelengths=(GREEN,)))
    heights = spline_of(field, lambda x, y: (x * x + y * y) / 90.0 + 2e-3 * torch.cos(2.0 * x) * torch.sin(1.5 * y))
    *orders, rest = taylor(_lines_of(system), {"back": heights}, screen)
    assert all(1.9 < o < 2.1 for o in orders) if source == "plane" else all(o > 1.5 for o in orders), (orders, rest)
    assert rest < 1e-2


def test_taylor_of_several_surfaces():
    """Both sides of a lens and a mirror behind it, by all heights at once."""
    field = HeightField((SplineSpace.uniform(5, 3),) * 2, (1.5, 1.5))
    elements = (
        Element("front", field, Aperture((0.5, 0.5)), behind=Medium(1.5)),
        Element("back", field, Aperture((1.5, 1.5)), pose=Pose((0, 0, 2.0))),
        Element("fold", field, Aperture((1.5, 1.5)), "reflect", pose=Pose((0, 0, 12.0))),
    )
    screen = Screen((1.5, 1.5), -25.0, (12, 12))
    system = System((PlaneWave(),), elements, (screen,), Light(wavelengths=(GREEN,)))
    heights = {
        name: spline_of(
            field, lambda x, y, k=k: 0.05 + (x * x - 0.5 * y * y) / (90.0 + 40.0 * k) + 3e-4 * torch.cos(2.0 * x + k * y)
        )
        for k, name in enumerate(("front", "back", "fold"))
    }
    *orders, rest = taylor(_lines_of(system), heights, screen)
    assert all(o > 1.5 for o in orders) and rest < 3e-3, (orders, rest)
