"""Optical materials by their common names: dispersion formulas, Abbe number and density.

Two formulas, lambda in micrometres:

    Sellmeier   n^2 - 1 = sum_k B_k lambda^2 / (lambda^2 - C_k)
    Cauchy      n = sum_k A_k lambda^p_k

Schott: optical glass data sheets (https://www.schott.com).  Malitson: J. Opt. Soc. Am. 55, 1205 (1965) for silica,
Appl. Opt. 2, 1103 (1963) for CaF2.  Rubin: Solar Energy Materials 12, 275 (1985).  Daimon: Appl. Opt. 46, 3811 (2007), water at
20 degrees C.  Sultanova et al.: Acta Physica Polonica A 116, 585 (2009) for the plastics.  Norland: data sheet of NOA 61.
Reynoso et al.: Opt. Mater. Express 11, 3392 (2021), who found 1.505 to 1.533 between 670 and 405 nm for three printing resins.
Materials whose index differs from batch to batch are marked `typical`, with a two-term Cauchy formula through n_d and the Abbe
number and the spread of n_d: measure your own and give it as an index.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from typing import Any

from caustic_cli.errors import InputError

#: Fraunhofer lines d (He), F and C (H), nm: where catalogues quote indices.
D_LINE, F_LINE, C_LINE = 587.5618, 486.1327, 656.2725


@dataclass(frozen=True)
class Material:
    """An optical material."""

    #: Reference.
    source: str
    #: Range of validity.
    range_nm: tuple[float, float]
    #: g/cm^3, None if the reference gives none.
    density: float | None
    #: Terms (B_k, C_k), or cauchy: terms (A_k, p_k).
    sellmeier: tuple[tuple[float, float], ...] = ()
    cauchy: tuple[tuple[float, float], ...] = ()
    #: Other names.
    also: tuple[str, ...] = ()
    #: Of n_d between batches, 0 for catalogue glasses.
    spread: float = 0.0

    def index(self, wavelength: float) -> float:
        """Refractive index at `wavelength` nm, without a check of the range."""
        length = wavelength * 1e-3
        if self.cauchy:
            return sum(a * length**p for a, p in self.cauchy)
        return math.sqrt(1.0 + sum(b * length**2 / (length**2 - c) for b, c in self.sellmeier))

    @property
    def abbe(self) -> float:
        """Abbe number V_d = (n_d - 1) / (n_F - n_C)."""
        return (self.index(D_LINE) - 1.0) / (self.index(F_LINE) - self.index(C_LINE))

    @property
    def steepest(self) -> float:
        """Surface slope, mm per mm, at which axial light inside reaches the critical angle: 1 / sqrt(n_d^2 - 1)."""
        return 1.0 / math.sqrt(self.index(D_LINE) ** 2 - 1.0)


def _typical(n_d: float, abbe: float, spread: float, density: float, *also: str) -> Material:
    """A material with a two-term Cauchy formula through typical values of n_d and the Abbe number."""
    b = (n_d - 1.0) / abbe / (1e6 / F_LINE**2 - 1e6 / C_LINE**2)
    cauchy = ((n_d - b * 1e6 / D_LINE**2, 0.0), (b, -2.0))
    return Material("typical", (400, 750), density, cauchy=cauchy, also=also, spread=spread)


# fmt: off
MATERIALS = {
    "PMMA": Material("Sultanova 2009", (437, 1052), 1.19, ((1.1819, 0.011313),),
        also=("acrylic", "acrylic glass", "plexiglass", "plexiglas", "perspex", "lucite", "polymethyl methacrylate")),
    "PC": Material("Sultanova 2009", (437, 1052), 1.20, ((1.4182, 0.021304),), also=("polycarbonate", "lexan", "makrolon")),
    "PS": Material("Sultanova 2009", (437, 1052), 1.05, ((1.4435, 0.020216),), also=("polystyrene", "styrene")),
    "PRINT-RESIN": _typical(1.510, 50.0, 0.01, 1.18, "resin", "clear resin", "SLA resin", "formlabs clear", "photopolymer"),
    "EPOXY": _typical(1.55, 38.0, 0.02, 1.15, "epoxy resin", "casting resin"),
    "POLYURETHANE": _typical(1.50, 45.0, 0.01, 1.10, "PU", "PUR", "urethane"),
    "SILICONE": _typical(1.41, 50.0, 0.02, 1.03, "PDMS", "silicone rubber"),
    "NOA61": Material("Norland", (450, 1550), None, cauchy=((1.5375, 0.0), (0.00829045, -2.0), (-0.000211046, -4.0)),
        also=("Norland 61", "UV adhesive")),
    "N-BK7": Material("Schott", (310, 2500), 2.51,
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)), also=("BK7", "crown", "crown glass")),
    "N-F2": Material("Schott", (365, 2500), 2.65,
        ((1.39757037, 0.00995906143), (0.159201403, 0.0546931752), (1.2686543, 119.248346)), also=("F2", "flint", "flint glass")),
    "N-BAF10": Material("Schott", (350, 2500), 3.75,
        ((1.5851495, 0.00926681282), (0.143559385, 0.0424489805), (1.08521269, 105.613573)), also=("BAF10",)),
    "N-SF11": Material("Schott", (370, 2500), 3.22,
        ((1.73759695, 0.013188707), (0.313747346, 0.0623068142), (1.89878101, 155.23629)), also=("SF11", "dense flint")),
    "SILICA": Material("Malitson 1965", (210, 3710), 2.20,
        ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
        also=("fused silica", "quartz", "quartz glass", "SiO2", "UVFS")),
    "SODA-LIME": Material("Rubin 1985", (310, 2500), 2.50, cauchy=((1.5130, 0.0), (-0.003169, 2.0), (0.003962, -2.0)),
        also=("soda-lime glass", "float glass", "window glass", "glass")),
    "CAF2": Material("Malitson 1963", (230, 9700), 3.18,
        ((0.5675888, 0.050263605**2), (0.4710914, 0.1003909**2), (3.8484723, 34.649040**2)), also=("calcium fluoride", "fluorite")),
    "WATER": Material("Daimon 2007", (200, 1100), 0.998, ((0.5684027565, 0.005101829712), (0.1726177391, 0.01821153936),
        (0.02086189578, 0.02620722293), (0.1130748688, 10.69792721))),
}
# fmt: on
#: Names of metals, which ask for a mirror.
METALS = ("aluminium", "aluminum", "brass", "bronze", "chrome", "copper", "gold", "silver", "steel", "stainless steel", "metal")


def _plain(name: str) -> str:
    """A name without case, blanks and hyphens, for comparison."""
    return "".join(c for c in name.casefold() if c.isalnum())


_BY_NAME = {_plain(other): name for name, material in MATERIALS.items() for other in (name, *material.also)}


def material(name: str) -> Material:
    """The material of this name; case, blanks and hyphens do not matter.

    Raises:
        InputError: it is unknown.
    """
    plain = _plain(name)
    if plain in _BY_NAME:
        return MATERIALS[_BY_NAME[plain]]
    if plain in map(_plain, METALS):
        raise InputError(f"⟨lens.glass⟩ must be a transparent material; {name} is a metal: give ⟨+lens.mirror⟩ instead")
    near = difflib.get_close_matches(plain, _BY_NAME, 1, 0.7)
    hint = f"; did you mean {_BY_NAME[near[0]]}?" if near else "; of any other material, give its ⟨+lens.index⟩"
    raise InputError(f"⟨lens.glass⟩ must be one of {', '.join(MATERIALS)}, got {name!r}{hint}")


def refractive_index(name: str, wavelength: float = D_LINE) -> float:
    """Refractive index of a material, by name, at `wavelength` nm.

    Raises:
        InputError: the material is unknown, or the wavelength outside the range of its formula.
    """
    glass = material(name)
    low, high = glass.range_nm
    if not low <= wavelength <= high:
        raise InputError(f"wavelength for {_BY_NAME[_plain(name)]} must be {low:g} to {high:g} nm, got {wavelength:g}")
    return glass.index(wavelength)


def nearest_index(name: str, wavelength: float) -> float:
    """Refractive index of a material at the nearest wavelength, nm, within the range of its formula: a continuous spectrum has ends
    of little weight beyond it."""
    low, high = material(name).range_nm
    return refractive_index(name, min(max(wavelength, low), high))


def described() -> list[dict[str, Any]]:
    """The materials for JSON: name, n_d and its spread between batches, Abbe number V_d, density in g/cm^3 or None, steepest_slope
    in mm per mm, range_nm, source, and other names; see `Material`."""
    return [
        {
            "name": name,
            "n_d": m.index(D_LINE),
            "spread": m.spread,
            "V_d": m.abbe,
            "density": m.density,
            "steepest_slope": m.steepest,
            "range_nm": list(m.range_nm),
            "source": m.source,
            "also": list(m.also),
        }
        for name, m in MATERIALS.items()
    ]


def rows() -> list[tuple[str, str, str, str, str, str]]:
    """The table of materials as text: name, n_d, Abbe number, density in g/cm^3, slope at the critical angle, other names."""
    return [
        (
            name,
            f"{m.index(D_LINE):.4f}" if not m.spread else f"{m.index(D_LINE):.2f} +- {m.spread:g}",
            f"{m.abbe:.1f}" if not m.spread else f"about {m.abbe:.0f}",
            "-" if m.density is None else f"{m.density:.2f}",
            f"{m.steepest:.2f}",
            ", ".join(m.also),
        )
        for name, m in MATERIALS.items()
    ]
