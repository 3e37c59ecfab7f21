"""What tests share: the picture they design for, small designs, a design that ends where it begins, and fewer combinations."""

from collections.abc import Sequence
from itertools import combinations, product
from types import SimpleNamespace

import numpy as np
from PIL import Image

from caustic_cli.config import default_stages
from caustic_cli.inverse import deconvolution, initial_surface
from caustic_cli.kinds import OneSurface, lenslet_array
from caustic_cli.studies import design_report


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


def small_designs(patch, rays: int, report: bool = False) -> None:
    """For tests of what is done with a design: a first surface from 64 source cells across the lens in place of 256, and from 32
    across a lenslet, fewer iterations for the least error, `rays` for the decision, and no report, whose drawing takes longer than
    all the rest, unless asked for.

    patch: pytest's monkeypatch."""
    patch.setattr(default_stages, "LEAST_CELLS", 64)
    patch.setattr(default_stages, "LEAST_CREASED", 64)
    patch.setattr(lenslet_array, "LEAST_CELLS", 32)
    patch.setattr(initial_surface, "FEW_CELLS", 32)
    patch.setattr(deconvolution, "MOST_STEPS", 400)
    patch.setattr(OneSurface, "final_rays", rays)
    if not report:
        patch.setattr(design_report, "write_report", lambda *args: None)


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
