"""A complete render: open the lens, compile the scene into a plan, retrace it, write images and figures."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from caustic_cli.config.design import filter_from
from caustic_cli.config.tolerances import read as read_tolerances
from caustic_cli.errors import InputError
from caustic_cli.export.mitsuba import quick_samples, write_mitsuba
from caustic_cli.export.page import refuse_untraceable
from caustic_cli.io.files import destination, discard, refuse_foreign, sha256_of
from caustic_cli.io.picture import WIDE, said_of, write_image, write_npy
from caustic_cli.optics.emission.measured import coarse_words
from caustic_cli.optics.plan import Plan, parse_effects
from caustic_cli.optics.surfaces.cut import CutSurface
from caustic_cli.project.archived import origin_of
from caustic_cli.project.project import FARTHER, WAVE, Project, beside
from caustic_cli.project.uptodate import FILES, Outputs, image_provenance
from caustic_cli.scene import Scene
from caustic_cli.studies import effects as effects_study
from caustic_cli.studies import manufacture
from caustic_cli.studies.irradiance import irradiance
from caustic_cli.studies.metrics import judged
from caustic_cli.studies.retrace import FINAL_RAYS, white_level
from caustic_cli.studies.second_target import second_figures
from caustic_cli.studies.verify import require_mitsuba, verify, write_panels
from caustic_cli.workflow import page
from caustic_cli.workflow.compilation import compile_for
from caustic_cli.workflow.illumination import solve_brightness, target_illumination
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.machining import cut_surface, form_deviation
from caustic_cli.workflow.reporter import Reporter
from caustic_cli.workflow.tolerances import tolerances

#: Default number of rays: initial for a tolerance, and for evaluations other than the image.
BESIDE_RAYS = 1_000_000
#: Ratio of the noise of an existing image to that of a new one below which the existing one is kept.
QUIETER = 0.9


@dataclass(frozen=True)
class Request:
    """Parameters of a render.

    Args:
        lens: project directory, or an exported .npz archive.
        rays: traced; with `tolerance`, the initial number; None for that of the evaluation of a design.
        tolerance: relative RMS noise of the image, for which the number of rays is increased, or None.
        reconstruction, filter_size, alpha: of the image; alpha in 1/mm^2, None for 1 per pixel^2.
        given: path in `config.table` -> value, overriding the settings of the project.
        screen_at: the screen's z instead of the scene's, mm.
        effects: auto, none or names, see `optics.plan.parse_effects`; explain: measure the cost of each.
        image, npy: files to write; None for render.png in the project, and for no .npy.
        html: file for an interactive page, or None.
        verify: compare with Mitsuba; report: write manufacturing figures, tool_radius in mm.
        cut: G-code program whose machined surface is traced instead of the designed one.
        force: replace files not made by this program, and repeat what is up to date.
        seed, dtype: of rays; None for the seed of the project, and float64.
        tolerances: TOML file of errors for a tolerance analysis.
        want: picture of a target illumination, for the brightness of the sources of an array.
        at: parameter values for a network that was trained over ranges, "throw=300"; None for their middle.
    """

    lens: Path
    rays: int | None = None
    tolerance: float | None = None
    reconstruction: str = "bincount"
    filter_size: tuple[int, int] = (3, 3)
    alpha: float | None = None
    given: Mapping[str, Any] = field(default_factory=dict)
    screen_at: float | None = None
    effects: str = "auto"
    explain: bool = False
    image: Path | None = None
    npy: Path | None = None
    html: Path | None = None
    verify: bool = False
    report: bool = False
    tool_radius: float | None = None
    cut: Path | None = None
    force: bool = False
    seed: int | None = None
    dtype: torch.dtype = torch.float64
    tolerances: Path | None = None
    want: Path | None = None
    at: str | None = None

    @property
    def count(self) -> int:
        """Number of rays for evaluations other than the image."""
        return BESIDE_RAYS if self.rays is None else self.rays

    @property
    def shows(self) -> dict[str, object]:
        """Parameters that determine the image, except for its noise, where they differ from their defaults."""
        usual = {f.name: f.default for f in fields(self)}
        names = ("reconstruction", "filter_size", "alpha", "screen_at", "effects", "at")
        cut = {"cut": _fingerprint(self.cut)} if self.cut else {}
        given = {key: _fingerprint(value) if key in FILES else value for key, value in dict(self.given).items()}
        return {name: getattr(self, name) for name in names if getattr(self, name) != usual[name]} | cut | given

    @property
    def asks(self) -> dict[str, object]:
        """Parameters that determine the result, without the names of outputs."""
        names = (
            "rays",
            "tolerance",
            "reconstruction",
            "filter_size",
            "alpha",
            "screen_at",
            "effects",
            "explain",
            "report",
            "tool_radius",
            "seed",
            "dtype",
            "at",
        )
        cut = {"cut": _fingerprint(self.cut)} if self.cut else {}
        off = {} if self.tolerances is None else {"tolerances": read_tolerances(self.tolerances)}
        want = {"want": _fingerprint(self.want)} if self.want else {}
        return {name: getattr(self, name) for name in names} | cut | off | want | dict(self.given)


def _fingerprint(path: Path | str) -> str:
    """Path and hash of a file, which change with its content; the path alone if it cannot be read."""
    return f"{path} {sha256_of(path)}".rstrip()


def render(asked: Request, device: str, say: Reporter) -> dict:
    """Trace a lens and write its irradiance image.

    Returns:
        the figures of the JSON table; `effects`, `report` and `verify` if requested; those of the earlier run if all is up to date.

    Raises:
        InputError: there is no lens, a value is out of range, or a file exists already; nothing was written.
    """
    began = time.monotonic()
    parse_effects(asked.effects)
    if asked.image is not None and asked.image.suffix.lower() not in ("", ".png"):
        raise InputError(f"{asked.image}: ⟨out⟩ is a PNG, and its name must end in .png")
    for path in [path for path in (asked.image, asked.npy, asked.html) if path is not None]:
        destination(path)  # refuses what is no file name, before others are made of it
    origin = origin_of(asked.lens, asked.at)
    project = origin if isinstance(origin, Project) else None
    if project is None and asked.tolerances is not None:
        raise InputError("⟨tolerances⟩ compares with the picture, which an archive does not hold; render its project")
    image_path = asked.image or origin.image

    def companion(name: str) -> Path:
        return image_path.with_name(name if asked.image is None else f"{image_path.stem}-{name}")

    panels = companion("verify.png") if asked.verify else None
    sheet = companion("report.json") if asked.report else None
    wave_path, wave_npy = beside(image_path), beside(asked.npy) if asked.npy else None
    off = None if asked.tolerances is None else read_tolerances(asked.tolerances)
    draws = (companion("tolerances.csv"), companion("tolerances.png")) if off else (None, None)
    in_project = asked.image is None and project is not None
    farther = image_path.with_name(FARTHER) if in_project else image_path.with_stem(f"{image_path.stem}-second")
    second = farther if project and project.second is not None else None
    lit = companion("wanted.png") if asked.want else None
    paths = (image_path, asked.npy, asked.html, panels, sheet, wave_path, wave_npy, second, *draws, lit)
    for path in paths:
        if path is not None:
            refuse_foreign(path, asked.force)
    made = Outputs(project, "render", asked.asks | {"device": device}, paths) if project and not asked.verify else None
    if made and not asked.force and (figures := made.found()):
        say.say(
            f"{image_path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it"
        )
        return figures
    lens = Lens.of(origin, asked.given)
    if asked.screen_at is not None:
        lens = replace(lens, scene=replace(lens.scene, screen=replace(lens.scene.screen, z=asked.screen_at)))
    scene = lens.scene
    goal = None if asked.want is None else target_illumination(lens, asked.want)
    if asked.verify:
        require_mitsuba(scene)
    if asked.html is not None:
        refuse_untraceable(scene)
    _refuse_unknown(asked, scene)
    filter = filter_from(asked.reconstruction, asked.filter_size, scene.screen, asked.alpha)
    seed = lens.seed if asked.seed is None else asked.seed
    cut = None if asked.cut is None else cut_surface(asked.cut, scene, lens.field, asked.tool_radius)
    deviation = {} if cut is None else form_deviation(cut, lens.field, lens.heights, scene.lens.opening)
    plan = lens.plan(asked.effects, deviation.get("cut_slope_most", 0.0))
    if coarse := coarse_words(scene):
        say.say(coarse)
    if asked.explain:
        compile_for(None, device, say)
    rays = BESIDE_RAYS if asked.rays is None and asked.tolerance is not None else asked.rays
    image, figures = lens.render(
        rays,
        seed=seed,
        tolerance=asked.tolerance,
        filter=filter,
        effects=plan,
        dtype=asked.dtype,
        device=device,
        say=say,
        cut=cut,
    )
    shown = irradiance(image, scene.screen)
    aim = None if lens.target is None else irradiance(lens.target, scene.screen)
    wide = WIDE if asked.image is None else 1
    own = image_provenance(project, lens.state.heights, figures, asked.shows) if project and lens.state else {}
    there = said_of(image_path) if in_project and own and not asked.force else {}
    if there.get("of") == own.get("of") and float(there.get("noise", "inf")) < QUIETER * float(own.get("noise", "inf")):
        say.say(
            f"{image_path}: its noise is {there['noise']}, less than the {own['noise']} of these rays, so it is kept; ⟨force⟩"
            " replaces it, ⟨out⟩ writes another beside it"
        )
        figures["image_kept"] = True
    else:
        write_image(image_path, shown, white_level(shown, aim), lens.encoding, wide, own)
    if scene.second is not None:
        farther_target = lens.origin.second_target(scene)
        with say.notify_if_slow("tracing the light behind the picture"):
            light, more = second_figures(
                plan.scene,
                lens.field,
                lens.heights,
                farther_target,
                rays=FINAL_RAYS if rays is None else rays,
                seed=seed,
                device=device,
                requests=plan.requests,
            )
        figures |= more
        if light is not None:
            write_image(farther, light, white_level(light, farther_target), lens.encoding, wide)
            figures["second_image"] = str(farther)
    if wave_path == asked.lens / WAVE:
        discard(wave_path)  # of an earlier render.png
    if asked.npy is not None:
        write_npy(asked.npy, image)
    waves = None
    if plan["diffraction"].on:
        with say.notify_if_slow("computing the wave image"):
            waves, more = _wave_image(plan, lens, device, asked.effects != "auto", wave_path, wave_npy, cut, wide)
        figures |= more
    figures = judged(figures, lens.by_waves or "diffraction" in (parse_effects(asked.effects) or ()))
    if cut is not None:
        nominal = lens.render(rays, seed=seed, effects=plan, dtype=asked.dtype, device=device, say=say).figures
        if figures["error_by"] == "waves":
            nominal |= lens.render_waves(effects=plan, required=False, device=device).figures
        beside_it = {f"nominal_{name}": nominal[name] for name in ("error", "error_by", "relative_rms", "noise")}
        figures["cut"] = {"program": str(asked.cut)} | beside_it | deviation
    if asked.html is not None:
        page.write(asked.html, lens, plan, figures, waves, asked.lens.resolve().stem)
        figures["page"] = str(asked.html)
    figures |= {
        "iterations": None if lens.state is None else lens.state.total,
        "seconds": time.monotonic() - began,
        "image": str(image_path),
    }
    if asked.explain:
        figures["effects"] = effects_study.explain(
            plan,
            scene,
            lens.field,
            lens.heights.to(device),
            rays=min(asked.count, effects_study.RAYS),
            seed=seed,
            dtype=asked.dtype,
        )
    if sheet is not None:
        figures["report"] = manufacture.manufacture(scene, lens.field, lens.heights, asked.tool_radius, seed)
        manufacture.write_json(sheet, figures["report"])
        say.say(f"{sheet}: manufacturing figures of the lens")
    if off is not None and draws[0] is not None and draws[1] is not None:
        figures["tolerances"] = tolerances(lens, plan, off, *draws, say)
    if goal is not None and lit is not None:
        figures["want"] = solve_brightness(lens, plan, goal, lit, asked.count, seed, device, say)
    if panels is not None:
        figures["verify"] = _verified(scene, lens, asked.count, seed, panels)
    if made:
        made.keep(figures)
    return figures


def _refuse_unknown(asked: Request, scene: Scene) -> None:
    """Refuse studies that support only single lenses of uniform index with a flat entrance.

    Raises:
        InputError: naming the study.
    """
    beyond = "a free-form entrance" if scene.two_sided else "an index that varies" if scene.lens.gradient is not None else ""
    beyond = "other elements beside it" if scene.elements else beyond
    for name, given in (("tolerances", asked.tolerances is not None), ("report", asked.report)):
        if given and beyond:
            raise InputError(f"⟨{name}⟩ supports lenses of uniform index with a flat entrance, and this one has {beyond}")


def _wave_image(
    plan: Plan, lens: Lens, device: str, required: bool, path: Path, npy: Path | None, cut: CutSurface | None, wide: int
) -> tuple[np.ndarray | None, dict]:
    """Write the wave image, at least `wide` columns; returns it, or None if it is not available, and its figures."""
    image, figures = lens.render_waves(effects=plan, required=required, device=device, cut=cut)
    if not image.size:
        return None, figures
    write_image(path, image, white_level(image, lens.target), lens.encoding, wide)
    if npy is not None:
        write_npy(npy, image)
    return image, figures | {"wave_image": str(path)}


def _verified(scene: Scene, lens: Lens, rays: int, seed: int, panels: Path) -> dict:
    """Compare with Mitsuba, at the index of a single wavelength; the figures.  The plot is written to `panels`."""
    if len(scene.light.wavelengths) == 1:
        scene = scene.at(scene.light.wavelengths[0])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "lens.xml"
        write_mitsuba(path, scene, lens.field, lens.heights, quick_samples(lens.field), dark=True)
        found = verify(path, scene, lens.field, lens.heights, rays, seed)
    write_panels(panels, found, scene)
    return found.figures | {"image": str(panels)}
