"""The camera is corrected while the run goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
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
from torchslam.map.file import read_tensors, write_tensors
from torchslam.optim.run_graph import RunGraph
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


@pytest.fixture(scope="module")
def corrected() -> Run:
    return run(OFF)


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


def half() -> tuple[SLAM, RunProgress]:
    """A system after its camera was changed."""
    return run_until(lambda sensor: bool(sensor.changes))


def test_a_resumed_run_goes_on_with_the_camera_that_was_found(corrected: Run, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    slam, so_far = half()
    write_checkpoint(path, slam, so_far, seen())
    resumed, loaded = read_checkpoint(path, seen(), config())
    assert torch.equal(resumed.shared_camera.current.params, slam.shared_camera.current.params)
    assert not torch.equal(resumed.shared_camera.current.params[:4], resumed.camera.params[:4])
    whole = OnlineRun(resumed, seen(), loaded).run()
    assert torch.equal(whole.trajectory.T_wc, corrected.trajectory.T_wc)
    assert [change.frame for change in whole.camera_changes] == [c.frame for c in corrected.camera_changes]


@pytest.mark.parametrize("params", [[400.0], [float("nan")] * 9, [0.0] * 9])
def test_a_damaged_camera_is_named(params: list[float], tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint(path, *half(), seen())
    tensors, about = read_tensors(path)
    about["run"]["camera_changes"][0][1] = params
    write_tensors(path, tensors, about)
    with pytest.raises(ResultsError, match="not a whole checkpoint"):
        read_checkpoint(path, seen(), config())


def test_a_new_start_has_the_given_camera_again() -> None:
    slam, _ = half()
    slam.reset()
    assert torch.equal(slam.shared_camera.current.params, slam.camera.params)
    assert slam.online_camera.changes == []


class Calls:
    """A solver that computes here, and records when estimates are begun and taken, by the frame before."""

    def __init__(self, slam: SLAM) -> None:
        self.slam, self.begun, self.taken = slam, list[int](), list[int]()
        self.found: list[SensorEstimate] = []

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        assert function is estimate_sensor
        self.begun.append(self.frame)
        found = function(*arguments)

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


def test_no_frame_waits_for_an_estimate() -> None:
    """It is taken some frames after it was begun, and the map that is adjusted by it some frames later."""
    slam = SLAM(given(OFF), config())
    calls, keyframes = Calls(slam), list[int]()
    begin = slam.online_camera.solver

    def solver(*arguments: Any) -> Callable[[], Any]:
        assert slam.submap is not None
        keyframes.append(slam.submap.map.num_keyframes)
        return calls(*arguments)

    with slam.online_camera.solved_by(solver):
        OnlineRun(slam, seen()).run()
    assert slam.online_camera.solver is begin
    assert len(calls.begun) > 2
    assert keyframes[0] >= FIRST_KEYFRAMES
    assert all(later >= GROWTH * earlier for earlier, later in pairwise(keyframes))
    assert keyframes[-1] <= MAX_KEYFRAMES
    waits = [taken - begun for begun, taken in zip(calls.begun, calls.taken, strict=False)]
    assert all(wait >= ESTIMATE_FRAMES for wait in waits)
    assert all(
        begun >= taken for begun, taken in zip(calls.begun[1:], calls.taken, strict=False)
    )  # one at a time
    changes = slam.online_camera.changes
    moments = [taken for taken, found in zip(calls.taken, calls.found, strict=True) if found.is_change]
    assert changes
    for moment, change in zip(moments, changes, strict=False):
        assert moment < change.frame <= moment + ADJUST_FRAMES


def test_the_estimate_is_by_the_given_camera_and_the_one_in_use() -> None:
    slam = SLAM(given(OFF), config())
    cameras, priors = list[Camera](), set[int]()

    def solver(function: Callable[..., Any], graph: RunGraph, prior: SensorPrior, *more: Any) -> Any:
        cameras.append(graph.camera)
        priors.add(id(prior))
        assert graph.camera is slam.shared_camera.current
        assert prior.camera is slam.online_camera.given
        return partial(function, graph, prior, *more)

    with slam.online_camera.solved_by(solver):
        OnlineRun(slam, seen()).run()
    assert len(priors) == 1
    assert torch.equal(cameras[0].params[:4], slam.camera.params[:4])
    assert cameras[-1] is slam.online_camera.changes[-1].camera
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
        OnlineRun(slam, seen()).run()
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


def test_no_checkpoint_while_the_whole_map_is_adjusted() -> None:
    slam = SLAM(given(OFF), config())
    adjusted = 0

    def look(_: StepResult) -> None:
        nonlocal adjusted
        if slam.mapper.adjustment.is_whole:
            adjusted += 1
            assert not slam.can_checkpoint

    OnlineRun(slam, seen(), observer=Observer(look)).run()
    assert adjusted > 0


def test_an_estimate_of_a_map_that_is_gone_is_forgotten() -> None:
    """Of a discarded one at once, and of another one than the active map when it would be taken."""
    slam, _ = half()
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


def test_the_stated_error_of_the_camera_is_a_prior(corrected: Run) -> None:
    """The surer the given camera, the less the images move it."""
    sure = run(OFF, "camera.std=0.002")
    last = sure.camera_changes[-1].camera if sure.camera_changes else given(OFF)
    assert focal_error(last) > 2 * focal_error(corrected.camera_changes[-1].camera)
