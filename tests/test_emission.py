"""Rays of points and discs: power, directions, aiming, limits."""

from __future__ import annotations

import math

import pytest
import torch

from caustic_cli.errors import InputError
from caustic_cli.optics.emission import Emission, rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Aperture, Disc, Lens, Offset, PlaneWave, Points, Pupil, Scene, Screen

LENS = Lens(size=(10.0, 8.0), control=(8, 7), z_in=0.0, index=1.5, fresnel="none")


def scene(source, lens=LENS):
    return Scene(source, lens, Screen((40.0, 32.0), 100.0, (20, 16)))


def whole(source, kind="stratified", rays=40_000, lens=LENS, **options):
    """Rays inside the lens."""
    here = scene(source, lens)
    (drawn,) = rays_of(here, kind, rays, **options).chunks()
    return Tracer(System.of(here), drawn).start


def rectangle(rx, ry, h):
    """Solid angle of a rectangle seen from height h above its centre."""
    return 4.0 * math.asin(rx * ry / math.sqrt((rx * rx + h * h) * (ry * ry + h * h)))


@pytest.mark.parametrize("kind", ["grid", "lines", "stratified", "uniform", "sobol"])
@pytest.mark.parametrize("aimed", [True, False])
def test_a_point_sends_the_lens_the_solid_angle_it_covers(kind, aimed):
    source = Points(((0.0, 0.0, -6.0),), cone=60.0, aimed=aimed)
    bundle = whole(source, kind)
    part = rectangle(5.0, 4.0, 6.0) / (4.0 * math.pi * math.sin(math.radians(30.0)) ** 2)
    assert float(bundle.power.sum()) == pytest.approx(part, abs=0.012 if kind == "uniform" or not aimed else 2e-3)
    assert float(bundle.power.sum()) + sum(bundle.lost.values()) == pytest.approx(1.0, abs=1e-13)
    if aimed:
        assert bool((bundle.power > 0).all())  # none wasted


def test_a_cone_within_the_lens_is_sampled_itself():
    bundle = whole(Points(((0.5, -0.5, -6.0),), cone=20.0))
    torch.testing.assert_close(bundle.power, torch.full_like(bundle.power, 1.0 / len(bundle.power)))
    assert bundle.lost["missed_lens"] == pytest.approx(0.0, abs=1e-13)
    sine = torch.hypot(bundle.direction[0], bundle.direction[1]) * 1.5  # Snell at the flat entrance
    assert float(sine.max()) <= math.sin(math.radians(20.0)) * (1 + 1e-12)
    assert float((1 - torch.sqrt(1 - sine**2)).mean()) == pytest.approx(math.sin(math.radians(10.0)) ** 2, rel=1e-3)


def test_lambertian_light_is_even_in_sine_squared():
    bundle = whole(Points(((0.0, 0.0, -6.0),), cone=30.0, intensity="lambertian"))
    sine2 = (bundle.direction[0] ** 2 + bundle.direction[1] ** 2) * 1.5**2
    assert float(sine2.mean()) == pytest.approx(0.5 * math.sin(math.radians(30.0)) ** 2, rel=1e-3)
    part = float(whole(Points(((0.0, 0.0, -6.0),), cone=60.0, intensity="lambertian")).power.sum())
    cone = float(whole(Points(((0.0, 0.0, -6.0),), cone=60.0, intensity="lambertian", aimed=False)).power.sum())
    assert part == pytest.approx(cone, abs=5e-3)
    assert part > float(whole(Points(((0.0, 0.0, -6.0),), cone=60.0)).power.sum())


@pytest.mark.parametrize("half", [1e-6, 1e-4, 0.27])
def test_narrow_cones_keep_their_digits(half):
    """1 - cos theta from sin^2(theta / 2): hard case 3."""
    bundle = whole(Points(((0.0, 0.0, -6.0),), cone=half))
    tangent = torch.hypot(bundle.origin[0], bundle.origin[1]) / 6.0
    assert float(tangent.max() / math.tan(math.radians(half))) == pytest.approx(1.0, abs=1e-2)
    assert float((tangent**2).mean() / math.tan(math.radians(half)) ** 2) == pytest.approx(0.5, rel=1e-3)


def test_rays_point_away_from_the_source():
    source = Points(((1.0, -2.0, -7.0), (-3.0, 0.0, -5.0)), (1.0, 3.0))
    bundle = whole(source, rays=2000)
    first = torch.arange(len(bundle.origin[0])) < len(bundle.origin[0]) // 2
    for mine, (x, y, z) in zip((first, ~first), source.positions, strict=True):
        dx, dy = bundle.direction[0][mine] * 1.5, bundle.direction[1][mine] * 1.5
        dz = torch.sqrt(1 - dx**2 - dy**2)
        torch.testing.assert_close(x - z * dx / dz, bundle.origin[0][mine])
        torch.testing.assert_close(y - z * dy / dz, bundle.origin[1][mine])
    torch.testing.assert_close(sum(d**2 for d in bundle.direction), torch.ones_like(bundle.power))


def test_powers_are_shared_as_asked():
    source = Points(((0.0, 0.0, -6.0), (0.0, 0.0, -6.0)), (1.0, 3.0), cone=20.0)
    bundle = whole(source, rays=2000)
    half = len(bundle.power) // 2
    assert float(bundle.power[half:].sum() / bundle.power[:half].sum()) == pytest.approx(3.0)


def test_a_grid_is_equispaced_with_its_borders():
    source = Points.grid((0.0, 0.0, -5.0), (2.0, 2.0), (25, 25))
    xs = sorted({p[0] for p in source.positions})
    assert (len(source.positions), len(xs), xs[0], xs[-1]) == (625, 25, -1.0, 1.0)
    assert source.power == pytest.approx(1.0)
    assert Points.grid((0.0, 0.0, -5.0), (2.0, 2.0), (1, 1)).positions == ((0.0, 0.0, -5.0),)


def test_a_disc_shines_from_all_of_itself():
    bundle = whole(Disc((0.5, 0.0, -8.0), (2.0, 1.0), cone=70.0), rays=200_000)
    dz = torch.sqrt(1 - (bundle.direction[0] ** 2 + bundle.direction[1] ** 2) * 1.5**2)
    x = bundle.origin[0] - 8.0 * bundle.direction[0] * 1.5 / dz
    y = bundle.origin[1] - 8.0 * bundle.direction[1] * 1.5 / dz
    inside = ((x - 0.5) / 1.0) ** 2 + (y / 0.5) ** 2
    assert 0.999 < float(inside.max()) < 1.0 + 1e-9
    # power from each point of the ellipse is even up to what the lens' rim takes away
    weight = bundle.power / bundle.power.sum()
    assert float((weight * inside).sum()) == pytest.approx(0.5, abs=0.02)


def test_a_disc_without_size_is_a_point():
    point = whole(Points(((0.0, 0.0, -8.0),), cone=60.0, intensity="lambertian"))
    disc = whole(Disc((0.0, 0.0, -8.0), (0.0, 0.0), cone=60.0))
    torch.testing.assert_close(point.power, disc.power)
    torch.testing.assert_close(point.direction[0], disc.direction[0])


def test_the_sun_fills_its_angle_evenly():
    bundle = whole(Disc(angle=0.533))
    half = math.radians(0.533) / 2
    sine = torch.hypot(bundle.direction[0], bundle.direction[1]) * 1.5
    assert float(sine.max()) == pytest.approx(math.sin(half), rel=1e-3)
    assert float((sine**2).mean()) == pytest.approx(0.5 * math.sin(half) ** 2, rel=1e-2)
    assert float(bundle.power.sum()) == pytest.approx(1.0)


@pytest.mark.parametrize("kind", ["stratified", "uniform", "sobol", "lines", "grid"])
def test_rays_do_not_depend_on_chunks(kind):
    emission = rays_of(scene(Points.grid((0.0, 0.0, -6.0), (1.0, 1.0), (2, 2))), kind, 1000, seed=4)
    (one,) = emission.chunks()
    many = list(emission.chunks(77))
    assert len(many) > 10
    assert {b.origin[2] for b in many} == {one.origin[2]}
    for part in zip(*((*b.origin[:2], *b.direction, b.power) for b in (one, *many)), strict=True):
        # torch rounds tangents and cosines in its vector loop and in its tail differently: an ulp, of millimetres
        torch.testing.assert_close(torch.cat(part[1:]), part[0], rtol=1e-14, atol=1e-14)
    assert sum(b.lost["missed_lens"] for b in many) == pytest.approx(one.lost["missed_lens"], abs=1e-14)


def heights(lens, mag=2.0, throw=100.0):
    x, y = HeightField.of(lens).control_xy()
    offset = Offset.for_magnification((mag, mag), lens.index, throw, 5.0)
    return offset.thickness + torch.from_numpy(offset.sag(x[:, None].numpy(), y[None, :].numpy()))


def test_a_source_a_kilometre_away_is_a_plane_wave():
    """Erratum E16, and hard case 3: z = -1e6 mm."""
    lens = Lens(size=(10.0, 8.0), control=(8, 7), index=1.5)
    field, z, images = HeightField.of(lens), heights(lens), []
    for source in (PlaneWave(), Points(((0.0, 0.0, -1e6),))):
        for dtype in (torch.float64, torch.float32):
            images.append(expose(scene(source, lens), field, z, rays_of(scene(source, lens), "grid", 1_000_000), dtype=dtype))
    for exposure in images[1:]:
        image = exposure.image / exposure.image.sum()
        reference = images[0].image / images[0].image.sum()
        assert float((image - reference).norm() / reference.norm()) < 1e-3
    # Along a line the rays land where the plane wave's do, to the divergence's 1e-4 mm.
    assert images[2].lost["missed_lens"] == pytest.approx(1 - 80.0 / (math.pi * (25 + 16)), abs=1e-6)


def test_aimed_and_unaimed_rays_make_the_same_image():
    lens = Lens(size=(10.0, 8.0), control=(8, 7), index=1.5)
    field, z = HeightField.of(lens), heights(lens)
    images = {}
    for aimed in (True, False):
        here = scene(Points(((1.0, 0.0, -9.0),), cone=50.0, aimed=aimed), lens)
        images[aimed] = [expose(here, field, z, rays_of(here, "uniform", 200_000, seed)).image for seed in range(4)]
    mean = {k: torch.stack(v).mean(0) for k, v in images.items()}
    noise = torch.sqrt(sum(torch.stack(v).var(0) / 4 for v in images.values())) + 1e-9
    score = ((mean[True] - mean[False]) / noise)[mean[True] > 1e-5]
    assert len(score) > 50
    assert float(score.pow(2).mean()) < 3.0  # each has 6 degrees of freedom: mean 1.5


@pytest.mark.parametrize(
    "source, message",
    [
        (lambda: Points(()), "position must name 1 to"),
        (lambda: Points(((0.0, 0.0),)), "three numbers"),
        (lambda: Points(((0.0, 0.0, math.nan),)), "position"),
        (lambda: Points(((0.0, 0.0, -5.0),), (0.0,)), "not all be 0"),
        (lambda: Points(((0.0, 0.0, -5.0),), (1.0, 2.0)), "one for each"),
        (lambda: Points(((0.0, 0.0, -5.0),), cone=0.0), "cone"),
        (lambda: Points(((0.0, 0.0, -5.0),), cone=91.0), "cone"),
        (lambda: Points(((0.0, 0.0, -5.0),), intensity="blue"), "intensity"),
        (lambda: Points.grid((0.0, 0.0, -5.0), (1.0, 1.0), (0, 3)), "grid"),
        (lambda: Disc(size=(-1.0, 1.0)), "size"),
        (lambda: Disc(angle=200.0), "angle"),
        (lambda: scene(Points(((0.0, 0.0, 0.0),))), "before the lens"),
        (lambda: Emission(scene(Disc()), "halton", (2, 2)), "sampler"),
    ],
)
def test_impossible_sources_are_refused(source, message):
    with pytest.raises(InputError, match=message):
        source()


def test_the_covering_cone_reaches_every_corner():
    source = Points(((2.0, 1.0, -6.0),))
    assert math.tan(source.cone_over(Pupil(Aperture((5.0, 4.0)), 0.0))) * 6.0 == pytest.approx(math.hypot(7.0, 5.0))
    assert bool((whole(source).power > 0).all())


@pytest.mark.parametrize(
    "source, expected",
    [
        (PlaneWave(), 0.0),
        (Points(((0.0, 0.0, -5.0),)), 0.0),
        (Disc(angle=0.533), 300.0 * math.radians(0.533)),
        (Disc((0.0, 0.0, -50.0), (5.0, 2.0)), 30.0),
        (Points.grid((0.0, 0.0, -50.0), (2.0, 1.0), (5, 5)), 12.0),
    ],
)
def test_the_blur_of_an_extended_source(source, expected):
    assert source.blur(0.0, 300.0) == pytest.approx(expected)


def test_the_blur_is_what_a_pinhole_s_worth_of_lens_shows():
    """Light of a disc through a small flat piece of glass: its image is as wide as the limit says."""
    lens = Lens(size=(0.02, 0.02), control=(4, 4), index=1.5, fresnel="none", offset=Offset(0.05))
    here = Scene(Disc((0.0, 0.0, -50.0), (2.0, 2.0)), lens, Screen((20.0, 20.0), 300.0, (200, 200)))
    flat = torch.full((4, 4), 0.05, dtype=torch.float64)
    image = expose(here, HeightField.of(lens), flat, rays_of(here, "stratified", 200_000)).image
    lit = (image.sum(1) > 0).nonzero()[:, 0]
    assert float(lit[-1] - lit[0] + 1) * 0.1 == pytest.approx(here.source.blur(0.0, 300.0), rel=0.05)
