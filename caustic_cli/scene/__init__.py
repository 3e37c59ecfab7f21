"""What is there: lens, source, screen, materials.  Frozen, validated on construction, no light yet."""

from caustic_cli.scene.lens import Lens, Offset
from caustic_cli.scene.screen import Screen
from caustic_cli.scene.source import Disc, PlaneWave, Points, Source

__all__ = ["Disc", "Lens", "Offset", "PlaneWave", "Points", "Scene", "Screen", "Source"]

from dataclasses import dataclass

from caustic_cli.errors import InputError


@dataclass(frozen=True)
class Scene:
    """Source, lens and screen on one optical axis (z); lengths in mm, powers in W.

    Raises:
        InputError: the screen does not stand behind the lens, or the source not before it.
    """

    source: Source
    lens: Lens
    screen: Screen

    def __post_init__(self):
        if self.screen.z <= self.lens.z_in:
            raise InputError(
                f"[screen] z must lie behind the lens (beyond z_in = {self.lens.z_in:g} mm), got {self.screen.z:g} mm"
            )
        if not isinstance(self.source, PlaneWave) and self.source.nearest >= self.lens.z_in:
            raise InputError(f"[source] position must lie before the lens (z below z_in = {self.lens.z_in:g} mm),"
                             f" got z = {self.source.nearest:g} mm")
