"""Writer of movies: GIF by Pillow, MP4 by ffmpeg if that is installed."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import numpy as np
from PIL import Image

from caustic_cli import __version__
from caustic_cli.errors import CausticError, InputError
from caustic_cli.io.files import CREATED_BY, atomic_path, refuse_foreign

MADE = f"{CREATED_BY} {__version__}"
#: Frames per second of an MP4, in which longer frames are repeated.
RATE = 25


def refuse_unwritable(path: str | Path, force: bool = False) -> None:
    """Refuse before work begins if a movie cannot be written to `path`.

    Raises:
        InputError: another suffix, no encoder is installed, or as in `files.refuse_foreign`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise InputError(f"{path}: a movie's name must end in .gif or .mp4")
    if suffix == ".mp4" and _ffmpeg() is None:
        raise InputError(
            f"{path}: an .mp4 needs ffmpeg (pip install imageio-ffmpeg brings one), which is not installed; a .gif needs nothing"
        )
    refuse_foreign(path, force)


def write_movie(path: str | Path, frames: Sequence[Image.Image], milliseconds: Sequence[int]) -> None:
    """Write frames of one size with their durations; a GIF repeats.

    Raises:
        InputError: as in `refuse_unwritable`; CausticError: it could not be encoded.
    """
    path = Path(path)
    refuse_unwritable(path, force=True)
    with atomic_path(path) as temporary:
        if path.suffix.lower() == ".gif":
            first, *rest = frames
            first.save(
                temporary,
                format="GIF",
                save_all=True,
                append_images=rest,
                duration=list(milliseconds),
                loop=0,
                comment=MADE.encode(),
                optimize=False,
            )
        else:
            _encode(temporary, frames, milliseconds)


def _ffmpeg() -> str | None:
    """Path of ffmpeg, of the system or of the package imageio-ffmpeg, or None."""
    found = shutil.which("ffmpeg")
    if found is None and importlib.util.find_spec("imageio_ffmpeg") is not None:
        found = import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return found


def _encode(path: Path, frames: Sequence[Image.Image], milliseconds: Sequence[int]) -> None:
    width, height = (n + n % 2 for n in frames[0].size)  # even, since yuv420p subsamples the chroma
    command = [str(_ffmpeg()), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command += ["-r", str(RATE), "-i", "-", "-c:v", "libx264", "-preset", "medium", "-crf", "18", "-pix_fmt", "yuv420p"]
    command += ["-metadata", f"comment={MADE}", "-f", "mp4", str(path)]
    data = b"".join(
        _padded(frame, width, height).tobytes() * max(1, round(ms * RATE / 1000))
        for frame, ms in zip(frames, milliseconds, strict=True)
    )
    done = subprocess.run(command, input=data, capture_output=True, check=False)
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        raise CausticError(f"ffmpeg could not write the movie: {said[-1] if said else f'exit status {done.returncode}'}")


def _padded(frame: Image.Image, width: int, height: int) -> np.ndarray:
    """RGB (height, width, 3), padded with black."""
    pixels = np.asarray(frame.convert("RGB"))
    return np.pad(pixels, ((0, height - pixels.shape[0]), (0, width - pixels.shape[1]), (0, 0)))
