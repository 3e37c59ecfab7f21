"""Names of the terms of a loss and reading of their weighted sum, see `losses`; torch is not needed for it."""

from __future__ import annotations

import math

from caustic_cli.errors import InputError

LOSSES = ("rms", "rms-light", "throughput", "light", "diffusion", "uniformity", "log-rms")
PENALTIES = ("laplacian", "curvature")


def parse(text: str) -> list[tuple[float, str]]:
    """ "rms-light + 0.1 laplacian" -> [(1.0, "rms-light"), (0.1, "laplacian")].

    Raises:
        InputError: an unknown name, a weight that is not a number of at least 0, or nothing that looks at the image.
    """
    terms = []
    for part in text.split("+"):
        weight, _, name = part.strip().rpartition(" ")
        try:
            value = float(weight.replace("*", "").strip() or 1.0)
        except ValueError:
            value = math.nan
        if not (0.0 <= value < math.inf) or name not in LOSSES + PENALTIES:
            raise InputError(
                f"⟨design.loss⟩ must be names with weights such as 'rms-light + 0.1 laplacian', of"
                f" {', '.join(LOSSES + PENALTIES)}; got {part.strip()!r}"
            )
        terms.append((value, name))
    if not any(weight > 0 and name in LOSSES for weight, name in terms):
        raise InputError(f"⟨design.loss⟩ must have one of {', '.join(LOSSES)} with a weight above 0, got {text!r}")
    return terms
