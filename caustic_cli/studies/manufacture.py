"""Manufacturing figures and alignment sensitivities of a lens: `render report`.

Lengths are mm, angles degrees.  Extrema of the surface are sampled on a grid of a few points per knot span, and bounded by its
control net (convex-hull property): the true values lie in between.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.io.files import SOFTWARE, write_bytes
from caustic_cli.optics import curvature
from caustic_cli.optics.bspline import SplineSpace, derivatives_over_grid
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.media import medium_of
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.strips import ROWS
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System, entrance_of
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Aperture, Lens, Scene
from caustic_cli.scene.materials import material
from caustic_cli.scene.traits import Capability

#: Most sample points along each axis and per knot span.
MOST, A_SPAN = 2001, 4
#: Thickness of common sheet material, in parts of the width of the plate.
SHEET = 0.08
#: Finite-difference steps of the sensitivities: of the throw, relative; of the index.
STEP = 1e-4
#: Figures that do not apply, by the kind of the lens.
NOT_OF: dict[str, tuple[str, ...]] = {
    "lens": (),
    "mirror": (
        *("minimum_wall_mm", "minimum_wall_bound_mm", "stock_height_mm", "volume_cm3", "mass_g"),
        *("critical_angle_deg", "steepest_incidence_deg", "internal_reflection_margin_deg"),
        *("landing_mm_per_thousandth_index", "index_error_of_a_pixel"),
    ),
}


def manufacture(scene: Scene, field: HeightField, heights: Tensor, tool_radius: float | None = None, seed: int = 0) -> dict:
    """Figures for JSON; None where one does not apply (no concave region, a mirror).  The blur of a point source is 0.

    Keys: minimum_wall_mm and _bound_mm, along the axis; stock_height_mm, least height of a blank; volume_cm3 and, of a
    known material, mass_g; maximum_slope and _bound; smallest_concave_radius_mm and its position (x, y) mm, seen from outside the
    glass; of a free-form entrance, entrance, with these of that side; tool_radius_mm and tool_fits, every side, if one was given;
    critical_angle_deg, steepest_incidence_deg inside the lens and internal_reflection_margin_deg; sharpness_limit_mm and _pixels,
    of the source's size, None among other elements; landing_mm_per_mm_throw and landing_mm_per_thousandth_index, root mean square
    over the light, and the errors that displace the light by one pixel, throw_error_of_a_pixel_mm and
    index_error_of_a_pixel; and screen_unit, of lengths on the screen.

    Raises:
        InputError: the tool's radius is not above 0.
    """
    if tool_radius is not None and not 0 < tool_radius < math.inf:
        raise InputError(f"⟨tool_radius⟩ must be greater than 0 mm, got {tool_radius:g}")
    lens, pixel = scene.lens, max(scene.screen.pixel)
    z, *derivatives = sampled(field, heights, [_points(s) for s in field.spaces])
    inside = _within(lens.opening, z)
    z, below = z[inside], _below(lens, field)[inside]
    side = _shape(field, heights, derivatives, inside, lens.cut_from)
    found = {
        "minimum_wall_mm": float((z - below).min()),
        "minimum_wall_bound_mm": float(heights.min()) - _highest_entrance(lens),
        "stock_height_mm": float(z.max() - below.min()),
        "volume_cm3": 1e-3 * float((z - below).mean()) * math.prod(lens.size) * (lens.opening.filled / 4.0),
    }
    density = None if lens.glass is None else material(lens.glass).density
    found |= {"mass_g": None if density is None else found["volume_cm3"] * density} | side
    if lens.entrance is not None:
        fixed = entrance_of(lens)
        found["entrance"] = shape_of(fixed.field, fixed.heights, lens.opening, -1)
    if tool_radius is not None:
        radii = [one["smallest_concave_radius_mm"] for one in (side, found.get("entrance", side))]
        found |= {"tool_radius_mm": tool_radius, "tool_fits": all(radius is None or radius >= tool_radius for radius in radii)}
    densest = lens.index * medium_of(lens).variation(lens.half_size, lens.offset.thickness - lens.z_in)[1]
    critical, incidence = math.degrees(math.asin(1.0 / densest)), _steepest_incidence(scene, field, heights, seed)
    blur = None if scene.unfolded.elements else scene.source.blur(lens.z_in, abs(scene.screen.z - lens.z_in))
    throw = STEP * abs(scene.screen.z)
    by_throw = _moved(scene, scene, field, heights, seed, throw) / throw
    other = replace(scene, lens=lens.denser(STEP))
    by_index = _moved(scene, other, field, heights, seed, 0.0) / STEP
    found |= {
        "critical_angle_deg": critical,
        "steepest_incidence_deg": incidence,
        "internal_reflection_margin_deg": critical - incidence,
        "sharpness_limit_mm": blur,
        "sharpness_limit_pixels": None if blur is None else blur / pixel,
        "screen_unit": scene.screen.unit,
        "landing_mm_per_mm_throw": by_throw,
        "landing_mm_per_thousandth_index": 1e-3 * by_index,
        "throw_error_of_a_pixel_mm": pixel / by_throw if by_throw > 0 else None,
        "index_error_of_a_pixel": pixel / by_index if by_index > 0 else None,
    }
    return found | dict.fromkeys(NOT_OF[lens.kind])


def shape_of(field: HeightField, heights: Tensor, opening: Aperture, cut_from: int) -> dict[str, Any]:
    """Slopes and concave radii, as of `manufacture`, of a free-form side that is cut from +z (1) or from -z (-1)."""
    _, *derivatives = sampled(field, heights, [_points(s) for s in field.spaces])
    return _shape(field, heights, derivatives, _within(opening, derivatives[0]), cut_from)


def _shape(field: HeightField, heights: Tensor, derivatives: list[Tensor], inside: Tensor, cut_from: int) -> dict[str, Any]:
    """Slopes and concave radii of a free-form side that is cut from +z (1) or from -z (-1), of those at the points `inside`."""
    at = tuple(n // 2 for n in inside.shape)
    derivatives = [torch.where(inside, d, d[at]) for d in derivatives]  # points outside are replaced by the centre
    bends = curvature.largest(*(cut_from * d for d in derivatives))
    bent, at = float(bends.max()), divmod(int(bends.argmax()), bends.shape[1])
    where = [(2.0 * k / (n - 1) - 1.0) * r for k, n, r in zip(at, bends.shape, field.half_size, strict=True)]
    return {
        "maximum_slope": float(torch.hypot(*derivatives[:2]).max()),
        "maximum_slope_bound": field.slope_bound(heights),
        "smallest_concave_radius_mm": 1.0 / bent if bent > 0 else None,
        "smallest_concave_radius_at_mm": where if bent > 0 else None,
    }


def _below(lens: Lens, field: HeightField) -> Tensor:
    """z of the entrance at the points at which the exit is sampled, mm."""
    shape = [_points(s) for s in field.spaces]
    if lens.entrance is None:
        return torch.full(shape, lens.z_in, dtype=torch.float64)
    fixed = entrance_of(lens)
    return lens.z_in + sampled(fixed.field, fixed.heights, shape, ((0, 0),))[0]


def _highest_entrance(lens: Lens) -> float:
    """Upper bound of z over the entrance, mm."""
    return lens.z_in + (0.0 if lens.entrance is None else entrance_of(lens).hull(None)[1])


def _within(aperture: Aperture, z: Tensor) -> Tensor:
    """Which of the points (n, m) of a grid over the half widths of an aperture lie inside."""
    u, v = (torch.linspace(-1.0, 1.0, n, dtype=torch.float64) for n in z.shape)
    return aperture.covers(u[:, None], v[None, :])


WALL = Capability(
    "wall and stock of a design",
    {"mirror": "a mirror has no glass"},
)


def wall_and_stock(scene: Scene, field: HeightField, heights: Tensor) -> dict[str, float]:
    """Least wall and height of a blank, mm, as of `manufacture`; nothing of a mirror."""
    if not WALL.supports(scene):
        return {}
    (z,) = sampled(field, heights, [_points(s) for s in field.spaces], ((0, 0),))
    inside, below = _within(scene.lens.opening, z), _below(scene.lens, field)
    z, below = z[inside], below[inside]
    return {"minimum_wall_mm": float((z - below).min()), "stock_height_mm": float(z.max() - below.min())}


def preview(scene: Scene, field: HeightField, heights: Tensor, project: float) -> str:
    """Manufacturing figures of the initial surface in one line; those of the finished one will be similar.

    project: expected size of the finished project, bytes."""
    lens, found = scene.lens, []
    for z, *derivatives in _strips(field, heights, [_points(s) for s in field.spaces]):
        bends = curvature.largest(*(lens.cut_from * d for d in derivatives))
        found.append(torch.stack([-z.min(), z.max(), torch.hypot(*derivatives[:2]).max(), bends.max()]))
    low, high, slope, bent = (float(m) for m in torch.stack(found).amax(0) * torch.tensor([-1.0, 1.0, 1.0, 1.0]))
    depths, reflected = f"{high - low:.2g} mm deep", ""
    if not lens.mirror:
        flat = {"wall": low - lens.z_in, "stock": high - lens.z_in}
        wall, stock = (flat if lens.entrance is None else wall_and_stock(scene, field, heights)).values()
        depths = f"wall {wall:.2f} mm, stock {stock:.2f} mm"
        reflected = f" (light along the axis is totally reflected from {1.0 / math.sqrt(lens.index**2 - 1.0):.2f})"
    return (
        f"first surface: {depths}, slopes up to {slope:.2g}{reflected},"
        f" {f'concave radius down to {1.0 / bent:.2g} mm' if bent > 0 else 'nowhere concave'}; project about {_megabytes(project)}"
        f"{_thinner(scene, low, high)}"
    )


THROW = Capability(
    "advice on the throw of a thinner plate",
    {
        "tilted light": "the throw is not along the axis",
        "near source": "the relief collects the light of the source, whatever the throw",
        **dict.fromkeys(("mirror", "two sides"), "its relief is not that of a sheet"),
        "other elements": "they decide the throw, too",
        "far field": "there is none",
    },
)


def _thinner(scene: Scene, low: float, high: float) -> str:
    """Advice on the throw at which a plate, whose surface lies between two heights, mm, is as thin as sheet material: relief ~ 1 /
    throw."""
    sheet = SHEET * max(scene.lens.size)
    room = sheet - (low - scene.lens.z_in)  # not positive for a lens that is not a plate
    if not (THROW.supports(scene) and 0.0 < room < high - low):
        return ""
    middle = scene.lens.offset.thickness
    throw = float(f"{middle + (scene.screen.z - middle) * (high - low) / room:.2g}")
    return f"; a ⟨+throw⟩ of about {throw:g} mm or a smaller ⟨+mag⟩ would make it {sheet:.2g} mm thick"


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.{0 if size >= 1e7 else 1}f} MB" if size >= 5e4 else f"{size / 1e3:.0f} kB"


def _points(space: SplineSpace) -> int:
    """Sample points along an axis: equispaced knots, where the curvature of cubics has its extrema, are among them."""
    spans = len(space.breaks) - 1
    return max(1, min(A_SPAN, MOST // spans)) * spans + 1


def sampled(field: HeightField, heights: Tensor, shape, orders=((0, 0), *curvature.ORDERS)) -> list[Tensor]:
    """Derivatives of these orders by x and y on an even grid over the aperture, borders included: (n_x, n_y) each."""
    return [torch.cat(parts) for parts in zip(*_strips(field, heights, shape, orders), strict=True)]


def _strips(field: HeightField, heights: Tensor, shape, orders=((0, 0), *curvature.ORDERS)) -> Iterator[list[Tensor]]:
    """`sampled`, ROWS at a time, so that intermediate arrays fit in the cache."""
    (su, sv), (rx, ry), net = field.spaces, field.half_size, heights.detach().double().cpu()
    u, v = (torch.linspace(0.0, 1.0, n, dtype=torch.float64) for n in shape)
    columns = [sv.banded(v, k) / (2.0 * ry) ** k for k in range(3)]
    for w in u.split(ROWS):
        rows = [su.banded(w, k) / (2.0 * rx) ** k for k in range(3)]
        yield derivatives_over_grid(rows, net, columns, orders)


def _steepest_incidence(scene: Scene, field: HeightField, heights: Tensor, seed: int) -> float:
    """Largest angle between the light inside the lens and the exit surface's normal, degrees."""
    least, system = 1.0, System.of(scene, field)
    for rays in _rays(scene, seed):
        traced = Tracer(system, rays)
        (gx, gy), (dx, dy, dz), power = traced.exit_of({EXIT: heights})
        cosine = ((dz - gx * dx - gy * dy) / torch.sqrt(1.0 + gx * gx + gy * gy))[power > 0]
        if cosine.numel():
            least = min(least, float(cosine.min()))
    return math.degrees(math.acos(max(-1.0, least)))


def _moved(scene: Scene, other: Scene, field: HeightField, heights: Tensor, seed: int, further: float) -> float:
    """RMS distance on the screen, mm, between the landing points of the same rays in two scenes, the second screen `further` mm
    away."""
    return apart(_landings(scene, field, heights, seed, 0.0), _landings(other, field, heights, seed, further))


def apart(before: list[RayState], after: list[RayState]) -> float:
    """RMS distance on the screen, mm, between two landing points of each ray, over the light that arrives at both."""
    total = power = 0.0
    for one, two in zip(before, after, strict=True):
        weight = torch.where(two.power > 0, one.power, 0.0)
        squares = sum((a - b) ** 2 for a, b in zip(one.origin[:2], two.origin[:2], strict=True))
        total += float((weight * squares).nan_to_num(0.0).sum())
        power += float(weight.sum())
    return math.sqrt(total / power) if power > 0 else 0.0


def _landings(scene: Scene, field: HeightField, heights: Tensor, seed: int, further: float) -> list[RayState]:
    screen = scene.screen if scene.screen.far else replace(scene.screen, z=scene.screen.z + further)
    return landings(replace(scene, screen=screen), System.of(scene, field), heights, seed)


def landings(scene: Scene, system: System, heights: Tensor, seed: int) -> list[RayState]:
    """Rays of a scene on its screen, behind a system with these heights (n, m) mm of the exit."""
    return [Tracer(system, rays).land({EXIT: heights}, scene.screen)[0] for rays in _rays(scene, seed)]


def _rays(scene: Scene, seed: int):
    rays = current_effort().sensitivity_rays
    return rays_of(scene, "stratified", rays, stream(seed, "report")).chunks(rays)


def write_json(path: str | Path, figures: dict) -> None:
    """Write `report.json`: the figures, with the program's mark first."""
    write_bytes(path, (json.dumps({"created_by": SOFTWARE} | figures, indent=2, allow_nan=False) + "\n").encode())


def _slope(f: dict) -> str:
    return f"{f['maximum_slope']:.4f} (surely below {f['maximum_slope_bound']:.4f})"


def _concave(f: dict) -> str:
    radius, at = f["smallest_concave_radius_mm"], f["smallest_concave_radius_at_mm"]
    return "nowhere concave" if radius is None else f"{radius:.4g} mm at ({at[0]:.3g}, {at[1]:.3g})"


def rows(f: dict) -> list[tuple[str, str]]:
    """The figures as rows of a table (name, text)."""
    concave = _concave(f)
    if "tool_radius_mm" in f:
        concave += f"; a tool of {f['tool_radius_mm']:g} mm {'fits' if f['tool_fits'] else 'DOES NOT FIT'}"

    def of_a_pixel(key: str, unit: str) -> str:
        return "" if f[key] is None else f"; one pixel at {f[key]:.3g}{unit}"

    found = [("maximum slope", _slope(f)), ("smallest concave radius", concave)]
    if other := f.get("entrance"):
        found += [("maximum slope of the entrance", _slope(other)), ("smallest concave radius there", _concave(other))]
    if f["sharpness_limit_mm"] is not None:
        limit = f"{f['sharpness_limit_mm']:.3g} {f['screen_unit']}, {f['sharpness_limit_pixels']:.3g} pixels"
        found.append(("sharpness limit", limit))
    found += [
        (
            "throw wrong by 1 mm",
            f"light moves {f['landing_mm_per_mm_throw']:.3g} {f['screen_unit']}{of_a_pixel('throw_error_of_a_pixel_mm', ' mm')}",
        ),
    ]
    if f["minimum_wall_mm"] is None:
        return found
    margin = f["internal_reflection_margin_deg"]
    return [
        ("minimum wall", f"{f['minimum_wall_mm']:.4f} mm (surely above {f['minimum_wall_bound_mm']:.4f})"),
        ("stock height", f"{f['stock_height_mm']:.4f} mm"),
        ("volume", f"{f['volume_cm3']:.4g} cm^3" + ("" if f["mass_g"] is None else f", {f['mass_g']:.4g} g")),
        *found,
        (
            "margin to internal reflection",
            f"{margin:.2f} degrees of {f['critical_angle_deg']:.2f}" + ", LIGHT IS LOST" * (margin < 0),
        ),
        (
            "index wrong by 0.001",
            f"light moves {f['landing_mm_per_thousandth_index']:.3g} {f['screen_unit']}{of_a_pixel('index_error_of_a_pixel', '')}",
        ),
    ]
