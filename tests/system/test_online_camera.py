"""The camera is corrected while the run goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.walks import Walk
from torchslam import SLAM, Camera, Config, Run, StepResult, Trajectory, evaluate, load_config
from torchslam.data.sequence import Sequence
from torchslam.errors import ResultsError
from torchslam.geometry import rigid, so3_exp
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.map.file import read_tensors, write_tensors
from torchslam.optim.observation_graph import RunGraph
from torchslam.optim.sensor_estimate import SensorEstimate, SensorPrior, estimate_sensor
from torchslam.system import map_start
from torchslam.system.checkpoint import read_checkpoint, write_checkpoint
from torchslam.system.front_end import Simulated, true_poses
from torchslam.system.online_camera import (
    ADJUST_FRAMES,
    ESTIMATE_FRAMES,
    FIRST_KEYFRAMES,
    GROWTH,
    MAX_KEYFRAMES,
    OnlineCamera,
)
from torchslam.system.online_run import Observer, OnlineRun, RunProgress

SETTINGS = ["features.kind=simulated", "features.num_keypoints=400", "simulated.points_per_view=250"]
SETTINGS += ["simulated.noise_px=0.2"]
OFF = 1.06
"""Ratio of the given focal length to the true one: two given standard deviations, and known of after a dozen frames."""
EARLY = 40
"""A frame before which an estimate has begun."""


@pytest.fixture(scope="module", autouse=True)
def soon_kept() -> Iterator[None]:
    """A new map is soon no longer taken back."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(map_start, "PROVISIONAL_FRAMES", 8)
        yield


def bend(frames: int, angle: float) -> torch.Tensor:
    """(F, 4, 4) T_wc of a walk along a bend: turning determines a focal length."""
    s = torch.linspace(0, 1, frames, dtype=torch.float64)
    centers = torch.stack([3 * s, 0.2 * torch.sin(9 * s), 1.5 * s * s], -1)
    turns = torch.stack([0.1 * torch.sin(11 * s), angle * torch.sin(2.5 * s), 0.2 * torch.sin(7 * s)], -1)
    return rigid(so3_exp(turns), centers)


WALK = Walk(bend(70, 1.2))


def config(*overrides: str) -> Config:
    return load_config(None, [*SETTINGS, *overrides])


def seen() -> Sequence:
    """The walk with what its true camera sees."""
    return Simulated(config(), WALK.camera, true_poses(WALK)).of(WALK)


def given(factor: float) -> Camera:
    """The camera with another focal length than the true one."""
    params = WALK.camera.params.clone()
    params[:2] *= factor
    return WALK.camera.with_params(params)


def run(factor: float, *overrides: str) -> Run:
    return SLAM(given(factor), config(*overrides)).run(seen())


def focal_error(camera: Camera) -> float:
    return abs(float(camera.focal) / float(WALK.camera.focal) - 1)


def error_after(found: Run, frame: int) -> float:
    """Trajectory error of the online poses after a frame, meters."""
    online = found.online
    later = online.timestamps > WALK.timestamps[frame]
    return evaluate(Trajectory(online.timestamps[later], online.T_wc[later]), WALK.groundtruth).ate_m


class Calls:
    """A solver that computes here, and records when estimates are begun and taken, by the frame before."""

    def __init__(self, slam: SLAM) -> None:
        self.slam, self.begun, self.taken = slam, list[int](), list[int]()
        self.found: list[SensorEstimate] = []
        self.keyframes, self.cameras, self.priors = list[int](), list[Camera](), list[SensorPrior]()

    def __call__(
        self, function: Callable[..., Any], graph: RunGraph, prior: SensorPrior, *more: Any
    ) -> Callable[[], Any]:
        assert function is estimate_sensor
        assert self.slam.submap is not None
        self.keyframes.append(self.slam.submap.map.num_keyframes)
        self.cameras.append(graph.camera)
        self.priors.append(prior)
        assert graph.camera is self.slam.shared_camera.current
        self.begun.append(self.frame)
        found = function(graph, prior, *more)

        def result() -> Any:
            self.taken.append(self.frame)
            self.found.append(found)
            return found

        return result

    @property
    def frame(self) -> int:
        """The frame that is processed now."""
        assert self.slam.last_frame is not None
        return self.slam.last_frame[0]


@pytest.fixture(scope="module")
def watched() -> tuple[Run, Calls, int]:
    """A run with a wrong camera, its estimates, and after how many frames the whole map was being adjusted."""
    slam = SLAM(given(OFF), config())
    calls, adjusted = Calls(slam), 0

    def look(_: StepResult) -> None:
        nonlocal adjusted
        if slam.mapper.adjustment.is_whole:
            adjusted += 1
            assert not slam.can_checkpoint

    begin = slam.online_camera.solver
    with slam.online_camera.solved_by(calls):
        found = OnlineRun(slam, seen(), observer=Observer(look)).run()
    assert slam.online_camera.solver is begin
    return found, calls, adjusted


@pytest.fixture(scope="module")
def corrected(watched: tuple[Run, Calls, int]) -> Run:
    return watched[0]


def test_a_wrong_camera_is_corrected_while_the_run_goes_on(corrected: Run) -> None:
    assert corrected.camera_changes
    for change in corrected.camera_changes:
        assert change.departure > 0
        assert 0 < change.frame < len(WALK) - 1
    assert focal_error(corrected.camera_changes[-1].camera) < 0.02
    assert focal_error(corrected.camera) < 0.01
    fixed = run(OFF, "camera.std=0")
    assert not fixed.camera_changes
    change = corrected.camera_changes[0].frame
    assert error_after(corrected, change) < 0.7 * error_after(fixed, change)


def test_poses_go_on_where_the_map_was(corrected: Run) -> None:
    """The map keeps its place and unit: no frame is far from those before and after it."""
    centers = corrected.online.T_wc[:, :3, 3]
    steps = centers.diff(dim=0).norm(dim=1)
    assert float(steps.max()) < 2.0 * float(steps.median())


@pytest.mark.slow
def test_a_right_camera_stays() -> None:
    found = run(1.0)
    assert found.camera_changes == ()
    assert focal_error(found.camera) < 0.01


def run_until(is_enough: Callable[[OnlineCamera], bool]) -> tuple[SLAM, RunProgress]:
    """A system that may write a checkpoint, once its sensor is as it should be."""
    slam, so_far = SLAM(given(OFF), config()), RunProgress()

    class Enough(BaseException):
        pass

    def stop(_: StepResult) -> None:
        if is_enough(slam.online_camera) and slam.can_checkpoint:
            raise Enough

    with pytest.raises(Enough):
        OnlineRun(slam, seen(), so_far, observer=Observer(stop)).run()
    return slam, so_far


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> tuple[SLAM, Path]:
    """A system after its camera was changed, and its checkpoint."""
    path = tmp_path_factory.mktemp("half") / "checkpoint.safetensors"
    slam, so_far = run_until(lambda sensor: bool(sensor.changes))
    write_checkpoint(path, slam, so_far, seen())
    return slam, path


def test_a_resumed_run_goes_on_with_the_camera_that_was_found(
    corrected: Run, half: tuple[SLAM, Path]
) -> None:
    slam, path = half
    resumed, loaded = read_checkpoint(path, seen(), config())
    assert torch.equal(resumed.shared_camera.current.params, slam.shared_camera.current.params)
    assert not torch.equal(resumed.shared_camera.current.params[:4], resumed.camera.params[:4])
    whole = OnlineRun(resumed, seen(), loaded).run()
    assert torch.equal(whole.trajectory.T_wc, corrected.trajectory.T_wc)
    assert [change.frame for change in whole.camera_changes] == [c.frame for c in corrected.camera_changes]


@pytest.mark.parametrize("params", [[400.0], [float("nan")] * 9, [0.0] * 9])
def test_a_damaged_camera_is_named(params: list[float], half: tuple[SLAM, Path], tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    tensors, about = read_tensors(half[1])
    about["run"]["camera_changes"][0][1] = params
    write_tensors(path, tensors, about)
    with pytest.raises(ResultsError, match="not a whole checkpoint"):
        read_checkpoint(path, seen(), config())


def test_a_new_start_has_the_given_camera_again(half: tuple[SLAM, Path]) -> None:
    slam, _ = read_checkpoint(half[1], seen(), config())
    assert slam.online_camera.changes
    slam.reset()
    assert torch.equal(slam.shared_camera.current.params, slam.camera.params)
    assert slam.online_camera.changes == []


def test_no_frame_waits_for_an_estimate(watched: tuple[Run, Calls, int]) -> None:
    """It is taken some frames after it was begun, and the map that is adjusted by it some frames later."""
    found, calls, _ = watched
    assert len(calls.begun) > 2
    assert calls.begun[0] < EARLY
    assert calls.keyframes[0] >= FIRST_KEYFRAMES
    assert all(later >= GROWTH * earlier for earlier, later in pairwise(calls.keyframes))
    assert calls.keyframes[-1] <= MAX_KEYFRAMES
    waits = [taken - begun for begun, taken in zip(calls.begun, calls.taken, strict=False)]
    assert all(wait >= ESTIMATE_FRAMES for wait in waits)
    assert all(
        begun >= taken for begun, taken in zip(calls.begun[1:], calls.taken, strict=False)
    )  # one at a time
    moments = [taken for taken, found in zip(calls.taken, calls.found, strict=True) if found.is_change]
    assert found.camera_changes
    for moment, change in zip(moments, found.camera_changes, strict=False):
        assert moment < change.frame <= moment + ADJUST_FRAMES


def test_the_estimate_is_by_the_given_camera_and_the_one_in_use(watched: tuple[Run, Calls, int]) -> None:
    _, calls, _ = watched
    slam = calls.slam
    assert {id(prior) for prior in calls.priors} == {id(calls.priors[0])}
    assert calls.priors[0].camera is slam.online_camera.given
    stated = CameraMeasurement.of(slam.camera, slam.config.camera.std)
    assert calls.priors[0].camera is not None
    torch.testing.assert_close(calls.priors[0].camera.directions, stated.directions)
    assert torch.equal(calls.cameras[0].params[:4], slam.camera.params[:4])
    assert calls.cameras[-1] is slam.online_camera.changes[-1].camera
    assert slam.submap is not None
    assert slam.submap.epoch == len(
        slam.online_camera.changes
    )  # poses by another camera are of another world


@pytest.mark.parametrize(
    "settings",
    [("camera.std=0", "camera.readout_std=0"), ("paper.unrefined=true",)],
    ids=["exact", "no adjustment"],
)
def test_nothing_is_estimated_where_nothing_may_change(settings: tuple[str, ...]) -> None:
    slam = SLAM(given(1.0), config(*settings))
    with slam.online_camera.solved_by(lambda *arguments: pytest.fail("an estimate was begun")):
        OnlineRun(slam, seen().part(stop=EARLY)).run()
    assert slam.online_camera.changes == []


def test_a_checkpoint_has_the_estimate_that_is_pending(tmp_path: Path) -> None:
    """The graph of the estimate is gone when the run goes on, so that its result is kept."""
    path = tmp_path / "checkpoint.safetensors"
    slam, so_far = run_until(lambda sensor: sensor.is_pending)
    write_checkpoint(path, slam, so_far, seen())
    resumed, _ = read_checkpoint(path, seen(), config())
    one, other = slam.online_camera.pending, resumed.online_camera.pending
    assert one is not None
    assert other is not None
    assert one[0] == other[0]
    assert one[1].is_change == other[1].is_change
    assert one[1].departure == other[1].departure
    if one[1].has_other_camera:
        assert torch.equal(one[1].sensor.camera.params, other[1].sensor.camera.params)


def test_an_estimate_is_made_once_although_checkpoints_ask_for_it() -> None:
    slam = SLAM(given(OFF), config())
    calls = Calls(slam)
    with slam.online_camera.solved_by(calls):
        for frame in seen():
            slam.step(frame)
            if slam.online_camera.is_pending:
                break
        assert slam.online_camera.pending is not None
        assert slam.online_camera.pending[1] is slam.online_camera.pending[1]
    assert len(calls.taken) == 1


def test_no_checkpoint_while_the_whole_map_is_adjusted(watched: tuple[Run, Calls, int]) -> None:
    assert watched[2] > 0


def test_an_estimate_of_a_map_that_is_gone_is_forgotten(half: tuple[SLAM, Path]) -> None:
    """Of a discarded one at once, and of another one than the active map when it would be taken."""
    slam, _ = read_checkpoint(half[1], seen(), config())
    online, (submap,) = slam.online_camera, slam.atlas
    online.solver = lambda *arguments: lambda: pytest.fail("the estimate was taken")
    online.next_check = 0
    online.step(submap)
    assert online.is_pending
    online.forget()
    assert not online.is_pending
    online.next_check = 0
    online.step(submap)
    assert online.is_pending
    online.step(submap.fork())
    assert not online.is_pending


@pytest.mark.slow
def test_the_stated_error_of_the_camera_is_a_prior(corrected: Run) -> None:
    """The surer the given camera, the less the images move it."""
    sure = run(OFF, "camera.std=0.002")
    last = sure.camera_changes[-1].camera if sure.camera_changes else given(OFF)
    assert focal_error(last) > 2 * focal_error(corrected.camera_changes[-1].camera)
