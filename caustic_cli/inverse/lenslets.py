"""Lenslet arrays: each lenslet is designed in its own frame, and all of them are assembled into one B-spline surface.

Notation
    (N, M)   lenslets along x and y
    c_ij     middle of the rectangle of whole knot spans around the cell of lenslet i, j, mm; in square packing its centre
    p        degree along an axis
    P_ij     control net of a lenslet, that of the array's surface over its rectangle
    h_ij     height offset (piston) of a lenslet, mm

In the frame of lenslet i, j the screen is shifted by -c_ij, as are near sources, and of sources that are each for a lenslet it has
its own; all else is the same.  Its light is that through its rectangle which meets its cell, or its circle, on the exit.  The
landing points of collimated light do not depend on a height offset, and those of other light hardly, so the h_ij are chosen to make
borders meet: they minimise the sum over all borders of the mean square step between both sides.

In square packing borders are knots of multiplicity p (`bspline.open_knots`), where the surface may have a crease, so that the
control points of a lenslet affect no other.  P_ij are points of the whole net, and neighbours share the ones on their border: the
remaining steps, at most `AssembledArray.gap`, are averaged.  In hexagonal packing borders cross the knot spans.  Each control point
of the array is then that of the lenslet at its place, continued beyond its rectangle, so that steps and creases become slopes over
p spans, and P_ij follow from the array's points by knot insertion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import on_entrance, part_within
from caustic_cli.inverse.initial_surface import COARSE, first_surface
from caustic_cli.inverse.mixture import Member, Mixture
from caustic_cli.inverse.objective import Evaluation, LossOfHeights
from caustic_cli.optics import ranks
from caustic_cli.optics.bspline import KNOT_RESOLUTION, SplineSpace
from caustic_cli.optics.resampling import area_average, resampled
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.scene import Aperture, Lens, Scene, Source
from caustic_cli.scene.packing import ConvexAperture, DiscAperture

#: Cells along a lenslet by which the light on it is summed; slack of a number of cells.
CELLS, SLACK = 16, 1e-9


@dataclass(frozen=True, eq=False)
class SplineSection:
    """A spline space on a part of the domain of another, from knot to knot: its control points are `matrix` times those of the
    other in `where`, or these points themselves where both of its ends are knots of full multiplicity (None)."""

    space: SplineSpace
    where: slice
    matrix: Tensor | None

    @classmethod
    def of(cls, whole: SplineSpace, low: float, high: float) -> SplineSection:
        """The part from one knot to another."""
        p, t = whole.degree, whole.knots
        inner = t[(t > low + KNOT_RESOLUTION) & (t < high - KNOT_RESOLUTION)]
        first, last = whole.span(torch.tensor([low + KNOT_RESOLUTION, high - KNOT_RESOLUTION], dtype=torch.float64)).tolist()
        own = SplineSpace(p, torch.cat([t.new_zeros(p + 1), (inner - low) / (high - low), t.new_ones(p + 1)]))
        where = slice(first - p, last + 1)
        if t[first - p + 1] > low - KNOT_RESOLUTION and t[last + p] < high + KNOT_RESOLUTION:
            return cls(own, where, None)
        at = (low + (high - low) * own.greville).clamp(low + KNOT_RESOLUTION, high - KNOT_RESOLUTION)
        return cls(own, where, own.interpolated(whole.matrix(at)[:, where]))

    @property
    def inverse(self) -> Tensor | None:
        """What its control points are multiplied by for those of the other: its ends are continued as polynomials."""
        return None if self.matrix is None else torch.linalg.inv(self.matrix)


def _along(matrices: Sequence[Tensor | None], net: Tensor) -> Tensor:
    """A net (n, m) times a matrix along each axis; None for the unit matrix."""
    u, v = (None if m is None else m.to(net) for m in matrices)
    net = net if u is None else u @ net
    return net if v is None else net @ v.T


@dataclass(frozen=True, eq=False)
class Lenslet:
    """One lenslet of an array.

    scene, field: in its own frame, with its section of the beam; sections: of the spaces of the array that its own are; share: its
    fraction of the light on the array; middle: of its rectangle on that, mm.
    """

    scene: Scene
    field: HeightField
    sections: tuple[SplineSection, SplineSection]
    share: float
    middle: tuple[float, float] = (0.0, 0.0)

    @property
    def where(self) -> tuple[slice, slice]:
        """The control points of the array on which it depends."""
        return self.sections[0].where, self.sections[1].where

    def of(self, net: Tensor) -> Tensor:
        """Its control net, of a net (n, m) of the array."""
        return _along([s.matrix for s in self.sections], net[self.where])

    def into(self, net: Tensor) -> Tensor:
        """The control points of the array on which it depends, of its control net."""
        return _along([s.inverse for s in self.sections], net)


@dataclass(frozen=True, eq=False)
class _OfSection:
    """The loss of a lenslet as a function of the control points of the array on which it depends."""

    objective: LossOfHeights
    matrices: list[Tensor | None]

    @property
    def loss(self):
        """Of its image."""
        return self.objective.loss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient."""
        found = self.objective(_along(self.matrices, heights))
        back = [None if m is None else m.T for m in self.matrices]
        return replace(found, gradients={EXIT: _along(back, found.gradient)})


def _rectangle(lens: Lens, spaces: Sequence[SplineSpace], k: int) -> list[tuple[float, float]]:
    """The least rectangle of whole knot spans that contains the cell of lenslet k: (low, high) along each axis in [0, 1]."""
    found = []
    for places, space, half in zip(zip(*lens.cells.outline(k), strict=True), spaces, lens.half_size, strict=True):
        breaks, ends = space.breaks, [0.5 * (end / half + 1.0) for end in (min(places), max(places))]
        slack = 1e-6 * float(breaks.diff().min())
        first = int(torch.searchsorted(breaks, ends[0] + slack)) - 1
        last = int(torch.searchsorted(breaks, ends[1] - slack))
        found.append((float(breaks[max(0, first)]), float(breaks[min(last, len(breaks) - 1)])))
    return found


def _outline(lens: Lens, k: int, half: tuple[float, float], middle: tuple[float, float]) -> Aperture | None:
    """What is clear of lenslet k in its own frame; None for its whole rectangle."""
    x, y = lens.cells.centres[k]
    if lens.round_lenslets:
        return DiscAperture(half, (x - middle[0], y - middle[1]), lens.cells.radius)
    if lens.pieces == lens.array:
        return None
    return ConvexAperture(half, tuple((a - middle[0], b - middle[1]) for a, b in lens.cells.outline(k)))


def lenslets(scene: Scene, control: tuple[int, int] | None = None) -> list[Lenslet]:
    """The lenslets of a scene's lens, j fastest; control: points of the array's net, the lens' own unless given.

    Raises:
        InputError: no light falls on a lenslet.
    """
    lens, screen = scene.lens, scene.screen
    spaces = HeightField.of(replace(lens, control=control or lens.control)).spaces
    found, known = [], dict[tuple[int, float, float], SplineSection]()
    for k in range(math.prod(lens.array)):
        i, j = divmod(k, lens.array[1])
        ends = _rectangle(lens, spaces, k)
        for axis, (low, high) in enumerate(ends):
            if (axis, low, high) not in known:
                known[axis, low, high] = SplineSection.of(spaces[axis], low, high)
        one, two = (known[axis, low, high] for axis, (low, high) in enumerate(ends))
        (w, mx), (h, my) = (((b - a) * 2.0 * r, (a + b - 1.0) * r) for (a, b), r in zip(ends, lens.half_size, strict=True))
        own = replace(
            lens,
            size=(w, h),
            control=(one.space.n, two.space.n),
            knots=(one.space.knots.tolist(), two.space.knots.tolist()),
            array=(1, 1),
            outline=_outline(lens, k, (w / 2.0, h / 2.0), (mx, my)),
        )
        source = scene.source.members[k] if scene.source.by_lenslet else scene.source
        alone = source.each(lambda light, ends=ends, middle=(mx, my): _part(light.on(scene.pupil), ends, middle))
        screen = scene.screen
        if not screen.far:
            screen = replace(screen, shift=(screen.shift[0] - mx, screen.shift[1] - my))
        placed = replace(scene, source=alone, lens=own, screen=screen)
        pairs = zip(source.fractions, source.members, alone.members, strict=True)
        share = math.fsum(part * _light_on(scene, light, own, section, (mx, my)) for part, light, section in pairs)
        if not share > 0:
            raise InputError(f"no light falls on lenslet {i}, {j} (⟨source.profile⟩, ⟨source.cone⟩); each needs some")
        found.append(Lenslet(placed, HeightField.of(own), (one, two), share, (mx, my)))
    total = sum(lenslet.share for lenslet in found)
    return [replace(lenslet, share=lenslet.share / total) for lenslet in found]


def _part(source: Source, ends: Sequence[tuple[float, float]], middle: Sequence[float]) -> Source:
    """A source in the frame of a lenslet: a near one or a beam displaced, of a plane wave its profile over the rectangle between
    `ends`."""
    if source.profile is None or source.beam is not None:
        return source.displaced(lambda at: (at[0] - middle[0], at[1] - middle[1], at[2]), 1.0)
    profile, across = source.profile, []
    for (low, high), n in zip(ends, source.profile.shape, strict=True):
        across.append(np.linspace(low, high, max(1, math.ceil(n * (high - low) - SLACK)) + 1))
    whole = [np.linspace(0.0, 1.0, n + 1) for n in profile.shape]
    return replace(cast(Any, source), profile=area_average(profile, whole, across))


def _light_on(scene: Scene, source: Source, lens: Lens, section: Source, middle: Sequence[float]) -> float:
    """Light of a source on a lenslet, the lens in its own frame, with its section of the source there, in the same unit for all of
    an array."""
    x, y = (np.linspace(-r, r, CELLS + 1) for r in lens.half_size)
    if section.beam is not None:
        light = section.irradiance(0.5 * (x[1:] + x[:-1])[:, None], 0.5 * (y[1:] + y[:-1])[None, :], lens.pupil)
    elif not source.distant:
        light = on_entrance(replace(scene, source=source), x + middle[0], y + middle[1])[0]
    else:
        light = np.ones((CELLS, CELLS)) if section.profile is None else resampled(section.profile, (CELLS, CELLS))
    return float((light * part_within(lens.clear, x, y)).mean()) * math.prod(lens.size)


@dataclass(frozen=True, eq=False)
class AssembledArray:
    """heights: control net (n, m) of the array, mm; gap: largest step between both sides of a border, mm."""

    heights: Tensor
    gap: float


def _pistons(before: Tensor, behind: Tensor, wanted: Tensor, count: int) -> Tensor:
    """Offsets (count,) of zero mean that minimise the sum of squares of wanted - (those `behind` a border - those `before` it)."""
    equations = torch.zeros(len(wanted) + 1, count, dtype=torch.float64)
    lines = torch.arange(len(wanted))
    equations[lines, behind], equations[lines, before], equations[-1] = 1.0, -1.0, 1.0
    # by numpy: the last bits of torch.linalg.lstsq differ from run to run, by where in memory MKL works
    found, *_ = np.linalg.lstsq(equations.numpy(), torch.cat([wanted, wanted.new_zeros(1)]).numpy())
    return torch.from_numpy(found)


def assemble(nets: Sequence[Tensor], array: tuple[int, int]) -> AssembledArray:
    """Assemble the control nets of all lenslets, j fastest, which share control points, into that of the array; the mean height is
    unchanged."""
    n, m = array
    parts = torch.stack(list(nets)).double().view(n, m, *nets[0].shape)
    steps = [parts[:-1, :, -1] - parts[1:, :, 0], parts[:, :-1, :, -1] - parts[:, 1:, :, 0]]  # (n - 1, m, k), (n, m - 1, k)
    numbers = torch.arange(n * m).view(n, m)
    before = torch.cat([numbers[:-1].reshape(-1), numbers[:, :-1].reshape(-1)])
    behind = torch.cat([numbers[1:].reshape(-1), numbers[:, 1:].reshape(-1)])
    wanted = torch.cat([s.mean(-1).reshape(-1) for s in steps])
    parts = parts + _pistons(before, behind, wanted, n * m).view(n, m, 1, 1)
    gaps = [parts[:-1, :, -1] - parts[1:, :, 0], parts[:, :-1, :, -1] - parts[:, 1:, :, 0]]
    (a, b) = parts.shape[2] - 1, parts.shape[3] - 1
    net, count = torch.zeros(n * a + 1, m * b + 1, dtype=torch.float64), torch.zeros(n * a + 1, m * b + 1, dtype=torch.float64)
    for i in range(n):
        for j in range(m):
            net[i * a : (i + 1) * a + 1, j * b : (j + 1) * b + 1] += parts[i, j]
            count[i * a : (i + 1) * a + 1, j * b : (j + 1) * b + 1] += 1.0
    return AssembledArray(net / count, max((float(g.abs().max()) for g in gaps if g.numel()), default=0.0))


def sampled(parts: Sequence[Lenslet], nets: Sequence[Tensor], lens: Lens, field: HeightField) -> AssembledArray:
    """The array whose control points are those of the lenslets with these nets, each of the lenslet at its place; `gap` is between
    the lenslets of neighbouring control points, at the first of them."""
    at_x, at_y = field.control_xy()
    owner = lens.cells.number(at_x[:, None], at_y[None, :]).long()
    net, borders = torch.zeros(owner.shape, dtype=torch.float64), []
    for axis in (0, 1):
        here, there = owner.narrow(axis, 0, owner.shape[axis] - 1), owner.narrow(axis, 1, owner.shape[axis] - 1)
        i, j = (here != there).nonzero().T
        borders.append((here[i, j], there[i, j], at_x[i], at_y[j]))
    one, two, x, y = (torch.cat(c) for c in zip(*borders, strict=True))

    def height(k: int, x: Tensor, y: Tensor) -> Tensor:
        part, (rx, ry) = parts[k], parts[k].field.half_size
        return part.field.evaluate(nets[k], (x - part.middle[0]).clamp(-rx, rx), (y - part.middle[1]).clamp(-ry, ry))[0]

    first, second = torch.zeros(len(x), dtype=torch.float64), torch.zeros(len(x), dtype=torch.float64)
    for k in range(len(parts)):
        for numbers, values in ((one, first), (two, second)):
            of = (numbers == k).nonzero()[:, 0]
            values[of] = height(k, x[of], y[of])
        mine = owner[parts[k].where] == k
        net[parts[k].where][mine] = parts[k].into(nets[k])[mine]
    pair, of = torch.unique(torch.minimum(one, two) * len(parts) + torch.maximum(one, two), return_inverse=True)
    rise = torch.where(one < two, first - second, second - first)
    wanted = torch.zeros(len(pair), dtype=torch.float64).index_add(0, of, rise) / torch.bincount(of, minlength=len(pair))
    raised = _pistons(pair // len(parts), pair % len(parts), wanted, len(parts))
    left = first + raised[one] - second - raised[two]
    return AssembledArray(net + raised[owner], float(left.abs().max()) if len(left) else 0.0)


def initial_array(
    scene: Scene, targets: Sequence[np.ndarray], control: tuple[int, int], cells: int, coarse: int = COARSE
) -> AssembledArray:
    """Initial surface of an array by optimal transport, solved for each lenslet.

    Args:
        scene: source, lens and screen of the whole.
        targets: (n_x, n_y) irradiance on the screen, of each lenslet, j fastest; or one for all.
        control: points of the array's net.
        cells, coarse: source cells along a lenslet's longer side, as of `first_surface`.

    Raises:
        InputError: as of `lenslets` and `first_surface`.
    """
    parts, lens = lenslets(scene, control), scene.lens
    whole = replace(scene, lens=replace(lens, array=(1, 1)))
    each = targets if len(targets) == len(parts) else [targets[0]] * len(parts)
    own = scene.source.by_lenslet or (scene.source.distant and not scene.source.oblique)  # no light through its neighbours
    nets, known = [], dict[tuple, np.ndarray | None]()  # of a picture and an outline, in the light of another lenslet
    for k, (one, goal) in enumerate(zip(parts, each, strict=True)):
        place = None if own else (whole, one.middle)
        outline = ((x - one.middle[0], y - one.middle[1]) for x, y in lens.cells.outline(k))
        alike = id(goal), *((round(x / lens.cells.radius, 1), round(y / lens.cells.radius, 1)) for x, y in outline)
        light = {"array": place, "similar": known.get(alike)}
        found = first_surface(one.scene, goal, one.field, cells, fixed=True, coarse=coarse, **light)
        nets.append(found.heights)
        known[alike] = found.potential
    if lens.pieces == lens.array:
        return assemble(nets, lens.array)
    return sampled(parts, nets, lens, HeightField.of(replace(lens, control=control)))


def array_objective(parts: Sequence[Lenslet], objective: Callable[[int, Lenslet], LossOfHeights]) -> Mixture:
    """The loss of an array as a function of its heights, each lenslet against its own target.

        L = sqrt(mean over lenslets of L_k^2),    L_k the loss of lenslet k as a lens by itself

    so that lenslets do not compensate each other's errors, and the image does not depend on the beam profile.  Control points at a
    border belong to both lenslets.

    Args:
        parts: the lenslets of the array.
        objective: returns the loss of a lenslet, given its number.
    """
    members = []
    for k, one in enumerate(parts):
        with ranks.alone():
            own = objective(k, one)
        matrices = [s.matrix for s in one.sections]
        if any(m is not None for m in matrices):
            own = _OfSection(own, matrices)
        members.append(Member(own, 1.0 / len(parts), one.share, one.share, one.where))
    return Mixture(members, 2.0)
