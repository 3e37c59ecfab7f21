"""Loss functions: the distance between an image and its target (thesis 5.2, 6.4, 7.2).

Every term is a dimensionless root mean square t; r is the relative residual N (J / P - T / sum T) on N pixels.

    rms         r with P = sum J, eq. 5.2.1.  Light beside the screen has no influence (erratum E13).
    rms-light   r with P = P_out, the power that leaves the lens: light beside the screen counts as missing.
    throughput  t^2 is the fraction of the light beside the screen, weighted by its distance from it (1 at the apron's rim), which
                has a gradient where that of rms-light, which does not depend on the distance, vanishes
    light       t^2 is the fraction of the light on the lens that does not reach the screen; light beside the screen is weighted by
                its distance, as in throughput, so that there is a gradient
    diffusion   the Laplacian of r, with P = P_out: penalises errors of high spatial frequency
    uniformity  standard deviation of J over its mean where the target is not dark (5.2)
    log-rms     the least relative error inside the picture at a given fraction of the light, for laser beams, see `Region`:
                t^2 = log(1 + (e^2 + d^2) / e_0^2) + w max(0, a + m - b)^2, with e the relative error in the mask, b the fraction in
                the region of the light that leaves the lens, a that of the picture times the wanted efficiency, and m a margin.
                The second term, of rank one, acts below the goal alone; the logarithm keeps the first in proportion to it at every
                error.  d^2 = k mean(max(0, 1 - I' / (D T))^2) counts pixels that are much darker than the picture once more: a zero
                of the field among them, a vortex, would remain.  Light outside the region is free
    laplacian, curvature    of the lens, see `penalties`

Image and target may both be blurred, J -> G_x J G_y^T, so that the residual is compared at a coarser scale.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.inverse.loss_terms import LOSSES, parse
from caustic_cli.loading import OnDemand

if TYPE_CHECKING:
    from caustic_cli.optics.region import Region

bright_parts = OnDemand("caustic_cli.optics.region")

#: e_0, an error too small to matter; w and m of log-rms; D and k.
LEAST, WEIGHT, BEYOND = 1e-4, 1e6, 3e-4
DARK, DARKER = 0.4, 3.0
IN_THE_DARK = "no light reaches the bright part of the picture"


class NoLight(CausticError):
    """Not one ray reached the screen."""


def gaussian_matrix(n: int, sigma: float) -> Tensor:
    """Gaussian blur along one axis with standard deviation `sigma` pixels, truncated at 4 sigma: (n, n) float64, dark beyond the
    frame."""
    reach = max(1, math.ceil(4.0 * sigma))
    d = torch.arange(n, dtype=torch.float64)
    d = d[:, None] - d[None, :]
    kernel = torch.exp(-0.5 * (d / sigma) ** 2) * (d.abs() <= reach)
    k = torch.arange(-reach, reach + 1, dtype=torch.float64)
    return kernel / torch.exp(-0.5 * (k / sigma) ** 2).sum()


class Loss:
    """Weighted terms against one target: sqrt(sum_k w_k t_k^2) / pixels, so that one of weight 1 is eq. 5.2.1 itself.

    Args:
        text: see `parse`.
        target: (n_x, n_y) irradiance to reach, any scale, not all zero, already filtered as the render will be.
        blur: standard deviation, pixels, of the Gaussian that image and target are blurred by; 0 for none.
        apron: pixels on each side that do not belong to the screen.
        region: (n_x, n_y) bool, where `uniformity` is evaluated; None for where the target is not dark.
        bright: where log-rms looks for light, and for how much; None for the default.
    """

    def __init__(
        self,
        text: str,
        target: Tensor,
        blur: float = 0.0,
        apron: int = 0,
        region: Tensor | None = None,
        bright: Region | None = None,
    ):
        self.terms = [(weight, name) for weight, name in parse(text) if name in LOSSES and weight > 0]
        self.blur = None
        if blur > 0:
            self.blur = tuple(gaussian_matrix(n, blur).to(target) for n in target.shape)
        self.target = target / target.sum()
        #: First and last pixels along each axis, the latter excluded, outside which light is of no influence; None for all.
        self.box: tuple[tuple[int, int], tuple[int, int]] | None = None
        if any(name == "log-rms" for _, name in self.terms):
            self.bright = (bright or bright_parts.Region()).on(self.target, apron)
            self.least = self.bright.goal * self.bright.own
            self.box = self.bright.box if len(self.terms) == 1 else None
        self.region = target > 0 if region is None else region
        beyond = [
            (torch.arange(n).to(target) - apron - 0.5 * (n - 2 * apron - 1)).abs() - 0.5 * (n - 2 * apron - 1) for n in target.shape
        ]
        self.distance = torch.maximum(*torch.broadcast_tensors(beyond[0][:, None], beyond[1][None, :])).clamp_min(0.0)
        self.apron = apron

    def __call__(self, image: Tensor, leaving: Tensor, penalty: Tensor | float = 0.0, entering: Tensor | None = None) -> Tensor:
        """Loss of an image (n_x, n_y) made by rays that carried `leaving` out of the lens: scalar, in units of eq. 5.2.1.

        penalty: weighted sum of squared penalty terms of the surface; entering: power on the lens, None for `leaving`.

        Raises:
            NoLight: the image is black.
        """
        total = image.sum()
        if not float(total.detach()) > 0:
            raise NoLight(
                "no light reaches the screen, so there is nothing to improve: every ray is absorbed or"
                " reflected inside the lens, or misses the screen; check index, absorption, throw, mag and screen size"
            )
        entering = leaving if entering is None else entering
        square = sum(weight * self._square(name, image, leaving, entering, total) for weight, name in self.terms) + penalty
        pixels = self.target.numel()
        if not float(square.detach()) > 0:
            return square / pixels  # zero loss: the square root has no derivative there, its square has
        return square.sqrt() / pixels

    def _square(self, name: str, image: Tensor, leaving: Tensor, entering: Tensor, total: Tensor) -> Tensor:
        if name == "throughput":
            return (image * self.distance).sum() / (self.apron * leaving)
        if name == "light":
            return 1.0 - (image * (1.0 - self.distance / max(self.apron, 1))).sum() / entering
        if name == "log-rms":
            if not float(image.detach()[self.bright.mask].sum()) > 0:
                raise NoLight(f"{IN_THE_DARK}, so its relative error is undefined; check throw, mag and screen size")
            ratio, part = self.bright.ratio(image), self.bright.light(image) / leaving
            square = (ratio - 1.0).square().mean() + DARKER * (1.0 - ratio / DARK).clamp_min(0.0).square().mean()
            short = (self.least + BEYOND - part).clamp_min(0.0)
            return torch.log1p(square / LEAST**2) + WEIGHT * short * short
        if name == "uniformity":
            inside = image[self.region]
            if not float(inside.detach().sum()) > 0:  # a black region would count as uniform
                raise NoLight(f"{IN_THE_DARK}, so uniformity is undefined; check throw, mag and screen size")
            return (inside / inside.mean()).var(correction=0)
        residual = image / (total if name == "rms" else leaving) - self.target
        if self.blur is not None:
            residual = self.blur[0] @ residual @ self.blur[1].T
        if name == "diffusion":
            padded = torch.nn.functional.pad(residual[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
            residual = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:] - 4.0 * residual
        return (residual * residual).sum() * self.target.numel()


class ColorLoss:
    """Root mean square of the losses of the red, green and blue channels; channels without light in the target are left out.

    Args:
        target, region: (3, n_x, n_y); all others as of `Loss`.
    """

    def __init__(self, text: str, target: Tensor, blur: float, apron: int, region: Tensor, bright: Region | None = None):
        lit = [k for k, t in enumerate(target) if float(t.sum()) > 0]
        self.channels = [(k, Loss(text, target[k], blur, apron, region[k], bright)) for k in lit]
        self.target, self.box = self.channels[0][1].target, None

    def __call__(self, image: Tensor, leaving: Tensor, penalty: Tensor | float = 0.0, entering: Tensor | None = None) -> Tensor:
        """Loss of an image (3, n_x, n_y) by rays that carried `leaving` (3,) of `entering` (3,): scalar, in units of eq. 5.2.1."""
        on_lens = leaving if entering is None else entering
        losses = torch.stack([loss(image[k], leaving[k], penalty, on_lens[k]) for k, loss in self.channels])
        square = (losses * losses).mean()
        return square.sqrt() if float(square.detach()) > 0 else square
