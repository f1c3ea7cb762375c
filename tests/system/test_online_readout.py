"""The readout of a rolling shutter is found and used while the run goes on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchslam import SLAM, Config, Run, StepResult, Trajectory, evaluate, load_config, open_sequence
from torchslam.config import CameraConfig
from torchslam.errors import ResultsError
from torchslam.map.file import read_tensors, write_tensors
from torchslam.system.checkpoint import read_checkpoint, write_checkpoint
from torchslam.system.run import RunProgress, run_sequence

ROOM = open_sequence("synthetic:room?readout=30&pace=2", limit=60)


def run(**camera: float) -> tuple[SLAM, Run]:
    slam = SLAM(ROOM.camera, Config(camera=CameraConfig(**camera)))
    return slam, slam.run(ROOM)


def error_after(found: Run, frame: int) -> float:
    """Trajectory error of the online poses after a frame, meters."""
    later = found.online.timestamps > ROOM.timestamps[frame]
    online = Trajectory(found.online.timestamps[later], found.online.T_wc[later])
    return evaluate(online, ROOM.groundtruth).ate_m


@pytest.fixture(scope="module")
def found() -> tuple[SLAM, Run]:
    return run()


@pytest.mark.slow
def test_a_readout_is_found_while_the_run_goes_on(found: tuple[SLAM, Run]) -> None:
    """It is taken for no lens, and the poses that follow are better."""
    slam, corrected = found
    first = corrected.camera_changes[0]
    assert first.readout is not None
    assert 0 < first.frame < 45
    assert float(first.readout.seconds) == pytest.approx(0.030, abs=0.005)
    assert slam.shared_camera.readout is not None
    assert float(slam.shared_camera.readout.seconds) == pytest.approx(0.030, abs=0.0025)
    for change in corrected.camera_changes:
        assert float(change.camera.focal) == pytest.approx(500.0, rel=0.01)
    told, without = run(readout_std=0.0)
    assert told.shared_camera.readout is None
    assert all(change.readout is None for change in without.camera_changes)
    assert error_after(corrected, first.frame) < 0.7 * error_after(without, first.frame)


def test_keypoints_of_keyframes_are_those_of_the_graph(found: tuple[SLAM, Run]) -> None:
    slam, corrected = found
    submap, readout = corrected.main, slam.shared_camera.readout
    assert submap is not None
    assert readout is not None
    keyframes = torch.arange(submap.map.num_keyframes)
    raw, seen = submap.map.observations(), slam.online_camera.observations(submap.map, keyframes)
    graph = submap.posed_frames.graph(submap.map, slam.shared_camera.current, readout=readout)
    torch.testing.assert_close(seen.pixels, graph.global_shutter().pixels[: len(seen)], rtol=0.0, atol=1e-6)
    assert float((seen.pixels - raw.pixels).norm(dim=1).max()) > 2.0
    part = slam.online_camera.observations(submap.map, keyframes[2:4])
    rows = (seen.keyframe_index == 2) | (seen.keyframe_index == 3)
    torch.testing.assert_close(part.pixels, seen.pixels[rows], rtol=0.0, atol=0.0)
    assert torch.equal(submap.map.observations().pixels, raw.pixels)  # they stay as they were found


def test_a_given_readout_holds_from_the_first_frame() -> None:
    slam = SLAM(ROOM.camera, Config(camera=CameraConfig(readout=30.0, readout_std=1.0)))
    for _ in range(2):
        assert slam.shared_camera.readout is not None
        assert float(slam.shared_camera.readout.seconds) == pytest.approx(0.03)
        slam.reset()
    assert SLAM(ROOM.camera).shared_camera.readout is None


def test_a_resumed_run_goes_on_with_the_readout(tmp_path: Path) -> None:
    settings = load_config(None, ["independent_motion.enabled=false"])  # what moves is not in a checkpoint
    slam, so_far, path = SLAM(ROOM.camera, settings), RunProgress(), tmp_path / "checkpoint.safetensors"

    class Enough(BaseException):
        pass

    def stop(_: StepResult) -> None:
        if slam.shared_camera.readout is not None and slam.can_checkpoint:
            raise Enough

    with pytest.raises(Enough):
        run_sequence(slam, ROOM, stop, so_far)
    write_checkpoint(path, slam, so_far, ROOM)
    resumed, loaded = read_checkpoint(path, ROOM, settings)
    assert resumed.shared_camera.readout == slam.shared_camera.readout
    assert resumed.online_camera.changes[-1].readout == slam.online_camera.changes[-1].readout
    assert resumed.online_camera.next_readout_check == slam.online_camera.next_readout_check
    following = ROOM[loaded.next]
    assert torch.equal(resumed.step(following).T_cw, slam.step(following).T_cw)
    tensors, about = read_tensors(path)
    for wrong in ([0.03], [float("inf"), 0.001, 0.0, 0.2], [0.03, -1.0, 0.0, 0.2], "fast"):
        write_tensors(path, tensors, about | {"run": about["run"] | {"readout": wrong}})
        with pytest.raises(ResultsError, match="not a whole checkpoint"):
            read_checkpoint(path, ROOM, settings)
