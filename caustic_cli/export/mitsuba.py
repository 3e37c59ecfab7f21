"""Scene description for Mitsuba 3: `NAME.xml`, to be run as `mitsuba NAME.xml`, with its meshes `NAME-exit.ply`, `NAME-sides.ply`
and `NAME-holder.ply` of a round lens (binary, float64).

    entrance, exit   the lens, `dielectric` or `roughdielectric`; the exit surface is a mesh with its normals at the vertices
    element-1-front  surfaces of other lenses, and mirrors, with black sides and a black frame; behind a mirror the screen and the
                     camera stand on the folded axis
    sides, holder    black: light that leaves through the sides or misses the lens is lost, as in a render
    mask             black, of round lenslets: what is between them, closely above the exit
    screen           white and diffuse; a camera between lens and screen, whose image is flipped to the view from its +z
    light            a plane wave as a collimated area, square to the wave, points as spots, a disc as a Lambertian area; with a
                     picture `NAME-light.pfm` where it is uneven

A mirror is its surface alone, a perfect `conductor` with a black back; the camera is between it and the screen, and views the side
that the mirror illuminates.

Light of several indices, and several sources, have a scene each, `NAME.xml`, `NAME-2.xml` and so on, whose images are added.  The
integrator traces light (`ptracer`), four surfaces deep: entrance, exit, screen, camera.  With radiance L in the image, pi L times a
pixel's area is its power; the view of a curved screen is in perspective.  Lengths are mm, so radiance is W / (mm^2 sr).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from caustic_cli.export import mesh
from caustic_cli.export.bodies import bodies
from caustic_cli.export.lattice import LATTICES, Patch, triangles
from caustic_cli.export.mesh import patches, refuse_open, rim_of, walls
from caustic_cli.export.mitsuba_light import BEFORE, SHAPES, light_files, lights
from caustic_cli.export.mitsuba_parts import BLACK, MIRRORED, Meshes, beside, dielectric
from caustic_cli.export.mitsuba_screen import DEPTH, SPIN, camera_of, screen_files, screen_of
from caustic_cli.export.ply import FACE
from caustic_cli.export.reading import Readings
from caustic_cli.export.surface import STEPS_PER_SPAN, Sampling
from caustic_cli.export.text import real
from caustic_cli.io.files import write_bytes
from caustic_cli.optics.obstruction import refuse_obstructed
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.scene import Aperture, Band, CircularAperture, Lens, Scene
from caustic_cli.scene.elements import surface_name

#: Width of the holder over that of the lens.
WIDE = 50.0
#: Vertices around the holder of a round lens, and around a round lenslet; rings of a mask, and its distance from the exit over the
#: extent of the lens: well above the step by which Mitsuba continues rays in single precision.
RING, AROUND, RINGS, ABOVE = 1024, 256, 9, 1e-3
#: Bytes per point with its normal and two triangles.
A_POINT = 6 * 8 + 2 * FACE.itemsize
#: Points along an axis of a mesh that Mitsuba loads in seconds.
QUICK = 2048
#: Width of the black frame around other elements, over their own.
FRAME = 1.5


class _Flat(NamedTuple):
    """What the outline of a flat entrance decides: the black holder around it, and the holder's mesh files."""

    holder: Callable[[Meshes, Lens], list[str]]
    files: tuple[str, ...] = ()


def companions(path: str | Path, scene: Scene) -> list[Path]:
    """Files beside the first scene: meshes of exit surface, sides, holder of a round lens, free-form entrance; or mirror; surfaces
    of other elements with their black parts; a screen that is not plane; further scenes; and the pictures of uneven light."""
    names = [*_OPTICS[scene.lens.kind][0](scene), *screen_files(scene)]
    for k, element in enumerate(scene.elements):
        names += [surface_name(k, side) for side in element.sides] + [f"element-{k + 1}-black"]
    each = _scenes(Path(path), scene)
    pictures = [beside(file, name, ".pfm") for file, band in each for name in light_files(band.scene)]
    return [*(beside(path, name) for name in names), *(file for file, _ in each[1:]), *pictures]


def _scenes(path: Path, scene: Scene) -> list[tuple[Path, Band]]:
    """The files of scenes, one for each separate trace."""
    return [(path if k == 1 else path.with_name(f"{path.stem}-{k}{path.suffix}"), band) for k, band in enumerate(scene.bands, 1)]


def write_mitsuba(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: Sampling | None = None,
    tolerance: float | None = None,
    dark: bool = False,
) -> None:
    """Write the meshes and then the scenes.

    Arguments as in `closed_mesh`; `dark`: without an emitter.

    Raises:
        InputError: as `closed_mesh`; a source without an equivalent emitter; something obstructs the light of a near source, whose
            emitter stands where the source does, on its way to a mirror; or the files cannot be written.
    """
    each, power = _scenes(Path(path), scene), scene.source.power
    light = [[] if dark else lights(file, b.scene, b.weight * power / b.scene.source.power) for file, b in each]
    sides, meshes = patches(scene.lens, field, heights, samples, tolerance), Meshes(Path(path))
    for (file, band), emitters in zip(each, light, strict=True):
        parts = [*_OPTICS[scene.lens.kind][1](meshes, band.scene, sides, emitters), *_mask(meshes, scene.lens, field, heights)]
        write_bytes(file, "\n".join([*parts, "</scene>", ""]).encode())


def _lens_files(scene: Scene) -> list[str]:
    """Names of the meshes of a lens."""
    lens = scene.lens
    return ["exit", "sides", *_FLATS[lens.aperture].files, *["entrance"] * scene.two_sided, *["mask"] * lens.round_lenslets]


def _lens(meshes: Meshes, scene: Scene, sides: tuple[Patch, ...], light: list[str]) -> list[str]:
    """The scene of a lens with these free-form sides, after writing its meshes."""
    lens, (*fronts, surface) = scene.lens, sides
    glass, flat = dielectric(lens.index), _FLATS[lens.aperture]
    points, normals = (a.reshape(-1, 3) for a in (surface.points, surface.normals))
    rim = points[rim_of(*surface.points.shape[:2])]
    if fronts:
        low, entrance = _free_entrance(meshes, fronts[0], glass)
    else:
        refuse_open(float(surface.points[..., 2].min()), lens.z_in)
        low, entrance = rim * [1.0, 1.0, 0.0] + [0.0, 0.0, lens.z_in], _flat_entrance(lens, SHAPES[lens.aperture], glass)
    exit = meshes.write("exit", points, triangles(surface.points), normals)
    around = meshes.write("sides", *_strip(rim, low))
    before = max(float(points[:, 2].max()), *(e.extent[1] for e in scene.behind), -math.inf)
    return [
        *camera_of(scene, before, len(System.of(scene).elements) + 2),
        *entrance,
        f'<shape type="ply" id="exit">{exit}{dielectric(lens.index, lens.roughness)}</shape>',
        f'<shape type="ply" id="sides">{around}<boolean name="face_normals" value="true"/>{BLACK}</shape>',
        *flat.holder(meshes, lens),
        *_others(meshes, scene),
        *screen_of(meshes, scene),
        *light,
    ]


def _mask(meshes: Meshes, lens: Lens, field: HeightField, heights: Tensor) -> list[str]:
    """What is opaque between round lenslets: rings from each of its circle, of the same area as a polygon, to its cell, closely
    behind the surface."""
    if not lens.round_lenslets:
        return []
    cells, turn = lens.cells, 2.0 * math.pi / AROUND
    radius = cells.radius * math.sqrt(turn / math.sin(turn))
    points, faces = [], []
    for k, (x, y) in enumerate(cells.centres):
        corners = np.array(cells.outline(k)) - [x, y]
        angles = np.arctan2(corners[:, 1], corners[:, 0]) % (2.0 * math.pi)
        angle = np.unique(np.concatenate([turn * np.arange(AROUND), angles]))
        far = np.maximum(_reach(corners, angle), radius)
        for share in np.linspace(0.0, 1.0, RINGS):
            r = radius + share * (far - radius)
            points.append(np.stack([x + r * np.cos(angle), y + r * np.sin(angle)], -1))
        first = sum(map(len, points[:-RINGS]))
        loops = [first + len(angle) * ring + np.arange(len(angle)) for ring in range(RINGS)]
        faces += [walls(outer, inner) for inner, outer in itertools.pairwise(loops)]
    at = np.concatenate(points)
    inside = (np.clip(c, -h, h) for c, h in zip(at.T, lens.half_size, strict=True))
    z = field.at(heights.double(), *(torch.from_numpy(c) for c in inside), ((0, 0),))[0].numpy()
    above = lens.interaction.side * ABOVE * max(1.0, lens.opening.reach, float(np.abs(z).max()))
    file = meshes.write("mask", np.column_stack([at, z + above]), np.concatenate(faces))
    return [f'<shape type="ply" id="mask">{file}<bsdf type="twosided">{BLACK}</bsdf></shape>']


def _reach(corners: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Distances from the origin to the sides of a convex polygon around it, (k, 2), at angles (N,), rad."""
    a, b = corners, np.roll(corners, -1, axis=0)
    normal = np.stack([b[:, 1] - a[:, 1], a[:, 0] - b[:, 0]], -1)
    along = normal @ np.stack([np.cos(angle), np.sin(angle)])
    with np.errstate(divide="ignore"):
        return np.where(along > 0, (normal * a).sum(-1)[:, None] / along, math.inf).min(0)


def _flat_entrance(lens: Lens, shape: str, glass: str) -> list[str]:
    """A flat entrance."""
    rx, ry = lens.half_size
    place = f'<transform name="to_world">{SPIN}<scale x="{real(rx)}" y="{real(ry)}"/><translate z="{real(lens.z_in)}"/></transform>'
    return [f'<shape type="{shape}" id="entrance">', f"  {glass}", f"  {place}", "</shape>"]


def _free_entrance(meshes: Meshes, front: Patch, glass: str) -> tuple[np.ndarray, list[str]]:
    """Border points (k, 3) mm of a free-form entrance, and its shape, after writing its mesh."""
    points = front.points.reshape(-1, 3)
    file = meshes.write("entrance", points, triangles(front.points)[:, ::-1], -front.normals.reshape(-1, 3))
    shape = [f'<shape type="ply" id="entrance">{file}{glass}</shape>']
    return points[rim_of(*front.points.shape[:2])], shape


#: Densities of files of at most `limit` bytes in all, the smallest first.
choices = partial(mesh.choices, a_point=A_POINT)


def readings(
    scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None, tolerance: float | None = None
) -> Readings:
    """The exit as Mitsuba interpolates it: flat facets with the normals of the vertices."""
    exit = patches(scene.lens, field, heights, samples, tolerance)[-1]
    return {"error": lambda: LATTICES[scene.lens.aperture].facets(exit.points, exit.normals)}


def _others(meshes: Meshes, scene: Scene) -> list[str]:
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
        body_black = body.placed(np.concatenate([frame, across])), np.concatenate([around, down + len(frame)])
        coating = _COATINGS[body.component.kind](body.component.index)
        for side, seen in zip(body.component.sides, sides, strict=False):
            name = surface_name(body.number, side)
            faces, normals = triangles(seen.points), seen.normals.reshape(-1, 3)
            if side == "front":  # normals out of the glass, or towards the light
                faces, normals = faces[:, ::-1], -normals
            file = meshes.write(name, body.placed(seen.points.reshape(-1, 3)), faces, body.turned(normals))
            lines.append(f'<shape type="ply" id="{name}">{file}{coating}</shape>')
        lines.append(
            f'<shape type="ply">{meshes.write(black, *body_black)}'
            f'<boolean name="face_normals" value="true"/><bsdf type="twosided">{BLACK}</bsdf></shape>'
        )
    return lines


def _mirror(meshes: Meshes, scene: Scene, sides: tuple[Patch, ...], light: list[str]) -> list[str]:
    """The scene of a mirror with this surface, after writing its mesh.

    Raises:
        InputError: something obstructs the light of a near source.
    """
    lens, surface = scene.lens, sides[-1]
    if not scene.source.collimated:
        refuse_obstructed(scene, designed=True)
    points, normals = (a.reshape(-1, 3) for a in (surface.points, surface.normals))
    file = meshes.write("mirror", points, triangles(surface.points)[:, ::-1], -normals)  # towards the light
    before = min(float(points[:, 2].min()), lens.z_in) - BEFORE
    return [
        *camera_of(scene, before, DEPTH),
        f'<shape type="ply" id="mirror">{file}{MIRRORED}</shape>',
        *screen_of(meshes, scene),
        *(line.replace("</shape>", '<bsdf type="null"/></shape>') for line in light),
    ]


def quick_samples(field: HeightField) -> tuple[int, int]:
    """Samples along x and y for a mesh that loads quickly: STEPS_PER_SPAN steps per knot span, or as many as `QUICK` allows."""
    spans = [len(s.breaks) - 1 for s in field.spaces]
    return tuple(min(STEPS_PER_SPAN, max(1, QUICK // k)) * k + 1 for k in spans)


def _strip(top: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strip between two loops (k, 3), counter-clockwise from +z: vertices, and triangles oriented outwards."""
    return np.concatenate([top, low]), walls(np.arange(len(top)), len(top) + np.arange(len(low)))


def _holder(_meshes: Meshes, lens: Lens) -> list[str]:
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


def _round_holder(meshes: Meshes, lens: Lens) -> list[str]:
    """A black annulus around the entrance, as a mesh of rings of growing width, since single precision misses thin triangles."""
    angle, radius = np.linspace(0.0, 2.0 * np.pi, RING, endpoint=False), lens.half_size[0]
    inner = np.stack([np.cos(angle), np.sin(angle), np.full_like(angle, lens.z_in)], -1) * [radius, radius, 1.0]
    inner[:, :2] /= math.cos(math.pi / RING)  # polygon circumscribed about the circle
    widths = [1.0, 1.05, 1.25, 2.0, 6.0, WIDE]
    parts = [_strip(inner * [a, a, 1.0], inner * [b, b, 1.0]) for a, b in itertools.pairwise(widths)]
    faces = np.concatenate([f + k * 2 * RING for k, (_, f) in enumerate(parts)])
    file = meshes.write("holder", np.concatenate([v for v, _ in parts]), faces)
    return [f'<shape type="ply" id="holder">{file}{BLACK}</shape>']


#: Flat entrances by the name of the aperture.
_FLATS = {Aperture.name: _Flat(_holder), CircularAperture.name: _Flat(_round_holder, ("holder",))}
#: By the kind of the lens: names of its meshes and its scene; by the kind of an element: what covers its surfaces.
_OPTICS = {"lens": (_lens_files, _lens), "mirror": (lambda scene: ["mirror", *["mask"] * scene.lens.round_lenslets], _mirror)}
_COATINGS = {"lens": dielectric, "mirror": lambda _index: MIRRORED}
