"""Physical effects, one file each; listed in the order in which they act on the light."""

from __future__ import annotations

from caustic_cli.optics.effects.absorption import Absorption
from caustic_cli.optics.effects.base import NEGLIGIBLE, NO_REQUESTS, Action, Decision, Effect, Probe, Requests
from caustic_cli.optics.effects.diffraction import Diffraction
from caustic_cli.optics.effects.dispersion import Dispersion
from caustic_cli.optics.effects.entrance import Entrance
from caustic_cli.optics.effects.fresnel import Fresnel
from caustic_cli.optics.effects.ghosts import Ghosts
from caustic_cli.optics.effects.gradient_index import GradientIndex
from caustic_cli.optics.effects.intersection import Intersection
from caustic_cli.optics.effects.mirror import Mirror
from caustic_cli.optics.effects.missed_surface import MissedSurface
from caustic_cli.optics.effects.polarisation import Polarisation
from caustic_cli.optics.effects.roughness import Roughness
from caustic_cli.optics.effects.screen_shape import ScreenShape
from caustic_cli.optics.effects.screen_shift import ScreenShift
from caustic_cli.optics.effects.screen_tilt import ScreenTilt
from caustic_cli.optics.effects.secondary_intersection import SecondaryIntersection
from caustic_cli.optics.effects.source_size import SourceSize
from caustic_cli.optics.effects.total_reflection import TotalReflection

EFFECTS: tuple[Effect, ...] = (
    SourceSize(),
    Polarisation(),
    Dispersion(),
    Entrance(),
    GradientIndex(),
    Intersection(),
    MissedSurface(),
    Absorption(),
    Roughness(),
    Fresnel(),
    TotalReflection(),
    Mirror(),
    SecondaryIntersection(),
    Ghosts(),
    ScreenShape(),
    ScreenTilt(),
    ScreenShift(),
    Diffraction(),
)

__all__ = ["EFFECTS", "NEGLIGIBLE", "NO_REQUESTS", "Action", "Decision", "Effect", "Probe", "Requests"]
