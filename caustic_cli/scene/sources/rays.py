"""Ray-file sources: a measured or simulated ray set as a light source."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.aperture import Pupil
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.points import Points
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.section import DISTANCE, SourceType, Table, content, positions
from caustic_cli.schema.table import check_all


@dataclass(frozen=True, eq=False)
class Measured(Source):
    """A ray set in front of the lens.  Rays that do not reach the lens count as missing it.

    Its position is the rays' point of closest approach, and its extent is their width there (`RaySet`).
    """

    #: In the file's own coordinates, whose z axis is parallel to the scene's.
    rays: RaySet = field()
    #: Of the origin of these coordinates, mm.
    position: tuple[float, float, float] = (0.0, 0.0, -50.0)
    #: Of all rays, W.
    power: float = 1.0

    kind = "rays"

    def __post_init__(self):
        check_all("source", self, "position", "power")
        _ = self.rays.forward  # raises if there is none

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """The point of closest approach."""
        return (self.rays.focus + self.position)[None, :], np.ones(1)

    def batch(self, k: int, of: int) -> Source:
        """As of a source: a random partition of the rays."""
        return replace(self, rays=self.rays.batch(k, of))

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths of the rays there, mm."""
        return self.rays.spread

    @property
    def nearest(self) -> float:
        """Largest z at which a ray starts, mm."""
        return self.rays.nearest + self.position[2]

    @property
    def sharp(self) -> bool:
        """Never, so that the type of design does not depend on its size."""
        return False

    @property
    def label(self) -> str:
        """As of a source."""
        return f"{self.rays.count:,} rays of a file"

    def power_words(self, pupil: Pupil) -> str:
        """That of the file's rays, wherever they go."""
        return "the power of all rays of the file"

    def emitted(self, pupil: Pupil) -> tuple[float, str]:
        """All rays of the file."""
        return 1.0, "by all rays of the file"

    def pointlike(self) -> Source:
        """A point source at the point of closest approach."""
        return Points((self.centre,), (self.power,))

    def blur(self, z_in: float, throw: float) -> float:
        """As of a source, from the point of closest approach."""
        return throw * self._width() / max(abs(z_in - self.centre[2]), np.finfo(float).tiny)

    def apparent_angle(self, z_in: float) -> float:
        """As of a source, from the point of closest approach."""
        return 2.0 * math.degrees(math.atan2(self._width() / 2.0, abs(z_in - self.centre[2])))

    def incidence(self, pupil: Pupil) -> float:
        """As of a source: the largest angle among the rays themselves."""
        d = self.rays.directions[self.crossing(pupil)[2]]
        return float(np.arctan2(np.hypot(d[:, 0], d[:, 1]), d[:, 2]).max(initial=0.0))

    def crossing(self, pupil: Pupil) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intersections x, y (N,) mm of the rays with the plane of a pupil, and which rays carry light through it, (N,)."""
        p, d = self.rays.positions, self.rays.directions
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # rays along the plane, which carry nothing
            way = (pupil.z - self.position[2] - p[:, 2]) / d[:, 2]
            x, y = (p[:, k] + self.position[k] + way * d[:, k] for k in (0, 1))
            inside = pupil.aperture.contains(x, y)
        return x, y, inside & (self.rays.forward > 0)


def _build(table: Table, _profile) -> Measured:
    rays, places = content(table, "file", RaySet), positions(table)
    if rays is None:
        raise InputError(
            "⟨source.file⟩ of type rays must be a ray file: IES TM-25 (.tm25ray), Zemax binary (.dat, .sdf) or"
            " LightTools text (.ray, .txt)"
        )
    if len(places) != 1:
        raise InputError(f"⟨source.position⟩ of a ray file is that of its origin, one [x, y, z], got {len(places)}")
    return Measured(rays, places[0], table["power"])


def _position_defaults(lens: Table) -> dict[str, Any]:
    return {"position": [[0.0, 0.0, lens["z_in"] - DISTANCE * max(lens["size"])]]}


TYPES = (SourceType("rays", "rays (of a file)", ("position", "file"), _build, _position_defaults),)
