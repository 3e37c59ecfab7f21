"""Rays of any direction, just inside the flat entrance of the lens."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Bundle:
    """Rays that start at (x, y, z) in unit directions (dx, dy, dz) inside the lens; x .. dz (N,) float64, z one for all, mm.

    share (N,): power each carries in, a part of what the source emits.  lost: what these rays' part of the source lost before
    the lens' inside, by name ("missed_lens", "fresnel"): with share it sums to the rays' part of the source.  field: unit vectors
    (N,) of polarised light, see `polarisation`; None where that is not asked for.  radius: of a circular aperture, mm, beyond
    which there is no surface; None where there is all of it.
    """

    x: Tensor
    y: Tensor
    z: float
    dx: Tensor
    dy: Tensor
    dz: Tensor
    share: Tensor
    lost: dict[str, float]
    field: tuple[Tensor, Tensor, Tensor] | None = None
    radius: float | None = None
