"""Does the check of a map find maps that were bent by hand, without a false alarm on right ones? See README.md."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from experiments.common import (
    add_engine,
    available,
    cached_run,
    check,
    parser_of,
    place_of,
    run_cases,
    table,
    write_between,
)
from torchslam.batch import DONE, Columns
from torchslam.batch.rows import short_name
from torchslam.config import Config
from torchslam.data import Sequence, open_sequence
from torchslam.evaluation import evaluate
from torchslam.geometry import se3_inverse
from torchslam.global_mapping.check import MapCheck, check_map
from torchslam.global_mapping.recording import keyframe_pairs
from torchslam.system.slam import SLAM
from torchslam.types import Trajectory

HERE = Path(__file__).parent
BACKWARD = -1
PARTS: dict[str, list[tuple[int, int, int]]] = {
    "redkitchen": [
        *((start, start + 100, 2) for start in range(0, 1000, 100)),
        (0, 150, 3),
        (400, 550, 3),
        (700, 780, BACKWARD),
        (200, 280, BACKWARD),
    ],
    "kitti07": [(0, 80, 1), (80, 160, 1), (40, 120, 1), (0, 60, BACKWARD)],
    "machine_hall": [(0, 80, 1), (80, 160, 1), (0, 120, 2), (100, 220, 2), (0, 180, 3), (0, 80, BACKWARD)],
    "fr2_desk_20": [(0, 20, 1), (0, 20, BACKWARD)],
    "shelf_bin": [(0, 50, 1), (0, 25, 1), (25, 50, 1), (0, 50, 2), (0, 50, BACKWARD)],
    "garden": [(0, 60, 1), (0, 40, 1), (30, 70, 1)],
} | {f"synthetic:room?frames=60&seed={seed}": [(0, 60, 1)] for seed in range(20)}
"""First frame, end and stride of the parts of sequences that are run."""
SCALES = 1.1, 1.2, 1.5
RIGHT, POSED = 0.02, 0.98
"""A run is right if its ATE is below this share of the extent of the true path, and so many frames are posed."""
WAYS = (*(f"scale {scale:g}" for scale in SCALES), "wrong loop")
HEADER = "maps | number | called wrong or uncertain"
MARKS = "<!-- check -->\n", "<!-- end of check -->"


class Backward(Sequence):
    """The frames of a sequence in reverse."""

    def __init__(self, forward: Sequence) -> None:
        times = (forward.timestamps[-1] - forward.timestamps).flip(0)
        truth = forward.groundtruth
        if truth is not None:
            truth = Trajectory((forward.timestamps[-1] - truth.timestamps).flip(0), truth.T_wc.flip(0))
        super().__init__(forward.name, forward.kind, forward.camera, times, truth)
        self._forward = forward

    def image(self, index: int) -> Float[Tensor, "1 1 H W"]:
        return self._forward.image(len(self) - 1 - index)

    def image_name(self, index: int) -> str:
        return self._forward.image_name(len(self) - 1 - index)


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    add_engine(parser, "map_check")
    options = parser.parse_args()
    cases = [
        {"sequence": name, "part": list(part), "output": str(options.output.absolute())}
        for name in available(PARTS)
        for part in PARTS[name]
    ]
    found = run_cases(attempt, cases, options, lambda columns: print(columns, flush=True))
    check(found)
    right = [columns for columns in found if columns["is_right"]]
    rows = [["right", str(len(right)), str(sum(bool(each["alarm"]) for each in right))]]
    rows += [
        [f"bent: {way}", str(len(right)), str(sum(each["found"][way] for each in right))] for way in WAYS
    ]
    others = [columns for columns in found if not columns["is_right"]]
    rows.append(["not right", str(len(others)), str(sum(bool(each["alarm"]) for each in others))])
    print(text := table(HEADER, rows))
    if not options.no_readme:
        write_between(HERE / "README.md", text, *MARKS)


def attempt(case: Columns) -> Columns:
    """Run a part of a sequence, check its map, bend it and check it again. Never raises."""
    start, stop, stride = case["part"]
    name = "_".join([short_name(case["sequence"].removeprefix("synthetic:")), *map(str, case["part"])])

    def work(folder: Path) -> Columns:
        torch.set_num_threads(1)
        sequence = open_sequence(place_of(case["sequence"])).part(start, stop, max(stride, 1))
        return {"status": DONE} | tried(Backward(sequence) if stride == BACKWARD else sequence)

    return cached_run(name, case["sequence"], map(str, case["part"]), work, case["output"], HERE)


@torch.no_grad()
def tried(sequence: Sequence) -> Columns:
    """Whether the run is right, what the check says of it (`alarm`, empty if nothing), which bent maps are `found`."""
    run = SLAM(sequence.camera, Config()).run(sequence)
    pairs = None if run.failure else keyframe_pairs(run)
    if pairs is None or sequence.groundtruth is None:
        return {"is_right": False, "alarm": run.failure or "nothing to check", "found": {}}
    truth = sequence.groundtruth.positions_w
    extent = float((truth.amax(0) - truth.amin(0)).norm())
    error = evaluate(run.trajectory, sequence.groundtruth).ate_m / extent
    T_cw, views, matched = pairs
    known = torch.ones(len(views), dtype=torch.bool)
    reduction = run.config.features.reduction(run.camera.size)

    def checked(T_cw: Tensor) -> MapCheck:
        return check_map(T_cw, known, views, matched, run.camera, None, reduction)

    before = checked(T_cw)
    bends: list[Callable[[Tensor], Tensor]] = [partial(scaled, factor=factor) for factor in SCALES]
    bent = dict(zip(WAYS, [*bends, closed_wrongly], strict=True))
    return {
        "is_right": error < RIGHT and len(run.trajectory) >= POSED * len(sequence),
        "error": error,
        "posed": len(run.trajectory),
        "keyframes": len(views),
        "alarm": before.sentence() if is_alarm(before) else "",
        "found": {way: is_alarm(checked(bend(T_cw))) for way, bend in bent.items()},
    }


def is_alarm(found: MapCheck) -> bool:
    """Whether a check contradicts a map, or calls some of its frames uncertain."""
    return not found.is_right or bool(found.uncertain)


def scaled(T_cw: Float[Tensor, "K 4 4"], factor: float, about: int | None = None) -> Float[Tensor, "K 4 4"]:
    """The second half of the poses with another scale, around a camera; None: its first one."""
    T_wc, half = se3_inverse(T_cw), len(T_cw) // 2
    center = T_wc[half if about is None else about, :3, 3].clone()
    T_wc[half:, :3, 3] = center + factor * (T_wc[half:, :3, 3] - center)
    return se3_inverse(T_wc)


def closed_wrongly(T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 4 4"]:
    """The last camera where the first one is, as by a wrong loop that the second half of the poses makes up for."""
    T_wc, half = se3_inverse(T_cw), len(T_cw) // 2
    share = torch.linspace(0, 1, len(T_cw) - half, dtype=T_wc.dtype)
    T_wc[half:, :3, 3] += share[:, None] * (T_wc[0, :3, 3] - T_wc[-1, :3, 3])
    return se3_inverse(T_wc)


if __name__ == "__main__":
    main()
