"""What does the arithmetic: an object that offers the stages of a trace, chosen once for a device.

Stages, each with its adjoint and tangent
    scatter                   points of the aperture, at random
    spline_on, spline_at      a B-spline's height and slopes at the points of a sample, or at points
    meet, meet_spline, meet_fixed   where rays meet any surface, a B-spline, or a B-spline if they are known beforehand
    find, finder, next_meetings   where they meet it, without derivatives, once or again
    flow                      through a medium of varying index
    interact                  Snell, Fresnel, or a mirror
    land                      to a plane
    splat                     onto pixels

`reference.Torch` does every stage in plain torch, on any device; `cpu.Numba` and `cuda.Cuda` do them by kernels.  No caller asks
which it has.  CAUSTIC_KERNELS=torch asks for the reference; CAUSTIC_KERNELS=cuda for the device's kernels on a CPU too, in numba's
simulator (NUMBA_ENABLE_CUDASIM=1), which is for tests.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from functools import cache
from importlib import import_module

import torch

from caustic_cli.errors import InputError

#: Name -> module and class, looked up when they are needed: they know surfaces, which know this, and numba is slow to load.
BACKENDS = {"torch": ("reference", "Torch"), "numba": ("cpu", "Numba"), "cuda": ("cuda", "Cuda")}
#: What CAUSTIC_KERNELS may be.
KERNELS = ("", "torch", "cuda")


def backend_for(device: torch.device | str):
    """The backend for tensors on `device`."""
    kernels = os.environ.get("CAUSTIC_KERNELS", "")
    if kernels not in KERNELS:
        raise InputError(f"the environment's CAUSTIC_KERNELS must be torch or cuda, or not be set, got {kernels!r}")
    if kernels == "torch":
        return _made("torch")
    if torch.device(device).type == "cpu":
        return _made("cuda" if kernels == "cuda" and os.environ.get("NUMBA_ENABLE_CUDASIM") == "1" else "numba")
    return _made("cuda" if cuda_kernels() else "torch")


@cache
def cuda_kernels() -> bool:
    """Whether the kernels of a CUDA device can be compiled here: numba finds a device and a compiler for it, as the extra `cuda`
    brings one."""
    from numba import config, cuda  # noqa: PLC0415

    return not config.ENABLE_CUDASIM and cuda.is_available()  # type: ignore[attr-defined]  # numba makes its settings as it is loaded


@contextlib.contextmanager
def plain() -> Iterator[None]:
    """Rays prepared meanwhile go by the plain-torch reference."""
    before = os.environ.get("CAUSTIC_KERNELS")
    os.environ["CAUSTIC_KERNELS"] = "torch"
    try:
        yield
    finally:
        if before is None:
            del os.environ["CAUSTIC_KERNELS"]
        else:
            os.environ["CAUSTIC_KERNELS"] = before


@cache
def _made(name: str):
    module, kind = BACKENDS[name]
    return getattr(import_module(f"{__name__}.{module}"), kind)()
