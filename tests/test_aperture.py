"""Round lenses, borders, lenses and pictures that are not square: light, design, render, export."""

import importlib.util
import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from test_export import make, signed_volume
from test_verify import NAMES, SOURCES, scene_with

from caustic_cli import cli
from caustic_cli.errors import CausticError, InputError
from caustic_cli.export.lattice import LATTICES
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mesh import FLANGE, closed_mesh, rim_of
from caustic_cli.export.mitsuba import companions, write_mitsuba
from caustic_cli.export.supported import SCRIPT
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.rays import RayStatus
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Aperture, CircularAperture, Lens, PlaneWave, Points, Pupil, Scene
from caustic_cli.studies import verify


def rounded(made, border: float = 0.0):
    """The same lens, square and cut round."""
    scene, field, heights = made
    return replace(scene, lens=replace(scene.lens, aperture="circle", border=border)), field, heights


def round_with(source):
    """A round lens of 8 mm under a source."""
    scene, _, _ = scene_with(source)
    made, field, heights = make(control=(9, 9), size=(8.0, 8.0), relief=0.004)
    return rounded((Scene(source, made.lens, scene.screen), field, heights))


# the scene


@pytest.mark.parametrize("change", [{"aperture": "oval"}, {"aperture": "circle", "size": (10.0, 8.0)}, {"border": -1.0}])
def test_bad_outlines_are_refused(change):
    with pytest.raises(InputError, match=r"\[lens\]"):
        Lens(**change)


def test_a_cone_that_covers_a_circle():
    source = Points(((3.0, 4.0, -20.0),))
    assert np.tan(source.cone_over(Pupil(CircularAperture((6.0, 6.0)), 0.0))) * 20 == pytest.approx(5 + 6)
    assert np.tan(source.cone_over(Pupil(Aperture((6.0, 6.0)), 0.0))) * 20 == pytest.approx(np.hypot(9, 10))


# light


@pytest.mark.parametrize("source", SOURCES, ids=NAMES)
def test_no_light_beyond_the_circle_and_the_energy_balance_closes(source, kernels):
    scene, field, heights = round_with(source)
    fluxes = 0.0
    for rays in rays_of(scene, "stratified", 20_000).chunks(7000):
        if isinstance(rays, Sample):
            x, y = ((2 * c - 1) * r for c, r in zip((rays.u, rays.v), field.half_size, strict=True))
            power = rays.flux.expand(x.shape)
        else:
            (x, y, _), power = rays.origin, rays.power
            (hits,) = Tracer(System.of(scene, field), rays, track=True).land({EXIT: heights}, scene.screen)
            beyond = hits.statuses() == RayStatus.MISSED_SURFACE
            assert not float(hits.power[beyond].abs().sum()) > 0
        fluxes += float(power.sum())
        assert not float(power[x * x + y * y > 16.0].sum()) > 0
    assert 0.2 < fluxes <= 1 + 1e-12
    out = expose(scene, field, heights, rays_of(scene, "stratified", 20_000))
    assert float(out.image.sum()) + sum(out.lost.values()) == pytest.approx(1, abs=1e-12)
    square = replace(scene, lens=replace(scene.lens, aperture="rectangle"))
    whole = expose(square, field, heights, rays_of(square, "stratified", 20_000))
    assert not torch.allclose(out.image, whole.image, atol=1e-4)


@pytest.mark.parametrize("sampler", ["grid", "lines", "stratified", "uniform", "sobol"])
def test_a_round_plane_wave_is_the_square_one_where_both_shine(sampler):
    """Each ray carries 4 / pi times as much, because the power is that through the aperture."""
    scene, field, heights = make(control=(9, 9), size=(8.0, 8.0))
    part = 0.0
    disc, _, _ = rounded((scene, field, heights))
    for one, two in zip(rays_of(disc, sampler, 40_000).chunks(), rays_of(scene, sampler, 40_000).chunks(), strict=True):
        fluxes, all_ = one.flux.expand(one.shape), two.flux.expand(two.shape)
        lit = fluxes > 0
        part += float(lit.double().mean())
        torch.testing.assert_close(
            fluxes[lit].mean() / all_[lit].mean(), torch.tensor(4 / np.pi, dtype=torch.float64), atol=2e-2, rtol=0
        )
    assert part == pytest.approx(np.pi / 4, abs=1e-2)


@pytest.mark.parametrize("source", SOURCES[2:5], ids=NAMES[2:5])
def test_rays_that_leave_by_a_round_side_are_lost(source):
    """The fused kernels and the plain-torch reference agree, and both lose more than the square lens there."""
    scene, field, heights = round_with(source)
    out = {}
    for name in ("fused", "torch"):
        with pytest.MonkeyPatch.context() as patch_:
            patch_.setenv("CAUSTIC_KERNELS", "" if name == "fused" else "torch")
            out[name] = expose(scene, field, heights, rays_of(scene, "stratified", 20_000, 3))
    torch.testing.assert_close(out["fused"].image, out["torch"].image, atol=1e-12, rtol=1e-9)
    assert out["fused"].lost["missed_surface"] == pytest.approx(out["torch"].lost["missed_surface"], abs=1e-12)
    assert out["fused"].lost["missed_surface"] > 0.01


def test_gradients_of_a_round_lens(kernels):
    """What lies beyond the circle has none; what lies within has that of differences."""
    scene, field, heights = round_with(SOURCES[2])
    (bundle,) = rays_of(scene, "stratified", 4000, 1).chunks()
    traced = Tracer(System.of(scene, field), bundle)

    def value(net):
        (landed,) = traced.land({EXIT: net}, scene.screen)
        return (landed.power * (landed.origin[0] + 0.3 * landed.origin[1])).sum()

    net = heights.clone().requires_grad_()
    (g,) = torch.autograd.grad(value(net), net)
    assert float(g[0, 0].abs()) < 1e-3 * float(g.abs().max())
    step = torch.zeros_like(heights)
    step[4, 4] = 1e-6
    values = [float(value(heights + step)), float(value(heights - step))]
    assert float(g[4, 4]) == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-3)


def test_transport_to_a_picture_from_a_circle():
    """A disc of light spread over a square: the start alone fills it, and evenly."""
    scene, field, _ = rounded(make(control=(40, 40), size=(8.0, 8.0)))
    target = np.zeros(scene.screen.resolution)
    target[12:52, 10:40] = 1.0
    first = first_surface(scene, target, field, 64).heights
    image = expose(scene, field, first, rays_of(scene, "stratified", 400_000)).image.numpy()
    assert image[12:52, 10:40].sum() / image.sum() > 0.97
    inner = image[15:49, 13:37]
    assert inner.std() / inner.mean() < 0.15


# meshes


@pytest.mark.parametrize("border", [0.0, 1.5])
@pytest.mark.parametrize("aperture", ["rectangle", "circle"])
def test_meshes_with_every_outline_are_closed(aperture, border):
    scene, field, heights = make(size=(8.0, 8.0) if aperture == "circle" else (10.0, 6.0))
    scene = replace(scene, lens=replace(scene.lens, aperture=aperture, border=border))
    vertices, faces = closed_mesh(scene, field, heights, (41, 41))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward, backward = edges[:, 0] * len(vertices) + edges[:, 1], edges[:, 1] * len(vertices) + edges[:, 0]
    assert len(np.unique(forward)) == len(forward) and (np.sort(forward) == np.sort(backward)).all()
    assert len(vertices) - len(edges) // 2 + len(faces) == 2
    rx, ry = scene.lens.half_size
    np.testing.assert_allclose(vertices[:, :2].max(0), (rx + border, ry + border), rtol=1e-12)
    a, b, c = vertices[faces].swapaxes(0, 1)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 2e-6  # twice the area, mm^2
    points = LATTICES[aperture].patch(field, heights, (41, 41)).points
    low = points.reshape(-1, 3)[rim_of(41, 41), 2].min() - scene.lens.z_in
    wide = np.pi * (rx + border) ** 2 if aperture == "circle" else 4 * (rx + border) * (ry + border)
    hole = np.pi * rx**2 if aperture == "circle" else 4 * rx * ry
    lens = closed_mesh(replace(scene, lens=replace(scene.lens, border=0.0)), field, heights, (41, 41))
    flange = signed_volume(vertices[faces]) - signed_volume(lens[0][lens[1]])
    assert flange == pytest.approx(FLANGE * low * (wide - hole), rel=2e-3, abs=1e-9)


def test_a_round_mesh_lies_on_the_surface():
    _, field, heights = rounded(make(size=(8.0, 8.0)))
    p = LATTICES["circle"].patch(field, heights, (33, 33))
    x, y, z = p.points.reshape(-1, 3).T
    exact, zx, zy = (t.numpy() for t in field.at(heights, torch.as_tensor(x.copy()), torch.as_tensor(y.copy())))
    assert np.abs(z - exact).max() < 1e-12
    normal = np.stack([-zx, -zy, np.ones_like(zx)], -1)
    np.testing.assert_allclose(p.normals.reshape(-1, 3), normal / np.linalg.norm(normal, axis=1, keepdims=True), atol=1e-12)
    np.testing.assert_allclose(np.hypot(x, y)[rim_of(33, 33)], 4, rtol=1e-12)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_chord_error_of_a_round_mesh(tolerance):
    scene, field, heights = rounded(make(size=(8.0, 8.0)))
    vertices, faces = closed_mesh(scene, field, heights, tolerance=tolerance)
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    corners = corners[area > 1e-9]
    weights = np.random.default_rng(2).dirichlet((1, 1, 1), (4, len(corners)))
    weights[0, :] = 0.5, 0.5, 0.0
    weights[1, :] = 0.5, 0.0, 0.5
    points = np.einsum("wij,ijk->wik", weights, corners).reshape(-1, 3)
    exact = field.at(heights, *torch.as_tensor(points[:, :2].T.copy()), [(0, 0)])[0].numpy()
    error = np.abs(points[:, 2] - exact).max()
    assert 0.05 * tolerance < error <= tolerance


def test_round_tolerance_wants_no_kinks():
    with pytest.raises(InputError, match="kinks"):
        closed_mesh(*rounded(make(size=(8.0, 8.0), degree=(1, 1))), tolerance=1e-3)


def test_scripts_are_for_rectangles():
    with pytest.raises(InputError, match="script"):
        SCRIPT.refuse(rounded(make())[0])


@pytest.mark.parametrize("source", SOURCES, ids=NAMES)
@pytest.mark.parametrize("aperture", ["rectangle", "circle"])
def test_an_archive_holds_the_whole_scene(tmp_path, source, aperture):
    scene, field, heights = round_with(source)
    scene = replace(scene, lens=replace(scene.lens, aperture=aperture, fresnel="schlick"))
    write_lighttools(tmp_path / "lens.npz", scene, field, heights)
    again, field_, net = open_archive(tmp_path / "lens.npz")
    one, two = (expose(s, f, h, rays_of(s, "stratified", 5000, 1)) for s, f, h in ((scene, field, heights), (again, field_, net)))
    torch.testing.assert_close(one.image, two.image, rtol=1e-9, atol=1e-15)
    assert one.lost == pytest.approx(two.lost, abs=1e-12)


# the whole way


@pytest.mark.parametrize("options", ["--lens-size 8 --aperture circle --border 1", "--lens-size 12x8 --border 0.5 --mag 2"])
def test_from_picture_to_files(tmp_path, monkeypatch, capfd, options):
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[0:24, 0:40]
    Image.fromarray((40 + 200 * np.exp(-((x - 14) ** 2 + (y - 9) ** 2) / 60.0)).astype(np.uint8)).save("wide.png")
    text = f"design wide.png --resolution 40 --quality draft --control 35 --rays 30000 --iterations 4 --json --quiet {options}"
    assert cli.run(shlex.split(text)) == 0, capfd.readouterr().err
    figures = json.loads(capfd.readouterr().out)
    assert figures["relative_rms"] < 0.6 and figures["on_screen"] > 0.9
    assert cli.run(shlex.split("render wide.caustic --rays 20000 --report --json --quiet")) == 0
    assert json.loads(capfd.readouterr().out)["on_screen"] == pytest.approx(figures["on_screen"], abs=1e-3)
    for name in ("lighttools", "zemax", "step", "stl", "ply", "obj", "xyz", "mitsuba"):
        assert cli.run(shlex.split(f"export wide.caustic --format {name} --quiet")) == 0, capfd.readouterr().err
    assert len(list(tmp_path.glob("wide-*.ply"))) == (3 if "circle" in options else 2)


# Mitsuba


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("source", SOURCES, ids=NAMES)
def test_mitsuba_agrees_on_round_lenses(tmp_path, source):
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("Mitsuba is not installed")
    scene, field, heights = round_with(source)
    write_mitsuba(tmp_path / "lens.xml", scene, field, heights, (257, 257), dark=True)
    assert all(p.is_file() for p in companions(tmp_path / "lens.xml", scene) if p.suffix == ".ply")
    try:
        decision = verify.verify([tmp_path / "lens.xml"], scene, field, heights, 100_000)
    except CausticError as error:
        pytest.skip(str(error))
    assert decision.agree, decision.figures
    square = replace(scene, lens=replace(scene.lens, aperture="rectangle"))
    if not isinstance(source, PlaneWave):
        assert not verify.verify([tmp_path / "lens.xml"], square, field, heights, 100_000).agree
