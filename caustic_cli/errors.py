"""Exceptions, with messages that are full sentences: what is wrong, where, and what would be accepted.

Only the command line converts them to exit codes; every other module raises them.  Messages refer to settings by their path in
`schema.table` between marks: ⟨lens.size⟩, or ⟨mag⟩ for a parameter.  `plain`, and thus str() of an error, replaces the mark by the
name in project.toml and in the library, [lens] size and mag; the command line by the option with which the setting was given.  A
setting that a message recommends has a plus, ⟨+lens.size⟩, and the command line always names its option.
"""

import difflib
import re
from collections.abc import Iterable, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context

#: A marked path.
MARK = re.compile(r"⟨(\+?[a-z_.]+)⟩")
#: Sections that are arrays of tables in project.toml, and their names there.
LISTS = {"design.stages": "[[design.stages]]", "source.also": "[[source]]", "element": "[[element]]"}

#: Torch's messages for lack of memory: on a CPU (its allocator, a failed mmap) and on a CUDA device.
OUT_OF_MEMORY = ("out of memory", "not enough memory", "can't allocate memory", "Cannot allocate memory")
#: The dynamic linker's message where a shared library does not fit into memory.
UNLOADABLE = "failed to map segment"
#: Longest message, characters.  A longer one repeats what it was given, and only its beginning is kept, which says what is wrong,
#: and its end, which may say what would be accepted.
LONGEST, BEGINNING, END = 600, 300, 160


def plain_name(path: str) -> str:
    """A path as in project.toml: [lens] size, or [[element]] for a list of tables; mag for a parameter without a section."""
    path = path.removeprefix("+")
    if path in LISTS:
        return LISTS[path]
    section, _, key = path.rpartition(".")
    return f"{LISTS.get(section, f'[{section}]')} {key}" if section else key


def plain(text: str) -> str:
    """A text with its marks replaced by plain names."""
    return MARK.sub(lambda found: plain_name(found[1]), text)


def shortened(text: str) -> str:
    """A message without the middle of one that is longer than LONGEST characters."""
    return text if len(text) <= LONGEST else f"{text[:BEGINNING]} ... [{len(text):,} characters] ... {text[-END:]}"


def near(name: str, known: Iterable[str]) -> str:
    """A hint for an unknown name: the closest known name, or all known names."""
    close = difflib.get_close_matches(name, known, 1, 0.5)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"


def alternatives(names: Sequence[str]) -> str:
    """Names as a clause: "a, b or c"."""
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def at_most(value: float, digits: int) -> str:
    """A limit to this number of digits, rounded so that a value of the text does not exceed it."""
    return f"{float(Context(digits, ROUND_FLOOR).create_decimal(repr(float(value)))):.{digits}g}"


def at_least(value: float, digits: int) -> str:
    """The same for a limit from below."""
    return f"{float(Context(digits, ROUND_CEILING).create_decimal(repr(float(value)))):.{digits}g}"


class CausticError(Exception):
    """The program could not complete a task; the message is one line for the user (exit status 1).

    Formatted in an f-string it keeps its marks and its whole length, for the message of another error.
    """

    def __str__(self) -> str:
        return shortened(plain(super().__str__()))

    def __format__(self, spec: str) -> str:
        return format(super().__str__(), spec)


class InputError(CausticError, ValueError):
    """Invalid usage or input, which the user can correct (exit status 2)."""


def no_project(path: object) -> InputError:
    """The error for a path that should be a project."""
    return InputError(f"{path}: is not a caustic project; a directory with a project.toml is needed (caustic design makes one)")


class Interrupted(CausticError):
    """A signal terminated the work; the last state has been saved.

    Attributes:
        status: the exit status (130 for SIGINT, 143 for SIGTERM).
    """

    def __init__(self, message: str, status: int):
        super().__init__(message)
        self.status = status


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error is an out-of-memory error of Python, NumPy or torch."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(s in str(error) for s in OUT_OF_MEMORY))


def is_unloadable(error: BaseException | None) -> bool:
    """Whether an error, or one that caused it, is that a shared library does not fit into memory."""
    return error is not None and (UNLOADABLE in str(error) or is_unloadable(error.__cause__ or error.__context__))
