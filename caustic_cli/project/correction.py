"""What is known of the errors of a part, in a project that was corrected for them: corrections.npz.

    deviation   (n, m) float64, mm: control heights of the part as it is made, less those that were sent to be made
    designed    (n, m) float64, mm: control heights of the lens that gives the picture without errors
    history     text, JSON: the figures of each correction, the first one first

The lens of such a project is the one to be made: its picture is right once the deviation is added to it.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io.arrays import open_npz
from caustic_cli.io.files import naming, write_bytes

CORRECTIONS = "corrections.npz"
ACCEPTED = "a file written with a corrected design is needed"


@dataclass(frozen=True, eq=False)
class Correction:
    """The contents of the file, see the module."""

    deviation: Tensor
    designed: Tensor
    history: tuple[dict[str, Any], ...]


def refuse_corrected(project: Path) -> None:
    """Refuse a project whose lens is no longer that of its design.

    Raises:
        InputError: it was corrected.
    """
    if (project / CORRECTIONS).exists():
        raise InputError(
            f"{project}: was corrected for the errors of a part, which designing on would undo; resume the design that it"
            " comes from"
        )


def read(project: Path | None, shape: tuple[int, ...]) -> Correction | None:
    """That of a project directory, None if it has none; shape: of its control net.

    Raises:
        InputError: it is damaged, or of another net.
    """
    if project is None or not (path := project / CORRECTIONS).exists():
        return None
    with open_npz(path, ACCEPTED) as archive:
        nets = [torch.from_numpy(archive.reals(name, *shape)) for name in ("deviation", "designed")]
        history = archive.text("history")
    with naming(path):
        try:
            rounds = json.loads(history)
        except ValueError as error:
            raise InputError(f"history must be JSON; {ACCEPTED}") from error
        if not (isinstance(rounds, list) and all(isinstance(one, dict) for one in rounds)):
            raise InputError(f"history must be a list of figures; {ACCEPTED}")
    return Correction(nets[0], nets[1], tuple(rounds))


def write(project: Path, correction: Correction) -> None:
    """Write it to a project directory."""
    held = io.BytesIO()
    nets = {name: getattr(correction, name).detach().double().cpu().numpy() for name in ("deviation", "designed")}
    np.savez_compressed(held, history=np.array(json.dumps(correction.history)), **nets)  # type: ignore[arg-type]
    write_bytes(project / CORRECTIONS, held.getvalue())
