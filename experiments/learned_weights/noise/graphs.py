"""Whole runs by their graphs, with what each keypoint showed and where the camera truly was."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import place_of
from experiments.learned_weights.noise.cues import Cues, describe
from experiments.trials.trials import drone
from torchslam import ORB, SLAM, Config, Features, open_sequence
from torchslam.data.sequence import GROUNDTRUTH_TOLERANCE, Sequence
from torchslam.data.trajectories import interpolate_poses
from torchslam.geometry import se3_inverse
from torchslam.optim.run_graph import ObservationGraph, RunGraph
from torchslam.system.front_end import image_extractor

LEAST_KNOWN = 4
"""Keyframes of which the truth must be known: fewer leave hardly more than the seven directions of their alignment."""
CAMERAS = {"kitti07": "685,685,601.887,183.110", "office_loop": "437.4,437.4,260.7,147.0"}
"""kitti07: with COLMAP's focal length: the one that the sequence gives is 3 % too long, see
experiments/self_calibration. office_loop: as `torchslam run` finds it."""


def opened(name: str) -> Sequence:
    """A sequence of the experiment. Raises SequenceError if it is not available."""
    if name == "drone":
        return drone()
    return open_sequence(place_of(name), camera=CAMERAS.get(name))


@dataclass(frozen=True)
class Example:
    """A run over a sequence, its observations by keyframes and those of the frames in between.

    graph:      weights are those of the hand-set rule
    values:     (O, C), directions: (O, 2, 2) the cues of the observations' keypoints
    T_cw:       (F, 4, 4) true poses, and (F,) where they are known
    noise_variance: what the run found, `Map.noise_variance`
    """

    graph: ObservationGraph
    values: Tensor
    directions: Tensor
    T_cw: Tensor
    known: Tensor
    noise_variance: float

    def save(self, path: Path) -> None:
        columns = {name: getattr(self.graph, name) for name in self.graph.columns()}
        rest = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "graph"}
        torch.save({"graph": columns, "camera": self.graph.camera, "rest": rest}, path)

    @classmethod
    def load(cls, path: Path) -> Example:
        """Of a file that `save` wrote, here: it is unpickled."""
        found = torch.load(path, weights_only=False)
        return cls(ObservationGraph(camera=found["camera"], **found["graph"]), **found["rest"])

    @property
    def keyframes_only(self) -> Example:
        """Without the frames between keyframes, which hang on the points and move nothing else."""
        graph, frames, rows = keyframes_of(self.graph)
        columns = self.values[rows], self.directions[rows], self.T_cw[frames], self.known[frames]
        return Example(graph, *columns, self.noise_variance)


def keyframes_of(graph: ObservationGraph) -> tuple[ObservationGraph, Tensor, Tensor]:
    """The graph of the keyframes of the largest submap alone; (K,) these frames and (O,) the observations kept."""
    largest = int(torch.bincount(graph.submap).argmax())
    chosen = graph.is_keyframe & (graph.submap == largest)
    frames = chosen.nonzero().squeeze(-1)
    rows = chosen[graph.frame_index].nonzero().squeeze(-1)
    slots = torch.full_like(graph.submap, -1)
    slots[frames] = torch.arange(len(frames))
    points, point_index = torch.unique(graph.point_index[rows], return_inverse=True)
    part = ObservationGraph(
        timestamps=graph.timestamps[frames],
        T_cw=graph.T_cw[frames],
        points_w=graph.points_w[points],
        frame_index=slots[graph.frame_index[rows]],
        point_index=point_index,
        pixels=graph.pixels[rows],
        weights=graph.weights[rows],
        camera=graph.camera,
        is_keyframe=graph.is_keyframe[frames],
    )
    return part, frames, rows


def truth_of(graph: ObservationGraph, sequence: Sequence) -> tuple[Tensor, Tensor]:
    """(F, 4, 4) true T_cw of a graph's frames, and (F,) where they are known; in the largest submap alone."""
    if sequence.groundtruth is None:
        return torch.eye(4, dtype=graph.T_cw.dtype).expand_as(graph.T_cw), torch.zeros_like(graph.is_keyframe)
    largest = int(torch.bincount(graph.submap).argmax())
    T_wc, known = interpolate_poses(sequence.groundtruth, graph.timestamps, GROUNDTRUTH_TOLERANCE)
    return se3_inverse(T_wc), known & (graph.submap == largest)


def example_of(sequence: Sequence, config: Config) -> Example:
    """Run a sequence by the hand-set rule; return its graph and cues."""
    run = SLAM(sequence.camera, config).run(sequence)
    graph = run.graph
    seen = _cues(sequence, config, graph)
    columns = {name: getattr(graph, name) for name in ObservationGraph.columns()}
    plain = ObservationGraph(camera=graph.camera, **columns)
    truth = truth_of(graph, sequence)
    return Example(plain, seen.values, seen.directions, *truth, run.map.noise_variance)


class _Watching:
    """ORB that keeps the cues of the last image."""

    def __init__(self, num_keypoints: int) -> None:
        self.orb = ORB(num_keypoints)
        self.cues = Cues(torch.zeros(0), torch.zeros(0))

    def __call__(self, images: Tensor) -> Features:
        features = self.orb(images)
        self.cues = describe(self.orb, images, features)
        return features


def _cues(sequence: Sequence, config: Config, graph: RunGraph) -> Cues:
    """The cues of a graph's observations; those of keypoint k of a frame are in row k."""
    watching = _Watching(config.features.num_keypoints)
    look = image_extractor(config, extractor=watching)
    columns: list[tuple[Tensor, Tensor, Tensor]] = []
    for frame in range(len(graph.T_cw)):
        rows = (graph.frame_index == frame).nonzero().squeeze(-1)
        features = look(sequence[int(graph.frame_ids[frame])])
        at = graph.keypoint_index[rows]
        if not torch.allclose(features.keypoints[0, at].to(graph.pixels), graph.pixels[rows], atol=1e-3):
            raise ValueError(f"frame {int(graph.frame_ids[frame])}: keypoints are others than in the run")
        columns.append((rows, watching.cues.values[0, at], watching.cues.directions[0, at]))
    order = torch.argsort(torch.cat([rows for rows, _, _ in columns]))
    values, directions = (torch.cat([column[k] for column in columns])[order].double() for k in (1, 2))
    return Cues(values, directions)
