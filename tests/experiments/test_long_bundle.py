"""The benchmark of long adjustments: a walk that closes loops, adjusted either way to the same cost."""

import pytest
import torch

from experiments.benchmarks.long_bundle import measure, walk
from torchslam.optim.bundle import _schur as schur


def test_a_walk_sees_points_again_in_the_next_lap() -> None:
    problem = walk(120)
    first = torch.full((len(problem.points_w),), 120).scatter_reduce(
        0, problem.point_index, problem.frame_index, "amin"
    )
    late = problem.frame_index - first[problem.point_index] > 20
    assert 0 < late.double().mean() < 0.2
    assert torch.bincount(problem.point_index).min() >= 3


def test_both_ways_reach_the_same_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SPARSE_FRAMES", "MOST_COVISIBLE"):  # `measure` sets them
        monkeypatch.setattr(schur, name, getattr(schur, name))
    threads = torch.get_num_threads()
    dense, blocks = (measure(60, by_blocks) for by_blocks in (False, True))
    torch.set_num_threads(threads)
    assert blocks.reached == pytest.approx(dense.reached, rel=1e-9)
