"""Figures of a lens as rows for display."""

from __future__ import annotations

from caustic_cli.commands import waves
from caustic_cli.commands.console import noise, number
from caustic_cli.loading import OnDemand

irradiance, accuracy_cost = OnDemand("caustic_cli.studies.irradiance"), OnDemand("caustic_cli.inverse.accuracy_cost")
judge, costs = OnDemand("caustic_cli.studies.judge"), OnDemand("caustic_cli.studies.radius")

#: Keys of the figures of a network's lens that are not values of its inputs.
OF_LENS = ("relative_rms", "noise", "on_screen", "of_source", "middle_relative_rms")

#: Why a design ended, in words, by the first clause of `reason`.
ENDED = {
    "iterations": "after all its iterations",
    "no progress": "since no iteration made progress",
    "time limit": "at the time limit",
}


def ended_words(reason: str) -> str:
    """Why a design ended."""
    first, *more = reason.split("; ", 1)
    return "; ".join([ENDED.get(first, first), *more])


def figures_rows(figures: dict) -> list[tuple[str, str]]:
    """The figures of merit as rows for display: the judged figure, then those of the same image; those of the other image, by rays
    or by waves, in one row that says so, which stands last where waves judge."""
    by_waves = figures.get("error_by") == "waves"
    return [
        ("relative RMS error", waves.error(figures) if by_waves else _error(figures)),
        *_of_start(figures),
        *_limits(figures),
        *_of_beam(figures),
        *([] if by_waves else [("loss (eq. 5.2.1)", number(figures, "loss", ".4e"))]),
        *_of_image(figures, "wave_" if by_waves else ""),
        *_of_radius(figures),
        *_behind(figures),
        ("lost, by rays" if by_waves else "lost", _lost(figures)),
        *_of_glass(figures),
        *([] if by_waves else waves.image_rows(figures)),
        *([("details resolved", number(figures, "resolvable", "d") + " across")] if "resolvable" in figures else []),
        ("rays", number(figures, "rays", ",d")),
        *([] if by_waves else _noise_of_image(figures)),
        ("iterations", number(figures, "iterations", "d")),
        ("time", number(figures, "seconds", ".1f") + " s"),
        *_price(figures),
        ("image", f"{figures['wave_image']}; by rays {figures['image']}" if by_waves else str(figures["image"])),
        *([("ended", ended_words(figures["reason"]))] if "reason" in figures else []),
        *([("by rays alone", waves.rays_alone(figures))] if by_waves else []),
    ]


def _price(figures: dict) -> list[tuple[str, str]]:
    """What a smaller error would cost, of a design."""
    rows = figures.get("accuracy_cost")
    words = accuracy_cost.price([accuracy_cost.Row(**row) for row in rows]) if rows else ""
    return [("accuracy and time", words)] if words else []


def _error(figures: dict) -> str:
    """The error by rays."""
    return number(figures, "relative_rms", ".4f") + waves.beside(figures) + noise(figures, "noise")


def _of_start(figures: dict) -> list[tuple[str, str]]:
    """Errors of the initial surface, and of the lenses of a network."""
    rows = []
    if figures.get("start_error") is not None:
        unsure = judge.judge_of(figures).noise(figures, "start_noise")
        rows = [("of the initial surface", f"{figures['start_error']:.4f}{noise({'start': unsure}, 'start')}")]
    for row in figures.get("over", ()):
        values = ", ".join(f"{key} {row[key]:g}" for key in row if key not in OF_LENS)
        middle = f"that for the middle {row['middle_relative_rms']:.4f}"
        rows.append((f"lens for {values}", f"{row['relative_rms']:.4f}{noise(row, 'noise')}; {middle}"))
    return rows


def _limits(figures: dict) -> list[tuple[str, str]]:
    """What an extended source allows."""
    rows = []
    if "least_relative_rms" in figures:
        rows = [("least possible", number(figures, "least_relative_rms", ".4f") + " or more for any lens, by the source's blur")]
    if "etendue_limit" in figures:
        rows.append(("etendue limit", number(figures, "etendue_limit", ".2%") + " of the light on the lens"))
    return rows


def _of_beam(figures: dict) -> list[tuple[str, str]]:
    """Figures of a shaped laser beam."""
    if "beam" not in figures:
        return []
    of = figures["beam"]
    zeros = f", {of['vortices']} vortices" if "vortices" in of else ""
    return [
        ("error in the mask", f"{of['error']:.4f} of the picture there; peak to valley {of['peak_to_valley']:.4f}{zeros}"),
        ("light in the mask", f"{of['in_mask']:.2%} of that behind the lens; {of['in_region']:.2%} in the region"),
        (
            "width of its edges",
            f"{of['edge_width']:.4g} {figures.get('screen_unit', 'mm')}, from 1/e² to 1 - 1/e² of the irradiance within",
        ),
    ]


def _of_image(figures: dict, prefix: str) -> list[tuple[str, str]]:
    """Figures of the ray image, or of the wave image with the prefix wave_."""
    of = f" of {figures['fractions_of']}" if "fractions_of" in figures else ""
    rows = [
        ("PSNR", number(figures, f"{prefix}psnr_db", ".2f") + " dB"),
        ("SSIM", number(figures, f"{prefix}ssim", ".4f")),
        *([("mean CIEDE2000", number(figures, f"{prefix}ciede2000", ".2f"))] if f"{prefix}ciede2000" in figures else []),
        ("light on the screen", number(figures, f"{prefix}on_screen", ".2%") + of),
        ("light on the picture", number(figures, f"{prefix}on_target", ".2%")),
    ]
    if figures.get("of_source") is not None:
        rows.append(("of all the source emits", f"{100.0 * figures['of_source']:.3g}%: {figures['source_emits']}"))
    if figures.get(f"{prefix}in_black") is not None:
        unsure = "" if prefix else noise(figures, "in_black_noise", ".2%")
        rows.append(("light in black", number(figures, f"{prefix}in_black", ".2%") + unsure))
    if figures.get(f"{prefix}peak_irradiance") is not None:
        rows += [
            (name, f"peak {peak:.4g} {unit}, mean {mean:.4g} {unit}")
            for name, unit, peak, mean in irradiance.in_units(figures, prefix)
        ]
    if figures.get("luminous_flux"):
        each = f"{figures['luminous_efficacy']:.4g} lm/W"
        rows.append(("power of the source", f"{figures['radiant_flux']:.4g} W, {figures['luminous_flux']:.4g} lm ({each})"))
    return rows


def _of_radius(figures: dict) -> list[tuple[str, str]]:
    """What a least radius costs."""
    if not (radius := costs.known_radius(figures)):
        return []
    with_it, without = radius["start_in_black"], radius["start_in_black_without"]
    words = f"first surface {with_it:.2%} in black, {without:.2%} without: {costs.cost_of_radius(radius)}"
    return [(f"a radius of {radius['radius_mm']:g} mm", words)]


def _behind(figures: dict) -> list[tuple[str, str]]:
    """Figures behind the picture."""
    if figures.get("second_relative_rms") is not None:
        error = f"relative RMS error {figures['second_relative_rms']:.4f}{noise(figures, 'second_noise')}"
        return [("second picture", error), ("light on it", number(figures, "second_on_target", ".2%"))]
    if figures.get("angle_rms_mrad") is not None:
        return [("directions off by", number(figures, "angle_rms_mrad", ".3g") + " mrad rms")]
    return []


def _lost(figures: dict) -> str:
    return ", ".join(f"{k.replace('_', ' ')} {value:.2%}" for k, value in figures["lost"].items() if value > 5e-7) or "nothing"


def _of_glass(figures: dict) -> list[tuple[str, str]]:
    if "stock_height_mm" not in figures:
        return []
    return [("glass", f"wall {figures['minimum_wall_mm']:.2f} mm, stock {figures['stock_height_mm']:.2f} mm")]


def _noise_of_image(figures: dict) -> list[tuple[str, str]]:
    if figures.get("error_estimate") is None:
        return []
    in_all = f"; {figures['rays_traced']:,} rays in all" if "rays_traced" in figures else ""
    return [("noise of the image", f"{figures['error_estimate']:.2g}, estimated{in_all}")]
