"""The least error that any lens can reach under an extended source, by its blur.

    python tests/benchmarks/extended.py      a minute or two; prints a Markdown table

Every point of the lens spreads its light over the same disc on the screen, throw times source size over distance wide.  So an
image is some light that is nowhere negative, convolved with that disc, and the least error is that of a constrained deconvolution,
here by accelerated projected gradients (FISTA).  A point's lens throws the picture itself, convolved with the disc.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.fft import irfft2, rfft2

from caustic_cli.inverse.target import target_on_screen
from caustic_cli.picture import read_picture
from caustic_cli.scene import Screen

PICTURES = Path(__file__).resolve().parents[2] / "examples"
WIDTH, PIXELS, THROW, DISC = 30.0, 250, 300.0, 5.0  # mm; the default lens at magnification 3 without margin
DISTANCES = (5000.0, 2500.0, 1000.0, 500.0, 100.0)
STEPS = 600
FINER = 4  # points to a pixel, along each axis, of the disc


def disc(pixels: int, width: float) -> np.ndarray:
    """An even disc `width` pixels wide in the middle of (pixels, pixels), of sum 1."""
    x = (np.arange(pixels * FINER) - (pixels * FINER - 1) / 2) / FINER
    inside = (x[:, None] ** 2 + x**2 <= (width / 2) ** 2).astype(float)
    kernel = inside.reshape(pixels, FINER, pixels, FINER).mean((1, 3))
    return kernel / kernel.sum()


def errors(name: str, blur: float) -> tuple[float, float]:
    """Relative RMS of a point's lens and of the best there can be, under a disc that blurs over `blur` mm."""
    picture = read_picture(PICTURES / f"{name}.png", linear=True)
    target = target_on_screen(picture.irradiance(), (WIDTH, WIDTH), Screen((WIDTH, WIDTH), THROW, (PIXELS, PIXELS)))
    pad = int(0.5 * blur / WIDTH * PIXELS) + 20
    size = PIXELS + 2 * pad + 1  # odd: the kernel has a middle
    goal, seen = np.zeros((size, size)), np.zeros((size, size), bool)
    seen[pad : pad + PIXELS, pad : pad + PIXELS] = True
    goal[seen] = (target / target.mean()).ravel()
    kernel = rfft2(np.fft.ifftshift(disc(size, blur / WIDTH * PIXELS)))

    def spread(light):
        return irfft2(rfft2(light) * kernel, s=light.shape)

    def error(light):
        return float(np.sqrt(((spread(light) - goal)[seen] ** 2).mean()))

    light, ahead, t, first = goal, goal, 1.0, error(goal)
    for _ in range(STEPS):
        moved = np.maximum(ahead - spread((spread(ahead) - goal) * seen), 0.0)
        moved *= goal.sum() / moved.sum()
        t_next = (1.0 + np.sqrt(1.0 + 4.0 * t * t)) / 2.0
        ahead = np.maximum(moved + (t - 1.0) / t_next * (moved - light), 0.0)
        light, t = moved, t_next
    return first, error(light)


if __name__ == "__main__":
    print("| distance, mm | blur, mm | ball: a point's lens | the least possible | flame: a point's lens | the least possible |")
    print("| --- | --- | --- | --- | --- | --- |")
    for distance in DISTANCES:
        figures = [f"{e:.3f}" for name in ("ball", "flame") for e in errors(name, THROW * DISC / distance)]
        print(f"| {distance:g} | {THROW * DISC / distance:g} | {' | '.join(figures)} |", flush=True)
