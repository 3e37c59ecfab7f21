"""What `test_ranks.py` starts by torchrun: small designs of every kind, then studies, one after the other, into a directory.

    torchrun ... ranks_designs.py DIRECTORY

Chunks of rays are made so small that there are several for every rank to trace.  Each rank says how many items it has computed.
"""

import json
import sys
from pathlib import Path

import torch

import caustic_cli
from caustic_cli.inverse import lamp, objective
from caustic_cli.loading import leave
from caustic_cli.optics import lamp as optics
from caustic_cli.optics import ranks
from caustic_cli.workflow import convergence
from caustic_cli.workflow.convergence import StudyRequest
from caustic_cli.workflow.reporter import Listener

PLAIN = {"resolution": 16, "control": 9, "rays": 2000, "start": "offset", "iterations": 3, "waves": "off"}
SOLVED = PLAIN | {"start": "transport"}
STAGES = {key: value for key, value in PLAIN.items() if key != "rays"}
LAMP = {"lamp": 24, "lamp_inner": 3, "throw": 500, "picture_size": [300, 200]}
LENS = {"type": "lens", "z": 20.0, "thickness": 4.0, "radius": [200.0, -200.0]}
#: Keywords of `caustic_cli.design`.
DESIGNS = {
    "surface": STAGES | {"stages": [{"rays": 1500, "control": [7, 7], "source": "point"}, {"rays": 3000, "control": [9, 9]}]},
    "transport": SOLVED,
    "network": PLAIN | {"network": "dense"},
    "waves": SOLVED | {"waves": "on", "wavelengths": [480, 550, 620], "glass": "N-BK7"},
    "colour": PLAIN | {"color": True, "glass": "N-BK7"},
    "extended": PLAIN | {"source": "disc", "source_size": 0.4, "source_position": [[0, 0, -50]]},
    "sun": SOLVED | {"source": "disc", "source_angle": 0.5},
    "near": PLAIN | {"source": "point", "source_position": [[0, 0, -80]]},
    "several": PLAIN | {"source": {"type": "point", "position": [[0, 0, -80], [1, 0, -80], [0, 1, -80]]}},
    "mirror": PLAIN | {"mirror": True},
    "tilted": PLAIN | {"source_tilt": [20, 0]},
    "two-sides": SOLVED | {"second": "blob.png", "second_at": 200, "throw": 100, "mag": 1, "second_size": [10, 10]},
    "collimated": SOLVED | {"collimate": True},
    "array": SOLVED | {"array": 2, "control": 13},
    "leds": SOLVED
    | {"array": 2, "control": 13, "source": "disc", "source_size": 0.4, "source_position": [[0, 0, -10]], "source_each": True},
    "among": PLAIN | {"element": [LENS]},
    "elements": SOLVED | {"element": [LENS | {"free": "back"}]},
    "range": PLAIN | {"network": "dense", "over": "throw=250:350"},
    "robust": PLAIN | {"robust": "errors.toml"},
    "beam": SOLVED | {"source": "gaussian", "waist": 2.0, "waves": "on", "wavelengths": [633]},
    "index": {"gradient": "free", "resolution": 16, "iterations": 3, "rays": 3000},
    "index-and-exit": {"gradient": "free", "with_surface": True, "resolution": 16, "iterations": 3, "rays": 3000},
    "lamp": LAMP,
    "lamp-of-two": LAMP | {"lamp_surfaces": 2, "lamp_wall": 1.0},
    "lamp-with-chip": LAMP | {"chip": 1.0},
}
#: Studies, and columns of theirs that are times.
STUDIES, TIMES = ("rays", "precision", "effects", "stability"), ("whole", "speedup")


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    objective.CHUNK = objective.CHUNK_OF_ROWS = 700
    optics.CHUNK, lamp.FOLD_POINTS = 1500, 500
    done = counted()
    with ranks.process_group("cpu") as rank:
        if rank:
            ranks.serve()
        else:
            for name, given in DESIGNS.items():
                caustic_cli.design("blob.png", out=folder / name, **given)
            (folder / "studies.json").write_text(json.dumps(studied(caustic_cli.load(folder / "tilted"))))
    (folder / f"rank-{rank}.txt").write_text(f"{sum(done)}")


def studied(lens: caustic_cli.Lens) -> dict[str, list[dict]]:
    """The rows of studies of a lens, without what differs from run to run."""
    found = {}
    for name in STUDIES:
        rays = None if name == "stability" else 1000
        asked = StudyRequest(None if rays is None else lens, "cpu", Listener(), lambda done, total: None, rays=rays)
        rows = convergence.STUDIES[name].measure(asked).rows
        found[name] = [{key: value for key, value in row.items() if "seconds" not in key and key not in TIMES} for row in rows]
    return found


def counted() -> list[int]:
    """Numbers of items that this process computes for `ranks.in_order`, a number for each call."""
    done, usual = [], ranks.in_order

    def in_order(own, *more):
        items = list(own)
        done.append(sum(item is not None for item in items))
        return usual(items, *more)

    ranks.in_order = in_order
    return done


if __name__ == "__main__":
    main(Path(sys.argv[1]))
    leave(0)
