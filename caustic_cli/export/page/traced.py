"""Light that the page does not trace but holds: rays behind the last surface, on a grid over the pupil.

Whatever a scene has before its screen (other lenses and mirrors, an index that varies, a mask), its rays are traced here, for each
point of the source at each refractive index, and the page only takes them to its screen, between them linearly.  Coordinates are
those of the axis in front of the screen.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from caustic_cli.export.page.light_field import FieldPoint, LightField
from caustic_cli.optics.emission.coherent import Mode, central_mode, modes
from caustic_cli.optics.frames import AxisSegment, to_local
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Band, Scene
from caustic_cli.scene.traits import Capability

#: What the page traces itself; the light of all other scenes is held.
ITSELF = Capability(
    "light that moves on the interactive page",
    dict.fromkeys(
        ("gradient index", "other elements", "round lenslets"),
        "its light is held by the page as it was traced here, where the page itself would take it to one lens of one index",
    ),
)
#: Points of an extended source, and those that are shown at most.
EACH, MOST = 60, 96


@dataclass(frozen=True, eq=False)
class TracedLight:
    """The light of one point of the source at one index: its part of the power; places x, y on the plane z, mm, direction cosines
    ox, oy and power w per area of the pupil, over that of the point, 1/mm^2, (n, m) each; ahead: sign of the third cosine.  Rays
    that do not arrive have the way of the nearest ray that does, and no power."""

    part: float
    band: Band
    z: float
    ahead: float
    grids: dict[str, np.ndarray]


def points_of(scene: Scene, fields: Mapping[int, LightField]) -> list[tuple[Band, Mode | FieldPoint, float]]:
    """Points of all sources at all indices, each with its part of the power; fields: of ray files, by the places of sources."""
    found: list[tuple[Band, Mode | FieldPoint, float]] = []
    for band in scene.bands:
        lit, measured = System.of(band.scene), fields.get(band.member or 0)
        each = measured.points if measured else modes(lit, EACH) if band.scene.source.extended else [central_mode(lit)]
        found += [(band, mode, band.weight) for mode in each[:: -(-len(each) // MOST)]]
    return found


def traced_lights(
    scene: Scene, field: HeightField, heights: Tensor, counts: tuple[int, int], fields: Mapping[int, LightField]
) -> Iterator[TracedLight]:
    """The light of every point, as of `points_of`, through a grid of (n, m) points over the pupil, borders included."""
    u, v = (
        c.reshape(-1) for c in torch.meshgrid(*(torch.linspace(0.0, 1.0, n, dtype=torch.float64) for n in counts), indexing="ij")
    )
    for band, mode, weight in points_of(scene, fields):
        system = System.of(band.scene, field)
        masks = [e.aperture for e in system.elements if e.name == EXIT and e.aperture.masks]
        clear = tuple(replace(e, aperture=system.pupil.aperture) if e.aperture in masks else e for e in system.elements)
        rays = mode.through(u, v, system.object_space.index_at(None))
        tracer = Tracer(replace(system, elements=clear), rays)
        with torch.no_grad():
            exit, last = tracer.ends({EXIT: heights.detach().double()})
        yield _held(band, weight, system, exit, last, masks, rays, counts)


def _held(band: Band, weight: float, system: System, exit, last, masks: list, rays, counts: tuple[int, int]) -> TracedLight:
    """The light of a point from its interactions with the lens' exit and with the last surface."""
    pose, state = (system.leg or AxisSegment()).pose(0.0), last.state.expanded()
    lit = exit.state.power.expand(state.power.shape)
    origin, direction = to_local(pose, state.origin, state.direction, state.datum)
    x, y, z, dx, dy, dz = (torch.as_tensor(c, dtype=torch.float64).expand(lit.shape) for c in (*origin, *direction))
    known = (state.power > 0) & torch.isfinite(x + y + z)
    plane, ahead = float(z[known].mean()), math.copysign(1.0, float(dz[known].mean()))
    far = torch.where(known, (plane - z) / dz, torch.zeros_like(z))
    power, (u, v) = state.power.expand(lit.shape).clone(), (torch.as_tensor(c) for c in rays_at(rays, system))
    for mask in masks:
        mx, my = (torch.as_tensor(c).expand(lit.shape) for c in exit.hit.local[:2])
        power = torch.where(mask.contains(mx, my), power, torch.zeros_like(power))
    power = torch.where(system.pupil.aperture.covers(u, v), power, torch.zeros_like(power))
    power = torch.where(known, power, torch.zeros_like(power))
    columns = {"x": x + far * dx, "y": y + far * dy, "ox": dx, "oy": dy, "w": power}
    near = distance_transform_edt(~known.reshape(counts).numpy(), return_distances=False, return_indices=True)
    grids = {name: c.reshape(counts).numpy() for name, c in columns.items()}
    return TracedLight(weight, band, plane, ahead, {name: grid if name == "w" else grid[*near] for name, grid in grids.items()})


def rays_at(rays, system: System) -> tuple[Tensor, Tensor]:
    """Where rays pass the pupil, over its half widths."""
    state = rays.expanded()
    x, y = state.full(state.origin)[:2]
    rx, ry = system.pupil.half_size
    return x / rx, y / ry
