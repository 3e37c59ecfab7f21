"""caustic design: find the lens whose caustic is TARGET."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic design flame.png --source plane --mag 3

  caustic design --resume flame.caustic --iterations 400
"""

Text = str | None


def run(
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="The picture: an image file or a 2-D .npy of irradiance;"
                                           " with --resume, the project.", show_default=False)],
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
    mirror: Annotated[bool, typer.Option("--mirror", help="The surface reflects; the screen stands on the source's side, --throw"
                                         " before it.")] = False,
    mag: Annotated[float | None, typer.Option(help="Width of the picture over width of the lens.  [default: 3]")] = None,
    lens_size: Annotated[Text, typer.Option(metavar="W[xH]", help="Lens aperture, mm.  [default: 10x10]")] = None,
    aperture: Annotated[Text, typer.Option(metavar="rectangle|circle", help="Shape of the lens; a circle is as wide as --lens-size."
                                           "  [default: rectangle]")] = None,
    border: Annotated[float | None, typer.Option(metavar="MM", help="Width of a rim around the aperture, which exported solids have"
                                                 " for their mount.  [default: 0]")] = None,
    throw: Annotated[float | None, typer.Option(help="Lens origin to screen, mm.  [default: 300]")] = None,
    screen_size: Annotated[Text, typer.Option(metavar="W[xH]", help="Screen, mm.  [default: picture plus margin]")] = None,
    resolution: Annotated[Text, typer.Option(metavar="N[xM]", help="Pixels over the whole screen; N alone counts across, rows"
                                             " follow the shape.  [default: 250]")] = None,
    margin: Annotated[float | None, typer.Option(help="Dark border, part of the picture's width in all.  [default: 0.28]")]
    = None,
    index: Annotated[float | None, typer.Option(help="Refractive index of the lens.  [default: 1.5443]")] = None,
    glass: Annotated[Text, typer.Option(help="Material instead of --index: N-BK7, SILICA, PMMA, PC, ...")] = None,
    control: Annotated[Text, typer.Option(metavar="N[xM]", help="Control points.  [default: by picture and quality]")] = None,
    degree: Annotated[Text, typer.Option(metavar="P[xQ]", help="Spline degree, 1 to 15.  [default: 3]")] = None,
    min_thickness: Annotated[float | None, typer.Option(help="Least thickness of the lens, mm.  [default: 1]")] = None,
    max_slope: Annotated[float | None, typer.Option(help="Limit of the surface's slope, mm per mm.  [default: none]")] = None,
    min_radius: Annotated[float | None, typer.Option(metavar="MM", help="Least radius of curvature of concave places, such as a"
                                                     " tool's.  [default: any]")] = None,
    linear: Annotated[bool, typer.Option("--linear", help="Pixel values are irradiance as they are, not sRGB-encoded.")] = False,
    color: Annotated[bool, typer.Option("--color", help="Keep red, green and blue apart (611, 549, 464 nm), with the glass' index"
                                        " for each.  [default glass: N-BK7]")] = False,
    flip: Annotated[Text, typer.Option(metavar="x|y|xy", help="Mirror the picture, for a viewer on the lens' side.")] = None,
    start: Annotated[Text, typer.Option(metavar="transport|offset|PROJECT|FILE", help="First surface: by optimal transport of the"
                                        " light to the picture, the sphere that follows from --mag, or the lens of another"
                                        " project or of a file: .npz or .step as exported, .npy of heights in mm."
                                        "  [default: transport; offset for a network, adam, several"
                                        " points or a small net]")] = None,
    quality: Annotated[Text, typer.Option(help="draft, standard or fine.  [default: standard]")] = None,
    rays: Annotated[Text, typer.Option(metavar="N", help="Rays of the last stage.  [default: by quality]")] = None,
    loss: Annotated[Text, typer.Option(help="rms (eq. 5.2.1), rms-light, where every ray counts, throughput, light (what does"
                                       " not reach the screen), diffusion, uniformity, laplacian, curvature; or a weighted sum:"
                                       " 'rms-light + 0.01 laplacian'."
                                       "  [default: rms-light]")] = None,
    waves: Annotated[Text, typer.Option(metavar="auto|on|off", help="Refine the wave image after the ray image: where diffraction"
                                        " matters and time allows, always, or never.  [default: auto]")] = None,
    network: Annotated[Text, typer.Option(help="none, sparse or dense.  [default: none]")] = None,
    optimizer: Annotated[Text, typer.Option(help="lbfgs or adam.  [default: lbfgs; adam for a network]")] = None,
    lr: Annotated[float | None, typer.Option(help="Learning rate of adam.  [default: 0.001]")] = None,
    iterations: Annotated[int | None, typer.Option(help="Iterations in all; with --resume, counted from the very first."
                                                   "  [default: what the stages say]")] = None,
    time_limit: Annotated[float | None, typer.Option(metavar="SECONDS", help="Stop optimising after so many seconds."
                                                     "  [default: none]")] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="TOML with any keys of project.toml; options win.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the project TARGET from its last checkpoint.")] = False,
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="DIR", help="Project directory."
                                             "  [default: TARGET's stem + .caustic, here]")] = None,
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
    """Find the lens whose caustic is the picture TARGET."""
    speaks = os.environ.get("RANK", "0") == "0"  # under torchrun, the first of all
    began, say = time.monotonic(), console.Reporter(quiet or not speaks, progress)
    given = {
        **options.source(source, source_position, source_size, source_grid, source_angle, cone, power, source_file, intensity),
        **options.physics(polarisation, wavelengths, absorption, roughness, screen_tilt, screen_shift),
        ("lens", "mirror", "--mirror"): mirror or None,
        ("lens", "size", "--lens-size"): lens_size and options.both(options.size("--lens-size", lens_size)),
        ("lens", "aperture", "--aperture"): aperture,
        ("lens", "border", "--border"): border,
        ("lens", "index", "--index"): index,
        ("lens", "glass", "--glass"): glass,
        ("lens", "control", "--control"): control and options.both(options.counts("--control", control)),
        ("lens", "degree", "--degree"): degree and options.both(options.counts("--degree", degree)),
        ("lens", "min_thickness", "--min-thickness"): min_thickness,
        ("design", "max_slope", "--max-slope"): max_slope,
        ("design", "min_radius", "--min-radius"): min_radius,
        ("screen", "z", "--throw"): -throw if mirror and throw is not None else throw,
        ("target", "encoding", "--linear"): "linear" if linear else None,
        ("target", "flip", "--flip"): flip,
        ("target", "color", "--color"): color or None,
        ("design", "loss", "--loss"): loss,
        ("design", "waves", "--waves"): waves,
        ("design", "network", "--network"): network,
        ("design", "optimizer", "--optimizer"): optimizer or ("adam" if network in ("sparse", "dense") else None),
        ("design", "lr", "--lr"): lr,
        ("design", "iterations", "--iterations"): iterations,
        ("design", "time_limit", "--time-limit"): time_limit,
        ("design", "start", "--start"): start,
        ("design", "seed", "--seed"): seed,
        ("design", "dtype", "--dtype"): dtype,
    }
    given = {key: value for key, value in given.items() if value is not None}
    screen = options.size("--screen-size", screen_size) if screen_size else None
    pixels = options.counts("--resolution", resolution) if resolution else None
    shaped = {"mag": mag, "margin": margin, "quality": quality, "rays": options.rays("--rays", rays) if rays else None}
    if iterations is not None and not 1 <= iterations <= 10**9:
        raise InputError(f"--iterations must be a whole number 1 to 1e9, got {iterations}")
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"--time-limit must be greater than 0 s, got {time_limit:g}")
    if not resume and speaks:
        from caustic_cli.io.picture import read_picture  # noqa: PLC0415

        read_picture(target, linear, color)  # before torch is loaded and kernels are compiled for nothing
    device = options.start_torch(device, threads, say)

    from caustic_cli.inverse import ranks  # noqa: PLC0415
    from caustic_cli.workflow import design as workflow  # noqa: PLC0415
    from caustic_cli.workflow.compilation import compile_for  # noqa: PLC0415

    with ranks.together(device) as rank:
        if rank > 0:
            workflow.follow(device)
            return
        if resume:
            names = [key[2] for key in given if key[2] not in ("--iterations", "--time-limit")]
            names += [f"--{k}" for k, v in shaped.items() if v is not None]
            names += [n for n, v in (("--screen-size", screen), ("--resolution", pixels), ("--config", config)) if v is not None]
            if names:
                raise InputError(f"--resume goes on with a project as it is, so {', '.join(names)} cannot be given;"
                                 " --iterations and --time-limit can, and project.toml can be edited")
            project = workflow.find(target, out)
            compile_for(project.scene(), device, say, gradient=True)
            figures = workflow.resume(project, iterations, time_limit, device, say, began)
        else:
            with say.patience("solving the transport of the light to the picture; the first time, its kernels are compiled, which"
                              " takes about half a minute"):
                project, first = workflow.begin(target, out, given, screen, pixels, shaped, config, force)
            compile_for(project.scene(), device, say, gradient=True)
            figures = workflow.design(project, first, device, say, began)
    say.table(str(project.path), [*console.figures_rows(figures), ("ended by", figures["reason"])])
    if json:
        console.emit_json(figures)
