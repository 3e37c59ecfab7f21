"""The wave image, a PNG beside the image by rays, where diffraction is simulated; a lens refined on it is judged by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from caustic_cli.io.files import discard
from caustic_cli.io.picture import write_image
from caustic_cli.optics.plan import parse_effects
from caustic_cli.project.project import WAVE, beside
from caustic_cli.studies.judge import judged
from caustic_cli.studies.viewing import as_lit
from caustic_cli.workflow.outputs.base import Output, Place, Rendering


class WavePicture(Output):
    """The wave image, as of every render whose plan has diffraction."""

    def paths(self, place: Place) -> tuple[Path, ...]:
        return (beside(place.image),)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write the wave image, if there is one: wave_image, and the figures of `Lens.render_waves`, with the judge of the lens."""
        lens, place, effects = rendering.lens, rendering.place, rendering.asked.tracing.effects
        path = beside(place.image)
        if path == place.lens / WAVE:
            discard(path)  # of an earlier render.png
        if not rendering.plan["diffraction"].on:
            return {}
        with rendering.say.notify_if_slow("computing the wave image"):
            found = lens.render_waves(
                effects=rendering.plan, required=effects != "auto", device=rendering.device, cut=rendering.cut
            )
        image, figures = found
        if image.size:
            write_image(path, *as_lit(lens.scene, image, lens.target, found.xyz), lens.encoding, place.wide)
            rendering.waves, rendering.waves_xyz = image, found.xyz
            figures = figures | {"wave_image": str(path)}
        return judged(rendering.figures | figures, lens.by_waves or "diffraction" in (parse_effects(effects) or ()))
