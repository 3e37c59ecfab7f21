"""The image by rays, a PNG.  That of the project is kept if it shows the same with less noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from caustic_cli.io.picture import said_of, write_image
from caustic_cli.project.uptodate import image_provenance
from caustic_cli.studies.viewing import as_lit
from caustic_cli.workflow.outputs.base import Output, Place, Rendering

#: Ratio of the noise of an existing image to that of a new one below which the existing one is kept.
QUIETER = 0.9


class RayPicture(Output):
    """The image by rays, as of every render."""

    def paths(self, place: Place) -> tuple[Path, ...]:
        return (place.image,)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write the image, or keep the one that is there: image_kept."""
        lens, place = rendering.lens, rendering.place
        own = {}
        if place.project and lens.state:
            own = image_provenance(place.project, lens.state.heights, rendering.figures, rendering.asked.shows)
        there = said_of(place.image) if place.in_project and own and not rendering.asked.force else {}
        noise = float(there.get("noise", "inf"))
        if there.get("of") == own.get("of") and noise < QUIETER * float(own.get("noise", "inf")):
            rendering.say.say(
                f"{place.image}: its noise is {there['noise']}, less than the {own['noise']} of these rays, so it is kept; ⟨force⟩"
                " replaces it, ⟨out⟩ writes another beside it"
            )
            return {"image_kept": True}
        seen = as_lit(lens.scene, rendering.image, lens.target, rendering.xyz)
        write_image(place.image, *seen, lens.encoding, place.wide, own)
        return {}
