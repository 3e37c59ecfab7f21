"""Bitwise reproducible sums, independent of the order of additions: 64-bit fixed point.

Integer sums do not depend on the order of additions, floating-point sums do.  A term x is therefore rounded to an integer multiple
of the unit 2^-k and added by integer atomics.  With a bound B >= sum |x| over all terms of any one sum, k is
the largest for which

    B 2^k <= 2^62,    and then    |sum| <= sum (|x| 2^k + 1/2) <= 2^62 + N / 2 < 2^63

for any number of terms N < 2^63: no sum overflows, and twice over there is room for the rounding of B itself.  A unit is at most
2^-61 B, so N terms are summed to N 2^-62 B, however much they cancel.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

#: Binary digits of the largest sum; largest term, in units.
DIGITS, LARGEST = 62, 2.0**62
#: Exponents k kept so that 2^k and 2^-k are normal numbers.
LEAST_EXPONENT, MOST_EXPONENT = -1000, 1000


def unit_of(bound: Tensor) -> Tensor:
    """(2,) float64: 2^k and 2^-k for a bound () of a sum; the second is NaN where the bound is not finite, and with it the sum."""
    finite = torch.isfinite(bound)
    _, exponent = torch.frexp(torch.where(finite, bound.double(), torch.ones_like(bound, dtype=torch.float64)))
    k = (DIGITS - exponent.long()).clamp(LEAST_EXPONENT, MOST_EXPONENT)
    k = torch.where(bound > 0, k, torch.zeros_like(k))
    up, down = (((sign * k + 1023) << 52).view(torch.float64) for sign in (1, -1))  # put together from their bits: exact anywhere
    return torch.stack([up, torch.where(finite, down, torch.full_like(down, torch.nan))])


def units(x: float, unit: float) -> int:
    """A term in integer units; 0 for NaN, and for terms beyond the bound, whose sum is NaN in any case."""
    return math.floor(x * unit + 0.5) if abs(x * unit) <= LARGEST else 0


def value_of(total: Tensor, unit: Tensor) -> Tensor:
    """Sums in units, int64 -> float64."""
    return total.double() * unit[1]
