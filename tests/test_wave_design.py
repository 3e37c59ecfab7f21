"""Designs on the wave image: the loss and its derivative, the stages, what commands say of it."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import begun
from PIL import Image

from caustic_cli import cli
from caustic_cli.commands.figures import figures_rows
from caustic_cli.config.default_stages import LEAST_WAVES, wave_refinement
from caustic_cli.config.design import build_options, build_stages
from caustic_cli.config.settings import build_scene
from caustic_cli.effort import STANDARD
from caustic_cli.errors import InputError
from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.wave_objective import WaveObjective
from caustic_cli.kinds import OneSurface
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.resolution import Resolution, diffraction_blur, local_magnification
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.project import completion
from caustic_cli.project.new import new_project
from caustic_cli.project.project import Project
from caustic_cli.scene import (
    Component,
    Disc,
    FoldMirror,
    FreeForm,
    Lens,
    Light,
    Offset,
    PlaneWave,
    Points,
    Scene,
    Screen,
    SecondTarget,
)
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.light import WAVE_NODES
from caustic_cli.scene.screen import Sags
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies import diffraction
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.waves import unseen_figures
from caustic_cli.workflow import comparison

SMALL = ["--lens-size", "2", "--throw", "60", "--mag", "2", "--resolution", "32", "--quiet", "--threads", "1"]


def scene_of(source=None, **lens) -> Scene:
    given = {
        "size": (2.0, 2.0),
        "control": (19, 19),
        "offset": Offset(1.5, (16.0, 16.0)),
        "height_range": (-0.3, 0.3),
        "min_thickness": 0.5,
    }
    return Scene(source or PlaneWave(), Lens(**(given | lens)), Screen((5.0, 5.0), 60.0, (32, 32)), lens.pop("light", Light()))


def heights_of(scene: Scene, relief: float = 2e-4) -> torch.Tensor:
    x, y = HeightField.of(scene.lens).control_xy()
    bumps = torch.cos(7.0 * x)[:, None] * torch.cos(5.0 * y + 0.4)[None, :]
    offset = scene.lens.offset
    return offset.thickness + torch.from_numpy(offset.sag(x[:, None].numpy(), y[None, :].numpy())) + relief * bumps


def goal() -> torch.Tensor:
    x = torch.linspace(-1.0, 1.0, 32, dtype=torch.float64)
    return ((x[:, None] ** 2 + x[None, :] ** 2) < 0.5).double()


@pytest.fixture
def _here(tmp_path, monkeypatch):
    """A fresh directory with a picture, and few rays for the decision."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[-1:1:32j, -1:1:32j]
    Image.fromarray(((np.hypot(x, y) < 0.7) * 255).astype(np.uint8)).save("blob.png")


def design(capfd, *arguments, code=0) -> dict | str:
    """Figures of `caustic design`, or what it says."""
    assert cli.run(["design", *map(str, arguments), "--json"]) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


# loss and derivative


SCENES = {
    "plane": scene_of(),
    "point": scene_of(Points(((0.1, 0.0, -80.0),))),
    "disc": scene_of(Disc(angle=0.1)),
    "two sources": scene_of(Several(members=(PlaneWave(), Points(((0.1, 0.0, -80.0),))))),
    "gradient index": scene_of(gradient=Gradient("radial", (-2e-2, 1e-2))),
    "curved screen": replace(scene_of(), screen=Screen((5.0, 5.0), 60.0, (32, 32), radius=(12.0, 12.0))),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
@pytest.mark.parametrize("how", [(), (LossImage(blur=1.0, apron=2), Limits(max_slope=0.01))], ids=["plain", "limits"])
def test_gradient_of_the_loss(scene, how):
    """As central differences say, in float64; a unit of wavelengths at a time or all kept."""
    heights, field = heights_of(scene), HeightField.of(scene.lens)
    made = WaveObjective(scene, field, heights, goal(), "rms-light", *how, wavelengths=(500.0, 600.0), dtype=torch.float64)
    g = torch.Generator().manual_seed(1)
    moved = heights + 2e-5 * torch.randn(heights.shape, generator=g, dtype=torch.float64)
    along = torch.randn(heights.shape, generator=g, dtype=torch.float64)
    found, step = made(moved), 1e-7
    difference = (made(moved + step * along).loss - made(moved - step * along).loss) / (2 * step)
    assert float((found.gradient * along).sum()) == pytest.approx(difference, rel=2e-5)
    assert 0.1 < found.on_screen < 1.0
    made.keeps = not made.keeps
    again = made(moved)
    assert again.loss == pytest.approx(found.loss, rel=1e-12)
    assert torch.allclose(again.gradient, found.gradient, rtol=1e-9, atol=1e-12 * float(found.gradient.abs().max()))


@pytest.mark.parametrize("source", [None, Points(((0.1, 0.0, -80.0),)), Disc(angle=0.1)], ids=["plane", "point", "disc"])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.0, 4.0)])
def test_the_kernels_are_as_accurate_as_single_precision_allows(source, tilt):
    """In float32 the loss and its derivative are computed by kernels, in float64 by plain torch."""
    scene = scene_of(source)
    scene = replace(scene, screen=replace(scene.screen, tilt=tilt))
    heights, field = heights_of(scene), HeightField.of(scene.lens)
    noise = torch.randn(heights.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    single, exact = (
        WaveObjective(scene, field, heights, goal(), "rms-light", wavelengths=(500.0, 600.0), dtype=dtype)(heights + 2e-5 * noise)
        for dtype in (torch.float32, torch.float64)
    )
    assert single.loss == pytest.approx(exact.loss, rel=1e-4)
    assert float((single.gradient - exact.gradient).abs().max()) < 1e-3 * float(exact.gradient.abs().max())


def test_an_image_that_is_computed_whole_is_that_by_blocks(monkeypatch):
    scene = scene_of()
    heights, field = heights_of(scene), HeightField.of(scene.lens)
    whole = wave_image(scene, field, heights).image
    monkeypatch.setattr("caustic_cli.optics.waves.image.WHOLE", 0)
    assert float((wave_image(scene, field, heights).image - whole).abs().max()) < 2e-5 * float(whole.max())


def test_the_path_around_a_lens_is_that_of_the_moved_lens():
    """The loss' own image after a move of 0.1 micrometres against that of an exact trace of the moved lens."""
    scene = scene_of()
    heights, field = heights_of(scene), HeightField.of(scene.lens)
    made = WaveObjective(scene, field, heights, goal(), "rms", wavelengths=(550.0,), dtype=torch.float64)
    g = torch.Generator().manual_seed(2)
    moved = heights + 1e-4 * torch.randn(heights.shape, generator=g, dtype=torch.float64)
    exact = wave_image(scene, field, moved, wavelengths=(550.0,), finer=1.5, dtype=torch.float64).image
    there = wave_image(scene, field, heights, wavelengths=(550.0,), dtype=torch.float64).image
    target = goal()
    loss = relative_rms(exact, target) / target.numel()
    assert made(moved).loss == pytest.approx(loss, rel=5e-3)
    assert relative_rms(exact, there) > 0.05  # the move matters


def test_wavelengths_of_the_scene_are_those_of_the_loss():
    scene = replace(scene_of(glass="N-BK7", index=1.5168), light=Light(None, (450.0, 650.0), (1.0, 3.0)))
    heights, field = heights_of(scene), HeightField.of(scene.lens)
    made = WaveObjective(scene, field, heights, goal(), "rms", wavelengths=(500.0,), dtype=torch.float64)
    assert [(p.line.wavelength, p.line.part) for p in made.parts] == [(450.0, 0.25), (650.0, 0.75)]
    assert made.parts[0].line.system is not made.parts[1].line.system
    image = wave_image(scene, field, heights, finer=1.5, dtype=torch.float64).image
    assert made(heights).loss == pytest.approx(relative_rms(image, goal()) / 1024, rel=5e-3)


def test_the_light_of_several_sources_is_the_sum_of_each():
    """Each at its own spectral lines and power; two sources as one of their powers; and at wavelengths beside their lines."""
    near = Points(((0.1, 0.0, -80.0),), powers=(3.0,))
    spectra = (((450.0,), (1.0,)), ((600.0, 650.0), (1.0, 3.0)))
    both = Light(None, (450.0, 600.0, 650.0), (0.25, 0.1875, 0.5625))
    scene = replace(scene_of(Several(members=(PlaneWave(), near), spectra=spectra)), light=both)
    heights, field, target = heights_of(scene), HeightField.of(scene.lens), goal()
    made = WaveObjective(scene, field, heights, target, "rms", wavelengths=(500.0,), dtype=torch.float64)
    alone = [replace(scene, source=one, light=Light(None, *of)) for one, of in zip((PlaneWave(), near), spectra, strict=True)]
    images = [wave_image(one, field, heights, finer=1.5, dtype=torch.float64).image for one in alone]
    whole = 0.25 * images[0] + 0.75 * images[1]
    assert made(heights).loss == pytest.approx(relative_rms(whole, target) / target.numel(), rel=5e-3)
    found = unseen_figures(scene, field, heights, target.numpy())
    assert found["wave_unseen_wavelengths"] == pytest.approx([445.5, 454.5, 594.0, 606.0, 643.5, 656.5])
    assert found["wave_unseen_relative_rms"] == pytest.approx(relative_rms(whole, target), rel=0.05)
    twice = replace(scene, source=Several(members=(near, near), spectra=(spectra[1],) * 2))
    one, two = (WaveObjective(k, field, heights, target, "rms", dtype=torch.float64)(heights) for k in (alone[1], twice))
    assert two.loss == pytest.approx(one.loss, rel=1e-9) and torch.allclose(two.gradient, one.gradient, rtol=1e-7)


# what is decided


def test_blur_and_details():
    assert diffraction_blur(550.0, 300.0, 3.0) == pytest.approx(0.7036, abs=1e-4)
    seen = Resolution(0.7036, 0.0, 0.12, 30.0, 10.0)
    assert seen.resolvable == 43 and seen.matters
    assert seen.lens_for_all() == pytest.approx(58.6, abs=0.1)
    assert seen.sentence() == (
        "about 43 x 43 details are resolved (diffraction 0.7 mm, source 0 mm, pixel 0.12 mm); a lens of 59 mm would resolve 250"
    )
    assert not Resolution(0.7, 2.8, 0.12, 30.0, 10.0).matters  # the sun washes it out
    assert not Resolution(0.01, 0.0, 0.12, 30.0, 10.0).matters
    assert Resolution(0.01, 0.0, 0.12, 30.0, 10.0).resolvable == 250


def test_local_magnification_is_that_of_the_map():
    """A sphere's, from its radius."""
    scene = scene_of()
    heights = heights_of(scene, 0.0)
    assert local_magnification(scene, HeightField.of(scene.lens), heights) == pytest.approx(1 + 58.5 * 0.5443 / 16.0, rel=0.02)


def test_local_magnification_is_that_wherever_the_lens_stands():
    """Lens, source and screen moved along the axis together."""
    at = Points(((0.0, 0.0, -8.0),))
    here, there = scene_of(at), scene_of(replace(at, positions=((0.0, 0.0, -5.0),)), z_in=3.0, offset=Offset(4.5, (16.0, 16.0)))
    there = replace(there, screen=replace(there.screen, z=here.screen.z + 3.0))
    one, two = (local_magnification(s, HeightField.of(s.lens), heights_of(s, 0.0)) for s in (here, there))
    assert two == pytest.approx(one, rel=1e-9)


@pytest.mark.parametrize(
    ("extra", "stages"),
    [
        ([], True),
        (["--waves", "off"], False),
        (["--resolution", "4"], False),
        (["--resolution", "4", "--waves", "on"], True),
        (["--source-angle", "3"], False),
        (["--network", "sparse"], False),
        (["--screen-tilt", "0,10"], False),
    ],
)
def test_auto_is_by_the_scene(extra, stages, _here, capfd, monkeypatch):
    from caustic_cli.workflow import design as workflow  # noqa: PLC0415

    monkeypatch.setattr(workflow, "_run", begun)
    small = SMALL if "--resolution" not in extra else [a for a in SMALL if a not in ("--resolution", "32")]
    design(capfd, "blob.png", *small, *extra, "-o", "p")
    tables = Project.open("p").settings.design.stages
    assert any(t.waves for t in tables) == stages
    assert not stages or [len(t.waves) for t in tables if t.waves] == [count for count, _ in STANDARD.waves]


OWN = "[[design.stages]]\ncontrol = [19, 19]\nrays = 4096\niterations = 1\n"


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        ([], ""),
        (["--waves", "off"], ""),
        (["--resolution", "4"], ""),
        (["--source-angle", "3"], ""),
        (["--network", "sparse"], "a network is trained on rays alone; --network none refines it"),
        (["--optimizer", "adam"], "adam was asked for, and the wave image takes lbfgs; --waves on adds"),
        (["--screen-tilt", "0,10"], "on a tilted or curved screen it takes many transforms for each wavelength; --waves on"),
        (["--quality", "fine"], "5 iterations on it would take longer than this quality's time; --waves on"),
        (["--config", "own.toml", "--control", "19"], "none of the given [[design.stages]] has waves; one with waves = [550.0]"),
    ],
)
def test_what_is_said_before_a_design(extra, reason, _here, capfd, monkeypatch):
    """One line on what is resolved; one more where the wave image is left out although it matters, of why."""
    from caustic_cli.workflow import design as workflow  # noqa: PLC0415

    monkeypatch.setattr(workflow, "_run", begun)
    if "fine" in extra:
        monkeypatch.setattr("caustic_cli.config.default_stages.SECONDS_A_SAMPLE", 1.0)
    Path("own.toml").write_text(OWN)
    small = [a for a in SMALL if a != "--quiet" and not ("--resolution" in extra and a in ("--resolution", "32"))]
    assert cli.run(["design", "blob.png", *small, *extra, "-o", "p"]) == 0
    said = capfd.readouterr().err.splitlines()
    carried = [k for k, line in enumerate(said) if "details are resolved" in line]
    assert len(carried) == 1 and not any("blurs every point" in line for line in said)
    after = [line for line in said if line.startswith("the wave image is not refined: ")]
    assert after == said[carried[0] + 1 : carried[0] + 2] and reason in after[0] if reason else not after


@pytest.mark.parametrize(
    ("waves", "own", "words"),
    [("on", {}, "none of them has waves"), ("maybe", {}, "auto, on, off"), ("off", {"waves": [550.0]}, "one of them has waves")],
)
def test_waves_and_own_stages_that_contradict_each_other(waves, own, words):
    with pytest.raises(InputError, match=words):
        completion.complete({"design": {"waves": waves, "stages": [{"rays": 100} | own]}}, 1.0)


@pytest.mark.parametrize("text", ["", "0", "nan", "1e9", "-5", "550,", "550:1:2", "550:0", "blue"])
def test_wavelengths_that_are_none(text, _here, capfd):
    message = design(capfd, "blob.png", *SMALL, "--wavelengths", text, code=2)
    assert message.startswith("caustic: --wavelengths must ") and "\n" not in message and not Path("blob.caustic").exists()


def test_a_design_on_waves_alone_has_no_rays_to_compare_others_on():
    full = completion.complete({"lens": {"control": [9, 9]}, "design": {"stages": [{"waves": [550.0]}]}}, 1.0)
    scene = build_scene(full)
    target = torch.ones(scene.screen.resolution, dtype=torch.float64)
    with pytest.raises(InputError, match="one stage on rays is needed"):
        comparison.variants(OneSurface(scene, target, build_stages(full), build_options(full)), full)


def test_time_bounds_the_stages():
    assert tuple(wave_refinement(1e6, 0)) == STANDARD.waves
    fewer = wave_refinement(3e7, 0)
    assert 0 < sum(n for _, n in fewer) < sum(n for _, n in STANDARD.waves) and all(n >= LEAST_WAVES for _, n in fewer)
    assert wave_refinement(1e9, 0) == [] and tuple(wave_refinement(1e9, 0, timed=False)) == STANDARD.waves
    with pytest.raises(InputError, match="waves"):
        completion.complete({"design": {"waves": "perhaps"}}, 1.0)
    with pytest.raises(InputError, match="network none"):
        completion.complete({"design": {"waves": "on", "network": "sparse", "optimizer": "adam"}}, 1.0)


# designs


def test_a_design_for_light(_here, capfd):
    """The wave image at wavelengths the design never used: far better than of a design for rays, with all of the light."""
    rays = design(capfd, "blob.png", *SMALL, "--waves", "off", "-o", "rays")
    assert "wave_relative_rms" not in rays and not Path("rays/wave.png").exists()
    waves = design(capfd, "blob.png", *SMALL, "-o", "waves")
    judged = json.loads(_render(capfd, "rays", "--rays", "40000"))
    assert (rays["error"], rays["error_by"]) == (rays["relative_rms"], "rays") and judged["error_by"] == "rays"
    assert judged["error"] == judged["relative_rms"] == pytest.approx(rays["error"], rel=0.1)  # the same headline
    (name, first), *others = figures_rows(judged)
    assert (name, first.split()[:3]) == ("relative RMS error", [f"{judged['error']:.4f}", "by", "rays,"])
    assert f"relative RMS error {judged['wave_relative_rms']:.4f}" in dict(others)["wave image"]
    asked = json.loads(_render(capfd, "rays", "--effects", "fresnel,diffraction"))  # who asks for waves is told of them
    assert (asked["error"], asked["error_by"]) == (asked["wave_relative_rms"], "waves")
    assert waves["wave_relative_rms"] < 0.6 * judged["wave_relative_rms"]
    assert waves["wave_relative_rms"] < 0.6 * waves["start_wave_relative_rms"]
    assert waves["wave_on_target"] > 0.93 * waves["wave_on_screen"] and waves["resolvable"] <= 32
    assert len(waves["wave_wavelengths"]) == WAVE_NODES and Path("waves/wave.png").exists()
    again = json.loads(_render(capfd, "waves"))
    for one in (waves, again):
        assert (one["error"], one["error_by"]) == (one["wave_relative_rms"], "waves") and one["wave_psnr_db"] > one["psnr_db"]
        rows = figures_rows(one)
        assert rows[0][1].startswith(f"{one['error']:.4f} by waves") and rows[-1][0] == "by rays alone"
        assert f"{one['relative_rms']:.4f}" in rows[-1][1] and "no fault" in rows[-1][1]
        of = dict(rows)
        assert of["PSNR"] == f"{one['wave_psnr_db']:.2f} dB" and of["SSIM"] == f"{one['wave_ssim']:.4f}"
        assert (
            of["light in black"] == f"{one['wave_in_black']:.2%}" and of["light on the picture"] == f"{one['wave_on_target']:.2%}"
        )
        assert of["image"] == "waves/wave.png; by rays waves/render.png"
    assert (
        waves["start_error"] == waves["start_wave_relative_rms"]
        and f"{waves['start_error']:.4f}" in dict(figures_rows(waves))["of the initial surface"]
    )
    assert again["wave_relative_rms"] == pytest.approx(waves["wave_relative_rms"], rel=0.03)
    assert again["wave_image"] == "waves/wave.png" and "relative_rms" in again
    assert cli.run(["render", "waves", "--rays", "4000", "--quiet", "--npy", "ray.npy", "-o", "ray.png"]) == 0
    light = np.load("ray-wave.npy")
    assert light.sum() == pytest.approx(again["wave_on_screen"], abs=1e-6) and Path("ray-wave.png").exists()
    assert again["wave_mean_irradiance"] / again["mean_irradiance"] == pytest.approx(again["wave_on_screen"] / again["on_screen"])
    assert again["wave_peak_irradiance"] == pytest.approx(again["wave_mean_irradiance"] * light.max() / light.mean())
    assert cli.run(["export", "waves", "--format", "lighttools", "-o", "lens.npz", "--quiet"]) == 0
    capfd.readouterr()
    assert cli.run(["render", "lens.npz", "--rays", "4000", "--effects", "diffraction"]) == 0
    assert re.search(r"wave image +on the screen 99", capfd.readouterr().out) and Path("lens-render-wave.png").exists()
    none = json.loads(_render(capfd, "waves", "--effects", "fresnel"))
    assert "wave_relative_rms" not in none and not Path("waves/wave.png").exists() and Path("ray-wave.png").exists()
    design(capfd, "blob.png", *SMALL, "-o", "waves")  # the same again is no work, but what is missing is made
    assert Path("waves/wave.png").exists()


def _render(capfd, project, *options) -> str:
    assert cli.run(["render", project, "--rays", "4000", "--quiet", "--json", *options]) == 0
    return capfd.readouterr().out


def test_resumed_within_a_wave_stage(_here, capfd):
    """Ten and ten iterations are twenty, bitwise, where the wave image is refined from the twelfth on."""
    Path("two.toml").write_text(
        "[lens]\ncontrol = [19, 19]\n[[design.stages]]\ncontrol = [19, 19]\nrays = 4096\niterations = 6\n"
        "[[design.stages]]\ncontrol = [19, 19]\nwaves = [500.0, 600.0]\niterations = 20\n"
    )
    options = [*SMALL, "--config", "two.toml"]
    design(capfd, "blob.png", *options, "--iterations", 16, "-o", "whole")
    design(capfd, "blob.png", *options, "--iterations", 11, "-o", "parts")
    design(capfd, "--resume", "parts", "--iterations", 16, "--quiet", "--threads", 1)
    states = [_state(p) for p in ("whole", "parts")]
    assert torch.equal(states[0].heights, states[1].heights) and states[0].stage == 1
    assert [row[2] for row in states[0].history] == [row[2] for row in states[1].history]
    assert Path("whole/project.toml").read_bytes() == Path("parts/project.toml").read_bytes()


def _state(path: str):
    from caustic_cli.project.project import Project  # noqa: PLC0415

    return Project.open(path).load().state


def test_one_wavelength_is_judged_beside_it_too(_here, capfd):
    figures = design(capfd, "blob.png", *SMALL, "--wavelengths", "550", "-o", "laser")
    assert figures["wave_wavelengths"] == [550.0] and figures["wave_unseen_wavelengths"] == pytest.approx([544.5, 555.5])
    assert figures["wave_relative_rms"] < 1.05 * figures["wave_unseen_relative_rms"]


def test_wavelengths_beside_one_are_those_that_the_glass_is_known_at(_here, capfd):
    """PMMA's formula begins at 437 nm."""
    figures = design(capfd, "blob.png", *SMALL, "--glass", "PMMA", "--wavelengths", "438")
    assert figures["wave_unseen_wavelengths"] == pytest.approx([442.38])


def test_limits_are_kept(_here, capfd):
    figures = design(capfd, "blob.png", *SMALL, "--max-slope", "0.08", "-o", "p")
    from caustic_cli.project.project import Project  # noqa: PLC0415

    project = Project.open("p")
    _, field, _, checkpoint = project.lens(project.scene())
    u = torch.linspace(-0.999, 0.999, 301, dtype=torch.float64)
    x, y = (c.reshape(-1) for c in torch.meshgrid(u, u, indexing="ij"))
    _, gx, gy = field.evaluate(checkpoint.state.heights, x, y)
    assert float(torch.hypot(gx, gy).max()) <= 0.08 * (1 + 1e-3) and figures["wave_relative_rms"] > 0


def test_light_without_a_wave_image(_here, capfd, monkeypatch):
    """Auto does without and says so; on is an error of one line."""

    def refuse(*args, **kwargs):
        raise NoWaveImage("light crosses itself")

    monkeypatch.setattr("caustic_cli.optics.waves.image.wavefront", refuse)
    figures = design(capfd, "blob.png", *SMALL, "-o", "auto")
    assert figures["wave_relative_rms"] is None and figures["reason"] == "no wave image"
    assert json.loads(_render(capfd, "auto"))["no_wave_image"] == "light crosses itself"
    assert design(capfd, "blob.png", *SMALL, "--waves", "on", "-o", "on", code=1) == "caustic: light crosses itself"


def test_a_wave_image_that_takes_long_is_taken_where_it_is_asked_for(_here, capfd, monkeypatch):
    design(capfd, "blob.png", *SMALL, "--waves", "off", "-o", "p")
    monkeypatch.setattr("caustic_cli.studies.waves.UNASKED", 1e6)
    left_out = json.loads(_render(capfd, "p"))
    assert left_out["wave_relative_rms"] is None
    assert "about 0 minutes on two cores; the effect diffraction, requested by name, computes it" in left_out["no_wave_image"]
    assert json.loads(_render(capfd, "p", "--effects", "diffraction"))["wave_relative_rms"] > 0


# the study


def test_study_of_diffraction(monkeypatch):
    """Rays come closer to light for larger lenses, shorter waves and larger sources."""
    monkeypatch.setattr(diffraction, "SIZES", (2.0, 8.0))
    monkeypatch.setattr(diffraction, "WAVELENGTHS", (400.0, 800.0))
    monkeypatch.setattr(diffraction, "ANGLES", (0.0, 0.6))
    scene = scene_of()
    study = diffraction.run_diffraction(scene, HeightField.of(scene.lens), heights_of(scene, 4e-3), rays=400_000)
    rows = {(r["series"], r["value"]): r for r in study.rows}
    assert len(rows) == 6 and all(math.isfinite(r["error"]) and r["seconds"] > 0 for r in study.rows)
    assert rows["lens size", 8.0]["error"] < rows["lens size", 2.0]["error"]
    assert rows["wavelength", 400.0]["error"] < rows["wavelength", 800.0]["error"]
    assert rows["source size", 0.6]["error"] < 0.5 * rows["source size", 0.0]["error"]
    assert "rays are" in study.advice


def test_a_scaled_lens_is_the_same_lens():
    scene = scene_of()
    larger, field, heights = diffraction.scaled(scene, HeightField.of(scene.lens), heights_of(scene), 10.0)
    assert larger.lens.half_size == (10.0, 10.0) and larger.screen.z == 600.0
    assert larger.screen.pixel[0] == pytest.approx(10 * scene.screen.pixel[0])
    before = local_magnification(scene, HeightField.of(scene.lens), heights_of(scene))
    assert local_magnification(larger, field, heights) == pytest.approx(before, rel=1e-9)


SAGS = Sags(0.5 * np.sin(np.arange(30.0)).reshape(6, 5), (5.0, 5.0))
VOLUME = 1.5 + 0.02 * np.sin(np.arange(7.0 * 6 * 4)).reshape(7, 6, 4)


def larger_scenes() -> dict[str, Scene]:
    """Scenes of which everything has to be scaled, by name."""
    scene = scene_of()
    screen = scene.screen
    gradients = (("selfoc", (0.1,)), ("radial", (-5e-3, 1e-4)), ("axial", (0.02, -3e-3)))
    lens = Component(8.0, (6.0, 6.0), 2.0, (20.0, -30.0), absorption=0.02)
    return {
        **{kind: scene_of(gradient=Gradient(kind, terms)) for kind, terms in gradients},
        "volume": scene_of(gradient=Gradient("volume", volume=VOLUME), absorption=0.05),
        "two sides": replace(
            scene_of(entrance=FreeForm(0.02 * np.sin(np.arange(42.0)).reshape(7, 6), (3, 3))), second_target=SecondTarget()
        ),
        "other elements": replace(scene, elements=(lens, FoldMirror(30.0, (9.0, 9.0), tilt=(45.0, 0.0)))),
        "displaced": replace(scene, elements=(lens,), mounting=((0.1, -0.05), (0.5, 0.2))),
        "mirrors alone": replace(scene, elements=(FoldMirror(30.0, (2.5, 2.5), tilt=(45.0, 0.0)),)).unfolded,
        "sphere": replace(scene, screen=replace(screen, radius=(30.0, 30.0), shift=(0.3, -0.1))),
        "measured shape": replace(scene, screen=replace(screen, sags=SAGS)),
        "far field": replace(scene, screen=Screen((80.0, 80.0), 1000.0, (32, 32), far=True)),
    }


@pytest.mark.parametrize("name", larger_scenes())
def test_a_scaled_scene_has_the_same_picture(name):
    scene = larger_scenes()[name]
    heights = heights_of(scene, 4e-3)
    larger = diffraction.scaled(scene, HeightField.of(scene.lens), heights, 7.0)
    before, after = (
        expose(*one, rays_of(one[0], "stratified", 4000, 1), Filter("cosine", (3, 3))).image
        for one in ((scene.onto(scene.screen), HeightField.of(scene.lens), heights), larger)
    )
    assert 0.2 < float(before.sum()) <= 1.0 and float((after - before).norm()) < 1e-7 * float(before.norm())


@pytest.mark.parametrize("name", ["radial", "two sides", "other elements", "far field"])
def test_study_of_diffraction_of_other_lenses(name, monkeypatch):
    monkeypatch.setattr(diffraction, "SIZES", (2.0, 8.0))
    monkeypatch.setattr(diffraction, "WAVELENGTHS", (800.0,))
    monkeypatch.setattr(diffraction, "ANGLES", (0.6,))
    scene = larger_scenes()[name]
    study = diffraction.run_diffraction(scene, HeightField.of(scene.lens), heights_of(scene, 4e-3), rays=400_000)
    small, large, red, wide = (row["error"] for row in study.rows)
    assert large < small < red and wide < small


def test_stages_on_rays_are_left_out_where_the_wave_image_is_refined(_here, capfd, monkeypatch):
    """They are in the project and serve where there turns out to be no wave image; their iterations are not given to others."""
    small = [*SMALL, "--quality", "draft"]
    refined = design(capfd, "blob.png", *small, "-o", "refined")
    stages, history = _stages("refined"), _state("refined").history
    spare = [k for k, stage in enumerate(stages) if stage.spare]
    assert spare == [k for k, stage in enumerate(stages) if not stage.waves] and len(spare) in (1, 2)
    assert {row[1] for row in history} == set(range(len(stages))) - set(spare)
    assert refined["iterations"] <= sum(stage.iterations for stage in stages if stage.waves)

    def crossed(*_, **__):
        raise NoWaveImage("rays cross")

    monkeypatch.setattr("caustic_cli.inverse.wave_objective.WaveObjective", crossed)
    design(capfd, "blob.png", *small, "-o", "rays")
    history = _state("rays").history
    assert {row[1] for row in history} == set(spare) and history[-1][2] < 0.9 * history[0][2]
    with pytest.raises(AssertionError):  # asked for, it is an error
        design(capfd, "blob.png", *small, "--waves", "on", "-o", "asked")


def test_a_design_of_wave_stages_is_resumed_bitwise(_here, capfd):
    """Interrupted in the second stage, which begins with the curvature of the first."""
    options = [*SMALL, "--quality", "standard"]
    design(capfd, "blob.png", *options, "--iterations", 24, "-o", "whole")
    design(capfd, "blob.png", *options, "--iterations", 22, "-o", "parts")
    design(capfd, "--resume", "parts", "--iterations", 24, "--quiet", "--threads", 1)
    whole, parts = _state("whole"), _state("parts")
    assert torch.equal(whole.heights, parts.heights) and whole.stage == parts.stage == len(_stages("whole")) - 1
    assert whole.total == parts.total == 24


def _stages(path: str):
    from caustic_cli.project.project import Project  # noqa: PLC0415

    return Project.open(path).settings.design.stages


@pytest.mark.parametrize("waves, spans", [("auto", 600), ("off", 1277)])
def test_diffraction_needs_no_finer_net(tmp_path, monkeypatch, waves, spans):
    """A draft of a picture of more than 256 pixels has a fine net for rays alone."""
    monkeypatch.delenv("CAUSTIC_EFFORT", raising=False)
    x, y = np.meshgrid(np.arange(250), np.arange(300))
    np.save(tmp_path / "waves.npy", 1.5 + (np.sin(x / 9.0) * np.cos(y / 7.0)).T)
    given = {"quality": "draft", "mag": 3.0, "design.waves": waves, "screen.resolution": [250, 300]}
    project, _ = new_project(tmp_path / "waves.npy", given, None, None, None, lambda _: None)
    assert max(project.settings.screen.resolution) == 300
    assert list(project.settings.lens.control) == [spans + 3] * 2
    assert {tuple(stage.control) for stage in project.settings.design.stages} == {(spans + 3,) * 2}
    assert any(stage.waves for stage in project.settings.design.stages) == (waves == "auto")
