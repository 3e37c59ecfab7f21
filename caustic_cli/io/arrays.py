"""Safe reader of NumPy files, `.npy` and `.npz`: bounded in size, with the header validated before data are read.

A .npy file is "\\x93NUMPY", two bytes of version, the length of the header, the header (a Python dictionary of descr, fortran_order
and shape, as text) and the data.  A .npz archive is a ZIP file of them.  NumPy's own reader is not used: it evaluates the
header as Python, and allocates and decompresses as much as the file declares.

Here a header is parsed by a regular expression, has at most MOST_HEADER bytes, and a numeric or text dtype; an array has at most
MOST_BYTES, all arrays read from an archive MOST_IN_ALL, and its central directory MOST_CONTENTS.  Other members are not read.
"""

from __future__ import annotations

import contextlib
import copy
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.io.files import Piped, naming, open_regular

#: Bytes of a header; NumPy's own readers take 10,000.
MOST_HEADER = 4096
#: Bytes of an array: a picture of 8192 x 8192 in float64, in three colours.
MOST_BYTES = 3 * 8 * 8192 * 8192
#: Bytes of all arrays read of one archive: a net of 4096 x 4096 control points and a picture.
MOST_IN_ALL = 1 << 30
#: Bytes of the central directory of an archive: 20,000 members.
MOST_CONTENTS = 1 << 20
#: Bytes of a file: the points and normals of 50 million samples fit.
MOST_OF_FILE = 1 << 33
#: Axes of an array, digits of its size along one, and characters of a text.
MOST_AXES, MOST_DIGITS, MOST_TEXT = 8, 18, 10_000
#: Bytes decompressed at a time.
PIECE = 1 << 20
MAGIC = b"\x93NUMPY"
#: Exceptions of reading a damaged file: ZIP directory and members, compression, and header.
DAMAGED = (OSError, EOFError, ValueError, TypeError, OverflowError, RuntimeError, zipfile.BadZipFile, zlib.error, struct.error)

_FIELD = re.compile(r"""["'](descr|fortran_order|shape)["']\s*:\s*(?:["']([^"']*)["']|(True|False)|\(([\d\s,L]*)\))\s*,?\s*""")
_KIND = re.compile(r"[<>=|]?[biufcUS]\d{1,9}")


@dataclass(frozen=True)
class Stored:
    """An array in a file, whose header has been read and validated.

    shape, dtype: from the header; unread: remaining byte budget, in a list of one number that arrays of an archive share; accepted:
    description of a valid file for error messages.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    file: BinaryIO
    unread: list[int]
    accepted: str

    def read(self) -> np.ndarray:
        """The array.

        Raises:
            InputError: it exceeds the byte budget, or is truncated or damaged.
        """
        size = math.prod(self.shape) * self.dtype.itemsize
        if size > self.unread[0]:
            raise InputError(f"has {size:,} bytes; at most {self.unread[0]:,} more are read")
        self.unread[0] -= size
        data = bytearray(size)
        view, at = memoryview(data), 0
        with refusing(self.accepted):
            while at < size:
                piece = self.file.read(min(PIECE, size - at))
                if not piece:
                    raise ValueError("cut off")
                view[at : at + len(piece)] = piece
                at += len(piece)
            return np.frombuffer(data, self.dtype).reshape(self.shape, order="F" if self.fortran else "C")

    def read_reals(self) -> np.ndarray:
        """An array of numbers as float64.

        Raises:
            InputError: as of `read`, or it is of text or complex numbers.
        """
        if self.dtype.kind not in "fiub":
            raise InputError(f"has {'text' if self.dtype.kind in 'US' else 'complex numbers'}, not real numbers; {self.accepted}")
        values = self.read()
        with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN; overflow to infinity
            return values.astype(np.float64)


@contextlib.contextmanager
def refusing(accepted: str) -> Iterator[None]:
    """Convert DAMAGED exceptions of the block to InputError; zipfile raises RuntimeError for an encrypted member."""
    try:
        yield
    except DAMAGED as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"is not a readable .npy array, or .npz archive of such ({error}); {accepted}") from error


def _header(file: BinaryIO, size: int, unread: list[int], accepted: str, exact: bool) -> Stored:
    """Read the header of an array at the beginning of a file of `size` bytes; exact: the file must end with the array.

    Raises:
        ValueError: the header is invalid, of another dtype, or declares more data than there are.
    """
    dtype, order, sizes = _described(_header_text(file))
    wanted, there = math.prod(sizes) * dtype.itemsize, size - file.tell()
    if wanted > there or (exact and wanted < there) or not wanted:
        raise ValueError(f"{there:,} bytes of data, where an array of shape {sizes} has {wanted:,}")
    if wanted > MOST_BYTES:
        raise ValueError(f"{wanted:,} bytes of data, where at most {MOST_BYTES:,} are read")
    return Stored(sizes, dtype, order == "True", file, unread, accepted)


def _header_text(file: BinaryIO) -> str:
    """The description of an array at the beginning of a file; errors as of `_header`."""
    start = file.read(8)
    if start[:6] != MAGIC or start[6:7] not in (b"\1", b"\2", b"\3"):
        raise ValueError("no header of a .npy array")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(file.read(width), "little")
    if not 0 < length <= MOST_HEADER:
        raise ValueError(f"a header of {length:,} bytes, where at most {MOST_HEADER:,} are read")
    return file.read(length).decode("latin-1").strip()


def _described(text: str) -> tuple[np.dtype, str, tuple[int, ...]]:
    """Type, order and shape of an array, from its description; errors as of `_header`."""
    fields = text[1:-1].strip()
    found = {m[1]: m for m in _FIELD.finditer(fields)}
    if text[:1] + text[-1:] != "{}" or len(found) != 3 or _FIELD.sub("", fields):
        raise ValueError("a header that cannot be read")
    kind, order, shape = found["descr"][2], found["fortran_order"][3], found["shape"][4]
    if kind is None or order is None or shape is None or not _KIND.fullmatch(kind):
        raise ValueError("an array of neither numbers nor text")
    numbers = [n.strip().rstrip("L") for n in shape.split(",")]
    if len(numbers) > MOST_AXES or any(len(n) > MOST_DIGITS for n in numbers):
        raise ValueError("a shape beyond all bounds")
    return np.dtype(kind), order, tuple(int(n) for n in (numbers if numbers[-1] else numbers[:-1]))


@contextlib.contextmanager
def open_npy(path: Path | Piped, accepted: str) -> Iterator[Stored]:
    """Open a .npy file and read its header; an InputError of the block is prefixed with the file name.

    Raises:
        InputError: there is no such regular file, or it is damaged; `accepted` describes a valid one.
    """
    with open_regular(path, accepted, MOST_OF_FILE) as file, naming(path):
        with refusing(accepted):
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            stored = _header(file, size, [MOST_BYTES], accepted, exact=False)
        yield stored


class _Bounded:
    """A file whose reads are limited to MOST_CONTENTS bytes: zipfile reads the central directory at once, by its declared
    length."""

    def __init__(self, file: BinaryIO):
        self.seek, self.tell, self.seekable, self.close, self._read = file.seek, file.tell, file.seekable, file.close, file.read

    def read(self, size: int = -1) -> bytes:
        data = self._read(MOST_CONTENTS + 1 if size is None or size < 0 else min(size, MOST_CONTENTS + 1))
        if len(data) > MOST_CONTENTS:
            raise ValueError(f"a table of contents of more than {MOST_CONTENTS:,} bytes")
        return data


class Archive:
    """The arrays of a .npz archive by name, each read on demand."""

    def __init__(self, archive: zipfile.ZipFile, accepted: str):
        self.accepted, self._zip, self._unread = accepted, archive, [MOST_IN_ALL]
        self._members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def renamed(self, names: Mapping[str, str]) -> Archive:
        """The arrays with these names, by others: name here -> name there."""
        view = copy.copy(self)
        view._members = {new: self._members[old] for new, old in names.items() if old in self}
        return view

    @contextlib.contextmanager
    def open(self, name: str) -> Iterator[Stored]:
        """Open an array and read its header.

        Raises:
            InputError: there is no such array, or it is damaged, encrypted, or not compressed by deflate.
        """
        if name not in self:
            raise InputError(f"has no {name}; {self.accepted}")
        info = self._members[name]
        with contextlib.ExitStack() as stack:
            with refusing(self.accepted):
                if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
                    raise ValueError(f"{name} is encrypted, or compressed otherwise than by deflate")
                member = stack.enter_context(self._zip.open(info))
                stored = _header(member, info.file_size, self._unread, self.accepted, exact=True)
            yield stored

    def reals(self, name: str, *shape: int | None, most: int | None = None) -> np.ndarray:
        """An array of finite numbers as float64.

        Args:
            shape: its size along each axis, None for any; most: of these.

        Raises:
            InputError: there is no such array, or it has another shape or dtype, or is damaged.
        """
        with self.open(name) as stored:
            _check(name, stored, shape, "fiub", "finite numbers")
            if most is not None and max(stored.shape) > most:
                raise InputError(f"{name} must be of at most {most} along each axis, got shape {stored.shape}")
            values = stored.read_reals()
        if not np.isfinite(values).all():
            raise InputError(f"{name} must be finite numbers")
        return values

    def real(self, name: str) -> float:
        """A finite number."""
        return float(self.reals(name))

    def wholes(self, name: str, count: int) -> tuple[int, ...]:
        """An array of `count` whole numbers."""
        with self.open(name) as stored:
            _check(name, stored, (count,), "iu", "whole numbers")
            return tuple(int(v) for v in stored.read())

    def text(self, name: str, default: str | None = None) -> str:
        """A text of at most MOST_TEXT characters; `default` if it is absent."""
        if default is not None and name not in self:
            return default
        with self.open(name) as stored:
            _check(name, stored, (), "U", "text")
            if stored.dtype.itemsize > 4 * MOST_TEXT:
                raise InputError(f"{name} must be a text of at most {MOST_TEXT} characters")
            raw = stored.read().astype(stored.dtype.newbyteorder("<")).tobytes()
        try:
            return raw.decode("utf-32-le").rstrip("\0")
        except UnicodeDecodeError as error:
            raise InputError(f"{name} must be text") from error


def _check(name: str, stored: Stored, shape: tuple[int | None, ...], kinds: str, what: str) -> None:
    same = len(stored.shape) == len(shape) and all(b in (None, a) for a, b in zip(stored.shape, shape, strict=True))
    if not same or stored.dtype.kind not in kinds:
        form = " x ".join("n" if n is None else str(n) for n in shape)
        raise InputError(f"{name} must be {what}{f' of shape {form}' if form else ''}, got {stored.dtype.name} {stored.shape}")


@contextlib.contextmanager
def open_npz(path: Path, accepted: str) -> Iterator[Archive]:
    """Open a .npz archive; an InputError of the block is prefixed with the file name.

    Raises:
        InputError: there is no such regular file, or it is damaged; `accepted` describes a valid one.
    """
    with open_regular(path, accepted, MOST_OF_FILE) as file, naming(path):
        with refusing(accepted):
            archive = Archive(zipfile.ZipFile(_Bounded(file)), accepted)
        yield archive
