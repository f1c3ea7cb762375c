"""The colors of map points, from the images that saw them."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError
from torchslam.map.map import Map
from torchslam.system.run import keyframe_rows


def colorize_points(maps: Iterable[Map], sequence: Sequence, session: int) -> None:
    """Give every point that keyframes of a session see its mean color in their images; other points keep theirs.

    The images are read once more, in order of time. One that cannot be read, as with simulated features, adds nothing.
    """
    for slam_map in maps:
        if len(slam_map.points) == 0:
            continue
        device = slam_map.positions_w.device
        total = torch.zeros(len(slam_map.points), 4, dtype=torch.int64, device=device)
        for keyframe in keyframe_rows(slam_map, session).tolist():
            _add_colors(total, slam_map, keyframe, sequence)
        seen = torch.nonzero(total[:, 3])[:, 0]
        count = total[seen, 3:]
        slam_map.points["colors"][seen] = ((total[seen, :3] + count // 2) // count).to(torch.uint8)


def _add_colors(total: Tensor, slam_map: Map, keyframe: int, sequence: Sequence) -> None:
    """Add to the rows (L, 4) of the points that a keyframe sees their red, green, blue and one."""
    try:
        image = sequence.color(int(slam_map.keyframes["frame_index"][keyframe])).to(total.device)
    except FrameError:
        return
    ids = slam_map.keyframes["point_ids"][keyframe]
    height, width = image.shape[:2]
    pixels = slam_map.keyframes["keypoints"][keyframe][ids >= 0].round().long()
    colors = image[pixels[:, 1].clamp(0, height - 1), pixels[:, 0].clamp(0, width - 1)].long()
    ones = torch.ones_like(colors[:, :1])
    total.index_add_(0, ids[ids >= 0], torch.cat((colors, ones), dim=1))
