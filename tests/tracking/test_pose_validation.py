"""Every threshold from both sides: a pose just inside is believed, one just outside is not, and says why."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.map.simulated import estimate_at
from tests.scene import pose
from torchslam.geometry import se3_exp
from torchslam.map.atlas import TrackingState
from torchslam.tracking.pose_validation import (
    MAX_POSITION_STD,
    MAX_ROTATION_STD_DEG,
    MAX_SQUARED_ERROR,
    MAX_TURN_DEG,
    MIN_COVERAGE_RATIO,
    MIN_EXPLAINED_RATIO,
    SURE_INLIERS,
    Certainty,
    Verdict,
    check_pose,
    deviations,
    jump,
)
from torchslam.types import PoseEstimate, PosePrediction, Reason, Rejection

HERE = pose(0.3, -0.2, 0.1, 0.2, 0.1, -0.3)


def seen(inliers: int = 60, matches: int = 60, **values: float | Tensor) -> PoseEstimate:
    return estimate_at(HERE, torch.arange(inliers), torch.arange(inliers), matches=matches, **values)


def verdict(
    estimate: PoseEstimate, expected: Tensor | None = None, error: float = 0.9, explained_ratio: float = 1.0
) -> Verdict:
    averages = replace(TrackingState.empty(HERE), error=error, explained_ratio=explained_ratio)
    return check_pose(estimate, None if expected is None else PosePrediction(expected), averages)


def doubt(estimate: PoseEstimate, expected: Tensor | None = None, **averages: float) -> str:
    return str(verdict(estimate, expected, **averages).rejection or "")


def test_a_certain_pose_is_accepted() -> None:
    assert doubt(seen()) == ""
    assert doubt(seen(), HERE) == ""


def test_half_of_the_matches_must_agree() -> None:
    assert doubt(seen(30, 60)) == ""
    assert doubt(seen(29, 60)) == "only 48% of 60 matches agree with the pose"
    assert doubt(seen(1, 1)) == ""
    assert doubt(seen(0, 0)).startswith("only 0% of 0")


def test_errors_averaged_over_frames_must_be_noise() -> None:
    assert doubt(seen(), error=MAX_SQUARED_ERROR - 0.01) == ""
    assert doubt(seen(), error=MAX_SQUARED_ERROR) == ""
    assert doubt(seen(), error=9.0).startswith(
        "the median error of the matches of the last frames is 3.0 times"
    )


def test_coverage_of_the_image_must_suffice() -> None:
    assert doubt(seen(coverage_ratio=MIN_COVERAGE_RATIO)) == ""
    assert doubt(seen(coverage_ratio=MIN_COVERAGE_RATIO - 0.01)).startswith("only 19% of the image")


def test_the_explained_fraction_must_suffice_over_many_frames() -> None:
    least = MIN_EXPLAINED_RATIO
    assert doubt(seen(), explained_ratio=least) == ""
    assert doubt(seen(explained_ratio=0.0)) == ""  # one frame alone proves nothing
    assert doubt(seen(), explained_ratio=least - 0.01).startswith(
        f"the map explains only {least - 0.01:.0%} of the image"
    )


def covariance(position: float = 0.0, rotation: float = 0.0) -> Tensor:
    """Of so much standard deviation along one axis each."""
    return torch.diag(torch.tensor([0, position, 0, 0, 0, rotation], dtype=torch.float64) ** 2)


def test_deviations_are_relative_to_depth_and_in_degrees() -> None:
    every = torch.diag(torch.tensor([0.01, 0.02, 0.02, 0.003, 0.006, 0.006], dtype=torch.float64) ** 2)
    position, rotation = deviations(seen(covariance=every, depth=2.0))
    assert position == pytest.approx(0.015)
    assert rotation == pytest.approx(math.degrees(0.009))


def test_the_position_must_be_certain_relative_to_depth() -> None:
    limit = MAX_POSITION_STD
    assert doubt(seen(covariance=covariance(2.99 * limit), depth=3.0)) == ""
    assert doubt(seen(covariance=covariance(3.01 * limit), depth=3.0)).startswith("position uncertainty 1.7%")


def test_the_rotation_must_be_certain() -> None:
    limit = math.radians(MAX_ROTATION_STD_DEG)
    assert doubt(seen(covariance=covariance(rotation=0.99 * limit))) == ""
    assert "rotation uncertainty 0.91 degrees" in doubt(seen(covariance=covariance(rotation=1.01 * limit)))


def test_the_motion_must_be_plausible() -> None:
    side = pose(2.0)  # half the depth
    assert doubt(seen(), pose(1.99) @ HERE) == ""
    assert doubt(seen(), pose(2.01) @ HERE) == "jumped by 0.50 of the scene depth and 0 degrees"
    assert doubt(seen(depth=3.9), side @ HERE).startswith("jumped by 0.51")
    turn = math.radians(MAX_TURN_DEG)
    few, enough = seen(SURE_INLIERS - 1), seen(SURE_INLIERS)
    assert doubt(few, pose(0, 0, 0, 0.99 * turn) @ HERE) == ""
    odd = pose(0, 0, 0, 1.01 * turn) @ HERE
    assert doubt(few, odd) == "jumped by 0.00 of the scene depth and 20 degrees"
    assert doubt(enough, odd) == ""  # so many matches are not wrong together
    assert doubt(enough, pose(2.01, 0, 0, 1.01 * turn) @ HERE).startswith("jumped by")


def test_a_jump_is_measured_in_its_camera_frame() -> None:
    tangent = torch.tensor([0.3, -0.1, 0.5, 0.0, 0.0, 0.4], dtype=torch.float64)
    expected = se3_exp(-tangent) @ HERE
    moved, turned = jump(seen(depth=0.5), expected)
    assert moved == pytest.approx(float(se3_exp(tangent)[:3, 3].norm()) / 0.5, rel=1e-9)
    assert turned == pytest.approx(math.degrees(0.4))


def test_a_scene_without_depth_is_uncertain() -> None:
    assert doubt(replace(seen(), depth=0.0)).startswith("position uncertainty")


# --- what a pose is good for ------------------------------------------------------------------------------------

TURNED = pose(0, 0, 0, 1.01 * math.radians(MAX_TURN_DEG)) @ HERE
FAR = pose(2.01) @ HERE  # more than half the depth


@pytest.mark.parametrize(
    ("found", "reason", "certainty"),
    [
        (verdict(seen()), None, Certainty.CERTAIN),
        (verdict(seen(29)), Reason.LOW_INLIER_RATIO, Certainty.WRONG),
        (verdict(seen(covariance=covariance(1.0))), Reason.UNCERTAIN_POSITION, Certainty.WRONG),
        (verdict(seen(covariance=covariance(rotation=1.0))), Reason.UNCERTAIN_ROTATION, Certainty.WRONG),
        (verdict(seen(), FAR), Reason.JUMP, Certainty.DOUBTFUL),
        (verdict(seen(SURE_INLIERS - 1, SURE_INLIERS - 1), TURNED), Reason.JUMP, Certainty.DOUBTFUL),
        (verdict(seen(), error=9.0), Reason.LARGE_ERRORS, Certainty.DOUBTFUL),
        (verdict(seen(), explained_ratio=0.0), Reason.LOW_EXPLAINED_RATIO, Certainty.DOUBTFUL),
        (verdict(seen(coverage_ratio=0.0)), Reason.LOW_COVERAGE_RATIO, Certainty.DOUBTFUL),
        (Verdict(Rejection.of(Reason.MOVING_MAJORITY)), Reason.MOVING_MAJORITY, Certainty.WRONG),
        (
            Verdict(Rejection.of(Reason.MOVING_REMAINDER, count=30)),
            Reason.MOVING_REMAINDER,
            Certainty.DOUBTFUL,
        ),
    ],
)
def test_every_reason_has_its_certainty(found: Verdict, reason: Reason | None, certainty: Certainty) -> None:
    assert (None if found.rejection is None else found.rejection.reason) is reason
    assert found.certainty is certainty
    assert found.is_jump is (reason is Reason.JUMP)


def test_a_pose_that_is_wrong_by_itself_is_not_compared_with_the_map() -> None:
    """Of several reasons the first counts: it decides whether the map may be extended."""
    found = verdict(seen(29, coverage_ratio=0.0), FAR, error=9.0, explained_ratio=0.0)
    assert found.rejection is not None
    assert found.rejection.reason is Reason.LOW_INLIER_RATIO
    assert verdict(seen(coverage_ratio=0.0), FAR, error=9.0).is_jump


def test_a_prediction_with_a_covariance_says_what_a_jump_is() -> None:
    """Off by 0.1 of the depth and by 30 degrees: odd where that is six and more deviations, plausible within three."""
    averages = replace(TrackingState.empty(HERE), error=0.9, explained_ratio=1.0)
    for off in (pose(0.1), pose(0, 0, 0, 0, 0.5, 0)):
        for std, is_jump in ((0.01, True), (0.3, False)):
            covariance = std**2 * torch.eye(6, dtype=torch.float64)
            found = check_pose(seen(depth=1.0), PosePrediction(off @ HERE, covariance), averages)
            assert found.is_jump == is_jump
