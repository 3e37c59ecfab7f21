"""The images as arrays, .npy: power per pixel as a fraction of the source's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from caustic_cli.io.files import destination
from caustic_cli.io.picture import write_npy
from caustic_cli.project.project import beside
from caustic_cli.workflow.outputs.base import Output, Place, Rendering


@dataclass(eq=False)
class PixelValues(Output):
    """The image by rays at `path`, and the wave image beside it."""

    path: Path

    def __post_init__(self):
        destination(self.path)  # refuses what is no file name, before others are made of it

    @classmethod
    def of(cls, options: Any) -> Self | None:
        """By the option `npy`."""
        return None if options.npy is None else cls(options.npy)

    def paths(self, place: Place) -> tuple[Path, ...]:
        """Both arrays."""
        return self.path, beside(self.path)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write the arrays of the images that there are."""
        write_npy(self.path, rendering.image)
        if rendering.waves is not None:
            write_npy(beside(self.path), rendering.waves)
        return {}
