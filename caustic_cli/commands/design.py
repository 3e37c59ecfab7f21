"""caustic design: compute the lens whose caustic is the picture TARGET."""

from __future__ import annotations

import math
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.commands.figures import figures_rows
from caustic_cli.errors import InputError
from caustic_cli.schema.table import TABLE, default

EXAMPLES = """Examples:

  caustic design flame.png --source plane --mag 3

  caustic design --resume flame.caustic --iterations 400
"""


#: Settings that can be given to a design that is resumed.
CONTINUED = ("design.iterations", "design.time_limit")


class DesignOptions(options.Computation):
    """Arguments and options of caustic design."""

    target: Annotated[
        Path,
        typer.Argument(
            metavar="TARGET",
            help="The picture: an image file or a 2-D .npy of irradiance, - for standard input, or uniform, disc or headlamp where"
            " there is no such file; of a lamp also road, for equal luminance of a road to a driver, or the light of a photometric"
            " file, .ies or .ldt; with --resume, the project.",
            show_default=False,
        ),
    ]
    given: Annotated[dict[str, Any], options.TableOptions("design")]
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Settings of a common product, such as plate-100 (list: all of them); --config and options take precedence.",
        ),
    ] = None
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="TOML with any keys of project.toml; options take precedence.")
    ] = None
    resume: Annotated[bool, typer.Option("--resume", help="Resume the project TARGET from its last checkpoint.")] = False
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Project directory.  [default: TARGET's stem + .caustic, here]"),
    ] = None
    correct: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="PHOTO",
            help="Correct the lens of the project TARGET for the errors of the part in this photograph of its caustic: the heights"
            " that give the picture with these errors added, into another project (-o); refused where the gain is not certain. "
            f" {options.SEVERAL_PHOTOS}",
        ),
    ] = None
    marks: options.Marks = None
    screen_corners: options.ScreenCorners = None
    plan: Annotated[
        bool,
        typer.Option(
            "--plan", help="Design nothing: print error, seconds and memory to expect of draft, standard and fine on this machine."
        ),
    ] = False
    error: Annotated[
        float | None,
        typer.Option(
            metavar="E",
            help="Take the cheapest quality that should reach this relative RMS error, judged by light that the optimiser does not"
            " use; stop as soon as it does; if it does not, go on with further iterations that should reach it, or with the next"
            " quality.",
            show_default=False,
        ),
    ] = None
    movie: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also record the design: the image during the iterations, as the optimiser sees it, then that of the final lens;"
            " .gif, or .mp4 where ffmpeg is installed.",
        ),
    ] = None


def run(asked: DesignOptions) -> None:
    """Compute the lens whose caustic is the picture TARGET."""
    say, target = asked.say, asked.target
    _check(asked)
    if asked.correct:
        _correct(asked)
        return
    piped = not asked.resume and str(target) == "-"
    path = asked.out or Path(f"{'picture' if piped else target.stem or 'design'}.caustic")
    project = target if target.is_dir() else path
    picture = _check_before_torch(asked, project)
    if not asked.resume:  # as early as possible, while this process loads the libraries
        from caustic_cli.optics.kernels.ahead import compile_behind  # noqa: PLC0415

        compile_behind(["multigrid"], more=True)
    device = asked.start_torch()

    from caustic_cli.config.lamp import asks_for_lamp, says_lamp  # noqa: PLC0415
    from caustic_cli.workflow import library  # noqa: PLC0415

    for_lamp = says_lamp(project) if asked.resume else asks_for_lamp(asked.given, asked.preset, asked.config)
    device = _device_for_lamps(asked) if for_lamp else device
    if asked.plan:
        _print_plan(asked, picture)
        return
    with _saying_what_is_kept(project if asked.resume else path):
        how: dict[str, Any] = {"force": asked.force, "movie": asked.movie, "say": say, "device": device}
        if asked.resume:
            iterations, time_limit = (asked.given.get(setting) for setting in CONTINUED)
            lens = library.resume(project, iterations=iterations, time_limit=time_limit, **how)
        else:
            how |= {"preset": asked.preset, "config": asked.config, "out": path}
            lens = library.design_of(picture, asked.given, error=asked.error, **how)
    say.table(lens.figures["project"], (library.lamp.rows if for_lamp else figures_rows)(lens.figures))
    if asked.json:
        console.emit_json(lens.figures)


def _correct(asked: DesignOptions) -> None:
    """Correct the lens of a project by a photograph.

    Raises:
        InputError: other options are given.
    """
    if names := _beside_resume(asked) + [f"--{name}" for name in ("resume", "movie") if getattr(asked, name)]:
        raise InputError(f"--correct takes the design of the project as it is: leave out {', '.join(names)}")
    options.require_project(asked.target)
    out = asked.out or Path(f"{asked.target.resolve().stem}-corrected.caustic")
    device = asked.start_torch()

    from caustic_cli.config.lamp import says_lamp  # noqa: PLC0415
    from caustic_cli.workflow import correction  # noqa: PLC0415
    from caustic_cli.workflow.outputs import photograph  # noqa: PLC0415

    if says_lamp(asked.target):
        raise InputError("--correct is for a lens before its light, not for a lamp around it")
    where = (asked.marks, asked.screen_corners, out)
    figures = correction.correct(asked.target, asked.correct, *where, force=asked.force, device=device, say=asked.say)
    photograph.show(figures["photo"], asked.say)
    asked.say.table(figures["project"], correction.rows(figures))
    if asked.json:
        console.emit_json(figures)


def _device_for_lamps(asked: DesignOptions) -> str:
    """The device of the design of a lamp.

    Raises:
        InputError: --plan, which no lamp is designed with.
    """
    if asked.plan:
        raise InputError("--plan is for a lens before its light, not for a lamp around it")
    return "cuda" if asked.device == "cuda" else "cpu"


def _check(asked: DesignOptions) -> None:
    """Refuse numbers out of range, and options that exclude each other."""
    _check_numbers(asked)
    if (asked.plan or asked.error is not None) and (names := [n for n in ("quality", "rays") if n in asked.given]):
        raise InputError(f"--{names[0]} is what {'--plan compares' if asked.plan else '--error chooses'}: leave it out")
    if asked.plan and asked.error is not None:
        raise InputError("--plan designs nothing, so --error has no meaning beside it: leave one out")
    options.refuse_marks(asked, "correct")
    if asked.resume and (names := _beside_resume(asked)):
        raise InputError(
            f"--resume goes on with a project as it is, so {', '.join(names)} cannot be given;"
            " --iterations and --time-limit can, and project.toml can be edited"
        )


def _check_numbers(asked: DesignOptions) -> None:
    iterations, time_limit = (asked.given.get(setting) for setting in CONTINUED)
    if iterations is not None and not 1 <= iterations <= 10**9:
        raise InputError(f"--iterations must be a whole number 1 to 1e9, got {iterations}")
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"--time-limit must be greater than 0 s, got {time_limit:g}")
    if asked.error is not None and not 0 < asked.error < math.inf:
        raise InputError(f"--error must be greater than 0, got {asked.error:g}")


def _print_plan(asked: DesignOptions, picture: Any) -> None:
    """Print what each quality would cost."""
    from caustic_cli.workflow.estimate import plans  # noqa: PLC0415

    found = list(plans(picture, asked.given, preset=asked.preset, config=asked.config))
    rows = [("quality", "judged by", "error", "two of three", "seconds", "memory", "project", "diffraction")]
    for e in found:
        sizes = f"{e.memory_mib / 1024:.1f} GiB", f"{e.project_mib:.0f} MiB"
        between = f"{e.low:.2g} to {e.high:.2g}"
        rows.append((e.quality, e.error_by, f"{e.relative_rms:.2g}", between, f"{e.seconds:.0f}", *sizes, f"{e.bound:.2g}"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    asked.say.result(*("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows))
    if len({e.error_by for e in found}) > 1:
        asked.say.result("by rays: with --waves off, which leaves diffraction out")
    if asked.json:
        console.emit_json({"plan": [row._asdict() for row in found]})


def _check_before_torch(asked: DesignOptions, project: Path) -> Any:
    """Refuse input before torch is loaded and kernels are compiled; the picture, as far as it had to be read.

    Raises:
        InputError: the movie cannot be written, there is no project or picture, or a setting is out of range.
    """
    if asked.movie is not None:
        from caustic_cli.io.movie import refuse_unwritable  # noqa: PLC0415

        refuse_unwritable(asked.movie, asked.force)
    if not asked.resume:
        return _check_new(asked)
    if not asked.target.exists() and not project.exists():
        raise InputError(f"{asked.target}: no such project; --resume needs a directory made by caustic design")
    options.require_project(project)
    return asked.target


def _check_new(asked: DesignOptions) -> Any:
    """Refuse settings and picture of a new design; the picture: a path, or what was read from standard input."""
    from caustic_cli.config.presets import path_of  # noqa: PLC0415
    from caustic_cli.config.settings import by_section, implied, refuse_unused  # noqa: PLC0415
    from caustic_cli.config.values import refuse_bad_file, refuse_bad_options  # noqa: PLC0415
    from caustic_cli.io.files import read_stdin  # noqa: PLC0415
    from caustic_cli.io.photometry import SUFFIXES, read_photometry  # noqa: PLC0415
    from caustic_cli.io.picture import ACCEPTED, MAX_BYTES, is_road, read_picture  # noqa: PLC0415

    given, target = asked.given, asked.target
    if (target / "project.toml").is_file():
        raise InputError(f"{target}: is a project, not a picture; caustic design --resume {target} goes on with it")
    if asked.preset is not None:
        path_of(asked.preset)
    if asked.config is not None:
        refuse_bad_file(asked.config, parameters=True)
    refuse_bad_options(given)
    if asked.config is None and asked.preset is None:
        refuse_unused({"type": default("source.type")} | implied(by_section(given)).get("source", {}), given)
    picture = read_stdin(ACCEPTED, MAX_BYTES) if str(target) == "-" else target
    if target.suffix.lower() in SUFFIXES:
        read_photometry(target)
    elif asked.config is None and not is_road(picture):  # a configuration may set its encoding
        read_picture(picture, "target.encoding" in given, given.get("target.color", False), given.get("invert", False))
    return picture


@contextmanager
def _saying_what_is_kept(project: Path):
    """Add to the message of an interruption before the first checkpoint what is on disk.  Later ones are answered by the design
    itself, or leave a checkpoint."""
    try:
        yield
    except BaseException:  # a signal may surface as another exception, see `cli`
        if not (project / "checkpoints.h5").exists():
            begun = (project / "project.toml").exists()
            console.set_kept(
                f"{project} holds the settings and the picture, and caustic design --resume {project} begins its iterations"
                if begun
                else f"before the first checkpoint: nothing was written to {project}"
            )
        raise


def _beside_resume(asked: DesignOptions) -> list[str]:
    """Names of the given options that cannot be combined with --resume."""
    others = [TABLE[path].option for path in asked.given if path not in CONTINUED]
    files = [f"--{name}" for name in ("preset", "config", "error") if getattr(asked, name) is not None]
    files += ["--plan"] if asked.plan else []
    return [*(option.name for option in others if option), *files]
