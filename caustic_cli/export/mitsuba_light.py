"""Emitters of a scene for Mitsuba 3, by the kind of its source.

Their radiance or intensity varies over a picture where the source's does: of a wave over its aperture, of a disc over its
rectangle, of points over the tangents of the angles to their axis.  A disc that is not Lambertian over all directions is a grid of
points.  A scene of a part of the light, a wavelength or one of several
sources, has the power of this part.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from caustic_cli.export.mitsuba_parts import picture
from caustic_cli.export.mitsuba_screen import turns
from caustic_cli.export.supported import EXPORT
from caustic_cli.export.text import real
from caustic_cli.optics.emission.base import intensity_of
from caustic_cli.scene import Aperture, CircularAperture, Scene, Source
from caustic_cli.scene.screen import tilted
from caustic_cli.scene.sources.base import looked_up

#: Distance of the collimated emitter before the entrance, mm.
BEFORE = 1.0
#: Cells of a picture that is resampled, along an axis; least width of a disc over its greater one.
CELLS, THIN = 1024, 1e-3
#: Points along an axis of a disc that is written as such, and finer points for the power of each.
SIDE, FINER = 16, 8
#: Shapes of light by the aperture that it fills.
SHAPES = {Aperture.name: "rectangle", CircularAperture.name: "disk"}


def lights(path: Path, scene: Scene, part: float = 1.0) -> list[str]:
    """The emitters of a scene's source, with this part of its power, after writing their pictures.

    Raises:
        InputError: Mitsuba has no equivalent emitter.
    """
    EXPORT["mitsuba"].refuse(scene, format="mitsuba")
    return _EMITTERS[scene.source.kind](path, scene, part)


def light_files(scene: Scene) -> list[str]:
    """Names of the pictures of the emitters of a scene."""
    source = scene.source
    if source.distant:
        return ["light"] * source.uneven
    return ["light"] * (source.intensity != "uniform" if _as_points(source) else source.brightness is not None)


def _as_points(source: Source) -> bool:
    """Whether a near source is written as points: also of discs those that are not Lambertian over all directions."""
    return source.kind != "disc" or source.intensity != "lambertian" or source.cone is not None


def _radiance(path: Path, mean: float, relative: np.ndarray | None) -> str:
    """Radiance of an emitter, W / (mm^2 sr), with this mean over its picture's relative values; None for a uniform one."""
    if relative is None:
        return f'<rgb name="radiance" value="{real(mean)}"/>'
    return picture(path, "light", "radiance", mean * relative)


def _collimated(path: Path, scene: Scene, part: float) -> list[str]:
    """Collimated emitter of a plane wave, as wide as the lens; of a tilted one the rectangle around the beam through the aperture,
    at right angles to it, of which the holder stops the rest; and of an uneven one the rectangle around the aperture."""
    source, pupil = scene.source, scene.pupil
    half, axes, shape = pupil.half_size, tilted(source.tilt), SHAPES[pupil.aperture.name]
    back = scene.lowest - BEFORE - pupil.z
    if source.oblique or source.uneven:
        shape = SHAPES[Aperture.name]
    if source.oblique:
        half = tuple(sum(r * abs(c) for r, c in zip(pupil.half_size, axis, strict=False)) for axis in axes[:2])
        back -= sum(h * abs(axis[2]) for h, axis in zip(half, axes, strict=False))
    x, y, z = (c * back / axes[2][2] for c in axes[2])
    radiance = part * source.power / (pupil.aperture.area * axes[2][2])
    relative = _irradiance(scene, half, axes) if source.uneven else None
    return [
        f'<shape type="{shape}" id="light">',
        f'  <transform name="to_world"><scale x="{real(half[0])}" y="{real(half[1])}"/>{turns(source.tilt)}'
        f'<translate x="{real(x)}" y="{real(y)}" z="{real(z + pupil.z)}"/></transform>',
        f'  <emitter type="directionalarea">{_radiance(path, radiance, relative)}</emitter>',
        "</shape>",
    ]


def _disc(path: Path, scene: Scene, part: float) -> list[str]:
    """A disc that is Lambertian over all directions, or another one."""
    return (_spots if _as_points(scene.source) else _area)(path, scene, part)


def _pieces(source: Source) -> tuple[np.ndarray, np.ndarray]:
    """A disc, or its picture, as points over its rectangle, (k, 2) in [-1, 1]^2, and the part of its power of each, (k,)."""
    line = (2.0 * np.arange(SIDE * FINER) + 1.0) / (SIDE * FINER) - 1.0
    u, v = np.meshgrid(line, line, indexing="ij")
    light = (u * u + v * v <= 1.0).astype(float) if source.brightness is None else looked_up(source.brightness, u, v)
    cells = light.reshape(SIDE, FINER, SIDE, FINER).sum((1, 3))
    middles = (2.0 * np.stack(np.nonzero(cells), -1) + 1.0) / SIDE - 1.0
    return middles, cells[cells > 0] / cells.sum()


def _irradiance(scene: Scene, half: tuple[float, ...], axes: tuple) -> np.ndarray:
    """Irradiance relative to its mean over the aperture, at the middles of cells of a rectangle across the light with these half
    widths, (a, b)."""
    source, pupil = scene.source, scene.pupil
    count = (CELLS, CELLS) if source.oblique or source.profile is None else source.profile.shape
    u, v = np.meshgrid(*(h * ((2.0 * np.arange(n) + 1.0) / n - 1.0) for h, n in zip(half, count, strict=True)), indexing="ij")
    across = [u * a + v * b for a, b in zip(*axes[:2], strict=True)]
    x, y = (c - across[2] * a / axes[2][2] for c, a in zip(across[:2], axes[2], strict=False))
    return source.irradiance(x, y, pupil) / source.passed(pupil)


def _area(path: Path, scene: Scene, part: float) -> list[str]:
    """Lambertian area emitter of a disc, or of the rectangle around one whose radiance a picture gives."""
    source, (x, y, z), cone = scene.source, scene.source.position, scene.source.cone_over(scene.pupil)
    wide, high = (max(w, THIN * max(source.size)) for w in source.size)
    pictured = source.brightness is not None
    shape, area = ("rectangle", wide * high) if pictured else ("disk", 0.25 * math.pi * wide * high)
    radiance = part * source.power / (math.pi * area * math.sin(cone) ** 2)  # power within the cone that covers the lens
    relative = source.brightness / source.brightness.mean() if pictured else None
    return [
        f'<shape type="{shape}" id="light">',
        f'  <transform name="to_world"><scale x="{real(wide / 2)}" y="{real(high / 2)}"/>'
        f'<translate x="{real(x)}" y="{real(y)}" z="{real(z)}"/></transform>',
        f'  <emitter type="area">{_radiance(path, radiance, relative)}</emitter>',
        "</shape>",
    ]


def _placed(source: Source) -> tuple[list, list]:
    """Positions of points, mm, and their powers; a disc is a square grid of them."""
    if source.kind != "disc":
        return list(source.positions), list(source.powers)
    middles, parts = _pieces(source)
    (x, y, z), (fx, fy) = source.position, source.frame
    return [(x + fx * u, y + fy * v, z) for u, v in middles.tolist()], (source.power * parts).tolist()


def _spots(path: Path, scene: Scene, part: float) -> list[str]:
    """A spot emitter per point; its falloff begins beyond the cone."""
    source, cone = scene.source, scene.source.cone_over(scene.pupil)
    lines, edge = [], cone * (1.0 + 1e-4)
    mean, texture = 1.0 / (4.0 * math.pi * math.sin(cone / 2.0) ** 2), ""
    if source.intensity != "uniform":
        t = math.tan(edge) * ((2.0 * np.arange(CELLS) + 1.0) / CELLS - 1.0)
        secant = torch.from_numpy(np.sqrt(1.0 + t[:, None] ** 2 + t[None, :] ** 2))
        texture = picture(path, "light", "texture", torch.as_tensor(intensity_of(source, cone, secant)).numpy() / mean, smooth=True)
    for (x, y, z), power in zip(*_placed(source), strict=True):
        lines += [
            '<emitter type="spot">',
            f'  <transform name="to_world"><translate x="{real(x)}" y="{real(y)}" z="{real(z)}"/></transform>',
            f'  <rgb name="intensity" value="{real(part * power * mean)}"/>'
            f'<float name="beam_width" value="{real(math.degrees(cone))}"/>'
            f'<float name="cutoff_angle" value="{real(math.degrees(edge))}"/>{texture}</emitter>',
        ]
    return lines


#: Emitters of a source, by its kind.
_EMITTERS: dict[str, Callable[[Path, Scene, float], list[str]]] = {
    "plane": _collimated,
    "point": _spots,
    "grid": _spots,
    "disc": _disc,
}
