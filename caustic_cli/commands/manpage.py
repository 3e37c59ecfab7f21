"""The manual pages: those of the commands, generated from the parser, and that of project.toml, from the table of settings.

`python -m caustic_cli.commands.manpage man` writes caustic.1, a page for each command, and caustic-project.5, the reference of
all settings, and the tables of capabilities in the guide and README.md.  The hand-written sections are below.
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
from caustic_cli.errors import plain_name
from caustic_cli.export.archive_keys import KEYS, Key
from caustic_cli.io.files import read_bytes, write_bytes
from caustic_cli.scene import materials
from caustic_cli.schema.table import TABLE, Setting
from caustic_cli.workflow.capabilities import limits, matrix

HEAD = r""".TH CAUSTIC 1 "" "caustic {version}" "User Commands"
.SH NAME
caustic \- design free-form lenses that project a picture as a caustic
.SH SYNOPSIS
.B caustic
.I COMMAND
.RI [ OPTIONS ]
.SH DESCRIPTION
Designs free-form lenses that project a given picture as a caustic.  The free-form surface is a tensor\-product B\-spline,
optimised by differentiable ray tracing until the irradiance on the screen matches the picture, and refined with diffraction
taken into account where it matters.
.PP
Lengths are in millimetres, angles in degrees, wavelengths in nanometres and powers in watts.  Results are written to standard
output, as tables or with
.B \-\-json
as one JSON object; messages are written to standard error.
.SH COMMANDS
"""

TAIL = r""".SH FILES
A project is a directory:
.TP
.I NAME.caustic/project.toml
All settings that define the scene and the design, with units; see
.BR caustic-project (5).
It may be edited by hand before the project is rendered again.
.TP
.I NAME.caustic/checkpoints.h5
Control heights, optimiser state, loss history and provenance (HDF5); always replaced as a whole.
.TP
.IR NAME.caustic/target.png " or " target.npy
The target as used by the design.
.TP
.IR NAME.caustic/source.* ", " intensity.csv
Copies of the files named in [source]: a ray file, a picture of the radiance, a table of the angular distribution; source\-2.*
and so on for further sources.
.TP
.I NAME.caustic/render.png
The caustic by ray tracing, as last rendered.
.TP
.I NAME.caustic/wave.png
The caustic by wave optics, where diffraction is simulated.
.TP
.IR NAME.caustic/second.png ", " render\-second.png
For a lens with two pictures, the second picture as used by the design and as last rendered.
.TP
.I NAME.caustic/report.png
Target, caustic and its error, height and relief of the lens, error during each stage, and energy budget.
.PP
An output whose name is a link is written where the link leads.  Directories, devices, pipes and open streams, such as
/dev/stdout, are refused, both as inputs and as outputs; a picture is read from standard input if TARGET is \-.
.SH JSON
With
.BR \-\-json ,
design and render print one object with the following keys, among others.  Undefined values are null.
.TP
.B error, error_by
The figure by which the lens is judged, and by what: waves, for a design that was refined on its wave image (wave_relative_rms), or
rays (relative_rms).
.TP
.B loss, relative_rms, psnr_db, ssim
Comparison of ray image and target, with rays counted in pixels: the loss of eq. 5.2.1 of the thesis; that loss times the number of
pixels, which is the RMS error divided by the mean; peak signal\-to\-noise ratio; structural similarity.
.TP
.B ciede2000, wave_ciede2000
For a coloured picture: mean CIEDE2000 colour difference between ray image, or wave image, and picture, over the smallest rectangle
that holds all light of the picture, at the picture's total luminance and with its white (sRGB 255,255,255).  The noise of the rays
adds to it.
.TP
.B in_black
Fraction of the light on the screen that lands where the target is below a hundredth of its peak, a dark margin included; null
for a target without such pixels.
.TP
.B min_radius
For a design with a minimum radius of concave places: radius_mm, and for the initial surface, retraced with the same rays,
start_in_black with the radius, start_in_black_without, in_black_per_mm (their difference divided by the radius) and its noise.
.TP
.B noise, in_black_noise, error_estimate
Standard errors of relative_rms and of in_black, and the relative RMS noise of the image, due to the rays of the retrace.
.TP
.B minimum_wall_mm, stock_height_mm
For a design: least and largest height of the exit above the flat entrance.
.TP
.B image_kept
For a render: true if render.png is an earlier image of the same scene, with less noise.
.TP
.B on_screen, on_target, lost, fractions_of
Fractions of the source's power that land on the screen, that land where the target is bright, and that are lost, by cause;
on_screen and all entries of lost sum to 1; fractions_of names the power of which they are fractions.
.TP
.B of_source, source_emits
Fraction of all that the source emits which lands on the picture, and what that is: the power through the aperture for a plane wave
or a disc at infinity; all rays of a ray file; for a point, grid or disc its Lambertian or tabulated distribution in all directions,
and for a uniform one the cone if that is given, else all directions; for several sources that of all together.
.TP
.B interior_rms, interior_noise, border, uniformity, cut_off, uncoated_limit, least_wall, greatest_radius, peak_candela, beam_angles
Of a lamp, whose of_source and the entries of lost sum to 1: relative_rms, which is over pixels that are lit entirely, without a
border of the target, 2.5 % of its smaller side or what a chip blurs, and its noise; that border, in border_unit;
least over mean
illuminance, or intensity in the far field; there the angle over which it falls from 90 to 10 % at its upper edge; the light that
uncoated surfaces pass at normal incidence; least distance of its surfaces and greatest radius, mm; in the far field candela for a
chip of 1000 lm, and full
angles with half of the peak or more in the planes of x and of y. flux and peak_candela of a photometric file are for 1000 lm, too.
.TP
.B wave_relative_rms, wave_psnr_db, wave_ssim, wave_on_screen, wave_on_target, wave_in_black, resolvable
The same quantities for the wave image, where diffraction is simulated; number of details across the picture that the light can
resolve.
.TP
.B beam
Of a design with the loss log-rms: error, the relative error sqrt(mean((I - T)^2 / T^2)) in the mask, where the picture is above
10 % of its peak, with I scaled to the same sum there; in_mask and in_region, fractions of the light behind the lens; peak_to_valley
and rms of I / T in the mask; edge_width, mm, from 1/e^2 to 1 - 1/e^2; and vortices, zeros of the field in the mask.
.TP
.B least_relative_rms, etendue_limit
For an extended source: a lower bound of the error of any lens, by its blur, and the largest fraction of the light that
\['e]tendue permits.
.TP
.B second_relative_rms, second_noise, second_on_target, second_on_screen, second_of_source, second_image
The same quantities for a second picture behind the first; if the light is to continue parallel or towards a focus instead,
.BR angle_rms_mrad ,
the root mean square of its angular deviation.
.TP
.B wave_wavelengths, wave_spectrum, wave_detector, wave_spectral_error
Wavelengths of the wave image, nm; the continuous spectrum that they represent and by what it is measured, eye or power, null for
spectral lines; and an estimate of the error of wave_relative_rms that their number leaves.
.TP
.B plan
Of design \-\-plan: rows of quality, error_by, relative_rms to expect, low and high, the range of two designs of three, seconds,
memory_mib, project_mib, and bound, the error that diffraction leaves to any lens.
.TP
.B accuracy_cost
Of a design: rows of iteration, seconds and processor_seconds since its beginning, and error, measured at eight or more iterations
(all, if they are fewer) by light that the optimiser does not use: of the wave image at seven or more wavelengths other than those
of its last stage, or by independent rays. The measurements themselves are not part of the times; some are left out where they take
more than 3 s and half of the design's time, as for a dispersive glass.
.TP
.B start_error, start_relative_rms, start_noise
The same quantities for the initial surface of a design, by the same rays; by waves (start_wave_relative_rms), where it is clearly
worse than the finished lens, as the first row of accuracy_cost.
.TP
.B tolerances
For a tolerance study: draws, error_by, percentiles p5, p50 and p95 of error (as placed; also as relative_rms),
shifted_relative_rms (after the best shift of the screen) and on_target, sensitivities, offenders, wave_check, csv, plot.
.TP
.B day
For a day of sunlight: times, rows of time, azimuth and elevation of the sun, incidence on the pane, error on the screen where it
stands, followed_error on one that follows the picture, moved (mm along the screen's x and y since the light of the design),
brightness (power on the picture over that of the design, in a beam of the same irradiance) and on_screen (part of it on the screen
where it stands); periods as_designed, legible and on_screen, each with its first and last time; the error of the design;
as_designed_error and legible_error, the bounds; film, plot.
.TP
.B hours
For a sundial: relative_rms of all light on the screen at the time of each lenslet against its picture, and contrast, of its own
light to that of the others on the bright part of the picture; in the order of the lenslets. hours_image: all images as a sheet.
.TP
.B stray
For an array with a source behind every lenslet: on_lens and on_screen, the fractions of the light on the lens and on the screen
that entered another lenslet than that of its source.
.TP
.B want
For an array with a prescribed illumination: brightness of each lenslet's source relative to the largest, N lists of M; error, the
relative RMS error of the resulting image; kkt_residual; power, as a fraction of what all sources would require; image.
.TP
.B rays_plot
For a render with \-\-rays\-plot: rays drawn, lost, lost_by (numbers of rays by the way in which they are lost: missed_surface,
total_internal_reflection, away_from_screen, off_screen), image.
.TP
.B photo
For a render with \-\-photo: file, registered_by, marks, mark_sigma_px; error of the picture in the frame of the screen,
as_photographed (codes taken for sRGB), registered (moved, stretched and sheared onto the picture) and against_lens (onto the image
of the lens), relative RMS; missing_light, a fraction; camera (gamma, background, gain, blur_mm, and displacements_mm that its marks
leave, each with its standard deviation); explained (fraction of the variance); screen_farther_mm, by how much its screen was
farther away than said, with its standard deviation, of photographs at several throws; others, the same of further photographs;
part: deviation_rms_um and relief_scale with their standard deviations (_sigma), uncertainty_um (RMS of the standard deviation over
the part), explained, not_told_apart; files.
.TP
.B correction
For a design with \-\-correct: round; registered, predicted (registered errors of the part and of one of the corrected heights),
error, predicted_error (the same in the frame of the screen) and gain, each with its standard deviation; moved_um; plot.
.TP
.B test_card
For a render with \-\-test\-card: sheet, marks (files), size_mm.
.TP
.B rays, iterations, seconds, image, project
Number of rays traced, number of iterations, wall time, paths of files.
.TP
.B glasses, presets
Of
.BR "\-\-glass list" " and " "\-\-preset list" ,
the materials: name, n_d, its spread between batches, the Abbe number V_d, density (g/cm^3), steepest_slope (mm per mm), range_nm,
source, other names (also); or the presets: name, purpose.
"""
AFTER_KEYS = r""".SH ORIENTATION
Arrays are indexed [i, j], with i along +x and j along +y.  Image files show the screen as seen from +z: column 0 is the \-x edge,
row 0 the +y edge.  Seen from the side of the lens the picture is mirrored;
.B \-\-flip x
designs for that viewer.
.SH REPEATED COMMANDS
A design, render or export that repeats an earlier command on the same inputs with the same options performs no work: it says
so, prints the same JSON, updates the time stamps of its outputs, so that
.BR make (1)
considers them newer than their sources, and exits with status 0.
.B \-\-force
repeats the work.
.SH COMPLETION
.B caustic \-\-install\-completion
adds completion of commands and options to the configuration of the shell;
.B caustic \-\-show\-completion
prints the lines that it would add.
.SH EXIT STATUS
.TP
.B 0
Done.
.TP
.B 1
The command could not finish; the message states the reason and what has been saved.
.TP
.B 2
Incorrect usage or input; a one-line message states what is wrong, where, and what would be accepted.
.TP
.B 130, 143
Interrupted by SIGINT or SIGTERM, after the state was saved.
.SH ENVIRONMENT
.TP
.BI CAUSTIC_ COMMAND _ OPTION
Default of an option, with hyphens written as underscores: CAUSTIC_DESIGN_MAG=2, CAUSTIC_RENDER_RAYS=4e6, CAUSTIC_DESIGN_LINEAR=1.
The command line takes precedence.
.TP
.B CAUSTIC_QUIET, CAUSTIC_PROGRESS, CAUSTIC_SEED, CAUSTIC_DEVICE, CAUSTIC_DTYPE, CAUSTIC_THREADS, CAUSTIC_DEBUG
Defaults of the options that most commands share.
.TP
.B CAUSTIC_KERNELS
"torch" selects the plain\-torch reference instead of the compiled kernels of a CPU; a CUDA device always uses it.
.TP
.B NUMBA_CACHE_DIR
Directory of the compiled kernels; by default caustic in XDG_CACHE_HOME or in ~/.cache.  If it cannot be written, a private
directory of the user among the temporary files is used.  Kernels that have not been used for 30 days are removed.
.TP
.B NO_COLOR
If set to any value, output is not coloured.
.SH SEVERAL PROCESSES
Every command runs under
.BR torchrun ,
on one host or several: "torchrun \-\-nproc\-per\-node 4 \-m \-\- caustic_cli render flame.caustic \-\-tolerances errors.toml".
The first process reads and writes all files.  Draws, times of day, finishes, most studies, and the rays, wavefronts, lenslets or
draws of designs are shared; what is not shared is done by the first process.  Results are the same to the last bit for any number
of processes.  A lost process ends the command with one line and status 1 or 143.
.SH EXAMPLES
.nf
caustic design flame.png --source plane --mag 3
caustic render flame.caustic --rays 4e6 --json
caustic gradmap flame.caustic --control 60,70 --check
caustic export flame.caustic --format stl -o flame.stl
caustic convergence flame.caustic --study rays
.fi
"""
#: What precedes the keys of an archive.
ARCHIVE = r""".SH LIGHTTOOLS ARCHIVE
.B caustic export \-\-format lighttools
writes one .npz file, which
.I numpy.load
reads with allow_pickle=False, and which design (\-\-start) and render accept.  It holds the surface as a cloud of points and as the
exact B\-spline, and the whole scene.  In shapes, letters are sizes: n x m control points, nx x ny points of the cloud, l
wavelengths, g other elements; k, a and b differ from key to key.  Grids are indexed [i, j], with i along +x and j along +y.
Numbers are float64, whole ones int64.
"""


def build() -> str:
    """The whole page as roff."""
    root = parser()
    parts = [HEAD.format(version=__version__)]
    for name, command in root.commands.items():
        parts.append(_command(name, command))
    return "".join(parts) + TAIL + _archive() + AFTER_KEYS


def _archive() -> str:
    """The keys of an archive, by the part of the scene."""
    return ARCHIVE + "".join(f".SS {part}\n" + "".join(map(_key, keys)) for part, keys in KEYS.items())


def _key(key: Key) -> str:
    facts = ", ".join(filter(None, (key.shape, {"1": "no unit", "whole": "whole"}.get(key.unit, key.unit))))
    return f".TP\n\\fB{_plain(key.name)}\\fR  {_plain(facts)}\n{_plain(key.meaning[0].upper() + key.meaning[1:])}.\n"


REFERENCE = r""".TH CAUSTIC-PROJECT 5 "" "caustic {version}" "File Formats"
.SH NAME
caustic\-project \- the settings of a caustic project, project.toml
.SH DESCRIPTION
A project's directory holds
.IR project.toml ,
which contains all settings that define the scene and the design.
.B caustic design
writes it, with the unit or meaning of each key beside it.  It may be edited by hand, and passed to a new design by
.BR \-\-config .
The Python library uses the same names, as
.IR section.key .
The reason for a default is given in parentheses after it.
.PP
Several tables
.B [[source]]
describe several sources; several tables
.B [[design.stages]]
describe the successive stages of a design.
"""
MATERIALS = """.SH MATERIALS
Values of [lens] glass; case, blanks and hyphens are ignored.  Listed are the refractive index at 587.6 nm, the Abbe number, the
density, and the slope of a surface above which light along the axis is totally reflected.  Where the index is given with a
spread, it varies between batches: measure that of your batch and set it as index.
"""
PRESETS = """.SH PRESETS
Values of \\fB\\-\\-preset\\fR, each of which is a file with some of these settings.
"""
#: Notation of each kind of setting.
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
    parts.append(".SH COMMAND\\-LINE ONLY\nOther settings are derived from these, which are not stored in a project.\n")
    parts.append("".join(_setting(row) for row in TABLE.values() if not row.section))
    parts.append(MATERIALS + "".join(f".TP\n\\fB{_plain(name)}\\fR\n{_plain(text)}\n" for name, text in _materials()))
    parts.append(PRESETS + "".join(f".TP\n\\fB{_plain(name)}\\fR\n{_plain(text)}\n" for name, text in presets.rows()))
    return "".join(parts) + ".SH SEE ALSO\n.BR caustic (1)\n"


def _materials() -> list[tuple[str, str]]:
    """Each material with its properties."""
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
    """All pages by file name: the program, each command, and the settings."""
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
        "describes files, orientation, exit status and environment.\n"
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
    """Text escaped for roff: backslashes, hyphens and leading dots."""
    text = re.sub(r"\s+", " ", text).strip().replace("\\", "\\e").replace("-", "\\-")
    return "\\&" + text if text[:1] in (".", "'") else text


#: Documents with generated tables of capabilities, beside the directory of the pages; what precedes and follows these there.
DOCUMENTS = {"examples/guide/8-how-it-works.md": matrix, "README.md": limits}
BEGIN, END = "<!-- capabilities: generated with the manual pages -->\n\n", "\n\n<!-- end of capabilities -->"


def document(name: str, text: str) -> str:
    """A document with its table as it is today."""
    head, rest = text.split(BEGIN)
    return head + BEGIN + DOCUMENTS[name]() + END + rest.split(END)[1]


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python -m caustic_cli.commands.manpage DIRECTORY")
    for file, page in pages().items():
        write_bytes(Path(sys.argv[1]) / file, page.encode())
    for name in DOCUMENTS:
        if (path := Path(sys.argv[1]).resolve().parent / name).exists():
            write_bytes(path, document(name, read_bytes(path, 1_000_000, "the documents are needed").decode()).encode())
