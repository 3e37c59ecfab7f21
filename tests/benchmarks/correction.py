"""Parts with form errors, photographed, judged and corrected: errors of the picture as made and after one correction.

    caustic design examples/ball.png --mag 3 --resolution 128 --waves off --control 131 -o ball.caustic
    python tests/benchmarks/correction.py ball.caustic

Photographs and errors of the corrected parts are by the independent tracer of tests/independent/photographs.py; a photograph is an
8-bit JPEG of 900 x 800 pixels through a projective camera with distortion, blur, noise and gamma.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "independent"))
from photographs import form_error, image_of, photographed, relative_rms

from caustic_cli import load
from caustic_cli.errors import CausticError, InputError
from caustic_cli.studies.photograph.card import marks_of_card
from caustic_cli.studies.photograph.comparison import registered, surfaces
from caustic_cli.workflow import correction, photographs
from caustic_cli.workflow.reporter import Listener

#: RMS in µm, correlation length over the lens, standard deviation of the marks in pixels (None: no marks), seed.
CASES = [
    (1, 1 / 3, 0.05, 1), (3, 1 / 3, 0.05, 2), (3, 1 / 3, 0.25, 3), (1, 1 / 3, 0.25, 4), (10, 1 / 3, 0.05, 7),
    (1, 1 / 10, 0.05, 5), (3, 1 / 10, 0.05, 6), (3, 1 / 3, None, 8),
]  # fmt: skip


def random_cases(count):
    """Form errors of 0.1 to 3 µm, correlation lengths of a tenth to a half of the lens, marks of 0.05 to 0.5 pixels."""
    for seed in range(count):
        rng = np.random.default_rng(1000 + seed)
        yield 10 ** rng.uniform(-1, 0.48), 10 ** rng.uniform(-1, -0.3), 10 ** rng.uniform(-1.3, -0.3), seed


def judged(lens, um, length, sigma, seed):
    """A row of figures: nominal, as made, predicted and after the correction, registered and in the frame of the wall."""
    half, (n, m) = lens.scene.screen.half_size, lens.target.shape
    error = form_error(lens.field.half_size[0], 1e-3 * um, 2 * lens.field.half_size[0] * length, seed)
    aim = lens.target / lens.target.mean()

    def errors(heights, off):
        image = image_of(lens, heights, off, (n, m))
        return relative_rms(image, aim), relative_rms(registered(image, aim), aim)

    data, project = photographed(lens, lens.heights, error, seed=seed)
    with tempfile.TemporaryDirectory() as home:
        photo, marks = Path(home) / "wall.jpg", None
        photo.write_bytes(data)
        if sigma is not None:
            known = marks_of_card()
            seen = np.stack(project(*known.T), 1) + sigma * np.random.default_rng(seed + 5).standard_normal(known.shape)
            marks = Path(home) / "marks.csv"
            np.savetxt(marks, np.concatenate([seen, known * np.array(half)], 1), delimiter=",")
        began, cpu = time.monotonic(), time.process_time()
        try:
            found = photographs.judge(lens, photo, None if marks is None else str(marks), None, Listener())
        except InputError as refusal:
            return {"refused": str(refusal)}
        seconds = time.monotonic() - began, time.process_time() - cpu
    heights = correction.corrected_heights(lens.project, lens, found, "cpu")
    predicted, refused = correction.predicted(lens, found, heights), ""
    try:
        correction.refuse_bad_fit(found)
        correction.refuse_uncertain(predicted)
    except CausticError as refusal:
        refused = str(refusal)
    off = surfaces(found.found)[1]
    return {
        "nominal": errors(lens.heights, None), "made": errors(lens.heights, error), "after": errors(heights, error),
        "predicted": predicted["predicted"], "gain": predicted["gain"], "explained": found.found.explained,
        "miss_um": 1e3 * float((off - error).std()), "said_um": 1e3 * found.found.uncertainty(),
        "scale": found.found.scale, "seconds": seconds, "refused": refused,
    }  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("--random", type=int, default=0, metavar="N", help="so many random parts instead of the table's cases")
    parser.add_argument("--only", type=int, metavar="K", help="case number K alone")
    asked = parser.parse_args()
    lens, worse = load(asked.project), 0
    cases = list(random_cases(asked.random)) if asked.random else CASES
    for case in cases if asked.only is None else [cases[asked.only]]:
        f = judged(lens, *case)
        um, length, sigma, seed = case
        print(f"{um:.2f} µm, L/{1 / length:.1f}, marks {sigma if sigma is None else round(sigma, 2)}, seed {seed}:", end=" ")
        if "nominal" not in f:
            print("refused:", f["refused"], flush=True)
            continue
        pair = {name: "{:.3f} ({:.3f})".format(*f[name]) for name in ("nominal", "made", "after")}
        print(
            f"wall (registered): nominal {pair['nominal']}, made {pair['made']}, after {pair['after']},"
            f" predicted {f['predicted'][0]:.3f} ± {f['predicted'][1]:.3f};"
            f" surface off by {f['miss_um']:.3f}, said {f['said_um']:.3f} µm;"
            f" scale {f['scale'][0]:.4f} ± {f['scale'][1]:.4f}; explained {f['explained']:.4f};"
            f" {f['seconds'][0]:.0f} s, {f['seconds'][1]:.0f} of a processor{'; refused' if f['refused'] else ''}",
            flush=True,
        )
        worse += not f["refused"] and f["after"][1] > f["made"][1] + 2 * f["gain"][1]
    print(f"made worse: {worse} of {len(cases)}")


if __name__ == "__main__":
    main()
