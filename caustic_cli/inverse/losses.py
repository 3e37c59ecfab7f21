"""How far an image is from its target (thesis 5.2).

    rms         sqrt(mean((J / sum J - T / sum T)^2)), eq. 5.2.1.  Light thrown off the screen costs nothing (notes 13).
    rms-light   the same with J / P_out, P_out the power that leaves the lens: every ray counts.

Both sides may be blurred by the same matrices, J -> G_x J G_y^T: the residual is then seen at a coarser scale.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.scene import checks

LOSSES = ("rms", "rms-light")


class NoLight(CausticError):
    """Not one ray reached the screen."""


def gaussian_matrix(n: int, sigma: float) -> Tensor:
    """Blur along one axis by a Gaussian of `sigma` pixels, cut at 4 sigma: (n, n) float64; light leaving the frame is lost."""
    reach = max(1, math.ceil(4.0 * sigma))
    d = torch.arange(n, dtype=torch.float64)
    d = d[:, None] - d[None, :]
    kernel = torch.exp(-0.5 * (d / sigma) ** 2) * (d.abs() <= reach)
    k = torch.arange(-reach, reach + 1, dtype=torch.float64)
    return kernel / torch.exp(-0.5 * (k / sigma) ** 2).sum()


class Loss:
    """A named loss against one target.

    Args:
        name: one of LOSSES.
        target: (n_x, n_y) irradiance to reach, any scale, not all zero, already filtered as the render will be.
        blur: standard deviation in pixels of the Gaussian both sides are seen through; 0 for none.
    """

    def __init__(self, name: str, target: Tensor, blur: float = 0.0):
        self.name = checks.choice("[design] loss", name, LOSSES)
        self.blur = None
        if blur > 0:
            self.blur = tuple(gaussian_matrix(n, blur).to(target) for n in target.shape)
        self.target = target / target.sum()

    def __call__(self, image: Tensor, leaving: Tensor) -> Tensor:
        """Loss of an image (n_x, n_y) made by rays that carried `leaving` out of the lens: scalar, in units of eq. 5.2.1.

        Raises:
            NoLight: no light to compare.
        """
        total = image.sum()
        if not float(total.detach()) > 0:
            raise NoLight("no light reaches the screen, so there is nothing to improve: every ray is reflected inside"
                          " the lens or misses the screen; check index, throw, mag and screen size")
        power = total if self.name == "rms" else leaving
        residual = image / power - self.target
        if self.blur is not None:
            residual = self.blur[0] @ residual @ self.blur[1].T
        square = (residual * residual).mean()
        if not float(square.detach()) > 0:
            return square  # a perfect picture: the root's slope is infinite there, the square's is 0
        return square.sqrt()
