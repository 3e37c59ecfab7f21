"""Does Mitsuba 3, which shares no line with this program, send every ray through a system to the same point with the same power?

    PYTHONPATH=. python tests/independent/mitsuba_systems.py

needs `pip install mitsuba pytest` beside the program; pytest does not run it.  The systems are those of tests/test_system.py and
one whose lens stands behind a mirror.  Each surface becomes a triangle mesh over its aperture, with the surface's own normals at
the vertices, placed by rotations of its own (tests/sequential.py), of Mitsuba's smooth `dielectric` or of `conductor` without a
material, which reflects everything; all meshes of a system stand in one scene.  The same rays are then sent through both programs:
    parallel    the program's own sample of a plane wave, which it meets on the surface itself where it can
    oblique     random points and directions, up to 0.08 off the axis along x and along y
In Mitsuba every ray goes by the scene's own intersections, whichever surface comes first, and by the BSDF's own sample of
transmission, weighted by its Fresnel factor; absorption is exp(-a t) over its own path; roughness is left out.  The way from the
last surface to the screen is plain geometry in double precision.

Reported, and what must hold:
    rays        that got to the screen, in both programs
    lost        in both (missed apertures, total internal reflection)
    apart       rays that only one of them loses: none
    rms, max    distance of landing points, mm: rms at most 2e-3
    power       largest difference of the parts of a ray's own power that get through: at most 1e-4

Measured with Mitsuba 3.9.1, 513 x 513 vertices a surface, 3000 rays of each kind, the program's plain-torch kernels:
                              parallel                              oblique
                          rays  lost   rms mm   max mm    power     rays  lost   rms mm   max mm    power
    biconvex              3025     0  2.3e-06  8.2e-06  6.9e-08     2988    12  2.7e-06  8.9e-06  7.0e-08
    prism                 3025     0  3.7e-06  1.3e-05  9.1e-08     3000     0  4.0e-06  1.6e-05  1.1e-07
    two lenses            3025     0  3.3e-06  1.3e-05  1.3e-07     2988    12  3.5e-06  1.2e-05  1.2e-07
    tilted                2885   140  6.9e-05  1.9e-03  4.1e-07     2846   154  5.9e-05  1.3e-03  1.1e-06
    folded                3025     0  6.1e-05  1.3e-03  1.4e-07     2985    15  6.0e-05  1.4e-03  1.4e-07
    lens behind mirror    2743   282  3.2e-05  5.9e-04  6.3e-08     2698   302  4.5e-05  1.6e-03  6.6e-08
and none apart.  What is left is Mitsuba's single precision, some 1e-6 mm, and on bumpy surfaces, the last three, normals that are
interpolated inside triangles: from 257 through 513 to 1025 vertices a side, rms of the tilted lens is 2.5e-4, 6.9e-5, 2.4e-5 mm.
An index off by 1e-4 puts landing points 0.6e-3 to 2.5e-3 mm off.

Exit status: 0 they agree, 1 they do not.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import torch

from caustic_cli.optics.frames import Pose
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces import Plane, Sphere
from caustic_cli.optics.system import Element, PlacedScreen, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Aperture, PlaneWave, Screen

sys.path.append(str(Path(__file__).parents[1]))
from sequential import onto, rotation
from test_system import GLASS, SYSTEMS, WIDE, bumpy, parabola

RMS, POWER = 2e-3, 1e-4
#: How far before the pupil rays start; and how far past a surface they go on, along themselves, lest they meet it again; mm.
BEFORE, PAST = 10.0, 1e-3
STEEPEST = 0.08


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=3000, help="of each kind through each system, default 3000")
    parser.add_argument("--points", type=int, default=513, help="vertices along each side of a mesh, default 513")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    mi.set_variant("scalar_rgb")  # needs no LLVM, and some ten thousand rays are few
    print(f"Mitsuba {mi.__version__}, variant {mi.variant()}, {options.points} x {options.points} vertices a surface")
    print(f"{'system':<20} {'light':<9} {'rays':>6} {'lost':>5} {'apart':>5} {'rms mm':>9} {'max mm':>9} {'power':>9}")
    agree = True
    for name, make in {**SYSTEMS, "lens behind mirror": behind_mirror}.items():
        system, heights = make()
        system = replace(system, elements=tuple(replace(e, roughness=0.0) for e in system.elements))
        scene = build(system, heights, options.points)
        for light, rays in lights(system, options.rays, options.seed):
            agree &= compare(f"{name:<20} {light:<9}", *follow(scene, system, rays), *program(system, heights, rays))
    print("agree" if agree else "DISAGREE")
    return 0 if agree else 1


def behind_mirror() -> tuple[System, dict]:
    """A mirror that turns light back by 50 degrees off -z, then a lens that it meets from the upper side of both surfaces."""
    turn = 50.0
    along = rotation((0.0, turn))[:, 2]  # light goes along minus this behind the mirror
    there = np.array([0.0, 0.0, 10.0])
    front, back = (Pose(tuple(there - t * along), (0.0, turn)) for t in (16.0, 20.0))
    elements = (
        Element("mirror", Sphere(-200.0), Aperture((8.0, 8.0)), "reflect", pose=Pose(tuple(there), (0.0, turn / 2))),
        Element("front", WIDE, Aperture((9.0, 9.0)), behind=GLASS, pose=front),
        Element("back", Plane(), Aperture((15.0, 15.0)), pose=back),
    )
    aside = PlacedScreen(Screen((20.0, 20.0), 0.0, (20, 20)), Pose(tuple(there - 60.0 * along), (0.0, turn)))
    return System((PlaneWave(),), elements, (aside,)), {"front": parabola(WIDE, -35.0) + bumpy(WIDE, 0.02, 6)}


# the light


def lights(system: System, rays: int, seed: int):
    """Names and starts of rays: a `Sample` or a `RayState`, on the pupil or before it."""
    pupil, rng = system.pupil, np.random.default_rng(seed)
    (sample,) = Sampler.of_size("stratified", rays, seed=seed).chunks()
    yield "parallel", RayState.on_axis(sample, pupil.half_size, pupil.z)
    slopes = rng.uniform(-STEEPEST, STEEPEST, (2, rays))
    x, y = (rng.uniform(-1, 1, rays) * r - BEFORE * s for r, s in zip(pupil.half_size, slopes, strict=True))
    d = np.array([*slopes, np.ones(rays)]) / np.sqrt(1 + (slopes**2).sum(0))
    one = torch.ones(rays, dtype=torch.float64)
    yield "oblique", RayState((*map(torch.from_numpy, (x, y)), pupil.z - BEFORE), tuple(map(torch.from_numpy, d)), one)


def starts(system: System, rays: RayState) -> tuple[np.ndarray, np.ndarray]:
    """Points before the pupil and directions of rays, (N, 3)."""
    rays = rays.expanded()
    o, d = (np.stack([c.double().numpy() for c in rays.full(v)], 1) for v in (rays.origin, rays.direction))
    return o + d * ((system.pupil.z - BEFORE - o[:, 2]) / d[:, 2])[:, None], d


# Mitsuba


def build(system: System, heights: dict, points: int) -> mi.Scene:
    """All surfaces of a system."""
    media, sides = system.media(), system.sides()
    scene = {"type": "scene"}
    for k, element in enumerate(system.elements):
        if element.reflects:
            bsdf = {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}
        else:  # ext_ior is on the side that normals look to, +z of the element's frame
            below, above = media[k : k + 2] if sides[k] > 0 else media[k : k + 2][::-1]
            bsdf = {"type": "dielectric", "int_ior": below.index, "ext_ior": above.index}
        scene[element.name] = mesh(element, heights.get(element.name), points, bsdf)
    return mi.load_dict(scene)


def mesh(element: Element, heights: torch.Tensor | None, points: int, bsdf: dict) -> mi.Mesh:
    """A surface over its aperture as triangles, counter-clockwise seen from its +z, with its own normals."""
    u, v = (c.ravel() for c in np.meshgrid(*[np.linspace(-1, 1, points)] * 2, indexing="ij"))
    if element.aperture.round:  # the square onto the disc
        u, v = u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)
    rx, ry = np.minimum(element.aperture.half_size, element.surface.half_size)
    x, y = u * rx, v * ry
    z, zx, zy = (c.numpy() for c in element.surface.at(heights, torch.from_numpy(x), torch.from_numpy(y)))
    turn = rotation(element.pose.tilt)
    vertices = np.stack([x, y, z], 1) @ turn.T + element.pose.position
    normals = np.stack([-zx, -zy, np.ones_like(zx)], 1) / np.sqrt(1 + zx**2 + zy**2)[:, None] @ turn.T
    number = np.arange(points**2).reshape(points, points)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh(element.name, len(vertices), len(faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(made)
    for key, values in (("vertex_positions", vertices), ("vertex_normals", normals), ("faces", faces)):
        parameters[key] = type(parameters[key])(values.astype(np.uint32 if key == "faces" else np.float32).ravel())
    parameters.update()
    return made


def follow(scene: mi.Scene, system: System, rays: RayState) -> tuple[np.ndarray, np.ndarray]:
    """Landing points (N, 2) on the screen's axes and powers (N,) of rays by Mitsuba, 0 of those lost."""
    media, (screen,) = system.media(), system.screens
    o, d = starts(system, rays)
    power = np.zeros(len(o))
    for n in range(len(o)):
        ray, weight, past = mi.Ray3f(mi.Point3f(*o[n]), mi.Vector3f(*d[n])), 1.0, 0.0
        for element, medium in zip(system.elements, media, strict=False):
            hit = scene.ray_intersect(ray)
            if not hit.is_valid() or hit.shape.id() != element.name:
                break
            wo, passed = interact(hit, element.reflects)
            if passed == 0:
                break
            weight *= passed * np.exp(-medium.absorption * (past + hit.t))
            ray, past = mi.Ray3f(hit.p + PAST * wo, wo), PAST  # along itself: `spawn_ray` moves it along the normal, by some um
        else:
            power[n], o[n], d[n] = weight, np.array(ray.o), np.array(ray.d)
    pose = screen.pose if isinstance(screen, PlacedScreen) else Pose((0.0, 0.0, screen.z), screen.tilt)
    return onto(o, d, pose.position, pose.tilt), power


def interact(hit: mi.SurfaceInteraction3f, reflects: bool) -> tuple[mi.Vector3f, float]:
    """The direction behind a surface and the part of the power that goes there, by Mitsuba's BSDF.

    Component 1 of `dielectric` is transmission; chosen alone, its sample is the refracted direction and its weight the Fresnel
    transmittance, 0 on total reflection.  Importance mode: power of light, not radiance scaled by the index.
    """
    context = mi.BSDFContext(mi.TransportMode.Importance)
    if not reflects:
        context.component = 1
    sample, weight = hit.bsdf().sample(context, hit, 0.5, mi.Point2f(0.5))
    return hit.to_world(sample.wo), float(weight[0])


# the program, and the decision


def program(system: System, heights: dict, rays: RayState) -> tuple[np.ndarray, np.ndarray]:
    """The same by the program."""
    (landed,) = Tracer(system, rays).land(heights, system.screens[0])
    share = rays.expanded().power
    return np.stack([c.numpy() for c in landed.origin[:2]], 1), (landed.power / share).numpy()


def compare(what: str, theirs: np.ndarray, their_power: np.ndarray, ours: np.ndarray, our_power: np.ndarray) -> bool:
    """Print the figures; whether they hold."""
    both, apart = (their_power > 0) & (our_power > 0), int(((their_power > 0) != (our_power > 0)).sum())
    distance = np.linalg.norm(theirs - ours, axis=1)[both]
    rms, power = float(np.sqrt(np.mean(distance**2))), float(abs(their_power - our_power)[both].max())
    good = bool(rms <= RMS and power <= POWER and apart == 0)
    print(
        f"{what} {both.sum():>6} {len(both) - both.sum() - apart:>5} {apart:>5} {rms:>9.1e} {distance.max():>9.1e} {power:>9.1e}"
        f"{'' if good else '  DISAGREE'}",
        flush=True,
    )
    return good


if __name__ == "__main__":
    sys.exit(main())
