"""Finishing models against what they stand for, simulated by other means: contact of an elastic pad by Boussinesq's formula in
space, a coat by the equation of a thin film, a printed staircase by plain rays."""

import json
import math
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from scipy.integrate import solve_ivp
from scipy.linalg import lu_factor, lu_solve
from scipy.signal import fftconvolve
from test_finishing import finish
from test_machine import spline

from caustic_cli import cli
from caustic_cli.optics import finishing
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Screen
from caustic_cli.workflow.lens import load


def rubbed(h, side, depth, steps=40):
    """Heights (n, n), mm, of a periodic cell of this side after a pad in full contact has removed `depth` on average, in proportion
    to its pressure: Boussinesq's displacement of a half-space by pressure on squares, summed over cells around."""
    n, cells = len(h), 5
    step = side / n
    at = (np.arange(n) - n // 2) * step
    kernel = np.zeros((n, n))
    for kx in range(-cells, cells + 1):
        for ky in range(-cells, cells + 1):
            r = np.hypot(at[:, None] + kx * side, at[None, :] + ky * side)
            kernel += np.where(r > 0, step**2 / np.maximum(r, 1e-9), 4.0 * step * math.log(1.0 + math.sqrt(2.0)))
    modulus = finishing.CLOTH / math.pi  # over the mean pressure
    index = (np.arange(n)[:, None] - np.arange(n)[None, :] + n // 2) % n
    matrix = kernel[index[:, None, :, None], index[None, :, None, :]].reshape(n * n, n * n) / (math.pi * modulus)
    system = np.block([[matrix, -np.ones((n * n, 1))], [np.full((1, n * n), 1.0 / n**2), np.zeros((1, 1))]])
    solver, h = lu_factor(system), h.ravel().copy()
    for _ in range(steps):  # the midpoint rule
        half = h - 0.5 * depth / steps * lu_solve(solver, np.append(h, 1.0))[:-1]
        pressure = lu_solve(solver, np.append(half, 1.0))[:-1]
        assert pressure.min() > 0.0  # full contact
        h -= depth / steps * pressure
    return h.reshape(n, n)


def test_a_polish_is_what_an_elastic_pad_removes():
    side, n, depth = 2.0, 28, 0.008
    line = (np.arange(n) - n // 2) * side / n

    def ripples(x, y):
        c = [np.cos(2 * np.pi * k * x / side) for k in (1, 2)] + [np.cos(2 * np.pi * k * y / side) for k in (1, 2)]
        return 2e-3 * c[0] * c[2] + 1e-3 * c[1] - 1e-3 * c[0] * c[3]

    before = ripples(line[:, None], line[None, :])
    after = rubbed(before, side, depth)
    grid = np.linspace(-8.0, 8.0, 321)
    surface = HeightField.through(ripples(grid[:, None], grid[None, :]) + 5.0, (8.0, 8.0))
    field, heights = finish(finishing.parse("polished:8"), *surface)
    x, y = (torch.from_numpy(c.ravel()) for c in np.meshgrid(line, line, indexing="ij"))
    model = field.at(heights, x, y, [(0, 0)])[0].numpy().reshape(n, n)
    off = (model - model.mean()) - (after - after.mean())
    assert (after - after.mean()).std() < 0.6 * before.std()
    assert off.std() < 0.04 * before.std()


def levelled(f, a, depth, seconds=60.0, n=64):
    """Amplitude, mm, of the top of a coat of `depth` mm that followed a ripple of amplitude a and frequency f, 1/mm, after it
    flowed by surface tension: H_t = -(sigma / (3 eta) h^3 H_xxx)_x, of 0.03 N/m and 0.3 Pa s."""
    x = np.arange(n) / n / f
    step, base = x[1], a * np.cos(2 * np.pi * f * x)

    def flow(_, top):
        third = (np.roll(top, -2) - 3 * np.roll(top, -1) + 3 * top - np.roll(top, 1)) / step**3  # between points
        film = top - base
        through = (0.5 * (film + np.roll(film, -1))) ** 3 * 0.03 / (3 * 0.3) * 1e3 * third
        return -(through - np.roll(through, 1)) / step

    top = solve_ivp(flow, (0.0, seconds), base + depth, "BDF", rtol=1e-6, atol=1e-9).y[:, -1]
    return 2.0 * np.mean(top * np.cos(2 * np.pi * f * x))


@pytest.mark.parametrize("f", [0.35, 0.5, 0.65])
def test_a_coat_flows_as_a_thin_film(f):
    """Within one per cent of a shallow ripple; of one half as deep as the coat within what is said to be known of the step."""
    (step,) = finishing.parse("coated:20")
    assert levelled(f, 5e-4, 0.02) / 5e-4 == pytest.approx(float(step.transfer(np.array(f))), rel=0.01)
    deep = levelled(f, 1e-2, 0.02) / 1e-2
    weak, strong = (float(step.by(s).transfer(np.array(f))) for s in (-1.0, 1.0))
    assert strong < deep < weak


def picture(scene, surface, seed, rays=1_000_000):
    """Fractions of parallel light on the screen's pixels by plain rays: z(x, y), mm, and slopes of the exit."""
    random, lens = np.random.default_rng(seed), scene.lens
    x, y = (random.uniform(-r, r, rays) for r in lens.half_size)
    z, gx, gy = surface(x, y)
    normal = np.stack([-gx, -gy, np.ones_like(x)]) / np.sqrt(1.0 + gx * gx + gy * gy)
    cosine = lens.index * normal[2]
    square = 1.0 - lens.index**2 * (1.0 - normal[2] ** 2)
    ray = np.stack([0.0 * x, 0.0 * x, np.full_like(x, lens.index)]) + (np.sqrt(np.maximum(square, 0.0)) - cosine) * normal
    t = (scene.screen.z - z) / ray[2]
    places = [c + t * d for c, d in ((x, ray[0]), (y, ray[1]))]
    ends = [[-r, r] for r in scene.screen.half_size]
    keep = square > 0
    return np.histogram2d(places[0][keep], places[1][keep], bins=scene.screen.resolution, range=ends)[0] / rays


@pytest.mark.parametrize("text", ["printed:20,100", "printed:5,50"])
def test_a_printed_staircase_is_traced_as_plain_rays_trace_it(text):
    """Its terraces are windows: parallel light goes straight on."""
    scene, field, heights = spline(lambda x, y: 5.0 - 0.004 * (x * x + y * y) + 2e-4 * x**3 + 2e-4 * y * y * x)
    scene, (step,) = replace(scene, screen=Screen((30.0, 24.0), 300.0, (30, 24))), finishing.parse(text)

    def stairs(x, y):
        x, y = ((np.floor(c / step.pixel) + 0.5) * step.pixel for c in (x, y))
        z = field.at(heights, torch.from_numpy(x), torch.from_numpy(y), [(0, 0)])[0].numpy()
        return step.layer * np.rint(z / step.layer), 0.0 * x, 0.0 * x

    surface = finish((step,), field, heights)
    through = (4.0 * scene.lens.index / (scene.lens.index + 1.0) ** 2) ** 2  # of two surfaces, by Fresnel
    model = expose(scene, *surface, rays_of(scene, "stratified", 400_000)).image.numpy() / through
    true, again = (picture(scene, stairs, seed) for seed in (0, 1))
    noise = float((true - again).std())
    assert true.sum() == pytest.approx(1.0) and model.sum() > 0.995
    assert (model - true).std() < 1.2 * noise
    x, y = (torch.from_numpy(np.random.default_rng(2).uniform(-r, r, 20_000)) for r in scene.lens.half_size)
    off = surface[0].at(surface[1], x, y, [(0, 0)])[0].numpy() - stairs(x.numpy(), y.numpy())[0]
    assert (np.abs(off) > 1e-9).mean() < 0.01


def polished(field, heights, depth, n=641):
    """Spline through a surface after a polish of `depth` mm: the heights beside a fitted paraboloid, continued by reflection in the
    borders, folded with Poisson's kernel, whose transform is exp(-f z pi E / p)."""
    line = [np.linspace(-r, r, n) for r in field.half_size]
    x, y = (c.ravel() for c in np.meshgrid(*line, indexing="ij"))
    z = field.at(heights, *(torch.from_numpy(c * (1.0 - 1e-12)) for c in (x, y)), [(0, 0)])[0].numpy()
    smooth = np.stack([x**a * y**b for a in range(3) for b in range(3)], 1)
    kept = smooth @ np.linalg.lstsq(smooth, z, rcond=None)[0]
    wide = np.pad((z - kept).reshape(n, n), n // 2, mode="reflect", reflect_type="odd")
    at, a = [c[1] - c[0] for c in line] * (np.arange(n) - n // 2)[:, None], depth * finishing.CLOTH
    kernel = 2 * np.pi * a * (4 * np.pi**2 * (at[:, :1] ** 2 + at[:, 1] ** 2) + a * a) ** -1.5 * at[n // 2 + 1].prod()
    return HeightField.through(kept.reshape(n, n) + fftconvolve(wide, kernel, "valid")[:n, :n], field.half_size)


def test_a_corrected_part_is_better_by_the_stated_amount(tmp_path, monkeypatch, capfd):
    """As made and polished by other code, and its light by plain rays against the picture; the correction gains most of what the
    polish costs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=2000000")
    write_blob()
    order = "design blob.png --mag 2 --resolution 24 --waves off --finish polished:5 --rays 400000 -o a.caustic --json --quiet"
    assert cli.run(shlex.split(order)) == 0
    stated, lens = json.loads(capfd.readouterr().out)["finish"], load("a.caustic")
    rays = 4_000_000

    def error(field, heights):
        def surface(x, y):
            at = (torch.from_numpy(c) for c in (x, y))
            return tuple(t.numpy() for t in field.at(heights, *at, [(0, 0), (1, 0), (0, 1)]))

        image, target = picture(lens.scene, surface, 3, rays), np.asarray(lens.target)
        counted = (image / rays / image.mean() ** 2).mean()  # variance of counts
        return math.sqrt(np.square(image / image.mean() - target / target.mean()).mean() - counted)

    made, plain = (error(*polished(*s, 0.005)) for s in (lens.made, (lens.field, lens.heights)))
    gain = stated["uncorrected_error"] - stated["error"]
    assert max(stated["noise"], stated["uncorrected_noise"]) < 1e-3 and stated["error"] < 0.25 * stated["uncorrected_error"]
    assert plain == pytest.approx(stated["uncorrected_error"], abs=2e-3)
    assert plain - made == pytest.approx(gain, rel=0.15)  # the kernel ends where the continued surface does
