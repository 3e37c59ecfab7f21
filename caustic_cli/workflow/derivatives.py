"""The derivative of an image with respect to a control height, of the lens and of the lamp of a project: for `caustic gradmap`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from caustic_cli.config.design import filter_from
from caustic_cli.effort import current_effort
from caustic_cli.inverse.lamp import pixels_of, stages_of
from caustic_cli.loading import OnDemand
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project.project import Project
from caustic_cli.scene import Scene, Screen
from caustic_cli.studies import gradmap
from caustic_cli.studies.gradmap import Comparison
from caustic_cli.studies.retrace import sampler_for
from caustic_cli.workflow.compilation import compile_for
from caustic_cli.workflow.lamp import LampDesign
from caustic_cli.workflow.reporter import Reporter

lamp_gradmap = OnDemand("caustic_cli.studies.lamp_gradmap")

Size = tuple[int, int]


@dataclass(frozen=True)
class OfLens:
    """Of the heights of a lens' exit.

    image(control) is the derivative (n_x, n_y) on the pixels of `screen`, parts of the source's power per mm; shape: of the control
    net; unit: of the screen; compared(gradient, control): with central differences.
    """

    scene: Scene
    field: HeightField
    heights: Tensor
    sampler: Rays
    filter: Filter
    dtype: torch.dtype
    unit: str = "mm"

    @classmethod
    def of(
        cls,
        path: Path,
        rays: int,
        seed: int | None,
        kind: str,
        size: Size,
        alpha: float | None,
        *,
        at: Any,
        device: str,
        dtype: torch.dtype,
        say: Reporter,
    ) -> OfLens:
        """Of a project, see the options of caustic gradmap."""
        opened = Project.open(path).at(at)
        scene, field, heights, _ = opened.lens(opened.scene())
        sampler = sampler_for(scene, rays, opened.settings.design.seed if seed is None else seed, device)
        found = cls(scene, field, heights, sampler, filter_from(kind, size, scene.screen, alpha), dtype)
        compile_for(scene, device, say)
        return found

    @property
    def shape(self) -> Size:
        return self.field.shape

    @property
    def screen(self) -> Screen:
        return self.scene.screen

    @property
    def rays(self) -> int:
        return self.sampler.count

    def image(self, control: Size) -> Tensor:
        of = (self.scene, self.field, self.heights, control)
        return gradmap.gradient_image(*of, sampler=self.sampler, filter=self.filter, dtype=self.dtype)

    def compared(self, gradient: Tensor, control: Size) -> Comparison:
        of = (self.scene, self.field, self.heights, control)
        return gradmap.compare(gradient, *of, sampler=self.sampler, filter=self.filter)


@dataclass(frozen=True)
class OfLamp:
    """Of the radius of a lamp's outer surface, as `OfLens`; on the pixels of its last stage."""

    traced: lamp_gradmap.LampRendering

    @classmethod
    def of(cls, path: Path, rays: int, seed: int | None, kind: str, size: Size, alpha: float | None) -> OfLamp:
        """Of a project, see the options of caustic gradmap."""
        project = Project.open(path)
        one = LampDesign.of(project)
        count = stages_of(one.lamp, current_effort())[-1][1][0]
        screen = Screen(one.goal.size, resolution=pixels_of(one.goal, count))
        filter, seed = filter_from(kind, size, screen, alpha), project.seed if seed is None else seed
        return cls(lamp_gradmap.LampRendering(one.lamp, one.goal, one.field, one.values, screen, filter, rays, seed))

    @property
    def shape(self) -> Size:
        return self.traced.field.shape

    @property
    def screen(self) -> Screen:
        return self.traced.screen

    @property
    def rays(self) -> int:
        return self.traced.rays

    @property
    def unit(self) -> str:
        return self.traced.goal.unit

    def image(self, control: Size) -> Tensor:
        return self.traced.derivative(control)

    def compared(self, gradient: Tensor, control: Size) -> Comparison:
        return self.traced.compared(gradient, control)
