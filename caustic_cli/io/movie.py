"""Pictures one after another in one file: GIF by Pillow, MP4 by ffmpeg where that is installed."""

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
#: Frames a second of an MP4, in which a picture that stays is there again and again.
RATE = 25


def refuse_unwritable(path: str | Path, force: bool = False) -> None:
    """Stop before work begins where a movie could not be written to `path`.

    Raises:
        InputError: its suffix is no movie's, what encodes it is not installed, or as of `files.refuse_foreign`.
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
    """Write pictures of one size, each shown for so long; a GIF begins again at its end.

    Raises:
        InputError: as of `refuse_unwritable`; CausticError: it could not be encoded.
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
    """The program, of the system or of the package imageio-ffmpeg."""
    found = shutil.which("ffmpeg")
    if found is None and importlib.util.find_spec("imageio_ffmpeg") is not None:
        found = import_module("imageio_ffmpeg").get_ffmpeg_exe()
    return found


def _encode(path: Path, frames: Sequence[Image.Image], milliseconds: Sequence[int]) -> None:
    width, height = (n + n % 2 for n in frames[0].size)  # colours are kept for every other pixel
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
    """Colours (height, width, 3), black beyond the frame."""
    pixels = np.asarray(frame.convert("RGB"))
    return np.pad(pixels, ((0, height - pixels.shape[0]), (0, width - pixels.shape[1]), (0, 0)))
