"""Bounds that hold for every ray of a scene, derived from the control net and the source without tracing.

Notation
    L           bound of |grad Z|: the derivative of a spline is a spline, which lies in the convex hull of its control net
    phi         atan L, largest angle of the surface normal to z; psi, the same for a free-form entrance
    theta       largest angle of rays to z inside the lens
    a           largest angle of rays to z in front of the lens: theta = psi + asin(sin(a - psi) / n), the worst case being a ray
                and a normal inclined to the same side
    i, o        angles of incidence and refraction at the exit: i <= theta + phi, sin o = n sin i

A ray leaves at an angle of at most theta + (o - i) to z, because the deviation o - i increases with i.  If L times the tangent of
this angle is below 1, it cannot intersect the surface again.  For a mirror the angle to -z is at most theta + 2 phi.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError, at_most
from caustic_cli.optics.effects.base import Bounds, ExitBounds
from caustic_cli.optics.interface import reflectance, reflectances
from caustic_cli.optics.media import medium_of
from caustic_cli.optics.resolution import Resolution, follows_from_exit, paraxial, traced
from caustic_cli.optics.sampling import LARGEST_NORMAL
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System, entrance_of
from caustic_cli.scene import Scene


def check_exit_above_entrance(scene: Scene, field: HeightField, heights: Tensor) -> None:
    """Check that the exit lies nowhere below the entrance: absorption over a negative thickness would amplify light.

    Raises:
        InputError: giving the depth by which it does.
    """
    lens, curved = scene.lens, scene.lens.entrance
    top = 0.0 if curved is None else float(curved.heights.max())
    if float(heights.min()) >= lens.interaction.base(lens.z_in) + top:  # the convex hulls of the nets contain the surfaces
        return
    dip = lens.z_in - field.least(heights, lens.opening, curved)
    if dip > 0:
        raise InputError(
            f"the entrance from ⟨lens.z_in⟩ of {lens.z_in:g} mm lies above a part of the exit surface, which dips {dip:.3g} mm"
            f" below it; it must be at most {at_most(lens.z_in - dip, 6)} mm"
        )


def bounds_of(scene: Scene, field: HeightField, heights: Tensor, steeper: float = 0.0) -> Bounds:
    """Bounds for every ray of a scene at heights (n, m) mm; steeper: by how much slopes may exceed those of the spline."""
    lens, indices = scene.lens, [band.scene.lens.inside for band in scene.bands]
    least, most = min(indices), max(indices)
    pupil = scene.pupil
    incidence = _through(scene, scene.source.incidence(pupil))
    depth = float(heights.max()) - lens.z_in
    low, high, steepest = medium_of(lens).variation(lens.half_size, depth)
    least, most, bent = least * low, most * high, steepest * depth / (low * lens.index)
    front = 0.0 if lens.entrance is None else math.atan(math.hypot(*entrance_of(lens).slope_bounds(None)))
    inside = min(front + math.asin(max(-1.0, min(1.0, math.sin(incidence - front) / least))) + bent, 0.5 * math.pi)
    exit = _exit(scene, inside, field.slope_bound(heights) + steeper, most, heights)
    ghost = _ghost(scene, field, heights, inside + front, most)
    focused = ghost_error(scene, field, heights, ghost, most)
    polarised, seen = _polarised(incidence + front, exit.critical, most), Resolution.at(scene, field, heights)
    return Bounds(incidence, inside, exit, most, depth, ghost, focused, polarised, seen)


def _exit(scene: Scene, inside: float, slope: float, most: float, heights: Tensor) -> ExitBounds:
    """Bounds at the exit, from the angle of rays inside, the slope bound and the largest index."""
    lens = scene.lens
    lean = math.atan(slope + lens.roughness * LARGEST_NORMAL)  # of the microfacets' normals to z
    critical, out = lens.interaction.leaving_bounds(inside, lean, most)
    slope_ratio = slope * math.tan(out) if out < math.pi / 2.0 else (math.inf if slope > 0 else 0.0)
    return ExitBounds(slope, critical, slope_ratio, _reach(scene, inside, float(heights.min()), float(heights.max())))


def _through(scene: Scene, lean: float) -> float:
    """Bound of the rays' angle to z behind the elements in front of the lens, from the bound `lean` in front of these."""
    system = System.of(scene) if scene.in_front else None
    for k, element in enumerate(system.elements[: 2 * len(scene.in_front)] if system else ()):
        assert system is not None
        normal = math.atan(math.hypot(*element.surface.slope_bounds(None))) if element.surface.shape is None else 0.5 * math.pi
        before, behind = (medium.index for medium in system.media()[k : k + 2])
        lean = normal + math.asin(min(1.0, before / behind * math.sin(min(lean + normal, 0.5 * math.pi))))
    return min(lean, 0.5 * math.pi)


def _polarised(incidence: float, critical: float, n: float) -> float:
    """|T_s - T_p| / (T_s + T_p) at the entrance times |R_s - R_p| / 2 at the exit, both at the greatest angles."""

    def split(sine: float, eta: float) -> tuple[float, float]:
        c, s = (math.sqrt(max(0.0, 1.0 - v * v)) for v in (sine, eta * sine))
        return reflectances(c, s, eta)

    rs, rp = split(math.sin(incidence), 1.0 / n)
    outer = split(critical / n, n) if critical < 1.0 else (1.0, 0.0)  # R_s - R_p stays below its value 1 at the critical angle
    passed = 2.0 - rs - rp  # 0 at grazing incidence, where all that enters may be of one polarisation
    return ((rs - rp) / passed if passed > 0 else 1.0) * (outer[0] - outer[1]) / 2.0


def _reach(scene: Scene, inside: float, lowest: float, top: float) -> float:
    """Bound of the rays' distance from the axis at the surface's greatest height, in half widths of the aperture; infinite where
    the surface may dip below the entrance, so that rays do not reach it from below."""
    source, lens = scene.source, scene.lens
    if scene.axial:
        return 1.0
    if lowest < lens.interaction.base(lens.z_in) or scene.in_front:
        return math.inf
    low, start = min(0.0, entrance_of(lens).hull(None)[0]) if lens.entrance is not None else 0.0, lens.pupil.z
    drift = max(top - start - low, start - lowest) * math.tan(min(inside, 1.57))
    if source.distant:
        return 1.0 + drift / min(lens.half_size)
    positions, extent, cone = source.points()[0], source.extent, source.cone_over(lens.pupil)
    wide = (start - positions[:, 2]) * math.tan(cone) if cone < math.pi / 2.0 else np.full(len(positions), math.inf)
    far = lens.opening.distances(*(np.abs(positions[:, k]) + extent[k] for k in (0, 1)))
    return max(float(((np.minimum(d + wide, r) + drift) / r).max()) for d, r in far)


def _ghost(scene: Scene, field: HeightField, heights: Tensor, inside: float, n: float) -> float:
    """Bound of the fraction of the power that is reflected at the exit and then at the entrance: an average over the knot spans for
    a uniform plane wave, their maximum for other light."""
    lens, kind = scene.lens, scene.lens.fresnel
    if "ghosts" in lens.interaction.lacks:
        return 0.0
    if scene.elements:  # of every pair of refracting surfaces, at normal incidence
        surfaces, n = 2 + sum(len(e.refracting) for e in scene.elements), max(n, *(e.index for e in scene.elements))
        return 0.0 if kind == "none" else surfaces * (surfaces - 1) / 2 * ((n - 1.0) / (n + 1.0)) ** 4
    slope, area = _slopes(field, heights.detach().double().cpu())
    lean = torch.atan(slope + lens.roughness * LARGEST_NORMAL)

    def part(angle: Tensor) -> Tensor:
        """Largest reflectance up to an internal angle of incidence; for unpolarised light it is bounded below by that at 0."""
        c = torch.cos(angle.clamp_max(math.pi / 2.0))
        square = 1.0 - n * n * (1.0 - c * c)
        s = square.clamp_min(0.0).sqrt()
        if kind == "none":
            value = torch.zeros_like(s)
        elif scene.light.polarisation is not None or scene.light.tracked:
            value = reflectances(c, s, n)[0]
        else:
            value = torch.maximum(reflectance(kind, c, s, n), torch.as_tensor(((n - 1.0) / (n + 1.0)) ** 2))
        return torch.where(square > 0, value, torch.ones_like(value))

    both = part(inside + lean) * part(inside + 2.0 * lean)
    even = scene.axial and not scene.source.uneven and not lens.opening.round
    return float((both * area).sum() if even else both.max())


def ghost_error(scene: Scene, field: HeightField, heights: Tensor, part: float, n: float) -> float:
    """Estimate of the relative RMS that the first ghost adds to the image if it carries the fraction `part` of the power; n: index;
    by traced ghosts where light does not follow from the exit, and 0 before all surfaces have heights.

    To first order a slope g deflects light by (n - 1) g and its first ghost by (3 n - 1) g.  A ghost whose map x -> X has the
    Jacobian J gives the irradiance part / (A |det J|) at X, A the aperture's area, so that over a screen of area S its mean square
    is part^2 S / A times the mean over the lens of 1 / |det J|.  The eigenvalues of J are reduced by the error of the first-order
    approximation, and bounded below by a pixel over the lens' width.
    """
    if not part > 0.0:
        return 0.0
    if not follows_from_exit(scene):
        return traced.ghost_error(scene, field, heights) if traced.is_known(scene, field) else 0.0
    light = paraxial(scene, field, heights)
    lens, screen = scene.lens, scene.screen
    gain = light.throw * (3.0 * n - 1.0)
    x, y = light.x * light.straight + gain * light.gx, light.y * light.straight + gain * light.gy
    on = ((x - screen.shift[0]).abs() <= screen.half_size[0]) & ((y - screen.shift[1]).abs() <= screen.half_size[1])
    middle = light.straight + 0.5 * gain * (light.xx + light.yy)
    split = 0.5 * gain * torch.hypot(light.xx - light.yy, 2.0 * light.xy)
    slopes = light.gx.square() + light.gy.square()
    wrong = abs((float(heights.max()) - lens.z_in) / light.throw) + 3.0 * n * n * slopes
    least = [w / (2.0 * r) for w, r in zip(screen.pixel, lens.half_size, strict=True)]
    both = [
        (e.abs() - (e - light.straight).abs() * wrong).clamp_min(k)
        for e, k in zip((middle - split, middle + split), least, strict=True)
    ]
    spread = torch.where(on, 1.0 / (both[0] * both[1]), 0.0).mean()
    ratio = math.prod(screen.half_size) / math.prod(lens.half_size)
    return part * math.sqrt(ratio * float(spread))


def _slopes(field: HeightField, heights: Tensor) -> tuple[Tensor, Tensor]:
    """Bound of |grad Z| on every knot span, and the span's fraction of the aperture: (spans along x, along y) each."""
    (su, sv), (rx, ry) = field.spaces, field.half_size
    gx, gy = su.differences(heights).abs() / (2 * rx), sv.differences(heights, 1).abs() / (2 * ry)
    p, q = su.degree, sv.degree
    along = [torch.nn.functional.max_pool2d(g[None, None], window, 1)[0, 0] for g, window in ((gx, (p, q + 1)), (gy, (p + 1, q)))]
    widths = [torch.diff(s.knots[s.degree : s.n + 1]).double() for s in (su, sv)]
    return torch.hypot(*along), widths[0][:, None] * widths[1][None, :]
