"""Screen and camera of a scene for Mitsuba 3.

A plane screen is a rectangle; a curved one, and the far field, are meshes with the normals of their vertices.  The far field is a
part of a sphere about the lens, whose radius is so large that light from either edge of the lens lands in the same pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import mul

import numpy as np

from caustic_cli.export.lattice import triangles
from caustic_cli.export.mitsuba_parts import Meshes
from caustic_cli.export.text import CREATED, real
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.system import System
from caustic_cli.scene import Scene, Screen

#: Samples per pixel of the scene, Mitsuba's `spp`.
SAMPLES = 256
DEPTH = 4
#: Rotation that turns rectangles towards -z.
SPIN = '<rotate x="1" angle="180"/>'
WHITE = '<bsdf type="diffuse"><rgb name="reflectance" value="1"/></bsdf>'
#: Part of a pixel by which the extent of the optics displaces light in the far field; vertices of a mesh along an axis, and at
#: most of one of a measured shape.
WITHIN, VERTICES, MOST = 1e-3, 257, 2049


def far_away(scene: Scene) -> float:
    """Radius of the sphere that stands for the far field of a scene, mm."""
    extent = max(scene.lens.opening.reach, *(abs(c) for e in System.of(scene).elements for c in e.pose.position))
    return abs(scene.screen.z) * extent / (WITHIN * min(scene.screen.pixel))


def onto(scene: Scene) -> str:
    """Transformation to the leg of a folded axis with the screen; empty for a straight axis."""
    leg = System.of(scene).leg
    if leg is None:
        return ""
    rows = [[*(axis[k] for axis in leg.frame), leg.origin[k]] for k in range(3)]
    return f'<matrix value="{" ".join(real(v) for row in (*rows, (0.0, 0.0, 0.0, 1.0)) for v in row)}"/>'


def facing(scene: Scene) -> bool:
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


def camera_of(scene: Scene, before: float, depth: int) -> list[str]:
    """The same for the screen of a scene, behind z = before of its axis."""
    return camera(viewed(scene), facing(scene), before, onto(scene), depth)


def viewed(scene: Scene) -> Screen:
    """The plane that a camera views: that of the screen, or where light of the far field arrives."""
    screen = scene.screen
    if not screen.far:
        return screen
    away, focal = far_away(scene), abs(screen.z)
    p, q = (sum(map(mul, screen.centre, axis)) / focal for axis in screen.axes[:2])
    along = math.copysign(math.sqrt(1.0 - p * p - q * q), 1.0 if facing(scene) else -1.0)
    x, y, z = screen.in_space(
        tuple(away * sum(map(mul, (p, q, along), column)) for column in zip(*screen.axes, strict=True))  # type: ignore[arg-type]
    )
    wide, high = (away / focal * s for s in screen.size)
    return replace(screen, far=False, size=(wide, high), shift=(x, y), z=z)


def screen_files(scene: Scene) -> list[str]:
    """Names of the meshes of the screen."""
    return [] if Receiver.of(System.of(scene), scene.screen).shape.flat else ["screen"]


def screen_of(meshes: Meshes, scene: Scene) -> list[str]:
    """The white screen of a scene, which faces its light, after writing its mesh, if it has one."""
    receiver = Receiver.of(System.of(scene), scene.screen)
    if receiver.shape.flat:
        return screen_shape(scene.screen, facing(scene), onto(scene))
    beyond = math.copysign(far_away(scene), receiver.forward) if scene.screen.far else 0.0
    sags, half = scene.screen.sags, scene.screen.half_size
    counts = (VERTICES,) * 2 if sags is None else (min(MOST, max(VERTICES, n)) for n in sags.values.shape)
    x, y = np.meshgrid(*(np.linspace(-h, h, n) for h, n in zip(half, counts, strict=True)), indexing="ij")
    points = receiver.shape.points(x, y, receiver.middle, receiver.axes, beyond)
    along, across = (np.gradient(points, axis=k) for k in (0, 1))
    normals = -receiver.forward * np.cross(along, across)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    faces = triangles(points)
    turned = faces if receiver.forward < 0 else faces[:, ::-1]
    file = meshes.write("screen", points.reshape(-1, 3), turned, normals.reshape(-1, 3))
    return [f'<shape type="ply" id="screen">{file}{WHITE}</shape>']


def screen_shape(screen: Screen, facing: bool, onto: str = "") -> list[str]:
    """White rectangle that faces its light; facing, onto: as of `camera`."""
    (sx, sy), spin = screen.half_size, SPIN if facing else ""
    return [
        '<shape type="rectangle" id="screen">',
        f"  {WHITE}",
        f'  <transform name="to_world">{spin}<scale x="{real(sx)}" y="{real(sy)}"/>{_stood(screen)}{onto}</transform>',
        "</shape>",
    ]


def turns(tilt: Sequence[float]) -> str:
    """The rotations of `scene.screen.tilted` in their order."""
    found = [*zip("z", tilt[2:], strict=False), *zip("xy", tilt, strict=False)]
    return "".join(f'<rotate {axis}="1" angle="{real(angle)}"/>' for axis, angle in found if angle)


def _stood(screen: Screen) -> str:
    """Transformation of a screen in the plane z = 0 to its place: tilted about its centre, and moved."""
    shift = "".join(f' {axis}="{real(c)}"' for axis, c in zip("xy", screen.shift, strict=True) if c)
    return f'{turns(screen.tilt)}<translate{shift} z="{real(screen.z)}"/>'
