"""Rays per second with gradient on a CUDA device, in plain torch, and by the kernels of the CPU beside it.

    python tests/benchmarks/gpu.py [--rays N] [--rounds N]      prints Markdown

An iteration is the image of a plane wave's rays by a lens, and the gradient of a function of it by the control heights, everything
float64 and on the device.  It is measured against the count of rays, the control net, the filter, and for a point source, whose
rays are intersected; the rest is table D.2's setting with a cubic net of 128 x 128 and 250 x 250 pixels.  Every figure is a median
over rounds.  Beside each stands how far image and gradient are from the CPU's (norm of the difference over the norm).  Without a
device it says so and ends with status 2.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import time

import torch

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import tracers
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen

SCREEN = Screen((38.4, 38.4), 300.0, (250, 250))
CHUNK = 1 << 20
COSINE = Filter("cosine", (3, 3))


class Iteration:
    """Image and gradient of one setting on a device."""

    def __init__(self, device: str, rays: int, control: int, filter: Filter, source=None):
        lens = Lens(control=(control, control), degree=(3, 3))
        scene = Scene(source or PlaneWave(), lens, SCREEN)
        field = HeightField.of(lens)
        x, y = (c.numpy() for c in field.control_xy())
        offset = Offset.for_magnification((3, 3), lens.index, SCREEN.z, 5.0)
        heights = offset.thickness + torch.from_numpy(offset.sag(x[:, None], y[None, :]))
        generator = torch.Generator().manual_seed(0)
        heights += 1e-4 * torch.randn(heights.shape, generator=generator, dtype=torch.float64)
        self.heights = heights.to(device).requires_grad_()
        self.by_image = torch.rand(SCREEN.resolution, generator=generator, dtype=torch.float64).to(device)
        sampler = rays_of(scene, "lines" if source is None else "stratified", rays, device=device)
        self.filter, self.count = filter, sampler.count
        self.tracers = list(tracers(scene, field, sampler, torch.float64, CHUNK))

    def __call__(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Image (250, 250), and the gradient (n, n) of its product with `by_image`; chunk by chunk, as a design does."""
        image, gradient = torch.zeros_like(self.by_image), torch.zeros_like(self.heights)
        for traced in self.tracers:
            part = traced.expose({EXIT: self.heights}, SCREEN, self.filter).image
            image += part.detach()
            gradient += torch.autograd.grad((part * self.by_image).sum(), self.heights)[0]
        return image, gradient


def seconds(iteration: Iteration, rounds: int) -> float:
    """Median of an iteration, after one that compiles what it needs."""
    iteration()
    times = []
    for _ in range(rounds):
        _wait()
        begin = time.perf_counter()
        iteration()
        _wait()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def apart(one, other) -> float:
    """The larger relative distance of image and gradient."""
    return max(float((a.cpu() - b.cpu()).norm() / b.cpu().norm()) for a, b in zip(one, other, strict=True))


def settings(rays: int) -> dict[str, dict]:
    """Name -> what `Iteration` takes."""
    base = {"rays": rays, "control": 128, "filter": COSINE}
    out = {f"{count:,} rays": {**base, "rays": count} for count in (rays // 10, rays, 10 * rays)}
    out |= {f"control net {n} x {n}": {**base, "control": n} for n in (32, 128, 512)}
    sizes = [Filter(), COSINE, Filter("cosine", (11, 11)), Filter("gaussian", (3, 3), (0.01, 0.01))]
    out |= {f"filter {f.kind} {f.size[0]} x {f.size[1]}": {**base, "filter": f} for f in sizes}
    return out | {"point source": {**base, "source": Points(((0.0, 0.0, -100.0),))}}


def rows(device: str, rays: int, rounds: int) -> None:
    """Print a table."""
    columns = ["setting", "rays/s on the device", "rays/s on the CPU", "ratio", "from the CPU's"]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for name, setting in settings(rays).items():
        here, there = Iteration(device, **setting), Iteration("cpu", **setting)
        mine, theirs = (here.count / seconds(one, rounds) for one in (here, there))
        print(f"| {name} | {mine:.3g} | {theirs:.3g} | {mine / theirs:.1f} | {apart(here(), there()):.1e} |", flush=True)


def main(rays: int, rounds: int) -> int:
    """The exit status."""
    if not torch.cuda.is_available():
        print("gpu.py: there is no CUDA device here, and no figure without one", file=sys.stderr)
        return 2
    print(f"{torch.cuda.get_device_name()}, {torch.get_num_threads()} threads of the CPU, torch {torch.__version__}\n")
    with contextlib.suppress(KeyboardInterrupt):
        rows("cuda", rays, rounds)
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rays", type=int, default=1_000_000, help="in most settings; one has a tenth, one ten times as many")
    parser.add_argument("--rounds", type=int, default=10)
    taken = parser.parse_args()
    sys.exit(main(taken.rays, taken.rounds))
