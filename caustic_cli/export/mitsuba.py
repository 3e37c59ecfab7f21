"""The whole scene for Mitsuba 3: `NAME.xml`, to be run as `mitsuba NAME.xml`, and beside it two meshes, `NAME-exit.ply` and
`NAME-sides.ply` (binary, float64).

    entrance, exit   the lens, smooth `dielectric`; the exit surface is a mesh with its normals at the vertices
    sides, holder    black: what leaves by the sides or goes past the lens is lost, as in a render
    screen           white and diffuse; a camera between lens and screen sees it mirrored back, as from behind
    light            a plane wave as a collimated area, points as spots, a disc as a Lambertian area

The integrator traces light (`ptracer`), four surfaces deep: entrance, exit, screen, camera.  With radiance L in the image,
pi L times a pixel's area is its power.  Lengths are mm, so radiance is W / (mm^2 sr).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.mesh import mesh_grid, refuse_open, rim_of, triangles
from caustic_cli.export.ply import write_mesh
from caustic_cli.export.surface import STEPS_PER_SPAN, SurfaceGrid
from caustic_cli.export.text import CREATED, real
from caustic_cli.files import write_bytes
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.scene import Disc, PlaneWave, Scene
from caustic_cli.scene.plain import beyond_plain
from caustic_cli.scene.source import covering_cone

#: Rays a pixel of the scene's own sampler, Mitsuba's `spp`.
SAMPLES = 256
#: The collimated light starts so far before the entrance, mm, and the holder is so many lens widths wide.
BEFORE, WIDE = 1.0, 50.0
DEPTH = 4
#: Points along an axis of a mesh that Mitsuba loads in seconds.
QUICK = 2048


def companions(path: str | Path) -> tuple[Path, Path]:
    """The meshes beside a scene file: of the exit surface and of the sides."""
    path = Path(path)
    return path.with_name(f"{path.stem}-exit.ply"), path.with_name(f"{path.stem}-sides.ply")


def write_mitsuba(path: str | Path, scene: Scene, field: HeightField, heights: Tensor,
                  samples: tuple[int, int] | None = None, tolerance: float | None = None, dark: bool = False) -> None:
    """Write the meshes and then the scene.  Arguments as of `closed_mesh`; `dark`: without its light, whatever that is.

    Raises:
        InputError: as `closed_mesh`; a light that Mitsuba has no emitter for; or the files cannot be written there.
    """
    light, grid = [] if dark else _light(scene), mesh_grid(field, heights, samples, tolerance)
    refuse_open(float(grid.z.min()), scene.lens.z_in)
    exit_mesh, sides = companions(path)
    write_mesh(exit_mesh, grid.points, triangles(*grid.z.shape), grid.normals, text=False)
    write_mesh(sides, *_walls(grid, scene.lens.z_in), text=False)
    lens, screen, spin = scene.lens, scene.screen, '<rotate x="1" angle="180"/>'  # rectangles look to -z
    glass = f'<bsdf type="dielectric"><float name="int_ior" value="{real(lens.index)}"/><float name="ext_ior" value="1"/></bsdf>'
    black = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
    (rx, ry), (sx, sy) = lens.half_size, screen.half_size
    away = 0.9 * (screen.z - float(grid.z.max()))
    width, height = screen.resolution[0], max(1, round(screen.resolution[0] * sy / sx))
    lines = [
        f"<!-- {CREATED}; millimetres -->", '<scene version="3.0.0">',
        f'<integrator type="ptracer"><integer name="max_depth" value="{DEPTH}"/></integrator>',
        '<sensor type="perspective">', '  <string name="fov_axis" value="x"/>',
        f'  <float name="fov" value="{real(2.0 * math.degrees(math.atan2(sx, away)))}"/>',
        f'  <float name="near_clip" value="{real(0.5 * away)}"/><float name="far_clip" value="{real(2.0 * away)}"/>',
        f'  <transform name="to_world"><scale x="-1"/><translate z="{real(screen.z - away)}"/></transform>',
        f'  <sampler type="independent"><integer name="sample_count" value="{SAMPLES}"/></sampler>',
        f'  <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/>',
        '    <string name="pixel_format" value="luminance"/><rfilter type="box"/></film>', "</sensor>",
        '<shape type="rectangle" id="entrance">', f"  {glass}",
        f'  <transform name="to_world">{spin}<scale x="{real(rx)}" y="{real(ry)}"/>'
        f'<translate z="{real(lens.z_in)}"/></transform>', "</shape>",
        f'<shape type="ply" id="exit"><string name="filename" value="{exit_mesh.name}"/>{glass}</shape>',
        f'<shape type="ply" id="sides"><string name="filename" value="{sides.name}"/>'
        f'<boolean name="face_normals" value="true"/>{black}</shape>',
        *_holder(lens.half_size, lens.z_in, black),
        '<shape type="rectangle" id="screen">', '  <bsdf type="diffuse"><rgb name="reflectance" value="1"/></bsdf>',
        f'  <transform name="to_world">{spin}<scale x="{real(sx)}" y="{real(sy)}"/><translate z="{real(screen.z)}"/></transform>',
        "</shape>", *light, "</scene>", "",
    ]
    write_bytes(path, "\n".join(lines).encode())


def quick_samples(field: HeightField) -> tuple[int, int]:
    """Samples along x and y for a mesh that loads quickly: four steps a knot span, or as many as `QUICK` allows."""
    spans = [len(s.breaks) - 1 for s in field.spaces]
    return tuple(min(STEPS_PER_SPAN, max(1, QUICK // k)) * k + 1 for k in spans)


def _walls(grid: SurfaceGrid, z_in: float) -> tuple[np.ndarray, np.ndarray]:
    """The sides alone: vertices and outward triangles."""
    rim = rim_of(*grid.z.shape)
    top = grid.points[rim]
    feet = top.copy()
    feet[:, 2] = z_in
    high, low = np.arange(len(rim)), len(rim) + np.arange(len(rim))
    next_high, next_low = np.roll(high, -1), np.roll(low, -1)
    return np.concatenate([top, feet]), np.concatenate([np.stack([low, next_low, next_high], -1),
                                                        np.stack([low, next_high, high], -1)])


def _holder(half: tuple[float, float], z: float, black: str) -> list[str]:
    """Four black rectangles around the entrance."""
    (rx, ry), wide, lines = half, WIDE * max(half), []
    for cx, cy, hx, hy in ((-(rx + wide) / 2, 0, (wide - rx) / 2, wide), ((rx + wide) / 2, 0, (wide - rx) / 2, wide),
                           (0, -(ry + wide) / 2, rx, (wide - ry) / 2), (0, (ry + wide) / 2, rx, (wide - ry) / 2)):
        lines += [f'<shape type="rectangle">{black}', f'  <transform name="to_world"><scale x="{real(hx)}" y="{real(hy)}"/>'
                  f'<translate x="{real(cx)}" y="{real(cy)}" z="{real(z)}"/></transform>', "</shape>"]
    return lines


def _light(scene: Scene) -> list[str]:
    """The emitters.

    Raises:
        InputError: Mitsuba has none like this.
    """
    source, lens = scene.source, scene.lens
    if beyond_plain(scene):
        raise InputError(f"--format mitsuba is written for clear lenses and straight screens, not {', '.join(beyond_plain(scene))}")
    if isinstance(source, PlaneWave):
        if source.profile is not None:
            raise InputError("--format mitsuba: its collimated emitter is uniform, so a source with a profile cannot be written")
        (rx, ry), area = lens.half_size, lens.size[0] * lens.size[1]
        radiance = real(source.power / area)
        return ['<shape type="rectangle" id="light">',
                f'  <transform name="to_world"><scale x="{real(rx)}" y="{real(ry)}"/>'
                f'<translate z="{real(lens.z_in - BEFORE)}"/></transform>',
                f'  <emitter type="directionalarea"><rgb name="radiance" value="{radiance}"/></emitter>', "</shape>"]
    cone = covering_cone(source, lens.half_size, lens.z_in)
    if not isinstance(source, Disc):
        return _spots(source, cone)
    if source.angle is not None or source.intensity != "lambertian" or source.cone is not None:
        raise InputError("--format mitsuba: of discs only a Lambertian one without a cone of its own can be written, not one at"
                         " infinity; render --verify mitsuba traces them all")
    (wx, wy), (x, y, z) = source.size, source.position
    radiance = source.power / (math.pi * math.pi * wx * wy / 4.0 * math.sin(cone) ** 2)  # its cone just covers the lens
    return ['<shape type="disk" id="light">',
            f'  <transform name="to_world"><scale x="{real(wx / 2)}" y="{real(wy / 2)}"/>'
            f'<translate x="{real(x)}" y="{real(y)}" z="{real(z)}"/></transform>',
            f'  <emitter type="area"><rgb name="radiance" value="{real(radiance)}"/></emitter>', "</shape>"]


def _spots(source, cone: float) -> list[str]:
    """A spot a point.  Mitsuba's fall off towards their rim, so they are even a little beyond the cone."""
    if source.intensity != "uniform":
        raise InputError("--format mitsuba: its spots shine evenly, so Lambertian points cannot be written")
    lines, degrees = [], math.degrees(cone)
    for (x, y, z), power in zip(source.positions, source.powers, strict=True):
        intensity = power / (4.0 * math.pi * math.sin(cone / 2.0) ** 2)
        lines += ['<emitter type="spot">',
                  f'  <transform name="to_world"><translate x="{real(x)}" y="{real(y)}" z="{real(z)}"/></transform>',
                  f'  <rgb name="intensity" value="{real(intensity)}"/><float name="beam_width" value="{real(degrees)}"/>'
                  f'<float name="cutoff_angle" value="{real(degrees * (1.0 + 1e-4))}"/></emitter>']
    return lines
