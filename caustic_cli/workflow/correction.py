"""The corrected part: heights that give the picture with the errors of the part that was photographed.

Notation
    H, H'   control heights that were sent to be made, and that are to be sent next, mm
    D       control heights of the design, which give the picture
    e       deviation of the part known before, mm
    s, d    error of the relief's scale and deviation inferred from the photograph: a part of H is made as (1 + s) (H + e) + d

H' solves (1 + s) (H' + e) + d = D.  The errors of the picture are predicted for draws from the posterior of s and d, the same for
both, so that what is refused is a gain that is not certain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import CausticError, InputError
from caustic_cli.io.files import naming
from caustic_cli.kinds import problem_of
from caustic_cli.project import correction, directory, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.packing import rounded
from caustic_cli.project.project import Project
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.photograph import comparison
from caustic_cli.studies.photograph.inference import FOUND
from caustic_cli.studies.photograph.model import Guess, deviation, scaled
from caustic_cli.studies.retrace import retrace
from caustic_cli.workflow import photographs
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.photographs import Judged
from caustic_cli.workflow.progress import provenance
from caustic_cli.workflow.reporter import Reporter

#: Draws from the posterior; rays per pixel of each of the two images by which one is judged, and least and most of them.
DRAWS, EACH, LEAST, MOST = 8, 64, 200_000, 8_000_000
#: Least part of a photograph's variance that a fit must explain, and least gain over its standard deviation; the former without
#: marks, where the wrong part explains much, too.
EXPLAINED, CERTAIN, EXPLAINED_ALONE = 0.99, 2.0, FOUND
PLOT = "correction.png"


def correct(
    path: Path,
    photos: Sequence[Path],
    marks: str | None,
    corners: tuple[str, ...] | None,
    out: Path,
    *,
    force: bool = False,
    device: str = "cpu",
    say: Reporter,
) -> dict[str, Any]:
    """Correct the lens of a project for the errors of a part, by photographs of its caustic; the figures of the JSON table.

    Raises:
        InputError: a photograph is not one of this lens' caustic, or `out` exists.
        CausticError: a photograph is explained badly, the gain is within its uncertainty, or no surface is within the limits.
    """
    project = Project.open(path)
    lens = Lens.of(project)
    taken = photographs.shots(photos, marks, corners, lens.scene.colored)
    if why := photographs.refuse_lens(lens):
        raise InputError(why)
    directory.check(out, force)
    judged = photographs.judge(lens, taken, say)
    refuse_bad_fit(judged)
    every = corrected_heights(project, lens, judged, device)
    heights = exit_of(every)
    figures = predicted(lens, judged, heights)
    with naming(photos[0]):
        refuse_uncertain(figures)
    before = judged.before
    found = judged.found
    known = lens.heights if before is None else lens.heights + before.deviation
    made = scaled(known, found.guess.scale) + deviation(lens.field, found.guess.modes)
    figures["round"] = 1 if before is None else len(before.history) + 1
    history = (*(() if before is None else before.history), figures | {"photo": judged.figures})
    state = replace(lens.state, heights=every, start=None, unrounded=None, optimizer={}, parameters={}, reason="corrected")
    target = replace(project, path=out)
    inputs = {"asked": "", "settings": uptodate.digest(target.settings, target.picture)}
    directory.create(target, force, Checkpoint(state, lens.field.spaces, provenance(target, device), {}, inputs))
    designed = lens.heights if before is None else before.designed
    correction.write(out, correction.Correction(made - lens.heights, designed, history))
    comparison.write_plot(out / PLOT, judged.shown[0], judged.targets[0], found, lens.encoding)
    target.hold.close()
    return {"project": str(out), "correction": figures | {"plot": str(out / PLOT)}, "photo": judged.figures}


def refuse_bad_fit(judged: Judged) -> None:
    """Refuse photographs that the model does not explain.

    Raises:
        CausticError: it does not.
    """
    for photograph, fit in zip(judged.photographs, judged.found.fits, strict=True):
        marked = photograph.camera.marks > 0
        if fit.explained < (least := EXPLAINED if marked else EXPLAINED_ALONE):
            raise CausticError(
                f"{photograph.path}: is explained badly by a deviation of the part: {fit.explained:.2%} of its variance, where"
                f" {least:.2%} are needed{'' if marked else ' without marks'}; nothing is corrected"
            )


def corrected_heights(project: Project, lens: Lens, judged: Judged, device: str) -> Tensor:
    """H', within the limits of the design, (n, m) mm; of a design of several surfaces those of all, (k, n, m), of which only the
    exit is corrected.

    Raises:
        CausticError: there are none.
    """
    guess, before = judged.found.guess, judged.before
    designed = lens.heights if before is None else before.designed
    off = deviation(lens.field, guess.modes)
    wanted = designed - (off - off.mean())
    wanted = wanted.mean() + (wanted - wanted.mean()) / (1.0 + guess.scale)
    if before is not None:
        wanted = wanted - (before.deviation - before.deviation.mean())
    assert lens.state is not None
    wanted, designed = wanted.to(lens.heights.dtype), lens.state.heights
    every = wanted if designed.ndim == 2 else torch.cat([designed[:-1], wanted[None]])
    feasible = rounded(problem_of(project, device).feasible(lens.state.stage, every).detach().cpu())
    return feasible if designed.ndim == 2 else torch.cat([designed[:-1], feasible[-1:]])


def exit_of(heights: Tensor) -> Tensor:
    """Heights (n, m) of the exit, of its own or of those of several surfaces (k, n, m)."""
    return heights if heights.ndim == 2 else heights[-1]


def predicted(lens: Lens, judged: Judged, heights: Tensor) -> dict[str, Any]:
    """Predicted errors of the picture of the part as it is and of a part of H', each with its standard deviation: registered and in
    the frame of the screen; gain and its standard deviation, of registered errors; and how far H' is from H, RMS in µm.  Light of
    the photograph that the fit does not explain may be of the part: it counts as uncertainty, and as many times as the error of a
    part is larger than its picture, since a caustic that has folded is explained by other surfaces, too."""
    known = judged.before.deviation if judged.before is not None else torch.zeros_like(lens.heights)

    def errors(sent: Tensor, guess: Guess) -> tuple[float, float]:
        return errors_of(lens, scaled(sent + known, guess.scale) + deviation(lens.field, guess.modes))

    draws = judged.found.draws(DRAWS)
    now, then = (np.array([errors(sent, guess) for guess in draws]) for sent in (lens.heights, heights))
    gain = now[:, 0] - then[:, 0]
    moved = heights - lens.heights

    fit, seen = judged.found.fits[0], judged.shown[0].irradiance
    unexplained = math.sqrt(max(0.0, 1.0 - fit.explained)) * float(seen.std() / seen.mean()) * max(1.0, float(now[:, 0].mean()))

    def both(values: np.ndarray) -> list[float]:
        return [float(values.mean()), math.hypot(float(values.std(ddof=1)), unexplained)]

    return {
        "registered": both(now[:, 0]),
        "predicted": both(then[:, 0]),
        "error": both(now[:, 1]),
        "predicted_error": both(then[:, 1]),
        "gain": both(gain),
        "moved_um": 1e3 * float((moved - moved.mean()).square().mean().sqrt()),
    }


def errors_of(lens: Lens, part: Tensor) -> tuple[float, float]:
    """Errors of the picture of a part of these heights, registered and in the frame of the screen, by the mean of two images with
    rays of their own, without the noise that their difference shows: that of few rays is no error of a part."""
    target = np.asarray(lens.target)
    rays = min(max(LEAST, EACH * target.size), MOST)
    lit = list(photographs.channels_of(lens.scene)) if lens.scene.colored else ...
    images = [
        retrace(lens.scene, lens.field, part, target, rays=rays, seed=lens.seed + k, noise=False)[0].image.cpu().numpy()
        for k in range(2)
    ]
    aim, a, b = (_over_means(image[lit]) for image in (target, *images))
    image, noise = 0.5 * (a + b), 0.25 * float(np.square(a - b).mean())
    onto = np.array([comparison.registered(*one) for one in zip(image, aim, strict=True)])

    def without_noise(seen: np.ndarray) -> float:
        each = (stack.reshape(-1, stack.shape[-1]) for stack in (seen, aim))
        return math.sqrt(max(0.0, relative_rms(*each) ** 2 - noise))

    return without_noise(onto), without_noise(image)


def _over_means(image: np.ndarray) -> np.ndarray:
    """Images (k, n, m) of an image (n, m), or of one of k colours, each over its mean."""
    each = image.reshape(-1, *image.shape[-2:])
    return each / each.mean((1, 2), keepdims=True)


def refuse_uncertain(figures: dict[str, Any]) -> None:
    """Refuse a correction whose gain is within its uncertainty.

    Raises:
        CausticError: it is.
    """
    (gain, sigma), (now, _), (then, left) = figures["gain"], figures["registered"], figures["predicted"]
    if not gain > CERTAIN * sigma or math.isnan(gain):
        raise CausticError(
            f"leaves nothing to correct for certain: the registered error of the part is {now:.3f}, and a corrected one would have"
            f" {then:.3f} ± {left:.3f}, a gain of {gain:.3f} ± {sigma:.3f}; nothing is written"
        )


def rows(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Rows of the closing table."""
    f = figures["correction"]
    said = {name: f"{f[name][0]:.4f} ± {f[name][1]:.4f}" for name in ("registered", "predicted", "error", "predicted_error")}
    return [
        ("round", str(f["round"])),
        ("error of this part", f"{said['registered']} registered, {said['error']} in the frame of the screen"),
        ("predicted of the next", f"{said['predicted']} registered, {said['predicted_error']} in the frame of the screen"),
        ("heights moved by", f"RMS {f['moved_um']:.2f} µm"),
        ("plot", f["plot"]),
    ]
