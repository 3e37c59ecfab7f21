"""caustic render: trace the lens of a project, write the irradiance image and its figures."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli import console
from caustic_cli.commands import options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic render flame.caustic --rays 4e6

  caustic render flame.caustic --screen-at 280 -o near.png --json
"""


def run(
    project: options.Project,
    rays: Annotated[str, typer.Option(metavar="N", help="Number of rays, independent of those of the design.")] = "1000000",
    tolerance: Annotated[float | None, typer.Option(metavar="ERROR", help="Add rays until the image's noise, estimated,"
                                                    " is below this relative RMS; --rays is where it begins.")] = None,
    reconstruction: Annotated[str, typer.Option(help="bincount, gaussian or cosine; the figures are always by bincount.")]
    = "bincount",
    filter_size: Annotated[str, typer.Option(metavar="V[xW]", help="Filter size, odd, pixels.")] = "3",
    alpha: Annotated[float | None, typer.Option(help="Of the gaussian, 1/mm^2.  [default: 1 per pixel^2]")] = None,
    source: options.SourceType = None,
    source_position: options.SourcePosition = None,
    source_size: options.SourceSize = None,
    source_grid: options.SourceGrid = None,
    source_angle: options.SourceAngle = None,
    cone: options.Cone = None,
    polarisation: options.Polarisation = None,
    wavelengths: options.Wavelengths = None,
    absorption: options.Absorption = None,
    roughness: options.Roughness = None,
    screen_tilt: options.ScreenTilt = None,
    screen_shift: options.ScreenShift = None,
    screen_at: Annotated[float | None, typer.Option(metavar="Z", help="Put the screen here instead, mm.")] = None,
    effects: Annotated[str, typer.Option(metavar="auto|none|NAME[,NAME...]", help="Effects to simulate: what the scene calls"
                                         " for, none that can be left out, or just these (--explain lists them).")] = "auto",
    explain: Annotated[bool, typer.Option("--explain", help="Show which effects are simulated, why, what each costs, and what"
                                          " leaving it out does.")] = False,
    output: Annotated[Path | None, typer.Option("-o", "--out", metavar="PNG",
                                                help="Image to write.  [default: render.png in PROJECT]")] = None,
    npy: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the irradiance: power per pixel as a part "
                                             "of the source's, float64, [i, j].")] = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    seed: options.Seed = None,
    device: options.Device = "auto",
    dtype: options.Dtype = None,
    threads: options.Threads = None,
    debug: options.Debug = False,
) -> None:
    """Trace the lens of PROJECT; write the irradiance image and its figures."""
    began, say = time.monotonic(), console.Reporter(quiet)
    count = options.rays("--rays", rays)
    if tolerance is not None and not 0 < tolerance < 100:
        raise InputError(f"--tolerance must be greater than 0 and less than 100, got {tolerance:g}")
    size = options.both(options.counts("--filter-size", filter_size))
    given = options.source(source, source_position, source_size, source_grid, source_angle, cone)
    given |= options.physics(polarisation, wavelengths, absorption, roughness, screen_tilt, screen_shift)
    device = options.start_torch(device, threads, say)

    from caustic_cli.derive import filter_from  # noqa: PLC0415
    from caustic_cli.files import refuse_foreign  # noqa: PLC0415
    from caustic_cli.optics.plan import compile_plan, parse_effects  # noqa: PLC0415
    from caustic_cli.picture import write_image, write_npy  # noqa: PLC0415
    from caustic_cli.project import RENDER, Project  # noqa: PLC0415
    from caustic_cli.studies.retrace import retrace, white_level  # noqa: PLC0415

    wanted = parse_effects(effects)
    opened = Project.open(project)
    image_path = output or project / RENDER
    for path in (image_path, npy):
        if path is not None:
            refuse_foreign(path, force)
    scene = opened.scene(given)
    options.compile_for(scene if wanted is None and not explain else None, device, say)
    target = opened.target(scene)
    field, checkpoint = opened.lens(scene)
    screen = scene.screen
    if screen_at is not None:
        screen = replace(screen, z=screen_at)
    if alpha is not None and reconstruction != "gaussian":
        raise InputError(f"--alpha belongs to --reconstruction gaussian, got {reconstruction}")
    filter = filter_from(reconstruction, size, screen, alpha)
    seed, precision = opened.settings["design"]["seed"] if seed is None else seed, options.dtype_of(dtype or "float64")
    heights = checkpoint.state.heights
    try:
        scene = replace(scene, screen=screen)
        plan = compile_plan(scene, field, heights, wanted)
        exposure, figures = retrace(plan.scene, field, heights, target, rays=count, filter=filter, device=device, seed=seed,
                                    dtype=precision, tolerance=tolerance, steps=plan.steps)
    except InputError as error:
        raise InputError(str(error).replace("[screen] z", "--screen-at") if screen_at is not None else str(error)) from error
    image = exposure.image.cpu().numpy()
    write_image(image_path, image, white_level(image, target), opened.settings["target"]["encoding"])
    if npy is not None:
        write_npy(npy, image)
    figures |= {"iterations": checkpoint.state.total, "seconds": time.monotonic() - began, "image": str(image_path)}
    say.table(f"{project}", console.figures_rows(figures))
    if explain:
        from caustic_cli.studies import effects as study  # noqa: PLC0415

        figures["effects"] = study.explain(plan, scene, field, heights.to(device), rays=min(count, study.RAYS), seed=seed,
                                           dtype=precision)
        say.say("\n".join(study.table(figures["effects"])))
    if json:
        console.emit_json(figures)
