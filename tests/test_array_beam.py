"""Arrays of lenslets in the beam of a laser, a beam homogeniser, and in the light of a ray file."""

import math
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.inverse.lenslets import initial_array, lenslets
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen
from caustic_cli.scene.lens import array_control
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.measured_beam import MeasuredBeam
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.studies.retrace import retrace

WAVELENGTH, WAIST = 633.0, 3.0


def measured(curved: float = 0.0, n: int = 96, wide=(9.0, 6.0)) -> MeasuredBeam:
    """A beam as of a Gaussian by its samples, with the wavefront of a point at the distance `curved` in front."""
    x, y = (((np.arange(n) + 0.5) / n - 0.5) * w for w in wide)
    square = x[:, None] ** 2 + y[None, :] ** 2
    phase = math.pi * square / (WAVELENGTH * 1e-6 * curved) if curved else np.zeros((n, n))
    return MeasuredBeam(phase, WAVELENGTH, np.exp(-2.0 * square / WAIST**2))


def array_of(source, array=(3, 2), spans=20, size=(9.0, 6.0), screen=(24.0, 20.0)) -> Scene:
    control = tuple(array_control(spans * k, 3, k) for k in array)
    lens = Lens(size, index=1.5, control=control, array=array, fresnel="none")
    return Scene(source, lens, Screen(screen, 200.0, (30, 25)))


@pytest.mark.parametrize("source", [Gaussian((WAIST, WAIST), WAVELENGTH), measured()], ids=["gaussian", "measured"])
def test_shares_of_a_gaussian_beam(source):
    """The light on each lenslet, by error functions."""
    along = [
        np.diff([math.erf(math.sqrt(2.0) * edge / WAIST) for edge in np.linspace(-w / 2, w / 2, n + 1)])
        for w, n in zip((9.0, 6.0), (3, 2), strict=True)
    ]
    whole = np.outer(*along)
    found = [one.share for one in lenslets(array_of(source))]
    assert found == pytest.approx(list((whole / whole.sum()).ravel()), rel=2e-3)


@pytest.mark.parametrize(
    "source",
    [
        Gaussian((WAIST, WAIST), WAVELENGTH, waist_at=-150.0),
        Gaussian((WAIST, 2.0), WAVELENGTH, tilt=(1.0, 0.5)),
        measured(curved=2000.0),
    ],
    ids=["curved", "tilted", "measured"],
)
def test_lenslets_together_throw_the_image_of_the_array(source):
    """Each in its own frame, with its part of the beam; but for light that crosses a border in the glass."""
    scene = array_of(source)
    rng = np.random.default_rng(1)
    heights = 0.3 + 0.003 * torch.from_numpy(rng.uniform(-1, 1, scene.lens.control))
    field = HeightField.of(scene.lens)
    whole = expose(scene, field, heights, rays_of(scene, "grid", 600_000), None, torch.float64)
    total, lost = torch.zeros_like(whole.image), 0.0
    for one in lenslets(scene):
        seen = expose(one.scene, one.field, one.of(heights), rays_of(one.scene, "grid", 100_000), None, torch.float64)
        total += one.share * seen.image
        lost += one.share * seen.lost["missed_surface"]
    assert lost < 2e-3
    assert float(whole.image.sum()) > 0.9
    assert float((total - whole.image).abs().sum()) < 0.02


def test_each_lenslet_maps_its_part_of_the_beam_onto_the_whole_picture():
    """Landing points on an even rectangle, in closed form: the fraction of the lenslet's light beside a ray."""
    array, half = (2, 2), 8.0
    scene = array_of(Gaussian((WAIST, WAIST), WAVELENGTH), array, 60, (8.0, 8.0), (2.0 * half, 2.0 * half))
    scene = replace(scene, screen=Screen((16.0, 16.0), 120.0, (32, 32)))
    made = initial_array(scene, [np.ones((32, 32))], scene.lens.control, 128)
    rng, field = np.random.default_rng(2), HeightField.of(scene.lens)
    x, y = (torch.from_numpy(rng.uniform(-3.9, 3.9, 400)) for _ in range(2))
    z, gx, gy = field.at(made.heights, x, y)
    length = torch.sqrt(1.0 + gx * gx + gy * gy)  # Snell's law in vector form, for light along z
    cosine, index = 1.0 / length, scene.lens.inside
    bent = torch.sqrt(1.0 - index * index * (1.0 - cosine * cosine)) - index * cosine
    dx, dy, dz = -gx / length * bent, -gy / length * bent, index + bent / length
    landed = [(c + d / dz * (120.0 - z)).numpy() for c, d in ((x, dx), (y, dy))]
    for at, seen in zip((x.numpy(), y.numpy()), landed, strict=True):
        inner, outer = np.zeros_like(at), np.sign(at) * 4.0
        erf = np.vectorize(lambda c: math.erf(math.sqrt(2.0) * c / WAIST))
        part = np.abs((erf(at) - erf(inner)) / (erf(outer) - erf(inner)))
        part = np.where(at > 0, part, 1.0 - part)
        wanted = half * (2.0 * part - 1.0)
        off = np.abs(seen - wanted)
        assert np.sqrt(np.mean(off**2)) < 0.02 * half


@pytest.mark.parametrize("tilt", [(0.0, 10.0), (-12.0, 7.0)], ids=str)
def test_each_lenslet_maps_its_part_of_tilted_light_onto_the_whole_picture(tilt):
    """Landing points on an even rectangle, in closed form: the place in the lit part of the lenslet, which is all of it but in the
    shadow of the array's sides.  Light through the entrance of a neighbour, a sixth of it here, goes there too."""
    array, half, far = (2, 1), 8.0, 120.0
    source = PlaneWave(tilt=tilt)
    scene = array_of(source, array, 60, (8.0, 4.0), (2.0 * half, 2.0 * half))
    d = np.array(source.axis)
    middle = tuple(far * d[:2] / d[2])
    scene = replace(scene, screen=Screen((2.0 * half, 2.0 * half), far, (16, 16), shift=middle))
    made, field, index = initial_array(scene, [np.ones((16, 16))], scene.lens.control, 64), HeightField.of(scene.lens), 1.5
    inside = np.array([*(d[:2] / index), math.sqrt(1.0 - float(d[:2] @ d[:2]) / index**2)])
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-3.9, 3.9, 2000), rng.uniform(-1.9, 1.9, 2000)
    z, gx, gy = (c.numpy() for c in field.at(made.heights, torch.from_numpy(x), torch.from_numpy(y)))
    normal = np.stack([-gx, -gy, np.ones_like(z)]) / np.sqrt(1.0 + gx * gx + gy * gy)
    cosine = inside @ normal  # Snell's law in vector form
    bent = np.sqrt(1.0 - index * index * (1.0 - cosine * cosine)) - index * cosine
    out = index * inside[:, None] + bent * normal
    drift = (z.mean() - scene.lens.z_in) * inside[:2] / inside[2]
    assert np.abs(drift).max() > 0.3
    shown = np.ones(len(x), dtype=bool)
    cells = (np.where(x < 0, -4.0, 0.0), np.where(x < 0, 0.0, 4.0), 4.0), (-2.0, 2.0, 2.0)
    for at, (first, last, edge), k, moved, centre in zip((x, y), cells, out[:2] / out[2], drift, middle, strict=True):
        low, high = np.maximum(first, moved - edge), np.minimum(last, moved + edge)
        shown &= (at > low + 0.05) & (at < high - 0.05)
        wanted = half * (2.0 * (at - low) / (high - low) - 1.0)
        off = (at + k * (far - z) - centre - wanted)[shown]
        assert np.sqrt(np.mean(off**2)) < 0.03 * half
    assert shown.mean() > 0.7


@pytest.mark.parametrize(("m2", "told"), [(1.0, True), (20.0, False)])
def test_fringes_are_told(m2, told, tmp_path, monkeypatch, capfd):
    """Of light with one phase, not of a beam of many modes: wavelength times distance over pitch, by hand."""
    monkeypatch.chdir(tmp_path)
    write_blob()
    laser = f"--source gaussian --waist 4 --wavelengths 1000 --m2 {m2} --lens-size 10 --throw 200 --thickness 5"
    command = f"design blob.png --array 2x2 {laser} --control 41 --resolution 24 --iterations 1 --quality draft --threads 2"
    assert cli.run(shlex.split(command)) == 0
    said = capfd.readouterr().err
    assert ("in fringes of 0.039 mm" in said) == told
    assert "interferes, in fringes" in said or not told


# Rays of a file


def led(rays: int, position, tilt=(0.0, 0.0)) -> Measured:
    """Rays of a spot of 0.1 mm, into all directions up to 0.25 to z in x and y."""
    rng = np.random.default_rng(0)
    directions = np.column_stack([rng.uniform(-0.25, 0.25, (rays, 2)), np.ones(rays)])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    starts = np.column_stack([rng.normal(0.0, 0.02, (rays, 2)), np.zeros(rays)])
    return Measured(RaySet(starts, directions, np.full(rays, 1.0 / rays)), position, 1.0, tilt)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (5.0, -3.0)], ids=["along z", "tilted"])
def test_rays_of_a_file_move_with_their_origin(tilt):
    source, pupil = led(1000, (1.0, -2.0, -40.0), tilt), Lens((8.0, 8.0)).pupil
    x, y, _ = source.crossing(pupil)
    moved = source.displaced(lambda at: (at[0] - 2.5, at[1] + 1.5, at[2]), 1.0)
    a, b, _ = moved.crossing(pupil)
    np.testing.assert_allclose(a, x - 2.5, atol=1e-9)
    np.testing.assert_allclose(b, y + 1.5, atol=1e-9)


def test_an_array_in_the_light_of_a_ray_file():
    """The picture by rays of the file that the transport was not told one by one, and the light on each lenslet, counted."""
    x = np.linspace(-1.0, 1.0, 32)
    goal = np.exp(-3.0 * (x[:, None] ** 2 + (x[None, :] - 0.2) ** 2)) + 0.2
    control = tuple(array_control(n, 3, 2) for n in (60, 60))
    lens = Lens((8.0, 8.0), index=1.5, control=control, array=(2, 2), fresnel="none")
    scene = Scene(led(600_000, (1.0, -2.0, -38.0)), lens, Screen((24.0, 24.0), 120.0, (32, 32)))
    at_x, at_y, met = scene.source.crossing(scene.pupil)
    counted = np.histogram2d(at_x[met], at_y[met], ([-4, 0, 4], [-4, 0, 4]))[0].ravel()
    assert [one.share for one in lenslets(scene)] == pytest.approx(list(counted / counted.sum()), rel=0.02)
    heights = initial_array(scene, [goal], control, 64).heights
    assert retrace(scene, HeightField.of(lens), heights, goal, rays=400_000)[1]["relative_rms"] < 0.11
