"""Initial distribution of a gradient-index (GRIN) lens for a picture (thesis 7.2.1), and what has no such design.

Notation
    p           transverse momentum n sin(angle) of light that arrives at the flat exit;  c  the cosine of that angle
    t, n        thickness of the lens, mm, and index

Light that leaves a flat side keeps its transverse momentum.  It gains grad n t / c in the lens, so that light of the momentum p
leaves in a direction of the transverse sine s where grad n = (s - p) c / t.  Optimal transport gives s from the light that a lens
of one index lets pass, as it does for an initial surface (`initial_surface`) of any source, other elements and screen.
The slopes are not exactly integrable; their least-squares potential is the initial index.

The slope acts along the path, which departs from the axis by the inclination of the light in the lens, and by that of its bending,
t (s - p) / (2 n c) at the exit, to first order.  An index independent of z has it at the mean place of the path, and smears detail
finer than the path is wide; in light that is inclined, several layers of control values along z follow the path (`layers_along`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import incident
from caustic_cli.inverse.initial_surface import turned_light
from caustic_cli.inverse.surface_from_slopes import fitted
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.gradient import DEGREE, Gradient
from caustic_cli.scene.traits import Capability

INDEX_DESIGN = Capability(
    "design of a gradient index",
    {"mirror": "⟨lens.gradient⟩ free is designed for lenses: no light enters a mirror"},
    {"mirror": "no light enters it"},
)
#: Places along each axis where the inclination of the light is measured, and most layers that follow it.
PLACES, MOST_LAYERS = 9, 8
#: Fixed-point iterations of the initial sines.
SINES = 3
#: Relative margin of the initial index to the ends of its range.
INSIDE = 0.01
#: Largest part of the deflection that the initial index takes beside a surface.
SHARE = 0.5


def with_index(scene: Scene, values: Tensor) -> Scene:
    """The scene with control values (n, m, layers) of the index of its lens, over aperture and thickness."""
    return replace(scene, lens=replace(scene.lens, gradient=Gradient("volume", volume=values.numpy())))


def refuse_index_design(scene: Scene, limits: tuple[float, float]) -> None:
    """Refuse what has no such design.

    Raises:
        InputError: a mirror, a range of the index out of bounds, or a lens without thickness.
    """
    lens, (low, high) = scene.lens, limits
    INDEX_DESIGN.refuse(scene)
    if not 1.0 <= low < high <= 5.0:
        raise InputError(f"⟨lens.index_range⟩ must ascend within 1 to 5, got [{low:g}, {high:g}]")
    if not lens.offset.thickness > lens.z_in:
        raise InputError(f"⟨lens.thickness⟩ must lie behind the entrance at {lens.z_in:g} mm, got {lens.offset.thickness:g} mm")


def layers_along(scene: Scene, control: tuple[int, int]) -> int:
    """Layers of control values along z by which an index follows the light of the centre of the source to the detail of its control
    values along x and y: 1 where the light departs from the axis by less than that."""
    lens, depth = scene.lens, scene.lens.offset.thickness - scene.lens.z_in
    x, y = (np.linspace(-r, r, PLACES) for r in lens.half_size)
    _, directions = incident(scene, x, y, np.full((PLACES, PLACES), lens.offset.thickness))
    if directions is None:
        return 1
    *across, along = directions
    finest = [2.0 * r / (n - min(DEGREE, n - 1)) for r, n in zip(lens.half_size, control, strict=True)]
    apart = round(max(depth * float(np.abs(c / along).max()) / w for c, w in zip(across, finest, strict=True)))
    return min(MOST_LAYERS, max(DEGREE, apart) + 1) if apart > 1 else 1


def index_of_plate(
    scene: Scene, target: np.ndarray, control: tuple[int, int], limits: tuple[float, float], cells: int, layers: int = 1
) -> Tensor:
    """Control values (n, m, layers) within `limits` of the index that takes all of the deflection; arguments as of
    `transport_index`.

    Raises:
        InputError: as of `refuse_index_design`, or the range is too narrow for the picture.
    """
    refuse_index_design(scene, limits)
    lens, (low, high) = scene.lens, limits
    values = transport_index(scene, target, control, cells, layers) + 0.5 * (low + high)
    spread, room = float(values.max() - values.min()), high - low
    if spread > (1.0 - 2.0 * INSIDE) * room:
        raise InputError(
            f"⟨lens.index_range⟩ spans {room:.3g}, and this picture requires an index that varies by {spread:.3g};"
            f" a thickness of {(lens.offset.thickness - lens.z_in) * 1.1 * spread / room:.3g} mm, a smaller ⟨mag⟩, or"
            " ⟨+lens.with_surface⟩ needs no more"
        )
    return values


def shared_index(
    scene: Scene,
    target: np.ndarray,
    control: tuple[int, int],
    limits: tuple[float, float],
    cells: int,
    layers: int = 1,
    share: float = SHARE,
) -> Tensor:
    """The same of the index that takes `share` of the deflection, or as much as the limits allow.

    Raises:
        InputError: as of `refuse_index_design`.
    """
    refuse_index_design(scene, limits)
    values, (low, high) = transport_index(scene, target, control, cells, layers), limits
    spread, room = float(values.max() - values.min()), (1.0 - 2.0 * INSIDE) * (high - low)
    return min(share, room / max(spread, 1e-300)) * values + 0.5 * (low + high)


def transport_index(scene: Scene, target: np.ndarray, control: tuple[int, int], cells: int, layers: int = 1) -> Tensor:
    """Control values (n, m, layers), less the middle of their range, of the index between flat sides that throws a picture, to
    first order in the thickness.

    Args:
        scene: its lens has one index; target: (n_x, n_y) irradiance on its screen; control: control values along x and y.
        cells: source cells of the transport along the longer side; layers: control values along z.

    Of separate sources, which no source at their centre represents, the index is even.
    """
    if scene.source.apart:
        return torch.zeros(*control, layers, dtype=torch.float64)
    lens, exit = scene.lens, scene.lens.offset.thickness
    net = HeightField.of(replace(lens, control=control, degree=(3, 3), knots=None, gradient=None))
    light, depth = turned_light(scene, target, cells), exit - lens.z_in
    x, y, (dx, dy, dz) = light.x[:, None], light.y[None, :], light.inside
    turn = np.zeros((2, *dz.shape))
    for _ in range(SINES):
        bent = 0.5 * depth / lens.index / dz * turn
        tx, ty, tz = light.towards(x + bent[0], y + bent[1], np.full_like(dz, exit))
        turn = np.stack([tx, ty]) / np.sqrt(tx * tx + ty * ty + tz * tz) - lens.index * np.stack([dx, dy])
    slopes = [torch.from_numpy(np.ravel(s * dz / depth)) for s in turn]
    found, first = [], torch.zeros(net.shape, dtype=torch.float64)
    for straight, curved in _ways(layers):
        ways = [c - (1.0 - straight) * depth * d / dz + curved * b for c, d, b in zip((x, y), (dx, dy), bent, strict=True)]
        px, py = (torch.from_numpy(np.clip(c, -r, r).ravel()) for c, r in zip(ways, lens.half_size, strict=True))
        first = fitted(net, (px, py), (slopes[0], slopes[1]), torch.ones_like(px), first)
        found.append(first)
    values = torch.stack(found, -1)
    return values - 0.5 * (values.min() + values.max())


def _ways(layers: int) -> list[tuple[float, float]]:
    """For each layer the part of the way through the lens, and that of the displacement by bending, where its slope acts: of one
    layer their means along the way."""
    if layers == 1:
        return [(1.0 / 2.0, 1.0 / 3.0)]
    return [(z, z * z) for z in SplineSpace.uniform(layers, min(DEGREE, layers - 1)).greville.tolist()]
