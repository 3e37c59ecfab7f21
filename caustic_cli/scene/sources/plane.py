"""A plane wave (thesis 4.2.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.screen import tilted
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.section import SourceType, Table, content
from caustic_cli.schema.table import check, default


@dataclass(frozen=True, eq=False)
class PlaneWave(Source):
    """A beam of parallel rays that fills the aperture of the entrance, at normal incidence unless it is tilted."""

    #: Power through the aperture, W.
    power: float = 1.0
    #: Optional relative irradiance E over the aperture, (a, b) non-negative, [i, j] with i along +x and j along +y, constant on
    #: each cell (eq. 4.2.3, erratum E19); None for uniform irradiance.
    profile: np.ndarray | None = None
    #: Right-handed rotations of its direction +z, first about the fixed x axis, then about the fixed y axis, degrees.
    tilt: tuple[float, float] = (0.0, 0.0)
    #: That direction, a unit vector.
    axis: tuple[float, float, float] = field(init=False, default=(0.0, 0.0, 1.0))

    kind = "plane"
    distant = True

    def __post_init__(self):
        check("source.power", self.power)
        object.__setattr__(self, "axis", direction(self.tilt))
        if self.profile is not None:
            object.__setattr__(self, "profile", picture_of(self.profile, "⟨source.profile⟩"))

    @property
    def collimated(self) -> bool:
        """As of a source."""
        return not self.oblique

    @property
    def emission(self) -> str:
        """As of a source."""
        return "plane" if self.collimated else "tilted plane"

    def extent_words(self, z_in: float) -> str:
        """As of a source."""
        return "a plane wave has one direction"


def picture_of(values: np.ndarray, where: str) -> np.ndarray:
    """A relative irradiance, (a, b) float64.

    Raises:
        InputError: it is none.
    """
    e = np.asarray(values, dtype=float)
    with np.errstate(over="ignore"):
        total = e.sum()
    if e.ndim != 2 or not np.isfinite(e).all() or (e < 0).any() or not 0 < total < np.inf:
        raise InputError(f"{where} must be a 2-D picture, finite, not negative, and not black all over")
    return e


#: Largest angle of light to +z, degrees: beyond it glass of index 1.5 reflects more than a third, and the beam is a sixth as wide.
GRAZING = 80.0


def direction(tilt: tuple[float, float], half_angle: float = 0.0) -> tuple[float, float, float]:
    """The direction of light from infinity, a unit vector; half_angle: of its rays to it, rad.

    Raises:
        InputError: it grazes the entrance, or does not reach it.
    """
    check("source.tilt", tilt)
    axis = tilted(tilt)[2]
    angle = math.degrees(math.acos(max(-1.0, min(1.0, axis[2]))) + half_angle)
    if any(tilt) and not angle <= GRAZING:
        raise InputError(
            f"⟨source.tilt⟩ must keep the light within {GRAZING:g} degrees of +z, got {angle:.3g}: at grazing incidence the"
            " entrance reflects it, and beyond 90 degrees it comes from behind"
        )
    return axis


def _plane(table: Table, profile: np.ndarray | None) -> PlaneWave:
    light = content(table, "file", np.ndarray)
    if light is None and table.get("file"):
        raise InputError("⟨source.file⟩ of a plane wave must be a picture of its irradiance, an image or a 2-D .npy")
    return PlaneWave(table["power"], light if profile is None else profile, tuple(table.get("tilt") or default("source.tilt")))


TYPES = (SourceType("plane", "plane (as wide as the lens)", ("profile", "file", "tilt"), _plane),)
