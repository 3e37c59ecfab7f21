"""The LightTools archive: one `.npz` with the sampled surface, the exact B-spline beside it, and the whole scene.

Lengths are mm, powers W (or lm), angles degrees.  Reals are float64, counts (`shape`, `resolution`, `degrees`,
`format_version`) int64, names strings; `numpy.load` reads it with allow_pickle=False.  Grids are indexed [i, j], i
along +x and j along +y, and flattened row-major: x varies slowest.  `archive_keys` lists every key for the manual.

Arrays are compressed by deflate, those of points column by column, in a fixed order and without the time of writing.  The control
points and the cloud of a large net are rounded by less than 0.05 nm, its normals by 1e-7, so that they can be compressed; those of
a smaller one, or of any on request, are exact.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.export import reading
from caustic_cli.export.reading import Readings
from caustic_cli.export.supported import EXPORT
from caustic_cli.export.surface import Sampling, control_points, sample_grid, samplings
from caustic_cli.io.files import MARK, atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Aperture, Lens, Light, Scene, Screen, Source
from caustic_cli.scene.elements import SIDES

FORMAT_VERSION = 1
#: Quantum of rounded heights, mm, a power of two, and of the components of normals; least control points of a rounded net.
QUANTUM, NORMAL_QUANTUM = 2.0**-24, 2.0**-23
LARGE = 1 << 20
#: Bytes of a point of the cloud and of a control point, compressed: exact and rounded; approximate bytes of all other arrays.
A_POINT, A_POLE, BESIDE = (42.0, 12.0), (9.0, 4.5), 100_000
#: The reading by which the density of the cloud is chosen: the spline is stored whatever the cloud.
CHOSEN_BY = "cloud_error"
#: Level of the compression; higher ones take several times as long for a hundredth.
LEVEL = 4


def write_lighttools(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: Sampling | None = None,
    tolerance: float | None = None,
) -> None:
    """Write the archive atomically: a point cloud, and the spline itself.

    Keys: points, normals (N, 3); shape (2,); x (nx,), y (ny,), z (nx, ny); lens_half_size (2,), z_in, refractive_index;
    screen_half_size (2,), z_screen, resolution (2,); those of `_screen` and `_sources`; fresnel unless exact; aperture if a circle;
    mirror, 1, of one; those of `_lens`, `_light` and `_elements`; those of `_entrance` where it is
    free-form; control_points (n, m, 3) with x, y at the Greville abscissae, degrees (2,), knots_u, knots_v on [0, 1]; unit,
    format_version, created_by.

    Args:
        heights: (n, m) control heights, mm.
        samples: density of the point cloud.
        tolerance: 0 for exact numbers, whatever the size of the file.

    Raises:
        InputError: the samples are too few or too many, the tolerance is not 0, or the file cannot be written there.
    """
    rounding = _rounding(field, tolerance)
    grid = sample_grid(field, heights, samples)
    points, normals = grid.points, grid.normals
    net = _net(heights, rounding)
    if rounding:
        points[:, 2] = _multiples(points[:, 2], QUANTUM)
        normals = _multiples(normals, NORMAL_QUANTUM)
    arrays = {
        "points": np.asfortranarray(points),
        "normals": np.asfortranarray(normals),
        "shape": np.array(grid.shape, np.int64),
        "x": grid.x,
        "y": grid.y,
        "z": points[:, 2].reshape(grid.shape),
        "lens_half_size": _reals(scene.lens.half_size),
        "z_in": _reals(scene.lens.z_in),
        "refractive_index": _reals(scene.lens.index),
        "screen_half_size": _reals(scene.screen.half_size),
        "z_screen": _reals(scene.screen.z),
        "resolution": np.array(scene.screen.resolution, np.int64),
        **_screen(scene.screen),
        **_sources(scene),
        **_lens(scene.lens),
        **_light(scene.light),
        "control_points": np.asfortranarray(control_points(field, net)),
        "degrees": np.array([s.degree for s in field.spaces], np.int64),
        "knots_u": field.spaces[0].knots.numpy(),
        "knots_v": field.spaces[1].knots.numpy(),
        **_entrance(scene),
        **_elements(scene),
        "unit": np.array("mm"),
        "format_version": np.array(FORMAT_VERSION, np.int64),
        "created_by": np.array(f"caustic {__version__}"),
    }
    _write(path, arrays)


def _write(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    """Write the archive of these arrays, in their order."""
    with atomic_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # dated 1980-01-01
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
        archive.comment = MARK


def choices(scene: Scene, field: HeightField, heights: Tensor, limit: float) -> list[dict]:
    """Densities of the cloud in archives of at most `limit` bytes, the smallest first."""
    nets = [field.shape] if scene.lens.entrance is None else [field.shape, entrance_of(scene.lens).field.shape]
    rounding = _rounding(field)
    room = limit - BESIDE - A_POLE[rounding] * sum(math.prod(shape) for shape in nets)
    return [{"samples": s} for s in samplings(field.spaces, max(4.0, room / A_POINT[rounding]))]


def readings(
    scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None, tolerance: float | None = None
) -> Readings:
    """The surface as read from the control points, and from the cloud."""
    rounding = _rounding(field, tolerance)
    grid = sample_grid(field, heights, samples)
    return {
        "error": lambda: reading.of_poles(field, torch.from_numpy(_net(heights, rounding))),
        "cloud_error": lambda: reading.of_points(grid.x, grid.y, _multiples(grid.z, QUANTUM) if rounding else grid.z),
    }


def _rounding(field: HeightField, tolerance: float | None = None) -> bool:
    """Whether the numbers of an archive are rounded; refuses a tolerance other than 0."""
    if tolerance:
        raise InputError(f"⟨tolerance⟩ of a LightTools archive must be 0, for exact numbers, or not given, got {tolerance:g} mm")
    return tolerance is None and math.prod(field.shape) >= LARGE


def _net(heights: Tensor, rounding: bool) -> np.ndarray:
    net = heights.detach().double().cpu().numpy()
    return _multiples(net, QUANTUM) if rounding else net


def _multiples(values: np.ndarray, quantum: float) -> np.ndarray:
    """Values rounded to multiples of a quantum, which end in zeros that can be compressed."""
    return np.rint(values / quantum) * quantum


def _unusual(lens: Lens) -> tuple[tuple[str, str | np.int64, str | int], ...]:
    """Optional keys of the lens, and the values with which they are left out."""
    return ("aperture", lens.aperture, Aperture.name), ("mirror", np.int64(lens.mirror), 0), ("fresnel", lens.fresnel, "exact")


def _glass(lens: Lens) -> dict[str, np.ndarray]:
    """Optional keys of the glass: absorption, 1/mm; roughness, RMS slope; glass, name of the material."""
    found = {key: _reals(getattr(lens, key)) for key in ("absorption", "roughness") if getattr(lens, key)}
    return found if lens.glass is None else found | {"glass": np.array(lens.glass)}


def _gradient(lens: Lens) -> dict[str, np.ndarray]:
    """Optional keys of an index that varies: gradient, the word of its formula or volume, with gradient_terms (k,), mm^-i, or
    gradient_volume (a, b, k), control values of the index; see `scene.gradient`."""
    given = lens.gradient
    if given is None:
        return {}
    if given.volume is not None:
        return {"gradient": np.array(given.kind), "gradient_volume": _reals(given.volume)}
    return {"gradient": np.array(given.kind), "gradient_terms": _reals(given.terms)}


def _lens(lens: Lens) -> dict[str, np.ndarray]:
    """Optional keys of the lens: those that are not as usual, and of `_gradient`, `_lenslets` and `_glass`."""
    found = {key: np.array(value) for key, value, usual in _unusual(lens) if value != usual}
    return found | _gradient(lens) | _lenslets(lens) | _glass(lens)


def _lenslets(lens: Lens) -> dict[str, np.ndarray]:
    """Optional keys of round lenslets, between which it is opaque: lenslets (2,), their numbers along x and y, lenslet_packing, and
    lenslet_centres (k, 2) and lenslet_radius, mm."""
    if not lens.round_lenslets:
        return {}
    return {
        "lenslets": np.array(lens.array, np.int64),
        "lenslet_packing": np.array(lens.packing),
        "lenslet_centres": _reals(lens.cells.centres),
        "lenslet_radius": _reals(lens.cells.radius),
    }


def _light(light: Light) -> dict[str, np.ndarray]:
    """Optional keys of the light: source_power_unit, unless W; source_wavelengths (k,), nm, with source_weights (k,); where they
    are samples of a continuous spectrum, source_spectrum (m, 2), nm and relative power per nm, and source_detector, eye or power;
    source_efficacy, lm/W, if known; source_color, 1, if these are those of a coloured picture; source_polarisation, degrees from
    +x."""
    found = {} if light.unit == "W" else {"source_power_unit": np.array(light.unit)}
    found |= _spectrum(light)
    if light.efficacy is not None:
        found["source_efficacy"] = _reals(light.efficacy)
    if light.color:
        found["source_color"] = np.array(1, np.int64)
    return found if light.polarisation is None else found | {"source_polarisation": _reals(light.polarisation)}


def _spectrum(light: Light) -> dict[str, np.ndarray]:
    """Its wavelengths and weights, and the continuous spectrum that they are samples of."""
    found = {}
    if (measure := light.measure) is not None:
        whole = measure.spectrum
        found = {"source_spectrum": np.stack([whole.wavelengths, whole.power], 1), "source_detector": np.array(measure.detector)}
    if not light.wavelengths:
        return found
    return found | {"source_wavelengths": _reals(light.wavelengths), "source_weights": _reals(light.fractions)}


def _entrance(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of a free-form entrance: entrance_control_points (n, m, 3), entrance_degrees, entrance_knots_u, entrance_knots_v."""
    if scene.lens.entrance is None:
        return {}
    front = entrance_of(scene.lens)
    u, v = front.field.spaces
    return {
        "entrance_control_points": control_points(front.field, front.heights.numpy() + scene.lens.z_in),
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
    """Optional keys of the screen: `screen_far`, 1, of the far field, whose lengths are those in the focus of a lens of the focal
    length |z_screen|; `screen_tilt` (2,) and `screen_turn`, degrees, `screen_shift` (2,), mm, and of a curved one
    `screen_curvature` (2,), 1/mm along x and y, 0 along a cylinder, or `screen_sag` (a, b), mm along its normal, [i, j] on a
    regular grid over `screen_sag_half_size` (2,), mm about its centre."""
    (*tilt, turn), shift = (*screen.tilt, 0.0)[:3], screen.shift
    found = {key: _reals(value) for key, value in (("tilt", tilt), ("turn", turn), ("shift", shift)) if np.any(value)}
    found = {f"screen_{key}": value for key, value in found.items()}
    if screen.far:
        found["screen_far"] = np.array(1, np.int64)
    if screen.rounded:
        found["screen_curvature"] = 1.0 / _reals(screen.radius)
    if screen.sags is not None:
        found |= {"screen_sag": _reals(screen.sags.values), "screen_sag_half_size": 0.5 * _reals(screen.sags.size)}
    return found


def _sources(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of the source; of k simultaneous ones source_type "several", source_count (1,), and of each those of a single source
    and of its light with its number: source_1_type, source_1_positions, ..., source_1_cone_half_angle, source_1_wavelengths.

    The power of each is its own; source_wavelengths and source_weights are those of the light of all.
    """
    if len(scene.by_source) == 1:
        return _source(scene)
    found = {"source_type": np.array("several"), "source_count": np.array([len(scene.by_source)], np.int64)}
    for k, one in enumerate(scene.by_source, 1):
        own = _source(one) | _spectrum(one.light)
        found |= {f"source_{k}_{key.removeprefix('source_')}": value for key, value in own.items()}
    return found


def _source(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of a single source.  A plane wave has no positions, one power, and cone 0.

    `source_power` (k,), of each position; (1,), through the aperture, for a plane wave or a disc at infinity.  `source_profile`
    (a, b), the relative irradiance over the aperture [i, j], only for a non-uniform wave; `source_size` (2,) mm
    or `source_angle` (full, degrees) only for a disc; `source_intensity` where there is a cone, with
    `source_intensity_table` (k, 2), degrees and relative intensity, if that is a table; `source_brightness` (a, b), the relative
    radiance over a disc's rectangle [i, j], if that is given by a picture.

    Raises:
        InputError: the format does not support this type of source.
    """
    EXPORT["lighttools"].refuse(scene, format="lighttools")
    source = scene.source
    return {
        "source_type": np.array(source.kind),
        "source_positions": source.points()[0],
        "source_power": _reals(source.powers),
        **_KEYS[source.kind](scene),
    }


def _of_plane(scene: Scene) -> dict[str, np.ndarray]:
    wave = scene.source
    profile = {} if wave.profile is None else {"source_profile": _reals(wave.profile)}
    return {"cone_half_angle": _reals(0.0)} | profile | _tilt(wave)


def _tilt(source: Source) -> dict[str, np.ndarray]:
    return {"source_tilt": _reals(source.tilt)} if source.lean else {}


def _of_points(scene: Scene) -> dict[str, np.ndarray]:
    source, lens = scene.source, scene.lens
    return {"cone_half_angle": _reals(np.degrees(source.cone_over(lens.pupil))), **_intensity(source)}


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
        return {"cone_half_angle": _reals(source.angle / 2.0), "source_angle": _reals(source.angle)} | light | _tilt(source)
    return _of_points(scene) | {"source_size": _reals(source.size)} | light


def _of_rays(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of a ray file, which is not included: the cone about the point where its rays are closest to each other, and
    `source_rays_sha256`, by which the file is recognised."""
    source, lens = scene.source, scene.lens
    cone = _reals(np.degrees(source.cone_over(lens.pupil)))
    return {"cone_half_angle": cone, "source_rays_sha256": np.array(source.rays.digest)} | _tilt(source)


def _of_beam(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of a Gaussian beam: source_wavelength, nm, source_waist (2,) and source_waist_at, mm, and source_m2."""
    beam = scene.source
    size = {"source_waist": _reals(beam.waist), "source_waist_at": _reals(beam.waist_at), "source_m2": _reals(beam.m2)}
    return {"cone_half_angle": _reals(0.0), "source_wavelength": _reals(beam.wavelength), **size} | _tilt(beam)


def _of_measured(scene: Scene) -> dict[str, np.ndarray]:
    """Keys of a measured beam: source_wavelength, nm, source_phase (a, b), rad over the aperture [i, j], and source_profile."""
    beam = scene.source
    light = {} if beam.profile is None else {"source_profile": _reals(beam.profile)}
    found = {"source_wavelength": _reals(beam.wavelength), "source_phase": _reals(beam.phase)}
    return {"cone_half_angle": _reals(0.0)} | found | light


#: Further keys of a source, by its kind.
_KEYS = {
    "plane": _of_plane,
    "point": _of_points,
    "grid": _of_points,
    "disc": _of_disc,
    "rays": _of_rays,
    "gaussian": _of_beam,
    "measured": _of_measured,
}


def _reals(value) -> np.ndarray:
    """`value` as a float64 array of its own shape."""
    return np.array(value, np.float64)
