"""Whether the final keyframes are as wrong as their covariances say, and what explains the rest. See README.md.

python -m experiments.consistency.run
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import CONTROL, available, parser_of, place_of, publish, table
from experiments.learned_weights.noise.consistency import (
    aligned_covariance,
    aligned_errors,
    inverse_information,
    normalized_squares,
    reduced_information,
    similarity_directions,
)
from torchslam import SLAM, Config, Run, Trajectory, open_sequence
from torchslam.data.sequence import GROUNDTRUTH_TOLERANCE
from torchslam.data.trajectories import interpolate_poses, read_trajectory
from torchslam.geometry import se3_inverse, umeyama
from torchslam.geometry.robust import TAIL_SCALE
from torchslam.global_mapping.recording import map_recording
from torchslam.optim import GRAPH_OPTIONS, pose_covariance
from torchslam.optim.run_graph import ObservationGraph, keyframe_problem, solve_graph

RECORDINGS = ("kitti07", "redkitchen", "fr2_desk_20", "machine_hall", "shelf_bin", "garden", CONTROL)
WINDOW = 8
"""Keyframes of a short stretch, which is aligned by itself."""
LEAST_KEYFRAMES = 12
"""With fewer, the four numbers of a wrong lever arm and clock explain a large part of any error."""
SPLITS = 3
"""Ways to divide the points into halves, of which figures are the mean."""
_SAME_S = 1e-3  # frames of two programs at the same time
_STEP_S = 0.01  # of the finite difference of the true path
SOLVED = GRAPH_OPTIONS.replace(iterations=30, backward="detached")


@dataclass(frozen=True)
class Keyframes:
    """The keyframes of a recording's largest map, at their minimum, with the truth.

    graph: of these alone, with the keypoints of a global shutter; camera_errors: columns of the camera's parameters
    truth: the true path; T_cw: (K, 4, 4) true poses, and (K,) where they are known
    """

    graph: ObservationGraph
    camera_errors: Tensor | None
    truth: Trajectory
    T_cw: Tensor
    known: Tensor

    @classmethod
    def of(cls, graph: ObservationGraph, camera_errors: Tensor | None, truth: Trajectory) -> Keyframes:
        """Of the graph of a run."""
        graph = graph.global_shutter()
        largest = int(torch.bincount(graph.submap[graph.is_keyframe]).argmax())
        frames, *_, problem = keyframe_problem(graph, largest)
        assert problem.weights is not None
        alone = ObservationGraph(
            graph.timestamps[frames],
            problem.T_cw,
            problem.points_w,
            problem.frame_index,
            problem.point_index,
            problem.pixels,
            problem.weights,
            graph.camera,
            torch.ones_like(frames).bool(),
        )
        T_wc, known = interpolate_poses(truth, alone.timestamps, GROUNDTRUTH_TOLERANCE)
        return cls(alone, camera_errors, truth, se3_inverse(T_wc), known)

    def formal(self) -> Tensor:
        """Joint covariance of the poses by independent errors as stated, the camera exact."""
        return inverse_information(reduced_information(self.graph, TAIL_SCALE, "cauchy"))

    def by_points(self, with_camera: bool = True) -> Tensor:
        """Joint covariance of the poses by the scatter of points, as a run stores it."""
        *_, problem = keyframe_problem(self.graph, 0)
        return pose_covariance(problem, SOLVED, self.camera_errors if with_camera else None)

    def normalized(self, covariance: Tensor, truth_m: float = 0.0) -> Tensor:
        """Squared errors of the known keyframes by their covariance, per number."""
        return normalized_squares(self.graph.T_cw, self.T_cw, self.known, covariance, truth_m)

    def windows(self) -> Iterator[Keyframes]:
        """Stretches of `WINDOW` keyframes in the order of time, each half over the one before."""
        order = torch.argsort(self.graph.timestamps)
        for start in range(0, len(order) - WINDOW + 1, WINDOW // 2):
            only = torch.zeros_like(self.known)
            only[order[start : start + WINDOW]] = True
            if int((only & self.known).sum()) == WINDOW:
                yield replace(self, known=only)

    def halves(self, seed: int) -> tuple[Keyframes, Keyframes]:
        """Both halves of the points, each solved alone; the first has the second for its truth."""
        generator = torch.Generator().manual_seed(seed)
        first = torch.rand(len(self.graph.points_w), generator=generator) < 0.5
        one, other = (self._of_points(points) for points in (first, ~first))
        return replace(one, T_cw=other.graph.T_cw, known=torch.ones_like(self.known)), other

    def _of_points(self, chosen: Tensor) -> Keyframes:
        graph, rows = self.graph, chosen[self.graph.point_index].nonzero().squeeze(-1)
        points, point_index = torch.unique(graph.point_index[rows], return_inverse=True)
        part = replace(
            graph,
            points_w=graph.points_w[points],
            frame_index=graph.frame_index[rows],
            point_index=point_index,
            pixels=graph.pixels[rows],
            weights=graph.weights[rows],
        )
        found = solve_graph(part, free_camera=False, options=SOLVED)
        return replace(self, graph=replace(part, T_cw=found.T_cw, points_w=found.points_w))

    def unexplained(self) -> float:
        """Share of the squared errors that is left if the truth has a wrong lever arm and clock, the best ones."""
        errors, scale = aligned_errors(self.graph.T_cw, self.T_cw, self.known)
        times = self.graph.timestamps[self.known]
        ahead, behind = (
            interpolate_poses(self.truth, times + step, 1.0)[0][:, :3, 3] for step in (_STEP_S, -_STEP_S)
        )
        T_wc = se3_inverse(self.T_cw[self.known])
        # The true path, turned into the axes of the map.
        _, R, _ = umeyama(T_wc[:, :3, 3], se3_inverse(self.graph.T_cw)[self.known, :3, 3])
        velocities = (ahead - behind) / (2 * _STEP_S * scale) @ R.mT
        lever = (R @ T_wc[:, :3, :3]).flatten(0, 1)
        columns = torch.cat((lever, velocities.flatten()[:, None]), dim=-1)
        Q = similarity_directions(self.graph.T_cw, self.known)
        columns = columns - Q @ (Q.mT @ columns)
        fit = columns @ torch.linalg.lstsq(columns, errors.flatten()[:, None]).solution
        return float((errors.flatten() - fit[:, 0]).square().sum() / errors.square().sum())


def error_of_truth(keyframes: Keyframes, covariance: Tensor) -> float:
    """Standard deviation of true positions in meters, each coordinate, with which errors are as large as stated."""
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2
        too_large = float(keyframes.normalized(covariance, middle).mean()) > 1
        low, high = (middle, high) if too_large else (low, middle)
    return high


def both(values: Tensor) -> str:
    """Mean and median."""
    return f"{float(values.mean()):.1f} ({float(values.median()):.1f})"


def row(name: str, keyframes: Keyframes) -> list[str]:
    """A line of the table."""
    own = keyframes.by_points()
    errors, scale = aligned_errors(keyframes.graph.T_cw, keyframes.T_cw, keyframes.known)
    count = len(errors)
    stated = aligned_covariance(keyframes.graph.T_cw, keyframes.known, own).trace() / count
    short = [float(each.normalized(own).mean()) for each in keyframes.windows()]
    apart = torch.tensor([_apart(*keyframes.halves(seed)) for seed in range(SPLITS)]).mean(0)
    return [
        name,
        f"{count}",
        f"{1e3 * scale * float(errors.square().sum(-1).mean().sqrt()):.2f}",
        f"{1e3 * scale * float(stated.sqrt()):.2f}",
        both(keyframes.normalized(keyframes.formal())),
        both(keyframes.normalized(keyframes.by_points(with_camera=False))),
        both(keyframes.normalized(own)),
        f"{float(torch.tensor(short).median()):.1f}" if short else "",
        f"{apart[0]:.1f}",
        f"{apart[1]:.1f}",
        f"{1e3 * error_of_truth(keyframes, own):.1f}",
        f"{100 * keyframes.unexplained():.0f} %" if count >= LEAST_KEYFRAMES else "",
    ]


def _apart(one: Keyframes, other: Keyframes) -> tuple[float, float]:
    """NEES of the distance of two halves by both covariances; what they share, as the camera, cancels."""
    formal = one.formal() + other.formal()
    by_points = one.by_points(with_camera=False) + other.by_points(with_camera=False)
    return float(one.normalized(formal).mean()), float(one.normalized(by_points).mean())


HEADER = [
    "recording", "keyframes", "ATE (mm)", "stated (mm)", "NEES: independent errors", "by points", "and camera",
    f"{WINDOW} in a row", "halves: independent", "halves: by points", "truth off by (mm)",
    "left by lever and clock", "by COLMAP",
]  # fmt: skip


def finished(name: str) -> tuple[Run, Trajectory | None]:
    """A recording as `torchslam run` maps it, and the truth."""
    sequence, config = open_sequence(place_of(name)), Config()
    online = SLAM(sequence.camera, config).run(sequence)
    return map_recording(sequence, online, config, sequence.camera).run, sequence.groundtruth


def by_another(keyframes: Keyframes, path: Path) -> str:
    """NEES if the poses of another program were the truth, which has errors of its own."""
    if not path.is_file():
        return ""
    other = read_trajectory(path)
    T_wc, known = interpolate_poses(other, keyframes.graph.timestamps, _SAME_S)
    seen = replace(keyframes, T_cw=se3_inverse(T_wc), known=known)
    return f"{both(seen.normalized(seen.by_points()))} of {int(known.sum())}"


def main() -> None:
    """Run all, and write the table into the README."""
    parser = parser_of(__doc__, readme=True)
    parser.add_argument("--others", type=Path, default=Path("results") / "others", metavar="DIR")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in available(RECORDINGS):
        run, truth = finished(name)
        assert truth is not None, "all have one"
        errors = None if run.calibration is None else run.calibration.directions
        keyframes = Keyframes.of(run.graph, errors, truth)
        label = "a rendered room" if name == CONTROL else name
        rows.append([*row(label, keyframes), by_another(keyframes, options.others / name / "trajectory.txt")])
        print(rows[-1], flush=True)
    publish(table(HEADER, rows), options, str(Path(__file__)))


if __name__ == "__main__":
    main()
