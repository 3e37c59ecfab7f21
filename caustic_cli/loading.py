"""Modules of capabilities that few commands need, loaded when they are first used rather than by every import; and the end of a
process, which does not take them down."""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import threading
from importlib import import_module
from typing import Any, NoReturn


class OnDemand:
    """In place of a module: loads it when one of its names is asked for."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self._name), attribute)

    def _load(self) -> None:
        with contextlib.suppress(Exception):  # which its first use raises again
            import_module(self._name)


def load_behind(module: OnDemand) -> None:
    """Load a module that is going to be used, in another thread."""
    threading.Thread(target=module._load, name="loading").start()


def leave(status: int) -> NoReturn:
    """End this process after its exit functions, without taking down the libraries, which costs a design 1 s, and in which one of
    three processes of torchrun aborted in two of eight runs with many designs."""
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
