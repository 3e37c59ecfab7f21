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
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from caustic_cli.errors import LISTS, MARK, InputError, plain_name, shortened
from caustic_cli.loading import OnDemand
from caustic_cli.schema.table import TABLE

irradiance, accuracy_cost = OnDemand("caustic_cli.studies.irradiance"), OnDemand("caustic_cli.inverse.accuracy_cost")

#: Seconds between lines of --progress json.
LINE_EVERY = 0.5
#: Keys of the figures of a network's lens that are not values of its inputs.
OF_LENS = ("relative_rms", "noise", "on_screen", "of_source", "middle_relative_rms")
#: Terminal width from which on a progress bar and the time elapsed are shown, and least width of the values of a table there.
WIDE, NARROW = 90, 24
#: Error by rays over that by waves from which on it needs a word.
WORSE = 1.1


class _TimeLeft(ProgressColumn):
    """The rest of the expected time of a task, whose total is that time in s."""

    def render(self, task: Task) -> Text:
        """As of a column."""
        left = (task.total or 0.0) - (task.elapsed or 0.0)
        return Text(f"about {left:.0f} s left" if left >= 1.0 else "longer than expected" if left < -1.0 else "nearly done")


class ConsoleReporter:
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
    def waiting(self, what: str, seconds: float):
        """On a terminal, a line with the time left of the `seconds` that the block is expected to take; nothing elsewhere."""
        hidden = self.lines or not self.console.is_terminal or self.console.quiet
        with Progress(TextColumn("{task.description}"), _TimeLeft(), console=self.console, transient=True, disable=hidden) as bar:
            bar.add_task(what, total=seconds)
            yield

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
                    left = round((now - began) * (whole - done) / done, 3) if done and whole else None
                    self._line(
                        event="progress",
                        what=description,
                        text=text,
                        done=done,
                        total=whole,
                        seconds=round(now - began, 3),
                        seconds_left=left,
                    )

            yield tell
            return
        numbers = [TextColumn("{task.description}"), MofNCompleteColumn(), TextColumn("{task.fields[text]}")]
        left = [TextColumn("left"), TimeRemainingColumn()]
        wide = self.console.width >= WIDE
        columns = [numbers[0], BarColumn(), *numbers[1:], TimeElapsedColumn(), *left] if wide else [*numbers, *left]
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


#: What is on disk if the command is interrupted now.
_kept = [""]


def set_kept(text: str) -> None:
    """Set the clause on what is on disk that the message of an interruption adds."""
    _kept[0] = text


def kept() -> str:
    """What is on disk if the command is interrupted now; "" if nothing is known."""
    return named(_kept[0])


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
        row = TABLE.get(path.removeprefix("+"))
        if row and row.option and (path.startswith("+") or not row.section):
            return row.option.name
        return _option_names.get(path) or (plain_name(path) if "." in path or path in LISTS else "--" + path.replace("_", "-"))

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
    sys.stderr.write(f"caustic: {shortened(line)}\n")


#: Why a design ended, in words, by the first clause of `reason`.
ENDED = {
    "iterations": "after all its iterations",
    "no progress": "since no iteration made progress",
    "time limit": "at the time limit",
}


def ended_words(reason: str) -> str:
    """Why a design ended."""
    first, *more = reason.split("; ", 1)
    return "; ".join([ENDED.get(first, first), *more])


def figures_rows(figures: dict) -> list[tuple[str, str]]:
    """The figures of merit as rows for display: the judged figure, then those of the same image; those of the other image, by rays
    or by waves, in one row that says so, which stands last where waves judge."""
    by_waves = figures.get("error_by") == "waves"
    return [
        ("relative RMS error", _error(figures, by_waves)),
        *_of_start(figures),
        *_limits(figures),
        *_of_beam(figures),
        *([] if by_waves else [("loss (eq. 5.2.1)", _number(figures, "loss", ".4e"))]),
        *_of_image(figures, "wave_" if by_waves else ""),
        *_of_radius(figures),
        *_behind(figures),
        ("lost, by rays" if by_waves else "lost", _lost(figures)),
        *_of_glass(figures),
        *([] if by_waves else _wave_image(figures)),
        *([("details resolved", _number(figures, "resolvable", "d") + " across")] if "resolvable" in figures else []),
        ("rays", _number(figures, "rays", ",d")),
        *([] if by_waves else _noise_of_image(figures)),
        ("iterations", _number(figures, "iterations", "d")),
        ("time", _number(figures, "seconds", ".1f") + " s"),
        *_price(figures),
        ("image", f"{figures['wave_image']}; by rays {figures['image']}" if by_waves else str(figures["image"])),
        *([("ended", ended_words(figures["reason"]))] if "reason" in figures else []),
        *([("by rays alone", _rays_alone(figures))] if by_waves else []),
    ]


def _price(figures: dict) -> list[tuple[str, str]]:
    """What a smaller error would cost, of a design."""
    rows = figures.get("accuracy_cost")
    words = accuracy_cost.price([accuracy_cost.Row(**row) for row in rows]) if rows else ""
    return [("accuracy and time", words)] if words else []


def _number(figures: dict, key: str, form: str) -> str:
    value = figures.get(key)
    return "-" if value is None else format(value, form)


def _noise(figures: dict, key: str, form: str = ".2g") -> str:
    """The noise of a figure as a clause, empty where it is unknown."""
    return "" if figures.get(key) is None else f", noise {figures[key]:{form}}"


def _error(figures: dict, by_waves: bool) -> str:
    """The judged figure and its judge."""
    if by_waves:
        return f"{_number(figures, 'wave_relative_rms', '.4f')} by waves, {_wavelengths(figures)}"
    beside = " by rays" if figures.get("wave_relative_rms") is not None else ""
    return _number(figures, "relative_rms", ".4f") + beside + _noise(figures, "noise")


def _wavelengths(figures: dict) -> str:
    """Wavelengths of the wave image as a clause, with what they represent, or what there is beside them."""
    values, spectrum, beside = figures["wave_wavelengths"], figures.get("wave_spectrum"), figures.get("wave_unseen_relative_rms")
    at = f"{values[0]:.4g} nm" if len(values) == 1 else f"{len(values)} wavelengths, {min(values):.4g} to {max(values):.4g} nm"
    if spectrum is not None:
        rest, seen = figures.get("wave_spectral_error"), "the eye" if figures["wave_detector"] == "eye" else "power"
        sure = "" if rest is None else f"; ± {rest:.1g} by their number"
        return f"at {at}, of the spectrum {spectrum} by {seen}{sure}"
    return f"at {at}" if beside is None else f"at {at}, those of the design; {beside:.4f} at wavelengths 1 % beside"


def _of_start(figures: dict) -> list[tuple[str, str]]:
    """Errors of the initial surface, and of the lenses of a network."""
    rows = []
    if figures.get("start_error") is not None:
        noise = "" if figures["error_by"] == "waves" else _noise(figures, "start_noise")
        rows = [("of the initial surface", f"{figures['start_error']:.4f}{noise}")]
    for row in figures.get("over", ()):
        values = ", ".join(f"{key} {row[key]:g}" for key in row if key not in OF_LENS)
        middle = f"that for the middle {row['middle_relative_rms']:.4f}"
        rows.append((f"lens for {values}", f"{row['relative_rms']:.4f}{_noise(row, 'noise')}; {middle}"))
    return rows


def _limits(figures: dict) -> list[tuple[str, str]]:
    """What an extended source allows."""
    rows = []
    if "least_relative_rms" in figures:
        rows = [("least possible", _number(figures, "least_relative_rms", ".4f") + " or more for any lens, by the source's blur")]
    if "etendue_limit" in figures:
        rows.append(("etendue limit", _number(figures, "etendue_limit", ".2%") + " of the light on the lens"))
    return rows


def _of_beam(figures: dict) -> list[tuple[str, str]]:
    """Figures of a shaped laser beam."""
    if "beam" not in figures:
        return []
    of = figures["beam"]
    zeros = f", {of['vortices']} vortices" if "vortices" in of else ""
    return [
        ("error in the mask", f"{of['error']:.4f} of the picture there; peak to valley {of['peak_to_valley']:.4f}{zeros}"),
        ("light in the mask", f"{of['in_mask']:.2%} of that behind the lens; {of['in_region']:.2%} in the region"),
        (
            "width of its edges",
            f"{of['edge_width']:.4g} {figures.get('screen_unit', 'mm')}, from 1/e² to 1 - 1/e² of the irradiance within",
        ),
    ]


def _of_image(figures: dict, prefix: str) -> list[tuple[str, str]]:
    """Figures of the ray image, or of the wave image with the prefix wave_."""
    of = f" of {figures['fractions_of']}" if "fractions_of" in figures else ""
    rows = [
        ("PSNR", _number(figures, f"{prefix}psnr_db", ".2f") + " dB"),
        ("SSIM", _number(figures, f"{prefix}ssim", ".4f")),
        *([("mean CIEDE2000", _number(figures, f"{prefix}ciede2000", ".2f"))] if f"{prefix}ciede2000" in figures else []),
        ("light on the screen", _number(figures, f"{prefix}on_screen", ".2%") + of),
        ("light on the picture", _number(figures, f"{prefix}on_target", ".2%")),
    ]
    if figures.get("of_source") is not None:
        rows.append(("of all the source emits", f"{100.0 * figures['of_source']:.3g}%: {figures['source_emits']}"))
    if figures.get(f"{prefix}in_black") is not None:
        noise = "" if prefix else _noise(figures, "in_black_noise", ".2%")
        rows.append(("light in black", _number(figures, f"{prefix}in_black", ".2%") + noise))
    if figures.get(f"{prefix}peak_irradiance") is not None:
        rows += [
            (name, f"peak {peak:.4g} {unit}, mean {mean:.4g} {unit}")
            for name, unit, peak, mean in irradiance.in_units(figures, prefix)
        ]
    if figures.get("luminous_flux"):
        each = f"{figures['luminous_efficacy']:.4g} lm/W"
        rows.append(("power of the source", f"{figures['radiant_flux']:.4g} W, {figures['luminous_flux']:.4g} lm ({each})"))
    return rows


def _of_radius(figures: dict) -> list[tuple[str, str]]:
    """What a least radius costs."""
    from caustic_cli.studies.radius import cost_of_radius  # noqa: PLC0415

    radius = figures.get("min_radius")
    if radius is None or radius["in_black_per_mm"] is None:
        return []
    with_it, without = radius["start_in_black"], radius["start_in_black_without"]
    words = f"first surface {with_it:.2%} in black, {without:.2%} without: {cost_of_radius(radius)}"
    return [(f"a radius of {radius['radius_mm']:g} mm", words)]


def _behind(figures: dict) -> list[tuple[str, str]]:
    """Figures behind the picture."""
    if figures.get("second_relative_rms") is not None:
        error = f"relative RMS error {figures['second_relative_rms']:.4f}{_noise(figures, 'second_noise')}"
        return [("second picture", error), ("light on it", _number(figures, "second_on_target", ".2%"))]
    if figures.get("angle_rms_mrad") is not None:
        return [("directions off by", _number(figures, "angle_rms_mrad", ".3g") + " mrad rms")]
    return []


def _lost(figures: dict) -> str:
    return ", ".join(f"{k.replace('_', ' ')} {value:.2%}" for k, value in figures["lost"].items() if value > 5e-7) or "nothing"


def _of_glass(figures: dict) -> list[tuple[str, str]]:
    if "stock_height_mm" not in figures:
        return []
    return [("glass", f"wall {figures['minimum_wall_mm']:.2f} mm, stock {figures['stock_height_mm']:.2f} mm")]


def _wave_image(figures: dict) -> list[tuple[str, str]]:
    """The wave image where it is not the judge."""
    if "no_wave_image" in figures:
        return [("wave image", f"none: {figures['no_wave_image']}")]
    if "wave_wavelengths" not in figures:
        return []
    at = _wavelengths(figures)
    if figures["wave_relative_rms"] is None:  # an archive has no target picture
        return [("wave image", f"on the screen {_number(figures, 'wave_on_screen', '.2%')}, {at}")]
    words = f"relative RMS error {_number(figures, 'wave_relative_rms', '.4f')}, {at}"
    if "wave_ciede2000" in figures:
        words += f"; mean CIEDE2000 {_number(figures, 'wave_ciede2000', '.2f')}"
    words += f"; on the picture {_number(figures, 'wave_on_target', '.2%')}"
    if figures.get("wave_in_black") is not None:
        words += f", in black {_number(figures, 'wave_in_black', '.2%')}"
    return [("wave image", f"{words}; the design was not refined on it")]


def _noise_of_image(figures: dict) -> list[tuple[str, str]]:
    if figures.get("error_estimate") is None:
        return []
    in_all = f"; {figures['rays_traced']:,} rays in all" if "rays_traced" in figures else ""
    return [("noise of the image", f"{figures['error_estimate']:.2g}, estimated{in_all}")]


def _rays_alone(figures: dict) -> str:
    """Figures of the ray image of a lens that waves judge, and why they are no fault of it where they are worse."""
    worse = (figures.get("relative_rms") or 0.0) > WORSE * figures["error"]
    why = "; no fault of the lens, which was refined for the diffraction that rays leave out" if worse else ""
    return (
        f"relative RMS error {_number(figures, 'relative_rms', '.4f')}{_noise(figures, 'noise')}, light on the picture"
        f" {_number(figures, 'on_target', '.2%')}{why}"
    )
