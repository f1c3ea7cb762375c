"""The noise of a map: what adjustments find, robustly, from a prior on."""

from __future__ import annotations

import pytest
import torch

from tests.map.simulated import CAMERA, simulated_submap
from torchslam.errors import ResultsError
from torchslam.map.file import read_atlas, write_atlas
from torchslam.map.map import _ADJUSTED_SQUARED_ERROR, _MAX_NOISE_VARIANCE, Map


def adjusted(slam_map: Map, factor: float, times: int) -> float:
    """The noise after adjustments whose median error is that of the stated noise times a factor; a tenth is wrong."""
    errors = torch.full((100,), factor * _ADJUSTED_SQUARED_ERROR, dtype=torch.float64)
    errors[:10] = torch.inf
    for _ in range(times):
        slam_map.update_noise(errors)
    return slam_map.noise_variance


def test_the_prior_is_that_the_feature_extractor_states_the_truth() -> None:
    slam_map = Map()
    assert slam_map.noise_variance == 1.0
    slam_map.update_noise(torch.zeros(0))
    assert slam_map.noise_variance == 1.0
    assert adjusted(slam_map, 1.0, 5) == pytest.approx(1.0)


def test_it_is_never_below_what_is_stated_nor_above_what_is_noise() -> None:
    assert adjusted(Map(), 0.1, 50) == 1.0
    assert adjusted(Map(), 100.0, 50) == _MAX_NOISE_VARIANCE


def test_a_map_file_keeps_it(tmp_path) -> None:
    submap = simulated_submap()
    submap.map.noise_variance = 2.5
    write_atlas(tmp_path / "map.safetensors", [submap], CAMERA)
    (read,) = read_atlas(tmp_path / "map.safetensors").atlas
    assert read.map.noise_variance == 2.5


@pytest.mark.parametrize("value", [0.5, float("inf")])
def test_an_impossible_noise_is_refused(tmp_path, value: float) -> None:
    submap = simulated_submap()
    submap.map.noise_variance = value
    write_atlas(tmp_path / "map.safetensors", [submap], CAMERA)
    with pytest.raises(ResultsError, match=r"noise_variances|not a torchslam map"):
        read_atlas(tmp_path / "map.safetensors")


def test_a_finished_map_sets_it_at_once_within_the_same_bounds() -> None:
    for factor, expected in ((0.1, 1.0), (2.0, 2.0), (100.0, _MAX_NOISE_VARIANCE)):
        slam_map = Map()
        slam_map.noise_variance = 3.0
        slam_map.set_noise(torch.full((9,), factor * _ADJUSTED_SQUARED_ERROR, dtype=torch.float64))
        assert slam_map.noise_variance == pytest.approx(expected)
    slam_map.set_noise(torch.zeros(0))
    assert slam_map.noise_variance == _MAX_NOISE_VARIANCE
