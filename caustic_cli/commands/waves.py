"""Figures of the wave image as rows for display, and those of rays beside it."""

from __future__ import annotations

from caustic_cli.commands.console import noise, number

#: Error by rays over that by waves from which on it needs a word.
WORSE = 1.1


def error(figures: dict) -> str:
    """The error where the wave image judges."""
    return f"{number(figures, 'wave_relative_rms', '.4f')} by waves, {_wavelengths(figures)}"


def beside(figures: dict) -> str:
    """What is said of an error by rays."""
    return " by rays" if figures.get("wave_relative_rms") is not None else ""


def _wavelengths(figures: dict) -> str:
    """Wavelengths of the wave image as a clause, with what they represent, or what there is beside them."""
    values, spectrum, beside = figures["wave_wavelengths"], figures.get("wave_spectrum"), figures.get("wave_unseen_relative_rms")
    at = f"{values[0]:.4g} nm" if len(values) == 1 else f"{len(values)} wavelengths, {min(values):.4g} to {max(values):.4g} nm"
    if spectrum is not None:
        rest, seen = figures.get("wave_spectral_error"), "the eye" if figures["wave_detector"] == "eye" else "power"
        sure = "" if rest is None else f"; ± {rest:.1g} by their number"
        return f"at {at}, of the spectrum {spectrum} by {seen}{sure}"
    return f"at {at}" if beside is None else f"at {at}, those of the design; {beside:.4f} at wavelengths 1 % beside"


def image_rows(figures: dict) -> list[tuple[str, str]]:
    """The wave image where it is not the judge."""
    if "no_wave_image" in figures:
        return [("wave image", f"none: {figures['no_wave_image']}")]
    if "wave_wavelengths" not in figures:
        return []
    at = _wavelengths(figures)
    if figures["wave_relative_rms"] is None:  # an archive has no target picture
        return [("wave image", f"on the screen {number(figures, 'wave_on_screen', '.2%')}, {at}")]
    words = f"relative RMS error {number(figures, 'wave_relative_rms', '.4f')}, {at}"
    if "wave_ciede2000" in figures:
        words += f"; mean CIEDE2000 {number(figures, 'wave_ciede2000', '.2f')}"
    words += f"; on the picture {number(figures, 'wave_on_target', '.2%')}"
    if figures.get("wave_in_black") is not None:
        words += f", in black {number(figures, 'wave_in_black', '.2%')}"
    return [("wave image", f"{words}; the design was not refined on it")]


def rays_alone(figures: dict) -> str:
    """Figures of the ray image of a lens that waves judge, and why they are no fault of it where they are worse."""
    worse = (figures.get("relative_rms") or 0.0) > WORSE * figures["error"]
    why = "; no fault of the lens, which was refined for the diffraction that rays leave out" if worse else ""
    return (
        f"relative RMS error {number(figures, 'relative_rms', '.4f')}{noise(figures, 'noise')}, light on the picture"
        f" {number(figures, 'on_target', '.2%')}{why}"
    )
