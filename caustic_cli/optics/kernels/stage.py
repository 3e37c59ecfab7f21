"""Kernels as differentiable torch functions, by a forward and an adjoint function of arrays; and the stages of a trace that treat
each ray by itself, which are given by two batch functions,

    forward, adjoint (v, start, count, ray, parameters, given, out)

`forward` takes the rays' components `ray` and gives `out`, the results and whether each ray goes on; `adjoint` takes the
derivatives `given` by the results, too, and gives those by the components.  A component of all rays is an array (N,), or (1,) if
it is the same for all: both compile to the same kernel.  A derivative that is not requested is an array (0,).  `v` is a small
scratch array that fits into the L1 cache, into whose rows a batch is copied: their strides are known at compile time, so the loops
over them are vectorised without checks for overlap.  Everything is float64.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.threads import ALL, on_threads

#: Rays in a batch: thirty rows of them fill the L1 cache.
BATCH = 128


@njit(inline="always", **FAST)
def load(component, start, count, out):
    """A batch of one component into a row."""
    if len(component) == 1:
        for j in range(count):
            out[j] = component[0]
    else:
        batch = component[start : start + count]
        for j in range(count):
            out[j] = batch[j]


@njit(inline="always", **FAST)
def store(row, start, count, component):
    """A row into a batch of one component, if it is requested."""
    if len(component):
        batch = component[start : start + count]
        for j in range(count):
            batch[j] = row[j]


@njit(inline="always", **FAST)
def store_flags(row, start, count, flags):
    """Whether the numbers of a row are positive, into a batch."""
    batch = flags[start : start + count]
    for j in range(count):
        batch[j] = row[j] > 0.0


def _kernel(batch, rows: int):
    """A kernel that runs a batch function over all rays."""

    @njit(entry=True, **FAST)
    def kernel(block, count, ray, parameters, given, out, blocks):
        if on_threads(block, blocks, (count, ray, parameters, given, out, blocks)):
            return
        v, end = np.empty((rows, BATCH)), (block + 1) * count // blocks
        for start in range(block * count // blocks, end, BATCH):
            batch(v, start, min(BATCH, end - start), ray, parameters, given, out)

    return kernel


class KernelStage(NamedTuple):
    """A torch function of float64 arrays, differentiable once, in reverse mode, by its kernels.

    forward (parameters, *inputs): its results, of which the first `results` are differentiable.
    adjoint (parameters, inputs, kept, by, wanted): derivatives by the inputs, from those by these results; None where one is not
    wanted.  kept: what `forward` gave, with `keeps`, or nothing.

    An input is a tensor or, for all rays, a number.
    """

    forward: Callable[..., Sequence[np.ndarray]]
    adjoint: Callable[..., Sequence[np.ndarray | None]]
    results: int
    keeps: bool = False
    kernels: tuple = ()

    def __call__(self, parameters, *inputs: Tensor | float) -> tuple[Tensor, ...]:
        """All results."""
        return _Applied.apply(self, parameters, *inputs)


class _Applied(torch.autograd.Function):
    @staticmethod
    def forward(stage: KernelStage, parameters, *inputs):
        return tuple(torch.from_numpy(np.asarray(a)) for a in stage.forward(parameters, *map(array, inputs)))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.stage, ctx.parameters, *values = inputs
        ctx.numbers = [None if isinstance(v, Tensor) else v for v in values]
        ctx.save_for_backward(*(v if isinstance(v, Tensor) else None for v in values), *(output if ctx.stage.keeps else ()))
        ctx.mark_non_differentiable(*output[ctx.stage.results :])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        (stage, count), wanted = (ctx.stage, len(ctx.numbers)), ctx.needs_input_grad[2:]
        tensors, kept = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        inputs = [n if t is None else array(t) for t, n in zip(tensors, ctx.numbers, strict=True)]
        out = stage.adjoint(ctx.parameters, inputs, [t.numpy() for t in kept], [array(t) for t in by[: stage.results]], wanted)
        found = (torch.from_numpy(a).to(t.dtype) if w else None for a, t, w in zip(out, tensors, wanted, strict=True))
        return None, None, *found


def array(value):
    """A tensor as a contiguous float64 array; anything else as it is."""
    return value.detach().double().contiguous().numpy() if isinstance(value, Tensor) else value


def empty(*shape: int) -> np.ndarray:
    """Memory of torch's, which is reused sooner than NumPy's."""
    return torch.empty(shape, dtype=torch.float64).numpy()


def ray_stage(forward, adjoint, rows: int, outputs: int) -> KernelStage:
    """By batch functions: results (N,) of rays, each component a tensor (N,) or a number, and whether each goes on, (N,) bool.

    rows: of scratch that these use; outputs: number of results.
    """
    run, run_back = _kernel(forward, rows), _kernel(adjoint, rows)

    def whole(parameters: tuple, *ray):
        count = _count(ray)
        out, flags = tuple(empty(count) for _ in range(outputs)), np.empty(count, np.bool_)
        run(ALL, count, _components(ray), parameters, (), (out, flags), blocks())
        return *out, flags

    def back(parameters: tuple, ray, _kept, by, wanted):
        count = _count(ray)
        out = tuple(empty(count if w else 0) for w in wanted)
        run_back(ALL, count, _components(ray), parameters, tuple(by), out, blocks())
        return out

    return KernelStage(whole, back, outputs, kernels=(run, run_back))


def _count(ray) -> int:
    """Number of rays."""
    return next(len(c) for c in ray if isinstance(c, np.ndarray))


def _components(ray) -> tuple[np.ndarray, ...]:
    """(N,) of an array, (1,) of a number."""
    return tuple(c if isinstance(c, np.ndarray) else np.full(1, float(c)) for c in ray)
