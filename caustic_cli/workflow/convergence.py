"""The studies of `caustic convergence`: each is one object, for a given lens or a default scene.

What they are called and which options they take is known without torch: what a study needs is imported when it runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

from caustic_cli.errors import InputError
from caustic_cli.schema import checks

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from caustic_cli.optics.surfaces.heightfield import HeightField
    from caustic_cli.project.project import Project
    from caustic_cli.scene import Scene
    from caustic_cli.studies.report import Drawing, Study
    from caustic_cli.workflow.lens import Lens
    from caustic_cli.workflow.reporter import Reporter


@dataclass(frozen=True)
class StudyRequest:
    """What is studied, and how; None for the default of the study."""

    lens: Lens | None
    device: str
    say: Reporter
    #: Called with (done, in total), in the study's unit.
    progress: Callable[[int, int], None]
    #: Rays of the largest setting.
    rays: int | None = None
    #: Rounds.
    repeats: int | None = None
    #: Seconds for each design.
    seconds: float | None = None
    #: Seed, and precision of the rays.
    seed: int | None = None
    dtype: torch.dtype | None = None

    @property
    def project(self) -> Project | None:
        """The project of the lens."""
        return self.lens.project if self.lens else None

    @property
    def seeds(self) -> dict[str, Any]:
        """Seed of the rays and the progress, as most studies take them."""
        return {"seed": self.seed or 0, "progress": self.progress}

    def surface(self, usual: Callable[[], tuple[Scene, HeightField, Tensor]]) -> tuple[Scene, HeightField, Tensor]:
        """Scene, spline spaces and heights (n, m) mm of the lens, or of the usual one, on the device."""
        scene, field, heights = (self.lens.scene, self.lens.field, self.lens.heights) if self.lens else usual()
        return scene, field, heights.to(self.device)


class StudyKind:
    """A study."""

    name: str
    #: Name of the module of `studies` that measures it.
    home: ClassVar[str]
    #: Unit of its progress.
    unit: ClassVar[str] = "rays"
    #: The options that apply to it among repeats, seconds and dtype.
    takes: ClassVar[tuple[str, ...]] = ()
    #: Whether the number of rays applies to it also among all studies.
    rays_of_all: ClassVar[bool] = False
    #: Whether its errors are those of lenses against the picture, as of a design; others compare images with each other.
    of_lenses: ClassVar[bool] = False
    #: Whether it can study the lens of a project.
    takes_project: ClassVar[bool] = True

    @property
    def module(self) -> Any:
        """The module that measures it."""
        return import_module(f"caustic_cli.studies.{self.home}")

    @property
    def plots(self) -> dict[str, Drawing] | None:
        """Endings of its plots' names, and what draws them; None for the usual one."""
        return getattr(self.module, "PLOTS", None)

    def measure(self, asked: StudyRequest) -> Study:
        """Run it.

        Raises:
            InputError: a value out of range, or a scene that it does not support.
        """
        from caustic_cli.workflow.compilation import compile_usual  # noqa: PLC0415

        compile_usual(asked.device, asked.say)
        return self.run(asked)

    def run(self, asked: StudyRequest) -> Study:
        """The measurement itself."""
        raise NotImplementedError


class IntersectionStudy(StudyKind):
    """Methods of intersection; by default in the scene of table D.3."""

    name, home, unit, takes = "intersection", "intersection", "evaluations", ("repeats",)

    def run(self, asked: StudyRequest) -> Study:
        rays, lens = (asked.rays, asked.seed or 0), asked.lens
        case = self.module.of_lens(lens.scene, lens.field, lens.heights, *rays) if lens else self.module.table_d3(*rays)
        return self.module.run_intersection(case, repeats=asked.repeats, **asked.seeds)


class ImageStudy(StudyKind):
    """Settings of an image, see `studies.convergence`; by default of the initial sphere of a design."""

    home, takes, rays_of_all = "convergence", ("repeats", "dtype"), True

    def __init__(self, name: str):
        self.name = name

    def run(self, asked: StudyRequest) -> Study:
        from caustic_cli.workflow.design import sphere  # noqa: PLC0415

        repeats = 3 if asked.repeats is None else asked.repeats
        return self.module.run_study(
            self.name, *asked.surface(sphere), max_rays=asked.rays, repeats=repeats, dtype=asked.dtype, **asked.seeds
        )


class EffectStudy(StudyKind):
    """Effects on and off; by default of the initial sphere of a design."""

    name, home, unit, takes, rays_of_all = "effects", "effects", "effects", ("repeats", "dtype"), True

    def run(self, asked: StudyRequest) -> Study:
        from caustic_cli.workflow.compilation import compile_for  # noqa: PLC0415
        from caustic_cli.workflow.design import sphere  # noqa: PLC0415

        lens = asked.surface(sphere)
        compile_for(None, asked.device, asked.say)
        return self.module.run_effects(*lens, rays=asked.rays, repeats=asked.repeats, dtype=asked.dtype, **asked.seeds)


class DesignStudy(StudyKind):
    """Optimisers, networks and control nets; by default for a bright disc."""

    name, home, unit, takes, of_lenses = "design", "optimiser_comparison", "turns", ("seconds", "dtype"), True

    def run(self, asked: StudyRequest) -> Study:
        from caustic_cli.workflow.comparison import timed_designs  # noqa: PLC0415

        designs = timed_designs(asked.project, asked.device, asked.dtype, asked.seed)
        return self.module.run_comparison(*designs, seconds=asked.seconds, rays=asked.rays, device=asked.device, **asked.seeds)


class NetworkStudy(DesignStudy):
    """Architectures of networks; by default for a bright disc."""

    name, home = "networks", "architectures"

    def run(self, asked: StudyRequest) -> Study:
        from caustic_cli.workflow.architectures import candidates  # noqa: PLC0415

        compared = candidates(asked.project, asked.device, asked.dtype, asked.seed, asked.rays)
        about = {"seed": asked.seed or 0, "device": asked.device}
        return self.module.run_architectures(compared, seconds=asked.seconds, about=about, progress=asked.progress)


class DiffractionStudy(StudyKind):
    """Rays against waves; by default of the lens of a bright disc."""

    name, home, unit, takes = "diffraction", "diffraction", "cases", ("dtype",)

    def run(self, asked: StudyRequest) -> Study:
        from caustic_cli.workflow.comparison import lens_of_disc  # noqa: PLC0415

        return self.module.run_diffraction(*asked.surface(lens_of_disc), rays=asked.rays, dtype=asked.dtype, **asked.seeds)


class LightStudy(StudyKind):
    """Error against efficiency; by default for a bright disc, from an LED."""

    name, home, unit, takes, of_lenses = "light", "efficiency", "lenses", ("seconds",), True

    def run(self, asked: StudyRequest) -> Study:
        from caustic_cli.workflow.tradeoff import lenses  # noqa: PLC0415

        seconds = self.module.SECONDS if asked.seconds is None else asked.seconds
        each = checks.number("⟨seconds⟩", seconds, 0.0, 1e6, open_low=True)
        count, designed = lenses(asked.project, each, asked.device)
        return self.module.run_efficiency(designed, count, rays=asked.rays, device=asked.device, **asked.seeds)


class StabilityStudy(StudyKind):
    """Numerically difficult cases, each with its own scene."""

    name, home, unit = "stability", "stability", "cases"
    takes_project = False

    def measure(self, asked: StudyRequest) -> Study:
        for option, value in (("PROJECT", asked.lens), ("⟨rays⟩", asked.rays)):
            if value is not None:
                raise InputError(f"{option} has no meaning for ⟨study⟩ stability, whose cases are given: leave it out")
        return super().measure(asked)

    def run(self, asked: StudyRequest) -> Study:
        return self.module.run_stability(asked.progress)


#: Every study by its name, in the order of `study all`; and that of networks, which is a variant of the study of designs.
STUDIES: dict[str, StudyKind] = {
    kind.name: kind
    for kind in (
        IntersectionStudy(),
        *map(ImageStudy, ("rays", "reconstruction", "precision")),
        EffectStudy(),
        DesignStudy(),
        DiffractionStudy(),
        LightStudy(),
        StabilityStudy(),
    )
}
NETWORKS = NetworkStudy()
