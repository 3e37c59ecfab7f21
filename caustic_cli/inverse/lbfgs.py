"""L-BFGS with a strong Wolfe line search (Nocedal & Wright, Numerical Optimization, algorithms 7.4, 3.5, 3.6).

Its whole state can be saved and restored (`state()`, `load()`), and no evaluation, the expensive part, is repeated.  A step to a
value that is not finite is treated as too long.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from caustic_cli.errors import InputError

#: Constants c1 (sufficient decrease, Armijo) and c2 (curvature) of the strong Wolfe conditions.
ARMIJO, CURVATURE = 1e-4, 0.9
UNFIT = (
    "the checkpoint's optimiser is another, or of another net, than ⟨design.optimizer⟩, ⟨design.network⟩ and ⟨lens.control⟩ say;"
    " design again to change them"
)
MAX_EVALUATIONS = 12  # per line search
FIRST_STEP = 0.1  # along the first direction, in units of f / |g|^2


class LBFGS:
    """Minimises f: R^n -> R.

    Args:
        evaluate: x (n,) float64 -> (f, gradient (n,)).
        x: initial point (n,).
        memory: number of correction pairs (s, y).
    """

    def __init__(self, evaluate: Callable[[Tensor], tuple[float, Tensor]], x: Tensor, memory: int = 20):
        self.evaluate, self.memory, self.x = evaluate, memory, x
        self.f: float | None = None
        self.g: Tensor = torch.zeros_like(x)
        self.pairs: list[tuple[Tensor, Tensor]] = []
        self.evaluations = 0

    def step(self) -> bool:
        """One iteration.  False if neither the quasi-Newton direction nor steepest descent leads to a lower value."""
        if self.f is None:
            self.f, self.g = self._evaluate(self.x)
        if not float(self.g.abs().max()) > 0:
            return False
        for _ in range(2):
            direction = self._direction()
            slope = float(direction @ self.g)
            length = 1.0 if self.pairs else FIRST_STEP * 2.0 * (abs(self.f) or 1.0) / max(-slope, 1e-300)
            if slope < 0 and self._search(direction, slope, length):
                return True
            if not self.pairs:
                return False
            self.pairs = []  # restart: discard the curvature estimate, use steepest descent
        return False

    def state(self) -> dict[str, Tensor]:
        """Everything needed to continue, as tensors; none is copied, since the pairs of a large net dominate its memory."""
        out = {"x": self.x, "g": self.g, "f": torch.tensor([] if self.f is None else [self.f], dtype=torch.float64)}
        for k, pair in enumerate(self.pairs):
            out |= {f"{name}{k}": value for name, value in zip("sy", pair, strict=True)}
        return out

    def load(self, state: dict[str, Tensor]) -> None:
        """Continue from a `state()`.

        Raises:
            InputError: the state is of another method or of another number of unknowns.
        """
        if "s" in state and "y" in state:  # the layout of version 0.1.0
            rows = {f"{name}{k}": row for name in "sy" for k, row in enumerate(state[name])}
            state = {name: value for name, value in state.items() if name not in ("s", "y")} | rows
        n, shapes = self.x.numel(), {name: tuple(value.shape) for name, value in state.items()}
        count = (len(state) - 3) // 2
        own: dict[str, tuple[int, ...]] = {"x": (n,), "g": (n,), "f": (0,) if shapes.get("f") == (0,) else (1,)}
        own |= {f"{name}{k}": (n,) for name in "sy" for k in range(count)}
        if shapes != own:
            raise InputError(UNFIT)
        self.x, self.g = state["x"].clone(), state["g"].clone()
        self.f = float(state["f"][0]) if len(state["f"]) else None
        # Copied: sums over a vector depend, in the last bit, on how its memory is aligned.
        self.pairs = [(state[f"s{k}"].clone(), state[f"y{k}"].clone()) for k in range(count)]

    def _evaluate(self, x: Tensor) -> tuple[float, Tensor]:
        self.evaluations += 1
        return self.evaluate(x)

    def _direction(self) -> Tensor:
        """-H g by the two-loop recursion."""
        q, saved = -self.g, []
        for s, y in reversed(self.pairs):
            a = (s @ q) / (s @ y)
            saved.append(a)
            q = q - a * y
        if self.pairs:
            s, y = self.pairs[-1]
            q = q * ((s @ y) / (y @ y))
        for (s, y), a in zip(self.pairs, reversed(saved), strict=True):
            q = q + s * (a - (y @ q) / (s @ y))
        return q

    def _accept(self, x: Tensor, f: float, g: Tensor) -> bool:
        s, y = x - self.x, g - self.g
        if float(s @ y) > 1e-14 * float(s.norm() * y.norm()):  # keep the estimate positive definite
            self.pairs = [*self.pairs, (s, y)][-self.memory :]
        self.x, self.f, self.g = x, f, g
        return True

    def _search(self, d: Tensor, slope0: float, t: float) -> bool:
        """Move to a point along d that meets the strong Wolfe conditions, or the best lower one found."""
        assert self.f is not None
        bracket, best, lowest = _Bracket(self.f, slope0), None, self.f
        for _ in range(MAX_EVALUATIONS):
            x = self.x + t * d
            f, g = self._evaluate(x)
            if not math.isfinite(f) or not bool(torch.isfinite(g).all()):
                t = bracket.shortened(t)
                continue
            if f < lowest:
                best, lowest = (x, f, g), f
            following = bracket.step_after(t, f, float(g @ d))
            if following is None:
                return self._accept(x, f, g)
            if bracket.closed:
                break
            t = following
        return self._accept(*best) if best else False


def curvature(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The state of a method that starts at 0 with the curvature found by another one of this `state`; empty from an empty one."""
    if not state:
        return {}
    start = torch.zeros_like(state["x"])
    pairs = {name: value for name, value in state.items() if name not in ("x", "g", "f")}
    return {"x": start, "g": start.clone(), "f": torch.empty(0, dtype=torch.float64)} | pairs


class _Bracket:
    """Step lengths between which some meet the strong Wolfe conditions, for a value and a slope at 0."""

    def __init__(self, f0: float, slope0: float):
        self.f0, self.slope0 = f0, slope0
        #: Step, value, slope at the best point that satisfies Armijo's condition, and at the other end, if there is one.
        self.low = (0.0, f0, slope0)
        self.high: tuple[float, float, float] | None = None

    def step_after(self, t: float, f: float, slope: float) -> float | None:
        """The step to try after one to this value and slope; None if that meets the conditions."""
        if f > self.f0 + ARMIJO * t * self.slope0 or (self.low[0] > 0 and f >= self.low[1]):
            self.high = (t, f, slope)
        elif abs(slope) <= -CURVATURE * self.slope0:
            return None
        elif slope * ((self.high[0] if self.high else math.inf) - self.low[0]) >= 0:
            self.high, self.low = self.low, (t, f, slope)
        else:
            self.low = (t, f, slope)
        return _interpolate(self.low, self.high) if self.high else 4.0 * t

    def shortened(self, t: float) -> float:
        """The step to try after one to a value that is not finite."""
        self.high = (t, math.inf, math.inf)
        return self.low[0] + 0.1 * (t - self.low[0])

    @property
    def closed(self) -> bool:
        """Whether its ends are equal but for rounding."""
        return self.high is not None and abs(self.high[0] - self.low[0]) < 1e-10 * max(self.high[0], self.low[0])


def _interpolate(a: tuple, b: tuple) -> float:
    """Minimum of the cubic through two points (step, value, slope), kept in the inner 80 % between them."""
    (ta, fa, ga), (tb, fb, gb) = a, b
    span = tb - ta
    t = ta + 0.5 * span
    if math.isfinite(fb):
        d1 = ga + gb - 3.0 * (fb - fa) / span
        square = d1 * d1 - ga * gb
        if square >= 0:
            d2 = math.copysign(math.sqrt(square), span)
            denominator = gb - ga + 2.0 * d2
            if denominator != 0:
                t = tb - span * (gb + d2 - d1) / denominator
    else:
        t = ta + 0.1 * span
    low, high = sorted((ta + 0.1 * span, ta + 0.9 * span))
    return min(max(t, low), high)
