"""Grouped help of the commands' options, and messages for unknown options."""

from __future__ import annotations

import difflib
import sys
from types import MethodType
from typing import Any

from caustic_cli.schema import table

#: The most common options, in this order, at the beginning of a command's help.
BASICS = {
    "design": ("preset", "source", "mag", "lens_size", "glass", "throw", "quality", "out"),
    "render": ("rays", "screen_at", "source", "effects", "explain", "report", "out"),
}
#: Headings of the groups, and the sections of the table that they contain.
GROUPS = {
    "Picture": ("target",),
    "Light source": ("source", "room"),
    "Lens": ("lens",),
    "Lamp": ("lamp",),
    "Screen": ("screen", "second"),
    "Design": ("design",),
    "Effects": (),
    "Image": (),
    "Output and run": (),
}
#: Groups of options that do not follow from a section, by option name.
PLACED = {
    **dict.fromkeys(("mag", "picture_size", "margin", "invert"), "Picture"),
    "element": "Lens",
    **dict.fromkeys(("throw", "screen", "screen_size", "resolution", "screen_at"), "Screen"),
    **dict.fromkeys(("quality", "rays", "config", "preset", "plan", "error", "resume", "robust"), "Design"),
    **dict.fromkeys(("absorption", "roughness", "polarisation", "wavelengths", "waves", "effects", "explain"), "Effects"),
    **dict.fromkeys(("tolerance", "reconstruction", "filter_size", "alpha"), "Image"),
}
#: Synonyms of options.
SYNONYMS = {
    **dict.fromkeys(("--magnification", "--magnify", "--scale"), "--mag"),
    **dict.fromkeys(("--size", "--width", "--lens", "--lens-width", "--plate"), "--lens-size"),
    **dict.fromkeys(("--distance", "--screen-distance", "--focal-length", "--wall", "--z"), "--throw"),
    **dict.fromkeys(("--material", "--plastic"), "--glass"),
    **dict.fromkeys(("--refractive-index", "--ior", "--n"), "--index"),
    **dict.fromkeys(("--pixels", "--res"), "--resolution"),
    **dict.fromkeys(("--output", "--dir", "--file"), "--out"),
    **dict.fromkeys(("--wall-thickness", "--minimum-thickness"), "--min-thickness"),
    **dict.fromkeys(("--knots", "--net", "--control-points"), "--control"),
    **dict.fromkeys(("--negative", "--inverse"), "--invert"),
    **dict.fromkeys(("--mirror-image",), "--flip"),
    **dict.fromkeys(("--time", "--timeout"), "--time-limit"),
    **dict.fromkeys(("--led", "--light"), "--source"),
    **dict.fromkeys(("--overwrite",), "--force"),
}


def grouped(name: str, command: Any) -> None:
    """Make a command list its options in groups, the most common ones first, if it has settings among them."""
    if name in BASICS:
        command.format_options = MethodType(_format_options, command)


def _format_options(command, context, formatter) -> None:
    lists: dict[str, list] = {"Arguments": [], "Basics": [], **{heading: [] for heading in GROUPS}}
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None:
            lists[_heading(command.name, parameter)].append((parameter.name, record))
    basics = BASICS[command.name]
    lists["Basics"].sort(key=lambda pair: basics.index(pair[0]))
    for heading, records in lists.items():
        if records:
            with formatter.section(heading):
                formatter.write_dl([record for _, record in records])


def _heading(command: str, parameter) -> str:
    name = parameter.name
    if parameter.param_type_name == "argument":
        return "Arguments"
    if name in BASICS[command]:
        return "Basics"
    if name in PLACED:
        return PLACED[name]
    section = SECTIONS.get(name, "")
    return next((heading for heading, sections in GROUPS.items() if section in sections), "Output and run")


#: Sections of settings with options, by option name.
SECTIONS = {
    row.option.name.lstrip("-").replace("-", "_"): row.section
    for row in table.TABLE.values()
    if row.option and not row.option.common
}


def usage_message(problem: Any) -> str:
    """A message for a usage error, with the probably intended option; "" if the parser has no message."""
    said = problem.format_message().rstrip(".")
    context = getattr(problem, "ctx", None)
    name = getattr(problem, "option_name", None)
    if name is not None and hasattr(problem, "possibilities"):
        known = [o for p in (context.command.params if context else ()) for o in p.opts]
        near = [SYNONYMS[name]] if SYNONYMS.get(name) in known else difflib.get_close_matches(name, known, 2, 0.6)
        said = f"no such option: {name}" + (f"; did you mean {' or '.join(near)}?" if near else "")
        if files := [a for a in sys.argv[1:] if not name.startswith("--") and a.startswith(name) and "." in a]:
            said = f"no such option: {name}; a file whose name begins with a hyphen is given as ./{files[0]}"
    return said and f"{said} ({context.command_path if context else 'caustic'} --help says more)"
