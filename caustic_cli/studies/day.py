"""The picture of a lens in a window through a day: where the sun carries it, and how long it is legible.

Lens and screen stand still, and the sun moves: all sources at infinity have its direction, and those nearby and lasers stand still,
too.  At each time the light is traced to the plane of the screen, and the image looked at twice: on the screen where it stands, and
on a screen of the same size and shape that is moved in that plane after the picture, to the median of its light and then to the
best match with the target (`studies.tolerances.best_shift`).  That of a curved screen is its tangent plane.

Notation
    F           relative RMS error against the target, of two independent halves of the rays, corrected for their noise
    F_0, P_0    error and power on the picture under the light for which the lens is designed
    C           contrast of the target, its standard deviation over its mean: F of an even grey
    as designed F <= FACTOR F_0 + MORE after following, with a power on the picture of at least DIM P_0
    legible     F <= C / 2 after following, three quarters of the variance of its pixels being the picture's, with the same power;
                or as designed
    on screen   legible, and at least PART of the power of the followed picture still lands on the screen where it stands

Of a sundial the picture is at each time that of the nearest of its hours, with F_0, P_0 and C of its own; it is on the screen as
far as its target is, displaced as it is.

Powers of the sun are those of a beam of constant irradiance across it, of which the pane receives the cosine of its incidence: air,
which weakens a low sun, is not in them.  Stray light is left out: ghosts, and what meets a surface twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta, tzinfo
from functools import cached_property, partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io.files import SOFTWARE, atomic_file
from caustic_cli.optics import ranks
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.image import Image
from caustic_cli.optics.misalignment import Misalignment, landing_points
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene, Screen, Source
from caustic_cli.scene.screen import tilted
from caustic_cli.scene.sunlight import Hours, Sunlight, hours, in_words
from caustic_cli.studies.metrics import figures_of_merit
from caustic_cli.studies.noise import variance_of
from caustic_cli.studies.retrace import limited_to_source, mean_of, sampler_for
from caustic_cli.studies.tolerances import best_shift

#: Rays of a time, both halves included, and by how many times fewer match the picture to the target.
RAYS, MATCHING = 200_000, 8
#: Rays that find the median of the light, and points along each axis of the coarse surface that they pass.
FINDING, COARSE = 4_000, 64
#: Periods of a day, properties of it.
PERIODS = ("as_designed", "legible", "on_screen")
#: Steps while the sun shines through the pane, minutes, and most times between them.
STEP, MOST_BETWEEN = 5, 160
#: Bound of a picture that is as designed; of a legible one, part of C; its least brightness; and the part of it that is on the
#: screen.
FACTOR, MORE, CONTRAST, DIM, PART = 1.5, 0.05, 0.5, 0.1, 0.5
#: Least part of the picture's power on the screen where it stands by which that is judged.
LEAST = 0.01
#: Width of the view of the screen's plane, in screens.
AROUND = 3
#: Rays that a displayed pixel is averaged over, in a Gaussian.
QUIET = 30.0

T = TypeVar("T")
#: Along the screen's axes from its centre, mm, and power, (N,) each, in parts.
Landing = list[tuple[Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Instant:
    """What is seen at a time."""

    time: datetime
    #: Of the sun, and of its light to the inner normal of the pane, degrees.
    azimuth: float
    elevation: float
    incidence: float
    #: F on the screen where it stands, None with hardly any light there; and after following the picture.
    error: float | None
    followed: float
    #: By how much the picture has moved along the screen's x and y since the light of the design, mm.
    moved: tuple[float, float]
    #: The largest F of a picture as designed, and of a legible one.
    bounds: tuple[float, float]
    #: Power on the picture over P_0; part of the power of the followed picture's screen that is on that where it stands.
    brightness: float
    on_screen: float

    @property
    def as_designed(self) -> bool:
        """Whether the picture is, wherever it is."""
        return self.followed <= self.bounds[0] and self.brightness >= DIM

    @property
    def legible(self) -> bool:
        """Whether it is, wherever it is."""
        return self.followed <= self.bounds[1] and self.brightness >= DIM


@dataclass(frozen=True)
class Looked:
    """An instant with its images, (n_x, n_y) or (3, n_x, n_y), power per pixel over that of the light of the design: on the screen
    that follows, and around the one that stands still."""

    instant: Instant
    image: np.ndarray
    around: np.ndarray


def moved(screen: Screen, x: float, y: float) -> Screen:
    """A screen moved along its own axes, mm."""
    u, v, _ = screen.axes
    *shift, z = screen.in_space(tuple(c + x * a + y * b for c, a, b in zip(screen.centre, u, v, strict=True)))
    return replace(screen, shift=(shift[0], shift[1]), z=z)


class Follower:
    """Follows the picture of a lens under the sun.

    Args:
        scene, field, heights: of a plan; the scene's source is the light of the design; heights (n, m) mm.
        target: (n_x, n_y) or (3, n_x, n_y) on the screen.
        light: of the sun.
    """

    def __init__(
        self,
        scene: Scene,
        field: HeightField,
        heights: Tensor,
        target: np.ndarray,
        light: Sunlight,
        *,
        rays: int = RAYS,
        seed: int = 0,
        device: str = "cpu",
    ):
        self.scene, self.field, self.heights, self.target, self.light = scene, field, heights, target, light
        self.rays, self.seed, self.device = rays, seed, device
        self._coarse = _coarse(field, heights)
        self._start = _median(self._landing(scene, scene.screen.uncurved))
        #: Image of the design, on the scale of `Looked`.
        self.white, self.offset, self.error, _ = self._followed(scene, (0.0, 0.0))
        self._power = self._on_picture(self.white)

    def of(self, time: datetime) -> Follower:
        """The follower of the picture that is looked for at a time."""
        return self

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """The largest F of a picture as designed, and of a legible one."""
        grey, as_designed = self.target.sum(0) if self.target.ndim == 3 else self.target, FACTOR * self.error + MORE
        return as_designed, max(as_designed, CONTRAST * float(grey.std() / grey.mean()))

    def at(self, time: datetime) -> Looked:
        """The picture at a time at which the sun shines through the pane.

        Raises:
            InputError: the light grazes the plane of the screen, or meets it where that reaches the lens.
        """
        sun, tilt = self.light.sun(time), self.light.tilt(time)
        scene = replace(self.scene, source=self.scene.source.each(partial(_under, tilt)))
        more, cosine = scene.source.power / self.scene.source.power, tilted(tilt)[2][2]
        place, landing = _median(self._landing(scene, scene.screen.uncurved)), self._landing(scene, scene.screen)
        image, at, followed, whole = self._followed(scene, (place[0] - self._start[0], place[1] - self._start[1]))
        around, still = self._where_it_stands(scene, landing)
        lands = 0.0 if still is None else float(mean_of(still).image.sum())
        instant = Instant(
            time,
            sun.azimuth,
            sun.elevation,
            float(np.degrees(np.arccos(min(1.0, cosine)))),
            self._error(still) if still is not None and lands > LEAST * whole else None,
            followed,
            (at[0] - self.offset[0], at[1] - self.offset[1]),
            self.bounds,
            self._on_picture(image) * more / self._power if self._power else 0.0,
            lands / whole if whole else 0.0,
        )
        return Looked(instant, image * more, around * more)

    def kept(self, moved: tuple[float, float]) -> float:
        """Part of the target that is on the screen where it stands after a displacement along the screen's axes, mm."""
        light = self.target.sum(0) if self.target.ndim == 3 else self.target
        pixels = [round(d / w) for d, w in zip(moved, self.scene.screen.pixel, strict=True)]
        i, j = (slice(max(0, -k), max(0, n - max(0, k))) for k, n in zip(pixels, light.shape, strict=True))
        return float(light[i, j].sum() / light.sum())

    def _where_it_stands(self, scene: Scene, landing: Landing) -> tuple[np.ndarray, list[Image] | None]:
        """Image around the screen where it stands, and halves of that on it; black and None where no light comes near it."""
        pixels = tuple(n * (AROUND - 1) // 2 for n in scene.screen.resolution)
        view = scene.screen.grown((pixels[0], pixels[1]))
        if not any(bool(((abs(x) < view.half_size[0]) & (abs(y) < view.half_size[1]) & (w > 0)).any()) for x, y, w in landing):
            return np.zeros((*self.target.shape[:-2], *view.resolution)), None
        inner = (..., *(slice(n, n + m) for n, m in zip(pixels, scene.screen.resolution, strict=True)))
        try:
            halves = self._halves(scene, view)
        except InputError:  # it reaches the lens, as a floor below a window does
            halves, around = self._halves(scene, scene.screen), np.zeros((*self.target.shape[:-2], *view.resolution))
            around[inner] = mean_of(halves).image.cpu().numpy()
            return around, halves
        return mean_of(halves).image.cpu().numpy(), [replace(half, image=half.image[inner]) for half in halves]

    def _followed(self, scene: Scene, at: tuple[float, float]) -> tuple[np.ndarray, tuple[float, float], float, float]:
        """Image on the screen moved after the picture from `at`, mm; by how much; F; and the power there."""
        first = next(self._images(scene, moved(scene.screen, *at), self.rays // MATCHING)).image.cpu().numpy()
        if first.sum() > 0:
            grey = (a.sum(0) if a.ndim == 3 else a for a in (first, self.target))
            _, shift = best_shift(*(a / a.mean() for a in grey))
            at = at[0] + shift[0] * scene.screen.pixel[0], at[1] + shift[1] * scene.screen.pixel[1]
        halves = self._halves(scene, moved(scene.screen, *at))
        image = mean_of(halves).image.cpu().numpy()
        return image, at, self._error(halves), float(image.sum())

    def _error(self, halves: list[Image]) -> float:
        variance = variance_of(*(half.image.cpu().numpy() for half in halves))
        return float(figures_of_merit(mean_of(halves), self.target, variance)["relative_rms"])

    def _on_picture(self, image: np.ndarray) -> float:
        return float(image[self.target > 0].sum())

    def _halves(self, scene: Scene, screen: Screen) -> list[Image]:
        """Images on a screen of two independent halves of the rays."""
        return list(self._images(scene, screen, self.rays // 2))

    def _images(self, scene: Scene, screen: Screen, rays: int) -> Iterator[Image]:
        """Independent images of so many rays each."""
        one, heights = scene.onto(screen), self.heights.to(self.device)
        for k in (0, 1):
            sampler = sampler_for(one.batch(k, 2), max(1, rays), stream(self.seed, f"day {k}"), self.device)
            yield limited_to_source(expose(one, self.field, heights, sampler))

    def _landing(self, scene: Scene, screen: Screen) -> Landing:
        """Landing points on a screen of rays through the coarse surface."""
        scene = scene.onto(screen)
        rays = rays_of(scene, "stratified" if scene.source.parallel else "sobol", FINDING, stream(self.seed, "day"))
        return [(p.x, p.y, p.power) for p in landing_points(scene, *self._coarse, rays, Misalignment())]


def _under(tilt: tuple[float, float], source: Source) -> Source:
    """A source with the light of the sun in another direction, if it is at infinity and no laser."""
    if not source.distant or source.beam is not None:
        return source
    return replace(cast(Any, source), tilt=tilt, power=source.power * tilted(tilt)[2][2] / source.axis[2])


class SundialFollower:
    """Follows the pictures of a sundial, at each time that of the nearest of its hours.

    Args:
        followers: of the pictures, each in a scene with the light of its own hour.
        hours: their times of day, in the same order.
    """

    def __init__(self, followers: Sequence[Follower], hours: Sequence[datetime]):
        self.followers = sorted(zip([_minutes(hour) for hour in hours], followers, strict=True), key=lambda one: one[0])
        self.error = float(np.mean([follower.error for follower in followers]))

    def of(self, time: datetime) -> Follower:
        """As of a follower."""
        return min(self.followers, key=lambda one: abs(one[0] - _minutes(time)))[1]

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Their means."""
        as_designed, legible = np.mean([follower.bounds for _, follower in self.followers], axis=0).tolist()
        return as_designed, legible

    def at(self, time: datetime) -> Looked:
        """As of a follower; other pictures are not counted as parts of this one on the screen where it stands."""
        follower = self.of(time)
        seen = follower.at(time)
        return replace(seen, instant=replace(seen.instant, on_screen=follower.kept(seen.instant.moved)))


def _minutes(time: datetime) -> float:
    """Minutes since midnight of its day."""
    return time.hour * 60.0 + time.minute + time.second / 60.0


def _coarse(field: HeightField, heights: Tensor) -> tuple[HeightField, Tensor]:
    """The surface without the detail that makes the picture, and its control heights."""
    x, y = (torch.linspace(-r, r, COARSE, dtype=torch.float64) for r in field.half_size)
    (z,) = field.at(heights.cpu(), x.repeat_interleave(COARSE), y.repeat(COARSE), [(0, 0)])
    return HeightField.through(z.reshape(COARSE, COARSE).numpy(), field.half_size)


def _median(landing: Landing) -> tuple[float, float]:
    """Medians of x and y, mm, below which half of the power lands; 0 without light."""
    x, y, power = (torch.cat(parts) for parts in zip(*landing, strict=True))
    found = []
    for values in (x, y):
        order = torch.where(power > 0, values, torch.inf).argsort()
        below = power[order].cumsum(0)
        found.append(float(values[order][int(torch.searchsorted(below, 0.5 * below[-1]))]) if float(below[-1]) > 0 else 0.0)
    return found[0], found[1]


@dataclass(frozen=True)
class Day:
    """A day of a lens: the error of its design, the bounds of a picture as designed and of a legible one, what is seen at each
    time, and the periods."""

    error: float
    bounds: tuple[float, float]
    instants: tuple[Instant, ...]

    @property
    def as_designed(self) -> Hours:
        """When the picture is as designed, wherever it is."""
        return self._periods(lambda i: i.as_designed)

    @property
    def legible(self) -> Hours:
        """When it is legible, wherever it is."""
        return self._periods(lambda i: i.legible)

    @property
    def on_screen(self) -> Hours:
        """When it is legible on the screen where it stands."""
        return self._periods(lambda i: i.legible and i.on_screen >= PART)

    def _periods(self, holds: Callable[[Instant], bool]) -> Hours:
        """First and last time of each run of instants for which something holds."""
        runs = [[i.time for i in group] for true, group in groupby(self.instants, holds) if true]
        return [(run[0], run[-1]) for run in runs]

    @property
    def figures(self) -> dict[str, Any]:
        """For JSON."""
        periods = {name: [[t.isoformat() for t in period] for period in getattr(self, name)] for name in PERIODS}
        table = [
            {
                "time": i.time.isoformat(),
                "azimuth": i.azimuth,
                "elevation": i.elevation,
                "incidence": i.incidence,
                "error": i.error,
                "followed_error": i.followed,
                "moved": list(i.moved),
                "brightness": i.brightness,
                "on_screen": i.on_screen,
            }
            for i in self.instants
        ]
        bounds = {"as_designed_error": self.bounds[0], "legible_error": self.bounds[1]}
        return {"error": self.error, **bounds, **periods, "times": table}


def hours_of_sun(light: Sunlight, day: date, zone: tzinfo | None) -> Hours:
    """When the sun shines through the pane on a day.

    Raises:
        InputError: it does at no time.
    """
    if found := hours(light.shines, day, zone):
        return found
    raise InputError(f"⟨day⟩ {day}: the sun shines through the pane at no time that day")


def follow_day(
    follower: Follower | SundialFollower,
    shines: Hours,
    keep: Callable[[Looked], T],
    progress: Callable[[str, int, int], None] = lambda what, done, whole: None,
) -> tuple[Day, list[T]]:
    """The hours of sun of a day in steps of STEP minutes, and in shorter ones while light is on the screen and where the picture
    becomes legible, as far as the light meets the plane of the screen; and what `keep` makes of what is seen at each time.

    Raises:
        InputError: it never does.
    """
    found: dict[datetime, tuple[Instant, T]] = {}

    def look(times: Iterable[datetime], why: str) -> None:
        todo = [t for t in times if t not in found]
        seen = ranks.mapped(partial(_seen, follower, keep), todo, lambda done: progress(why, done, len(todo)))
        found.update((time, one) for time, one in zip(todo, seen, strict=True) if one is not None)

    look(_every(shines, STEP), "the sun's day")
    if not found:
        raise InputError("⟨day⟩ needs light on the plane of the screen, and there is none at any time of that day")
    look(_between(Day(follower.error, follower.bounds, _sorted(found)), shines), "while the picture is on the screen")
    return Day(follower.error, follower.bounds, _sorted(found)), [found[time][1] for time in sorted(found)]


def _seen(follower: Follower | SundialFollower, keep: Callable[[Looked], T], time: datetime) -> tuple[Instant, T] | None:
    """What is seen at a time, None where there is no picture in the plane of the screen."""
    try:
        seen = follower.at(time)
    except InputError:
        return None
    return seen.instant, keep(seen)


def _sorted(found: dict[datetime, tuple[Instant, Any]]) -> tuple[Instant, ...]:
    return tuple(found[time][0] for time in sorted(found))


def _between(day: Day, shines: Hours) -> list[datetime]:
    """Minutes at which light falls on the screen, and those between times of which one is as designed, or legible, only."""
    near = [(i.time, i.time) for i in day.instants if i.on_screen > 0.0]
    for a, b in pairwise(day.instants):
        if a.as_designed != b.as_designed or a.legible != b.legible:
            near.append((a.time, b.time))
    step = timedelta(minutes=STEP)
    minutes = [t for t in _every(shines, 1) if any(a - step < t < b + step if a == b else a < t < b for a, b in near)]
    return minutes[:: max(1, -(-len(minutes) // MOST_BETWEEN))]


def _every(periods: Hours, minutes: int) -> list[datetime]:
    """Times within periods at whole multiples of some minutes of the clock; their first and last minute, too."""
    found = []
    for first, last in periods:
        inner = [first + timedelta(minutes=k) for k in range(round((last - first).total_seconds() / 60.0) + 1)]
        found += [t for t in inner if t in (first, last) or (t.hour * 60 + t.minute) % minutes == 0]
    return found


def rows(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """The figures as rows of a table (name, text)."""
    times = figures["times"]
    said = {name: in_words([_read(*period) for period in figures[name]]) for name in PERIODS}
    ends = [figures["legible"][0][0], figures["legible"][-1][1]] if figures["legible"] else []
    table = [
        ("sun through the pane", f"{in_words([_read(times[0]['time'], times[-1]['time'])])}, looked at {len(times)} times"),
        ("as designed", f"{said['as_designed']}: error {figures['error']:.3f}, at most {figures['as_designed_error']:.3f}"),
        ("legible", f"{said['legible']}: error at most {figures['legible_error']:.3f}"),
        ("legible on the screen", f"{said['on_screen']}: at least {PART:.0%} of it lands there"),
    ]
    for word, end in zip(("first", "last"), ends, strict=False):
        (x, y), brightness = next((row["moved"], row["brightness"]) for row in times if row["time"] == end)
        table.append((f"when {word} legible", f"{x:+.1f}, {y:+.1f} mm away, brightness {brightness:.2f}"))
    return table


def _read(*period: str) -> tuple[datetime, datetime]:
    first, last = map(datetime.fromisoformat, period)
    return first, last


def smoothed(image: np.ndarray, rays: int) -> np.ndarray:
    """An image (..., n_x, n_y) for display: averaged over about QUIET rays where it has fewer in a pixel; its power is kept."""
    width = (QUIET * image.shape[-1] * image.shape[-2] / (4.0 * np.pi * max(rays, 1))) ** 0.5
    return image if width < 0.3 else gaussian_filter(image, (*[0.0] * (image.ndim - 2), width, width), mode="constant")


def write_plot(path: Path, day: Day) -> None:
    """Write a PNG: error, displacement and brightness over the time of day, legible periods shaded."""
    from matplotlib.dates import DateFormatter  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.ticker import NullFormatter  # noqa: PLC0415

    from caustic_cli.studies.report import COLOURS  # noqa: PLC0415

    figure = Figure(figsize=(10.0, 9.0), dpi=100, layout="constrained")
    error, place, light = figure.subplots(3, 1, sharex=True)
    times = [i.time.replace(tzinfo=None) for i in day.instants]
    still = [np.nan if i.error is None else i.error for i in day.instants]
    error.plot(times, still, color=COLOURS[0], label="on the screen where it stands")
    error.plot(times, [i.followed for i in day.instants], color=COLOURS[1], label="on a screen that follows the picture")
    for k, (name, style) in enumerate((("as designed", ":"), ("legible", "--"))):
        error.plot(times, [i.bounds[k] for i in day.instants], color="0.4", ls=style, lw=1.0, label=f"{name}: {day.bounds[k]:.3f}")
    error.set(ylabel="relative RMS error", yscale="log")
    error.yaxis.set_major_formatter("{x:g}")
    error.yaxis.set_minor_formatter(NullFormatter())
    for axis, colour in zip((0, 1), COLOURS[:2], strict=True):
        place.plot(times, [i.moved[axis] for i in day.instants], color=colour, label=f"along the screen's {'xy'[axis]}")
    place.set_ylabel("displacement (mm)")
    reach = max((max(map(abs, i.moved)) for i in day.instants if i.legible), default=0.0)
    if reach:
        place.set_ylim(-1.5 * reach, 1.5 * reach)
    light.plot(times, [i.brightness for i in day.instants], color=COLOURS[0], label="power on the picture, over that of the design")
    light.plot(times, [i.on_screen for i in day.instants], color=COLOURS[1], label="part of it on the screen where it stands")
    light.plot(times, [i.elevation / 90.0 for i in day.instants], color="0.6", lw=1.0, label="elevation of the sun / 90 degrees")
    light.set(xlabel=f"time, {day.instants[0].time:%Y-%m-%d}", ylabel="fraction", ylim=(0.0, None))
    light.xaxis.set_major_formatter(DateFormatter("%H:%M"))
    for axis in (error, place, light):
        for periods, shade in ((day.legible, 0.12), (day.on_screen, 0.3)):
            for a, b in periods:
                axis.axvspan(a.replace(tzinfo=None), b.replace(tzinfo=None), color=COLOURS[2], alpha=shade, lw=0)
        axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, fontsize=8, frameon=False)
    words = [f"{name.replace('_', ' ')} {in_words(getattr(day, name))}" for name in PERIODS]
    figure.suptitle("; ".join(words).replace("on screen", "legible on the screen"), fontsize=10)
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})
