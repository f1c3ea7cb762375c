"""The graph, the covariances and the adjustments of whole runs on simulated features."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.system.test_slam import NEARLY_EXACT, SIMULATED, run_walk, soon_kept
from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc, walk_with_jump
from torchslam import (
    SLAM,
    StepResult,
    load_config,
    solve_graph,
)
from torchslam.evaluation import ate
from torchslam.features import SimulatedFeatures
from torchslam.geometry import se3_inverse, se3_log, transform
from torchslam.map.map import Map
from torchslam.mapping import local_bundle, mapper
from torchslam.mapping.local_bundle import ApplyAt, AsyncBundleAdjustment
from torchslam.optim import GRAPH_OPTIONS
from torchslam.system import state_machine
from torchslam.system.final_adjustment import FinalAdjustment
from torchslam.system.modes import Mode
from torchslam.system.state_machine import StateMachine

__all__ = ["soon_kept"]


def test_the_trajectory_of_a_run_minimizes_its_graph() -> None:
    walk = Walk(arc(40)[:20])
    run = run_walk(walk, "simulated.noise_px=0.5")
    graph = run.graph
    assert int(graph.is_keyframe.sum()) == run.map.num_keyframes
    assert len(graph.timestamps) == 20
    solution = solve_graph(graph, options=GRAPH_OPTIONS.replace(backward="detached"))
    assert torch.allclose(solution.trajectory.timestamps, run.trajectory.timestamps)
    assert torch.allclose(solution.trajectory.T_wc, run.trajectory.T_wc, atol=1e-5)


def test_the_gradient_of_the_error_reaches_camera_and_keypoints() -> None:
    walk = Walk(arc(40)[:14])
    graph = run_walk(walk, "simulated.noise_px=0.5").graph

    def error(fx: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        params = torch.cat([fx[None], graph.camera.params[1:]])
        moved = replace(graph, camera=graph.camera.with_params(params), pixels=pixels)
        solution = solve_graph(moved, options=GRAPH_OPTIONS.replace(iterations=60, tolerance=1e-14))
        return ate(T_cw=solution.T_cw, T_cw_groundtruth=true_T_cw(walk)[graph.frame_ids])

    fx = graph.camera.params[0].clone().requires_grad_()
    pixels = graph.pixels.clone().requires_grad_()
    error(fx, pixels).backward()
    assert fx.grad is not None
    assert pixels.grad is not None
    with torch.no_grad():
        h = 1e-2  # far above what a minimum is off by
        numeric = (error(fx + h, pixels) - error(fx - h, pixels)) / (2 * h)
        assert float(fx.grad) == pytest.approx(float(numeric), rel=1e-3)
        direction = pixels.grad / pixels.grad.norm()
        h = 1e-2
        numeric = (error(fx, pixels + h * direction) - error(fx, pixels - h * direction)) / (2 * h)
        assert float(pixels.grad.norm()) == pytest.approx(float(numeric), rel=1e-3)


def test_covariances_predict_the_errors_of_the_map() -> None:
    """Errors of keyframes and points, squared and normalized, average to their degrees of freedom.

    The map's scale is free; of all scales, the covariances belong to the one that least moves the keyframes.
    """
    walk = Walk(arc(60)[:40])
    exact = "camera.std=0"  # an unknown camera adds errors that all points share
    slam = SLAM(walk.camera, load_config(None, [*SIMULATED, "simulated.noise_px=0.5", "seed=1", exact]))
    slam_map = slam.run(walk).map
    truth = true_T_cw(walk)[slam_map.keyframes["frame_index"]]
    points_w, known = true_points(slam, walk)
    points_w, truth = transform(truth[0], points_w), truth @ se3_inverse(truth[0])
    T_cw = slam_map.T_cw
    scale = (T_cw[:, :3, 3] ** 2).sum() / (T_cw[:, :3, 3] * truth[:, :3, 3]).sum()
    truth[:, :3, 3] *= scale

    errors = se3_log(truth @ se3_inverse(T_cw))[1:]
    keyframes = normalized(errors, slam_map.keyframes["covariances"][1:])
    assert 0.4 < float(keyframes.mean()) / 6 < 2.0
    points = normalized(
        slam_map.positions_w[known] - scale * points_w, slam_map.points["covariances_w"][known]
    )
    assert len(points) > 200
    assert 0.5 < float(points.mean()) / 3 < 1.7


def true_points(slam: SLAM, walk: Walk) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions (n, 3) in the submap of the walk, and ids (n,) of the map's points, by their descriptors."""
    settings = slam.config.simulated
    scene = SimulatedFeatures(
        true_T_cw(walk),
        walk.camera,
        points_per_view=settings.points_per_view,
        depth_near=settings.depth_near,
        depth_far=settings.depth_far,
        seed=slam.config.seed,
    )
    ids = slam.map.valid_points()
    same = (slam.map.points["descriptors"][ids][:, None] == scene.descriptors).all(-1)
    assert same.any(1).all()
    return scene.points_w[same.int().argmax(1)], ids


def normalized(errors: torch.Tensor, covariances: torch.Tensor) -> torch.Tensor:
    return (errors * torch.linalg.solve(covariances, errors)).sum(-1)


# --- adjustments that wait -----------------------------------------------------------------------------------


def adjustment_events(monkeypatch: pytest.MonkeyPatch, walk: Walk, *overrides: str) -> list[tuple[str, int]]:
    """Record when adjustments of confirmed submaps are requested and applied."""
    events: list[tuple[str, int]] = []
    slam = SLAM(walk.camera, load_config(None, [*SIMULATED, NEARLY_EXACT, *overrides]))
    request, apply = slam.mapper.adjustment.request, slam.mapper.adjustment.apply

    def record_request(slam_map: Map, keyframe: int, due: int | None) -> None:
        events.append(("requested", int(slam_map.keyframes["frame_index"][keyframe])))
        request(slam_map, keyframe, due)

    def record_application(slam_map: Map) -> None:
        assert slam.last_frame is not None
        events.append(("applied", slam.last_frame[0]))
        apply(slam_map)

    monkeypatch.setattr(slam.mapper.adjustment, "request", record_request)
    monkeypatch.setattr(slam.mapper.adjustment, "apply", record_application)
    confirmed: list[int] = []  # frames in which the submap is confirmed

    def after(result: StepResult) -> None:
        assert not (slam.submap is None and slam.mapper.adjustment.is_pending)  # nothing is left behind
        if slam.submap is not None and slam.mode not in (Mode.PROVISIONAL, Mode.PROVISIONAL_DOUBTED):
            confirmed.append(result.index)

    monkeypatch.setattr(FinalAdjustment, "adjust", lambda *_, **__: None)
    slam.run(walk, after)
    assert not slam.mapper.adjustment.is_pending
    return [event for event in events if event[1] in confirmed[1:]]


@pytest.mark.parametrize(
    ("delay", "translation", "few"),
    [pytest.param(1, 0.1, 0, marks=pytest.mark.slow), (2, 0.6, 0), (2, 0.6, 1000)],
)
def test_an_adjustment_is_applied_after_some_frames_or_before_the_next_keyframe(
    delay: int, translation: float, few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With few points in view, before the next frame."""
    walk = Walk(arc(80, 6.0)[:40])
    monkeypatch.setattr(state_machine, "MIN_POINTS", few)
    monkeypatch.setattr(mapper, "DELAY_FRAMES", delay)
    events = adjustment_events(monkeypatch, walk, f"keyframes.max_translation={translation}")
    kinds = [what for what, _ in events]
    pairs = len(kinds) // 2
    assert kinds[: 2 * pairs] == ["requested", "applied"] * pairs  # one after the other
    waits = [
        applied - requested for (_, requested), (_, applied) in zip(events[::2], events[1::2], strict=False)
    ]
    assert len(waits) >= 3
    assert set(waits) <= set(range(1, delay + 1))
    assert set(waits) == {1} if few else delay in waits


@pytest.mark.slow
def test_in_a_small_map_adjustment_is_applied_before_the_next_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    walk, runs, begun = Walk(arc(80, 6.0)[:40]), [], []
    start = AsyncBundleAdjustment.start

    def record_start(self: AsyncBundleAdjustment) -> None:
        if self._pending is None or self._pending.window is None:
            begun.append(self.due)
        start(self)

    monkeypatch.setattr(AsyncBundleAdjustment, "start", record_start)
    for module in (local_bundle, state_machine):
        monkeypatch.setattr(module, "LOCAL_WINDOW", 1000)
    for is_at_once in (True, False):
        begun.clear()
        with monkeypatch.context() as patched:
            if is_at_once:
                patched.setattr(StateMachine, "_apply_at", lambda *_: ApplyAt.NOW)
            runs.append(run_walk(walk))
        assert len(begun) > 6
        assert set(begun) == {None}  # no frame is tracked before
    at_once, between = runs
    assert torch.equal(at_once.trajectory.T_wc, between.trajectory.T_wc)
    assert torch.equal(at_once.map.positions_w, between.map.positions_w)
    events = adjustment_events(monkeypatch, walk)
    assert [what for what, _ in events[:6]] == ["requested", "applied"] * 3
    assert all(
        applied == requested + 1
        for (_, requested), (_, applied) in zip(events[:6:2], events[1:6:2], strict=True)
    )


@pytest.mark.usefixtures("soon_kept")
def test_a_lost_camera_leaves_no_pending_adjustment(monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Walk(walk_with_jump()[:20])
    monkeypatch.setattr(mapper, "DELAY_FRAMES", 1000)
    events = adjustment_events(monkeypatch, walk, "keyframes.min_overlap=0")
    assert [what for what, _ in events if what == "applied"]
