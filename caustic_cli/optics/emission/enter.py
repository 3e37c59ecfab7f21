"""Rays through the lens' flat entrance (thesis 4.3.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.interface import reflectance, reflectances
from caustic_cli.optics.polarisation import beyond, field_of, part_s
from caustic_cli.scene import Scene


def enter(scene: Scene, x: Tensor, y: Tensor, dx: Tensor, dy: Tensor, dz: Tensor, share: Tensor, emitted: float) -> Bundle:
    """Rays of unit directions through points of the flat entrance: Snell keeps n (d_x, d_y), Fresnel takes its part.

    share: power of each that arrives there; emitted: of all at their source.
    """
    lens, n = scene.lens, scene.lens.inside
    ux, uy = dx / n, dy / n
    uz = torch.sqrt(1.0 - ux * ux - uy * uy)
    kind, field = "none" if lens.mirror else lens.fresnel, None
    if kind == "exact" and scene.light.polarisation is not None:
        before, after, flat = (dx, dy, dz), (ux, uy, uz), (0.0, 0.0, 1.0)
        e = field_of(scene.light.polarisation, before)
        (rs, rp), s = reflectances(dz, uz, 1.0 / n), part_s(e, before, flat)
        reflected, field = (s * rs + (1.0 - s) * rp) * share, beyond(e, before, after, flat, dz, uz, 1.0 / n)
    else:
        reflected = reflectance(kind, dz, uz, 1.0 / n) * share
    arriving, lost = float(share.sum()), float(reflected.sum())
    return Bundle(x, y, lens.z_in, ux, uy, uz, share - reflected, {"missed_lens": emitted - arriving, "fresnel": lost}, field,
                  lens.half_size[0] if lens.round else None)
