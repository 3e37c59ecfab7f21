"""Numerical studies with tables and plots: figures of merit, gradient images, accuracy against computation time.

Matplotlib needs a writable directory for its font cache, and does not start without one; in that case it is loaded here without a
cache.  Its log messages about the cache are suppressed.
"""

import logging
import os
import tempfile
from pathlib import Path
from unittest import mock

#: Directories in which no file can be created, of Linux and of other Unix systems.
UNWRITABLE = ("/proc/self", "/dev/fd")


def _without_directory() -> None:
    """Load matplotlib with a cache directory that it takes to be writable; a failure to write there is only a warning."""
    os.environ["MPLCONFIGDIR"] = next((d for d in UNWRITABLE if Path(d).is_dir()), os.curdir)
    with mock.patch("os.access", return_value=True):
        import matplotlib.font_manager  # noqa: F401, PLC0415 - builds the list of fonts


logging.getLogger("matplotlib").setLevel(logging.ERROR)
try:
    tempfile.gettempdir()
except FileNotFoundError:
    _without_directory()
