"""colour-science as an oracle for spectra and colours, imported on demand since that takes seconds."""

import warnings
from types import ModuleType

import numpy as np


def colour_science() -> ModuleType:
    """The package `colour`, without its warnings about what it may do besides, and without its formatting of NumPy's arrays."""
    options = np.get_printoptions()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour  # noqa: PLC0415
        import colour.plotting.datasets.astm_g_173  # noqa: PLC0415
    np.set_printoptions(**options)
    return colour
