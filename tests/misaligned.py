"""A lens with errors once more, by brute force: turned and shifted surfaces in the room's own frame, and random rays of its own.

For a plane wave, which is wider than the lens: its rays fall on a rectangle around it, and what misses the lens is gone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from caustic_cli.optics.frames import Pose, rotate_to_global
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, PlacedScreen, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Aperture, Pupil, Scene

#: Part of the lens by which the light reaches beyond it on every side, and how far before the entrance it starts, mm.
BEYOND, BEFORE = 0.05, 2.0


def room(scene: Scene, field: HeightField, e) -> tuple[System, PlacedScreen]:
    """The system and the screen with errors `e` (a Misalignment) in the room's frame."""
    changed = replace(scene, lens=replace(scene.lens, index=scene.lens.index + e.index))
    plain, stand = System.of(changed, field), Pose((*e.lens_shift, scene.lens.z_in), e.lens_tilt)
    down = rotate_to_global(stand, (0.0, 0.0, e.thickness - scene.lens.z_in))
    foot = tuple(a + b for a, b in zip(stand.position, down, strict=True))
    poses = (stand, Pose(foot, e.lens_tilt))
    elements = tuple(replace(element, pose=pose) for element, pose in zip(plain.elements, poses, strict=True))
    half = tuple(2.0 * r for r in scene.lens.half_size)
    lit = Pupil(Aperture((half[0], half[1])), scene.lens.z_in - BEFORE)
    s = scene.screen
    middle = (s.shift[0] + e.screen_shift[0], s.shift[1] + e.screen_shift[1], s.z + e.throw)
    tilt = (s.tilt[0] + e.screen_tilt[0], s.tilt[1] + e.screen_tilt[1])
    return replace(plain, elements=elements, lit=lit), PlacedScreen(
        replace(s, shift=(0.0, 0.0), tilt=(0.0, 0.0)), Pose(middle, tilt)
    )


def image(scene: Scene, field: HeightField, heights: torch.Tensor, e, rays: int, rng: np.random.Generator) -> np.ndarray:
    """Power on the pixels, on any scale, of random rays of a plane wave."""
    system, screen = room(scene, field, e)
    (rx, ry), n = scene.lens.half_size, round(np.sqrt(rays))
    cells = (np.indices((n, n)).reshape(2, -1) + rng.random((2, n * n))) / n
    x, y = ((2.0 * c - 1.0) * (1.0 + BEYOND) * r + d for c, r, d in zip(cells, (rx, ry), e.lens_shift, strict=True))
    direction = rotate_to_global(Pose(tilt=e.source_tilt), (0.0, 0.0, 1.0))
    z = scene.lens.z_in - BEFORE  # so that its middle falls on the lens' middle
    start = tuple(torch.from_numpy(c - BEFORE * d / direction[2]) for c, d in zip((x, y), direction, strict=False))
    power = torch.full((n * n,), 1.0 / (n * n), dtype=torch.float64)
    state = RayState((start[0], start[1], z), tuple(torch.full_like(power, d) for d in direction), power)
    with torch.no_grad():
        landed = Tracer(system, state).land({EXIT: heights}, screen)[0]
    edges = [np.linspace(-h, h, k + 1) for h, k in zip(scene.screen.half_size, scene.screen.resolution, strict=True)]
    return np.histogram2d(landed.origin[0].numpy(), landed.origin[1].numpy(), edges, weights=landed.power.numpy())[0]


def relative_rms(scene: Scene, field: HeightField, heights: torch.Tensor, e, target: np.ndarray, rays: int, rng) -> float:
    """Relative RMS error without the noise of the rays, from two images of half of them."""
    a, b = (i / i.mean() for i in (image(scene, field, heights, e, rays // 2, rng) for _ in range(2)))
    t = target / target.mean()
    return float(np.sqrt(max(0.0, np.mean((a - t) * (b - t)))))


def near_image(scene: Scene, field: HeightField, heights: torch.Tensor, e, intensity, rays: int, rng) -> np.ndarray:
    """Fractions of the power, per unit of axial intensity, on the pixels: random rays of a point source at a finite distance.

    intensity: relative, of the angle to the room's z, rad, and nothing else: the axis is the room's, whatever the lens does.
    """
    system, screen = room(scene, field, e)
    (rx, ry), n = scene.lens.half_size, round(np.sqrt(rays))
    (source,) = scene.source.points()[0]
    at = [p + d for p, d in zip(source, (*e.source_shift, e.source_distance), strict=True)]
    cells = (np.indices((n, n)).reshape(2, -1) + rng.random((2, n * n))) / n
    z = scene.lens.z_in - BEFORE  # a plane of the room that all light of the lens passes
    x, y = ((2.0 * c - 1.0) * (1.0 + 4.0 * BEYOND) * r + d for c, r, d in zip(cells, (rx, ry), e.lens_shift, strict=True))
    area = 4.0 * (1.0 + 4.0 * BEYOND) ** 2 * rx * ry / (n * n)
    dx, dy, h = x - at[0], y - at[1], z - at[2]
    r = np.sqrt(dx * dx + dy * dy + h * h)
    power = torch.from_numpy(intensity(np.arccos(h / r)) * h / r**3 * area)
    direction = tuple(torch.from_numpy(c / r) for c in (dx, dy, np.full_like(x, h)))
    state = RayState((torch.from_numpy(x), torch.from_numpy(y), z), direction, power)
    with torch.no_grad():
        landed = Tracer(system, state).land({EXIT: heights}, screen)[0]
    edges = [np.linspace(-h, h, k + 1) for h, k in zip(scene.screen.half_size, scene.screen.resolution, strict=True)]
    return np.histogram2d(landed.origin[0].numpy(), landed.origin[1].numpy(), edges, weights=landed.power.numpy())[0]
