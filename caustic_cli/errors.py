"""What can go wrong, as full sentences: what, where, and what would be accepted.

Only the command line turns these into exit codes; every other module raises them.  A setting that a sentence speaks of is named by
its path in `config.table`, between marks: ⟨lens.size⟩, or ⟨mag⟩ of a parameter.  `plain`, and so str() of an error, says it as
project.toml and the library do, [lens] size and mag; the command line says the option by which it was given.  What a sentence
advises to set has a plus, ⟨+lens.size⟩, and the command line says its option whether it was given or not.
"""

import difflib
import re
from collections.abc import Iterable

#: A marked path.
MARK = re.compile(r"⟨(\+?[a-z_.]+)⟩")
#: Sections that are lists of tables in project.toml, and what they are called there.
LISTS = {"design.stages": "[[design.stages]]", "source.also": "[[source]]", "element": "[[element]]"}

#: How torch says that memory is short: on a CPU (its allocator, a failed mmap) and on a CUDA device.
OUT_OF_MEMORY = ("out of memory", "not enough memory", "can't allocate memory", "Cannot allocate memory")


def plain_name(path: str) -> str:
    """A path as project.toml says it: [lens] size; mag of a parameter without a section."""
    section, _, key = path.removeprefix("+").rpartition(".")
    return f"{LISTS.get(section, f'[{section}]')} {key}" if section else key


def plain(text: str) -> str:
    """A text without its marks."""
    return MARK.sub(lambda found: plain_name(found[1]), text)


def near(name: str, known: Iterable[str]) -> str:
    """What a name that is not known may have been meant for."""
    close = difflib.get_close_matches(name, known, 1, 0.5)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"


class CausticError(Exception):
    """Something this program could not do; the message is one line for the user (exit status 1).

    Within an f-string it keeps its marks, for another error's message.
    """

    def __str__(self) -> str:
        return plain(super().__str__())

    def __format__(self, spec: str) -> str:
        return format(super().__str__(), spec)


class InputError(CausticError, ValueError):
    """Bad usage or bad input: the user can put it right (exit status 2)."""


def no_project(path: object) -> InputError:
    """What to raise where a project was to be."""
    return InputError(f"{path}: is not a caustic project; a directory with a project.toml is needed (caustic design makes one)")


class Interrupted(CausticError):
    """A signal asked the program to stop; the last state is on disk.

    Attributes:
        status: the exit status to leave with (130 for SIGINT, 143 for SIGTERM).
    """

    def __init__(self, message: str, status: int):
        super().__init__(message)
        self.status = status


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out: NumPy's MemoryError, or one of torch's."""
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(s in str(error) for s in OUT_OF_MEMORY))
