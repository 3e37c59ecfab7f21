"""Cones from 1e-6 to 89.999 degrees, sources from 1e-6 mm to 1e6 mm before the lens.

A cone's solid angle is 2 pi (1 - cos), of which a difference leaves nothing at small angles; a source close to the lens lights it
within a few distances around its foot, where rays spread evenly over the lens hardly ever fall.
"""

import math

import numpy as np
import pytest
import torch
from exact import mp

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Disc, Lens, PlaneWave, Points, Scene, Screen

CONES = [1e-6, 1e-4, 1e-2, 1.0, 30.0, 60.0, 80.0, 89.0, 89.999]
DISTANCES = [1e-6, 1e-3, 0.1, 3.0, 50.0, 1e4, 1e6]


def scene(distance: float, *, lens: Lens | None = None, **source) -> Scene:
    return Scene(Points(((0.0, 0.0, -distance),), **source), lens or Lens(size=(10.0, 8.0), fresnel="none"), Screen((10.0, 10.0)))


def arriving(scene: Scene, count: int = 10_000) -> float:
    bundles = [Tracer(System.of(scene), b).start for b in rays_of(scene, "stratified", count, 1).chunks()]  # inside the lens
    for b in bundles:
        assert all(bool(torch.isfinite(a).all()) for a in (*b.origin[:2], *b.direction, b.power))
        assert float(b.power.min()) >= 0 and float(b.direction[2].min()) > 0
    total = math.fsum(float(b.power.sum()) for b in bundles)
    assert total + math.fsum(b.lost["missed_lens"] for b in bundles) == pytest.approx(1.0, abs=1e-12)
    return total


def solid_angle(half_x: float, half_y: float, h: float):
    """Of a rectangle centred over the source, mpf."""
    a, b, h = mp.mpf(half_x), mp.mpf(half_y), mp.mpf(h)
    return 4 * mp.atan(a * b / (h * mp.sqrt(a * a + b * b + h * h)))


@pytest.mark.parametrize("cone", CONES)
def test_part_of_a_cone_that_meets_the_lens(cone):
    """The cone's circle reaches 1.2 times as far as the lens' corner: the part is a ratio of solid angles."""
    h = min(math.hypot(5.0, 4.0) / (math.tan(math.radians(cone)) / 1.2), 1e12)
    exact = solid_angle(5.0, 4.0, h) / (4 * mp.pi * mp.sin(mp.radians(mp.mpf(cone)) / 2) ** 2)
    assert abs(arriving(scene(h, cone=cone)) / float(exact) - 1.0) < 3e-4


@pytest.mark.parametrize("intensity", ["uniform", "lambertian"])
@pytest.mark.parametrize("distance", DISTANCES)
def test_power_from_any_distance(distance, intensity):
    """A hemisphere: uniform light by the solid angle, Lambertian light by the integral of cos^2 / (pi r^2)."""
    found = arriving(scene(distance, cone=90.0, intensity=intensity))
    h = mp.mpf(distance)
    if intensity == "uniform":
        exact = solid_angle(5.0, 4.0, h) / (2 * mp.pi)
    else:  # form factor of a rectangle over a differential area below its centre
        x, y = 5 / h, 4 / h
        a, b = x / mp.sqrt(1 + x * x), y / mp.sqrt(1 + y * y)
        exact = 4 * (a * mp.atan(y / mp.sqrt(1 + x * x)) + b * mp.atan(x / mp.sqrt(1 + y * y))) / (2 * mp.pi)
    assert abs(found / float(exact) - 1.0) < 2e-3


@pytest.mark.parametrize("aside", [3.0, 20.0, 1e4])
def test_directions_from_far_off_the_axis(aside):
    """Every ray points from the source to where it meets the lens, to the last digits of its direction."""
    s = Scene(Points(((aside, -2.0 * aside, -50.0),), cone=90.0), Lens(size=(10.0, 8.0)), Screen((10.0, 10.0)))
    b = Tracer(System.of(s), next(rays_of(s, "stratified", 500, 1).chunks())).start
    (x, y, _), checked = b.origin, 0
    for k in range(0, len(x), 50):
        dx, dy = mp.mpf(float(x[k])) - aside, mp.mpf(float(y[k])) + 2 * aside
        length = mp.sqrt(dx * dx + dy * dy + 2500)
        for found, exact in zip(b.direction[:2], (dx / length / s.lens.index, dy / length / s.lens.index), strict=True):
            assert abs(float(found[k]) - float(exact)) < 1e-15
            checked += 1
    assert checked >= 20


def test_from_afar_a_point_is_a_plane_wave(kernels, dtype, compare):
    """At -1e6 mm, value and derivative of the image, beside the plane wave through the same places.

    The naive ray starts at the source: in float32 t = 1e6 mm leaves 0.03 mm of doubt about where it meets the lens.
    """
    lens = Lens(size=(10.0, 8.0), control=(9, 8), fresnel="none", index=1.5)
    field = HeightField.of(lens)
    x, y = field.control_xy()
    heights = 3.0 - 0.01 * (x[:, None] ** 2 + 1.3 * y**2) + 0.002 * torch.sin(x[:, None] + 2.0 * y)
    screen, out = Screen((16.0, 16.0), 60.0, (16, 16)), []
    weights = torch.rand(16, 16, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for source in (PlaneWave(), Points(((0.0, 0.0, -1e6),))):
        s, leaf = Scene(source, lens, screen), heights.clone().requires_grad_()
        (rays,) = rays_of(s, "stratified", 4000, 5).chunks()
        image = Tracer(System.of(s, field), rays, dtype).expose({EXIT: leaf}, screen, Filter("cosine", (3, 3))).image.double()
        (by,) = torch.autograd.grad((image / image.sum().detach() * weights).sum(), leaf)
        out.append((image.detach() / image.detach().sum(), by))
    value, slope = (float((a - b).norm() / a.norm()) for a, b in zip(*out, strict=True))
    # the wave's own curvature, 5e-6 rad over a throw of 57 mm, is 3e-4 mm on pixels of 1 mm
    assert value < 2e-3
    assert slope < 1e-2
    inside = Tracer(System.of(s, field), rays).start
    t, _, _, hit = field.intersect(heights, inside.origin, inside.direction, 1.0)
    assert int(hit.sum()) > 2000
    x, y, z = (o + t * d for o, d in zip(inside.origin, inside.direction, strict=True))
    off = (z - field.at(heights, x, y)[0])[hit].abs().max()
    far, depth = torch.tensor(-1e6, dtype=torch.float32), z[hit].float()
    naive = (far + (depth - far) - depth).abs().max()
    compare("source 1e-6 to 1e6 mm before the lens", "place of the hit, mm", float(naive), float(off), 1e-9)


@pytest.mark.parametrize(
    "source",
    [
        Points(((0.0, 0.0, -1e-6),)),
        Disc((0.0, 0.0, -1e-6), (2.0, 1.0)),
        Disc(angle=1e-6),
        Disc(angle=170.0),
        Points(((4.9, 3.9, -1e-6),), cone=89.0),
        Points(((0.0, 0.0, -1e6),), cone=1e-6),
    ],
    ids=["near", "near disc", "thin sun", "wide sun", "near the corner", "far and narrow"],
)
@pytest.mark.parametrize("count", [1, 1000])
def test_energy_closes_and_nothing_is_negative(source, count, kernels, dtype):
    lens = Lens(size=(10.0, 8.0), control=(6, 6), index=1.5)
    s, field = Scene(source, lens, Screen((30.0, 30.0), 40.0, (12, 12))), HeightField.of(lens)
    heights = 2.0 + 0.1 * torch.rand(6, 6, dtype=torch.float64)
    e = expose(s, field, heights, rays_of(s, "stratified", count, 3), Filter("cosine", (3, 3)), dtype)
    assert bool(torch.isfinite(e.image).all()) and float(e.image.min()) >= 0
    assert min(e.lost.values()) >= -1e-9
    assert float(e.image.sum()) + math.fsum(e.lost.values()) == pytest.approx(1.0, abs=1e-12 if dtype == torch.float64 else 1e-6)
    assert np.isfinite(e.leaving)
