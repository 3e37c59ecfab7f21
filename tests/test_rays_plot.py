"""The plot of rays: vertices obey Snell's law and lie on the surfaces and the screen, and no ray is lost from the count."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Disc, Lens, Light, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.elements import FoldMirror
from caustic_cli.studies.rays_plot import MOST, OFF_SCREEN, check_count, seen_across, trace_paths, write_plot

INDEX = 1.5
LENS = Lens((10.0, 8.0), control=(9, 8), index=INDEX, offset=Offset(4.0, (30.0, 30.0)))
SCREEN = Screen((12.0, 12.0), 80.0, (12, 12))
SOURCES = {"plane": PlaneWave(), "point": Points(((1.0, -0.5, -20.0),)), "disc": Disc((0.0, 0.0, -30.0))}


def bulged() -> torch.Tensor:
    """Control heights of a lens whose exit is no plane."""
    x, y = HeightField.of(LENS).control_xy()
    return 4.0 + 0.01 * x[:, None] ** 2 - 0.02 * y[None, :] ** 2 + 0.05 * x[:, None]


def paths_of(count: int = 150, **changes):
    scene = replace(Scene(PlaneWave(), LENS, SCREEN), **changes)
    return trace_paths(scene, HeightField.of(scene.lens), bulged(), count, 3)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@pytest.mark.parametrize("name", SOURCES)
def test_vertices_lie_on_the_surfaces_and_bend_by_snells_law(name):
    """The tangential component of n d is continuous at both surfaces, with a normal by finite differences of the heights."""
    paths = paths_of(source=SOURCES[name])
    whole = paths.vertices[np.isin(paths.status, (0, OFF_SCREEN))]
    assert len(paths.status) == 150 and len(whole) > 50 and np.isfinite(paths.vertices).all()
    start, front, back, end = (whole[:, k] for k in range(4))
    field, z = HeightField.of(LENS), bulged()
    height = lambda x, y: field.at(z, torch.from_numpy(x), torch.from_numpy(y), ((0, 0),))[0].numpy()  # noqa: E731
    x, y, h = back[:, 0], back[:, 1], 1e-5
    inner = (np.abs(x) < 4.99) & (np.abs(y) < 3.99)
    x, y = x[inner], y[inner]
    assert np.abs(front[:, 2]).max() < 1e-12 and np.abs(end[:, 2] - 80.0).max() < 1e-9
    assert np.abs(back[inner, 2] - height(x, y)).max() < 1e-9
    slopes = [(height(x + h, y) - height(x - h, y)) / (2 * h), (height(x, y + h) - height(x, y - h)) / (2 * h)]
    before, inside, after = unit(front - start)[inner], unit(back - front)[inner], unit(end - back)[inner]
    flat, curved = np.array([[0.0, 0.0, 1.0]]), unit(np.stack([-slopes[0], -slopes[1], np.ones_like(x)], 1))
    for bend, normal in ((INDEX * inside - before, flat), (after - INDEX * inside, curved)):
        assert np.abs(np.cross(bend, normal)).max() < 1e-8
    assert np.abs(np.cross(INDEX * inside - after, flat)).max() > 1e-3  # another normal fails


def test_rays_of_a_point_start_there():
    paths = paths_of(source=SOURCES["point"])
    np.testing.assert_allclose(paths.vertices[:, 0], np.tile([1.0, -0.5, -20.0], (150, 1)), atol=1e-9)


def test_every_ray_is_counted_once_by_how_it_is_lost():
    figures = paths_of(200, source=SOURCES["point"]).figures
    assert (
        figures["rays"] == 200 and figures["lost"] == sum(figures["lost_by"].values()) and set(figures["lost_by"]) >= {"off_screen"}
    )
    assert paths_of(200, source=SOURCES["point"], screen=replace(SCREEN, size=(300.0, 300.0))).figures["lost"] < figures["lost"]
    aside = paths_of(60, screen=replace(SCREEN, shift=(100.0, 0.0)))
    assert aside.figures == {"rays": 60, "lost": 60, "lost_by": {"off_screen": 60}}
    steep = replace(LENS, index=5.0)
    totally = trace_paths(Scene(PlaneWave(), steep, SCREEN), HeightField.of(steep), 4 * bulged() - 12.0, 60)
    lost = totally.status == 1
    assert lost.any() and (totally.vertices[lost, -1] == totally.vertices[lost, -2]).all()


def test_rays_that_leave_by_the_sides_are_drawn_beside_the_exit():
    paths = paths_of(200, source=SOURCES["point"])
    ends = paths.vertices[paths.status == 3, -1]
    assert len(ends) > 10 and np.abs(ends[:, 2] - 4.0).max() < 1.0
    assert ((np.abs(ends[:, 0]) > 4.5) | (np.abs(ends[:, 1]) > 3.5)).all()


def test_rays_end_on_a_tilted_screen_and_on_a_curved_one():
    """Its plane is turned about x; the sphere's sag is r - sqrt(r^2 - x^2 - y^2)."""
    tilted = paths_of(screen=replace(SCREEN, tilt=(30.0, 0.0))).vertices[:, -1]
    across = (tilted[:, 2] - 80.0) * np.cos(np.radians(30.0)) - tilted[:, 1] * np.sin(np.radians(30.0))
    assert np.abs(across).max() < 1e-9 and np.ptp(tilted[:, 2]) > 1.0
    sphere = paths_of(screen=replace(SCREEN, radius=(40.0, 40.0))).vertices[:, -1]
    assert np.abs(np.hypot(np.hypot(sphere[:, 0], sphere[:, 1]), sphere[:, 2] - 120.0) - 40.0).max() < 1e-6


def test_a_mirror_folds_them_and_wavelengths_share_the_number():
    folded = paths_of(elements=(FoldMirror(40.0, (60.0, 60.0), tilt=(45.0, 0.0)),))
    assert folded.vertices.shape == (150, 5, 3) and np.ptp(folded.vertices[:, -1, 1]) < 1e-9  # the screen is across y
    assert len(paths_of(99, light=Light(wavelengths=(450.0, 550.0, 650.0))).status) == 99


@pytest.mark.parametrize("count", [0, -3, MOST + 1])
def test_a_number_that_cannot_be_drawn_is_refused(count):
    with pytest.raises(InputError, match=f"1 to {MOST} rays, got {count}"):
        check_count(count)


def test_the_plot_shows_arrived_and_lost_rays(tmp_path):
    write_plot(tmp_path / "one.png", paths_of(1, screen=replace(SCREEN, shift=(100.0, 0.0))))
    write_plot(tmp_path / "a.png", paths_of(40, screen=replace(SCREEN, shift=(2.0, 0.0), size=(6.0, 6.0))))
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    difference = pixels[..., 0] - pixels[..., 2]  # red less blue
    assert len(pixels) == 720 and (difference > 30).sum() > 100 and (difference < -30).sum() > 100


def test_the_command_writes_it_beside_the_image(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_lighttools("lens.npz", Scene(PlaneWave(), LENS, SCREEN), HeightField.of(LENS), bulged())
    asked = ["render", "lens.npz", "--rays", "2000", "--effects", "fresnel", "--quiet", "--json", "-o", "a.png"]
    assert cli.run([*asked, "--rays-plot", "50"]) == 0
    said = json.loads(capfd.readouterr().out)["rays_plot"]
    assert said["rays"] == 50 and said["image"] == "a-rays.png" and Path("a-rays.png").stat().st_size > 10_000
    assert cli.run([*asked[:-1], "b.png", "--rays-plot", "2001"]) == 2 and "--rays-plot must be 1 to 2000" in capfd.readouterr().err
    assert not Path("b.png").exists()
    Path("c-rays.png").write_bytes(b"not of this program")
    assert cli.run([*asked[:-1], "c.png", "--rays-plot", "5"]) == 2 and Path("c-rays.png").read_bytes() == b"not of this program"


def test_rays_that_a_mirror_folds_along_x_are_seen_from_above():
    assert seen_across(paths_of()) == 1
    assert [seen_across(paths_of(elements=(FoldMirror(40.0, (60.0, 60.0), tilt=t),))) for t in ((45.0, 0.0), (0.0, 45.0))] == [1, 0]


def test_a_plot_of_many_rays_shows_where_light_is_dense(tmp_path):
    """The side view before the lens keeps its paper between the rays: 625 of them do not make one opaque block."""
    write_plot(tmp_path / "many.png", paths_of(625))
    pixels = np.asarray(Image.open(tmp_path / "many.png").convert("RGB")).astype(int)[40:310, 100:770]
    blue = pixels[(pixels[..., 2] - pixels[..., 0]) > 8]
    assert len(blue) > 2000 and len(np.unique(blue[:, 0])) > 30 and np.percentile(blue[:, 0], 50) > 0x3A + 20


def test_the_plot_of_a_gradient_index_lens_an_array_and_several_lenses(tmp_path, monkeypatch, capfd):
    """From designs: every ray is drawn, with two vertices on each lens; files of another program stay unless forced."""
    monkeypatch.chdir(tmp_path)
    picture = np.zeros((16, 16), np.uint8)
    picture[4:12, 4:12] = 255
    Image.fromarray(picture).save("square.png")
    kinds = {
        "graded": (["--gradient", "radial", "--gradient-terms=-1e-3"], 4),
        "array": (["--array", "2x2"], 4),
        "mirror": (["--mirror"], 3),
        "several": (["--element", "lens z=-20 thickness=4 radius=150,inf glass=N-BK7"], 6),
    }
    small = ["--resolution", "16", "--waves", "off", "--iterations", "1", "--quality", "draft", "--quiet"]
    for name, (more, vertices) in kinds.items():
        assert cli.run(["design", "square.png", *small, *more, "-o", f"{name}.caustic"]) == 0
        lens = load(f"{name}.caustic")
        assert trace_paths(lens.scene, lens.field, lens.heights, 40).vertices.shape == (40, vertices, 3)
        capfd.readouterr()
        asked = ["render", f"{name}.caustic", "--rays", "2000", "--rays-plot", "40", "--quiet", "--json"]
        assert cli.run(asked) == 0 and json.loads(capfd.readouterr().out)["rays_plot"]["rays"] == 40
    plot = Path("mirror.caustic/rays.png")
    own = plot.read_bytes()
    plot.write_bytes(b"not of this program")
    asked = ["render", "mirror.caustic", "--rays", "2000", "--rays-plot", "40", "--quiet"]
    assert cli.run(asked) == 2 and plot.read_bytes() == b"not of this program"
    assert cli.run([*asked, "--force"]) == 0 and plot.read_bytes() == own
