"""A day of sunlight: the picture through the hours of a date, as a film, a plot and a table."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from functools import partial
from typing import Any, ClassVar

import numpy as np
from PIL import Image, ImageDraw

from caustic_cli.config.optional import in_reading_order, sunlight
from caustic_cli.errors import InputError
from caustic_cli.io.movie import write_movie
from caustic_cli.io.picture import codes_of
from caustic_cli.scene import Scene
from caustic_cli.scene.sunlight import Hours, Sunlight, instants, moment
from caustic_cli.scene.traits import Capability
from caustic_cli.studies import day as study
from caustic_cli.studies.retrace import white_level
from caustic_cli.studies.viewing import as_viewed, in_colour, separated
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.movie import HEIGHT, captioned, enlarged
from caustic_cli.workflow.outputs.base import Output, Rendering
from caustic_cli.workflow.reporter import Reporter

#: Duration of a frame, milliseconds.
FRAME = 100


@dataclass(eq=False)
class DayOfSunlight(Output):
    """The film and the plot, beside the image; day: an ISO date, in the time zone of the design."""

    option: ClassVar[str] = "day"
    capability: ClassVar[Capability] = Capability("a day of sunlight", {})
    files: ClassVar[tuple[str, ...]] = ("day.gif", "day.png")
    beyond: ClassVar[bool] = True

    day: str

    def unsupported(self, lens: Lens) -> str:
        if lens.target is None:
            return "⟨day⟩ compares with the picture, which an archive does not hold; render its project"
        return super().unsupported(lens)

    def prepare(self, rendering: Rendering) -> None:
        """Check that the sun shines through the window on that day.

        Raises:
            InputError: it does not, `day` is no date, or the project has no place on earth.
        """
        self._sunlight(rendering)

    def _sunlight(self, rendering: Rendering) -> tuple[Sunlight, Hours]:
        """The light of the sun, and the hours at which it shines through the pane."""
        try:
            day = date.fromisoformat(self.day)
        except ValueError:
            raise InputError(f"⟨day⟩ must be a date like 2026-06-21, got {self.day!r}") from None
        moment(f"{day}T12:00Z", "⟨day⟩")  # refuses years in which the sun is elsewhere
        lens = rendering.lens
        room = None if lens.project is None else lens.project.room(rendering.asked.tracing.given)
        if room is None:
            raise InputError("⟨day⟩ needs a place on earth and a time of the design: ⟨+room.place⟩")
        light, designed = sunlight(room)
        return light, study.hours_of_sun(light, day, designed.tzinfo)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """day: the figures of `studies.day`, with the paths of both files."""
        lens, say, (film, plot) = rendering.lens, rendering.say, self.paths(rendering.place)
        light, shines = self._sunlight(rendering)
        follower = self._follower(rendering, light)
        with say.progress(None) as show:
            found, frames = study.follow_day(
                follower,
                shines,
                partial(_frame, follower, lens.encoding),
                lambda what, done, whole: show("day", what, done, whole),
            )
        write_movie(film, frames, [FRAME] * len(frames))
        study.write_plot(plot, found)
        return {"day": found.figures | {"film": str(film), "plot": str(plot)}}

    def _follower(self, rendering: Rendering, light: Sunlight) -> study.Follower | study.SundialFollower:
        """Of the picture, or of each picture of a sundial.

        Raises:
            InputError: its sources are not the sun at several times.
        """
        lens, scene, project = rendering.lens, rendering.plan.scene, rendering.lens.project
        assert lens.target is not None and project is not None
        rays = rendering.asked.tracing.rays or study.RAYS

        def follower(one: Scene, target: np.ndarray) -> study.Follower:
            how = {"rays": rays, "seed": rendering.seed, "device": rendering.device}
            return study.Follower(one, lens.field, lens.heights, target, light, **how)

        if not scene.source.in_turn:
            return follower(scene, lens.target)
        room = project.room(rendering.asked.tracing.given)
        assert room is not None
        times, targets = instants(room.time, len(scene.by_source)), project.targets(scene)
        if not len(times) == len(targets) == len(scene.by_source):
            raise InputError("⟨day⟩ of sources that shine in turn needs ⟨room.time⟩ as an interval and a picture for each of them")
        followers = [follower(*pair) for pair in zip(scene.by_source, targets, strict=True)]
        return study.SundialFollower(followers, in_reading_order(times, scene.lens.array))

    def show(self, figures: dict[str, Any], say: Reporter) -> None:
        found = figures["day"]
        say.table(f"the sun on {self.day}", [*study.rows(found), ("film and plot", f"{found['film']}, {found['plot']}")])


def _frame(followed: study.Follower | study.SundialFollower, encoding: str, seen: study.Looked) -> Image.Image:
    """The plane of the screen, with the outline of the screen, beside the picture that is followed."""
    i = seen.instant
    follower = followed.of(i.time)
    scene = follower.scene
    white = white_level(follower.white, follower.target)
    shown = []
    for image in (seen.around, seen.image):
        grey, xyz = separated(scene, study.smoothed(image, follower.rays))
        if scene.colored:
            exposure = float(image.sum() / follower.white.sum())
            viewed, level = as_viewed(scene, grey, exposure * follower.target)
        else:
            viewed, level = grey if xyz is None else in_colour(scene, xyz, white), white
        shown.append(enlarged(codes_of(viewed, level, encoding)))
    wall, picture = (one.convert("RGB") for one in shown)
    wide, high = (round(n / study.AROUND) for n in wall.size)
    ImageDraw.Draw(wall).rectangle((wide, high, 2 * wide, 2 * high), outline=(90, 130, 200))
    both = Image.new("RGB", (wall.width + 8 + picture.width, HEIGHT), (40, 40, 40))
    both.paste(wall, (0, 0))
    both.paste(picture, (wall.width + 8, 0))
    legible = "" if i.legible else ", not legible"
    place = f"{i.moved[0]:+.1f}, {i.moved[1]:+.1f} mm"
    return captioned(
        both,
        f"{i.time:%H:%M}, sun at azimuth {i.azimuth:.1f}, elevation {i.elevation:.1f} degrees, {i.incidence:.1f} from the normal",
        f"left: the screen where it stands; right: followed, {place}, error {i.followed:.3f}{legible}",
    )
