"""The interaction with a smooth surface: refraction with Fresnel losses, or reflection by a mirror.

The fused form of `interface` and `polarisation.s_fraction`, differentiable in reverse mode by direction, slopes,
power and field; formulas are with the kernels, in `refraction` and `mirror`.
"""

from __future__ import annotations

from torch import Tensor

from caustic_cli.optics.kernels import mirror, refraction
from caustic_cli.optics.kernels.fresnel import FRESNEL
from caustic_cli.optics.kernels.stage import here


def interact(direction, slopes, power: Tensor, *, eta: float, reflects: bool, fresnel: str, field=None, on=here):
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
        on: what makes a stage one of the rays' device.

    Returns:
        direction: three tensors (N,), finite but meaningless where light is totally reflected.
        power: (N,), 0 where light is totally reflected.
        passes: (N,) bool, False where it is.
    """
    if reflects:
        *t, passes = on(mirror.REFLECT)((), *direction, *slopes)
        return tuple(t), power, passes
    polarised = field is not None and fresnel == "exact"
    surface = refraction.Interface(float(eta), FRESNEL[fresnel], polarised)
    *t, after, passes = on(refraction.REFRACT)(surface, *direction, *slopes, power, *(field if polarised else (0.0, 0.0, 0.0)))
    return tuple(t), after, passes
