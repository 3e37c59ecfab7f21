"""The stages of a trace that treat each ray by itself, as differentiable torch functions: each is given by two batch functions.

    forward, adjoint (v, start, count, ray, parameters, given, out)

`forward` takes the rays' components `ray` and gives `out`, the results and whether each ray goes on; `adjoint` takes the
derivatives `given` by the results, too, and gives those by the components.  A component of all rays is an array (N,), or (1,) if
it is the same for all: both compile to the same kernel.  A derivative that is not requested is an array (0,).  `v` is a small
scratch array that fits into the L1 cache, into whose rows a batch is copied: their strides are known at compile time, so the loops
over them are vectorised without checks for overlap.  Everything is float64.
"""

from __future__ import annotations

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

    @njit(**FAST)
    def some(begin, end, ray, parameters, given, out):
        v = np.empty((rows, BATCH))
        for start in range(begin, end, BATCH):
            batch(v, start, min(BATCH, end - start), ray, parameters, given, out)

    @njit(entry=True, **FAST)
    def kernel(block, count, ray, parameters, given, out, blocks):
        if block == ALL:
            on_threads(blocks, (count, ray, parameters, given, out, blocks))
            return
        some(block * count // blocks, (block + 1) * count // blocks, ray, parameters, given, out)

    return kernel


def _run(kernel, count: int, *arguments) -> None:
    """Call such a kernel with tensors, also in tuples, in place of arrays."""
    kernel(ALL, count, *map(_arrays, arguments), blocks())


def _arrays(value):
    if isinstance(value, Tensor):
        return value.numpy()
    return tuple(map(_arrays, value)) if type(value) is tuple else value  # a named one is of numbers


class RayStage(NamedTuple):
    """A stage: the kernels of its batch functions, and how many results it has."""

    kernels: tuple
    outputs: int

    @classmethod
    def of(cls, forward, adjoint, rows: int, outputs: int) -> RayStage:
        """By its batch functions; rows: of scratch that these use."""
        return cls((_kernel(forward, rows), _kernel(adjoint, rows)), outputs)

    def __call__(self, parameters: tuple, *ray: Tensor | float) -> tuple[Tensor, ...]:
        """Results (N,) of rays, each component a tensor (N,) or a number, and whether each goes on, (N,) bool.

        Differentiable once, in reverse mode.
        """
        return _Applied.apply(self, parameters, *ray)


class _Applied(torch.autograd.Function):
    @staticmethod
    def forward(stage: RayStage, parameters: tuple, *ray):
        like = _like(ray)
        out, flags = tuple(torch.empty_like(like) for _ in range(stage.outputs)), torch.empty_like(like, dtype=torch.bool)
        _run(stage.kernels[0], len(like), _components(ray, like), parameters, (), (out, flags))
        return *out, flags

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.stage, ctx.parameters, *ray = inputs
        ctx.save_for_backward(*(v if isinstance(v, Tensor) else None for v in ray))
        ctx.numbers = [None if isinstance(v, Tensor) else v for v in ray]
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(output[-1])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        ray = tuple(n if t is None else t for t, n in zip(ctx.saved_tensors, ctx.numbers, strict=True))
        like, wanted = _like(ray), ctx.needs_input_grad[2:]
        out = tuple(torch.empty_like(like) if w else like.new_empty(0) for w in wanted)
        _run(ctx.stage.kernels[1], len(like), _components(ray, like), ctx.parameters, _components(by[:-1], like), out)
        return None, None, *(a if w else None for a, w in zip(out, wanted, strict=True))


def _like(ray) -> Tensor:
    """A component of all rays, (N,) float64."""
    return next(c for c in ray if isinstance(c, Tensor)).detach().double().contiguous()


def _components(values, like: Tensor) -> tuple[Tensor, ...]:
    """(N,) of a tensor, (1,) of a number; None stands for 0."""
    return tuple(
        v.detach().double().contiguous() if isinstance(v, Tensor) else like.new_full((1,), 0.0 if v is None else float(v))
        for v in values
    )
