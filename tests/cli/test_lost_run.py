"""Where tracking is lost, `torchslam run` maps the recording as a whole at once, and goes on online only if it must."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.walks import Walk, arc
from torchslam import SLAM, Frame, State, StepResult, load_config
from torchslam.cli import arguments
from torchslam.cli.main import main
from torchslam.data import read_trajectory
from torchslam.global_mapping import recording
from torchslam.global_mapping.check import MapCheck
from torchslam.system import online_run
from torchslam.system.online_run import Observer, OnlineRun, finish

SETTINGS = ["features.kind=simulated", "features.num_keypoints=250", "simulated.points_per_view=150"]
SETTINGS += ["simulated.noise_px=0.05", "camera.readout_std=0"]
FRAMES, LOST = 16, 10
WALK = Walk(arc(45)[:FRAMES])

Run = Callable[..., dict[str, Any]]


@pytest.fixture(autouse=True)
def steps(without_pictures: None, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The frames that were processed online; one is said to be lost."""
    processed, step = list[int](), SLAM.step

    def recorded(slam: SLAM, frame: Frame) -> StepResult:
        processed.append(frame.index)
        result = step(slam, frame)
        return replace(result, state=State.LOST) if frame.index == LOST else result

    monkeypatch.setattr(SLAM, "step", recorded)
    return processed


@pytest.fixture
def run(steps: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs the command; returns its metrics."""
    monkeypatch.setattr(arguments, "sequence", lambda options: WALK)

    def execute(folder: str, *more: str) -> dict[str, Any]:
        steps.clear()
        settings = [part for setting in SETTINGS for part in ("--set", setting)]
        status = main(["run", "walk", "--output", str(tmp_path / folder), *settings, *more])
        assert status == 0
        metrics: dict[str, Any] = json.loads((tmp_path / folder / "metrics.json").read_text())
        return metrics

    return execute


def test_frames_until_one_is_lost_and_the_others_later_are_the_whole_run() -> None:
    config = load_config(None, SETTINGS)
    whole = OnlineRun(SLAM(WALK.camera, config), WALK).run()
    seen: list[int] = []
    run = OnlineRun(
        SLAM(WALK.camera, config), WALK, observer=Observer(lambda result: seen.append(result.index))
    )
    for _ in range(2):  # the second time it was lost before
        run.run(until_lost=True)
        assert not run.is_finished
        assert seen == list(range(LOST + 1))
        assert run.so_far.next == LOST + 1
    parts = run.run()
    assert run.is_finished
    assert len(parts.results) == FRAMES
    assert torch.equal(parts.trajectory.T_wc, whole.trajectory.T_wc)


def test_a_right_map_of_the_whole_needs_no_other_frames_online(run: Run, steps: list[int]) -> None:
    found = run("auto")
    assert (found["mapping"], found["mapping_reason"]) == ("global", f"tracking was lost at frame {LOST}")
    assert steps == list(range(LOST + 1))
    assert found["posed"] == FRAMES
    # The times are those of the frames that were processed online.
    assert found["stage_ms"]["total"]["frames"] == LOST + 1
    assert 0 < found["ms_median"] <= found["ms_p95"]
    assert found["fps"] == pytest.approx(1e3 / found["stage_ms"]["total"]["mean"])
    assert 0 < found["online_posed"] <= LOST
    assert found["ms_longest"] > 0


@pytest.mark.parametrize(
    "options",
    [
        ("--mapping", "online"),
        pytest.param(("--video",), marks=pytest.mark.slow),  # which shows every frame
        ("--set", f"global_mapping.window_images={FRAMES - 1}"),  # which are chosen by what is lost
    ],
)
def test_all_frames_are_processed_online_where_they_count(
    run: Run, steps: list[int], options: tuple[str, ...]
) -> None:
    run("every", *options)
    assert steps == list(range(FRAMES))


def test_where_the_map_of_the_whole_is_not_right_the_run_goes_on(
    run: Run, steps: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MapCheck, "is_right", False)
    found = run("auto")
    assert steps == list(range(FRAMES))
    assert found["mapping_reason"] == "tracking was lost in 1 frames"


def test_ctrl_c_after_the_run_went_on_does_not_end_it_twice(
    run: Run, steps: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = []

    def counted(*given: Any) -> Any:
        ends.append(len(steps))
        return finish(*given)

    def stop(*given: Any) -> None:
        given[8]()  # go_on
        raise KeyboardInterrupt

    monkeypatch.setattr(online_run, "finish", counted)
    monkeypatch.setattr(recording, "map_recording", stop)
    assert run("auto")["interrupted"]
    assert steps == list(range(FRAMES))
    assert ends == [FRAMES]


def test_ctrl_c_keeps_the_frames_so_far(
    run: Run, steps: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*given: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recording, "map_recording", stop)
    found = run("auto")
    assert steps == list(range(LOST + 1))
    assert found["interrupted"]
    assert len(read_trajectory(tmp_path / "auto" / "trajectory.txt")) == LOST + 1
