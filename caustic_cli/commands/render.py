"""caustic render: trace the lens of a project, write the irradiance image and its figures."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from caustic_cli import console
from caustic_cli.commands import options
from caustic_cli.errors import CausticError, InputError

EXAMPLES = """Examples:

  caustic render flame.caustic --rays 4e6

  caustic render flame.caustic --screen-at 280 -o near.png --json
"""


def run(
    project: Annotated[Path, typer.Argument(help="Project directory made by caustic design, or an .npz made by caustic export.",
                                            show_default=False)],
    rays: Annotated[str, typer.Option(metavar="N", help="Number of rays, independent of those of the design.")] = "1000000",
    tolerance: Annotated[float | None, typer.Option(metavar="ERROR", help="Add rays until the image's noise, estimated,"
                                                    " is below this relative RMS; --rays is where it begins.")] = None,
    reconstruction: Annotated[str, typer.Option(help="bincount, gaussian or cosine; the figures are always by bincount.")]
    = "bincount",
    filter_size: Annotated[str, typer.Option(metavar="V[xW]", help="Filter size, odd, pixels.")] = "3",
    alpha: Annotated[float | None, typer.Option(help="Of the gaussian, 1/mm^2.  [default: 1 per pixel^2]")] = None,
    source: options.SourceType = None,
    source_file: options.SourceFile = None,
    intensity: options.Intensity = None,
    source_position: options.SourcePosition = None,
    source_size: options.SourceSize = None,
    source_grid: options.SourceGrid = None,
    source_angle: options.SourceAngle = None,
    cone: options.Cone = None,
    power: options.Power = None,
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
    verify: Annotated[str | None, typer.Option(metavar="mitsuba", help="Trace the same lens in Mitsuba 3 (pip install"
                                               " 'caustic-cli[verify]') with as many rays and compare, pixel by pixel; writes"
                                               " verify.png beside the image.  Exit status 1 if they disagree.")] = None,
    report: Annotated[bool, typer.Option("--report", help="Also say what making the lens asks for: wall, stock, slopes, concave"
                                         " radius, margin to internal reflection, sharpness, tolerances; writes report.json"
                                         " beside the image.")] = False,
    tool_radius: Annotated[float | None, typer.Option(metavar="MM", help="Radius of the tool that --report tries in concave"
                                                      " places.")] = None,
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
    """Trace the lens of PROJECT; write the irradiance image and its figures."""
    asked, began, say = locals(), time.monotonic(), console.Reporter(quiet, progress)
    count = options.rays("--rays", rays)
    if tolerance is not None and not 0 < tolerance < 100:
        raise InputError(f"--tolerance must be greater than 0 and less than 100, got {tolerance:g}")
    size = options.both(options.counts("--filter-size", filter_size))
    if tool_radius is not None and not (report and tool_radius > 0):
        raise InputError(f"--tool-radius belongs to --report and must be greater than 0 mm, got {tool_radius:g}")
    if verify not in (None, "mitsuba"):
        raise InputError(f"--verify must be mitsuba, got {verify!r}")
    if verify and screen_at is not None:
        raise InputError("--verify compares on the project's own screen: give no --screen-at")
    given = options.source(source, source_position, source_size, source_grid, source_angle, cone, power, source_file, intensity)
    given |= options.physics(polarisation, wavelengths, absorption, roughness, screen_tilt, screen_shift)
    device = options.start_torch(device, threads, say)

    from caustic_cli.derive import filter_from  # noqa: PLC0415
    from caustic_cli.files import discard, refuse_foreign  # noqa: PLC0415
    from caustic_cli.optics.emission.measured import coarse_words  # noqa: PLC0415
    from caustic_cli.optics.plan import compile_plan, parse_effects  # noqa: PLC0415
    from caustic_cli.optics.resolution import Resolution  # noqa: PLC0415
    from caustic_cli.picture import write_image, write_npy  # noqa: PLC0415
    from caustic_cli.project import RENDER, WAVE, Project, beside  # noqa: PLC0415
    from caustic_cli.reuse import Outputs  # noqa: PLC0415
    from caustic_cli.studies.retrace import retrace, white_level  # noqa: PLC0415
    from caustic_cli.studies.waves import wave_figures  # noqa: PLC0415

    wanted = parse_effects(effects)
    opened = archive = None
    if project.suffix.lower() == ".npz" and project.is_file():
        from caustic_cli.archive import open_archive  # noqa: PLC0415

        archive = open_archive(project)
        if given:
            raise InputError(f"{next(iter(given))[2]}: an archive's source is fixed; render its project under another light")
    else:
        opened = Project.open(project)
    image_path = output or (project / RENDER if opened else Path(project.stem + ".png"))
    panels = image_path.with_name("verify.png" if output is None else f"{image_path.stem}-verify.png") if verify else None
    sheet = image_path.with_name("report.json" if output is None else f"{image_path.stem}-report.json") if report else None
    of_waves = beside(image_path), beside(npy) if npy else None
    for path in (image_path, npy, panels, sheet, *of_waves):
        if path is not None:
            refuse_foreign(path, force)
    made = Outputs(opened, "render", asked, (image_path, npy, panels, sheet, *of_waves)) if opened and not verify else None
    if made and not force and (figures := made.found()):
        say.say(f"{image_path}: is what the same options made of the same project, so there is nothing to do; --force does it"
                " again")
        if json:
            console.emit_json(figures)
        return
    if opened:
        scene = opened.scene(given)
        target, (field, checkpoint) = opened.target(scene), opened.lens(scene)
        heights, iterations = checkpoint.state.heights, checkpoint.state.total
        encoding, own_seed = opened.settings["target"]["encoding"], opened.settings["design"]["seed"]
    else:
        (scene, field, heights), target, iterations, encoding, own_seed = archive, None, None, "srgb", 0
    if verify:
        from caustic_cli.studies.verify import require_mitsuba  # noqa: PLC0415

        require_mitsuba(scene)
    screen = scene.screen
    if screen_at is not None:
        screen = replace(screen, z=screen_at)
    if alpha is not None and reconstruction != "gaussian":
        raise InputError(f"--alpha belongs to --reconstruction gaussian, got {reconstruction}")
    filter = filter_from(reconstruction, size, screen, alpha)
    seed, precision = own_seed if seed is None else seed, options.dtype_of(dtype or "float64")
    try:
        scene = replace(scene, screen=screen)
        plan = compile_plan(scene, field, heights, wanted)
        if coarse := coarse_words(scene):
            say.say(coarse)
        options.compile_for(None if explain else plan.scene, device, say, plan.requests)
        exposure, figures = retrace(plan.scene, field, heights, target, rays=count, filter=filter, device=device, seed=seed,
                                    dtype=precision, tolerance=tolerance, requests=plan.requests)
    except InputError as error:
        raise InputError(str(error).replace("[screen] z", "--screen-at") if screen_at is not None else str(error)) from error
    image = exposure.image.cpu().numpy()
    write_image(image_path, image, white_level(image, target), encoding)
    if of_waves[0] == project / WAVE:
        discard(of_waves[0])  # of what render.png was before
    if npy is not None:
        write_npy(npy, image)
    if plan["diffraction"].on:
        with say.patience("taking the wave image"):
            seen = Resolution.before(plan.scene, tuple(opened.settings["target"]["size"])) if opened else \
                Resolution.at(plan.scene, field, heights)
            light, more = wave_figures(plan.scene, field, heights.to(device), target, seen, finer=1.0,
                                       required=wanted is not None)
        figures |= more
        if light is not None:
            of_light = light.image.cpu().numpy()
            write_image(of_waves[0], of_light, white_level(of_light, target), encoding)
            if npy is not None:
                write_npy(of_waves[1], of_light)
            figures |= {"wave_image": str(of_waves[0])}
    figures |= {"iterations": iterations, "seconds": time.monotonic() - began, "image": str(image_path)}
    say.table(f"{project}", console.figures_rows(figures))
    if explain:
        from caustic_cli.studies import effects as study  # noqa: PLC0415

        figures["effects"] = study.explain(plan, scene, field, heights.to(device), rays=min(count, study.RAYS), seed=seed,
                                           dtype=precision)
        say.say("\n".join(study.table(figures["effects"])))
    if report:
        from caustic_cli.studies import manufacture  # noqa: PLC0415

        figures["report"] = manufacture.manufacture(scene, field, heights, tool_radius, seed)
        manufacture.write_json(sheet, figures["report"])
        say.table(str(sheet), manufacture.rows(figures["report"]))
    if verify:
        figures["verify"] = _verify(scene, field, heights, count, seed, panels, say)
    if made:
        made.keep(figures)
    if json:
        console.emit_json(figures)
    if verify and not figures["verify"]["agree"]:
        raise CausticError(f"the image and Mitsuba's disagree by more than noise; see {panels}")


def _verify(scene, field, heights, rays: int, seed: int, panels: Path, say: console.Reporter) -> dict:
    """The figures of the comparison with Mitsuba; its picture is written to `panels`."""
    from caustic_cli.export.mitsuba import quick_samples, write_mitsuba  # noqa: PLC0415
    from caustic_cli.studies.verify import verify, write_panels  # noqa: PLC0415

    with TemporaryDirectory() as folder:
        path = Path(folder) / "lens.xml"
        write_mitsuba(path, scene, field, heights, quick_samples(field), dark=True)
        verdict = verify(path, scene, field, heights, rays, seed)
    write_panels(panels, verdict, scene)
    f = verdict.figures
    say.table(f"Mitsuba {f['mitsuba']}, {f['variant']}", [
        ("verdict", "agree" if verdict.agree else "DISAGREE"),
        ("mean Z^2, beyond 3, largest", f"{f['z_mean_square']:.3f}, {f['z_beyond_3']:.2%}, {f['z_largest']:.2f}"
                                        "  (of noise: 1, 0.27%, 4)"),
        ("judged", f"{f['pixels']:,} of {f['pixel_side']} x {f['pixel_side']} pixels, {f['noise']:.1%} noise each"),
        ("relative RMS beyond noise", f"{f['relative_rms_beyond_noise']:.4f} of {f['relative_rms']:.4f}"),
        ("light on the screen", f"{f['on_screen']:.6f}, render {f['on_screen_render']:.6f} ({f['light_z']:.1f} sigma)"),
        ("correlation, and turned", f"{f['correlation']:.5f}, {f['correlation_turned']:.5f}"),
        ("image", str(panels))])
    return f | {"image": str(panels)}
