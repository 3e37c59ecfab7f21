"""Fresnel's integral on fields that are given directly: closed forms, energy, pieces, precision, derivatives."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from fields import Given, disc, mean_around, mean_over, middles, slit
from scipy.special import airy, j0, j1, jv

from caustic_cli.optics.waves.propagation import Exposure, PrunedExposure, cells, pixel_edges, power_by_blocks, power_on_pixels
from caustic_cli.optics.waves.sampling import Sampling

LAMBDA = 5.5e-4
ONE, FLAT = np.ones(1), np.zeros(1)


# Closed forms, to parts of the incident irradiance or of the peak


@pytest.mark.parametrize(("half", "distance"), [(0.2, 100.0), (0.8, 60.0), (1.5, 30.0)])
def test_slit_near(half, distance):
    """Fresnel's integrals, 1e-3 of the incident irradiance, from a Fresnel number of 0.7 to 136; light fades out along the slit."""
    screen, count = 1.25 * half, 60
    given = Given((half, 0.5), (screen, 1.0), (count, 2), distance, LAMBDA, finer=4.0, watched=(max(4.0, 2.0 * half), 1.0))
    fade = np.cos(math.pi * given.y[None, :]) ** 2
    found = given.power(FLAT, fade).sum(1) * 1.0 / (1.0 * 0.375)  # a pixel is 1 mm long; int cos^4 = 0.375
    exact = mean_over(lambda x: slit(x, half, LAMBDA, distance), -screen, screen, count, 8)
    assert np.abs(found - exact).max() < 1e-3


def test_rectangle_near():
    """Sharp along both axes, sampled as an image is: 2e-2."""
    half, distance, screen, count = (0.8, 0.5), 60.0, (1.0, 0.7), (60, 44)
    exact = [
        mean_over(lambda x, h=h: slit(x, h, LAMBDA, distance), -s, s, n, 8) for h, s, n in zip(half, screen, count, strict=True)
    ]
    found = Given(half, screen, count, distance, LAMBDA).power(FLAT, ONE)
    assert np.abs(found - exact[0][:, None] * exact[1][None, :]).max() < 2e-2


def test_rectangle_far():
    """(sin x / x)^2 along both axes, each as wide as it should be."""
    half, distance = (0.05, 0.08), 2000.0
    screen, count = (30.0, 20.0), (32, 32)
    given = Given(half, screen, count, distance, LAMBDA)
    peak = (4.0 * half[0] * half[1] / (LAMBDA * distance)) ** 2
    one = [
        mean_over(lambda x, h=h: np.sinc(2.0 * h * x / (LAMBDA * distance)) ** 2, -s, s, n, 4)
        for h, s, n in zip(half, screen, count, strict=True)
    ]
    # At the Fresnel number h^2 / lambda L = 0.006 the closed form itself is right to its square.
    assert np.abs(given.power(FLAT, ONE) - peak * one[0][:, None] * one[1][None, :]).max() < 1e-3 * peak


@pytest.mark.parametrize("number", [1.0, 2.0, 2.5])
def test_circle_near_on_axis(number):
    """4 sin^2(pi a^2 / 2 lambda L): four times the incident light at odd Fresnel numbers, none at even ones."""
    distance = 100.0
    a = math.sqrt(number * LAMBDA * distance)
    assert float(hankel(np.zeros(1), a, distance)[0]) == pytest.approx(4.0 * math.sin(math.pi * number / 2.0) ** 2, abs=1e-9)
    given = Given((a, a), (0.06, 0.06), (3, 3), distance, LAMBDA, watched=(6.0, 6.0))
    found = given.power(FLAT, disc(given.x, given.y, a))
    # The mean of the middle pixel, 40 um wide, by Hankel's integral off the axis.
    at, weights = np.polynomial.legendre.leggauss(4)
    exact = weights @ hankel(np.hypot(*np.meshgrid(0.02 * at, 0.02 * at)), a, distance) @ weights / 4.0
    assert found[1, 1] == pytest.approx(exact, abs=4e-3)


def hankel(rho: np.ndarray, a: float, distance: float, curvature: float = 0.0) -> np.ndarray:
    """|k / L int_0^a exp(i k r^2 / 2 (1 / L - curvature)) J0(k r rho / L) r dr|^2 by Gauss' rule."""
    k = 2.0 * math.pi / LAMBDA
    t, w = np.polynomial.legendre.leggauss(400)
    r, w = 0.5 * a * (t + 1.0), 0.5 * a * w
    kernel = np.exp(0.5j * k * r**2 * (1.0 / distance - curvature)) * r * w
    return np.abs(k / distance * (j0(k / distance * rho[..., None] * r) @ kernel)) ** 2


def test_circle_near_off_axis():
    """A Fresnel number of 5: every pixel against Hankel's integral, 4e-3 at the worst and 1e-3 on the mean."""
    distance = 80.0
    a = math.sqrt(5.0 * LAMBDA * distance)
    screen, count = 1.3 * a, 25
    given = Given((a, a), (screen, screen), (count, count), distance, LAMBDA, finer=2.0, watched=(3.0, 3.0))
    found = given.power(FLAT, disc(given.x, given.y, a))
    exact = mean_around(lambda rho: hankel(rho, a, distance), screen, count)
    error = np.abs(found - exact)
    assert error.max() < 4e-3 and math.sqrt((error**2).mean()) < 1e-3


def jinc(x):
    return np.where(np.abs(x) > 1e-9, 2.0 * j1(x) / np.where(np.abs(x) > 1e-9, x, 1.0), 1.0)


@pytest.mark.parametrize("lens", [True, False], ids=["focus", "far"])
def test_airy_pattern(lens):
    """(2 J1(x) / x)^2, at the focus of a thin lens and far from an aperture alone, to 1e-3 of the peak."""
    a, distance = (0.8, 50.0) if lens else (0.05, 4000.0)
    width = LAMBDA * distance / (2.0 * a)
    screen, count = 4.0 * width, 40
    given = Given((a, a), (screen, screen), (count, count), distance, LAMBDA, finer=1.5)
    path = -(given.x[:, None] ** 2 + given.y[None, :] ** 2) / (2.0 * distance) if lens else FLAT
    found = given.power(path, disc(given.x, given.y, a))
    peak = (math.pi * a * a / (LAMBDA * distance)) ** 2
    exact = peak * mean_around(lambda rho: jinc(2.0 * math.pi * a / (LAMBDA * distance) * rho) ** 2, screen, count)
    assert np.abs(found - exact).max() < 1e-3 * peak


@pytest.mark.parametrize("pixel", [0.1, 0.37, 1.0, 2.3])
def test_cylindrical_lens_at_its_focus(pixel):
    """(sin x / x)^2 across a line, of pixels from a tenth of its width to twice that, sampled as an image is."""
    half, distance, count = (0.6, 0.3), 40.0, 24
    width = LAMBDA * distance / (2.0 * half[0])
    screen = 0.5 * pixel * width * count
    given = Given(half, (screen, 0.2), (count, 8), distance, LAMBDA)
    found = given.power(-(given.x[:, None] ** 2) / (2.0 * distance), ONE)
    exact = mean_over(lambda x: np.sinc(x / width) ** 2, -screen, screen, count, 16) * 2.0 * half[0] / width
    along = mean_over(lambda y: slit(y, half[1], LAMBDA, distance), -0.2, 0.2, 8, 8)
    assert np.abs(found.sum(1) - exact * along.sum()).max() < 5e-3 * along.sum() * 2.0 * half[0] / width
    tight = Given(half, (screen, 0.2), (count, 8), distance, LAMBDA, finer=2.0)
    found = tight.power(-(tight.x[:, None] ** 2) / (2.0 * distance), ONE)
    assert np.abs(found.sum(1) - exact * along.sum()).max() < 1e-3 * along.sum() * 2.0 * half[0] / width


def peaks(x: np.ndarray, y: np.ndarray) -> list[tuple[float, float, float]]:
    """Maxima: place, height and full width at half of it, each between samples."""
    found = []
    for i in np.nonzero((y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:]))[0] + 1:
        a, b, c = y[i - 1], y[i], y[i + 1]
        shift = 0.5 * (a - c) / (a - 2.0 * b + c)
        top, ends = b - 0.25 * (a - c) * shift, []
        for step in (-1, 1):
            j = i
            while 0 < j < len(y) - 1 and y[j] > 0.5 * top:
                j += step
            ends.append(x[j] - step * (x[1] - x[0]) * (0.5 * top - y[j]) / (y[j - step] - y[j]))
        found.append((x[i] + shift * (x[1] - x[0]), top, ends[1] - ends[0]))
    return found


def test_fold_caustic():
    """A cubic phase, its edges faded out: Airy's function, places and widths of three fringes to 1 %, heights to 1 %."""
    distance, cubic = 60.0, 2.0e-3  # path cubic x^3 / 3, its mean slope such that the chirp of the way cancels
    half = (2.2, 0.2)
    given = Given(half, (0.25, 0.1), (600, 2), distance, LAMBDA, watched=(1.2, 0.2))
    fade = np.clip((half[0] - np.abs(given.x)) / 0.8, 0.0, 1.0)
    fade = fade**3 * (10.0 - 15.0 * fade + 6.0 * fade**2)
    path = cubic * given.x[:, None] ** 3 / 3.0 - given.x[:, None] ** 2 / (2.0 * distance)
    found = given.power(path, fade[:, None]).sum(1)
    # int exp(i k (c x^3 / 3 - x X / L)) dx = 2 pi (k c)^(-1/3) Ai(-k X / (L (k c)^(1/3)))
    k = 2.0 * math.pi / LAMBDA
    scale = (k * cubic) ** (1.0 / 3.0) * distance / k
    x = middles(-0.25, 0.25, 600)
    exact = airy(-x / scale)[0] ** 2
    fringes = [sorted(peaks(x, y), key=lambda p: -p[1])[:3] for y in (found, exact)]
    for a, b in zip(*fringes, strict=True):
        assert a[0] == pytest.approx(b[0], rel=0.01)
        assert a[2] == pytest.approx(b[2], rel=0.01)
        assert a[1] / fringes[0][0][1] == pytest.approx(b[1] / fringes[1][0][1], rel=0.01)


def test_phase_grating():
    """Orders m of a sinusoidal phase of depth d hold J_m(d)^2 of the light, at the focus of a lens whose edges fade out."""
    depth, period, distance, half, count = 1.7, 0.1, 100.0, (1.5, 0.1), 9
    order = LAMBDA * distance / period
    screen = 0.5 * order * count
    given = Given(half, (screen, 2.0), (count, 2), distance, LAMBDA, finer=2.0, watched=(2.0 * screen, 2.0))
    path = LAMBDA / (2.0 * math.pi) * depth * np.sin(2.0 * math.pi * given.x[:, None] / period)
    fade = np.cos(0.5 * math.pi * given.x[:, None] / half[0]) ** 2
    amplitude = given.polar(path, fade)[1]
    found = given.power(path - given.x[:, None] ** 2 / (2.0 * distance), fade).sum(1) / given.scale
    found /= float(amplitude.square().sum()) * along(given)
    exact = jv(np.arange(count) - count // 2, depth) ** 2
    assert np.abs(found - exact).max() < 1e-4


def along(given: Given) -> float:
    """The part of a slit's light along y that the screen catches."""
    half, screen = given.half[1], given.screen[1]
    return float(mean_over(lambda y: slit(y, half, LAMBDA, given.sampling.distance), -screen, screen, 1, 400)[0] * screen / half)


# Energy, pieces, precision


def random_field(given: Given, seed: int, dtype):
    rng = np.random.default_rng(seed)
    path = 2e-3 * rng.standard_normal(given.sampling.count)
    return given.polar(path, rng.uniform(0.2, 1.0, given.sampling.count), dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_energy_of_the_transform(dtype, tolerance):
    """All samples of the screen on one row of pixels that holds them: the field's power."""
    given = Given((0.8, 0.5), (1.0, 0.7), (60, 44), 60.0, LAMBDA)
    phase, amplitude = random_field(given, 1, dtype)
    s = given.sampling
    first, spacing = s.first(LAMBDA), s.spacing(LAMBDA)
    whole = [
        cells(pixel_edges(first[k] - spacing[k], spacing[k] * (n + 1) / 7, 7, first[k], spacing[k], n), n).to(dtype)
        for k, n in enumerate(s.padded)
    ]
    for mask in whole:
        assert float(mask.sum(0).min()) == pytest.approx(1.0, abs=1e-5)
    found = power_on_pixels(phase, amplitude, s.padded, *whole)
    assert found.shape == (7, 7)
    assert float(found.double().sum()) == pytest.approx(float(amplitude.double().square().sum()), rel=tolerance)


@pytest.mark.parametrize("pieces", [1, 2, 4, 11])
def test_blocks_and_pieces_are_the_whole(pieces):
    """To rounding, at block sizes that divide nothing."""
    given = Given((0.8, 0.5), (1.0, 0.7), (60, 44), 60.0, LAMBDA)
    phase, amplitude = random_field(given, 2, torch.float64)
    s = given.sampling
    field = torch.polar(amplitude, phase)
    whole = power_on_pixels(phase, amplitude, s.padded, *given.masks)
    for block in (37, 256):
        found, power = power_by_blocks(lambda part: field[part], s, pieces, *given.masks, block=block)
        torch.testing.assert_close(found, whole, rtol=1e-11, atol=1e-12 * float(whole.max()))
        assert power == pytest.approx(float(amplitude.square().sum()), rel=1e-12)


def test_single_precision():
    """1e-5 of the mean irradiance, of a focus as of a speckle."""
    given = Given((0.8, 0.5), (1.0, 0.7), (60, 44), 60.0, LAMBDA)
    exact = power_on_pixels(*random_field(given, 3, torch.float64), given.sampling.padded, *given.masks)
    masks = [m.float() for m in given.masks]
    found = power_on_pixels(*random_field(given, 3, torch.float32), given.sampling.padded, *masks)
    assert float((found.double() - exact).abs().max() / exact.mean()) < 1e-5


def test_cells_share_out_every_sample():
    """Columns sum to 1 inside, to 0 outside, and a sample across an edge is shared in proportion."""
    found = cells(pixel_edges(-1.0, 0.5, 4, -3.05, 0.1, 61), 61)
    at = -3.05 + 0.1 * np.arange(61)
    whole = found.sum(0).numpy()
    np.testing.assert_allclose(whole, np.clip((1.0 - np.abs(at)) / 0.1 + 0.5, 0.0, 1.0), atol=1e-12)
    shared = cells(pixel_edges(0.0, 1.0, 2, 0.93, 0.2, 1), 1)
    np.testing.assert_allclose(shared[:, 0].numpy(), [0.85, 0.15], atol=1e-12)
    assert float(cells(pixel_edges(5.0, 0.5, 4, -3.05, 0.1, 61), 61).abs().max()) == 0.0


def test_samples_follow_lens_and_screen():
    """What is watched holds the screen, samples of the transform are fine enough at every wavelength, lengths are even."""
    for lengths in ((5.5e-4,), (4.5e-4, 6.5e-4)):
        s = Sampling.of(((-3.0, -1.0), (2.0, 1.0)), ((-4.0, -9.0), (6.0, -7.0)), (0.02, 0.05), 150.0, lengths, 1.0)
        for length in lengths:
            for k, (low, high) in enumerate(((-4.0, 6.0), (-9.0, -7.0))):
                first, spacing = s.first(length)[k], s.spacing(length)[k]
                assert first < low and first + spacing * (s.padded[k] - 1) > high
                assert spacing <= (0.02, 0.05)[k] / 3.0 and s.padded[k] % 2 == 0 and s.padded[k] > s.count[k]
                assert spacing * s.padded[k] == pytest.approx(length * 150.0 / s.step[k])


# Derivatives


def test_gradcheck():
    """Both derivatives by differences, of a transform longer than its field."""
    torch.manual_seed(1)
    phase, amplitude = torch.rand(5, 4, dtype=torch.float64) * 6.0, 0.3 + torch.rand(5, 4, dtype=torch.float64)
    rows, columns = torch.rand(3, 8, dtype=torch.float64), torch.rand(2, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda p, a: power_on_pixels(p, a, (8, 6), rows, columns), (phase.requires_grad_(), amplitude.requires_grad_())
    )


def loss_of(given: Given, phase, amplitude):
    masks = [m.to(phase.dtype) for m in given.masks]
    weights = torch.cos(torch.arange(60 * 44, dtype=torch.float64)).view(60, 44).to(phase.dtype)
    return (weights * power_on_pixels(phase, amplitude, given.sampling.padded, *masks)).sum()


def test_second_order_taylor():
    """What a derivative leaves falls with the square of the step."""
    given = Given((0.8, 0.5), (1.0, 0.7), (60, 44), 60.0, LAMBDA)
    phase, amplitude = (t.requires_grad_() for t in random_field(given, 4, torch.float64))
    value = loss_of(given, phase, amplitude)
    value.backward()
    generator = torch.Generator().manual_seed(5)
    along = [torch.randn(t.shape, generator=generator, dtype=torch.float64) * t.detach().abs().mean() for t in (phase, amplitude)]
    slope = float((phase.grad * along[0]).sum() + (amplitude.grad * along[1]).sum())
    left = []
    with torch.no_grad():
        for h in (1e-2, 1e-3, 1e-4):
            left.append(abs(float(loss_of(given, phase + h * along[0], amplitude + h * along[1]) - value) - h * slope))
    orders = [math.log10(a / b) for a, b in pairwise(left)]
    assert all(1.9 < order < 2.1 for order in orders), (left, orders)


def test_single_precision_derivative():
    """1e-5 of its own length."""
    given, found = Given((0.8, 0.5), (1.0, 0.7), (60, 44), 60.0, LAMBDA), []
    for dtype in (torch.float32, torch.float64):
        phase, amplitude = (t.requires_grad_() for t in random_field(given, 6, dtype))
        loss_of(given, phase, amplitude).backward()
        found.append((phase.grad.double(), amplitude.grad.double()))
    for a, b in zip(*found, strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-5


@pytest.mark.parametrize("keep", [False, True])
def test_a_part_of_the_pixels_by_matrix_products(keep):
    """The power on these pixels, by samples that are much finer, and its derivative."""
    torch.manual_seed(0)
    phase, amplitude, change = (torch.rand(30, 24, dtype=torch.float64) for _ in range(3))
    fine = 16
    edges = torch.linspace(3.3, 60.1, 21, dtype=torch.float64), torch.linspace(0.2, 79.3, 17, dtype=torch.float64)
    # Sample j of N is sample fine j of fine N, between edges that are (fine - 1) / 2 fine samples farther on.
    finer = tuple(fine * (e - 0.5) + 0.5 for e in edges)
    part, inside = PrunedExposure(6.0 * phase, amplitude, 3.0, (64, 80), edges, ((4, 15), (1, 9))), (slice(4, 15), slice(1, 9))
    whole = Exposure(6.0 * phase, amplitude, 3.0, (64 * fine, 80 * fine), finer)
    image = part.image(change, keep)
    assert torch.equal(image.nonzero().amin(0), torch.tensor([4, 1])) and torch.equal(
        image.nonzero().amax(0), torch.tensor([14, 8])
    )
    assert torch.allclose(image[inside], whole.image(change)[inside], rtol=1e-3, atol=1e-3 * float(image.max()))
    by_pixel, found, expected = torch.zeros(20, 16, dtype=torch.float64), torch.zeros_like(phase), torch.zeros_like(phase)
    by_pixel[inside] = torch.rand(11, 8, dtype=torch.float64)
    part.pull(by_pixel, change, found)
    whole.pull(by_pixel, change, expected)
    assert torch.allclose(found, expected, atol=3e-3 * float(expected.abs().max()))
    step = 1e-6 * torch.rand_like(change)
    ahead, behind = (float((part.image(change + s) * by_pixel).sum()) for s in (step, -step))
    assert (ahead - behind) / 2.0 == pytest.approx(float((found * step).sum()), rel=1e-6)


def test_pixels_of_half_a_nyquist_interval_at_their_middles():
    """Their power is that of the transform's sample there, and that of all pixels is Parseval's."""
    torch.manual_seed(0)
    phase, amplitude = (torch.rand(32, 20, dtype=torch.float64) for _ in range(2))
    edges = torch.arange(65, dtype=torch.float64), torch.arange(41, dtype=torch.float64)
    part = PrunedExposure(6.0 * phase, amplitude, 0.0, (64, 40), edges, sparse=True)
    field = torch.fft.fft2(torch.polar(amplitude, 6.0 * phase), s=(64, 40), norm="ortho")
    image = part.image(torch.zeros_like(phase))
    assert torch.allclose(image, field.abs().square(), rtol=1e-9, atol=1e-12)
    assert float(image.sum()) == pytest.approx(float(amplitude.square().sum()), rel=1e-12)
