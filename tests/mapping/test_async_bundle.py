"""Bundle adjustment that is requested now and applied later, here or in another process."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.parallel.test_pool import wait_until_ready
from tests.scene import CAMERA, Scene, adjust_local, rows_of, sideways, submap_of_scene
from torchslam.geometry import Camera, SharedCamera, se3_exp, se3_inverse, umeyama
from torchslam.map.map import Map
from torchslam.mapping import local_bundle
from torchslam.mapping.local_bundle import (
    AsyncBundleAdjustment,
    adjust_all,
    solve_local,
    solve_whole,
    squared_errors,
)
from torchslam.parallel.workers import SolverWorker

SCENE = Scene.of(150)
ROWS = rows_of(SCENE)


@pytest.fixture(autouse=True)
def small_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """Local adjustments free three of the five keyframes."""
    monkeypatch.setattr(local_bundle, "LOCAL_WINDOW", 3)


def perturbed_map(seed: int = 0) -> Map:
    """A row of keyframes, the last ones not where they should be."""
    slam_map = submap_of_scene(SCENE, sideways(5)).map
    generator = torch.Generator().manual_seed(seed)
    for keyframe in (3, 4):
        twist = 0.003 * torch.randn(6, generator=generator, dtype=torch.float64)
        slam_map.keyframes["T_cw"][keyframe] = se3_exp(twist) @ slam_map.T_cw[keyframe]
    return slam_map


def columns(slam_map: Map) -> list[Tensor]:
    """All that an adjustment may change."""
    kept, points = slam_map.keyframes, slam_map.points
    return [kept["T_cw"], kept["covariances"], kept["point_ids"], *(points[name] for name in CHANGED)]


CHANGED = ("positions_w", "covariances_w", "view_directions_w", "is_valid", "times_observed")


def assert_same(mine: Map, other: Map) -> None:
    assert all(torch.equal(a, b) for a, b in zip(columns(mine), columns(other), strict=True))


def adjusted(seed: int = 0) -> Map:
    """The same map, adjusted at once."""
    slam_map = perturbed_map(seed)
    adjust_local(slam_map, 4, CAMERA)
    return slam_map


def mean_error(slam_map: Map, camera: Camera) -> float:
    """Mean squared reprojection error, whitened."""
    return float(squared_errors(slam_map, slam_map.observations(), camera).mean())


def recorded(adjusting: AsyncBundleAdjustment) -> list[Any]:
    """The functions that are started from here on."""
    started: list[Any] = []

    def solver(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        started.append(function)
        return partial(function, *arguments)

    adjusting.solver = solver
    return started


def test_the_map_does_not_change_before_the_result_is_applied() -> None:
    adjusting, slam_map = AsyncBundleAdjustment(SharedCamera(CAMERA)), perturbed_map()
    assert not adjusting.is_pending
    assert adjusting.due is None
    assert not adjusting.is_due(100)
    adjusting.request(slam_map, 4, due=12)
    assert adjusting.is_pending
    assert adjusting.due == 12
    assert [adjusting.is_due(frame) for frame in (11, 12, 13)] == [False, True, True]
    assert_same(slam_map, perturbed_map())
    adjusting.apply(slam_map)
    assert_same(slam_map, adjusted())
    assert not adjusting.is_pending
    adjusting.apply(slam_map)  # there is nothing more
    assert_same(slam_map, adjusted())


def test_a_request_is_started_once() -> None:
    adjusting, slam_map = AsyncBundleAdjustment(SharedCamera(CAMERA)), perturbed_map()
    started = recorded(adjusting)
    adjusting.start()  # nothing was requested
    adjusting.request(slam_map, 4, due=12)
    assert not started
    adjusting.start()
    adjusting.start()
    assert started == [solve_local]
    assert_same(slam_map, perturbed_map())
    adjusting.apply(slam_map)
    assert_same(slam_map, adjusted())
    adjusting.start()
    assert len(started) == 1
    adjusting.request(slam_map, 3, due=20)
    adjusting.apply(slam_map)  # one that was not started is started now
    assert len(started) == 2
    adjusting.request(slam_map, 4, due=30)
    adjusting.start()
    adjusting.drop()
    before = [column.clone() for column in columns(slam_map)]
    adjusting.apply(slam_map)
    assert all(torch.equal(a, b) for a, b in zip(columns(slam_map), before, strict=True))


def test_a_request_can_be_hurried_or_dropped_or_due_before_the_next_frame() -> None:
    adjusting, slam_map = AsyncBundleAdjustment(SharedCamera(CAMERA)), perturbed_map()
    adjusting.set_deadline(3)
    assert not adjusting.is_pending
    assert not adjusting.is_due_before_next_frame
    adjusting.request(slam_map, 4, due=12)
    assert not adjusting.is_due_before_next_frame
    adjusting.set_deadline(9)
    assert adjusting.due == 9
    adjusting.drop()
    adjusting.apply(slam_map)
    assert_same(slam_map, perturbed_map())
    adjusting.request(slam_map, 4, due=None)
    assert adjusting.is_pending
    assert adjusting.is_due_before_next_frame
    assert adjusting.due is None
    assert adjusting.is_due(0)  # after whatever frame, at the latest
    assert_same(slam_map, perturbed_map())
    adjusting.apply(slam_map)
    assert_same(slam_map, adjusted())
    assert not adjusting.is_due_before_next_frame


def test_an_empty_request_is_due_as_well() -> None:
    adjusting, slam_map = AsyncBundleAdjustment(SharedCamera(CAMERA)), perturbed_map()
    slam_map.keyframes["point_ids"][:] = -1
    adjusting.request(slam_map, 4, due=12)
    assert adjusting.is_due(12)
    before = slam_map.T_cw.clone()
    adjusting.apply(slam_map)
    assert torch.equal(slam_map.T_cw, before)
    assert not adjusting.is_pending


def test_a_whole_map_is_adjusted_by_another_camera_later() -> None:
    """All keyframes but the first, in place and unit of the map; the camera is replaced once it is applied."""
    shared = SharedCamera(CAMERA)
    other = CAMERA.with_params(CAMERA.params * CAMERA.params.new_tensor([1.02, 1.02, 1, 1]))
    adjusting, slam_map, used = AsyncBundleAdjustment(shared), perturbed_map(), list[Any]()
    started = recorded(adjusting)
    adjusting.request_whole(slam_map, other, due=12, on_applied=lambda: used.append(slam_map.T_cw.clone()))
    assert started == [solve_whole]  # at once, since the camera was estimated for this map
    assert adjusting.is_whole
    assert [adjusting.is_due(frame) for frame in (11, 12)] == [False, True]
    assert not adjusting.is_due_before_next_frame
    assert_same(slam_map, perturbed_map())
    before, off = slam_map.T_cw.clone(), mean_error(slam_map, other)
    adjusting.apply(slam_map)
    assert not adjusting.is_pending
    assert not adjusting.is_whole
    assert len(used) == 1
    assert torch.equal(used[0], slam_map.T_cw)  # called after the map has changed
    expected = perturbed_map()
    adjust_all(expected, other)
    assert off > 5 * mean_error(expected, other)
    assert mean_error(slam_map, other) < 1.2 * mean_error(expected, other)
    centers, centers_before = (se3_inverse(T_cw)[:, :3, 3] for T_cw in (slam_map.T_cw, before))
    assert float(umeyama(centers_before, centers)[0]) == pytest.approx(1.0, abs=1e-3)
    torch.testing.assert_close(centers.mean(0), centers_before.mean(0), rtol=0.0, atol=1e-3)
    adjusting.request(slam_map, 4, due=20)
    assert not adjusting.is_whole
    adjusting.drop()
    adjusting.request_whole(slam_map, CAMERA, due=30, on_applied=lambda: pytest.fail("it was dropped"))
    adjusting.drop()
    adjusting.apply(slam_map)
    assert not adjusting.is_whole


def test_a_solver_is_used_within_its_context() -> None:
    adjusting = AsyncBundleAdjustment(SharedCamera(CAMERA))

    def elsewhere(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        return partial(function, *arguments)

    def fail() -> None:
        with adjusting.solved_by(elsewhere):
            assert adjusting.solver is elsewhere
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert adjusting.solver is partial


@pytest.fixture(scope="module")
def worker() -> Iterator[SolverWorker]:
    """A process that has started."""
    with SolverWorker() as solver:
        wait_until_ready(solver)
        yield solver


def test_another_process_computes_the_same_result(worker: SolverWorker) -> None:
    adjusting = AsyncBundleAdjustment(SharedCamera(CAMERA))
    adjusting.solver = worker
    for seed in (0, 1):
        expected = adjusted(seed)
        slam_map = perturbed_map(seed)
        adjusting.request(slam_map, 4, due=12)
        adjusting.apply(slam_map)
        assert_same(slam_map, expected)
    adjusting.request(perturbed_map(2), 4, due=12)
    adjusting.drop()  # its answer comes all the same, and is not mistaken for the next one
    slam_map = perturbed_map(3)
    adjusting.request(slam_map, 4, due=12)
    adjusting.apply(slam_map)
    assert_same(slam_map, adjusted(3))


def test_errors_of_the_worker_are_raised_here(worker: SolverWorker) -> None:
    slam_map = perturbed_map()
    adjusting = AsyncBundleAdjustment(SharedCamera(CAMERA))

    def wrong(function: Callable[..., Any], problem: BundleProblem, iterations: int) -> Callable[[], Any]:
        problem.frame_index[0] = 99
        return worker(function, problem, iterations)

    adjusting.solver = wrong
    adjusting.request(slam_map, 4, due=12)
    with pytest.raises(ValueError, match="frame_index") as raised:
        adjusting.apply(slam_map)
    assert "solve_local" in str(raised.value.__cause__)


def test_the_run_continues_without_a_killed_worker() -> None:
    adjusting, slam_map = AsyncBundleAdjustment(SharedCamera(CAMERA)), perturbed_map()
    with SolverWorker() as solver:
        wait_until_ready(solver)
        adjusting.solver = solver
        adjusting.request(slam_map, 4, due=12)
        os.kill(solver._workers[0].process.pid or 0, signal.SIGKILL)
        solver._workers[0].process.join()
        with pytest.warns(UserWarning, match="died"):
            adjusting.apply(slam_map)
        assert_same(slam_map, adjusted())
        slam_map = perturbed_map(1)
        adjusting.request(slam_map, 4, due=12)
        adjusting.apply(slam_map)
        assert_same(slam_map, adjusted(1))


def test_a_worker_that_has_not_started_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: False)
    with SolverWorker() as solver:
        monkeypatch.setattr(solver, "result", None)
        adjusting, slam_map = AsyncBundleAdjustment(SharedCamera(CAMERA)), perturbed_map()
        adjusting.solver = solver
        adjusting.request(slam_map, 4, due=12)
        adjusting.apply(slam_map)
        assert_same(slam_map, adjusted())
