"""What is there: lens, source, screen, materials.  Frozen, validated on construction, no light yet."""

from caustic_cli.scene.lens import Lens, Offset
from caustic_cli.scene.screen import Screen
from caustic_cli.scene.source import PlaneWave

__all__ = ["Lens", "Offset", "PlaneWave", "Scene", "Screen"]

from dataclasses import dataclass

from caustic_cli.errors import InputError


@dataclass(frozen=True)
class Scene:
    """Source, lens and screen on one optical axis (z); lengths in mm, powers in W.

    Raises:
        InputError: the screen does not stand behind the lens.
    """

    source: PlaneWave
    lens: Lens
    screen: Screen

    def __post_init__(self):
        if self.screen.z <= self.lens.z_in:
            raise InputError(
                f"[screen] z must lie behind the lens (beyond z_in = {self.lens.z_in:g} mm), got {self.screen.z:g} mm"
            )
