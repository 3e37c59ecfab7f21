"""caustic: design of free-form lenses that project a picture as a caustic.

`from caustic_cli import design, render, load, spread, trace` is the library interface (`workflow.library`), loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from caustic_cli.workflow.library import Lens, Render, design, load, render, trace
    from caustic_cli.workflow.processes import spread

__version__ = "0.1.0"
__all__ = ["Lens", "Render", "__version__", "design", "load", "render", "spread", "trace"]


def __getattr__(name: str) -> Any:
    if name == "spread":
        from caustic_cli.workflow import processes  # noqa: PLC0415

        return processes.spread
    if name in __all__:
        from caustic_cli.workflow import library  # noqa: PLC0415

        return getattr(library, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
