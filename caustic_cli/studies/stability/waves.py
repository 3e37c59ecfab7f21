"""Difficult cases of waves."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import torch

from caustic_cli.optics.waves.propagation import phase_of
from caustic_cli.optics.waves.sampling import Sampling
from caustic_cli.studies.stability.case import Case

#: Wavelength, mm.
LENGTH = 550e-6
TURN = 2.0 * math.pi


def long_path(millimetres: float) -> tuple[float, float]:
    """Phase of paths of about this length, which are reduced to one turn before they are rounded, rad."""
    region = (-1.0, -1.0), (1.0, 1.0)
    sampling = Sampling.of(region, region, (0.1, 0.1), millimetres, (LENGTH,))
    n = sampling.count
    paths = millimetres + torch.linspace(-1e-3, 1e-3, n[0] * n[1], dtype=torch.float64).view(*n)
    phase, none = (phase_of(p, sampling, LENGTH, LENGTH).float().double() for p in (paths, torch.zeros_like(paths)))
    single = TURN / LENGTH * paths.float()
    naive = ours = 0.0
    with localcontext() as context:
        context.prec = 50
        for i, j in ((0, 0), (n[0] // 2, n[1] // 3), (n[0] - 1, n[1] - 1)):
            turns = Decimal(float(paths[i, j])) / Decimal(LENGTH)
            exact = float(turns - turns.to_integral_value()) * TURN
            naive, ours = (
                max(worst, abs(math.remainder(float(found) - exact, TURN)))
                for worst, found in ((naive, single[i, j]), (ours, phase[i, j] - none[i, j]))
            )
    return naive, ours


# Half a turn in float32 is rounded by 1e-7, and its cell of the phase by as much; 1e4 mm in float64 are known to 2e-8 rad.
CASES = (Case("optical paths of 300 mm to 10 m", "phase, rad", "2 pi L / lambda in float32", 1e-5, long_path, (300.0, 1e4)),)
