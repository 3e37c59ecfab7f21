"""The light behind the picture, of a lens with two free-form sides: the second picture, or the error of the directions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from caustic_cli.effort import current_effort
from caustic_cli.io.picture import write_image
from caustic_cli.project.project import FARTHER
from caustic_cli.studies.second_target import second_figures
from caustic_cli.studies.viewing import as_viewed
from caustic_cli.workflow.outputs.base import Output, Place, Rendering


class SecondPicture(Output):
    """The second picture, as of every render of a lens that has one."""

    def paths(self, place: Place) -> tuple[Path, ...]:
        return () if place.project is None or place.project.second is None else (self._path(place),)

    def _path(self, place: Place) -> Path:
        return place.image.with_name(FARTHER) if place.in_project else place.image.with_stem(f"{place.image.stem}-second")

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write the image on the second screen, if there is one: second_image, and the figures of `second_figures`."""
        lens, place = rendering.lens, rendering.place
        if lens.scene.second_target is None:
            return {}
        target = lens.origin.second_target(lens.scene)
        with rendering.say.notify_if_slow("tracing the light behind the picture"):
            light, figures = second_figures(
                rendering.plan.scene,
                lens.field,
                lens.heights,
                target,
                rays=current_effort().final_rays if rendering.rays is None else rendering.rays,
                seed=rendering.seed,
                device=rendering.device,
                requests=rendering.plan.requests,
            )
        if light is None:
            return figures
        write_image(self._path(place), *as_viewed(lens.scene, light, target), lens.encoding, place.wide)
        return figures | {"second_image": str(self._path(place))}
