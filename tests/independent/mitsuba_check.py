"""Does Mitsuba 3, which shares no line with this program, throw the same caustic through the exported lens?

    caustic export lens.caustic --format lighttools -o lens.npz
    caustic render lens.caustic --npy render.npy
    python tests/independent/mitsuba_check.py lens.npz render.npy

needs `pip install mitsuba numpy` and nothing else, caustic_cli least of all.  The archive's point cloud becomes a
triangle mesh with its normals at the vertices, its flat entrance a rectangle, both of Mitsuba's smooth `dielectric`;
parallel light is sent through with Mitsuba's own intersections and BSDF, transmission chosen at each interface and
weighted by its Fresnel factor, and what reaches a rectangle at z_screen is binned.  Normals interpolated inside a
triangle are off by the square of the grid's step: with 4 steps a knot span by some 1e-3 mm on the screen.

Compared are the two images as parts of their own sum, times the number of pixels:
    relative RMS    of their difference
    noise           of Mitsuba's image, from the difference of two independent halves; at most 0.05 too, or nothing is
                    proved.  The render counts as exact: its own noise is held against it
    beyond noise    sqrt(relative RMS^2 - noise^2), which must not exceed 0.05
    correlation     with the render as it is, and flipped, transposed and turned: as it is must be the best

Exit status: 0 they agree, 1 they do not, 2 bad input.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

import mitsuba as mi
import numpy as np

TOLERANCE = 0.05
#: A flipped image may correlate better than the image itself by this much: symmetric pictures differ by noise alone.
TIE = 1e-3
BATCH = 1 << 20
VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "scalar_rgb")  # the scalar one works everywhere and takes minutes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lens", help="LightTools archive, .npz")
    parser.add_argument("render", help="image from `caustic render --npy`: [i, j], i along +x, j along +y")
    parser.add_argument("--rays", type=int, default=32_000_000, help="rays in all, default 3.2e7")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--variant", default=None, help="Mitsuba variant, default the first that works")
    options = parser.parse_args()
    with np.load(options.lens, allow_pickle=False) as archive:
        lens = dict(archive)
    render = np.load(options.render, allow_pickle=False)
    if lens["source_type"].item() != "plane":
        print("mitsuba_check: only a plane wave is traced", file=sys.stderr)
        return 2
    if render.shape != tuple(lens["resolution"]):
        print(f"mitsuba_check: the render has {render.shape} pixels, the archive {lens['resolution']}", file=sys.stderr)
        return 2
    print(f"Mitsuba {mi.__version__}, variant {choose_variant(options.variant)}, {options.rays:.3g} rays,"
          f" {lens['shape'][0]} x {lens['shape'][1]} points")
    scene = build(lens)
    halves = [trace(scene, lens, options.rays // 2, [options.seed, half]) for half in (0, 1)]
    return compare(render, halves)


def choose_variant(name: str | None) -> str:
    """Set the named variant, or the first that works on this machine.

    Tried in a process of its own: an LLVM older than 17 does not raise on what Dr.Jit asks of it, it aborts.
    (A newer one is found with the environment variable DRJIT_LIBLLVM_PATH.)
    """
    probe = ("import sys, mitsuba as mi, drjit as dr; mi.set_variant(sys.argv[1]);"
             "print(dr.maximum(dr.arange(mi.Float, 9) if 'llvm' in mi.variant() else 1.0, 3.0))")
    for variant in (name,) if name else VARIANTS:
        if subprocess.run([sys.executable, "-c", probe, variant], capture_output=True, check=False).returncode == 0:
            mi.set_variant(variant)
            return variant
    raise SystemExit(f"mitsuba_check: no Mitsuba variant works here of {', '.join((name,) if name else VARIANTS)}")


# the scene


def build(lens: dict[str, np.ndarray]) -> mi.Scene:
    """Entrance, exit surface and screen; mm.  The screen is the one shape without a refracting BSDF."""
    (rx, ry), (sx, sy) = lens["lens_half_size"], lens["screen_half_size"]
    to_world, index = mi.ScalarTransform4f, float(lens["refractive_index"])
    glass = {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
    down = to_world().rotate([1, 0, 0], 180)  # the entrance looks out of the lens, towards -z
    return mi.load_dict({
        "type": "scene",
        "entrance": {"type": "rectangle", "bsdf": glass,
                     "to_world": to_world().translate([0, 0, float(lens["z_in"])]).scale([rx, ry, 1]) @ down},
        "exit": exit_mesh(lens, glass),
        "screen": {"type": "rectangle", "bsdf": {"type": "diffuse"},
                   "to_world": to_world().translate([0, 0, float(lens["z_screen"])]).scale([sx, sy, 1]) @ down},
    })  # fmt: skip


def exit_mesh(lens: dict[str, np.ndarray], glass: dict) -> mi.Mesh:
    """The cloud as triangles, counter-clockwise seen from +z, with the archive's normals."""
    nx, ny = (int(n) for n in lens["shape"])
    number = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(glass)
    mesh = mi.Mesh("exit", nx * ny, len(faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(mesh)
    for key, values in (("vertex_positions", lens["points"]), ("vertex_normals", lens["normals"]), ("faces", faces)):
        buffer = type(parameters[key])  # float32 or uint32, in the variant's own array
        parameters[key] = buffer(values.astype(np.uint32 if key == "faces" else np.float32).ravel())
    parameters.update()
    return mesh


# the light


def trace(scene: mi.Scene, lens: dict[str, np.ndarray], rays: int, seed: list[int]) -> np.ndarray:
    """Power per pixel [i, j], as a part of the source's, of about `rays` rays: one anywhere in each of square cells."""
    rng = np.random.default_rng(seed)
    rx, ry = lens["lens_half_size"]
    nu = max(1, round((rays * rx / ry) ** 0.5))
    nv = max(1, round(rays / nu))
    image = np.zeros(tuple(lens["resolution"]))
    follow = follow_wavefront if "scalar" not in mi.variant() else follow_scalar
    for start in range(0, nu * nv, BATCH):
        k = np.arange(start, min(start + BATCH, nu * nv))
        x = (2 * (k // nv + rng.random(len(k))) / nu - 1) * rx
        y = (2 * (k % nv + rng.random(len(k))) / nv - 1) * ry
        image += bin_points(*follow(scene, x, y, float(lens["z_in"]) - 1.0), lens)
    return image / (nu * nv)


def follow_wavefront(scene: mi.Scene, x: np.ndarray, y: np.ndarray, z: float):
    """Landing x, y (mm) and weight of the rays from (x, y, z) along +z, all at once; weight 0 where lost."""
    ray = mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(y), z), mi.Vector3f(0, 0, 1))
    weight, active = mi.Float(1.0), mi.Bool(True)
    for _ in range(2):  # entrance, exit
        hit = scene.ray_intersect(ray, active)
        active &= hit.is_valid()
        ray, passed = refract(hit, active)
        weight *= passed
    hit = scene.ray_intersect(ray, active)
    active &= hit.is_valid()
    return np.array(hit.p.x), np.array(hit.p.y), np.where(np.array(active), np.array(weight), 0.0)


def follow_scalar(scene: mi.Scene, x: np.ndarray, y: np.ndarray, z: float):
    """The same, ray by ray."""
    out = np.zeros((3, len(x)))
    for k in range(len(x)):
        ray, weight = mi.Ray3f(mi.Point3f(x[k], y[k], z), mi.Vector3f(0, 0, 1)), 1.0
        for _ in range(2):
            hit = scene.ray_intersect(ray)
            if not hit.is_valid():
                break
            ray, passed = refract(hit, True)
            weight *= passed
        else:
            hit = scene.ray_intersect(ray)
            if hit.is_valid():
                out[:, k] = hit.p.x, hit.p.y, weight
    return out


def refract(hit: mi.SurfaceInteraction3f, active):
    """The transmitted ray and its share of the power, by Mitsuba's BSDF.

    Component 1 of `dielectric` is transmission; chosen alone, its sample is the refracted direction and its weight the
    Fresnel transmittance, 0 on total reflection.  Importance mode: power of light, not radiance scaled by the index.
    """
    context = mi.BSDFContext(mi.TransportMode.Importance)
    context.component = 1
    sample, weight = hit.bsdf().sample(context, hit, 0.5, mi.Point2f(0.5), active)
    return hit.spawn_ray(hit.to_world(sample.wo)), weight[0]


def bin_points(x: np.ndarray, y: np.ndarray, weight: np.ndarray, lens: dict[str, np.ndarray]) -> np.ndarray:
    """Sum of weights per pixel [i, j], i along +x, j along +y."""
    (nx, ny), (sx, sy) = lens["resolution"], lens["screen_half_size"]
    i, j = np.floor((x / sx + 1) * nx / 2), np.floor((y / sy + 1) * ny / 2)
    inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny) & (weight > 0)
    at = (i[inside] * ny + j[inside]).astype(np.int64)
    return np.bincount(at, weight[inside], nx * ny).reshape(nx, ny)


# the verdict


def compare(render: np.ndarray, halves: list[np.ndarray]) -> int:
    """Print the figures; 0 when the images agree."""
    image = (halves[0] + halves[1]) / 2

    def relative(a: np.ndarray) -> np.ndarray:
        return a / a.sum() * a.size

    def rms(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(np.mean((relative(a) - relative(b)) ** 2)))

    total, noise = rms(image, render), rms(*halves) / 2
    beyond = max(total**2 - noise**2, 0.0) ** 0.5
    print(f"power on screen        Mitsuba {image.sum():.6f}, render {render.sum():.6f}")
    print(f"relative RMS           {total:.5f}")
    print(f"noise of Mitsuba's     {noise:.5f}  (at most {TOLERANCE}; more --rays lower it)")
    print(f"beyond noise           {beyond:.5f}  (at most {TOLERANCE})")
    turned = {"flipped in x": render[::-1], "flipped in y": render[:, ::-1], "turned by 180": render[::-1, ::-1]}
    if render.shape[0] == render.shape[1]:
        turned |= {"transposed": render.T, "turned by 90": np.rot90(render), "turned by 270": np.rot90(render, 3),
                   "transposed, turned": render.T[::-1, ::-1]}
    own = correlation(image, render)
    print(f"correlation as it is   {own:.5f}")
    others = {name: correlation(image, other) for name, other in turned.items()}
    for name, value in others.items():
        print(f"  {name:<20} {value:.5f}")
    agree = max(beyond, noise) <= TOLERANCE and own >= max(others.values()) - TIE
    print("agree" if agree else "DISAGREE")
    return 0 if agree else 1


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's, over pixels."""
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


if __name__ == "__main__":
    sys.exit(main())
