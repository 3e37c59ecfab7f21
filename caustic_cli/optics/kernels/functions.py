"""The kernels as differentiable torch functions: reverse mode by the written adjoint, forward mode by the tangent."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import bend, blocks, plane, shares, spline
from caustic_cli.optics.reconstruction import Filter, padding
from caustic_cli.scene import Screen

_FRESNEL = {"none": bend.NONE, "schlick": bend.SCHLICK, "exact": bend.EXACT}
_KIND = {"bincount": shares.BINCOUNT, "gaussian": shares.GAUSSIAN, "cosine": shares.COSINE}


def _blocks() -> int:
    """Blocks to cut the rays into; numba's threads follow torch's."""
    count = blocks()
    numba.set_num_threads(max(1, min(count, numba.config.NUMBA_NUM_THREADS)))
    if torch.get_num_threads() != count:  # numba's OpenMP layer resets the count it shares with torch when it starts
        torch.set_num_threads(count)
    return count


class _Workspace:
    """Arrays that the kernels overwrite, kept from one call to the next."""

    def __init__(self):
        self.arrays: dict[str, np.ndarray] = {}

    def __call__(self, name: str, *shape: int) -> np.ndarray:
        array = self.arrays.get(name)
        if array is None or array.shape != shape:
            array = self.arrays[name] = np.zeros(shape)
        return array


#: Scattered rays are handed to the kernel in rows of so many.
ROW = 1024


class PlaneKernel:
    """The fused form of a height field at the rays of a plane wave, `tracing.trace_plane` and `reconstruction.splat`.

    Args:
        spaces, half_size: of the height field; half widths in mm.
        u, v: the rays' parameters; with `tensor` all pairs of them, else pairwise.
        share: part of the source's power per ray, scalar or of the rays' shape.
        dtype: of everything stored.
        like: the kernel of another sample, whose basis values along v serve again where v is the same tensor, and whose
            workspace serves both.
    """

    def __init__(self, spaces, half_size, u: Tensor, v: Tensor, tensor: bool, share: Tensor, dtype: torch.dtype,
                 like: PlaneKernel | None = None):
        (su, sv), (rx, ry) = spaces, half_size
        self.dtype, self.tensor, self.v = dtype, tensor, v
        self.workspace = _Workspace() if like is None else like.workspace
        if tensor:
            self.first, bu = su.basis(u)
            du = su.basis(u, 1)[1] / (2.0 * rx)
            self.bu, self.du = (b.to(dtype).contiguous() for b in (bu, du))
            if like is not None and like.v is v:
                self.along_v = like.along_v
            else:
                self.along_v = tuple(m.to(dtype).T.contiguous() for m in (sv.matrix(v), sv.matrix(v, 1) / (2.0 * ry)))
            x, y, shape = u[:, None], v[None, :], (len(u), len(v))
        else:
            columns = min(ROW, len(u))
            short = -len(u) % columns  # rays without power fill the last row
            if short:
                share = torch.nn.functional.pad(share.expand(len(u)), (0, short))
                u, v = (torch.nn.functional.pad(t, (0, short), value=0.5) for t in (u, v))
            shape = (len(u) // columns, columns)
            self.first = torch.arange(shape[0])
            self.bu = self.du = torch.ones(shape[0], 1, dtype=dtype)
            self.points, self.scale = (u.numpy(), v.numpy()), (0.5 / rx, 0.5 / ry)
            self.axes = (Axis(su), Axis(sv))
            x, y, share = u.view(shape), v.view(shape), share.view(shape) if share.ndim else share
        self.shape = shape
        coordinates = ((2.0 * x - 1.0) * rx, (2.0 * y - 1.0) * ry, share)
        self.rays = tuple(_strided(np.broadcast_to(t.to(dtype).numpy(), shape)) for t in coordinates)
        self.rows = (self.first.numpy(), self.bu.numpy(), self.du.numpy())

    def __call__(self, sag: Tensor, index: float, fresnel: str, height: float, screen: Screen,
                 filter: Filter) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Control heights (n, m) relative to some plane, mm, and the screen's height above it, mm.

        Returns:
            image (n_x, n_y) and the power leaving the lens (), float64, differentiable; what was lost, by name.
        """
        if self.tensor:
            net, net_y = (sag.to(self.dtype) @ m for m in self.along_v)  # (n, m_v)
            nets = (net, net, net_y)
        else:
            nets = (t.view(self.shape) for t in _ScatteredSurface.apply(sag, *self.points, self.axes, self.scale, self.dtype))
        size = tuple(2 * r + 1 for r in filter.reach)
        real = (index, height, *screen.half_size, *screen.pixel, *filter.alpha)
        whole = (_FRESNEL[fresnel], *screen.resolution, _KIND[filter.kind], *size)
        arguments = (*self.rays, np.array(real, np.float64), np.array(whole, np.int64))
        padded, leaving, ledger = _PlaneImage.apply(*nets, self.rows, not self.tensor, arguments, self.workspace)
        (nx, ny), (rx, ry) = screen.resolution, filter.reach
        image = padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny]
        return image, leaving, {"fresnel": ledger[plane.FRESNEL], "total_internal_reflection": ledger[plane.REFLECTED],
                                "off_screen": ledger[plane.OFF_SCREEN] + padding(padded.detach(), filter.reach)}


def _strided(array: np.ndarray) -> np.ndarray:
    """The same values read-only and not contiguous: tensor and scattered rays then share one compiled kernel."""
    if array.flags.c_contiguous:
        wide = np.empty((array.shape[0], array.shape[1] + 1), array.dtype)
        wide[:, :-1] = array
        array = np.broadcast_to(wide[:, :-1], array.shape)
    return array


def compile_kernels(*dtypes: torch.dtype) -> None:
    """Have the kernels ready for rays of these precisions: from numba's cache, or compiled for this machine."""
    space, at = SplineSpace.uniform(4, 3), torch.linspace(0.0, 1.0, 2 * ROW, dtype=torch.float64)
    share, screen = torch.tensor(0.25, dtype=torch.float64), Screen((10.0, 10.0), 10.0, (4, 4))
    for dtype in dtypes:
        for tensor in (True, False):
            points = at[:2] if tensor else at
            kernel = PlaneKernel((space, space), (1.0, 1.0), points, points, tensor, share, dtype)
            sag = torch.zeros(4, 4, dtype=dtype, requires_grad=True)
            kernel(sag, 1.5, "exact", 10.0, screen, Filter("cosine", (3, 3)))[0].sum().backward()


class _PlaneImage(torch.autograd.Function):
    """Three nets (n, b), and how `plane.forward` is to use them -> padded image, power leaving the lens (), ledger (4,)."""

    @staticmethod
    def forward(net: Tensor, net_x: Tensor, net_y: Tensor, rows: tuple, apart: bool, arguments: tuple, workspace: _Workspace):
        image, ledger = plane.forward(*_images(arguments, workspace), *rows, *_arrays(net, net_x, net_y), *arguments)
        return torch.from_numpy(image), torch.tensor(ledger[plane.LEAVING], dtype=torch.float64), torch.from_numpy(ledger)

    @staticmethod
    def setup_context(ctx, inputs, output):
        *nets, ctx.rows, ctx.apart, ctx.arguments, ctx.workspace = inputs
        ctx.save_for_backward(*nets)
        ctx.save_for_forward(*nets)
        ctx.mark_non_differentiable(output[2])

    @staticmethod
    def backward(ctx, by_image, by_leaving, _):
        nets = ctx.saved_tensors
        scratch = _images(ctx.arguments, ctx.workspace)[1]
        sums = ctx.workspace("nets", 3, 1 if ctx.apart else len(scratch), *nets[0].shape)
        grads = plane.backward(by_image.contiguous().numpy(), float(by_leaving), ctx.apart, sums, scratch, *ctx.rows,
                               *_arrays(*nets), *ctx.arguments)
        return *(torch.from_numpy(g).to(n.dtype) for g, n in zip(grads, nets, strict=True)), None, None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        nets = ctx.saved_tensors
        along = [torch.zeros_like(n) if t is None else t for t, n in zip(tangents[:3], nets, strict=True)]
        image, leaving = plane.tangent(*_arrays(*along), *_images(ctx.arguments, ctx.workspace), *ctx.rows, *_arrays(*nets),
                                       *ctx.arguments)
        return torch.from_numpy(image), torch.tensor(leaving, dtype=torch.float64), None


def _images(arguments: tuple, workspace: _Workspace) -> tuple[np.ndarray, np.ndarray]:
    """Images and scratch of all blocks, to be overwritten."""
    x, whole, blocks = arguments[0], arguments[-1], _blocks()
    padded = (int(n + 2 * (v - 1)) for n, v in zip(whole[1:3], whole[4:6], strict=True))
    return workspace("images", blocks, *padded), workspace("scratch", blocks, int(plane.scratch_rows(whole)), x.shape[1])


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [t.detach().contiguous().numpy() for t in tensors]


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


class _ScatteredSurface(torch.autograd.Function):
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
        return _ScatteredSurface.forward(tangent, *ctx.rest)
