"""The camera before a run: its focal length by pairs of images, the error that is stated, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.walks import Walk, turn
from torchslam.calibration import find_camera as module
from torchslam.calibration import keyframe_evidence, search_focal
from torchslam.calibration.find_camera import (
    GUESS_STD,
    LEAST_STD,
    OPTIONS,
    ROUGH_STD,
    better_camera,
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
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.view_graph_focal import ViewGraphFocal
from torchslam.global_mapping.mapper import features_to_keep
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.system.front_end import KeptFeatures, Simulated, true_poses

CAMERA = Camera.pinhole(200.0, 200.0, 159.5, 119.5, size=(320, 240))
CPU = torch.device("cpu")


@pytest.fixture(scope="module", autouse=True)
def few_places() -> Iterator[None]:
    """Pairs of images from half as many places of a recording."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "PLACES", 10)
        yield


@pytest.fixture(scope="module")
def room() -> Sequence:
    """Rendered images, of whose focal length of 500 px nothing is known."""
    whole = open_sequence("synthetic:room", "f=0.85w", limit=60)
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
    assert module.PLACES < len(searched.errors) <= module.MAX_PAIRS


@pytest.mark.slow
def test_features_of_mapping_give_the_same_focal_length(room: Sequence, searched: ViewGraphFocal) -> None:
    """The strongest of them, extracted once."""
    kept = features_to_keep(Config(), room.size, module.NUM_KEYPOINTS)
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
    assert again.taken(frame) is kept(frame)  # by the last one who asks, so that it is not kept any longer
    again(frame)
    assert read == [3, 3]


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
    assert features_to_keep(load_config(None, settings), size, module.NUM_KEYPOINTS) is None


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
    shaken = replace(config, camera=CameraConfig(readout=20.0, readout_std=1.0, guessed=True))
    stated = with_stated_std(shaken, unknown.with_camera(unknown.camera, std=0.1))
    assert stated.camera == CameraConfig(std=0.1, readout=20.0, readout_std=1.0)


@pytest.mark.parametrize(
    ("focal", "said"),
    [
        (204.0, "better with a focal length of 204 ± 2 than with 200 px"),
        # so far off, the run's own choices hide how much further it is
        (210.0, "better with a focal length of 210 px or more than with 200 px; poses and map may be badly"),
        (160.0, "better with a focal length of 160 px or less than with 200 px; poses and map may be badly"),
    ],
)
def test_a_contradicted_calibration_is_reported(focal: float, said: str) -> None:
    camera = CAMERA.with_params(CAMERA.params * torch.tensor([focal / 200] * 2 + [1.0] * 2))
    assert said in contradiction(CAMERA, CameraMeasurement.of(camera, 0.01), CAMERA)
    assert contradiction(CAMERA, CameraMeasurement.of(camera, 0.01), camera).endswith("than with 200 px")


def straight(camera: Camera, factor: float = 1.0) -> Camera:
    """`factor` times the focal length, no distortion."""
    return Camera.pinhole(factor * camera.fx, factor * camera.fy, camera.cx, camera.cy, camera.size)


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("seed", range(2))
def test_a_better_camera_is_near_the_true_one(
    simulated: Callable[..., ObservationGraph], truth: Camera, factor: float, seed: int
) -> None:
    """The true one is no better than itself."""
    given = straight(truth, factor)
    graph = replace(simulated(straight(truth), noise=0.5, frames=24, seed=seed), camera=given)
    better = better_camera(graph, given)
    if factor == 1.0:
        assert better is None
    else:
        assert better is not None
        assert float(better.camera.focal) == pytest.approx(float(truth.focal), rel=0.02)
        assert abs(float(better.camera.focal / truth.focal) - 1) < 3 * better.focal_std


def test_missing_distortion_contradicts_no_focal_length(
    simulated: Callable[..., ObservationGraph], truth: Camera
) -> None:
    graph = replace(simulated(noise=0.5, frames=24), camera=straight(truth))
    evidence = keyframe_evidence(graph, CameraMeasurement.of(straight(truth), ROUGH_STD), OPTIONS)
    assert evidence is not None
    assert evidence.gain(straight(truth)).is_worth()
    assert float(evidence.estimate().camera.params[4]) == pytest.approx(float(truth.params[4]), abs=0.05)
    assert better_camera(graph, straight(truth)) is None


def test_a_straight_path_does_not_determine_the_camera(
    simulated: Callable[..., ObservationGraph], truth: Camera
) -> None:
    twists = torch.zeros(16, 6, dtype=torch.float64)
    twists[:, 2] = torch.linspace(0, 1.5, 16)
    given = straight(truth, 0.9)
    graph = simulated(straight(truth), noise=0.5, twists=twists, frames=16)
    assert better_camera(replace(graph, camera=given), given) is None
