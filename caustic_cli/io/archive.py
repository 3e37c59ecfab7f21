"""Reader of exported `.npz` archives: scene and lens, for tracing without the project."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io.arrays import Archive, open_npz
from caustic_cli.io.files import naming
from caustic_cli.io.surfaces import ACCEPTED, MAX_CONTROL, surface_of
from caustic_cli.optics.bounds import check_exit_above_entrance
from caustic_cli.optics.bspline import MAX_DEGREE
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import freeform_of
from caustic_cli.scene import Component, Disc, FreeForm, Lens, Light, Offset, PlaneWave, Points, Scene, Screen, Source
from caustic_cli.scene.elements import COMPONENTS, SIDES
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.light import MAX_WAVELENGTHS
from caustic_cli.scene.materials import material
from caustic_cli.scene.screen import MAX_SAGS, Sags, tilted
from caustic_cli.scene.sources.distribution import MOST_ANGLES, Distribution
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.measured_beam import MeasuredBeam
from caustic_cli.scene.sources.points import MAX_POINTS
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import MOST, Several, together
from caustic_cli.scene.spectrum import MOST_ROWS, Measure, Spectrum, luminous_efficacy
from caustic_cli.schema.table import check

#: Keys of a source and of its spectrum.
KEYS = (
    *("cone_half_angle", "source_type", "source_positions", "source_power", "source_profile", "source_size"),
    *("source_angle", "source_tilt"),
    *("source_intensity", "source_intensity_table", "source_brightness", "source_rays_sha256"),
    *("source_wavelength", "source_waist", "source_waist_at", "source_m2", "source_phase"),
    *("source_wavelengths", "source_weights", "source_spectrum", "source_detector", "source_efficacy"),
)
#: Numbers of a Gaussian beam.
BEAM = ("source_wavelength", "source_waist_at", "source_m2")
#: Most cells along an axis of a picture of a source, and terms of a gradient.
MOST_CELLS, MOST_TERMS = 1 << 16, 64
#: Signs of x and y in the four quadrants.
CORNERS = (-1.0, -1.0, 1.0, 1.0), (-1.0, 1.0, -1.0, 1.0)


def open_archive(path: str | Path, rays: RaySet | None = None) -> tuple[Scene, HeightField, Tensor]:
    """Scene, spline spaces and control heights (n, m) mm of an archive made by `caustic export format lighttools`.

    rays: those of its source, if that is a ray file, which an archive does not contain.

    Raises:
        InputError: it cannot be read, something is missing, the rays are missing or others, or something is out of range.
    """
    with open_npz(Path(path), ACCEPTED) as data:
        field, heights = surface_of(data)
        array = _lenslets(data)
        lens = Lens(
            size=tuple(2.0 * h for h in field.half_size),
            z_in=data.real("z_in"),
            index=data.real("refractive_index"),
            control=field.shape,
            degree=tuple(s.degree for s in field.spaces),
            knots=None if array else tuple(tuple(s.knots.tolist()) for s in field.spaces),
            fresnel=data.text("fresnel", "exact"),
            aperture=data.text("aperture", "rectangle"),
            mirror="mirror" in data,
            absorption=data.real("absorption") if "absorption" in data else 0.0,
            roughness=data.real("roughness") if "roughness" in data else 0.0,
            glass=data.text("glass") if "glass" in data else None,
            gradient=_gradient(data),
            **array,
        )
        place = lens.interaction.first((0.0, 0.0), lambda: lens.opening.on_edge)  # at the edge of a mirror
        x, y = (c * torch.tensor(signs, dtype=torch.float64) for c, signs in zip(place, CORNERS, strict=True))
        lens = replace(lens, offset=Offset(float(field.at(heights, x, y, ((0, 0),))[0].mean())))
        if lens.glass is not None:
            material(lens.glass)
        if "entrance_control_points" in data:
            entrance, low = surface_of(data, "entrance_")
            lens = replace(lens, entrance=freeform_of(entrance, low - lens.z_in))
        screen = _screen(data)
        scene = Scene(_source(data, rays), lens, screen, _light(data), elements=_elements(data))
        check_exit_above_entrance(scene, field, heights)
        return scene, field, heights


def _gradient(data: Archive) -> Gradient | None:
    """An index that varies, or None; see `export/lighttools.py`."""
    if "gradient" not in data:
        return None
    if "gradient_volume" in data:
        return Gradient(data.text("gradient"), volume=data.reals("gradient_volume", None, None, None, most=MOST_CELLS))
    return Gradient(data.text("gradient"), tuple(data.reals("gradient_terms", None, most=MOST_TERMS).tolist()))


def _lenslets(data: Archive) -> dict[str, Any]:
    """Round lenslets as arguments of a lens; empty without them."""
    if "lenslets" not in data:
        return {}
    return {"array": data.wholes("lenslets", 2), "packing": data.text("lenslet_packing"), "lenslets": "round"}


def _light(data: Archive) -> Light:
    """Wavelengths and polarisation; see `export/lighttools.py`."""
    wavelengths, weights = _spectrum(data)
    polarisation = data.real("source_polarisation") if "source_polarisation" in data else None
    return Light(
        polarisation,
        wavelengths,
        weights,
        color="source_color" in data,
        unit=data.text("source_power_unit", "W"),
        measure=_measure(data),
        efficacy=data.real("source_efficacy") if "source_efficacy" in data else None,
    )


def _measure(data: Archive) -> Measure | None:
    """The continuous spectrum, or None."""
    if "source_spectrum" not in data:
        return None
    columns = data.reals("source_spectrum", None, 2, most=MOST_ROWS)
    with naming("source_spectrum"):
        return Measure(Spectrum("source_spectrum", *columns.T), data.text("source_detector", "eye"))


def _spectrum(data: Archive) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Wavelengths, nm, and weights; empty if absent."""
    wavelengths, weights = (
        tuple(data.reals(f"source_{key}", None, most=MAX_WAVELENGTHS).tolist()) if f"source_{key}" in data else ()
        for key in ("wavelengths", "weights")
    )
    return wavelengths, weights


def _elements(data: Archive) -> tuple[Component, ...]:
    """Other lenses and mirrors; see `export/lighttools.py`."""
    if "element_type" not in data:
        return ()
    kinds, apertures = (data.text(f"element_{key}").split(",") for key in ("type", "aperture"))
    count = len(kinds)
    glasses = data.text("element_glass", "," * (count - 1)).split(",")
    for key, words in (("aperture", apertures), ("glass", glasses)):
        if len(words) != count:
            raise InputError(f"element_{key} must be {count} words separated by commas, got {len(words)}")
    for glass in filter(None, glasses):
        material(glass)
    z, thickness, index, absorption = (
        data.reals(f"element_{key}", count).tolist() for key in ("z", "thickness", "index", "absorption")
    )
    size, tilt, bent = (data.reals(f"element_{key}", count, 2).tolist() for key in ("size", "tilt", "curvature"))
    return tuple(
        COMPONENTS[check("element.type", kinds[k])](
            z[k],
            tuple(size[k]),
            thickness[k],
            tuple(1.0 / c if c else math.inf for c in bent[k]),
            index[k],
            absorption[k],
            glasses[k] or None,
            apertures[k],
            tilt=tuple(tilt[k]),
            surfaces=tuple(_front(data, f"element_{k + 1}_{side}_") for side in SIDES),
        )
        for k in range(count)
    )


def _front(data: Archive, name: str) -> FreeForm | None:
    """A designed surface of another element, or None."""
    if f"{name}heights" not in data:
        return None
    heights, degree = data.reals(f"{name}heights", None, None, most=MAX_CONTROL), data.wholes(f"{name}degrees", 2)
    u, v = (data.reals(f"{name}knots_{axis}", None, most=MAX_CONTROL + MAX_DEGREE + 1).tolist() for axis in "uv")
    if [len(u), len(v)] != [n + p + 1 for n, p in zip(heights.shape, degree, strict=True)]:
        raise InputError(f"{name}knots must have control + degree + 1 entries along each axis")
    return FreeForm(heights, degree, (u, v))


def _screen(data: Archive) -> Screen:
    sags = None
    if "screen_sag" in data:
        width, height = (2.0 * h for h in data.reals("screen_sag_half_size", 2).tolist())
        sags = Sags(data.reals("screen_sag", None, None, most=MAX_SAGS), (width, height))
    return Screen(
        tuple(2.0 * h for h in data.reals("screen_half_size", 2).tolist()),
        data.real("z_screen"),
        data.wholes("resolution", 2),
        (*_pair(data, "screen_tilt"), *((data.real("screen_turn"),) if "screen_turn" in data else ())),
        _pair(data, "screen_shift"),
        _radius(data),
        sags,
        far="screen_far" in data,
    )


def _pair(data: Archive, key: str) -> tuple[float, float]:
    a, b = data.reals(key, 2).tolist() if key in data else (0.0, 0.0)
    return a, b


def _radius(data: Archive) -> tuple[float, float]:
    x, y = (1.0 / k if k else math.inf for k in _pair(data, "screen_curvature"))
    return x, y


def _source(data: Archive, rays: RaySet | None) -> Source:
    kind = data.text("source_type")
    if kind == "several":
        return _several(data, rays)
    if kind == "rays":
        return _measured(data, rays)
    if kind not in _READERS:
        raise InputError(f"source_type must be {', '.join(_READERS)}, rays or several, got {kind!r}")
    if rays is not None:
        raise InputError(f"⟨source.file⟩ belongs to an archive whose source is a ray file, and this one's is of type {kind}")
    return _READERS[kind](data)


def _several(data: Archive, rays: RaySet | None) -> Several:
    """Several sources, of which those that are ray files have these rays."""
    (count,) = data.wholes("source_count", 1)
    members, lights, files = [], [], 0
    unit = data.text("source_power_unit", "W")
    for k in range(1, min(count, MOST) + 1):
        with naming(f"source {k}"):
            one = data.renamed({key: f"source_{k}_{key.removeprefix('source_')}" for key in KEYS})
            if one.text("source_type") == "several":
                raise InputError("source_type must be that of a single source, got 'several'")
            files += one.text("source_type") == "rays"
            members.append(_source(one, rays if one.text("source_type") == "rays" else None))
            measure = _measure(one)
            efficacy = None if measure is None else luminous_efficacy(measure.spectrum)
            lights.append(Light(None, *_spectrum(one), unit=unit, measure=measure, efficacy=efficacy))
    if rays is not None and not files:
        raise InputError("⟨source.file⟩ belongs to an archive whose source is a ray file, and none of this one's is")
    return together(members, lights)


def _measured(data: Archive, rays: RaySet | None) -> Measured:
    """A ray file at the position at which its point of closest approach is that of the archive."""
    if rays is None:
        raise InputError("its source is a ray file, which an archive does not contain: ⟨+source.file⟩ names it")
    if "source_rays_sha256" in data and data.text("source_rays_sha256") != rays.digest:
        raise InputError("⟨source.file⟩ holds other rays than those of its source; render its project under another light")
    tilt = _pair(data, "source_tilt")
    x, y, z = (np.array(tilted(tilt)) @ _positions(data)[0] - rays.focus).tolist()
    return Measured(rays, (x, y, z), _power(data), tilt)


def _plane(data: Archive) -> PlaneWave:
    return PlaneWave(_power(data), _picture(data, "source_profile"), _pair(data, "source_tilt"))


def _points(data: Archive) -> Points:
    powers = data.reals("source_power", None, most=MAX_POINTS).tolist()
    return Points(_positions(data), tuple(powers), kind=data.text("source_type"), **_shining(data))


def _disc(data: Archive) -> Disc:
    brightness = _picture(data, "source_brightness")
    if "source_angle" in data:
        return Disc(power=_power(data), angle=data.real("source_angle"), brightness=brightness, tilt=_pair(data, "source_tilt"))
    size = tuple(data.reals("source_size", 2).tolist())
    return Disc(_positions(data)[0], size, _power(data), brightness=brightness, **_shining(data))


def _gaussian(data: Archive) -> Gaussian:
    waist, (wavelength, waist_at, m2) = _pair(data, "source_waist"), map(data.real, BEAM)
    return Gaussian(waist, wavelength, waist_at, m2, _pair(data, "source_tilt"), _power(data))


def _measured_beam(data: Archive) -> MeasuredBeam:
    phase = data.reals("source_phase", None, None, most=MOST_CELLS)
    return MeasuredBeam(phase, data.real("source_wavelength"), _picture(data, "source_profile"), _power(data))


#: Readers of a source by its kind: see `export/lighttools.py`.
_READERS = {"plane": _plane, "point": _points, "grid": _points, "disc": _disc, "gaussian": _gaussian, "measured": _measured_beam}


def _power(data: Archive) -> float:
    return float(data.reals("source_power", 1)[0])


def _picture(data: Archive, name: str) -> np.ndarray | None:
    """Relative irradiance or radiance (a, b), None if absent."""
    return data.reals(name, None, None, most=MOST_CELLS) if name in data else None


def _positions(data: Archive) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(p) for p in data.reals("source_positions", None, 3, most=MAX_POINTS).tolist())


def _shining(data: Archive) -> dict[str, object]:
    intensity = data.text("source_intensity")
    if intensity == "table":
        angles, values = data.reals("source_intensity_table", None, 2, most=MOST_ANGLES).T.tolist()
        intensity = Distribution(tuple(angles), tuple(values))
    return {"cone": data.real("cone_half_angle"), "intensity": intensity}
