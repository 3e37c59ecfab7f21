"""caustic gradmap: the derivative of the image with respect to a control height."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic gradmap flame.caustic --control 60,70

  caustic gradmap flame.caustic --filter-size 11 --check --json
"""


def run(
    project: options.Project,
    control: Annotated[
        list[str] | None,
        typer.Option(
            metavar="I,J", help="Control point, counted from 0 at the -x, -y corner; may be repeated.  [default: the middle one]"
        ),
    ] = None,
    rays: Annotated[str, typer.Option(metavar="N", help="Number of rays.")] = "1000000",
    reconstruction: Annotated[str, typer.Option(help="gaussian or cosine; bincount has no derivative.")] = "cosine",
    filter_size: Annotated[str, typer.Option(metavar="V[xW]", help="Filter size, odd, 3 or more (pixels).")] = "3",
    alpha: Annotated[float | None, typer.Option(help="Alpha of the gaussian filter (1/mm^2).  [default: 1 per pixel^2]")] = None,
    check: Annotated[bool, typer.Option("--check", help="Compare with central differences.")] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="PNG",
            help="Image to write; with several points, -I-J is added.  [default: gradmap-I-J.png in PROJECT]",
        ),
    ] = None,
    npy: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the derivative, fractions of the source's power per mm, float64, [i, j]."),
    ] = None,
    at: options.At = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    seed: options.Seed = None,
    device: options.Device = "auto",
    dtype: options.Dtype = None,
    threads: options.Threads = None,
    debug: options.Debug = False,
) -> None:
    """Compute the derivative of the image with respect to a control height, by one forward-mode pass."""
    began, say = time.monotonic(), console.Reporter(quiet, as_json=json)
    count = options.rays("--rays", rays)
    size = options.both(options.counts("--filter-size", filter_size))
    points = [options.indices("--control", text) for text in control or []]
    options.require_project(project)
    device = options.start_torch(device, threads, say)

    from caustic_cli.config.design import filter_from  # noqa: PLC0415
    from caustic_cli.io.files import destination, refuse_foreign  # noqa: PLC0415
    from caustic_cli.io.picture import write_npy  # noqa: PLC0415
    from caustic_cli.project.project import Project  # noqa: PLC0415
    from caustic_cli.studies import gradmap  # noqa: PLC0415
    from caustic_cli.studies.retrace import sampler_for  # noqa: PLC0415
    from caustic_cli.workflow.compilation import compile_for  # noqa: PLC0415

    opened = Project.open(project).at(at)
    scene = opened.scene()
    scene, field, heights, _ = opened.lens(scene)
    points = points or [(field.shape[0] // 2, field.shape[1] // 2)]
    for i, j in points:
        if not (0 <= i < field.shape[0] and 0 <= j < field.shape[1]):
            raise InputError(f"--control must be I,J with I 0 to {field.shape[0] - 1} and J 0 to {field.shape[1] - 1}, got {i},{j}")

    for path in [path for path in (output, npy) if path is not None]:
        destination(path)  # refuses what is no file name, before others are made of it

    def place(base: Path, point: tuple[int, int]) -> Path:
        return base if len(points) == 1 else base.with_name(f"{base.stem}-{point[0]}-{point[1]}{base.suffix}")

    files = [
        (place(output, p) if output else project / f"gradmap-{p[0]}-{p[1]}.png", place(npy, p) if npy else None) for p in points
    ]
    for pair in files:
        for path in pair:
            if path is not None:
                refuse_foreign(path, force)
    if alpha is not None and reconstruction != "gaussian":
        raise InputError(f"--alpha belongs to --reconstruction gaussian, got {reconstruction}")
    filter = filter_from(reconstruction, size, scene.screen, alpha)
    sampler = sampler_for(scene, count, opened.settings.design.seed if seed is None else seed, device)
    compile_for(scene, device, say)
    maps = []
    for point, (image, data) in zip(points, files, strict=True):
        gradient = gradmap.gradient_image(
            scene, field, heights, point, sampler=sampler, filter=filter, dtype=options.dtype_of(dtype or "float64")
        )
        gradmap.plot_gradient(image, gradient, scene, f"derivative with respect to control height {point[0]}, {point[1]}")
        if data is not None:
            write_npy(data, gradient.cpu().numpy())
        row = {
            "control": list(point),
            "sum": float(gradient.sum()),
            "largest": float(gradient.abs().max()),
            "image": str(image),
            "npy": None if data is None else str(data),
        }
        lines = [
            ("sum over pixels", f"{row['sum']:.4e} per mm"),
            ("largest pixel", f"{row['largest']:.4e} per mm"),
            ("image", str(image)),
        ]
        if check:
            found = gradmap.compare(gradient, scene, field, heights, point, sampler=sampler, filter=filter)
            row["check"] = {"relative_error": found.relative_error, "largest_error": found.largest_error, "step": found.step}
            lines.append(
                (
                    "against central differences",
                    f"relative error {found.relative_error:.1e}, step {found.step:.1e} mm"
                    if found.relative_error is not None
                    else "the difference vanishes, the derivative does not",
                )
            )
        maps.append(row)
        say.table(f"control point {point[0]}, {point[1]}", lines)
    if json:
        console.emit_json({"maps": maps, "rays": sampler.count, "seconds": time.monotonic() - began})
