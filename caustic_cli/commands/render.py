"""caustic render: trace the lens of a project, and write the irradiance image and its figures of merit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import CausticError, InputError

EXAMPLES = """Examples:

  caustic render flame.caustic --rays 4e6

  caustic render flame.caustic --screen-at 280 -o near.png --json
"""


@options.from_table("render")
def run(
    project: Annotated[
        Path,
        typer.Argument(help="Project directory made by caustic design, or an .npz made by caustic export.", show_default=False),
    ],
    given: dict[str, Any],
    rays: Annotated[
        str | None,
        typer.Option(
            metavar="N",
            help="Number of rays, independent of those of the design.  [default: as at the end of a design: 4e6; for a plane"
            " wave at least 64 per pixel (at most 6.4e7); for other light up to 1.6e7 until the noise is a tenth of the"
            " error; with --tolerance, 1e6]",
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            metavar="ERROR",
            help="Add rays until the estimated noise of the image is below this relative RMS; --rays is the initial number.",
        ),
    ] = None,
    reconstruction: Annotated[
        str, typer.Option(help="bincount, gaussian or cosine; the figures are always by bincount.")
    ] = "bincount",
    filter_size: Annotated[str, typer.Option(metavar="V[xW]", help="Filter size, odd (pixels).")] = "3",
    alpha: Annotated[float | None, typer.Option(help="Alpha of the gaussian filter (1/mm^2).  [default: 1 per pixel^2]")] = None,
    at: options.At = None,
    screen_at: Annotated[float | None, typer.Option(metavar="Z", help="Move the screen to this position (mm).")] = None,
    effects: Annotated[
        str,
        typer.Option(
            metavar="auto|none|NAME[,NAME...]",
            help="Effects to simulate: those that the scene needs, none that can be omitted, or the listed ones (see --explain).",
        ),
    ] = "auto",
    explain: Annotated[
        bool,
        typer.Option("--explain", help="Show which effects are simulated, why, the cost of each, and the error of omitting it."),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="PNG",
            help="Image to write, with the pixels of the screen.  [default: render.png in PROJECT, at least 800 pixels wide,"
            " unless a less noisy one of the same scene exists; for an archive, its name + -render.png, here]",
        ),
    ] = None,
    npy: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write the irradiance: power per pixel as a fraction of the source's, float64, [i, j]."
        ),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write a self-contained page that traces the lens in any browser: the lens in three dimensions,"
            " the caustic for movable screen and light, target and difference.",
        ),
    ] = None,
    verify: Annotated[
        str | None,
        typer.Option(
            metavar="mitsuba",
            help="Trace the same lens in Mitsuba 3 (pip install"
            " mitsuba) with as many rays and compare, pixel by pixel; writes"
            " verify.png beside the image.  Exit status 1 if they disagree.",
        ),
    ] = None,
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Also report the manufacturing data of the lens: wall, stock, slopes, concave"
            " radius, margin to internal reflection, sharpness, tolerances; writes report.json"
            " beside the image.",
        ),
    ] = False,
    tool_radius: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Tool radius that --report checks in concave regions, and that of a --cut program that does not state it (mm).",
        ),
    ] = None,
    cut: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Trace the surface machined by this program (G-code, as from caustic export --format gcode) with a ball-nose tool,"
            " including scallops.",
        ),
    ] = None,
    tolerances: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also analyse the manufacturing and alignment errors of this TOML file (like examples/tolerances.toml):"
            " sensitivities, percentiles of error and light, worst offenders; writes tolerances.csv and .png beside the image.",
        ),
    ] = None,
    want: Annotated[
        Path | None,
        typer.Option(
            metavar="PICTURE",
            help="For a lenslet array: the source brightness of each lenslet that gives this illumination (non-negative least"
            " squares over the images of the single lenslets); writes wanted.png beside the image.",
        ),
    ] = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    progress: options.Progress = "auto",
    seed: options.Seed = None,
    device: options.Device = "auto",
    dtype: options.Dtype = None,
    threads: options.Threads = None,
    debug: options.Debug = False,
) -> None:
    """Trace the lens of PROJECT; write the irradiance image and its figures of merit."""
    say = console.Reporter(quiet, progress, json)
    count = None if rays is None else options.rays("--rays", rays)
    if tolerance is not None and not 0 < tolerance < 100:
        raise InputError(f"--tolerance must be greater than 0 and less than 100, got {tolerance:g}")
    size = options.both(options.counts("--filter-size", filter_size))
    if tool_radius is not None and not ((report or cut) and tool_radius > 0):
        raise InputError(f"--tool-radius belongs to --report and --cut and must be greater than 0 mm, got {tool_radius:g}")
    designed = [name for name, there in (("--verify", verify), ("--explain", explain), ("--html", html)) if there]
    if cut and designed:
        raise InputError(f"--cut goes without {designed[0]}, which looks at the surface as designed")
    if verify not in (None, "mitsuba"):
        raise InputError(f"--verify must be mitsuba, got {verify!r}")
    if verify and screen_at is not None:
        raise InputError("--verify compares on the project's own screen: give no --screen-at")
    if alpha is not None and reconstruction != "gaussian":
        raise InputError(f"--alpha belongs to --reconstruction gaussian, got {reconstruction}")
    given = {
        path: value for path, value in given.items() if not path.startswith("design.")
    }  # seed and dtype apply to this render's rays
    if screen_at is not None:
        console.set_option_names(console.option_names() | {"screen.z": "--screen-at"})
    options.require_project(project, archives=True)

    from caustic_cli.config import tolerances as schema  # noqa: PLC0415
    from caustic_cli.config.values import refuse_bad_options  # noqa: PLC0415

    refuse_bad_options(given)
    if tolerances is not None:
        schema.read(tolerances)
    device = options.start_torch(device, threads, say)

    from caustic_cli.workflow.render import Request, render  # noqa: PLC0415

    asked = Request(
        project,
        count,
        tolerance,
        reconstruction,
        size,
        alpha,
        given,
        screen_at,
        effects,
        explain,
        output,
        npy,
        html,
        verify is not None,
        report,
        tool_radius,
        cut,
        force,
        seed,
        options.dtype_of(dtype or "float64"),
        tolerances,
        want,
        at,
    )
    figures = render(asked, device, say)
    _show(str(project), figures, say)
    if json:
        console.emit_json(figures)
    if verify and not figures["verify"]["agree"]:
        raise CausticError(f"the image and Mitsuba's disagree by more than noise; see {figures['verify']['image']}")


def _show(title: str, figures: dict, say: console.Reporter) -> None:
    """Print the figures of merit and the requested reports."""
    say.table(title, console.figures_rows(figures))
    if "cut" in figures:
        from caustic_cli.workflow.machining import rows as of_cut  # noqa: PLC0415

        say.table(f"as {figures['cut']['program']} cuts it", of_cut(figures))
    if "effects" in figures:
        from caustic_cli.studies.effects import table  # noqa: PLC0415

        say.result(*table(figures["effects"]))
    if "report" in figures:
        from caustic_cli.studies.manufacture import rows  # noqa: PLC0415

        say.table("making the lens", rows(figures["report"]))
    if "tolerances" in figures:
        from caustic_cli.studies.tolerances import rows as of_tolerances  # noqa: PLC0415

        say.table("tolerances", of_tolerances(figures["tolerances"]))
    if "want" in figures:
        from caustic_cli.workflow.illumination import rows as of_wanted  # noqa: PLC0415

        say.table("brightness of the lenslets' sources", of_wanted(figures["want"]))
    if "verify" in figures:
        f = figures["verify"]
        say.table(
            f"Mitsuba {f['mitsuba']}, {f['variant']}",
            [
                ("decision", "agree" if f["agree"] else "DISAGREE"),
                (
                    "mean Z^2, beyond 3, largest",
                    f"{f['z_mean_square']:.3f}, {f['z_beyond_3']:.2%}, {f['z_largest']:.2f}  (of noise: 1, 0.27%, 4)",
                ),
                ("judged", f"{f['pixels']:,} of {f['pixel_side']} x {f['pixel_side']} pixels, {f['noise']:.1%} noise each"),
                ("relative RMS beyond noise", f"{f['relative_rms_beyond_noise']:.4f} of {f['relative_rms']:.4f}"),
                ("light on the screen", f"{f['on_screen']:.6f}, render {f['on_screen_render']:.6f} ({f['light_z']:.1f} sigma)"),
                ("correlation, and turned", f"{f['correlation']:.5f}, {f['correlation_turned']:.5f}"),
                ("image", f["image"]),
            ],
        )
