"""Target illumination by a lenslet array: image of each lenslet, and brightness of its source by non-negative least squares."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.inverse.lenslets import lenslets
from caustic_cli.inverse.target import target_on_screen
from caustic_cli.io.picture import read_picture, write_image
from caustic_cli.optics.plan import Plan, compile_plan
from caustic_cli.studies.brightness import brightness
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.retrace import retrace, white_level
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.reporter import Reporter


def target_illumination(lens: Lens, picture: Path) -> np.ndarray:
    """The target illumination on the pixels of the screen (n_x, n_y), placed like the picture of the project.

    Raises:
        InputError: the lens is not an array, or comes from an archive; the picture cannot be read.
    """
    scene, project = lens.scene, lens.project
    if project is None or not scene.lens.arrayed:
        raise InputError("⟨want⟩ is for a project whose lens is an array of lenslets (caustic design with ⟨+lens.array⟩)")
    if scene.colored:
        raise InputError("⟨want⟩ is of brightness alone, and the project's picture has colours")
    goal = project.settings.target
    light = read_picture(picture, goal.encoding == "linear")
    return target_on_screen(light.irradiance(), goal.size, scene.screen, goal.flip)


def solve_brightness(
    lens: Lens, plan: Plan, asked: np.ndarray, image: Path, rays: int, seed: int, device: str, say: Reporter
) -> dict[str, Any]:
    """Solve for the brightnesses and write the resulting image.

    Args:
        asked: from `target_illumination`.
        rays: in total, over all lenslets.

    Returns:
        the figures for JSON: `brightness`, N lists of M, in parts of the largest; `error`, relative RMS of the image, both scaled
        to the same power; `kkt_residual`, see `studies.brightness`; `power`, the fraction of the source's that they take, if the
        largest is one; `image`.
    """
    scene = plan.scene
    parts, images = lenslets(scene, lens.field.shape), []
    with say.progress(len(parts)) as show:
        for k, one in enumerate(parts):
            show("lenslets", f"{k + 1} of {len(parts)}", k, len(parts))
            heights = one.of(lens.heights)
            alone = compile_plan(one.scene, one.field, heights)
            found, _ = retrace(
                alone.scene,
                one.field,
                heights.to(device),
                None,
                rays=max(1, rays // len(parts)),
                seed=seed,
                device=device,
                requests=alone.requests,
                noise=False,
            )
            images.append(one.share * found.image.cpu().numpy())
    basis = np.stack([i.ravel() for i in images], -1)
    on_screen = asked * (basis.sum() / asked.sum())
    solved = brightness(basis, on_screen.ravel())
    level = solved.brightness / solved.brightness.max()
    seen = (basis @ level).reshape(asked.shape)
    write_image(image, seen, white_level(seen, asked), lens.encoding)
    return {
        "brightness": level.reshape(scene.lens.array).tolist(),
        "error": relative_rms(seen, asked),
        "kkt_residual": solved.residual,
        "power": float(np.dot(level, [one.share for one in parts])),
        "image": str(image),
    }


def rows(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """The figures as rows of a table (name, text); brightnesses in the layout of the lenslets seen from +z, +y up, +x right."""
    level = np.array(figures["brightness"]).T[::-1]
    lines = [("brightness" if k == 0 else "", "  ".join(f"{b:.4f}" for b in line)) for k, line in enumerate(level)]
    return [
        *lines,
        ("relative RMS error", f"{figures['error']:.4f}"),
        ("KKT residual", f"{figures['kkt_residual']:.1e}"),
        ("power", f"{figures['power']:.1%} of all sources at the largest brightness"),
        ("image", figures["image"]),
    ]
