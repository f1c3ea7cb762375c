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

from experiments.common import available, parser_of, place_of
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


def main() -> None:
    """Run all, print a line each and the shares."""
    parser = parser_of(__doc__)
    parser.parse_args()
    torch.set_num_threads(1)
    rng, errors = random.Random(0), list[tuple[float, float]]()
    for number in range(2 * ROOMS):
        scene = ("room", "loop")[number % 2]
        noise = (3, 5, 8)[number % 3]
        name = f"synthetic:{scene}?frames={FRAMES}&seed={number + 1}&noise={noise}&blur=0.8"
        sequence = open_sequence(place_of(name))
        truth = float(sequence.camera.focal), 0.0
        run = SLAM(scaled(sequence.camera, math.exp(rng.gauss(0, OFF))), Config()).run(sequence)
        final, alone = found(run)
        errors.append((apart(final, truth), apart(alone, truth)))
        print(f"| {name} | {final[0]:.1f} ± {final[1]:.1f} | {truth[0]:.1f} | {errors[-1][0]:+.2f} |")
    for name in available(HALVES):
        first, middle, end = HALVES[name]
        halves = []
        for start, stop in ((first, middle), (middle, end)):
            sequence = open_sequence(place_of(name), start=start, stop=stop)
            halves.append(found(SLAM(sequence.camera, Config()).run(sequence)))
        (one, one_alone), (other, other_alone) = halves
        errors.append((apart(one, other), apart(one_alone, other_alone)))
        print(
            f"| {name} | {one[0]:.1f} ± {one[1]:.1f} | {other[0]:.1f} ± {other[1]:.1f} | {errors[-1][0]:+.2f} |"
        )
    for column, what in enumerate(("final adjustment", "images alone")):
        within = [sum(abs(error[column]) < limit for error in errors) for limit in (1, 2)]
        print(f"{what}: {within[0]} of {len(errors)} within one stated error, {within[1]} within two")


if __name__ == "__main__":
    main()
