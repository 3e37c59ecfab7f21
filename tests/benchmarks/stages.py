"""What each stage of a trace costs by itself, forward and backward, in ms.

    python tests/benchmarks/stages.py [THREADS]      some seconds; prints a table

The setting is table D.2's: 562,500 rays, 50 x 50 control net of degree 10, 250 x 250 pixels, everything float64, one thread unless
told otherwise.  Every figure is a median over rounds.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels.grid import GridSurface
from caustic_cli.optics.kernels.refraction import interact
from caustic_cli.optics.kernels.splat import splat_rays
from caustic_cli.optics.kernels.transfer import land
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.scene import Screen

SIDE, ROUNDS = 750, 15
SCREEN = Screen((38.4, 38.4), 300.0, (250, 250))
ALPHA = 0.01 * SCREEN.pixel[0] ** 2  # 1 / cm^2 = 0.01 / mm^2, per pixel
UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def flat(out) -> list[torch.Tensor]:
    return [out] if isinstance(out, torch.Tensor) else [t for part in out for t in flat(part)]


def timed(stage, wanted) -> tuple[float, float]:
    """Median ms of a stage, and of its derivatives by some of its inputs."""
    times = []
    for _ in range(ROUNDS + 1):
        begin = time.perf_counter()
        outs = [t for t in flat(stage()) if t.requires_grad]
        middle = time.perf_counter()
        ones = [torch.ones_like(t) for t in outs]
        again = time.perf_counter()
        torch.autograd.grad(outs, wanted, ones)
        times.append((middle - begin, time.perf_counter() - again))
    return tuple(1e3 * statistics.median(column) for column in zip(*times[1:], strict=True))


def stages() -> dict:
    """Name -> (stage, what it is differentiated by)."""
    generator, count = torch.Generator().manual_seed(0), SIDE * SIDE

    def noise(scale: float) -> torch.Tensor:
        return (scale * torch.randn(count, generator=generator, dtype=torch.float64)).requires_grad_()

    g, power, z = (noise(0.1), noise(0.1)), noise(1.0), noise(0.01)
    dx, dy = noise(0.05).detach(), noise(0.05).detach()
    d = tuple(c.requires_grad_() for c in (dx, dy, torch.sqrt(1.0 - dx * dx - dy * dy)))
    at = (torch.arange(SIDE, dtype=torch.float64) + 0.5) / SIDE
    x, y = ((36.0 * c - 18.0).reshape(-1) for c in torch.meshgrid(at, at, indexing="ij"))
    px, py = ((c + noise(0.1).detach()).requires_grad_() for c in (x, y))
    space = SplineSpace.uniform(50, 10)
    surface = GridSurface((space, space), (10.0, 10.0), at, at)
    heights = torch.randn(50, 50, generator=generator, dtype=torch.float64).requires_grad_()

    def bend(direction, fresnel: str, field=None):
        return lambda: interact(direction, g, power, eta=1.544, fresnel=fresnel, field=field)

    along = (0.0, 0.0, 1.0)
    filters = [Filter(), Filter("gaussian", (3, 3), (ALPHA, ALPHA)), Filter("cosine", (3, 3)), Filter("cosine", (11, 11))]
    return {
        "grid": (lambda: surface(heights), [heights]),
        **{f"interact, plane wave, {f}": (bend(along, f), [*g]) for f in ("none", "schlick", "exact")},
        "interact, plane wave, polarised": (bend(along, "exact", field=(1.0, 0.0, 0.0)), [*g]),
        "interact, any direction, exact": (bend(d, "exact"), [*d, *g, power]),
        "land, plane wave": (lambda: land((x, y, z), d, (0.0, 0.0, 300.0), UPRIGHT, 1.0), [z, *d]),
        "land, any direction": (lambda: land((px, py, z), d, (0.0, 0.0, 300.0), UPRIGHT, 1.0), [px, py, z, *d]),
        **{
            f"splat, {f.kind} {f.size[0]} x {f.size[1]}": (lambda f=f: splat_rays(px, py, power, SCREEN, f), [px, py, power])
            for f in filters
        },
    }


def main(threads: int = 1) -> None:
    torch.set_num_threads(threads)
    print("| stage | forward | backward |\n|---|---|---|")
    for name, (stage, wanted) in stages().items():
        print("| {} | {:.1f} | {:.1f} |".format(name, *timed(stage, wanted)), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("threads", type=int, nargs="?", default=1)
    main(parser.parse_args().threads)
