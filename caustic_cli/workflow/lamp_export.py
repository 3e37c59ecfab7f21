"""Export of lamps: their solid, a scene for Mitsuba, and their light as photometric files."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.export import lamp_mitsuba, obj, ply, stl
from caustic_cli.export.lamp import SAMPLES, lamp_mesh
from caustic_cli.export.lamp_step import write_lamp_step
from caustic_cli.inverse.lamp import pixels_of
from caustic_cli.io.photometry import Photometry, write_ies, write_ldt
from caustic_cli.optics.lamp import sides
from caustic_cli.project import uptodate
from caustic_cli.project.project import Project
from caustic_cli.studies.photometry import FLUX, intensity_table
from caustic_cli.workflow.lamp import LampDesign
from caustic_cli.workflow.reporter import Reporter

#: Rings, and points of each.
Samples = tuple[int, int]


class Format(NamedTuple):
    """A format: its suffix; its writer, of a path, a lamp and samples, which returns further figures; whether it has samples; and
    the names of further files."""

    suffix: str
    write: Callable[[Path, LampDesign, Samples], dict[str, Any] | None]
    sampled: bool = True
    companions: Callable[[Path], list[Path]] = lambda path: []


def _mesh(write: Callable[..., None], path: Path, found: LampDesign, samples: Samples) -> None:
    write(path, *lamp_mesh(found.lamp, found.field, found.values, samples))


def _step(path: Path, found: LampDesign, _: Samples) -> None:
    write_lamp_step(path, found.lamp, found.field, found.values)


def _mitsuba(path: Path, found: LampDesign, samples: Samples) -> None:
    pixels = pixels_of(found.goal, current_effort().lamp_stages[-1][0])
    lamp_mitsuba.write_lamp_mitsuba(path, found.lamp, found.goal, found.field, found.values, pixels, samples)


def _photometry(write: Callable[[Path, Photometry], None], path: Path, found: LampDesign, _: Samples) -> dict[str, Any]:
    """flux, lm per 1000 lm of the chip, and peak_candela."""
    table = intensity_table(found.lamp, found.field, found.values, rays=current_effort().final_rays, seed=found.project.seed)
    greatest, name = found.field.extent(sides(found.values)[1])[1], found.name
    write(path, Photometry(table.planes, table.angles, table.values, FLUX, name, 2.0 * greatest, greatest))
    return {"flux": table.flux, "peak_candela": table.peak}


FORMATS = {
    "step": Format(".step", _step, False),
    "stl": Format(".stl", partial(_mesh, stl.write_mesh)),
    "ply": Format(".ply", partial(_mesh, ply.write_mesh)),
    "obj": Format(".obj", partial(_mesh, obj.write_mesh)),
    "mitsuba": Format(".xml", _mitsuba, companions=lamp_mitsuba.companions),
    "ies": Format(".ies", partial(_photometry, write_ies), False),
    "ldt": Format(".ldt", partial(_photometry, write_ldt), False),
}


def check_export(format: str, samples: Samples | None) -> None:
    """Refuse a format that no lamp has, or samples of one that has none.

    Raises:
        InputError: as it says.
    """
    if format not in FORMATS:
        raise InputError(
            f"⟨format⟩ {format} holds height fields, and a lamp's surface is none; {', '.join(FORMATS)} hold the lamp or its light,"
            " step for programs of optical design as well"
        )
    if samples is not None and not FORMATS[format].sampled:
        raise InputError(f"⟨samples⟩ belongs to {', '.join(name for name in FORMATS if FORMATS[name].sampled)}, got {format}")


def export(
    project: Project, format: str, output: Path | None, samples: Samples | None, force: bool, say: Reporter
) -> dict[str, Any]:
    """Write a lamp in one of FORMATS; returns file, format, bytes, seconds, and beside, the further files; of a photometric file
    the flux of its light, lm per 1000 lm of the chip, and peak_candela.

    Raises:
        InputError: there is no lamp, the format is not one of a lamp, or a file exists already; nothing was written.
    """
    began = time.monotonic()
    check_export(format, samples)
    assert project.path is not None
    own = FORMATS[format]
    path = output or Path(project.path.resolve().stem + own.suffix)
    beside = own.companions(path)
    made = uptodate.Outputs(project, "export", {"format": format, "samples": samples}, [path, *beside])
    if not force and (found := made.found()):
        say.say(f"{path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it")
        return found
    made.refuse_foreign(force)
    more = own.write(path, LampDesign.of(project), samples or SAMPLES) or {}
    more |= {"beside": list(map(str, beside))} if beside else {}
    figures = {"file": str(path), "format": format, "bytes": path.stat().st_size, **more, "seconds": time.monotonic() - began}
    made.keep(figures)
    return figures
