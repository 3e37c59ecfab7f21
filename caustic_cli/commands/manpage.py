"""The manual pages: of the commands, from the parser itself, and of project.toml, from the table of settings.

`python -m caustic_cli.commands.manpage man` writes caustic.1, one for each command, and caustic-project.5, the reference of all
settings.  The sections around them are below.
"""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

from caustic_cli import __version__
from caustic_cli.commands.options import default_words
from caustic_cli.commands.parser import parser
from caustic_cli.config import presets
from caustic_cli.config.table import TABLE, Setting
from caustic_cli.errors import plain_name
from caustic_cli.io.files import write_bytes
from caustic_cli.scene import materials

HEAD = r""".TH CAUSTIC 1 "" "caustic {version}" "User Commands"
.SH NAME
caustic \- design free-form lenses that throw a picture as a caustic
.SH SYNOPSIS
.B caustic
.I COMMAND
.RI [ OPTIONS ]
.SH DESCRIPTION
Give it a picture, and it finds the free-form lens that throws this picture as a caustic: a B-spline surface is shaped by
differentiable ray tracing until the light lands where the picture is bright.
.PP
Lengths are millimetres, angles degrees, wavelengths nanometres, powers watts.  Results go to standard output, everything
meant for a person to standard error.
.SH COMMANDS
"""

TAIL = r""".SH FILES
A project is a directory:
.TP
.I NAME.caustic/project.toml
Everything that defines the scene and the design, with units:
.BR caustic-project (5).
Editing it and rendering again is a normal way to work.
.TP
.I NAME.caustic/checkpoints.h5
Control heights, optimiser state, loss history, provenance (HDF5); replaced as a whole, never half-written.
.TP
.IR NAME.caustic/target.png " or " target.npy
The target as used.
.TP
.IR NAME.caustic/source.* ", " intensity.csv
Copies of the files that [source] names: rays, a picture of its brightness, a table of angles; source-2.*, ... of further sources.
.TP
.I NAME.caustic/render.png
The caustic by rays, as last rendered.
.TP
.I NAME.caustic/wave.png
The caustic as light makes it, where diffraction is simulated.
.TP
.IR NAME.caustic/second.png ", " render\-second.png
The second picture as used, and as last rendered, of a lens with two.
.TP
.I NAME.caustic/report.png
Target, caustic, its error, lens height and relief, loss against time, where the light goes.
.SH JSON
With
.BR \-\-json ,
design and render print one object with these keys, among others.  A figure that is undefined is null.
.TP
.B loss, relative_rms, psnr_db, ssim
Image against target, counted in pixels: eq. 5.2.1 of the thesis; that times the pixels, the RMS error over the mean; peak
signal\-to\-noise ratio; structural similarity.
.TP
.B in_black
Of the light on the screen, the part that lands where the target is below a hundredth of its peak, a dark margin included; null of
a target that is so nowhere.
.TP
.B min_radius
Of design with a least radius of concave places: radius_mm; of the surface that the design began from, retraced by the same rays,
start_in_black with the radius, start_in_black_without, in_black_per_mm, the difference over the radius, and its noise.
.TP
.B noise, in_black_noise, error_estimate
Standard errors of relative_rms and of in_black, and relative RMS noise of the image, that the retrace's own rays leave.
.TP
.B minimum_wall_mm, stock_height_mm
Of design: least and largest height of the exit above the flat entrance.
.TP
.B image_kept
Of render: true where render.png is still an earlier one of the same, with less noise.
.TP
.B on_screen, on_target, lost
Parts of the source's power on the screen, where the target is bright, and lost, by cause; on_screen and all of lost sum to 1.
.TP
.B wave_relative_rms, wave_on_target, wave_in_black, resolvable
The same of the wave image, where diffraction is simulated; details that light carries across the picture.
.TP
.B least_relative_rms, etendue_limit
Behind an extended source's blur: the error of the best light found, and the most light that \['e]tendue lets through.
.TP
.B second_relative_rms, second_noise, second_on_target, second_on_screen, second_image
The same of a second picture behind the first; of light that shall leave that parallel or towards a focus,
.BR angle_rms_mrad ,
the root mean square of its angle to that way.
.TP
.B start_relative_rms, start_noise
Of the surface that a design began from, by the same rays.
.TP
.B tolerances
Of a study of errors: draws, percentiles p5, p50 and p95 of relative_rms (as placed), shifted_relative_rms (after the best shift of
the screen) and on_target, sensitivities, offenders, wave_check, csv, plot.
.TP
.B want
Of an array and a wanted illumination: brightness of each lenslet's source in parts of the largest, N lists of M; error, relative
RMS of the image that they give; kkt_residual; power, part of what all sources would take; image.
.TP
.B rays, iterations, seconds, image, project
Rays traced, iterations done, wall time, files.
.SH ORIENTATION
Arrays are indexed [i, j], i along +x and j along +y.  Image files are the screen seen from +z: column 0 is the \-x edge,
row 0 the +y edge.  Seen from the lens' side the picture is mirrored;
.B \-\-flip x
designs for that viewer.
.SH THE SAME AGAIN
A design, render or export of the same inputs with the same options as before is no work: the command says so, prints the same
JSON, touches what it made, so that
.BR make (1)
finds it newer than its sources, and exits 0.
.B \-\-force
does it anew.
.SH COMPLETION
.B caustic \-\-install\-completion
adds completion of commands and options to the shell;
.B caustic \-\-show\-completion
prints what it would add.
.SH EXIT STATUS
.TP
.B 0
Done.
.TP
.B 1
Could not finish; the message says why and what is safe on disk.
.TP
.B 2
Bad usage or bad input: one line says what, where, and what would be accepted.
.TP
.B 130, 143
Interrupted by SIGINT or SIGTERM, after the last state was saved.
.SH ENVIRONMENT
.TP
.BI CAUSTIC_ COMMAND _ OPTION
The default of an option, hyphens written as underscores: CAUSTIC_DESIGN_MAG=2, CAUSTIC_RENDER_RAYS=4e6, CAUSTIC_DESIGN_LINEAR=1.
What the command line says wins.
.TP
.B CAUSTIC_QUIET, CAUSTIC_PROGRESS, CAUSTIC_SEED, CAUSTIC_DEVICE, CAUSTIC_DTYPE, CAUSTIC_THREADS, CAUSTIC_DEBUG
The same for the options that most commands share.
.TP
.B CAUSTIC_KERNELS
"torch" runs the plain-torch reference instead of the compiled kernels, on a CUDA device too, where --dtype float32 counts then.
.TP
.B NUMBA_CACHE_DIR
Directory to keep the compiled kernels in; default: caustic in XDG_CACHE_HOME or in ~/.cache. Where nothing can be written there, it
is a directory of the user's own among the temporary files. What has not been used for 30 days is removed.
.TP
.B NO_COLOR
Set to anything: no colour.
.SH EXAMPLES
.nf
caustic design flame.png --source plane --mag 3
caustic render flame.caustic --rays 4e6 --json
caustic gradmap flame.caustic --control 60,70 --check
caustic export flame.caustic --format stl -o flame.stl
caustic convergence flame.caustic --study rays
.fi
"""


def build() -> str:
    """The whole page as roff."""
    root = parser()
    parts = [HEAD.format(version=__version__)]
    for name, command in root.commands.items():
        parts.append(_command(name, command))
    return "".join(parts) + TAIL


REFERENCE = r""".TH CAUSTIC-PROJECT 5 "" "caustic {version}" "File Formats"
.SH NAME
caustic\-project \- the settings of a caustic project, project.toml
.SH DESCRIPTION
A project's directory holds
.IR project.toml ,
which says everything that defines the scene and the design.
.B caustic design
writes it, with each key's unit or meaning beside it; it may be edited by hand, and given to a new design with
.BR \-\-config .
The same names, as
.IR section.key ,
are the library's.  What a default's reason is stands after it.
.PP
Several tables
.B [[source]]
are several sources; several tables
.B [[design.stages]]
are the stages of a design, one after another.
"""
MATERIALS = """.SH MATERIALS
What [lens] glass may say, whatever the case, blanks and hyphens: refractive index at 587.6 nm, Abbe number, density, and the slope
of a surface from which on light along the axis is totally reflected.  Where an index has a spread, batches differ: measure yours
and say it as index.
"""
PRESETS = """.SH PRESETS
What \\fB\\-\\-preset\\fR may say: files with some of these settings.
"""
#: How a kind of setting is written.
KINDS = {
    "number": "number",
    "whole": "whole number",
    "text": "text",
    "flag": "true or false",
    "numbers": "[x, y]",
    "wholes": "[x, y], whole numbers",
    "list": "list of numbers",
    "points": "[x, y, z], or a list of such",
    "tables": "several tables",
}


def reference() -> str:
    """Every setting of the table, by section, as roff."""
    parts = [REFERENCE.format(version=__version__)]
    headings = {row.section: plain_name(f"{row.section}.").strip() for row in TABLE.values() if row.section}
    for section, heading in headings.items():
        parts.append(f".SH {_plain(heading)}\n" + "".join(_setting(row) for row in TABLE.values() if row.section == section))
    parts.append(".SH FROM THE COMMAND LINE ALONE\nSettings are derived from these, and no project holds them.\n")
    parts.append("".join(_setting(row) for row in TABLE.values() if not row.section))
    parts.append(MATERIALS + "".join(f".TP\n\\fB{_plain(name)}\\fR\n{_plain(text)}\n" for name, text in _materials()))
    parts.append(PRESETS + "".join(f".TP\n\\fB{_plain(name)}\\fR\n{_plain(text)}\n" for name, text in presets.rows()))
    return "".join(parts) + ".SH SEE ALSO\n.BR caustic (1)\n"


def _materials() -> list[tuple[str, str]]:
    """Each material, and what is known of it."""
    found = []
    for name, index, abbe, density, slope, also in materials.rows():
        facts = [f"n_d {index}", f"V_d {abbe}", "" if density == "-" else f"{density} g/cm^3", f"steepest slope {slope}"]
        found.append((name, f"{', '.join(filter(None, facts))}{f'; also {also}' if also else ''}."))
    return found


def _setting(row: Setting) -> str:
    low, high = (("" if math.isinf(v) else f"{v:g}") for v in (row.low, row.high))
    bounds = (
        f"{'greater than' if row.above else 'at least'} {low}" * bool(low)
        + " and " * bool(low and high)
        + f"at most {high}" * bool(high)
    )
    if row.choices:
        bounds = "one of " + ", ".join(choice or '""' for choice in row.choices)
    start = default_words(row)
    facts = [
        f"{KINDS[row.kind]}{f', {row.unit}' if row.unit else ''}{f', {bounds}' if bounds else ''}.",
        f"Default: {start}{f' ({row.why})' if row.why else ''}." if start != "none" or row.why else "",
        f"Option: {row.option.name}." if row.option else "",
    ]
    return (
        f".TP\n\\fB{_plain(row.key)}\\fR\n{_plain(row.help[0].upper() + row.help[1:])}.\n.br\n"
        f"{_plain(' '.join(filter(None, facts)))}\n"
    )


def pages() -> dict[str, str]:
    """All pages by file name: the whole program, each command alone, and the settings."""
    commands = {f"caustic-{name}.1": _page(name, command) for name, command in parser().commands.items()}
    return {"caustic.1": build(), **commands, "caustic-project.5": reference()}


def _page(name: str, command) -> str:
    summary = _plain((command.help or "").split(".")[0])
    examples = "\n".join(
        line.strip().replace("\\", "\\e").replace("-", "\\-")
        for line in (command.epilog or "").splitlines()
        if line.strip().startswith("caustic")
    )
    options = _command(name, command).split("\n", 2)[2]
    return (
        f'.TH CAUSTIC-{name.upper()} 1 "" "caustic {__version__}" "User Commands"\n.SH NAME\ncaustic\\-{name} \\- {summary}\n'
        f".SH SYNOPSIS\n.B caustic {name}\n{_plain(_usage(command))} [OPTIONS]\n.SH DESCRIPTION\n{_plain(command.help or '')}\n"
        f".SH OPTIONS\n{options}.SH EXAMPLES\n.nf\n{examples}\n.fi\n.SH SEE ALSO\n.BR caustic (1)\n"
        "tells of files, orientation, exit status and environment.\n"
    )


def _usage(command) -> str:
    return " ".join((p.metavar or p.name.upper()) for p in command.params if p.param_type_name == "argument")


def _command(name: str, command) -> str:
    flags = [p for p in command.params if p.param_type_name == "option"]
    lines = [f".SS caustic {name} {_plain(_usage(command))} [OPTIONS]", _plain(command.help or "")]
    for p in flags:
        names = ", ".join(_plain(o) for o in sorted([*p.opts, *p.secondary_opts], key=len, reverse=True))
        value = "" if p.is_flag else " \\fI" + _plain(p.metavar or p.name.upper()) + "\\fR"
        default = "" if p.default in (None, False) or p.is_flag or callable(p.default) else f"  [default: {p.default}]"
        lines += [".TP", f"\\fB{names}\\fR{value}", _plain((p.help or "") + default)]
    return "\n".join(lines) + "\n"


def _plain(text: str) -> str:
    """Text as roff shows it: backslashes, hyphens and leading dots made safe."""
    text = re.sub(r"\s+", " ", text).strip().replace("\\", "\\e").replace("-", "\\-")
    return "\\&" + text if text[:1] in (".", "'") else text


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python -m caustic_cli.commands.manpage DIRECTORY")
    for file, page in pages().items():
        write_bytes(Path(sys.argv[1]) / file, page.encode())
