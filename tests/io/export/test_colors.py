from __future__ import annotations

import torch
from torch import Tensor

from tests.walks import Walk, arc
from torchslam.errors import FrameError
from torchslam.io.write_run import colorize_points
from torchslam.map.map import Map

SIZE = (160, 120)


class Painted(Walk):
    """Images whose red is the frame, whose green and blue are column and row."""

    missing: tuple[int, ...] = ()

    def color(self, index: int) -> Tensor:
        if index in self.missing:
            raise FrameError(f"{index}: not there")
        rows, columns = torch.arange(SIZE[1]), torch.arange(SIZE[0])
        image = torch.full((*reversed(SIZE), 3), index, dtype=torch.uint8)
        image[..., 1], image[..., 2] = columns, rows[:, None]
        return image


def test_colors_are_the_mean_over_what_keyframes_see(slam_map: Map) -> None:
    keypoints = slam_map.keyframes["keypoints"]
    keypoints[:, :, 0].clamp_(max=SIZE[0] - 1)
    keypoints[:, :, 1].clamp_(max=SIZE[1] - 1)
    colorize_points([slam_map, Map()], Painted(arc(30)), session=0)
    seen = slam_map.observations()
    for point in slam_map.valid_points().tolist():
        rows = seen.point_index == point
        frames = slam_map.keyframes["frame_index"][seen.keyframe_index[rows]]
        expected = torch.cat((frames[:, None], seen.pixels[rows].round()), dim=1).double().mean(dim=0)
        assert slam_map.points["colors"][point].tolist() == (expected + 0.5).floor().tolist()
    assert slam_map.points["colors"][3].tolist() == [0, 0, 0]  # an invalid point has no observations


def test_other_sessions_and_missing_images_keep_colors(slam_map: Map) -> None:
    slam_map.keyframes["session"][1:] = 1
    slam_map.points["colors"][:] = 77
    sequence = Painted(arc(30))
    sequence.missing = (0,)
    colorize_points([slam_map], sequence, session=0)
    assert bool((slam_map.points["colors"] == 77).all())
    colorize_points([slam_map], sequence, session=1)
    seen = slam_map.observations(torch.arange(1, slam_map.num_keyframes)).point_index
    painted = (slam_map.points["colors"][:, 0] != 77).nonzero()[:, 0]
    assert torch.equal(painted, torch.unique(seen))


def test_keypoints_beyond_the_last_pixel_take_its_color(slam_map: Map) -> None:
    slam_map.keyframes["detected"][:] = torch.tensor((SIZE[0] - 0.4, SIZE[1] - 0.4), dtype=torch.float64)
    colorize_points([slam_map], Painted(arc(30)), session=0)
    alive = slam_map.valid_points()
    expected = torch.tensor((SIZE[0] - 1, SIZE[1] - 1), dtype=torch.uint8).expand(len(alive), 2)
    assert torch.equal(slam_map.points["colors"][alive, 1:], expected)
