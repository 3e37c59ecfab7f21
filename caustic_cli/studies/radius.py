"""What a least radius of concave regions costs, in words."""

from __future__ import annotations

#: Least fraction that is printed with two decimals of a percent.
SMALL = 5e-5


def known_radius(figures: dict) -> dict | None:
    """The figures `min_radius` of a design, None where they say no cost."""
    radius = figures.get("min_radius")
    return radius if radius and radius["in_black_per_mm"] is not None else None


def cost_of_radius(radius: dict) -> str:
    """The change of the light in black per mm of radius, from the figures `min_radius` of a design, as a clause: with its noise if
    it has one; no difference where it is within that."""
    value, noise = radius["in_black_per_mm"], radius["noise"]
    if value == 0.0 or (noise is not None and abs(value) <= noise):
        return "no difference" + (f" beyond the noise of {_percent(noise)} a mm" if noise else "")
    return f"{_percent(value)} a mm" + (f", noise {_percent(noise)}" if noise else "")


def _percent(value: float) -> str:
    """A fraction other than 0 as a percentage that is not rounded to 0."""
    return f"{value:.2%}" if abs(value) >= SMALL else f"{100.0 * value:.1g}%"
