"""Export of a lens to files of other programs."""

from __future__ import annotations

import time
from importlib import import_module
from pathlib import Path
from types import ModuleType

from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import FORMATS, TWO_SIDED
from caustic_cli.export.accuracy import Deviation
from caustic_cli.export.milling import Milling
from caustic_cli.export.part import part_of
from caustic_cli.io.heightmaps import beside
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project.project import Project
from caustic_cli.project.uptodate import Outputs
from caustic_cli.scene import Scene
from caustic_cli.workflow.reporter import Reporter


def export(
    project: Path, format: str, output: Path | None, script: bool, given: dict, force: bool, say: Reporter, at: str | None = None
) -> tuple[dict, bool]:
    """Export the lens of a project.

    Args:
        format: a name of FORMATS.
        output: file to write, None for the project's name here.
        script: of lighttools: also the script that rebuilds the scene.
        given: samples (n, m) or tolerance, mm, of the sampled formats; mould, block; milling, a dictionary.
        force: replace files not made by this program, and repeat what is up to date.
        at: parameter values for a network that was trained over ranges, "throw=300"; also part of the default file name.

    Returns:
        figures file, format, bytes, seconds, and beside, the companion files; and whether all of it was up to date already.

    Raises:
        InputError: there is no lens, the format does not support it, or a file exists already; nothing was written.
    """
    began, opened = time.monotonic(), Project.open(project).at(at)
    which = "" if at is None else f"-{at.replace(' ', '').replace(',', '-').replace('=', '-')}"
    path = output or Path(project.resolve().stem + which + FORMATS[format][0])
    scene = opened.scene()
    written = files(path, scene, format, script)
    values = {"at": at} if at is not None else {}
    made = Outputs(opened, "export", {"format": format, "script": script, **values, **given}, written)
    if not force and (found := made.found()):
        say.say(f"{path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it")
        return found, True
    made.refuse_foreign(force)
    scene, field, heights, _ = opened.lens(scene)
    found = write(path, scene, field, heights, format, script, **given)
    more = {"beside": [str(file) for file in written[1:]]} if len(written) > 1 else {}
    figures = {
        "file": str(path),
        "format": format,
        "bytes": path.stat().st_size,
        **more,
        "seconds": time.monotonic() - began,
    } | found
    made.keep(figures)
    return figures, False


def write(
    path: Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    format: str,
    script: bool = False,
    mould: bool = False,
    block: float | None = None,
    milling: dict | None = None,
    **given,
) -> dict:
    """Write the files of a lens, see `files`, and return their figures: samples and deviation of the surface that is read from them
    (`export.accuracy`), or those of milling and height maps.

    given: samples or tolerance, mm.  For light of a single wavelength, the refractive index in the file is that at this wavelength.
    """
    if len(scene.light.wavelengths) == 1:
        scene = scene.at(scene.light.wavelengths[0])
    if scene.lens.entrance is not None and (script or mould or format not in TWO_SIDED):
        raise InputError(
            f"⟨format⟩ {format} holds one free-form side; of this lens, which has two, {', '.join(TWO_SIDED)} hold both, without"
            " ⟨script⟩ or ⟨mould⟩"
        )
    if scene.elements and (script or format == "zemax"):
        raise InputError(
            f"⟨format⟩ {format} holds a single lens; with other elements {', '.join(TWO_SIDED)} hold the scene, without ⟨script⟩"
        )
    part = part_of(format, scene, field, heights, mould, block)
    writer = getattr(_home(format), f"write_{format}")
    if format == "gcode":
        found = writer(path, part, Milling(**(milling or {})), **given)
        return {"milling": found | _scallops(scene, field, found)}
    if format == "heightmap":
        found = writer(path, part, **given)
        return {"heightmap": {key: value for key, value in found.items() if key != "spline"}}
    scripts = import_module("caustic_cli.export.lighttools_script") if script else None
    if scripts is not None:
        scripts.refuse(scene)
    off: Deviation | None = writer(path, part.scene, part.field, part.heights, **given)
    if scripts is not None:
        scripts.write_script(path, scene, field, heights, given.get("samples"))
    return {} if off is None else off.figures(scene)


def accuracy_words(figures: dict) -> str:
    """Deviation of the exported surface from the designed one, as a phrase."""
    if "heightmap" in figures:
        said = figures["heightmap"]
        return f"{said['columns']} x {said['rows']} points; between them heights are at most {_length(said['height_error_mm'])} off"
    if "read_as" not in figures:
        return "the spline itself" if figures["format"] == "step" else ""
    nx, ny = figures["samples"]
    exact = {"step": "; ⟨tolerance⟩ 0 writes the exact one", "lighttools": "; the exact spline is stored beside them"}
    if spline := figures.get("spline"):
        n, m = spline["samples"]
        exact["lighttools"] = (
            f"; the spline stored with them has {n} x {m} control points, heights at most {_length(spline['height_error_mm'])} off"
            f" and light {_shift(spline['shift_pixels'])}; ⟨tolerance⟩ 0 stores the exact one"
        )
    return (
        f"{nx} x {ny} points; read as {figures['read_as']}, heights are at most {_length(figures['height_error_mm'])} off and"
        f" light {_shift(figures['shift_pixels'])} (RMS){exact.get(figures['format'], '')}"
    )


def _length(length: float) -> str:
    """A length, given in mm, in micrometres."""
    return f"{1e3 * length:.2g} µm" if length >= 1e-6 else "a nanometre"


def _shift(pixels: float) -> str:
    return f"{pixels:.2g} pixels" if pixels >= 0.001 else "a thousandth of a pixel"


def _scallops(scene: Scene, field: HeightField, found: dict) -> dict:
    """Optical effect of the scallops: see `studies.scallops`."""
    return import_module("caustic_cli.studies.scallops").scallops(scene, found["step_over_mm"], found["tool_radius_mm"])


def files(path: Path, scene: Scene, format: str, script: bool = False) -> list[Path]:
    """All files of an export, the lens first."""
    if format == "heightmap":
        return [path, beside(path)]
    if format == "mitsuba":
        return [path, *_home(format).companions(path, scene.lens.round, scene.lens.mirror, scene.two_sided, scene.elements)]
    return [path, *import_module("caustic_cli.export.lighttools_script").companions(path)] if script else [path]


def _home(format: str) -> ModuleType:
    return import_module(f"caustic_cli.export.{FORMATS[format][1]}")
