"""What tests of commands share: the picture they design for, and a design that ends where it begins."""

from types import SimpleNamespace

import numpy as np
from PIL import Image


def write_blob(name: str = "blob.png", size: int = 24, centre: tuple[float, float] = (8, 9), width: float = 30.0) -> None:
    """A grey picture with a smooth bright spot: `size` x `size` 8-bit codes, 40 to 240; centre: column and row."""
    y, x = np.mgrid[:size, :size]
    spot = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / width)
    Image.fromarray((40 + 200 * spot).astype(np.uint8)).save(name)


def begun(project, *_) -> SimpleNamespace:
    """In place of `workflow.design._run`: what was begun, without an iteration."""
    figures = {"lost": {}, "image": "", "reason": "", "project": str(project.path)}
    return SimpleNamespace(
        project=project, scene=None, field=None, target=None, state=SimpleNamespace(heights=None), figures=figures
    )
