"""Optimisers over an objective and a parametrisation: Adam, as in the thesis, and L-BFGS.

Both evaluate a step before accepting it, and reject one that leads to a loss that is not finite or to an image without light.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor

from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.lbfgs import LBFGS, UNFIT
from caustic_cli.inverse.losses import NoLight
from caustic_cli.inverse.objective import Evaluation, Objective
from caustic_cli.inverse.parametrisation import Heights
from caustic_cli.optics.pullback import pull_back

#: Most halvings of a rejected step of Adam.
MOST_HALVINGS = 200


class NotFinite(CausticError):
    """The loss or its derivative is not finite."""

    def __init__(self):
        super().__init__("the loss or its derivative is not finite for this lens; heights within a smaller height_range may help")


class Adam:
    """Adam on the loss (Kingma and Ba, 2015); `loss`, `on_screen` and `image` are those of the point before the step.

    A step to a loss that is not finite, or to an image without light, is rejected and halved until it is accepted, so that the
    parameters in a checkpoint have always been evaluated.  `rejected` counts such steps.
    """

    #: Whether a step changes the tensors of parameters and `state`, instead of replacing them.
    in_place = True

    def __init__(self, objective: Objective, heights: Heights, lr: float):
        self.objective, self.heights, self.loss, self.on_screen = objective, heights, math.inf, 0.0
        self.image: Tensor | None = None
        self.adam = torch.optim.Adam(heights.parameters(), lr=lr)
        self.here: tuple[Tensor, Evaluation] | None = None
        self.rejected = 0

    def step(self) -> bool:
        z, e = self.here or self._evaluate_here()
        parameters = list(self.heights.parameters())
        before = [p.detach().clone() for p in parameters]
        for p, by in zip(parameters, pull_back([z], parameters, [e.gradient.to(z.device)]), strict=True):
            p.grad = by
        self.adam.step()
        self.loss, self.on_screen, self.image, self.here = e.loss, e.on_screen, e.image, None
        for halvings in range(MOST_HALVINGS):
            try:
                self.here = self._evaluate_here()
                return True
            except (NoLight, NotFinite):
                self.rejected += halvings == 0
                for p, old in zip(parameters, before, strict=True):
                    p.data = 0.5 * (p.data + old)
        raise CausticError("no step along the gradient leads to a finite loss with light on the screen; a smaller ⟨lr⟩ may help")

    def _evaluate_here(self) -> tuple[Tensor, Evaluation]:
        """Heights, with their graph, and their evaluation.

        Raises:
            NotFinite, NoLight: the loss or its gradient is not finite, or no light reaches the screen.
        """
        z, objective = self._objective_here()
        e = objective(z.detach()) if bool(torch.isfinite(z).all()) else None
        if e is None or not e.finite:
            raise NotFinite
        return z, e

    def _objective_here(self) -> tuple[Tensor, Callable[[Tensor], Evaluation]]:
        """Heights, with their graph, and the objective to evaluate them with."""
        return self.heights(), self.objective

    @property
    def steps(self) -> int:
        """Number of steps so far, including those before a checkpoint."""
        state = self.adam.state_dict()["state"]
        return int(state[0]["step"]) if state else 0

    def state(self) -> dict[str, Tensor]:
        out = {}
        for k, entry in self.adam.state_dict()["state"].items():
            out |= {f"{k}.{name}": value for name, value in entry.items()}
        return out

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue from a `state()`.

        Raises:
            InputError: the state is of another method or of other parameters.
        """
        own = {}
        for k, p in enumerate(self.heights.parameters()):
            own |= {f"{k}.step": (), f"{k}.exp_avg": tuple(p.shape), f"{k}.exp_avg_sq": tuple(p.shape)}
        if {name: tuple(value.shape) for name, value in state.items()} != own:
            raise InputError(UNFIT)
        whole = self.adam.state_dict()
        whole["state"] = {}
        for key, value in state.items():
            k, name = key.split(".")
            whole["state"].setdefault(int(k), {})[name] = value
        self.adam.load_state_dict(whole)


class QuasiNewton:
    """L-BFGS on half the squared relative RMS, whose curvature near the minimum is that of a least-squares problem."""

    #: As of `Adam`.
    in_place = False

    def __init__(self, objective: Objective, heights: Heights, lr: float):
        self.objective, self.heights = objective, heights
        (self.parameter,) = heights.parameters()
        self.pixels = objective.loss.target.numel()
        self.seen: dict[float, tuple[float, Tensor]] = {}
        self.image: Tensor | None = None
        self.rejected = 0
        here = weakref.ref(self)  # else each would hold the other, and the memory of the objective

        def evaluate(x: Tensor) -> tuple[float, Tensor]:
            return cast(QuasiNewton, here())._evaluate(x)

        self.method = LBFGS(evaluate, self.parameter.detach().reshape(-1).clone())
        self.loss, self.on_screen = math.inf, 0.0

    def _evaluate(self, x: Tensor) -> tuple[float, Tensor]:
        self.parameter.data = x.view(self.parameter.shape)
        z = self.heights()
        try:
            e = self.objective(z.detach())
            if not e.finite:
                raise NotFinite
        except (NoLight, NotFinite):
            if self.method.f is None:
                raise
            self.rejected += 1
            return math.inf, torch.zeros_like(x)  # treated as too long by the line search
        relative = e.loss * self.pixels
        (g,) = pull_back([z], [self.parameter], [e.gradient.to(z.device) * (self.pixels * relative)])
        value = 0.5 * relative * relative
        least = min(self.seen, default=value)  # the line search accepts the best or the last evaluation
        self.seen = {key: found for key, found in self.seen.items() if key == least} | {value: (e.on_screen, e.image)}
        return value, g.reshape(-1)

    def step(self) -> bool:
        self.seen = {}
        moved = self.method.step()
        self.parameter.data = self.method.x.view(self.parameter.shape)
        if self.method.f is not None:
            self.loss = math.sqrt(2.0 * self.method.f) / self.pixels
            self.on_screen, self.image = self.seen.get(self.method.f, (self.on_screen, self.image))
        return moved

    def state(self) -> dict[str, Tensor]:
        return self.method.state()

    def load(self, state: dict[str, Tensor]) -> None:
        self.method.load(state)
