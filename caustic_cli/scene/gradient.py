"""Gradient-index (GRIN) media of the lens (thesis 7.2.1): the index distribution of [lens] gradient as data.

Notation
    n_0     the lens' index;  r  distance from the axis, mm;  z  distance from the entrance, mm
    selfoc  n^2 = n_0^2 (1 - (g r)^2), terms (g,), 1/mm: a GRIN rod lens of pitch 2 pi / g (Marchand, Gradient Index Optics)
    radial  n = n_0 + a_1 r^2 + a_2 r^4 + ..., terms (a_1, a_2, ...), mm^-2k
    axial   n = n_0 + a_1 z + a_2 z^2 + ..., terms (a_1, a_2, ...), mm^-k
    volume  control values (n, m, k) of a B-spline volume over aperture and thickness; k = 1 is an index independent of z
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caustic_cli.errors import InputError

KINDS = ("selfoc", "radial", "axial")
#: For a B-spline volume: range of the control values, and their largest number.
INDEX, MOST_VALUES = (1.0, 5.0), 50_000_000
#: Degree of a volume along every axis; where there are too few control values, their number less one.
DEGREE = 3


@dataclass(frozen=True, eq=False)
class Gradient:
    """A gradient-index distribution; see the module.

    Raises:
        InputError: the kind is unknown, the number of terms is wrong, or the volume is invalid.
    """

    #: selfoc, radial, axial or volume.
    kind: str
    #: Coefficients of a formula.
    terms: tuple[float, ...] = ()
    #: (n, m, k) or (n, m) float64 control values.
    volume: np.ndarray | None = None

    def denser(self, by: float) -> Gradient:
        """The distribution in a lens whose index is larger by this: formulas are relative to that, a volume is not."""
        return self if self.volume is None else replace(self, volume=self.volume + by)

    def words(self, index: float) -> str:
        """The distribution in words, in a lens of this index."""
        if self.volume is not None:
            return f"control values of a B-spline over aperture and thickness, {' x '.join(map(str, self.volume.shape))}"
        if self.kind == "selfoc":
            return f"n^2 = {index:g}^2 (1 - ({self.terms[0]:g} r)^2), r in mm from the axis"
        by, each, origin = ("z", 1, "entrance") if self.kind == "axial" else ("r", 2, "axis")
        terms = "".join(f" {'-' if t < 0 else '+'} {abs(t):g} {by}^{each * k}" for k, t in enumerate(self.terms, 1))
        return f"n = {index:g}{terms}, {by} in mm from the {origin}"

    def scaled(self, factor: float) -> Gradient:
        """The distribution n(q / factor) in a lens that is larger by this factor; a volume is over the lens."""
        order = {"selfoc": lambda k: 1, "radial": lambda k: 2 * k, "axial": lambda k: k}.get(self.kind)
        return self if order is None else replace(self, terms=tuple(t / factor ** order(k) for k, t in enumerate(self.terms, 1)))

    def __post_init__(self):
        if self.kind == "volume":
            object.__setattr__(self, "volume", checked_volume(self.volume))
            return
        if self.kind not in KINDS:
            raise InputError(f"⟨lens.gradient⟩ must be {', '.join(KINDS)}, volume or free, got {self.kind!r}")
        if not self.terms or (self.kind == "selfoc" and len(self.terms) != 1):
            wanted = "one number, g in 1/mm" if self.kind == "selfoc" else "at least one number"
            raise InputError(f"⟨lens.gradient_terms⟩ of {self.kind} must be {wanted}, got {list(self.terms)}")


def checked_volume(values: np.ndarray | None, where: str = "⟨lens.index_file⟩") -> np.ndarray:
    """Validated control values (n, m, k) float64, from an array (n, m, k) or (n, m).

    Raises:
        InputError: the array has another shape, or values outside INDEX.
    """
    array = np.asarray(values, dtype=np.float64) if isinstance(values, np.ndarray) else np.empty(0)
    array = array[:, :, None] if array.ndim == 2 else array
    if array.ndim != 3 or min(array.shape[:2]) < 2 or array.size > MOST_VALUES:
        raise InputError(f"{where} must be an array of (n, m) or (n, m, k) control values, n and m at least 2, got {array.shape}")
    low, high = INDEX
    if not (np.isfinite(array).all() and array.min() >= low and array.max() <= high):
        raise InputError(f"{where} must have refractive indices of {low:g} to {high:g}, got {array.min():g} to {array.max():g}")
    return array
