"""Verification against Mitsuba 3, an independent light tracer: statistical comparison of the two images.

Mitsuba loads the exported scene (`export format mitsuba`) and sends independent rays through entrance and exit with its own
intersections and its own `dielectric` (or `roughdielectric`), transmission chosen at both, weighted by its Fresnel factor, and
absorbed over its own paths; what reaches the screen is binned.  Light that leaves through the sides or misses the lens is lost,
as in a render.

Notation, for each pixel, or for bins of `side` x `side` pixels with a sufficient expected number of rays
    M, R        power by Mitsuba and by the render, fractions of the source's
    s_M^2       variance of M, from the sum of squares of the weights of independent rays
    s_R^2       variance of R, from BATCHES independent renders, pooled over 3 x 3 pixels
    s_S         range of R over 3 x 3 times the fraction of a pixel by which TURN displaces light on the screen: error of the mesh
    Z           (M - R) / sqrt(s_M^2 + s_R^2 + s_S^2)

The images agree if Z is noise: mean square near 1, few values beyond 3, none beyond LARGEST; if the power on the screen is the
same; and if M correlates best with R in its own orientation.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.io.files import SOFTWARE, atomic_file
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability
from caustic_cli.studies.independent_rays import sample_rays
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.retrace import BATCHES

VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "scalar_rgb")  # the scalar variant works everywhere but is slow
#: Angle, rad, by which interpolated normals may deflect the light.
TURN = 1e-5
#: Least expected rays of a tested bin, least fraction of the light in tested bins, and most pixels along the side of a bin.
LEAST_RAYS, JUDGED, MOST = 25, 0.8, 32
#: Fraction of normal values beyond 3 sigma; tolerated excess of the mean square over 1, beside its own 3 sigma; largest |Z|.
NORMAL, CHI2, LARGEST = 0.0027, 0.05, 7.0
#: Largest |Z| of the light on the screen, and fraction of it that single precision may lose between triangles and at borders.
LIGHT, LEAK = 4.0, 5e-5
#: Tolerance for a better correlation of a flipped image, which for symmetric pictures differs by noise alone; and standard errors
#: of a correlation, of which that of an even picture consists.
TIE, ERRORS = 1e-2, 4.0
VERIFICATION = Capability.because(
    "comparison with Mitsuba",
    {
        "its rays are straight": ("gradient index",),
        "its rays are traced without polarisation": ("polarisation",),
        "its Fresnel reflection is exact": ("approximate Fresnel",),
    },
    "⟨verify⟩ mitsuba: {reason}, so {{}} cannot be compared",
)


def unsupported(scene: Scene) -> str:
    """Why a scene cannot be verified, "" if it can: Mitsuba is not installed, or it does not trace such scenes."""
    return not_installed() or VERIFICATION.why_not(scene)


def not_installed() -> str:
    """What is said where Mitsuba is not installed, "" where it is."""
    missing = find_spec("mitsuba") is None
    return "⟨verify⟩ mitsuba needs Mitsuba 3, which is not installed: pip install mitsuba" if missing else ""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Result of the comparison.

    render, mitsuba, z: (n_x, n_y), z per bin and NaN where too few rays are expected; figures: for JSON.
    """

    render: np.ndarray
    mitsuba: np.ndarray
    z: np.ndarray
    figures: dict

    @property
    def agree(self) -> bool:
        """Whether the images agree within noise."""
        return self.figures["agree"]


def verify(paths: Sequence[Path], scene: Scene, field: HeightField, heights: Tensor, rays: int, seed: int = 0) -> Agreement:
    """Trace the lens here and its exported scenes in Mitsuba, with about `rays` rays each, and compare.

    paths: of the scenes of its `bands`, one for each index; each is traced with its part of the rays.

    Raises:
        CausticError: no variant of Mitsuba works on this machine, or no light reaches the screen.
    """
    variant = choose_variant()
    import mitsuba as mi  # noqa: PLC0415

    mi.set_log_level(mi.LogLevel.Error)
    image, squares = np.zeros((2, *scene.screen.resolution))
    for k, (path, band) in enumerate(zip(paths, scene.bands, strict=True)):
        world = mi.load_file(str(path), optimize=False)  # optimising would merge entrance and exit into one unnamed mesh
        found = _trace(mi, world, band.scene, max(1, round(rays * band.weight)), [seed, 1, *([k] if k else [])])
        image, squares = image + band.weight * found[0], squares + band.weight**2 * found[1]
    renders = np.array(
        [
            expose(scene, field, heights, rays_of(scene, "stratified", max(1, rays // BATCHES), stream(seed, f"verify {k}")))
            .image.numpy()
            .reshape(-1, *scene.screen.resolution)
            .sum(0)
            for k in range(BATCHES)
        ]
    )
    if not (renders.sum() > 0 and image.sum() > 0):
        raise CausticError("no light reaches the screen, so there is nothing to verify")
    throw = math.hypot(*scene.screen.shift, scene.screen.z - scene.lens.z_in)
    shift = TURN * throw / min(scene.screen.pixel)
    return compare(renders, image, squares, rays, shift, {"mitsuba": mi.__version__, "variant": variant})


def choose_variant() -> str:
    """Set the first variant that works on this machine.

    Each is tried in a subprocess, since Dr.Jit aborts with an LLVM that is too old.  (The environment variable DRJIT_LIBLLVM_PATH
    selects another one.)
    """
    probe = (
        "import sys, mitsuba as mi, drjit as dr; mi.set_variant(sys.argv[1]);"
        "print(dr.maximum(dr.arange(mi.Float, 9) if 'llvm' in mi.variant() else 1.0, 3.0))"
    )
    for variant in VARIANTS:
        if subprocess.run([sys.executable, "-c", probe, variant], capture_output=True, check=False).returncode == 0:
            import mitsuba as mi  # noqa: PLC0415

            mi.set_variant(variant)
            return variant
    raise CausticError(f"⟨verify⟩ mitsuba: none of its variants {', '.join(VARIANTS)} works on this machine")


# tracing


class SceneSurface(NamedTuple):
    """A surface in the order of light: its name in the exported scene, whether it reflects, and the absorption of the medium in
    front of it, 1/mm."""

    name: str
    reflects: bool
    absorption: float


def _trace(mi, world, scene: Scene, rays: int, seed: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Power per pixel [i, j], as a fraction of the source's, and the sums of squares of the contributions of the rays."""
    rng = np.random.default_rng(seed)
    shapes = {shape.id(): shape for shape in world.shapes()}
    image, squares = np.zeros((2, *scene.screen.resolution))
    system = System.of(scene)
    receiver, own = Receiver.of(system, scene.screen), {EXIT: "mirror"} if scene.lens.mirror else {}  # the export's name of it
    elements = [*((own.get(e.name, e.name), e.reflects) for e in system.elements), ("screen", False)]
    surfaces = [SceneSurface(*e, m.absorption) for e, m in zip(elements, system.media(), strict=True)]
    for start, direction, share in sample_rays(scene, rays, rng):
        *points, weight = follow(mi, world, shapes, surfaces, start, direction, rng)
        x, y = receiver.shape.coordinates(np.array(points, np.float64), receiver.middle, receiver.axes)
        image += _binned(x, y, weight * share, receiver)
        squares += _binned(x, y, (weight * share) ** 2, receiver)
    return image / rays, squares / rays**2


def follow(mi, world, shapes, surfaces: list[SceneSurface], start: np.ndarray, direction: np.ndarray, rng: np.random.Generator):
    """Landing points x, y, z (mm) and weights of all rays through this sequence of surfaces; weight 0 where lost.

    Args:
        shapes: of the scene, by name; surfaces: the screen last.
        start: (3, N) mm; direction: (3, N) unit vectors.
        rng: of the facets of rough surfaces.
    """
    return (_follow if "scalar" not in mi.variant() else _follow_scalar)(mi, world, shapes, surfaces, start, direction, rng)


def _follow(mi, world, shapes, surfaces: list[SceneSurface], start: np.ndarray, direction: np.ndarray, rng: np.random.Generator):
    """The same, all rays at a time."""
    ray = mi.Ray3f(mi.Point3f(*map(mi.Float, start)), mi.Vector3f(*map(mi.Float, direction)))
    weight, active = mi.Float(1.0), mi.Bool(True)
    for name, reflects, absorption in surfaces:
        hit = world.ray_intersect(ray, active)
        active &= hit.is_valid() & (hit.shape == mi.ShapePtr(shapes[name]))
        if absorption:
            weight *= mi.Float(np.exp(-absorption * np.array(hit.t, np.float64)))
        if name != "screen":
            facets = mi.Point2f(*map(mi.Float, rng.random((2, start.shape[1]))))
            ray, passed = _onwards(mi, hit, active, reflects, facets)
            weight *= passed
    return *(np.array(c) for c in (hit.p.x, hit.p.y, hit.p.z)), np.where(np.array(active), np.array(weight), 0.0)


def _follow_scalar(
    mi, world, _shapes, surfaces: list[SceneSurface], start: np.ndarray, direction: np.ndarray, rng: np.random.Generator
):
    """The same, ray by ray."""
    out = np.zeros((4, start.shape[1]))
    for k in range(start.shape[1]):
        ray, weight = mi.Ray3f(mi.Point3f(*start[:, k]), mi.Vector3f(*direction[:, k])), 1.0
        for name, reflects, absorption in surfaces:
            hit = world.ray_intersect(ray)
            if not hit.is_valid() or hit.shape.id() != name:
                break
            weight *= math.exp(-absorption * hit.t)
            if name == "screen":
                out[:, k] = hit.p.x, hit.p.y, hit.p.z, weight
            else:
                ray, passed = _onwards(mi, hit, True, reflects, mi.Point2f(*rng.random(2)))
                weight *= passed
    return out


def _onwards(mi, hit, active, reflects: bool, facets):
    """The transmitted ray and its transmittance, or the ray reflected by a mirror, by Mitsuba's BSDF; facets: two random numbers,
    for the facet of a rough surface.

    Component 1 of `dielectric` is transmission; selected alone, its sample is the refracted direction and its weight the Fresnel
    transmittance, 0 for total reflection.  Importance mode: power, not radiance scaled by the index.
    """
    context = mi.BSDFContext(mi.TransportMode.Importance)
    if not reflects:
        context.component = 1
    sample, weight = hit.bsdf().sample(context, hit, 0.5, facets, active)
    return hit.spawn_ray(hit.to_world(sample.wo)), weight[0]


def _binned(x: np.ndarray, y: np.ndarray, value: np.ndarray, receiver: Receiver) -> np.ndarray:
    """Sum of `value` per pixel [i, j]; x, y: its own coordinates from its `middle`, mm."""
    nx, ny = receiver.resolution
    i, j = (np.floor((c - low) / width) for c, low, width in zip((x, y), receiver.low, receiver.pixel, strict=True))
    inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny) & (value > 0)
    at = (i[inside] * ny + j[inside]).astype(np.int64)
    return np.bincount(at, value[inside], nx * ny).reshape(nx, ny)


# comparison


def compare(
    renders: np.ndarray, image: np.ndarray, squares: np.ndarray, rays: int, shift: float = 0.0, about: dict | None = None
) -> Agreement:
    """Z-scores of Mitsuba's image against several renders, and whether they are consistent with noise.

    Args:
        renders: (k, n_x, n_y), independent.
        image, squares: (n_x, n_y), power and the sums of squares of the contributions of the `rays` rays.
        shift: fraction of a pixel by which the light may be displaced.
        about: further figures.
    """
    render = renders.mean(0)
    per_ray, side = squares.sum() / image.sum(), 1
    while side < MOST:
        expected = _rebinned(render, side)
        if expected[expected >= LEAST_RAYS * per_ray].sum() >= JUDGED * expected.sum():
            break
        side *= 2
    z, spread = _z_scores(*(_rebinned(a, side) for a in (renders, image, squares)), rays, per_ray, shift / side)
    some = z[np.isfinite(z)]
    if not len(some):
        raise CausticError(f"{rays:,} rays are too few to test a single pixel; ⟨rays⟩ must be larger")
    sums = renders.sum((1, 2))
    noise = squares.sum() - image.sum() ** 2 / rays + sums.var(ddof=1) / len(sums) + (LEAK * render.sum()) ** 2
    light = float((image.sum() - render.sum()) / noise**0.5)
    chi2, beyond, largest = float(np.mean(some**2)), float(np.mean(abs(some) > 3)), float(abs(some).max())
    turned = _other_orientations(render)
    own, other = _correlation(image, render), max(_correlation(image, t) for t in turned)
    total, of_noise = relative_rms(image, render), _noise(image, squares, renders)
    figures = {
        **(about or {}),
        "rays": rays,
        "pixels": len(some),
        "pixel_side": side,
        "noise": float(spread),
        "relative_rms": total,
        "noise_rms": of_noise,
        "relative_rms_beyond_noise": max(total**2 - of_noise**2, 0.0) ** 0.5,
        "on_screen": float(image.sum()),
        "on_screen_render": float(render.sum()),
        "light_z": light,
        "z_mean": float(some.mean()),
        "z_mean_square": chi2,
        "z_beyond_3": beyond,
        "z_largest": largest,
        "correlation": own,
        "correlation_turned": other,
    }
    figures["agree"] = bool(
        chi2 <= 1 + CHI2 + 3 * (2 / len(some)) ** 0.5
        and beyond <= 2 * NORMAL + 3 * (NORMAL / len(some)) ** 0.5
        and largest < LARGEST
        and abs(light) < LIGHT
        and own >= other - TIE - ERRORS * (1.0 - own * own) / image.size**0.5
    )
    return Agreement(render, image, np.repeat(np.repeat(z, side, 0), side, 1), figures)


def _z_scores(renders: np.ndarray, image: np.ndarray, squares: np.ndarray, rays: int, per_ray: float, shift: float):
    """Z of each bin, NaN where too few rays are expected, and the mean relative noise of the others."""
    render, scatter = renders.mean(0), renders.var(0, ddof=1) / len(renders)
    around = _neighbourhood(render).sum(0)  # pooled variance per unit of power, since few renders estimate that of a pixel poorly
    scatter = render * _neighbourhood(scatter).sum(0) / np.where(around > 0, around, 1.0)
    moved = shift * np.ptp(_neighbourhood(render, "edge"), axis=0)
    judged = render >= LEAST_RAYS * per_ray
    each = np.where(image > 0, squares / np.where(image > 0, image, 1.0), per_ray)  # mean contribution of a ray there
    expected = (image + render) / 2  # with the observed count the variance of a bin with few rays would be underestimated
    variance = np.where(judged, each * expected - expected**2 / rays + scatter + moved**2, 1.0)
    z = np.where(judged, (image - render) / np.sqrt(variance), np.nan)
    return z, np.mean(np.sqrt(variance[judged]) / render[judged]) if judged.any() else 0.0


def _rebinned(a: np.ndarray, side: int) -> np.ndarray:
    """Sums over bins of side x side pixels along the last two axes, zero-padded at the upper borders."""
    nx, ny = (-(-n // side) for n in a.shape[-2:])
    pad = [(0, 0)] * (a.ndim - 2) + [(0, nx * side - a.shape[-2]), (0, ny * side - a.shape[-1])]
    return np.pad(a, pad).reshape(*a.shape[:-2], nx, side, ny, side).sum((-3, -1))


def _neighbourhood(a: np.ndarray, mode: str = "constant") -> np.ndarray:
    """The 3 x 3 pixels around each: (9, n_x, n_y)."""
    padded = np.pad(a, 1, mode=mode)
    return np.array([padded[i : i + a.shape[0], j : j + a.shape[1]] for i in range(3) for j in range(3)])


def _other_orientations(a: np.ndarray) -> list[np.ndarray]:
    """The image in all other orientations that keep its shape."""
    flipped = [a[::-1], a[:, ::-1], a[::-1, ::-1]]
    return flipped if a.shape[0] != a.shape[1] else flipped + [b.T for b in (a, *flipped)]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson correlation over pixels."""
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1]) if np.ptp(a) > 0 < np.ptp(b) else 0.0


def _noise(image: np.ndarray, squares: np.ndarray, renders: np.ndarray) -> float:
    """Expected `relative_rms` from noise alone."""
    return float(np.sqrt(squares.mean() + renders.var(0, ddof=1).mean() / len(renders)) / image.mean())


def write_panels(path: str | Path, found: Agreement, half_size: tuple[float, float]) -> None:
    """Write a PNG with the render, Mitsuba's image, and their difference in standard deviations."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(14.4, 5.0), dpi=100, layout="constrained")
    axes, (sx, sy) = figure.subplots(1, 3), half_size
    white = np.quantile(found.render, 0.999) or 1.0
    shown = {"extent": [-sx, sx, -sy, sy], "origin": "lower"}
    for axis, image, title in zip(axes, (found.render, found.mitsuba), ("caustic", "Mitsuba 3"), strict=False):
        axis.imshow(np.sqrt(np.clip(image / white, 0.0, 1.0)).T, cmap="gray", vmin=0, vmax=1, **shown)
        axis.set(title=title, xlabel="x on the screen (mm)", ylabel="y (mm)")
    z = found.z[: found.render.shape[0], : found.render.shape[1]]
    drawn = axes[2].imshow(z.T, cmap="coolwarm", vmin=-4, vmax=4, **shown)
    figure.colorbar(drawn, cax=axes[2].inset_axes((1.03, 0.0, 0.046, 1.0)), label="standard deviations")
    f = found.figures
    axes[2].set(
        title=f"Mitsuba - caustic: mean Z² {f['z_mean_square']:.3f}, {'agree' if f['agree'] else 'DISAGREE'}",
        xlabel="x on the screen (mm)",
        ylabel="y (mm)",
    )
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})


def rows(f: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of a comparison, with its image, as rows for display."""
    noise = f"{f['z_mean_square']:.3f}, {f['z_beyond_3']:.2%}, {f['z_largest']:.2f}  (of noise: 1, 0.27%, 4)"
    return [
        ("decision", "agree" if f["agree"] else "DISAGREE"),
        ("mean Z^2, beyond 3, largest", noise),
        ("judged", f"{f['pixels']:,} of {f['pixel_side']} x {f['pixel_side']} pixels, {f['noise']:.1%} noise each"),
        ("relative RMS beyond noise", f"{f['relative_rms_beyond_noise']:.4f} of {f['relative_rms']:.4f}"),
        ("light on the screen", f"{f['on_screen']:.6f}, render {f['on_screen_render']:.6f} ({f['light_z']:.1f} sigma)"),
        ("correlation, and turned", f"{f['correlation']:.5f}, {f['correlation_turned']:.5f}"),
        ("image", f["image"]),
    ]
