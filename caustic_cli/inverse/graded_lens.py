"""Optimisation of the index of a gradient-index lens, alone or together with its exit surface.

Notation
    z, n        heights of the exit, mm, and index
    t, n_0      thickness, mm, and the index of the lens
    c           factor of the unknowns of the index, relative to those of the surface (raw values of `parametrisation.FreeHeights`)

In a thin lens only the optical path (n_0 - 1) z + t n matters: what one block does, the other can do, too.  So the picture does not
say how they share the deflection of the light.  The start does: the index takes half of it, or as much as its range allows, and
the surface, found by transport of the light that this index bends, takes the rest.  From there both are unknowns of one L-BFGS
search, scaled such that steps of equal length change the optical path, as a function over the aperture, by equal amounts:

    c = (n_0 - 1) Z / (t R) sqrt(k N_i / N_s)    Z, R ranges of heights and index; N_s, N_i control points of surface and layer

with k layers, so that corrections are shared and neither block stalls.  The search minimises half the squared relative RMS, as
that of a surface does.  The values of the index are kept within the range of the material by tanh.  An index alone is searched in
the coordinates of the inverse Laplacian of each layer (`parametrisation`), since the image depends on the Laplacian of the index as
it does on that of a surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import torch
from torch import Tensor

from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.inverse.losses import NoLight
from caustic_cli.inverse.objective import Evaluation, LossOfLens
from caustic_cli.inverse.parametrisation import FreeHeights
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.system import ENTRANCE, EXIT
from caustic_cli.scene import Lens

#: Name of the control values (i, j, layers) of the index among the parameters of a trace (`gradient.medium.index_name`).
INDEX = f"{ENTRANCE}.index"
#: Parts of a `FirstValues` that the state of a search holds, since its unknowns count from there.
BEGUN = ("heights", "index")
#: Weights of the steps of exit and index: of both, and of the index alone.
BOTH, INDEX_ALONE = (1.0, 1.0), (0.0, 1.0)
#: Called with the iteration, the loss, the fraction of the light on the screen and the image there.
OnIteration = Callable[[int, float, float, Tensor | None], None]


@dataclass(frozen=True, eq=False)
class IndexAndExit:
    """A gradient-index lens: control values (i, j, layers) of its index, heights (n, m) mm of its exit, and the state from which
    the search continues bitwise."""

    index: Tensor
    heights: Tensor
    state: dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class FirstValues:
    """Where a search begins."""

    #: Heights of the exit (n, m) mm, and control values of the index (i, j, layers).
    heights: Tensor
    index: Tensor
    #: Least and largest heights (n, m), mm, and the same of the control values.
    bounds: tuple[Tensor, Tensor]
    limits: tuple[float, float]


class JointLoss:
    """Half the squared relative RMS and its gradient at unknowns x (n m + layers i j,), those of the surface first; 0 at the start.

    Args:
        objective: of EXIT and INDEX; lens: its index and thickness; start: of the search.
        weights: of the steps of surface and index; 0 keeps one as it is.
    """

    def __init__(self, objective: LossOfLens, lens: Lens, start: FirstValues, weights: tuple[float, float] = BOTH):
        self.objective, self.pixels, self.start = objective, objective.loss.target.numel(), start
        layers = [layer.contiguous() for layer in start.index.double().unbind(-1)]
        low, high = (torch.full_like(layers[0], limit) for limit in start.limits)
        self.surface = FreeHeights(*start.bounds, start.heights)
        self.layers = [FreeHeights(low, high, layer, laplacian=not weights[0]) for layer in layers]
        points = start.heights.numel()
        by_surface = float(self.surface.span.mean()) * (lens.index - 1.0)
        by_index = (start.limits[1] - start.limits[0]) * (lens.offset.thickness - lens.z_in)
        alike = by_surface / by_index * math.sqrt(len(layers) * low.numel() / points)
        self.weights = weights[0], weights[1] * (alike if weights[0] else 1.0)
        self.split = [points, len(layers) * low.numel()]
        #: By their value.
        self.evaluations: dict[float, Evaluation] = {}
        self.is_lit = False

    def lens(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Heights (n, m) mm and control values (i, j, layers) at x."""
        of_surface, of_index = (weight * part for weight, part in zip(self.weights, x.split(self.split), strict=True))
        self.surface.y.data = of_surface.view(self.surface.y.shape).clone()
        for net, y in zip(self.layers, of_index.view(len(self.layers), *self.layers[0].y.shape), strict=True):
            net.y.data = y.clone()
        values = torch.stack([net() for net in self.layers], -1)
        return self.surface() if self.weights[0] else self.start.heights, values

    def __call__(self, x: Tensor) -> tuple[float, Tensor]:
        heights, values = self.lens(x)
        try:
            found = self.objective.evaluate({EXIT: heights.detach(), INDEX: values.detach()})
        except NoLight:
            if not self.is_lit:
                raise
            return math.inf, torch.zeros_like(x)  # treated as too long by the line search
        relative, self.is_lit = found.loss * self.pixels, True
        by = {name: gradient.to(x.device) for name, gradient in found.gradients.items()}
        of_surface = torch.zeros_like(self.surface.y)
        if self.weights[0]:
            (of_surface,) = pull_back([heights], [self.surface.y], [by[EXIT]])
        of_index = torch.stack(pull_back([values], [net.y for net in self.layers], [by[INDEX]]))
        blocks = [weight * part.reshape(-1) for weight, part in zip(self.weights, (of_surface, of_index), strict=True)]
        value = 0.5 * relative * relative
        self.evaluations[value] = found
        return value, self.pixels * relative * torch.cat(blocks)


def design_graded_lens(
    objective: LossOfLens,
    lens: Lens,
    start: FirstValues,
    weights: tuple[float, float] = BOTH,
    *,
    iterations: int,
    known: Mapping[str, Tensor] = MappingProxyType({}),
    on_iteration: OnIteration = lambda k, loss, on_screen, image: None,
    stop: Callable[[], bool] = lambda: False,
) -> IndexAndExit:
    """Design the index, and the exit with it, for a picture: at most so many iterations, until there is no progress.

    Args:
        objective, lens, weights: as of a `JointLoss`.
        known: the state of an earlier search, which is continued instead of one from `start`; empty for none.
        on_iteration: see `OnIteration`; stop: called before every iteration; True ends the design.

    Raises:
        CausticError: no light reaches the screen.
        InputError: `known` is of other unknowns.
    """
    if known:
        start = replace(start, **{name: known[name] for name in BEGUN})
    loss = JointLoss(objective, lens, start, weights)
    search = LBFGS(loss, torch.zeros(sum(loss.split), dtype=torch.float64))
    if known:
        search.load({name: value for name, value in known.items() if name not in BEGUN})
    for k in range(iterations):
        loss.evaluations.clear()
        if stop() or not search.step():
            break
        assert search.f is not None
        found = loss.evaluations[search.f]
        on_iteration(k + 1, found.loss, found.on_screen, found.image)
    with torch.no_grad():
        heights, values = loss.lens(search.x)
    return IndexAndExit(values, heights, search.state() | {name: getattr(start, name) for name in BEGUN})
