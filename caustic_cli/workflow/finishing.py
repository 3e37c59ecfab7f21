"""Lenses as they are finished: what a finish makes of a part, what that costs, and what the correction for it is worth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch

from caustic_cli.errors import InputError
from caustic_cli.optics import finishing, ranks
from caustic_cli.optics.finishing import Relief
from caustic_cli.optics.scattering import scattered
from caustic_cli.scene import Scene
from caustic_cli.studies.judge import judge_of
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.machining import cut_surface
from caustic_cli.workflow.reporter import Reporter

#: Finishes of `compared`, the coarsest first.
LADDER = ("sanded:400,800,2000+polished:5", "sanded:2000+polished:5", "polished:20", "polished:5", "polished:1", "polished:0.2")
LADDER += ("coated:20", "coated:5", "coated:1", "printed:25,50", "printed:25,50,20")
#: Errors, in errors of the lens as designed, for which the finishes that keep them are named.
KEPT = (1.2, 1.5, 2.0, 4.0)
#: Slope off the designed one beyond which a point is of the riser of a step, through which no light is refracted.
RISER = 1.0
#: Points along each axis at which surfaces are compared.
SURVEY = 301


@dataclass(frozen=True, eq=False)
class Workpiece:
    """A part that is made of a lens and finished.

    Args:
        finish: as of `optics.finishing.parse`; tool_radius: mm, for a program that does not state it.
        corrected: whether it is made as `Lens.made`, or else as designed.

    Raises:
        InputError: the finish is not written so, or a program cannot be read.
    """

    lens: Lens
    finish: str
    tool_radius: float | None = None
    corrected: bool = True

    @cached_property
    def steps(self) -> tuple[finishing.Finish, ...]:
        """Of the finish."""
        return finishing.parse(self.finish)

    @cached_property
    def relief(self) -> Relief:
        """As it is made: as a program cuts it, or else without errors."""
        lens, program = self.lens, self.steps[0].program
        shape = finishing.points(self.steps, lens.field)
        if program:
            return Relief.of(cut_surface(program, lens.scene, lens.field, self.tool_radius), lens.field.half_size, shape)
        field, heights = lens.made if self.corrected else (lens.field, lens.heights)
        return Relief(field.on_grid(heights, shape).numpy(), field.half_size)

    def finished(self, strength: float = 0.0) -> Lens:
        """The lens in its scene with the finished surface; strength: of the steps within what is known of them, -1 to 1."""
        steps = tuple(step.by(strength) for step in self.steps)
        field, heights = finishing.finished(steps, self.relief, self.lens.field)
        return replace(self.lens, field=field, heights=heights, scene=_rough(self.lens.scene, finishing.roughness(steps).slope))

    @property
    def scattered(self) -> float:
        """Fraction of the light that the roughness scatters; wave images leave it out."""
        scene = self.lens.scene
        return scattered(finishing.roughness(self.steps).height, abs(scene.lens.effective_index - 1.0), scene.light.mean)

    def unsure(self, **how: Any) -> list[float | None]:
        """Errors for weaker and for stronger steps, none if they are known; how: arguments of `judged`."""
        if all(step.by(1.0) == step for step in self.steps):
            return []
        return [judged(self.finished(strength), **how)["error"] for strength in (-1.0, 1.0)]


def _rough(scene: Scene, slope: float) -> Scene:
    """With a surface whose facets have these slopes beside their own, if they matter."""
    if slope < finishing.SMOOTH:
        return scene
    return replace(scene, lens=replace(scene.lens, roughness=min(math.hypot(scene.lens.roughness, slope), 1.0)))


def of_design(lens: Lens, say: Reporter) -> dict[str, Any]:
    """What the correction for the finish of a new design is worth, also said: finish, with steps, the error of the finished part,
    error_by and noise, weaker_error and stronger_error for the ends of what is known of the steps, uncorrected_error and its noise,
    and relief_um, by how much the surface to be made departs from the designed one; empty without a finish."""
    finish = lens.project.settings.lens.finish if lens.project else ""
    if not finish:
        return {}
    with say.notify_if_slow("tracing the finished part"):
        part, plain = Workpiece(lens, finish), judged(Workpiece(lens, finish, corrected=False).finished())
        found = judged(part.finished())
        weaker, stronger = part.unsure() or (found["error"], found["error"])
    off = deviation(replace(lens, field=lens.made[0], heights=lens.made[1]), lens)["most_um"]
    say.say(
        f"finished ({finish}), the corrected part has an error of {said(found['error'], found['noise'])} by {found['error_by']},"
        f" {said(weaker)} if the steps are weaker than assumed and {said(stronger)} if stronger, by what is not known of them; one"
        f" made as designed has {said(plain['error'], plain['noise'])}; the surface to be made, which is exported, is up to"
        f" {off:.3g} µm off the designed one"
    )
    more = {"weaker_error": weaker, "stronger_error": stronger, "relief_um": off}
    more |= {"uncorrected_error": plain["error"], "uncorrected_noise": plain["noise"]}
    return {"finish": found | {"steps": finish} | more}


def said(error: float | None, noise: float | None = None) -> str:
    """An error in words, with its standard error where rays leave some; None where light crosses within the lens, so that it has no
    wave image."""
    return "unknown (no wave image)" if error is None else f"{error:.4f}" + (f" ± {noise:.2g}" if noise else "")


def deviation(lens: Lens, of: Lens) -> dict[str, float]:
    """By how much a surface differs from another beside piston, for JSON: rms_um, most_um, and slope_rms, without risers."""
    line = [torch.linspace(-r, r, SURVEY, dtype=torch.float64) * (1.0 - 1e-9) for r in of.field.half_size]
    x, y = (c.reshape(-1) for c in torch.meshgrid(*line, indexing="ij"))
    z, gx, gy = (a - b for a, b in zip(lens.field.at(lens.heights, x, y), of.field.at(of.heights, x, y), strict=True))
    off, steep = 1e3 * (z - z.mean()), torch.hypot(gx, gy)
    return {
        "rms_um": float(off.std()),
        "most_um": float(off.abs().max()),
        "slope_rms": float(steep[steep < RISER].square().mean().sqrt()),
    }


def judged(lens: Lens, rays: float | None = None, **how: Any) -> dict[str, Any]:
    """The figures of a lens by its judge: error, error_by, noise; by waves where the design was refined on them."""
    figures = lens.render(rays, **how).figures
    if lens.by_waves:
        figures = {**figures, **lens.render_waves(required=False).figures}
    return {key: figures.get(key) for key in ("error", "error_by")} | {"noise": judge_of(figures).noise(figures)}


def compared(lens: Lens, finishes: tuple[str, ...] | None = None) -> list[Mapping[str, Any]]:
    """The lens as designed, and each finish, those of LADDER unless given, with its error and those for the weaker and the stronger
    end of what is known of it: finish, error, low, high, error_by, slope_rms, and scattered, the fraction of light that roughness
    scatters; or why, where the lens cannot be finished so."""
    own: Mapping[str, Any] = {"finish": "as designed", **judged(lens), "slope_rms": 0.0, "scattered": 0.0}
    return [own, *ranks.mapped(partial(_compared, lens), finishes or LADDER)]


def _compared(lens: Lens, finish: str) -> Mapping[str, Any]:
    """A row of `compared`."""
    part = Workpiece(lens, finish)
    try:
        now = part.finished()
    except InputError as error:
        return {"finish": finish, "error": None, "error_by": None, "why": str(error)}
    figures = judged(now)
    errors = sorted(e for e in (figures["error"], *part.unsure()) if e is not None) or [None]
    more = {"low": errors[0], "high": errors[-1], "slope_rms": deviation(now, lens)["slope_rms"]}
    return {"finish": finish, **figures, **more, "scattered": part.scattered}


def needed(rows: list[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Which finishes keep which error, of rows of `compared`: error, the limit, over, in errors of the lens as designed, and
    finishes, those that stay below it even at the worse end of what is known of them."""
    own = rows[0]["error"]
    if own is None:
        return []
    kept = [[row["finish"] for row in rows[1:] if (row.get("high") or math.inf) <= over * own] for over in KEPT]
    return [{"error": over * own, "over": over, "finishes": names} for over, names in zip(KEPT, kept, strict=True)]
