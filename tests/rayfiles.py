"""Ray files written from the descriptions of their formats, and rays of known sources to write into them."""

from __future__ import annotations

import struct

import numpy as np


def tm25(
    positions,
    directions,
    flux,
    *,
    unit="W",
    wavelengths=None,
    total=None,
    tables=(),
    columns=0,
    text=b"",
    version=2013,
    spectrum=None,
    stokes=False,
    magic=b"TM25",
    count=None,
    flags=None,
    single=float("nan"),
    order="<",
) -> bytes:
    """A file of IES TM-25; every part of its header may be said otherwise than the rays are."""
    n = len(flux)
    spectrum = (2 if wavelengths is not None else 3 if len(tables) == 1 else 0) if spectrum is None else spectrum
    total = float(np.sum(flux)) if total is None else total
    head = magic + struct.pack(f"{order}ii", version, 0)
    head += struct.pack(f"{order}ffQ", total if unit == "lm" else 0.0, total if unit == "W" else 0.0, n if count is None else count)
    head += b"2026-11-22T10:00:00+01:00".ljust(28, b"\0") + struct.pack(f"{order}ii", 0, spectrum)
    head += struct.pack(f"{order}fff", single, 400.0, 700.0) + struct.pack(f"{order}iii", len(tables), columns, len(text))
    head = head.ljust(256, b"\0")
    own = (1, 1, int(unit == "W"), int(wavelengths is not None), int(unit == "lm"), int(stokes), 0, 0)
    head += struct.pack(f"{order}8i", *(own if flags is None else flags))
    head += "LED".encode("utf-32-le").ljust(4000, b"\0") + bytes(8 * 4000)
    block = b"".join(struct.pack(f"<i{2 * len(t)}f", len(t), *np.ravel(t)) for t in tables)
    head += block + bytes(-len(block) % 32) + b"".join(f"column {k}".encode("utf-32-le").ljust(512, b"\0") for k in range(columns))
    rays = [positions, directions]
    if unit == "W":
        rays.append(np.reshape(flux, (n, 1)))
    if wavelengths is not None:
        rays.append(np.reshape(wavelengths, (n, 1)))
    if unit == "lm":
        rays.append(np.reshape(flux, (n, 1)))
    if stokes:
        rays.append(np.zeros((n, 6)))
    rays.append(np.full((n, columns), 7.0))
    return head + text + np.hstack(rays).astype("<f4").tobytes()


def zemax(
    positions,
    directions,
    flux,
    *,
    wavelengths=None,
    length=4,
    form=None,
    luminous=0,
    identifier=1010,
    count=None,
    total=None,
    wavelength=0.0,
    order="<",
) -> bytes:
    """A Zemax binary source file."""
    n = len(flux)
    head = struct.pack(f"{order}iI100s", identifier, n if count is None else count, b"LED")
    head += struct.pack("<7f", 1.0, float(np.sum(flux)) if total is None else total, wavelength, 0, 0, 0, 0)
    head += struct.pack("<i", length) + struct.pack("<13f", *[0.0] * 13)
    head += struct.pack("<4i", (2 if wavelengths is not None else 0) if form is None else form, luminous, 0, 0)
    rays = [positions, directions, np.reshape(flux, (n, 1))]
    if wavelengths is not None:
        rays.append(np.reshape(wavelengths, (n, 1)) / 1000.0)
    return head + np.hstack(rays).astype("<f4").tobytes()


def lighttools(positions, directions, flux, *, wavelengths=None, end="\n", closing=True, **said) -> bytes:
    """A LightTools ray file as text; `said` replaces lines of its header."""
    lines = {
        "lt_rdf_version": "2.0",
        "dataname": "LED",
        "lt_datatype": "radiant_power",
        "lt_radiant_flux": f"{np.sum(flux):.9g}",
        "lt_far_field_data": "NO",
        "lt_color_info": "none" if wavelengths is None else "wavelength",
        "lt_length_units": "millimeters",
        "lt_data_origin": "0 0 0",
    } | {f"lt_{k}": v for k, v in said.items()}
    rays = np.hstack(
        [positions, directions, np.reshape(flux, (-1, 1))] + ([] if wavelengths is None else [np.reshape(wavelengths, (-1, 1))])
    )
    rows = ["  ".join(f"{v:.9g}" for v in ray) for ray in rays]
    text = ["# LightTools", "# Ray Data Export File", *(f"{k}: {v}" for k, v in lines.items()), "lt_startofdata", *rows]
    return end.join([*text, *(["lt_endofdata"] if closing else []), ""]).encode()


def cone_of(n: int, half_angle: float, size=(0.0, 0.0), seed: int = 0, lambertian: bool = False):
    """(positions, directions, flux) of n rays from an even ellipse of that size, mm, about the origin, into a cone, degrees."""
    rng = np.random.default_rng(seed)
    a, b, u, v = rng.random((4, n))
    cone = np.radians(half_angle)
    cosine = np.sqrt(1 - a * np.sin(cone) ** 2) if lambertian else 1 - a * (1 - np.cos(cone))
    sine = np.sqrt(1 - cosine**2)
    directions = np.stack([sine * np.cos(2 * np.pi * b), sine * np.sin(2 * np.pi * b), cosine], 1)
    r = np.sqrt(u) / 2
    positions = np.stack([size[0] * r * np.cos(2 * np.pi * v), size[1] * r * np.sin(2 * np.pi * v), np.zeros(n)], 1)
    return positions, directions, np.full(n, 1.0 / n)
