"""Formats of lamps: their solid, a scene for Mitsuba, and their light as photometric files."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.export import lamp_mitsuba, obj, ply, pob, stl, threemf
from caustic_cli.export.lamp import SAMPLES, lamp_mesh, lamp_parts
from caustic_cli.export.lamp_step import write_lamp_step
from caustic_cli.inverse.lamp import pixels_of
from caustic_cli.io.photometry import Photometry, write_ies, write_ldt
from caustic_cli.optics.lamp import sides
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Goal, Lamp
from caustic_cli.studies.photometry import FLUX, intensity_table

#: Rings, and points of each.
Samples = tuple[int, int]


class Exported(NamedTuple):
    """A lamp: control values of r, mm, see `optics.lamp.sides`; its name, and the seed of the rays of its light."""

    lamp: Lamp
    goal: Goal
    field: PolarField
    values: Tensor
    name: str
    seed: int


class Format(NamedTuple):
    """A format: its suffix; its writer, of a path, a lamp and samples, which returns further figures; whether it has samples; and
    the names of further files."""

    suffix: str
    write: Callable[[Path, Exported, Samples], dict[str, Any] | None]
    sampled: bool = True
    companions: Callable[[Path], list[Path]] = lambda path: []


def _mesh(write: Callable[..., None], path: Path, found: Exported, samples: Samples) -> None:
    write(path, *lamp_mesh(found.lamp, found.field, found.values, samples))


def _pob(path: Path, found: Exported, samples: Samples) -> None:
    pob.write_pob(path, lamp_parts(found.lamp, found.field, found.values, samples), ("inner surface", "outer surface", "foot"))


def _step(path: Path, found: Exported, _: Samples) -> None:
    write_lamp_step(path, found.lamp, found.field, found.values)


def _mitsuba(path: Path, found: Exported, samples: Samples) -> None:
    pixels = pixels_of(found.goal, current_effort().lamp_stages[-1][0])
    lamp_mitsuba.write_lamp_mitsuba(path, found.lamp, found.goal, found.field, found.values, pixels, samples)


def _photometry(write: Callable[[Path, Photometry], None], path: Path, found: Exported, _: Samples) -> dict[str, Any]:
    """flux, lm per 1000 lm of the chips, and peak_candela; the file of an array holds the light of as many chips of 1000 lm."""
    table = intensity_table(found.lamp, found.field, found.values, rays=current_effort().final_rays, seed=found.seed)
    greatest, name, count = found.field.extent(sides(found.values)[1])[1], found.name, found.lamp.count
    across = 2.0 * (greatest + math.hypot(*found.lamp.places.max(0)))
    write(path, Photometry(table.planes, table.angles, count * table.values, count * FLUX, name, across, greatest))
    return {"flux": table.flux, "peak_candela": table.peak}


FORMATS = {
    "step": Format(".step", _step, False),
    "stl": Format(".stl", partial(_mesh, stl.write_mesh)),
    "ply": Format(".ply", partial(_mesh, ply.write_mesh)),
    "obj": Format(".obj", partial(_mesh, obj.write_mesh)),
    "3mf": Format(".3mf", partial(_mesh, threemf.write_mesh)),
    "zemax": Format(".pob", _pob),
    "lighttools": Format(".step", _step, False),
    "mitsuba": Format(".xml", _mitsuba, companions=lamp_mitsuba.companions),
    "ies": Format(".ies", partial(_photometry, write_ies), False),
    "ldt": Format(".ldt", partial(_photometry, write_ldt), False),
}
#: What formats hold that have no lamp.
HOLDS = {
    "gcode": "the path of a tool above a height at each x and y",
    "phase": "the phase of a thin element at each x and y",
}


def check_export(format: str, samples: Samples | None) -> None:
    """Refuse a format that no lamp has, or samples of one that has none.

    Raises:
        InputError: as it says.
    """
    if format not in FORMATS:
        what = HOLDS.get(format, "a height at each x and y")
        raise InputError(
            f"⟨format⟩ {format} holds {what}, and a lamp's surface is none of that: it has two sides and may overhang;"
            f" {', '.join(FORMATS)} hold the lamp or its light, step and lighttools as a solid, zemax as a Polygon Object"
        )
    if samples is not None and not FORMATS[format].sampled:
        raise InputError(f"⟨samples⟩ belongs to {', '.join(name for name in FORMATS if FORMATS[name].sampled)}, got {format}")


def format_of(suffix: str) -> str:
    """The format of this suffix.

    Raises:
        InputError: there is none.
    """
    if found := [name for name, own in FORMATS.items() if own.suffix == suffix.lower()]:
        return found[0]
    listed = ", ".join(f"{name} ({own.suffix})" for name, own in FORMATS.items())
    raise InputError(f"of a lamp a ⟨format⟩ is needed, or an ⟨out⟩ with its suffix, of {listed}")


def write(path: Path, found: Exported, format: str, samples: Samples | None) -> dict[str, Any]:
    """Write a lamp in a format that was checked; returns further figures, and beside, the further files."""
    own = FORMATS[format]
    figures, beside = own.write(path, found, samples or SAMPLES) or {}, own.companions(path)
    return figures | ({"beside": list(map(str, beside))} if beside else {})
