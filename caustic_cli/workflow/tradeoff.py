"""Designs for the trade-off between error and efficiency, `convergence study light`: several thicknesses and loss weights."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import cast

from caustic_cli.config import settings
from caustic_cli.config.design import region_of
from caustic_cli.config.settings import Settings
from caustic_cli.errors import CausticError
from caustic_cli.inverse.designer import Designer
from caustic_cli.io.picture import Picture
from caustic_cli.kinds import problem_of
from caustic_cli.optics.region import Region
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.studies.beam import beam_figures
from caustic_cli.studies.efficiency import DesignedLens
from caustic_cli.workflow.comparison import picture_of_disc
from caustic_cli.workflow.preparation import PreparedDesign, first_heights

#: Weights of the loss "light" relative to "rms", for distant sources, where thickness has no influence, and for near sources.
DISTANT_WEIGHTS, NEAR_WEIGHTS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0), (0.0, 1.0, 10.0)
#: Efficiencies of laser beams, from the highest down.
BEAM = (0.99, 0.985, 0.97, 0.95, 0.9)
#: Thicknesses for near sources, relative to that of the scene.
PARTS = (0.7, 1.0, 1.4, 2.0)
#: Default scene: width of an LED and its distance, mm, at which much of its light is lost; cone, degrees; pixels across the screen.
LED, BEFORE, CONE, PIXELS = 2.0, 3.0, 90.0, 100


def led() -> Project:
    """The default scene of the study, with a bright disc for its picture."""
    full = complete(
        {
            "source": {"type": "disc", "position": [[0.0, 0.0, -BEFORE]], "size": [LED, LED], "cone": CONE},
            "screen": {"z": 25.0, "resolution": [PIXELS, PIXELS]},
        },
        1.0,
    )
    full = full.changed(target=full.target.changed(file="target.npy", encoding="linear"))
    return Project(None, full, Picture(picture_of_disc(), "linear"))


def lenses(project: Project | None, seconds: float, device: str) -> tuple[int, Iterator[DesignedLens]]:
    """Largest number of lenses, and an iterator that designs them, each with at most `seconds` of iterations; those whose light
    cannot reach the picture are left out."""
    project = project or led()
    full = project.settings
    if region_of(full.design) is not None:
        return len(BEAM), _shaped(project, seconds, device)
    near = not settings.build_source(full.source).distant and not full.lens.mirror
    weights, fractions = (NEAR_WEIGHTS, PARTS) if near else (DISTANT_WEIGHTS, (1.0,))
    return len(weights) * len(fractions), _designed(project, weights, fractions, seconds, device)


def _designed(project: Project, weights, fractions, seconds: float, device: str) -> Iterator[DesignedLens]:
    full = project.settings
    for fraction in fractions:
        thickness = full.lens.z_in + fraction * (full.lens.thickness - full.lens.z_in)
        on_rays = [s for s in full.design.stages if not s.waves]
        varied = full.changed(lens=full.lens.changed(thickness=thickness), design=full.design.changed(waves="off", stages=on_rays))
        try:
            prepared = _prepared(project, varied, device)
        except CausticError:
            continue
        problem = prepared.problem
        assert problem is not None
        for weight in weights:
            loss = f"rms + {weight:g} light" if weight else "rms"
            try:
                designer = Designer(problem.varied(problem.stages, replace(problem.options, loss=loss, waves=False)))
                state = designer.run(designer.initial_state(*prepared.first or ()), time_limit=seconds)
            except CausticError:
                continue
            yield DesignedLens(
                thickness,
                weight,
                loss,
                problem.scene,
                designer.field(state.stage),
                designer.within_limits(state),
                problem.target.numpy(),
                state.seconds,
            )


def _shaped(project: Project, seconds: float, device: str) -> Iterator[DesignedLens]:
    """Lenses that shape a laser beam, with the loss and the stages of the project, for each efficiency."""
    prepared = _prepared(project, project.settings, device)
    problem = prepared.problem
    assert problem is not None
    for goal in BEAM:
        region = replace(cast(Region, problem.stages[-1].rendering.bright), goal=goal)
        stages = [replace(stage, rendering=replace(stage.rendering, bright=region)) for stage in problem.stages]
        try:
            designer = Designer(problem.varied(stages, problem.options))
            state = designer.run(designer.initial_state(*prepared.first or ()), time_limit=seconds)
            field, heights = designer.field(state.stage), designer.within_limits(state)
            found = wave_image(problem.scene, field, heights)
        except CausticError:
            continue
        figures = beam_figures(found.image, found.leaving, region.on(problem.target), problem.scene.screen.pixel)
        how = problem.scene, field, heights, problem.target.numpy(), state.seconds, figures
        yield DesignedLens(problem.scene.lens.offset.thickness, goal, problem.options.loss, *how)


def _prepared(project: Project, varied: Settings, device: str) -> PreparedDesign:
    """The design with these settings, adapted to its initial heights."""
    changed = replace(project, settings=varied)
    return first_heights(changed, {"lens": {"thickness": varied.lens.thickness}}, problem_of(changed, device))
