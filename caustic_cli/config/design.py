"""The [design] section and its stages, as the objects that a design runs with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from caustic_cli.config.default_stages import stage_base
from caustic_cli.config.settings import Settings, build_screen, build_source
from caustic_cli.errors import InputError
from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.loss_terms import parse
from caustic_cli.inverse.parametrisation import Architecture, Parametrisation
from caustic_cli.inverse.problem import Options
from caustic_cli.inverse.schedule import LossImage, Stage
from caustic_cli.optics import finishing
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.region import Region
from caustic_cli.scene import Screen
from caustic_cli.scene.sources.section import content
from caustic_cli.schema.table import DesignSettings, StageSettings, check_all


def relative_to_initial(design: Mapping[str, Any]) -> bool:
    """Whether the design uses a network whose outputs are relative to an initial surface."""
    return design["network"] != "none" and design.get("preconditioner") == "laplacian"


def filter_from(kind: str, size, screen: Screen, per_mm2: float | None = None, per_pixel2: float | None = None) -> Filter:
    """A reconstruction filter; the Gaussian's alpha in 1/mm^2 or 1/pixel^2 (default 1 per pixel^2)."""
    if per_mm2 is not None and per_pixel2 is not None:
        raise InputError("alpha_per_mm2 and alpha_per_pixel2 say the same thing twice: give one of them")
    if kind == "bincount":
        size = (1, 1)
    alpha = (0.0, 0.0)
    if kind == "gaussian":
        if per_mm2 is not None:
            alpha = per_mm2 * screen.pixel[0] * screen.pixel[0], per_mm2 * screen.pixel[1] * screen.pixel[1]
        else:
            alpha = (1.0 if per_pixel2 is None else per_pixel2,) * 2
    return Filter(kind, tuple(size), alpha)


def build_stages(settings: Settings) -> list[Stage]:
    """The stages of complete settings.

    Raises:
        InputError: there are none, a value is out of range, or the last stage does not use the lens' control net.
    """
    stages = [stage_of(table, settings) for table in settings.design.stages]
    if not stages:
        raise InputError("[[design.stages]] at least one stage is needed")
    if stages[-1].control != settings.lens.control:
        raise InputError(
            f"[[design.stages]] the last stage's control {list(stages[-1].control)} must be the lens' own,"
            f" {list(settings.lens.control)}"
        )
    return stages


def region_of(design: DesignSettings) -> Region | None:
    """Where the loss log-rms looks for light; None for another loss.

    Raises:
        InputError: neither pixels nor a picture.
    """
    if "log-rms" not in [name for _, name in parse(design.loss)]:
        return None
    check_all("design", design, "efficiency")
    given = content(design, "region", np.ndarray)
    if given is None and not design.region.isdecimal():
        raise InputError(f"⟨design.region⟩ must be a number of pixels or a picture, got {design.region!r}")
    return Region(design.efficiency, 0 if given is not None else int(design.region), given)


def stage_of(table: Mapping[str, Any], settings: Settings) -> Stage:
    """The stage of a table of complete settings."""
    t = StageSettings(stage_base(settings, "grid"), table)
    filter = filter_from(t.reconstruction, t.filter_size, build_screen(settings.screen), t.alpha_per_mm2, t.alpha_per_pixel2)
    return Stage(
        t.control,
        t.rays,
        t.sampler,
        LossImage(filter, t.blur, t.apron, t.oversample, settings.design.filter_target, region_of(settings.design)),
        t.iterations,
        t.tolerance,
        None if t.source is None else build_source(settings.source, t.source, settings.lens),
        t.waves or (),
        t.spread,
        t.lenslets,
        t.spare,
    )


def build_options(settings: Settings) -> Options:
    """The design options of complete settings."""
    d = settings.design
    if settings.lens.finish:
        finishing.refuse_program(finishing.parse(settings.lens.finish))
    check_all("design", d, "dtype", "seed", "iterations")
    for key in ("time_limit", "checkpoint_every"):  # which may be infinite
        if not d[key] > 0:
            raise InputError(f"⟨design.{key}⟩ must be greater than 0 s, got {d[key]:g}")
    architecture = Architecture(d.network_layers, d.network_width, d.activation)
    return Options(
        d.loss,
        d.optimizer,
        d.lr,
        Parametrisation(d.network, d.initial, d.preconditioner, architecture),
        d.seed,
        getattr(torch, d.dtype),
        Limits(d.max_slope, d.min_radius),
        d.waves == "on",
    )
