"""Modules of capabilities that few commands need, loaded when they are first used rather than by every import."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class OnDemand:
    """In place of a module: loads it when one of its names is asked for."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self._name), attribute)
