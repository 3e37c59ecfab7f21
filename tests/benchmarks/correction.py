"""Parts with form errors, photographed, judged and corrected: errors of the picture as made and after one correction.

    caustic design examples/ball.png --mag 3 --resolution 128 --waves off --control 131 -o ball.caustic
    python tests/benchmarks/correction.py ball.caustic
    python tests/benchmarks/correction.py ball.caustic --only 4 --rounds 2
    caustic design examples/ball.png --mag 3 --resolution 64 --waves off --control 67 -o small.caustic
    python tests/benchmarks/correction.py small.caustic --random 100 --first 7000

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
from photographs import form_error, image_of, photographed, relative_rms, waves

from caustic_cli import load
from caustic_cli.errors import CausticError, InputError
from caustic_cli.studies.photograph import inference
from caustic_cli.studies.photograph.card import marks_of_card
from caustic_cli.studies.photograph.comparison import registered, surfaces
from caustic_cli.workflow import correction, photographs
from caustic_cli.workflow.reporter import Listener

#: RMS in µm, correlation length over the lens, standard deviation of the marks in pixels (None: no marks), seed.
CASES = [
    (1, 1 / 3, 0.05, 1), (3, 1 / 3, 0.05, 2), (3, 1 / 3, 0.25, 3), (1, 1 / 3, 0.25, 4), (10, 1 / 3, 0.05, 7),
    (1, 1 / 10, 0.05, 5), (3, 1 / 10, 0.05, 6), (3, 1 / 3, None, 8),
]  # fmt: skip


def random_cases(count, first=0):
    """Form errors of 0.1 to 3 µm, correlation lengths of a tenth to a half of the lens, marks of 0.05 to 0.5 pixels."""
    for seed in range(first, first + count):
        rng = np.random.default_rng(1000 + seed)
        yield 10 ** rng.uniform(-1, 0.48), 10 ** rng.uniform(-1, -0.3), 10 ** rng.uniform(-1.3, -0.3), seed


def taken(home, lens, heights, error, sigma, seed, **how):
    """A photograph of a part of these heights with this error, its marks beside it, as `workflow.photographs` takes it."""
    half = np.array(lens.scene.screen.half_size)
    data, project = photographed(lens, heights, error, seed=seed, **how)
    photo, marks, known = home / "wall.jpg", None, marks_of_card()
    photo.write_bytes(data)
    if sigma is not None:
        seen = np.stack(project(*known.T), 1) + sigma * np.random.default_rng(seed + 5).standard_normal(known.shape)
        marks = home / "marks.csv"
        np.savetxt(marks, np.concatenate([seen, known * half], 1), delimiter=",")
    return photo, None if marks is None else str(marks)


def judged(lens, um, length, sigma, seed, by_waves=False, **how):
    """A row of figures: nominal, as made, predicted and after the correction, registered and in the frame of the wall."""
    error = form_error(lens.field.half_size[0], 1e-3 * um, 2 * lens.field.half_size[0] * length, seed)
    aim, rays = lens.target / lens.target.mean(), how.pop("judged_by", 2000)

    def errors(heights, off):
        image = image_of(lens, heights, off, lens.target.shape, rays=rays)
        return relative_rms(image, aim), relative_rms(registered(image, aim), aim)

    how |= {"wave": waves(lens, lens.heights, error)} if by_waves else {}
    with tempfile.TemporaryDirectory() as home:
        shot = taken(Path(home), lens, lens.heights, error, sigma, seed, **how)
        began, cpu = time.monotonic(), time.process_time()
        try:
            found = photographs.judge(lens, photographs.shots([shot[0]], shot[1]), Listener())
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


def rounds(path, um, length, sigma, seed, count):
    """Chain corrections of the lens of a project; errors of the picture after each, in the frame of the wall and registered."""
    with tempfile.TemporaryDirectory() as home:
        for k in range(count + 1):
            lens = load(path)
            error = form_error(lens.field.half_size[0], 1e-3 * um, 2 * lens.field.half_size[0] * length, seed)
            image, aim = image_of(lens, lens.heights, error, lens.target.shape), lens.target / lens.target.mean()
            pair = relative_rms(image, aim), relative_rms(registered(image, aim), aim)
            print("round {}: wall {:.4f}, registered {:.4f}".format(k, *pair), flush=True)
            if k < count:
                shot = taken(Path(home), lens, lens.heights, error, sigma, seed + 17 * k)
                path = Path(home) / f"{k}.caustic"
                try:
                    correction.correct(lens.project.path, [shot[0]], shot[1], None, path, say=Listener())
                except CausticError as refusal:
                    print("refused:", refusal)
                    break


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("--random", type=int, default=0, metavar="N", help="so many random parts instead of the table's cases")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="seed of the first of them, 0")
    parser.add_argument("--only", type=int, metavar="K", help="case number K alone")
    parser.add_argument("--rounds", type=int, metavar="K", help="chain so many corrections of the case of --only")
    parser.add_argument("--waves", action="store_true", help="photographs of light as waves")
    parser.add_argument("--quick", action="store_true", help="fewer rays, pixels and modes, for many parts of a small picture")
    asked = parser.parse_args()
    lens, how = load(asked.project), {"by_waves": asked.waves}
    if asked.rounds:
        rounds(asked.project, *CASES[asked.only or 0], asked.rounds)
        return
    if asked.quick:
        photographs.RAYS, correction.DRAWS = 112, 6
        inference.LEVELS = ((32, 6, 1.0, 3), (48, 12, 0.7, 8))
        how |= {"rays": 700, "judged_by": 1000, "size": (450, 400), "blur": 0.8}
    tally = []
    cases = list(random_cases(asked.random, asked.first)) if asked.random else CASES
    cases = cases if asked.only is None else [cases[asked.only]]
    for case in cases:
        f = judged(lens, *case, **how)
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
        tally.append(f)
    summary(tally, len(cases))


def summary(tally, count):
    """How many corrections were refused, made a part worse, or reached what was predicted of them."""
    applied, refused = ([f for f in tally if bool(f["refused"]) == which] for which in (False, True))
    pairs = [(f["made"][1], f["after"][1]) for f in applied]
    beyond = [f for f in applied if f["after"][1] > f["made"][1] + 2 * f["gain"][1]]
    told = [abs(f["after"][1] - f["predicted"][0]) / f["predicted"][1] for f in applied]
    of_surface = [f["miss_um"] / f["said_um"] for f in tally]
    print(
        f"{count} parts: {len(applied)} corrected, {len(refused)} refused, {count - len(tally)} photographs refused;"
        f" of those corrected {sum(after > made for made, after in pairs)} became worse, {len(beyond)} beyond twice the stated"
        f" standard deviation; of those refused {sum(f['after'][1] > f['made'][1] for f in refused)} would have"
    )
    if applied:
        made, after = np.median(pairs, 0)
        print(
            f"median registered error {made:.3f} as made, {after:.3f} corrected; off what was predicted by a median of"
            f" {np.median(told):.2f} and at most {max(told):.2f} sigma, by less than 2 in {np.mean(np.less(told, 2)):.0%}"
        )
    off = np.array([(f["scale"][0] - 1.0) / f["scale"][1] for f in tally])
    print(f"scale of the relief off over what is said: RMS {np.sqrt((off**2).mean()):.2f}, at most {np.abs(off).max():.2f}")
    print(f"surface off over what is said: median {np.median(of_surface):.2f}, 95 % {np.percentile(of_surface, 95):.2f}")


if __name__ == "__main__":
    main()
