"""The brightness of each lenslet's source for a wanted illumination.

Notation
    A_k   image of lenslet k alone, lit as it is in the scene: power per pixel, (pixels,)
    b     brightness of each lenslet's source, counted in what the scene gives it; not negative
    w     the wanted image, of as much power as all lenslets throw on the screen at b = 1

    min over b >= 0 of |A b - w|^2,    gradient g = A^T (A b - w)

Karush, Kuhn and Tucker: b is the solution if and only if g_k = 0 where b_k > 0 and g_k >= 0 where b_k = 0.  The active set is that
of Lawson & Hanson (Solving Least Squares Problems, 1974, ch. 23), by SciPy; on it the least squares are solved again by an
orthogonal factorisation of columns of unit length, with a step of refinement.  Where lenslets throw the same picture the solution
is not unique, and one of them is found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lstsq
from scipy.optimize import nnls

from caustic_cli.errors import CausticError


@dataclass(frozen=True, eq=False)
class Solution:
    """brightness (n,); residual: largest violation of the conditions above over the largest |A_k . w|, columns of unit length;
    error: |A b - w| over |w|."""

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
    # A set with a member at nearly nothing may leave it below: then SciPy's own numbers stand.
    candidates = [found] + ([refined] if (refined >= 0).all() else [])
    best = min(candidates, key=lambda b: _violation(columns, goal, b))
    out = np.zeros(basis.shape[1])
    out[lit] = best * np.linalg.norm(wanted) / length[lit]
    return Solution(out, _violation(columns, goal, best), float(np.linalg.norm(columns @ best - goal)))


def _violation(columns: np.ndarray, goal: np.ndarray, b: np.ndarray) -> float:
    """How far b is from the conditions, over the largest gradient at b = 0."""
    gradient = columns.T @ (columns @ b - goal)
    wrong = np.where(b > 0, np.abs(gradient), np.maximum(0.0, -gradient))
    return float(wrong.max(initial=0.0) / np.abs(columns.T @ goal).max())
