"""The interaction with a smooth surface: refraction with Fresnel losses, or reflection by a mirror.

The fused form of `interface` and `polarisation.s_fraction`, differentiable in reverse mode by direction, slopes,
power and field; formulas are with the kernels, in `refraction` and `mirror`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import blocks, mirror, refraction
from caustic_cli.optics.kernels.axial_refraction import FRESNEL
from caustic_cli.optics.kernels.stage import components, given, keep, kept, new, wanted
from caustic_cli.optics.kernels.threads import ALL


def interact(direction, slopes, power: Tensor, *, eta: float, reflects: bool, fresnel: str, field=None):
    """Direction and power behind a surface z(x, y).

    Args:
        direction: (d_x, d_y, d_z) of unit length, each a tensor (N,) float64 or a number for all rays.  It may run along the
            surface's normal (-z_x, -z_y, 1) or against it.
        slopes: (z_x, z_y) at the hits, (N,) float64.
        power: (N,) float64.
        eta: n_in / n_out.
        reflects: a mirror, which keeps all the power; eta, fresnel and field do not matter then.
        fresnel: none, schlick or exact.
        field: (E_x, E_y, E_z) of linearly polarised light, unit length, tensors or numbers; None for light without
            polarisation.  Only exact Fresnel losses heed it.

    Returns:
        direction: three tensors (N,), finite but meaningless where light is totally reflected.
        power: (N,), 0 where light is totally reflected.
        passes: (N,) bool, False where it is.
    """
    if reflects:
        return _Mirror.apply(*direction, *slopes), power, torch.ones(power.shape, dtype=torch.bool)
    polarised = field is not None and fresnel == "exact"
    surface = refraction.Interface(float(eta), FRESNEL[fresnel], polarised)
    *t, after, passes = _Refraction.apply(*direction, *slopes, power, *(field if polarised else (0.0, 0.0, 0.0)), surface)
    return tuple(t), after, passes


class _Refraction(torch.autograd.Function):
    """d, g, P and E by components, and the surface -> t by components, P' and whether light passes."""

    @staticmethod
    def forward(dx, dy, dz, gx, gy, power, ex, ey, ez, surface: refraction.Interface):
        *t, after = new(4, len(power))
        passes = np.empty(len(power), np.bool_)
        refraction.refract(ALL, components((dx, dy, dz, gx, gy, power, ex, ey, ez)), surface, tuple(t), after, passes, blocks())
        return tuple(torch.from_numpy(a) for a in (*t, after, passes))

    @staticmethod
    def setup_context(ctx, inputs, output):
        *ray, ctx.surface = inputs
        keep(ctx, ray)
        ctx.mark_non_differentiable(output[4])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        ray = components(kept(ctx))
        count = len(ray[5])
        out = wanted(ctx, 9, count)
        refraction.refract_adjoint(ALL, ray, ctx.surface, components(by[:4]), out, count, blocks())
        return *given(ctx, out), None


class _Mirror(torch.autograd.Function):
    """d and g by components -> t by components."""

    @staticmethod
    def forward(dx, dy, dz, gx, gy):
        t = new(3, len(gx))
        mirror.reflect(ALL, components((dx, dy, dz, gx, gy)), t, blocks())
        return tuple(torch.from_numpy(a) for a in t)

    @staticmethod
    def setup_context(ctx, inputs, output):
        keep(ctx, inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        ray = components(kept(ctx))
        count = len(ray[3])
        out = wanted(ctx, 5, count)
        mirror.reflect_adjoint(ALL, ray, components(by), out, count, blocks())
        return tuple(given(ctx, out))
