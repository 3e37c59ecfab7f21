"""Light sources.  A plane wave along +z, as wide as the lens' aperture (thesis 4.2.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene import checks


@dataclass(frozen=True, eq=False)
class PlaneWave:
    """Parallel light at normal incidence on the entrance surface.

    Args:
        power: power through the aperture, W.
        profile: optional relative irradiance E over the aperture, (a, b) non-negative, [i, j] with i along +x and j
            along +y, constant on each cell (eq. 4.2.3); None for uniform light.
    """

    power: float = 1.0
    profile: np.ndarray | None = None

    def __post_init__(self):
        checks.number("[source] power", self.power, 0.0, open_low=True)
        if self.profile is not None:
            e = np.asarray(self.profile, dtype=float)
            if e.ndim != 2 or not np.isfinite(e).all() or (e < 0).any() or not e.sum() > 0:
                raise InputError("[source] profile must be a 2-D picture, finite, not negative, and not black all over")
            object.__setattr__(self, "profile", e)
