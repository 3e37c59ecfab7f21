"""Files are written whole or not at all: temporary file beside the target, fsync, rename.

Only regular files, and links to them, are opened or replaced: a device, a pipe or a socket may have no end, keep its reader
waiting, or be lost.  Each reader says how many bytes it reads at most, and a larger file is refused by its size alone.
"""

from __future__ import annotations

import contextlib
import glob
import io
import os
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from caustic_cli.errors import CausticError, InputError

#: What marks a file as made by this program, so that it may be replaced.
SOFTWARE = "caustic"
MARK = SOFTWARE.encode()
CREATED_BY = f"created by {SOFTWARE}"  # in a comment at the beginning of a text file
#: How files begin that a project is made of.
PARTS = ("project.toml", "checkpoints.h5", "target.", "profile.", "source.", "source-", "intensity.", "intensity-", ".outputs.json")
PARTS += ("tolerances.toml", "second.", "screen.", "index.")
NPY_MAGIC = b"\x93NUMPY"
NPY_HEADER = 256  # bytes; NumPy itself pads to 64 or 128
#: A temporary file nobody has written to for so many seconds was left by a killed process.
LEFT_BEHIND = 600.0


@contextlib.contextmanager
def naming(path: str | Path | Piped) -> Iterator[None]:
    """Put the file's name before what is said of its content within the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


class Piped(bytes):
    """What came through standard input, in place of a file's path."""

    def __str__(self) -> str:
        return "standard input"


def read_stdin(accepted: str, most: int) -> Piped:
    """All of standard input.

    Raises:
        InputError: it is closed, a terminal, empty, or more than `most` bytes; `accepted` says what is needed.
    """
    if sys.stdin is None or sys.stdin.closed:
        raise InputError(f"standard input is closed; {accepted}")
    if sys.stdin.isatty():
        raise InputError(f"standard input is a terminal; {accepted}, piped in")
    data = Piped(sys.stdin.buffer.read(most + 1))
    if not data:
        raise InputError(f"{data}: is empty; {accepted}")
    if len(data) > most:
        raise InputError(f"{data}: is more than {most:,} bytes, the most that are read; {accepted}")
    return data


def open_regular(path: str | Path | Piped, accepted: str, most: int) -> BinaryIO:
    """A regular file of at most `most` bytes, opened for reading; whoever reads it closes it.  What was piped in is one in memory.

    Raises:
        InputError: there is none, it is something else or larger, or cannot be read; `accepted` says what is needed.
    """

    if isinstance(path, Piped):
        return io.BytesIO(path)

    def opened(name, flags: int) -> int:
        return os.open(name, flags | getattr(os, "O_NONBLOCK", 0))  # a pipe that takes its place meanwhile keeps nobody waiting

    try:
        _refuse_special(path, os.stat(path), accepted)  # before it is opened: that alone may set a device going
        file = open(path, "rb", opener=opened)  # noqa: SIM115 (it is the caller's)
        try:
            found = os.fstat(file.fileno())
            _refuse_special(path, found, accepted)
            if found.st_size > most:
                raise InputError(f"{path}: is {found.st_size:,} bytes; at most {most:,} are read; {accepted}")
        except InputError:
            file.close()
            raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; {accepted}") from error
    except (OSError, ValueError) as error:  # a name too long, or with a zero byte
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}); {accepted}") from error
    return file


def read_bytes(path: str | Path, most: int, accepted: str, least: int = 1) -> bytes:
    """All of a regular file of `least` (0 or 1) to `most` bytes.

    Raises:
        InputError: there is none, it is empty, too large or cannot be read; `accepted` says what is needed.
    """
    with open_regular(path, accepted, most) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            data = file.read(size + 1)  # for which memory is taken at once
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); {accepted}") from error
    if len(data) < least:
        raise InputError(f"{path}: is empty; {accepted}")
    if len(data) > size:
        raise InputError(f"{path}: grew beyond {size:,} bytes while it was read; {accepted}")
    return data


def _refuse_special(path: str | Path, found: os.stat_result, needed: str) -> None:
    """Refuse what is neither a regular file nor a link to one."""
    if not stat.S_ISREG(found.st_mode):
        kind = "a directory" if stat.S_ISDIR(found.st_mode) else "not a regular file"
        raise InputError(f"{path}: is {kind}; {needed}")


def refuse_special(path: str | Path) -> None:
    """Refuse to write where something stands that is no regular file: renaming onto a device would remove it.

    Raises:
        InputError: there is a directory, a device, a pipe or a socket, or a link to one.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # nothing there; what makes writing impossible is said where it is tried
        return
    _refuse_special(path, found, "a file name is needed")


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the same directory; renamed onto `path` when the block ends well, removed when it does not.

    Raises:
        InputError: the directory cannot be written to, or something else than a regular file stands there.
        CausticError: the file could not be written, on a full disk for instance; what stood there before still does.
    """
    path = Path(path)
    refuse_special(path)
    _sweep(path)
    try:
        prefix, suffix = _around(path)
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); a directory you may write to is needed") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp makes it private; a plain open() would not have
        with open(temporary, "rb") as f:
            os.fsync(f.fileno())
        os.replace(temporary, path)
        _sync_directory(path.parent)
    except BaseException as problem:
        with contextlib.suppress(OSError):  # the directory may be gone, or read-only by now
            temporary.unlink(missing_ok=True)
        if isinstance(problem, OSError):
            raise CausticError(f"{path}: could not be written ({problem.strerror or problem})") from problem
        raise


def _around(path: Path) -> tuple[str, str]:
    """Beginning and end of a temporary file's name, not longer than a name may be even if that of `path` is as long."""
    name, suffix = path.name.encode(errors="surrogateescape"), path.suffix.encode(errors="surrogateescape")
    return f".{name[:200].decode(errors='ignore')}.", path.suffix if len(suffix) <= 40 else ""


def _sweep(path: Path) -> None:
    """Remove what processes that were killed while they wrote `path` have left beside it."""
    prefix, suffix = map(glob.escape, _around(path))
    for left in path.parent.glob(f"{prefix}????????{suffix}"):
        with contextlib.suppress(OSError):  # another process was faster
            if left.is_file() and time.time() - left.stat().st_mtime > LEFT_BEHIND:
                left.unlink()


def write_bytes(path: str | Path, *parts: bytes | memoryview) -> None:
    """Write `parts`, one after the other, to `path` atomically."""
    with atomic_path(path) as temporary, open(temporary, "wb") as f:
        f.writelines(parts)


def is_ours(path: str | Path) -> bool:
    """Whether this program made the file: by our mark in a PNG, GIF, MP4, .npy, .npz, STL, JSON or text; nothing else is ours.

    Read are its first and last 1024 bytes.  What cannot be read is not ours.
    """
    try:
        with open_regular(path, "", sys.maxsize) as f:
            head = f.read(1024)
            size = os.fstat(f.fileno()).st_size
            f.seek(max(0, size - 1024))
            tail = f.read(1024)
    except (InputError, OSError):
        return False
    if head.startswith(b"\x93NUMPY\x01\x00"):
        return int.from_bytes(head[8:10], "little") == NPY_HEADER - 10
    if head.startswith(b"\x89PNG"):
        return b"Software\x00" + MARK in head
    if head[4:8] == b"ftyp":
        return CREATED_BY.encode() + b" " in tail  # the comment of an MP4
    if head.startswith(b"PK"):
        return tail.endswith(MARK)  # the archive's comment
    if MARK in head[:80] and size == 84 + 50 * int.from_bytes(head[80:84], "little"):
        return True  # the header of a binary STL
    return b'"created_by": "' + MARK in head + tail or CREATED_BY.encode() + b" " in head


def discard(path: Path) -> None:
    """Remove a file that is out of date, if this program made it."""
    if path.is_file() and is_ours(path):
        path.unlink()


def refuse_foreign(path: str | Path, force: bool = False) -> None:
    """Stop before work begins when `path` cannot be written, or holds something this program did not make.

    Raises:
        InputError: its directory is missing or read-only, it is no regular file, it is foreign and `force` is false, or it
            is what a project is made of.
    """
    path = Path(path)
    refuse_special(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: its directory {path.parent} does not exist; make it first")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: its directory {path.parent} is read-only; one you may write to is needed")
    if (path.parent / "project.toml").exists() and path.name.startswith(PARTS):
        raise InputError(f"{path}: is part of the project and is never replaced by an output; choose another name")
    if path.exists() and not force and not is_ours(path):
        raise InputError(f"{path}: exists and was not made by caustic; ⟨force⟩ replaces it, another name spares it")


def _sync_directory(directory: Path) -> None:
    """Make the rename itself durable, where the system lets a directory be synced."""
    try:
        handle = os.open(directory, os.O_RDONLY)
    except OSError:  # not possible on every system; the file's own content is safe already
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
