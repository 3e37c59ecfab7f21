"""Files are written whole or not at all: temporary file beside the target, fsync, rename."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from caustic_cli.errors import InputError


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the same directory; renamed onto `path` when the block ends well, removed when it does not.

    Raises:
        InputError: the directory cannot be written to.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
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
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def refuse_overwrite(path: str | Path, force: bool) -> None:
    """Stop before work begins when `path` exists and was not asked to be replaced.

    Raises:
        InputError: it exists and `force` is false, it is a directory, or its directory does not exist.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; a file name is needed")
    if path.exists() and not force:
        raise InputError(f"{path}: exists already and is not replaced without --force")
    if not path.parent.is_dir():
        raise InputError(f"{path}: its directory {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: its directory {path.parent} cannot be written to")


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
