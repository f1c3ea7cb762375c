"""Where does the time of a run go? From the frames.csv of its results.

python -m experiments.benchmarks.slam.stages results/demo
"""

from __future__ import annotations

from pathlib import Path

from experiments.common import parser_of, table
from torchslam.io.report import stage_times
from torchslam.io.results import FRAMES, read_frames

HEADER = ["stage", "frames", "ms where it ran", "ms a frame", "ms a keyframe", "share"]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("results", type=Path, help="folder that `torchslam run` wrote")
    results = read_frames(parser.parse_args().results / FRAMES)
    stages, keyframes = stage_times(results), sum(result.is_keyframe for result in results)
    if "total" not in stages:
        raise SystemExit("no frame was processed")
    sums = {stage: times["mean"] * times["frames"] for stage, times in stages.items()}
    rows = [
        [
            stage,
            f"{stages[stage]['frames']:.0f}",
            f"{stages[stage]['mean']:.1f}",
            f"{total / len(results):.1f}",
            f"{total / keyframes:.1f}" if keyframes else "",
            f"{total / sums['total']:.0%}",
        ]
        for stage, total in sorted(sums.items(), key=lambda each: each[1])
    ]
    print(f"{len(results)} frames, {keyframes} keyframes\n\n{table(HEADER, rows)}")


if __name__ == "__main__":
    main()
