"""Movie of a design: the images of the objective at its iterations, then that of the finished lens.

The image of an iteration is a by-product of the objective, so that recording needs no tracing: it has the rays and filter of the
design, or is its wave image.  The last one is that of the independent evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from caustic_cli.inverse.designer import State
from caustic_cli.inverse.target import grey
from caustic_cli.io.picture import codes_of
from caustic_cli.loading import OnDemand
from caustic_cli.scene import Scene
from caustic_cli.studies.judge import judge_of
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.viewing import as_lit, separated
from caustic_cli.workflow.reporter import Reporter

movies = OnDemand("caustic_cli.io.movie")

#: Most frames; for a longer design every second, fourth, ... iteration is kept.
MOST = 160
#: Duration of the movie, of a frame at least and at most, and of the finished lens, milliseconds.
LENGTH, LEAST, LONGEST, LAST = 10_000, 60, 300, 2000
#: Height of the picture and of a line of text, and font size, pixels.
HEIGHT, LINE, LETTERS = 480, 24, 15


@dataclass(frozen=True)
class Frame:
    """codes: 8-bit pixels, (rows, columns) or (rows, columns, 3); words: two lines of text below."""

    codes: np.ndarray
    words: tuple[str, str]


class NoMovie:
    """What a design asks of its recording, where none is made."""

    def begin(self, scene: Scene) -> None:
        """Record images of this scene, by whose screen's pixel areas power is converted to irradiance."""

    def record(self, state: State, target: np.ndarray, encoding: str, waves: bool) -> None:
        """Record the image of the last iteration; waves: whether it is a wave image."""

    def finish(self, image: np.ndarray, figures: dict[str, Any], say: Reporter) -> dict[str, str]:
        """Record the image of the finished lens, or the tristimulus values of light with colour, with the figures of its evaluation
        as the last frame, and write; the figures of the recording."""
        return {}

    def write(self) -> None:
        """Write the file atomically; none if nothing was recorded."""

    def unused(self, say: Reporter) -> None:
        """Report that no design was run."""


@dataclass(eq=False)
class Movie(NoMovie):
    """Records a design.

    Raises:
        InputError: it could not be written, see `io.movie.refuse_unwritable`.
    """

    #: A .gif or .mp4.
    path: Path
    #: Replace an existing file.
    force: bool = False
    frames: list[Frame] = field(default_factory=list)

    def __post_init__(self):
        movies.refuse_unwritable(self.path, self.force)
        self._every, self._seen = 1, 0
        self._target: np.ndarray | None = None
        self._encoding = "srgb"
        self._last = ""
        self.scene: Scene | None = None

    def begin(self, scene: Scene) -> None:
        self.scene = scene

    def record(self, state: State, target: np.ndarray, encoding: str, waves: bool) -> None:
        self._target, self._encoding, self._seen = target, encoding, self._seen + 1
        total, stage, _, _, seconds = state.history[-1]
        self._last = f"iteration {total}, {seconds:.1f} s"
        if state.image is None or (self._seen - 1) % self._every:
            return
        if len(self.frames) >= MOST:
            self.frames, self._every = self.frames[::2], 2 * self._every
        image = state.image.cpu().numpy()
        how = "wave image" if waves else "the rays of the design"
        self._add(image, f"stage {stage + 1}, {self._last}", f"relative RMS error {self._error(image):.3f}, by {how}")

    def finish(self, image: np.ndarray, figures: dict[str, Any], say: Reporter) -> dict[str, str]:
        words = f"relative RMS error {figures['error']:.3f}, {judge_of(figures).light.format(**figures)}"
        self._add(image, f"finished after {self._last}" if self._last else "finished", words)
        self.write()
        say.say(f"{self.path}: {len(self.frames)} frames of the design")
        return {"movie": str(self.path)}

    def unused(self, say: Reporter) -> None:
        say.say(f"{self.path}: is not written, since no design was run")

    def write(self) -> None:
        if self.frames:
            each = min(max(LENGTH // len(self.frames), LEAST), LONGEST)
            shown = [_drawn(frame) for frame in self.frames]
            movies.write_movie(self.path, shown, [*[each] * (len(shown) - 1), LAST])

    def _error(self, image: np.ndarray) -> float:
        assert self._target is not None
        return relative_rms(grey(separated(self.scene, image)[0]), grey(self._target))

    def _add(self, image: np.ndarray, *words: str) -> None:
        target, scene = self._target, self.scene
        seen, xyz = separated(scene, image)
        self.frames.append(Frame(codes_of(*as_lit(scene, seen, target, xyz), self._encoding), (words[0], words[1])))


def recorder(path: Path | None, force: bool) -> NoMovie:
    """The recording of a design at `path`, or none."""
    return NoMovie() if path is None else Movie(path, force)


def _drawn(frame: Frame) -> Image.Image:
    """A frame of a design."""
    return captioned(enlarged(frame.codes), *frame.words)


def enlarged(codes: np.ndarray) -> Image.Image:
    """8-bit pixels, (rows, columns) or (rows, columns, 3), as a picture of the height of a movie."""
    rows, columns = codes.shape[:2]
    return Image.fromarray(codes).resize((round(HEIGHT * columns / rows), HEIGHT), Image.Resampling.BILINEAR)


def captioned(picture: Image.Image, *words: str) -> Image.Image:
    """A picture above two lines of text, white on black: a frame of a movie."""
    width = max(320, round(picture.width / 2) * 2)
    sheet = Image.new(picture.mode, (width, HEIGHT + 2 * LINE + 8))
    sheet.paste(picture, ((width - picture.width) // 2, 0))
    draw = ImageDraw.Draw(sheet)
    import matplotlib  # noqa: PLC0415 - for its font

    font = ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), LETTERS)
    for k, (line, shade) in enumerate(zip(words, (235, 170), strict=True)):
        draw.text((10, HEIGHT + 4 + k * LINE), line, fill=shade if sheet.mode == "L" else (shade,) * 3, font=font)
    return sheet
