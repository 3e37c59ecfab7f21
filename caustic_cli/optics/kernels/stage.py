"""Common conventions of the stage kernels: rays by components, in batches, with derivatives only on request.

A component of all rays is an array (N,), or (1,) if it is the same for all: both compile to the same kernel.  A derivative that is
not requested is an array (0,).  Kernels copy a batch of rays to rows of a small scratch array that fits into the L1 cache, and loop
over these rows: their strides are known at compile time, so the loops are vectorised without checks for overlap.  Everything is
float64.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.kernels.jit import FAST, njit

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


def component(value: Tensor | float | None) -> np.ndarray:
    """(N,) of a tensor, (1,) of a number; None stands for 0."""
    if isinstance(value, Tensor):
        return value.detach().contiguous().numpy()
    return np.array([0.0 if value is None else value], np.float64)


def components(values) -> tuple[np.ndarray, ...]:
    """Several of them."""
    return tuple(component(v) for v in values)


def keep(ctx, values: tuple) -> None:
    """Save components for the adjoint: tensors for torch's bookkeeping, numbers separately."""
    tensors = [v if isinstance(v, Tensor) else None for v in values]
    ctx.save_for_backward(*tensors)
    ctx.numbers = [None if isinstance(v, Tensor) else v for v in values]
    ctx.set_materialize_grads(False)


def kept(ctx) -> tuple:
    """The components saved by `keep`."""
    return tuple(n if t is None else t for t, n in zip(ctx.saved_tensors, ctx.numbers, strict=True))


def wanted(ctx, values: int, count: int) -> tuple[np.ndarray, ...]:
    """Output arrays for the derivatives by the first `values` inputs, empty where not needed."""
    return tuple(np.empty(count if need else 0) for need in ctx.needs_input_grad[:values])


def new(values: int, count: int) -> tuple[np.ndarray, ...]:
    """Output arrays for `values` components."""
    return tuple(np.empty(count) for _ in range(values))


def given(ctx, arrays: tuple[np.ndarray, ...]) -> list[Tensor | None]:
    """The requested derivatives, as tensors."""
    return [torch.from_numpy(a) if need else None for a, need in zip(arrays, ctx.needs_input_grad, strict=False)]
