"""The pictures of a sundial, each at its hour."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caustic_cli.effort import current_effort
from caustic_cli.inverse.lenslets import lenslets
from caustic_cli.io.picture import write_image
from caustic_cli.loading import OnDemand
from caustic_cli.studies.irradiance import irradiance
from caustic_cli.studies.retrace import white_level
from caustic_cli.workflow.outputs.base import Output, Place, Rendering
from caustic_cli.workflow.reporter import Reporter

study = OnDemand("caustic_cli.studies.sundial")


class Hours(Output):
    """A sheet of images, in the order of the pictures, as of every render of an array whose sources shine in turn."""

    def paths(self, place: Place) -> tuple[Path, ...]:
        return (place.beside("hours.png"),) if place.project is not None and place.project.scene().source.in_turn else ()

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write the sheet: hours, a list of the figures of `studies.sundial.shown` with the time of each; hours_image."""
        lens, scene = rendering.lens, rendering.plan.scene
        if not scene.source.in_turn or lens.project is None:
            return {}
        targets = lens.project.targets(scene)
        if len(targets) != len(scene.source.members):
            return {}
        heights = lens.heights
        alone = [study.Alone(one.scene, one.field, one.of(heights), one.share) for one in lenslets(scene, tuple(heights.shape))]
        with rendering.say.notify_if_slow("tracing the light of every hour"):
            images, figures = study.shown(
                scene,
                lens.field,
                heights,
                alone,
                targets,
                (current_effort().final_rays if rendering.rays is None else rendering.rays) // len(targets),
                rendering.seed,
            )
        n, m = scene.lens.array
        images, targets = ([irradiance(a, scene.screen) for a in each] for each in (images, targets))
        sheet = np.concatenate([np.concatenate(images[i * m : (i + 1) * m], 1) for i in range(n)], 0)
        wanted = np.concatenate([np.concatenate(targets[i * m : (i + 1) * m], 1) for i in range(n)], 0)
        (path,) = self.paths(rendering.place)
        write_image(path, sheet, white_level(sheet, wanted), lens.encoding, rendering.place.wide)
        return {"hours": figures, "hours_image": str(path)}

    def show(self, figures: dict[str, Any], say: Reporter) -> None:
        if "hours" in figures:
            say.table("the hours", [*study.rows(figures["hours"]), ("images", figures["hours_image"])])
