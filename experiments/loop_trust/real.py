"""Graphs of a real run: its odometry, loops as the system measures them between its keyframes, false ones added."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from experiments.loop_trust.graphs import Graphs
from experiments.loop_trust.simulation import false_loops
from torchslam.config import Config
from torchslam.data.association import interpolate_poses
from torchslam.data.formats.trajectory_file import read_trajectory
from torchslam.geometry import Camera, se3_inverse, sim3_inverse
from torchslam.loop_closing.relative_sim3 import relate
from torchslam.map.file import read_map
from torchslam.map.map import Map

_APART = 10  # keyframes between the ends of a loop, at least
_LOOPS = 30  # pairs of keyframes that are tried, evenly spaced among those that share points
_SHARED = 20  # points that two keyframes of a loop have in common in the finished map
_TOLERANCE_S = 0.1
# Nobody has measured these: of a step, and of a loop, in median steps, radians and log scale.
_ODOMETRY_SIGMAS, _LOOP_SIGMAS = [0.05] * 3 + [0.01] * 4, [0.1] * 3 + [0.02] * 4


def real_graphs(run: Path, false_share: float, count: int, seed: int = 0) -> Graphs | None:
    """`count` graphs of the run in a folder of results, with other false loops each; None where it has no loop.

    Nodes are keyframes; odometry is what the system said of them at the time (`online.txt`). The unit is the median
    step of the truth, to which the run is brought by its scale alone.
    """
    slam_map, camera = read_map(run / "map.safetensors")
    keyframes, T_online, T_true = _keyframes(slam_map, run)
    pairs, S_ji = _loops(slam_map, camera, keyframes)
    if not len(pairs):
        return None
    steps = T_true[:, :3, 3].diff(dim=0).norm(dim=-1)
    unit = float(steps[steps > 0].median())
    # The map's own unit, by the length of its steps beside the true ones.
    T_map = slam_map.T_cw[keyframes]
    own = se3_inverse(T_map)[:, :3, 3].diff(dim=0).norm(dim=-1)
    ratio = float(steps.sum() / own.sum()) / unit
    T_true = _scaled(T_true, 1 / unit)
    T_online, S_ji = _scaled(T_online, ratio), _scaled(S_ji, ratio)
    odometry = se3_inverse(T_online[1:]) @ T_online[:-1]
    generator = torch.Generator().manual_seed(seed)
    num_false = round(false_share / (1 - false_share) * len(pairs))
    graphs: list[Graphs] = []
    while len(graphs) < count:
        false = false_loops(T_true, num_false, torch.tensor(_LOOP_SIGMAS).double(), generator)
        if false is None:
            raise ValueError(f"{run}: the run is too small for {num_false} false loops")
        graphs.append(_graph(T_true, odometry, (pairs, S_ji), false))
    return Graphs.cat(graphs)


def _graph(
    T_true: Tensor, odometry: Tensor, genuine: tuple[Tensor, Tensor], false: tuple[Tensor, Tensor]
) -> Graphs:
    pairs, loops = torch.cat([genuine[0], false[0]]), torch.cat([genuine[1], false[1]])
    order = torch.argsort(pairs[:, 1], stable=True)
    total = len(pairs)
    return Graphs(
        sim3_inverse(T_true)[None],
        odometry[None],
        odometry.new_tensor(_ODOMETRY_SIGMAS).expand(1, len(odometry), 7),
        pairs[order][None],
        loops[order][None],
        odometry.new_tensor(_LOOP_SIGMAS).expand(1, total, 7),
        (torch.arange(total) < len(genuine[0]))[order][None],
        torch.ones(1, total, dtype=torch.bool),
    )


def _keyframes(slam_map: Map, run: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (K,) of keyframes in time, their poses (K, 4, 4) at the time and the true ones, camera to world."""
    rows = torch.argsort(slam_map.keyframes["timestamp"])
    times = slam_map.keyframes["timestamp"][rows].double()
    online, known = interpolate_poses(read_trajectory(run / "online.txt"), times, _TOLERANCE_S)
    truth, measured = interpolate_poses(read_trajectory(run / "groundtruth.txt"), times, _TOLERANCE_S)
    both = known & measured
    return rows[both], online[both].double(), truth[both].double()


def _loops(slam_map: Map, camera: Camera, keyframes: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 2) nodes and (N, 4, 4) similarities between them, as the system measures them to close a loop."""
    candidates = []
    for j in range(_APART, len(keyframes)):
        near = slam_map.covisible(int(keyframes[j]), slam_map.num_keyframes, min_shared=_SHARED)
        candidates += [(i, j) for i in range(j - _APART) if bool((near == keyframes[i]).any())]
    even = torch.linspace(0, max(len(candidates) - 1, 0), min(len(candidates), _LOOPS)).round().long()
    pairs, S_ji, T_cw = [], [], slam_map.T_cw
    for i, j in (candidates[row] for row in even.tolist()):
        one, two = int(keyframes[j]), int(keyframes[i])
        relation = relate(slam_map, one, slam_map, two, camera, Config())
        if relation is not None:
            pairs.append((i, j))
            S_ji.append(T_cw[one] @ sim3_inverse(relation.S_21) @ se3_inverse(T_cw[two]))
    if not pairs:
        return torch.empty(0, 2, dtype=torch.int64), torch.empty(0, 4, 4, dtype=torch.float64)
    return torch.tensor(pairs), torch.stack(S_ji).double()


def _scaled(T: Tensor, factor: float) -> Tensor:
    """Poses with translations in another unit."""
    scaled = T.clone()
    scaled[:, :3, 3] *= factor
    return scaled
