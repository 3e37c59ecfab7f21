"""The LightTools archive: one `.npz` with the sampled surface, the exact B-spline beside it, and the whole scene.

Lengths are mm, powers W (or lm), angles degrees.  Reals are float64, counts (`shape`, `resolution`, `degrees`,
`format_version`) int64, names strings; `numpy.load` reads it with allow_pickle=False.  Grids are indexed [i, j], i
along +x and j along +y, and flattened row-major: x varies slowest.

Arrays are stored uncompressed, in a fixed order and without the time of writing, so that the same lens gives the same
bytes whatever the day or the zlib.
"""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.export.accuracy import Deviation, of_poles, of_spline
from caustic_cli.export.approximation import on_fewer_knots
from caustic_cli.export.surface import USUAL_BYTES, SurfaceGrid, most_points, sample_grid
from caustic_cli.io.files import MARK, atomic_path
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Lens, Light, Scene, Screen, Source
from caustic_cli.scene.elements import SIDES

FORMAT_VERSION = 1
#: Bytes of a point in `points`, `normals` and `z`, and of a control point; approximate bytes of all but these.
A_POINT, A_POLE, BESIDE = 7 * 8, 3 * 8, 100_000


def write_lighttools(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: tuple[int, int] | None = None,
    tolerance: float | None = None,
) -> Deviation:
    """Write the archive atomically; the deviation of a spline through its point cloud.  The exact spline is stored with it, or, if
    that alone would exceed `USUAL_BYTES`, an approximation on fewer knots within half of these.

    Keys: points, normals (N, 3); shape (2,); x (nx,), y (ny,), z (nx, ny); lens_half_size (2,), z_in, refractive_index;
    screen_half_size (2,), z_screen, resolution (2,); those of `_screen` and `_source`; fresnel unless exact; aperture if a circle;
    mirror, 1, of one; those of `_glass`, `_light` and `_elements`; those of `_entrance` where it is free-form; control_points
    (n, m, 3) with x, y at the Greville abscissae, degrees (2,), knots_u, knots_v on [0, 1]; unit, format_version, created_by.

    Args:
        heights: (n, m) control heights, mm.
        samples: (nx, ny) of the point cloud; None for as many as `USUAL_BYTES` allow, at most a grid on the knots (`sample_grid`).
        tolerance: 0 for the exact spline, whatever its size.

    Raises:
        InputError: the samples are too few or too many, the tolerance is not 0, or the file cannot be written there.
    """
    if tolerance:
        raise InputError(f"⟨tolerance⟩ of a LightTools archive must be 0, for the exact spline, or not given, got {tolerance:g} mm")
    exact = tolerance == 0 or heights.numel() * A_POLE <= USUAL_BYTES
    grid = usual_cloud(scene, field, heights, samples)
    written = (field, heights) if exact else on_fewer_knots(field, heights, USUAL_BYTES // 2 // A_POLE)
    x, y = (c.numpy() for c in written[0].control_xy())
    x, y = np.broadcast_arrays(x[:, None], y[None, :])
    arrays = {
        "points": grid.points,
        "normals": grid.normals,
        "shape": np.array(grid.z.shape, np.int64),
        "x": grid.x,
        "y": grid.y,
        "z": grid.z,
        "lens_half_size": _reals(scene.lens.half_size),
        "z_in": _reals(scene.lens.z_in),
        "refractive_index": _reals(scene.lens.index),
        "screen_half_size": _reals(scene.screen.half_size),
        "z_screen": _reals(scene.screen.z),
        "resolution": np.array(scene.screen.resolution, np.int64),
        **_screen(scene.screen),
        **_source(scene),
        **({"aperture": np.array("circle")} if scene.lens.round else {}),
        **({"mirror": np.array(1, np.int64)} if scene.lens.mirror else {}),
        **({} if scene.lens.fresnel == "exact" else {"fresnel": np.array(scene.lens.fresnel)}),
        **_glass(scene.lens),
        **_light(scene.light),
        "control_points": np.stack([x, y, written[1].detach().double().cpu().numpy()], -1),
        "degrees": np.array([s.degree for s in written[0].spaces], np.int64),
        "knots_u": written[0].spaces[0].knots.numpy(),
        "knots_v": written[0].spaces[1].knots.numpy(),
        **_entrance(scene),
        **_elements(scene),
        "unit": np.array("mm"),
        "format_version": np.array(FORMAT_VERSION, np.int64),
        "created_by": np.array(f"caustic {__version__}"),
    }
    with atomic_path(path) as temporary, open(temporary, "w+b") as file:  # an open file: savez would rename `lens.dat`
        np.savez(file, **arrays)  # dates every entry 1980-01-01
        with zipfile.ZipFile(file, "a") as archive:
            archive.comment = MARK
    off = of_spline(grid, field, heights)
    return off if exact else replace(off, spline=of_poles(arrays["control_points"], written[0], field, heights))


def usual_cloud(scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None) -> SurfaceGrid:
    """Grid of the point cloud of an archive; arguments as in `write_lighttools`.  Large splines leave it half of `USUAL_BYTES`."""
    nets = A_POLE * (heights.numel() + (0 if scene.lens.entrance is None else entrance_of(scene.lens).heights.numel()))
    return sample_grid(field, heights, samples, most_points(A_POINT, min(nets, USUAL_BYTES // 2) + BESIDE))


def _glass(lens: Lens) -> dict[str, np.ndarray]:
    """Optional keys of the glass: absorption, 1/mm; roughness, RMS slope; glass, name of the material."""
    found = {key: _reals(getattr(lens, key)) for key in ("absorption", "roughness") if getattr(lens, key)}
    return found if lens.glass is None else found | {"glass": np.array(lens.glass)}


def _light(light: Light) -> dict[str, np.ndarray]:
    """Optional keys of the light: source_power_unit, unless W; source_wavelengths (k,), nm, with source_weights (k,); source_color,
    1, if these are those of a coloured picture; source_polarisation, degrees from +x."""
    found = {} if light.unit == "W" else {"source_power_unit": np.array(light.unit)}
    if light.wavelengths:
        found |= {"source_wavelengths": _reals(light.wavelengths), "source_weights": _reals(light.parts)}
    if light.color:
        found["source_color"] = np.array(1, np.int64)
    return found if light.polarisation is None else found | {"source_polarisation": _reals(light.polarisation)}


def _entrance(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of a free-form entrance: entrance_control_points (n, m, 3), entrance_degrees, entrance_knots_u, entrance_knots_v."""
    if scene.lens.entrance is None:
        return {}
    front = entrance_of(scene.lens)
    x, y = (c.numpy() for c in front.field.control_xy())
    x, y = np.broadcast_arrays(x[:, None], y[None, :])
    u, v = front.field.spaces
    return {
        "entrance_control_points": np.stack([x, y, front.heights.numpy() + scene.lens.z_in], -1),
        "entrance_degrees": np.array([u.degree, v.degree], np.int64),
        "entrance_knots_u": u.knots.numpy(),
        "entrance_knots_v": v.knots.numpy(),
    }


def _elements(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of k other lenses and mirrors, in the order of the light: element_type, element_aperture, and element_glass if one is of
    a glass, k words separated by commas, the last empty for an index; element_z, element_thickness, element_index,
    element_absorption (k,); element_curvature (k, 2), 1/mm, of front and back; element_size, element_tilt (k, 2), degrees; of
    designed surfaces element_1_front_heights (n, m) from their vertex' plane, mm, with their degrees, knots_u and knots_v.  Behind
    a mirror z counts along the folded axis."""
    found, elements = {}, scene.elements
    if not elements:
        return {}
    for key, name in (("type", "kind"), ("aperture", "aperture")):
        found[f"element_{key}"] = np.array(",".join(getattr(e, name) for e in elements))
    if any(e.glass for e in elements):
        found["element_glass"] = np.array(",".join(e.glass or "" for e in elements))
    for key in ("z", "thickness", "index", "absorption", "size", "tilt"):
        found[f"element_{key}"] = _reals([getattr(e, key) for e in elements])
    found["element_curvature"] = 1.0 / _reals([e.radius for e in elements])
    for k, e in enumerate(elements):
        for side, front in zip(SIDES, e.surfaces, strict=True):
            if front is not None and front.knots is not None:
                name = f"element_{k + 1}_{side}_"
                found |= {
                    f"{name}heights": _reals(front.heights),
                    f"{name}degrees": np.array(front.degree, np.int64),
                    f"{name}knots_u": _reals(front.knots[0]),
                    f"{name}knots_v": _reals(front.knots[1]),
                }
    return found


def _screen(screen: Screen) -> dict[str, np.ndarray]:
    """Optional keys of the screen: `screen_tilt` (2,), degrees, `screen_shift` (2,), mm, and of a curved one
    `screen_curvature` (2,), 1/mm along x and y, 0 along a cylinder, or `screen_sag` (a, b), mm along its normal, [i, j] on a
    regular grid over `screen_sag_half_size` (2,), mm about its centre."""
    found = {f"screen_{key}": _reals(getattr(screen, key)) for key in ("tilt", "shift") if any(getattr(screen, key))}
    if screen.rounded:
        found["screen_curvature"] = 1.0 / _reals(screen.radius)
    if screen.sags is not None:
        found |= {"screen_sag": _reals(screen.sags.values), "screen_sag_half_size": 0.5 * _reals(screen.sags.size)}
    return found


def _source(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of the source.  A plane wave has no positions, one power, and cone 0.

    `source_power` (k,), of each position; (1,), through the aperture, for a plane wave or a disc at infinity.  `source_profile`
    (a, b), the relative irradiance over the aperture [i, j], only for a non-uniform wave; `source_size` (2,) mm
    or `source_angle` (full, degrees) only for a disc; `source_intensity` where there is a cone, with
    `source_intensity_table` (k, 2), degrees and relative intensity, if that is a table; `source_brightness` (a, b), the relative
    radiance over a disc's rectangle [i, j], if that is given by a picture.

    Raises:
        InputError: the format does not support this type of source.
    """
    source = scene.source
    if source.kind not in _KEYS:
        raise InputError(f"⟨format⟩ lighttools does not support sources of type {source.kind}")
    return {
        "source_type": np.array(source.kind),
        "source_positions": source.points()[0],
        "source_power": _reals(source.powers),
        **_KEYS[source.kind](scene),
    }


def _of_plane(scene: Scene) -> dict[str, np.ndarray]:
    profile = scene.source.profile
    return {"cone_half_angle": _reals(0.0)} | ({} if profile is None else {"source_profile": _reals(profile)})


def _of_points(scene: Scene) -> dict[str, np.ndarray]:
    source, lens = scene.source, scene.lens
    return {"cone_half_angle": _reals(np.degrees(source.cone_over(lens.half_size, lens.z_in, lens.round))), **_intensity(source)}


def _intensity(source: Source) -> dict[str, np.ndarray]:
    """Keys of the intensity: a word, or "table" with angles and intensities."""
    given = source.intensity
    if isinstance(given, str):
        return {"source_intensity": np.array(given)}
    return {"source_intensity": np.array("table"), "source_intensity_table": _reals((given.angles, given.values)).T}


def _of_disc(scene: Scene) -> dict[str, np.ndarray]:
    source = scene.source
    light = {} if source.brightness is None else {"source_brightness": _reals(source.brightness)}
    if source.distant:
        return {"cone_half_angle": _reals(source.angle / 2.0), "source_angle": _reals(source.angle)} | light
    return _of_points(scene) | {"source_size": _reals(source.size)} | light


def _of_rays(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of a ray file, which is not included: the cone about the point where its rays are closest to each other, and
    `source_rays_sha256`, by which the file is recognised."""
    source, lens = scene.source, scene.lens
    cone = _reals(np.degrees(source.cone_over(lens.half_size, lens.z_in, lens.round)))
    return {"cone_half_angle": cone, "source_rays_sha256": np.array(source.rays.digest)}


#: Further keys of a source, by its kind.
_KEYS = {"plane": _of_plane, "point": _of_points, "grid": _of_points, "disc": _of_disc, "rays": _of_rays}


def _reals(value) -> np.ndarray:
    """`value` as a float64 array of its own shape."""
    return np.array(value, np.float64)
