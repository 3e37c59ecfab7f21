"""Questions with tables and plots: figures of merit, gradient images, accuracy against time.

Matplotlib, which draws them, wants a directory for its list of fonts, and does not start where it can write none; here it goes
without, and writes none.  What it has to say about that, and about a list it makes, is no result and no error.
"""

import logging
import os
import tempfile
from pathlib import Path
from unittest import mock

#: Directories in which nobody creates a file, of Linux and of other Unix systems.
UNWRITABLE = ("/proc/self", "/dev/fd")


def _without_directory() -> None:
    """Load matplotlib for a directory that it takes to be writable; that it can keep no list there is only a warning to it."""
    os.environ["MPLCONFIGDIR"] = next((d for d in UNWRITABLE if Path(d).is_dir()), os.curdir)
    with mock.patch("os.access", return_value=True):
        import matplotlib.font_manager  # noqa: F401, PLC0415 - the list of fonts is sought here and now


logging.getLogger("matplotlib").setLevel(logging.ERROR)
try:
    tempfile.gettempdir()
except FileNotFoundError:
    _without_directory()
