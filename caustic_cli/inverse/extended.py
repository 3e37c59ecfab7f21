"""What an extended source lets a lens do: the best light behind its blur, the least error, and the most light that etendue lets by.

Etendue, the integral of cos cos / r^2 dA dA' over two areas that see each other, is kept from the source's light to the screen's:
of light of etendue E_1 through the lens no more than E_2 / E_1 lands on a screen that sees the lens under E_2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from caustic_cli.inverse.deconvolution import FINEST, Deconvolved, deconvolved
from caustic_cli.inverse.schedule import Stage
from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.emission.coherent import modes, spots
from caustic_cli.optics.emission.regular import RegularGrid
from caustic_cli.optics.screen_shape import normals, points_in_space
from caustic_cli.optics.spread import Convolution, Spread, spread_at
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene, Source
from caustic_cli.scene.sources.distribution import relative

#: A source shifts the image where it misplaces light by no more than this part of what it spreads it over.
SHIFTS = 0.35
#: How much of it may be misplaced in a refinement, and how many points of a source are taken for that, at most.
EXACT, MOST_MODES = 0.04, 24
#: Points along each axis of an area.
POINTS = 12
#: Pixels over which light is spread at least where anything is said of the least error.
LEAST_REACH = 0.5
#: Control points along each axis of the offset surface by which this is judged before there is a lens.
NET = 24


@dataclass(frozen=True)
class Limits:
    """light: the best behind the source's blur; etendue: the most of the light that the lens is lit with that the screen can get, a
    part; None of either where it does not follow from the source's image or extent."""

    light: Deconvolved | None
    etendue: float | None

    def sentence(self) -> str:
        """What cannot be."""
        found = []
        if self.light is not None:
            found.append(
                f"behind the source's blur the best light there can be is {self.light.bound:.3g} (proven) to"
                f" {self.light.error:.3g} (found) relative RMS from the picture"
            )
        if self.etendue is not None:
            found.append(f"etendue lets {self.etendue:.0%} of the light on the lens reach the screen")
        return "; ".join(found)


def limits(
    scene: Scene,
    target: np.ndarray,
    field: HeightField | None = None,
    heights: torch.Tensor | None = None,
    steps: int | None = None,
) -> Limits:
    """What the source of a scene lets any lens do, by the spread of this lens, or of the offset surface.

    target: (n, m); steps: as of `best_light`.
    """
    if not scene.source.extended or scene.source.apart or scene.elements:
        return Limits(None, None)
    spread = shift_of(scene, field, heights)
    seen = spread is not None and max(spread.reach()) > LEAST_REACH * max(scene.screen.pixel)
    light = best_light(scene, target, spread, steps) if seen else None
    return Limits(light, etendue_limit(scene))


def best_light(scene: Scene, target: np.ndarray, spread: Spread, steps: int | None = None) -> Deconvolved:
    """The best light on a scene's screen behind a source's spread; see `deconvolved`."""
    return deconvolved(target, spread.on(scene.screen.pixel, FINEST), steps)


def shift_of(scene: Scene, field: HeightField | None = None, heights: torch.Tensor | None = None) -> Spread | None:
    """How an extended source spreads its middle's image; None where it has no extent, does much else, or lights far more than the
    screen."""
    if not scene.source.extended or scene.source.apart or any(scene.screen.tilt) or scene.screen.curved or scene.elements:
        return None
    if heights is None:
        scene = replace(scene, lens=replace(scene.lens, control=(NET, NET), knots=None, array=(1, 1)))
        field = HeightField.of(scene.lens)
        x, y = (c.numpy() for c in field.control_xy())
        offset = scene.lens.offset
        heights = torch.from_numpy(offset.thickness + offset.sag(x[:, None], y[None, :]))
    found = spread_at(scene, field, heights)
    if found is None or found.usual > SHIFTS * max(found.reach()) or max(found.reach()) > max(scene.screen.size):
        return None
    return found


def centre_of(scene: Scene) -> Source:
    """The source without its extent, that shines into the same cone."""
    source = scene.source.pointlike()
    if not source.distant and source.cone is None:
        cone = scene.source.cone_over(scene.lens.half_size, scene.lens.z_in, scene.lens.round)
        return replace(source, cone=math.degrees(cone))
    return source


def regular_rays(
    scene: Scene, spread: Spread, stage: Stage, seed: int, device: str | torch.device
) -> tuple[Scene, Rays | list[Rays], list[Convolution]]:
    """The rays of a stage that are spread: of the source's middle, or of a few of its points where its light does more than shift;
    with the scene that they are for, and what the image of each point's is convolved with."""
    pixel, each = scene.screen.pixel, math.ceil((spread.usual / (EXACT * max(spread.reach()))) ** 2)
    if each <= 1 or not min(spread.half) > 0:
        scene = replace(scene, source=centre_of(scene))
        return scene, rays_of(scene, stage.sampler, stage.rays, seed, device), [spread.on(pixel, stage.oversample)]
    each = min(each, MOST_MODES)
    parts = spread.parts_on(pixel, spots(scene.source, each), stage.oversample)
    return scene, RegularGrid.of_modes(modes(scene, each), stage.rays, device), parts


def etendue_limit(scene: Scene) -> float | None:
    """E_2 / E_1, at most 1; None for a source that has no area, or is not evenly bright over it."""
    lens, screen, source = scene.lens, scene.screen, scene.source
    if not source.even:
        return None
    x, y, cell = _area(lens.half_size, lens.round)
    area = cell * len(x)
    if source.distant:
        given = area * math.pi * math.sin(source.half_angle) ** 2
    elif min(source.extent) > 0 and len(source.points()[0]) == 1:
        a, b, part = _area(source.extent, True)
        x0, y0, z0 = source.points()[0][0]
        seen = _seen(x, y, (a + x0, b + y0, z0 - lens.z_in))
        slope = np.hypot(a + x0 - x[:, None], b + y0 - y[:, None]) / (lens.z_in - z0)
        cone = source.cone_over(lens.half_size, lens.z_in, lens.round)
        given = cell * part * seen[(np.arctan(slope) <= cone) & (relative(source.intensity, slope) > 0)].sum()
    else:
        return None
    a, b, part = _area(screen.half_size, False)
    px, py, pz = points_in_space(screen, a, b)
    taken = cell * part * _seen(x, y, (px, py, pz - lens.offset.thickness), normals(screen, a, b)).sum()
    return min(1.0, float(taken / given)) if given > 0 else None


def _area(half: tuple[float, float], round: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """Even points of a rectangle or an ellipse, and the area of each."""
    x, y = (h * ((np.arange(POINTS) + 0.5) * (2.0 / POINTS) - 1.0) for h in half)
    x, y = (c.ravel() for c in np.meshgrid(x, y, indexing="ij"))
    area = 4.0 * half[0] * half[1]
    if round:
        inside = (x / half[0]) ** 2 + (y / half[1]) ** 2 <= 1.0
        x, y, area = x[inside], y[inside], area * math.pi / 4.0
    return x, y, area / len(x)


def _seen(x: np.ndarray, y: np.ndarray, point: tuple, normal: tuple = (0.0, 0.0, 1.0)) -> np.ndarray:
    """cos cos / r^2 between points (x, y, 0) of the lens' plane and points of a surface with these normals, (len(x), points); a
    normal's length is the area that its point stands for."""
    dx, dy, dz = point[0] - x[:, None], point[1] - y[:, None], point[2]
    r2 = dx * dx + dy * dy + dz * dz
    return np.abs(dz) * np.abs(normal[0] * dx + normal[1] * dy + normal[2] * dz) / (r2 * r2)
