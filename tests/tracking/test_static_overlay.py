"""What stays in the image while the camera moves, and what must not be taken for it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, pose, sideways
from torchslam.config import Config
from torchslam.geometry import SharedCamera
from torchslam.tracking.static_overlay import StaticOverlayDetector, distances_to_segments
from torchslam.types import FrameFeatures

SCENE = Scene.of(200)
LOGO = 12  # keypoints of it
STEP = 0.1  # radians: 20 px


def turning(count: int, step: float = STEP) -> Tensor:
    """(F, 4, 4) cameras that turn and step aside: points move, however far they are."""
    return torch.stack([pose(0.1 * index, 0, 0, 0, step * index) for index in range(count)])


def with_logo(
    view: FrameFeatures, keypoints: int = LOGO, spread: float = 9.0, shift: float = 0.0
) -> FrameFeatures:
    """The view with the keypoints of a logo in its lower right instead of its last ones."""
    x = torch.arange(keypoints, dtype=torch.float64)
    pixels = torch.stack([270 + spread * (x % 4) + shift, 190 + spread * (x // 4)], -1)
    generator = torch.Generator().manual_seed(1)
    looks = torch.randint(0, 256, (keypoints, 32), generator=generator, dtype=torch.uint8)

    def put(column: Tensor, values: Tensor) -> Tensor:
        return torch.cat([column[: len(column) - keypoints], values])

    return replace(
        view,
        keypoints=put(view.keypoints, pixels),
        scales=put(view.scales, torch.ones(keypoints, dtype=torch.float64)),
        descriptors=put(view.descriptors, looks),
        mask=put(view.mask, torch.ones(keypoints, dtype=torch.bool)),
    )


def overlay_detector() -> StaticOverlayDetector:
    return StaticOverlayDetector(SharedCamera(CAMERA), Config())


def observed(by: StaticOverlayDetector, T_cw: Tensor, *, logo: bool = True, **options: float) -> list[int]:
    """What each frame of a way makes known."""
    views = [SCENE.view(index, T) for index, T in enumerate(T_cw)]
    shown = [with_logo(view, **options) if logo else view for view in views]  # type: ignore[arg-type]
    return [by.observe(view, T, 4.0) for view, T in zip(shown, T_cw, strict=True)]


def test_a_logo_is_detected_after_two_observations() -> None:
    by = overlay_detector()
    known = observed(by, turning(3))
    assert known[:2] == [0, 0]
    assert known[2] > LOGO
    view = with_logo(SCENE.view(9, sideways(1)[0]))
    assert by.covers(view.keypoints[-LOGO:]).all()
    cleared = by.mask_out(view)
    assert not cleared.mask[-LOGO:].any()
    scene = view.mask[:-LOGO] & (view.keypoints[:-LOGO] - torch.tensor([283.5, 199.0])).abs().amax(-1).gt(30)
    assert torch.equal(cleared.mask[:-LOGO] & scene, scene)


def test_before_detection_nothing_is_masked() -> None:
    by = overlay_detector()
    observed(by, turning(2))
    view = with_logo(SCENE.view(9, sideways(1)[0]))
    assert by.mask_out(view) is view
    assert not by.covers(view.keypoints).any()


def test_cells_around_a_static_keypoint_are_masked() -> None:
    by = overlay_detector()
    observed(by, turning(3))
    corner = torch.tensor([[270.0, 190.0]]).double()  # cell 67 (268 to 272), 47 (188 to 192)
    for x, y, covered in (
        (264.1, 184.1, True),
        (263.9, 190.0, False),
        (270.0, 183.9, False),
        (271.9, 191.9, True),
    ):
        assert bool(by.covers(torch.tensor([[x, y]]).double())[0]) is covered
    assert by.covers(corner).all()


def test_the_image_border_is_masked_like_its_center() -> None:
    corners = torch.tensor([[0.0, 0.0], [319.4, 0.0], [0.0, 239.4], [319.4, 239.4]] * 2).double()
    by = overlay_detector()
    by.add(corners)
    by.add(corners)
    assert by.covers(corners).all()
    inside = torch.tensor([[7.9, 7.9], [312.1, 7.9], [7.9, 232.1], [312.1, 232.1]]).double()
    assert by.covers(inside).all()
    assert not by.covers(inside + 9 * (torch.tensor([159.5, 119.5]) - inside).sign()).any()


def test_a_scene_without_overlay_masks_nothing() -> None:
    by = overlay_detector()
    assert observed(by, turning(5), logo=False) == [0] * 5
    assert not by.covers(SCENE.view(0, pose()).keypoints).any()


def test_a_static_camera_gives_no_evidence() -> None:
    by = overlay_detector()
    assert observed(by, turning(6, 0.0)) == [0] * 6
    assert observed(overlay_detector(), sideways(4, 0.4)) == [0] * 4  # what is far stays


def test_small_motions_accumulate_to_evidence() -> None:
    by = overlay_detector()
    known = observed(by, turning(31, STEP / 10))
    assert sum(known) > LOGO
    assert known[1:3] == [0] * 2


def test_few_static_keypoints_are_ignored() -> None:
    assert observed(overlay_detector(), turning(3), keypoints=8)[2] > 0
    by = overlay_detector()
    assert observed(by, turning(6), keypoints=7) == [0] * 6


def test_weak_evidence_decays() -> None:
    """It stays once and is gone. Five frames later it is back, five later it stayed once more, then twice."""
    by = overlay_detector()
    T_cw = turning(14, step=0.04)
    results = []
    for index in range(14):
        view = SCENE.view(index, T_cw[index])
        results.append(by.observe(view if index == 2 else with_logo(view), T_cw[index], 4.0))
    assert results[:13] == [0] * 13
    assert results[13] > LOGO


def test_detection_pauses_where_nothing_is_static() -> None:
    by = overlay_detector()
    T_cw = turning(8, step=0.04)
    looked = []
    for index in range(8):
        before = by._last
        by.observe(SCENE.view(index, T_cw[index]), T_cw[index], 4.0)
        looked.append(by._last is not before)
    assert looked == [True, True, False, False, False, False, True, False]


def test_a_logo_may_move_slightly() -> None:
    for shift, found in ((1.4, True), (1.6, False)):
        by = overlay_detector()
        T_cw = turning(3)
        results = [
            by.observe(with_logo(SCENE.view(index, T), shift=shift * (index % 2)), T, 4.0)
            for index, T in enumerate(T_cw)
        ]
        assert (results[2] > 0) is found


def test_frames_of_other_sessions_or_submaps_are_not_compared() -> None:
    by = overlay_detector()
    T_cw = turning(4)
    for index, T in enumerate(T_cw):
        view = replace(with_logo(SCENE.view(index, T)), session=index)
        assert by.observe(view, T, 4.0) == 0
    by = overlay_detector()
    for index, T in enumerate(T_cw):
        assert by.observe(with_logo(SCENE.view(index, T)), T, 4.0, world=(0, index)) == 0


def test_most_of_the_image_must_have_moved() -> None:
    """By more than four pixels: a turn by a little less than a fiftieth, or more."""
    for pixels, detected in ((2.5, False), (4.4, True)):
        by = overlay_detector()
        known = observed(by, torch.stack([pose(0, 0, 0, 0, pixels / 200.0 * index) for index in range(3)]))
        assert (known[2] > 0) is detected


def test_external_evidence_counts_equally() -> None:
    pixels = 40.0 + 10 * torch.arange(8, dtype=torch.float64)[:, None].expand(8, 2)
    for times, enough, known in ((1, 8, False), (2, 8, True), (2, 7, False)):
        by = overlay_detector()
        for _ in range(times):
            by.add(pixels[:enough])
        assert bool(by.covers(pixels[:enough]).all()) is known


def test_distances_from_segments() -> None:
    start, end = torch.tensor([0.0, 0.0]), torch.tensor([4.0, 0.0])
    points = torch.tensor([[2.0, 3.0], [-3.0, 4.0], [7.0, 4.0], [1.0, 0.0]])
    assert distances_to_segments(points, start, end).tolist() == pytest.approx([3.0, 5.0, 5.0, 0.0])
    assert distances_to_segments(points, end, start).tolist() == pytest.approx([3.0, 5.0, 5.0, 0.0])
    assert distances_to_segments(points, start, start).tolist() == pytest.approx([13**0.5, 5.0, 65**0.5, 1.0])
