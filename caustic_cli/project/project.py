"""A project directory: the scene and the design in text, the lens in a checkpoint, pictures and the source's files beside them.

NAME.caustic/  project.toml  checkpoints.h5  target.png (or target.npy)  render.png  wave.png  report.png
               source.tm25ray (or what else [source] file names)
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config import settings
from caustic_cli.config.completion import build_options, build_stages, complete, complete_source
from caustic_cli.config.settings import Settings, value_of
from caustic_cli.errors import InputError, no_project, plain
from caustic_cli.inverse.conditions import Ranges
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.target import target_on_screen, tiles
from caustic_cli.io.files import write_bytes
from caustic_cli.io.picture import Picture, read_picture
from caustic_cli.optics.bounds import check_exit_above_entrance
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights
from caustic_cli.project import attachments, checkpoint
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.scene import Scene, sources

TOML, CHECKPOINT, RENDER, WAVE, REPORT = "project.toml", "checkpoints.h5", "render.png", "wave.png", "report.png"
#: The image on the second screen, of a design that has one.
FARTHER = "render-second.png"
#: What a design makes beside its inputs; WAVE only where diffraction is simulated, FARTHER only where there are two screens.
MADE = (CHECKPOINT, RENDER, WAVE, REPORT, FARTHER)


def is_project(path: Path) -> bool:
    """Whether a directory holds a project.toml."""
    return (path / TOML).is_file()


def beside(path: Path) -> Path:
    """Where the wave image belongs beside a ray image or its numbers: render.png -> wave.png, NAME.png -> NAME-wave.png."""
    return path.with_stem(Path(WAVE).stem if path.stem == Path(RENDER).stem else f"{path.stem}-wave")


class Designed(NamedTuple):
    """A designed lens: its scene, the spline spaces and heights (n, m) mm of its exit, and the checkpoint it comes from."""

    scene: Scene
    field: HeightField
    heights: Tensor
    checkpoint: Checkpoint


@dataclass(frozen=True, eq=False)
class Project:
    """An opened project: its directory, complete settings, target picture and source profile.

    path: None of one that is in memory alone; second: the picture on a screen farther on; on_disk: whether its settings were read
    from there; asked: digest of what its user gave (`uptodate`); found: the checkpoint, where the same had been asked for before;
    hold: what lets go of the directory when the design that works there is done; without_waves: see
    `config.completion.without_waves`; values: those of a network's ranges that its scene and lens are for, None for their middle.
    """

    path: Path | None
    settings: Settings
    picture: Picture
    profile: Picture | None = None
    second: Picture | None = None
    asked: str = ""
    found: Checkpoint | None = None
    hold: ExitStack = field(default_factory=ExitStack, repr=False)
    without_waves: str = ""
    on_disk: bool = False
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
            goal = given.get("target", {})
            picture = _picture(
                path, goal.get("file", "target.png"), goal.get("encoding", "srgb") == "linear", goal.get("color", False)
            )
            light = given.get("source", {})
            profile = light.get("profile")
            for table in (light, *light.get("also", ())):
                for key in attachments.STEMS.keys() & table.keys():
                    _within(table[key])
            given["source"] = attachments.attached(light, path)
            if (how := given.get("design", {})).get("robust"):
                _within(how["robust"])
                given["design"] = attachments.with_errors(how, path)
            if "shape_file" in (screen := given.get("screen", {})):
                _within(screen["shape_file"])
                given["screen"] = attachments.with_shape(screen, path)
            if index := given.get("lens", {}).get("index_file"):
                _within(index)
                given["lens"] = attachments.with_index(given["lens"], path)
            full = complete(given, picture.aspect)
            other = full.get("second", {}).get("file")
            second = _picture(path, other, full["target"]["encoding"] == "linear") if other else None
            build_stages(full), build_options(full)  # a project whose design is impossible is not opened for its lens either
            return cls(path, full, picture, _picture(path, profile, True) if profile else None, second, on_disk=True)
        except InputError as error:
            raise InputError(f"{path / TOML}: {error!s}") from error

    def error(self, words: str) -> InputError:
        """An error about its settings, which names the file if they are in one."""
        return InputError(f"{self.path / TOML}: {plain(words)}" if self.on_disk else words)

    @property
    def over(self) -> Ranges | None:
        """Over which its network is trained, None where it is none such."""
        return Ranges.parse(value_of(self.settings["design"], "design.over"))

    def at(self, text: str | None) -> Project:
        """The same with scene and lens for "throw=300" (`Ranges.values`) of a network that is trained over a range.

        Raises:
            InputError: it is not, or the values are not within its ranges.
        """
        if text is None:
            return self
        if self.over is None:
            raise InputError(
                f"⟨at⟩ {text} needs a network that was trained over a range (⟨+design.over⟩), and this lens is for one scene"
            )
        return replace(self, values=self.over.values(text))

    def scene(self, given: Mapping[str, Any] | None = None) -> Scene:
        """The scene it describes, at its values; `given`, path -> value, replaces some of its settings."""
        scene = self._scene(given)
        return scene if self.values is None or self.over is None else self.over.scene(scene, self.values)

    def _scene(self, given: Mapping[str, Any] | None) -> Scene:
        profile = None if self.profile is None else self.profile.irradiance()
        if not given:
            try:
                return settings.build_scene(self.settings, profile)
            except InputError as error:
                raise self.error(f"{error}") from error
        changed = {section: dict(values) for section, values in self.settings.items()}
        changed["design"].pop("over", None)  # it says nothing of another light
        before = changed["source"]["type"]
        for path, value in given.items():
            section, _, key = path.rpartition(".")
            changed[section][key] = value
        changed["screen"] = attachments.with_shape(changed["screen"])
        _change(changed["source"], before, {path.rpartition(".")[2] for path in given if path.startswith("source.")})
        settings.refuse_unused(changed["source"], given)
        if changed["source"]["type"] not in sources.used_by("profile"):
            changed["source"].pop("profile", None)
        changed = settings.with_defaults(changed)
        complete_source(changed["source"], changed["lens"])  # what else a design asks of its light, an image does not
        return settings.build_scene(changed, profile)

    def target(self, scene: Scene) -> np.ndarray:
        """The picture on the scene's screen, (n_x, n_y), or (3, n_x, n_y) of a coloured one."""
        t, light = self.settings["target"], self.picture.irradiance()
        if value_of(t, "target.sheet"):
            return np.mean([own / own.sum() for own in self.targets(scene)], axis=0)
        if light.ndim == 3:
            whole = target_on_screen(light.sum(0), tuple(t["size"]), scene.screen, t["flip"])
            parts = [target_on_screen(c, tuple(t["size"]), scene.screen, t["flip"]) if c.any() else 0.0 * whole for c in light]
            return np.stack(parts)
        return target_on_screen(light, tuple(t["size"]), scene.screen, t["flip"])

    def second_target(self, scene: Scene) -> np.ndarray | None:
        """The second picture on its screen, (n_x, n_y); None where there is none."""
        if self.second is None or scene.second is None or scene.second.screen is None:
            return None
        size, flip = tuple(self.settings["second"]["size"]), self.settings["target"]["flip"]
        return target_on_screen(self.second.irradiance(), size, scene.second.screen, flip)

    def targets(self, scene: Scene) -> list[np.ndarray]:
        """The picture of each lenslet on the scene's screen, (n_x, n_y), j fastest; of a single picture, that alone."""
        t, light = self.settings["target"], self.picture.irradiance()
        if not value_of(t, "target.sheet"):
            return [self.target(scene)]
        return [target_on_screen(tile, tuple(t["size"]), scene.screen, t["flip"]) for tile in tiles(light, scene.lens.array)]

    def load(self) -> Checkpoint:
        """The design so far."""
        return checkpoint.load(self.path / CHECKPOINT)

    def save(self, state: Checkpoint) -> None:
        """Write the design so far."""
        checkpoint.save(self.path / CHECKPOINT, state)

    def lens(self, scene: Scene) -> Designed:
        """The designed surface over the scene's aperture, and that scene with the designed entrance, if that is free-form.

        Raises:
            InputError: there is none, or project.toml was edited to another net than the lens was designed on.
        """
        state = self.load()
        field = HeightField(state.spaces, scene.lens.half_size)
        degree = tuple(s.degree for s in state.spaces)
        if degree != scene.lens.degree:
            raise self.error(
                f"⟨lens.degree⟩ {list(scene.lens.degree)} is not that of the designed lens,"
                f" {list(degree)}; design again to change it"
            )
        done = state.state.stage == len(self.settings["design"]["stages"]) - 1
        if done and field.shape != scene.lens.control:
            raise self.error(
                f"⟨lens.control⟩ {list(scene.lens.control)} is not that of the designed lens,"
                f" {list(field.shape)}; design again to change it"
            )
        has, says = state.state.heights.shape[0] if state.state.heights.ndim == 3 else 1, len(scene.free_surfaces)
        if has != says:
            raise self.error(
                f"[second] and [[element]] say {says} free-form surface(s), and what was designed has {has}; design again"
            )
        scene, heights = split_heights(scene, field, state.state.heights if self.values is None else self._trained(state.state))
        try:
            check_exit_above_entrance(scene, field, heights)
        except InputError as error:
            raise self.error(f"{error}") from error
        return Designed(scene, field, heights, state)

    def _trained(self, state: State) -> Tensor:
        """The lens (n, m), mm, that its network gives for its values."""
        if not state.parameters:
            raise self.error("holds no network yet: design it first")
        middle = self._scene(None)
        target = torch.from_numpy(self.target(middle))
        designer = Designer(middle, target, build_stages(self.settings), build_options(self.settings))
        return designer.heights_at(state, self.values or ())

    def write(self, path: Path | None = None) -> None:
        """Write project.toml and the pictures to `path`, the project's own unless given; the directory exists.

        project.toml comes last: where it is, the rest is.
        """
        path = path or self.path
        self.picture.write(path / self.settings["target"]["file"])
        if self.profile is not None:
            self.profile.write(path / self.settings["source"]["profile"])
        if self.second is not None:
            self.second.write(path / self.settings["second"]["file"])
        for file in attachments.of(self.settings):
            write_bytes(path / file, file.data)
        self.write_settings(path)

    def write_settings(self, path: Path | None = None) -> None:
        """Write project.toml alone."""
        write_bytes((path or self.path) / TOML, settings.dump(self.settings).encode())


def _change(source: Settings, before: str, given: set[str]) -> None:
    """Read the files that new keys of [source] name, and forget that of another type."""
    if given - {"polarisation"}:  # another light is another light for all of it
        source.pop("also", None)
    if source["type"] != before and "file" not in given:
        source.pop("file", None)
    source |= attachments.attached(source)


def _within(name: str) -> None:
    if name != Path(name).name or name in ("", ".", "..", TOML, *MADE):
        raise InputError(f"a file of a project must be the name of one within the project, got {name!r}")


def _picture(directory: Path, name: str, linear: bool, color: bool = False) -> Picture:
    _within(name)
    return read_picture(directory / name, linear, color)
