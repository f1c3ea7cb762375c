"""Which modules of the package does a tracked frame pass? Those with a Python call during one `SLAM.step`.

python -m experiments.benchmarks.slam.modules [SEQUENCE]
"""

from __future__ import annotations

import sys
from collections import Counter
from types import FrameType

from experiments.common import parser_of
from torchslam import SLAM, open_sequence
from torchslam.types import Frame, State, StepResult


def modules_of_step(slam: SLAM, frame: Frame) -> tuple[set[str], StepResult]:
    """The modules of torchslam that one step calls, and the result of the step."""
    seen: set[str] = set()

    def record(call: FrameType, event: str, argument: object) -> None:
        name = call.f_globals.get("__name__", "")
        if event == "call" and name.startswith("torchslam."):
            seen.add(name)

    sys.setprofile(record)
    try:
        result = slam.step(frame)
    finally:
        sys.setprofile(None)
    return seen, result


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("sequence", nargs="?", default="synthetic:room")
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args()
    sequence = open_sequence(options.sequence, limit=options.frames)
    slam = SLAM(sequence.camera)
    counts: Counter[tuple[int, int]] = Counter()
    everything: set[str] = set()
    for frame in sequence:
        modules, result = modules_of_step(slam, frame)
        if result.state is State.TRACKING and not result.is_keyframe:
            features = {name for name in modules if name.startswith("torchslam.features.")}
            counts[len(modules - features), len(features)] += 1
            everything |= modules
    for (others, extractor), frames in counts.most_common(5):
        print(f"{frames} frames: {others} modules and {extractor} of the feature extractor")
    print("\n".join(sorted(everything)))


if __name__ == "__main__":
    main()
