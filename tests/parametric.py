"""Parametric B-spline and NURBS surfaces (u, v) -> points, by the quotient rule: an oracle for height fields and their NURBS."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace


@dataclass(frozen=True, eq=False)
class Surface:
    """A B-spline surface, or a NURBS surface when it has weights (eqs. 2.4.7, 2.4.8).

    Args:
        spaces: the spline spaces along u and v.
        points: (n, m, d) control points.
        weights: (n, m) positive NURBS weights, or None for a plain B-spline.
    """

    spaces: tuple[SplineSpace, SplineSpace]
    points: Tensor
    weights: Tensor | None = None

    def __post_init__(self):
        expected = (self.spaces[0].n, self.spaces[1].n)
        if self.points.ndim != 3 or tuple(self.points.shape[:2]) != expected:
            raise InputError(f"control points must have shape {expected} x d, got {tuple(self.points.shape)}")
        if self.weights is not None:
            if tuple(self.weights.shape) != expected:
                raise InputError(f"NURBS weights must have shape {expected}, got {tuple(self.weights.shape)}")
            if not bool((self.weights > 0).all()):
                raise InputError("NURBS weights must all be positive")

    def _polynomial(self, net: Tensor, u: Tensor, v: Tensor, du: int, dv: int) -> Tensor:
        """Sum of N_i^(du)(u) N_j^(dv)(v) net_ij: (..., d)."""
        (i, bu), (j, bv) = self.spaces[0].basis(u, du), self.spaces[1].basis(v, dv)
        rows = i[..., None] + torch.arange(bu.shape[-1], device=i.device)
        cols = j[..., None] + torch.arange(bv.shape[-1], device=j.device)
        local = net[rows[..., :, None], cols[..., None, :]]  # (..., p + 1, q + 1, d)
        return torch.einsum("...a,...b,...abd->...d", bu.to(net.dtype), bv.to(net.dtype), local)

    def evaluate(self, u: Tensor, v: Tensor, du: int = 0, dv: int = 0) -> Tensor:
        """The point, or the mixed partial derivative d^(du+dv) S / du^du dv^dv, at u, v (...): (..., d).

        Any order for a B-spline; for a NURBS by the quotient rule (Piegl & Tiller, eq. 4.20), also any order.
        """
        if self.weights is None:
            return self._polynomial(self.points, u, v, du, dv)
        w = self.weights[..., None]
        homogeneous = torch.cat([self.points * w, w], -1)
        known: dict[tuple[int, int], Tensor] = {}
        table = {(a, b): self._polynomial(homogeneous, u, v, a, b) for a in range(du + 1) for b in range(dv + 1)}
        for a in range(du + 1):
            for b in range(dv + 1):
                value = table[a, b][..., :-1]
                for k in range(a + 1):
                    for m in range(b + 1):
                        if k or m:
                            value = value - comb(a, k) * comb(b, m) * table[k, m][..., -1:] * known[a - k, b - m]
                known[a, b] = value / table[0, 0][..., -1:]
        return known[du, dv]

    def insert(self, new_u=(), new_v=()) -> Surface:
        """The same surface over finer knot vectors."""
        (su, tu), (sv, tv) = self.spaces[0].insert(new_u), self.spaces[1].insert(new_v)

        def carry(net: Tensor) -> Tensor:
            return torch.einsum("ai,bj,ijd->abd", tu.to(net), tv.to(net), net)

        if self.weights is None:
            return Surface((su, sv), carry(self.points))
        w = carry(self.weights[..., None])
        return Surface((su, sv), carry(self.points * self.weights[..., None]) / w, w[..., 0])
