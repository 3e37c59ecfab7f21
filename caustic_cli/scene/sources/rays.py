"""Ray-file sources: a measured or simulated ray set as a light source."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.aperture import Pupil
from caustic_cli.scene.screen import tilted
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.plane import direction
from caustic_cli.scene.sources.points import Points
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.section import DISTANCE, SourceType, Table, content, positions
from caustic_cli.schema.table import check_all, default


@dataclass(frozen=True, eq=False)
class Measured(Source):
    """A ray set in front of the lens.  Rays that do not reach the lens count as missing it.

    Its position is the rays' point of closest approach, and its extent is their width there (`RaySet`).
    """

    #: In the file's own coordinates, whose axes are parallel to the scene's before they are turned.
    rays: RaySet = field()
    #: Of the origin of these coordinates, mm, before it is turned.
    position: tuple[float, float, float] = (0.0, 0.0, -50.0)
    #: Of all rays, W.
    power: float = 1.0
    #: Rotations of the rays and of their origin about the scene's origin, see `PlaneWave`.
    tilt: tuple[float, float] = (0.0, 0.0)
    #: Direction that +z of the file is turned to, a unit vector.
    axis: tuple[float, float, float] = field(init=False, default=(0.0, 0.0, 1.0))

    kind = "rays"

    def __post_init__(self):
        check_all("source", self, "position", "power")
        object.__setattr__(self, "axis", direction(self.tilt))
        _ = self.turned.forward  # raises if there is none

    @cached_property
    def turned(self) -> RaySet:
        """The rays along the scene's axes, from `origin`."""
        return self.rays.turned(tilted(self.tilt)) if any(self.tilt) else self.rays

    @cached_property
    def origin(self) -> np.ndarray:
        """The origin of the rays' coordinates in the scene, (3,) mm."""
        return np.array(self.position) @ np.array(tilted(self.tilt))

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """The point of closest approach."""
        return (self.turned.focus + self.origin)[None, :], np.ones(1)

    def batch(self, k: int, of: int) -> Source:
        """As of a source: a random partition of the rays."""
        return replace(self, rays=self.rays.batch(k, of))

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths of the rays there, mm."""
        return self.turned.spread

    @property
    def nearest(self) -> float:
        """Largest z at which a ray starts, mm."""
        return self.turned.nearest + float(self.origin[2])

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

    def displaced(self, place, scale: float, axis=None) -> Source:
        """The rays from another origin, along the same directions."""
        return replace(self, rays=self.turned, position=place(self.origin.tolist()), tilt=(0.0, 0.0))

    def pointlike(self) -> Source:
        """A point source at the point of closest approach."""
        return Points((self.centre,), (self.power,))

    def blur(self, z_in: float, throw: float) -> float:
        """As of a source, from the point of closest approach."""
        return throw * self._width() / max(abs(z_in - self.centre[2]), np.finfo(float).tiny)

    def apparent_angle(self, z_in: float) -> float:
        """As of a source, from the point of closest approach."""
        return 2.0 * math.degrees(math.atan2(self._width() / 2.0, abs(z_in - self.centre[2])))

    def cone_over(self, pupil: Pupil) -> float:
        """As of a source, about +z: what covers the pupil from the point of closest approach."""
        return self._covering(pupil)

    def incidence(self, pupil: Pupil) -> float:
        """As of a source: the largest angle among the rays themselves."""
        d = self.turned.directions[self.crossing(pupil)[2]]
        return float(np.arctan2(np.hypot(d[:, 0], d[:, 1]), d[:, 2]).max(initial=0.0))

    def crossing(self, pupil: Pupil) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intersections x, y (N,) mm of the rays with the plane of a pupil, and which rays carry light through it, (N,)."""
        (p, d), o = (self.turned.positions, self.turned.directions), self.origin
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # rays along the plane, which carry nothing
            way = (pupil.z - o[2] - p[:, 2]) / d[:, 2]
            x, y = (p[:, k] + o[k] + way * d[:, k] for k in (0, 1))
            inside = pupil.aperture.contains(x, y)
        return x, y, inside & (self.turned.forward > 0)


def _build(table: Table, _profile) -> Measured:
    rays, places = content(table, "file", RaySet), positions(table)
    if rays is None:
        raise InputError(
            "⟨source.file⟩ of type rays must be a ray file: IES TM-25 (.tm25ray), Zemax binary (.dat, .sdf) or"
            " LightTools text (.ray, .txt)"
        )
    if len(places) != 1:
        raise InputError(f"⟨source.position⟩ of a ray file is that of its origin, one [x, y, z], got {len(places)}")
    return Measured(rays, places[0], table["power"], tuple(table.get("tilt") or default("source.tilt")))


def _position_defaults(lens: Table) -> dict[str, Any]:
    return {"position": [[0.0, 0.0, lens["z_in"] - DISTANCE * max(lens["size"])]]}


TYPES = (SourceType("rays", "rays (of a file)", ("position", "file", "tilt"), _build, _position_defaults),)
