"""Files are written whole or not at all: temporary file beside the target, fsync, rename."""

from __future__ import annotations

import contextlib
import glob
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from caustic_cli.errors import CausticError, InputError

#: What marks a file as made by this program, so that it may be replaced.
SOFTWARE = "caustic"
MARK = SOFTWARE.encode()
CREATED_BY = f"created by {SOFTWARE}"  # in a comment at the beginning of a text file
#: How files begin that a project is made of.
PARTS = ("project.toml", "checkpoints.h5", "target.", "profile.", "source.", "source-", "intensity.", "intensity-", ".outputs.json")
NPY_HEADER = 256  # bytes; NumPy itself pads to 64 or 128
#: A temporary file nobody has written to for so many seconds was left by a killed process.
LEFT_BEHIND = 600.0


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the same directory; renamed onto `path` when the block ends well, removed when it does not.

    Raises:
        InputError: the directory cannot be written to.
        CausticError: the file could not be written, on a full disk for instance; what stood there before still does.
    """
    path = Path(path)
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


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def is_ours(path: str | Path) -> bool:
    """Whether this program made the file: by our mark in a PNG, .npy, .npz, STL, JSON or text; nothing else is ours."""
    with open(path, "rb") as f:
        head = f.read(1024)
        size = os.path.getsize(path)
        f.seek(max(0, size - 1024))
        tail = f.read()
    if head.startswith(b"\x93NUMPY\x01\x00"):
        return int.from_bytes(head[8:10], "little") == NPY_HEADER - 10
    if head.startswith(b"\x89PNG"):
        return b"Software\x00" + MARK in head
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
        InputError: its directory is missing or read-only, it is a directory, it is foreign and `force` is false, or it
            is what a project is made of.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; a file name is needed")
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
