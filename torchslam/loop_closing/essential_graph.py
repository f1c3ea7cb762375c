"""Which keyframes hold each other in place when a loop is closed: a spanning tree and the strongest ties."""

from __future__ import annotations

import torch
from torch import Tensor

from torchslam.map.map import Map

STRONG = 100  # shared points that make a tie beside the tree's
_TIES = 20  # that a keyframe has at most


def essential_edges(slam_map: Map) -> Tensor:
    """(E, 2) int64 pairs of keyframes: every one but the first with an earlier one, and those that share much.

    The earlier one is that which shares most points; without any, the row before.
    """
    edges: set[tuple[int, int]] = set()
    for keyframe in range(1, slam_map.num_keyframes):
        near = slam_map.covisible(keyframe, slam_map.num_keyframes, min_shared=1)
        earlier = near[near < keyframe]
        edges.add((int(earlier[0]) if len(earlier) else keyframe - 1, keyframe))
        strong = slam_map.covisible(keyframe, _TIES, min_shared=STRONG)
        edges.update((other, keyframe) for other in strong.tolist() if other < keyframe)
    return torch.tensor(sorted(edges), dtype=torch.int64, device=slam_map.T_cw.device).reshape(-1, 2)
