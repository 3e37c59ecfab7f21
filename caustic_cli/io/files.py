"""Atomic writing (temporary file in the same directory, fsync, rename) and bounded reading of files.

Every file that a user names is opened here: only regular files, and links to them, are read or replaced, since a device, a pipe or
a socket may be endless, block its reader, or be destroyed.  Each reader gives the largest number of bytes it reads, and a larger
file is refused by its size.  An output whose path is a link is written where that leads, and the link remains.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import io
import os
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, BinaryIO

from caustic_cli.errors import CausticError, InputError

#: Mark of files made by this program, which it may replace.
SOFTWARE = "caustic"
MARK = SOFTWARE.encode()
CREATED_BY = f"created by {SOFTWARE}"  # in a comment at the beginning of a text file
#: Beginnings of the names of the files of a project that outputs must not replace.
PARTS = ("project.toml", "checkpoints.h5", "target.", "profile.", "source.", "source-", "intensity.", "intensity-", ".outputs.json")
PARTS += ("tolerances.toml", "second.", "screen.", "index.", "corrections.")
NPY_MAGIC = b"\x93NUMPY"
NPY_HEADER = 256  # bytes; NumPy itself pads to 64 or 128
#: What an output needs.
FILE_NAME = "a file name is needed"
#: Largest file of which a hash is taken, bytes: the largest checkpoint has 6.5 GB.
MOST_HASHED = 1 << 33
#: Age, s, after which a temporary file counts as left by a killed process.
LEFT_BEHIND = 600.0


@contextlib.contextmanager
def naming(path: str | Path | Piped) -> Iterator[None]:
    """Prefix an InputError of the block with the file name."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


class Piped(bytes):
    """Data from standard input, in place of a path."""

    def __str__(self) -> str:
        return "standard input"


def read_stdin(accepted: str, most: int) -> Piped:
    """All of standard input.

    Raises:
        InputError: it is closed, a terminal, empty, or more than `most` bytes; `accepted` describes a valid file.
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


@contextlib.contextmanager
def open_regular(path: str | Path | Piped, accepted: str, most: int) -> Iterator[BinaryIO]:
    """Open a regular file of at most `most` bytes for reading; piped data are a file in memory.

    Raises:
        InputError: there is no such regular file, it is larger, or cannot be read, now or within the block; `accepted` describes a
            valid file.
    """

    def opened(name, flags: int) -> int:
        return os.open(name, flags | getattr(os, "O_NONBLOCK", 0))  # does not block on a pipe that replaced the file meanwhile

    if isinstance(path, Piped):
        yield io.BytesIO(path)
        return
    try:
        _refuse_special(path, os.stat(path), accepted)  # checked first, since opening may already act on a device
        file = open(path, "rb", opener=opened)  # noqa: SIM115 (closed below)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; {accepted}") from error
    except (OSError, ValueError) as error:  # e.g. a name that is too long, or contains a zero byte
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read ({reason(error)}); {accepted}") from error
    with file:
        found = os.fstat(file.fileno())
        _refuse_special(path, found, accepted)
        if found.st_size > most:
            raise InputError(f"{path}: is {found.st_size:,} bytes; at most {most:,} are read; {accepted}")
        try:
            yield file
        except OSError as error:
            if error.strerror is None or error.filename is not None:  # raised by a decoder, or of another file
                raise
            raise InputError(f"{path}: cannot be read ({reason(error)}); {accepted}") from error


def reason(error: OSError | ValueError) -> str:
    """What the operating system says of a failure, as a clause."""
    return getattr(error, "strerror", None) or str(error)


def read_bytes(path: str | Path, most: int, accepted: str, least: int = 1) -> bytes:
    """All of a regular file of `least` (0 or 1) to `most` bytes.

    Raises:
        InputError: there is no such file, it is empty, too large or cannot be read; `accepted` describes a valid file.
    """
    with open_regular(path, accepted, most) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1) or b""  # allocates the whole size at once; None of a file of /proc that has to be waited for
    if len(data) < least:
        raise InputError(f"{path}: is empty; {accepted}")
    if len(data) > size:
        raise InputError(f"{path}: grew beyond {size:,} bytes while it was read; {accepted}")
    return data


def sha256_of(path: str | Path) -> str:
    """sha256 of a regular file of at most MOST_HASHED bytes, "" if it cannot be read."""
    try:
        with open_regular(path, "", MOST_HASHED) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except InputError:
        return ""


def _refuse_special(path: str | Path, found: os.stat_result, needed: str) -> None:
    """Refuse anything but a regular file or a link to one."""
    if stat.S_ISDIR(found.st_mode):
        raise InputError(f"{path}: is a directory; {needed}")
    if not stat.S_ISREG(found.st_mode):
        kind = "a pipe" if stat.S_ISFIFO(found.st_mode) else "a socket" if stat.S_ISSOCK(found.st_mode) else "a device"
        raise InputError(f"{path}: is {kind}, not a regular file; {needed}")


def destination(path: str | Path) -> Path:
    """The file that an output path leads to, which need not exist.  Links are followed, since replacing one to a device or an open
    stream would remove that for every program; a link that leads nowhere is its own destination.

    Raises:
        InputError: the path is a directory, a device, a pipe, a socket or an open stream, or a link to one, or no possible name.
    """
    path = Path(path)
    if not path.name:
        raise InputError(f"{path}: is a directory; {FILE_NAME}")
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return path
    except (OSError, ValueError) as error:  # e.g. a loop of links, a name that is too long, or one that contains a zero byte
        raise InputError(f"{path}: cannot be written ({reason(error)}); {FILE_NAME}") from error
    _refuse_special(path, found, FILE_NAME)
    if _is_stream(path):
        raise InputError(f"{path}: is an open stream, not a file that can be replaced; {FILE_NAME}")
    return Path(os.path.realpath(path))


def _is_stream(path: Path) -> bool:
    """Whether a path leads to a file by a descriptor, as /dev/stdout does: it is written to while it is open, not by its name."""
    while path.is_symlink():
        folder = os.path.realpath(path.parent)
        if folder.startswith("/proc/") and folder.endswith("/fd"):
            return True
        path = Path(folder, os.readlink(path))
    return False


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside the destination of `path`, renamed to that when the block succeeds, removed otherwise.

    Raises:
        InputError: the directory cannot be written to, or the path is not a regular file.
        CausticError: the file could not be written, on a full disk for instance; an existing file is unchanged.
    """
    place = destination(path)
    _sweep(place)
    try:
        prefix, suffix = _around(place)
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=place.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); a directory you may write to is needed") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp creates it with mode 0600, unlike open()
        with open(temporary, "rb") as f:
            os.fsync(f.fileno())
        os.replace(temporary, place)
        _sync_directory(place.parent)
    except BaseException as problem:
        with contextlib.suppress(OSError):  # the directory may be gone, or read-only by now
            temporary.unlink(missing_ok=True)
        if isinstance(problem, OSError):
            raise CausticError(f"{path}: could not be written ({problem.strerror or problem})") from problem
        raise


@contextlib.contextmanager
def atomic_file(path: str | Path, encoding: str | None = None) -> Iterator[IO]:
    """A file open for writing and reading bytes, or text of an encoding with newlines as they are, that becomes `path` as by
    `atomic_path`."""
    text = {} if encoding is None else {"encoding": encoding, "newline": "\n"}
    with atomic_path(path) as temporary, open(temporary, "w+b" if encoding is None else "w", **text) as file:
        yield file


def _around(path: Path) -> tuple[str, str]:
    """Prefix and suffix of the name of a temporary file, within the length limit of names for any `path`."""
    name, suffix = path.name.encode(errors="surrogateescape"), path.suffix.encode(errors="surrogateescape")
    return f".{name[:200].decode(errors='ignore')}.", path.suffix if len(suffix) <= 40 else ""


def _sweep(path: Path) -> None:
    """Remove temporary files left by processes that were killed while writing `path`."""
    prefix, suffix = map(glob.escape, _around(path))
    for left in path.parent.glob(f"{prefix}????????{suffix}"):
        with contextlib.suppress(OSError):  # another process was faster
            if left.is_file() and time.time() - left.stat().st_mtime > LEFT_BEHIND:
                left.unlink()


def write_bytes(path: str | Path, *parts: bytes | memoryview) -> None:
    """Write `parts`, one after the other, to `path` atomically."""
    with atomic_file(path) as file:
        file.writelines(parts)


def is_ours(path: str | Path) -> bool:
    """Whether this program made the file, by its mark in a PNG, GIF, MP4, .npy, .npz, STL, JSON or text.

    Reads the first and last 1024 bytes.  False for a file that cannot be read.
    """
    try:
        with open_regular(path, "", sys.maxsize) as f:
            head = f.read(1024)
            size = os.fstat(f.fileno()).st_size
            f.seek(max(0, size - 1024))
            tail = f.read(1024)
    except InputError:
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
    """Remove an outdated file, if this program made it."""
    if path.is_file() and is_ours(path):
        path.unlink()


def refuse_foreign(path: str | Path, force: bool = False) -> None:
    """Refuse before work begins if `path` cannot be written, or holds a file not made by this program.

    Raises:
        InputError: its directory is missing or read-only, it is not a regular file, it is part of a project, or `force` is false
            and it was not made by this program or is a link that leads nowhere.
    """
    path, place = Path(path), destination(path)
    if not place.parent.is_dir():
        raise InputError(f"{path}: its directory {place.parent} does not exist; make it first")
    if not os.access(place.parent, os.W_OK):
        raise InputError(f"{path}: its directory {place.parent} is read-only; one you may write to is needed")
    for one in (path, place):
        if (one.parent / "project.toml").exists() and one.name.startswith(PARTS):
            raise InputError(f"{path}: is part of the project and is never replaced by an output; choose another name")
    if place.is_symlink() and not force:
        raise InputError(
            f"{path}: is a link to {os.readlink(place)}, which does not exist; ⟨force⟩ replaces it, another name spares it"
        )
    if place.exists() and not force and not is_ours(place):
        raise InputError(f"{path}: exists and was not made by caustic; ⟨force⟩ replaces it, another name spares it")


def _sync_directory(directory: Path) -> None:
    """Sync the directory, which makes the rename durable, where the system supports it."""
    try:
        handle = os.open(directory, os.O_RDONLY)
    except OSError:  # not possible on every system; the content of the file is synced already
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
