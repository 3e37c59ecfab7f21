"""Options that several commands share, defined once, and the parsing of sizes and counts."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli.commands.console import Reporter
from caustic_cli.errors import InputError

Json = Annotated[bool, typer.Option("--json", help="Print exactly one JSON object on stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", envvar="CAUSTIC_QUIET", help="Say nothing on stderr but errors.")]
Debug = Annotated[bool, typer.Option("--debug", envvar="CAUSTIC_DEBUG", help="Show the traceback of an error.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is in the way.")]
Seed = Annotated[int | None, typer.Option(envvar="CAUSTIC_SEED", help="Seed of every random number; the same seed gives the same"
                                          " bytes.  [default: 0]")]
Device = Annotated[str, typer.Option(envvar="CAUSTIC_DEVICE", help="auto, cpu or cuda.")]
Dtype = Annotated[str | None, typer.Option(envvar="CAUSTIC_DTYPE", help="Precision of the rays: float32 or float64. The CPU's"
                                           " kernels are float64 always.")]
Threads = Annotated[int | None, typer.Option(envvar="CAUSTIC_THREADS", help="Threads to use; default: all cores.")]
Progress = Annotated[str, typer.Option(envvar="CAUSTIC_PROGRESS", metavar="auto|json", help="json: everything on stderr but errors"
                                       " is JSON, one object a line, and the work's progress is among it.")]
Project = Annotated[Path, typer.Argument(help="Project directory made by caustic design.", show_default=False)]


SourceType = Annotated[str | None, typer.Option(help="plane: parallel light along +z as wide as the lens; point; grid of"
                                                " points; disc, an extended source; rays of a --source-file."
                                                "  [default: plane]")]
SourceFile = Annotated[str | None, typer.Option(metavar="FILE", help="Ray file: IES TM-25 (.tm25ray), Zemax binary (.dat, .sdf) or"
                                                " LightTools text (.ray, .txt); of a disc, a picture of its brightness,"
                                                " whose values are taken as they are.  The project keeps a copy.")]
Intensity = Annotated[str | None, typer.Option(metavar="uniform|lambertian|FILE", help="Of a point, grid or disc: the same"
                                               " into every solid angle, by the cosine, or a .csv of angles from +z, degrees, and"
                                               " relative intensities.  [default: uniform]")]
SourcePosition = Annotated[list[str] | None, typer.Option(metavar="X,Y,Z", help="Point (may be repeated), centre of a grid or"
                                                          " disc, or origin of a ray file, mm.  [default: on the axis, five lens"
                                                          " widths before it]")]
SourceSize = Annotated[str | None, typer.Option(metavar="W[xH]", help="Grid or disc, mm.  [default: a fifth of the lens]")]
SourceGrid = Annotated[str | None, typer.Option(metavar="N[xM]", help="Points of a grid.  [default: 25x25]")]
SourceAngle = Annotated[float | None, typer.Option(metavar="DEG", help="Disc at infinity: full angle it is seen under (the sun:"
                                                   " 0.533).")]
Cone = Annotated[float | None, typer.Option(metavar="DEG", help="Half-angle of a source's cone about +z.  [default: as wide as"
                                            " the lens]")]
Power = Annotated[str | None, typer.Option(metavar="NUMBER[W|lm]", help="All of the source's power: 2W, or 100lm for images in lux."
                                           "  [default: 1W]")]


Polarisation = Annotated[float | None, typer.Option(metavar="DEG", help="The source is linearly polarised, so far from +x."
                                                     "  [default: unpolarised]")]
Wavelengths = Annotated[str | None, typer.Option(metavar="NM[:W],...", help="The source's spectrum: wavelengths and relative"
                                                 " powers; a --glass refracts each by its own index.  [default: one wavelength]")]
Absorption = Annotated[float | None, typer.Option(metavar="PER_MM", help="Absorption coefficient of the glass, 1/mm."
                                                   "  [default: 0]")]
Roughness = Annotated[float | None, typer.Option(metavar="SLOPE", help="Standard deviation of the slopes of the surface's"
                                                 " microfacets, mm per mm.  [default: 0]")]
ScreenTilt = Annotated[str | None, typer.Option(metavar="A,B", help="Turn the screen about its own x, then y, degrees."
                                                "  [default: 0,0]")]
ScreenShift = Annotated[str | None, typer.Option(metavar="X,Y", help="Move the screen's middle off the axis, mm.  [default: 0,0]")]


def physics(polarisation: float | None, wavelengths: str | None, absorption: float | None, roughness: float | None,
            tilt: str | None, shift: str | None) -> dict[tuple[str, str, str], object]:
    """The options of effects as (section, key, option) -> value, without those that were not given."""
    form = "wavelengths in nm, each with a weight or without, like 450:2,550"
    lines = None if wavelengths is None else [numbers("--wavelengths", p, (1, 2), ":", form) for p in wavelengths.split(",")]
    given = {
        ("source", "polarisation", "--polarisation"): polarisation,
        ("source", "wavelengths", "--wavelengths"): lines and [line[0] for line in lines],
        ("source", "weights", "--wavelengths"): lines and [line[1] if len(line) == 2 else 1.0 for line in lines],
        ("lens", "absorption", "--absorption"): absorption,
        ("lens", "roughness", "--roughness"): roughness,
        ("screen", "tilt", "--screen-tilt"): list(numbers("--screen-tilt", tilt, (2,), ",")) if tilt else None,
        ("screen", "shift", "--screen-shift"): list(numbers("--screen-shift", shift, (2,), ",")) if shift else None,
    }
    return {key: value for key, value in given.items() if value is not None}


def source(kind: str | None, position: list[str] | None, size_: str | None, grid: str | None, angle: float | None,
           cone: float | None, power_: str | None = None, file: str | None = None,
           intensity: str | None = None) -> dict[tuple[str, str, str], object]:
    """The source options as (section, key, option) -> value, without those that were not given."""
    watts = (None, None) if power_ is None else power("--power", power_)
    given = {
        ("source", "power", "--power"): watts[0],
        ("source", "power_unit", "--power"): watts[1],
        ("source", "type", "--source"): kind or ("disc" if angle is not None else None),
        ("source", "position", "--source-position"):
            [list(numbers("--source-position", p, (3,), ",")) for p in position] if position else None,
        ("source", "size", "--source-size"): both(size("--source-size", size_)) if size_ else None,
        ("source", "grid", "--source-grid"): both(counts("--source-grid", grid)) if grid else None,
        ("source", "angle", "--source-angle"): angle,
        ("source", "cone", "--cone"): cone,
        ("source", "file", "--source-file"): file,
        ("source", "intensity", "--intensity"): intensity,
    }
    return {key: value for key, value in given.items() if value is not None}


def numbers(option: str, text: str, count: tuple[int, ...], separator: str = r"[xX×]", form: str = "") -> tuple[float, ...]:
    """Numbers parted by x ("10x8") or by what `separator` matches; `form` says what would be accepted.

    Raises:
        InputError: naming the option.
    """
    parts = re.split(separator, text.strip())
    try:
        values = tuple(float(p) for p in parts)
    except ValueError:
        values = ()
    if len(values) not in count or not all(math.isfinite(v) for v in values):
        usual = "a number or two like 10x8" if separator.startswith("[x") else f"{max(count)} numbers parted by commas"
        raise InputError(f"{option} must be {form or usual}, got {text!r}")
    return values


def size(option: str, text: str) -> tuple[float, float] | tuple[float]:
    """W or WxH in mm, greater than 0."""
    values = numbers(option, text, (1, 2))
    if min(values) <= 0:
        raise InputError(f"{option} must be greater than 0, got {text!r}")
    return values


def power(option: str, text: str) -> tuple[float, str]:
    """A power and its unit, W where none is said: "100lm", "2 W", "2".

    Raises:
        InputError: naming the option.
    """
    from caustic_cli.scene import checks  # noqa: PLC0415

    found = re.fullmatch(r"([0-9.]+(?:[eE][+-]?[0-9]+)?) ?(W|lm)?", text.strip(), re.ASCII)
    try:
        value = float(found[1]) if found else math.nan
    except ValueError:  # of two points
        value = math.nan
    if not 0 < value <= checks.POWER:
        raise InputError(f"{option} must be a number greater than 0 and at most {checks.POWER:g}, of W or lm, like 2W or 100lm,"
                         f" got {text!r}")
    return value, found[2] or "W"


def counts(option: str, text: str) -> tuple[int, ...]:
    """N or NxM, whole and at least 1."""
    values = numbers(option, text, (1, 2))
    if any(v != int(v) or v < 1 for v in values):
        raise InputError(f"{option} must be whole numbers of at least 1, got {text!r}")
    return tuple(int(v) for v in values)


def both(values: tuple) -> list:
    """One value for both axes, or one each."""
    return list(values) if len(values) == 2 else [values[0], values[0]]


def rays(option: str, text: str) -> int:
    """A number of rays, also written 2e6."""
    (value,) = numbers(option, text, (1,))
    if value != int(value) or not 1 <= value <= 1e12:
        raise InputError(f"{option} must be a whole number 1 to 1e12 (2e6 is fine), got {text!r}")
    return int(value)


def start_torch(device: str, threads: int | None, say: Reporter):
    """Load torch, set its threads, choose the device ("cpu" or "cuda"), and have the CPU's kernels compiled.

    Raises:
        InputError: an unknown device, CUDA asked for but absent, or fewer than one thread.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device must be auto, cpu or cuda, got {device!r}")
    if threads is not None and not 1 <= threads <= 1024:
        raise InputError(f"--threads must be a whole number 1 to 1024, got {threads}")
    import torch  # noqa: PLC0415

    if threads:
        torch.set_num_threads(threads)
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: no CUDA device is at hand here; use auto or cpu")
    device = "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"
    from caustic_cli.workflow.compilation import compile_usual  # noqa: PLC0415

    with say.patience("compiling the kernels for this machine, once: about ten seconds"):
        compile_usual(device)
    return device


def dtype_of(name: str):
    """The torch dtype of float32 or float64."""
    import torch  # noqa: PLC0415

    if name not in ("float32", "float64"):
        raise InputError(f"--dtype must be float32 or float64, got {name!r}")
    return getattr(torch, name)


def indices(option: str, text: str) -> tuple[int, int]:
    """I,J: two whole numbers of at least 0."""
    values = numbers(option, text, (2,), ",")
    if any(v != int(v) or v < 0 for v in values):
        raise InputError(f"{option} must be two whole numbers like 3,5, got {text!r}")
    return int(values[0]), int(values[1])
