"""report.png: target, caustic, error, lens height, and loss and light against time, side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caustic_cli.io.files import atomic_path
from caustic_cli.io.picture import SOFTWARE, to_linear, to_srgb
from caustic_cli.scene import Lens, Screen

#: A scale of irradiance that ends below this has no room for ticks between numbers; a black image has such a one.
DARK = 1e-250


def write_report(
    path: Path,
    target: np.ndarray,
    image: np.ndarray,
    heights: np.ndarray,
    history: np.ndarray,
    lens: Lens,
    screen: Screen,
    figures: dict,
    encoding: str,
    waves: np.ndarray | None = None,
) -> None:
    """Write the panels.

    Args:
        target, image: (n_x, n_y) irradiance; drawn at the same exposure and in the picture's encoding, images beside a bar of
            what they are on the screen.
        heights: (a, b) surface heights on an even grid over the aperture, mm; the sphere that fits best is taken out,
            because it hides the relief; of a lens whose index is a volume, that is drawn instead.
        history: (k, 5) rows iteration, stage, loss, on_screen, seconds.
        waves: (n_x, n_y), the wave image, where there is one: light follows it, and errors are its errors.
    """
    import matplotlib  # noqa: PLC0415

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415
    from matplotlib.colors import FuncNorm, Normalize  # noqa: PLC0415

    across = 3 if waves is None else 4
    figure, axes = plt.subplots(2, across, figsize=(4.8 * across, 8.8), constrained_layout=True)
    extent = [-screen.half_size[0], screen.half_size[0], -screen.half_size[1], screen.half_size[1]]
    scale = target.sum() / target.max()

    def titled(name: str, relative: float | None) -> str:
        return name if relative is None else f"{name}\nrelative RMS error {relative:.3f}"

    if waves is None:
        title = titled("caustic", figures["relative_rms"])
        if "least_relative_rms" in figures:
            title += f", {figures['least_relative_rms']:.3f} possible"
        shown = [(target, "target"), (image, title)]
    else:
        shown = [
            (target, "target"),
            (image, titled("by rays", figures["relative_rms"])),
            (waves, titled("what light will do (waves)", figures["wave_relative_rms"])),
        ]
        image = waves
    for axis, (picture, title) in zip(axes[0], shown, strict=False):
        part = picture / max(picture.sum(), 1e-300)
        peak, brightest = figures["wave_peak_irradiance" if picture is waves else "peak_irradiance"], picture
        if picture is target:
            brightest = shown[1][0]
        white = peak / (brightest.max() or 1.0) * brightest.sum() / scale
        white = white if white > DARK else 1.0
        norm = (
            FuncNorm((lambda e, w=white: to_srgb(e / w), lambda v, w=white: w * to_linear(v)), 0.0, white, clip=True)
            if encoding == "srgb"
            else Normalize(0.0, white, clip=True)
        )
        drawn = axis.imshow((part * scale * white).T, origin="lower", extent=extent, cmap="gray", norm=norm)
        if picture is not target:
            figure.colorbar(drawn, ax=axis, label=_irradiance_words(figures, "wave_" if picture is waves else ""))
        axis.set(title=title, xlabel="x on the screen (mm)", ylabel="y (mm)")
    error = image / max(image.sum(), 1e-300) - target / target.sum()
    drawn = axes[0, -1].imshow(error.T * target.size, origin="lower", extent=extent, cmap="coolwarm", vmin=-1.0, vmax=1.0)
    figure.colorbar(drawn, ax=axes[0, -1], label="of the mean irradiance")
    axes[0, -1].set(title="error: too dark (blue), too bright (red)", xlabel="x on the screen (mm)", ylabel="y (mm)")
    rx, ry = lens.half_size
    volume = None if lens.gradient is None else lens.gradient.volume
    shown, unit, name = (
        (_without_sphere(heights, rx, ry) * 1e3, "µm", "lens height, best paraboloid removed")
        if volume is None
        else (volume.mean(-1), "index", "index, mean along z")
    )
    drawn = axes[1, 0].imshow(shown.T, origin="lower", extent=[-rx, rx, -ry, ry], cmap="viridis")
    figure.colorbar(drawn, ax=axes[1, 0], label=unit)
    axes[1, 0].set(title=name, xlabel="x on the lens (mm)", ylabel="y (mm)")
    for stage in np.unique(history[:, 1]):
        rows = history[history[:, 1] == stage]
        axes[1, 1].semilogy(rows[:, 4], rows[:, 2] * target.size, lw=1.5)
        axes[1, 2].plot(rows[:, 4], rows[:, 3], lw=1.5)
    axes[1, 1].set(title="loss of each stage against time", xlabel="s", ylabel="relative RMS")
    axes[1, 2].set(title="light on the screen against time", xlabel="s", ylabel="part of the source's power", ylim=(0.0, 1.0))
    for last in axes[1, 3:]:
        last.set_axis_off()
    for last in axes[1, 1:3]:
        last.grid(alpha=0.3, which="both")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100, metadata={"Software": SOFTWARE})
    plt.close(figure)


def _irradiance_words(figures: dict, prefix: str) -> str:
    """What a bar of irradiance shows, its unit, and the peak and the mean of the image."""
    unit = figures["irradiance_unit"].replace("^2", "²")
    peak, mean = (figures[f"{prefix}{k}_irradiance"] for k in ("peak", "mean"))
    return f"{'illuminance' if unit == 'lux' else 'irradiance'} ({unit}): peak {peak:.3g}, mean {mean:.3g}"


def _without_sphere(heights: np.ndarray, rx: float, ry: float) -> np.ndarray:
    """`heights` less its least-squares fit by 1, x, y, x^2 + y^2."""
    x = np.linspace(-rx, rx, heights.shape[0])[:, None] + np.zeros(heights.shape[1])
    y = np.linspace(-ry, ry, heights.shape[1]) + np.zeros(heights.shape)
    terms = np.stack([np.ones_like(x), x, y, x * x + y * y], -1).reshape(-1, 4)
    fit, *_ = np.linalg.lstsq(terms, heights.reshape(-1), rcond=None)
    return heights - (terms @ fit).reshape(heights.shape)
