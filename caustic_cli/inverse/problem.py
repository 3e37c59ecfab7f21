"""The problem that a design solves: unknown heights of a lens in a scene, their parametrisation, limits and loss in each stage.

`Problem` is a single free-form surface on rays.  Other kinds of design are subclasses (`caustic_cli.kinds`), of which the stage
loop (`designer`) knows nothing.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from caustic_cli.effort import STANDARD, Effort
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.loss_terms import parse
from caustic_cli.inverse.objective import LossOfHeights, Objective
from caustic_cli.inverse.optimisers import Adam, QuasiNewton
from caustic_cli.inverse.parametrisation import Heights, Parametrisation
from caustic_cli.inverse.schedule import Stage
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.screen_shape import reach
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene
from caustic_cli.schema.table import check_all


class Skipped(CausticError):
    """A stage that cannot be done, or is not needed, and is left out; reason: of its end."""

    def __init__(self, words: str, reason: str):
        super().__init__(words)
        self.reason = reason


@dataclass(frozen=True)
class Options:
    """Options of the optimisation; the stages set its resolution."""

    #: Weighted terms, see `losses`.
    loss: str = "rms-light"
    #: lbfgs, or adam.
    optimizer: str = "lbfgs"
    #: Learning rate of adam.
    lr: float = 1e-3
    parametrisation: Parametrisation = field(default_factory=Parametrisation)
    #: Of rays and networks.
    seed: int = 0
    #: Precision of the rays.
    dtype: torch.dtype = torch.float32
    limits: Limits = field(default_factory=Limits)
    #: Whether stages on the wave image must not be left out.
    waves: bool = False

    def __post_init__(self):
        parse(self.loss)
        check_all("design", self, "optimizer", "lr", "seed")
        if self.optimizer == "lbfgs" and not self.parametrisation.free:
            raise InputError(
                "⟨design.optimizer⟩ lbfgs works on the heights themselves (network none); a network needs optimizer adam"
            )


class Problem:
    """One free-form surface: the exit of the lens of a scene.

    Args:
        scene: its lens holds the final control net; stages replace `control`.
        target: (n_x, n_y) irradiance on the scene's screen, not all zero.
        stages, options: of the optimisation.
        device: where rays are traced.
        effort: of the initial surface and of the evaluation.

    Raises:
        InputError: stages and options contradict each other, or the lens leaves no room before the screen.
    """

    def __init__(
        self,
        scene: Scene,
        target: Tensor,
        stages: list[Stage],
        options: Options,
        device: str = "cpu",
        effort: Effort = STANDARD,
    ):
        self.scene, self.target, self.device, self.effort = scene, target, device, effort
        self.stages, self.options = stages, options
        self._prepare()

    def varied(self, stages: list[Stage], options: Options) -> Problem:
        """The same problem with other stages and options."""
        other = copy.copy(self)
        other.stages, other.options = stages, options
        other._prepare()
        return other

    def _prepare(self) -> None:
        self._room: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
        self.check()
        for k in range(len(self.stages)):
            self.bounds(k)  # refuse an impossible lens before any work

    def check(self) -> None:
        """Refuse stages and options that contradict each other.

        Raises:
            InputError: they do.
        """
        lens, stages = self.scene.lens, self.stages
        if not stages:
            raise InputError("[[design.stages]] at least one stage is needed")
        if lens.knots is not None and any(s.control != lens.control for s in stages):
            raise InputError(
                "[lens] knots: a lens with knots of its own is designed on its own net; every stage's control"
                f" must be {list(lens.control)}"
            )
        if any(name == "throughput" for _, name in parse(self.options.loss)) and not all(s.rendering.apron for s in stages):
            raise InputError(
                "⟨design.loss⟩: throughput needs dark pixels around the screen that catch stray light; every stage needs an apron"
            )

    @property
    def scenes(self) -> list[Scene]:
        """The scenes in which the lens must be possible."""
        return [self.scene]

    def field(self, k: int) -> HeightField:
        """The spline spaces of stage k."""
        return HeightField.of(replace(self.scene.lens, control=self.stages[k].control))

    def all_surfaces(self, heights: Tensor) -> Tensor:
        """Initial heights of all unknown surfaces on the control net of the first stage, from those of the exit (n, m), mm."""
        return heights

    # Limits

    def bounds(self, k: int) -> tuple[Tensor, Tensor]:
        """Least and largest heights of the control net of stage k, mm.

        Raises:
            InputError: the surface may reach the screen.
        """
        if (control := self.stages[k].control) not in self._room:
            self._room = {control: self._bounds(k)}
        return self._room[control]

    def _bounds(self, k: int) -> tuple[Tensor, Tensor]:
        lens, side = self.scene.lens, self.scene.lens.interaction.side
        low, high = lens.height_bounds(*(c.numpy() for c in self.field(k).control_xy()))
        top = side * max((side * z).max() for z in (low, high))  # towards the screen
        for screen in (scene.screen for scene in self.scenes):
            if side * (screen.z - top) <= max(-side * bound for bound in reach(screen)):
                raise InputError(
                    f"⟨screen.z⟩ must lie {lens.interaction.beyond} the {lens.kind}, whose surface may reach {top:.4g} mm,"
                    f" got {screen.z:g} mm"
                )
        return torch.from_numpy(low), torch.from_numpy(high)

    def feasible(self, k: int, heights: Tensor, rounded: bool = True) -> Tensor:
        """Heights near the given ones of stage k, mm, within the limits of slope and radius; rounded: False leaves the radius out.

        Raises:
            CausticError: none were found.
        """
        return self.options.limits.feasible(self.field(k), heights, self.bounds(k), self.scene.lens.cut_from, rounded)

    # Optimisation

    #: Number of inputs of a network beside the 1.
    inputs: int = 0

    def parametrised(self, k: int, start: Tensor | None, loaded: bool = False) -> Heights:
        """The parametrisation of stage k from initial heights, if any; loaded: its tensors are loaded afterwards."""
        o = self.options
        return o.parametrisation.heights(*self.bounds(k), start, degree=self.scene.lens.degree, seed=o.seed, inputs=self.inputs)

    def carries_parameters(self, k: int) -> bool:
        """Whether stage k goes on with the parameters of the stage before, rather than with its surface."""
        same = self.stages[k].control == self.stages[k - 1].control
        return same and (not self.options.parametrisation.free or self.options.optimizer == "adam")

    def carries_curvature(self, k: int) -> bool:
        """Whether stage k begins with the curvature that the optimiser of the stage before has found."""
        return False

    def objective(self, k: int, initial: Tensor) -> LossOfHeights:
        """The loss of stage k, for heights near `initial`."""
        return self.objective_in(self.scene, k, initial)

    def objective_in(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        """The same in another scene."""
        scene = self.lit(scene, k)
        return self.on_rays(scene, k, self.field(k), self.target, self.stages[k].rays)

    def optimiser(self, k: int) -> type[Adam] | type[QuasiNewton]:
        """The optimiser of stage k, made from objective, parametrisation and learning rate."""
        return Adam if self.options.optimizer == "adam" else QuasiNewton

    def lit(self, scene: Scene, k: int) -> Scene:
        """The scene with the source of stage k."""
        source = self.stages[k].source
        return scene if source is None else replace(scene, source=source)

    def on_rays(self, scene: Scene, k: int, field: HeightField, target: Tensor, count: int) -> Objective:
        """The objective of stage k with `count` rays of the whole source of a scene."""
        stage, o = self.stages[k], self.options
        rays = rays_of(scene, stage.sampler, count, self.seed(k), self.device)
        return Objective(scene, field, rays, target, o.loss, stage.rendering, o.limits, dtype=o.dtype)

    def seed(self, k: int) -> int:
        """Seed of all random numbers of stage k."""
        return stream(self.options.seed, f"stage {k}")
