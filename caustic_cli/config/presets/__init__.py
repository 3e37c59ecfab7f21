"""Settings for what people make, by name: a TOML file each, whose first comment says what it is for."""

from __future__ import annotations

import difflib
from pathlib import Path

from caustic_cli.errors import InputError

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """All presets, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def path_of(name: str) -> Path:
    """The file of a preset.

    Raises:
        InputError: there is none of that name.
    """
    if name not in names():
        near = difflib.get_close_matches(name, names(), 1, 0.4)
        raise InputError(
            f"⟨preset⟩ must be one of {', '.join(names())}, got {name!r}{f'; did you mean {near[0]}?' if near else ''}"
        )
    return FOLDER / f"{name}.toml"


def rows() -> list[tuple[str, str]]:
    """Name and purpose of every preset."""
    return [(name, _purpose(FOLDER / f"{name}.toml")) for name in names()]


def described() -> list[dict[str, str]]:
    """The presets for JSON: name and purpose."""
    return [{"name": name, "purpose": purpose} for name, purpose in rows()]


def _purpose(path: Path) -> str:
    """The comment that a preset's file begins with."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = lines[: next(k for k, line in enumerate(lines) if not line.startswith("#"))]
    return " ".join(line.lstrip("# ").strip() for line in comment)
