"""A project directory: settings of scene and design in TOML, the lens in a checkpoint, pictures and files of the source.

NAME.caustic/  project.toml  checkpoints.h5  target.png (or target.npy)  render.png  wave.png  report.png
               source.tm25ray (or another type of [source] file)
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from caustic_cli.config import settings
from caustic_cli.config.design import build_options, build_stages
from caustic_cli.config.optional import complete_sunlight
from caustic_cli.config.settings import Settings
from caustic_cli.errors import InputError, no_project, plain
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.inverse.target import target_on_screen, tiles
from caustic_cli.io.files import write_bytes
from caustic_cli.io.picture import Picture, read_picture
from caustic_cli.kinds import problem_of
from caustic_cli.optics import finishing
from caustic_cli.optics.bounds import check_exit_above_entrance
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights
from caustic_cli.project import attachments, checkpoint, colours
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.completion import complete, complete_source
from caustic_cli.scene import Scene, sources
from caustic_cli.scene.sources.section import content
from caustic_cli.schema.table import RoomSettings, SourceSettings, TargetSettings

TOML, CHECKPOINT, RENDER, WAVE, REPORT = "project.toml", "checkpoints.h5", "render.png", "wave.png", "report.png"
#: Name of the image on the second screen, of a design with one.
FARTHER = "render-second.png"
#: Outputs of a design; WAVE only with diffraction, FARTHER only with two screens.
MADE = (CHECKPOINT, RENDER, WAVE, REPORT, FARTHER)


def is_project(path: Path) -> bool:
    """Whether a directory holds a project.toml."""
    return (path / TOML).is_file()


def beside(path: Path) -> Path:
    """Path of the wave image for that of a ray image or its array: render.png -> wave.png, NAME.png -> NAME-wave.png."""
    return path.with_stem(Path(WAVE).stem if path.stem == Path(RENDER).stem else f"{path.stem}-wave")


class LensData(NamedTuple):
    """A lens of a project or an archive in its scene.

    field, heights: spline spaces of its exit, and control heights (n, m), mm; target: (n_x, n_y) or (3, n_x, n_y) on the screen,
    None for an archive; figures: of the evaluation of its design; state, provenance: of that, None for an archive.
    """

    scene: Scene
    field: HeightField
    heights: Tensor
    target: np.ndarray | None = None
    figures: Mapping[str, Any] = {}
    state: State | None = None
    provenance: dict[str, Any] | None = None


class Designed(NamedTuple):
    """A designed lens: its scene, the spline spaces and heights (n, m) mm of its exit, and the checkpoint it comes from."""

    scene: Scene
    field: HeightField
    heights: Tensor
    checkpoint: Checkpoint


@dataclass(frozen=True, eq=False)
class Project:
    """An opened project: its directory, complete settings, and target picture."""

    #: None for a project in memory.
    path: Path | None
    settings: Settings
    picture: Picture
    #: Digest of the user's input, see `uptodate`.
    asked: str = ""
    #: Of an earlier design with the same input.
    checkpoint: Checkpoint | None = None
    #: Releases the lock of the directory.
    hold: ExitStack = field(default_factory=ExitStack, repr=False)
    #: See `config.wave_stages.without_waves`.
    without_waves: str = ""
    #: Whether its settings were read from the directory.
    on_disk: bool = False
    #: Of the scene parameters of a network, None for the middle of their ranges.
    values: tuple[float, ...] | None = None

    @classmethod
    def open(cls, path: str | Path) -> Project:
        """Read project.toml and the pictures it names.

        Raises:
            InputError: not a project, or something in it is missing, damaged or out of range.
        """
        path = Path(path)
        if not path.is_dir() or not is_project(path):
            raise no_project(path)
        given = settings.read(path / TOML)
        try:
            goal = TargetSettings.of(given.get("target", {}))
            name = goal.get("file", "target.png")
            for file in (name, *(table[row.key] for table, row in attachments.names_in(given))):
                _within(file)
            picture = read_picture(path / name, goal.encoding == "linear", goal.color)
            given = colours.completed(given, goal, picture)
            full = complete(attachments.attached(attachments.located(given, path)), picture.aspect)
            if full.lamp is None:
                build_stages(full), build_options(full)  # validates the design, too
            return cls(path, full, picture, on_disk=True)
        except InputError as error:
            raise InputError(f"{path / TOML}: {plain(f'{error}')}") from error

    def error(self, words: str) -> InputError:
        """An error about its settings, which names their file if there is one."""
        return InputError(f"{self.path / TOML}: {plain(words)}" if self.on_disk else words)

    @property
    def second(self) -> np.ndarray | None:
        """The picture on a screen farther away, irradiance (a, b), or (3, a, b) R, G, B, or None."""
        return content(self.settings.second or {}, "file", np.ndarray)

    def room(self, given: Mapping[str, Any]) -> RoomSettings | None:
        """The [room] section, in which `given`, path -> value, overrides settings; None without one."""
        own = settings.by_section(given).get("room", {})
        return RoomSettings.of({**(self.settings.room or {}), **own}) if own or self.settings.room else None

    @property
    def over(self) -> Ranges | None:
        """Ranges over which its network is trained, or None."""
        return Ranges.parse(self.settings.design.over)

    def at(self, text: str | None) -> Project:
        """The project at parameter values "throw=300" (`Ranges.values`) of a network trained over ranges; unchanged for None.

        Raises:
            InputError: there is no such network, or the values are out of range.
        """
        if text is None:
            return self
        if self.over is None:
            raise InputError(
                f"⟨at⟩ {text} needs a network that was trained over a range (⟨+design.over⟩), and this lens is for one scene"
            )
        return replace(self, values=self.over.values(text))

    def scene(self, given: Mapping[str, Any] | None = None) -> Scene:
        """The scene, at the parameter values; `given`, path -> value, overrides some of its settings."""
        scene = self._scene(given)
        return scene if self.values is None or self.over is None else self.over.scene(scene, self.values)

    def _scene(self, given: Mapping[str, Any] | None) -> Scene:
        if not given:
            try:
                return settings.build_scene(self.settings)
            except InputError as error:
                raise self.error(f"{error}") from error
        own = attachments.attached(settings.implied(settings.by_section(given)))
        s = self.settings
        other, room = _other_source(s.source, own.get("source", {})), self.room(given)
        if "room" in own:  # another light of the sun
            stale = {"tilt", "angle", "also", "each"} - own.get("source", {}).keys()
            other = {key: value for key, value in other.items() if key not in stale}
        if room is not None and ("room" in own or "tilt" not in own.get("source", {})):
            other = dict(complete_sunlight(SourceSettings(other), room, s.lens.array))
        settings.refuse_unused(other, given)
        # Further conditions of a design on its source do not apply to an image.
        other = colours.completed({"source": other}, s.target, self.picture)["source"]
        source = complete_source(SourceSettings.of(other), s.lens)
        lens, screen = s.lens.changed(**own.get("lens", {})), s.screen.changed(**own.get("screen", {}))
        return settings.build_scene(s.changed(source=source, lens=lens, screen=screen))

    def target(self, scene: Scene) -> np.ndarray:
        """The target on the screen of the scene, (n_x, n_y), or (3, n_x, n_y) in colour, the power of each wavelength."""
        t, light = self.settings.target, self.picture.irradiance()
        if t.sheet:
            return np.mean([own / own.sum() for own in self.targets(scene)], axis=0)
        return colours.on_screen(light, scene.light, t.size, scene.screen, t.flip)

    def second_target(self, scene: Scene) -> np.ndarray | None:
        """The second target on its screen, (n_x, n_y), or (3, n_x, n_y) in the colours of the first, or None.

        Raises:
            InputError: it needs a wavelength of which the source has no light.
        """
        picture, section = self.second, self.settings.second
        if picture is None or section is None or scene.second_target is None or scene.second_target.screen is None:
            return None
        flip = self.settings.target.flip
        found = colours.on_screen(picture, scene.light, section.size, scene.second_target.screen, flip)
        colours.refuse_without_light(found, scene.light)
        return found

    def targets(self, scene: Scene) -> list[np.ndarray]:
        """The target of each lenslet on the screen of the scene, (n_x, n_y), j fastest; a single one for a common picture."""
        t, light = self.settings.target, self.picture.irradiance()
        if not t.sheet:
            return [self.target(scene)]
        return [target_on_screen(tile, t.size, scene.screen, t.flip) for tile in tiles(light, scene.lens.array)]

    def load(self) -> Checkpoint:
        """Read the checkpoint."""
        return checkpoint.load(self.path / CHECKPOINT)

    def save(self, state: Checkpoint, nets: Mapping[str, bytes | None] | None = None) -> None:
        """Write a checkpoint; nets: as of `checkpoint.save`."""
        checkpoint.save(self.path / CHECKPOINT, state, nets)

    def lens(self, scene: Scene) -> Designed:
        """The designed surface, and the scene with the designed entrance, if that is free-form.

        Raises:
            InputError: there is none, or project.toml was edited to another control net.
        """
        state = self.load()
        field = HeightField(state.spaces, scene.lens.half_size)
        degree = tuple(s.degree for s in state.spaces)
        if degree != scene.lens.degree:
            raise self.error(
                f"⟨lens.degree⟩ {list(scene.lens.degree)} is not that of the designed lens,"
                f" {list(degree)}; design again to change it"
            )
        done = state.state.stage == len(self.settings.design.stages) - 1
        if done and field.shape != scene.lens.control:
            raise self.error(
                f"⟨lens.control⟩ {list(scene.lens.control)} is not that of the designed lens,"
                f" {list(field.shape)}; design again to change it"
            )
        has, says = state.state.heights.shape[0] if state.state.heights.ndim == 3 else 1, len(scene.free_surfaces)
        if has != says:
            raise self.error(f"[second] and [[element]] give {says} free-form surface(s), and the design has {has}; design again")
        scene, heights = split_heights(scene, field, state.state.heights if self.values is None else self._trained(state.state))
        try:
            check_exit_above_entrance(scene, field, heights)
        except InputError as error:
            raise self.error(f"{error}") from error
        return Designed(scene, field, heights, state)

    def made(self, field: HeightField, heights: Tensor) -> tuple[HeightField, Tensor]:
        """The surface to be made: corrected for how it is finished, the designed one without a finish."""
        finish = self.settings.lens.finish
        return finishing.corrected(finishing.parse(finish), field, heights) if finish else (field, heights)

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""
        return self.settings.design.seed

    @property
    def encoding(self) -> str:
        """Encoding of its picture, and of its images."""
        return self.settings.target.encoding

    @property
    def image(self) -> Path:
        """Name of the image of its lens."""
        return self.path / RENDER

    def read(self, given: Mapping[str, Any]) -> LensData:
        """The lens of the last checkpoint, at the parameter values; given: path in `schema.table` -> value, overriding settings."""
        scene = self.scene(given)
        target = self.target(scene)
        scene, field, heights, checkpoint = self.lens(scene)
        return LensData(scene, field, heights, target, dict(checkpoint.results), checkpoint.state, checkpoint.provenance)

    def refined_by_waves(self, state: State | None) -> bool:
        """Whether a design in this state was refined on its wave image."""
        return state is not None and any(stage.waves for stage in self.settings.design.stages[: state.stage + 1])

    def resolution(self, scene: Scene, field: HeightField, heights: Tensor) -> Resolution:
        """Resolution of the picture by diffraction."""
        return Resolution.before(scene, self.settings.target.size)

    def moved(self, path: Path) -> Project:
        """The project in another directory."""
        return replace(self, path=path)

    def _trained(self, state: State) -> Tensor:
        """Heights (n, m), mm, from the network at the parameter values."""
        if not state.parameters:
            raise self.error("holds no network yet: design it first")
        problem = problem_of(replace(self, values=None))
        return problem.heights_at(Designer(problem), state, self.values or ())

    def write(self, path: Path | None = None) -> None:
        """Write project.toml and all files to an existing directory, that of the project by default.

        project.toml is written last, so that its presence implies that of the others.
        """
        path = path or self.path
        write_bytes(path / self.settings.target.file, self.picture.encoded())
        for file in attachments.of(self.settings):
            write_bytes(path / file, file.data)
        self.write_settings(path)

    def write_settings(self, path: Path | None = None) -> None:
        """Write project.toml alone."""
        write_bytes((path or self.path) / TOML, settings.dump(self.settings).encode())


def _other_source(source: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The [source] section with other keys: a changed source replaces all further ones, another type has another file, and weights
    are those of their own wavelengths."""
    gone = {"also"} if given.keys() - {"polarisation"} else set()
    type = given.get("type", source["type"])
    gone |= {"file"} if type != source["type"] else set()
    gone |= set() if type in sources.used_by("each") and "angle" not in given else {"each"}
    gone |= {"weights"} if "wavelengths" in given else set()
    gone |= set() if type in sources.used_by("profile") else {"profile"}
    return {key: value for key, value in source.items() if key not in gone} | dict(given)


def _within(name: str) -> None:
    if name != Path(name).name or name in ("", ".", "..", TOML, *MADE):
        raise InputError(f"a file of a project must be the name of one within the project, got {name!r}")
