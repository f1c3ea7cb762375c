"""The final adjustment leaves out what is far from its point, in units of the noise that the front end states."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.global_mapping.synthetic import CAMERA, SIGMA_PX, Recording, arc, ball
from torchslam.config import Config
from torchslam.global_mapping.frames_between import FramePoser
from torchslam.global_mapping.mapper import fill_submap, with_camera_std
from torchslam.global_mapping.rounds import Reconstruction
from torchslam.map.atlas import Atlas
from torchslam.system.run import FINAL_CHI_SQUARE, FinalAdjustment

SCENE = Recording.of(arc(20, 120.0, 2.5), ball(60), first=0)


@pytest.mark.parametrize(("deviations", "is_kept"), [(1.45, True), (1.55, False)])
def test_observations_beyond_one_and_a_half_deviations_leave(deviations: float, is_kept: bool) -> None:
    """One of twenty of its point, which follows it by a twentieth; all others are exact."""
    assert FINAL_CHI_SQUARE == 1.5**2
    views = list(SCENE.views)
    keypoints = views[7].keypoints.clone()
    keypoints[int(SCENE.at(7)[30]), 1] += deviations * SIGMA_PX * 20 / 19
    views[7] = replace(views[7], keypoints=keypoints)
    everything = torch.ones(len(SCENE.tracks), dtype=torch.bool)
    atlas = Atlas(CAMERA.params)
    submap = atlas.create()
    observed = replace(SCENE, views=views).observed
    found = Reconstruction(SCENE.T_cw, CAMERA, SCENE.points_w, everything)
    fill_submap(submap, views, torch.arange(20), observed, found)
    FramePoser(CAMERA, Config()).pose(submap, views)
    before = len(submap.map.observations().pixels)
    FinalAdjustment(CAMERA, with_camera_std(Config(), 0.0)).adjust(atlas, 0, settled=True)
    assert before == 20 * 60
    assert len(submap.map.observations().pixels) == before - (not is_kept)
