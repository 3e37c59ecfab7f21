"""Text of two columns of numbers: a header line is optional; columns are separated by commas, semicolons or blanks; # begins a
comment."""

from __future__ import annotations

import re
from collections.abc import Iterator

from caustic_cli.errors import InputError


def rows_of(data: bytes, where: str, accepted: str, first: str, most: int) -> Iterator[tuple[float, float, str]]:
    """The rows of a file, each with what names its line.

    Args:
        accepted: what would be; first: what the first column holds, in the plural; most: rows.

    Raises:
        InputError: naming `where` and the line.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: is not text; {accepted}") from error
    if "\0" in text:
        raise InputError(f"{where}: is not text; {accepted}")
    count, named = 0, False
    for k, line in enumerate(text.splitlines(), 1):
        cells = [c for c in re.split(r"[,;\s]+", line.partition("#")[0].strip(), maxsplit=2) if c]
        values = [number(c) for c in cells]
        if not any((count, named)) and all(v is None for v in values):
            named = bool(cells)
        elif cells:
            at = f"{where}: line {k} is {line.strip()!r}"
            if len(values) != 2 or values[0] is None or values[1] is None:
                raise InputError(f"{at}; {accepted}")
            yield values[0], values[1], at
            count += 1
            if count > most:
                raise InputError(f"{where}: has more than {most:,} {first}; {accepted}")


def number(cell: str) -> float | None:
    """A number, None of other text."""
    try:
        return float(cell)
    except ValueError:
        return None
