"""Which pairs of views start a map, and why the others do not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.scene import CAMERA, Scene, camera_center, pose
from torchslam.config import Config, load_config
from torchslam.geometry import KeypointNoise, SharedCamera, Triangulation, transform
from torchslam.tracking import initialization
from torchslam.tracking.initialization import Initializer, check_two_view_map, is_good, refine_pair
from torchslam.types import FrameFeatures, TwoViewMap

SCENE = Scene.of(400)
DEFAULT, PARALLAX = Config(), load_config(None, ["paper.parallax=true"])
SIDE = pose(-0.5, 0.0, 0.1, 0.01, -0.05, 0.02)


def tried(
    T_cw: Tensor, *overrides: str, scene: Scene = SCENE, noise: float = 0.0
) -> tuple[TwoViewMap | None, str]:
    """The last result for views at T_cw (F, 4, 4): a map, or the text of its rejection."""
    return tried_views([scene.view(index, T, noise=noise) for index, T in enumerate(T_cw)], *overrides)


def tried_views(views: list[FrameFeatures], *overrides: str) -> tuple[TwoViewMap | None, str]:
    initializer = Initializer(SharedCamera(CAMERA), load_config(None, overrides))
    for view in views:
        result = step(initializer, view)
    return result


def step(initializer: Initializer, view: FrameFeatures) -> tuple[TwoViewMap | None, str]:
    """The result for one view: a map, or the text of its rejection."""
    result = initializer.step(view)
    return (result, "") if isinstance(result, TwoViewMap) else (None, str(result))


def pair(T_cw: Tensor) -> Tensor:
    return torch.stack([pose(), T_cw])


def test_an_initialization_has_motion_and_points_in_units_of_its_baseline() -> None:
    start, reason = tried(pair(SIDE))
    assert start is not None, reason
    assert reason == ""
    baseline = float(SIDE[:3, 3].norm())
    wanted = SIDE.clone()
    wanted[:3, 3] /= baseline
    torch.testing.assert_close(start.T_cw, wanted, atol=1e-6, rtol=0)
    shown = SCENE.shows(0)[start.keypoints_1]
    assert torch.equal(shown, SCENE.shows(1)[start.keypoints_2])
    torch.testing.assert_close(start.points_w, SCENE.points_w[shown] / baseline, atol=1e-3, rtol=1e-4)
    assert (start.reference.index, start.view.index) == (0, 1)
    assert len(shown) > 150


def test_the_first_frame_is_the_reference_until_it_is_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(initialization, "MAX_REFERENCE_AGE", 3)
    initializer = Initializer(SharedCamera(CAMERA), DEFAULT)
    reasons = "took", "the camera stands", "the camera stands", "took", "the"
    for index, reason in enumerate(reasons):
        assert step(initializer, SCENE.view(index, pose()))[1].startswith(reason)
    assert initializer.reference.index == 3
    assert initializer.num_views == 2


def test_too_few_matches_replace_the_reference() -> None:
    views = [SCENE.view(index, T) for index, T in enumerate(pair(SIDE))]
    both = len(torch.nonzero(views[0].mask[SCENE.at(0)] & views[1].mask[SCENE.at(1)]))
    assert tried(pair(SIDE), f"initialization.min_matches={both}")[0] is not None
    initializer = Initializer(
        SharedCamera(CAMERA), load_config(None, [f"initialization.min_matches={both + 1}"])
    )
    step(initializer, views[0])
    start, reason = step(initializer, views[1])
    assert start is None
    assert reason.startswith(f"too few matches with the reference frame: {both}, {both + 1} are needed")
    assert initializer.reference is views[1]
    assert initializer.num_views == 1


def test_a_static_camera_is_distinguished_from_a_moving_one() -> None:
    """The points are four away, on the average: a pixel is about 0.02 of a step to the side."""
    assert "stands still: the image moved by 0.0 px" in tried(pair(pose()))[1]
    views = [SCENE.view(index, pose()) for index in range(2)]
    for pixels, still in ((1.9, True), (2.1, False)):
        moved = replace(views[1], keypoints=views[1].keypoints + torch.tensor([0.6, 0.8]) * pixels)
        assert ("stands still" in tried_views([views[0], moved])[1]) is still


def static(
    view: FrameFeatures, share: float, order: Tensor, at_rest: FrameFeatures, rest_order: Tensor
) -> FrameFeatures:
    """The view in which a share of the points is seen where another view has them."""
    count = round(share * len(order))
    chosen = torch.arange(count)
    keypoints, mask, scales = view.keypoints.clone(), view.mask.clone(), view.scales.clone()
    place, there = torch.argsort(order)[chosen], torch.argsort(rest_order)[chosen]
    keypoints[place], mask[place], scales[place] = (
        at_rest.keypoints[there],
        at_rest.mask[there],
        at_rest.scales[there],
    )
    return replace(view, keypoints=keypoints, mask=mask, scales=scales)


def test_a_scene_behind_a_static_overlay_initializes_a_map() -> None:
    views = [SCENE.view(0, pose()), SCENE.view(1, SIDE)]
    half = static(views[1], 0.6, SCENE.shows(1), views[0], SCENE.shows(0))
    start, reason = tried_views([views[0], half], "initialization.min_matches=60")
    assert start is not None, reason
    wanted = SIDE[:3, 3] / SIDE[:3, 3].norm()
    torch.testing.assert_close(start.T_cw[:3, 3], wanted, atol=1e-4, rtol=0)
    count = int((half.keypoints[SCENE.at(1)] != views[0].keypoints[SCENE.at(0)]).any(-1).sum())
    start, reason = tried_views([views[0], half], f"initialization.min_matches={count}")
    assert start is None
    assert "the camera stands still" in reason or "not clear" in reason


ROLLED = pose(-0.6, 0.3, 0.1, 0.02, -0.02, 0.05)  # what stays in place is on no epipolar line


def with_static(T_cw: Tensor, share: float, noise: float = 0.0) -> tuple[Initializer, TwoViewMap | None]:
    """An initializer that has seen two views, the second at T_cw with a share of points where the first has them."""
    views = [SCENE.view(index, T, noise=noise) for index, T in enumerate(pair(T_cw))]
    some = static(views[1], share, SCENE.shows(1), views[0], SCENE.shows(0))
    initializer = Initializer(SharedCamera(CAMERA), load_config(None, ["initialization.min_matches=60"]))
    step(initializer, views[0])
    return initializer, step(initializer, some)[0]


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_static_image_points_are_excluded_from_initialization(share: float) -> None:
    """Most of the image moves with the scene, but some of it stays."""
    _, start = with_static(ROLLED, share)
    assert start is not None
    moving = SCENE.shows(1)[start.keypoints_2] >= round(share * len(SCENE))
    assert moving.double().mean() > 0.98
    wanted = ROLLED[:3, 3] / ROLLED[:3, 3].norm()
    torch.testing.assert_close(start.T_cw[:3, 3], wanted, atol=1e-3, rtol=0)


@pytest.mark.parametrize("T_cw", [pose(-0.5, 0.0, 0.0, 0.0, -0.03, 0.0), SIDE])
def test_points_behind_the_camera_are_excluded(T_cw: Tensor) -> None:
    """Sideways, what stays in place is near its epipolar line; the turn says that it would be behind the camera."""
    initializer, start = with_static(T_cw, 0.3, noise=0.2)
    assert start is not None
    assert len(initializer.static_pixels) > 80
    wanted = T_cw[:3, 3] / T_cw[:3, 3].norm()
    torch.testing.assert_close(start.T_cw[:3, 3], wanted, atol=0.02, rtol=0)


@pytest.mark.parametrize(("turn", "left_out"), [(-0.003, False), (-0.012, True)])
def test_points_at_infinity_within_noise_are_inliers(turn: float, left_out: bool) -> None:
    """A turn of 0.003 moves the image of infinity by 0.6 pixels, less than the threshold of 1.5."""
    initializer, _ = with_static(pose(-0.5, 0.0, 0.0, 0.0, turn, 0.0), 0.3)
    assert (len(initializer.static_pixels) > 80) is left_out


def test_a_moving_object_before_a_static_camera_is_no_scene() -> None:
    """A flat thing: one homography explains its motion."""
    views = [SCENE.view(0, pose()), SCENE.view(1, pose())]
    moving = torch.argsort(SCENE.shows(1))[150:]
    keypoints = views[1].keypoints.clone()
    keypoints[moving] += torch.tensor([30.0, 5.0], dtype=torch.float64)
    start, reason = tried_views(
        [views[0], replace(views[1], keypoints=keypoints)], "initialization.min_matches=50"
    )
    assert start is None
    assert re_any(
        reason, "possible moving object in front of a stationary camera", "the motion of the rest is unclear"
    )


def test_a_rotating_camera_gives_no_depth() -> None:
    assert "only turns" in tried(pair(pose(0, 0, 0, 0.02, 0.1, 0.05)), noise=0.2)[1]


WALL = Scene(SCENE.points_w * torch.tensor([1.0, 1.0, 0.0]).double() + torch.tensor([0.0, 0, 4.0]).double(),
             SCENE.sizes, SCENE.descriptors)  # fmt: skip
TURNED = pose(-1.2, 0.1, 0.5, 0.0, -0.25, 0.0)


def test_a_plane_is_accepted_after_several_frames() -> None:
    poses = torch.stack([pose(), *[TURNED] * 4])
    for patience, believed in ((4, True), (5, False)):
        start, reason = tried(
            poses,
            f"initialization.min_planar_frames={patience}",
            "initialization.min_matches=50",
            scene=WALL,
            noise=0.2,
        )
        if believed:
            assert "looks planar" not in reason
        else:
            assert start is None
            assert "looks planar" in reason


def test_planes_seen_with_an_earlier_reference_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera that turns while it moves on looks a while as if before a plane: so do the first frames after a turn."""
    poses = torch.stack([pose(), *[TURNED] * 3, pose(), TURNED])
    monkeypatch.setattr(initialization, "MAX_REFERENCE_AGE", 4)
    start, reason = tried(
        poses, "initialization.min_planar_frames=4", "initialization.min_matches=50", scene=WALL, noise=0.2
    )
    assert start is None
    assert "looks planar" in reason


def test_a_short_baseline_leaves_depths_uncertain() -> None:
    # sigma / (f a): one to three pixels of scale; at 200 px and a tenth a parallax of 0.05 to 0.15 is needed
    start, reason = tried(pair(pose(-0.1)), noise=0.1)
    assert start is None
    assert re_any(reason, "parallax", "uncertain", "planar", "turns", "ambiguous")
    assert tried(pair(pose(-0.6)), noise=0.1)[0] is not None


def re_any(text: str, *parts: str) -> bool:
    return any(part in text for part in parts)


def seen(angles: list[float], errors: float = 0.0, mask: bool = True) -> Triangulation:
    angle = torch.tensor(angles, dtype=torch.float64)
    zero, points = torch.zeros_like(angle), torch.zeros(len(angles), 3, dtype=torch.float64)
    return Triangulation(points, angle, zero, zero, zero, zero + errors, (zero == 0) & mask)


def good(
    angles: list[float], sigma: float = 1.0, off: float = 0.0, mask: bool = True, config: Config = DEFAULT
) -> list[bool]:
    """Which points are good that are seen under angles, off by a multiple of the noise."""
    ones = torch.ones(len(angles), dtype=torch.float64)
    return is_good(seen(angles, mask=mask), off**2 * ones, sigma * ones, CAMERA, config).tolist()


def test_a_point_is_good_when_its_depth_is_certain_to_a_tenth() -> None:
    assert good([0.0501, 0.0499]) == [True, False]  # 1 / (200 * 0.05)
    assert good([0.1002, 0.0998], sigma=2.0) == [True, False]
    assert good([0.0, 1.0], mask=False) == [False, False]
    assert good([1.0, 1.0], off=2.99) == [True, True]
    assert good([1.0, 1.0], off=3.01) == [False, False]


def test_with_the_parallax_criterion_a_point_needs_an_angle() -> None:
    assert good([math.radians(3.01), math.radians(2.99)], config=PARALLAX) == [True, False]


def reason_for(count: int, total: int, matches: int, share: float = 0.15, config: Config = DEFAULT) -> str:
    good = torch.arange(total) < count
    return str(check_two_view_map(good, seen([math.radians(4.9)] * total), matches, config, share) or "")


def test_rejected_initializations_have_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    assert reason_for(60, 100, 100) == ""
    assert reason_for(59, 100, 100) == "too little parallax: 59 points have enough, 60 are needed"
    assert reason_for(60, 100, 400) == ""
    assert reason_for(60, 100, 401).startswith("depths too uncertain: 60 of 401 are certain, 15%")
    assert reason_for(60, 100, 100, share=0.61).startswith("depths too uncertain")
    assert (
        reason_for(60, 100, 400, config=PARALLAX)
        == "too little parallax: 4.9 degrees on average, 5.0 are needed"
    )
    assert (
        reason_for(39, 100, 400, config=PARALLAX)
        == "too little parallax: 39 points have enough, 40 are needed"
    )
    monkeypatch.setattr(initialization, "PAPER_MEAN_PARALLAX_DEG", 4.8)
    assert reason_for(60, 100, 1000, config=PARALLAX) == ""


def test_most_points_must_lie_in_front() -> None:
    for behind, fine in ((20, True), (21, False)):
        some = seen([0.1] * 100)
        some = replace(some, mask=torch.arange(100) >= behind)
        reason = check_two_view_map(torch.ones(100, dtype=torch.bool), some, 100, DEFAULT, 0.15)
        assert (reason is None) is fine
        assert fine or str(reason) == "matches behind a camera: only 79% lie in front of both"


def refined(scales: Tensor, off: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Refinement from the truth, in units of twice the baseline, with pixels of the second view off by (n, 2)."""
    points_w = SCENE.points_w[:200]
    pixels = [CAMERA.project(transform(T, points_w))[0] for T in (pose(), SIDE)]
    return refine_pair(SIDE, points_w, pixels[0], pixels[1] + off, KeypointNoise.of(scales, None), CAMERA)


def test_an_exact_pair_is_unchanged_by_refinement() -> None:
    T_cw, points_w, agrees = refined(torch.ones(200).double(), torch.zeros(200, 2).double())
    torch.testing.assert_close(T_cw, SIDE, atol=1e-8, rtol=0)
    torch.testing.assert_close(points_w, SCENE.points_w[:200], atol=1e-6, rtol=0)
    assert agrees.all()


def test_the_baseline_keeps_its_length_and_noise_weighs_by_its_variance() -> None:
    generator = torch.Generator().manual_seed(2)
    scales = torch.where(torch.arange(200) % 2 == 0, 1.0, 6.0).double()
    noise = torch.randn(200, 2, generator=generator, dtype=torch.float64)
    T_cw, _, agrees = refined(scales, 0.5 * scales[:, None] * noise)
    assert float(T_cw[:3, 3].norm()) == pytest.approx(float(SIDE[:3, 3].norm()))
    blunt, _, _ = refined(torch.ones(200).double(), 0.5 * scales[:, None] * noise)
    off, much = ((camera_center(T) - camera_center(SIDE)).norm() for T in (T_cw, blunt))
    assert off < 0.7 * much
    assert agrees.double().mean() > 0.9


def test_coarse_keypoints_are_weighted_by_their_variance() -> None:
    """Half of the keypoints are six times as coarse and 3 px too low: 3 / 37 px are left of that."""
    coarse = torch.arange(200) % 2 == 1
    off = torch.zeros(200, 2, dtype=torch.float64)
    off[coarse, 1] = 3.0
    T_cw, _, _ = refined(torch.where(coarse, 6.0, 1.0).double(), off)
    sunk = [CAMERA.project(transform(T, SCENE.points_w[:200]))[0][:, 1] for T in (SIDE, T_cw)]
    assert float((sunk[1] - sunk[0]).median()) == pytest.approx(3 / 37, rel=0.4)


def test_points_that_disagree_with_both_views_are_flagged() -> None:
    off = torch.zeros(200, 2, dtype=torch.float64)
    off[:10, 1] = 12.0  # across the epipolar lines: shared by the two views, six each
    ones = torch.ones(200, dtype=torch.float64)
    assert not refined(ones, off)[2][:10].any()
    assert refined(ones, off)[2][10:].double().mean() > 0.95
    assert refined(torch.where(off[:, 1] > 0, 6.0, 1.0).double(), off)[2][:10].all()


def turning(focal: float, *overrides: str, T_cw: Tensor | None = None) -> tuple[TwoViewMap | None, str]:
    """The first map, or the last rejection, of a camera that turns, or of poses (F, 4, 4), with a focal length."""
    if T_cw is None:
        T_cw = torch.stack([pose(0, 0, 0, 0.02 * k, 0.06 * k, 0.02 * k) for k in range(7)])
    camera = CAMERA.with_params(torch.cat((torch.full_like(CAMERA.params[:2], focal), CAMERA.params[2:])))
    scene = Scene.of(600, width=14.0)
    always = ["initialization.min_matches=60", "initialization.min_planar_frames=2"]
    initializer = Initializer(SharedCamera(camera), load_config(None, [*always, *overrides]))
    start, reason = None, ""
    for index, T in enumerate(T_cw):
        start, reason = step(initializer, scene.view(index, T, noise=0.2))
        if start is not None:
            break
    return start, reason


@pytest.mark.parametrize("focal", [110.0, 350.0])
def test_a_rotating_camera_gives_no_depth_with_a_guess_of_its_focal_length(focal: float) -> None:
    assert turning(focal)[0] is not None  # with the 2 % of a given camera
    start, reason = turning(focal, "camera.guessed=true")
    assert start is None
    assert reason.startswith("the camera only turns: a rotation with a focal length of about ")
    assert float(reason.split("about ")[1].split(" px")[0]) == pytest.approx(200.0, rel=0.05)


def test_the_error_of_the_camera_bounds_the_focal_length_of_a_rotation() -> None:
    assert turning(350.0, "camera.std=0")[0] is not None
    assert turning(350.0, "camera.std=0.1")[0] is not None  # log(350 / 200) is 5.6 of these
    start, reason = turning(350.0, "camera.std=0.3")
    assert start is None
    assert "only turns: a rotation with a focal length" in reason


@pytest.mark.parametrize("focal", [160.0, 200.0, 300.0])
def test_a_guess_of_the_focal_length_does_not_hide_depth(focal: float) -> None:
    T_cw = torch.stack([pose(-0.1 * k, 0.0, 0.02 * k, 0.01 * k, 0.03 * k, 0.0) for k in range(9)])
    certain, reason = turning(focal, "camera.std=0", T_cw=T_cw)
    assert certain is not None, reason
    guessed, reason = turning(focal, "camera.guessed=true", T_cw=T_cw)
    assert guessed is not None, reason
    assert guessed.view.index == certain.view.index
    assert torch.equal(guessed.T_cw, certain.T_cw)
