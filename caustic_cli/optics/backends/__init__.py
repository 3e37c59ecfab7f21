"""What does the arithmetic: an object that offers the stages of a trace, chosen once for a device.

Stages, each with its adjoint and tangent
    spline_on, spline_at      a B-spline's height and slopes at the points of a sample, or at points
    meet_fixed, meet_spline   where rays meet a B-spline: rays known beforehand, or rays that depend on what came before
    interact                  Snell, Fresnel, or a mirror
    land                      to a plane
    splat                     onto pixels

`reference.Torch` does every stage in plain torch, on any device; `cpu.Numba` does them by kernels.  No caller asks which it has.
CAUSTIC_KERNELS=torch asks for the reference.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from functools import cache

import torch


def backend_for(device: torch.device | str):
    """The backend for tensors on `device`."""
    plain = torch.device(device).type != "cpu" or os.environ.get("CAUSTIC_KERNELS", "") == "torch"
    return _made("torch" if plain else "numba")


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
    if name == "torch":
        from caustic_cli.optics.backends.reference import Torch  # noqa: PLC0415 - backends know surfaces, surfaces this

        return Torch()
    from caustic_cli.optics.backends.cpu import Numba  # noqa: PLC0415 - numba is slow to load

    return Numba()
