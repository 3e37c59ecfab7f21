"""The loss of laser beams, its mask and region, and the figures of a shaped beam, against formulas in NumPy."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse.losses import BEYOND, DARK, DARKER, LEAST, WEIGHT, Loss
from caustic_cli.optics.region import Region, dilated
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.waves.image import Imager, lines_of
from caustic_cli.optics.waves.unsupported import receiver_of
from caustic_cli.scene import Lens, Light, Offset, Scene, Screen
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.studies.beam import beam_figures, edge_width, turns, vortices


def pictures(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A target with a dark border and tails below a tenth of its peak, and an image near it, of power 0.9."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-2, 2, 20), np.linspace(-2, 2, 16), indexing="ij")
    target = np.exp(-(x**2) - y**2) * (np.hypot(x, y) < 1.8)
    image = np.exp(-(x**2) - y**2) * rng.uniform(0.9, 1.1, x.shape)
    return target, 0.9 * image / image.sum()


def of_numpy(image: np.ndarray, target: np.ndarray, pixels: int) -> tuple[float, float]:
    """Error in the mask, and light in the region, by the definitions."""
    mask = target > 0.1 * target.max()
    region = np.zeros_like(mask)
    for i, j in np.argwhere(mask):
        for a in range(image.shape[0]):
            for b in range(image.shape[1]):
                region[a, b] |= (a - i) ** 2 + (b - j) ** 2 <= pixels**2
    scaled = image * target[mask].sum() / image[mask].sum()
    return math.sqrt(np.mean((scaled[mask] - target[mask]) ** 2 / target[mask] ** 2)), image[region].sum()


@pytest.mark.parametrize("pixels", [0, 2])
@pytest.mark.parametrize("goal", [0.7, 0.99])
def test_value(pixels, goal):
    target, image = pictures()
    loss = Loss("log-rms", torch.from_numpy(target), bright=Region(goal, pixels))
    error, light = of_numpy(image, target, pixels)
    found = float(loss(torch.from_numpy(image), torch.tensor(1.0, dtype=torch.float64))) * target.size
    _, own = of_numpy(target / target.sum(), target, pixels)
    short = max(0.0, goal * own + BEYOND - light)
    assert (short > 0) == (goal == 0.99) and (own < 0.99) == (pixels == 0)
    assert found**2 == pytest.approx(math.log1p((error / LEAST) ** 2) + WEIGHT * short**2, rel=1e-12)


def test_much_darker_pixels_count_more():
    target, image = pictures(5)
    mask = target > 0.1 * target.max()
    image[tuple(np.argwhere(mask)[7])] *= 0.05
    found = (
        float(Loss("log-rms", torch.from_numpy(target), bright=Region(0.2))(torch.from_numpy(image), torch.ones(()))) * target.size
    )
    ratio = image[mask] / target[mask] * (target[mask].sum() / image[mask].sum())
    square = np.mean((ratio - 1.0) ** 2) + DARKER * np.mean(np.clip(1.0 - ratio / DARK, 0.0, None) ** 2)
    assert found**2 == pytest.approx(math.log1p(square / LEAST**2), rel=1e-12)


@pytest.mark.parametrize("goal", [0.7, 0.99])
def test_derivative(goal):
    target, image = pictures(1)
    loss, leaving = Loss("log-rms", torch.from_numpy(target), bright=Region(goal)), torch.tensor(1.0, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda i: loss(i, leaving), torch.from_numpy(image).requires_grad_(), eps=1e-9, atol=1e-5)


def test_light_outside_the_region_is_free():
    """Only its amount counts, not its place; nor does the scale of the rest as long as enough is in the region."""
    target, image = pictures(2)
    loss, one = Loss("log-rms", torch.from_numpy(target), bright=Region(0.2)), torch.tensor(1.0, dtype=torch.float64)
    other = image.copy()
    other[target <= 0.1 * target.max()] = 0.0
    assert float(loss(torch.from_numpy(0.5 * other), one)) == pytest.approx(float(loss(torch.from_numpy(image), one)), rel=1e-12)


def test_an_apron_belongs_to_neither():
    target, image = pictures(3)
    wide = [torch.nn.functional.pad(torch.from_numpy(c), (3,) * 4) for c in (target, image)]
    one = torch.tensor(1.0, dtype=torch.float64)
    given = np.zeros_like(target)
    given[8:12, 6:10] = 1.0
    for region in (Region(0.5, 1), Region(0.5, given=given)):
        inner, outer = Loss("log-rms", torch.from_numpy(target), bright=region), Loss("log-rms", wide[0], 0.0, 3, bright=region)
        assert float(outer(wide[1], one)) * wide[0].numel() == pytest.approx(
            float(inner(torch.from_numpy(image), one)) * target.size, rel=1e-12
        )
    with pytest.raises(InputError, match="region"):
        Region(given=np.ones((3, 3))).on(torch.from_numpy(target))


def test_dilation_is_by_distance():
    mask = np.zeros((15, 15), bool)
    mask[7, 7] = True
    assert dilated(mask, 5).sum() == 81  # lattice points within a radius of 5
    assert dilated(mask, 0) is mask


def test_figures():
    target, image = pictures(4)
    bright = Region(0.9, 2).on(torch.from_numpy(target))
    error, light = of_numpy(image, target, 2)
    mask = target > 0.1 * target.max()
    ratio = image[mask] / target[mask]
    found = beam_figures(torch.from_numpy(image), 0.95, bright, (0.1, 0.1))
    assert found["error"] == pytest.approx(error) and found["in_region"] == pytest.approx(light / 0.95)
    assert found["in_mask"] == pytest.approx(image[mask].sum() / 0.95)
    assert found["peak_to_valley"] == pytest.approx((ratio.max() - ratio.min()) / (ratio.max() + ratio.min()))
    assert found["rms"] == pytest.approx(ratio.std() / ratio.mean())


def test_width_of_an_edge():
    """Of a disc that falls to zero along a ramp of 10 pixels: 1 - 2 / e^2 of it."""
    x, y = np.meshgrid(np.arange(300) - 149.5, np.arange(300) - 149.5, indexing="ij")
    ramp = np.clip((105.0 - np.hypot(x, y)) / 10.0, 0.0, 1.0)
    assert edge_width(ramp, ramp, (0.02, 0.02)) == pytest.approx(0.2 * (1.0 - 2.0 * math.exp(-2.0)), rel=0.05)


def test_vortices_are_counted_where_the_phase_turns():
    x, y = np.meshgrid(np.arange(40) - 20.3, np.arange(30) - 14.6, indexing="ij")
    phase = np.angle((x + 5.0 + 1j * y) * (x - 7.0 - 1j * (y - 4.0)))
    everywhere = np.ones_like(phase, bool)
    assert turns(phase, everywhere) == 2 and turns(phase, everywhere & (x < 0.0)) == 1
    assert turns(np.angle(np.exp(1j * (0.7 * x - 0.4 * y))), everywhere) == 0


def test_vortices_of_speckle():
    """Behind a rough surface: those of the whole transform whose four samples lie in the mask's pixels."""
    source, lens = Gaussian((1.0, 1.0), 1064.0), Lens((4.0, 4.0), control=(24, 24), index=1.5, offset=Offset(1.0))
    scene = Scene(source, lens, Screen((6.0, 6.0), 800.0, (30, 30)), Light(wavelengths=(1064.0,)))
    field = HeightField.of(lens)
    heights = 1.0 + 1e-3 * torch.rand(field.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    mask = np.zeros((30, 30), bool)
    mask[8:22, 10:25] = True
    line = lines_of(scene, field)[0]
    imager = Imager.of([line], {EXIT: heights}, receiver_of(line.system, scene.screen))
    front = imager.front(line, imager.modes(line.system)[0], {EXIT: heights})
    phase, amplitude = imager.field(line, front, torch.float64)
    whole = torch.fft.fft2(torch.polar(amplitude, phase), s=imager.sampling.padded).angle().numpy()
    rows, columns = ((e[1:].numpy(), e[:-1].numpy()) for e in imager.edges(line))
    lit = [
        np.array([any(low[k] <= j + 0.5 < high[k] for k in kept) for j in range(n)])
        for (high, low), kept, n in zip((rows, columns), (range(8, 22), range(10, 25)), whole.shape, strict=True)
    ]
    expected = turns(whole, lit[0][:, None] & lit[1][None, :])
    assert vortices(scene, field, heights, mask) == expected > 5


def test_a_beam_is_shaped_on_the_command_line(tmp_path, monkeypatch, capfd):
    """Better than the transport that it starts from, at the light that is asked for; and refused without a number."""
    monkeypatch.chdir(tmp_path)
    x = np.abs(np.linspace(-1, 1, 48))
    edge = np.clip((0.7 - x) / 0.1, 0.0, 1.0)
    np.save("square.npy", np.outer(edge, edge))
    beam = ["--source", "gaussian", "--waist", "3", "--wavelengths", "1064", "--lens-size", "8", "--throw", "800"]
    small = ["--linear", "--picture-size", "10x10", "--margin", "0", "--resolution", "48", "--control", "60", "--threads", "1"]
    loss = ["--loss", "log-rms", "--waves", "on", "--quiet", "--json"]
    found = []
    for more in (["--iterations", "1"], ["--efficiency", "0.992", "--region", "0"], ["--efficiency", "0.992", "--region", "3"]):
        assert cli.run(["design", "square.npy", *beam, *small, *loss, *more, "--force"]) == 0
        found.append(json.loads(capfd.readouterr().out)["beam"])
    start, tight, wide = found
    assert tight["in_region"] == tight["in_mask"] > 0.991 and tight["error"] < 0.5 * start["error"] and tight["vortices"] == 0
    assert wide["in_region"] > 0.991 and wide["in_region"] > wide["in_mask"] and wide["error"] < tight["error"]
    assert cli.run(["design", "square.npy", *beam, "--loss", "log-rms", "--region", "two"]) == 2
    assert "--region must be a number of pixels or a picture, got 'two'" in capfd.readouterr().err
    assert cli.run(["design", "square.npy", *beam, "--loss", "log-rms", "--efficiency", "1.2"]) == 2
    assert "--efficiency" in capfd.readouterr().err
    assert cli.run(["design", "square.npy", *beam, *small, "--loss", "log-rms", "--plan"]) == 2
    assert "depends on the part of the light" in capfd.readouterr().err


def test_error_against_efficiency_and_errors_of_alignment(tmp_path, monkeypatch, capfd):
    """The less light is asked for the smaller the error; a beam aside or wider has a larger one."""
    monkeypatch.chdir(tmp_path)
    x = np.abs(np.linspace(-1, 1, 48))
    np.save("square.npy", np.outer(x < 0.7, x < 0.7) + 0.0)
    beam = ["--source", "gaussian", "--waist", "3", "--wavelengths", "1064", "--lens-size", "8", "--throw", "800"]
    small = ["--linear", "--picture-size", "10x10", "--margin", "0", "--resolution", "48", "--control", "60", "--threads", "1"]
    assert cli.run(["design", "square.npy", *beam, *small, "--loss", "log-rms", "--waves", "on"]) == 0
    assert "decentred by 1 % of its radius" in capfd.readouterr().err
    assert cli.run(["convergence", "square.caustic", "--study", "light", "--seconds", "3", "-o", "light", "--quiet", "--json"]) == 0
    rows = json.loads((tmp_path / "light" / "light.json").read_text())["rows"]
    capfd.readouterr()
    assert [row["weight"] for row in rows] == [0.99, 0.985, 0.97, 0.95, 0.9]
    assert all(row["on_screen"] > row["weight"] - 0.03 for row in rows)
    assert rows[-1]["error"] < 0.7 * rows[0]["error"] and any(row["front"] for row in rows)
    (tmp_path / "errors.toml").write_text("draws = 12\n[source_shift]\nsigma = [0.06, 0.06]\n[source_size]\nhalf_width = 0.05\n")
    render = ["render", "square.caustic", "--tolerances", "errors.toml", "--rays", "60000", "--quiet", "--threads", "1", "--json"]
    assert cli.run(render) == 0
    found = json.loads(capfd.readouterr().out)
    assert {row["name"] for row in found["tolerances"]["sensitivities"]} == {"source_shift x", "source_shift y", "source_size"}
    assert found["tolerances"]["error"]["p95"] > 1.3 * found["wave_relative_rms"]
