"""A plane wave (thesis 4.2.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.section import SourceType, Table
from caustic_cli.schema.table import check


@dataclass(frozen=True, eq=False)
class PlaneWave(Source):
    """A collimated beam at normal incidence on the entrance, as wide as the lens' aperture."""

    #: Power through the aperture, W.
    power: float = 1.0
    #: Optional relative irradiance E over the aperture, (a, b) non-negative, [i, j] with i along +x and j along +y, constant on
    #: each cell (eq. 4.2.3, erratum E19); None for uniform irradiance.
    profile: np.ndarray | None = None

    kind = "plane"
    collimated = True

    def __post_init__(self):
        check("source.power", self.power)
        if self.profile is not None:
            e = np.asarray(self.profile, dtype=float)
            with np.errstate(over="ignore"):
                total = e.sum()
            if e.ndim != 2 or not np.isfinite(e).all() or (e < 0).any() or not 0 < total < np.inf:
                raise InputError("⟨source.profile⟩ must be a 2-D picture, finite, not negative, and not black all over")
            object.__setattr__(self, "profile", e)

    def extent_words(self, z_in: float) -> str:
        """As of a source."""
        return "a plane wave has one direction"


def _plane(table: Table, profile: np.ndarray | None) -> PlaneWave:
    return PlaneWave(table["power"], profile)


TYPES = (SourceType("plane", "plane (as wide as the lens)", ("profile",), _plane),)
