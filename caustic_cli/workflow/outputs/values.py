"""The images as arrays, .npy: power per pixel as a fraction of the source's; of light with colour X, Y, Z, Y on that scale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from caustic_cli.io.files import destination
from caustic_cli.io.picture import write_npy
from caustic_cli.project.project import beside
from caustic_cli.workflow.outputs.base import Output, Place, Rendering


@dataclass(eq=False)
class PixelValues(Output):
    """The image by rays at `npy`, and the wave image beside it."""

    option: ClassVar[str] = "npy"

    npy: Path

    def __post_init__(self):
        destination(self.npy)  # refuses what is no file name, before others are made of it

    def paths(self, place: Place) -> tuple[Path, ...]:
        return self.npy, beside(self.npy)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write the arrays of the images that there are."""
        write_npy(self.npy, rendering.image if rendering.xyz is None else rendering.xyz)
        if rendering.waves is not None:
            write_npy(beside(self.npy), rendering.waves if rendering.waves_xyz is None else rendering.waves_xyz)
        return {}
