"""The loss against loops over pixels and SciPy's Gaussian, and where light thrown away must and must not count."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.loss_terms import parse
from caustic_cli.inverse.losses import Loss, gaussian_matrix

SHAPE = (9, 7)
G = torch.Generator().manual_seed(2)
TARGET = torch.rand(SHAPE, generator=G, dtype=torch.float64)
IMAGE = torch.rand(SHAPE, generator=G, dtype=torch.float64) * 0.01
FULL = torch.tensor(0.9, dtype=torch.float64)


def naive(image, power: float) -> float:
    """Equation 5.2.1 pixel by pixel."""
    t, total = TARGET.tolist(), float(TARGET.sum())
    square = sum((image[i, j].item() / power - t[i][j] / total) ** 2 for i in range(SHAPE[0]) for j in range(SHAPE[1]))
    return math.sqrt(square / (SHAPE[0] * SHAPE[1]))


def test_rms_is_equation_5_2_1():
    assert float(Loss("rms", TARGET)(IMAGE, FULL)) == pytest.approx(naive(IMAGE, float(IMAGE.sum())), rel=1e-13)


def test_rms_light_divides_by_the_power_that_left_the_lens():
    assert float(Loss("rms-light", TARGET)(IMAGE, FULL)) == pytest.approx(naive(IMAGE, 0.9), rel=1e-13)


@pytest.mark.parametrize("name", ["rms", "rms-light"])
def test_scales_cancel(name):
    """Any power, any scale of the target: only proportions count."""
    value = float(Loss(name, TARGET)(IMAGE, FULL))
    assert float(Loss(name, 1e6 * TARGET)(IMAGE, FULL)) == pytest.approx(value, rel=1e-12)
    assert float(Loss(name, TARGET)(1e-6 * IMAGE, 1e-6 * FULL)) == pytest.approx(value, rel=1e-12)


def test_only_rms_light_minds_light_that_is_lost():
    """Erratum E13: with 30 % of all light off the screen, the plain loss sees a perfect picture."""
    perfect = TARGET / TARGET.sum()
    one = torch.ones((), dtype=torch.float64)
    assert float(Loss("rms", TARGET)(0.7 * perfect, one)) < 1e-17
    missing = 0.3 * float((perfect**2).mean().sqrt())
    assert float(Loss("rms-light", TARGET)(0.7 * perfect, one)) == pytest.approx(missing, rel=1e-13)
    assert float(Loss("rms-light", TARGET)(perfect, one)) < 1e-17


@pytest.mark.parametrize("name", ["rms", "rms-light"])
@pytest.mark.parametrize("blur", [0.0, 1.3])
def test_gradient_is_finite_differences(name, blur):
    loss = Loss(name, TARGET, blur)
    image = IMAGE.clone().requires_grad_()
    leaving = FULL.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, (image, leaving), eps=1e-8, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("name", ["rms", "rms-light"])
def test_a_perfect_picture_pulls_at_nothing(name):
    """The root is not differentiable at 0: its gradient there must be 0 and not NaN, which would destroy the lens."""
    image = (0.25 * TARGET).requires_grad_()
    leaving = image.detach().sum()
    value = Loss(name, TARGET)(image, leaving)
    assert float(value.detach()) < 1e-18
    (gradient,) = torch.autograd.grad(value, image)
    assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("name", ["rms", "rms-light"])
def test_no_light_is_an_error_in_a_sentence(name):
    for dark in (torch.zeros(SHAPE, dtype=torch.float64), torch.full(SHAPE, math.nan, dtype=torch.float64)):
        with pytest.raises(CausticError, match="no light reaches the screen"):
            Loss(name, TARGET)(dark, dark.sum())


def test_unknown_loss_is_refused():
    with pytest.raises(InputError, match="got 'l1'"):
        Loss("l1", TARGET)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.7, 8.0, 100.0])
@pytest.mark.parametrize("n", [2, 40, 75])
def test_blur_is_scipys_gaussian(n, sigma):
    """Cut at 4 sigma, nothing beyond the frame; to rounding."""
    expected = gaussian_filter1d(np.eye(n), sigma, axis=0, mode="constant", radius=max(1, math.ceil(4 * sigma)))
    np.testing.assert_allclose(gaussian_matrix(n, sigma).numpy(), expected, rtol=0, atol=1e-15)


def test_blur_keeps_the_light_of_the_interior():
    """Each column is one pixel's light: 4 sigma from the frame it is all there, at the frame half of it, never more than all."""
    matrix = gaussian_matrix(60, 3.0)
    sums = matrix.sum(0)
    torch.testing.assert_close(sums[12:-12], torch.ones(36, dtype=torch.float64), rtol=0, atol=1e-14)
    assert float(sums.max()) <= 1 + 1e-14
    assert 0.5 < float(sums[0]) < 0.6
    assert torch.equal(matrix, matrix.T)
    assert float(gaussian_matrix(5, 1e-3).sub(torch.eye(5)).abs().max()) == 0.0  # no blur at all, and no 0 / 0


@pytest.mark.parametrize("name", ["rms", "rms-light"])
def test_blurred_loss_compares_blurred_pictures(name):
    def blurred(a):
        for axis in (0, 1):
            a = gaussian_filter1d(a, 1.5, axis=axis, mode="constant", radius=6)
        return a

    power = float(IMAGE.sum()) if name == "rms" else 0.9
    difference = blurred((IMAGE / power).numpy()) - blurred((TARGET / TARGET.sum()).numpy())
    expected = math.sqrt((difference**2).mean())
    assert float(Loss(name, TARGET, 1.5)(IMAGE, FULL)) == pytest.approx(expected, rel=1e-12)
    assert expected != pytest.approx(float(Loss(name, TARGET)(IMAGE, FULL)), rel=0.01)


def test_blur_sees_how_far_light_has_to_go():
    """A spot two pixels from its place costs less than one four pixels away only when blurred."""
    target = torch.zeros(20, 20, dtype=torch.float64)
    target[10, 10] = 1.0
    one = torch.ones((), dtype=torch.float64)
    near, far = target.roll(2, 0), target.roll(4, 0)
    sharp, soft = Loss("rms-light", target), Loss("rms-light", target, 3.0)
    assert float(sharp(near, one)) == float(sharp(far, one))
    assert float(soft(near, one)) < 0.7 * float(soft(far, one))


@pytest.mark.parametrize(
    "text", ["throughput", "diffusion", "uniformity", "rms-light + 0.5 throughput + 2 * diffusion + 0.1 uniformity"]
)
def test_every_term_has_the_slope_of_differences(text):
    loss = Loss(text, TARGET, 0.0, 2)
    image, leaving = IMAGE.clone().requires_grad_(), FULL.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, (image, leaving), eps=1e-8, atol=1e-7, rtol=1e-5)


def test_terms_add_in_squares():
    one, two = (Loss(name, TARGET, 0.0, 2)(IMAGE, FULL) for name in ("rms-light", "diffusion"))
    both = Loss("rms-light + 0.25 diffusion", TARGET, 0.0, 2)(IMAGE, FULL)
    assert float(both) == pytest.approx(math.sqrt(float(one) ** 2 + 0.25 * float(two) ** 2), rel=1e-13)
    with_penalty = Loss("rms-light", TARGET)(IMAGE, FULL, torch.tensor(3.0, dtype=torch.float64))
    assert float(with_penalty) * TARGET.numel() == pytest.approx(math.sqrt((float(one) * TARGET.numel()) ** 2 + 3.0), rel=1e-13)


def test_throughput_counts_light_beside_the_screen_by_distance():
    loss = Loss("throughput", TARGET, 0.0, 2)
    one = torch.ones((), dtype=torch.float64)
    for (i, j), expected in {(4, 3): 0.0, (2, 2): 0.0, (1, 3): 0.5, (0, 3): 1.0, (4, 5): 0.5, (8, 6): 1.0}.items():
        image = torch.zeros(SHAPE, dtype=torch.float64)
        image[i, j] = 0.3
        assert (float(loss(image, one)) * TARGET.numel()) ** 2 == pytest.approx(0.3 * expected, abs=1e-15)


def test_uniformity_asks_for_no_picture():
    flat = torch.full(SHAPE, 0.01, dtype=torch.float64)
    region = torch.zeros(SHAPE, dtype=torch.bool)
    region[2:5, 2:6] = True
    loss = Loss("uniformity", TARGET, region=region)
    assert float(loss(flat, FULL)) == 0.0
    flat[~region] = 0.7
    assert float(loss(flat, FULL)) < 1e-15
    values = IMAGE[region]
    assert float(loss(IMAGE, FULL)) * TARGET.numel() == pytest.approx(float(values.std(correction=0) / values.mean()), rel=1e-12)


def test_diffusion_minds_what_alternates():
    base = TARGET / TARGET.sum()
    i, j = torch.meshgrid(torch.arange(SHAPE[0]), torch.arange(SHAPE[1]), indexing="ij")
    chequered, smooth = 1e-4 * (-1.0) ** (i + j), 1e-4 * torch.ones(SHAPE, dtype=torch.float64)
    one = torch.ones((), dtype=torch.float64)
    assert float(Loss("diffusion", TARGET)(base + chequered, one)) > 4e-4
    assert float(Loss("diffusion", TARGET)(base + smooth, one)) < 1e-15


@pytest.mark.parametrize(
    "text, terms",
    [
        ("rms", [(1.0, "rms")]),
        ("rms-light + 0.1 laplacian", [(1.0, "rms-light"), (0.1, "laplacian")]),
        ("2*rms+1e-3 * curvature".replace("2*rms", "2 * rms"), [(2.0, "rms"), (1e-3, "curvature")]),
    ],
)
def test_parse(text, terms):
    assert parse(text) == terms


@pytest.mark.parametrize("text", ["", "l1", "rms +", "-1 rms", "nan rms", "inf rms", "x rms", "laplacian", "0 rms", "rms rms"])
def test_parse_refuses(text):
    with pytest.raises(InputError, match="loss must"):
        parse(text)
