"""Export of a lens to files of other programs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError, alternatives
from caustic_cli.export import AS_CUT, FORMATS, KEEPERS, MOST_BYTES, SIDE_BY_SIDE, WITHIN
from caustic_cli.export.milling import ROTARY, Milling
from caustic_cli.export.part import Part, part_of, turned
from caustic_cli.export.reading import Reading, Readings
from caustic_cli.export.register import other, parts_of, registered, with_stock
from caustic_cli.export.supported import EXPORT, refuse
from caustic_cli.io.heightmaps import beside
from caustic_cli.optics import finishing
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.surfaces.base import MeasuredSurface
from caustic_cli.optics.surfaces.facets import FacetSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import freeform_of
from caustic_cli.project.project import Project
from caustic_cli.project.uptodate import Outputs
from caustic_cli.scene import Scene
from caustic_cli.studies.judge import judge_of
from caustic_cli.studies.picture_error import PictureError, picture_error
from caustic_cli.workflow.compilation import compile_for
from caustic_cli.workflow.reporter import Listener, Reporter


class Exporter:
    """Exports of one lens, whose picture through each file is compared with its own.

    Args:
        scene, field, heights: of the lens, (n, m) mm.
        target: its picture on the screen's pixels, None if it is not known.
        waves: judge by the wave image.
        seed: of the rays; most: largest file by default, bytes.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        heights: Tensor,
        target: np.ndarray | None,
        waves: bool = False,
        seed: int = 0,
        most: float = MOST_BYTES,
        say: Reporter | None = None,
    ):
        self.scene, self.field, self.heights, self.target = scene, field, heights, target
        self.waves, self.seed, self.most, self.say = waves, seed, most, say or Listener()

    @property
    def asked(self) -> dict:
        """What determines its files beside the project, the format and their options."""
        return {"most": self.most} if self.most != MOST_BYTES else {}

    @cached_property
    def picture(self) -> PictureError:
        """The error of the lens' own picture, and of others."""
        plan = compile_plan(self.scene, self.field, self.heights)
        compile_for(plan.scene, "cpu", self.say, plan.requests)
        return picture_error(plan, self.field, self.heights, self.target, self.waves, self.seed)

    def write(
        self,
        path: Path,
        format: str,
        script: bool = False,
        mould: bool = False,
        block: float | None = None,
        milling: dict | None = None,
        **given,
    ) -> dict:
        """Write the files of the lens, see `files`, and return their figures: those of `figures`, or of milling; none for a format
        whose module defines no `readings`.

        given: samples or tolerance, mm; without these the smallest file of at most `most` bytes that keeps the picture, or else the
        best.  For light of a single wavelength, the refractive index in the file is that at this wavelength.
        """
        scene = at_own_wavelength(self.scene)
        refuse(scene, format, script, mould)
        m = Milling(**(milling or {}))
        sides = parts_of(format, scene, self.field, self.heights, m, mould, block)
        if "pin" in (milling or {}) and sides[0].register is None:
            raise InputError("⟨pin⟩ is of a lens with two free-form sides, which is turned over onto pins; this one has one side")
        home, paths = _home(format), (path, other(path))[: len(sides)]
        if format == "gcode":
            found, *back = (home.write_gcode(p, s, with_stock(m, s), **given) for p, s in zip(paths, sides, strict=True))
            entrance = {"entrance": back[0]} if back else {}
            return {"milling": found | scallops_of(scene, self.field, found)} | entrance | registered(sides)
        each = [file_of(format, p, s) for p, s in zip(paths, sides, strict=True)]
        file = each[0] if len(sides) == 1 else BothSides(**vars(each[0]), other=each[1], scene=scene)
        judged = hasattr(home, "readings")
        more = {key: given.pop(key) for key in getattr(home, "MORE", ()) if key in given}
        choice = given if not judged or {"samples", "tolerance"} & set(given) else self.smallest(file)
        writer = getattr(home, f"write_{format}")
        written, *_ = [writer(p, *one.arguments, **choice, **more) for p, one in zip(paths, each, strict=True)]
        if script:
            import_module("caustic_cli.export.lighttools_script").write_script(
                path, scene, self.field, self.heights, choice.get("samples")
            )
        found = self.figures(file, choice, format) if judged else {}
        if written is not None:
            found[format] = {key: value for key, value in written.items() if key != "spline"}
        return found | registered(sides)

    def error(self, file: File, choice: dict, key: str | None = None) -> float:
        """Relative RMS error of the picture through a file; key: which of its readings, that by which it is chosen unless given."""
        key = key or file.chosen_by
        which = (key, str(choice))
        if which not in file.errors:
            reading = file.readings(choice)[key]()
            file.errors[which] = self.picture.through(*file.in_the_scene(reading), reading.entrance)
        return file.errors[which]

    def smallest(self, file: File, parts: int = 1) -> dict:
        """The smallest choice that keeps the picture, or else the one with the least error of those tried; parts: of such files,
        by which the largest size is divided.

        The error falls with the size of the file, but for rounding: the choices are tried upwards or downwards from that with every
        knot on a grid line.
        """
        choices, errors = file.choices(self.most / parts), dict[int, float]()

        def error(k: int) -> float:
            if k not in errors:
                errors[k] = self.error(file, choices[k])
            return errors[k]

        k = start = next((k for k, c in enumerate(choices) if c.get("samples") == 1), len(choices) - 1)
        if error(k) <= self.picture.largest:
            while k > 0 and error(k - 1) <= self.picture.largest:
                k -= 1
        else:
            while k + 1 < len(choices) and error(k) > self.picture.largest and (k == start or error(k) < error(k - 1)):
                k += 1
            if error(k) > self.picture.largest:
                k = start
                while k > 0 and error(k - 1) < error(k):
                    k -= 1
                k = min(errors, key=lambda j: errors[j])
        fewer = file.smaller(choices[k])
        return fewer if fewer and self.error(file, fewer) <= self.picture.largest else choices[k]

    def figures(self, file: File, choice: dict, format: str) -> dict:
        """Figures of a file for JSON: error of the picture as read from it; lens_error, of the lens itself; error_by and noise;
        errors of other readings (facet_error, cloud_error); keeps_picture; read_as, samples, height_error_mm; and keep_it, the
        formats that keep a picture that this file does not.  An error is None where the reading has no wave image."""
        readings = file.readings(choice)
        errors = {key: self.error(file, choice, key) for key in readings}
        kept = errors["error"] <= self.picture.largest
        own = readings["error"]()
        found = {
            **{key: value if math.isfinite(value) else None for key, value in errors.items()},
            "error_by": self.picture.by,
            "lens_error": self.picture.own if self.picture.known else None,
            "noise": self.picture.noise,
            "keeps_picture": kept,
            "read_as": own.read_as,
            "samples": list(own.samples if file.chosen_by == "error" else readings[file.chosen_by]().samples),
            "height_error_mm": own.largest_deviation(file.part.field, file.part.heights, file.part.lens.opening),
        }
        return found if kept else found | {"keep_it": [name for name in KEEPERS if name != format and self._keeps(name)]}

    def _keeps(self, format: str) -> bool:
        """Whether the largest file of a format keeps the picture."""
        if not EXPORT[format].supports(self.scene):
            return False
        part = part_of(format, self.scene, self.field, self.heights)
        file = file_of(format, Path(f"lens{FORMATS[format][0]}"), part)
        return self.error(file, file.choices(MOST_BYTES)[-1], "error") <= self.picture.largest


def at_own_wavelength(scene: Scene) -> Scene:
    """A scene with the refractive index at its wavelength, if it has a single one."""
    return scene.at(scene.light.wavelengths[0]) if len(scene.light.wavelengths) == 1 else scene


@dataclass(frozen=True, eq=False)
class File:
    """A file of one format, to be chosen.

    home: its module, with `choices` and `readings`; arguments: of these, which describe the lens; path: of height maps, whose
    suffix determines their kind; part: the part in it; errors: of readings that have been traced, by their key and choice.
    """

    home: ModuleType
    arguments: tuple
    path: Path | None
    part: Part
    errors: dict[tuple[str, str], float] = field(default_factory=dict)

    @property
    def _more(self) -> dict:
        return {} if self.path is None else {"path": self.path}

    @property
    def chosen_by(self) -> str:
        """Key of the reading by which its size is chosen."""
        return getattr(self.home, "CHOSEN_BY", "error")

    def choices(self, limit: float) -> list[dict]:
        """Arguments of the writer for files of at most `limit` bytes, the smallest first."""
        return self.home.choices(*self.arguments, limit, **self._more)

    def smaller(self, choice: dict) -> dict | None:
        """The same choice with fewer bits, where the format has them."""
        return self.home.smaller(self.path, choice) if hasattr(self.home, "smaller") else None

    def readings(self, choice: dict) -> Readings:
        """The surfaces as read from a file with this choice."""
        return self.home.readings(*self.arguments, **self._more, **choice)

    def in_the_scene(self, reading: Reading) -> tuple[HeightField | MeasuredSurface, Tensor | None]:
        """The surface of a reading in the coordinates of the scene."""
        if not self.part.turned:
            return reading.surface, reading.heights
        if isinstance(reading.surface, FacetSurface):
            return reading.surface.turned(), None
        return turned(reading.surface, reading.heights)


@dataclass(frozen=True, eq=False)
class BothSides(File):
    """The exit of a lens with two free-form sides, or of its mould; other: its entrance; read together."""

    other: File = field(kw_only=True)
    scene: Scene = field(kw_only=True)

    def readings(self, choice: dict) -> Readings:
        """As of a file, the exit with the entrance as read from its own."""

        def both(read: Callable[[], Reading]) -> Reading:
            entrance, heights = self.other.in_the_scene(self.other.readings(choice)["error"]())
            if heights is None:  # facets, beside which the entrance is the designed one
                return read()
            assert isinstance(entrance, HeightField)
            return replace(read(), entrance=freeform_of(entrance, heights - self.scene.lens.z_in))

        return {key: partial(both, read) for key, read in super().readings(choice).items()}


def export(
    exporter: Exporter,
    opened: Project,
    format: str,
    output: Path | None,
    script: bool,
    given: dict,
    force: bool,
    at: str | None = None,
) -> dict:
    """Export the lens of a project.

    Args:
        format: a name of FORMATS.
        output: file to write, None for the project's name here.
        script: of lighttools: also the script that rebuilds the scene.
        given: samples (n, m) or tolerance, mm, of the sampled formats; mould, block; milling, a dictionary; printer, mm, which is
            else that of the project's finish.
        force: replace files not made by this program, and repeat what is up to date.
        at: parameter values for a network that was trained over ranges, "throw=300"; also part of the default file name.

    Returns:
        figures file, format, bytes, seconds, and beside, the companion files; those of an earlier run where all is up to date.

    Raises:
        InputError: there is no lens, the format does not support it, or a file exists already; nothing was written.
    """
    began = time.monotonic()
    which = "" if at is None else f"-{at.replace(' ', '').replace(',', '-').replace('=', '-')}"
    path = output or Path(opened.path.resolve().stem + which + FORMATS[format][0])
    rotary = (given.get("milling") or {}).get("path") == ROTARY
    written = files(path, exporter.scene, format, script, given.get("mould", False), rotary)
    printer = finishing.printer(opened.settings.lens.finish)
    if printer is not None and "printer" in getattr(_home(format), "MORE", ()):
        given = {"printer": printer} | given
    values = ({"at": at} if at is not None else {}) | exporter.asked
    made = Outputs(opened, "export", {"format": format, "script": script, **values, **given}, written)
    if not force and (found := made.found()):
        exporter.say.say(
            f"{path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it"
        )
        return found
    made.refuse_foreign(force)
    with exporter.say.notify_if_slow(f"{path} takes long: {LESS[format]}"):
        found = exporter.write(path, format, script, **given)
    more = {"beside": [str(file) for file in written[1:]]} if len(written) > 1 else {}
    figures = {
        "file": str(path),
        "format": format,
        "bytes": path.stat().st_size,
        **more,
        "seconds": time.monotonic() - began,
    } | found
    made.keep(figures)
    return figures


def exporter_of(project: Path, at: str | None, say: Reporter, most: float = MOST_BYTES) -> tuple[Exporter, Project]:
    """The exporter of the lens of a project; arguments as of `export`."""
    opened = Project.open(project).at(at)
    scene = opened.scene()
    target = opened.target(scene)
    scene, field, heights, checkpoint = opened.lens(scene)
    field, heights = opened.made(field, heights)
    waves = checkpoint.results.get("wave_relative_rms") is not None and checkpoint.results.get("error_by", "waves") == "waves"
    return Exporter(scene, field, heights, target, waves, opened.settings.design.seed, most, say), opened


#: How to have a file of a format sooner.
LESS = dict.fromkeys(FORMATS, "fewer ⟨samples⟩ take less") | dict.fromkeys(WITHIN, "a larger ⟨tolerance⟩ takes less")
LESS["gcode"] = "a larger ⟨tolerance⟩, or ⟨scallop⟩ of a tool, takes less"
#: How to have formats of splines exactly.
EXACT = {"step": "⟨tolerance⟩ 0 writes the exact one", "lighttools": "⟨tolerance⟩ 0 stores exact numbers"}


def accuracy_words(figures: dict) -> str:
    """The picture through the exported file, as a phrase."""
    if "read_as" not in figures:
        return ""
    nx, ny = figures["samples"]
    noise = "" if not figures["noise"] else f" ± {figures['noise']:.2g}"
    by = judge_of(figures).after.format(noise=noise)
    if figures["lens_error"] is None:
        judged = f"its image differs from the lens' own by {figures['error']:.2g} (relative RMS, by rays)"
    else:
        judged = f"relative RMS error {_error(figures['error'])} {by}, where the lens itself has {figures['lens_error']:.4f}"
    others = [
        f"{name} {_error(figures[key])}"
        for key, name in (("facet_error", "its flat facets have"), ("cloud_error", "its points, read as a bicubic spline, have"))
        if key in figures
    ]
    if figures["height_error_mm"] > 0:
        others.append(f"heights are at most {_length(figures['height_error_mm'])} off")
    exact = figures["height_error_mm"] == 0.0 and "B-spline" in figures["read_as"]
    read = "the spline itself" if exact else f"{nx} x {ny} points, read as {figures['read_as']}"
    if not exact and figures.get("format") in EXACT:
        others.append(EXACT[figures["format"]])
    text = "; ".join([f"{read}: {judged}", *others])
    if figures["keeps_picture"]:
        return text
    kept = f"⟨format⟩ {alternatives(figures['keep_it'])} keeps it" if figures["keep_it"] else "no format keeps it in 100 MB"
    return f"{text}; warning: this file does not keep the picture; {kept}"


def file_of(format: str, path: Path, part: Part) -> File:
    """The file of a part in a format."""
    return File(_home(format), _arguments(format, part), path if format == "heightmap" else None, part)


def _arguments(format: str, part: Part) -> tuple:
    return (part,) if format in AS_CUT else (part.scene, part.field, part.heights)


def _error(error: float | None) -> str:
    return "unknown, as there is no wave image," if error is None else f"{error:.4f}"


def _length(length: float) -> str:
    """A length, given in mm, in micrometres."""
    return f"{1e3 * length:.2g} µm" if length >= 1e-6 else "a nanometre"


def scallops_of(scene: Scene, field: HeightField, found: dict) -> dict:
    """Optical effect of the scallops: see `studies.scallops`."""
    return import_module("caustic_cli.studies.scallops").scallops(scene, found["step_over_mm"], found["tool_radius_mm"])


def files(path: Path, scene: Scene, format: str, script: bool = False, mould: bool = False, rotary: bool = False) -> list[Path]:
    """All files of an export, the lens first; rotary: a program for a mill with a rotary axis."""
    both = scene.lens.entrance is not None and (mould or format in SIDE_BY_SIDE) and not rotary
    paths = [path, other(path)] if both else [path]
    if format == "heightmap":
        return [name for p in paths for name in (p, beside(p))]
    if both:
        return paths
    if format in ("phase", "mitsuba"):
        return [path, *_home(format).companions(path, scene)]
    return [path, *import_module("caustic_cli.export.lighttools_script").companions(path)] if script else [path]


def _home(format: str) -> ModuleType:
    return import_module(f"caustic_cli.export.{FORMATS[format][1]}")
