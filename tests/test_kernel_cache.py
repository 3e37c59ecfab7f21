"""Where compiled kernels are kept: a directory for each state of their sources, and what is done where nothing can be written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from caustic_cli.optics.kernels import cache

#: A kernel that is compiled in a second; what it gives follows from a constant of `tolerances`, by way of a function of `fresnel`.
PROBE = '''"""A small kernel."""

from caustic_cli.optics.kernels.fresnel import cosine_behind
from caustic_cli.optics.kernels.jit import njit


@njit(entry=True)
def probe(a):
    return 1.0 if cosine_behind(1.0 + a, 1.0, 1.5)[1] else 0.0
'''
RUN = """
from caustic_cli.optics.kernels.probe import probe
print(probe(0.0), sum(probe.stats.cache_hits.values()), sum(probe.stats.cache_misses.values()))
"""
#: Kills the process as soon as a function is compiled.
DIES = """
import os, signal
from numba.core import event

class Killer(event.Listener):
    def on_start(self, event):
        os.kill(os.getpid(), signal.SIGKILL)

    def on_end(self, event):
        pass

event.register("numba:compile", Killer())
"""


def run(code: str, package: Path, **variables: str | None) -> list[str]:
    """What a fresh interpreter with a copy of the package prints, with changes to the environment (None: unset)."""
    env = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", **variables}
    env = {name: value for name, value in env.items() if value is not None}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=package.parent, env=env, capture_output=True, text=True, check=False
    )  # python -c looks for modules in the working directory first
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.fixture
def package(tmp_path) -> Path:
    """A copy of the package, with PROBE among its kernels."""
    copy = tmp_path / "site" / "caustic_cli"
    shutil.copytree(cache.PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "optics" / "kernels" / "probe.py").write_text(PROBE)
    return copy


def test_an_edit_of_another_file_is_noticed(package, tmp_path):
    """Even one that leaves the file's size and time stamp as they were."""
    kept = str(tmp_path / "kept")
    assert run(RUN, package, NUMBA_CACHE_DIR=kept) == ["1.0", "0", "1"]
    assert run(RUN, package, NUMBA_CACHE_DIR=kept) == ["1.0", "1", "0"]
    limits = package / "optics" / "tolerances.py"
    before, text = limits.stat(), limits.read_text()
    assert "CRITICAL = 1e-16" in text
    limits.write_text(text.replace("CRITICAL = 1e-16", "CRITICAL = 1e+16"))
    os.utime(limits, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert limits.stat().st_size == before.st_size
    assert run(RUN, package, NUMBA_CACHE_DIR=kept) == ["0.0", "0", "1"]
    assert len(list(Path(kept).glob(f"{cache.PREFIX}*"))) == 2


def test_installations_of_the_same_sources_share_what_is_kept(package, tmp_path):
    """Wherever and whenever they were installed."""
    kept, other = str(tmp_path / "kept"), tmp_path / "other" / "caustic_cli"
    assert run(RUN, package, NUMBA_CACHE_DIR=kept) == ["1.0", "0", "1"]
    shutil.copytree(package, other)
    os.utime(other / "optics" / "kernels" / "probe.py", (1e9, 1e9))
    assert run(RUN, other, NUMBA_CACHE_DIR=kept) == ["1.0", "1", "0"]


def test_processes_that_start_together_compile_a_function_once(package, tmp_path):
    """Whichever is first, the other loads what it stored; one that is killed while it compiles does not hold up the others."""
    env = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "NUMBA_CACHE_DIR": str(tmp_path / "kept")}

    def started(code: str) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, "-c", code], cwd=package.parent, env=env, stdout=subprocess.PIPE, text=True)

    dying = started(DIES + RUN)
    dying.communicate()
    assert dying.returncode == -9
    with started(RUN) as one, started(RUN) as other:
        found = [process.communicate()[0].split() for process in (one, other)]
    assert sorted(found) == [["1.0", "0", "1"], ["1.0", "1", "0"]]


def test_damaged_files_are_made_anew(package, tmp_path):
    """An index or a function's code that was cut off, as by a loss of power, costs one compilation and no more."""
    kept = tmp_path / "kept"
    assert run(RUN, package, NUMBA_CACHE_DIR=str(kept)) == ["1.0", "0", "1"]
    for ending in ("nbi", "nbc"):
        (damaged,) = kept.rglob(f"probe.probe-*.{ending}")
        damaged.write_bytes(b"")
        assert run(RUN, package, NUMBA_CACHE_DIR=str(kept)) == ["1.0", "0", "1"]
        assert run(RUN, package, NUMBA_CACHE_DIR=str(kept)) == ["1.0", "1", "0"]


@pytest.mark.parametrize("temporary", [True, False], ids=["temporary files only", "nowhere"])
def test_kernels_run_where_nothing_can_be_written(package, tmp_path, temporary):
    """No home and no cache: below the directory of temporary files; and if not there either, without keeping anything."""
    (tmp_path / "file").touch()
    (tmp_path / "temporary").mkdir()
    for path in (package, *package.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    before = sorted(package.rglob("*"))
    code = RUN if temporary else "import tempfile; tempfile.tempdir = '/proc/nonexistent'" + RUN
    nowhere = str(tmp_path / "file" / "cache")  # below a file there is no directory, for whoever asks
    try:
        found = run(
            code,
            package,
            HOME="/proc/nonexistent",
            XDG_CACHE_HOME=None if temporary else nowhere,
            NUMBA_CACHE_DIR=None,
            TMPDIR=str(tmp_path / "temporary"),
        )
    finally:
        for path in (package, *package.rglob("*")):
            path.chmod(0o755)
    assert found == ["1.0", "0", "1"]
    kept = list((tmp_path / "temporary").rglob("*.nbi"))
    assert bool(kept) == temporary
    assert sorted(package.rglob("*")) == before


def test_the_first_that_can_be_written_is_chosen(tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(cache.tempfile, "tempdir", str(temporary))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "asked"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "common"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache.choose() == tmp_path / "asked" / cache.name()
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    assert cache.choose() == tmp_path / "common" / "caustic" / cache.name()
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache.choose() == tmp_path / "home" / ".cache" / "caustic" / cache.name()
    really = cache.writable
    monkeypatch.setattr(cache, "writable", lambda path: "home" not in path.parts and really(path))
    assert cache.choose().parent.parent == temporary
    monkeypatch.setattr(cache, "writable", lambda path: False)
    assert cache.choose() is None


def test_a_temporary_directory_of_others_is_not_trusted(tmp_path):
    """What numba reads there it unpickles."""
    assert cache.private(tmp_path / "new")
    assert cache.private(tmp_path / "new")
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    assert not cache.private(tmp_path / "open")
    (tmp_path / "link").symlink_to(tmp_path / "new")
    assert not cache.private(tmp_path / "link")


def test_every_file_with_a_kernel_counts():
    names = {p.relative_to(cache.PACKAGE).as_posix() for p in cache.sources()}
    assert {
        "optics/kernels/fused.py",
        "optics/kernels/axial_refraction.py",
        "optics/tolerances.py",
        "optics/kernels/laguerre.py",
        "optics/kernels/multigrid.py",
    } <= names


def test_old_directories_of_ours_alone_are_removed(tmp_path):
    def made(name: str, days: float, used: bool = True) -> Path:
        path = tmp_path / name
        path.mkdir()
        (path / "kernel.nbi").touch()
        if used:
            (path / cache.USED).touch()
            os.utime(path / cache.USED, (time.time() - days * 86400.0,) * 2)
        return path

    digits = "0123456789abcdef0123"[: cache.DIGITS]
    own, old = made(cache.PREFIX + digits, 99.0), made(cache.PREFIX + digits[::-1], 31.0)
    others = [
        made(cache.PREFIX + "f" * cache.DIGITS, 29.0),
        made(cache.PREFIX + "e" * cache.DIGITS, 0.0, used=False),
        made("kernels_" + digits, 99.0),
        made(cache.PREFIX + "notes", 99.0),
    ]
    cache.tidy(own)
    assert not old.exists()
    assert own.exists()
    assert all(path.exists() for path in others)
    cache.tidy(tmp_path / "absent" / "directory")


def test_a_kernel_kept_around_a_kept_loop_finds_its_threads(tmp_path):
    """Three processes: one compiles the loop with another kernel, one compiles the kernel around it, one only calls that."""
    other = """
import numpy as np
from caustic_cli.optics.kernels import blocks, pixels
blocks()
assert pixels.total(np.ones((2, 3, 4))).sum() == 24.0
"""
    kernel = """
import torch
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels.surface import FusedSurface
fused = FusedSurface((SplineSpace.uniform(6, 3),) * 2, (5.0, 5.0))
assert fused.coefficients(torch.zeros(6, 6, dtype=torch.float64)).shape == (3, 3, 4, 4)
"""
    for text in (other, kernel, kernel):
        ran = subprocess.run(
            [sys.executable, "-c", text],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            check=False,
            capture_output=True,
            text=True,
        )
        assert ran.returncode == 0, ran.stderr[-2000:]
