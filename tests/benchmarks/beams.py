"""Shaping a laser beam: least error against efficiency on the six targets of the field, with Gerchberg-Saxton beside it.

    python tests/benchmarks/beams.py [--targets square,diadem] [--efficiencies 0.985,0.97,0.95,0.9] [--region 0] [--cut] [-o FILE]

The targets are those of Pasienski and DeMarco, Opt. Express 16, 2176 (2008), by closed formulas: functions of whole pixels of the
1536 x 1536 transform of 768 x 768 phase pixels under a field exp(-r^2 / (2 x 282.5^2 px^2)).  Here this is a lens of 12 mm behind a
Gaussian beam of 1064 nm, and a screen at 1 m whose pixels, lambda L / 24 mm wide, are those of the transform.

Error: sqrt(mean((I - T)^2 / T^2)) where T is above 10 % of its peak (the mask), I scaled to the same sum there.  Light: fractions
of all behind the lens in the mask, and in the region, the mask dilated by `--region` pixels; and efficiency, the latter over what
it is of the target itself, whose tails leave its mask (12.8 % of the diadem's light).  With `--cut` the target ends at its mask.
All of Gerchberg-Saxton (Gerchberg
and Saxton, Optik 35, 237, 1972) and of its weighted form (Di Leonardo et al., Opt. Express 15, 1913, 2007) are taken on the
transform's own grid; the lens' field, from rays at twice as many points as the design used, is propagated by a plain sum over them
at the middles of the pixels, which shares nothing with the program's transforms.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, uniform_filter

from caustic_cli import Lens, design
from caustic_cli.inverse.wave_objective import FINER
from caustic_cli.optics.region import BRIGHT, dilated
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.waves.image import Imager, lines_of
from caustic_cli.optics.waves.unsupported import receiver_of

SIZE, PIXELS, TRANSFORM, SIGMA = 12.0, 768, 1536, 282.5
WAVELENGTH, THROW = 1.064e-3, 1000.0
#: Width of the screen in pixels, and iterations of Gerchberg-Saxton.
WIDE, ITERATIONS = 384, 100


def grid() -> tuple[np.ndarray, np.ndarray]:
    line = np.arange(WIDE, dtype=float) - WIDE // 2
    return line[:, None], line[None, :]


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    return gaussian_filter(picture.astype(float), sigma, mode="constant", truncate=2.0)


def diadem() -> np.ndarray:
    x, y = grid()
    return np.exp(-((np.hypot(x, y) - 53) ** 2) / 98) + 3 * np.exp(-((abs(x) - 53) ** 2) / 98) * np.exp(-(y**2) / 98)


def shuriken() -> np.ndarray:
    x, y = (c + 13 for c in grid())
    r0, sixty = 40 * math.sin(math.radians(14)) / math.sin(math.radians(106)), math.radians(60)
    inside = np.ones((WIDE, WIDE), bool)
    for j in range(3):
        t = math.pi + 2 * math.pi * j / 3
        a, b = x * math.cos(t) + y * math.sin(t), y * math.cos(t) - x * math.sin(t)
        inside &= a < r0 + abs(b) * (math.cos(sixty) - r0 / 40) / math.sin(sixty)
    return blurred(inside, 2.5)


def square() -> np.ndarray:
    x, y = grid()
    return uniform_filter(((abs(x) <= 58) & (abs(y + 63) <= 58)).astype(float), 9, mode="constant")


def or_gate() -> np.ndarray:
    def bar(cx: float, cy: float, h: float, w: float) -> np.ndarray:
        return (abs(x - cx) <= h / 2) & (abs(y - cy) <= w / 2)

    x, y = (c / 1.25 for c in grid())
    x0, y0 = 260 / 2 - 100, (55 + 35 + 55 + 50) / 2 - 105
    main, foot, tail = bar(x0, y0, 120, 70), bar(x0 + 75 + 25, y0, 50, 70), bar(x0, y0 + 80, 50, 50)
    wires = bar(x0 + 60, y0, 80, 10) | bar(x0, y0 + 45, 10, 60) | bar(x0, y0, 10, 140)
    hole = bar(x0, y0, 70, 25)
    return blurred(((main | foot | tail | wires) + 0.33 * bar(x0, y0, 15, 70)) * ~hole, 1.0)


def squid() -> np.ndarray:
    x, y = grid()
    ring = np.exp(-((np.hypot(x, y) - 53) ** 2) / 98)
    leads = ((abs(x) >= 53) & (abs(x) <= 92.5)) * np.exp(-(y**2) / 98)
    return blurred(np.maximum(ring, leads) * (1 - 0.5 * ((abs(x) <= 5) & (abs(y) <= 88))), 1.5)


def q_tip() -> np.ndarray:
    x, y = grid()
    return np.maximum((abs(x) <= 132) * np.exp(-(y**2) / 24.5), np.exp(-((abs(x) - 132) ** 2 + y**2) / 619.52))


TARGETS = {made.__name__: made for made in (diadem, shuriken, square, or_gate, squid, q_tip)}


class Judge:
    """Figures of an image (WIDE, WIDE) in a target's mask and region; power: of all light, in its unit."""

    def __init__(self, target: np.ndarray, region: int):
        self.target, self.mask = target, target > BRIGHT * target.max()
        self.region = dilated(self.mask, region)

    def __call__(self, image: np.ndarray, power: float) -> dict[str, float]:
        ratio = image[self.mask] / self.target[self.mask]
        ratio /= image[self.mask].sum() / self.target[self.mask].sum()
        own, in_region = self.target[self.region].sum() / self.target.sum(), image[self.region].sum() / power
        return {
            "error": float(np.sqrt(np.mean((ratio - 1) ** 2))),
            "in_mask": float(image[self.mask].sum() / power),
            "in_region": float(in_region),
            "efficiency": float(in_region / own),
        }


def beam() -> torch.Tensor:
    """Amplitude (PIXELS, PIXELS), power 1."""
    line = torch.arange(PIXELS, dtype=torch.float64) - (PIXELS - 1) / 2
    one = torch.exp(-(line**2) / (2 * SIGMA**2))
    field = one[:, None] * one[None, :]
    return field / field.square().sum().sqrt()


def gerchberg_saxton(target: np.ndarray, phase: torch.Tensor, weighted: bool) -> np.ndarray:
    """Power per pixel (WIDE, WIDE) after ITERATIONS from a phase (PIXELS, PIXELS), rad."""
    amplitude, low = beam().float(), TRANSFORM // 2 - WIDE // 2
    seen = slice(low, low + WIDE)
    phase = phase.float()
    wanted = torch.zeros(TRANSFORM, TRANSFORM)
    wanted[seen, seen] = torch.from_numpy(np.sqrt(target / target.sum())).float()
    weight, part = torch.ones_like(wanted), wanted > 0
    for k in range(ITERATIONS + 1):
        far = torch.fft.fftshift(torch.fft.fft2(torch.polar(amplitude, phase), s=(TRANSFORM, TRANSFORM), norm="ortho"))
        if k == ITERATIONS:
            return far[seen, seen].abs().double().square().numpy()
        if weighted:  # pixels that are too dark ask for more
            size = far.abs()[part]
            weight[part] *= (wanted[part] / (size / size.norm()).clamp_min(1e-6)).clamp(0.5, 2.0) ** 0.5
        goal = torch.polar(wanted * weight, far.angle())
        back = torch.fft.ifft2(torch.fft.ifftshift(goal), norm="ortho")[:PIXELS, :PIXELS]
        phase = back.angle()
    raise AssertionError


def by_slmsuite(target: np.ndarray, phase: torch.Tensor) -> np.ndarray:
    """The same by the weighted algorithm of slmsuite, which has to be installed."""
    from slmsuite.holography.algorithms import Hologram  # noqa: PLC0415

    low = TRANSFORM // 2 - WIDE // 2
    wanted = np.zeros((TRANSFORM, TRANSFORM), np.float32)
    wanted[low : low + WIDE, low : low + WIDE] = np.sqrt(target / target.sum())
    hologram = Hologram(wanted, amp=beam().numpy().astype(np.float32), phase=phase.numpy().astype(np.float32))
    hologram.optimize("WGS-Leonardo", maxiter=ITERATIONS, verbose=False)
    found = torch.polar(beam(), torch.from_numpy(np.asarray(hologram.get_phase())).double())
    far = torch.fft.fftshift(torch.fft.fft2(found, s=(TRANSFORM, TRANSFORM), norm="ortho"))
    return far[low : low + WIDE, low : low + WIDE].abs().square().numpy()


def lens_of(target: np.ndarray, efficiency: float, region: int, **options) -> Lens:
    """A lens by the command's own defaults for this beam."""
    pixel = WAVELENGTH * THROW / (2 * SIZE)
    return design(
        target,
        source={"type": "gaussian", "waist": [SIGMA * math.sqrt(2) * SIZE / PIXELS] * 2, "wavelengths": [1e6 * WAVELENGTH]},
        throw=THROW,
        margin=0.0,
        lens_size=[SIZE, SIZE],
        picture_size=[WIDE * pixel, WIDE * pixel],
        resolution=WIDE,
        screen_shift=[-0.5 * pixel, -0.5 * pixel],  # so that pixel WIDE / 2 is the centre of the transform
        loss="log-rms",
        efficiency=efficiency,
        region=str(region),
        lens_fresnel="none",
        waves="on",
        **options,
    )


def field_of(lens: Lens, samples: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Field (n, m) on the plane behind a lens, of which the image is the far field, x, y of its samples, mm, and the distance of
    the screen, mm: by rays traced at twice as many points as in the design, and there; samples: interpolated at so many over the
    lens instead."""
    line = lines_of(lens.scene, lens.field)[0]
    parameters = {EXIT: lens.heights.double()}
    imager = Imager.of([line], parameters, receiver_of(line.system, lens.scene.screen), 2.0 * FINER, dense=True)
    sampling, (mode,) = imager.sampling, imager.modes(line.system)
    grid = sampling.low, sampling.step, sampling.count
    if samples is not None:
        grid = (-SIZE / 2,) * 2, (SIZE / samples,) * 2, (samples,) * 2
    path, amplitude = imager.front(line, mode, parameters).on(*grid).whole
    x, y = (low + step * (np.arange(n) + 0.5) for low, step, n in zip(*grid, strict=True))
    across = (x[:, None] ** 2 + y[None, :] ** 2) / (2 * sampling.distance)
    field = amplitude.numpy() * np.exp(2j * np.pi / WAVELENGTH * (path.numpy() + across))
    return field, x, y, sampling.distance


def propagated(lens: Lens) -> tuple[np.ndarray, float]:
    """Power per pixel (WIDE, WIDE) at the middles of the pixels, and that of all light, by Fresnel's integral as a plain sum."""
    (field, x, y, distance), screen = field_of(lens), lens.scene.screen
    at = [s + w * (np.arange(WIDE) + 0.5 - WIDE / 2) for s, w in zip(screen.shift, screen.pixel, strict=True)]
    kernels = [np.exp(-2j * np.pi / (WAVELENGTH * distance) * np.outer(big, c)) for big, c in zip(at, (x, y), strict=True)]
    density = np.abs(kernels[0] @ field @ kernels[1].T) ** 2 * (x[1] - x[0]) * (y[1] - y[0]) / (WAVELENGTH * distance) ** 2
    return density * screen.pixel[0] * screen.pixel[1], float((np.abs(field) ** 2).sum())


def transport_phase(target: np.ndarray) -> torch.Tensor:
    """Phase (PIXELS, PIXELS), rad, of the lens that the designs start from."""
    lens = lens_of(target, 0.97, 0, stages=[{"waves": [1e6 * WAVELENGTH], "iterations": 0}])
    return torch.from_numpy(np.angle(field_of(lens, PIXELS)[0]))


def measured(name: str, efficiencies: list[float], region: int, iterative: bool, cut: bool) -> dict:
    """Rows of a target."""
    target = TARGETS[name]()
    if cut:
        target = target * (target > BRIGHT * target.max())
    judge, rows = Judge(target, region), {}
    start = transport_phase(target) if iterative else torch.zeros(())
    for method, weighted in (("GS", False), ("weighted GS", True)) if iterative else ():
        began = time.process_time()
        rows[method] = judge(gerchberg_saxton(target, start, weighted), 1.0) | {"seconds": time.process_time() - began}
        print(f"{name} {method}: {rows[method]}", flush=True)
    if iterative and find_spec("slmsuite"):
        began = time.process_time()
        rows["slmsuite"] = judge(by_slmsuite(target, start), 1.0) | {"seconds": time.process_time() - began}
        print(f"{name} slmsuite: {rows['slmsuite']}", flush=True)
    for efficiency in efficiencies:
        began, wall = time.process_time(), time.perf_counter()
        lens = lens_of(target, efficiency, region)
        seconds = {"seconds": time.process_time() - began, "wall": time.perf_counter() - wall}
        rows[f"{efficiency:g}"] = judge(*propagated(lens)) | seconds | {"vortices": lens.figures["beam"]["vortices"]}
        rows[f"{efficiency:g}"]["own_error"] = lens.figures["beam"]["error"]
        print(f"{name} {efficiency:g}: {rows[f'{efficiency:g}']}", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--targets", default=",".join(TARGETS))
    parser.add_argument("--efficiencies", default="0.985,0.97,0.95,0.9")
    parser.add_argument("--region", type=int, default=0, help="pixels by which the mask is dilated")
    parser.add_argument("--cut", action="store_true", help="end targets at their masks, in which all the light is then wanted")
    parser.add_argument("--lenses-only", action="store_true", help="without Gerchberg-Saxton")
    parser.add_argument("-o", "--out", type=Path, help="a JSON file for the figures")
    options = parser.parse_args()
    found = {}
    for name in options.targets.split(","):
        found[name] = measured(
            name, [float(e) for e in options.efficiencies.split(",") if e], options.region, not options.lenses_only, options.cut
        )
        if options.out:
            options.out.write_text(json.dumps(found, indent=1))
    columns = list(next(iter(found.values())))
    print("| target | " + " | ".join(columns) + " |")
    print("| --- " * (len(columns) + 1) + "|")
    for name, rows in found.items():
        print(
            f"| {name} | "
            + " | ".join(f"{r['error']:.4f} at {r['efficiency']:.3f}, {r['in_mask']:.3f} in the mask" for r in rows.values())
            + " |"
        )


if __name__ == "__main__":
    main()
