"""Lenses that other programs design, by this program's measure: the rows about them in the README's table.

    python tests/benchmarks/others.py judge LENS.obj --target examples/flame.png --unit 10      seconds
    python tests/benchmarks/others.py mitsuba --picture examples/flame.png      a quarter of an hour; `pip install mitsuba`

The scene is that of `caustic design PICTURE --mag 3 --margin 0 --linear`: a lens of 10 x 10 mm and index 1.5443 in a plane wave, a
screen of 30 x 30 mm and 250 x 250 pixels in the plane z = 300 mm, filled by a picture whose codes are proportional to irradiance.

judge reads triangles (.obj), of a solid the curved face, or heights in mm of a grid of vertices over the whole lens (.npy, [i, j],
i along +x).  Lengths are multiplied by --unit; without it the lens is made 10 mm wide.  One stratified ray in each of as many
square cells over the lens is refracted by its triangle, weighted by what both surfaces let through, and counted in its pixel;
twice, because a mesh does not say what lies between its vertices:
    facets      every triangle flat, as it is written
    smooth      normals averaged at the vertices by angle and interpolated, as renderers and polishing have it
Of the picture's eight orientations the best counts: a program may mirror.  relative_rms is `caustic_cli.studies.metrics`'; light is
the part of the power in the lens' aperture that lands on the screen or is reflected by the surfaces, as in the README.

mitsuba follows the method of Mitsuba 3's tutorial "Caustics optimization": a texture of heights displaces a triangle mesh whose
caustic `ptracer` renders differentiably; Adam lessens the mean square of image over its mean less picture over its mean, while the
texture is refined four times; after 0.7 and 0.9 of the iterations the step is halved and the rays are doubled.  Step (in parts of
the picture) and rays are the tutorial's.  Unlike there, the surface begins as the sphere that spreads light over the whole picture,
where a slab would light a ninth of it, and is rendered with the decision's pixels.  The heights are kept in --out.

The optimal-transport tool is github.com/dylanmsu/fast_caustic_design (transport on grids by Nader and Guennebaud; Ceres and CHOLMOD
from the distribution), built as its README says, with the line of apps/caustic_design.cpp that scales the target points put in
effect, as scalePoints(trg_pts, {3, 3, 0}, {0.5, 0.5, 0}).  Its lens is 1 wide, so --unit is 10 and the focal length 30:
    caustic_design -in_trg flame.png -res 250 -focal_l 30 -refractive_index 1.5443 -output flame.obj      or -res 512
    python tests/benchmarks/others.py judge flame.obj --target flame.png --unit 10
The README's photograph: matplotlib's grace_hopper.jpg (mpl-data/sample_data), `convert("L")`, cropped to (0, 0, w, w), 500 x 500.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from scipy.ndimage import zoom

from caustic_cli.inverse.target import target_on_screen
from caustic_cli.io.picture import read_picture
from caustic_cli.scene import Screen
from caustic_cli.studies.metrics import relative_rms

WIDTH, INDEX, SCREEN, THROW, PIXELS = 10.0, 1.5443, 30.0, 300.0, 250  # mm
RAYS = (4e6, 3.2e7)
THICKNESS, DOUBLINGS = 5.0, 4  # mm, of the lens that Mitsuba begins with; of its texture
# The tutorial's step of 3e-5 on texels of 2 / 32 before a screen 7 away, on a picture 1.95 wide, is this one here.
STEP = 3e-5 / (2 / 32) * 0.5 * 7 / 1.95 * SCREEN / (THROW - THICKNESS) / (INDEX - 1) * (WIDTH / 32)


@dataclass(frozen=True)
class Sheet:
    """An exit surface: vertices (n, 3) in mm, corners of its triangles (m, 3); light comes along +z."""

    vertices: np.ndarray
    faces: np.ndarray

    def normals(self) -> np.ndarray:
        """Unit normals of the triangles, towards +z: (m, 3)."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return _upwards(np.cross(b - a, c - a))

    def smooth(self) -> np.ndarray:
        """Unit normals at the vertices, means over the triangles around them by their angles there: (n, 3)."""
        mean, normals = np.zeros_like(self.vertices), self.normals()
        for k in range(3):
            at, left, right = (self.vertices[self.faces[:, (k + m) % 3]] for m in range(3))
            angle = np.arccos(np.clip((_unit(left - at) * _unit(right - at)).sum(1), -1.0, 1.0))
            for axis in range(3):
                mean[:, axis] += np.bincount(self.faces[:, k], normals[:, axis] * angle, len(mean))
        return _upwards(mean)


def _unit(a: np.ndarray) -> np.ndarray:
    """Vectors of length 1, or 0 where there is none."""
    return a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-300)


def _upwards(a: np.ndarray) -> np.ndarray:
    return _unit(a) * np.where(a[:, 2:] < 0, -1.0, 1.0)


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a Wavefront file; polygons become fans."""
    vertices, faces = [], []
    with open(path, encoding="utf-8") as file:
        for line in file:
            key, *words = line.split() or [""]
            if key == "v":
                vertices.append([float(w) for w in words[:3]])
            elif key == "f":
                corner = [int(w.split("/")[0]) - 1 for w in words]
                faces += [(corner[0], corner[k], corner[k + 1]) for k in range(1, len(corner) - 1)]
    return np.array(vertices), np.array(faces)


def curved_face(vertices: np.ndarray, faces: np.ndarray) -> Sheet:
    """Of a solid, the face across z that is not flat, light coming through the other one; a sheet as it is, light along +z."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = _unit(np.cross(b - a, c - a))[:, 2]
    sides = [s for s in (faces[across > 0.1], faces[across < -0.1]) if len(s)]
    heights = [vertices[np.unique(s), 2] for s in sides]
    if not sides or (len(sides) == 2 and min(np.ptp(h) for h in heights) > 1e-6 * np.ptp(vertices[:, 0])):
        raise SystemExit("others: one face across z must be flat and the other one curved")
    curved = int(np.argmax([np.ptp(h) for h in heights]))
    used, faces = np.unique(sides[curved], return_inverse=True)
    return Sheet(vertices[used] * [1, 1, -1 if heights[curved].mean() < heights[curved - 1].mean() else 1], faces.reshape(-1, 3))


def grid(heights: np.ndarray) -> Sheet:
    """Two triangles between any four neighbours of heights (n, m) over the lens, counter-clockwise from +z."""
    x, y = np.meshgrid(*(np.linspace(-WIDTH / 2, WIDTH / 2, n) for n in heights.shape), indexing="ij")
    number = np.arange(heights.size).reshape(heights.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([a, b, d, b, c, d], -1).reshape(-1, 3)
    return Sheet(np.stack([x, y, heights], -1).reshape(-1, 3), faces)


def read_lens(path: Path, unit: float | None = None) -> Sheet:
    """The exit surface in a file, in mm, centred."""
    sheet = grid(np.load(path, allow_pickle=False)) if path.suffix == ".npy" else curved_face(*read_obj(path))
    low, high = sheet.vertices.min(0), sheet.vertices.max(0)
    return Sheet((sheet.vertices - [*(low + high)[:2] / 2, 0.0]) * (unit or WIDTH / (high[0] - low[0])), sheet.faces)


@njit(cache=True)
def _uniform(number):
    """Two numbers in [0, 1) that belong to a cell's number (SplitMix64)."""
    key = np.uint64(number) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x632BE59BD9B4E019)
    key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    key = key ^ (key >> np.uint64(31))
    return (key >> np.uint64(32)) / 4294967296.0, (key & np.uint64(0xFFFFFFFF)) / 4294967296.0


@njit(cache=True)
def _expose(vertices, faces, of_faces, of_vertices, smooth, low, cell, cells, pixels, index, half, throw):
    """Image (pixels, pixels) of one ray a cell, and the sum of what the surfaces reflect of them."""
    image, reflected = np.zeros((pixels, pixels)), 0.0
    entrance = 1.0 - ((index - 1.0) / (index + 1.0)) ** 2
    first, last = np.empty(2, np.int64), np.empty(2, np.int64)
    for t in range(len(faces)):
        a, b, c = vertices[faces[t, 0]], vertices[faces[t, 1]], vertices[faces[t, 2]]
        twice = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if twice == 0.0:
            continue
        for k in range(2):
            first[k] = max(0, int(np.floor((min(a[k], b[k], c[k]) - low[k]) / cell[k])))
            last[k] = min(cells[k] - 1, int(np.floor((max(a[k], b[k], c[k]) - low[k]) / cell[k])))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                u, v = _uniform(i * cells[1] + j)
                x, y = low[0] + (i + u) * cell[0], low[1] + (j + v) * cell[1]
                p = ((x - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (y - a[1])) / twice
                q = ((b[0] - a[0]) * (y - a[1]) - (x - a[0]) * (b[1] - a[1])) / twice
                if p < 0.0 or q < 0.0 or p + q > 1.0:
                    continue
                n_x, n_y, n_z = of_faces[t, 0], of_faces[t, 1], of_faces[t, 2]
                if smooth:
                    m = (1 - p - q) * of_vertices[faces[t, 0]] + p * of_vertices[faces[t, 1]] + q * of_vertices[faces[t, 2]]
                    n_x, n_y, n_z = m / np.sqrt((m**2).sum())
                squared = 1.0 - index**2 * (1.0 - n_z**2)
                if squared <= 0.0:  # total reflection
                    continue
                out = np.sqrt(squared)
                weight = entrance * (
                    1.0
                    - ((index * n_z - out) / (index * n_z + out)) ** 2 / 2.0
                    - ((index * out - n_z) / (index * out + n_z)) ** 2 / 2.0
                )
                reflected += 1.0 - weight
                turn = out - index * n_z
                far = (throw - (a[2] + p * (b[2] - a[2]) + q * (c[2] - a[2]))) / (index + turn * n_z)
                k_x = int(np.floor((x + far * turn * n_x + half) / (2.0 * half) * pixels))
                k_y = int(np.floor((y + far * turn * n_y + half) / (2.0 * half) * pixels))
                if 0 <= k_x < pixels and 0 <= k_y < pixels:
                    image[k_x, k_y] += weight
    return image, reflected


def expose(sheet: Sheet, smooth: bool, rays: float, pixels: int = PIXELS) -> tuple[np.ndarray, float]:
    """Image [i, j] in parts of the power in the lens' aperture, and the part that is on it or reflected by the surfaces."""
    low, size = sheet.vertices.min(0)[:2], np.ptp(sheet.vertices, axis=0)[:2]
    cells = np.maximum(1, np.rint(np.sqrt(rays / size.prod()) * size)).astype(np.int64)
    image, reflected = _expose(
        sheet.vertices,
        sheet.faces,
        sheet.normals(),
        sheet.smooth(),
        smooth,
        low,
        size / cells,
        cells,
        pixels,
        INDEX,
        SCREEN / 2,
        THROW,
    )
    return image / cells.prod(), float(image.sum() + reflected) / float(cells.prod())


def target(picture: Path, pixels: int = PIXELS) -> np.ndarray:
    """The picture on the screen's pixels, [i, j]."""
    screen = Screen((SCREEN, SCREEN), THROW, (pixels, pixels))
    return target_on_screen(read_picture(picture, linear=True).irradiance(), screen.size, screen)


def report(sheet: Sheet, picture: Path, seconds: float | None = None) -> None:
    """Print the decision as a Markdown table."""
    goal = target(picture)
    turned = {f"{name}{90 * k} degrees": np.rot90(g, k) for name, g in (("", goal), ("mirrored, ", goal[::-1])) for k in range(4)}
    print("| normals | relative RMS, 4e6 rays | 3.2e7 rays | light | picture turned | seconds |", "| --- " * 6 + "|", sep="\n")
    for smooth in (False, True):
        images = [expose(sheet, smooth, n) for n in RAYS]
        best = min(turned, key=lambda name: relative_rms(images[0][0], turned[name]))
        cells = [f"{relative_rms(image, turned[best]):.3f}" for image, _ in images]
        cells += [f"{images[-1][1]:.3f}", best, "" if seconds is None else f"{seconds:.0f}"]
        print(f"| {'smooth' if smooth else 'facets'} | {' | '.join(cells)} |")


def build(mi, sheet: Sheet, pixels: int):
    """Collimated light, a plate whose exit is to be displaced, a white screen, and a camera that sees it from the lens."""
    to_world, value = mi.ScalarTransform4f(), lambda number: {"type": "spectrum", "value": number}
    glass = {"type": "dielectric", "int_ior": INDEX, "ext_ior": 1.0, "specular_reflectance": value(0.0)}
    turn, half, away = to_world.rotate([1, 0, 0], 180), WIDTH / 2, 0.9 * (THROW - THICKNESS)  # rectangles look to +z
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(glass)
    mesh = mi.Mesh("exit", len(sheet.vertices), len(sheet.faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["faces"], parameters["vertex_positions"] = mi.UInt32(sheet.faces.ravel()), mi.Float(sheet.vertices.ravel())
    parameters.update()
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "ptracer", "max_depth": 4}, "exit": mesh,
        "entrance": {"type": "rectangle", "to_world": to_world.scale([half, half, 1]) @ turn, "bsdf": glass},
        "light": {"type": "rectangle", "to_world": to_world.translate([0, 0, -1]).scale([half, half, 1]),
                  "emitter": {"type": "directionalarea", "radiance": value(1.0)}},
        "screen": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": value(1.0)},
                   "to_world": to_world.translate([0, 0, THROW]).scale([2 * SCREEN, 2 * SCREEN, 1]) @ turn},
        "camera": {"type": "perspective", "fov": float(2 * np.degrees(np.arctan2(SCREEN / 2, away))), "near_clip": 1.0,
                   "far_clip": 1e3, "to_world": to_world.translate([0, 0, THROW - away]).scale([-1, 1, 1]),
                   "film": {"type": "hdrfilm", "width": pixels, "height": pixels, "pixel_format": "luminance"}},
    })  # fmt: skip


def optimise(picture: Path, resolution: int, iterations: int, samples: int, step: float, pixels: int = PIXELS) -> np.ndarray:
    """Heights in mm of the vertices, [i, j], after the tutorial's optimisation."""
    import drjit as dr  # noqa: PLC0415 - the decision needs neither
    import mitsuba as mi  # noqa: PLC0415

    mi.set_variant("cuda_ad_mono", "llvm_ad_mono")
    radius, sheet = (INDEX - 1) * (THROW - THICKNESS) / (SCREEN / WIDTH - 1), grid(np.zeros((resolution, resolution)))
    sheet.vertices[:, 2] = THICKNESS + radius - np.sqrt(radius**2 - (sheet.vertices[:, :2] ** 2).sum(1))
    parameters = mi.traverse(scene := build(mi, sheet, pixels))
    goal = target(picture, pixels).T[::-1, :, None]
    goal, (x, y, z) = mi.TensorXf(goal / goal.mean()), (mi.Float(a) for a in sheet.vertices.T)
    where = dr.zeros(mi.SurfaceInteraction3f, len(sheet.vertices))
    where.uv = mi.Point2f(x / WIDTH + 0.5, y / WIDTH + 0.5)
    coarse = mi.Bitmap(np.zeros((resolution >> DOUBLINGS, resolution >> DOUBLINGS, 1), np.float32))
    texture = mi.load_dict({"type": "bitmap", "raw": True, "wrap_mode": "clamp", "bitmap": coarse})
    values, adam, rate = mi.traverse(texture), mi.ad.Adam(lr=step), step
    adam["heights"] = mi.TensorXf(values["data"])
    refined = [int(iterations * (k / (DOUBLINGS + 1)) ** 2) for k in range(1, DOUBLINGS + 1)]

    def surface():
        values["data"] = adam["heights"]
        values.update()
        return z + texture.eval_1(where)

    for i in range(iterations):
        if i in refined:
            finer = zoom(np.array(adam["heights"])[..., 0], 2, order=1, mode="nearest", grid_mode=True)
            adam["heights"] = mi.TensorXf(finer[..., None])
        if i in (int(0.7 * iterations), int(0.9 * iterations)):
            samples, rate = 2 * samples, rate / 2
            adam.set_learning_rate(rate)
        parameters["exit.vertex_positions"] = dr.ravel(mi.Point3f(x, y, surface()))
        parameters.update()
        image = mi.render(scene, parameters, seed=i, spp=2 * samples, spp_grad=samples)
        loss = dr.mean(dr.square(image / dr.mean(dr.detach(image)) - goal))
        dr.backward(loss)
        adam.step()
        if i % 20 == 0 or i == iterations - 1:
            print(f"iteration {i}: relative RMS {float(loss.array[0]) ** 0.5:.3f} by its own render", file=sys.stderr, flush=True)
    return np.array(surface(), dtype=float).reshape(resolution, resolution)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    of = commands.add_parser("judge")
    of.add_argument("lens", type=Path, help=".obj, or .npy of heights in mm")
    of.add_argument("--target", type=Path, required=True, help="the picture it was designed for")
    of.add_argument("--unit", type=float, help="mm of the file's unit of length")
    of = commands.add_parser("mitsuba")
    of.add_argument("--picture", type=Path, required=True)
    of.add_argument("--resolution", type=int, default=512, help="vertices and texels along a side")
    of.add_argument("--iterations", type=int, default=1000)
    of.add_argument("--samples", type=int, default=8, help="rays a pixel for the gradient; twice as many for the image")
    of.add_argument("--step", type=float, default=STEP, help="Adam's, mm")
    of.add_argument("--out", type=Path, default=Path("mitsuba-heights.npy"))
    options = parser.parse_args()
    if options.command == "judge":
        return report(read_lens(options.lens, options.unit), options.target)
    began = time.perf_counter()
    np.save(options.out, optimise(options.picture, options.resolution, options.iterations, options.samples, options.step))
    return report(read_lens(options.out, 1.0), options.picture, time.perf_counter() - began)


if __name__ == "__main__":
    main()
