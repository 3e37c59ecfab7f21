"""The mask and the region of a picture in the light of a laser beam, and the figures of an image there.

Notation
    T, I        picture and image, power per pixel
    mask        pixels where T is above BRIGHT of its peak, or those of a given picture that are not dark
    region      the mask, dilated by a number of pixels
    e           relative error sqrt(mean((I' / T - 1)^2)) over the mask, with I' = I sum T / sum I, sums over the mask
    b           sum of I over the region, over the light that leaves the lens
    efficiency  b over what it is of the picture itself, sum of T over the region over sum of T: 1 of an image that is the picture,
                whose own tails may leave the region

as Pasienski and DeMarco (Opt. Express 16, 2176, 2008) judge holograms, whose light outside the region is free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor

from caustic_cli.errors import InputError

#: Part of the picture's peak above which a pixel belongs to the mask.
BRIGHT = 0.1


@dataclass(frozen=True, eq=False)
class Region:
    """Which light counts, and how much of it is wanted.

    goal: efficiency; dilated: pixels; given: (n_x, n_y) not negative, of the screen, whose lit pixels are the region,
    dilated by nothing.
    """

    goal: float = 0.97
    dilated: int = 0
    given: np.ndarray | None = None

    def on(self, target: Tensor, apron: int = 0) -> Bright:
        """The mask and the region on the pixels of a target, (n_x, n_y), with an apron of dark pixels."""
        mask = target > BRIGHT * target.max()
        inside = dilated(mask.cpu().numpy(), self.dilated)
        if self.given is not None:
            if tuple(n + 2 * apron for n in self.given.shape) != tuple(target.shape):
                raise InputError(f"⟨design.region⟩ must have {' x '.join(str(n - 2 * apron) for n in target.shape)} pixels")
            inside = np.pad(self.given > 0, apron)
        return Bright(self.goal, target, mask, torch.from_numpy(inside).to(target.device))


def dilated(mask: np.ndarray, pixels: int) -> np.ndarray:
    """A mask (n_x, n_y) and the pixels within this distance of it."""
    if pixels == 0:
        return mask
    line = np.arange(-pixels, pixels + 1)
    return binary_dilation(mask, np.hypot(line[:, None], line[None, :]) <= pixels)


@dataclass(frozen=True, eq=False)
class Bright:
    """A mask and a region, (n_x, n_y) bool, of a target, and the wanted efficiency."""

    goal: float
    target: Tensor
    mask: Tensor
    region: Tensor

    @property
    def box(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """First and last pixels of both along each axis, the latter excluded."""
        lit = self.mask | self.region
        rows, columns = (lit.any(k).nonzero()[:, 0] for k in (1, 0))
        return (int(rows[0]), int(rows[-1]) + 1), (int(columns[0]), int(columns[-1]) + 1)

    def ratio(self, image: Tensor) -> Tensor:
        """I' / T of an image (n_x, n_y) at the pixels of the mask (n,)."""
        inside, wanted = image[self.mask], self.target[self.mask]
        return inside / wanted * (wanted.sum() / inside.sum())

    def error(self, image: Tensor) -> Tensor:
        """e of an image (n_x, n_y), ()."""
        return (self.ratio(image) - 1.0).square().mean().sqrt()

    def light(self, image: Tensor) -> Tensor:
        """Sum over the region, ()."""
        return image[self.region].sum()

    @property
    def own(self) -> float:
        """The part of the picture's light that is in the region."""
        return float(self.light(self.target) / self.target.sum())
