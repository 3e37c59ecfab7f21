"""Questions with tables and plots: figures of merit, gradient images, accuracy against time.

Matplotlib, which draws them, wants a directory for its list of fonts, and does not start where it can write none; here it goes
without.  What it has to say about that, and about a list it makes, is no result and no error.
"""

import logging
import os
import tempfile
from pathlib import Path
from unittest import mock


def _without_directory() -> None:
    """Load matplotlib for a directory that it takes to be writable; that it keeps no list there is only a warning to it."""
    os.environ["MPLCONFIGDIR"] = str(Path(__file__).parent)
    with mock.patch("os.access", return_value=True):
        import matplotlib.font_manager  # noqa: F401, PLC0415 - the list of fonts is sought here and now


logging.getLogger("matplotlib").setLevel(logging.ERROR)
try:
    tempfile.gettempdir()
except FileNotFoundError:
    _without_directory()
