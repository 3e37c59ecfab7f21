"""CUDA kernels of the stages ray by ray: those of `kernels.stage`, with batches of one ray."""

from __future__ import annotations

from functools import cache

from numba import cuda, float64

from caustic_cli.optics.kernels.cuda.launch import device, start
from caustic_cli.optics.kernels.stage import RayStage


def _kernel(batch, rows: int):
    """A kernel that runs a batch function over all rays."""
    run = device(batch)

    @cuda.jit
    def kernel(count, ray, parameters, given, out):
        v = cuda.local.array((rows, 1), float64)
        for k in range(cuda.grid(1), count, cuda.gridsize(1)):
            run(v, k, 1, ray, parameters, given, out)

    return kernel


def _run(kernel, count: int, *arguments) -> None:
    start(kernel, count, count, *arguments)


@cache
def on_device(stage: RayStage) -> RayStage:
    """A stage for tensors on the device."""
    return RayStage.of(stage.batches[0], stage.batches[1], stage.rows, stage.outputs, _kernel, _run)
