"""Lenslet arrays: each lenslet is designed in its own frame, and all of them are assembled into one B-spline surface.

Notation
    (N, M)   lenslets along x and y; a lenslet is w = size / (N, M) wide
    c_ij     centre of lenslet i, j: ((i + 1/2) / N - 1/2, (j + 1/2) / M - 1/2) times the size, mm
    s, p     knot spans of a lenslet and the degree, along each axis
    P_ij     control net of a lenslet, s + p points along each axis: those from i (s + p - 1) on of the whole net, so that
             neighbours share the ones on their border
    h_ij     height offset (piston) of a lenslet, mm

In the frame of lenslet i, j the screen is shifted by -c_ij, as are near sources, and of sources that are each for a lenslet it has
its own; all else is the same.  Its light is that through its own part of the entrance.  The landing points of collimated light do
not depend on a height offset, and those of other light hardly, so the h_ij are chosen to make borders meet: they minimise the sum
over all borders of the mean square step between the control points on both sides.  The remaining steps, at most
`AssembledArray.gap`, are averaged.  The surface may have a crease along a border: borders are knots of multiplicity p
(`bspline.open_knots`), so that the control points of a lenslet affect no other.
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
from caustic_cli.inverse.incidence import on_entrance
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.inverse.mixture import Member, Mixture
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.optics import ranks
from caustic_cli.optics.resampling import resampled
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene, Source
from caustic_cli.scene.lens import lenslet_centres
from caustic_cli.scene.traits import Capability

LENSLETS = Capability(
    "lenslet arrays",
    {
        "laser beam": "⟨lens.array⟩ would give each lenslet a beam of its own",
        **dict.fromkeys(
            ("ray file", "ray file among sources"), "⟨lens.array⟩ does not divide the rays of a file among its lenslets"
        ),
    },
)
#: Cells along a lenslet by which the light on it is summed.
CELLS = 16


@dataclass(frozen=True, eq=False)
class Lenslet:
    """One lenslet of an array.

    scene, field: in its own frame, with its section of the beam; rows, columns: of its control points in the net of the array;
    share: its fraction of the light on the array; middle: its centre on that, mm.
    """

    scene: Scene
    field: HeightField
    rows: slice
    columns: slice
    share: float
    middle: tuple[float, float] = (0.0, 0.0)

    def of(self, net: Tensor) -> Tensor:
        """Its section of a control net (n, m) of the array."""
        return net[self.rows, self.columns]


def lenslets(scene: Scene, control: tuple[int, int] | None = None) -> list[Lenslet]:
    """The lenslets of a scene's lens, j fastest; control: points of the array's net, the lens' own unless given.

    Raises:
        InputError: no light falls on a lenslet.
    """
    lens, screen = scene.lens, scene.screen
    LENSLETS.refuse(scene)
    steps = [(n - 1) // k for n, k in zip(control or lens.control, lens.array, strict=True)]
    size = (lens.size[0] / lens.array[0], lens.size[1] / lens.array[1])
    own = replace(lens, size=size, control=(steps[0] + 1, steps[1] + 1), array=(1, 1))
    found, centres = [], lenslet_centres(lens.array, lens.size)
    for i in range(lens.array[0]):
        for j in range(lens.array[1]):
            number = i * lens.array[1] + j
            middle = centres[number]
            source = scene.source.members[number] if scene.source.by_lenslet else scene.source
            alone = source.each(lambda one, at=(i, j), middle=middle: _section(one, at, lens.array, middle))
            pairs = zip(source.fractions, source.members, alone.members, strict=True)
            share = math.fsum(part * _light_on(scene, one, section, middle, size) for part, one, section in pairs)
            if not share > 0:
                raise InputError(f"no light falls on lenslet {i}, {j} (⟨source.profile⟩, ⟨source.cone⟩); each needs some")
            if not screen.far:
                screen = replace(screen, shift=tuple(s - m for s, m in zip(scene.screen.shift, middle, strict=True)))
            rows, columns = (slice(k * n, (k + 1) * n + 1) for k, n in zip((i, j), steps, strict=True))
            placed = replace(scene, source=alone, lens=own, screen=screen)
            found.append(Lenslet(placed, HeightField.of(own), rows, columns, share, middle))
    total = sum(lenslet.share for lenslet in found)
    return [replace(lenslet, share=lenslet.share / total) for lenslet in found]


def _section(source: Source, number: tuple[int, int], array: tuple[int, int], middle: Sequence[float]) -> Source:
    """A source in the frame of a lenslet: a near one displaced, of a distant one its profile there."""
    if source.profile is None:
        return source.displaced(lambda at: (at[0] - middle[0], at[1] - middle[1], at[2]), 1.0)
    (a, b), (i, j) = (max(1, -(-n // k)) for n, k in zip(source.profile.shape, array, strict=True)), number
    profile = resampled(source.profile, (a * array[0], b * array[1]))
    return replace(cast(Any, source), profile=profile[i * a : (i + 1) * a, j * b : (j + 1) * b])


def _light_on(scene: Scene, source: Source, section: Source, middle: Sequence[float], size: tuple[float, float]) -> float:
    """Light of a source, and of its section in the frame of a lenslet, on that, in the same unit for all of an array."""
    if source.distant:
        return 1.0 if section.profile is None else float(section.profile.sum())
    x, y = (m + np.linspace(-0.5, 0.5, CELLS + 1) * w for m, w in zip(middle, size, strict=True))
    return float(on_entrance(replace(scene, source=source), x, y)[0].sum())


@dataclass(frozen=True, eq=False)
class AssembledArray:
    """heights: control net (n, m) of the array, mm; gap: largest step between control points of two lenslets on a border, mm."""

    heights: Tensor
    gap: float


def assemble(nets: Sequence[Tensor], array: tuple[int, int]) -> AssembledArray:
    """Assemble the control nets of all lenslets, j fastest, into that of the array; the mean height is unchanged."""
    n, m = array
    parts = torch.stack(list(nets)).double().view(n, m, *nets[0].shape)
    steps = [parts[:-1, :, -1] - parts[1:, :, 0], parts[:, :-1, :, -1] - parts[:, 1:, :, 0]]  # (n - 1, m, k), (n, m - 1, k)
    numbers = torch.arange(n * m).view(n, m)
    before = torch.cat([numbers[:-1].reshape(-1), numbers[:, :-1].reshape(-1)])
    behind = torch.cat([numbers[1:].reshape(-1), numbers[:, 1:].reshape(-1)])
    wanted = torch.cat([s.mean(-1).reshape(-1) for s in steps])
    equations = torch.zeros(len(wanted) + 1, n * m, dtype=torch.float64)
    lines = torch.arange(len(wanted))
    equations[lines, behind], equations[lines, before], equations[-1] = 1.0, -1.0, 1.0  # the last equation: zero mean offset
    # by numpy: the last bits of torch.linalg.lstsq differ from run to run, by where in memory MKL works
    found, *_ = np.linalg.lstsq(equations.numpy(), torch.cat([wanted, wanted.new_zeros(1)]).numpy())
    raised = torch.from_numpy(found).view(n, m)
    parts = parts + raised[:, :, None, None]
    gaps = [parts[:-1, :, -1] - parts[1:, :, 0], parts[:, :-1, :, -1] - parts[:, 1:, :, 0]]
    (a, b) = parts.shape[2] - 1, parts.shape[3] - 1
    net, count = torch.zeros(n * a + 1, m * b + 1, dtype=torch.float64), torch.zeros(n * a + 1, m * b + 1, dtype=torch.float64)
    for i in range(n):
        for j in range(m):
            net[i * a : (i + 1) * a + 1, j * b : (j + 1) * b + 1] += parts[i, j]
            count[i * a : (i + 1) * a + 1, j * b : (j + 1) * b + 1] += 1.0
    return AssembledArray(net / count, max((float(g.abs().max()) for g in gaps if g.numel()), default=0.0))


def initial_array(scene: Scene, targets: Sequence[np.ndarray], control: tuple[int, int], cells: int) -> AssembledArray:
    """Initial surface of an array by optimal transport, solved for each lenslet.

    Args:
        scene: source, lens and screen of the whole.
        targets: (n_x, n_y) irradiance on the screen, of each lenslet, j fastest; or one for all.
        control: points of the array's net.
        cells: source cells along a lenslet's longer side.

    Raises:
        InputError: as of `lenslets` and `first_surface`.
    """
    parts, whole = lenslets(scene, control), replace(scene, lens=replace(scene.lens, array=(1, 1)))
    each = targets if len(targets) == len(parts) else [targets[0]] * len(parts)
    nets = []
    for one, goal in zip(parts, each, strict=True):
        place = None if scene.source.distant or scene.source.by_lenslet else (whole, one.middle)
        nets.append(first_surface(one.scene, goal, one.field, cells, fixed=True, array=place).heights)
    return assemble(nets, scene.lens.array)


def array_objective(parts: Sequence[Lenslet], objective: Callable[[int, Lenslet], LossOfHeights]) -> Mixture:
    """The loss of an array as a function of its heights, each lenslet against its own target.

        L = sqrt(mean over lenslets of L_k^2),    L_k the loss of lenslet k as a lens by itself

    so that lenslets do not compensate each other's errors, and the image does not depend on the beam profile.  Control points on a
    border belong to both lenslets.

    Args:
        parts: the lenslets of the array.
        objective: returns the loss of a lenslet, given its number.
    """
    with ranks.alone():
        losses = [objective(k, one) for k, one in enumerate(parts)]
    each = 1.0 / len(parts)
    return Mixture(
        [Member(loss, each, one.share, one.share, (one.rows, one.columns)) for loss, one in zip(losses, parts, strict=True)], 2.0
    )
