"""The scene and the lens out of an exported `.npz`, so that it can be traced without its project."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io.surfaces import load_npz, surface_of
from caustic_cli.optics.bounds import refuse_without_glass
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Disc, Lens, Light, PlaneWave, Points, Scene, Screen, Source
from caustic_cli.scene.sources.distribution import Distribution


def open_archive(path: str | Path) -> tuple[Scene, HeightField, Tensor]:
    """Scene, spline spaces and control heights (n, m) mm of an archive made by `caustic export format lighttools`.

    Raises:
        InputError: it cannot be read, something is missing, or something is out of range.
    """
    path = Path(path)
    data = load_npz(path)
    field, heights = surface_of(data, path)
    try:
        lens = Lens(
            size=tuple(2.0 * h for h in field.half_size),
            z_in=float(data["z_in"]),
            index=float(data["refractive_index"]),
            control=field.shape,
            degree=tuple(s.degree for s in field.spaces),
            knots=tuple(tuple(s.knots.tolist()) for s in field.spaces),
            fresnel=_text(data, "fresnel", "exact"),
            aperture=_text(data, "aperture", "rectangle"),
        )
        screen = Screen(
            tuple(2.0 * h for h in _reals(data, "screen_half_size", 2)),
            float(data["z_screen"]),
            tuple(int(n) for n in _reals(data, "resolution", 2)),
        )
        scene = Scene(_source(data), lens, screen, Light(unit=_text(data, "source_power_unit", "W")))
        refuse_without_glass(scene, field, heights)
        return scene, field, heights
    except KeyError as error:
        raise InputError(f"{path}: has no {error.args[0]}; an archive of caustic export ⟨format⟩ lighttools is needed") from error
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: holds something of the wrong shape or type ({error})") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _source(data: dict[str, np.ndarray]) -> Source:
    kind = data["source_type"].item()
    if kind not in _READERS:
        raise InputError(f"source_type must be plane, point, grid or disc, got {kind!r}")
    return _READERS[kind](data)


def _plane(data: dict[str, np.ndarray]) -> PlaneWave:
    return PlaneWave(float(data["source_power"][0]), data.get("source_profile"))


def _points(data: dict[str, np.ndarray]) -> Points:
    powers = data["source_power"]
    return Points(_positions(data), tuple(float(p) for p in powers), kind=data["source_type"].item(), **_shining(data))


def _disc(data: dict[str, np.ndarray]) -> Disc:
    power = float(data["source_power"][0])
    if "source_angle" in data:
        return Disc(power=power, angle=float(data["source_angle"]), brightness=data.get("source_brightness"))
    return Disc(
        _positions(data)[0],
        tuple(_reals(data, "source_size", 2)),
        power,
        brightness=data.get("source_brightness"),
        **_shining(data),
    )


#: What makes a source of its keys in the archive, by its kind: see `export/lighttools.py`.
_READERS = {"plane": _plane, "point": _points, "grid": _points, "disc": _disc}


def _positions(data: dict[str, np.ndarray]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in p) for p in data["source_positions"])


def _shining(data: dict[str, np.ndarray]) -> dict[str, object]:
    intensity = data["source_intensity"].item()
    if intensity == "table":
        angles, values = np.asarray(data["source_intensity_table"], dtype=float).T.tolist()
        intensity = Distribution(tuple(angles), tuple(values))
    return {"cone": float(data["cone_half_angle"]), "intensity": intensity}


def _reals(data: dict[str, np.ndarray], key: str, count: int) -> list[float]:
    if data[key].shape != (count,):
        raise ValueError(f"{key} must be {count} numbers")
    return [float(v) for v in data[key]]


def _text(data: dict[str, np.ndarray], key: str, default: str) -> str:
    return data[key].item() if key in data else default
