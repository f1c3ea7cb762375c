"""How often the stated error of a camera contains the truth: halves of recordings, rendered rooms with a wrong camera.

Rendered rooms are given with a focal length that is off by a random factor of 2 % standard deviation. Of recordings,
two halves are adjusted, and their cameras compared. Cameras are those of the final adjustment, prior and evidence
together, and what the images alone say.

    python -m experiments.self_calibration.errors.run
"""

from __future__ import annotations

import math
import random

import torch

from experiments.common import available, parser_of, place_of, publish, table
from torchslam import SLAM, Config, Run, open_sequence
from torchslam.geometry import Camera
from torchslam.optim.camera_evidence import graph_evidence

ROOMS, FRAMES, OFF = 8, 120, 0.02
"""Of each of two scenes; frames of one; standard deviation of the given focal length."""
HALVES = {
    "kitti07": (0, 80, 160),
    "machine_hall": (0, 160, 320),
    "shelf_bin": (0, 25, 50),
    "redkitchen": (0, 300, 600),
}
"""First frame, middle and end."""
Found = tuple[float, float]  # a focal length and its error, px


def scaled(camera: Camera, factor: float) -> Camera:
    """The camera with another focal length."""
    return camera.with_params(torch.cat([factor * camera.params[:2], camera.params[2:]]))


def found(run: Run) -> tuple[Found, Found]:
    """Focal lengths with their errors: of the final adjustment, and of the images alone."""
    assert run.given is not None
    assert run.calibration is not None
    focal = float(run.camera.focal)
    evidence = graph_evidence(run.graph, run.given)
    assert evidence is not None
    alone = evidence.estimate(len(run.given.directions.T))
    given, unit = float(run.given.camera.focal), run.given.focal_std
    if unit == 0:
        return (focal, focal * run.calibration.focal_std), (given, math.inf)
    step, std = float(alone.step[0]), float(alone.covariance[0, 0].sqrt())
    return (focal, focal * run.calibration.focal_std), (given * (1 + unit * step), given * unit * std)


def apart(one: Found, other: Found) -> float:
    """Their distance in standard errors."""
    return (one[0] - other[0]) / math.hypot(one[1], other[1])


def px(found: Found) -> str:
    """A focal length with its error, if it has one."""
    return f"{found[0]:.1f}" if found[1] == 0 else f"{found[0]:.1f} ± {found[1]:.1f}"


def main() -> None:
    """Run all, and write a line each and the shares into the README."""
    parser = parser_of(__doc__, readme=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rng, errors, rows = random.Random(0), list[tuple[float, float]](), list[list[str]]()

    def compare(name: str, one: tuple[Found, Found], other: tuple[Found, Found]) -> None:
        errors.append((apart(one[0], other[0]), apart(one[1], other[1])))
        rows.append([name, px(one[0]), px(other[0]), f"{errors[-1][0]:+.2f}"])
        print(*rows[-1], sep=" | ", flush=True)

    for number in range(2 * ROOMS):
        scene = ("room", "loop")[number % 2]
        noise = (3, 5, 8)[number % 3]
        name = f"synthetic:{scene}?frames={FRAMES}&seed={number + 1}&noise={noise}&blur=0.8"
        sequence = open_sequence(place_of(name))
        truth = float(sequence.camera.focal), 0.0
        run = SLAM(scaled(sequence.camera, math.exp(rng.gauss(0, OFF))), Config()).run(sequence)
        compare(f"{scene}, seed {number + 1}, noise {noise}", found(run), (truth, truth))
    for name in available(HALVES):
        first, middle, end = HALVES[name]
        halves = []
        for start, stop in ((first, middle), (middle, end)):
            sequence = open_sequence(place_of(name), start=start, stop=stop)
            halves.append(found(SLAM(sequence.camera, Config()).run(sequence)))
        compare(f"{name}, halves", *halves)
    text = table("check | f (px) | truth, or other half (px) | z", rows)
    for column, what in enumerate(("Final adjustment", "Images alone")):
        within = [sum(abs(error[column]) < limit for error in errors) for limit in (1, 2)]
        text += f"\n{what}: {within[0]} of {len(errors)} within one stated error, {within[1]} within two.\n"
    publish(text, options, __file__)


if __name__ == "__main__":
    main()
