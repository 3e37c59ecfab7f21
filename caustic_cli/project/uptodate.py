"""Incremental work: outputs with unchanged inputs and options are kept, and only their time stamps are updated.

The hashes of the inputs of a design are stored in its checkpoint and, until there is one, in the RECORD of the project, which holds
those of other outputs.  Outputs are touched, checkpoint first, so that make finds them newer than their prerequisites.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.config import settings
from caustic_cli.config.settings import Settings
from caustic_cli.errors import CausticError, InputError
from caustic_cli.io.files import read_bytes, refuse_foreign, sha256_of, write_bytes
from caustic_cli.io.heightmaps import beside
from caustic_cli.io.picture import Picture
from caustic_cli.project import attachments
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.project import CHECKPOINT, FARTHER, MADE, RENDER, WAVE, Project, is_project
from caustic_cli.schema.table import options_of

RECORD = ".outputs.json"
#: Entry of the design itself.
BEGUN = "design"
#: Largest record read, bytes; a larger file is not a record of this program.
MOST_RECORDED = 1 << 24
#: Settings of a single run that name files.
FILES = tuple(row.path for row in options_of("render") if row.file)


def digest(full: Settings, picture: Picture) -> str:
    """Hash of complete settings, the picture and the files they refer to, and the lens that the design starts from."""
    found = hashlib.sha256(f"{__version__}\n{settings.dump(full)}".encode())
    found.update(f"{picture.values.shape}{picture.values.dtype}{picture.encoding}".encode())
    found.update(np.ascontiguousarray(picture.values).tobytes())
    for file in attachments.of(full):
        found.update(hashlib.sha256(file.data).digest())
    start = Path(full.design.start)
    named = full.design.start in ("transport", "offset")  # whatever the directory holds of these names
    if not named and is_project(start):
        found.update(sha256_of(start / CHECKPOINT).encode())
    elif not named and start.is_file():
        found.update(f"{sha256_of(start)}{sha256_of(beside(start))}".encode())  # and the JSON of a height map
    return found.hexdigest()


def inputs(project: Project) -> dict[str, str]:
    """Digests stored in a checkpoint: `asked`, of the user's input, and `settings`, of the complete settings."""
    return {"asked": project.asked, "settings": digest(project.settings, project.picture)}


def asked_of(project: Project, checkpoint: Checkpoint) -> str:
    """Digest of the user's input of a project, "" if the project has been edited since."""
    before = checkpoint.inputs
    return before.get("asked", "") if inputs(project)["settings"] == before.get("settings") else ""


def same_design(path: Path, asked: str) -> tuple[Project, Checkpoint] | None:
    """Project and checkpoint at `path`, if they have the same input digest `asked`; else None."""
    if not is_project(path) or not (path / CHECKPOINT).exists():
        return None
    try:
        project = Project.open(path)
        checkpoint = project.load()
    except InputError:  # damaged: reported when the directory is to be used
        return None
    return (project, checkpoint) if asked == asked_of(project, checkpoint) else None


def record_begun(project: Project, path: Path) -> None:
    """Record the inputs of a design in its directory, so that the same command is recognised before the first checkpoint."""
    _write_records(path / RECORD, {BEGUN: {"asked": project.asked, "settings": _undesigned(project)}})


def forget_begun(path: Path) -> None:
    """Remove this entry from the record of a project directory, whose checkpoint holds the inputs from now on."""
    record = _records(path / RECORD)
    if BEGUN not in record:
        return
    del record[BEGUN]
    with contextlib.suppress(CausticError, OSError):  # what remains is not read beside a checkpoint
        if record:
            write_bytes(path / RECORD, json.dumps(record, indent=1).encode())
        else:
            (path / RECORD).unlink()


def is_record(path: Path) -> bool:
    """Whether a file is the record of a design."""
    return path.name == RECORD and BEGUN in _records(path)


def begun(project: Project) -> str:
    """Digest of the user's input of a project without a checkpoint, "" if it has one, or has been edited since its creation."""
    if (project.path / CHECKPOINT).exists():
        return ""
    record = _records(project.path / RECORD).get(BEGUN)
    if not isinstance(record, dict) or record.get("settings") != _undesigned(project):
        return ""
    return str(record.get("asked", ""))


def is_begun(path: Path, asked: str) -> bool:
    """Whether the design of this input digest at `path` was interrupted before its first checkpoint."""
    try:
        return is_project(path) and asked == begun(Project.open(path))
    except InputError:  # damaged: reported when the directory is to be used
        return False


def _undesigned(project: Project) -> str:
    """Hash of a project's settings and files without the refractive index that was designed, a file that settings name."""
    full = project.settings
    if full.lens.gradient == "free":
        full = full.changed(lens=full.lens.without("index_file"))
    return digest(full, project.picture)


def finished(project: Project, checkpoint: Checkpoint) -> dict | None:
    """Figures of a finished design with complete outputs, which are touched; None if it is unfinished or an output is missing."""
    waves = checkpoint.results.get("wave_relative_rms") is not None
    without = {name for name, there in ((WAVE, waves), (FARTHER, project.second is not None)) if not there}
    files = [project.path / name for name in MADE if name not in without]
    if not checkpoint.results or not all(p.exists() for p in files):
        return None
    _touch(files)
    return checkpoint.results | made_by(project, waves)


def made_by(project: Project, waves: bool) -> dict[str, str]:
    """Paths of the project and its images for the figures of a design; waves: with a wave image."""
    wave_image = {"wave_image": str(project.path / WAVE)} if waves else {}
    return {"image": str(project.path / RENDER), **wave_image, "project": str(project.path)}


def image_provenance(project: Project, heights: Tensor, figures: dict, asked: Mapping[str, object] | None = None) -> dict[str, str]:
    """Text entries of the PNG of a lens: `of`, a hash of settings, control heights (n, m) and options, and its estimated
    `noise`."""
    how = {name: str(value) for name, value in sorted((asked or {}).items())}
    found = hashlib.sha256(f"{inputs(project)['settings']}\n{json.dumps(how)}\n".encode())
    found.update(np.ascontiguousarray(heights.detach().double().cpu().numpy()).tobytes())
    return {"of": found.hexdigest(), "noise": f"{figures.get('error_estimate') or 0.0:.3g}"}


class Outputs:
    """Outputs of a command for a project, and the record of their inputs.

    Args:
        project: the project; command: name of the command; options: parameters that determine the result, by name.
        paths: the files written.
    """

    def __init__(self, project: Project, command: str, options: dict, paths: Iterable[Path | None]):
        self.record, self.paths = project.path / RECORD, [p for p in paths if p is not None]
        given = {k: str(v) for k, v in sorted(options.items())}
        inputs = [digest(project.settings, project.picture), sha256_of(project.path / CHECKPOINT)]
        inputs += [sha256_of(Path(options[name])) for name in FILES if options.get(name)]
        self.asked = hashlib.sha256(json.dumps([command, given, inputs]).encode()).hexdigest()
        self.key = " ".join(map(os.path.realpath, self.paths))

    def found(self) -> dict | None:
        """Figures of an earlier run with the same inputs if all its files are unchanged; these are touched."""
        record = _records(self.record).get(self.key)
        if not isinstance(record, dict) or record.get("asked") != self.asked or not isinstance(record.get("figures"), dict):
            return None
        if record.get("files") != [sha256_of(p) for p in self.paths]:
            return None
        _touch(self.paths)
        return record["figures"]

    def refuse_foreign(self, force: bool) -> None:
        """Refuse before work begins if a file cannot be written, or was made by another program according to its mark and the
        record (a CSV has no mark).

        Raises:
            InputError: as of `io.files.refuse_foreign`.
        """
        entries = [entry.get("files") for entry in _records(self.record).values() if isinstance(entry, dict)]
        ours = {found for files in entries if isinstance(files, list) for found in files if found and isinstance(found, str)}
        for path in self.paths:
            refuse_foreign(path, force or sha256_of(path) in ours)

    def keep(self, figures: dict) -> None:
        """Record the outputs and their figures."""
        entry = {"asked": self.asked, "files": [sha256_of(p) for p in self.paths], "figures": figures}
        with contextlib.suppress(CausticError):  # a read-only project has no record; the outputs exist
            _write_records(self.record, {self.key: entry})


def _records(path: Path) -> dict:
    try:
        record = json.loads(read_bytes(path, MOST_RECORDED, "").decode())
    except (ValueError, RecursionError):  # InputError is a ValueError
        return {}
    return record if isinstance(record, dict) else {}


def _write_records(path: Path, entries: dict) -> None:
    """Add entries to a record, or replace them."""
    write_bytes(path, json.dumps(_records(path) | entries, indent=1).encode())


def _touch(paths: Iterable[Path]) -> None:
    for path in paths:
        with contextlib.suppress(OSError):  # read-only: make runs the command again
            os.utime(path)
