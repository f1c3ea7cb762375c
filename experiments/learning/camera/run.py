"""What does a camera learned through trajectories give on frames that were not used? See README.md."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import torch

from examples.learn_camera import FRAMES, MIN_PARALLAX, LearnedCamera, Straightened, describe, learn
from experiments.common import parser_of, place_of, publish, table
from experiments.learning.camera.bent_lens import FOCAL, SIZE, Bent, bent_lens, ray_errors
from torchslam import SLAM, Camera, evaluate, load_config, open_sequence
from torchslam.data import Sequence as Frames
from torchslam.learning import Clips

OFF = 1.05  # how wrong the focal lengths at the start are
SEEDS = (0, 1, 2)  # of the choice of clips, and of the lens
LEARNED = (("focal",), ("focal", "distortion"), ("focal", "distortion", "grid"))
SUPERVISED = {True: "true poses", False: "the images alone"}

DRIVE, SPLIT = "kitti07", 81  # the frames before the split are learned from
DRIVE_FRAMES, DRIVE_PARALLAX = 8, 0.02  # of a clip, and radians: a car shows no more
DRIVE_HEADER = (
    "what is learned | from | fx, fy, cx, cy, k1, k2, p1, p2, k3 | ATE of the other half (m) | CPU (s)"
)

LEARNED_FROM = ("synthetic:room?seed=1", "synthetic:loop?seed=4", "synthetic:corridors?seed=6")
JUDGED_ON = (
    "synthetic:room?seed=3",
    "synthetic:storey?seed=1",
    "synthetic:corridors?seed=5",
    "synthetic:loop?seed=2",
)
ROOM_FRAMES, JUDGED_FRAMES, ROOM_CLIPS = 160, 80, 10
ROOMS_HEADER = (
    "lens | camera | rays off by, rms and largest (px) | ATE (mm): "
    + ", ".join(name.removeprefix("synthetic:") for name in JUDGED_ON)
    + " | over the true lens, geometric mean | CPU (s)"
)


def error(sequence: Frames, camera: Camera, lens: LearnedCamera | None = None, is_held: bool = True) -> float:
    """The ATE of a run, in meters; with a camera that is held, or that the run adjusts.

    Raises SystemExit if a frame has no pose.
    """
    config = load_config(None, ["camera.std=0"] if is_held else [])
    extractor = None
    if lens is not None:
        extractor = Straightened(config.features.num_keypoints)
        extractor.load_state_dict(lens.weights())
    with torch.no_grad():
        run = SLAM(camera, config, extractor).run(sequence)
    assert sequence.groundtruth is not None
    if len(run.trajectory) < len(sequence):
        raise SystemExit(f"{sequence.name}: {len(sequence) - len(run.trajectory)} frames without a pose")
    return evaluate(run.trajectory, sequence.groundtruth).ate_m


def detached(lens: LearnedCamera) -> Camera:
    """The camera of a lens, without a gradient."""
    camera = lens.camera()
    return camera.with_params(camera.params.detach())


def drive_rows() -> list[list[str]]:
    """A half of a drive, with cameras learned on the other half."""
    place = place_of(DRIVE)
    train, test = open_sequence(place, stop=SPLIT), open_sequence(place, start=SPLIT)
    given = train.camera
    scale = given.params.new_ones(len(given.params))
    scale[:2] = OFF
    wrong = given.with_params(given.params * scale)
    rows = []
    for what, camera in (("nothing", given), ("nothing, 5 % off", wrong)):
        rows.append([what, "", describe(camera), f"{error(test, camera):.3f}", ""])
        rows.append([f"{what}, adjusted by the run", "", "", f"{error(test, camera, None, False):.3f}", ""])
    for is_supervised, source in SUPERVISED.items():
        for parts in LEARNED:
            for seed in SEEDS:
                start = time.process_time()
                clips = Clips([train], DRIVE_FRAMES, 30, DRIVE_PARALLAX, seed=seed)
                lens = learn(clips, wrong, is_supervised, parts)
                seconds = time.process_time() - start
                found = error(test, detached(lens), lens)
                what = f"{', '.join(parts)} ({seed})"
                rows.append([what, source, describe(lens.camera()), f"{found:.3f}", f"{seconds:.0f}"])
                print(" | ".join(rows[-1]), flush=True)
    return rows


def room_rows(seed: int) -> list[list[str]]:
    """Recordings through one lens, with cameras learned on others through the same."""
    lens = bent_lens(seed)
    cx, cy = ((side - 1) / 2 for side in SIZE)
    given = Camera.pinhole(OFF * FOCAL, OFF * FOCAL, cx, cy, size=SIZE)
    train = [Bent(open_sequence(name, stop=ROOM_FRAMES), lens, given) for name in LEARNED_FROM]
    test = [Bent(open_sequence(name, stop=JUDGED_FRAMES), lens, given) for name in JUDGED_ON]
    clips = Clips(train, FRAMES, ROOM_CLIPS, MIN_PARALLAX, seed=seed)

    exact = [error(each, detached(lens), lens) for each in test]
    rows = []

    def row(name: str, found: Sequence[float], of: LearnedCamera, seconds: float | None = None) -> None:
        off = ", ".join(f"{each:.2f}" for each in ray_errors(of, lens))
        ratio = math.exp(sum(math.log(a / b) for a, b in zip(found, exact, strict=True)) / len(exact))
        millimeters = ", ".join(f"{1e3 * each:.1f}" for each in found)
        taken = "" if seconds is None else f"{seconds:.0f}"
        rows.append([str(seed), name, off, millimeters, f"{ratio:.2f}", taken])
        print(" | ".join(rows[-1]), flush=True)

    row("the true lens", exact, lens)
    start = LearnedCamera(given)
    row("given: 5 % off, straight", [error(each, given) for each in test], start)
    row("given, adjusted by the run", [error(each, given, None, False) for each in test], start)
    without_grid = LearnedCamera(detached(lens))
    row("the true camera without the grid", [error(each, detached(lens)) for each in test], without_grid)
    for is_supervised, source in SUPERVISED.items():
        began = time.process_time()
        found = learn(clips, given, is_supervised)
        seconds = time.process_time() - began
        row(f"learned from {source}", [error(each, detached(found), found) for each in test], found, seconds)
    return rows


def main() -> None:
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("recordings", choices=("drive", "rooms"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.recordings == "drive":
        text = table(DRIVE_HEADER, drive_rows())
    else:
        text = table(ROOMS_HEADER, [row for seed in SEEDS for row in room_rows(seed)])
    marks = f"<!-- {arguments.recordings} -->\n", f"<!-- end {arguments.recordings} -->"
    publish(text, arguments, __file__, *marks)


if __name__ == "__main__":
    main()
