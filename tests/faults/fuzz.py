"""Damages valid files in thousands of ways and gives them to the program's readers, each case in bounded time and memory.

    python tests/faults/fuzz.py --cases 4000 --seed 1                 every kind of file in turn
    python tests/faults/fuzz.py --cases 1 --first 1234 --seed 1       one of these cases again, its file kept in --keep DIR

A reader may return, or refuse in one line (CausticError), and say nothing else on stderr.  Whatever else it does is printed:
another exception with its traceback, more than SECONDS, more than DATA bytes beyond what the process had, or a crash.  A case is
made of its number and the seed alone, and run by a forked process of its own.  Exit status: 1 if something was found.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import os
import random
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import torch
from PIL import Image
from rayfiles import cone_of, lighttools, tm25, zemax
from test_export import make

from caustic_cli.config.settings import dump
from caustic_cli.errors import CausticError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.step import write_step
from caustic_cli.inverse.designer import State
from caustic_cli.io.archive import open_archive
from caustic_cli.io.picture import read_picture
from caustic_cli.io.surfaces import read_surface
from caustic_cli.project import attachments, checkpoint
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project

#: Bounds of a case: seconds of wall clock, and bytes of memory.
SECONDS, DATA = 20, 2 << 30
#: What stands in place of a number in a text, and of some bytes in a binary file.
NUMBERS = (
    *("0", "-1", "1", "2", "-0.0", "nan", "inf", "-inf", "1e308", "1e30", "1e-320", "1e99999", "-1e9", "", "1.2.3", "0x1f", "1_0"),
    *("9" * 19, "9" * 5000, "4294967296", "65536", "1000000000", "9223372036854775807", "-9223372036854775808", "true", "'", '"'),
)
WORDS = (0, 1, 2, 3, 7, 15, 16, 127, 128, 255, 256, 4095, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
PIECES = (
    b"",
    b"\0",
    b"\n",
    b"'",
    b'"',
    b"(",
    b")",
    b"[" * 40,
    b"((" * 20,
    b".a" * 50,
    b",",
    b"#",
    b";",
    b"\xff" * 9,
    b"/*",
    b"%PDF",
    b"PK\3\4",
)


@dataclass(frozen=True)
class Kind:
    """A kind of file: its name, valid ones, what reads it, and how a damaged one is made whole around the damage."""

    name: str
    valid: tuple[bytes, ...]
    read: Callable[[Path], object]
    mended: Callable[[bytes, random.Random], bytes] = lambda data, rng: data
    damaged: Callable[[bytes, random.Random], bytes] | None = None


# how files are damaged


def damaged(data: bytes, rng: random.Random, others: tuple[bytes, ...] = ()) -> bytes:
    """One to four changes: bits, bytes, pieces lost, repeated, moved or taken from other files, numbers that nobody expects."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(CHANGES)(data, rng, others)
    return data


def _bits(data: bytes, rng: random.Random, _) -> bytes:
    out = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 3, 16))):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(data: bytes, rng: random.Random, _) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _span(data: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.choice((1, 4, 30, 500, len(data))))


def _lost(data: bytes, rng: random.Random, _) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _repeated(data: bytes, rng: random.Random, _) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 2, 50 if end - start < 1000 else 1)) + data[end:]


def _spliced(data: bytes, rng: random.Random, others: tuple[bytes, ...]) -> bytes:
    other = rng.choice(others or (data,))
    (start, end), at = _span(other, rng), rng.randrange(len(data) + 1)
    return data[:at] + other[start:end] + data[at + rng.choice((0, end - start)) :]


def _piece(data: bytes, rng: random.Random, _) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(PIECES) + data[at + rng.choice((0, 1, 5)) :]


def _word(data: bytes, rng: random.Random, _) -> bytes:
    size = rng.choice((1, 2, 4, 8))
    word = (rng.choice(WORDS) % (1 << 8 * size)).to_bytes(size, rng.choice(("little", "big")))
    at = rng.randrange(max(1, min(len(data), rng.choice((64, 512, len(data) + 1)))))
    return data[:at] + word + data[at + size :]


def _real(data: bytes, rng: random.Random, _) -> bytes:
    value = rng.choice((np.nan, np.inf, -np.inf, 1e308, 1e-320, -1.0, 0.0, 1e30))
    word = struct.pack("<d", value) if rng.random() < 0.5 else np.float32(min(value, 3e38)).tobytes()
    at = rng.randrange(len(data) + 1) & ~3
    return data[:at] + word + data[at + len(word) :]


def _number(data: bytes, rng: random.Random, _) -> bytes:
    found = list(re.finditer(rb"[0-9][0-9.eE+-]*", data[:200_000]))
    if not found:
        return data
    at = rng.choice(found)
    return data[: at.start()] + rng.choice(NUMBERS).encode() + data[at.end() :]


CHANGES = (_bits, _cut, _lost, _repeated, _spliced, _piece, _word, _real, _number, _number)

# valid files, and what keeps a checksum from hiding the damage behind it


def _saved(write: Callable[[Path], object], name: str = "a") -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def _image(kind: str, mode: str, **options) -> bytes:
    i, j = np.mgrid[0:12, 0:9]
    picture = Image.fromarray(np.stack([20 * i, 25 * j, 10 * (i + j)], -1).astype(np.uint8)).convert(mode)
    out = io.BytesIO()
    picture.save(out, kind, **options)
    return out.getvalue()


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def _with_crcs(data: bytes, rng: random.Random) -> bytes:
    """A PNG whose chunks have the checksums of what they hold, half of the time."""
    if rng.random() < 0.5 or not data.startswith(b"\x89PNG"):
        return data
    out, at = data[:8], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        if at + 12 + length > len(data):
            break
        body = data[at + 4 : at + 8 + length]
        out += struct.pack(">I", length) + body + struct.pack(">I", zlib.crc32(body))
        at += 12 + length
    return out + data[at:]


def _members(data: bytes, rng: random.Random) -> bytes:
    """An archive of which members are damaged and put in again, in one of ZIP's ways of compression; or its own bytes damaged."""
    if rng.random() < 0.3:
        return damaged(data, rng)
    out, ways = io.BytesIO(), (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        chosen = rng.sample(old.namelist(), rng.choice((1, 1, 3)))
        for name in old.namelist():
            held = old.read(name)
            if name in chosen:
                way = rng.randrange(4)
                if way == 0:
                    held = damaged(held, rng)
                elif way == 1:
                    held = _npy(_hostile(rng))
                elif way == 2:
                    held = old.read(rng.choice(old.namelist()))
                else:
                    held = held[:128] + damaged(held[128:], rng)[: len(held) - 128].ljust(len(held) - 128, b"\0")
            if name not in chosen or rng.random() < 0.95:
                new.writestr(name, held, rng.choice(ways) if name in chosen and rng.random() < 0.3 else rng.choice(ways[:2]))
    return damaged(out.getvalue(), rng) if rng.random() < 0.2 else out.getvalue()


def _hostile(rng: random.Random) -> np.ndarray:
    """An array of a kind and shape that nobody expects."""
    shape = rng.choice(((), (0,), (1,), (2,), (3,), (0, 3), (1, 3), (2, 2), (3, 3), (7, 2), (1, 1, 3), (2,) * 9, (5, 0, 3)))
    value = rng.choice((0, 1, -1, 2**62, np.nan, np.inf, 1e308, -1e308, 1e-320, 5.5, "x", "9" * 200, "plane", True, 1j, b"bytes"))
    array = np.full(shape, value)
    kinds = ("<f2", ">f8", "<i1", ">i8", "<u8", "<f4", "?", "<U9", "S4", "<c16", "<M8[s]")
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return array.astype(rng.choice(kinds)) if rng.random() < 0.4 else array
        except (ValueError, TypeError, OverflowError):
            return array


def _sealed(data: bytes, rng: random.Random) -> bytes:
    """A checkpoint whose image has its own checksum, mostly; else it is refused at once, or as one of earlier versions probed."""
    way = rng.random()
    image = data[checkpoint.SEAL :]
    return checkpoint.seal(image) + image if way < 0.8 else image if way < 0.87 else data


def _checkpoint(lens, folder: Path) -> bytes:
    _, field, heights = lens
    state = State(
        heights,
        1,
        7,
        9,
        {"heights": heights.clone(), "scale": torch.tensor(2.0)},
        {"x": heights.flatten(), "s": torch.ones(3, heights.numel()), "step": torch.tensor(5)},
        [(k, 0, 0.5, 0.9, 0.1 * k) for k in range(9)],
        1.5,
        "",
        heights.clone(),
    )
    path = folder / "checkpoints.h5"
    checkpoint.save(path, Checkpoint(state, field.spaces, {"a": 1}, {"loss": 0.5}, {"asked": "x"}))
    return path.read_bytes()


def kinds(folder: Path) -> list[Kind]:
    """All kinds of files, made in a folder."""
    lens = make(control=(8, 6), size=(10.0, 8.0), relief=0.03)
    half = lens[0].lens.half_size
    checkpoint_bytes = _checkpoint(lens, folder)
    project = folder / "a.caustic"
    project.mkdir()
    (project / "target.png").write_bytes(_image("PNG", "L"))
    full = complete({"target": {"file": "target.png"}}, 1.0)
    toml = dump(full).encode()
    points = dump(
        complete({"target": {"file": "target.png"}, "source": {"type": "point", "position": [[0, 0, -50.0], [1, 2, -60.0]]}}, 1.0)
    )
    bare = b'[source]\ntype = "disc"\nangle = 0.5\n[[design.stages]]\nrays = 100\ncontrol = [5, 5]\n# end\n'
    rays = cone_of(5, 40.0, (1.0, 0.5))
    nm = np.linspace(450.0, 650.0, 5)
    table = [(450.0, 10.0), (550.0, 100.0), (650.0, 20.0)]

    def read_project(path: Path) -> object:
        shutil.copyfile(path, project / "project.toml")
        return Project.open(project).scene()

    def read_heights(path: Path) -> object:
        return read_surface(path.rename(path.with_suffix(".npy")), half)

    def read_image(path: Path) -> object:
        found = read_picture(path, len(path.read_bytes()) % 2 == 0, path.stat().st_size % 3 == 0)
        return found.irradiance(), found.lit

    def read_array(path: Path) -> object:
        return read_image(path.rename(path.with_suffix(".npy")))

    def read_archive(path: Path) -> object:
        return open_archive(path), read_surface(path.rename(path.with_suffix(".npz")), half)

    def read_rays(path: Path) -> object:
        found = attachments.attached({"source": {"file": str(path.rename(path.with_suffix(".ray")))}})["source"]["file"].content
        return found.focus, found.nearest, found.spread

    def read_intensity(path: Path) -> object:
        return attachments.attached({"source": {"intensity": str(path.rename(path.with_suffix(".csv")))}})["source"][
            "intensity"
        ].content.flux(1.0)

    step = _saved(lambda path: write_step(path, *lens))
    return [
        Kind("project.toml", (toml, points.encode(), bare), read_project),
        Kind("checkpoints.h5", (checkpoint_bytes,), checkpoint.load, _sealed),
        Kind("archive.npz", (_saved(lambda p: write_lighttools(p, *lens, (5, 5)), "a.npz"),), read_archive, damaged=_members),
        Kind("heights.npy", (_npy(np.random.default_rng(0).normal(size=(6, 5))), _npy(np.arange(12).reshape(3, 4))), read_heights),
        Kind("picture.npy", (_npy(np.ones((4, 5), np.float32)), _npy(np.ones((3, 4, 5)))), read_array),
        Kind("lens.step", (step, step.replace(b"''", b"'a; (b'")), read_surface_step(half)),
        Kind("picture.png", tuple(_image("PNG", m) for m in ("L", "RGB", "RGBA", "P", "I;16", "1", "LA")), read_image, _with_crcs),
        Kind(
            "picture.tif",
            (*(_image("TIFF", "RGB", compression=c) for c in (None, "tiff_lzw", "tiff_deflate", "jpeg")), _image("TIFF", "F")),
            read_image,
        ),
        Kind("picture.jpg", (_image("JPEG", "RGB"), _image("JPEG", "L", progressive=True), _image("JPEG", "CMYK")), read_image),
        Kind("rays.tm25", (tm25(*rays, wavelengths=nm), tm25(*rays, tables=(table,), columns=2, stokes=True)), read_rays),
        Kind("rays.zemax", (zemax(*rays, wavelengths=nm), zemax(*rays)), read_rays),
        Kind("rays.lighttools", (lighttools(*rays, wavelengths=nm), lighttools(*rays, end="\r\n")), read_rays),
        Kind("intensity.csv", (b"angle, value\n0, 1\n10, 0.5 # half\n20;0\n", b"0 1\n90 1\n180 0\n"), read_intensity),
    ]


def read_surface_step(half: tuple[float, float]) -> Callable[[Path], object]:
    """What reads a STEP file for a lens of this size."""
    return lambda path: read_surface(path.rename(path.with_suffix(".step")), half)


# running them


def case(number: int, seed: int, all_kinds: list[Kind]) -> tuple[Kind, bytes]:
    """The file of a case."""
    rng = random.Random(f"{seed}/{number}")
    kind = all_kinds[number % len(all_kinds)]
    data = rng.choice(kind.valid)
    data = kind.damaged(data, rng) if kind.damaged else damaged(data, rng, kind.valid)
    return kind, kind.mended(data, rng)


def outcome(work: Callable[[], object]) -> str:
    """What it says if it returns text, "" if anything else; "refused: " and the one line; or what is wrong with it."""
    with tempfile.TemporaryFile() as said:
        before = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            value = work()
            found = value if isinstance(value, str) else ""
        except CausticError as error:
            found = f"refused: {error}" if "\n" not in str(error) else f"refused in more than one line: {error}"
        except Exception:  # whatever is not a refusal is what is looked for
            found = traceback.format_exc()
        finally:
            os.dup2(before, 2)
            os.close(before)
        said.seek(0)
        words = said.read(2000).decode("utf-8", "replace")
    return f"said on stderr: {words}" if words and (not found or found.startswith("refused: ")) else found


def bounded(work: Callable[[], object], seconds: int = SECONDS, data: int = DATA) -> str:
    """The outcome of work in a process of its own, which ends after so many seconds and has so many bytes more than this one."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        faulthandler.disable()
        try:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)  # which ends the process, whatever library it is in
            signal.alarm(seconds)
            held = int(re.search(r"VmData:\s*(\d+)", Path("/proc/self/status").read_text())[1]) * 1024
            resource.setrlimit(resource.RLIMIT_DATA, (held + data, held + data))
            with open(writing, "w", encoding="utf-8", errors="replace") as answer:
                answer.write(outcome(work))
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(3)
    os.close(writing)
    with open(reading, encoding="utf-8") as answer:
        found = answer.read()
    _, status = os.waitpid(child, 0)
    if status == 0:
        return found
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGALRM:
        return f"took longer than {seconds} s"
    return f"died: signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"died: status {os.WEXITSTATUS(status)}"


def run(numbers: list[int], seed: int, all_kinds: list[Kind], folder: Path) -> Iterator[tuple[int, Kind, bytes, str]]:
    """Every case: its number, the kind of its file, the file, and what came of it."""
    for number in numbers:
        kind, data = case(number, seed, all_kinds)
        place = folder / "case"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        (place / kind.name).write_bytes(data)
        yield number, kind, data, bounded(lambda kind=kind, path=place / kind.name: kind.read(path))


def main(arguments: list[str] | None = None) -> int:
    """Run as a script; the number of findings as exit status, at most 1."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", help="files of this kind only")
    parser.add_argument("--keep", type=Path, help="directory for the files of cases with findings")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    counts: dict[str, list[int]] = {}
    found = 0
    with tempfile.TemporaryDirectory() as name:
        all_kinds = kinds(Path(name))
        numbers = [
            n for n in range(given.first, given.first + given.cases) if given.kind in (None, all_kinds[n % len(all_kinds)].name)
        ]
        for number, kind, data, what in run(numbers, given.seed, all_kinds, Path(name)):
            ending = 0 if not what else 1 if what.startswith("refused: ") else 2
            counts.setdefault(kind.name, [0, 0, 0])[ending] += 1
            if ending == 2:
                found += 1
                print(f"case {number} of seed {given.seed}, {kind.name}: {what}", flush=True)
                if given.keep:
                    given.keep.mkdir(parents=True, exist_ok=True)
                    (given.keep / f"{given.seed}-{number}-{kind.name}").write_bytes(data)
    for name, (read, refused, wrong) in counts.items():
        print(f"{name:<16} {read:6d} read {refused:6d} refused {wrong:6d} otherwise")
    return min(found, 1)


if __name__ == "__main__":
    sys.exit(main())
