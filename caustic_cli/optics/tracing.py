"""Light from the source to the screen, ray by ray (thesis 4.3.1).

    plane wave:     free-form surface -> screen
    other sources:  flat entrance -> free-form surface -> screen

A plane wave meets the flat entrance at normal incidence, which bends nothing and reflects the same part of every ray,
so its rays start on the exit surface.  All others start inside the entrance, where `emission` puts them once for a scene,
and are intersected with the surface.

Powers are parts of what the source emits.  Nothing vanishes: image + every entry of `lost` = 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics import intersection
from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.heightfield import Evaluator, HeightField
from caustic_cli.optics.interface import reflectance, refract
from caustic_cli.optics.kernels import fused
from caustic_cli.optics.landing import LOSSES, Landing, Part, Status, collect
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.shortage import with_less
from caustic_cli.optics.stepwise import SEQUENTIAL, Steps, StepTracer, needed
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Lens, Scene, Screen


class PlaneTracer:
    """Traces one sample of a plane wave through a lens; prepared once, called for any heights.

    Args:
        scene: source, lens and screen.
        field: the exit surface's spline spaces.
        sample: the rays.
        dtype: precision of the plain-torch reference; the kernels know float64 only.  Heights are float64 and enter relative
            to their mean, so float32 rays see sag, not thickness.
        like: the tracer of the chunk before, whose basis values along v are taken over where they are the same.
    """

    def __init__(self, scene: Scene, field: HeightField, sample: Sample, dtype: torch.dtype, like: PlaneTracer | None = None):
        self.scene, self.field, self.sample, self.dtype = scene, field, sample, dtype
        self.kernel = None
        if fused(sample.u.device):
            from caustic_cli.optics.kernels.functions import PlaneKernel  # noqa: PLC0415

            self.kernel = PlaneKernel(field.spaces, field.half_size, sample.u, sample.v, sample.tensor, sample.share,
                                      None if like is None else like.kernel)

    @cached_property
    def evaluator(self) -> Evaluator:
        """The surface at the rays, for the reference; the kernel brings its own."""
        return self.field.prepare(self.sample, self.dtype)

    def __call__(self, heights: Tensor, screen_z: float | None = None) -> Landing:
        """Heights (n, m) mm float64 -> where the rays land at screen_z (default: the scene's): the plain-torch reference."""
        reference = float(heights.detach().mean())
        sag = (heights - reference).to(self.dtype)
        z = self.scene.screen.z if screen_z is None else screen_z
        (rx, ry), s = self.field.half_size, self.sample
        x, y = ((2.0 * s.u - 1.0) * rx).to(self.dtype), ((2.0 * s.v - 1.0) * ry).to(self.dtype)
        if s.tensor:
            x, y = x[:, None], y[None, :]
        return trace_plane(self.scene.lens, self.evaluator, sag, z - reference, x, y, s.share.to(self.dtype), s.shape)

    def expose(self, heights: Tensor, screen: Screen, filter: Filter) -> Part:
        """Heights (n, m) mm float64 -> image and energy account on a screen; by the fused kernel on a CPU."""
        if self.kernel is None:
            return collect(self(heights, screen.z), screen, filter)
        reference = float(heights.detach().mean())
        return Part(*self.kernel(heights - reference, self.scene.lens, screen.z - reference, screen, filter))


class RayTracer:
    """Traces a bundle of rays through a lens; prepared once, called for any heights.  Arguments as of `PlaneTracer`.

    Hits are found in float64 whatever `dtype` is: a distance through thick glass has no digits of float32 to spare for the sag.
    """

    def __init__(self, scene: Scene, field: HeightField, bundle: Bundle, dtype: torch.dtype, like: RayTracer | None = None):
        self.scene, self.field, self.bundle, self.dtype = scene, field, bundle, dtype
        self.kernel = None
        if fused(bundle.x.device):
            from caustic_cli.optics.kernels.functions import RayKernel  # noqa: PLC0415

            self.kernel = RayKernel(field.spaces, field.half_size, bundle, None if like is None else like.kernel)

    def __call__(self, heights: Tensor, screen_z: float | None = None) -> Landing:
        """Heights (n, m) mm float64 -> where the rays land at screen_z (default: the scene's): the plain-torch reference."""
        b, lens, d = self.bundle, self.scene.lens, self.dtype
        z = self.scene.screen.z if screen_z is None else screen_z
        t, gx, gy, found = intersection.meet(self.field, heights, b)
        hit, reference = found == intersection.Status.HIT, float(heights.detach().mean())
        sag = (b.z - reference + t * b.dz).to(d)
        inside = torch.where(hit, b.share, torch.zeros_like(b.share)).to(d)
        direction = tuple(c.to(d) for c in (b.dx, b.dy, b.dz))
        landing = carry(lens, direction, sag, gx.to(d), gy.to(d), (b.x + t * b.dx).to(d), (b.y + t * b.dy).to(d), inside,
                        z - reference)
        lost = landing.lost | {"missed_surface": _sum(b.share.to(d) - inside)}
        status = torch.where(hit, landing.status, int(Status.MISSED_SURFACE))
        return Landing(landing.x, landing.y, landing.weight, status, self._with_lost(lost), landing.leaving)

    def expose(self, heights: Tensor, screen: Screen, filter: Filter) -> Part:
        """Heights (n, m) mm float64 -> image and energy account on a screen; by the fused kernel on a CPU."""
        if self.kernel is None:
            return collect(self(heights, screen.z), screen, filter)
        part = Part(*self.kernel(heights, self.scene.lens, float(heights.detach().mean()), screen, filter))
        return Part(part.image, part.leaving, self._with_lost(part.lost))

    def _with_lost(self, lost: dict[str, Tensor]) -> dict[str, Tensor]:
        """With what these rays' part of the source lost before the lens' inside."""
        return {**lost, **{name: lost.get(name, 0.0) + value for name, value in self.bundle.lost.items()}}


def tracer(scene: Scene, field: HeightField, rays: Sample | Bundle, dtype: torch.dtype, like=None,
           steps: Steps = SEQUENTIAL) -> PlaneTracer | RayTracer | StepTracer:
    """What traces some rays of the scene's source: `stepwise` only for what the sequential path does not know.

    like: the tracer of the chunk before; steps: what to do beyond what the scene says.
    """
    if needed(scene, steps):
        return StepTracer(scene, field, rays, dtype, steps)
    return (PlaneTracer if isinstance(rays, Sample) else RayTracer)(scene, field, rays, dtype, like)


class BandTracer:
    """A tracer of one of several bands, whose light is a part of the whole: images (n_x, n_y), or (3, n_x, n_y) with colours."""

    def __init__(self, one: PlaneTracer | RayTracer | StepTracer, weight: float, channel: int | None):
        self.one, self.weight, self.channel = one, weight, channel

    def expose(self, heights: Tensor, screen: Screen, filter: Filter) -> Part:
        """As of a tracer; of colours, leaving is (3,)."""
        part, w = self.one.expose(heights, screen, filter), self.weight
        image, leaving = w * part.image, w * part.leaving
        if self.channel is not None:
            image, leaving = (torch.stack([t if k == self.channel else torch.zeros_like(t) for k in range(3)])
                              for t in (image, leaving))
        return Part(image, leaving, {name: w * value for name, value in part.lost.items()})


def tracers(scene: Scene, field: HeightField, sampler: Rays, dtype: torch.dtype, chunk: int,
            steps: Steps = SEQUENTIAL,
            part: tuple[int, int] = (0, 1)) -> Iterator[PlaneTracer | RayTracer | StepTracer | BandTracer]:
    """Tracers of all rays of a sampler, chunk by chunk; of a scene with several bands, one after the other.

    part: (k, n) takes every n-th chunk from number k on, what one of n processes traces.
    """
    bands = scene.bands
    for band in bands:
        traced = None
        for rays in sampler.through(band.scene).chunks(chunk, *part):
            traced = tracer(band.scene, field, rays, dtype, traced, steps)
            yield traced if len(bands) == 1 else BandTracer(traced, band.weight, band.channel)


def trace_plane(lens: Lens, evaluator: Evaluator, sag_net: Tensor, height: float, x, y, share, shape) -> Landing:
    """The plane-wave path: surface, Snell, Fresnel, plane of the screen.

    Args:
        sag_net: (n, m) control heights relative to some plane, mm.
        height: of the screen above that plane, mm.
        x, y: where the rays leave the lens, broadcastable to `shape`, mm.
        share: part of the source's power per ray, scalar or `shape`.
    """
    sag, slope_x, slope_y = evaluator(sag_net)
    entrance = reflectance(lens.fresnel, 1.0, 1.0, 1.0 / lens.index)  # normal incidence: the same for every ray
    emitted = torch.broadcast_to(share, shape)
    inside = emitted * (1.0 - entrance)
    # Plain floats where the plane wave's direction is constant: the products with 0 and 1 are never computed on rays.
    landing = carry(lens, (0.0, 0.0, 1.0), sag, slope_x, slope_y, x, y, inside, height)
    lost = landing.lost | {"fresnel": _sum(emitted - inside) + landing.lost["fresnel"]}
    return Landing(landing.x, landing.y, landing.weight, landing.status, lost, landing.leaving)


def carry(lens: Lens, incoming, sag: Tensor, slope_x: Tensor, slope_y: Tensor, x, y, inside: Tensor, height: float) -> Landing:
    """From the exit surface to the screen: Snell, Fresnel, plane of the screen.

    Args:
        incoming: unit direction inside the lens, tensors or plain floats.
        sag, slope_x, slope_y: of the surface at the rays, relative to some plane (mm), and dimensionless.
        x, y: the points there, mm.
        inside: power each ray carries up to the surface.
        height: of the screen above that plane, mm.
    """
    n, kind = lens.index, lens.fresnel
    direction, passes, c, s = refract(incoming, slope_x, slope_y, n)
    length = torch.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y) if kind == "schlick" else 1.0
    reflected = reflectance(kind, c / length, s / length, n)
    none = torch.zeros_like(inside)
    leaving = torch.where(passes, inside * (1.0 - reflected), none)
    arrives = passes & (direction[2] > PARALLEL)
    path = (height - sag) / torch.where(arrives, direction[2], torch.ones_like(direction[2]))
    on_way = arrives & (path > 0)
    path = torch.where(on_way, path, torch.zeros_like(path))
    status = torch.where(passes, int(Status.OK), int(Status.TOTAL_INTERNAL_REFLECTION))
    status = torch.where(passes & ~on_way, int(Status.AWAY_FROM_SCREEN), status)
    lost = {
        "fresnel": _sum(torch.where(passes, inside - leaving, none)),
        "total_internal_reflection": _sum(torch.where(passes, none, inside)),
        "off_screen": _sum(torch.where(on_way, none, leaving)),
    }
    weight = torch.where(on_way, leaving, none)
    return Landing(x + path * direction[0], y + path * direction[1], weight, status, lost, _sum(leaving))


def _sum(power: Tensor) -> Tensor:
    return power.sum(dtype=torch.float64)


@dataclass(frozen=True)
class Exposure:
    """An image and its energy account, as parts of the source's power.

    image (n_x, n_y) float64, power per pixel, or (3, n_x, n_y) with colours; lost, all of LOSSES; leaving, what left the lens;
    rays, how many.  image.sum() + sum(lost.values()) = 1.
    """

    image: Tensor
    lost: dict[str, float]
    leaving: float
    rays: int


def expose(scene: Scene, field: HeightField, heights: Tensor, sampler: Rays, filter: Filter | None = None,
           dtype: torch.dtype = torch.float64, screen: Screen | None = None, chunk: int = 1 << 19,
           steps: Steps = SEQUENTIAL) -> Exposure:
    """Trace all rays of a sampler and collect them: the value of the one function every command asks about.

    Chunks are accumulated in float64, so neither memory nor rounding grows with the number of rays.  Where memory runs out,
    smaller ones are tried.

    Raises:
        InputError: the lens reaches the screen.
        CausticError: out of memory.
    """
    screen, filter = screen or scene.screen, filter or Filter()
    heights = heights.detach().to(sampler.device, torch.float64)
    check_room(scene, heights, screen)
    return with_less(lambda size: _expose(scene, field, heights, sampler, filter, dtype, screen, size, steps), chunk)


def _expose(scene: Scene, field: HeightField, heights: Tensor, sampler: Rays, filter: Filter, dtype: torch.dtype,
            screen: Screen, chunk: int, steps: Steps) -> Exposure:
    shape = (3, *screen.resolution) if scene.colored else screen.resolution
    image = torch.zeros(shape, dtype=torch.float64, device=sampler.device)
    lost, leaving = dict.fromkeys(LOSSES, 0.0), 0.0
    with torch.no_grad():
        for traced in tracers(scene, field, sampler, dtype, chunk, steps):
            part = traced.expose(heights, screen, filter)
            image += part.image
            leaving += float(part.leaving.sum())
            for name, value in part.lost.items():
                lost[name] += float(value)
    return Exposure(image, lost, leaving, sampler.count)


def check_room(scene: Scene, heights: Tensor, screen: Screen) -> None:
    """Refuse a screen that the surface reaches, the corners of a tilted one included.

    Raises:
        InputError: saying how far the surface reaches.
    """
    lean = f" and its tilt takes it {screen.depth:.4g} mm nearer" if screen.depth else ""
    if scene.lens.mirror:
        if float(heights.min()) <= screen.z + screen.depth:
            raise InputError(f"[screen] z must lie before the mirror, whose surface reaches {float(heights.min()):.6g} mm,"
                             f" got {screen.z:g} mm{lean}")
    elif float(heights.max()) >= screen.z - screen.depth:
        raise InputError(f"[screen] z must lie behind the lens, whose surface reaches {float(heights.max()):.6g} mm,"
                         f" got {screen.z:g} mm{lean}")
