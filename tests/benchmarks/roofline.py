"""How near the hot stages are to the limits of this machine: memory bandwidth and arithmetic, both measured here.

    python tests/benchmarks/roofline.py        half a minute on two cores; prints a Markdown table

A stage cannot take less than its bytes at the memory's bandwidth, nor less than its operations at the arithmetic rate; the larger
of the two is its limit, and the attained fraction is the limit over its time.  Bytes are those that a stage must read and write at
least (a written line that was not in the cache is read first), operations those of its formulas: additions and multiplications,
a division or root counted as one.  Medians over rounds in which all stages take turns.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
import torch
from speed import BASE, forward, interleaved, objective

from caustic_cli.optics import kernels
from caustic_cli.optics.kernels import fields
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.waves.wavefront import LastSurface
from caustic_cli.scene import Lens

#: Samples along each axis of the field, of its transform, and control points: those of the default flame; pixels.
FIELD, TRANSFORM, CONTROL, PIXELS = (1312, 1552), (1440, 1680), 503, 250
ROUNDS = 9


class Stage(NamedTuple):
    """A stage: what it is counted in and how often, bytes and operations for each, and a function that runs it."""

    unit: str
    count: int
    bytes: float
    operations: float
    run: Callable[[], object]


@numba.njit(parallel=True, fastmath=True)
def _copy(a, b, c):
    for k in numba.prange(len(a)):
        a[k] = b[k] + 0.5 * c[k]


@numba.njit(parallel=True, fastmath=True)
def _multiply(out, times):
    for k in numba.prange(out.shape[0]):
        row = out[k]
        for _ in range(times):
            for j in range(row.shape[0]):
                row[j] = row[j] * np.float32(0.999) + np.float32(0.001)


def machine() -> tuple[float, float]:
    """Bandwidth, bytes/s, of a sum of arrays far larger than the caches, and operations/s of float32 in the first cache."""
    kernels.blocks()
    a, b, c = (np.ones(1 << 24) for _ in range(3))
    rows, times = np.ones((2 * torch.get_num_threads(), 4096), np.float32), 4000
    found = interleaved({"bandwidth": lambda: _copy(a, b, c), "arithmetic": lambda: _multiply(rows, times)}, ROUNDS)
    return 4.0 * a.nbytes / min(found["bandwidth"]), 2.0 * rows.size * times / min(found["arithmetic"])


def wave_stages() -> dict[str, Stage]:
    """Those of the wave image, for one wavelength."""
    field, (n, m) = HeightField.of(Lens((10.0, 10.0), control=(CONTROL, CONTROL))), FIELD
    samples, points, pieces = math.prod(TRANSFORM), n * m, (CONTROL - 3) ** 2
    phase, amplitude, change = (torch.rand(FIELD) for _ in range(3))
    edges = tuple(torch.linspace(40.0, k - 40.0, PIXELS + 1, dtype=torch.float64) for k in TRANSFORM)
    light = fields.FusedExposure(phase, amplitude, 1e4, TRANSFORM, edges)
    x, y = torch.meshgrid(*(torch.linspace(-5.0, 5.0, k, dtype=torch.float64) for k in FIELD), indexing="ij")
    moved = fields.FusedPathChange(field, LastSurface(x, y, torch.ones(FIELD, dtype=torch.float64)), torch.float32)
    spectrum, heights = light._spectrum(change), 1e-3 * torch.rand(CONTROL, CONTROL, dtype=torch.float64)
    pairs, out, total = fields._pairs(spectrum), np.empty((PIXELS, PIXELS)), torch.zeros(FIELD)
    widened = np.ones((PIXELS, 2 * TRANSFORM[1]), np.float32)
    buffer, blocks = fields._pairs(fields._buffer(TRANSFORM, FIELD)), kernels.blocks()
    transform = 5.0 * math.log2(samples)

    def change_of() -> None:
        moved.spline.last = None  # the coefficients of every evaluation are new
        moved.of(heights)

    return {
        "change of the paths": Stage("sample", points, 20 + 4 + 256 * pieces / points, 40 + 128 * pieces / points, change_of),
        "field": Stage("sample", points, 12 + 16, 34, lambda: fields.make_field(-1, *light._field(change), buffer, blocks)),
        "transform": Stage("sample", samples, 2 * 24, transform, lambda: torch.fft.fft2(spectrum, norm="ortho")),
        "power on pixels": Stage("sample", samples, 8, 6, lambda: fields.on_pixels(-1, pairs, *light.limits, out, blocks)),
        "derivative by the spectrum": Stage(
            "sample", samples, 16, 4, lambda: fields.weigh(-1, pairs, widened, light.limits[0], blocks)
        ),
        "transform back": Stage("sample", samples, 2 * 24, transform, lambda: torch.fft.ifft2(spectrum, norm="ortho")),
        "derivative by the paths": Stage(
            "sample", points, 20 + 8, 38, lambda: fields.make_pull(-1, pairs, *light._field(change), total.numpy(), blocks)
        ),
        "derivative by the heights": Stage(
            "sample", points, 16 + 5 * 8 * 16 * blocks * pieces / points, 45 + 128 * pieces / points, lambda: moved.pull(total)
        ),
    }


def ray_stages() -> dict[str, Stage]:
    """Image and derivative of a plane wave, a row of rays at a time: z and slopes from contracted nets, 11 control points each,
    Snell, Fresnel and landing, weights of 3 x 3 pixels; the derivative reads and writes the same and computes all again."""
    setting = {**BASE, "kind": "cosine", "alpha": 0.0}
    rays, net = setting["rays"], setting["degree"] + 1
    work = 2 * 3 * net + 70 + 9 * 6
    return {
        "rays: image": Stage("ray", rays, 2 * 9 * 8 / 9, work, forward("", **setting)),
        "rays: image and derivative": Stage("ray", rays, 3 * 2 * 9 * 8 / 9, 3 * work, objective("", **setting)),
    }


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    bandwidth, arithmetic = machine()
    stages = wave_stages() | ray_stages()
    times = interleaved({name: stage.run for name, stage in stages.items()}, ROUNDS)
    print(f"memory {bandwidth / 1e9:.1f} GB/s, arithmetic {arithmetic / 1e9:.0f} GFlop/s, {torch.get_num_threads()} threads\n")
    print("| stage | ms | per | ns | bytes | operations | limit | attained |")
    print("| --- | ---: | --- | ---: | ---: | ---: | --- | ---: |")
    for name, stage in stages.items():
        seconds = statistics.median(times[name])
        by_memory, by_operations = stage.count * stage.bytes / bandwidth, stage.count * stage.operations / arithmetic
        limit = "memory" if by_memory > by_operations else "arithmetic"
        print(
            f"| {name} | {1e3 * seconds:.1f} | {stage.unit} | {1e9 * seconds / stage.count:.1f} | {stage.bytes:.0f} |"
            f" {stage.operations:.0f} | {limit} | {max(by_memory, by_operations) / seconds:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    began = time.perf_counter()
    main()
    print(f"\n{time.perf_counter() - began:.0f} s")
