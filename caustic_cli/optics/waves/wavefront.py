"""The wavefront behind a lens: optical path and power density on a reference plane, from an exact ray trace.

Notation, for a ray that lands on the screen's plane
    X       landing point, mm (two components)
    q       transverse direction cosines
    V       optical path length from the source to X, mm
    L       distance of the screen from the vertex of the last surface, mm; n index of the image space
    x       X - L q, the intercept of the ray: the point of the reference plane, at distance L, from which paraxial propagation
            leads to X
    v       V - n L (1 + q^2 / 2), optical path to the intercept

In the Fresnel approximation a ray from x with slope q lands at x + L q after the path n L (1 + q^2 / 2).  With the field given as a
function of the intercept x, light therefore arrives at the traced landing point with the exact optical path, at any angle.
Intercepts differ by micrometres to tenths of a millimetre from the points where rays leave the surface.  Geometrical optics over
this short distance is the only approximation; it is good if the Fresnel scale of the distance is small compared with the surface
structure.

The far field is that in the focus of an ideal lens, of focal length L, in the reference plane: a ray through x with the slope q
lands at X = L q.  Behind that lens its slope is q - x / L and its path, to the plane, less by n x^2 / 2 L, so that the same
propagation, whose Fresnel kernel cancels the lens, is the Fourier transform of the field, which is exact.

The field is needed on a uniform grid of intercepts.  Rays are aimed at the grid points by Newton's method on the pupil, with the
mean magnification for the Jacobian (`ray_aiming`), and the remaining displacement e is corrected to first order: by Fermat's
principle v(x) = v + n q . e up to O(e^2).  The derivative by the heights, with rays fixed on the pupil, is then the one at fixed x,
as required.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.loading import OnDemand
from caustic_cli.optics.effects import Requests
from caustic_cli.optics.emission.coherent import Mode
from caustic_cli.optics.interaction import Interaction, Parameters
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.receiver import NormalPlane, dot
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.optics.waves.imaged_exit import ImagedExit, conjugate_of
from caustic_cli.optics.waves.interpolation import FineWavefront, Lit, extrapolated, interpolate, lagrange_weights
from caustic_cli.optics.waves.ray_aiming import aimed_rays
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.scene import Pupil
from caustic_cli.scene.screen import passed_by

interpolate_nd = OnDemand("scipy.interpolate")
#: Points along each side of the pupil for a survey; fraction of rays outside the quantiles `mostly`.
SURVEY, FEW = 65, 0.01
#: Least number of its rays that arrive.
LEAST_LIT = 16
DARK = "no light reaches the screen, so it has no wave image"
#: Tolerance of ray aiming: error of the optical path relative to the wavelength.
LEFT = 1e-4
#: The same for exact derivatives, whose error is of first order in the displacement.
LEFT_EXACT = 1e-9
CROSSES = (
    "rays cross within the depth of the lens, so that the light behind it has no single wavefront; a flatter surface or a screen"
    " farther away has one"
)
#: Part of the scale up to which the skew of the map from pupil to intercepts is left to the iterations of ray aiming.
STRAIGHT = 0.05
#: Deviation of the local magnification from pupil to intercepts from its mean, relative, from which on, behind two free-form sides,
#: the iterations of ray aiming begin at the survey's rays, with their local magnification.
UNEVEN = 0.7
#: Tolerated displacement from the grid at the edges of dark regions, in cells.
AT_EDGE = 0.05
#: Rays per chunk.
CHUNK = 1 << 19
#: Tolerated fraction of the power where rays cross in front of the reference plane, which an image leaves out: refined lenses have
#: a thousandth of it at their rim.
CROSSED = 5e-3
STAGES = Requests.to(stages=True)
#: Width of the taper at the edge of the computed region, relative to the region.
SOFT = 0.02


@dataclass
class Intercepts:
    """Rays by their intercepts, (N,) each: x, y, path v, direction cosines qx, qy, landing points X, Y, and power, a density on the
    pupil; see the module.  On request at_x, at_y, mm, the points of the exit or last surface, and sensitivity, the derivative
    of the path by its height."""

    x: Tensor
    y: Tensor
    path: Tensor
    qx: Tensor
    qy: Tensor
    big_x: Tensor
    big_y: Tensor
    power: Tensor
    at_x: Tensor | None = None
    at_y: Tensor | None = None
    sensitivity: Tensor | None = None

    def columns(self) -> list[Tensor]:
        """Those that there are."""
        return [c for c in vars(self).values() if c is not None]

    def updated(self, some: Tensor | slice, new: Intercepts) -> Intercepts:
        """These, with other rays in place of `some`; in place."""
        for column, other in zip(self.columns(), new.columns(), strict=True):
            column[some] = other
        return self


@dataclass(frozen=True)
class Optics:
    """The trace of one mode of a source for its wavefront.

    wavelength: mm; label: nm, at which the indices of media are evaluated, None if the system has them already; plane: of the
    screen; distance: L, mm; imaged: with other elements behind the lens' exit, what is then the reference plane.
    """

    system: System
    mode: Mode
    parameters: Parameters
    wavelength: float
    label: float | None
    plane: NormalPlane
    distance: float
    imaged: ImagedExit | None = None
    #: Distance of the far field's plane of reference behind the last surface, mm.
    beyond: float = 0.0

    @classmethod
    def of(cls, system: System, mode: Mode, parameters: Parameters, line: Any, plane: NormalPlane) -> Optics:
        """Of a spectral line (`image.Line`), with the distance of the plane from the last surface, or of its image behind the
        exit; for the far field with that image as plane of reference."""
        self = cls(system, mode, parameters, line.length, line.label, plane, distance_of(system, parameters, plane))
        if EXIT not in [e.name for e in system.elements[:-1]]:
            return self
        with torch.no_grad():
            left, last = self.interactions(*_grid(device_of(self)))
            f = self.intercepts_of(last)
            lit = f.power > 0
            if int(lit.sum()) < LEAST_LIT:
                raise NoWaveImage(DARK)
            at = tuple(c.expand(lit.shape)[lit] for c in left.hit.local[:2])
            if plane.far:
                waist = ((f.x[lit], f.big_x[lit]), (f.y[lit], f.big_y[lit]))
                return replace(self, beyond=conjugate_of(at, waist) * self.distance)
            imaged = ImagedExit.fitted(at, (f.big_x[lit], f.big_y[lit]), (f.qx[lit], f.qy[lit]), self.distance)
        return replace(self, distance=imaged.distance, imaged=imaged)

    @cached_property
    def unmasked(self) -> tuple[System, Any]:
        """The system without a mask on its exit, through which rays are traced, and the mask, None if there is none."""
        masks = [e.aperture for e in self.system.elements if e.name == EXIT and e.aperture.masks]
        if not masks:
            return self.system, None
        clear = self.system.pupil.aperture
        elements = tuple(replace(e, aperture=clear) if e.aperture in masks else e for e in self.system.elements)
        return replace(self.system, elements=elements), masks[0]

    @property
    def index(self) -> float:
        """Refractive index of the image space."""
        return self.system.media()[-1].index_at(self.label)

    def interactions(self, u: Tensor, v: Tensor) -> tuple[Interaction, Interaction]:
        """Rays through points (N,) of the pupil at the lens' exit, or where there is none at the last element, and at that; behind
        the interaction."""
        rays = self.mode.through(u, v, self.system.object_space.index_at(self.label))
        return Tracer(self.unmasked[0], rays, requests=STAGES, wavelength=self.label).ends(self.parameters)

    def intercepts(self, u: Tensor, v: Tensor, sensitive: bool = False) -> Intercepts:
        """Intercepts of the rays through points (N,) of the pupil; sensitive: with those at the last surface."""
        if torch.is_grad_enabled() or len(u) <= CHUNK:
            met, last = self.interactions(u, v)
            with_exit = sensitive or self.unmasked[1] is not None
            return _with_exit(met, self.intercepts_of(last)) if with_exit else self.intercepts_of(last)
        found: Intercepts | None = None
        for start in range(0, len(u), CHUNK):
            part = slice(start, start + CHUNK)
            new = self.intercepts(u[part], v[part], sensitive)
            found = found or Intercepts(*(c.new_empty(len(u)) for c in new.columns()))
            found.updated(part, new)
        assert found is not None
        return found

    def landing(self, mode: Mode, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Landing points X, Y of another mode's light, mm, its power, and its points on the exit or last element, mm."""
        met, last = replace(self, mode=mode).interactions(u, v)
        f, state = self.intercepts_of(last), met.state.expanded()
        x, y = (c.expand(len(u)) if isinstance(c, Tensor) else torch.full_like(u, c) for c in state.origin[:2])
        return f.big_x, f.big_y, f.power, x, y

    def intercepts_of(self, m: Interaction) -> Intercepts:
        """Intercepts of rays behind the last element."""
        state, (e1, e2, e3) = m.state.expanded(), self.plane.axes
        o, d = state.full((state.origin[0], state.origin[1], state.origin[2] + state.datum)), state.full(state.direction)
        qx, qy, qz = (sum(a * b for a, b in zip(d, e, strict=True)) for e in (e1, e2, e3))
        height = sum(a * b for a, b in zip(o, e3, strict=True))
        if self.plane.far:
            t = (vertex_of(self.system, self.parameters, self.plane) + self.beyond - height) / qz
            ahead = (qz > 0) & torch.isfinite(t)
            t, power = torch.where(ahead, t, torch.zeros_like(t)), torch.where(ahead, state.power, torch.zeros_like(state.power))
            x, y = (sum(a * b for a, b in zip(o, e, strict=True)) + t * q for e, q in ((e1, qx), (e2, qy)))
            n, f = self.index, self.distance
            path = state.path + n * t - (0.5 * n / f) * (x * x + y * y)
            return Intercepts(x, y, path, qx - x / f, qy - y / f, f * qx, f * qy, power)
        t = (self.plane.z - height) / qz
        ahead = (t > 0) & torch.isfinite(t)
        ahead = ahead & passed_by(self.plane.windows, o, d)
        t = torch.where(ahead, t, torch.zeros_like(t))
        big_x, big_y = (sum(a * b for a, b in zip(o, e, strict=True)) + t * q for e, q in ((e1, qx), (e2, qy)))
        n, far = self.index, self.distance
        power = torch.where(ahead, state.power, torch.zeros_like(state.power))
        path = state.path + n * t
        if self.imaged is not None:
            (x, qx), (y, qy) = self.imaged.intercept(0, big_x, qx), self.imaged.intercept(1, big_y, qy)
            path = path - n * (self.imaged.path(0, big_x) + self.imaged.path(1, big_y) + 0.5 * far * (qx * qx + qy * qy))
            return Intercepts(x, y, path, qx, qy, big_x, big_y, power)
        path = path - n * far * (1.0 + 0.5 * (qx * qx + qy * qy))
        return Intercepts(big_x - far * qx, big_y - far * qy, path, qx, qy, big_x, big_y, power)


def distance_of(system: System, parameters: Parameters, plane: NormalPlane) -> float:
    """L, the distance of a plane from the centre of the last surface, mm; for the far field its focal length."""
    return plane.z if plane.far else abs(plane.z - vertex_of(system, parameters, plane))


def vertex_of(system: System, parameters: Parameters, plane: NormalPlane) -> float:
    """Distance along a plane's normal of the centre of the last surface from the system's origin, mm."""
    last = system.elements[-1]
    x, y, z = last.pose.position
    if last.surface.shape is not None:
        middle, normal = float(parameters[last.name].detach().double().mean()), last.pose.axes[2]
        x, y, z = (c + middle * a for c, a in zip((x, y, z), normal, strict=True))
    return dot((x, y, z), plane.axes[2])


@dataclass(frozen=True)
class Survey:
    """Extent of the light, from a coarse grid of rays.

    light, landing: lower and upper limits of intercepts and of landing points, mm; offset, scale: linear fit x = offset + scale u
    from the pupil's u and v, in [0, 1], to intercepts along each axis; skew: and their change along the other one, 0 where it is
    small; magnification: square root of the mean area of landing points over that of intercepts; mostly: limits of landing points
    without the fraction FEW of rays on each side; places: where the intercepts are far from that fit, as behind two surfaces that
    reshape a beam, u, v, x, y of the survey's rays, (N,) each.
    """

    light: tuple
    landing: tuple
    offset: tuple[float, float]
    scale: tuple[float, float]
    magnification: float
    mostly: tuple
    skew: tuple[float, float] = (0.0, 0.0)
    places: tuple[Tensor, ...] | None = None

    def aim(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """u and v for intercepts (N,), mm: of the fit, or where there are `places` linear between them, and beyond them of the fit
        from the nearest one on."""
        if self.places is None:
            return self.toward(x - self.offset[0], y - self.offset[1])
        u, v, px, py = (c.cpu().numpy() for c in self.places)
        at, of, to = (np.stack(pair, -1) for pair in ((x.cpu().numpy(), y.cpu().numpy()), (px, py), (u, v)))
        found = interpolate_nd.LinearNDInterpolator(of, to)(at)
        beyond = np.isnan(found).any(-1)
        there, near = at[beyond], interpolate_nd.NearestNDInterpolator(of, np.concatenate([of, to], -1))(at[beyond])
        found[beyond] = near[:, 2:] + np.stack(self.toward(*(there - near[:, :2]).T), -1)
        there_u, there_v = torch.from_numpy(found).to(x).unbind(-1)
        return there_u, there_v

    def toward(self, x, y, _some: Tensor | slice = slice(None)) -> tuple:
        """Changes of u and v for changes of the intercepts, mm, tensors or numbers; of which rays does not matter."""
        (a, d), (b, c) = self.scale, self.skew
        if not (b or c):
            return x / a, y / d
        over = 1.0 / (a * d - b * c)
        return over * (d * x - b * y), over * (a * y - c * x)


@torch.no_grad()
def survey(optics: Optics) -> Survey:
    """Trace a coarse grid of rays of a mode.

    Raises:
        NoWaveImage: no light reaches the screen.
    """
    u, v = _grid(device_of(optics))
    f = optics.intercepts(u, v)
    lit = f.power > 0
    pupil = optics.mode.scene.pupil
    lit &= pupil.aperture.covers(2.0 * u - 1.0, 2.0 * v - 1.0, 1e-12)
    if int(lit.sum()) < LEAST_LIT:
        raise NoWaveImage(DARK)
    light, landing = (
        tuple(tuple(float(getattr(c[lit], w)()) for c in pair) for w in ("min", "max")) for pair in ((f.x, f.y), (f.big_x, f.big_y))
    )
    scale, offset, lows, highs = [], [], [], []
    for k, (at, foot) in enumerate(((u[lit], f.x[lit]), (v[lit], f.y[lit]))):
        a, b = _centred(at, foot)
        scale.append(float((a * b).sum() / (a * a).sum()))
        offset.append(float(foot.mean() - scale[-1] * at.mean()))
        low, high = light[0][k], light[1][k]
        for end, edge in ((at.min(), 0.0), (at.max(), 1.0)):
            upper = (edge > 0.5) == (scale[-1] > 0)
            if float(end) != edge:  # an edge within the pupil, somewhere between this point and the next
                reach = (high if upper else low) + (1.0 if upper else -1.0) * abs(scale[-1]) / (SURVEY - 1)
            else:  # the survey's points may miss a circle's edge
                reach = offset[-1] + scale[-1] * edge if pupil.aperture.round else low
            low, high = (low, max(high, reach)) if upper else (min(low, reach), high)
        lows.append(low)
        highs.append(high)
    light = (tuple(lows), tuple(highs))
    skew = [float((a * b).sum() / (a * a).sum()) for a, b in (_centred(v[lit], f.x[lit]), _centred(u[lit], f.y[lit]))]
    if max(map(abs, skew)) <= STRAIGHT * min(map(abs, scale)):
        skew = [0.0, 0.0]
    offset = [o - s * float(at[lit].mean()) for o, s, at in zip(offset, skew, (v, u), strict=True)]
    grid = (SURVEY, SURVEY)
    area = _jacobian(f.big_x.view(grid), f.big_y.view(grid), 1.0, 1.0).abs()
    foot = _jacobian(f.x.view(grid), f.y.view(grid), 1.0, 1.0).abs()
    weight = f.power.view(grid)
    magnification = float((weight * area).sum() / (weight * foot).sum()) ** 0.5
    mostly = tuple(tuple(float(torch.quantile(c[lit], q)) for c in (f.big_x, f.big_y)) for q in (FEW, 1.0 - FEW))
    stretched = [torch.gradient(c.view(grid), spacing=1.0 / (SURVEY - 1), dim=k)[0].view(-1)[lit] for k, c in enumerate((f.x, f.y))]
    reshapes = sum(not e.surface.flat for e in optics.system.elements) > 1 and not any(skew)
    uneven = reshapes and any(float((g / s - 1.0).abs().max()) > UNEVEN for g, s in zip(stretched, scale, strict=True))
    places = tuple(c[lit] for c in (u, v, f.x, f.y)) if uneven else None
    return Survey(light, landing, (offset[0], offset[1]), (scale[0], scale[1]), magnification, mostly, (skew[0], skew[1]), places)


def _grid(device: torch.device) -> tuple[Tensor, Tensor]:
    """u and v of the rays of a survey."""
    line = torch.linspace(0.0, 1.0, SURVEY, dtype=torch.float64, device=device)
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    return u, v


def _centred(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Without their means."""
    return a - a.mean(), b - b.mean()


def _jacobian(a: Tensor, b: Tensor, dx: float, dy: float) -> Tensor:
    """Jacobian determinant of two functions (n, m) on a uniform grid."""
    (ax, ay), (bx, by) = (torch.gradient(c, spacing=(dx, dy), dim=(0, 1), edge_order=2) for c in (a, b))
    return ax * by - ay * bx


@dataclass(frozen=True)
class LastSurface:
    """The rays of a wavefront at the last surface, (n, m) each: points x, y, mm, and the derivative of the path by its height."""

    x: Tensor
    y: Tensor
    sensitivity: Tensor

    def displacement(self, height: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """A function of points (N,) mm at these rays, (n, m)."""
        return height(self.x.reshape(-1), self.y.reshape(-1)).view(self.x.shape)


class PathChange:
    """Change of the optical paths of a wavefront by a change of the last surface's heights, to first order, and its adjoint.

    Args:
        surface: spline spaces of the heights.
        last: the rays at that surface, (n, m).
        dtype: of the change.
    """

    def __init__(self, surface: HeightField, last: LastSurface, dtype: torch.dtype):
        self.surface, self.last, self.dtype = surface, last, dtype

    def of(self, heights: Tensor) -> Tensor:
        """(n, m) mm, of a change of the heights, mm."""
        moved = self.last.displacement(lambda x, y: self.surface.evaluate(heights, x, y)[0])
        return (self.last.sensitivity * moved).to(self.dtype)

    def pull(self, by: Tensor) -> Tensor:
        """The derivative by the heights, float64, from that by the change of the paths (n, m)."""
        with torch.enable_grad():
            heights = torch.zeros([s.n for s in self.surface.spaces], dtype=torch.float64, device=by.device, requires_grad=True)
            return pull_back([self.of(heights)], [heights], [by])[0]


@dataclass
class Wavefront:
    """The wavefront on a uniform grid of intercepts, (n, m) float64 each."""

    #: Lower edges and widths of the cells, whose centres are the nodes, mm.
    low: tuple[float, float]
    step: tuple[float, float]
    #: v minus its mean, mm; power per mm^2.  Both are extrapolated where light is blocked behind the pupil.
    path: Tensor
    density: Tensor
    lit: Lit
    #: Landing points X, Y, mm.
    landing: tuple[Tensor, Tensor]
    #: None unless requested.
    last: LastSurface | None = None
    _fine: tuple | None = field(default=None, init=False, repr=False)

    def within(self, middle: tuple[float, float], width: tuple[float, float]) -> Wavefront:
        """The wavefront tapered to light that lands within a rectangle on the screen, mm; itself if that is all."""
        density = self.density
        for big, ends, m, w in zip(self.landing, self.lands, middle, width, strict=True):
            if max(m - ends[0], ends[1] - m) > (0.5 - SOFT) * w:
                density = density * ((0.5 * w - (big - m).abs()) / (SOFT * w)).clamp(0.0, 1.0)
        return self if density is self.density else replace(self, density=density)

    @cached_property
    def lands(self) -> tuple[tuple[float, float], ...]:
        """Limits of the landing points of the light along each axis, mm."""
        lit = self.density > 0
        return tuple((float(big[lit].min()), float(big[lit].max())) for big in self.landing)

    @cached_property
    def power(self) -> float:
        """Total power."""
        return float((self.density.detach() * self.lit.fraction(self.step).detach()).sum()) * self.step[0] * self.step[1]

    def on(self, low: tuple[float, float], step: tuple[float, float], count: tuple[int, int]) -> FineWavefront:
        """The wavefront on a finer grid; the last result is cached."""
        key = low, step, count
        if self._fine is not None and self._fine[0] == key:
            return self._fine[1]
        x, y = (
            lagrange_weights(self.path.shape[k], self.low[k], self.step[k], low[k], step[k], count[k], self.path) for k in (0, 1)
        )
        bright = self.density > 0  # at 0 a root has no derivative
        root = torch.where(bright, self.density, torch.ones_like(self.density)).sqrt() * bright * (step[0] * step[1]) ** 0.5
        path, root = (interpolate(c, None, y) for c in (self.path, root))
        fine = FineWavefront(path, root, self.lit.mapped(lambda c: interpolate(c, None, y)), step, x)
        self._fine = key, fine
        return fine


def wavefront(
    optics: Optics,
    seen: Survey,
    low: tuple[float, float],
    step: tuple[float, float],
    count: tuple[int, int],
    sensitive: bool = False,
    exact: bool = False,
) -> Wavefront:
    """The wavefront on a grid of `count` cells of width `step` from `low` on; differentiable by the heights in `optics.parameters`.

    exact: aim rays to rounding accuracy.
    sensitive: with the sensitivity to the height of the last surface, instead of derivatives by autograd.

    Raises:
        NoWaveImage: rays cross in front of the reference plane, so that there is no single wavefront.
    """
    device = device_of(optics)
    differentiable = not sensitive and torch.is_grad_enabled() and any(h.requires_grad for h in optics.parameters.values())
    left = (LEFT_EXACT if exact else LEFT) * optics.wavelength / optics.index
    x, y = (low[k] + step[k] * (torch.arange(count[k], dtype=torch.float64, device=device) + 0.5) for k in (0, 1))
    shape = (len(x), len(y))
    x, y = (c.reshape(-1) for c in torch.meshgrid(x, y, indexing="ij"))
    with torch.no_grad():
        f, held, behind = aimed_rays(optics, seen, (x, y), shape, step, left, sensitive)
    last = LastSurface(*(c.view(shape) for c in (f.at_x, f.at_y, f.sensitivity))) if sensitive else None
    if differentiable:
        f = optics.intercepts(*held)
    ex, ey = x - f.x, y - f.y
    path = f.path + optics.index * (f.qx * ex + f.qy * ey)
    dark = (f.power <= 0) | (behind & ((ex.abs() > AT_EDGE * step[0]) | (ey.abs() > AT_EDGE * step[1]))).detach()
    if bool(dark.all()):
        raise NoWaveImage(CROSSES)
    known = ~dark | (behind & (f.power > 0))  # next to dark regions use the path of rays from the edge of the light
    path = torch.where(known, path - path[~dark].detach().mean(), torch.zeros_like(path))
    apart, at = (ex.view(shape), ey.view(shape)), (x.view(shape), y.view(shape))
    density, lit = _density(optics.mode.scene.pupil, seen, held, apart, at, f.power.view(shape), dark.view(shape), step)
    if (mask := optics.unmasked[1]) is not None and f.at_x is not None and f.at_y is not None:
        lit = replace(lit, mask=mask.margin((f.at_x + ex).detach(), (f.at_y + ey).detach()).view(shape))
    big_x, big_y = (c.detach().view(shape) for c in (f.big_x, f.big_y))
    return Wavefront(low, step, path.view(shape), density, lit, (big_x, big_y), last)


def _density(
    pupil: Pupil,
    seen: Survey,
    held: tuple[Tensor, Tensor],
    apart: tuple[Tensor, Tensor],
    at: tuple[Tensor, Tensor],
    power: Tensor,
    dark: Tensor,
    step: tuple[float, float],
) -> tuple[Tensor, Lit]:
    """Power per mm^2 on a grid, and what of it is lit, from the Jacobian of the pupil points of the light at its points.

    Args:
        held: points u, v of the pupil of the traced rays, (N,).
        apart: displacement of the grid from their intercepts; at: its points, (n, m) mm; step: its spacing.
        power: of the rays, a density on the pupil; dark: whether light is blocked there, (n, m).

    Raises:
        NoWaveImage: see `wavefront`.
    """
    (ex, ey), (x, y) = apart, at
    px, py = (((h - 0.5) * c).view(dark.shape) for h, c in zip(held, seen.scale, strict=True))
    gone = [extrapolated((p + e).detach() - c, dark) + c for p, e, c in ((px, ex, x), (py, ey, y))]
    (pxx, pxy), (pyx, pyy) = (torch.gradient(p, spacing=step, dim=(0, 1), edge_order=2) for p in gone)
    px = torch.where(dark, gone[0], px + pxx * ex + pxy * ey)
    py = torch.where(dark, gone[1], py + pyx * ex + pyy * ey)
    mm = [2.0 * pupil.half_size[k] / abs(seen.scale[k]) for k in (0, 1)]
    squeeze = mm[0] * mm[1] * _jacobian(px, py, *step)
    crossed = torch.where((squeeze.detach() <= 0) & ~dark, power.detach(), torch.zeros_like(power))
    if float(crossed.sum()) > CROSSED * float(power.detach().sum()):
        raise NoWaveImage(CROSSES)
    power = torch.where(dark, extrapolated(power.detach(), dark), power)
    by_x, by_y = torch.gradient(power.detach(), spacing=step, dim=(0, 1), edge_order=2)
    density = (power + torch.where(dark, torch.zeros_like(ex), by_x * ex + by_y * ey)).clamp_min(0.0) * squeeze.clamp_min(0.0)
    rx, ry = (abs(s) / 2.0 for s in seen.scale)
    edge_x, edge_y = pupil.aperture.edges(px, py, (rx, ry))
    return density, Lit(edge_x, edge_y, (~dark).double() if bool(dark.any()) else None)


def _with_exit(m: Interaction, f: Intercepts) -> Intercepts:
    """Intercepts of rays behind the last element, with their points on the surface of the interaction."""
    into, normal = m.hit.incoming[2], m.element.pose.axes[2]
    out = sum(c * a for c, a in zip(m.state.full(m.state.direction), normal, strict=True))
    x, y = (c.expand(out.shape) for c in m.hit.local[:2])
    return replace(f, at_x=x, at_y=y, sensitivity=m.n_in * into - m.n_out * out)


def device_of(optics: Optics) -> torch.device:
    """Device of the heights."""
    return next((h.device for h in optics.parameters.values()), torch.device("cpu"))
