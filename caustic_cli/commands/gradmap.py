"""caustic gradmap: the derivative of the image with respect to a control height."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic gradmap flame.caustic --control 60,70

  caustic gradmap flame.caustic --filter-size 11 --check --json
"""


#: Options that apply to lamps.
OF_LAMPS = ("control", "rays", "reconstruction", "filter_size", "alpha", "check", "output", "npy")


class GradmapOptions(options.OfDesign, options.OnDevice):
    """Arguments and options of caustic gradmap."""

    project: Annotated[Path, typer.Argument(help="Project directory made by caustic design.", show_default=False)]
    control: Annotated[
        list[str] | None,
        typer.Option(
            metavar="I,J",
            help="Control point, counted from 0 at the -x, -y corner, of a lamp that of the radius of the outer surface; may be"
            " repeated.  [default: the middle one]",
        ),
    ] = None
    rays: Annotated[str, typer.Option(metavar="N", help="Number of rays.")] = "1000000"
    reconstruction: Annotated[str, typer.Option(help="gaussian or cosine; bincount has no derivative.")] = "cosine"
    filter_size: Annotated[str, typer.Option(metavar="V[xW]", help="Filter size, odd, 3 or more (pixels).")] = "3"
    alpha: Annotated[float | None, typer.Option(help="Alpha of the gaussian filter (1/mm^2).  [default: 1 per pixel^2]")] = None
    check: Annotated[bool, typer.Option("--check", help="Compare with central differences.")] = False
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="PNG",
            help="Image to write; with several points, -I-J is added.  [default: gradmap-I-J.png in PROJECT]",
        ),
    ] = None
    npy: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write the derivative, fractions of the source's power per mm, float64, [i, j]."),
    ] = None


def run(asked: GradmapOptions) -> None:
    """Compute the derivative of the image with respect to a control height, by one forward-mode pass."""
    began, say = time.monotonic(), asked.say
    count, size = options.rays("--rays", asked.rays), options.both(options.counts("--filter-size", asked.filter_size))
    points = [options.indices("--control", text) for text in asked.control or []]
    options.require_project(asked.project)
    device = asked.start_torch()

    from caustic_cli.config.lamp import says_lamp  # noqa: PLC0415
    from caustic_cli.io.picture import write_npy  # noqa: PLC0415
    from caustic_cli.optics import ranks  # noqa: PLC0415
    from caustic_cli.studies.gradmap import plot_gradient  # noqa: PLC0415
    from caustic_cli.workflow.derivatives import OfLamp, OfLens  # noqa: PLC0415

    options.refuse_alpha(asked.alpha, asked.reconstruction)
    how = (asked.project, count, asked.seed, asked.reconstruction, size, asked.alpha)
    if says_lamp(asked.project):
        options.refuse_others(asked, OF_LAMPS)
        derivative: OfLamp | OfLens = OfLamp.of(*how)
    else:
        derivative = OfLens.of(*how, at=asked.at, device=device, dtype=options.dtype_of(asked.dtype or "float64"), say=say)
    shape = derivative.shape
    points = points or [(shape[0] // 2, shape[1] // 2)]
    for i, j in points:
        if not (0 <= i < shape[0] and 0 <= j < shape[1]):
            raise InputError(f"--control must be I,J with I 0 to {shape[0] - 1} and J 0 to {shape[1] - 1}, got {i},{j}")
    maps = []
    files = _files(asked, points)
    for point, (image, npy), gradient in zip(points, files, ranks.mapped(derivative.image, points), strict=True):
        title = f"derivative with respect to control height {point[0]}, {point[1]}"
        plot_gradient(image, gradient, derivative.screen, title, derivative.unit)
        if npy is not None:
            write_npy(npy, gradient.cpu().numpy())
        found: dict[str, Any] = {
            "control": list(point),
            "sum": float(gradient.sum()),
            "largest": float(gradient.abs().max()),
            "image": str(image),
            "npy": None if npy is None else str(npy),
        }
        if asked.check:
            found["check"] = asdict(derivative.compared(gradient, point))
        maps.append(found)
        say.table(f"control point {point[0]}, {point[1]}", _rows(found))
    if asked.json:
        console.emit_json({"maps": maps, "rays": derivative.rays, "seconds": time.monotonic() - began})


def _rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """The figures of a derivative as rows of a table."""
    rows = [
        ("sum over pixels", f"{found['sum']:.4e} per mm"),
        ("largest pixel", f"{found['largest']:.4e} per mm"),
        ("image", found["image"]),
    ]
    if "check" in found:
        error, step = found["check"]["relative_error"], found["check"]["step"]
        words = "the difference vanishes, the derivative does not"
        rows.append(("against central differences", words if error is None else f"relative error {error:.1e}, step {step:.1e} mm"))
    return rows


def _files(asked: GradmapOptions, points: list[tuple[int, int]]) -> list[tuple[Path, Path | None]]:
    """The image and the array, None unless asked for, of each control point.

    Raises:
        InputError: one cannot be written.
    """
    from caustic_cli.io.files import destination, refuse_foreign  # noqa: PLC0415

    for path in filter(None, (asked.output, asked.npy)):
        destination(path)  # refuses what is no file name, before others are made of it

    def place(base: Path, point: tuple[int, int]) -> Path:
        return base if len(points) == 1 else base.with_name(f"{base.stem}-{point[0]}-{point[1]}{base.suffix}")

    files = []
    for point in points:
        image = place(asked.output, point) if asked.output else asked.project / f"gradmap-{point[0]}-{point[1]}.png"
        npy = place(asked.npy, point) if asked.npy else None
        for path in filter(None, (image, npy)):
            refuse_foreign(path, asked.force)
        files.append((image, npy))
    return files
