"""The design loop: stages of Adam or L-BFGS over a parametrisation of the control heights (thesis ch. 5).

What is designed, and how it is judged, is the `problem`'s.  A design is resumed bitwise: `State` holds everything the next
iteration depends on, and every random number is a function of the seed and the stage.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.lbfgs import UNFIT, curvature
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.inverse.optimisers import Adam, QuasiNewton
from caustic_cli.inverse.parametrisation import Heights
from caustic_cli.inverse.problem import Problem, Skipped
from caustic_cli.optics import ranks
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights

if TYPE_CHECKING:
    from caustic_cli.inverse.accuracy_cost import Row

#: Iterations over which the decrease of the loss is compared with the tolerance of a stage.
FLAT_SPAN = 10


@dataclass
class State:
    """State of a design."""

    #: Current lens, (n, m) mm float64.
    heights: Tensor
    #: Index of the stage, iterations done in it, and in total.
    stage: int = 0
    iteration: int = 0
    total: int = 0
    #: Tensors by name, empty before a stage begins.
    parameters: dict[str, Tensor] = field(default_factory=dict)
    optimizer: dict[str, Tensor] = field(default_factory=dict)
    #: Rows (iteration, stage, loss, on_screen, seconds).
    history: list[tuple[int, int, float, float, float]] = field(default_factory=list)
    #: Elapsed in the stages.
    seconds: float = 0.0
    #: Of its end, "" while running.
    reason: str = ""
    #: Initial heights on the control net of the first stage (n_0, m_0), and the same without the limit of the radius.
    start: Tensor | None = None
    unrounded: Tensor | None = None
    #: Errors by independent light, saved with the rest.
    accuracy: list[Row] = field(default_factory=list)
    #: Of the last iteration of this run; not saved.
    image: Tensor | None = None


class InitialHeights(NamedTuple):
    """Initial heights, (n, m) mm on the control net of the first stage: heights, within all limits; unrounded, within all but that
    of the radius, None where there is no such limit."""

    heights: Tensor
    unrounded: Tensor | None


class Designer:
    """Runs the stages of the design of a problem.

    Where several surfaces are designed jointly, heights are those of all, (k, n, m): see `Scene.free_surfaces`.
    """

    def __init__(self, problem: Problem):
        self.problem, self.scene, self.stages, self.options = problem, problem.scene, problem.stages, problem.options
        self._origin = 0.0

    def field(self, stage: int) -> HeightField:
        """The spline spaces of a stage."""
        return self.problem.field(stage)

    def exit(self, state: State) -> Tensor:
        """Heights of the exit alone (n, m) mm, on the control net of the stage of the state."""
        return split_heights(self.scene, self.field(state.stage), state.heights)[1]

    def initial_heights(self, heights: Tensor | None) -> InitialHeights | None:
        """Initial heights within the limits, from those of the exit (n, m) or of all surfaces on the control net of the first
        stage; None from None.

        Raises:
            CausticError: as of `Problem.feasible`.
        """
        if heights is None:
            return None
        surfaces = self.problem.all_surfaces(heights)
        return InitialHeights(
            self.problem.feasible(0, surfaces),
            self.problem.feasible(0, surfaces, rounded=False) if self.options.limits.min_radius > 0 else None,
        )

    def initial_state(self, heights: Tensor | None = None, unrounded: Tensor | None = None) -> State:
        """The initial state: that of the parametrisation, or from `initial_heights`."""
        module = self.problem.parametrised(0, heights)
        first, free = module().detach(), self.options.parametrisation.free  # free heights are the parameters themselves
        return State(first, parameters={} if free else module.state_dict(), start=first, unrounded=unrounded)

    def initial_surface(self, state: State, rounded: bool = True) -> Tensor:
        """The initial surface on the control net of the current stage (n, m), mm; or the `unrounded` one."""
        heights = state.start if rounded else state.unrounded
        assert heights is not None
        return self._carried(heights, 0, state.stage)

    def showing(self, state: State, heights: Tensor) -> State:
        """A state whose lens is `heights`, while the parameters of the optimiser are unchanged; `restored` undoes it."""
        return replace(state, heights=heights)

    def restored(self, state: State) -> State:
        """A state whose heights are those of the parameters of the optimiser again, see `showing`."""
        return replace(state, heights=self.module(state)().detach()) if state.parameters else state

    def heights_at(self, state: State, inputs: Tensor) -> Tensor:
        """The lens (n, m), mm, that a network returns for its inputs (1, d)."""
        heights = self.module(state)(inputs).detach()
        return self.problem.feasible(state.stage, heights.reshape(state.heights.shape))

    def module(self, state: State) -> Heights:
        """The parametrisation of a state, with its parameters.

        Raises:
            InputError: they are of another one.
        """
        start = state.heights if self.options.parametrisation.free else None
        module = self.problem.parametrised(state.stage, start, loaded=bool(state.parameters))
        if state.parameters:
            expected, loaded = (
                {k: tuple(v.shape) for k, v in parameters.items()} for parameters in (module.state_dict(), state.parameters)
            )
            if expected != loaded:
                raise InputError(UNFIT)
            module.load_state_dict(state.parameters)
        return module

    def run(
        self,
        state: State,
        *,
        iterations: int = 0,
        time_limit: float = math.inf,
        stop: Callable[[], bool] = lambda: False,
        further: Callable[[], bool] = lambda: False,
        on_iteration: Callable[[State], None] = lambda s: None,
        on_objective: Callable[[State], None] = lambda s: None,
        notice: Callable[[str], None] = lambda text: None,
    ) -> State:
        """Continue from `state` until the stages are done.

        Args:
            iterations: in total, counted from the beginning of the design; 0 for those of the stages.
            time_limit: seconds for this run, shared by the stages in proportion to their cost.
            stop: called after every iteration; True ends the run with a complete state.
            further: called after the last iteration and every one beyond it; True continues.
            on_iteration: called after every iteration.
            on_objective: called when the objective of a stage is ready, before its iterations.
            notice: called with messages for the user, such as of a rejected step.

        Raises:
            CausticError: no light reaches the screen at the beginning of a stage, or the loss there is not finite.
        """
        started = time.monotonic()
        self._origin = started - state.seconds
        done_in = {row[1] for row in state.history}
        used = {k: s for k, s in enumerate(self.stages) if k >= state.stage or k in done_in or not s.spare}
        first, last = state.stage, len(self.stages) - 1
        state.reason = ""
        for k in range(first, last + 1):
            deadline, ahead = started + time_limit, sum(s.cost for j, s in used.items() if j >= first)
            if k < last and ahead and math.isfinite(time_limit):
                deadline = started + time_limit * sum(s.cost for j, s in used.items() if first <= j <= k) / ahead
            limit = iterations or sum(s.iterations for s in used.values())
            end = partial(self._end, state, k, limit, deadline, stop, further)
            try:
                done = self._stage(state, k, end, on_iteration, on_objective, notice)
            except Skipped as skipped:
                notice(f"stage {k + 1}: {skipped}")
                state.reason, done = skipped.reason, True
                if self.stages[k].spare:
                    del used[k]
            if not done or k == last:
                break
            state = self._next(state, k + 1)
        return state

    def _clock(self) -> float:
        """Seconds of iterations and of what prepares them, in all runs."""
        return time.monotonic() - self._origin

    def within_limits(self, state: State) -> Tensor:
        """The heights of the state, made feasible for the limits of slope and radius.

        Raises:
            CausticError: as of `Problem.feasible`.
        """
        return self.problem.feasible(state.stage, state.heights)

    def _end(
        self, state: State, k: int, limit: int, deadline: float, stop: Callable[[], bool], further: Callable[[], bool]
    ) -> bool | None:
        """Whether stage k is done (True), the whole design ends here for `state.reason` (False), or neither (None); decided from
        the contents of a checkpoint alone but for time and signals, so that a resumed run decides alike."""
        stage, final = self.stages[k], k == len(self.stages) - 1
        if not final and state.iteration >= stage.iterations:
            return True
        if self._flat(state, stage.tolerance):
            state.reason = "no progress"
            return True
        decide = partial(ranks.decide, device=self.problem.device)
        asked, late = decide(stop), decide(lambda: time.monotonic() >= deadline)
        if asked or (state.total >= limit and not decide(further)):
            state.reason = "interrupted" if asked else "iterations"
            return False
        if late and (state.iteration > 0 or final):
            state.reason = "time limit"
            return not final
        return None

    def _stage(self, state: State, k: int, end: Callable[[], bool | None], on_iteration, on_objective, notice) -> bool:
        """Iterate stage k in place until its `end`.  True: the stage is done; False: the whole design ends here.

        Raises:
            Skipped: the stage cannot be done.
        """
        method: Adam | QuasiNewton | None = None
        while (done := end()) is None:
            if method is None:
                heights = self.module(state)
                method = self.problem.optimiser(k)(self.objective(k, heights), heights, self.options.lr)
                if state.optimizer:
                    method.load(state.optimizer)
                self._apart(on_objective, state)
                continue  # which may end it
            told = method.rejected > 0
            moved = method.step()
            if method.rejected and not told:
                notice(
                    f"stage {k + 1}, iteration {state.total + 1}: a step to an image without light or a loss that is not finite"
                    " was rejected and shortened, as any such step will be"
                )
            if not moved:
                state.reason = "no progress"
                return True
            state.heights = heights().detach()
            if not bool(torch.isfinite(state.heights).all()):
                raise CausticError("the heights stopped being finite; a smaller ⟨lr⟩ may help")
            state.iteration, state.total, state.seconds = state.iteration + 1, state.total + 1, self._clock()
            state.history.append((state.total, k, method.loss, method.on_screen, state.seconds))
            state.parameters, state.optimizer, state.image = heights.state_dict(), method.state(), method.image
            self._apart(on_iteration, state)
        return done

    def _apart(self, called: Callable[[State], None], state: State) -> None:
        """Call it, outside the clock of the design."""
        before = self._clock()
        with ranks.alone():
            called(state)
        self._origin += self._clock() - before

    def objective(self, k: int, heights: Heights) -> LossOfHeights:
        """The objective of stage k, for heights near those of the parametrisation."""
        return self.problem.objective(k, heights.initial_heights())

    def _next(self, state: State, k: int) -> State:
        """The state at the beginning of stage k: the same surface on its control net."""
        if self.problem.carries_parameters(k):
            return replace(state, stage=k, iteration=0, optimizer={})
        if not self.options.parametrisation.free:
            raise InputError("⟨design.stages.control⟩ cannot change between stages of a network")
        heights = self._carried(state.heights, k - 1, k)
        kept = curvature(state.optimizer) if self.problem.carries_curvature(k) else {}
        return replace(state, stage=k, iteration=0, parameters={}, optimizer=kept, heights=heights)

    def _carried(self, heights: Tensor, source: int, destination: int) -> Tensor:
        """The same surface on the control net of another stage."""
        if self.stages[source].control == self.stages[destination].control:
            return heights
        tu, tv = (a.change_of_basis(b) for a, b in zip(self.field(source).spaces, self.field(destination).spaces, strict=True))
        return tu @ heights @ tv.T

    @staticmethod
    def _flat(state: State, tolerance: float) -> bool:
        """Whether the last FLAT_SPAN iterations of this stage lowered the loss by less than the tolerance."""
        if tolerance == 0 or state.iteration <= FLAT_SPAN:
            return False
        losses = [row[2] for row in state.history[-FLAT_SPAN - 1 :]]
        return losses[-1] > (1.0 - tolerance) * losses[0]
