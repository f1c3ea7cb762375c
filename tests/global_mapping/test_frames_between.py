"""Keypoints that are followed from keyframes to the frames between them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from torch import Tensor

from torchslam.global_mapping import frames_between
from torchslam.global_mapping.frames_between import CELL_PX, FollowedViews, Still, Template, gray_of, spread
from torchslam.types import Explanation, Frame, FrameFeatures, Reason, State

HEIGHT, WIDTH = 120, 160
WAVES = 0.15 * torch.randn(24, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
PHASES = 6.3 * torch.rand(24, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def picture(shift: tuple[float, float], scale: float = 1.0) -> Tensor:
    """A texture of smooth waves, moved by a part of a pixel."""
    v, u = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    places = torch.stack([u / scale - shift[0], v / scale - shift[1]], -1).double()
    waves = torch.sin(places @ WAVES.mT + PHASES).sum(-1)
    return (0.5 + 0.05 * waves).clamp(0, 1).float()[None, None]


def keyframe(index: int, pixels: Tensor) -> FrameFeatures:
    count = len(pixels)
    return FrameFeatures(
        index,
        0.1 * index,
        pixels,
        torch.linspace(1, 3, count, dtype=torch.float64),
        torch.zeros(count, dtype=torch.float64),
        torch.eye(count),
        torch.ones(count, dtype=torch.bool),
    )


PIXELS = torch.tensor(
    [[40.0, 30.0], [80.0, 60.0], [120.5, 90.25], [60.0, 85.0], [152.0, 60.0]], dtype=torch.float64
)


def still(index: int, image: Tensor, reduction: float = 1.0) -> Still:
    return Still(index, 0.1 * index, gray_of(image, reduction))


def test_keypoints_are_followed_to_a_tenth_of_a_pixel() -> None:
    view = keyframe(3, PIXELS)
    kept = torch.tensor([True, False, True, True, True])
    template = Template.of(view, gray_of(picture((0, 0)), 1.0), kept, 1.0)
    shifts = [(2.3, -0.6), (5.1, -1.4), (9.7, 2.2)]
    found = list(template.follow(still(4 + row, picture(shift)) for row, shift in enumerate(shifts)))
    assert [each.index for each in found] == [4, 5, 6]
    assert [each.timestamp for each in found] == pytest.approx([0.4, 0.5, 0.6])
    for each, shift in zip(found, shifts, strict=True):
        true = PIXELS[kept] + torch.tensor(shift)
        assert each.mask[:3].tolist() == [True, True, True]
        assert (each.keypoints - true)[:3].abs().max() < 0.1
        assert torch.equal(each.keypoints, each.detected)
        assert torch.equal(each.descriptors, view.descriptors[kept])
        assert torch.equal(each.scales, view.scales[kept])
    assert not bool(found[-1].mask[3])  # which has left the image


def test_what_is_covered_is_masked() -> None:
    view = keyframe(0, PIXELS[:4])
    template = Template.of(view, gray_of(picture((0, 0)), 1.0), view.mask, 1.0)
    other = picture((1.5, 0.5))
    other[..., 40:82, 60:105] = picture((31.0, 17.0))[..., 40:82, 60:105]
    (found,) = template.follow([still(1, other)])
    assert found.mask.tolist() == [True, False, True, True]


def test_reduced_images_give_pixels_of_the_images() -> None:
    big = torch.nn.functional.interpolate(
        picture((0, 0)), scale_factor=2, mode="bicubic", align_corners=False
    )
    moved = torch.nn.functional.interpolate(
        picture((2, 1)), scale_factor=2, mode="bicubic", align_corners=False
    )
    assert gray_of(big, 2.0).shape == (HEIGHT, WIDTH)
    view = keyframe(0, 2 * PIXELS[:4])
    (found,) = Template.of(view, gray_of(big, 2.0), view.mask, 2.0).follow([still(1, moved, 2.0)])
    assert (found.keypoints - view.keypoints - torch.tensor([4.0, 2.0])).abs().max() < 0.3


class Film:
    """Pictures that move by a pixel a frame; what is read and extracted is noted."""

    def __init__(self, unreadable: tuple[int, ...] = ()) -> None:
        self.unreadable, self.extracted = unreadable, list[int]()

    def read(self, index: int) -> Frame | None:
        if index in self.unreadable:
            return None
        return Frame(index, 0.1 * index, picture((float(index), 0.0)))

    def extract(self, index: int) -> FrameFeatures | None:
        self.extracted.append(index)
        return None if index in self.unreadable else keyframe(index, PIXELS[:1])

    def views(
        self, mapped: tuple[int, ...], keyframes: tuple[int, ...], frames: int
    ) -> list[FrameFeatures | None]:
        known = {index: keyframe(index, PIXELS + torch.tensor([float(index), 0.0])) for index in mapped}
        with_point = {index: known[index].mask for index in keyframes}
        return list(FollowedViews(self.read, self.extract, known, with_point, 1.0).of(range(frames)))


def place(view: FrameFeatures | None) -> float:
    """The first keypoint of a view, in the picture as it was in frame 0."""
    assert view is not None
    return float(view.keypoints[0, 0]) - view.index


def test_frames_between_have_the_keypoints_of_the_nearer_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    film = Film()
    found = film.views((1, 6), (1, 6), 9)
    assert [view.index for view in found if view is not None] == list(range(9))
    assert film.extracted == []
    assert [place(view) for view in found] == pytest.approx([40.0] * 9, abs=0.1)
    monkeypatch.setattr(frames_between, "MOST_FOLLOWED", 1)
    found = film.views((1, 6), (1, 6), 9)
    assert [view.index for view in found if view is not None] == list(range(9))
    assert film.extracted == [3, 4, 8]


def test_frames_without_a_keyframe_have_their_own_features() -> None:
    """A frame that was mapped without a pose is none."""
    film = Film()
    found = film.views((0, 3), (), 5)
    assert [view.index for view in found if view is not None] == list(range(5))
    assert film.extracted == [1, 2, 4]
    film = Film()
    film.views((0, 3), (0,), 5)
    assert film.extracted == [4]
    assert Film().views((), (), 2) != []


def test_only_followed_frames_are_extracted_again() -> None:
    film = Film()
    known = {0: keyframe(0, PIXELS)}
    followed = FollowedViews(film.read, film.extract, known, {0: known[0].mask}, 1.0)
    assert len(list(followed.of([0, 1, 2]))) == 3
    assert followed.again(0) is None
    again = followed.again(2)
    assert again is not None
    assert (again.index, len(again.keypoints), film.extracted) == (2, 1, [2])


def test_frames_that_cannot_be_read_are_left_out() -> None:
    found = Film((2, 4)).views((0, 6), (0, 6), 7)
    assert [view.index for view in found if view is not None] == [0, 1, 3, 5, 6]


def test_keypoints_that_are_followed_are_spread() -> None:
    """The first of each cell, then the second of each, in the order of the rows."""
    right = torch.tensor([CELL_PX, 0.0], dtype=torch.float64)
    pixels = torch.tensor([[5.0, 5.0]] * 5, dtype=torch.float64)
    pixels[3:] += right
    assert spread(pixels, 2).tolist() == [0, 3]
    assert spread(pixels, 3).tolist() == [0, 1, 3]
    assert spread(pixels, 4).tolist() == [0, 1, 3, 4]
    assert spread(pixels, 9).tolist() == [0, 1, 2, 3, 4]
    assert spread(pixels[:0], 3).tolist() == []


def test_at_most_so_many_are_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames_between, "MOST_KEYPOINTS", 3)
    view = keyframe(0, PIXELS)
    kept = torch.tensor([True, False, True, True, True])
    template = Template.of(view, gray_of(picture((0, 0)), 1.0), kept, 1.0)
    assert template.view.keypoints.tolist() == PIXELS[[0, 2, 3]].tolist()


def estimate(inliers: int, is_doubtful: bool) -> SimpleNamespace:
    return SimpleNamespace(
        inliers=inliers, is_doubtful=is_doubtful, matches=99, T_cw=torch.eye(4), covariance=torch.eye(6)
    )


@pytest.mark.parametrize(
    ("tried", "chosen", "state"),
    [
        ([(30, False), (90, False), (90, False)], 0, State.TRACKING),
        ([(30, True), (20, False), (90, False)], 1, State.TRACKING),
        ([(30, True), (90, True), (20, False)], 2, State.TRACKING),
        ([(30, True), (90, True), (60, True)], 1, State.UNCERTAIN),
        ([(30, True), (20, True), (60, True)], 2, State.UNCERTAIN),
    ],
)
def test_the_first_pose_that_is_not_doubtful_is_taken(
    monkeypatch: pytest.MonkeyPatch, tried: list[tuple[int, bool]], chosen: int, state: State
) -> None:
    """Of what was followed, the frame's own features and its relocalization; nothing is tried after it."""
    views = [keyframe(7, PIXELS[:1]) for _ in tried]
    poses, asked = [estimate(*each) for each in tried], list[int]()

    def estimates(*_: object) -> Any:
        for row, (view, pose) in enumerate(zip(views, poses, strict=True)):
            asked.append(row)
            yield view, pose, row < 2

    doubt = Explanation.of(Reason.OTHER, text="doubtful")
    monkeypatch.setattr(frames_between, "_estimates", estimates)
    monkeypatch.setattr(frames_between, "_doubt", lambda _, pose: doubt if pose.is_doubtful else None)
    tracker, submap = MagicMock(), MagicMock()
    found = frames_between._track(tracker, submap, views[0], None)
    assert (found.inliers, found.state) == (tried[chosen][0], state)
    assert found.reasons == ((doubt,) if state is State.UNCERTAIN else ())
    assert asked == list(range(chosen + 1 if state is State.TRACKING else 3))
    (committed,) = tracker.commit.call_args_list
    assert committed.args[1] is views[chosen]
    assert committed.args[2] is (poses[chosen] if chosen < 2 else None)
    assert tracker.start_at_estimate.called == (chosen == 2)
    assert submap.posed_frames.add.call_args.args[:2] == (views[chosen], poses[chosen])


def test_a_frame_without_any_pose_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames_between, "_estimates", lambda *_: iter(()))
    tracker, submap = MagicMock(), MagicMock()
    found = frames_between._track(tracker, submap, keyframe(7, PIXELS[:1]), None)
    assert found.state is State.LOST
    assert [each.reason for each in found.reasons] == [Reason.NOT_FOUND]
    assert tracker.commit.call_args.args[2] is None
    assert not submap.posed_frames.add.called
