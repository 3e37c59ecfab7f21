"""Figures of merit against loops that follow the formulas word by word, and at their edges."""

import json
import math

import numpy as np
import pytest
import torch

from caustic_cli.errors import InputError
from caustic_cli.optics.image import Image
from caustic_cli.optics.rays import LOSSES
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen
from caustic_cli.studies import metrics

SHAPES = [(15, 13), (11, 11), (7, 9), (3, 20), (2, 2)]


def pictures(shape, seed=0):
    """A noisy image and a target with some black in it, on different scales."""
    g = np.random.default_rng(seed)
    target = g.random(shape)
    target[target < 0.3] = 0.0
    return 3.7 * (target + 0.2 * g.random(shape)), 255.0 * target


def naive_ssim(image, target):
    """Wang et al. 2004 with loops over pixels and over the window, whose borders mirror the picture."""
    image = image * (target.sum() / image.sum())
    peak, (nx, ny), r = target.max(), target.shape, 5
    window = [[math.exp(-(a * a + b * b) / (2 * 1.5**2)) for b in range(-r, r + 1)] for a in range(-r, r + 1)]
    whole = sum(map(sum, window))

    def mirrored(k, n):  # ... 1 0 | 0 1 ... n-1 | n-1 n-2 ...
        k %= 2 * n
        return k if k < n else 2 * n - 1 - k

    values = {}
    for i in range(nx):
        for j in range(ny):
            m = dict.fromkeys(("k", "t", "kk", "tt", "kt"), 0.0)
            for a in range(-r, r + 1):
                for b in range(-r, r + 1):
                    w = window[a + r][b + r] / whole
                    k, t = (p[mirrored(i + a, nx), mirrored(j + b, ny)] for p in (image, target))
                    for name, value in (("k", k), ("t", t), ("kk", k * k), ("tt", t * t), ("kt", k * t)):
                        m[name] += w * value
            c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
            var = m["kk"] - m["k"] ** 2 + m["tt"] - m["t"] ** 2
            cov = m["kt"] - m["k"] * m["t"]
            values[i, j] = (2 * m["k"] * m["t"] + c1) * (2 * cov + c2) / ((m["k"] ** 2 + m["t"] ** 2 + c1) * (var + c2))
    if min(nx, ny) >= 2 * r + 1:
        values = {(i, j): v for (i, j), v in values.items() if r <= i < nx - r and r <= j < ny - r}
    return sum(values.values()) / len(values)


@pytest.mark.parametrize("shape", SHAPES)
def test_every_figure_equals_its_naive_loop(shape):
    image, target = pictures(shape)
    n, total_j, total_t = image.size, image.sum(), target.sum()
    square = sum((j / total_j - t / total_t) ** 2 for j, t in zip(image.ravel(), target.ravel(), strict=True))
    assert metrics.loss(image, target) == pytest.approx(math.sqrt(square / n), rel=1e-12)
    assert metrics.relative_rms(image, target) == pytest.approx(math.sqrt(square / n) * n, rel=1e-12)
    scaled = square * total_t**2 / n
    assert metrics.psnr_db(image, target) == pytest.approx(10 * math.log10(target.max() ** 2 / scaled), rel=1e-12)
    assert metrics.ssim(image, target) == pytest.approx(naive_ssim(image, target), rel=1e-10)


def test_scale_does_not_matter():
    image, target = pictures((14, 12))
    for figure in (metrics.loss, metrics.relative_rms, metrics.psnr_db, metrics.ssim):
        assert figure(1e-9 * image, 1e200 * target) == pytest.approx(figure(image, target), rel=1e-12)


def test_identical_images():
    _, target = pictures((14, 12))
    assert metrics.loss(target, target) == 0.0
    assert metrics.psnr_db(target, target) is None
    assert metrics.ssim(target, target) == pytest.approx(1.0, abs=1e-12)


def test_even_target_and_black_image_have_a_relative_rms_of_one():
    black, even = np.zeros((6, 5)), np.ones((6, 5))
    assert metrics.relative_rms(black, even) == pytest.approx(1.0, rel=1e-14)
    assert metrics.psnr_db(black, even) == pytest.approx(0.0, abs=1e-12)
    assert 0.0 < metrics.ssim(black, even) < 1e-3


def test_black_target_has_no_peak():
    image, black = np.ones((12, 12)), np.zeros((12, 12))
    assert metrics.psnr_db(image, black) is None
    assert metrics.ssim(image, black) is None
    assert metrics.relative_rms(image, black) == pytest.approx(1.0, rel=1e-14)
    assert metrics.loss(black, black) == 0.0


def test_more_noise_is_worse_by_every_figure():
    _, target = pictures((30, 30))
    noise = np.random.default_rng(1).random(target.shape)
    found = [
        (
            metrics.relative_rms(target + a * noise, target),
            -metrics.psnr_db(target + a * noise, target),
            -metrics.ssim(target + a * noise, target),
        )
        for a in (1.0, 10.0, 100.0)
    ]
    assert all(np.diff(column).min() > 0 for column in zip(*found, strict=True))


def test_on_target_counts_light_where_the_target_is_not_black():
    image = np.array([[0.1, 0.2], [0.3, 0.05]])
    assert metrics.on_target(image, np.array([[0.0, 5.0], [1e-9, 0.0]])) == pytest.approx(0.5, rel=1e-15)


def test_light_in_black_is_counted_below_a_hundredth_of_the_peak():
    image, target = np.array([[0.1, 0.2], [0.3, 0.2]]), np.array([[0.0, 5.0], [0.049, 0.05]])
    assert metrics.in_black(image, target) == pytest.approx(0.4 / 0.8, rel=1e-15)
    assert metrics.in_black(1e-9 * image, 1e200 * target) == pytest.approx(0.5, rel=1e-12)
    assert metrics.in_black(image * (target >= 0.05), target) == 0.0
    assert metrics.in_black(image, target + 0.1) is None  # no black
    assert metrics.in_black(image, 0.0 * target) is None  # no peak
    assert metrics.in_black(0.0 * image, target) is None  # no light


def test_coloured_light_is_in_the_black_of_its_own_colour():
    red, green = np.array([[0.0, 1.0]]), np.array([[4.0, 0.0]])
    image, target = np.stack([[[0.1, 0.4]], [[0.3, 0.2]]]), np.stack([red, green])
    assert metrics.in_black(image, target) == pytest.approx(0.3, rel=1e-15)
    assert metrics.figures_of_merit(Image(image, 1.0, {}), target)["in_black"] == pytest.approx(0.3, rel=1e-15)


@pytest.mark.parametrize("black", [False, True])
def test_figures_of_merit_account_for_all_light_and_are_strict_json(black):
    lens = Lens(control=(5, 4))
    scene = Scene(PlaneWave(), lens, Screen((9.0, 9.0), 100.0, (12, 12)))
    x = torch.linspace(-5.0, 5.0, 5, dtype=torch.float64)[:, None]
    heights = (30.0 + (2.0 if black else 0.01) * x).expand(5, 4)  # a slope of 2 reflects all light inside
    exposure = expose(scene, HeightField.of(lens), heights, Sampler("grid", (40, 40)))
    target = np.zeros((12, 12))
    target[3:, :] = 1.0
    found = metrics.figures_of_merit(exposure, torch.from_numpy(target))
    assert list(found) == ["loss", "relative_rms", "psnr_db", "ssim", "in_black", "on_screen", "on_target", "lost", "rays"]
    assert set(found["lost"]) == set(LOSSES)
    assert found["on_screen"] + sum(found["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert found["rays"] == 1600
    assert 0.0 <= found["on_target"] <= found["on_screen"]
    assert (found["on_screen"] == 0.0) == black
    assert json.loads(json.dumps(found, allow_nan=False)) == found


@pytest.mark.parametrize(
    ("image", "target", "complaint"),
    [
        (np.ones((3, 4)), np.ones((4, 3)), "same shape"),
        (np.ones(3), np.ones(3), "2-D"),
        (np.full((3, 4), np.nan), np.ones((3, 4)), "finite"),
        (np.ones((3, 4)), np.full((3, 4), np.inf), "finite"),
    ],
)
def test_what_cannot_be_compared_is_refused(image, target, complaint):
    for figure in (metrics.loss, metrics.relative_rms, metrics.psnr_db, metrics.ssim, metrics.on_target):
        with pytest.raises(InputError, match=complaint):
            figure(image, target)
