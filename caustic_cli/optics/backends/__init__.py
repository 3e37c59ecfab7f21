"""Computational backends: implementations of the stages of a trace, selected by device.

Stages, each with its adjoint
    scatter                    random points of the aperture
    spline_on, spline_at       height and slopes of a B-spline at a sample, or at given points
    intersect, intersect_spline, intersect_fixed   intersections with any surface, with a B-spline, or of fixed rays with a B-spline
    find, finder, next_intersections   first and next intersections without derivatives
    flow                       ray integration in a gradient-index medium
    interact                   refraction with Fresnel losses, or reflection
    land                       ray transfer to a plane
    splat                      accumulation on pixels
    exposure, path_change      of the wave image: a field's power on pixels, and changes of its optical paths

`reference.Torch` implements every stage in plain torch, on any device; `cpu.Numba` uses compiled kernels.  Callers do not depend
on which one is used.  The kernels are differentiated in reverse mode only: within a dual level of forward mode the reference stands
in for them.  CAUSTIC_KERNELS=torch selects the reference on a CPU, too.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module

import torch
from torch import Tensor
from torch.autograd import forward_ad

from caustic_cli.errors import InputError
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.scene import Screen

#: Name -> module and class, imported on demand: surfaces and backends refer to each other, and numba is slow to load.
BACKENDS = {"torch": ("reference", "Torch"), "numba": ("cpu", "Numba")}
#: A fused kernel: heights, upright screen and filter -> image, power behind the surface, and losses there.
Fused = Callable[[Tensor, Screen, Filter], tuple[Tensor, Tensor, dict]]
#: Accepted values of CAUSTIC_KERNELS.
KERNELS = ("", "torch")


def in_forward_mode() -> bool:
    """Whether a dual level of forward-mode differentiation is entered (`torch.autograd.forward_ad`)."""
    return forward_ad._current_level >= 0


def primal(value: Tensor) -> Tensor:
    """The value without derivatives of either mode."""
    return forward_ad.unpack_dual(value).primal.detach()


def differentiated(*values: Tensor) -> bool:
    """Whether one of the values has derivatives, of either mode."""
    if torch.is_grad_enabled() and any(value.requires_grad for value in values):
        return True
    return in_forward_mode() and any(forward_ad.unpack_dual(value).tangent is not None for value in values)


def backend_for(device: torch.device | str):
    """The backend for tensors on `device`: the kernels on a CPU, the reference elsewhere and in forward mode."""
    kernels = os.environ.get("CAUSTIC_KERNELS", "")
    if kernels not in KERNELS:
        raise InputError(f"the environment's CAUSTIC_KERNELS must be torch, or not be set, got {kernels!r}")
    plain = kernels == "torch" or in_forward_mode() or torch.device(device).type != "cpu"
    return _made("torch" if plain else "numba")


def usable(backend):
    """The backend itself; in forward mode the reference."""
    return _made("torch") if in_forward_mode() else backend


@contextlib.contextmanager
def plain() -> Iterator[None]:
    """A context in which rays are traced by the plain-torch reference."""
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
