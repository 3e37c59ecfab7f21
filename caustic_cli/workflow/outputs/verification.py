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
        verify.write_panels(panels, found, scene)
        return {"verify": found.figures | {"image": str(panels)}}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        f = figures["verify"]
        noise = f"{f['z_mean_square']:.3f}, {f['z_beyond_3']:.2%}, {f['z_largest']:.2f}  (of noise: 1, 0.27%, 4)"
        rows = [
            ("decision", "agree" if f["agree"] else "DISAGREE"),
            ("mean Z^2, beyond 3, largest", noise),
            ("judged", f"{f['pixels']:,} of {f['pixel_side']} x {f['pixel_side']} pixels, {f['noise']:.1%} noise each"),
            ("relative RMS beyond noise", f"{f['relative_rms_beyond_noise']:.4f} of {f['relative_rms']:.4f}"),
            ("light on the screen", f"{f['on_screen']:.6f}, render {f['on_screen_render']:.6f} ({f['light_z']:.1f} sigma)"),
            ("correlation, and turned", f"{f['correlation']:.5f}, {f['correlation_turned']:.5f}"),
            ("image", f["image"]),
        ]
        say.table(f"Mitsuba {f['mitsuba']}, {f['variant']}", rows)
