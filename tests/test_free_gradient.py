"""A free gradient index for light and screens other than a plane wave and a screen on the axis: its start, judged by rays that this
file integrates itself, and designs on the command line.

Rays: the ray equation dx/dz = p / q, dp/dz = n grad n / q with q = sqrt(n^2 - p^2) by the classical Runge-Kutta method, in an index
that SciPy interpolates; p, the transverse momentum n sin(angle), is kept at both flat sides.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image
from scipy.interpolate import NdBSpline

from caustic_cli import cli, load
from caustic_cli.inverse.graded_lens import INDEX
from caustic_cli.inverse.gradient_index import layers_along, transport_index, with_index
from caustic_cli.kinds import problem_of
from caustic_cli.kinds.gradient_index import IndexPlate
from caustic_cli.kinds.robust import RobustPlate
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Component, Lens, Light, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.elements import FoldMirror

PIXELS, THICK, STEPS, ACROSS = 12, 5.0, 8, (72, 72)
PLAIN = Scene(PlaneWave(), Lens(control=(4, 4), offset=Offset(THICK)), Screen((30.0, 30.0), 150.0, (PIXELS, PIXELS)))
BEHIND = Component(40.0, (30.0, 30.0), 6.0, (90.0, -90.0), 1.5)
SCENES = {
    "plane wave": PLAIN,
    "far field": replace(PLAIN, screen=Screen((120.0, 120.0), 1000.0, (PIXELS, PIXELS), far=True)),
    "near source": replace(PLAIN, source=Points(((2.0, -1.0, -60.0),))),
    "tilted light": replace(PLAIN, source=PlaneWave(tilt=(15.0, 0.0)), screen=replace(PLAIN.screen, shift=(0.0, -40.0))),
    "lens behind": replace(PLAIN, elements=(BEHIND,)),
    "folded axis": replace(PLAIN, elements=(FoldMirror(50.0, (60.0, 60.0), tilt=(45.0, 0.0)),)),
}


def picture() -> np.ndarray:
    """(12, 12) irradiance without symmetry: a spot beside the centre on grey."""
    x = np.linspace(-1.0, 1.0, PIXELS)
    return np.exp(-3.0 * ((x[:, None] + 0.3) ** 2 + (x[None, :] - 0.2) ** 2)) + 0.3


def started(scene: Scene, layers: int = 1, wanted: np.ndarray | None = None, control: tuple[int, int] = (27, 29)) -> torch.Tensor:
    """Control values of the initial index."""
    wanted = picture() if wanted is None else wanted
    return transport_index(scene, wanted, control, 64, layers) + scene.lens.index


def entering(scene: Scene, across: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (2, N) of rays on the entrance, the transverse part (2, N) of their unit directions, and the power of each."""
    lens, source = scene.lens, scene.source
    middles = [(2.0 * (np.arange(n) + 0.5) / n - 1.0) * r for n, r in zip(across, lens.half_size, strict=True)]
    at = np.stack([m.ravel() for m in np.meshgrid(*middles, indexing="ij")])
    if source.distant:
        return at, np.array(source.axis)[:2, None] + 0.0 * at, np.ones(at.shape[1])
    away = np.stack([*(at - np.array(source.centre)[:2, None]), np.full(at.shape[1], lens.z_in - source.centre[2])])
    length = np.sqrt((away * away).sum(0))
    return at, away[:2] / length, length**-3.0


def integrated(scene: Scene, values: torch.Tensor, across: tuple[int, int] = ACROSS) -> tuple[np.ndarray, ...]:
    """Points (3, N) and directions (3, N) of rays behind the exit, and the power of each."""
    lens = scene.lens
    c = values.numpy() if values.shape[2] > 1 else np.repeat(values.numpy(), 2, axis=2)
    degrees, ends = [min(3, n - 1) for n in c.shape], [(-r, r) for r in lens.half_size] + [(0.0, THICK)]
    knots = [np.r_[[a] * p, np.linspace(a, b, n - p + 1), [b] * p] for n, p, (a, b) in zip(c.shape, degrees, ends, strict=True)]
    field = NdBSpline(tuple(knots), c, degrees)
    at, p, power = entering(scene, across)

    def rate(q: np.ndarray, p: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray]:
        places = np.stack([*(np.clip(c, -r, r) for c, r in zip(q, lens.half_size, strict=True)), np.full(q.shape[1], z)], -1)
        n = field(places)
        along = np.sqrt(n * n - (p * p).sum(0))
        return p / along, n / along * np.stack([field(places, nu=nu) for nu in ((1, 0, 0), (0, 1, 0))])

    q, h = at, THICK / STEPS
    for k in range(STEPS):
        z = k * h
        a, fa = rate(q, p, z)
        b, fb = rate(q + 0.5 * h * a, p + 0.5 * h * fa, z + 0.5 * h)
        d, fd = rate(q + 0.5 * h * b, p + 0.5 * h * fb, z + 0.5 * h)
        e, fe = rate(q + h * d, p + h * fd, z + h)
        q, p = q + h / 6.0 * (a + 2.0 * (b + d) + e), p + h / 6.0 * (fa + 2.0 * (fb + fd) + fe)
    inside = (np.abs(q) <= np.array(lens.half_size)[:, None]).all(0)
    return np.stack([*q, np.full(q.shape[1], THICK)]), np.stack([*p, np.sqrt(1.0 - (p * p).sum(0))]), np.where(inside, power, 0.0)


def through_sphere(o: np.ndarray, d: np.ndarray, vertex: float, radius: float, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays refracted by a sphere with its vertex on the axis; ratio: index in front over that behind."""
    rel = o - np.array([0.0, 0.0, vertex + radius])[:, None]
    b, c = (rel * d).sum(0), (rel * rel).sum(0) - radius * radius
    o = o + d * (-b - np.sign(radius) * np.sqrt(b * b - c))
    normal = (o - np.array([0.0, 0.0, vertex + radius])[:, None]) / -radius  # towards +z
    cosine = (normal * d).sum(0)
    return o, ratio * d + (np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2)) - ratio * cosine) * normal


def landed(scene: Scene, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Coordinates (2, N) on the screen of rays behind the exit."""
    screen = scene.screen
    if screen.far:
        return screen.z * d[:2]
    middle, axes = np.array([0.0, 0.0, screen.z]), np.eye(3)
    for element in scene.elements:
        if isinstance(element, FoldMirror):
            normal = np.array([0.0, 1.0, -1.0]) / np.sqrt(2.0)  # or the opposite
            o = o + d * ((np.array([0.0, 0.0, element.z])[:, None] - o) * normal[:, None]).sum(0) / (normal @ d)
            d = d - 2.0 * normal[:, None] * (normal @ d)
            pose = System.of(scene).placed(screen).pose
            middle, axes = np.array(pose.position), np.array(pose.axes)
        else:
            for vertex, radius, ratio in ((element.z, 90.0, 1.0 / 1.5), (element.z + 6.0, -90.0, 1.5)):
                o, d = through_sphere(o, d, vertex, radius, ratio)
    o = o + d * ((middle[:, None] - o) * axes[2][:, None]).sum(0) / (axes[2] @ d)
    return axes[:2] @ (o - middle[:, None]) - np.array(screen.shift)[:, None]


def error(scene: Scene, values: torch.Tensor, wanted: np.ndarray, across: tuple[int, int] = ACROSS) -> float:
    """Relative RMS error of the image by integrated rays."""
    *rays, power = integrated(scene, values, across)
    edges = [np.linspace(-h, h, n + 1) for h, n in zip(scene.screen.half_size, wanted.shape, strict=True)]
    image = np.histogram2d(*landed(scene, *rays), bins=edges, weights=power)[0]
    return float(np.sqrt(np.mean((image / image.mean() - wanted / wanted.mean()) ** 2)))


@pytest.mark.parametrize("name", SCENES)
def test_the_start_throws_the_picture_by_rays_integrated_apart(name):
    """Upright and unmirrored, from any light and through any elements: the mirrored picture would have three times the error."""
    scene = SCENES[name]
    found = error(scene, started(scene), picture())
    other = picture()[::-1]
    assert found < 0.14
    assert np.sqrt(np.mean((other - picture()) ** 2)) / picture().mean() > 3.0 * 0.14


@pytest.mark.parametrize("name", SCENES)
def test_rays_are_those_of_the_ray_equation(name):
    """Landing points by the tracer that designs, to a thousandth of a pixel, in an index with layers."""
    scene = SCENES[name]
    values = started(scene, 5)
    *rays, power = integrated(scene, values, across=(12, 12))
    graded = with_index(scene, torch.full_like(values, scene.lens.index))  # the index is a parameter of the trace
    at, p, _ = entering(scene, (12, 12))
    d = np.stack([*p, np.sqrt(1.0 - (p * p).sum(0))])
    o = np.stack([*at, np.zeros(at.shape[1])]) - 0.5 * d
    begun = RayState(*(tuple(torch.from_numpy(c.copy()) for c in v) for v in (o, d)), torch.ones(at.shape[1], dtype=torch.float64))
    field = HeightField.of(graded.lens)
    flat = torch.full(field.shape, THICK, dtype=torch.float64)
    (state,) = Tracer(System.of(graded, field), begun).land({EXIT: flat, INDEX: values}, scene.screen)
    on = (state.power.numpy() > 0) & (power > 0)
    assert on.sum() > 100
    found = np.stack([c.numpy() for c in state.origin[:2]]) - np.array(scene.screen.shift)[:, None]
    apart = np.abs(found - landed(scene, *rays))[:, on]
    assert apart.max() < 1e-3 * min(scene.screen.pixel)


def test_layers_follow_inclined_light():
    """One layer smears what is finer than the way of the light is wide; light along the axis needs no more than one."""
    scene, control = SCENES["tilted light"], (9, 59)
    scene = replace(scene, screen=replace(scene.screen, resolution=(4, 24)))
    stripes = np.tile(1.0 + 0.9 * np.sin(0.5 * np.pi * (np.arange(24) + 0.5)), (4, 1))
    layers = layers_along(scene, control)
    one, followed = (error(scene, started(scene, n, stripes, control), stripes, (12, 432)) for n in (1, layers))
    assert layers > 3
    assert one > 1.4 * followed
    assert layers_along(PLAIN, control) == layers_along(SCENES["far field"], control) == 1
    assert layers_along(replace(scene, lens=replace(scene.lens, offset=Offset(0.2))), control) == 1


def test_every_colour_is_bent_by_its_own_index():
    """In glass the whole distribution is scaled by the ratio of its Sellmeier indices, and so is what rays meet on the way."""
    scene = replace(PLAIN, lens=replace(PLAIN.lens, index=1.5187, glass="N-BK7"), light=Light(wavelengths=(464.0,)))
    values = started(scene)
    graded = with_index(scene, values)
    field = HeightField.of(graded.lens)
    flat = torch.full(field.shape, THICK, dtype=torch.float64)

    def dispersive(w: float) -> float:
        square = (w / 1000.0) ** 2
        terms = ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653))
        return float(np.sqrt(1.0 + sum(b * square / (square - c) for b, c in terms)))

    at, p, _ = entering(scene, (12, 12))
    o = (*at, np.full(at.shape[1], -0.5))
    d = (*p, np.ones(at.shape[1]))
    begun = RayState(
        *(tuple(torch.from_numpy(np.array(c)) for c in v) for v in (o, d)), torch.ones(at.shape[1], dtype=torch.float64)
    )
    (state,) = Tracer(System.of(graded, field), begun, wavelength=464.0).land({EXIT: flat}, scene.screen)
    *rays, power = integrated(scene, values * (dispersive(464.0) / scene.lens.index), (12, 12))
    on = (state.power.numpy() > 0) & (power > 0)
    apart = np.abs(np.stack([c.numpy() for c in state.origin[:2]]) - landed(scene, *rays))[:, on]
    assert on.sum() > 100
    assert apart.max() < 1e-3 * min(scene.screen.pixel)


# on the command line

TINY = ("--gradient", "free", "--resolution", "24", "--threads", "1", "--quiet", "--index-control", "27")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()


def run(capfd, *arguments: str) -> dict:
    """The JSON of a command."""
    status = cli.run([*arguments, "--json"])
    out, err = capfd.readouterr()
    assert status == 0, err
    return json.loads(out)


@pytest.mark.parametrize(
    "options",
    [
        ("--throw", "inf"),
        ("--source", "disc", "--source-angle", "0.3"),
        ("--source-tilt", "15,0", "--movie", "m.gif"),
        (
            "--with-surface",
            "--control",
            "30",
            "--source",
            "point",
            "--source-position",
            "1,0,-100",
            "--element",
            "mirror z=100 tilt=45,0",
        ),
    ],
    ids=["far field", "extended source", "tilted", "near source and surface, folded"],
)
def test_four_iterations_are_two_and_two_bitwise(here, capfd, options):
    figures = run(capfd, "design", "blob.png", *TINY, *options, "--iterations", "4", "-o", "whole")
    assert figures["relative_rms"] < 0.2
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    if "--movie" in options:
        with Image.open("m.gif") as movie:
            assert movie.n_frames > 2
        options = options[:-2]
    run(capfd, "design", "blob.png", *TINY, *options, "--iterations", "2", "-o", "parts")
    run(capfd, "design", "--resume", "parts", "--iterations", "4", "--quiet", "--threads", "1")
    assert Path("whole/index.npy").read_bytes() == Path("parts/index.npy").read_bytes()
    assert torch.equal(load("whole").heights, load("parts").heights)
    again = run(capfd, "render", "parts", "--rays", "40000", "--quiet", "--threads", "1")
    assert again["relative_rms"] == pytest.approx(figures["relative_rms"], abs=0.03)


def test_a_picture_in_colour_is_designed(here, capfd):
    """By light of three wavelengths that the glass spreads: all have the picture's shape."""
    with Image.open("blob.png") as grey:
        Image.merge("RGB", [grey.convert("L")] * 3).save("rgb.png")
    figures = run(
        capfd, "design", "rgb.png", "--color", "--glass", "N-BK7", *TINY, "--iterations", "3", "-o", "colour", "--movie", "m.gif"
    )
    with Image.open("m.gif") as movie:
        assert movie.n_frames > 2
    assert figures["relative_rms"] < 0.2 and figures["ciede2000"] < 10.0
    lens = load("colour")
    seen = expose(lens.scene, lens.field, lens.heights, rays_of(lens.scene, "grid", 20_000)).image
    assert seen.shape == (3, 24, 24)
    assert np.load("colour/index.npy").shape == (27, 27, 1)


def test_a_robust_index_is_judged_with_its_errors(here, capfd):
    """The loss of the design: that of the lens and of lenses with errors of index and thickness, made by hand; and its gradient."""
    Path("errors.toml").write_text("[index]\nsigma = 0.004\n[thickness]\nsigma = 0.1\n[throw]\nhalf_width = 5.0\n")
    options = ("--quality", "draft", "--robust", "errors.toml", "--iterations", "2")
    figures = run(capfd, "design", "blob.png", *TINY, *options, "-o", "robust")
    assert figures["relative_rms"] < 0.3
    problem = problem_of(load("robust").project)
    assert isinstance(problem, RobustPlate)
    values = torch.from_numpy(np.load("robust/index.npy"))
    mixture = problem.objective_of(problem.scene)
    flat = torch.full((4, 4), THICK, dtype=torch.float64)
    found = mixture.evaluate({EXIT: flat, INDEX: values})
    losses = []
    for member in mixture.members:
        scene, by = member.objective.objective.scene, member.objective.by
        exact = with_index(scene, values + by)
        objective = IndexPlate.objective_of(problem, exact)
        losses.append(objective.evaluate({EXIT: flat + member.added, INDEX: values + by}).loss)
    assert len({m.objective.by for m in mixture.members}) == 5
    weights = np.array([0.9, *[0.025] * 4])
    assert found.loss == pytest.approx(float(np.sqrt(weights @ np.square(losses))), rel=1e-9)
    x = torch.linspace(0.0, 1.0, 27, dtype=torch.float64)
    way = 1e-3 * torch.outer(torch.sin(3.0 * x), torch.cos(4.0 * x))[:, :, None]
    ahead, back = (mixture.evaluate({EXIT: flat, INDEX: values + h * way}).loss for h in (1e-4, -1e-4))
    assert (ahead - back) / 2e-4 == pytest.approx(float((found.gradients[INDEX] * way).sum()), rel=1e-4)
