"""All capabilities with the scenes that they support: the matrix in the documents, and tests, follow from them."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module

from caustic_cli.scene.traits import TRAITS, Capability

#: Where they stand; of a mapping or a list, those of all entries.
PLACES = (
    "scene.elements:BESIDE_ELEMENTS",
    "optics.waves.unsupported:WAVE_IMAGE",
    "optics.waves.unsupported:WAVE_REFINEMENT",
    "optics.waves.unsupported:WAVES_BY_DEFAULT",
    "inverse.gradient_index:INDEX_DESIGN",
    "inverse.reachability:REACHABILITY",
    "inverse.source_limits:LIMITS",
    "inverse.source_image:SOURCE_IMAGES",
    "studies.manufacture:WALL",
    "studies.manufacture:THROW",
    "workflow.outputs:OUTPUTS",
    "studies.gradmap:DERIVATIVE",
    "export.supported:EXPORT",
    "export.supported:MOULD",
    "export.supported:SCRIPT",
)


def capabilities() -> Iterator[Capability]:
    """All of them."""
    for place in PLACES:
        module, _, name = place.partition(":")
        found = getattr(import_module(f"caustic_cli.{module}"), name)
        for one in [found] if isinstance(found, Capability) else found.values() if isinstance(found, dict) else found:
            yield getattr(one, "capability", one)


def matrix() -> str:
    """What is not supported, as a table in Markdown: a row for the capabilities that support the same scenes for the same reasons,
    with the reason behind the traits that have one."""
    alike: dict[str, list[str]] = {}
    for one in capabilities():
        groups: dict[str, list[str]] = {}
        for name in TRAITS:
            if name in one.unsupported:
                groups.setdefault(one.reason(name), []).append(TRAITS[name].words)
        if groups:
            said = "; ".join(", ".join(words) + (f" ({reason})" if reason else "") for reason, words in groups.items())
            alike.setdefault(said, []).append(one.name)
    rows = [f"| {', '.join(names)} | {said} |" for said, names in alike.items()]
    return "\n".join(["| capability | not for |", "| --- | --- |", *rows])


def limits() -> str:
    """The same by what a scene has, as a table in Markdown: a row for what excludes the same capabilities."""
    excluded = {trait: [one.name for one in capabilities() if trait in one.unsupported] for trait in TRAITS}
    alike: dict[tuple[str, ...], list[str]] = {}
    for trait, names in excluded.items():
        if names:
            alike.setdefault(tuple(names), []).append(TRAITS[trait].words)
    rows = [f"| {', '.join(traits)} | {', '.join(names)} |" for names, traits in alike.items()]
    return "\n".join(["| scenes with | are not supported by |", "| --- | --- |", *rows])
