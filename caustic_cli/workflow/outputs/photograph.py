"""Photographs of the caustic of the part that was made: on the screen, compared with the picture, and errors of the part."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from caustic_cli.io.picture import WIDE, write_image, write_npy
from caustic_cli.scene.traits import Capability
from caustic_cli.studies.irradiance import irradiance
from caustic_cli.studies.photograph import comparison
from caustic_cli.studies.photograph.inference import FOUND
from caustic_cli.studies.viewing import as_viewed
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Output, Rendering, fingerprint
from caustic_cli.workflow.photographs import Shot, files_of, judge, refuse_lens, shots


@dataclass(eq=False)
class PartPhotograph(Output):
    """The photographs `photo`, a single one found on the screen by `marks`, a file or auto, or by `screen_corners`."""

    option: ClassVar[str] = "photo"
    capability: ClassVar[Capability] = Capability("photographs of a part", {})
    files: ClassVar[tuple[str, ...]] = ("photo.png", "photo.npy", "missing.png", "part.png", "part.npy", "deviation.npy")
    beyond: ClassVar[bool] = True

    photo: list[Path]
    marks: str | None = None
    screen_corners: tuple[str, str, str, str] | None = None
    taken: tuple[Shot, ...] = field(default=(), init=False)

    @property
    def asks(self) -> dict[str, object]:
        marks = None if self.marks in (None, "auto") else fingerprint(str(self.marks))
        return {
            "photo": [fingerprint(file) for path in self.photo for file in files_of(path)],
            "marks": marks,
            "screen_corners": self.screen_corners,
        }

    def unsupported(self, lens: Lens) -> str:
        return refuse_lens(lens)

    def prepare(self, rendering: Rendering) -> None:
        self.taken = shots(self.photo, self.marks, self.screen_corners, rendering.scene.colored)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """photo: as of `workflow.photographs.Judged.figures`, with the paths of the files."""
        lens, paths = rendering.lens, self.paths(rendering.place)
        assert lens.target is not None
        found = judge(lens, self.taken, rendering.say)
        shown, aim = found.shown[0], found.targets[0]
        made, deviation = comparison.surfaces(found.found)
        image, values, missing, plot, part, off = paths
        as_designed = irradiance(lens.target, lens.scene.screen)
        write_image(image, *as_viewed(found.scenes[0], found.of_first, as_designed), lens.encoding, WIDE)
        write_npy(values, found.of_first)
        write_image(missing, shown.missing, float(aim.max() / aim.mean()), lens.encoding, WIDE)
        comparison.write_plot(plot, shown, aim, found.found, lens.encoding)
        write_npy(part, made)
        write_npy(off, deviation)
        names = ("image", "values", "missing_image", "plot", "part_file", "deviation_file")
        return {"photo": found.figures | dict(zip(names, map(str, paths), strict=True))}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        show(figures["photo"], say)


def show(f: dict[str, Any], say: Any) -> None:
    """Print the figures of photographs and of their part; say: as of `Output.show`."""
    several = bool(f.get("others"))
    for one in (f, *f.get("others", ())):
        say.table(f"photograph {one['file']}", rows_of(one) + ([] if several else rows_of_part(f)))
    if several:
        say.table("the part, by all photographs", rows_of_part(f))


def rows_of(f: dict[str, Any]) -> list[tuple[str, str]]:
    """Rows of the closing table, from the figures of a photograph."""
    camera = f["camera"]
    sigma = f", {f['mark_sigma_px']:.2g} pixels each" if f["marks"] else ""
    found = [
        ("screen found by", f"{f['registered_by']}{sigma}"),
        ("error of the picture", f"{f['error']:.4f}; as photographed {f['as_photographed']:.4f}"),
        ("after registration", f"{f['registered']:.4f}; against the lens as designed {f['against_lens']:.4f}"),
        ("light missing", f"{f['missing_light']:.2%} of the picture's"),
        ("camera", f"gamma {camera['gamma']:.2f}, background {camera['background']:.3f}, blur {camera['blur_mm']:.2g} mm"),
        ("explained", f"{f['explained']:.2%} of the photograph's variance"),
    ]
    if f["screen_farther_mm"] is not None:
        found.append(("screen", "{:+.2f} ± {:.2f} mm farther away than said".format(*f["screen_farther_mm"])))
    return found


def rows_of_part(f: dict[str, Any]) -> list[tuple[str, str]]:
    """The same of what is wrong with the part."""
    part = f["part"]
    same = ", or index less one" if f["screen_farther_mm"] is not None else ", or throw, or index less one"
    found = [
        (
            "deviation of the part",
            f"RMS {part['deviation_rms_um']:.2f} ± {part['deviation_rms_sigma_um']:.2f} µm;"
            f" known to {part['uncertainty_um']:.2f} µm",
        ),
        ("scale of the relief", f"{part['relief_scale']:.4f} ± {part['relief_scale_sigma']:.4f}{same}"),
    ]
    if not part["found"]:
        found.insert(
            0,
            (
                "uncertain",
                f"{part['explained']:.2%} of the photograph's variance is explained, less than the {FOUND:.2%} that the part's own"
                " deviation explains: where light is folded finely, the fit ends on another surface, off by more than is said",
            ),
        )
    found += [("not told apart", words) for words in part["not_told_apart"]]
    names = ("image", "missing_image", "plot", "part_file", "deviation_file")
    return [*found, ("files", ", ".join(f[name] for name in names))] if "plot" in f else found
