"""The CUDA kernels through the device's compiler, which needs no device: `test_cuda.py` runs this file as a process.

Every kernel is started as a trace starts it, on tensors of the CPU, and compiled for the types it is given in place of being run.
Prints a line for each.  Ends with status 77 where there is no compiler.
"""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace

import numba
import torch
from numba import cuda
from numba.cuda import dispatcher
from numba.cuda.cudadrv import nvvm

from caustic_cli.optics import trace
from caustic_cli.optics.backends.cuda import Cuda
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.kernels.cuda import launch
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.scene import Lens, PlaneWave, Points, Scene, Screen

#: What PTX is asked for: the first generation with everything that is used here is older.
CAPABILITY = (8, 0)
compiled: dict = {}


def compile_for(kernel, blocks: int, threads: int, arguments: tuple) -> None:
    """In place of `launch.run`."""
    key = kernel, tuple(numba.typeof(a) for a in arguments)
    if key not in compiled:
        compiled[key], _ = cuda.compile_ptx(kernel.py_func, key[1], device=False, cc=CAPABILITY)
        print(f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}", flush=True)


def differentiate(function, *inputs) -> None:
    """A function of tensors to tensors and its gradient."""
    leaves = [v.clone().requires_grad_() for v in inputs]
    torch.autograd.grad(sum(out.sum() for out in function(*leaves) if out.requires_grad), leaves, allow_unused=True)


def main() -> None:
    launch.run, launch.array = compile_for, lambda tensor: tensor.numpy()
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=CAPABILITY)
    backend = Cuda()
    trace.backend_for = lambda device: backend
    screen, cosine = Screen((36.0, 36.0), resolution=(25, 20)), Filter("cosine", (3, 3))
    x, y, z, w = torch.rand(4, 64, dtype=torch.float64)
    up, none = torch.ones_like(x), torch.zeros_like(x)

    for filter in (cosine, Filter("gaussian", (5, 3), (0.3, 30.0))):
        differentiate(lambda x, y, w, filter=filter: backend.splat(x, y, w, screen, filter), x, y, w)
    lens = Lens(control=(7, 9), degree=(3, 4))
    field, heights = HeightField.of(lens), torch.full((7, 9), 5.0, dtype=torch.float64)
    for source, kind in ((PlaneWave(), "lines"), (Points(((0.0, 0.0, -50.0),)), "stratified")):
        scene = Scene(source, lens, screen)
        tracer = trace.Tracer(System.of(scene, field), next(iter(rays_of(scene, kind, 64).chunks(4096))))
        assert tracer.fused is not None

        def image(heights, tracer=tracer):
            out = tracer.expose({"exit": heights}, screen, cosine)
            return out.image, out.leaving

        differentiate(image, heights)
    for polarised in (None, (1.0, 0.0, 0.0)):
        options = {"eta": 1.5, "reflects": False, "fresnel": "exact", "polarised": polarised}

        def refracted(dx, dy, dz, gx, gy, power, options=options):
            out = backend.interact((dx, dy, dz), (gx, gy), power, **options)
            return *out.direction, out.power

        differentiate(refracted, none, none, up, 0.1 * x, 0.1 * y, w)
    mirror = {"eta": 1.0, "reflects": True, "fresnel": "none"}
    differentiate(lambda *r: backend.interact(r[:3], r[3:], w, **mirror).direction, none, none, up, 0.1 * x, 0.1 * y)
    differentiate(lambda *r: backend.land(r[:3], r[3:], (0.0, 0.0, 40.0), screen.axes, 1.0)[:2], x, y, z, none, none, up)

    for (kernel, _), ptx in compiled.items():
        floating = re.search(r"\b(atom|red)\.\S*\.f(32|64)", ptx)
        assert not floating, f"{kernel.py_func.__qualname__} adds floating-point numbers in no fixed order"
    assert any("atom.global.add.u64" in ptx or "red.global.add.u64" in ptx for ptx in compiled.values())


if __name__ == "__main__":
    if not nvvm.is_available():
        sys.exit(77)
    main()
