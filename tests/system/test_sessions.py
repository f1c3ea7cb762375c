"""Maps that last: submaps that are saved, and gone on in; what a frame must be to be processed at all."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc
from torchslam import SLAM, Config, Frame, Run, State, TorchslamError, evaluate, load_config
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError, FrameError, ResultsError
from torchslam.system import state_machine
from torchslam.system.front_end import Simulated, WithFeatures
from torchslam.types import Features

SIMULATED = ["features.kind=simulated", "features.num_keypoints=300", "simulated.points_per_view=200"]
SIMULATED += ["camera.readout_std=0"]
FIRST = 30  # frames of the walk that the first session sees
WALK = Walk(arc(50))


def config_of(*overrides: str) -> Config:
    return load_config(None, [*SIMULATED, *overrides])


def simulated_features(seed: int = 0) -> Simulated:
    """Features of the scene of the whole walk; frames of a part of it are known by their true poses."""
    return Simulated(config_of(f"seed={seed}"), WALK.camera, true_T_cw(WALK))


SEEN = simulated_features().of(WALK)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[SLAM, Run, Path]:
    """A system that has seen the beginning of the walk, its run, and the file of its submaps."""
    slam = SLAM(WALK.camera, config_of())
    run = slam.run(SEEN.part(0, FIRST))
    path = tmp_path_factory.mktemp("saved") / "map.safetensors"
    slam.save(path)
    return slam, run, path


def test_a_loaded_map_is_saved_with_the_same_bytes(first: tuple[SLAM, Run, Path], tmp_path: Path) -> None:
    loaded = SLAM.load(first[2], config_of(), mapping=False)
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == first[2].read_bytes()
    assert loaded.camera.size == WALK.camera.size
    assert loaded.session.number == 1


@pytest.fixture(scope="module")
def second(first: tuple[SLAM, Run, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    """The run of a second session, and the file of the submaps that both have made."""
    slam = SLAM.load(first[2], config_of())
    assert slam.map.num_keyframes == first[1].map.num_keyframes
    assert len(slam.trajectory()) == 0
    assert (slam.map.points["last_seen_frame"] == -1).all()  # frames are numbered anew
    run = slam.run(SEEN.part(FIRST - 10))
    path = tmp_path_factory.mktemp("grown") / "map.safetensors"
    slam.save(path)
    return run, path


def test_a_new_session_extends_the_map(first: tuple[SLAM, Run, Path], second: tuple[Run, Path]) -> None:
    run, path = second
    assert len(run.submaps) == 1
    assert run.session == 1
    assert len(run.trajectory) == len(WALK) - FIRST + 10
    assert run.results[0].state is State.UNCERTAIN
    assert run.results[-1].state is State.TRACKING
    assert run.map.num_keyframes > first[1].map.num_keyframes
    assert len(run.keyframes) == int((run.map.keyframes["session"] == 1).sum()) > 0
    assert evaluate(run.trajectory, WALK.groundtruth).ate_m < 1e-3
    (submap,) = run.submaps
    both = torch.cat([submap.trajectory(session).timestamps for session in (0, 1)])
    assert len(both) == len(submap.trajectory()) == FIRST + len(run.trajectory)
    assert len(run.graph.timestamps) == len(both)  # frames of the same number in both sessions are two
    assert evaluate(submap.trajectory(0), WALK.groundtruth).ate_m < 1e-3
    assert SLAM.load(path, config_of()).session.number == 2


def test_a_third_session_relocalizes_in_both_earlier_ones(second: tuple[Run, Path]) -> None:
    run, path = second
    third = SLAM.load(path, config_of(), mapping=False)
    assert len(third.loop_closer.keyframe_database) == run.map.num_keyframes
    assert third.step(SEEN[45]).reason == "relocalized"


def columns_of(slam: SLAM) -> list[tuple[str, str, torch.Tensor]]:
    tables = {"points": slam.map.points, "keyframes": slam.map.keyframes}
    return [(kind, name, rows) for kind, table in tables.items() for name, rows in table.columns().items()]


def test_localization_does_not_change_the_map(first: tuple[SLAM, Run, Path], tmp_path: Path) -> None:
    slam = SLAM.load(first[2], config_of(), mapping=False)
    before = {(kind, name): rows.clone() for kind, name, rows in columns_of(slam)}
    run = slam.run(SEEN.part(5, FIRST + 5))
    assert len(run.trajectory) >= FIRST - 5
    assert evaluate(run.trajectory, WALK.groundtruth).ate_m < 1e-3
    assert not any(result.is_keyframe for result in run.results)
    for kind, name, rows in columns_of(slam):
        assert torch.equal(rows, before[kind, name]), name
    slam.save(tmp_path / "after")
    assert (tmp_path / "after").read_bytes() == first[2].read_bytes()


def test_localization_elsewhere_finds_no_pose_and_starts_no_map(
    first: tuple[SLAM, Run, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_machine, "FRAMES_BEFORE_NEW_SUBMAP", 2)
    slam = SLAM.load(first[2], config_of(), mapping=False)
    run = slam.run(simulated_features(seed=1).of(WALK).part(0, 10))  # another scene: a map of it could begin
    assert {result.state for result in run.results} == {State.LOST}
    assert len(run.submaps) == 1
    assert len(run.trajectory) == 0
    assert run.failure == "none of 10 frames was recognized in the map"
    assert run.graph is not None


def test_localization_needs_a_map(tmp_path: Path) -> None:
    SLAM(WALK.camera, config_of()).save(tmp_path / "empty")
    with pytest.raises(ResultsError, match="no submap in it to localize in"):
        SLAM.load(tmp_path / "empty", config_of(), mapping=False)
    slam = SLAM.load(tmp_path / "empty", config_of())
    assert len(slam.run(SEEN.part(0, 12)).trajectory) == 12


def test_another_feature_extractor_is_refused(first: tuple[SLAM, Run, Path]) -> None:
    def with_floats(frame: Frame) -> Features:
        seen = simulated_features()(frame)
        return replace(seen, descriptors=seen.descriptors.float())

    def with_fewer(frame: Frame) -> Features:
        seen = simulated_features()(frame)
        return seen.rows(slice(200))

    for other in (with_floats, with_fewer):
        with pytest.raises(ConfigError, match="made with another feature extractor"):
            SLAM.load(first[2], config_of()).step(WithFeatures(WALK, other)[0])
    assert (
        SLAM.load(first[2], config_of(), mapping=False).step(WithFeatures(WALK, with_fewer)[0]).T_cw
        is not None
    )


# --- frames that cannot be ----------------------------------------------------------------------------------


def test_a_frame_is_not_processed_twice() -> None:
    slam = SLAM(WALK.camera, config_of())
    slam.step(SEEN[3])
    for frame in (
        SEEN[3],
        SEEN[2],
        replace(SEEN[4], timestamp=SEEN[3].timestamp),
        replace(SEEN[4], index=3),
        replace(SEEN[4], timestamp=float("nan")),
        replace(SEEN[4], timestamp=1403636579763555584.0),  # which no map file takes
    ):
        with pytest.raises(FrameError, match=r"does not come after|has the time nan|times are seconds"):
            slam.step(frame)
    slam.step(SEEN[4])


def test_an_image_of_another_size_is_refused() -> None:
    slam = SLAM(WALK.camera, config_of())
    small = replace(SEEN[0], image=torch.zeros(1, 1, 120, 160))
    with pytest.raises(FrameError, match="160 x 120 pixels, the camera 320 x 240"):
        slam.step(small)
    slam.step(SEEN[0])


class Stumbling(Sequence):
    """A sequence whose frame 7 is of another size and whose clock stands still at frame 12."""

    def __init__(self) -> None:
        super().__init__("stumbling", "poses", WALK.camera, WALK.timestamps[:20], WALK.groundtruth)

    def image(self, index: int) -> torch.Tensor:
        return torch.zeros(1, 1, 10, 10) if index == 7 else WALK.image(index)

    def image_name(self, index: int) -> str:
        return f"image {index}"

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        return replace(frame, timestamp=float(self.timestamps[11])) if index == 12 else frame


def test_a_run_skips_invalid_frames() -> None:
    slam = SLAM(WALK.camera, config_of("paper.unrefined=true"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run = slam.run(simulated_features().of(Stumbling()))
    assert len(run.skipped) == len(caught) == 2
    assert "image 7 has 10 x 10 pixels" in run.skipped[0]
    assert "image 12" in run.skipped[1]
    assert len(run.results) == len(run.trajectory) == 18


@pytest.mark.parametrize("before", [lambda slam: slam.run(SEEN.part(0, 5)), lambda slam: slam.step(SEEN[0])])
def test_a_second_run_is_refused_until_reset(before: Callable[[SLAM], object]) -> None:
    slam = SLAM(WALK.camera, config_of("paper.unrefined=true"))
    before(slam)
    with pytest.raises(TorchslamError, match=r"reset\(\).*SLAM.load\(\)"):
        slam.run(SEEN.part(0, 5))
    slam.reset()
    assert slam.session.number == 0
    assert len(slam.run(SEEN.part(0, 12)).trajectory) == 12
