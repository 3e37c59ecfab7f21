"""caustic design: compute the lens whose caustic is the picture TARGET."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.config import checks
from caustic_cli.config.table import TABLE, default
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic design flame.png --source plane --mag 3

  caustic design --resume flame.caustic --iterations 400
"""


@options.from_table("design")
def run(
    target: Annotated[
        Path,
        typer.Argument(
            metavar="TARGET",
            help="The picture: an image file or a 2-D .npy of irradiance, - for standard input; with --resume, the project.",
            show_default=False,
        ),
    ],
    given: dict[str, Any],
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Settings of a common product, such as plate-100 (list: all of them); --config and options take precedence.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="TOML with any keys of project.toml; options take precedence.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume the project TARGET from its last checkpoint.")] = False,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="Project directory.  [default: TARGET's stem + .caustic, here]"),
    ] = None,
    movie: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also record the design: the image during the iterations, as the optimiser sees it, then that of the final lens;"
            " .gif, or .mp4 where ffmpeg is installed.",
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
    """Compute the lens whose caustic is the picture TARGET."""
    speaks = checks.rank_and_size()[0] == 0  # under torchrun, rank 0
    say = console.Reporter(quiet or not speaks, progress, json)
    iterations, time_limit = given.get("design.iterations"), given.get("design.time_limit")
    if iterations is not None and not 1 <= iterations <= 10**9:
        raise InputError(f"--iterations must be a whole number 1 to 1e9, got {iterations}")
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"--time-limit must be greater than 0 s, got {time_limit:g}")
    if resume and (names := _beside_resume(given, preset, config)):
        raise InputError(
            f"--resume goes on with a project as it is, so {', '.join(names)} cannot be given;"
            " --iterations and --time-limit can, and project.toml can be edited"
        )
    piped = not resume and str(target) == "-"
    path = out or Path(f"{'picture' if piped else target.stem or 'design'}.caustic")
    picture: Any = target
    if movie is not None and speaks:
        from caustic_cli.io.movie import refuse_unwritable  # noqa: PLC0415

        refuse_unwritable(movie, force)
    if not resume and speaks:
        from caustic_cli.config.presets import path_of  # noqa: PLC0415
        from caustic_cli.config.settings import by_section, implied, refuse_unused  # noqa: PLC0415
        from caustic_cli.config.values import refuse_bad_file, refuse_bad_options  # noqa: PLC0415
        from caustic_cli.io.files import read_stdin  # noqa: PLC0415
        from caustic_cli.io.picture import ACCEPTED, MAX_BYTES, read_picture  # noqa: PLC0415

        if (target / "project.toml").is_file():
            raise InputError(f"{target}: is a project, not a picture; caustic design --resume {target} goes on with it")
        # checked before torch is loaded and kernels are compiled
        if preset is not None:
            path_of(preset)
        if config is not None:
            refuse_bad_file(config, parameters=True)
        refuse_bad_options(given)
        if config is None and preset is None:
            refuse_unused({"type": default("source.type")} | implied(by_section(given)).get("source", {}), given)
        picture = read_stdin(ACCEPTED, MAX_BYTES) if piped else target
        if config is None:  # a configuration may set its encoding
            read_picture(picture, "target.encoding" in given, given.get("target.color", False), given.get("invert", False))
    project = target if target.is_dir() else path
    if resume and speaks:
        if not target.exists() and not project.exists():
            raise InputError(f"{target}: no such project; --resume needs a directory made by caustic design")
        options.require_project(project)
    device = options.start_torch(device, threads, say)

    from caustic_cli.inverse import ranks  # noqa: PLC0415
    from caustic_cli.workflow import library  # noqa: PLC0415
    from caustic_cli.workflow.design import follow  # noqa: PLC0415

    with _saying_what_is_kept(path if not resume else project), ranks.process_group(device) as rank:
        if rank > 0:
            follow(device)
            return
        if resume:
            lens = library.resume(
                project, iterations=iterations, time_limit=time_limit, movie=movie, force=force, say=say, device=device
            )
        else:
            lens = library.design_of(
                picture, given, preset=preset, config=config, out=path, force=force, movie=movie, say=say, device=device
            )
    say.table(lens.figures["project"], console.figures_rows(lens.figures))
    if json:
        console.emit_json(lens.figures)


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


def _beside_resume(given: dict[str, Any], preset: str | None, config: Path | None) -> list[str]:
    """Names of the given options that cannot be combined with --resume."""
    others = [TABLE[path].option for path in given if path not in ("design.iterations", "design.time_limit")]
    files = [name for name, value in (("--preset", preset), ("--config", config)) if value is not None]
    return [*(option.name for option in others if option), *files]
