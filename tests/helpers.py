"""What tests share: the picture they design for, a design that ends where it begins, and fewer combinations."""

from collections.abc import Sequence
from itertools import combinations, product
from types import SimpleNamespace

import numpy as np
from PIL import Image

from caustic_cli.scene.sources.base import looked_up


def write_blob(name: str = "blob.png", size: int = 24, centre: tuple[float, float] = (8, 9), width: float = 30.0) -> None:
    """A grey picture with a smooth bright spot: `size` x `size` 8-bit codes, 40 to 240; centre: column and row."""
    y, x = np.mgrid[:size, :size]
    spot = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / width)
    Image.fromarray((40 + 200 * spot).astype(np.uint8)).save(name)


def begun(project, *_) -> SimpleNamespace:
    """In place of `workflow.design._run`: what was begun, without an iteration."""
    figures = {"lost": {}, "image": "", "reason": "", "project": str(project.path)}
    return SimpleNamespace(
        project=project, scene=None, field=None, heights=None, target=None, state=SimpleNamespace(heights=None), figures=figures
    )


def pairwise(*lists: Sequence) -> list[tuple]:
    """Rows with one value of each list, few of them, so that any two values of two lists meet in some row.

    For parameters that may disturb one another in twos, not in threes.  Each row begins with a pair that is still missing and, list
    by list, takes the value that meets most others for the first time: the same rows every time, 12 for four lists of 3, not 81.
    """
    columns = [range(len(one)) for one in lists]
    missing = {((i, a), (j, b)) for (i, one), (j, other) in combinations(enumerate(columns), 2) for a, b in product(one, other)}
    rows: list[tuple] = []
    while missing:
        row = dict(min(missing))
        for k, column in enumerate(columns):
            if k not in row:
                met = [sum(tuple(sorted((own, (k, c)))) in missing for own in row.items()) for c in column]
                row[k] = met.index(max(met))
        missing -= {*combinations(sorted(row.items()), 2)}
        rows.append(tuple(one[row[k]] for k, one in enumerate(lists)))
    return rows


def looked_up_in(profile):
    """A profile (a, b), constant per cell, as the function of u and v that a sampler takes."""
    return lambda u, v: looked_up(profile.numpy(), 2.0 * u - 1.0, 2.0 * v - 1.0)
