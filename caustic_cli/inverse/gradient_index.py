"""Initial distribution of a gradient-index (GRIN) lens for a picture (thesis 7.2.1), and what has no such design.

Notation
    p           transverse momentum n sin(angle) of light that arrives at the flat exit;  c  the cosine of that angle
    t, n        thickness of the lens, mm, and index

Light that leaves a flat side keeps its transverse momentum.  It gains grad n t / c in the lens, so that light of the momentum p
leaves in a direction of the transverse sine s where grad n = (s - p) c / t.  Optimal transport gives s from the light that a lens
of one index lets pass, as it does for an initial surface (`initial_surface`) of any source, other elements and screen.
The displacement of the light in the lens is added to first order: the mean slope acts at the middle of the straight path, plus a
third of the displacement t (s - p) / (2 n c) at the exit.  The slopes are not exactly integrable; their least-squares potential,
independent of z, is the initial index.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.initial_surface import turned_light
from caustic_cli.inverse.surface_from_slopes import fitted
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.traits import Capability

INDEX_DESIGN = Capability(
    "design of a gradient index",
    {"mirror": "⟨lens.gradient⟩ free is designed for lenses: no light enters a mirror"},
    {"mirror": "no light enters it"},
)
#: Fixed-point iterations of the initial sines.
SINES = 3
#: Relative margin of the initial index to the ends of its range.
INSIDE = 0.01
#: Largest part of the deflection that the initial index takes beside a surface.
SHARE = 0.5


def with_index(scene: Scene, values: Tensor) -> Scene:
    """The scene with control values (n, m) or (n, m, layers) of the index of its lens, over aperture and thickness."""
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


def index_of_plate(scene: Scene, target: np.ndarray, control: tuple[int, int], limits: tuple[float, float], cells: int) -> Tensor:
    """Control values (n, m) within `limits` of the index that takes all of the deflection; arguments as of `transport_index`.

    Raises:
        InputError: as of `refuse_index_design`, or the range is too narrow for the picture.
    """
    refuse_index_design(scene, limits)
    lens, (low, high) = scene.lens, limits
    layer = transport_index(scene, target, control, cells) + 0.5 * (low + high)
    spread, room = float(layer.max() - layer.min()), high - low
    if spread > (1.0 - 2.0 * INSIDE) * room:
        raise InputError(
            f"⟨lens.index_range⟩ spans {room:.3g}, and this picture requires an index that varies by {spread:.3g};"
            f" a thickness of {(lens.offset.thickness - lens.z_in) * 1.1 * spread / room:.3g} mm, a smaller ⟨mag⟩, or"
            " ⟨+lens.with_surface⟩ needs no more"
        )
    return layer


def shared_index(
    scene: Scene, target: np.ndarray, control: tuple[int, int], limits: tuple[float, float], cells: int, share: float = SHARE
) -> Tensor:
    """The same of the index that takes `share` of the deflection, or as much as the limits allow.

    Raises:
        InputError: as of `refuse_index_design`.
    """
    refuse_index_design(scene, limits)
    layer, (low, high) = transport_index(scene, target, control, cells), limits
    spread, room = float(layer.max() - layer.min()), (1.0 - 2.0 * INSIDE) * (high - low)
    return min(share, room / max(spread, 1e-300)) * layer + 0.5 * (low + high)


def transport_index(scene: Scene, target: np.ndarray, control: tuple[int, int], cells: int) -> Tensor:
    """Control values (n, m) of the index between flat sides that throws a picture, to first order in the thickness, less the middle
    of their range.

    Args:
        scene: its lens has one index; target: (n_x, n_y) irradiance on its screen; control: control values along x and y.
        cells: source cells of the transport along the longer side.
    """
    lens, exit = scene.lens, scene.lens.offset.thickness
    net = HeightField.of(replace(lens, control=control, degree=(3, 3), knots=None, gradient=None))
    light, depth = turned_light(scene, target, cells), exit - lens.z_in
    x, y, (dx, dy, dz) = light.x[:, None], light.y[None, :], light.inside
    turn = np.zeros((2, *dz.shape))
    for _ in range(SINES):
        bent = 0.5 * depth / lens.index / dz * turn
        tx, ty, tz = light.towards(x + bent[0], y + bent[1], np.full_like(dz, exit))
        turn = np.stack([tx, ty]) / np.sqrt(tx * tx + ty * ty + tz * tz) - lens.index * np.stack([dx, dy])
    middle = [c - 0.5 * depth * d / dz + b / 3.0 for c, d, b in zip((x, y), (dx, dy), bent, strict=True)]
    points = [torch.from_numpy(np.clip(c, -r, r).ravel()) for c, r in zip(middle, lens.half_size, strict=True)]
    slopes = [torch.from_numpy(np.ravel(s * dz / depth)) for s in turn]
    first = torch.zeros(net.shape, dtype=torch.float64)
    found = fitted(net, (points[0], points[1]), (slopes[0], slopes[1]), torch.ones_like(points[0]), first)
    return found - 0.5 * float(found.min() + found.max())
