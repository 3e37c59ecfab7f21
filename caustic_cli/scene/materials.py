"""Refractive indices of a few common glasses and plastics by the Sellmeier equation.

    n^2 - 1 = sum_k B_k lambda^2 / (lambda^2 - C_k),    lambda in micrometres, C_k in micrometres squared

Schott: optical glass data sheets (https://www.schott.com).  Malitson: J. Opt. Soc. Am. 55, 1205 (1965) for silica,
Appl. Opt. 2, 1103 (1963) for CaF2.  Sultanova et al.: Acta Physica Polonica A 116, 585 (2009) for the plastics.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from caustic_cli.errors import InputError

#: Fraunhofer d line (He), nm: where catalogues quote their index.
D_LINE = 587.5618


@dataclass(frozen=True)
class Glass:
    """Sellmeier terms (B_k, C_k), the range of wavelengths they were fitted on (nm), and their source."""

    terms: tuple[tuple[float, float], ...]
    range_nm: tuple[float, float]
    source: str


GLASSES = {
    "N-BK7": Glass(((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)), (310, 2500), "Schott"),
    "N-F2": Glass(((1.39757037, 0.00995906143), (0.159201403, 0.0546931752), (1.2686543, 119.248346)), (365, 2500), "Schott"),
    "N-BAF10": Glass(((1.5851495, 0.00926681282), (0.143559385, 0.0424489805), (1.08521269, 105.613573)), (350, 2500), "Schott"),
    "N-SF11": Glass(((1.73759695, 0.013188707), (0.313747346, 0.0623068142), (1.89878101, 155.23629)), (370, 2500), "Schott"),
    "SILICA": Glass(((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)), (210, 3710), "Malitson 1965"),
    "CAF2": Glass(
        ((0.5675888, 0.050263605**2), (0.4710914, 0.1003909**2), (3.8484723, 34.649040**2)), (230, 9700), "Malitson 1963"
    ),
    "PMMA": Glass(((1.1819, 0.011313),), (437, 1052), "Sultanova 2009"),
    "PC": Glass(((1.4182, 0.021304),), (437, 1052), "Sultanova 2009"),
    "PS": Glass(((1.4435, 0.020216),), (437, 1052), "Sultanova 2009"),
}


def refractive_index(name: str, wavelength: float = D_LINE) -> float:
    """Index of the glass `name` (any case) at `wavelength` nm.

    Raises:
        InputError: the glass is unknown, or the wavelength outside the range of its fit.
    """
    key = name.upper()
    if key not in GLASSES:
        near = difflib.get_close_matches(key, GLASSES, 1, 0.4)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(f"glass must be one of {', '.join(GLASSES)}, got {name!r}{hint}")
    glass = GLASSES[key]
    low, high = glass.range_nm
    if not low <= wavelength <= high:
        raise InputError(f"wavelength for {key} must be {low:g} to {high:g} nm, got {wavelength:g}")
    square = (wavelength * 1e-3) ** 2
    return (1.0 + sum(b * square / (square - c) for b, c in glass.terms)) ** 0.5
