"""The camera before a run: its focal length by pairs of images, the error that is stated, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.walks import Walk, turn
from torchslam.calibration import IntrinsicsEstimate, from_pairs, search_focal
from torchslam.calibration.find_camera import (
    GUESS_STD,
    LEAST_STD,
    contradiction,
    describe_search,
    find_camera,
    with_stated_std,
)
from torchslam.config import CameraConfig, Config, load_config
from torchslam.data import open_sequence
from torchslam.data.calibration import read_numbers
from torchslam.data.sequence import Calibrated, Sequence
from torchslam.errors import ConfigError
from torchslam.geometry import Camera
from torchslam.geometry.view_graph_focal import ViewGraphFocal
from torchslam.global_mapping.mapper import features_to_keep
from torchslam.system.front_end import KeptFeatures, Simulated, true_poses

CAMERA = Camera.pinhole(200.0, 200.0, 159.5, 119.5, size=(320, 240))
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def room() -> Sequence:
    """Rendered images, of whose focal length of 500 px nothing is known."""
    whole = open_sequence("synthetic:room", "f=0.85w", limit=100)
    return whole.with_camera(whole.camera, Calibrated.GUESSED)


@pytest.fixture(scope="module")
def searched(room: Sequence) -> ViewGraphFocal:
    found = search_focal(room, Config())
    assert found is not None
    return found


def walk(poses: torch.Tensor, share: float = 0.85) -> tuple[Sequence, Config]:
    """A walk with `CAMERA`, of which the sequence does not know."""
    settings = ["features.num_keypoints=200", "simulated.points_per_view=90", "simulated.noise_px=0.3"]
    config = load_config(None, ["features.kind=simulated", *settings])
    path = Walk(poses).with_camera(CAMERA)
    guess = CAMERA.with_params(CAMERA.params * torch.tensor([share * 1.6] * 2 + [1.0] * 2))
    unknown = Simulated(config, CAMERA, true_poses(path)).of(path).with_camera(guess, Calibrated.GUESSED)
    return unknown, config


def test_pairs_of_images_give_the_focal_length(searched: ViewGraphFocal) -> None:
    assert searched.success
    assert float(searched.focal) == pytest.approx(500.0, rel=0.05)
    assert abs(float(searched.focal) - 500.0) < 4 * float(searched.std) * 500.0
    assert from_pairs.PLACES < len(searched.errors) <= from_pairs.MAX_PAIRS


@pytest.mark.slow
def test_features_of_mapping_give_the_same_focal_length(room: Sequence, searched: ViewGraphFocal) -> None:
    """The strongest of them, extracted once."""
    kept = features_to_keep(Config(), room.size, from_pairs.NUM_KEYPOINTS)
    assert kept is not None
    found = search_focal(room, Config(), CPU, lambda done, most: None, kept)
    assert found is not None
    assert float(found.focal) == float(searched.focal)
    read: list[int] = []
    again = KeptFeatures(lambda frame: read.append(frame.index) or kept(frame))  # type: ignore[func-returns-value]
    frame = room[3]
    assert again(frame) is again(frame)
    assert len(again(frame).mask[0]) == Config().global_mapping.num_keypoints
    assert read == [3]


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        (["features.kind=simulated"], (640, 480)),
        (["global_mapping.num_keypoints=1499"], (640, 480)),
        ([], (1920, 1080)),  # the search reduces them more
        (["global_mapping.max_image_pixels=40000"], (640, 480)),
    ],
)
def test_other_features_are_not_shared(settings: list[str], size: tuple[int, int]) -> None:
    assert features_to_keep(load_config(None, settings), size, from_pairs.NUM_KEYPOINTS) is None


def test_the_camera_is_written_with_its_error_and_read_again(
    room: Sequence, searched: ViewGraphFocal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchslam.calibration.find_camera.search_focal", lambda *_: searched)
    said: list[str] = []
    found, words = find_camera(room, Config(), tmp_path, CPU, on_progress=said.append)
    assert said == [words]
    assert words == describe_search(searched, found.camera)
    assert float(found.camera.focal) == pytest.approx(float(searched.focal))
    assert found.camera.params[2:].tolist() == room.camera.params[2:].tolist()
    assert found.camera_std == max(LEAST_STD, 2 * float(searched.std))
    assert read_numbers(tmp_path / "calibration.txt").std == pytest.approx(found.camera_std)
    again, words = find_camera(room, Config(), tmp_path, CPU, resume=True)
    assert words == f"from {tmp_path / 'calibration.txt'}"
    assert float(again.camera.focal) == pytest.approx(float(found.camera.focal), rel=1e-6)


def test_the_ratio_of_the_focal_lengths_is_kept(
    room: Sequence, searched: ViewGraphFocal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a video whose pixels are 4:3."""
    params = room.camera.params * torch.tensor([1.0, 4 / 3, 1.0, 1.0], dtype=torch.float64)
    squeezed = room.with_camera(room.camera.with_params(params), Calibrated.GUESSED)
    monkeypatch.setattr("torchslam.calibration.find_camera.search_focal", lambda *_: searched)
    found, _ = find_camera(squeezed, Config(), tmp_path, CPU)
    focal = float(searched.focal)
    expected = [focal, 4 / 3 * focal, *room.camera.params[2:].tolist()]
    assert found.camera.params.tolist() == pytest.approx(expected)
    assert read_numbers(tmp_path / "calibration.txt").params == pytest.approx(expected)


def test_undetermined_focal_lengths_stay_a_guess(
    room: Sequence, searched: ViewGraphFocal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vague = replace(searched, success=torch.tensor(False))
    for search, word in ((vague, "do not determine it"), (None, "no two images")):
        monkeypatch.setattr("torchslam.calibration.find_camera.search_focal", lambda *_, s=search: s)
        found, words = find_camera(room, Config(), tmp_path, CPU)
        assert word in words
        assert found.camera.params.tolist() == room.camera.params.tolist()
        assert found.camera_std == GUESS_STD


def test_a_camera_that_only_turns_gives_no_focal_length() -> None:
    unknown, config = walk(turn(14))
    found = search_focal(unknown, config)
    assert found is None or not found.success


def test_simulated_features_cannot_say_the_camera(tmp_path: Path) -> None:
    unknown, config = walk(turn(2))
    with pytest.raises(ConfigError, match="made with the camera"):
        find_camera(unknown, config, tmp_path, CPU)


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
