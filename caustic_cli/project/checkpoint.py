"""checkpoints.h5: the current lens of a design and the state needed to resume it (HDF5).

    /lens/heights             (n, m) float64, mm, or (2, n, m) of entrance and exit; attributes degree (2,)
    /lens/knots_u, knots_v    knot vectors on [0, 1]
    /start                    (n_0, m_0) float64, mm: initial heights, on the control net of the first stage
    /unrounded                of the same shape, mm: the same without the limit of the radius, if there is one;
                              nets of more than a million heights are compressed (`packing`), with an attribute shape, when the
                              design is finished; start and unrounded as differences to heights if the shapes are equal
    /state                    attributes stage, iteration, total, seconds, reason
    /state/parameters/*, /state/optimizer/*   tensors by name
    /history                  (iterations, 5): iteration, stage, loss (eq. 5.2.1), on_screen, seconds
    /accuracy                 (rows, 4): iteration, seconds, processor seconds, error by independent light
    attributes                format_version (1; with packed nets 3, earlier 2), created_by, provenance, results, inputs (JSON)

A file whose writer was killed cannot be read, so a checkpoint is never updated in place: it is written to a temporary file and
renamed.  The HDF5 data follow a user block of SEAL bytes with the sha256 of the data, so that no part of a damaged file is used.
Files of earlier versions have none.

At most MAX_BYTES are read; the checksum is computed in pieces, and datasets are read only if their data are in the file, none
twice.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import h5py
import numpy as np
import torch

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.inverse.accuracy_cost import Row
from caustic_cli.inverse.designer import State
from caustic_cli.io.files import open_regular, write_bytes
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.project.packing import pack, unpack

FORMAT_VERSION = 3
#: Version without packed nets, and that whose packed nets are differences in two's complement.
PLAIN, COMPLEMENT = 1, 2
HEIGHTS = "lens/heights"
#: Nets that a state may have beside its heights.
STARTS = ("start", "unrounded")
HISTORY = ("iteration", "stage", "loss", "on_screen", "seconds")
#: Length of the user block, the least that HDF5 allows; and the signature of an HDF5 file.
SEAL, SIGNATURE = 512, b"\x89HDF\r\n\x1a\n"
SEALED = f"caustic checkpoint, HDF5 from byte {SEAL}, sha256 "
#: Largest checkpoint read: a net of 4096 x 4096 with its 20 pairs of L-BFGS, or the largest network with Adam's moments, is 6.5 GB.
MAX_BYTES = 1 << 33
#: Most heights of a compressed net that is read, a bound of its expansion: three of 4096 x 4096.
MOST_PACKED = 3 << 24
#: Most iterations of a history that is read.
MOST_ITERATIONS = 10_000_000
NEEDED = "a project with a designed lens is needed (caustic design makes one)"
#: Reads every attribute of a file, then says its version.
PROBE = """
import sys, h5py
with h5py.File(sys.argv[1], "r") as f:
    f.visititems(lambda name, item: [*item.attrs.values()] and None)
    print([*f.attrs.values()] and int(f.attrs["format_version"]))
"""


@dataclass(frozen=True)
class Checkpoint:
    """State of a design, spline spaces of its heights, provenance, and figures once it is finished.

    inputs: digests of its inputs, see `uptodate`.
    """

    state: State
    spaces: tuple[SplineSpace, SplineSpace]
    provenance: dict
    results: dict
    inputs: dict = field(default_factory=dict)


def packed(state: State) -> dict[str, bytes | None]:
    """The nets of a state as they are stored, by name; None for those that are not compressed."""
    heights = state.heights.cpu().numpy()
    found = {HEIGHTS: pack(heights)}
    for name in STARTS:
        if (net := getattr(state, name)) is not None:
            found[name] = pack(net.cpu().numpy(), heights if net.shape == state.heights.shape else None)
    return found


def save(path: Path, checkpoint: Checkpoint, nets: Mapping[str, bytes | None] | None = None) -> None:
    """Write a checkpoint atomically; nets: of its state, as of `packed`, if they have been compressed already.

    Raises:
        CausticError: it could not be written; the one before is intact.
    """
    state, spaces = checkpoint.state, checkpoint.spaces
    nets = packed(state) if nets is None else nets
    image = io.BytesIO()  # in memory, so that a full disk is not an error inside HDF5
    with h5py.File(image, "w") as f:
        f.attrs["format_version"] = PLAIN
        f.attrs["created_by"] = f"caustic {__version__}"
        f.attrs["provenance"] = json.dumps(checkpoint.provenance, sort_keys=True)
        f.attrs["results"] = json.dumps(checkpoint.results)
        f.attrs["inputs"] = json.dumps(checkpoint.inputs, sort_keys=True)
        _write_net(f, HEIGHTS, state.heights, nets[HEIGHTS])
        f["lens"].attrs["degree"] = [s.degree for s in spaces]
        f["lens/knots_u"], f["lens/knots_v"] = (s.knots.numpy() for s in spaces)
        for name in STARTS:
            if (net := getattr(state, name)) is not None:
                _write_net(f, name, net, nets[name])
        group = f.create_group("state")
        for name in ("stage", "iteration", "total", "seconds", "reason"):
            group.attrs[name] = getattr(state, name)
        for name in ("parameters", "optimizer"):
            part = group.create_group(name)
            for key, value in getattr(state, name).items():
                part[key] = value.detach().cpu().numpy()
        f["history"] = np.array(state.history, dtype=np.float64).reshape(-1, len(HISTORY))
        f["history"].attrs["columns"] = ",".join(HISTORY)
        f["accuracy"] = np.array(state.accuracy, dtype=np.float64).reshape(-1, len(Row._fields))
        f["accuracy"].attrs["columns"] = ",".join(Row._fields)
    write_bytes(path, seal(image.getbuffer()), image.getbuffer())


def _write_net(f: h5py.File, name: str, net: torch.Tensor, coded: bytes | None) -> None:
    if coded is None:
        f[name] = net.cpu().numpy()
        return
    f[name] = np.frombuffer(coded, np.uint8)
    f[name].attrs["shape"] = net.shape
    f.attrs["format_version"] = FORMAT_VERSION


def seal(image: bytes | memoryview) -> bytes:
    """The user block for an HDF5 image."""
    return _block(hashlib.sha256(image).hexdigest())


def _block(digest: str) -> bytes:
    return f"{SEALED}{digest}\n".encode().ljust(SEAL)


def _sealed(file: BinaryIO) -> bool:
    """Whether a file begins with a user block whose checksum matches the data."""
    file.seek(0)
    head = file.read(SEAL)
    return head.startswith(SEALED.encode()) and head == _block(hashlib.file_digest(file, "sha256").hexdigest())


def _begins(file: BinaryIO) -> tuple[bool, bool]:
    """Whether HDF5 data begin at offset 0, and whether they begin after a user block."""
    found = []
    for at in (0, SEAL):
        file.seek(at)
        found.append(file.read(len(SIGNATURE)) == SIGNATURE)
    return found[0], found[1]


class _Newer(InputError):
    """A checkpoint of a later version."""

    def __init__(self, path: Path, version: int):
        super().__init__(f"{path}: has format version {version}; this caustic {__version__} reads up to {FORMAT_VERSION}")


def _version(path: Path) -> int:
    """Format version of a file without a valid checksum, 0 if it cannot be read; reads all its attributes.

    In a subprocess, since the HDF5 library may crash on a damaged file.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", PROBE, str(path.absolute())], capture_output=True, text=True, timeout=60, check=False
        )
        return int(done.stdout) if done.returncode == 0 else 0
    except (OSError, ValueError, subprocess.SubprocessError):
        return 0


class _Contents:
    """Restricted access to the datasets of a file: none external, compressed or larger than the file, and none read twice."""

    def __init__(self, file: h5py.File):
        self.file, self.unread = file, file.id.get_filesize()

    def read(self, name: str) -> np.ndarray:
        found = self.file[name]
        made = found.id.get_create_plist()
        if made.get_external_count() or made.get_layout() not in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT):
            raise ValueError(f"layout of {name}")
        if found.dtype.kind not in "fiub" or found.nbytes > self.unread:
            raise ValueError(f"size of {name}")
        self.unread -= found.nbytes
        return np.asarray(found[()])

    def tensor(self, name: str) -> torch.Tensor:
        return torch.from_numpy(self.read(name))

    def net(self, name: str, beside: torch.Tensor | None = None) -> torch.Tensor:
        """A control net as written by `save`; beside: the heights to which it may be stored as a difference."""
        values, shape = self.read(name), self.file[name].attrs.get("shape")
        if shape is None:
            return torch.from_numpy(values).double()
        shape = tuple(int(n) for n in shape)
        if values.dtype != np.uint8 or min(shape) < 1 or math.prod(shape) > MOST_PACKED:
            raise ValueError(f"shape of {name}")
        like = None if beside is None or beside.shape != shape else beside.numpy()
        complement = int(self.file.attrs["format_version"]) <= COMPLEMENT
        return torch.from_numpy(unpack(values.tobytes(), shape, like, complement))


def load(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        InputError: it is missing, no regular file, larger than MAX_BYTES, damaged, or of a newer version.
    """
    with open_regular(path, NEEDED, MAX_BYTES) as file:
        _refuse_unsealed(path, file)
        try:
            with h5py.File(file, "r") as f:
                if (version := int(f.attrs["format_version"])) > FORMAT_VERSION:
                    raise _Newer(path, version)
                checkpoint = _read(f)
        except _Newer:
            raise
        except Exception as error:  # a damaged file may cause any exception in h5py
            raise InputError(
                f"{path}: is damaged or not a caustic checkpoint ({error}); an intact checkpoints.h5 is needed"
            ) from error
    if not _is_consistent(checkpoint):
        raise InputError(f"{path}: is damaged (its heights do not match its knots); an intact checkpoints.h5 is needed")
    return checkpoint


def _refuse_unsealed(path: Path, file: BinaryIO) -> None:
    """Refuse a file whose checksum does not match, unless it is of a version without one; errors as of `load`."""
    if _sealed(file):
        return
    at_once, later = _begins(file)
    version = _version(path) if at_once or later else 0
    if version > FORMAT_VERSION:
        raise _Newer(path, version)
    if version == 0 or not at_once:
        raise InputError(
            f"{path}: is damaged (its checksum does not match its content) or not a caustic checkpoint; an intact"
            " checkpoints.h5 is needed"
        )


def _read(f: h5py.File) -> Checkpoint:
    """The contents of a file of a known version; any exception is raised if it is damaged."""
    if f.visititems_links(lambda name, link: None if isinstance(link, h5py.HardLink) else name):
        raise ValueError("link")
    contents = _Contents(f)
    rows = contents.read("history")
    if rows.ndim != 2 or rows.shape[1] != len(HISTORY) or len(rows) > MOST_ITERATIONS:
        raise ValueError("history")
    measured = contents.read("accuracy") if "accuracy" in f else np.empty((0, len(Row._fields)))
    if measured.ndim != 2 or measured.shape[1] != len(Row._fields) or len(measured) > MOST_ITERATIONS:
        raise ValueError("accuracy")
    group = f["state"]
    heights = contents.net(HEIGHTS)
    state = State(
        heights,
        **{k: int(group.attrs[k]) for k in ("stage", "iteration", "total")},
        **{name: {k: contents.tensor(f"state/{name}/{k}") for k in group[name]} for name in ("parameters", "optimizer")},
        history=[(int(r[0]), int(r[1]), *map(float, r[2:])) for r in rows],
        accuracy=[Row(int(r[0]), *map(float, r[1:])) for r in measured],
        seconds=float(group.attrs["seconds"]),
        reason=str(group.attrs["reason"]),
        **{name: contents.net(name, heights) for name in STARTS if name in f},
    )
    if min(state.stage, state.iteration, state.total) < 0 or not 0 <= state.seconds < math.inf:
        raise ValueError("state")
    u, v = (
        SplineSpace(int(p), contents.tensor(f"lens/knots_{axis}")) for p, axis in zip(f["lens"].attrs["degree"], "uv", strict=True)
    )
    texts = f.attrs["provenance"], f.attrs["results"], f.attrs.get("inputs", "{}")
    tables = [json.loads(text) for text in texts]
    if not all(isinstance(table, dict) for table in tables):
        raise ValueError("tables")
    return Checkpoint(state, (u, v), *tables)


def _is_consistent(checkpoint: Checkpoint) -> bool:
    """Whether the heights are finite and match the knots and each other."""
    state, (u, v) = checkpoint.state, checkpoint.spaces
    nets = [z for z in (state.heights, state.start, state.unrounded) if z is not None]
    fits = tuple(state.heights.shape[-2:]) == (u.n, v.n)
    fits &= state.unrounded is None or (state.start is not None and state.start.shape == state.unrounded.shape)
    return fits and all(bool(torch.isfinite(z).all()) for z in nets)
