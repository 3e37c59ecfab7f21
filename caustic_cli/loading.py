"""Modules of capabilities that few commands need, loaded when they are first used rather than by every import."""

from __future__ import annotations

import contextlib
import threading
from importlib import import_module
from typing import Any


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
