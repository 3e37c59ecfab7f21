"""Console output: results to stdout, as tables or as one JSON object; messages and progress to stderr.

Results are not printed through Rich, which wraps lines at 80 columns when piped.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
import textwrap
import threading
import time
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from caustic_cli.config.table import TABLE
from caustic_cli.errors import MARK, InputError, plain_name

#: Largest length of an error line in characters: a longer one repeats the content of a file.
LONGEST_LINE = 4000
#: Seconds between lines of --progress json.
LINE_EVERY = 0.5
#: Keys of the figures of a network's lens that are not values of its inputs.
OF_LENS = ("relative_rms", "noise", "on_screen", "middle_relative_rms")
#: Terminal width from which on a progress bar and clocks are shown, and least width of the values of a table on a terminal.
WIDE, NARROW = 90, 24


class Reporter:
    """Messages to the user on stderr, unless `quiet`; results on stdout, unless `as_json`: a JSON object stands for them there.
    Colour follows the terminal and NO_COLOR.

    With `progress` json stderr is for programs: one JSON object per line, with the `event` message, progress or result.

    Raises:
        InputError: `progress` is neither auto nor json.
    """

    def __init__(self, quiet: bool = False, progress: str = "auto", as_json: bool = False):
        if progress not in ("auto", "json"):
            raise InputError(f"--progress must be auto or json, got {progress!r}")
        self.console = Console(stderr=True, quiet=quiet, highlight=False, soft_wrap=True)
        self.lines, self.as_json = progress == "json", as_json

    def say(self, text: str) -> None:
        """Print a message."""
        text = named(text)
        if self.lines:
            self._line(event="message", text=text)
        else:
            self.console.print(text, markup=False)

    def _line(self, **values) -> None:
        if not self.console.quiet:
            sys.stderr.write(json.dumps(values) + "\n")
            sys.stderr.flush()

    def result(self, *lines: str) -> None:
        """Print lines of results."""
        if not self.as_json:
            for line in lines:
                emit(named(line))

    def table(self, title: str, rows: list[tuple[str, str]]) -> None:
        """Print a table of names and values as results; on a terminal, values are folded beside their names."""
        if self.lines:
            self._line(event="result", title=title, rows=dict(rows))
        width = max(len(name) for name, _ in rows)
        wide = max(NARROW, shutil.get_terminal_size().columns - width - 4) if sys.stdout.isatty() else math.inf
        self.result(title)
        for name, value in rows:
            folded = textwrap.wrap(value, int(wide)) if len(value) > wide else [value]
            self.result(*(f"  {label:<{width}}  {part}" for label, part in zip((name, *("",) * len(folded)), folded, strict=False)))

    @contextmanager
    def notify_if_slow(self, text: str, seconds: float = 4.0):
        """Print `text` if the block is still running after `seconds`."""
        timer = threading.Timer(seconds, self.say, (text,))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    @contextmanager
    def progress(self, total: int | None):
        """A progress bar on a terminal, nothing elsewhere; `total` may be set later.  JSON lines are printed every LINE_EVERY
        seconds."""
        if self.lines:
            began, last = time.monotonic(), -math.inf

            def tell(description="", text="", done=None, whole=None) -> None:
                nonlocal last
                now = time.monotonic()
                if now - last >= LINE_EVERY or done == whole:
                    last = now
                    self._line(event="progress", what=description, text=text, done=done, total=whole, seconds=round(now - began, 3))

            yield tell
            return
        numbers = [TextColumn("{task.description}"), MofNCompleteColumn(), TextColumn("{task.fields[text]}")]
        clocks = [TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()]
        columns = [numbers[0], BarColumn(), *numbers[1:], *clocks] if self.console.width >= WIDE else numbers
        bar = Progress(
            *columns,
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal or self.console.quiet,
        )
        with bar:
            task = bar.add_task("beginning", total=total, text="")
            yield lambda description="", text="", done=None, whole=None: bar.update(
                task, description=description, text=text, completed=done, total=whole
            )


#: Names of the options with which settings were given in this run, by path.
_option_names: dict[str, str] = {}


def option_names() -> dict[str, str]:
    """The names of the options with which settings were given, by path."""
    return dict(_option_names)


def set_option_names(options: dict[str, str]) -> None:
    """Set the names under which messages refer to settings, by path: the options used; other settings are named as in
    project.toml."""
    _option_names.clear()
    _option_names.update(options)


def named(text: str) -> str:
    """A text with marks replaced by option names, or by names of project.toml where no option was used."""

    def name(path: str) -> str:
        row = TABLE.get(path[1:]) if path.startswith("+") else None
        if row and row.option:
            return row.option.name
        return _option_names.get(path) or (plain_name(path) if "." in path else "--" + path.replace("_", "-"))

    return MARK.sub(lambda found: name(found[1]), text)


def emit_json(value: dict) -> None:
    """Print one JSON object on stdout."""
    sys.stdout.write(json.dumps(value, allow_nan=False) + "\n")
    sys.stdout.flush()


def emit(line: str) -> None:
    """Print a line of results on stdout, with control characters replaced, and those escaped that its encoding lacks."""
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(printable(line).encode(encoding, "backslashreplace").decode(encoding) + "\n")
    sys.stdout.flush()


def printable(text: str) -> str:
    """A text with control characters replaced, for instance those of a malicious file name."""
    return "".join(c if c.isprintable() else "?" for c in text)


def error(message: str) -> None:
    """Print one line on stderr, even if quiet, with control characters replaced."""
    line = printable(" ".join(named(message).split()))
    sys.stderr.write(f"caustic: {line if len(line) <= LONGEST_LINE else line[:LONGEST_LINE] + ' ...'}\n")


def _wavelengths(values: list[float]) -> str:
    """Wavelengths as a clause."""
    if len(values) == 1:
        return f"at {values[0]:.4g} nm"
    return f"at {len(values)} wavelengths, {min(values):.4g} to {max(values):.4g} nm"


def _absolute(figures: dict, prefix: str) -> list[tuple[str, str]]:
    """Peak and mean of the image on the screen, in its unit."""
    if figures.get(f"{prefix}peak_irradiance") is None:
        return []
    unit = figures["irradiance_unit"]
    return [
        (
            "illuminance" if unit == "lux" else "irradiance",
            f"peak {figures[prefix + 'peak_irradiance']:.4g} {unit}, mean {figures[prefix + 'mean_irradiance']:.4g} {unit}",
        )
    ]


def figures_rows(figures: dict) -> list[tuple[str, str]]:
    """The figures of merit as rows for display."""

    def number(key: str, form: str) -> str:
        value = figures.get(key)
        return "-" if value is None else format(value, form)

    lost = ", ".join(f"{name.replace('_', ' ')} {value:.2%}" for name, value in figures["lost"].items() if value > 5e-7)
    own = figures.get("noise")
    of_rays, noise = "" if own is None else f", noise {own:.2g}", []
    if figures.get("error_estimate") is not None:
        in_all = f"; {figures['rays_traced']:,} rays in all" if "rays_traced" in figures else ""
        noise = [("noise of the image", f"{figures['error_estimate']:.2g}, estimated{in_all}")]
    black = []
    if figures.get("in_black") is not None:
        known = figures.get("in_black_noise")
        black = [("light in black", number("in_black", ".2%") + ("" if known is None else f", noise {known:.2%}"))]
    radius = figures.get("min_radius")
    if radius is not None and radius["in_black_per_mm"] is not None:
        with_it, without = radius["start_in_black"], radius["start_in_black_without"]
        known = "" if radius["noise"] is None else f", noise {radius['noise']:.2%}"
        each = f"{radius['in_black_per_mm']:.2%} a mm{known}"
        black += [
            (f"a radius of {radius['radius_mm']:g} mm", f"first surface {with_it:.2%} in black, {without:.2%} without: {each}")
        ]
    error, waves = [("relative RMS error", number("relative_rms", ".4f") + of_rays)], []
    if "no_wave_image" in figures:
        waves = [("wave image", f"none: {figures['no_wave_image']}")]
    elif "wave_relative_rms" in figures:
        seen = f"on the picture {number('wave_on_target', '.2%')}"
        if figures.get("wave_in_black") is not None:
            seen += f", in black {number('wave_in_black', '.2%')}"
        if figures["wave_relative_rms"] is None:  # an archive has no target picture
            seen = f"on the screen {number('wave_on_screen', '.2%')}"
        else:  # where light is a wave its error comes first, since that of the rays says little of it
            of_waves = f"{number('wave_relative_rms', '.4f')} of the wave image, {_wavelengths(figures['wave_wavelengths'])}"
            error = [("relative RMS error", of_waves), ("of the rays alone", error[0][1])]
        waves = [
            ("wave image", f"{seen}, {_wavelengths(figures['wave_wavelengths'])}"),
            *((f"{name} as a wave", value) for name, value in _absolute(figures, "wave_")),
            ("details resolved", number("resolvable", "d") + " across"),
        ]
    behind = []
    if figures.get("second_relative_rms") is not None:
        value, known = number("second_relative_rms", ".4f"), figures.get("second_noise")
        behind = [
            ("second picture", f"relative RMS error {value}" + ("" if known is None else f", noise {known:.2g}")),
            ("light on it", number("second_on_target", ".2%")),
        ]
    elif figures.get("angle_rms_mrad") is not None:
        behind = [("directions off by", number("angle_rms_mrad", ".3g") + " mrad rms")]
    least = (
        [("least possible", number("least_relative_rms", ".4f") + ", behind the source's blur")]
        if "least_relative_rms" in figures
        else []
    )
    start = []
    if figures.get("start_relative_rms") is not None:
        known = f", noise {figures['start_noise']:.2g}" if "start_noise" in figures else ""
        start = [("of the initial surface, by rays", f"{figures['start_relative_rms']:.4f}{known}")]
    for row in figures.get("over", ()):
        values = ", ".join(f"{key} {row[key]:g}" for key in row if key not in OF_LENS)
        known = "" if row["noise"] is None else f", noise {row['noise']:.2g}"
        start.append(
            (f"lens for {values}", f"{row['relative_rms']:.4f}{known}; that for the middle {row['middle_relative_rms']:.4f}")
        )
    if "etendue_limit" in figures:
        least.append(("etendue limit", number("etendue_limit", ".2%") + " of the light on the lens"))
    return [
        *error,
        *start,
        *least,
        ("loss (eq. 5.2.1)", number("loss", ".4e")),
        ("PSNR", number("psnr_db", ".2f") + " dB"),
        ("SSIM", number("ssim", ".4f")),
        (
            "light on the screen",
            number("on_screen", ".2%") + (f" of {figures['fractions_of']}" if "fractions_of" in figures else ""),
        ),
        ("light on the picture", number("on_target", ".2%")),
        *black,
        *behind,
        ("lost", lost or "nothing"),
        *(
            [("glass", f"wall {figures['minimum_wall_mm']:.2f} mm, stock {figures['stock_height_mm']:.2f} mm")]
            if "stock_height_mm" in figures
            else []
        ),
        *_absolute(figures, ""),
        *waves,
        ("rays", number("rays", ",d")),
        *noise,
        ("iterations", number("iterations", "d")),
        ("time", number("seconds", ".1f") + " s"),
        ("image", str(figures["image"])),
    ]
