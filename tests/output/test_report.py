from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from torchslam.config import Config
from torchslam.evaluation import evaluate
from torchslam.geometry import Camera
from torchslam.output.report import metrics, summary, table
from torchslam.run import Run, keyframe_trajectory
from torchslam.values import State, StepResult, Trajectory
from torchslam.world.history import History
from torchslam.world.map import Map


@pytest.fixture
def run(trajectory: Trajectory, slam_map: Map, camera: Camera, results: list[StepResult]) -> Run:
    posed = torch.tensor([result.T_cw is not None for result in results])
    return Run(
        trajectory=Trajectory(trajectory.timestamps[posed], trajectory.T_wc[posed]),
        keyframes=keyframe_trajectory(slam_map),
        map=slam_map,
        history=History(),
        camera=camera,
        config=Config(),
        results=results,
        skipped=["image 31 is not an image"],
        interrupted=False,
        failure="",
    )


def test_counts(run: Run) -> None:
    figures = metrics(run)
    assert figures["frames"] == 31
    assert figures["posed"] == 23
    assert figures["lost"] == 4
    assert figures["initialised_at"] == 3
    assert figures["posed_share_after_initialisation"] == pytest.approx(23 / 27)
    assert figures["keyframes"] == 6
    assert figures["points"] == 119
    assert figures["skipped"] == ["image 31 is not an image"]


def test_times(run: Run) -> None:
    figures = metrics(run)
    totals = torch.tensor([result.stage_ms["total"] for result in run.results], dtype=torch.float64)
    assert figures["ms_median"] == pytest.approx(float(totals.quantile(0.5)))
    assert figures["ms_p95"] == pytest.approx(float(totals.quantile(0.95)))
    assert figures["fps"] == pytest.approx(1e3 / float(totals.mean()))
    assert figures["stage_ms"]["mapping"] == {"median": 12.0, "mean": 12.0, "frames": 4}
    assert figures["stage_ms"]["tracking"]["frames"] == 30


def test_a_map_that_was_given_up_does_not_count_as_the_start(run: Run) -> None:
    given_up = [replace(run.results[0], state=State.TRACKING), *run.results[1:]]
    assert metrics(replace(run, results=given_up))["initialised_at"] == 3


def test_ground_truth_adds_errors(run: Run, trajectory: Trajectory) -> None:
    doubled = trajectory.T_wc.clone()
    doubled[:, :3, 3] *= 2
    figures = metrics(run, evaluate(run.trajectory, Trajectory(trajectory.timestamps, doubled)))
    assert figures["ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert figures["scale"] == pytest.approx(2.0)
    assert figures["ate_se3_m"] > 0.1
    assert figures["path_length_m"] > 0
    assert {"translation_m", "rotation_deg"} <= figures["rpe"].keys()
    assert json.loads(json.dumps(figures)) == figures
    words = table(summary(figures))
    for part in (
        "31, 1 of them unreadable",
        "23 (74.2%)",
        "85.2% since the start at frame 3",
        "2.0000 true metres",
    ):
        assert part in words


def test_a_run_without_a_map(run: Run) -> None:
    nothing = Trajectory(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))
    failed = replace(
        run,
        trajectory=nothing,
        keyframes=nothing,
        map=Map(),
        results=run.results[:3],
        failure="no map was initialised in 3 frames: the camera does not move",
    )
    figures = metrics(failed)
    assert figures["initialised_at"] is None
    assert figures["posed"] == figures["points"] == figures["keyframes"] == 0
    assert figures["failure"].endswith("the camera does not move")
    assert summary(figures) == {"frames": "4, 1 of them unreadable and skipped", "map": "none"}


def test_no_frames_at_all(run: Run) -> None:
    figures = metrics(replace(run, results=[], skipped=[], failure="the sequence has no frames"))
    assert figures["fps"] == figures["ms_median"] == 0.0
    assert figures["stage_ms"] == {}
