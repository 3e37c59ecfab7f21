"""Regularisation and penalty terms of the lens surface (thesis 6.4): roughness, slope limit, least concave radius of curvature.

Notation
    d       departure of the surface from the offset, mm
    G       (n - 1) T, mm, with T from lens to screen: a curvature d_xx moves light apart by the factor 1 + G d_xx

    laplacian   root mean square of G (d_xx + d_yy): to first order, the variation of the local magnification
    curvature   root mean square of G sqrt(d_xx^2 + 2 d_xy^2 + d_yy^2): the bending energy of a thin plate
    slope       root mean square of 100 max(0, |grad z| / limit - 1)
    radius      root mean square of 100 max(0, k r - 1), k the largest principal curvature, concave seen from the tool (from -z for
                a mirror), r the least concave radius

Means are over the Greville abscissae of the control net.
"""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics import curvature
from caustic_cli.optics.bspline import derivatives_over_grid
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

#: Weight of the relative excess over a limit.
STIFFNESS = 100.0


class Penalty:
    """Weighted sum of squared penalty terms of a surface.

    Args:
        scene, field: the lens and the spline spaces of its heights.
        terms: (weight, name) of `losses.PENALTIES`.
        max_slope: limit of |grad z|, 0 for none.
        min_radius: least radius of curvature of concave regions, mm, 0 for any.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        terms: list[tuple[float, str]],
        max_slope: float = 0.0,
        device: str | torch.device = "cpu",
        min_radius: float = 0.0,
    ):
        self.terms, self.limit, self.radius, self.side = terms, max_slope, min_radius, scene.lens.cut_from
        if min_radius > 0 and min(s.degree for s in field.spaces) < 2:
            raise InputError("⟨design.min_radius⟩ needs splines of degree 2 or more, which have a curvature")
        if terms and min(s.degree for s in field.spaces) < 2:
            raise InputError("⟨design.loss⟩: laplacian and curvature need splines of degree 2 or more")
        (su, sv), (rx, ry) = field.spaces, field.half_size
        self.u = [(su.banded(su.greville, k) / (2.0 * rx) ** k).to(device) for k in range(3)]
        self.v = [(sv.banded(sv.greville, k) / (2.0 * ry) ** k).to(device) for k in range(3)]
        if self:  # the entrance of a two-sided lens is measured from the base, too
            x, y = (c.numpy() for c in field.control_xy())
            offset = scene.lens.offset
            self.base = torch.from_numpy(offset.heights(x, y)).to(device)
            self.gain = (scene.lens.effective_index - 1.0) * (scene.screen.z - offset.thickness)

    def __bool__(self) -> bool:
        return bool(self.terms) or self.limit > 0 or self.radius > 0

    def __call__(self, heights: Tensor) -> Tensor:
        """Heights (n, m) mm -> sum of weighted squares, scalar."""
        total = heights.new_zeros(())
        if self.terms:
            d = self.gain * (heights - self.base)
            xx, xy, yy = derivatives_over_grid(self.u, d, self.v, ((2, 0), (1, 1), (0, 2)))
        for weight, name in self.terms:
            square = (xx + yy) ** 2 if name == "laplacian" else xx * xx + 2.0 * xy * xy + yy * yy
            total = total + weight * square.mean()
        if self.limit > 0:
            zx, zy = derivatives_over_grid(self.u, heights, self.v, ((1, 0), (0, 1)))
            slope2 = zx * zx + zy * zy
            excess = (slope2.clamp_min(1e-300).sqrt() / self.limit - 1.0).clamp_min(0.0)
            total = total + (STIFFNESS * excess).square().mean()
        if self.radius > 0:
            bent = curvature.largest(*(self.side * d for d in derivatives_over_grid(self.u, heights, self.v, curvature.ORDERS)))
            total = total + (STIFFNESS * (bent * self.radius - 1.0).clamp_min(0.0)).square().mean()
        return total
