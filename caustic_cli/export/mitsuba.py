"""Scene description for Mitsuba 3: `NAME.xml`, to be run as `mitsuba NAME.xml`, with its meshes `NAME-exit.ply`, `NAME-sides.ply`
and `NAME-holder.ply` of a round lens (binary, float64).

    entrance, exit   the lens, smooth `dielectric`; the exit surface is a mesh with its normals at the vertices
    element-1-front  surfaces of other lenses, and mirrors, with black sides and a black frame; behind a mirror the screen and the
                     camera stand on the folded axis
    sides, holder    black: light that leaves through the sides or misses the lens is lost, as in a render
    screen           white and diffuse; a camera between lens and screen, whose image is flipped to the view from its +z
    light            a plane wave as a collimated area, square to the wave, points as spots, a disc as a Lambertian area

A mirror is its surface alone, a perfect `conductor` with a black back; the camera is between it and the screen, and views the side
that the mirror illuminates.

The integrator traces light (`ptracer`), four surfaces deep: entrance, exit, screen, camera.  With radiance L in the image,
pi L times a pixel's area is its power.  Lengths are mm, so radiance is W / (mm^2 sr).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from operator import mul
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from torch import Tensor

from caustic_cli.export import mesh
from caustic_cli.export.bodies import bodies
from caustic_cli.export.lattice import LATTICES, Patch, triangles
from caustic_cli.export.mesh import patches, refuse_open, rim_of, walls
from caustic_cli.export.ply import FACE, write_mesh
from caustic_cli.export.reading import Readings
from caustic_cli.export.supported import EXPORT
from caustic_cli.export.surface import STEPS_PER_SPAN, Sampling
from caustic_cli.export.text import CREATED, real
from caustic_cli.io.files import write_bytes
from caustic_cli.optics.obstruction import refuse_obstructed
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.scene import Aperture, CircularAperture, Lens, Scene, Screen
from caustic_cli.scene.elements import surface_name
from caustic_cli.scene.screen import tilted

#: Samples per pixel of the scene, Mitsuba's `spp`.
SAMPLES = 256
#: Distance of the collimated emitter before the entrance, mm; width of the holder over that of the lens.
BEFORE, WIDE = 1.0, 50.0
DEPTH = 4
#: Vertices around the holder of a round lens.
RING = 1024
#: Bytes per point with its normal and two triangles.
A_POINT = 6 * 8 + 2 * FACE.itemsize
#: Points along an axis of a mesh that Mitsuba loads in seconds.
QUICK = 2048
#: Width of the black frame around other elements, over their own.
FRAME = 1.5
#: Rotation that turns rectangles towards -z; a perfect absorber.
SPIN = '<rotate x="1" angle="180"/>'
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
MIRRORED = f'<bsdf type="twosided"><bsdf type="conductor"><string name="material" value="none"/></bsdf>{BLACK}</bsdf>'


class _Flat(NamedTuple):
    """What the outline of a flat entrance decides: its shape, the black holder around it, and the holder's mesh files."""

    shape: str
    holder: Callable[[Path, Lens], list[str]]
    files: tuple[str, ...] = ()


def beside(path: str | Path, name: str) -> Path:
    """The mesh file of a part of a scene."""
    return Path(path).with_name(f"{Path(path).stem}-{name}.ply")


def companions(path: str | Path, scene: Scene) -> list[Path]:
    """Mesh files of a scene: exit surface, sides, holder of a round lens, free-form entrance; or mirror; and surfaces of other
    elements with their black parts."""
    names = [*_OPTICS[scene.lens.kind][0](scene)]
    for k, element in enumerate(scene.elements):
        names += [surface_name(k, side) for side in element.sides] + [f"element-{k + 1}-black"]
    return [beside(path, name) for name in names]


def write_mitsuba(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: Sampling | None = None,
    tolerance: float | None = None,
    dark: bool = False,
) -> None:
    """Write the meshes and then the scene.

    Arguments as in `closed_mesh`; `dark`: without an emitter.

    Raises:
        InputError: as `closed_mesh`; a source without an equivalent emitter; something obstructs the light of a near source, whose
            emitter stands where the source does, on its way to a mirror; or the files cannot be written.
    """
    light = [] if dark else _light(scene)
    sides = patches(scene.lens, field, heights, samples, tolerance)
    lines = [*_OPTICS[scene.lens.kind][1](Path(path), scene, sides, light), "</scene>", ""]
    write_bytes(path, "\n".join(lines).encode())


def _lens_files(scene: Scene) -> list[str]:
    """Names of the meshes of a lens."""
    return ["exit", "sides", *_FLATS[scene.lens.aperture].files] + ["entrance"] * scene.two_sided


def _lens(path: Path, scene: Scene, sides: tuple[Patch, ...], light: list[str]) -> list[str]:
    """The scene of a lens with these free-form sides, after writing its meshes."""
    lens, (*fronts, surface) = scene.lens, sides
    glass, onto, flat = dielectric(lens.index), _onto(scene), _FLATS[lens.aperture]
    points, normals = (a.reshape(-1, 3) for a in (surface.points, surface.normals))
    rim = points[rim_of(*surface.points.shape[:2])]
    if fronts:
        low, entrance = _free_entrance(path, fronts[0], glass)
    else:
        refuse_open(float(surface.points[..., 2].min()), lens.z_in)
        low, entrance = rim * [1.0, 1.0, 0.0] + [0.0, 0.0, lens.z_in], _flat_entrance(lens, flat.shape, glass)
    write_mesh(beside(path, "exit"), points, triangles(surface.points), normals)
    write_mesh(beside(path, "sides"), *_strip(rim, low))
    before = max(float(points[:, 2].max()), *(e.extent[1] for e in scene.behind), -math.inf)
    return [
        *camera(scene.screen, _facing(scene), before, onto, len(System.of(scene).elements) + 2),
        *entrance,
        f'<shape type="ply" id="exit">{file_of(path, "exit")}{glass}</shape>',
        f'<shape type="ply" id="sides">{file_of(path, "sides")}<boolean name="face_normals" value="true"/>{BLACK}</shape>',
        *flat.holder(path, lens),
        *_others(path, scene),
        *screen_shape(scene.screen, _facing(scene), onto),
        *light,
    ]


def _flat_entrance(lens: Lens, shape: str, glass: str) -> list[str]:
    """A flat entrance."""
    rx, ry = lens.half_size
    place = f'<transform name="to_world">{SPIN}<scale x="{real(rx)}" y="{real(ry)}"/><translate z="{real(lens.z_in)}"/></transform>'
    return [f'<shape type="{shape}" id="entrance">', f"  {glass}", f"  {place}", "</shape>"]


def _free_entrance(path: Path, front: Patch, glass: str) -> tuple[np.ndarray, list[str]]:
    """Border points (k, 3) mm of a free-form entrance, and its shape, after writing its mesh."""
    points = front.points.reshape(-1, 3)
    write_mesh(beside(path, "entrance"), points, triangles(front.points)[:, ::-1], -front.normals.reshape(-1, 3))
    shape = [f'<shape type="ply" id="entrance">{file_of(path, "entrance")}{glass}</shape>']
    return points[rim_of(*front.points.shape[:2])], shape


def file_of(path: Path, name: str) -> str:
    """Reference to the mesh of a part."""
    return f'<string name="filename" value={quoteattr(beside(path, name).name)}/>'


#: Densities of files of at most `limit` bytes in all, the smallest first.
choices = partial(mesh.choices, a_point=A_POINT)


def readings(
    scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None, tolerance: float | None = None
) -> Readings:
    """The exit as Mitsuba interpolates it: flat facets with the normals of the vertices."""
    exit = patches(scene.lens, field, heights, samples, tolerance)[-1]
    return {"error": lambda: LATTICES[scene.lens.aperture].facets(exit.points, exit.normals)}


def _others(path: Path, scene: Scene) -> list[str]:
    """Shapes of other lenses and mirrors: their surfaces, black sides, and a black frame around each, which stops light beside
    it."""
    lines = []
    for body in bodies(scene):
        sides = patches(body.lens, body.field, body.heights)
        black = f"element-{body.number + 1}-black"
        rims = [p.points.reshape(-1, 3)[rim_of(*p.points.shape[:2])] for p in sides]
        outer = rims[0] * [FRAME, FRAME, 1.0]
        frame, around = _strip(outer, rims[0])
        across, down = _strip(rims[1], rims[0])
        write_mesh(beside(path, black), body.placed(np.concatenate([frame, across])), np.concatenate([around, down + len(frame)]))
        coating = _COATINGS[body.component.kind](body.component.index)
        for side, seen in zip(body.component.sides, sides, strict=False):
            name = surface_name(body.number, side)
            faces, normals = triangles(seen.points), seen.normals.reshape(-1, 3)
            if side == "front":  # normals out of the glass, or towards the light
                faces, normals = faces[:, ::-1], -normals
            write_mesh(beside(path, name), body.placed(seen.points.reshape(-1, 3)), faces, body.turned(normals))
            lines.append(f'<shape type="ply" id="{name}">{file_of(path, name)}{coating}</shape>')
        lines.append(
            f'<shape type="ply">{file_of(path, black)}'
            f'<boolean name="face_normals" value="true"/><bsdf type="twosided">{BLACK}</bsdf></shape>'
        )
    return lines


def dielectric(index: float) -> str:
    return f'<bsdf type="dielectric"><float name="int_ior" value="{real(index)}"/><float name="ext_ior" value="1"/></bsdf>'


def _mirror(path: Path, scene: Scene, sides: tuple[Patch, ...], light: list[str]) -> list[str]:
    """The scene of a mirror with this surface, after writing its mesh.

    Raises:
        InputError: something obstructs the light of a near source.
    """
    lens, surface = scene.lens, sides[-1]
    if not scene.source.collimated:
        refuse_obstructed(scene, designed=True)
    points, normals = (a.reshape(-1, 3) for a in (surface.points, surface.normals))
    write_mesh(beside(path, "mirror"), points, triangles(surface.points)[:, ::-1], -normals)  # towards the light
    before = min(float(points[:, 2].min()), lens.z_in) - BEFORE
    return [
        *camera(scene.screen, _facing(scene), before),
        f'<shape type="ply" id="mirror">{file_of(path, "mirror")}{MIRRORED}</shape>',
        *screen_shape(scene.screen, _facing(scene)),
        *(line.replace("</shape>", '<bsdf type="null"/></shape>') for line in light),
    ]


def _onto(scene: Scene) -> str:
    """Transformation to the leg of a folded axis with the screen; empty for a straight axis."""
    leg = System.of(scene).leg
    if leg is None:
        return ""
    rows = [[*(axis[k] for axis in leg.frame), leg.origin[k]] for k in range(3)]
    return f'<matrix value="{" ".join(real(v) for row in (*rows, (0.0, 0.0, 0.0, 1.0)) for v in row)}"/>'


def _facing(scene: Scene) -> bool:
    """Whether the normal of the screen is along its light, not against it."""
    return sum(map(mul, scene.undeviated, scene.screen.axes[2])) > 0


def camera(screen: Screen, facing: bool, before: float, onto: str = "", depth: int = DEPTH) -> list[str]:
    """First lines of the scene: integrator, and a camera on the normal of the screen, on the side of the light, whose image the
    screen fills; facing: whether that normal is along the light; before: z of the axis from which its plane is away; onto:
    transformation to a folded axis."""
    (sx, sy), (x, y, z) = screen.half_size, screen.centre
    away = 0.9 * abs(sum(map(mul, (x, y, z - before), screen.axes[2])))
    seen = f'<scale x="-1"/><translate z="{real(-away)}"/>'
    if not facing:
        seen = f'<rotate y="1" angle="180"/><translate z="{real(away)}"/>'
    width, height = screen.resolution[0], max(1, round(screen.resolution[0] * sy / sx))
    return [
        f"<!-- {CREATED}; millimetres -->",
        '<scene version="3.0.0">',
        f'<integrator type="ptracer"><integer name="max_depth" value="{depth}"/></integrator>',
        '<sensor type="perspective">',
        '  <string name="fov_axis" value="x"/>',
        f'  <float name="fov" value="{real(2.0 * math.degrees(math.atan2(sx, away)))}"/>',
        f'  <float name="near_clip" value="{real(0.5 * away)}"/><float name="far_clip" value="{real(2.0 * away)}"/>',
        f'  <transform name="to_world">{seen}{_stood(screen)}{onto}</transform>',
        f'  <sampler type="independent"><integer name="sample_count" value="{SAMPLES}"/></sampler>',
        f'  <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/>',
        '    <string name="pixel_format" value="luminance"/><rfilter type="box"/></film>',
        "</sensor>",
    ]


def screen_shape(screen: Screen, facing: bool, onto: str = "") -> list[str]:
    """White rectangle that faces its light; facing, onto: as of `camera`."""
    (sx, sy), spin = screen.half_size, SPIN if facing else ""
    return [
        '<shape type="rectangle" id="screen">',
        '  <bsdf type="diffuse"><rgb name="reflectance" value="1"/></bsdf>',
        f'  <transform name="to_world">{spin}<scale x="{real(sx)}" y="{real(sy)}"/>{_stood(screen)}{onto}</transform>',
        "</shape>",
    ]


def _turns(tilt: Sequence[float]) -> str:
    """The rotations of `scene.screen.tilted` in their order."""
    turns = [*zip("z", tilt[2:], strict=False), *zip("xy", tilt, strict=False)]
    return "".join(f'<rotate {axis}="1" angle="{real(angle)}"/>' for axis, angle in turns if angle)


def _stood(screen: Screen) -> str:
    """Transformation of a screen in the plane z = 0 to its place: tilted about its centre, and moved."""
    shift = "".join(f' {axis}="{real(c)}"' for axis, c in zip("xy", screen.shift, strict=True) if c)
    return f'{_turns(screen.tilt)}<translate{shift} z="{real(screen.z)}"/>'


def quick_samples(field: HeightField) -> tuple[int, int]:
    """Samples along x and y for a mesh that loads quickly: STEPS_PER_SPAN steps per knot span, or as many as `QUICK` allows."""
    spans = [len(s.breaks) - 1 for s in field.spaces]
    return tuple(min(STEPS_PER_SPAN, max(1, QUICK // k)) * k + 1 for k in spans)


def _strip(top: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strip between two loops (k, 3), counter-clockwise from +z: vertices, and triangles oriented outwards."""
    return np.concatenate([top, low]), walls(np.arange(len(top)), len(top) + np.arange(len(low)))


def _holder(_path: Path, lens: Lens) -> list[str]:
    """Four black rectangles around the entrance."""
    (rx, ry), wide, lines = lens.half_size, WIDE * max(lens.half_size), []
    for cx, cy, hx, hy in (
        (-(rx + wide) / 2, 0, (wide - rx) / 2, wide),
        ((rx + wide) / 2, 0, (wide - rx) / 2, wide),
        (0, -(ry + wide) / 2, rx, (wide - ry) / 2),
        (0, (ry + wide) / 2, rx, (wide - ry) / 2),
    ):
        lines += [
            f'<shape type="rectangle">{BLACK}',
            f'  <transform name="to_world"><scale x="{real(hx)}" y="{real(hy)}"/>'
            f'<translate x="{real(cx)}" y="{real(cy)}" z="{real(lens.z_in)}"/></transform>',
            "</shape>",
        ]
    return lines


def _round_holder(path: Path, lens: Lens) -> list[str]:
    """A black annulus around the entrance, as a mesh of rings of growing width, since single precision misses thin triangles."""
    angle, radius = np.linspace(0.0, 2.0 * np.pi, RING, endpoint=False), lens.half_size[0]
    inner = np.stack([np.cos(angle), np.sin(angle), np.full_like(angle, lens.z_in)], -1) * [radius, radius, 1.0]
    inner[:, :2] /= math.cos(math.pi / RING)  # polygon circumscribed about the circle
    widths = [1.0, 1.05, 1.25, 2.0, 6.0, WIDE]
    parts = [_strip(inner * [a, a, 1.0], inner * [b, b, 1.0]) for a, b in itertools.pairwise(widths)]
    faces = np.concatenate([f + k * 2 * RING for k, (_, f) in enumerate(parts)])
    write_mesh(beside(path, "holder"), np.concatenate([v for v, _ in parts]), faces)
    return [f'<shape type="ply" id="holder">{file_of(path, "holder")}{BLACK}</shape>']


#: Flat entrances by the name of the aperture.
_FLATS = {Aperture.name: _Flat("rectangle", _holder), CircularAperture.name: _Flat("disk", _round_holder, ("holder",))}
#: By the kind of the lens: names of its meshes and its scene; by the kind of an element: what covers its surfaces.
_OPTICS = {"lens": (_lens_files, _lens), "mirror": (lambda _scene: ["mirror"], _mirror)}
_COATINGS = {"lens": dielectric, "mirror": lambda _index: MIRRORED}


def _light(scene: Scene) -> list[str]:
    """The emitters of the source.

    Raises:
        InputError: Mitsuba has no equivalent emitter.
    """
    EXPORT["mitsuba"].refuse(scene, format="mitsuba")
    return _EMITTERS[scene.source.kind](scene)


def _collimated(scene: Scene) -> list[str]:
    """Collimated emitter of a plane wave, as wide as the lens; of a tilted one the rectangle around the beam through the aperture,
    at right angles to it, of which the holder stops the rest."""
    source, pupil = scene.source, scene.pupil
    half, axes, shape = pupil.half_size, tilted(source.tilt), _FLATS[pupil.aperture.name].shape
    back = scene.lowest - BEFORE - pupil.z
    if source.oblique:
        shape = _FLATS[Aperture.name].shape
        half = tuple(sum(r * abs(c) for r, c in zip(pupil.half_size, axis, strict=False)) for axis in axes[:2])
        back -= sum(h * abs(axis[2]) for h, axis in zip(half, axes, strict=False))
    x, y, z = (c * back / axes[2][2] for c in axes[2])
    radiance = source.power / (pupil.aperture.area * axes[2][2])
    return [
        f'<shape type="{shape}" id="light">',
        f'  <transform name="to_world"><scale x="{real(half[0])}" y="{real(half[1])}"/>{_turns(source.tilt)}'
        f'<translate x="{real(x)}" y="{real(y)}" z="{real(z + pupil.z)}"/></transform>',
        f'  <emitter type="directionalarea"><rgb name="radiance" value="{real(radiance)}"/></emitter>',
        "</shape>",
    ]


def _area(scene: Scene) -> list[str]:
    """Lambertian area emitter of a disc."""
    source, pupil = scene.source, scene.pupil
    (wx, wy), (x, y, z), cone = source.size, source.position, source.cone_over(pupil)
    radiance = source.power / (
        math.pi * math.pi * wx * wy / 4.0 * math.sin(cone) ** 2
    )  # the power is that within the cone that covers the lens
    return [
        '<shape type="disk" id="light">',
        f'  <transform name="to_world"><scale x="{real(wx / 2)}" y="{real(wy / 2)}"/>'
        f'<translate x="{real(x)}" y="{real(y)}" z="{real(z)}"/></transform>',
        f'  <emitter type="area"><rgb name="radiance" value="{real(radiance)}"/></emitter>',
        "</shape>",
    ]


def _spots(scene: Scene) -> list[str]:
    """A spot emitter per point; its falloff begins beyond the cone."""
    source, pupil = scene.source, scene.pupil
    cone = source.cone_over(pupil)
    lines, degrees = [], math.degrees(cone)
    for (x, y, z), power in zip(source.positions, source.powers, strict=True):
        intensity = power / (4.0 * math.pi * math.sin(cone / 2.0) ** 2)
        lines += [
            '<emitter type="spot">',
            f'  <transform name="to_world"><translate x="{real(x)}" y="{real(y)}" z="{real(z)}"/></transform>',
            f'  <rgb name="intensity" value="{real(intensity)}"/><float name="beam_width" value="{real(degrees)}"/>'
            f'<float name="cutoff_angle" value="{real(degrees * (1.0 + 1e-4))}"/></emitter>',
        ]
    return lines


#: Emitters of a source, by its kind.
_EMITTERS = {"plane": _collimated, "point": _spots, "grid": _spots, "disc": _area}
