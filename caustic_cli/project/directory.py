"""Creation and locking of a project directory: atomic, never over foreign files, and with one design at a time.

The lock is an advisory lock of the operating system on the directory itself, so it ends with the process that holds it, even if
that is killed, and leaves no lock file.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from caustic_cli.errors import InputError
from caustic_cli.io.files import LEFT_BEHIND, PARTS, destination, is_ours
from caustic_cli.project import attachments, checkpoint, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.correction import CORRECTIONS
from caustic_cli.project.project import CHECKPOINT, MADE, TOML, Project, is_project

try:
    import fcntl
except ImportError:  # not on Windows, where concurrent designs in one directory are not detected
    fcntl = None

#: Name, without suffix, of the picture of a project.
PICTURE = "target"


def check(path: Path, force: bool) -> None:
    """Refuse a path with contents that a new project must not replace; changes nothing.

    Raises:
        InputError: it is no directory, not a project, a project without `force`, or cannot be written to.
    """
    place = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not os.access(place, os.W_OK) or (not place.is_dir() and place != path):
        reason = "permission denied" if place.is_dir() else f"{place} is not a directory"
        raise InputError(f"{path}: cannot be written to ({reason}); -o DIR chooses another place")
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{path}: exists and is not a directory; -o DIR chooses another place")
    if not is_project(path) and not all(_of_a_new_project(p) for p in path.iterdir()):
        raise InputError(f"{path}: exists and is not a caustic project; -o DIR chooses another place")
    if is_project(path) and not force:
        raise InputError(
            f"{path}: holds a design already, of another picture or other options; ⟨resume⟩ continues it,"
            " ⟨force⟩ begins anew, -o DIR chooses another place"
        )


def _of_a_new_project(path: Path) -> bool:
    """Whether a file belongs to an incomplete project, whose design was killed before its project.toml was written."""
    return path.is_file() and (
        path.name.startswith(tuple(f".{stem}" for stem in (PICTURE, *attachments.STEMS, TOML, uptodate.RECORD)))
        or uptodate.is_record(path)
        or (path.stem == PICTURE and is_ours(path))
        or (path.stem.split("-")[0] in attachments.STEMS and any(map(is_ours, path.parent.glob(f"{PICTURE}.*"))))
    )


def create(project: Project, force: bool, state: Checkpoint | None = None) -> None:
    """Create a project directory, with its checkpoint if there is a `state`, and lock it (`Project.hold`).

    A new directory is written beside its path and renamed, so that it appears complete or not at all.

    Raises:
        InputError: there are other contents, another design is running there, or it cannot be written to.
    """
    path = project.path
    check(path, force)
    try:
        if path.exists():
            try:
                project.hold.enter_context(locked(path))
                parts = [present for present in path.iterdir() if present.name.startswith((*PARTS, *MADE))]
                for present in parts:
                    destination(present)  # refuses what is no regular file before anything is removed
                for present in parts:
                    if present.name in (*MADE, CORRECTIONS) or present.is_symlink():  # where a link leads is not the project's
                        present.unlink()
                _write(project, path, state)
            except BaseException:
                project.hold.close()
                raise
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        for left in path.parent.glob(".*.caustic-new"):
            if time.time() - left.stat().st_mtime > LEFT_BEHIND:
                shutil.rmtree(left, ignore_errors=True)
        staging = Path(tempfile.mkdtemp(suffix=".caustic-new", prefix=".", dir=path.parent))
        try:
            umask = os.umask(0)
            os.umask(umask)
            staging.chmod(0o777 & ~umask)
            project.hold.enter_context(locked(staging))
            _write(project, staging, state)
            os.rename(staging, path)
        except BaseException:
            project.hold.close()
            shutil.rmtree(staging, ignore_errors=True)
            raise
    except OSError as error:
        raise InputError(f"{path}: cannot be written to ({error.strerror}); -o DIR chooses another place") from error


def _write(project: Project, path: Path, state: Checkpoint | None) -> None:
    uptodate.record_begun(project, path)
    project.write(path)
    if state is not None:
        checkpoint.save(path / CHECKPOINT, state)
        uptodate.forget_begun(path)


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Lock a directory exclusively, until the block or the process ends.

    Raises:
        InputError: another process has locked it.
    """
    handle = os.open(directory, os.O_RDONLY)
    try:
        _lock(handle, directory)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, directory: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(
            f"{directory}: another caustic design is running there; wait until it has ended, or -o DIR chooses another place"
        ) from error
    except OSError:  # a network file system without locks
        return
