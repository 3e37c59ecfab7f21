"""Export of a closed ring of panels: the same one N times, or several designs side by side around the axis."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from caustic_cli.errors import InputError, alternatives
from caustic_cli.export import FORMATS, RINGS
from caustic_cli.export.milling import ROTARY, Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.panels import Panels, Side, refuse_number
from caustic_cli.export.part import part_of
from caustic_cli.export.ring import figures, ring_of
from caustic_cli.export.supported import refuse
from caustic_cli.scene import Lens
from caustic_cli.workflow.export import Exporter, at_own_wavelength, exporter_of, file_of, scallops_of


class RingExporter(Exporter):
    """Exports of a ring: `others` are the panels beside the first, of which the other arguments are."""

    others: tuple[Side, ...] = ()

    @classmethod
    def of(cls, first: Exporter, ring: int | Sequence[Path]) -> RingExporter:
        """Of a number of equal panels, or of the projects of the others in their order around the axis.

        Raises:
            InputError: there are too few or too many, a project has no lens, or is on another base.
        """
        refuse_number(ring if isinstance(ring, int) else len(ring) + 1)
        found = cls(first.scene, first.field, first.heights, first.target, first.waves, first.seed, first.most, first.say)
        own = (first.field, first.heights.detach().double().cpu())
        if isinstance(ring, int):
            found.others = (own,) * (ring - 1)
            return found
        known = dict[Path, Side]()
        for path in ring:
            if path not in known:
                panel, _ = exporter_of(path, None, first.say)
                _refuse_other_base(path, panel.scene.lens, first.scene.lens)
                known[path] = (panel.field, panel.heights.detach().double().cpu())
        found.others = tuple(known[path] for path in ring)
        return found

    @property
    def asked(self) -> dict:
        """As of an exporter, and the panels."""
        found = hashlib.sha256()
        for field, heights in self.others:
            found.update(b"".join(space.knots.numpy().tobytes() for space in field.spaces) + heights.numpy().tobytes())
        return super().asked | {"ring": len(self.others) + 1, "panels": found.hexdigest()}

    def write(
        self,
        path: Path,
        format: str,
        script: bool = False,
        mould: bool = False,
        block: float | None = None,
        milling: dict | None = None,
        **given,
    ) -> dict:
        """Write the file of the ring; figures `ring`, or those of milling.

        given: samples or tolerance, mm; without these as many points of a panel as keep its picture in a file by itself.

        Raises:
            InputError: the format holds no rings, the panels do not close, or another option contradicts.
        """
        if format not in RINGS or mould:
            raise InputError(f"⟨ring⟩ belongs to ⟨format⟩ {alternatives(RINGS)}, got {'a mould' if mould else format}")
        if "orientation" in given:
            raise InputError("⟨orientation⟩ is that of one part on a plate: a ring stands on its end")
        given.pop("printer", None)  # by which an orientation is advised
        scene = at_own_wavelength(self.scene)
        refuse(scene, format, script, mould)
        part = replace(part_of(format, scene, self.field, self.heights, mould, block), others=self.others)
        m = Milling(**(milling or {}))
        if format == "gcode":
            if m.path != ROTARY:
                raise InputError(f"⟨ring⟩ is milled around its axis: ⟨path⟩ {ROTARY} is needed, got {m.path}")
            made = write_gcode(path, part, m, **given)
            return {"milling": made | scallops_of(scene, self.field, made)}
        panels = Panels.of(part, self.others)
        chosen = {"samples", "tolerance"} & set(given)
        choice = given if chosen else self.smallest(file_of(format, path, part), len(panels.sides))
        ring = ring_of(panels, part.lens, **choice)
        import_module(f"caustic_cli.export.{FORMATS[format][1]}").write_mesh(path, ring.vertices, ring.faces)
        return {"ring": figures(panels, ring)}


def _refuse_other_base(path: Path, lens: Lens, first: Lens) -> None:
    """Refuse a panel that does not stand beside the first.

    Raises:
        InputError: its base, inner side, size or material is another.
    """
    its, wanted = ((n.offset, n.size, n.z_in, n.aperture, n.entrance is None, n.index, n.glass) for n in (lens, first))
    if its != wanted:
        raise InputError(
            f"{path}: panels of a ring need the same base (⟨lens.radius⟩), ⟨lens.size⟩, ⟨lens.thickness⟩, inner side"
            " (⟨lens.entrance⟩) and the same material (⟨lens.index⟩)"
        )
