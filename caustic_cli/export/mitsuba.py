"""Scene description for Mitsuba 3: `NAME.xml`, to be run as `mitsuba NAME.xml`, with its meshes `NAME-exit.ply`, `NAME-sides.ply`
and `NAME-holder.ply` of a round lens (binary, float64).

    entrance, exit   the lens, smooth `dielectric`; the exit surface is a mesh with its normals at the vertices
    element-1-front  surfaces of other lenses, and mirrors, with black sides and a black frame; behind a mirror the screen and the
                     camera stand on the folded axis
    sides, holder    black: light that leaves through the sides or misses the lens is lost, as in a render
    screen           white and diffuse; a camera between lens and screen, whose image is flipped to the view from +z
    light            a plane wave as a collimated area, points as spots, a disc as a Lambertian area

A mirror is its surface alone, a perfect `conductor` with a black back; the camera is between it and the screen, and views its +z
side, which the mirror illuminates.

The integrator traces light (`ptracer`), four surfaces deep: entrance, exit, screen, camera.  With radiance L in the image,
pi L times a pixel's area is its power.  Lengths are mm, so radiance is W / (mm^2 sr).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import mesh
from caustic_cli.export.bodies import bodies
from caustic_cli.export.mesh import Patch, both_patches, patches, refuse_open, rim_of, triangles, walls
from caustic_cli.export.ply import FACE, write_mesh
from caustic_cli.export.reading import Readings, of_facets
from caustic_cli.export.surface import STEPS_PER_SPAN, Sampling
from caustic_cli.export.text import CREATED, real
from caustic_cli.io.files import write_bytes
from caustic_cli.optics.obstruction import refuse_obstructed
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.scene import Component, Lens, Scene, Screen
from caustic_cli.scene.elements import surface_name
from caustic_cli.scene.features import special_features

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


def companions(
    path: str | Path, round: bool = True, mirror: bool = False, two_sided: bool = False, elements: Sequence[Component] = ()
) -> list[Path]:
    """Mesh files of a scene: exit surface, sides, holder of a round lens, free-form entrance; or mirror; and surfaces of other
    elements with their black parts."""
    path = Path(path)
    if mirror:
        return [path.with_name(f"{path.stem}-mirror.ply")]
    names = ["exit", "sides"] + ["holder"] * round + ["entrance"] * two_sided
    for k, element in enumerate(elements):
        names += [surface_name(k, side) for side in element.sides] + [f"element-{k + 1}-black"]
    return [path.with_name(f"{path.stem}-{name}.ply") for name in names]


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
        InputError: as `closed_mesh`; a source without an equivalent emitter; or the files cannot be written.
    """
    light = [] if dark else _light(scene)
    *fronts, surface = patches(scene.lens, field, heights, samples, tolerance)
    front = fronts[0] if fronts else None
    if scene.lens.mirror:
        _write_mirror(path, scene, surface, light)
        return
    if front is None:
        refuse_open(float(surface.points[..., 2].min()), scene.lens.z_in)
    exit_mesh, sides = companions(path, False)
    points, normals = (a.reshape(-1, 3) for a in (surface.points, surface.normals))
    write_mesh(exit_mesh, points, triangles(surface.points), normals)
    rim = points[rim_of(*surface.points.shape[:2])]
    low = rim * [1.0, 1.0, 0.0] + [0.0, 0.0, scene.lens.z_in]
    write_mesh(sides, *_strip(rim, low if front is None else front.points.reshape(-1, 3)[rim_of(*front.points.shape[:2])]))
    lens, screen = scene.lens, scene.screen
    glass, onto, surfaces = _glass(lens.index), _onto(scene), len(System.of(scene).elements)
    rx, ry = lens.half_size
    flat, holder = ("disk", _round_holder(path, rx, lens.z_in, BLACK)) if lens.round else ("rectangle", _holder(lens, BLACK))
    away = 0.9 * (screen.z - max(float(points[:, 2].max()), *(e.extent[1] for e in scene.behind), -math.inf))
    place = f'<transform name="to_world">{SPIN}<scale x="{real(rx)}" y="{real(ry)}"/><translate z="{real(lens.z_in)}"/></transform>'
    entrance = [f'<shape type="{flat}" id="entrance">', f"  {glass}", f"  {place}", "</shape>"]
    if front is not None:
        mesh = companions(path, lens.round, two_sided=True)[-1]
        write_mesh(mesh, front.points.reshape(-1, 3), triangles(front.points)[:, ::-1], -front.normals.reshape(-1, 3))
        entrance = [f'<shape type="ply" id="entrance"><string name="filename" value={quoteattr(mesh.name)}/>{glass}</shape>']
    lines = [
        *_camera(screen, away, f'<scale x="-1"/>{_moved(screen, screen.z - away)}{onto}', surfaces + 2),
        *entrance,
        f'<shape type="ply" id="exit"><string name="filename" value={quoteattr(exit_mesh.name)}/>{glass}</shape>',
        f'<shape type="ply" id="sides"><string name="filename" value={quoteattr(sides.name)}/>'
        f'<boolean name="face_normals" value="true"/>{BLACK}</shape>',
        *holder,
        *_others(path, scene),
        *_screen(screen, SPIN, onto),
        *light,
        "</scene>",
        "",
    ]
    write_bytes(path, "\n".join(lines).encode())


def choices(scene: Scene, field: HeightField, heights: Tensor, limit: float) -> list[dict]:
    """Densities of files of at most `limit` bytes in all, the smallest first."""
    return mesh.choices(scene, field, heights, limit, A_POINT)


def readings(
    scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None, tolerance: float | None = None
) -> Readings:
    """The exit as Mitsuba interpolates it: flat facets with the normals of the vertices."""
    exit = patches(scene.lens, field, heights, samples, tolerance)[-1]
    return {"error": lambda: of_facets(exit.points, scene.lens.round, exit.normals)}


def _others(path: str | Path, scene: Scene) -> list[str]:
    """Shapes of other lenses and mirrors: their surfaces, black sides, and a black frame around each, which stops light beside
    it."""
    lines = []
    for body in bodies(scene):
        patches = both_patches(body.lens, body.field, body.heights)
        black = Path(path).with_name(f"{Path(path).stem}-element-{body.number + 1}-black.ply")
        rims = [p.points.reshape(-1, 3)[rim_of(*p.points.shape[:2])] for p in patches]
        outer = rims[0] * [FRAME, FRAME, 1.0]
        frame, around = _strip(outer, rims[0])
        sides, across = _strip(rims[1], rims[0])
        write_mesh(black, body.placed(np.concatenate([frame, sides])), np.concatenate([around, across + len(frame)]))
        coating = _glass(body.component.index)
        if body.component.mirror:
            coating = MIRRORED
        for side, seen in zip(body.component.sides, patches, strict=False):
            name = surface_name(body.number, side)
            mesh = Path(path).with_name(f"{Path(path).stem}-{name}.ply")
            faces, normals = triangles(seen.points), seen.normals.reshape(-1, 3)
            if side == "front":  # normals out of the glass, or towards the light
                faces, normals = faces[:, ::-1], -normals
            write_mesh(mesh, body.placed(seen.points.reshape(-1, 3)), faces, body.turned(normals))
            lines.append(f'<shape type="ply" id="{name}"><string name="filename" value={quoteattr(mesh.name)}/>{coating}</shape>')
        lines.append(
            f'<shape type="ply"><string name="filename" value={quoteattr(black.name)}/>'
            f'<boolean name="face_normals" value="true"/><bsdf type="twosided">{BLACK}</bsdf></shape>'
        )
    return lines


def _glass(index: float) -> str:
    return f'<bsdf type="dielectric"><float name="int_ior" value="{real(index)}"/><float name="ext_ior" value="1"/></bsdf>'


def _write_mirror(path: str | Path, scene: Scene, surface: Patch, light: list[str]) -> None:
    """Write the scene of a mirror.

    Raises:
        InputError: something obstructs the light of a near source, whose emitter stands where the source does.
    """
    screen, lens = scene.screen, scene.lens
    if not scene.source.collimated:
        refuse_obstructed(scene, designed=True)
    (mesh,) = companions(path, False, True)
    points, normals = (a.reshape(-1, 3) for a in (surface.points, surface.normals))
    write_mesh(mesh, points, triangles(surface.points)[:, ::-1], -normals)  # towards the light
    away = 0.9 * (min(float(points[:, 2].min()), lens.z_in) - BEFORE - screen.z)
    lines = [
        *_camera(screen, away, f'<rotate y="1" angle="180"/>{_moved(screen, screen.z + away)}'),
        f'<shape type="ply" id="mirror"><string name="filename" value={quoteattr(mesh.name)}/>{MIRRORED}</shape>',
        *_screen(screen, ""),
        *(line.replace("</shape>", '<bsdf type="null"/></shape>') for line in light),
        "</scene>",
        "",
    ]
    write_bytes(path, "\n".join(lines).encode())


def _onto(scene: Scene) -> str:
    """Transformation to the leg of a folded axis with the screen; empty for a straight axis."""
    leg = System.of(scene).leg
    if leg is None:
        return ""
    rows = [[*(axis[k] for axis in leg.frame), leg.origin[k]] for k in range(3)]
    return f'<matrix value="{" ".join(real(v) for row in (*rows, (0.0, 0.0, 0.0, 1.0)) for v in row)}"/>'


def _camera(screen: Screen, away: float, place: str, depth: int = DEPTH) -> list[str]:
    """First lines of the scene: integrator, and a camera `away` mm from the screen, which fills its image."""
    sx, sy = screen.half_size
    width, height = screen.resolution[0], max(1, round(screen.resolution[0] * sy / sx))
    return [
        f"<!-- {CREATED}; millimetres -->",
        '<scene version="3.0.0">',
        f'<integrator type="ptracer"><integer name="max_depth" value="{depth}"/></integrator>',
        '<sensor type="perspective">',
        '  <string name="fov_axis" value="x"/>',
        f'  <float name="fov" value="{real(2.0 * math.degrees(math.atan2(sx, away)))}"/>',
        f'  <float name="near_clip" value="{real(0.5 * away)}"/><float name="far_clip" value="{real(2.0 * away)}"/>',
        f'  <transform name="to_world">{place}</transform>',
        f'  <sampler type="independent"><integer name="sample_count" value="{SAMPLES}"/></sampler>',
        f'  <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/>',
        '    <string name="pixel_format" value="luminance"/><rfilter type="box"/></film>',
        "</sensor>",
    ]


def _screen(screen: Screen, spin: str, onto: str = "") -> list[str]:
    """White rectangle facing +z, or -z with `spin`; onto: transformation to a folded axis."""
    sx, sy = screen.half_size
    return [
        '<shape type="rectangle" id="screen">',
        '  <bsdf type="diffuse"><rgb name="reflectance" value="1"/></bsdf>',
        f'  <transform name="to_world">{spin}<scale x="{real(sx)}" y="{real(sy)}"/>{_moved(screen, screen.z)}{onto}</transform>',
        "</shape>",
    ]


def _moved(screen: Screen, z: float) -> str:
    """Translation to z on the line through the centre of the screen along its axis."""
    shift = "".join(f' {axis}="{real(c)}"' for axis, c in zip("xy", screen.shift, strict=True) if c)
    return f'<translate{shift} z="{real(z)}"/>'


def quick_samples(field: HeightField) -> tuple[int, int]:
    """Samples along x and y for a mesh that loads quickly: STEPS_PER_SPAN steps per knot span, or as many as `QUICK` allows."""
    spans = [len(s.breaks) - 1 for s in field.spaces]
    return tuple(min(STEPS_PER_SPAN, max(1, QUICK // k)) * k + 1 for k in spans)


def _strip(top: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strip between two loops (k, 3), counter-clockwise from +z: vertices, and triangles oriented outwards."""
    return np.concatenate([top, low]), walls(np.arange(len(top)), len(top) + np.arange(len(low)))


def _holder(lens: Lens, black: str) -> list[str]:
    """Four black rectangles around the entrance."""
    (rx, ry), wide, lines = lens.half_size, WIDE * max(lens.half_size), []
    for cx, cy, hx, hy in (
        (-(rx + wide) / 2, 0, (wide - rx) / 2, wide),
        ((rx + wide) / 2, 0, (wide - rx) / 2, wide),
        (0, -(ry + wide) / 2, rx, (wide - ry) / 2),
        (0, (ry + wide) / 2, rx, (wide - ry) / 2),
    ):
        lines += [
            f'<shape type="rectangle">{black}',
            f'  <transform name="to_world"><scale x="{real(hx)}" y="{real(hy)}"/>'
            f'<translate x="{real(cx)}" y="{real(cy)}" z="{real(lens.z_in)}"/></transform>',
            "</shape>",
        ]
    return lines


def _round_holder(path: str | Path, radius: float, z: float, black: str) -> list[str]:
    """A black annulus around the entrance, as a mesh of rings of growing width, since single precision misses thin triangles."""
    angle = np.linspace(0.0, 2.0 * np.pi, RING, endpoint=False)
    inner = np.stack([np.cos(angle), np.sin(angle), np.full_like(angle, z)], -1) * [radius, radius, 1.0]
    inner[:, :2] /= math.cos(math.pi / RING)  # polygon circumscribed about the circle
    widths = [1.0, 1.05, 1.25, 2.0, 6.0, WIDE]
    parts = [_strip(inner * [a, a, 1.0], inner * [b, b, 1.0]) for a, b in itertools.pairwise(widths)]
    faces = np.concatenate([f + k * 2 * RING for k, (_, f) in enumerate(parts)])
    file = companions(path, True)[2]
    write_mesh(file, np.concatenate([v for v, _ in parts]), faces)
    return [f'<shape type="ply" id="holder"><string name="filename" value={quoteattr(file.name)}/>{black}</shape>']


def _light(scene: Scene) -> list[str]:
    """The emitters of the source.

    Raises:
        InputError: Mitsuba has no equivalent emitter.
    """
    beyond = [name for name in special_features(scene) if name not in ("a mirror", "a shifted screen")]
    if beyond:
        raise InputError(f"⟨format⟩ mitsuba is written for clear lenses and straight screens, not {', '.join(beyond)}")
    if scene.source.kind not in _EMITTERS:
        raise InputError(f"⟨format⟩ mitsuba does not support sources of type {scene.source.kind}")
    return _EMITTERS[scene.source.kind](scene)


def _collimated(scene: Scene) -> list[str]:
    """Collimated emitter of a plane wave, as wide as the lens."""
    source, pupil = scene.source, scene.pupil
    if source.profile is not None:
        raise InputError("⟨format⟩ mitsuba: its collimated emitter is uniform, so a source with a profile cannot be written")
    (rx, ry), area = pupil.half_size, 4.0 * math.prod(pupil.half_size) * (math.pi / 4.0 if pupil.round else 1.0)
    radiance = real(source.power / area)
    return [
        f'<shape type="{"disk" if pupil.round else "rectangle"}" id="light">',
        f'  <transform name="to_world"><scale x="{real(rx)}" y="{real(ry)}"/>'
        f'<translate z="{real(scene.lowest - BEFORE)}"/></transform>',
        f'  <emitter type="directionalarea"><rgb name="radiance" value="{radiance}"/></emitter>',
        "</shape>",
    ]


def _area(scene: Scene) -> list[str]:
    """Lambertian area emitter of a disc."""
    source, pupil = scene.source, scene.pupil
    if source.distant or source.intensity != "lambertian" or source.cone is not None:
        raise InputError(
            "⟨format⟩ mitsuba: of discs only a Lambertian one without a cone of its own can be written, not one at"
            " infinity; render ⟨verify⟩ mitsuba traces them all"
        )
    if source.brightness is not None:
        raise InputError("⟨format⟩ mitsuba: its disc is evenly bright, so one with a picture of its brightness cannot be written")
    if not min(source.size) > 0:
        raise InputError("⟨format⟩ mitsuba: its disc shines by its area, so one without any cannot be written")
    (wx, wy), (x, y, z), cone = source.size, source.position, source.cone_over(pupil.half_size, pupil.z, pupil.round)
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
    if source.intensity != "uniform":
        raise InputError("⟨format⟩ mitsuba: its spots shine evenly, so points of another intensity cannot be written")
    cone = source.cone_over(pupil.half_size, pupil.z, pupil.round)
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
