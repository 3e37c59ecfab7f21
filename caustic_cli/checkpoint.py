"""checkpoints.h5: the lens as designed so far and everything needed to go on (HDF5).

    /lens/heights             (n, m) float64, mm; attributes degree (2,)
    /lens/knots_u, knots_v    knot vectors on [0, 1]
    /start                    (n_0, m_0) float64, mm: the heights it began from, on the first stage's net
    /state                    attributes stage, iteration, total, seconds, reason
    /state/parameters/*, /state/optimizer/*   tensors by name
    /history                  (iterations, 5): iteration, stage, loss (eq. 5.2.1), on_screen, seconds
    attributes                format_version, created_by, provenance (JSON), results (JSON)

A file whose writer was killed cannot be read, so a checkpoint is never updated in place: it is written beside the old
one and renamed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import torch

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.files import atomic_path
from caustic_cli.inverse.designer import State
from caustic_cli.optics.bspline import SplineSpace

FORMAT_VERSION = 1
HISTORY = ("iteration", "stage", "loss", "on_screen", "seconds")


@dataclass(frozen=True)
class Checkpoint:
    """A design's state, the spline spaces of its heights, where it came from and, once finished, its figures."""

    state: State
    spaces: tuple[SplineSpace, SplineSpace]
    provenance: dict
    results: dict


class _Newer(InputError):
    """A checkpoint of a later version."""


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint atomically."""
    state, spaces = checkpoint.state, checkpoint.spaces
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as f:
        f.attrs["format_version"] = FORMAT_VERSION
        f.attrs["created_by"] = f"caustic {__version__}"
        f.attrs["provenance"] = json.dumps(checkpoint.provenance, sort_keys=True)
        f.attrs["results"] = json.dumps(checkpoint.results, sort_keys=True)
        f["lens/heights"] = state.heights.cpu().numpy()
        f["lens"].attrs["degree"] = [s.degree for s in spaces]
        f["lens/knots_u"], f["lens/knots_v"] = (s.knots.numpy() for s in spaces)
        if state.start is not None:
            f["start"] = state.start.cpu().numpy()
        group = f.create_group("state")
        for name in ("stage", "iteration", "total", "seconds", "reason"):
            group.attrs[name] = getattr(state, name)
        for name in ("parameters", "optimizer"):
            part = group.create_group(name)
            for key, value in getattr(state, name).items():
                part[key] = value.detach().cpu().numpy()
        f["history"] = np.array(state.history, dtype=np.float64).reshape(-1, len(HISTORY))
        f["history"].attrs["columns"] = ",".join(HISTORY)


def load(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        InputError: it is missing, damaged, or of a newer version.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; a project with a designed lens is needed (caustic design makes one)")
    try:
        with h5py.File(path, "r") as f:
            version = int(f.attrs["format_version"])
            if version > FORMAT_VERSION:
                raise _Newer(f"{path}: has format version {version}; this caustic {__version__} reads up to {FORMAT_VERSION}")
            rows = f["history"][()]
            if rows.ndim != 2 or rows.shape[1] != len(HISTORY):
                raise ValueError("history")
            group = f["state"]
            state = State(
                torch.from_numpy(f["lens/heights"][()]),
                **{k: int(group.attrs[k]) for k in ("stage", "iteration", "total")},
                **{name: {k: torch.from_numpy(np.asarray(v[()])) for k, v in group[name].items()}
                   for name in ("parameters", "optimizer")},
                history=[(int(r[0]), int(r[1]), *map(float, r[2:])) for r in rows],
                seconds=float(group.attrs["seconds"]), reason=str(group.attrs["reason"]),
                start=torch.from_numpy(f["start"][()]) if "start" in f else None)
            spaces = tuple(SplineSpace(int(p), torch.from_numpy(f[f"lens/knots_{axis}"][()]))
                           for p, axis in zip(f["lens"].attrs["degree"], "uv", strict=True))
            checkpoint = Checkpoint(state, spaces, json.loads(f.attrs["provenance"]), json.loads(f.attrs["results"]))
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        if isinstance(error, _Newer):
            raise
        raise InputError(f"{path}: is damaged or not a caustic checkpoint ({type(error).__name__});"
                         " a whole checkpoints.h5 is needed") from error
    if tuple(state.heights.shape) != (spaces[0].n, spaces[1].n) or not bool(torch.isfinite(state.heights).all()):
        raise InputError(f"{path}: is damaged (its heights do not fit its knots); a whole checkpoints.h5 is needed")
    return checkpoint
