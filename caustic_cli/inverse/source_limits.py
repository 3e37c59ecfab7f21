"""Fundamental limits set by an extended source: the least error behind its blur, and the most light that etendue allows.

The image of any lens is a sum of images of the source by its points (`source_image`), whose weights are not negative; the
error of every such sum is bounded from below (`deconvolution`).

Etendue, the integral of cos cos / r^2 dA dA' over two areas, is conserved from the source to the screen: of light of etendue E_1
through the pupil at most the fraction E_2 / E_1 reaches a screen whose etendue with the exit of the lens is E_2.  Behind elements
that is the integral over the rays from the exit to the first of them that reach the screen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from caustic_cli.effort import STANDARD
from caustic_cli.errors import at_most
from caustic_cli.inverse.deconvolution import BOUND_STEPS, BOUND_WORK, FINEST, NO_ERROR, Blur, Deconvolved, deconvolved, error_bound
from caustic_cli.inverse.projection import stretching_surface
from caustic_cli.inverse.relay import RelayedScreen
from caustic_cli.inverse.source_image import Sent, placed_images, source_images
from caustic_cli.optics.frames import to_global
from caustic_cli.optics.screen_shape import normals, points_in_space
from caustic_cli.optics.spread import Spread
from caustic_cli.optics.spreads import Spreads, spreads_at
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Aperture, CircularAperture, Scene
from caustic_cli.scene.aperture import UNBOUNDED
from caustic_cli.scene.sources.distribution import relative
from caustic_cli.scene.traits import Capability

LIMITS = Capability(
    "limits by the source",
    {"unknown elements": "what is designed between lens and screen decides which etendue that accepts"},
)

#: The blur is taken as a convolution where the deviation from it is at most this fraction of its half width.
SHIFTS = 0.35
#: Points along each axis of an area.
POINTS = 12
#: Sets of rays from the exit to the element behind it, and rays of each; the rectangle about that element through which those that
#: it takes pass its vertex plane, in its half widths; standard errors of the sets' mean that this is taken larger by.
SETS, BEHIND, AROUND, ABOVE = 8, 1 << 15, 1.5, 3.0
#: Least half width of the blur, pixels, for which the least error is computed.
LEAST_REACH = 0.5
#: Least half width of the blur, binned pixels, for the least error.
BLURRED = 8.0
#: What the widest image may have beyond the widest that stands for others.
WIDER = 1.25
#: Control points along each axis of the offset surface that stands for the lens before it is designed.
NET = 24


@dataclass(frozen=True)
class SourceLimits:
    """Limits that the source sets to any lens; each None where it does not determine it."""

    #: Lower bound of the relative RMS error of any lens, by the blur of the source.
    error: float | None
    #: Largest fraction of the light on the lens that can reach the screen.
    etendue: float | None

    def sentence(self) -> str:
        """The limits as a sentence for the user; empty without any."""
        found = []
        if self.error is not None:
            found.append(f"the source blurs the picture: no lens has a relative RMS error of less than {at_most(self.error, 3)}")
        if self.etendue is not None:
            found.append(f"by etendue, at most {self.etendue:.0%} of the light on the lens can reach the screen")
        return "; ".join(found)


def performance_limits(
    scene: Scene, target: np.ndarray, most: int = STANDARD.bound_steps, sent: Sent | None = None
) -> SourceLimits:
    """Limits for any lens under the source of a scene.

    target: (n, m) irradiance, or (3, n, m) in colour, whose bound is the mean of its colours', as their error is; most:
    iterations, as of `error_bound`; sent: of a lens, whose light others send to about the same places, see `placed_images`.
    """
    scene = scene.unfolded
    if not (scene.source.extended and LIMITS.supports(scene)):
        return SourceLimits(None, None)
    images, pixel, size = source_images(scene), scene.screen.pixel, max(scene.screen.size)
    seen = bool(images) and LEAST_REACH * max(pixel) < max(images[0].reach()) <= size
    errors = [_least_error(one, scene, images, sent, most) for one in np.atleast_3d(target.T).T if one.any() and seen]
    error = sum(errors) / len(errors) if errors else 0.0
    return SourceLimits(error if error > NO_ERROR else None, etendue_limit(scene))


def _least_error(target: np.ndarray, scene: Scene, images: list[Spread], sent: Sent | None, most_steps: int) -> float:
    """Lower bound of the error of any lens with these images of its source, the sharpest first.

    Only the images of light that reaches the lit part of the picture count.  Where it would take too long, pixels much smaller than
    the blur are binned: the error of binned images is no larger than theirs.
    """
    pixel, (n, m) = scene.screen.pixel, target.shape
    most = max(1.0, min(r / (BLURRED * w) for r, w in zip(images[0].reach(), pixel, strict=True)))
    widest = WIDER * np.max([image.reach() for image in images], axis=0)
    at = [(np.arange(count) + 0.5 - 0.5 * count) * w for count, w in zip((n, m), pixel, strict=True)]
    lit = [c[target.any(axis)] for c, axis in zip(at, (1, 0), strict=True)]
    around = zip(lit, widest, pixel, scene.screen.half_size, strict=True)
    low, high = zip(*((max(c[0] - r - w, -h), min(c[-1] + r + w, h)) for c, r, w, h in around), strict=True)
    placed = placed_images(scene, low, high, sent)
    sides = [k for k in range(1, min(n, m) + 1) if n % k == m % k == 0 and k <= most]
    work = len(placed) * target.size * FINEST**2 * BOUND_STEPS
    k = next((k for k in sides if work <= BOUND_WORK * k * k), sides[-1])
    binned, centres = target.reshape(n // k, k, m // k, k).mean((1, 3)), [c.reshape(-1, k).mean(1) for c in at]
    cells = (pixel[0] * k, pixel[1] * k)
    blurs = [Blur(tuple(one.image.on(cells, cut) for cut in (1, FINEST)), torch.from_numpy(one.covers(*centres))) for one in placed]
    return error_bound(binned, blurs, most_steps)


def best_irradiance(scene: Scene, target: np.ndarray, spread: Spread | Spreads, steps: int) -> Deconvolved:
    """The deconvolution of a target by the source's blur on the screen of a scene, see `deconvolved`, to light that is even over
    each pixel, as a transport map makes it."""
    return deconvolved(target, spread.on(scene.screen.pixel).of_even_pixels, steps)


def source_spread(scene: Scene, field: HeightField | None = None, heights: torch.Tensor | None = None) -> Spread | Spreads | None:
    """The point-spread function of an extended source or of several; None for a point source, where the blur is not well
    approximated by a convolution, where it is wider than the screen, before several surfaces are designed, or where each of several
    sources has a lenslet of its own."""
    scene = scene.unfolded
    if not scene.source.extended or scene.source.by_lenslet:
        return None
    if heights is None and scene.joint:  # the offset of one surface does not represent a lens with several
        return None
    if heights is None:
        scene = replace(scene, lens=replace(scene.lens, control=(NET, NET), knots=None, array=(1, 1)))
        field = HeightField.of(scene.lens)
        x, y = (c.numpy() for c in field.control_xy())
        heights = torch.from_numpy(stretching_surface(scene, x, y) if scene.source.oblique else scene.lens.offset.heights(x, y))
    found = spreads_at(scene, field, heights)
    if found is None or found.usual > SHIFTS * max(found.reach()) or max(found.reach()) > max(scene.screen.size):
        return None
    return found


def etendue_limit(scene: Scene) -> float | None:
    """E_2 / E_1, at most 1; None for a source without area or of uneven radiance, and for several."""
    source, pupil = scene.source, scene.pupil
    if not source.even or len(source.members) > 1:
        return None
    x, y, cell = _area(pupil.half_size, pupil.aperture if scene.in_front else scene.lens.clear)
    area = cell * len(x)
    if source.distant:
        given = area * math.pi * math.sin(source.half_angle) ** 2 * source.axis[2]
    elif min(source.extent) > 0 and len(source.points()[0]) == 1:
        a, b, part = _area(source.extent, CircularAperture())
        x0, y0, z0 = source.points()[0][0]
        seen = _geometric_factor(x, y, (a + x0, b + y0, z0 - pupil.z))
        slope = np.hypot(a + x0 - x[:, None], b + y0 - y[:, None]) / (pupil.z - z0)
        cone = source.cone_over(pupil)
        given = cell * part * seen[(np.arctan(slope) <= cone) & (relative(source.intensity, slope) > 0)].sum()
    else:
        return None
    return min(1.0, _accepted(scene) / float(given)) if given > 0 else None


def _accepted(scene: Scene) -> float:
    """E_2, mm^2 sr."""
    lens, screen = scene.lens, scene.screen
    if scene.behind:
        return _relayed(scene)
    x, y, cell = _area(lens.half_size, lens.clear)
    a, b, part = _area(screen.half_size, UNBOUNDED)
    px, py, pz = points_in_space(screen, a, b)
    return float(cell * part * _geometric_factor(x, y, (px, py, pz - lens.offset.thickness), normals(screen, a, b)).sum())


def _relayed(scene: Scene) -> float:
    """E_2, mm^2 sr, behind other elements, from rays between points of the exit and of the first of them: an upper bound by ABOVE
    standard errors of randomised sets of low discrepancy."""
    lens, screen, relay = scene.lens, scene.screen, RelayedScreen(scene, scene.lens.offset.thickness)
    first = relay.with_apertures.elements[0]
    wide = [AROUND * h for h in first.aperture.half_size]
    points = [torch.quasirandom.SobolEngine(4, scramble=True, seed=k).draw(BEHIND, dtype=torch.float64) for k in range(SETS)]
    x, y, a, b = ((2.0 * torch.cat(points) - 1.0) * torch.tensor([*lens.half_size, *wide], dtype=torch.float64)).T
    exit = (x, y, torch.full_like(x, lens.offset.thickness))
    to = to_global(first.pose, (a, b, torch.zeros_like(a)), 0.0)
    d = [(q - p).numpy() for p, q in zip(exit, to, strict=True)]
    r = np.sqrt(sum(c * c for c in d))
    facing = np.abs(d[2]) * np.abs(sum(c * axis for c, axis in zip(d, first.pose.axes[2], strict=True))) / r**4
    landed = relay.landing(tuple(c.numpy() for c in exit), tuple(c / r for c in d), stopped=True)
    with np.errstate(invalid="ignore"):
        on = [np.abs(c - s) <= h for c, s, h in zip(landed, screen.shift, screen.half_size, strict=True)]
    lit = lens.clear.contains(x, y).numpy() & on[0] & on[1]
    means = np.where(lit, facing, 0.0).reshape(SETS, -1).mean(1)
    most = means.mean() + ABOVE * means.std(ddof=1) / math.sqrt(SETS)
    return float(16.0 * math.prod(lens.half_size) * math.prod(wide) * most)


def _area(half: tuple[float, float], shape: Aperture) -> tuple[np.ndarray, np.ndarray, float]:
    """Midpoint-rule nodes of an aperture's shape stretched to half widths, mm, and the area of each, mm^2."""
    x, y = (h * ((np.arange(POINTS) + 0.5) * (2.0 / POINTS) - 1.0) for h in half)
    x, y = (c.ravel() for c in np.meshgrid(x, y, indexing="ij"))
    inside = shape.covers(x / half[0], y / half[1])
    return x[inside], y[inside], half[0] * half[1] * shape.filled / np.count_nonzero(inside)


def _geometric_factor(x: np.ndarray, y: np.ndarray, point: tuple, normal: tuple = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Geometric factor cos cos / r^2 between points (x, y, 0) of the lens' plane and points of a surface: (len(x), points).

    The length of each normal is the area that its point represents."""
    dx, dy, dz = point[0] - x[:, None], point[1] - y[:, None], point[2]
    r2 = dx * dx + dy * dy + dz * dz
    return np.abs(dz) * np.abs(normal[0] * dx + normal[1] * dy + normal[2] * dz) / (r2 * r2)
