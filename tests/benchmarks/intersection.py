"""Rays a second that meet a B-spline surface: Newton's method here beside Mitsuba's triangles (Embree), on the same rays.

    python tests/benchmarks/intersection.py [CELLS ...]      CELLS along each side of Mitsuba's mesh, default 512 1024 1536

needs `pip install mitsuba` beside this program, and for Mitsuba's LLVM variants an LLVM (DRJIT_LIBLLVM_PATH).  The setting is
table D.3's: 15 x 15 cubic control net over 10 x 10 mm, heights sqrt(81 - x^2 - y^2) - 9, a point at (0, 0, -6), directions
even in the cone of half-angle 0.8 rad.  Each round times Mitsuba on every mesh and Newton, so that a change in the machine's
speed meets all; rays are made before, on each one's own side; figures are medians over rounds, ratios medians of rounds'
ratios.  Errors are of t, against Newton's, which is checked against the surface itself.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time

import numpy as np
import torch

try:
    import drjit as dr
    import mitsuba as mi
except ImportError:
    dr = mi = None

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels.ray_intersections import RayIntersections
from caustic_cli.optics.kernels.surface import FusedSurface
from caustic_cli.optics.surfaces.heightfield import HeightField

RAYS, ROUNDS, HALF = 2_000_000, 9, 5.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("cells", type=int, nargs="*", default=[512, 1024, 1536], help="of Mitsuba's meshes, along an axis")
    cells = parser.parse_args().cells
    if mi is None:
        parser.error("Mitsuba 3 is needed: pip install mitsuba")
    mi.set_variant("llvm_ad_mono", "llvm_ad_rgb")
    space = SplineSpace.uniform(15, 3)
    field = HeightField((space, space), (HALF, HALF))
    x, y = field.control_xy()
    heights = torch.sqrt(81.0 - x[:, None] ** 2 - y[None, :] ** 2) - 9.0

    rng = np.random.default_rng(1)
    cosine, angle = 1.0 - rng.random(RAYS) * (1.0 - math.cos(0.8)), rng.random(RAYS) * 2.0 * math.pi
    sine = np.sqrt(1.0 - cosine**2)
    d = np.array([sine * np.cos(angle), sine * np.sin(angle), cosine]).astype(np.float32).astype(float)  # Mitsuba's floats
    zero, *directions = (torch.from_numpy(a) for a in (np.zeros(RAYS), *d))
    newton = RayIntersections(FusedSurface(field.spaces, field.half_size), (zero, zero, -6.0), directions, None)
    ray = mi.Ray3f(mi.Point3f(0.0, 0.0, -6.0), mi.Vector3f(*(mi.Float(a) for a in d)))
    dr.eval(ray)
    scenes = {n: mi.load_dict({"type": "scene", "surface": mesh(field, heights, n)}) for n in cells}

    def triangles(n: int) -> np.ndarray:
        found = scenes[n].ray_intersect_preliminary(ray)
        dr.eval(found.t)
        dr.sync_thread()
        return found.t

    work = {"newton": lambda: newton.find(heights)} | {n: lambda n=n: triangles(n) for n in cells}
    took = {name: [] for name in work}
    for k in range(-1, ROUNDS):  # the first only warms up
        for name, job in work.items():
            began = time.perf_counter()
            job()
            if k >= 0:
                took[name].append(time.perf_counter() - began)

    hit = newton.status == 0
    t = torch.from_numpy(newton.t[hit])
    where = [c[torch.from_numpy(hit)] * t for c in directions]
    residual = (where[2] - 6.0 - field.at(heights, where[0], where[1])[0]).abs().max()
    print(
        f"{RAYS:,} rays, {hit.mean():.3f} of them hit, {torch.get_num_threads()} threads, Mitsuba {mi.__version__}, {mi.variant()}"
    )
    print(
        f"Newton                  {RAYS / statistics.median(took['newton']) / 1e6:6.2f} Mrays/s"
        f"   largest |z - Z(x, y)| {float(residual):.1e} mm"
    )
    for n in cells:
        other = np.array(triangles(n), float)
        both = hit & np.isfinite(other)
        error = abs(other - newton.t)[both]
        ratio = [a / b for a, b in zip(took[n], took["newton"], strict=True)]
        print(
            f"Mitsuba, {n:4} x {n:4} x 2  {RAYS / statistics.median(took[n]) / 1e6:6.2f} Mrays/s"
            f"   error of t: rms {np.sqrt(np.mean(error**2)):.1e}, largest {error.max():.1e} mm;"
            f" hit or missed otherwise {np.sum(hit != np.isfinite(other))};"
            f"   Newton is {statistics.median(ratio):.2f} times as fast ({min(ratio):.2f} to {max(ratio):.2f})"
        )


def mesh(field: HeightField, heights: torch.Tensor, n: int) -> mi.Mesh:
    """The surface as 2 n^2 triangles whose corners lie on it."""
    x = torch.linspace(-HALF, HALF, n + 1, dtype=torch.float64)
    u, v = (c.reshape(-1) for c in torch.meshgrid(x, x, indexing="ij"))
    points = torch.stack([u, v, field.at(heights, u, v)[0]], 1).numpy()
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2)
    made = mi.Mesh("surface", len(points), 2 * n * n)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = mi.Float(points.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    parameters.update()
    return made


if __name__ == "__main__":
    main()
