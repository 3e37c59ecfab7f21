"""Mirror planes of a lamp and its target, of which a part of the light stands for all of it.

Light that is its own mirror image stays so through surfaces that are theirs: its image is the mean of that of the light on one side
of a plane and of that image mirrored.  A design for such a target traces half of the rays for each plane, and its surfaces are
symmetric.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from caustic_cli.scene.lamp import Goal, Lamp

#: Largest difference of a target from its mirror image, relative to its largest value.
EQUAL = 1e-9


class Mirrors(NamedTuple):
    """Whether the planes x = 0 and y = 0 are mirror planes."""

    x: bool = False
    y: bool = False

    @classmethod
    def of(cls, lamp: Lamp, goal: Goal, target: Tensor) -> Mirrors:
        """Those of a lamp with a target (n_x, n_y); none of a chip whose rays are those of a file."""
        if lamp.chip.rays is not None:
            return cls()
        least = EQUAL * float(target.max())
        return cls(*(goal.shift[k] == 0.0 and float((target - target.flip(k)).abs().max()) <= least for k in (0, 1)))

    def whole(self, part: Tensor) -> Tensor:
        """The mean (.., n, m) of an image, or of control values, and of their mirror images."""
        for axis, mirrored in zip((-2, -1), self, strict=True):
            if mirrored:
                part = 0.5 * (part + part.flip(axis))
        return part
