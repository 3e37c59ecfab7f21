"""Comparison with Mitsuba 3, an independent ray tracer, and a plot of it beside the image."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

from caustic_cli.export.mitsuba import quick_samples, write_mitsuba
from caustic_cli.scene.traits import Capability
from caustic_cli.studies import verify
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Output, Rendering


class MitsubaComparison(Output):
    """The comparison."""

    option: ClassVar[str] = "verify"
    capability: ClassVar[Capability] = verify.VERIFICATION
    files: ClassVar[tuple[str, ...]] = ("verify.png",)
    beyond: ClassVar[bool] = True
    kept: ClassVar[bool] = False

    def unsupported(self, lens: Lens) -> str:
        return verify.unsupported(lens.scene)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """verify: the figures of `studies.verify`, and image."""
        scene, lens, (panels,) = rendering.scene, rendering.lens, self.paths(rendering.place)
        with TemporaryDirectory() as folder:
            paths = [Path(folder) / f"lens-{k}.xml" for k in range(len(scene.bands))]
            for path, band in zip(paths, scene.bands, strict=True):
                write_mitsuba(path, band.scene, lens.field, lens.heights, quick_samples(lens.field), dark=True)
            found = verify.verify(paths, scene, lens.field, lens.heights, rendering.count, rendering.seed)
        verify.write_panels(panels, found, scene.screen.half_size)
        return {"verify": found.figures | {"image": str(panels)}}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        f = figures["verify"]
        say.table(f"Mitsuba {f['mitsuba']}, {f['variant']}", verify.rows(f))
