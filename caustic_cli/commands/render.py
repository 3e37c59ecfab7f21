"""caustic render: trace the lens of a project, and write the irradiance image and its figures of merit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.commands.figures import figures_rows
from caustic_cli.errors import CausticError, InputError

EXAMPLES = """Examples:

  caustic render flame.caustic --rays 4e6

  caustic render flame.caustic --screen-at 280 -o near.png --json
"""


class TracingOptions(options.Given):
    """The lens, and how its light is traced."""

    project: Annotated[
        Path,
        typer.Argument(help="Project directory made by caustic design, or an .npz made by caustic export.", show_default=False),
    ]
    given: Annotated[dict[str, Any], options.TableOptions("render")]
    rays: Annotated[
        str | None,
        typer.Option(
            metavar="N",
            help="Number of rays, independent of those of the design.  [default: as at the end of a design: 4e6; for a plane"
            " wave at least 64 per pixel (at most 6.4e7); for other light up to 1.6e7 until the noise is a tenth of the"
            " error; with --tolerance, 1e6]",
        ),
    ] = None
    tolerance: Annotated[
        float | None,
        typer.Option(
            metavar="ERROR",
            help="Add rays until the estimated noise of the image is below this relative RMS; --rays is the initial number.",
        ),
    ] = None
    reconstruction: Annotated[str, typer.Option(help="bincount, gaussian or cosine; the figures are always by bincount.")] = (
        "bincount"
    )
    filter_size: Annotated[str, typer.Option(metavar="V[xW]", help="Filter size, odd (pixels).")] = "3"
    alpha: Annotated[float | None, typer.Option(help="Alpha of the gaussian filter (1/mm^2).  [default: 1 per pixel^2]")] = None
    at: options.At = None
    screen_at: Annotated[float | None, typer.Option(metavar="Z", help="Move the screen to this position (mm).")] = None
    effects: Annotated[
        str,
        typer.Option(
            metavar="auto|none|NAME[,NAME...]",
            help="Effects to simulate: those that the scene needs, none that can be omitted, or the listed ones (see --explain).",
        ),
    ] = "auto"


class OutputOptions(options.Given):
    """What is written."""

    explain: Annotated[
        bool,
        typer.Option("--explain", help="Show which effects are simulated, why, the cost of each, and the error of omitting it."),
    ] = False
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="PNG",
            help="Image to write, with the pixels of the screen.  [default: render.png in PROJECT, at least 800 pixels wide,"
            " unless a less noisy one of the same scene exists; for an archive, its name + -render.png, here]",
        ),
    ] = None
    npy: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write the irradiance: power per pixel as a fraction of the source's, float64, [i, j]; of light with a"
            " spectrum seen by the eye X, Y and Z on that scale, (3, n_x, n_y).",
        ),
    ] = None
    html: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write a self-contained page that traces the lens in any browser: the lens in three dimensions,"
            " the caustic for movable screen and light, target and difference.",
        ),
    ] = None
    rays_plot: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Also draw this many rays (1 to 2000) through the lens to the screen, from the side and in three dimensions, lost"
            " ones in another colour; writes rays.png beside the image.",
        ),
    ] = None
    verify: Annotated[
        str | None,
        typer.Option(
            metavar="mitsuba",
            help="Trace the same lens in Mitsuba 3 (pip install"
            " mitsuba) with as many rays and compare, pixel by pixel; writes"
            " verify.png beside the image.  Exit status 1 if they disagree.",
        ),
    ] = None
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Also report the manufacturing data of the lens: wall, stock, slopes, concave"
            " radius, margin to internal reflection, sharpness, tolerances; writes report.json"
            " beside the image.  Of a lamp, isolux lines, polar diagram, sections and losses: report.png.",
        ),
    ] = False
    shop: Annotated[
        Path | None,
        typer.Option(
            metavar="HTML",
            help="Also write a page for the shop that makes the part: drawing, blank, what has to be held, how it is finished and"
            " photographed; with a test card beside it.",
        ),
    ] = None
    tool_radius: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Tool radius that --report checks in concave regions, and that of a --cut program that does not state it (mm).",
        ),
    ] = None
    cut: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Trace the surface machined by this program (G-code, as from caustic export --format gcode) with a ball-nose tool,"
            " including scallops.",
        ),
    ] = None
    finish: Annotated[
        str | None,
        typer.Option(
            metavar="STEP[+STEP...]|list",
            help="Trace the part as finishing leaves it: sanded:GRIT[,GRIT...], polished:UM (removed on average), coated:UM,"
            " printed:LAYER,PIXEL[,COAT] (µm), milled:FILE (G-code), joined by +; list: the error by each of several.  [default:"
            " what the design was corrected for]",
        ),
    ] = None
    tolerances: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also analyse the manufacturing and alignment errors of this TOML file (like examples/tolerances.toml):"
            " sensitivities, percentiles of error and light, worst offenders; writes tolerances.csv and .png beside the image.",
        ),
    ] = None
    day: Annotated[
        str | None,
        typer.Option(
            metavar="DATE",
            help="For a lens in a window (--sun): also follow the sun on a day like 2026-06-21, in the time zone of the design: how"
            " long the picture is legible, where it wanders, how bright it is; writes day.gif and day.png beside the image, by"
            " 200,000 rays a time unless --rays says otherwise.",
        ),
    ] = None
    photo: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="PHOTO",
            help="Also judge a photograph of the caustic of the part that was made: on the screen (photo.png, photo.npy), its"
            " error, where light is missing (missing.png), and what is wrong with the part (part.png, part.npy,"
            f" deviation.npy: heights in mm over the aperture).  {options.SEVERAL_PHOTOS}",
        ),
    ] = None
    marks: options.Marks = None
    screen_corners: options.ScreenCorners = None
    test_card: Annotated[
        bool,
        typer.Option(
            "--test-card",
            help="Also draw a sheet with marks around the picture's place, to be printed in true size and fixed on the screen for"
            " --photo; writes card.png and card.csv beside the image.",
        ),
    ] = False
    want: Annotated[
        Path | None,
        typer.Option(
            metavar="PICTURE",
            help="For a lenslet array: the source brightness of each lenslet that gives this illumination (non-negative least"
            " squares over the images of the single lenslets, of their sources through the whole array with --source-each); writes"
            " wanted.png beside the image.",
        ),
    ] = None


class RenderOptions(TracingOptions, OutputOptions, options.Computation):
    """Arguments and options of caustic render."""


def run(asked: RenderOptions) -> None:
    """Trace the lens of PROJECT; write the irradiance image and its figures of merit."""
    rays, size = None if asked.rays is None else options.rays("--rays", asked.rays), _checked_size(asked)
    given = {path: value for path, value in asked.given.items() if not path.startswith("design.")}  # seed, dtype: of these rays
    if asked.screen_at is not None:
        console.set_option_names(console.option_names() | {"screen.z": "--screen-at"})
    options.require_project(asked.project, archives=True)

    from caustic_cli.config import tolerances as schema  # noqa: PLC0415
    from caustic_cli.config.lamp import says_lamp  # noqa: PLC0415
    from caustic_cli.config.values import refuse_bad_options  # noqa: PLC0415

    refuse_bad_options(given)
    if asked.tolerances is not None:
        schema.read(asked.tolerances)
    device = asked.start_torch()
    if says_lamp(asked.project):
        _render_lamp(asked, rays)
    else:
        _render_lens(asked, device, rays, size, given)


def _render_lens(asked: RenderOptions, device: str, rays: int | None, size: list[int], given: dict[str, Any]) -> None:
    """Trace a lens and print its figures; given: settings instead of the project's."""
    from caustic_cli.workflow.outputs import outputs_for  # noqa: PLC0415
    from caustic_cli.workflow.outputs.base import Request, Tracing  # noqa: PLC0415
    from caustic_cli.workflow.render import render  # noqa: PLC0415

    say = asked.say
    tracing = Tracing(
        rays=rays,
        tolerance=asked.tolerance,
        reconstruction=asked.reconstruction,
        filter_size=size,
        alpha=asked.alpha,
        given=given,
        screen_at=asked.screen_at,
        effects=asked.effects,
        seed=asked.seed,
        dtype=options.dtype_of(asked.dtype or "float64"),
    )
    outputs = outputs_for(asked)
    figures = render(Request(asked.project, tracing, outputs, asked.output, asked.at, asked.force), device, say)
    say.table(str(asked.project), figures_rows(figures))
    for output in outputs:
        output.show(figures, say)
    if asked.json:
        console.emit_json(figures)
    _refuse_disagreement(asked, figures)


def _refuse_disagreement(asked: RenderOptions, figures: dict[str, Any]) -> None:
    """Refuse an image that is not Mitsuba's.

    Raises:
        CausticError: they disagree.
    """
    if asked.verify and not figures["verify"]["agree"]:
        raise CausticError(f"the image and Mitsuba's disagree by more than noise; see {figures['verify']['image']}")


#: Options that apply to lamps.
OF_LAMPS = ("rays", "output", "npy", "verify", "report", "effects", "explain")


def _render_lamp(asked: RenderOptions, rays: int | None) -> None:
    """Trace a lamp and print its figures.

    Raises:
        InputError: an option is given that belongs to a lens with a height field.
    """
    from caustic_cli.project.project import Project  # noqa: PLC0415
    from caustic_cli.studies import verify  # noqa: PLC0415
    from caustic_cli.workflow import lamp  # noqa: PLC0415

    options.refuse_others(asked, OF_LAMPS)
    if asked.verify and (why := verify.not_installed()):
        raise InputError(why)
    where = (asked.output, asked.npy, asked.force, asked.say, asked.verify is not None, asked.report)
    project = Project.open(asked.project)
    figures = lamp.render(project, rays, asked.seed, *where, effects=asked.effects)
    asked.say.table(str(asked.project), lamp.rows(figures))
    if asked.explain:
        asked.say.table("effects", lamp.effects_of(project, asked.effects, figures))
    if asked.verify:
        asked.say.table("Mitsuba", verify.rows(figures["verify"]))
    if asked.json:
        console.emit_json(figures)
    _refuse_disagreement(asked, figures)


def _checked_size(asked: RenderOptions) -> list[int]:
    """The size of the filter, after a check of the options that are checked before the project is opened.

    Raises:
        InputError: one is out of range, or options exclude each other.
    """
    if asked.tolerance is not None and not 0 < asked.tolerance < 100:
        raise InputError(f"--tolerance must be greater than 0 and less than 100, got {asked.tolerance:g}")
    size = tuple(options.both(options.counts("--filter-size", asked.filter_size)))
    radius = asked.tool_radius
    if radius is not None and not (any((asked.report, asked.cut, asked.finish)) and radius > 0):
        raise InputError(f"--tool-radius belongs to --report, --cut and --finish and must be greater than 0 mm, got {radius:g}")
    others = ("verify", "explain", "html", "rays-plot", "day", "finish")
    designed = [option for option in others if getattr(asked, option.replace("-", "_"))]
    if asked.cut and designed:
        raise InputError(f"--cut goes without --{designed[0]}, which looks at the surface as designed")
    options.refuse_marks(asked, "photo")
    if asked.verify not in (None, "mitsuba"):
        raise InputError(f"--verify must be mitsuba, got {asked.verify!r}")
    if asked.verify and asked.screen_at is not None:
        raise InputError("--verify compares on the project's own screen: give no --screen-at")
    options.refuse_alpha(asked.alpha, asked.reconstruction)
    return size
