"""Nowhere to keep compiled code, no directory for temporary files: everything runs, and only takes longer."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from test_kernel_cache import RUN, package, run

__all__ = ["package"]


def kept(folder: Path) -> list[Path]:
    """The files of compiled code below a directory."""
    return sorted(p for p in folder.rglob("*") if p.suffix in (".nbi", ".nbc"))


def test_a_directory_that_numba_cannot_use(package, tmp_path):
    """It can be written to, so it is chosen; numba's own directory in it cannot be made."""
    folder = tmp_path / "kept"
    assert run(RUN, package, NUMBA_CACHE_DIR=str(folder)) == ["1.0", "0", "1"]
    (place,) = {p.parent for p in kept(folder)}
    for path in place.iterdir():
        path.unlink()
    place.rmdir()
    place.touch()
    nowhere = {"HOME": "/proc/nonexistent", "XDG_CACHE_HOME": "/proc/nonexistent"}
    for writable in (True, False):
        if not writable:
            beside = package / "optics" / "kernels" / "__pycache__"
            shutil.rmtree(beside, ignore_errors=True)
            beside.touch()
        assert run(RUN, package, NUMBA_CACHE_DIR=str(folder), **nowhere) == ["1.0", "0", "1"]
        assert not kept(tmp_path)  # nor beside the sources, where an edit of another one would go unnoticed


def test_a_full_disk(package, tmp_path):
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"  # writing beyond fails as on a full disk
    for _ in range(2):
        assert run(limit + RUN, package, NUMBA_CACHE_DIR=str(tmp_path / "kept")) == ["1.0", "0", "1"]
    assert run(RUN, package, NUMBA_CACHE_DIR=str(tmp_path / "kept")) == ["1.0", "0", "1"]


DRAW = """
import io, tempfile
tempfile._candidate_tempdir_list = lambda: ["/proc/nonexistent"]
from caustic_cli.studies import report
figure = report.Figure()
figure.add_subplot().set(title="drawn")
figure.savefig(out := io.BytesIO(), format="png")
print(out.getvalue()[1:4].decode())
"""


def test_pictures_are_drawn_where_nothing_can_be_written():
    """Also without a word about matplotlib's list of fonts, and without one in the package."""
    root = Path(__file__).parents[2]
    before = {p for p in (root / "caustic_cli").rglob("*") if p.suffix == ".json"}
    environment = {k: v for k, v in os.environ.items() if k not in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")}
    places = {"HOME": "/proc/nonexistent", "NUMBA_CACHE_DIR": "/proc/nonexistent", "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", DRAW], env=environment | places, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "PNG\n", "")
    assert {p for p in (root / "caustic_cli").rglob("*") if p.suffix == ".json"} == before
