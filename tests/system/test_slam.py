"""The whole system: simulated features for the geometry, a rendered room for the images."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc, still, turn, walk_with_jump
from torchslam import (
    SLAM,
    Camera,
    Frame,
    Run,
    State,
    StepResult,
    evaluate,
    load_config,
    open_sequence,
)
from torchslam.errors import ConfigError, FrameError
from torchslam.evaluation import ate_apart
from torchslam.map.atlas import Submap
from torchslam.mapping import mapper
from torchslam.mapping.mapper import MapInitializer
from torchslam.system import map_start, state_machine
from torchslam.system.front_end import Simulated
from torchslam.tracking.localizer import LOCAL_KEYFRAMES
from torchslam.types import FrameFeatures, Reason, TwoViewMap

SIMULATED = ["features.kind=simulated", "features.num_keypoints=400", "simulated.points_per_view=250"]
SIMULATED += ["camera.readout_std=0"]  # a walk has none


def run_walk(walk: Walk, *overrides: str, progress: Callable[[StepResult], None] | None = None) -> Run:
    return SLAM(walk.camera, load_config(None, [*SIMULATED, *overrides])).run(walk, progress)


def test_exact_features_give_the_exact_trajectory() -> None:
    walk = Walk(arc(60)[:22])
    run = run_walk(walk)
    assert len(run.trajectory) == 22  # frames before the start are posed once there is a map
    result = evaluate(run.trajectory, walk.groundtruth)
    assert result.ate_m < 1e-4 * result.path_length_m
    assert all(r.state is State.TRACKING for r in run.results[-15:])


@pytest.mark.parametrize("scales", [pytest.param("false", marks=pytest.mark.slow), "true"])
def test_noise_and_outliers_are_tolerated(scales: str) -> None:
    walk = Walk(arc(60)[:20])
    noisy = ("simulated.noise_px=0.5", "simulated.outlier_ratio=0.1")
    run = run_walk(walk, *noisy, f"simulated.with_scales={scales}")
    assert len(run.trajectory) == 20
    result = evaluate(run.trajectory, walk.groundtruth)
    assert result.ate_m < 0.01 * result.path_length_m


def test_the_scale_can_be_that_of_ground_truth() -> None:
    walk = Walk(arc(40)[:16])
    run = run_walk(walk, "scale=groundtruth")
    assert evaluate(run.trajectory, walk.groundtruth).scale == pytest.approx(1.0, rel=1e-3)


def test_unit_scale_sets_the_initial_median_depth_to_one() -> None:
    walk = Walk(arc(12))
    run = run_walk(walk, "paper.unrefined=true", "paper.last_keyframe=true")
    initial = run.map.points["first_keyframe"] == 1
    assert float(run.map.positions_w[initial, 2].median()) == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize(
    ("poses", "message"), [(still(20), "stands still"), (turn(20), "turns|parallax|planar")]
)
def test_without_parallax_there_is_no_map_and_a_reason(poses: torch.Tensor, message: str) -> None:
    run = run_walk(Walk(poses), "simulated.noise_px=0.3", "simulated.depth_near=2", "simulated.depth_far=6")
    assert run.map.num_keyframes == 0
    assert len(run.trajectory) == 0
    assert "no map was initialized in 20 frames" in run.failure
    assert re.search(message, run.failure)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    walk = Walk(arc(40)[:12])
    noisy = ("simulated.noise_px=0.5", "simulated.outlier_ratio=0.1")
    one, two, other = run_walk(walk, *noisy), run_walk(walk, *noisy), run_walk(walk, *noisy, "seed=1")
    assert torch.equal(one.trajectory.T_wc, two.trajectory.T_wc)
    assert torch.equal(one.map.positions_w, two.map.positions_w)
    assert not torch.equal(one.trajectory.T_wc, other.trajectory.T_wc)


@pytest.fixture
def soon_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new map is soon no longer taken back."""
    monkeypatch.setattr(map_start, "PROVISIONAL_FRAMES", 8)


GAP = range(35, 40)
NEARLY_EXACT = "simulated.noise_px=0.05"
"""Adjustments of exact data go on to the last digit, which takes twice as long."""


class Gap(Walk):
    """Some frames show nothing that was seen before or after: their poses are far away."""

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        if index in GAP:
            away = torch.eye(4, dtype=torch.float64)
            away[2, 3] = -1e6
            return Frame(index, frame.timestamp, frame.image, frame.name, away)
        return frame


def test_loss_is_reported_and_tracking_recovers() -> None:
    walk = Gap(arc(60)[:46])
    run = run_walk(walk, NEARLY_EXACT)
    states = [r.state for r in run.results]
    lost, found = GAP.start, GAP.stop
    assert states[lost:found] == [State.LOST] * 5
    assert all(r.T_cw is None for r in run.results[lost:found])
    confirmed = found + state_machine.NUM_RELOCALIZED_FRAMES
    assert states[found:confirmed] == [State.UNCERTAIN] * (confirmed - found)
    assert run.results[found].reason == Reason.RELOCALIZED
    assert not any(r.is_keyframe for r in run.results[lost : confirmed + 1])
    assert states[confirmed:] == [State.TRACKING] * (46 - confirmed)
    assert len(run.submaps) == 1
    assert {r.submap for r in run.results if r.T_cw is not None} == {0}
    assert len(run.trajectory) == 41
    assert evaluate(run.trajectory, walk.groundtruth).ate_m < 1e-3


def test_frames_pending_at_the_end_have_uncertain_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Gap(arc(60)[:42])
    with monkeypatch.context() as patch:
        patch.setattr(SLAM, "finalize", SLAM.confirm_map)
        without = run_walk(walk, NEARLY_EXACT)
    slam = SLAM(walk.camera, load_config(None, [*SIMULATED, NEARLY_EXACT]))
    run = slam.run(walk)
    assert [r.state for r in run.results[-2:]] == [State.UNCERTAIN] * 2
    assert run.posed_frames.frames["frame_index"][-2:].tolist() == [40, 41]
    assert len(run.trajectory) == 37
    assert evaluate(run.trajectory, walk.groundtruth).ate_m < 1e-3
    assert torch.equal(run.map.positions_w, without.map.positions_w)  # nothing was built on them
    assert torch.equal(run.trajectory.T_wc[:35], without.trajectory.T_wc)
    whole = Simulated(slam.config, slam.camera, true_T_cw(walk)).of(Gap(arc(60)))
    states = [slam.step(whole[index]).state for index in range(42, 46)]
    assert states[0] is State.UNCERTAIN  # the next frames still have to confirm it
    assert states[-1] is State.TRACKING
    frames = slam.posed_frames.frames["frame_index"]
    assert len(torch.unique(frames)) == len(frames) == 41


class FrameSnapshot(Walk):
    """From frame 15 on the camera is where nothing was ever seen, but for one frame that shows frame 12 again."""

    def __getitem__(self, index: int) -> Frame:
        frame = super().__getitem__(index)
        away = torch.eye(4, dtype=torch.float64)
        away[2, 3] = -1e6
        if index == 18:
            return replace(frame, T_cw_groundtruth=super().__getitem__(12).T_cw_groundtruth)
        return frame if index < 15 else replace(frame, T_cw_groundtruth=away)


@pytest.mark.usefixtures("soon_kept")
def test_an_unconfirmed_relocalization_leaves_no_trace() -> None:
    run = run_walk(FrameSnapshot(arc(34)[:24]), NEARLY_EXACT)
    states = [r.state for r in run.results]
    assert states[15:] == [State.LOST] * 3 + [State.UNCERTAIN] + [State.LOST] * 5
    assert run.results[18].reason == Reason.RELOCALIZED
    assert len(run.trajectory) == 15
    assert int(run.map.keyframes["frame_index"].max()) < 15
    assert int(run.posed_frames.frames["frame_index"].max()) < 15


@pytest.mark.parametrize(("least", "believed"), [(0.4, True), (0.6, False)])
def test_an_initialization_must_explain_the_frames_since_its_reference(
    least: float, believed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reference frame is explained, the one that starts the map is not."""
    monkeypatch.setattr(mapper, "MIN_EXPLAINED_RATIO", least)
    explains = MapInitializer._explains
    monkeypatch.setattr(
        MapInitializer,
        "_explains",
        lambda founder, submap, view: explains(founder, submap, view) and view.index == 0,
    )
    walk = Walk(arc(40)[[0, 3]])
    run = run_walk(walk, "simulated.depth_near=7", "simulated.depth_far=25")
    assert (len(run.submaps) == 1) is believed
    assert believed or run.results[-1].reason == "bad start: it explains 1 of 2 frames"


@pytest.mark.parametrize("explained", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_contradicting_initialization_replaces_a_provisional_map(
    explained: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No support is enough here: whatever start the first and the last frame make is a rival."""
    few = ("initialization.min_matches=30", *(() if explained else (NEARLY_EXACT,)))
    walk, config = Walk(arc(120)[:26]), load_config(None, [*SIMULATED, *few])
    seen = Simulated(config, walk.camera, true_T_cw(walk)).of(walk).part(0, 26 if explained else 12)
    plain = None if explained else SLAM(walk.camera, config).run(seen)
    monkeypatch.setattr("torchslam.tracking.initialization.MIN_SUPPORT_RATIO", 2.0)
    found, founded = MapInitializer.build, []

    def counted(
        founder: MapInitializer, submap: Submap, start: TwoViewMap, views: list[FrameFeatures]
    ) -> str:
        founded.append(views)
        return found(founder, submap, start, views) if explained or len(founded) == 1 else "it does not"

    monkeypatch.setattr(MapInitializer, "build", counted)
    slam = SLAM(walk.camera, config)
    run = slam.run(seen)
    anew = [r for r in run.results if r.reason == Reason.STARTED_ANEW]
    assert len(founded) > 1
    assert [view.index for view in founded[1]] == list(range(founded[1][-1].index + 1))
    assert len(run.trajectory) == len(seen)
    assert len(run.submaps) == 1
    assert run.submaps[0].number == len(anew)
    if explained:
        assert len(anew) == len(founded) - 1
        assert all(r.is_keyframe and r.state is State.TRACKING for r in anew)
        assert len(slam.loop_closer.keyframe_database) == run.map.num_keyframes
        assert evaluate(run.trajectory, walk.groundtruth).ate_m < 1e-4
    else:
        assert not anew
        assert plain is not None
        assert torch.equal(run.trajectory.T_wc, plain.trajectory.T_wc)


def test_frames_before_initialization_have_poses_in_the_end() -> None:
    """A camera that stands at first: there is nothing to start with before it moves."""
    walk = Walk(torch.cat([still(6), arc(60)[1:14]]))
    run = run_walk(walk, "simulated.depth_near=0.6", "simulated.depth_far=2", "simulated.noise_px=0.2")
    begun = next(r.index for r in run.results if r.state is State.TRACKING)
    assert begun >= 6
    assert all(r.T_cw is None for r in run.results[:begun])
    assert len(run.trajectory) == len(walk)
    assert evaluate(run.trajectory, walk.groundtruth).ate_m < 0.01


JOINED = ("simulated.depth_near=0.3", "simulated.depth_far=0.8", "simulated.noise_px=0.5",
          "simulated.with_scales=true")  # fmt: skip


@pytest.fixture
def submaps_soon(soon_kept: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lost camera soon starts another submap, which is soon kept."""
    monkeypatch.setattr(state_machine, "FRAMES_BEFORE_NEW_SUBMAP", 3)


@pytest.mark.usefixtures("submaps_soon")
def test_two_submaps_merge_when_the_second_reaches_the_first() -> None:
    walk = Walk(walk_with_jump())
    run = run_walk(walk, *JOINED)
    submaps = [r.submap for r in run.results if r.T_cw is not None]
    assert set(submaps) == {0, 1}
    assert submaps[0] == submaps[-1] == 0
    assert len(run.submaps) == 1
    assert sum(len(part) for part in run.online_parts) == len(submaps) > len(run.online)
    assert ate_apart(run.online_parts, walk.groundtruth) < 0.015  # keyframes are adjusted two frames later
    assert len(run.trajectory) == len(walk)
    assert evaluate(run.trajectory, walk.groundtruth).ate_m < 0.01


@pytest.mark.usefixtures("submaps_soon")
def test_separate_submaps_are_kept() -> None:
    walk = Walk(walk_with_jump()[4:33])
    run = run_walk(walk, *JOINED)
    assert [len(submap.posed_frames) for submap in run.submaps] == [12, 17]
    assert [submap.number for submap in run.submaps] == [0, 1]
    assert len(run.trajectory) == 17  # of the submap with most frames


class Damaged(Walk):
    def image(self, index: int) -> torch.Tensor:
        if index in (3, 17):
            raise FrameError(f"rgb.txt:{index}: is not an image")
        return super().image(index)


def test_damaged_frames_are_skipped_with_a_warning_and_counted() -> None:
    walk = Damaged(arc(60)[:19])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run = run_walk(walk, "paper.unrefined=true")
    assert [str(w.message) for w in caught if "skipped a frame" in str(w.message)] != []
    assert run.skipped == ["rgb.txt:3: is not an image", "rgb.txt:17: is not an image"]
    assert len(run.trajectory) == 17


def test_an_interrupt_keeps_the_results_so_far() -> None:
    def interrupt(result: StepResult) -> None:
        if result.index == 12:
            raise KeyboardInterrupt

    run = run_walk(Walk(arc(60)[:16]), NEARLY_EXACT, progress=interrupt)
    assert run.interrupted
    assert len(run.results) == 13
    assert len(run.trajectory) == 13


def test_simulated_features_need_true_poses() -> None:
    walk = Walk(arc(5))
    slam = SLAM(walk.camera, load_config(None, SIMULATED))
    with pytest.raises(ConfigError, match="true poses"):
        slam.step(walk[0])


def test_poses_are_rigid_and_results_have_stage_times() -> None:
    run = run_walk(Walk(arc(40)[:16]), "simulated.noise_px=0.5")
    R = run.trajectory.T_wc[:, :3, :3]
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), atol=1e-9)
    assert torch.allclose(torch.linalg.det(R), torch.ones(len(R), dtype=R.dtype))
    keyframe = next(r for r in run.results if r.is_keyframe and "bundle" in r.stage_ms)
    assert {"features", "tracking", "mapping", "bundle", "rest", "total"} <= keyframe.stage_ms.keys()
    assert keyframe.reason


def test_every_frame_uses_a_bounded_part_of_the_map() -> None:
    walk = Walk(arc(50, length=25.0))
    slam = SLAM(
        walk.camera,
        load_config(
            None, [*SIMULATED, NEARLY_EXACT, "simulated.depth_near=0.032", "simulated.depth_far=0.16"]
        ),
    )
    slam.run(walk)
    assert slam.map.num_keyframes > 10
    assert slam.submap is not None
    tracking = slam.submap.tracking
    assert len(tracking.local_keyframes) <= LOCAL_KEYFRAMES + 1
    assert len(tracking.local_points) < 0.5 * slam.map.num_points


def test_a_rendered_room_is_tracked() -> None:
    sequence = open_sequence("synthetic:room").part(0, 20)
    run = SLAM(sequence.camera).run(sequence)
    assert len(run.trajectory) >= 19
    result = evaluate(run.trajectory, sequence.groundtruth)
    assert result.ate_m < 0.02 * result.path_length_m


def test_the_system_keeps_its_camera_when_parameters_move_in_place() -> None:
    params = torch.tensor([400.0, 400.0, 319.5, 239.5], dtype=torch.float64).requires_grad_()
    slam = SLAM(Camera("pinhole", params, (640, 480)))
    with torch.no_grad():
        params.mul_(2)
    assert float(slam.camera.fx) == 400
    assert not slam.camera.params.requires_grad
