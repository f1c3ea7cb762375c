"""What does a camera learned through trajectories give on frames that were not used? See README.md."""

from __future__ import annotations

import time

import torch

from examples.learn_camera import LearnedCamera, SeenThrough, describe, learn
from experiments.common import parser_of, place_of, publish, table
from torchslam import ORB, SLAM, Camera, evaluate, load_config, open_sequence
from torchslam.data.sequence import Sequence
from torchslam.learning import Clips

OFF = 1.05  # how wrong the focal lengths at the start are
STEPS = 40
SEEDS = (0, 1, 2)
MIN_PARALLAX = 0.02  # radians: a car shows no more in eight frames
LEARNED = (("focal",), ("focal", "distortion"))
HEADER = "recording | what is learned | from | fx, fy, cx, cy, k1, k2, p1, p2, k3 | ATE of the other half (m) | CPU (s)"
RECORDINGS = {"kitti07": (81, None), "synthetic:room": (100, "320x240")}


def halves(name: str) -> tuple[Sequence, Sequence]:
    """The frames to learn from and the others."""
    split, size = RECORDINGS[name]
    place = place_of(name)
    return open_sequence(place, stop=split, resize_to=size), open_sequence(place, start=split, resize_to=size)


def error(sequence: Sequence, camera: Camera, lens: LearnedCamera | None = None) -> str:
    """The ATE of a run with a camera that is held, in meters, and how many frames have no pose."""
    config = load_config(None, ["camera.std=0"])
    front_end = None if lens is None else SeenThrough(ORB(config.features.num_keypoints), lens)
    with torch.no_grad():
        run = SLAM(camera, config, front_end).run(sequence)
    assert sequence.groundtruth is not None
    missing = len(sequence) - len(run.trajectory)
    found = evaluate(run.trajectory, sequence.groundtruth).ate_m
    return f"{found:.3f}" + (f", {missing} frames without a pose" if missing else "")


def rows_of(name: str) -> list[list[str]]:
    """The lines of one recording."""
    train, test = halves(name)
    given = train.camera
    scale = given.params.new_ones(len(given.params))
    scale[:2] = OFF
    wrong = given.with_params(given.params * scale)
    rows = [
        [name, "nothing", "given", describe(given), error(test, given), ""],
        [name, "nothing", "5 % off", describe(wrong), error(test, wrong), ""],
    ]
    clips = Clips([train], per_sequence=30, min_parallax=MIN_PARALLAX)
    for supervised in (True, False):
        for parts in LEARNED:
            for seed in SEEDS:
                start = time.process_time()
                lens = learn(clips, wrong, STEPS, supervised, parts, seed=seed)
                seconds = time.process_time() - start
                camera = lens.camera()
                camera = camera.with_params(camera.params.detach())
                found = error(test, camera, lens if "grid" in parts else None)
                source = "true poses" if supervised else "the images alone"
                what = f"{', '.join(parts)} ({seed})"
                rows.append([name, what, source, describe(camera), found, f"{seconds:.0f}"])
                print(" | ".join(rows[-1]), flush=True)
    return rows


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("recordings", nargs="*", default=["kitti07"], help=f"of {', '.join(RECORDINGS)}")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    text = table(HEADER, [row for name in arguments.recordings for row in rows_of(name)])
    publish(text, arguments, __file__)


if __name__ == "__main__":
    main()
