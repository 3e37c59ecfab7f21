"""Design of a lamp: its free-form surface by transport, then by L-BFGS on the image of its light.

    loss = rho^2 + w (1 - efficiency + distance beside the target + lack of margin to total reflection)

rho     relative RMS error of the power on the pixels of the target and of an apron around it, the image divided by its own sum;
        of a chip, which blurs the edges, those of a border and of the apron count little, and the image is divided by its sum on
        the interior.  Of a point pixels are half as wide: on wide ones an edge that is not sharp is made up for by too much light
        beside it, and the fold in which the light ends at the rim needs a spline finer than wide pixels show
w       weight of the light that does not arrive, all light of the chip counting 1.  Where light is scarce, at the rim of the
        hemisphere, both terms compete: it is large at first, so that light comes onto the target, and small in the last stage
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.effort import STANDARD, Effort
from caustic_cli.errors import InputError
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.inverse.mirrors import Mirrors
from caustic_cli.inverse.parametrisation import InverseLaplacian
from caustic_cli.inverse.refractor_transport import CELLS, source_directions, transported
from caustic_cli.inverse.target import target_on_screen
from caustic_cli.optics import ranks
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.lamp import ChipRays, PointGrid, chip_grids, from_centre, land, least_wall, through, through_point
from caustic_cli.optics.lamp_side import Roof, inner_side
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene import Screen
from caustic_cli.scene.lamp import Goal, Lamp

#: Squared cosine of the angle of exit below which a ray is near total reflection.
MARGIN = 0.005
#: Dark pixels around the target on which light beside it is seen.
APRON = 4
#: Filters of the image, wide and narrow: of waves as long as two pixels they show 0.17 and 0.30 of the amplitude, pixels themselves
#: 0.64.  Behind the wide one light at sharp edges oscillates more: the error of a disc was 0.0079 instead of 0.0033.  The narrow
#: one needs so many rays per pixel: with 6 light within the edges of 17 x 4 m was uneven by 0.007 instead of 0.003.
WIDE, NARROW, ENOUGH = Filter("cosine", (3, 3)), Filter("gaussian", (3, 3), (2.0, 2.0)), 7
#: Pixels of a point's loss along either axis in one of a stage.
FINER = 2
#: Points of a chip along both of its axes; weight of the pixels on the border that it blurs, and of the apron.
CHIP_POINTS, BLURRED = 8, 0.015
#: Least pixels of a stage per square of a span of the spline, of a point FINER^2 times as many: finer waves than pixels show would
#: grow unseen, and cost most of the iterations of the following stage.
PER_SPAN = 1.4
#: Degree of the spline: with 5 the error of 30 x 10 m from 8 m by two surfaces was 0.0114 instead of 0.0102.
DEGREE = 3
#: Points of a grid at which limits of two surfaces hold, weight of their squares, the wall there over that to be kept, and the
#: greatest radius over that there.
LIMIT_POINTS, STIFF, SAFE, WITHIN = 8000, 10.0, 1.1, 1.02
#: Points of the grid at whose cells light must not fold, least area of a cell over that on the brightest place of the target,
#: and weight.
FOLD_POINTS, LEAST_AREA, FOLDED = 18_000, 0.2, 0.005
#: Pairs of L-BFGS: 250 iterations with 100 reached what took 600 with 20 (one surface, 30 x 10 m from 8 m).
MEMORY = 100
#: Iterations of `Aimed`.
AIMING = 60
#: Most groups of parts of the rays, each traced by one process.
GROUPS = 16
#: Radius of the first inner surface, a sphere, over its least one.
BEGIN = 4.0 / 3.0


def pixels_of(goal: Goal, count: int) -> tuple[int, int]:
    """About `count` nearly square pixels on a target: their numbers along both axes."""
    across = max(2, round(math.sqrt(count * goal.size[0] / goal.size[1])))
    return across, max(2, round(count / across))


def wanted(goal: Goal, picture: np.ndarray, pixels: tuple[int, int]) -> Tensor:
    """The part of the light wanted on each pixel, of sum 1: (n_x, n_y) float64.

    picture: (a, b) irradiance on a plane, or intensity in the far field, any scale; [i, j] with i along +x.  In the far field the
    solid angle of a pixel varies, and what lies beyond 90 degrees from the axis is dark.

    Raises:
        InputError: it is black.
    """
    power = target_on_screen(picture, goal.size, Screen(goal.size, resolution=pixels)) * goal.shares(pixels)
    if goal.far:
        power = power * (goal.directions(pixels)[:, 2] > 0).reshape(pixels)
        if not power.any():
            raise InputError("the picture has no light within 90 degrees of the axis")
    return torch.from_numpy(power / power.sum())


def directions_of(goal: Goal, pixels: tuple[int, int]) -> Tensor:
    """Unit directions from the origin to the centres of pixels, (n_x n_y, 3)."""
    return torch.from_numpy(goal.directions(pixels))


def coarse(image: Tensor) -> Tensor:
    """Sums over FINER x FINER pixels."""
    n, m = image.shape
    return image.view(n // FINER, FINER, m // FINER, FINER).sum((1, 3))


class _Traced(torch.autograd.Function):
    """Image of all rays of an objective, on the pixels of its screen, and their sums of distance and lack of margin, see `see`.

    Each part of the rays is traced in a thread, since its tensors are too small for the threads of one operation.  Of several
    processes each traces some groups of parts, over which sums are taken in their order.
    """

    @staticmethod
    def forward(ctx, values: Tensor, objective: LampObjective):
        def trace(part: Any) -> tuple[Tensor, tuple[Tensor, ...]]:
            with torch.set_grad_enabled(wanted):
                leaf = values.detach().requires_grad_(wanted)
                return leaf, objective.see(part, leaf)

        def group(count: int) -> list[Tensor]:
            done, landed = list(islice(traced, count)), []
            sums = [torch.zeros_like(objective.target), *torch.zeros(2, dtype=torch.float64)]
            for _, found in done:
                landed.append([c.detach().requires_grad_(wanted) for c in found[:3]])
                with torch.set_grad_enabled(wanted):
                    sums[0] = sums[0] + objective.splat(*landed[-1], objective.screen, objective.filter)[0]
                sums[1:] = [total + more.detach() for total, more in zip(sums[1:], found[3:], strict=True)]
            ctx.groups.append((done, landed, sums[0]))
            return [c.detach() for c in sums]

        wanted = ctx.needs_input_grad[0]
        ctx.of, ctx.groups, ctx.like = objective, [], torch.empty_like(values)
        traced = objective.pool.map(trace, (part for some in objective.groups for part in some or ()))
        own = (None if some is None else group(len(some)) for some in objective.groups)
        zero = torch.zeros((), dtype=torch.float64)
        total = [torch.zeros_like(objective.target), zero.clone(), zero.clone()]
        for more in ranks.in_order(own, [objective.target, zero, zero], objective.share):
            total = [c + m for c, m in zip(total, more, strict=True)]
        return tuple(total)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_image, *by_sums):
        def pull(traced: tuple[tuple[Tensor, tuple[Tensor, ...]], Sequence[Tensor]]) -> Tensor:
            (leaf, found), by = traced
            pairs = [(c, g) for c, g in zip(found, (*by, *by_sums), strict=True) if c.requires_grad]
            return pull_back([c for c, _ in pairs], [leaf], [g for _, g in pairs])[0]

        parts = []
        for done, landed, image in ctx.groups:
            by = pull_back([image], [c for three in landed for c in three], [by_image])
            parts += list(zip(done, (by[k : k + 3] for k in range(0, len(by), 3)), strict=True))
        pulled = ctx.of.pool.map(pull, parts)
        own = (None if some is None else [sum(islice(pulled, len(some)))] for some in ctx.of.groups)
        return sum(more for (more,) in ranks.in_order(own, [ctx.like], ctx.of.share)), None


class LampObjective:
    """The loss of control values, (n, m) or (2, n, m) (`optics.lamp.sides`), for fixed rays: of a point those of a grid, of a
    chip those of grids from several of its points.

    Args:
        target: (n_x, n_y) as of `wanted`, FINER times as many along each axis as a stage has.
        rays: about, of which `mirrors` leave those on one side.
        weight: w, see the module; of a chip for a blur as wide as the border, and in proportion to it, since the light at stake at
            the edges is.
        threads: in which parts of the rays are traced.
    """

    def __init__(self, lamp: Lamp, goal: Goal, field: PolarField, target: Tensor, rays: int, weight: float = 0.1, threads: int = 1):
        point, shape = lamp.chip.shape == "point", (target.shape[0], target.shape[1])
        self.goal, self.weight = goal, weight if point else weight * lamp.blur(goal) / lamp.border(goal)
        self.mirrors = Mirrors.of(lamp, goal, target)
        parts: Sequence[PointGrid | ChipRays] = (
            PointGrid.of(field, rays, lamp.chip, self.mirrors, shape[0] / shape[1])
            if point
            else list(chip_grids(lamp.chip, CHIP_POINTS, rays, self.mirrors))
        )
        #: Rank of this process and number of those among which groups of parts of the rays are dealt out, and these groups, None
        #: for those of other ranks.
        self.share, each = ranks.rank_and_size(), math.ceil(len(parts) / GROUPS)
        self.groups = [
            parts[k : k + each] if own else None
            for k, own in zip(range(0, len(parts), each), ranks.turns(self.share), strict=False)
        ]
        self.pool = ThreadPoolExecutor(threads)
        self.through = partial(through_point if point else through, lamp, field)
        apron, self.filter = FINER * APRON, NARROW if point and rays >= ENOUGH * target.numel() else WIDE
        self.screen = Screen(goal.size, resolution=shape).grown((apron, apron))
        smooth = self.filter.smooth(torch.nn.functional.pad(target.double(), (apron,) * 4))
        self.inside = torch.nn.functional.pad(torch.ones_like(target), (apron,) * 4, value=float(point))
        self.seen = torch.ones_like(smooth) if point else self._interior(lamp, shape)
        self.target = smooth / (smooth * self.seen).sum()
        self.over = (lambda image: image) if point else coarse
        counted = self.seen + BLURRED * (1.0 - self.seen)
        lit = torch.nn.functional.pad(target, (apron,) * 4) * self.seen
        self.weights = self.over(counted) / self.over(torch.ones_like(counted)) * float((self.over(lit) > 0).sum())
        self.splat = backend_for("cpu").splat
        brightest = float((target.numpy() / goal.shares(shape)).max())
        self.limits = limits_of(lamp, goal, field, brightest)

    def _interior(self, lamp: Lamp, shape: tuple[int, int]) -> Tensor:
        """1 on the pixels of the grown screen without a border of the target."""
        reach = [
            FINER * (APRON + round(lamp.border(self.goal) / s * n / FINER)) for n, s in zip(shape, self.goal.size, strict=True)
        ]
        found = torch.zeros([n + 2 * FINER * APRON for n in shape], dtype=torch.float64)
        found[reach[0] : -reach[0], reach[1] : -reach[1]] = 1.0
        return found

    def terms(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """rho^2, efficiency, mean distance beside the target, and lack of margin."""
        image, distance, lack = _Traced.apply(values, self)
        image = self.mirrors.whole(image)
        residual = self.over(image / (image * self.seen).sum() - self.target)
        return (self.weights * residual**2).sum(), (image * self.inside).sum(), distance, lack

    def see(self, rays, values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Where some rays land, x, y, mm, and with what power, and their contributions to the distance beside the target and to the
        lack of margin."""
        light = self.through(rays, values)
        x, y, ahead = land(self.goal, light)
        beside = [(c.abs() / (0.5 * s) - 1.0).clamp_min(0.0) for c, s in zip((x, y), self.goal.size, strict=True)]
        distance = beside[0] + beside[1]
        lack = (1.0 - light.spare / MARGIN).clamp_min(0.0)
        power = torch.where(ahead, light.power, torch.zeros_like(x))
        return x, y, power, (light.power * (distance / (1.0 + distance))).sum(), (rays.power * lack).sum()

    def __call__(self, values: Tensor) -> Tensor:
        square, efficiency, distance, lack = self.terms(values)
        loss = square + self.weight * (1.0 - efficiency + distance + lack)
        return loss if self.limits is None else loss + self.limits.lack(values)


class SurfaceLimits:
    """Limits of two free-form surfaces, at the points of a grid: a wall between them, estimated by the radial distance and the
    slopes, the least radius of the inner one, and the greatest of the outer one; and that their light does not fold."""

    def __init__(self, lamp: Lamp, goal: Goal, field: PolarField, brightest: float = 1.0):
        self.lamp, self.grids = lamp, PointGrid.of(field, LIMIT_POINTS)
        self.folds = Folds(lamp, goal, field, brightest)

    def lack(self, values: Tensor) -> Tensor:
        """Sum of squares of what lacks, relative to each limit, per point, times STIFF; and `Folds`."""
        total, count, lamp = torch.zeros((), dtype=torch.float64), 0, self.lamp
        for grid in self.grids:
            hits = [grid.hits(net) for net in values]
            inner, outer = (sum(c * c for c in hit.point).sqrt() for hit in hits)
            steep = torch.maximum(*(hit.p * hit.p + hit.q * hit.q for hit in hits))
            wall = (outer - inner) / (1.0 + steep).sqrt()
            lacks = (1.0 - wall / (SAFE * lamp.wall), 1.0 - inner / lamp.inner, WITHIN * outer / lamp.radius - 1.0)
            total = total + sum((lack.clamp_min(0.0) ** 2).sum() for lack in lacks)
            count += len(inner)
        return STIFF / count * total + self.folds.lack(values)


class RoofLimits:
    """Limits of a surface around a cavity with a flat roof, at the points of a grid: the wall, and the greatest radius."""

    def __init__(self, lamp: Lamp, roof: Roof, field: PolarField):
        self.lamp, self.roof, self.grids = lamp, roof, PointGrid.of(field, LIMIT_POINTS)

    def lack(self, values: Tensor) -> Tensor:
        """Sum of squares of what lacks, relative to each limit, per point, times STIFF."""
        total, count, lamp = torch.zeros((), dtype=torch.float64), 0, self.lamp
        for grid in self.grids:
            point = grid.hits(values).point
            lacks = (
                1.0 - self.roof.clearance(point) / (SAFE * lamp.wall),
                WITHIN * sum(c * c for c in point).sqrt() / lamp.radius - 1.0,
            )
            total = total + sum((lack.clamp_min(0.0) ** 2).sum() for lack in lacks)
            count += len(point[0])
        return STIFF / count * total


LampLimits = SurfaceLimits | RoofLimits


def limits_of(lamp: Lamp, goal: Goal, field: PolarField, brightest: float) -> LampLimits | None:
    """The limits of a design, brightest: as of `Folds`; None of a hemisphere, whose light is the same around any scaled lens."""
    if lamp.surfaces == 2:
        return SurfaceLimits(lamp, goal, field, brightest)
    side = inner_side(lamp, field, None)
    return RoofLimits(lamp, side, field) if isinstance(side, Roof) else None


class Folds:
    """Whether the light of the chip's centre folds, at the cells of a grid.

    Where it folds, which pays a little at the rim of the light, the edges of the folds are bright lines narrower than pixels: on
    pixels half as wide the error of two surfaces was 0.012 with folds and 0.006 to 0.010 without (30 x 10 m from 8 m).  What a cell
    can lack is bounded, since some targets need folds: 17 x 4 m from 5 m ended at 0.058 otherwise.

    brightest: greatest density of the target over its mean, by which the areas of cells may be smaller.
    """

    def __init__(self, lamp: Lamp, goal: Goal, field: PolarField, brightest: float = 1.0):
        (self.rays,) = PointGrid.of(field, FOLD_POINTS, lamp.chip.centre)
        self.scale = brightest / math.prod(goal.size)
        self.goal, self.through = goal, partial(through_point, replace(lamp, chip=lamp.chip.centre), field)
        number = torch.full(self.rays.shape, -1)
        number.view(-1)[self.rays.lit] = torch.arange(len(self.rays.lit))
        corners = torch.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], 2).view(-1, 4)
        self.corners = corners[(corners >= 0).all(1)]
        self.power = self.rays.power[self.corners].mean(1)

    def lack(self, values: Tensor) -> Tensor:
        """Mean over the power of how far the area of each cell on the target, over that for its light at the brightest place, is
        below LEAST_AREA; areas of folded cells are negative."""
        light = self.through(self.rays, values)
        x, y, ahead = land(self.goal, light)
        passed = torch.where(ahead, light.power, torch.zeros_like(x))
        (x0, x1, x2, x3), (y0, y1, y2, y3), power = (
            x[self.corners].unbind(1),
            y[self.corners].unbind(1),
            passed[self.corners],
        )
        area = 0.5 * ((x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)) * self.scale
        lack = (LEAST_AREA - area * passed.sum() / power.mean(1).clamp_min(1e-12)).clamp_min(0.0)
        square = torch.where((power > 0).all(1), lack * lack, torch.zeros_like(lack))
        return FOLDED * (self.power * square / (1.0 + square)).sum()


def refine(
    objective: LampObjective | Aimed,
    values: Tensor,
    iterations: int,
    on_iteration: Callable[[int, float], None] = lambda k, loss: None,
) -> Tensor:
    """Control values after at most so many iterations of L-BFGS, in the coordinates of the inverse Laplacian, from initial ones.

    on_iteration: called with the number of iterations and the loss.
    """
    # Of the logarithms of the control values, which keeps them positive; their mean affects the image, except around a hemisphere.
    spread, whole = InverseLaplacian(values, 0.0 if objective.limits is None else 1.0), objective.mirrors.whole
    values = whole(values)

    def evaluate(x: Tensor) -> tuple[float, Tensor]:
        y = x.view(values.shape).clone().requires_grad_()
        loss = objective(values * whole(spread(y)).exp())
        (g,) = torch.autograd.grad(loss, y)
        return float(loss.detach()), g.reshape(-1)

    method = LBFGS(evaluate, torch.zeros(values.numel(), dtype=torch.float64), MEMORY)
    for k in range(iterations):
        if not method.step() or method.f is None:
            break
        on_iteration(k + 1, method.f)
    with torch.no_grad():
        return values * whole(spread(method.x.view(values.shape))).exp()


def initial_lamp(lamp: Lamp, goal: Goal, field: PolarField, picture: np.ndarray, cells: int = CELLS) -> Tensor:
    """Control values (n, m) of r by transport of the light of a point to the target, see `refractor_transport`.

    cells: of the light along u and v; the target has as many directions.
    """
    pixels = pixels_of(goal, round(0.25 * math.pi * cells * cells))
    power = wanted(goal, picture, pixels).reshape(-1)
    lit = power > 0
    emitted, light = source_directions(cells, lamp.chip)
    x, a = from_centre(lamp, field, emitted, light)
    emitted, x, a = emitted[a > 0], x[a > 0], a[a > 0]
    values, aims = transported(field, x, a, directions_of(goal, pixels)[lit], power[lit], lamp.index, lamp.radius)
    limits = limits_of(replace(lamp, surfaces=1), goal, field, 1.0)
    if limits is None:
        return values
    return refine(Aimed(replace(lamp, chip=lamp.chip.centre), field, limits, emitted, a, aims), values, AIMING)


class Aimed:
    """Mean square distance of the directions (N, 3) behind a lens of light that is emitted in given ones from those aimed at: the
    transport takes light within the lens as if from the centre, from which that behind a plane does not come."""

    def __init__(self, lamp: Lamp, field: PolarField, limits: LampLimits, emitted: Tensor, power: Tensor, aims: Tensor):
        x, y, z = emitted.unbind(1)
        zero, self.mirrors = torch.zeros_like(x), Mirrors()
        self.lamp, self.field, self.aims, self.limits = lamp, field, aims, limits
        self.rays = ChipRays((zero, zero, zero), (x, y, z), power)

    def __call__(self, values: Tensor) -> Tensor:
        light = through(self.lamp, self.field, self.rays, values)
        off = ((torch.stack(light.direction, 1) - self.aims) ** 2).sum(1)
        lack = (1.0 - light.spare / MARGIN).clamp_min(0.0)
        off = torch.where(light.power > 0, off, torch.zeros_like(off))
        return (self.rays.power * (off + lack)).sum() + self.limits.lack(values)


def field_of(effort: Effort, pixels: int | None = None) -> PolarField:
    """The spline spaces of a stage with so many pixels, or the finest: spans are halved until there are as many as pixels show."""
    spans = effort.lamp_spans
    while pixels is not None and pixels < PER_SPAN * spans * spans:
        spans = spans // 2
    return PolarField.uniform((spans + DEGREE,) * 2, (DEGREE,) * 2)


def final_field(lamp: Lamp, effort: Effort) -> PolarField:
    """The spline spaces of a design."""
    stages = stages_of(lamp, effort)
    return field_of(effort, stages[-1][1][0] if stages else None)


def refined(field: PolarField, values: Tensor, finer: PolarField) -> Tensor:
    """The control values (.., n, m) of the same surfaces over spline spaces with more knots."""
    u, v = (one.change_of_basis(other) for one, other in zip(field.spaces, finer.spaces, strict=True))
    return u @ values @ v.T


def stages_of(lamp: Lamp, effort: Effort) -> list[tuple[Lamp, tuple[int, int, int, float]]]:
    """The stages of a design, each with the lamp that it refines: the lamp itself, with one surface or with a point as its chip; a
    chip with an extent comes after those of fewer rays than its own."""
    point = replace(lamp, chip=lamp.chip.centre)
    if lamp.surfaces == 2:
        found = [(replace(point, surfaces=1), effort.lamp_stages[0]), *((point, stage) for stage in effort.two_stages)]
    elif lamp.flat is not None:  # the light is deflected twice as well, and its rays cost as much
        found = [(point, stage) for stage in effort.two_stages]
    else:
        found = [(point, stage) for stage in effort.lamp_stages]
    if lamp.chip.shape == "point":
        return found
    stages = [(lamp, stage) for stage in effort.chip_stages]
    return [*(one for one in found if one[1][1] < stages[0][1][1]), *stages]


def judged_pixels(lamp: Lamp, goal: Goal, effort: Effort) -> tuple[int, int]:
    """Pixels on which a lamp is judged: half as wide along both axes as those of the last stage; of a point those of its loss."""
    across, along = pixels_of(goal, stages_of(lamp, effort)[-1][1][0])
    return 2 * across, 2 * along


def first_lamp(lamp: Lamp, goal: Goal, picture: np.ndarray, effort: Effort) -> tuple[int, PolarField, Tensor]:
    """The lamp before the first stage, `begun` of `design_lamp`.

    Raises:
        InputError: the picture is black, or the surfaces come too near to each other.
    """
    stages = stages_of(lamp, effort)
    field = field_of(effort, stages[0][1][0] if stages else None)
    values = initial_lamp(lamp, goal, field, picture, effort.lamp_cells)
    refuse_thin(lamp, field, values)
    return 0, field, values


def design_lamp(
    lamp: Lamp,
    goal: Goal,
    picture: np.ndarray,
    *,
    effort: Effort = STANDARD,
    begun: tuple[int, PolarField, Tensor] | None = None,
    on_iteration: Callable[[int, int, float], None] = lambda stage, k, loss: None,
    on_stage: Callable[[int, PolarField, Tensor], None] = lambda done, field, values: None,
    threads: int = 1,
) -> Tensor:
    """The surfaces that send the light of a chip to a picture: control values of r, mm, over the spline spaces `final_field`,
    (n, m) of one or (2, n, m) of two (`optics.lamp.sides`).

    Args:
        picture: as of `wanted`.
        begun: number of stages that were done before, and the spline spaces and control values after them.
        on_iteration: called with the number of the stage, that of iterations in it and the loss.
        on_stage: called with the number of stages that are done, and the spline spaces and control values.
        threads: as of `LampObjective`.

    Raises:
        InputError: the picture is black, or the surfaces come too near to each other.
    """
    stages, (first, field, values) = stages_of(lamp, effort), begun or first_lamp(lamp, goal, picture, effort)
    for k, (designed, (pixels, rays, iterations, weight)) in list(enumerate(stages))[first:]:
        coarser, field = field, field_of(effort, pixels)
        values = refined(coarser, values, field)
        if designed.surfaces == 2 and values.ndim == 2:
            values = torch.stack([field.sphere(BEGIN * lamp.inner), values])
        across, along = pixels_of(goal, pixels)
        target = wanted(goal, picture, (FINER * across, FINER * along))
        objective = LampObjective(designed, goal, field, target, rays, weight, threads)
        values = refine(objective, values, iterations, partial(on_iteration, k))
        on_stage(k + 1, field, values)
    if lamp.surfaces == 1 and lamp.flat is None:  # the light of one that is a little smaller is the same
        values = min(1.0, lamp.radius / field.extent(values)[1]) * values
    refuse_thin(lamp, field, values)
    return values


def refuse_thin(lamp: Lamp, field: PolarField, values: Tensor) -> None:
    """Refuse surfaces that come nearer to each other than the least wall.

    Raises:
        InputError: they do; of one surface with the radius with which it would not.
    """
    least = least_wall(lamp, field, values)
    if least >= lamp.wall:
        return
    if values.ndim == 3:
        raise InputError(
            f"the two free-form surfaces come within {least:.3g} mm of each other, and ⟨lamp.wall⟩ must be {lamp.wall:g} mm: a"
            " larger ⟨+lamp.radius⟩ or a smaller ⟨+lamp.inner⟩ is needed"
        )
    if lamp.flat is not None:
        raise InputError(
            f"the free-form surface comes within {least:.3g} mm of the cavity of {lamp.inner:g} x {lamp.flat:g} mm, and the wall"
            f" must be {lamp.wall:g} mm: a larger ⟨+lamp.radius⟩ or a smaller ⟨+lamp.inner⟩ is needed"
        )
    needed = lamp.radius * (lamp.inner + lamp.wall) / (lamp.inner + least)
    raise InputError(
        f"the free-form surface comes within {least:.3g} mm of the hemisphere of {lamp.inner:g} mm, and the wall must be"
        f" {lamp.wall:g} mm: ⟨lamp.radius⟩ of {math.ceil(10.1 * needed) / 10:g} mm or more, or a smaller ⟨+lamp.inner⟩, is needed"
    )
