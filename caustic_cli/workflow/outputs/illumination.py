"""Target illumination by a lenslet array: image of each lenslet's source, and its brightness by non-negative least squares."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from caustic_cli.inverse.lenslets import lenslets
from caustic_cli.io.picture import read_picture, write_image
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project import colours
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability
from caustic_cli.studies.brightness import brightness
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.retrace import retrace
from caustic_cli.studies.viewing import as_lit
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Output, Rendering, fingerprint
from caustic_cli.workflow.photographs import CHANNELS


@dataclass(eq=False)
class Illumination(Output):
    """The brightness of the source of each lenslet that gives the illumination `want`, in colour that of each colour."""

    option: ClassVar[str] = "want"
    capability: ClassVar[Capability] = Capability("illumination by an array", {})
    files: ClassVar[tuple[str, ...]] = ("wanted.png",)
    beyond: ClassVar[bool] = True

    want: Path
    #: The target illumination on the pixels of the screen (n_x, n_y), or (3, n_x, n_y), placed like the picture of the project.
    target: np.ndarray = field(default_factory=lambda: np.empty((0, 0)), init=False)

    @property
    def asks(self) -> dict[str, object]:
        return {"want": fingerprint(self.want)}

    def unsupported(self, lens: Lens) -> str:
        if lens.project is None or not lens.scene.lens.arrayed:
            return "⟨want⟩ is for a project whose lens is an array of lenslets (caustic design with ⟨+lens.array⟩)"
        return super().unsupported(lens)

    def prepare(self, rendering: Rendering) -> None:
        project, scene = rendering.place.project, rendering.scene
        assert project is not None
        goal = project.settings.target
        light = read_picture(self.want, goal.encoding == "linear", goal.color).irradiance()
        self.target = colours.on_screen(light, scene.light, goal.size, scene.screen, goal.flip)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Solve for the brightnesses and write the resulting image.

        Returns:
            want: `brightness`, N lists of M, in parts of the largest, in colour three times; `error`, relative RMS of the image,
            both scaled to the same power; `kkt_residual`, see `studies.brightness`; `power`, the fraction of the source's that they
            take, if the largest is one; `image`.
        """
        (path,) = self.paths(rendering.place)
        shares, images = zip(*_images(rendering), strict=True)
        scene, pixels = rendering.scene, self.target.shape[-2] * self.target.shape[-1]
        basis = np.moveaxis(np.array(images).reshape(len(images), -1, pixels), 0, -1)  # (colours, pixels, lenslets)
        wanted = self.target.reshape(-1, pixels) * (basis.sum() / self.target.sum())
        parts = scene.light.fractions if scene.colored else (1.0,)
        lit = [k for k, goal in enumerate(wanted) if parts[k] and goal.any()]
        level, residuals = np.zeros((len(wanted), len(images))), []
        for k in lit:
            solved = brightness(basis[k], wanted[k])
            level[k] = solved.brightness
            residuals.append(solved.residual)
        level /= level.max()
        seen = (basis @ level[..., None]).reshape(self.target.shape)
        shown, white = as_lit(scene, seen, self.target)
        write_image(path, shown, white, rendering.lens.encoding)
        by_lenslet = level.reshape(*self.target.shape[:-2], *scene.lens.array)
        found = {
            "brightness": by_lenslet.tolist(),
            "error": relative_rms(*(image.reshape(-1, image.shape[-1]) for image in (seen, self.target))),
            "kkt_residual": max(residuals),
            "power": float(np.array(parts) @ level @ np.array(shares)),
            "image": str(path),
        }
        return {"want": found}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        f = figures["want"]
        found = np.array(f["brightness"])
        names = ("brightness",) if found.ndim == 2 else tuple(f"brightness, {name}" for name in CHANNELS)
        lines = []
        for name, level in zip(names, found.reshape(-1, *found.shape[-2:]), strict=True):
            lines += [(name if k == 0 else "", "  ".join(f"{b:.4f}" for b in line)) for k, line in enumerate(level.T[::-1])]
        rows = [
            *lines,
            ("relative RMS error", f"{f['error']:.4f}"),
            ("KKT residual", f"{f['kkt_residual']:.1e}"),
            ("power", f"{f['power']:.1%} of all sources at the largest brightness"),
            ("image", f["image"]),
        ]
        say.table("brightness of the lenslets' sources", rows)


def _images(rendering: Rendering) -> Iterator[tuple[float, np.ndarray]]:
    """Of each lenslet's source, its share of the light and the image of this light, (n_x, n_y) or (3, n_x, n_y): of a beam through
    the lenslet alone, of a source behind it through the whole array."""
    lens, scene = rendering.lens, rendering.plan.scene
    if scene.source.behind_each:
        whole = zip(scene.by_source, scene.source.fractions, strict=True)
        parts = [(one, lens.field, lens.heights, share) for one, share in whole]
    else:
        own = lenslets(scene, lens.field.shape)
        parts = [(one.scene, one.field, one.of(lens.heights), one.share) for one in own]
    with rendering.say.progress(len(parts)) as show:
        for k, (*one, share) in enumerate(parts):
            show("lenslets", f"{k + 1} of {len(parts)}", k, len(parts))
            yield share, share * _image(rendering, *one, rendering.count // len(parts))


def _image(rendering: Rendering, scene: Scene, field: HeightField, heights: Tensor, rays: int) -> np.ndarray:
    """The image of the light of a scene through a surface: spline spaces and control heights, mm."""
    alone, device = compile_plan(scene, field, heights), rendering.device
    found, _ = retrace(
        alone.scene,
        field,
        heights.to(device),
        None,
        rays=max(1, rays),
        seed=rendering.seed,
        device=device,
        requests=alone.requests,
        noise=False,
    )
    return found.image.cpu().numpy()
