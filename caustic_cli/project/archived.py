"""An exported archive as the origin of a lens: it holds one lens in a fixed scene, without picture, settings or design.

It answers what a `Project` does of a lens, so that others need not ask which of the two a lens comes from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import State
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project import attachments
from caustic_cli.project.project import LensData, Project
from caustic_cli.scene import Scene


@dataclass(frozen=True, eq=False)
class ArchivedLens:
    """The `.npz` archive at a path."""

    path: Path
    seed = 0
    encoding = "srgb"

    def at(self, text: str | None) -> ArchivedLens:
        """Refuse parameter values of a network."""
        if text is not None:
            raise InputError(f"⟨at⟩ {text} needs a project, whose network gives a lens for every value; an archive holds one lens")
        return self

    @property
    def image(self) -> Path:
        """Name of an image of the lens, here."""
        return Path(f"{self.path.stem}-render.png")

    def read(self, given: Mapping[str, Any]) -> LensData:
        """The lens; given: path in `schema.table` -> value, which may be the `source.file` of its rays only, if its source is a
        ray file."""
        other, rays = dict(given), None
        if "source.file" in other and other.get("source.type", "rays") == "rays":
            rays = attachments.rays_of(other.pop("source.file"))
            other.pop("source.type", None)
        found = open_archive(self.path, rays)
        return LensData(*found) if not other else self.scene(other)

    def scene(self, given: Mapping[str, Any]) -> NoReturn:
        """Refuse another scene."""
        raise InputError(f"⟨{next(iter(given))}⟩: an archive's source is fixed; render its project under another light")

    def target(self, scene: Scene) -> None:
        """There is no picture."""

    def second_target(self, scene: Scene) -> None:
        """There is no second picture."""

    def refined_by_waves(self, state: State | None) -> bool:
        """Whether the design was refined on its wave image: unknown, and not assumed."""
        return False

    def resolution(self, scene: Scene, field: HeightField, heights: Tensor) -> Resolution:
        """Resolution of the lens by diffraction."""
        return Resolution.at(scene, field, heights)

    def made(self, field: HeightField, heights: Tensor) -> tuple[HeightField, Tensor]:
        """The surface to be made, which is that in the archive."""
        return field, heights

    def moved(self, path: Path) -> NoReturn:
        """Refuse to become a project."""
        raise InputError("an archive's lens has no picture and no design, so it cannot be saved as a project")


def origin_of(path: str | Path, at: str | None = None) -> Project | ArchivedLens:
    """The project or the archive at a path, at parameter values of a network ("throw=300").

    Raises:
        InputError: there is neither, or there is no such network.
    """
    archive = Path(path)
    archived = archive.suffix.lower() == ".npz" and archive.is_file()
    return ArchivedLens(archive).at(at) if archived else Project.open(path).at(at)
