"""Scene of a lamp for Mitsuba 3: `NAME.xml`, to be run as `mitsuba NAME.xml`, with its meshes `NAME-inner.ply`, `NAME-outer.ply`
and `NAME-foot.ply` (binary, float64).

    inner, outer   smooth `dielectric`, meshes with their exact normals at the vertices
    foot           black, with the side of a cavity below a flat inner side: light that meets it is lost, as in a render
    light          a Lambertian area of the size of the chip; of a point a disc of POINT times the radius of the inner side
    screen         white and diffuse at the target, or `plane_of` one in the far field; camera and integrator are those of `mitsuba`
"""

from __future__ import annotations

import math
from pathlib import Path

from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.lamp import SAMPLES, lamp_parts
from caustic_cli.export.mitsuba_parts import BLACK, beside, dielectric, file_of
from caustic_cli.export.mitsuba_screen import camera, screen_shape
from caustic_cli.export.ply import write_mesh
from caustic_cli.export.text import real
from caustic_cli.io.files import write_bytes
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene import Screen
from caustic_cli.scene.lamp import Goal, Lamp

#: Names of the meshes; radius of the disc that stands for a point, over that of the inner side.
PARTS, POINT = ("inner", "outer", "foot"), 1e-4
#: Distance of the plane on which the far field is seen, in radii of the lens, and its half width at most, degrees.
DISTANT, WIDE = 1000.0, 70.0
#: Rings and points of meshes for a comparison, so many that their normals turn light by 1e-5 at most.
FINE = (600, 2400)


def plane_of(goal: Goal, radius: float) -> Goal:
    """The target, or the plane on which one in the far field is seen."""
    if not goal.far:
        return goal
    width, height = (2.0 * DISTANT * radius * math.tan(math.radians(min(0.5 * s, WIDE))) for s in goal.angles)
    return Goal((width, height), DISTANT * radius)


def companions(path: Path) -> list[Path]:
    """Mesh files of a scene."""
    return [beside(path, name) for name in PARTS]


def write_lamp_mitsuba(
    path: Path,
    lamp: Lamp,
    goal: Goal,
    field: PolarField,
    values: Tensor,
    pixels: tuple[int, int],
    samples: tuple[int, int] = SAMPLES,
    dark: bool = False,
) -> None:
    """Write the meshes and then the scene; pixels: of the camera; samples: as of `lamp_mesh`; dark: without an emitter.

    Raises:
        InputError: as `lamp_mesh`, or the chip is not Lambertian, as emitters of Mitsuba are.
    """
    if lamp.chip.intensity is not None and not dark:
        raise InputError("⟨format⟩ mitsuba holds chips that obey Lambert's law, and this one has a table or a ray file")
    parts = lamp_parts(lamp, field, values, samples)
    for name, (points, faces, normals) in zip(PARTS, parts, strict=True):
        write_mesh(beside(path, name), points, faces, normals)
    seen = plane_of(goal, lamp.radius)
    screen = Screen(seen.size, seen.distance, pixels, shift=seen.shift)
    smooth = [f'<shape type="ply" id="{name}">{file_of(path, name)}{dielectric(lamp.index)}</shape>' for name in PARTS[:2]]
    lines = [
        *camera(screen, True, float(parts[1][0][:, 2].max())),
        *smooth,
        f'<shape type="ply" id="foot">{file_of(path, "foot")}<boolean name="face_normals" value="true"/>{BLACK}</shape>',
        *screen_shape(screen, True),
        *([] if dark else _chip(lamp)),
        "</scene>",
        "",
    ]
    write_bytes(path, "\n".join(lines).encode())


def _chip(lamp: Lamp) -> list[str]:
    """The emitters, of power 1 together."""
    chip, point = lamp.chip, lamp.chip.shape == "point"
    (x, y), square = (2.0 * POINT * lamp.inner,) * 2 if point else chip.size, chip.shape == "rectangle"
    radiance, lines = 1.0 / (lamp.count * math.pi * x * y * (1.0 if square else math.pi / 4.0)), []
    for k, (left, up) in enumerate(lamp.places):
        move = f'<translate x="{real(left)}" y="{real(up)}"/>' if lamp.count > 1 else ""
        lines += [
            f'<shape type="{"rectangle" if square else "disk"}" id="light{k or ""}">',
            f'  <transform name="to_world"><scale x="{real(x / 2)}" y="{real(y / 2)}"/>{move}</transform>',
            f'  <emitter type="area"><rgb name="radiance" value="{real(radiance)}"/></emitter>',
            "</shape>",
        ]
    return lines
