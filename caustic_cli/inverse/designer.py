"""The design loop: stages of Adam or L-BFGS over a parametrisation of the control heights (thesis ch. 5).

A design is resumed bitwise: `State` holds everything the next iteration depends on, and every random number is a
function of the seed and the stage.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config.table import check_all
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse import ranks
from caustic_cli.inverse.constraints import within_limits
from caustic_cli.inverse.deconvolution import SMOOTH_STEPS
from caustic_cli.inverse.initial_surface import departure_bound, sphere_net
from caustic_cli.inverse.internal_rays import entrance_points
from caustic_cli.inverse.lbfgs import UNFIT
from caustic_cli.inverse.lenslets import ArrayObjective, lenslets
from caustic_cli.inverse.loss_terms import parse
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.optimisers import Adam, QuasiNewton
from caustic_cli.inverse.parametrisation import Architecture, FreeHeights, Heights, SidesTogether, parametrise
from caustic_cli.inverse.range_training import RangeAdam, RangeObjective
from caustic_cli.inverse.robust import RobustObjective
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.inverse.schedule import Stage
from caustic_cli.inverse.source_limits import SourceLimits, best_irradiance, performance_limits, regular_rays, source_spread
from caustic_cli.inverse.target import grey
from caustic_cli.inverse.two_sided import TwoSidedObjective
from caustic_cli.inverse.waves import WaveObjective
from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.screen_shape import reach
from caustic_cli.optics.spread import Convolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, split_heights
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.scene import Scene
from caustic_cli.scene.tolerances import Tolerances

AnyObjective = Objective | WaveObjective | ArrayObjective | TwoSidedObjective | RangeObjective
#: Iterations over which the decrease of the loss is compared with the tolerance of a stage.
FLAT_SPAN = 10


@dataclass(frozen=True)
class Options:
    """Options of the optimisation; the stages set its resolution.

    loss: weighted terms, see `losses`; max_slope: limit of the lens' slope, 0 for none;
    min_radius: least radius of concave regions, mm, 0 for any;
    optimizer, lr: lbfgs, or adam with its learning rate; network, initial, preconditioner:
    see `parametrisation`; filter_target: filter the target as the render is filtered; seed: of rays and networks;
    dtype: precision of the rays; waves: stages on the wave image have to be, see `NoWaveImage`;
    robust: errors that the last stage takes into account, see `robust`; architecture: of a dense network; over: ranges of scene
    parameters over which a network is trained; inputs: whether it takes them as inputs, or is a single lens for all.
    """

    loss: str = "rms-light"
    optimizer: str = "lbfgs"
    lr: float = 1e-3
    network: str = "none"
    initial: str = "zero"
    preconditioner: str = "laplacian"
    filter_target: bool = True
    seed: int = 0
    dtype: torch.dtype = torch.float32
    max_slope: float = 0.0
    min_radius: float = 0.0
    waves: bool = False
    robust: Tolerances | None = None
    architecture: Architecture = field(default_factory=Architecture)
    over: Ranges | None = None
    inputs: bool = True

    def __post_init__(self):
        parse(self.loss)
        check_all("design", self, "max_slope", "min_radius", "network", "initial", "preconditioner", "optimizer", "lr", "seed")
        if self.optimizer == "lbfgs" and self.network != "none":
            raise InputError(
                "⟨design.optimizer⟩ lbfgs works on the heights themselves (network none); a network needs optimizer adam"
            )
        if self.network != "dense" and self.architecture != Architecture():
            raise InputError(
                "⟨design.network_layers⟩, ⟨design.network_width⟩ and ⟨design.activation⟩ belong to ⟨+design.network⟩ dense,"
                f" got {self.network}"
            )
        if self.over is None:
            return
        if self.network == "none":
            raise InputError("⟨design.over⟩ needs a network, which gives a lens for every value: ⟨+design.network⟩ dense or sparse")
        if self.initial == "zero":
            raise InputError(
                "⟨design.initial⟩ zero leaves the inputs of a network without any effect, for good: zero-last, uniform or random"
            )
        if self.robust is not None:
            raise InputError("⟨design.robust⟩ cannot be combined with ⟨design.over⟩, which is a mean over scenes already")


@dataclass
class State:
    """State of a design.

    stage, iteration: index of the stage and iterations done in it; total: iterations in total; heights (n, m) mm float64, the
    current lens; parameters, optimizer: tensors by name, empty before a stage begins; history: rows (iteration, stage, loss,
    on_screen, seconds); seconds: elapsed; reason: of its end, "" while running; start (n_0, m_0), the initial heights on the
    control net of the first stage; unrounded, of that shape, the same without the limit of the radius; image, of the last iteration
    of this run, which is not saved.
    """

    heights: Tensor
    stage: int = 0
    iteration: int = 0
    total: int = 0
    parameters: dict[str, Tensor] = field(default_factory=dict)
    optimizer: dict[str, Tensor] = field(default_factory=dict)
    history: list[tuple[int, int, float, float, float]] = field(default_factory=list)
    seconds: float = 0.0
    reason: str = ""
    start: Tensor | None = None
    unrounded: Tensor | None = None
    image: Tensor | None = None


class InitialHeights(NamedTuple):
    """Initial heights, (n, m) mm on the control net of the first stage: heights, within all limits; unrounded, within all but that
    of the radius, None where there is no such limit."""

    heights: Tensor
    unrounded: Tensor | None


class Designer:
    """Runs the stages of the design of a lens.

    Args:
        scene: its lens holds the final control net; stages replace `control`.
        target: (n_x, n_y) irradiance on the scene's screen, not all zero.
        stages, options: of the optimisation.
        device: where rays are traced.
        own: (n_x, n_y) targets of the lenslets of an array; or one for all, `target` unless given.
        second: (k_x, k_y) irradiance on the scene's second screen, where it has one.

    Where several surfaces are designed jointly, heights are those of all, (k, n, m): see `Scene.shaped`.
    """

    def __init__(
        self,
        scene: Scene,
        target: Tensor,
        stages: list[Stage],
        options: Options,
        device: str = "cpu",
        own: Sequence[Tensor] | None = None,
        second: Tensor | None = None,
    ):
        if not stages:
            raise InputError("[[design.stages]] at least one stage is needed")
        if scene.lens.knots is not None and any(s.control != scene.lens.control for s in stages):
            raise InputError(
                "[lens] knots: a lens with knots of its own is designed on its own net; every stage's control"
                f" must be {list(scene.lens.control)}"
            )
        if any(name == "throughput" for _, name in parse(options.loss)) and not all(s.apron for s in stages):
            raise InputError(
                "⟨design.loss⟩: throughput needs dark pixels around the screen that catch stray light; every stage needs an apron"
            )
        self.scene, self.target, self.stages, self.options, self.device = scene, target, stages, options, device
        self.second = second
        self.own = list(own) if own else [target]
        if any(s.lenslets and (s.waves or s.spread or not scene.lens.arrayed) for s in stages):
            raise InputError("⟨design.stages.lenslets⟩ needs ⟨lens.array⟩, and neither waves nor spread in the same stage")
        if options.network != "none" and any(s.waves for s in stages):
            raise InputError("⟨design.stages.waves⟩ needs network none: the wave image refines the heights themselves")
        if options.over and any(s.spread or s.source for s in stages):
            raise InputError("⟨design.over⟩ needs stages on the rays of the scene's own source, without spread")
        self._room: tuple[tuple[int, int], tuple[Tensor, Tensor]] | None = None
        self._limits: dict[int | None, SourceLimits] = {}
        for stage in stages:
            self._bounds(stage)  # refuse an impossible lens before any work

    @property
    def scenes(self) -> list[Scene]:
        """The scene; for a network over ranges, the scenes at all combinations of their ends."""
        return [self.scene] if self.options.over is None else self.options.over.ends(self.scene)

    def source_limits(self, steps: int | None = None) -> SourceLimits:
        """The limits set by the source, which are the same for any lens: computed once; steps: as of `performance_limits`."""
        if steps not in self._limits:
            self._limits[steps] = performance_limits(self.scene, self.target.cpu().numpy(), steps)
        return self._limits[steps]

    def field(self, stage: int) -> HeightField:
        """The spline spaces of a stage."""
        return HeightField.of(replace(self.scene.lens, control=self.stages[stage].control))

    def exit(self, state: State) -> Tensor:
        """Heights of the exit alone (n, m) mm, on the control net of the stage of the state."""
        return split_heights(self.scene, self.field(state.stage), state.heights)[1]

    def whole(self, heights: Tensor | None) -> Tensor | None:
        """Heights of the exit (n, m) on the control net of the first stage, with the initial spheres of other designed surfaces,
        (k, n, m); heights of all surfaces are returned unchanged."""
        if heights is None or heights.ndim == 3 or not self.scene.joint:
            return heights
        others = [sphere_net(e, side, self.field(0)) for e in self.scene.elements for side in e.free_sides]
        return torch.stack([*others, heights])

    def initial_heights(self, heights: Tensor | None) -> InitialHeights | None:
        """Initial heights within the limits, from those of the exit (n, m) or of all surfaces on the control net of the first
        stage; None from None.

        Raises:
            CausticError: as of `within_limits`.
        """
        if (whole := self.whole(heights)) is None:
            return None
        state = State(whole)
        return InitialHeights(
            self.within_limits(state), self.within_limits(state, rounded=False) if self.options.min_radius > 0 else None
        )

    def begin(self, heights: Tensor | None = None, unrounded: Tensor | None = None) -> State:
        """The initial state: that of the parametrisation, or from `initial_heights`."""
        module = self._parametrise(0, heights)
        first, free = module().detach(), self.options.network == "none"  # free heights are the parameters themselves
        return State(first, parameters={} if free else module.state_dict(), start=first, unrounded=unrounded)

    def begun(self, state: State, rounded: bool = True) -> Tensor:
        """The initial surface on the control net of the current stage (n, m), mm; or the `unrounded` one."""
        return self._carried(state.start if rounded else state.unrounded, 0, state.stage)

    def showing(self, state: State, heights: Tensor) -> State:
        """A state whose lens is `heights`, while the parameters of the optimiser are unchanged; `restored` undoes it."""
        return replace(state, heights=heights)

    def restored(self, state: State) -> State:
        """A state whose heights are those of the parameters of the optimiser again, see `showing`."""
        return replace(state, heights=self._module(state)().detach()) if state.parameters else state

    def heights_at(self, state: State, values: Sequence[float]) -> Tensor:
        """The lens (n, m), mm, that a network returns for values of the scene parameters, in the order of the ranges."""
        assert self.options.over is not None
        heights = self._module(state)(self.options.over.scaled([values])).detach()
        return self.within_limits(replace(state, heights=heights.reshape(state.heights.shape)))

    def _module(self, state: State) -> Heights:
        module = self._parametrise(
            state.stage, state.heights if self.options.network == "none" else None, loaded=bool(state.parameters)
        )
        if state.parameters:
            own, held = ({k: tuple(v.shape) for k, v in part.items()} for part in (module.state_dict(), state.parameters))
            if own != held:
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
        on_iteration: Callable[[State], None] = lambda s: None,
        notice: Callable[[str], None] = lambda text: None,
    ) -> State:
        """Continue from `state` until the stages are done.

        Args:
            iterations: in total, counted from the beginning of the design; 0 for those of the stages.
            time_limit: seconds for this run, shared by the stages in proportion to their cost.
            stop: called after every iteration; True ends the run with a complete state.
            on_iteration: called after every iteration.
            notice: called with messages for the user, such as of a rejected step.

        Raises:
            CausticError: no light reaches the screen at the beginning of a stage, or the loss there is not finite.
        """
        began, before = time.monotonic(), state.seconds
        limit = iterations or sum(s.iterations for s in self.stages)
        last = len(self.stages) - 1
        costs = [s.cost for s in self.stages]
        ahead = sum(costs[state.stage :])
        state.reason = ""
        for k in range(state.stage, last + 1):
            deadline = began + time_limit
            if k < last and ahead and math.isfinite(time_limit):
                deadline = began + time_limit * sum(costs[state.stage : k + 1]) / ahead
            done = self._stage(state, k, limit, deadline, stop, on_iteration, notice, began - before)
            if not done or k == last:
                break
            state = self._next(state, k + 1)
        return state

    def within_limits(self, state: State, rounded: bool = True) -> Tensor:
        """The heights of the state, made feasible for the limits of slope and radius; rounded: False leaves the radius out.

        Raises:
            CausticError: no feasible surface was found near them.
        """
        field, bounds, o = self.field(state.stage), self._bounds(self.stages[state.stage]), self.options
        radius = o.min_radius if rounded else 0.0
        if not self.scene.joint:
            return _within_limits_from(field, state.heights, bounds, o.max_slope, radius, self.scene.lens.cut_from)
        found = []
        halves = [e.half_size for e in self.scene.elements for _ in e.free_sides] or [field.half_size]
        for name, half, heights, low, high in zip(
            self.scene.free_surfaces, [*halves, field.half_size], state.heights, *bounds, strict=True
        ):
            field = replace(field, half_size=half)
            side = self.scene.lens.cut_from if name == EXIT else -1 if name.endswith(("entrance", "front")) else 1
            found.append(_within_limits_from(field, heights, (low, high), o.max_slope, radius, side))
        return torch.stack(found)

    def _stage(self, state: State, k: int, limit: int, deadline: float, stop, on_iteration, notice, origin: float) -> bool:
        """Iterate stage k in place.  True: the stage is done; False: the whole design ends here, for `state.reason`."""
        stage, final = self.stages[k], k == len(self.stages) - 1
        cap = math.inf if final else stage.iterations
        method = heights = None
        while True:
            # Decided from the contents of a checkpoint alone, so that a resumed run decides alike.
            if state.iteration >= cap:
                return True
            if self._flat(state, stage.tolerance):
                state.reason = "no progress"
                return True
            asked, late = (ranks.decide(said, self.device) for said in (stop(), time.monotonic() >= deadline))
            if state.total >= limit or asked:
                state.reason = "interrupted" if asked else "iterations"
                return False
            if late and (state.iteration > 0 or final):
                state.reason = "time limit"
                return not final
            if method is None:
                heights = self._module(state)
                try:
                    objective = self._objective(k, heights)
                except NoWaveImage as error:
                    if self.options.waves:
                        raise
                    notice(f"stage {k + 1}: the wave image is not refined: {error}")
                    state.reason = "no wave image"
                    return True
                adam = self.options.optimizer == "adam" and not stage.waves
                kind = RangeAdam if self.options.over else Adam if adam else QuasiNewton
                method = kind(objective, heights, self.options.lr)
                if state.optimizer:
                    method.load(state.optimizer)
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
            state.iteration, state.total, state.seconds = state.iteration + 1, state.total + 1, time.monotonic() - origin
            state.history.append((state.total, k, method.loss, method.on_screen, state.seconds))
            state.parameters, state.optimizer, state.image = heights.state_dict(), method.state(), method.image
            on_iteration(state)

    def _objective(self, k: int, heights: Heights) -> AnyObjective | RobustObjective:
        o = self.options
        if o.robust is None or k < len(self.stages) - 1:
            return self._objective_in(self.scene, k, heights.begun())

        def objective(scene: Scene, begun: Tensor) -> Objective | WaveObjective | ArrayObjective:
            return self._objective_in(scene, k, begun)

        return RobustObjective(objective, self.scene, self.field(k), heights.begun(), o.robust)

    def _objective_in(self, scene: Scene, k: int, begun: Tensor) -> AnyObjective:
        """The objective of stage k in a scene, for heights near `begun`."""
        stage, o = self.stages[k], self.options
        if stage.source is not None:
            scene = replace(scene, source=stage.source)
        if stage.waves:
            return WaveObjective(
                scene,
                self.field(k),
                begun,
                self.target,
                o.loss,
                wavelengths=stage.waves,
                blur=stage.blur,
                apron=stage.apron,
                max_slope=o.max_slope,
                min_radius=o.min_radius,
                dtype=o.dtype,
                device=self.device,
            )
        if scene.second is not None:
            targets = (self.target,) if self.second is None else (self.target, self.second)
            rays = rays_of(scene, stage.sampler, stage.rays, self._seed(k), self.device)
            return TwoSidedObjective(scene, self.field(k), rays, stage.filter, targets, o.loss, **self._how(k))
        if stage.lenslets:
            own = self.own * (math.prod(scene.lens.array) if len(self.own) == 1 else 1)
            parts = lenslets(scene, stage.control)
            rays = max(1, stage.rays // len(parts))
            return ArrayObjective(parts, lambda n, lenslet: self._on_rays(lenslet.scene, k, lenslet.field, own[n], rays))
        if stage.spread and (spread := source_spread(scene, self.field(k), begun)) is not None:
            expected = best_irradiance(scene, grey(self.target.cpu().numpy()), spread, SMOOTH_STEPS).kept
            scene, rays, spread = regular_rays(scene, spread, stage, self._seed(k), self.device)
            return self._traced(scene, k, self.field(k), self.target, rays, spread, expected)
        found = self._on_rays(scene, k, self.field(k), self.target, stage.rays)
        if o.over is None:
            return found
        return RangeObjective(
            found, o.over, lambda s, seed: rays_of(s, stage.sampler, stage.rays, seed, self.device), self._seed(k)
        )

    def _on_rays(self, scene: Scene, k: int, field: HeightField, target: Tensor, count: int) -> Objective:
        """The objective of stage k with `count` rays of the whole source of a scene."""
        rays = rays_of(scene, self.stages[k].sampler, count, self._seed(k), self.device)
        return self._traced(scene, k, field, target, rays, (), 1.0)

    def _seed(self, k: int) -> int:
        """Seed of all random numbers of stage k."""
        return stream(self.options.seed, f"stage {k}")

    def _traced(
        self,
        scene: Scene,
        k: int,
        field: HeightField,
        target: Tensor,
        rays: Rays | Sequence[Rays],
        spread: Sequence[Convolution],
        expected: float,
    ) -> Objective:
        """The objective of stage k on the ray image, with these rays."""
        how = self._how(k)
        return Objective(
            scene, field, rays, self.stages[k].filter, target, self.options.loss, spread=spread, expected=expected, **how
        )

    def _how(self, k: int) -> dict[str, Any]:
        """Keyword arguments of any objective on rays, from stage k and the options."""
        stage, o = self.stages[k], self.options
        return {
            "blur": stage.blur,
            "filter_target": o.filter_target,
            "apron": stage.apron,
            "max_slope": o.max_slope,
            "min_radius": o.min_radius,
            "oversample": stage.oversample,
            "dtype": o.dtype,
        }

    def _next(self, state: State, k: int) -> State:
        """The state at the beginning of stage k: the same surface on its control net."""
        by_rays = not (self.stages[k].waves or self.stages[k - 1].waves)
        keep = self.options.network != "none" or (self.options.optimizer == "adam" and by_rays)
        if self.stages[k].control == self.stages[k - 1].control and keep:
            return replace(state, stage=k, iteration=0, optimizer={})
        if self.options.network != "none":
            raise InputError("⟨design.stages.control⟩ cannot change between stages of a network")
        return replace(state, stage=k, iteration=0, parameters={}, optimizer={}, heights=self._carried(state.heights, k - 1, k))

    def _carried(self, heights: Tensor, before: int, after: int) -> Tensor:
        """The same surface on the control net of another stage."""
        if self.stages[before].control == self.stages[after].control:
            return heights
        tu, tv = (a.change_of_basis(b) for a, b in zip(self.field(before).spaces, self.field(after).spaces, strict=True))
        return tu @ heights @ tv.T

    def _parametrise(self, k: int, start: Tensor | None, loaded: bool = False) -> Heights:
        """The parametrisation of stage k; loaded: its tensors are loaded afterwards."""
        o = self.options
        low, high = self._bounds(self.stages[k])
        if self.stages[k].waves:
            return FreeHeights(low, high, start, counted=True)
        if self.scene.second is not None and start is not None:
            light = None if loaded else entrance_points(self.scene, self.field(k), start)
            return SidesTogether(low, high, start, o.preconditioner == "laplacian", light)
        return parametrise(
            low,
            high,
            o.network,
            start=start,
            degree=self.scene.lens.degree,
            initial=o.initial,
            preconditioner=o.preconditioner,
            seed=o.seed,
            architecture=o.architecture,
            inputs=len(o.over.each) if o.over and o.inputs else 0,
        )

    def _bounds(self, stage: Stage) -> tuple[Tensor, Tensor]:
        """Least and largest heights of the control net of a stage, mm; cached for one stage."""
        if self._room is None or self._room[0] != stage.control:
            self._room = stage.control, self._bounds_of(stage)
        return self._room[1]

    def _bounds_of(self, stage: Stage) -> tuple[Tensor, Tensor]:
        lens = replace(self.scene.lens, control=stage.control)
        x, y = HeightField.of(lens).control_xy()
        low, high = lens.height_bounds(x.numpy(), y.numpy())
        for scene in self.scenes:
            screen = scene.screen
            before, behind = reach(screen)
            if lens.mirror and low.min() <= screen.z + behind:
                raise InputError(
                    f"⟨screen.z⟩ must lie before the mirror, whose surface may reach {low.min():.4g} mm, got {screen.z:g} mm"
                )
            if not lens.mirror and high.max() >= screen.z + before:
                raise InputError(
                    f"⟨screen.z⟩ must lie behind the lens, whose surface may reach {high.max():.4g} mm, got {screen.z:g} mm"
                )
        ahead = [e.extent[0] for e in self.scene.behind[:1]]
        if ahead and high.max() >= ahead[0]:
            raise InputError(
                f"⟨element.z⟩ of the element behind the lens must lie beyond {high.max():.4g} mm, which the lens' surface may"
                f" reach, got a body from {ahead[0]:.4g} mm on"
            )
        if self.scene.second is not None:
            most = np.full_like(low, lens.height_range[1])
            low, high = np.stack([-most, low]), np.stack([most, high])
        elif self.scene.joint:
            field = HeightField.of(lens)
            others = [
                (sphere_net(e, side, field).numpy(), departure_bound(e, lens)) for e in self.scene.elements for side in e.free_sides
            ]
            low = np.stack([*(net - room for net, room in others), low])
            high = np.stack([*(net + room for net, room in others), high])
        return torch.from_numpy(low), torch.from_numpy(high)

    @staticmethod
    def _flat(state: State, tolerance: float) -> bool:
        """Whether the last FLAT_SPAN iterations of this stage lowered the loss by less than the tolerance."""
        if tolerance == 0 or state.iteration <= FLAT_SPAN:
            return False
        losses = [row[2] for row in state.history[-FLAT_SPAN - 1 :]]
        return losses[-1] > (1.0 - tolerance) * losses[0]


def _within_limits_from(
    field: HeightField, heights: Tensor, bounds: tuple[Tensor, Tensor], max_slope: float, min_radius: float, side: int
) -> Tensor:
    """`within_limits` for a surface that is machined from +z, or from -z (side -1), where concave and convex are exchanged."""
    if side > 0:
        return within_limits(field, heights, bounds, max_slope, min_radius)
    low, high = bounds
    return -within_limits(field, -heights, (-high, -low), max_slope, min_radius)
