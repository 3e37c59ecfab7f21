"""Does Mitsuba 3, which shares no line with this program, throw the same caustic through the exported lens?

    caustic export lens.caustic --format lighttools --samples 1025 -o lens.npz
    caustic render lens.caustic --rays 1e7 --npy render.npy
    python tests/independent/mitsuba_check.py lens.npz render.npy

needs `pip install mitsuba numpy` and nothing else, caustic_cli least of all.  The archive's point cloud becomes a
triangle mesh with its normals at the vertices, its flat entrance a rectangle, both of Mitsuba's smooth `dielectric`;
the source's rays are sent through with Mitsuba's own intersections and BSDF, transmission chosen at each interface and
weighted by its Fresnel factor, and what reaches a rectangle at z_screen is binned.  A ray that leaves through the
lens' side, or comes in there, is lost.  Normals interpolated inside a triangle are off by the square of the grid's
step: with 4 steps a knot span by some 1e-3 mm on the screen.

Compared are the two images as parts of their own sum, times the number of pixels:
    relative RMS    of their difference
    noise           of Mitsuba's image, from the difference of two independent halves; at most 0.05 too, or nothing is
                    proved.  The render counts as exact: its own noise is held against it
    beyond noise    sqrt(relative RMS^2 - noise^2), which must not exceed 0.05
    correlation     with the render as it is, and flipped, transposed and turned: as it is must be the best

Rays of points and discs are drawn independently all over the cone, none aimed, and too few reach a pixel for that.
Give at least 4 renders of different --seed for such a source: then both images' variances are known, and each pixel
(--bin of them along each side taken together) that expects 25 of Mitsuba's rays or more is judged by
    Z               difference of absolute powers over its standard deviation.  Mitsuba's rays are independent, so the
                    squares of their weights tell its variance; the render's comes from the renders' scatter,
                    taken over 3 x 3 of these pixels
    chi2            mean of Z^2, off 1 by at most 0.02 and 3 sigma
    beyond 3 sigma  part of the pixels, at most 0.0027 (normal) and 3 sigma; largest |Z| below 6
    neighbours      correlation of Z with the next pixel's, below 0.05 and 3 sigma: noise has no extent
    light           power on the screen: |Z| below 4; noise of the relative RMS: of both images

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
LEAST_RAYS, LEAST_RENDERS = 25, 4
#: Part of normal values beyond 3 sigma; what chi2 may be off by beside its own 3 sigma, for the mesh; and the other limits.
NORMAL, CHI2, LARGEST, NEIGHBOURS, LIGHT = 0.0027, 0.02, 6.0, 0.05, 4.0
BATCH = 1 << 20
SHAPES = ("entrance", "exit", "screen")
VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "scalar_rgb")  # the scalar one works everywhere and takes minutes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lens", help="LightTools archive, .npz")
    parser.add_argument("render", nargs="+", help="image from `caustic render --npy`: [i, j], i along +x, j along +y")
    parser.add_argument("--rays", type=int, default=32_000_000, help="rays in all, default 3.2e7")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bin", type=int, default=2, help="pixels along each side to a judged one, default 2; not a plane wave's")
    parser.add_argument("--variant", default=None, help="Mitsuba variant, default the first that works")
    options = parser.parse_args()
    with np.load(options.lens, allow_pickle=False) as archive:
        lens = dict(archive)
    renders = np.array([np.load(name, allow_pickle=False) for name in options.render])
    plane = lens["source_type"].item() == "plane"
    wrong = None
    if renders.shape[1:] != tuple(lens["resolution"]):
        wrong = f"the render has {renders.shape[1:]} pixels, the archive {lens['resolution']}"
    elif "source_profile" in lens:
        wrong = "only a uniform plane wave is traced"
    elif not plane and (len(renders) < LEAST_RENDERS or (lens["resolution"] % options.bin).any()):
        wrong = f"needs {LEAST_RENDERS} renders of different seeds or more, and a --bin that divides {lens['resolution']}"
    if wrong:
        print(f"mitsuba_check: {wrong}", file=sys.stderr)
        return 2
    print(
        f"Mitsuba {mi.__version__}, variant {choose_variant(options.variant)}, {options.rays:.3g} rays,"
        f" {lens['shape'][0]} x {lens['shape'][1]} points, source: {lens['source_type']}"
    )
    scene = build(lens)
    halves = [trace(scene, lens, options.rays // 2, [options.seed, half]) for half in (0, 1)]
    image, render = (halves[0][0] + halves[1][0]) / 2, renders.mean(0)
    noise = rms(halves[0][0], halves[1][0]) / 2 if plane else None
    if not plane:
        squares = (halves[0][1] + halves[1][1]) / 4
        noise = (np.mean(squares) + np.mean(renders.var(0, ddof=1)) / len(renders)) ** 0.5 * image.size / image.sum()
    agree = compare(render, image, noise, plane)
    if not plane:
        agree &= judge(renders, image, squares, options.rays // 2 * 2, options.bin)
    print("agree" if agree else "DISAGREE")
    return 0 if agree else 1


def choose_variant(name: str | None) -> str:
    """Set the named variant, or the first that works on this machine.

    Tried in a process of its own: an LLVM older than 17 does not raise on what Dr.Jit asks of it, it aborts.
    (A newer one is found with the environment variable DRJIT_LIBLLVM_PATH.)
    """
    probe = (
        "import sys, mitsuba as mi, drjit as dr; mi.set_variant(sys.argv[1]);"
        "print(dr.maximum(dr.arange(mi.Float, 9) if 'llvm' in mi.variant() else 1.0, 3.0))"
    )
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


def trace(scene: mi.Scene, lens: dict[str, np.ndarray], rays: int, seed: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Power per pixel [i, j], as a part of the source's, of about `rays` rays; sums of the squares of what each ray brings."""
    rng = np.random.default_rng(seed)
    image, squares = np.zeros((2, *lens["resolution"]))
    follow = follow_wavefront if "scalar" not in mi.variant() else follow_scalar
    count = 0
    for start, direction in (parallel if lens["source_type"].item() == "plane" else spread)(lens, rays, rng):
        x, y, weight = follow(scene, start, direction)
        image += bin_points(x, y, weight, weight, lens)
        squares += bin_points(x, y, weight, weight**2, lens)
        count += start.shape[1]
    return image / count, squares / count**2


def parallel(lens: dict[str, np.ndarray], rays: int, rng: np.random.Generator):
    """Starts and directions (3, N) of a plane wave's rays, batch by batch: one anywhere in each of square cells."""
    rx, ry = lens["lens_half_size"]
    nu = max(1, round((rays * rx / ry) ** 0.5))
    nv = max(1, round(rays / nu))
    for first in range(0, nu * nv, BATCH):
        k = np.arange(first, min(first + BATCH, nu * nv))
        x = (2 * (k // nv + rng.random(len(k))) / nu - 1) * rx
        y = (2 * (k % nv + rng.random(len(k))) / nv - 1) * ry
        yield np.array([x, y, np.full_like(x, float(lens["z_in"]) - 1.0)]), np.array([0 * x, 0 * x, 1 + 0 * x])


def spread(lens: dict[str, np.ndarray], rays: int, rng: np.random.Generator):
    """The same of points or a disc, independent rays anywhere in the cone about +z."""
    z_in, (rx, ry), far = float(lens["z_in"]), lens["lens_half_size"], "source_angle" in lens
    power, half = lens["source_power"], np.radians(float(lens["cone_half_angle"]))
    for first in range(0, rays, BATCH):
        n = min(BATCH, rays - first)
        a, b, u, v = rng.random((4, n))
        if far or lens["source_intensity"].item() == "lambertian":
            sine = np.sqrt(a) * np.sin(half)
        else:  # even in the cosine, reckoned from 1
            off = a * 2 * np.sin(half / 2) ** 2
            sine = np.sqrt(off * (2 - off))
        d = np.array([sine * np.cos(2 * np.pi * b), sine * np.sin(2 * np.pi * b), np.sqrt(1 - sine**2)])
        if far:  # an evenly bright disc at infinity, seen through the aperture
            yield np.array([(2 * u - 1) * rx, (2 * v - 1) * ry, np.full(n, z_in)]) - d, d
            continue
        which = rng.choice(len(power), n, p=power / power.sum()) if len(power) > 1 else np.zeros(n, int)
        o = lens["source_positions"][which].T
        if "source_size" in lens:
            wide, high = np.sqrt(u) * lens["source_size"][:, None] / 2
            o = o + np.array([wide * np.cos(2 * np.pi * v), high * np.sin(2 * np.pi * v), np.zeros(n)])
        near = d[2] > 1e-6  # from 1 mm or less before the entrance: single precision knows no far origin
        yield o + d * np.where(near, np.maximum((z_in - o[2]) / np.where(near, d[2], 1) - 1, 0), 0), d


def follow_wavefront(scene: mi.Scene, start: np.ndarray, direction: np.ndarray):
    """Landing x, y (mm) and weight of the rays, all at once; weight 0 where lost."""
    ray = mi.Ray3f(mi.Point3f(*map(mi.Float, start)), mi.Vector3f(*map(mi.Float, direction)))
    weight, active = mi.Float(1.0), mi.Bool(True)
    for shape in SHAPES:
        hit = scene.ray_intersect(ray, active)
        active &= hit.is_valid() & (hit.shape == mi.ShapePtr(named(scene, shape)))
        if shape != "screen":
            ray, passed = refract(hit, active)
            weight *= passed
    return np.array(hit.p.x), np.array(hit.p.y), np.where(np.array(active), np.array(weight), 0.0)


def follow_scalar(scene: mi.Scene, start: np.ndarray, direction: np.ndarray):
    """The same, ray by ray."""
    out = np.zeros((3, start.shape[1]))
    for k in range(start.shape[1]):
        ray, weight = mi.Ray3f(mi.Point3f(*start[:, k]), mi.Vector3f(*direction[:, k])), 1.0
        for shape in SHAPES:
            hit = scene.ray_intersect(ray)
            if not hit.is_valid() or hit.shape.id() != shape:
                break
            if shape == "screen":
                out[:, k] = hit.p.x, hit.p.y, weight
            else:
                ray, passed = refract(hit, True)
                weight *= passed
    return out


def named(scene: mi.Scene, name: str) -> mi.Shape:
    """The scene's shape of this name."""
    return next(shape for shape in scene.shapes() if shape.id() == name)


def refract(hit: mi.SurfaceInteraction3f, active):
    """The transmitted ray and its share of the power, by Mitsuba's BSDF.

    Component 1 of `dielectric` is transmission; chosen alone, its sample is the refracted direction and its weight the
    Fresnel transmittance, 0 on total reflection.  Importance mode: power of light, not radiance scaled by the index.
    """
    context = mi.BSDFContext(mi.TransportMode.Importance)
    context.component = 1
    sample, weight = hit.bsdf().sample(context, hit, 0.5, mi.Point2f(0.5), active)
    return hit.spawn_ray(hit.to_world(sample.wo)), weight[0]


def bin_points(x: np.ndarray, y: np.ndarray, weight: np.ndarray, of: np.ndarray, lens: dict[str, np.ndarray]) -> np.ndarray:
    """Sum of `of` per pixel [i, j], i along +x, j along +y, where the weight is not 0."""
    (nx, ny), (sx, sy) = lens["resolution"], lens["screen_half_size"]
    i, j = np.floor((x / sx + 1) * nx / 2), np.floor((y / sy + 1) * ny / 2)
    inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny) & (weight > 0)
    at = (i[inside] * ny + j[inside]).astype(np.int64)
    return np.bincount(at, of[inside], nx * ny).reshape(nx, ny)


# the decision


def relative(a: np.ndarray) -> np.ndarray:
    """As parts of the mean."""
    return a / a.sum() * a.size


def rms(a: np.ndarray, b: np.ndarray) -> float:
    """Relative difference of two images."""
    return float(np.sqrt(np.mean((relative(a) - relative(b)) ** 2)))


def compare(render: np.ndarray, image: np.ndarray, noise: float, plane: bool) -> bool:
    """Print the figures; whether the images agree.  Only a plane wave's noise is judged."""
    total = rms(image, render)
    beyond = max(total**2 - noise**2, 0.0) ** 0.5
    print(f"power on screen        Mitsuba {image.sum():.6f}, render {render.sum():.6f}")
    print(f"relative RMS           {total:.5f}")
    print(f"noise                  {noise:.5f}" + f"  (at most {TOLERANCE}; more --rays lower it)" * plane)
    print(f"beyond noise           {beyond:.5f}  (at most {TOLERANCE})")
    turned = {"flipped in x": render[::-1], "flipped in y": render[:, ::-1], "turned by 180": render[::-1, ::-1]}
    if render.shape[0] == render.shape[1]:
        turned |= {
            "transposed": render.T,
            "turned by 90": np.rot90(render),
            "turned by 270": np.rot90(render, 3),
            "transposed, turned": render.T[::-1, ::-1],
        }
    own = correlation(image, render)
    print(f"correlation as it is   {own:.5f}")
    others = {name: correlation(image, other) for name, other in turned.items()}
    for name, value in others.items():
        print(f"  {name:<20} {value:.5f}")
    return (max(beyond, noise) if plane else beyond) <= TOLERANCE and own >= max(others.values()) - TIE


def judge(renders: np.ndarray, image: np.ndarray, squares: np.ndarray, rays: int, side: int) -> bool:
    """Print Z-scores' figures; whether they are those of noise.

    Args:
        squares: sums of the squares of what each of Mitsuba's `rays` rays brings to a pixel.
    """
    nx, ny = image.shape
    renders, image, squares = (
        a.reshape(*a.shape[:-2], nx // side, side, ny // side, side).sum((-3, -1)) for a in (renders, image, squares)
    )
    render, scatter = renders.mean(0), renders.var(0, ddof=1) / len(renders)
    around = around_each(render)  # few renders tell a pixel's variance badly: as much a unit of light as its neighbours'
    scatter = render * around_each(scatter) / np.where(around > 0, around, 1.0)
    per_ray = squares.sum() / image.sum()
    judged = render >= LEAST_RAYS * per_ray
    each = np.where(image > 0, squares / np.where(image > 0, image, 1.0), per_ray)  # what a ray brings there
    expected = (image + render) / 2  # the count itself would make a pixel that has too few look surer than it is
    z = (image - render) / np.sqrt(np.where(judged, each * expected - expected**2 / rays + scatter, np.inf))
    some = z[judged]
    pairs = [(z[:-1], z[1:], judged[:-1] & judged[1:]), (z[:, :-1], z[:, 1:], judged[:, :-1] & judged[:, 1:])]
    neighbours = float(np.mean(np.concatenate([(a * b)[c] for a, b, c in pairs])))
    chi2, beyond, largest = float(np.mean(some**2)), float(np.mean(abs(some) > 3)), float(abs(some).max())
    sums = renders.sum((1, 2))
    spread_of_light = squares.sum() - image.sum() ** 2 / rays + sums.var(ddof=1) / len(sums)
    light = (image.sum() - sums.mean()) / spread_of_light**0.5
    print(
        f"judged                 {judged.sum()} of {judged.size} pixels of {side} x {side},"
        f" {render[judged].sum() / render.sum():.4f} of the light, {np.sqrt(per_ray / np.mean(render[judged])):.3f} mean noise;"
        f" render's part of the variance {np.mean(scatter[judged]) / np.mean((each * expected + scatter)[judged]):.2f}"
    )
    most, off = NORMAL + 3 * np.sqrt(NORMAL / len(some)), CHI2 + 3 * np.sqrt(2 / len(some))
    related = NEIGHBOURS + 3 / np.sqrt(2 * len(some))
    print(f"beyond 3 sigma         {beyond:.5f}  (at most {most:.5f}; normal {NORMAL})")
    print(f"chi2 a pixel           {chi2:.4f}  ({1 - off:.3f} to {1 + off:.3f}; one sigma {np.sqrt(2 / len(some)):.4f})")
    print(f"mean Z, largest |Z|    {some.mean():.4f}, {largest:.2f}  (below {LARGEST})")
    print(f"neighbours             {neighbours:.4f}  (below {related:.3f})")
    print(f"light                  Mitsuba - render = {image.sum() - sums.mean():.2e}, Z {light:.2f}  (below {LIGHT})")
    return bool(abs(chi2 - 1) <= off and beyond <= most and largest < LARGEST and abs(neighbours) < related and abs(light) < LIGHT)


def around_each(a: np.ndarray) -> np.ndarray:
    """Sums over the 3 x 3 pixels around each."""
    padded = np.pad(a, 1)
    return sum(padded[i : i + a.shape[0], j : j + a.shape[1]] for i in range(3) for j in range(3))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's, over pixels."""
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


if __name__ == "__main__":
    sys.exit(main())
