"""Import into LightTools: a Python script that rebuilds the scene from the `.npz`, and a block of points.

    NAME.py        attaches to a running LightTools by COM (pywin32), builds lens, source, receiver and simulation from NAME.npz,
                   runs it, and writes the illuminance as NAME-lighttools.npy, [i, j], or [k, i, j] of several simulations: one for
                   each source, and each index
    NAME.lts.txt   the two `restorePoints` blocks of a FreeformSolid in an `.lts` model, front and rear, x varying fastest,
                   to be pasted into a model in place of its own: for those without COM

Calls and block follow working scripts and models of LightTools 8.5; neither has been tested in LightTools itself.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.export.surface import Sampling, SurfaceGrid, sample_grid
from caustic_cli.export.text import CREATED, real
from caustic_cli.io.files import atomic_file, write_bytes
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Band, Scene

#: Points of a flat entrance along each axis.
FLAT = 5
#: Points per line of the block.
WRAP = 4

SCRIPT = '''"""@CREATED@ for the model @NPZ@: run it on Windows while LightTools (8.5 or later) is open.

    pip install pywin32 numpy
    python @NAME@

Builds the lens, its source, a receiver on the screen and the simulation in a new model; millimetres.  Each of several sources, and
each wavelength in a dispersive glass, has a model and a simulation of its own, and an image [k, i, j].
"""

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
RAYS = int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_000_000
BEFORE = 1.0  # light from infinity starts so far before all of the entrance, mm
POINT, STRIPS, CELLS = 1e-6, 32, 32  # width of a point, mm; strips of a disc; cells of a picture along each axis
RUNS = @RUNS@  # number of the source, refractive index and part of the power of each simulation
SURFACE = ("LENS_MANAGER[1].COMPONENTS[Components].SOLID[{}].FREEFORM_PRIMITIVE[FreeformPrimitive_1]"
           ".FREEFORM_SURFACE[{}]")
MESH = "RECEIVER[screen].MESH[1]"


def main():
    import win32com.client

    lens = dict(np.load(HERE / "@NPZ@", allow_pickle=False))
    lt = win32com.client.Dispatch("LightTools.LTAPI4")  # attaches to the LightTools that runs
    js = win32com.client.Dispatch("LTCOM64.JSNET")
    for name in ("ShowDialogs", "ShowFileDialogBox", "ConfirmDeleteModel"):
        lt.SetOption(name, 0)
    images = []
    for source, index, part in RUNS:
        lt.Begin()
        js.NewV3D(lt)
        build_lens(lt, lens, index)
        build_source(lt, js, member(lens, source), part)
        build_receiver(lt, js, lens)
        lt.End()
        images.append(simulate(lt, lens))
    image = np.array(images) if len(images) > 1 else images[0]
    np.save(HERE / "@STEM@-lighttools.npy", image)
    print("illuminance: sum %.9g, saved" % image.sum())


def member(lens, number):
    """The archive with the keys of one of several sources in place of those of all; 0 for a single one."""
    own = "source_%d_" % number
    found = {key[len(own):]: value for key, value in lens.items() if key.startswith(own)}
    return lens | {key if key == "cone_half_angle" else "source_" + key: value for key, value in found.items()}


def build_lens(lt, lens, index):
    """A FreeformSolid between the points of the entrance and those of the exit surface, u = x, v = y."""
    lt.Cmd("FreeformSolid XYZ 0,0,0 XYZ 0,0,1 XYZ 0,1,0")
    name = got(lt.DbGet("SOLID[@Last]", "Name"))
    rear = lens["points"].reshape(*lens["shape"], 3)
    for surface, grid in (("FrontSurface", entrance(lens)), ("RearSurface", rear)):
        lt.SetFreeformSurfacePoints(SURFACE.format(name, surface), grid.tolist(), grid.shape[0], grid.shape[1])
    lt.DbSet("SOLID[@Last]", "Name", "lens")
    if lt.DbSet("SOLID[lens]", "Refractive_Index", index):
        print("please give the solid `lens` a material of index %.9g by hand" % index)


def entrance(lens):
    """Points of the entrance, [nU][nV][3]: flat, or of the spline in the archive, as dense as those of the exit."""
    if "entrance_control_points" not in lens:
        x, y = (np.linspace(-r, r, @FLAT@) for r in lens["lens_half_size"])
        return np.stack(np.broadcast_arrays(x[:, None], y[None, :], float(lens["z_in"])), -1)
    x, y, net = lens["x"], lens["y"], lens["entrance_control_points"]
    u, v = (basis(lens["entrance_knots_" + k], int(p), np.clip(0.5 * (c / r + 1.0), 0.0, 1.0))
            for k, p, c, r in zip("uv", lens["entrance_degrees"], (x, y), lens["lens_half_size"]))
    return np.stack(np.broadcast_arrays(x[:, None], y[None, :], u @ net[..., 2] @ v.T), -1)


def basis(t, degree, at):
    """All B-splines of knots t at parameters, [at][n], by the Cox-de Boor recursion."""
    span = np.clip(np.searchsorted(t, at, "right") - 1, degree, len(t) - degree - 2)
    found = (span[:, None] == np.arange(len(t) - 1)).astype(float)
    for q in range(1, degree + 1):
        low, high = t[:-q], t[q:]
        width = np.where(high > low, high - low, 1.0)
        part = (at[:, None] - low[:-1]) / width[:-1], (high[1:] - at[:, None]) / width[1:]
        found = part[0] * found[:, :-1] + part[1] * found[:, 1:]
    return found


def build_source(lt, js, lens, part):
    """Each place of the source as rectangles that shine along +z, into their cone; part: of its power."""
    cone, apodizer = float(lens["cone_half_angle"]), "Uniform"
    if len(lens["source_positions"]):
        apodizer = "Cosine" if lens["source_intensity"].item() == "lambertian" else "Uniform"
        places = zip(lens["source_positions"], lens["source_power"])
    else:
        places = [((0.0, 0.0, float(entrance(lens)[..., 2].min()) - BEFORE), lens["source_power"][0])]
    pieces, number = tiles(lens), 0
    for (x, y, z), power in places:
        for (dx, dy), size, share in pieces:
            number += 1
            place(lt, js, "light%d" % number, (x + dx, y + dy, z), size, float(power) * part * share, cone, apodizer)


def tiles(lens):
    """What shines at a place: centres, widths and parts of the power of rectangles, mm.  The whole aperture, or the cells of a
    profile over it; the cells of a picture of a disc, at most CELLS along each axis; strips of a disc, each as wide as it is there;
    a tiny square for a point."""
    distant = not len(lens["source_positions"])
    cells = lens.get("source_profile", np.ones((1, 1))) if distant else lens.get("source_brightness")
    half = lens["lens_half_size"] if distant else lens.get("source_size", np.full(2, POINT)) / 2
    if cells is not None:
        for axis in (0, 1):
            count = cells.shape[axis]
            at = np.linspace(0.0, count, min(CELLS, count) + 1)  # sums over equal parts, which may cut cells
            sums = np.insert(np.cumsum(cells, axis), 0, 0.0, axis)
            cells = np.diff(np.apply_along_axis(lambda c: np.interp(at, np.arange(count + 1), c), axis, sums), axis=axis)
        across = [r * ((2 * np.arange(n) + 1) / n - 1) for r, n in zip(half, cells.shape)]
        size = [2 * max(r, POINT / 2) / n for r, n in zip(half, cells.shape)]
        return [((x, y), size, cells[i, j] / cells.sum()) for i, x in enumerate(across[0])
                for j, y in enumerate(across[1]) if cells[i, j] > 0]
    if "source_size" not in lens:
        return [((0.0, 0.0), (POINT, POINT), 1.0)]
    turn = np.linspace(0.0, np.pi, STRIPS + 1)  # of a circle, between whose chords lie the strips
    areas = np.diff(turn - np.sin(2 * turn) / 2)
    low, high = -np.cos(turn[:-1]), -np.cos(turn[1:])
    wide = areas / (high - low)
    return [((0.0, half[1] * y), (max(half[0] * w, POINT), max(half[1] * h, POINT)), a / np.pi)
            for y, w, h, a in zip((low + high) / 2, wide, high - low, areas)]


def place(lt, js, name, position, size, power, cone, apodizer):
    """A cube source whose +z face alone shines (the last of its six), so thin that it stands at `position`, into a cone of
    half-angle `cone`.  Powers are watts here, or the lumens of the archive in their place."""
    x, y, z = (float(v) for v in position)
    depth = 1e-6
    js.MakeSourceSurfaceCube(lt, float(size[1]), float(size[0]), depth, name, 0, 0, 0, 0, 0, -1)
    js.MoveVector(lt, name, x, y, z - depth)
    js.SetSourceAimSphere(lt, name, "Aim Region", "Yes", 0, 0, 0, max(cone, 1e-6))
    js.SetSourcePower(lt, name, power, "watts", "Automatic")
    lt.DbSet(name, "Direction_Apodizer_Type", apodizer)


def build_receiver(lt, js, lens):
    """The screen's pixels, without LightTools' smoothing, which is on by default."""
    (sx, sy), z, (nx, ny) = lens["screen_half_size"], float(lens["z_screen"]), lens["resolution"]
    x, y = (float(c) for c in lens.get("screen_shift", np.zeros(2)))
    js.MakeDummyPlane(lt, x, y, z, 0, 0, -1, "N", "Rectangular", float(2 * sx), float(2 * sy), "screen_plane")
    js.MakeReceiver(lt, "screen_plane", "dummyplane", "screen")
    for field, value in (("X_Dimension", int(nx)), ("Y_Dimension", int(ny)), ("Min_X_Bound", -float(sx)),
                         ("Max_X_Bound", float(sx)), ("Min_Y_Bound", -float(sy)), ("Max_Y_Bound", float(sy)),
                         ("Do_Noise_Reduction", "No")):
        lt.DbSet(MESH, field, value)


def simulate(lt, lens):
    """Trace RAYS rays; the receiver's illuminance, W/mm2, as an array [i, j]."""
    lt.DbSet("LENS_MANAGER[1].ILLUM_MANAGER[Illumination_Manager].SIMULATIONS[ForwardAll]", "MaxProgress", RAYS)
    lt.Cmd("\\\\V3D BeginAllSimulations")
    return np.array(got(lt.GetMeshData(MESH, np.zeros(tuple(lens["resolution"])).tolist(), "CellValue")))


def got(answer):
    """The value of an answer (value, status) or (status, value), as LightTools gives them; status 0 is success."""
    value, status = answer if isinstance(answer[1], int) else answer[::-1]
    if status:
        raise SystemExit("LightTools answered with status %s" % status)
    return value


if __name__ == "__main__":
    main()
'''


def companions(path: str | Path) -> tuple[Path, Path]:
    """The script and the point block beside an archive."""
    path = Path(path)
    return path.with_suffix(".py"), path.with_suffix(".lts.txt")


def write_script(path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None) -> None:
    """Write script and block for an archive written by `write_lighttools` with the same arguments, of a scene that
    `supported.SCRIPT` supports.

    Raises:
        InputError: the files cannot be written.
    """
    path = Path(path)
    script, block = companions(path)
    runs = [
        f"({0 if band.member is None else band.member + 1}, {real(band.scene.lens.index)}, {real(part)})"
        for band, part in _parts(scene)
    ]
    words = {
        "@CREATED@": CREATED,
        "@RUNS@": f"({', '.join(runs)},)",
        "@NPZ@": path.name,
        "@NAME@": script.name,
        "@STEM@": path.stem,
        "@FLAT@": str(FLAT),
    }
    text = SCRIPT
    for word, value in words.items():
        text = text.replace(word, value.replace("\\", "\\\\").replace('"', '\\"'))
    write_bytes(script, text.encode())
    _write_block(block, _entrance(scene, samples), sample_grid(field, heights, samples))


def _parts(scene: Scene) -> list[tuple[Band, float]]:
    """The separate simulations, and the part of the power of its source that each has."""
    return [(band, band.weight * scene.source.power / band.scene.source.power) for band in scene.bands]


def _entrance(scene: Scene, samples: Sampling | None) -> np.ndarray:
    """Points of the entrance, (n, m, 3) mm: flat, or as dense as those of the exit."""
    if scene.lens.entrance is None:
        x, y = (np.linspace(-r, r, FLAT) for r in scene.lens.half_size)
        return np.stack(np.broadcast_arrays(x[:, None], y[None, :], scene.lens.z_in), -1)
    front = entrance_of(scene.lens)
    grid = sample_grid(front.field, front.heights + scene.lens.z_in, samples)
    return grid.points.reshape(*grid.z.shape, 3)


def _write_block(path: Path, front: np.ndarray, grid: SurfaceGrid) -> None:
    with atomic_file(path, "ascii") as file:
        file.write(f"# {CREATED}; millimetres.  Replace the two restorePoints blocks of a FreeformSolid by these.\n")
        for points, name in ((front, "Front"), (grid.points.reshape(*grid.z.shape, 3), "Rear")):
            nu, nv = points.shape[:2]
            file.write(f"restorePoints:\nORAStartData;\n0 0 {nu} {nv} 0 0 {nu * nv} 0 0 0\n")
            rows = points.swapaxes(0, 1).reshape(-1, 3)
            for start in range(0, len(rows), WRAP):
                file.write(" ".join(map(real, rows[start : start + WRAP].ravel())) + "\n")
            file.write(
                "0 1 4 CartesianMapper 1 0 0 0 0\nORAEndData;\nORAReadForeignData;\n"
                f"}} restore{name}: $FreeformSurface_{int(name == 'Rear')};\n"
            )
