"""Light from the source to the screen, ray by ray (thesis 4.3.1).

    plane wave:  free-form surface -> screen

A plane wave meets the flat entrance at normal incidence, which bends nothing and reflects the same part of every ray,
so its rays start on the exit surface.

Powers are parts of what the source emits.  Nothing vanishes: image + every entry of `lost` = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.heightfield import Evaluator, HeightField
from caustic_cli.optics.interface import reflectance, refract
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import Sample, Sampler
from caustic_cli.scene import Scene, Screen

LOSSES = ("missed_lens", "missed_surface", "total_internal_reflection", "fresnel", "absorbed", "off_screen")
#: A direction cosine to the screen's normal below this counts as parallel to it: the ray never arrives.
PARALLEL = 1e-9


class Status(IntEnum):
    """What became of a ray before the screen."""

    OK = 0
    TOTAL_INTERNAL_REFLECTION = 1
    AWAY_FROM_SCREEN = 2


@dataclass(frozen=True)
class Landing:
    """Rays on the screen's plane.

    x, y (shape of the sample) mm; weight, the power each carries (0 where lost); status, a `Status` a ray;
    lost, the power lost on the way, by name; leaving, the power that left the lens.
    """

    x: Tensor
    y: Tensor
    weight: Tensor
    status: Tensor
    lost: dict[str, Tensor]
    leaving: Tensor


class PlaneTracer:
    """Traces one sample of a plane wave through a lens; prepared once, called for any heights.

    Args:
        scene: source, lens and screen.
        field: the exit surface's spline spaces.
        sample: the rays.
        dtype: precision of the ray arithmetic.  Heights are float64 and enter relative to their mean, so float32 rays
            see sag, not thickness.
    """

    def __init__(self, scene: Scene, field: HeightField, sample: Sample, dtype: torch.dtype):
        self.scene, self.dtype, self.evaluator = scene, dtype, field.prepare(sample, dtype)
        (rx, ry), device = field.half_size, sample.u.device
        x, y = ((2.0 * sample.u - 1.0) * rx).to(dtype), ((2.0 * sample.v - 1.0) * ry).to(dtype)
        self.x, self.y = (x[:, None], y[None, :]) if sample.tensor else (x, y)
        self.share = sample.share.to(device=device, dtype=dtype)
        self.shape = sample.shape

    def __call__(self, heights: Tensor) -> Landing:
        """Heights (n, m) mm float64 -> where the rays land."""
        reference = heights.detach().mean()
        return trace_plane(self.scene, self.evaluator, (heights - reference).to(self.dtype), float(reference),
                           self.x, self.y, self.share, self.shape)


def trace_plane(scene: Scene, evaluator: Evaluator, sag_net: Tensor, reference: float, x, y, share, shape) -> Landing:
    """The plane-wave path: surface, Snell, Fresnel, plane of the screen.

    Args:
        sag_net: (n, m) control heights relative to `reference` mm.
        x, y: where the rays leave the lens, broadcastable to `shape`, mm.
        share: part of the source's power per ray, scalar or `shape`.
    """
    n, kind = scene.lens.index, scene.lens.fresnel
    sag, slope_x, slope_y = evaluator(sag_net)
    # Plain floats where the plane wave's direction is constant: the products with 0 and 1 are never computed on rays.
    direction, passes, c, s = refract((0.0, 0.0, 1.0), slope_x, slope_y, n)
    entrance = reflectance(kind, 1.0, 1.0, 1.0 / n)  # normal incidence: the same for every ray
    emitted = torch.broadcast_to(share, shape)
    inside = emitted * (1.0 - entrance)
    length = torch.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y) if kind == "schlick" else 1.0
    reflected = reflectance(kind, c / length, s / length, n)
    none = torch.zeros_like(inside)
    leaving = torch.where(passes, inside * (1.0 - reflected), none)
    arrives = passes & (direction[2] > PARALLEL)
    path = (scene.screen.z - reference - sag) / torch.where(arrives, direction[2], torch.ones_like(direction[2]))
    on_way = arrives & (path > 0)
    path = torch.where(on_way, path, torch.zeros_like(path))
    status = torch.where(passes, int(Status.OK), int(Status.TOTAL_INTERNAL_REFLECTION))
    status = torch.where(passes & ~on_way, int(Status.AWAY_FROM_SCREEN), status)
    lost = {
        "fresnel": (emitted - inside).sum() + torch.where(passes, inside * reflected, none).sum(),
        "total_internal_reflection": torch.where(passes, none, inside).sum(),
        "off_screen": torch.where(on_way, none, leaving).sum(),
    }
    weight = torch.where(on_way, leaving, none)
    return Landing(x + path * direction[0], y + path * direction[1], weight, status, lost, leaving.sum())


@dataclass(frozen=True)
class Exposure:
    """An image and its energy account, as parts of the source's power.

    image (n_x, n_y) float64, power per pixel; lost, all of LOSSES; leaving, what left the lens; rays, how many.
    image.sum() + sum(lost.values()) = 1.
    """

    image: Tensor
    lost: dict[str, float]
    leaving: float
    rays: int


def expose(scene: Scene, field: HeightField, heights: Tensor, sampler: Sampler, filter: Filter | None = None,
           dtype: torch.dtype = torch.float64, screen: Screen | None = None, chunk: int = 1 << 19) -> Exposure:
    """Trace all rays of a sampler and collect them: the value of the one function every command asks about.

    Chunks are accumulated in float64, so neither memory nor rounding grows with the number of rays.

    Raises:
        InputError: the lens reaches the screen.
    """
    screen, filter = screen or scene.screen, filter or Filter()
    heights = heights.detach().to(sampler.device, torch.float64)
    if float(heights.max()) >= screen.z:
        raise InputError(f"[screen] z must lie behind the lens, whose surface reaches {float(heights.max()):.6g} mm,"
                         f" got {screen.z:g} mm")
    image = torch.zeros(screen.resolution, dtype=torch.float64, device=sampler.device)
    lost, leaving = dict.fromkeys(LOSSES, 0.0), 0.0
    with torch.no_grad():
        for sample in sampler.chunks(chunk):
            landing = PlaneTracer(scene, field, sample, dtype)(heights)
            part, off = splat(landing.x, landing.y, landing.weight, screen, filter)
            image += part.double()
            for name, value in landing.lost.items():
                lost[name] += float(value)
            lost["off_screen"] += float(off)
            leaving += float(landing.leaving)
    return Exposure(image, lost, leaving, sampler.count)
