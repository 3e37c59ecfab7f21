"""Brightness of the sources of a lenslet array for a target illumination, by non-negative least squares.

Notation
    A_k   image of lenslet k alone, lit as it is in the scene: power per pixel, (pixels,)
    b     brightness of each lenslet's source, relative to that of the scene; not negative
    w     the target image, scaled to the power on the screen at b = 1

    min over b >= 0 of |A b - w|^2,    gradient g = A^T (A b - w)

Optimality conditions (Karush, Kuhn, Tucker): g_k = 0 where b_k > 0 and g_k >= 0 where b_k = 0.  The active set is found by the
method of Lawson & Hanson (Solving Least Squares Problems, 1974, ch. 23), by SciPy; on it the least-squares problem is solved again
by an orthogonal factorisation of the normalised columns, with one step of iterative refinement.  Where lenslets have the same
picture the solution is not unique.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq
from scipy.optimize import nnls

from caustic_cli.errors import CausticError


@dataclass(frozen=True, eq=False)
class Solution:
    """brightness (n,); residual: largest violation of the optimality conditions over the largest |A_k . w|, for columns of unit
    length; error: |A b - w| / |w|."""

    brightness: np.ndarray
    residual: float
    error: float


def brightness(basis: np.ndarray, wanted: np.ndarray) -> Solution:
    """Non-negative least squares: basis (pixels, n) of images, wanted (pixels,), any unit.

    Columns without light get brightness 0.

    Raises:
        CausticError: no image has light where it is wanted.
    """
    length = np.linalg.norm(basis, axis=0)
    lit = length > 0
    if not (wanted @ basis > 0).any():
        raise CausticError("no image has light where it is wanted, so no brightness comes closer than none")
    columns, goal = basis[:, lit] / length[lit], wanted / np.linalg.norm(wanted)
    found = nnls(columns, goal)[0]
    positive = found > 0
    refined = np.zeros_like(found)
    for _ in range(2):
        refined[positive] += lstsq(columns[:, positive], goal - columns @ refined, lapack_driver="gelsy")[0]
    # With a nearly degenerate active set a refined value may be negative: then the unrefined solution is kept.
    candidates = [found] + ([refined] if (refined >= 0).all() else [])
    best = min(candidates, key=lambda b: _violation(columns, goal, b))
    out = np.zeros(basis.shape[1])
    out[lit] = best * np.linalg.norm(wanted) / length[lit]
    return Solution(out, _violation(columns, goal, best), float(np.linalg.norm(columns @ best - goal)))


def _violation(columns: np.ndarray, goal: np.ndarray, b: np.ndarray) -> float:
    """Largest violation of the optimality conditions at b, over the largest gradient at b = 0."""
    gradient = columns.T @ (columns @ b - goal)
    wrong = np.where(b > 0, np.abs(gradient), np.maximum(0.0, -gradient))
    return float(wrong.max(initial=0.0) / np.abs(columns.T @ goal).max())
