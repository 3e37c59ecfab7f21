"""Difficult cases of refraction, of what is parallel, and of scenes without light."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import numpy as np
import torch

from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.frames import IDENTITY
from caustic_cli.studies import metrics
from caustic_cli.studies.stability.case import Case, largest

#: Index of the glass, and a rounding of double precision.
INDEX, EPS = 1.5, 2.0**-52


def interact(slope: torch.Tensor, index: float, fresnel: str):
    """Refraction of rays along the axis at these slopes along x, from glass to air."""
    zero, one = torch.zeros_like(slope), torch.ones_like(slope)
    return backend_for("cpu").interact((zero, zero, one), (slope, zero), one, eta=index, reflects=False, fresnel=fresnel)


def transmittance(slope: Decimal) -> Decimal:
    """Fresnel's, of unpolarised light, times 1: from c = d . N = 1 and s = t . N."""
    n = Decimal(INDEX)
    s = (1 - (n * n - 1) * slope * slope).sqrt()
    rs, rp = (n - s) / (n + s), (1 - n * s) / (1 + n * s)
    return 1 - (rs * rs + rp * rp) / 2


def critical(margin: float) -> tuple[float, float]:
    """Derivatives of the power by the slope so many rad before and beyond the critical angle, in units of 30 eps / cos^2."""
    angle = math.asin(1.0 / INDEX)
    slopes = [math.tan(angle - margin), math.tan(angle + margin)]
    with localcontext() as context:
        context.prec = 60
        g, step = Decimal(slopes[0]), Decimal(10) ** -25
        cosine = (1 - (Decimal(INDEX) ** 2 - 1) * g * g) / (1 + g * g)
        exact = float((transmittance(g + step) - transmittance(g - step)) / (2 * step))

    def error(found: list[float]) -> float:
        return largest((abs(found[0] / exact - 1.0), abs(found[1]))) / (30.0 * EPS / float(cosine))

    leaf = torch.tensor(slopes, dtype=torch.float64, requires_grad=True)
    (ours,) = torch.autograd.grad(interact(leaf, INDEX, "exact").power.sum(), leaf)
    square = 1.0 - (INDEX**2 - 1.0) * leaf * leaf
    s = torch.where(square > 0.0, square.sqrt(), torch.zeros_like(square))
    rs, rp = (INDEX - s) / (INDEX + s), (1.0 - INDEX * s) / (1.0 + INDEX * s)
    (naive,) = torch.autograd.grad((1.0 - 0.5 * (rs * rs + rp * rp)).sum(), leaf)
    return error(naive.tolist()), error(ours.tolist())


def faint_index(excess: float) -> tuple[float, float]:
    """Deflection by glass of index 1 + excess; naively gamma = (s - n c) / |N|^2."""
    index, slope = 1.0 + excess, 0.375
    with localcontext() as context:
        context.prec = 60
        n, g = Decimal(index), Decimal(slope)
        exact = -g * ((1 - (n * n - 1) * g * g).sqrt() - n) / (1 + g * g)
    naive = -slope * (math.sqrt(1.0 - (index * index - 1.0) * slope * slope) - index) / (1.0 + slope * slope)
    ours = float(interact(torch.tensor([slope], dtype=torch.float64), index, "none").direction[0][0])
    return tuple(abs(float(Decimal(x) / exact - 1)) for x in (naive, ours))  # type: ignore[return-value]


def parallel(cosine: float) -> tuple[float, float]:
    """Derivative of the place by the direction, of a ray of this cosine to the screen's normal and of one parallel to it."""
    height = 10.0
    sine = math.sqrt((1.0 - cosine) * (1.0 + cosine))
    exact = float(-Decimal(height) * Decimal(sine) / Decimal(cosine) ** 2)
    leaf = torch.tensor([cosine, 0.0], dtype=torch.float64, requires_grad=True)
    zero, along = torch.zeros(2, dtype=torch.float64), torch.tensor([sine, 1.0], dtype=torch.float64)
    x, _, arrives = backend_for("cpu").land((zero, zero, zero), (along, zero, leaf), (0.0, 0.0, height), IDENTITY, 1.0)
    (ours,) = torch.autograd.grad(torch.where(arrives, x, torch.zeros_like(x)).sum(), leaf)
    (naive,) = torch.autograd.grad(torch.where(leaf > 0.0, height / leaf * along, torch.zeros_like(leaf)).sum(), leaf)

    def error(found: torch.Tensor) -> float:
        return largest((abs(float(found[0]) / exact - 1.0), abs(float(found[1]))))

    return error(naive), error(ours)


def dark(pixels: int) -> tuple[float, float]:
    """The relative error of a black image against an even target, which is 1; naively the image over its own sum."""
    image, target = np.zeros((pixels, pixels)), np.ones((pixels, pixels))
    with np.errstate(invalid="ignore"):
        naive = math.sqrt(float(np.mean((image / image.sum() * pixels**2 - 1.0) ** 2)))
    return abs(naive - 1.0), abs(metrics.relative_rms(image, target) - 1.0)


def one_bright_pixel(pixels: int) -> tuple[float, float]:
    """An even image against a target of one bright pixel: the error is sqrt(N - 1) for N pixels; naively by relative errors."""
    image, target = np.ones((pixels, pixels)), np.zeros((pixels, pixels))
    target[pixels // 2, pixels // 3] = 1.0
    exact = math.sqrt(pixels**2 - 1.0)
    with np.errstate(divide="ignore"):
        naive = math.sqrt(float(np.mean(((image / pixels**2 - target) / target) ** 2)))
    return abs(naive / exact - 1.0), abs(metrics.relative_rms(image, target) / exact - 1.0)


CASES = (
    # the roundings of the radicand n^2 c^2 + ..., less than 30 in all, change its root by 30 eps / (2 cos^2)
    Case(
        "1e-1 to 1e-6 rad from the critical angle",
        "derivative of the power, in 30 eps / cos²",
        "0 times an infinite slope beyond",
        1.0,
        critical,
        (1e-1, 1e-3, 1e-6),
    ),
    # sums and products of positive terms: some ten roundings
    Case("indices of 1 + 1e-12 to 1 + 1e-6", "deflection, relative", "s - n c cancels", 1e-14, faint_index, (1e-12, 1e-9, 1e-6)),
    # a quotient and its square: some ten roundings
    Case(
        "rays all but parallel to the screen",
        "derivative of the place, relative",
        "0 times infinity in the derivative",
        1e-14,
        parallel,
        (1e-1, 1e-4, 1e-8),
    ),
    # a mean of N equal terms: log2 N roundings
    Case("all rays lost", "the relative error, which is 1", "0 / 0", 1e-14, dark, (12, 256)),
    # a mean of N terms and a root
    Case("targets of one bright pixel", "the error, relative", "divides by the dark pixels", 1e-13, one_bright_pixel, (16, 256)),
)
