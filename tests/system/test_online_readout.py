"""The readout of a rolling shutter is found and used while the run goes on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchslam import SLAM, Config, Run, StepResult, Trajectory, evaluate, open_sequence
from torchslam.config import CameraConfig
from torchslam.data import Sequence
from torchslam.errors import ResultsError
from torchslam.geometry import SensorModel
from torchslam.geometry.rolling_shutter import Readout
from torchslam.map.file import read_tensors, write_tensors
from torchslam.system.checkpoint import read_checkpoint, write_checkpoint
from torchslam.system.online_run import Observer, OnlineRun, RunProgress
from torchslam.tracking.non_static import NO_MOVEMENT, SceneFilter

SCENE = "synthetic:room?readout=30&pace=2"
ROOM = open_sequence(SCENE, limit=60)


class Saved:
    """A checkpoint of a run that has just found the readout, and its state there."""

    def __init__(self, path: Path, slam: SLAM) -> None:
        self.path, self.slam, self.so_far = path, slam, RunProgress()
        self.readout: Readout | None = None
        self.next_check = 0

    def write(self, _: StepResult) -> None:
        readout = self.slam.shared_camera.model.readout
        if self.readout is None and readout is not None and self.slam.can_checkpoint:
            write_checkpoint(self.path, self.slam, self.so_far, ROOM)
            self.readout, self.next_check = readout, self.slam.online_camera.next_check


def error_after(found: Run, sequence: Sequence, frame: int) -> float:
    """Trajectory error of the online poses after a frame, meters."""
    later = found.online.timestamps > sequence.timestamps[frame]
    online = Trajectory(found.online.timestamps[later], found.online.T_wc[later])
    return evaluate(online, sequence.groundtruth).ate_m


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[SLAM, Run, Saved]:
    slam = SLAM(ROOM.camera)
    saved = Saved(tmp_path_factory.mktemp("readout") / "checkpoint.safetensors", slam)
    with pytest.MonkeyPatch.context() as patched:
        # What moves is not in a checkpoint.
        patched.setattr(SceneFilter, "detect_independent_motion", lambda *_: NO_MOVEMENT)
        run = OnlineRun(slam, ROOM, saved.so_far, observer=Observer(saved.write)).run()
    return slam, run, saved


@pytest.fixture(scope="module")
def found(saved: tuple[SLAM, Run, Saved]) -> tuple[SLAM, Run]:
    return saved[:2]


@pytest.mark.slow
def test_a_readout_is_found_while_the_run_goes_on() -> None:
    """It is taken for no lens, and the poses of the second half, which follow, are better."""
    sequence = open_sequence(SCENE)
    slam = SLAM(sequence.camera)
    corrected = slam.run(sequence)
    first = corrected.camera_changes[0]
    assert first.readout is not None
    assert 0 < first.frame < 60
    assert float(first.readout.seconds) == pytest.approx(0.030, abs=0.005)
    assert slam.shared_camera.model.readout is not None
    assert float(slam.shared_camera.model.readout.seconds) == pytest.approx(0.030, abs=0.0025)
    for change in corrected.camera_changes:
        assert float(change.camera.focal) == pytest.approx(500.0, rel=0.01)
    told = SLAM(sequence.camera, Config(camera=CameraConfig(readout_std=0.0)))
    without = told.run(sequence)
    assert told.shared_camera.model.readout is None
    assert all(change.readout is None for change in without.camera_changes)
    errors = [error_after(run, sequence, first.frame) for run in (corrected, without)]
    assert errors[0] < 0.7 * errors[1]


def test_keypoints_of_keyframes_are_those_of_the_graph(found: tuple[SLAM, Run]) -> None:
    _, corrected = found
    slam_map = corrected.map
    seen, raw = slam_map.observations(), slam_map.observations(as_detected=True)
    of_graph = corrected.graph.global_shutter().pixels[: len(seen)]
    assert float((seen.pixels - raw.pixels).norm(dim=1).max()) > 2.0
    # The graph moves keypoints by the shift of their point, which is off by as much as they are from it.
    assert float((seen.pixels - of_graph).norm(dim=1).median()) < 0.02
    torch.testing.assert_close(seen.pixels, of_graph, rtol=0.0, atol=0.3)
    torch.testing.assert_close(raw.pixels, corrected.graph.pixels[: len(seen)], rtol=0.0, atol=0.0)


def test_keypoints_that_see_no_point_are_corrected_too(found: tuple[SLAM, Run]) -> None:
    keyframes = found[1].map.keyframes
    free = keyframes["mask"] & (keyframes["point_ids"] < 0)
    moved = (keyframes["keypoints"] - keyframes["detected"]).norm(dim=-1)
    assert float(moved[free].max()) > 2.0
    assert bool(keyframes["keypoints"].isfinite().all())


def test_all_but_chosen_keyframes_keep_their_keypoints(found: tuple[SLAM, Run]) -> None:
    submap = found[1].main
    assert submap is not None
    before = submap.map.keyframes["keypoints"].clone()
    submap.correct_keyframes(SensorModel(found[1].camera), newest=2)
    newest = torch.argsort(submap.map.keys, descending=True)[:2]
    changed = (submap.map.keyframes["keypoints"] != before).flatten(1).any(1).nonzero()[:, 0]
    assert sorted(changed.tolist()) == sorted(newest.tolist())
    assert torch.equal(submap.map.keyframes["keypoints"][newest], submap.map.keyframes["detected"][newest])
    submap.map.keyframes["keypoints"][:] = before


def test_a_given_readout_holds_from_the_first_frame() -> None:
    slam = SLAM(ROOM.camera, Config(camera=CameraConfig(readout=30.0, readout_std=1.0)))
    for _ in range(2):
        assert slam.shared_camera.model.readout is not None
        assert float(slam.shared_camera.model.readout.seconds) == pytest.approx(0.03)
        slam.reset()
    assert SLAM(ROOM.camera).shared_camera.model.readout is None


def test_a_resumed_run_goes_on_with_the_readout(
    saved: tuple[SLAM, Run, Saved], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SceneFilter, "detect_independent_motion", lambda *_: NO_MOVEMENT)
    _, whole, before = saved
    resumed, loaded = read_checkpoint(before.path, ROOM, Config())
    assert before.readout is not None
    assert resumed.shared_camera.model.readout == before.readout
    change = next(change for change in whole.camera_changes if change.readout == before.readout)
    assert resumed.online_camera.changes[-1].readout == change.readout
    assert resumed.online_camera.next_check == before.next_check
    T_cw = whole.results[loaded.next].T_cw
    assert T_cw is not None
    assert torch.equal(resumed.step(ROOM[loaded.next]).T_cw, T_cw)
    tensors, about = read_tensors(before.path)
    path = tmp_path / "checkpoint.safetensors"
    for wrong in ([0.03], [float("inf"), 0.001, 0.0, 0.2], [0.03, -1.0, 0.0, 0.2], "fast"):
        write_tensors(path, tensors, about | {"run": about["run"] | {"readout": wrong}})
        with pytest.raises(ResultsError, match="not a whole checkpoint"):
            read_checkpoint(path, ROOM, Config())
