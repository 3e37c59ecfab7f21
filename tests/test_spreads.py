"""Designs for several sources by convolution: the image of all against rays drawn from all, kernels, and what has none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.inverse.objective import Objective, SourceBlur
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.source_limits import best_irradiance, source_spread
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.spread import point_source
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.project.project import Project
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies.metrics import relative_rms

NONE = ((), ())
LENS = Lens((2.0, 2.0), control=(19, 19), offset=Offset(1.5, (90.0, 90.0)), height_range=(-0.3, 0.3), min_thickness=0.5)


def together(*members, spectra=None):
    return Several(members, spectra or (NONE,) * len(members))


CHIP = np.outer([3.0, 1.0, 0.0], [1.0, 2.0, 0.0, 1.0])
#: Sources that act as one: dies side by side, of one power or not; a core in a halo; points; the sun around a laser.
SOURCES = {
    "dies": together(Disc((0.9, 0.2, -80.0), (1.0, 1.4), 1.0), Disc((-0.7, 0.0, -80.0), (0.8, 0.8), 2.5, brightness=CHIP)),
    "halo": together(Disc(angle=1.6), Disc(angle=0.5, power=0.5)),
    "points": together(Points(((0.8, 0.0, -80.0),)), Points(((-0.8, 0.3, -80.0),), (0.5,)), Points(((0.0, -0.6, -80.0),))),
    "points of one source": Points(((0.8, 0.0, -80.0), (-0.8, 0.3, -80.0)), (1.0, 0.5)),
    "sun and wave": together(Disc(angle=1.5), PlaneWave(0.3)),
}


def scene_of(source):
    return Scene(source, LENS, Screen((8.0, 8.0), 60.0, (32, 32)))


def heights_of(scene, relief=2e-3):
    x, y = HeightField.of(scene.lens).control_xy()
    sag = torch.from_numpy(LENS.offset.sag(x[:, None].numpy(), y[None, :].numpy()))
    return LENS.offset.thickness + sag + relief * torch.cos(3.0 * x)[:, None] * torch.cos(2.0 * y + 0.4)[None, :]


def disc_on(pixels, radius=0.6):
    x = np.linspace(-1.0, 1.0, pixels)
    return (np.hypot(x[:, None], x[None, :]) < radius).astype(float)


@pytest.mark.parametrize("kind", SOURCES)
def test_objective_sees_the_images_of_all_sources(kind):
    """On regular rays of their centres, each spread, the loss is that of very many rays drawn from all; its gradient is right."""
    scene = scene_of(SOURCES[kind])
    field, heights = HeightField.of(scene.lens), heights_of(scene)
    traced, rays, kernels = source_spread(scene, field, heights).rays(scene, "grid", 200_000, 4, 0, "cpu")
    assert len(rays) == len(kernels) > 1
    target, how = torch.from_numpy(disc_on(32)), LossImage(Filter("cosine", (3, 3)), filter_target=False, oversample=4)
    made = Objective(traced, field, rays, target, "rms", how, dtype=torch.float64, blur=SourceBlur(kernels))
    drawn = Objective(scene, field, rays_of(scene, "sobol", 1 << 18), target, "rms", how, dtype=torch.float64)(heights)
    found = made(heights)
    assert found.loss == pytest.approx(drawn.loss, rel=0.02) and found.on_screen == pytest.approx(drawn.on_screen, rel=0.005)
    assert relative_rms(found.image, drawn.image) < 0.03
    along = torch.randn(heights.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    step = 1e-7
    slope = (made(heights + step * along).loss - made(heights - step * along).loss) / (2 * step)
    assert float((found.gradient * along).sum()) == pytest.approx(slope, rel=2e-3)


@pytest.mark.parametrize("kind", SOURCES)
def test_the_kernel_of_all_is_the_image_of_all(kind):
    """The image of a point between them, convolved, is that of very many rays drawn from all."""
    scene = scene_of(SOURCES[kind])
    field, heights = HeightField.of(scene.lens), heights_of(scene)
    kernel = source_spread(scene, field, heights).on(scene.screen.pixel, 4)
    assert float(kernel.kernel.sum()) == pytest.approx(1.0) and float(kernel.kernel.min()) >= 0.0
    point = replace(scene, source=point_source(scene))
    own = scene.screen.grown(tuple(n // kernel.cut for n in kernel.beside))
    cells = replace(own, resolution=tuple(n * kernel.cut for n in own.resolution))
    found = kernel(expose(point.onto(cells), field, heights, rays_of(point, "grid", 1 << 18)).image)
    drawn = expose(scene, field, heights, rays_of(scene, "sobol", 1 << 18)).image
    sharp = expose(point, field, heights, rays_of(point, "grid", 1 << 18)).image
    error = relative_rms(found / found.sum(), drawn / drawn.sum())
    assert error < 0.12 and relative_rms(sharp / sharp.sum(), drawn / drawn.sum()) > 2.0 * error


def test_each_wavelength_is_of_its_source():
    """A red and a blue die behind glass that disperses: rays of their centres land where those of each do, and with the wavelengths
    exchanged they do not."""
    colours = ((650.0,), (1.0,)), ((450.0,), (1.0,))
    dies = Disc((0.9, 0.0, -80.0), (0.5, 0.5)), Disc((-0.9, 0.0, -80.0), (0.5, 0.5))
    lens = replace(LENS, glass="N-SF11", index=1.7847, offset=Offset(1.5, (30.0, 30.0)))
    target, how = torch.ones(32, 32, dtype=torch.float64), LossImage(Filter("cosine", (3, 3)), filter_target=False, oversample=4)

    def of(spectra):
        scene = replace(scene_of(together(*dies, spectra=spectra)), lens=lens)
        return replace(scene, light=replace(scene.light, wavelengths=(650.0, 450.0), weights=(1.0, 1.0)))

    scene, exchanged = of(colours), of(colours[::-1])
    field, heights = HeightField.of(lens), lens.offset.thickness + heights_of(scene) - LENS.offset.thickness
    traced, rays, kernels = source_spread(scene, field, heights).rays(scene, "grid", 100_000, 4, 0, "cpu")
    made = Objective(traced, field, rays, target, "rms", how, dtype=torch.float64, blur=SourceBlur(kernels))(heights)
    drawn, other = (
        Objective(one, field, rays_of(one, "sobol", 1 << 18), target, "rms", how, dtype=torch.float64)(heights)
        for one in (scene, exchanged)
    )
    off = relative_rms(made.image, drawn.image)
    assert off < 0.03 and off < 0.5 * relative_rms(made.image, other.image)


def test_sources_at_several_distances_have_no_kernel():
    """A near and a distant one, near ones at two distances, each behind its lenslet, or images wider apart than the screen."""
    die = Disc((0.5, 0.0, -80.0))
    for source in (
        together(die, PlaneWave()),
        together(die, Disc((0.5, 0.0, -40.0))),
        replace(together(die, Disc((-0.5, 0.0, -80.0))), behind=True),
        together(Disc((14.0, 0.0, -80.0)), Disc((-14.0, 0.0, -80.0))),
        together(PlaneWave(), PlaneWave(2.0)),
    ):
        assert source_spread(scene_of(source)) is None
    assert source_spread(scene_of(together(die, Disc((-0.5, 0.0, -80.0))))) is not None


def test_a_design_for_several_sources_comes_close_to_the_best_light(tmp_path, monkeypatch, capfd):
    """By transport and regular rays, at a small size; the least error is that of the deconvolution by their kernel."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=200000")
    Image.fromarray((disc_on(32, 0.7) * 255).astype(np.uint8)).save("blob.png")
    Path("two.toml").write_text(
        "".join(f'[[source]]\ntype = "disc"\nposition = [{x}, 0.0, -100.0]\nsize = [0.5, 0.5]\n' for x in (0.4, -0.4))
    )
    size = ["--lens-size", "2", "--throw", "60", "--mag", "2", "--resolution", "32", "--quiet", "--threads", "1"]
    assert cli.run(["design", "blob.png", "--config", "two.toml", *size, "--json", "--waves", "off"]) == 0
    found = json.loads(capfd.readouterr().out)
    design = settings.read(Path("blob.caustic/project.toml"))["design"]
    assert design["start"] == "transport" and all(stage["spread"] for stage in design["stages"])
    project = Project.open("blob.caustic")
    scene = project.scene()
    best = best_irradiance(scene, project.target(scene), source_spread(scene), 300)
    assert found["relative_rms"] < 1.25 * best.error + 0.02
