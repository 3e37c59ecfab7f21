"""A hundred cases of `fuzz.py`, the same every time, and that it would find what it looks for."""

import os
import time
import warnings

import fuzz
import numpy as np
import pytest

from caustic_cli.errors import InputError


def refuse(words):
    raise InputError(words)


def test_readers_read_or_refuse(capfd):
    """Of every kind of file some are read and some refused, and nothing else happens."""
    assert fuzz.main(["--cases", "104", "--seed", "3"]) == 0, capfd.readouterr().out
    rows = [line.split() for line in capfd.readouterr().out.splitlines()]
    assert len(rows) == 13 and all(row[5] == "0" for row in rows)
    assert sum(int(row[1]) for row in rows) > 10 and sum(int(row[3]) for row in rows) > 40


@pytest.mark.parametrize(
    ("work", "found"),
    [
        (lambda: None, ""),
        (lambda: refuse("a.png: is none"), "refused: a.png: is none"),
        (lambda: refuse("two\nlines"), "refused in more than one line"),
        (lambda: 1 / 0, "ZeroDivisionError"),
        (lambda: np.ones(3 * fuzz.DATA // 16), "MemoryError"),
        (lambda: time.sleep(9), "took longer than 2 s"),
        (lambda: os.kill(os.getpid(), 11), "died: signal 11"),
        (lambda: os.write(2, b"a library's remark") and None, "said on stderr: a library's remark"),
    ],
)
def test_what_else_happens_is_found(work, found):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # from Python 3.12 on, forking a process with threads
        outcome = fuzz.bounded(work, seconds=2)
    assert found in outcome and (found or not outcome)
