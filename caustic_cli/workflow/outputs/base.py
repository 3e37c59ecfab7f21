"""What is asked of a render, what its outputs share, and the interface of an output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch

from caustic_cli.config.design import filter_from
from caustic_cli.io.files import sha256_of
from caustic_cli.io.picture import WIDE
from caustic_cli.optics.emission.measured import coarse_words
from caustic_cli.optics.plan import Plan
from caustic_cli.optics.surfaces.cut import CutSurface
from caustic_cli.project.project import RENDER, Project
from caustic_cli.project.uptodate import FILES
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability
from caustic_cli.workflow.lens import Lens, Render
from caustic_cli.workflow.reporter import Reporter

#: Default number of rays: initial for a tolerance, and for evaluations other than the image.
BESIDE_RAYS = 1_000_000


def fingerprint(path: Path | str) -> str:
    """Path and hash of a file, which change with its content; the path alone if it cannot be read."""
    return f"{path} {sha256_of(path)}".rstrip()


@dataclass(frozen=True)
class Tracing:
    """How the light is traced."""

    #: Number of rays; with `tolerance`, the initial one; None for that of the evaluation of a design.
    rays: int | None = None
    #: Relative RMS noise of the image, for which the number of rays is increased, or None.
    tolerance: float | None = None
    #: Reconstruction filter of the image, its size in pixels, and alpha in 1/mm^2, None for 1 per pixel^2.
    reconstruction: str = "bincount"
    filter_size: Sequence[int] = (3, 3)
    alpha: float | None = None
    #: Path in `schema.table` -> value, overriding the settings of the project.
    given: Mapping[str, Any] = field(default_factory=dict)
    #: The screen's z instead of the scene's, mm.
    screen_at: float | None = None
    #: auto, none or names, see `optics.plan.parse_effects`.
    effects: str = "auto"
    #: Seed of the rays, None for that of the project.
    seed: int | None = None
    dtype: torch.dtype = torch.float64

    @property
    def shows(self) -> dict[str, object]:
        """Parameters that determine the image, except for its noise, where they differ from their defaults."""
        usual = {f.name: f.default for f in fields(self)}
        names = ("reconstruction", "filter_size", "alpha", "screen_at", "effects")
        given = {key: fingerprint(value) if key in FILES else value for key, value in dict(self.given).items()}
        return {name: getattr(self, name) for name in names if getattr(self, name) != usual[name]} | given

    @property
    def asks(self) -> dict[str, object]:
        """Parameters that determine the result."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "given"} | dict(self.given)


@dataclass(frozen=True)
class Request:
    """A render: of what, how, and what is written."""

    #: Project directory, or an exported .npz archive.
    lens: Path
    tracing: Tracing = field(default_factory=Tracing)
    #: In the order in which they are written, see `outputs.outputs_for`.
    outputs: tuple[Output, ...] = ()
    #: The image to write, None for render.png in the project; other outputs without a name of their own lie beside it.
    image: Path | None = None
    #: Parameter values for a network that was trained over ranges, "throw=300"; None for their middle.
    at: str | None = None
    #: Replace files not made by this program, and repeat what is up to date.
    force: bool = False

    @property
    def shows(self) -> dict[str, object]:
        """Parameters that determine the image, except for its noise, where they differ from their defaults."""
        at = {} if self.at is None else {"at": self.at}
        return self.tracing.shows | at | {key: value for output in self.outputs for key, value in output.shows.items()}

    @property
    def asks(self) -> dict[str, object]:
        """Parameters that determine the result, without the names of outputs."""
        return self.tracing.asks | {"at": self.at} | {key: value for output in self.outputs for key, value in output.asks.items()}


@dataclass(frozen=True)
class Place:
    """Where a render is written."""

    #: Project directory or archive, and the project if it is one.
    lens: Path
    project: Project | None
    #: The image, if it was given a name.
    named: Path | None

    @property
    def image(self) -> Path:
        """The image."""
        return self.named or (self.lens / RENDER if self.project else Path(self.lens.stem + "-render.png"))

    @property
    def in_project(self) -> bool:
        """Whether the image is that of the project."""
        return self.named is None and self.project is not None

    @property
    def wide(self) -> int:
        """Least width of images, pixels."""
        return WIDE if self.named is None else 1

    def beside(self, name: str) -> Path:
        """A file beside the image, whose name precedes its own if it was given one."""
        return self.image.with_name(name if self.named is None else f"{self.image.stem}-{name}")


@dataclass(eq=False)
class Rendering:
    """A render in progress: what its outputs share."""

    asked: Request
    place: Place
    lens: Lens
    device: str
    say: Reporter
    #: A machined surface that is traced instead of the lens' own, and by how much it may be steeper.
    cut: CutSurface | None = None
    steeper: float = 0.0
    #: Power per pixel, and the wave image, None where there is none.
    image: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    waves: np.ndarray | None = None
    #: Tristimulus values of both, None for light without colour.
    xyz: np.ndarray | None = None
    waves_xyz: np.ndarray | None = None
    figures: dict[str, Any] = field(default_factory=dict)
    #: As designed, whatever surface is traced instead.
    designed: Lens = field(init=False)

    def __post_init__(self) -> None:
        self.designed = self.lens

    @property
    def scene(self) -> Scene:
        """The whole scene, with the effects that the plan leaves out."""
        return self.lens.scene

    @property
    def seed(self) -> int:
        """Seed of the rays."""
        return self.lens.seed if self.asked.tracing.seed is None else self.asked.tracing.seed

    @property
    def rays(self) -> int | None:
        """Number of rays of the image, the initial one for a tolerance; None for that of the evaluation of a design."""
        return self.count if self.asked.tracing.tolerance is not None else self.asked.tracing.rays

    @property
    def count(self) -> int:
        """Number of rays for evaluations other than the image."""
        return BESIDE_RAYS if self.asked.tracing.rays is None else self.asked.tracing.rays

    @cached_property
    def plan(self) -> Plan:
        """The effects to simulate."""
        return self.lens.plan(self.asked.tracing.effects, self.steeper)

    def trace(self, **how: Any) -> Render:
        """Retrace the lens; how: further arguments of `Lens.render`."""
        return self.lens.render(
            self.rays, seed=self.seed, effects=self.plan, dtype=self.asked.tracing.dtype, device=self.device, say=self.say, **how
        )

    def trace_image(self) -> None:
        """The image, of the machined surface if there is one, and its figures."""
        how = self.asked.tracing
        filter = filter_from(how.reconstruction, how.filter_size, self.scene.screen, how.alpha)
        self.plan  # noqa: B018 - refuses first what stands in the light
        if coarse := coarse_words(self.scene):
            self.say.say(coarse)
        found = self.trace(tolerance=how.tolerance, filter=filter, cut=self.cut)
        self.image, self.figures, self.xyz = found.image, found.figures, found.xyz


@dataclass(eq=False)
class Output:
    """One of the things that a render writes or finds out.  Subclasses override what applies to them."""

    #: The option that asks for it; "" for what every render writes.
    option: ClassVar[str] = ""
    #: The scenes that it supports.
    capability: ClassVar[Capability] = Capability("images", {})
    #: Names of its files, which lie beside the image.
    files: ClassVar[tuple[str, ...]] = ()
    #: Whether it goes beyond the images, so that its time does not count as the render's.
    beyond: ClassVar[bool] = False
    #: Whether the same output need not be written again while nothing has changed.
    kept: ClassVar[bool] = True

    @classmethod
    def of(cls, options: Any) -> Self | None:
        """The output as the options of the command ask for it, None if they do not; its fields are named as they are."""
        if cls.option and not getattr(options, cls.option):
            return None
        return cls(**{f.name: getattr(options, f.name) for f in fields(cls) if f.init})

    @property
    def shows(self) -> dict[str, object]:
        """Parameters that change the image."""
        return {}

    @property
    def asks(self) -> dict[str, object]:
        """Parameters that change the result, without the names of files."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.init}
        return {self.option: True} | {name: value for name, value in own.items() if not isinstance(value, Path)} | self.shows

    def paths(self, place: Place) -> tuple[Path, ...]:
        """The files it may write."""
        return tuple(map(place.beside, self.files))

    def unsupported(self, lens: Lens) -> str:
        """Why a lens does not have it, "" if it does."""
        return self.capability.why_not(lens.scene)

    def prepare(self, rendering: Rendering) -> None:
        """Read its input, before anything is traced.

        Raises:
            InputError: that cannot be read.
        """

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write its files; the figures to be added to the render's."""
        raise NotImplementedError

    def show(self, figures: dict[str, Any], say: Any) -> None:
        """Print its figures, from those of the render; say: with `table` and `result`, as of the command line."""
