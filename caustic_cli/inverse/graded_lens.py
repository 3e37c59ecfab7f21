"""Design of a gradient-index lens whose index and exit surface are found together.

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
that of a surface does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.gradient_index import (
    INSIDE,
    IndexObjective,
    OnIteration,
    iterate,
    refuse_index_design,
    transport_index,
    volume,
)
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.inverse.losses import NoLight
from caustic_cli.inverse.objective import Evaluation
from caustic_cli.inverse.parametrisation import FreeHeights
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.gradient.fields import SplineIndex
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.scene import Scene

#: Largest part of the deflection that the initial index takes.
SHARE = 0.5
#: Parts of a `FirstValues` that the state of a search holds, since its unknowns count from there.
BEGUN = ("heights", "index")


@dataclass(frozen=True, eq=False)
class IndexAndExit:
    """A gradient-index lens: its index, heights of the exit (n, m) mm, and the state from which the search continues bitwise."""

    index: SplineIndex
    heights: Tensor
    state: dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class FirstValues:
    """Where a search begins."""

    #: Heights of the exit (n, m) mm, and control values of the index (n, m, layers).
    heights: Tensor
    index: Tensor
    #: Least and largest heights (n, m), mm, and the same of the control values.
    bounds: tuple[Tensor, Tensor]
    limits: tuple[float, float]


def initial_index(
    scene: Scene, target: np.ndarray, control: tuple[int, int], limits: tuple[float, float], cells: int, share: float = SHARE
) -> Tensor:
    """Control values (n, m) of the index that takes `share` of the deflection, or as much as the limits allow; args as of
    `design_gradient_index`.

    Raises:
        InputError: as of `refuse_index_design`.
    """
    refuse_index_design(scene, limits)
    layer, (low, high) = transport_index(scene, target, control, cells), limits
    spread, room = float(layer.max() - layer.min()), (1.0 - 2.0 * INSIDE) * (high - low)
    return min(share, room / max(spread, 1e-300)) * layer + 0.5 * (low + high)


class JointLoss:
    """Half the squared relative RMS and its gradient at unknowns x (n m + layers i j,), those of the surface first; 0 at the start.

    Args:
        objective: of both; start: of the search.
        weights: of the steps of surface and index; 0 keeps one as it is.
        laplacian: the preconditioner, which a start by transport is better without.
    """

    def __init__(
        self, objective: IndexObjective, start: FirstValues, weights: tuple[float, float] = (1.0, 1.0), laplacian: bool = False
    ):
        self.objective, self.pixels = objective, objective.loss.target.numel()
        layers = [layer.contiguous() for layer in start.index.double().unbind(-1)]
        low, high = (torch.full_like(layers[0], limit) for limit in start.limits)
        self.surface = FreeHeights(*start.bounds, start.heights, laplacian)
        self.layers = [FreeHeights(low, high, layer, laplacian) for layer in layers]
        lens, points = objective.scene.lens, start.heights.numel()
        by_surface = float(self.surface.span.mean()) * (lens.index - 1.0)
        by_index = (start.limits[1] - start.limits[0]) * (lens.offset.thickness - lens.z_in)
        self.weights = weights[0], weights[1] * by_surface / by_index * math.sqrt(len(layers) * low.numel() / points)
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
        return self.surface(), torch.stack([net() for net in self.layers], -1)

    def __call__(self, x: Tensor) -> tuple[float, Tensor]:
        (heights, values), name = self.lens(x), self.objective.name
        try:
            found = self.objective.evaluate({EXIT: heights.detach(), name: values.detach()})
        except NoLight:
            if not self.is_lit:
                raise
            return math.inf, torch.zeros_like(x)  # treated as too long by the line search
        relative, self.is_lit = found.loss * self.pixels, True
        (by_surface,) = pull_back([heights], [self.surface.y], [found.gradients[EXIT]])
        by_index = torch.stack(pull_back([values], [net.y for net in self.layers], [found.gradients[name]]))
        blocks = [weight * by.reshape(-1) for weight, by in zip(self.weights, (by_surface, by_index), strict=True)]
        value = 0.5 * relative * relative
        self.evaluations[value] = found
        return value, self.pixels * relative * torch.cat(blocks)


def design_graded_lens(
    scene: Scene,
    field: HeightField,
    target: np.ndarray,
    start: FirstValues,
    *,
    rays: int,
    iterations: int,
    seed: int = 0,
    limits: Limits | None = None,
    how: LossImage | None = None,
    known: Mapping[str, Tensor] = MappingProxyType({}),
    on_iteration: OnIteration = lambda k, loss, on_screen, image: None,
    stop: Callable[[], bool] = lambda: False,
) -> IndexAndExit:
    """Design index and exit for a picture.

    Args:
        scene: a plane wave, the lens and the screen; field: spline spaces of the exit.
        target: (n_x, n_y) irradiance on the screen's pixels.
        rays: traced in each iteration; seed: of the rays; limits: of the surface; how: the image is rendered.
        known: the state of an earlier search, which is continued instead of one from `start`; empty for none.
        on_iteration, stop: as of `design_gradient_index`.

    Raises:
        CausticError: no light reaches the screen.
        InputError: `known` is of other unknowns, or as of `refuse_index_design`.
    """
    refuse_index_design(scene, start.limits)
    if known:
        start = replace(start, **{name: known[name] for name in BEGUN})
    objective = IndexObjective(scene, target, volume(scene, start.index), rays, seed, field, limits, how)
    loss = JointLoss(objective, start)
    search = LBFGS(loss, torch.zeros(sum(loss.split), dtype=torch.float64))
    if known:
        search.load({name: value for name, value in known.items() if name not in BEGUN})
    iterate(search, loss.evaluations, iterations, on_iteration, stop)
    with torch.no_grad():
        heights, values = loss.lens(search.x)
    return IndexAndExit(volume(scene, values), heights, search.state() | {name: getattr(start, name) for name in BEGUN})
