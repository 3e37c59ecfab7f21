"""Lenslet arrays: each lenslet is designed in its own frame, and all of them are assembled into one B-spline surface.

Notation
    (N, M)   lenslets along x and y; a lenslet is w = size / (N, M) wide
    c_ij     centre of lenslet i, j: ((i + 1/2) / N - 1/2, (j + 1/2) / M - 1/2) times the size, mm
    s, p     knot spans of a lenslet and the degree, along each axis
    P_ij     control net of a lenslet, s + p points along each axis: those from i (s + p - 1) on of the whole net, so that
             neighbours share the ones on their border
    h_ij     height offset (piston) of a lenslet, mm

In the frame of lenslet i, j the screen is shifted by -c_ij, and of sources that shine in turn it has its own; all else is the same.
The landing points of collimated light do not
depend on a height offset, so the h_ij are chosen to make borders meet: they minimise the sum over all borders of the mean square
step between the control points on both sides.  The remaining steps, at most `AssembledArray.gap`, are averaged.  The surface may
have a crease along a border: borders are knots of multiplicity p (`bspline.open_knots`), so that the control points of a lenslet
affect no other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.inverse.mixture import Member, Mixture
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.optics.resampling import resampled
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability

NEEDS_DISTANT_SOURCE = (
    "⟨lens.array⟩ needs light from infinity, which reaches every lenslet alike: ⟨+source.type⟩ plane, or a disc with"
    " ⟨+source.angle⟩"
)
LENSLETS = Capability(
    "lenslet arrays",
    {
        "near source": NEEDS_DISTANT_SOURCE,
        "laser beam": "⟨lens.array⟩ would give each lenslet a beam of its own",
        "far field": "⟨lens.array⟩ is designed for a screen at a distance, not for ⟨+throw⟩ inf",
    },
)


@dataclass(frozen=True, eq=False)
class Lenslet:
    """One lenslet of an array.

    scene, field: in its own frame, with its section of the beam; rows, columns: of its control points in the net of the array;
    share: its fraction of the light on the array.
    """

    scene: Scene
    field: HeightField
    rows: slice
    columns: slice
    share: float

    def of(self, net: Tensor) -> Tensor:
        """Its section of a control net (n, m) of the array."""
        return net[self.rows, self.columns]


def lenslets(scene: Scene, control: tuple[int, int] | None = None) -> list[Lenslet]:
    """The lenslets of a scene's lens, j fastest; control: points of the array's net, the lens' own unless given.

    Raises:
        InputError: light does not come from infinity, or none falls on a lenslet.
    """
    lens, screen = scene.lens, scene.screen
    LENSLETS.refuse(scene)
    steps = [(n - 1) // k for n, k in zip(control or lens.control, lens.array, strict=True)]
    size = (lens.size[0] / lens.array[0], lens.size[1] / lens.array[1])
    own = replace(lens, size=size, control=(steps[0] + 1, steps[1] + 1), array=(1, 1))
    light, found, hours = _light(scene.source.profile, lens.array), [], scene.source.in_turn
    for i in range(lens.array[0]):
        for j in range(lens.array[1]):
            middle = [((k + 0.5) / n - 0.5) * w for k, n, w in zip((i, j), lens.array, lens.size, strict=True)]
            part, source = light[i][j], scene.source.members[i * lens.array[1] + j] if hours else scene.source
            if not part.sum() > 0:
                raise InputError(f"⟨source.profile⟩ leaves lenslet {i}, {j} dark; each needs some light")
            if source.profile is not None:
                source = replace(source, profile=part)
            shift = (screen.shift[0] - middle[0], screen.shift[1] - middle[1])
            alone = replace(scene, source=source, lens=own, screen=replace(screen, shift=shift))
            rows, columns = (slice(k * n, (k + 1) * n + 1) for k, n in zip((i, j), steps, strict=True))
            found.append(Lenslet(alone, HeightField.of(own), rows, columns, float(part.sum())))
    total = sum(lenslet.share for lenslet in found)
    return [replace(lenslet, share=lenslet.share / total) for lenslet in found]


def _light(profile: np.ndarray | None, array: tuple[int, int]) -> list[list[np.ndarray]]:
    """Irradiance profile over each lenslet, on a grid of its own, all in the same unit."""
    if profile is None:
        return [[np.ones((1, 1))] * array[1]] * array[0]
    cells = [max(1, -(-n // k)) for n, k in zip(profile.shape, array, strict=True)]
    (a, b) = cells
    profile = resampled(profile, (a * array[0], b * array[1]))
    return [[profile[i * a : (i + 1) * a, j * b : (j + 1) * b] for j in range(array[1])] for i in range(array[0])]


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
    raised = torch.linalg.lstsq(equations, torch.cat([wanted, wanted.new_zeros(1)])[:, None]).solution.view(n, m)
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
    parts = lenslets(scene, control)
    each = targets if len(targets) == len(parts) else [targets[0]] * len(parts)
    return assemble(
        [first_surface(one.scene, goal, one.field, cells).heights for one, goal in zip(parts, each, strict=True)], scene.lens.array
    )


def array_objective(parts: Sequence[Lenslet], objective: Callable[[int, Lenslet], LossOfHeights]) -> Mixture:
    """The loss of an array as a function of its heights, each lenslet against its own target.

        L = sqrt(mean over lenslets of L_k^2),    L_k the loss of lenslet k as a lens by itself

    so that lenslets do not compensate each other's errors, and the image does not depend on the beam profile.  Control points on a
    border belong to both lenslets.

    Args:
        parts: the lenslets of the array.
        objective: returns the loss of a lenslet, given its number.
    """
    return Mixture(
        [Member(objective(k, one), 1.0 / len(parts), one.share, one.share, (one.rows, one.columns)) for k, one in enumerate(parts)],
        2.0,
    )
