"""The cache directory of compiled kernels: one for each state of their sources.

Numba identifies a cached function by the path and time stamp of its own file, so that changes of functions or constants in other
files that are compiled into it go unnoticed, and every installation compiles again.  Here every state of all kernel sources,
together with the versions of numba and Python, has its own directory `caustic-<hash>` below the first of

    NUMBA_CACHE_DIR, the user's choice;
    XDG_CACHE_HOME/caustic, by default ~/.cache/caustic: one per user, which leaves the installation unchanged and works for one
    that is read-only;
    caustic-<user> in the system's temporary directory, if only this user can write to it, since numba unpickles its files,

that is writable.  If none is, kernels are compiled again in every process.  Processes that start together share the work: a
function that one of them compiles the others wait for (`claim`).
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import platform
import re
import shutil
import stat
import tempfile
import time
import zlib
from collections.abc import Iterator
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, where processes that start at the same time compile the same functions
    fcntl = None  # type: ignore[assignment]

PACKAGE = Path(__file__).resolve().parents[2]
PREFIX, DIGITS = "caustic-", 20
#: Marker file in each directory, touched on every use, so that its age shows how long the directory has been unused.
USED = "last-used"
KEPT_DAYS = 30.0
#: File of each directory in which a process that compiles a function locks the byte whose position follows from its name.
LOCKS = "locks"
#: Longest time, s, to wait for another process, which may have been stopped, and the time between two attempts.
LONGEST, PAUSE = 60.0, 0.01


def sources(package: Path = PACKAGE) -> list[Path]:
    """The source files of compiled code: all kernel files, other files with compiled functions, and those with their constants."""
    own = package / "optics" / "kernels"
    found = {p for p in package.rglob("*.py") if own in p.parents or b"njit" in p.read_bytes()}
    return sorted(found | {package / "optics" / "tolerances.py"})


def name(package: Path = PACKAGE) -> str:
    """Name of the directory for the current state of the sources."""
    state = hashlib.sha256()
    for path in sources(package):
        state.update(f"{path.relative_to(package).as_posix()}\0".encode())
        state.update(hashlib.sha256(path.read_bytes()).digest())
    for part in ("numba", "llvmlite", "numpy"):
        with contextlib.suppress(PackageNotFoundError):
            state.update(f"{part} {version(part)}\0".encode())
    state.update(f"{platform.python_implementation()} {platform.python_version()} {platform.machine()}".encode())
    return PREFIX + state.hexdigest()[:DIGITS]


def bases() -> Iterator[Path]:
    """Candidate parent directories, in order of preference."""
    asked, common = os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")
    if asked:
        yield Path(asked)
    elif common and Path(common).is_absolute():  # the XDG Base Directory Specification asks for others to be ignored
        yield Path(common) / "caustic"
    else:
        with contextlib.suppress(RuntimeError):  # no HOME, and an unknown user id
            yield Path.home() / ".cache" / "caustic"
    with contextlib.suppress(OSError):  # no directory for temporary files either
        if private(path := Path(tempfile.gettempdir()) / f"{PREFIX}{os.getuid() if hasattr(os, 'getuid') else 'user'}"):
            yield path


def private(path: Path) -> bool:
    """Whether only this user can write to a directory, which is created if necessary."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    state = path.lstat()
    if not stat.S_ISDIR(state.st_mode):
        return False
    return not hasattr(os, "getuid") or (state.st_uid == os.getuid() and not state.st_mode & 0o022)


def writable(path: Path) -> bool:
    """Whether a directory, created if necessary, is writable; leaves `USED` in it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):  # with a unique name: another process may do the same
            (path / USED).touch()
    except OSError:
        return False
    return True


def choose() -> Path | None:
    """The cache directory; None if no candidate is writable."""
    own = name()
    for base in bases():
        if writable(base / own):
            return base / own
    return None


def tidy(directory: Path, days: float = KEPT_DAYS) -> None:
    """Remove sibling cache directories that have not been used for `days`."""
    ours, before = re.compile(f"{PREFIX}[0-9a-f]{{{DIGITS}}}"), time.time() - days * 86400.0
    with contextlib.suppress(OSError):  # whatever cannot be read or removed stays: another process may be removing it
        for path in list(directory.parent.iterdir()):
            used = path / USED
            if path == directory or not ours.fullmatch(path.name) or path.is_symlink() or not used.is_file():
                continue
            if used.stat().st_mtime < before:
                shutil.rmtree(path, ignore_errors=True)


@lru_cache(maxsize=1)
def _locks() -> int | None:
    """File descriptor of LOCKS, open until the process ends, since closing it would release all its locks; None if it cannot be."""
    with contextlib.suppress(OSError):
        return None if fcntl is None or DIRECTORY is None else os.open(DIRECTORY / LOCKS, os.O_RDWR | os.O_CREAT, 0o666)
    return None


def claim(function: str) -> None:
    """Wait while another process compiles a function; from then on others wait for this one, until it calls `release` or ends."""
    last = time.monotonic() + LONGEST
    while (locks := _locks()) is not None:
        try:
            fcntl.lockf(locks, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, zlib.crc32(function.encode()))
            return
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN) or time.monotonic() > last:  # no locks on this file system
                return
        time.sleep(PAUSE)


def release(function: str) -> None:
    """End the wait of other processes for a function, which this one has compiled and stored."""
    if (locks := _locks()) is not None:
        with contextlib.suppress(OSError):
            fcntl.lockf(locks, fcntl.LOCK_UN, 1, zlib.crc32(function.encode()))


#: Of this process, found once.
DIRECTORY = choose()
if DIRECTORY is not None:
    tidy(DIRECTORY)
