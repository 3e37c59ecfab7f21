"""How functions of the CPU's kernels become functions of a CUDA device, and how kernels are started there.

Threads stride: thread k of T takes the rays k, k + T, k + 2 T, ...  What a kernel computes does not depend on T.

numba's simulator (NUMBA_ENABLE_CUDASIM=1) runs the same kernels as plain Python on tensors of the CPU, a Python thread for each of
the device's: that is how they are tested where there is no device.
"""

from __future__ import annotations

import types
import warnings
from collections.abc import Callable
from functools import cache

import numba
import torch
from numba import cuda
from numba.core.registry import CPUDispatcher
from torch import Tensor

SIMULATED = bool(numba.config.ENABLE_CUDASIM)  # type: ignore[attr-defined]  # numba makes its settings as it is loaded
#: Threads in a block, and most blocks: enough to fill the largest device several times over; few where each is a thread of Python.
THREADS, BLOCKS = (8, 2) if SIMULATED else (128, 4096)
# numba warns of every grid that leaves a device idle, as that of a few rays does.
numba.config.CUDA_LOW_OCCUPANCY_WARNINGS = False  # type: ignore[attr-defined]  # as above
warnings.filterwarnings("ignore", "Grid size .* will likely result in GPU under-utilization")


class _Within:
    """The module `cuda` inside a running kernel of the simulator, where alone it has atomics."""

    def __getattr__(self, name: str):
        from numba.cuda.simulator.kernel import _get_kernel_context  # noqa: PLC0415

        return getattr(_get_kernel_context(), name)


def _max(a, b):
    """Python's `max` of two, which numba's own target for CUDA (0.68) cannot compile."""
    return b if b > a else a


def _min(a, b):
    """Python's `min` of two."""
    return b if b < a else a


#: Device implementations of builtins, by name.
STAND_INS = {"max": _max, "min": _min}


@cache
def device(function: CPUDispatcher | Callable) -> Callable:
    """A device function: the Python code of a function compiled for the CPU, with all that it calls.

    Its sums of products may be contracted on the device, as on the CPU.
    """
    plain = function.py_func if isinstance(function, CPUDispatcher) else function
    names = dict(plain.__globals__)
    for name in plain.__code__.co_names:
        value = names.get(name)
        if name in STAND_INS and value is None:
            names[name] = device(STAND_INS[name])
        if isinstance(value, CPUDispatcher):
            names[name] = device(value)
        elif SIMULATED and value is cuda:
            names[name] = _Within()
    copy = types.FunctionType(plain.__code__, names, plain.__name__, plain.__defaults__, plain.__closure__)
    return copy if SIMULATED else cuda.jit(device=True)(copy)


def start(kernel, count: int, *arguments) -> None:
    """Run a kernel over `count` rays; tensors, also in tuples, are passed without a copy."""
    if count:
        run(kernel, min(BLOCKS, -(-count // THREADS)), THREADS, tuple(_view(a) for a in arguments))


def run(kernel, blocks: int, threads: int, arguments: tuple) -> None:
    """Launch a kernel on torch's current stream, so that its arrays are used and freed in order."""
    stream = () if SIMULATED else (cuda.external_stream(torch.cuda.current_stream().cuda_stream),)
    kernel[(blocks, threads, *stream)](*arguments)


def array(tensor: Tensor):
    """A tensor as a kernel argument."""
    return tensor.numpy() if SIMULATED else cuda.as_cuda_array(tensor)


def _view(value):
    if isinstance(value, Tensor):
        return array(value.detach())
    if isinstance(value, tuple):
        made = map(_view, value)
        return value._make(made) if hasattr(value, "_make") else tuple(made)
    return value
