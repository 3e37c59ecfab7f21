"""The part as it is finished, traced instead of the designed surface."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from caustic_cli.optics import finishing as steps_of
from caustic_cli.studies.judge import judge_of
from caustic_cli.workflow import finishing
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Output, Rendering, fingerprint

#: Instead of a finish: all of a ladder are compared.
LIST = "list"
#: Fraction of scattered light that is not mentioned.
FEW = 0.005


@dataclass(eq=False)
class FinishedPart(Output):
    """The part as `finish` leaves it, by default that for which the project was corrected; tool_radius: mm, for a program that does
    not state it."""

    finish: str | None = None
    tool_radius: float | None = None
    part: finishing.Workpiece | None = field(default=None, init=False)
    ladder: list[Any] = field(default_factory=list, init=False)

    @property
    def shows(self) -> dict[str, object]:
        if self.finish in (None, LIST):
            return {}
        programs = [fingerprint(step.program) for step in steps_of.parse(self.finish or "") if step.program]
        return {"finish": self.finish, **({"finished program": programs} if programs else {})}

    @property
    def asks(self) -> dict[str, object]:
        return {"finish": self.finish} | self.shows if self.finish else {}

    def _of(self, lens: Lens) -> str:
        """The finish, "" for none."""
        return self.finish or (lens.project.settings.lens.finish if lens.project else "")

    def prepare(self, rendering: Rendering) -> None:
        finish = self._of(rendering.lens)
        if finish == LIST:
            with rendering.say.notify_if_slow("tracing the lens as each of the finishes leaves it"):
                self.ladder = finishing.compared(rendering.lens)
        elif finish:
            self.part = finishing.Workpiece(rendering.lens, finish, self.tool_radius)
            rendering.lens = self.part.finished()

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """finishes and needed, see `finishing.needed`, or finish: the steps, error, error_by and noise as designed, and for the
        weaker and the stronger end of what is known of the steps; the deviation from the designed surface, and the roughness that
        is left."""
        if self.ladder:
            return {"finishes": self.ladder, "needed": finishing.needed(self.ladder)}
        if self.part is None:
            return {}
        designed, how = self.part.lens, {"rays": rendering.rays, "seed": rendering.seed}
        figures: dict[str, Any] = {
            "steps": self.part.finish,
            "roughness": rendering.scene.lens.roughness,
            "scattered": self.part.scattered,
        }
        figures |= {f"nominal_{key}": value for key, value in finishing.judged(designed, **how).items()}
        figures |= dict(zip(("weaker_error", "stronger_error"), self.part.unsure(**how), strict=False))
        return {"finish": figures | finishing.deviation(rendering.lens, designed)}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        if found := figures.get("finishes"):
            say.table("finishes: error, and that of weaker and stronger steps", [(row["finish"], _words(row)) for row in found])
            if kept := figures["needed"]:
                rows = [
                    (f"up to {row['error']:.4f} ({row['over']:g} times)", ", ".join(row["finishes"]) or "none of these")
                    for row in kept
                ]
                say.table("finishes that keep an error, at the worse end of what is known of them", rows)
        if f := figures.get("finish"):
            rows = []
            if f["nominal_error"] is not None:
                error = f"{finishing.said(figures['error'], judge_of(figures).noise(figures))} by {figures['error_by']}"
                error += f"; as designed {finishing.said(f['nominal_error'], f['nominal_noise'])}"
                rows.append(("relative RMS error", error))
            if "weaker_error" in f and f["nominal_error"] is not None:
                unsure = f"weaker ones {finishing.said(f['weaker_error'])}; stronger ones {finishing.said(f['stronger_error'])}"
                rows.append(("steps known to a factor", unsure))
            rough = (
                f"slopes RMS {f['roughness']:.2g}, scatters {f['scattered']:.0%} of the light"
                if f["roughness"]
                else "none that matters"
            )
            rows += [
                ("off the designed surface", f"RMS {f['rms_um']:.3g} µm, up to {f['most_um']:.3g} µm"),
                ("slopes off by", f"RMS {f['slope_rms']:.3g}"),
                ("roughness left", rough),
            ]
            say.table(f"as finished, {f['steps']}", rows)


def _words(row: dict[str, Any]) -> str:
    """A row of the ladder."""
    if "why" in row:
        return row["why"]
    slopes = f"slopes off by RMS {row['slope_rms']:.2g}"
    if row["error_by"] is None or row.get("low", 0.0) is None:
        return slopes
    error = f"{finishing.said(row['error'], row.get('noise'))} by {row['error_by']}"
    if "low" not in row:
        return error
    rough = f", scatters {row['scattered']:.0%} of the light" if row["scattered"] > FEW else ""
    return f"{error} ({row['low']:.3f} to {row['high']:.3f}), {slopes}{rough}"
