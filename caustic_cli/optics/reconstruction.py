"""Image reconstruction from landing points (splatting): bincount, truncated Gaussian or raised-cosine filters (thesis 4.4).

Notation, in pixels (w = 1)
    x        landing coordinate, 0 at the lower edge of the frame
    i0       index of its pixel, floor(x);  phi = x - i0 in [0, 1)
    v        filter size, odd;  r = (v - 1) / 2
    d_k      distance k + 1/2 - phi from the centre of pixel i0 + k, k = -r..r

The weights of a ray are normalised over its v x v pixels, so its power is conserved.  Rays within r pixels outside the frame still
contribute to it, and their weights extend to 2 r pixels, so the image is accumulated on a frame padded by 2 r and cropped (errata
E7 and E8).  Power on the padding is counted as lost, never renormalised.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.scene import Screen

FILTERS = ("bincount", "gaussian", "cosine")
MAX_FILTER = 63


@dataclass(frozen=True)
class Filter:
    """A reconstruction filter."""

    #: bincount, gaussian (truncated, C0: eq. 4.4.5) or cosine (raised cosine, C1).
    kind: str = "bincount"
    #: (v_x, v_y) pixels, odd; 1 is bincount along that axis.
    size: tuple[int, int] = (1, 1)
    #: (alpha_x, alpha_y) of the Gaussian per pixel squared; alpha per mm^2 times w^2 (erratum E15).
    alpha: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        if self.kind not in FILTERS:
            raise InputError(f"reconstruction must be one of {', '.join(FILTERS)}, got {self.kind!r}")
        for v in self.size:
            if not (isinstance(v, int) and 1 <= v <= MAX_FILTER and v % 2):
                raise InputError(f"filter size must be an odd number 1 to {MAX_FILTER}, got {v!r}")
        if any(not math.isfinite(a) or a < 0 for a in self.alpha):
            raise InputError(f"alpha must be finite and not negative, got {self.alpha}")

    @property
    def reach(self) -> tuple[int, int]:
        """Radius of the filter, (r_x, r_y) pixels."""
        return (0, 0) if self.kind == "bincount" else ((self.size[0] - 1) // 2, (self.size[1] - 1) // 2)

    def weights(self, phi: Tensor, axis: int) -> Tensor:
        """Weights of a ray at sub-pixel position phi (...) on its v pixels along an axis: (..., v), sum 1."""
        r = self.reach[axis]
        v = 2 * r + 1
        if v == 1:
            return torch.ones_like(phi)[..., None]
        d = torch.arange(-r, r + 1, device=phi.device, dtype=phi.dtype) + 0.5 - phi[..., None]
        if self.kind == "cosine":  # the v shifted cosines cancel: no normalisation needed
            return (1.0 + torch.cos(d * (2.0 * math.pi / v))) / v
        return self._gaussian(d, v, self.alpha[axis])

    @staticmethod
    def _gaussian(d: Tensor, v: int, alpha: float) -> Tensor:
        """exp(-alpha d^2) - exp(-alpha (v/2)^2), normalised; by expm1, since for small alpha both terms are nearly 1."""
        room = (0.25 * v * v - d * d).clamp_min(0.0)
        if alpha == 0.0:  # the limit of small alpha is a parabola
            f = room
        else:  # divided by the largest term, so that a large alpha cannot underflow all of them
            least = (d * d).amin(-1, keepdim=True).detach()
            f = -torch.exp(-alpha * (d * d - least)) * torch.expm1(-alpha * room)
        return f / f.sum(-1, keepdim=True)

    def kernel(self, axis: int) -> Tensor:
        """Mean weights of rays uniformly distributed over a pixel: (v,), float64, sum 1.

        A target convolved with it is filtered like the image of a perfect lens, so that a loss compares like with like.
        """
        fine = 512
        phi = (torch.arange(fine, dtype=torch.float64) + 0.5) / fine
        return self.weights(phi, axis).mean(0)

    def smooth(self, image: Tensor) -> Tensor:
        """`image` (n_x, n_y) convolved with the mean weights; light outside the frame is lost."""
        kernels = [self.kernel(axis).to(image) for axis in (0, 1)]
        out = image[None, None]
        out = torch.nn.functional.conv2d(out, kernels[0].view(1, 1, -1, 1), padding=(self.reach[0], 0))
        return torch.nn.functional.conv2d(out, kernels[1].view(1, 1, 1, -1), padding=(0, self.reach[1]))[0, 0]


def splat(x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
    """Accumulate rays into an image.

    Args:
        x, y: landing points on the screen's plane, mm (any shape, the same); differentiable for filters of size > 1.
        weight: power of each ray; differentiable.

    Returns:
        image (n_x, n_y), power per pixel; off_screen, the power outside the frame; both float64.  They sum to weight.sum().
    """
    x, y, weight = x.reshape(-1), y.reshape(-1), weight.reshape(-1)
    first, weights = [], []
    inside: Tensor | None = None
    for axis, at in ((0, x), (1, y)):
        n, r = screen.resolution[axis], filter.reach[axis]
        at = (at - screen.low[axis]) / screen.pixel[axis]
        near = (at >= -r) & (at < n + r)  # False for NaN and infinity too, so that floor() below is always defined
        at = torch.where(near, at, torch.zeros_like(at))
        i0 = at.detach().floor()
        first.append(i0.long() + r)  # index of the first weight on the padded frame, whose origin is -2 r
        weights.append(filter.weights(at - i0, axis))
        inside = near if inside is None else inside & near
    assert inside is not None
    kept = torch.where(inside, weight, torch.zeros_like(weight))
    (nx, ny), (rx, ry) = screen.resolution, filter.reach
    shape = (nx + 4 * rx, ny + 4 * ry)
    padded = torch.zeros(shape[0] * shape[1], dtype=torch.float64, device=x.device)  # float32 would saturate at 2^24 rays
    for k in range(weights[0].shape[1]):
        at = ((first[0] + k) * shape[1] + first[1])[:, None] + torch.arange(weights[1].shape[1], device=x.device)
        part = (kept * weights[0][:, k])[:, None] * weights[1]
        padded = padded.scatter_add(0, at.reshape(-1), part.reshape(-1).double())
    padded = padded.view(shape)
    image = padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny]
    outside = torch.where(inside, torch.zeros_like(weight), weight).sum(dtype=torch.float64)
    return image, outside + padding(padded, filter.reach)


def padding(padded: Tensor, reach: tuple[int, int]) -> Tensor:
    """Power on the 2 r pixels around the frame of a padded image, summed rather than found by subtraction."""
    (rx, ry), total = reach, padded.new_zeros(())
    if rx:
        total = total + padded[: 2 * rx].sum() + padded[-2 * rx :].sum()
    if ry:
        rows = padded[2 * rx : padded.shape[0] - 2 * rx]
        total = total + rows[:, : 2 * ry].sum() + rows[:, -2 * ry :].sum()
    return total
