"""What the default stages of a design follow from, for `complete` of each kind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

from caustic_cli.config.default_stages import RAYS_PER_PIXEL, Table, completed_stage, usual_sampler
from caustic_cli.config.design import region_of, relative_to_initial
from caustic_cli.config.settings import Settings, build_scene
from caustic_cli.effort import DRAFT, EFFORTS, FINE, STANDARD, Effort, current_effort
from caustic_cli.errors import InputError
from caustic_cli.inverse.source_limits import source_spread
from caustic_cli.optics.spread import point_source
from caustic_cli.optics.trace import evaluates_by_rows
from caustic_cli.scene import Scene, Source
from caustic_cli.schema.table import DesignSettings, LensSettings, StageSettings, check

EXTENDED = 5.0  # factor of the time limits of qualities for an extended source, whose start includes a deconvolution
LEAST_SPANS = STANDARD.refinement.least_spans  # which resolve an initial surface
#: See `Defaults.fewer_rays`.
SCATTERED, BLURRED = 4, 2


class Defaults:
    """Settings, complete but for the design, and the user's wishes.

    Args:
        s: all settings, replaced as they are completed; source: built from them.
        quality: of the default stages, None for that of the time limit; rays: of the last of them, None for that of the quality.
        lit, gaps: of the picture, see `project.completion.complete`.
    """

    def __init__(self, s: Settings, source: Source, quality: str | None, rays: int | None, lit: tuple[float, float], gaps: float):
        self.s, self.source, self.asked, self.rays, self.lit, self.gaps = s, source, quality, rays, lit, gaps
        self.own_control = "control" in s.lens

    @property
    def lens(self) -> LensSettings:
        """The [lens] section as completed so far."""
        return self.s.lens

    @property
    def design(self) -> DesignSettings:
        """The [design] section as completed so far."""
        return self.s.design

    def set_control(self, control: Sequence[int]) -> None:
        """Set the control net."""
        self.s = self.s.changed(lens=self.lens.changed(control=control))

    def set_design(self, **values: Any) -> None:
        """Set values of [design]."""
        self.s = self.s.changed(design=self.design.changed(**values))

    def fill_design(self, **values: Any) -> None:
        """Set values of [design] that are not given."""
        self.s = self.s.changed(design=self.design.filled(**values))

    def set_stages(self, stages: Sequence[Table]) -> None:
        """Set the stages."""
        self.set_design(stages=[StageSettings(stage) for stage in stages])

    def refuse_given_stages(self) -> None:
        """Refuse wishes for the default stages beside stages of the user's own.

        Raises:
            InputError: both are given.
        """
        check("lens.degree", self.lens.degree)
        if "stages" in self.design and (self.asked or self.rays):
            raise InputError(
                "⟨quality⟩ and ⟨rays⟩ shape the default stages, but the configuration brings [[design.stages]]"
                " of its own: change them there"
            )

    @cached_property
    def effort(self) -> Effort:
        """That of the quality asked for, or of that which the time limit permits at 250 x 250 pixels on two cores."""
        if self.asked:
            return EFFORTS[check("quality", self.asked)]
        seconds = self.design.time_limit / (EXTENDED if self.source.extended else 1.0)
        return DRAFT if seconds < STANDARD.seconds else FINE if FINE.seconds <= seconds < math.inf else current_effort()

    @property
    def resolution(self) -> tuple[int, int]:
        """Pixels of the screen."""
        return self.s.screen.resolution

    @property
    def sampled(self) -> int:
        """Rays of stages that are not a quadrature, unless given."""
        return self.rays or min(4_000_000, max(40_000, int(RAYS_PER_PIXEL * math.prod(self.resolution))))

    @property
    def sampler(self) -> str:
        """The default sampler of such stages."""
        return usual_sampler(self.source)

    @property
    def trained(self) -> bool:
        """Whether the heights are the output of a network."""
        return self.design.network != "none"

    @property
    def plain(self) -> bool:
        """Whether the heights themselves are optimised, by L-BFGS."""
        return not self.trained and self.design.optimizer == "lbfgs"

    @property
    def shaped(self) -> bool:
        """Whether a laser beam is shaped, whose diffraction carries no detail finer than a coarse net's."""
        return region_of(self.design) is not None

    @property
    def from_surface(self) -> bool:
        """Whether the optimisation can begin from any surface."""
        return self.plain or relative_to_initial(self.design)

    @property
    def fine_net(self) -> bool:
        """Whether the control net resolves an initial surface by transport."""
        return not self.own_control or (min(n - p for n, p in zip(self.lens.control, self.lens.degree, strict=True)) >= LEAST_SPANS)

    @cached_property
    def shifts(self) -> bool:
        """Whether the source's extent only shifts the image."""
        return source_spread(self.scene) is not None

    @property
    def by_rows(self) -> bool:
        """Whether rays of the source's centre are not intersected with the surface one by one."""
        return evaluates_by_rows(self.scene)

    @property
    def fewer_rays(self) -> int:
        """By what factor rays are fewer than those of a plane wave: where every one has to be intersected with the surface."""
        return 1 if self.source.collimated or self.by_rows else SCATTERED

    @property
    def fewer_blurred(self) -> int:
        """The same where those of the source's centre are traced: also of a near source, whose start takes longer the more there
        are."""
        scene = self.scene
        centre = replace(scene, source=point_source(scene))
        if centre.source.collimated:
            return 1
        blur = source_spread(scene)
        return BLURRED if evaluates_by_rows(centre) and (blur is None or blur.points == 1) else SCATTERED

    @property
    def scene(self) -> Scene:
        """The scene with some control net."""
        lens = self.s.lens.filled(control=[LEAST_SPANS] * 2)
        return replace(build_scene(self.s.changed(lens=lens)), source=self.source)

    def complete_given_stages(self) -> bool:
        """Complete stages of the user's own; False if there are none."""
        if "stages" not in self.design:
            return False
        self.set_stages([completed_stage(stage, self.s, self.sampler) for stage in self.design.stages])
        return True
