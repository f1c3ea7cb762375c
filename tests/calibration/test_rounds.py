"""Runs and refinements in turns, on simulated features of a known camera; and what is said of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.walks import Walk, arc, turn
from torchslam.calibration import CalibrationResult, CalibrationRound, IntrinsicsEstimate, calibrate
from torchslam.calibration.find_camera import contradiction, describe_camera, with_stated_std
from torchslam.config import CameraConfig, Config, load_config
from torchslam.data.sequence import Calibrated, Sequence
from torchslam.geometry import Camera
from torchslam.system.front_end import Simulated, true_poses

CAMERA = Camera.pinhole(200.0, 200.0, 159.5, 119.5, size=(320, 240))


def walk(poses: torch.Tensor, share: float = 0.85) -> tuple[Sequence, Config]:
    """A walk with `CAMERA`, of which the sequence does not know."""
    settings = ["features.num_keypoints=200", "simulated.points_per_view=90", "simulated.noise_px=0.3"]
    config = load_config(None, ["features.kind=simulated", *settings])
    path = Walk(poses).with_camera(CAMERA)
    guess = CAMERA.with_params(CAMERA.params * torch.tensor([share * 1.6] * 2 + [1.0] * 2))
    unknown = Simulated(config, CAMERA, true_poses(path)).of(path).with_camera(guess, Calibrated.GUESSED)
    return unknown, config


def test_the_focal_length_is_estimated_without_a_guess() -> None:
    unknown, config = walk(arc(22, 2.2))
    rounds: list[CalibrationRound] = []
    found = calibrate(unknown, config, on_progress=rounds.append)
    assert found.is_determined
    assert float(found.camera.focal) == pytest.approx(200.0, rel=0.02)
    assert found.rounds == rounds
    assert [round(float(each.camera.focal) / 320, 3) for each in rounds[:2]] == [0.85, 0.6]
    assert found.estimate is not None
    assert abs(float(found.camera.focal) - 200.0) < 3 * found.estimate.focal_std * 200.0
    assert describe_camera(found).startswith("focal length ")
    assert len(unknown) == 22  # and the sequence is as it was
    assert unknown.calibrated is Calibrated.GUESSED


def test_a_given_camera_is_refined_without_guessing() -> None:
    unknown, config = walk(arc(22, 2.2), share=0.55)
    given = unknown.with_camera(unknown.camera)
    found = calibrate(given, config, radial=0, guess=False)
    assert float(found.camera.focal) == pytest.approx(200.0, rel=0.02)
    assert len(found.rounds) < 4


def test_a_rotating_camera_is_not_calibrated() -> None:
    unknown, config = walk(turn(14))
    found = calibrate(unknown, config)
    assert not found.is_determined
    assert found.camera is unknown.camera or float(found.camera.focal) == float(unknown.camera.focal)
    assert "a guess, which may be wrong by a factor of two" in describe_camera(found)


def test_no_round_makes_a_map_of_a_rotating_camera() -> None:
    """Taken for right, all guesses but the second, which is nearly right, make a translation of it."""
    unknown, config = walk(turn(20, 0.7))
    early = replace(config.initialization, min_planar_frames=2, min_matches=40, min_points=20)
    found = calibrate(unknown, replace(config, initialization=early))
    assert [round(float(each.camera.focal)) for each in found.rounds] == [272, 192, 384, 544]
    assert all(each.estimate is None for each in found.rounds)


def test_a_guess_without_a_search_counts_as_one() -> None:
    unknown, config = walk(turn(2))
    assert with_stated_std(config, unknown).camera.guessed
    assert not with_stated_std(config, unknown.with_camera(unknown.camera)).camera.guessed
    stated = with_stated_std(config, unknown.with_camera(unknown.camera, std=0.1))
    assert stated.camera == CameraConfig(std=0.1)


def refinement(focal: float, std: float, drop: float = 0.0) -> IntrinsicsEstimate:
    camera = CAMERA.with_params(CAMERA.params * torch.tensor([focal / 200] * 2 + [1.0] * 2))
    return IntrinsicsEstimate(camera, 0, std, std, (), 1.0 - drop, 1.0)


@pytest.mark.parametrize(
    ("focal", "std", "drop", "said"),
    [
        (200.5, 1e-5, 0.0, ""),  # certain, but the difference is negligible
        (204.0, 0.005, 0.0, "better with a focal length of 204 ± 1 px than with 200"),
        (205.0, 0.01, 0.01, ""),  # within the error
        # so far off, the run's own choices hide how much further it is
        (
            210.0,
            0.01,
            0.0,
            "better with a focal length of 210 px or more than with 200; poses and map may be badly",
        ),
        (
            160.0,
            0.01,
            0.0,
            "better with a focal length of 160 px or less than with 200; poses and map may be badly",
        ),
        (
            240.0,
            0.09,
            0.05,
            "240 px or more than with 200",
        ),  # uncertain, but the residuals are clearly smaller
        (240.0, 0.09, 0.01, ""),
        (204.0, 0.09, 0.05, ""),
        (240.0, 0.3, 0.05, "contradict a focal length of 200 px and do not determine the right one"),
        (2000.0, 0.01, 0.0, "contradict a focal length of 200 px"),  # beyond the bounds
        (240.0, 0.3, 0.01, ""),
    ],
)
def test_a_contradicted_calibration_is_reported(focal: float, std: float, drop: float, said: str) -> None:
    words = contradiction(CAMERA, refinement(focal, std, drop))
    assert said in words
    assert bool(said) == bool(words)


def test_undetermined_parameters_are_reported() -> None:
    vague = refinement(200.0, 0.12)
    found = CalibrationResult(vague.camera, vague, [])
    assert not found.is_determined
    assert "may be wrong by 24 %" in describe_camera(found)
    assert "a factor of two" in describe_camera(replace(found, estimate=refinement(200.0, 0.7)))
    far = refinement(2000.0, 0.01)  # beyond the bounds
    assert not far.is_determined
    bent = CAMERA.params.new_tensor([200.0, 200.0, 160.0, 120.0, -0.2, 0.05, 0, 0, 0])
    sure = replace(
        refinement(200.0, 0.02),
        camera=Camera("radial_tangential", bent, CAMERA.size),
        num_radial=1,
        k_std=(0.01,),
    )
    assert (
        describe_camera(CalibrationResult(sure.camera, sure, []))
        == "focal length 200 ± 4 px, k1 -0.200 ± 0.010"
    )
