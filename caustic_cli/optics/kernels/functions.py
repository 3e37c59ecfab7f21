"""The kernels as differentiable torch functions: reverse mode by the written adjoint, forward mode by the tangent."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import blocks, plane, spline
from caustic_cli.optics.reconstruction import Filter, padding
from caustic_cli.scene import Screen

_FRESNEL = {"none": plane.NONE, "schlick": plane.SCHLICK, "exact": plane.EXACT}
_KIND = {"bincount": plane.BINCOUNT, "gaussian": plane.GAUSSIAN, "cosine": plane.COSINE}


def _blocks() -> int:
    """Blocks to cut the rays into; numba's threads follow torch's."""
    count = blocks()
    numba.set_num_threads(max(1, min(count, numba.config.NUMBA_NUM_THREADS)))
    return count


def plane_image(surface, rays: tuple[Tensor, Tensor, Tensor], index: float, fresnel: str, height: float, screen: Screen,
                filter: Filter) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """The fused form of `tracing.trace_plane` and `reconstruction.splat`.

    Args:
        surface: sag, dz/dx, dz/dy of the rays, (a, b) or (N,); differentiable.
        rays: x, y mm and share, parts of the source's power, broadcastable to them.
        height: of the screen above the sag's zero, mm.

    Returns:
        image (n_x, n_y) and the power leaving the lens (), float64, differentiable; what was lost, by name.
    """
    shape = tuple(surface[0].shape) if surface[0].ndim == 2 else (len(surface[0]), 1)
    grid = [np.broadcast_to(t.numpy().reshape(t.shape if t.ndim != 1 else (-1, 1)), shape) for t in rays]
    size = tuple(2 * r + 1 for r in filter.reach)
    arguments = (*grid, float(index), _FRESNEL[fresnel], float(height), screen.half_size, screen.pixel, screen.resolution,
                 _KIND[filter.kind], size, tuple(float(a) for a in filter.alpha), _blocks())
    padded, leaving, ledger = _PlaneImage.apply(*(s.reshape(shape) for s in surface), arguments)
    (nx, ny), (rx, ry) = screen.resolution, filter.reach
    image = padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny]
    return image, leaving, {"fresnel": ledger[plane.FRESNEL], "total_internal_reflection": ledger[plane.REFLECTED],
                            "off_screen": ledger[plane.OFF_SCREEN] + padding(padded.detach(), filter.reach)}


class _PlaneImage(torch.autograd.Function):
    """(sag, gx, gy) (a, b) and the kernel's other arguments -> padded image, power leaving the lens (), ledger (4,)."""

    @staticmethod
    def forward(sag: Tensor, gx: Tensor, gy: Tensor, arguments: tuple):
        image, ledger = plane.forward(sag.numpy(), gx.numpy(), gy.numpy(), *arguments)
        return torch.from_numpy(image), torch.tensor(ledger[plane.LEAVING], dtype=torch.float64), torch.from_numpy(ledger)

    @staticmethod
    def setup_context(ctx, inputs, output):
        *surface, ctx.arguments = inputs
        ctx.save_for_backward(*surface)
        ctx.save_for_forward(*surface)
        ctx.mark_non_differentiable(output[2])

    @staticmethod
    def backward(ctx, by_image, by_leaving, _):
        surface = [t.numpy() for t in ctx.saved_tensors]
        grads = plane.backward(by_image.contiguous().numpy(), float(by_leaving), *surface, *ctx.arguments)
        return *(torch.from_numpy(g) for g in grads), None

    @staticmethod
    def jvp(ctx, *tangents):
        surface = [t.numpy() for t in ctx.saved_tensors]
        along = [np.zeros_like(s) if t is None else t.contiguous().numpy()
                 for t, s in zip(tangents[:3], surface, strict=True)]
        image, leaving = plane.tangent(*along, *surface, *ctx.arguments)
        return torch.from_numpy(image), torch.tensor(leaving, dtype=torch.float64), None


def scattered_points(keys, salts, start: int, stop: int, nu: int, nv: int, stratified: bool) -> tuple[Tensor, Tensor]:
    """The points u, v of rays start..stop of a stratified or uniform `Sampler`: (stop - start,) float64 each."""
    _blocks()
    keys, salts = (tuple(np.uint64(k) for k in pair) for pair in (keys, salts))
    return tuple(torch.from_numpy(a) for a in spline.scatter(keys, salts, start, stop, nu, nv, stratified))


class Axis:
    """A spline space as the kernels take it: knots, breaks, the span of each piece, the degree."""

    def __init__(self, space: SplineSpace):
        self.space = space
        breaks = space.breaks
        spans = torch.searchsorted(space.knots, breaks[:-1].contiguous(), right=True) - 1
        self.arguments = (space.knots.numpy(), breaks.numpy(), spans.numpy(), space.degree)


class ScatteredSurface(torch.autograd.Function):
    """Heights (n, m) and points -> z, dz/dx, dz/dy (N,) in `dtype`; linear in the heights."""

    @staticmethod
    def forward(heights: Tensor, u: np.ndarray, v: np.ndarray, axes: tuple[Axis, Axis], scale, dtype: torch.dtype):
        out = [torch.empty(len(u), dtype=dtype) for _ in range(3)]
        spline.evaluate(u, v, heights.double().contiguous().numpy(), *axes[0].arguments, *axes[1].arguments, *scale,
                        *(t.numpy() for t in out), _blocks())
        return tuple(out)

    @staticmethod
    def setup_context(ctx, inputs, output):
        heights, *ctx.rest = inputs
        ctx.shape, ctx.heights_dtype = tuple(heights.shape), heights.dtype

    @staticmethod
    def backward(ctx, *grads):
        u, v, axes, scale, _ = ctx.rest
        out = spline.pull_back(u, v, *(g.contiguous().numpy() for g in grads), ctx.shape, *axes[0].arguments,
                               *axes[1].arguments, *scale, _blocks())
        return torch.from_numpy(out).to(ctx.heights_dtype), None, None, None, None, None

    @staticmethod
    def jvp(ctx, tangent, *_):
        return ScatteredSurface.forward(tangent, *ctx.rest)
