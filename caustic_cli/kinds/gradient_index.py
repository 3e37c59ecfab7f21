"""A flat plate whose refractive index is designed, evaluated like any lens.

The control values of the index are a file of the project, which [lens] index_file names; the checkpoint holds the flat exit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config.default_stages import refinement, transport_cells
from caustic_cli.config.settings import Settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import State
from caustic_cli.inverse.gradient_index import design_gradient_index
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.surface import OneSurface
from caustic_cli.schema.table import LensSettings, ScreenSettings, check, check_all

#: Half range about the index; degree of its splines, knot spans per pixel and their largest number.
HALF_RANGE, INDEX_DEGREE, INDEX_SPANS, MOST_SPANS = 0.05, 3, 2, 768
RAYS_BENT, ITERATIONS = 16, 24  # largest number of rays per pixel, since they cost more; and iterations


class IndexPlate(OneSurface):
    """A plate with a designed index; its surface is flat."""

    in_stages = False

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return s.lens.gradient == "free"

    @classmethod
    def blank(cls, lens: LensSettings, screen: ScreenSettings, index: float) -> LensSettings:
        """A plane-parallel blank; its sides have the smallest control net."""
        lens = lens.filled(radius=(math.inf, math.inf))
        if any(map(math.isfinite, lens.radius)):
            raise InputError(f"⟨lens.radius⟩ of a free gradient must be [inf, inf], two flat sides, got {list(lens.radius)}")
        lens = lens.filled(
            control=[p + 1 for p in check("lens.degree", lens.degree)],
            index_range=(max(1.0, index - HALF_RANGE), index + HALF_RANGE),
            index_control=[min(MOST_SPANS, INDEX_SPANS * n) + INDEX_DEGREE for n in screen.resolution],
        )
        check_all("lens", lens, "index_range", "index_control", "index_layers")
        if not lens.index_range[0] < lens.index_range[1]:
            raise InputError(f"⟨lens.index_range⟩ must ascend, got {list(lens.index_range)}")
        return super().blank(lens, screen, index)

    @classmethod
    def complete(cls, d: Defaults) -> None:
        """L-BFGS from optimal transport, on rays."""
        s, lens, design = d.s, d.lens, d.design
        if not d.source.collimated:
            raise InputError(f"⟨lens.gradient⟩ free is designed for light of ⟨source.type⟩ plane, got {s.source.type}")
        check("design.waves", design.waves)
        if design.get("start", "offset") not in ("offset", "transport"):
            raise InputError(f"⟨design.start⟩ of a free gradient must be transport, got {design.start}")
        d.set_design(start="offset")  # of the surface, which is flat; the index starts from optimal transport
        d.fill_design(preconditioner="laplacian")
        if "stages" not in design:
            last = refinement(lens.control, d.rays, d.resolution, d.effort.refinement)[-1]
            rays = d.rays or min(last["rays"], RAYS_BENT * math.prod(d.resolution))
            d.set_stages([last | {"rays": rays, "oversample": min(4, last["oversample"]), "iterations": ITERATIONS}])

    def iterate(
        self,
        lens: LensSettings,
        state: State,
        total: int,
        began: float,
        time_limit: float,
        stop: Callable[[], bool],
        on_iteration: Callable[[State], None],
    ) -> tuple[np.ndarray, State]:
        """Design the index of the plate: its control values, and the final state.

        Args:
            lens: the [lens] section; state: the initial one, after whose iterations the index is that of the lens.
            total: iterations, with those.
            began: start of the command by `time.monotonic`; time_limit: of the command, s, of which two thirds are for the
                iterations and the rest for the evaluation.
            stop: called before every iteration; on_iteration: after.

        Raises:
            InputError: as of `design_gradient_index`.
        """
        stage, target = self.stages[-1], self.target.numpy()
        limit = time_limit if math.isinf(time_limit) else 2.0 * time_limit / 3.0
        flat = torch.full(lens.control, float(self.scene.lens.offset.thickness), dtype=torch.float64)
        before, now = state.seconds, State(flat, total=state.total, iteration=state.total, history=list(state.history))

        def late() -> bool:
            return time.monotonic() - began > limit

        def done(k: int, loss: float, on_screen: float, image: Tensor | None) -> None:
            now.total = now.iteration = state.total + k
            now.seconds, now.image = before + time.monotonic() - began, image
            now.history.append((now.total, 0, loss, on_screen, now.seconds))
            on_iteration(now)

        designed = self.scene.lens.gradient if state.total else None
        blank = replace(self.scene, lens=replace(self.scene.lens, gradient=None))
        design = design_gradient_index(
            blank,
            target,
            lens.index_control,
            lens.index_layers,
            lens.index_range,
            cells=transport_cells(stage.rays, False, least=self.effort.source_cells),
            iterations=max(0, total - state.total),
            rays=stage.rays,
            seed=self.options.seed,
            begin=None if designed is None else designed.volume,
            on_iteration=done,
            stop=lambda: stop() or late(),
        )
        if stop():
            now.reason = "interrupted"
        elif now.total >= total:
            now.reason = "iterations"
        else:
            now.reason = "time limit" if late() else "no progress"
        return design.index.coefficients.numpy(), now

    def words(self, lens: LensSettings) -> str:
        """What is designed, before it is."""
        return (
            f"index: {lens.index_control[0]} x {lens.index_control[1]} x {lens.index_layers} control values"
            f" of {lens.index_range[0]:.4g} to {lens.index_range[1]:.4g}, {self.stages[-1].rays:,} rays"
        )
