"""Principal curvatures of a height field.

With slopes g = (z_x, z_y), s = 1 + |g|^2 and second derivatives z_xx, z_xy, z_yy, for the normal towards +z:

    mean      H = ((1 + z_y^2) z_xx - 2 z_x z_y z_xy + (1 + z_x^2) z_yy) / (2 s^(3/2))
    Gaussian  K = (z_xx z_yy - z_xy^2) / s^2
    largest principal curvature   k = H + sqrt(H^2 - K),  1/mm; where k > 0 the surface is concave seen from +z, of radius 1 / k
"""

from __future__ import annotations

from torch import Tensor

#: Orders of the derivatives by (x, y) that `largest` takes, in the order of its arguments.
ORDERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
#: Relative difference below which the principal curvatures count as equal: it keeps the derivative of the square root finite.
EQUAL = 1e-12


def largest(zx: Tensor, zy: Tensor, zxx: Tensor, zxy: Tensor, zyy: Tensor) -> Tensor:
    """Largest principal curvature, 1/mm, of the shape of the arguments; differentiable."""
    s = 1.0 + zx * zx + zy * zy
    mean = ((1.0 + zy * zy) * zxx - 2.0 * zx * zy * zxy + (1.0 + zx * zx) * zyy) / (2.0 * s * s.sqrt())
    gauss = (zxx * zyy - zxy * zxy) / (s * s)
    scale = EQUAL * (mean * mean).detach() + 1e-300
    return mean + (mean * mean - gauss).clamp_min(0.0).add(scale).sqrt()
