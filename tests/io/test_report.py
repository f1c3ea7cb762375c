from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from torchslam.evaluation import evaluate
from torchslam.geometry import transform
from torchslam.geometry.rolling_shutter import Readout
from torchslam.global_mapping.check import Break, BreakKind, MapCheck
from torchslam.global_mapping.recording import MappedRun, Mapping
from torchslam.io.report import (
    check_metrics,
    quality,
    readout_metrics,
    result_warnings,
    run_metrics,
    shake_remark,
    summary,
)
from torchslam.map.atlas import Submap
from torchslam.optim.model_choice import Gain
from torchslam.optim.rolling_shutter import RollingShutter
from torchslam.system.run import Run
from torchslam.types import PoseEstimate, State, Trajectory
from torchslam.utils.console import table


def test_counts(run: Run) -> None:
    figures = run_metrics(run)
    assert figures["frames"] == 31
    assert figures["posed"] == 23
    assert figures["lost"] == 4
    assert figures["initialized_at"] == 3
    assert figures["posed_ratio_after_initialization"] == pytest.approx(23 / 27)
    assert figures["keyframes"] == 6
    assert figures["points"] == 119
    assert figures["skipped"] == ["image 31 is not an image"]
    assert (figures["session"], figures["submap"]) == (0, 0)
    counts = {"submap": 0, "keyframes": 6, "points": 119, "posed": 23, "uncertain": 0, "lost": 4}
    assert figures["submaps"] == [counts]


def test_quality(run: Run) -> None:
    graph = run.posed_frames.graph(run.map, run.sensor)
    points_c = transform(graph.T_cw[graph.frame_index], graph.points_w[graph.point_index][:, None])[:, 0]
    pixels, valid = run.camera.project(points_c)
    assert valid.any()
    errors = (pixels - graph.pixels).norm(dim=-1).where(valid, torch.inf)
    expected, far = float(errors.median()), float((errors > 4.0).double().mean())
    seen = torch.bincount(graph.point_index)
    found = quality(run)
    assert found["reprojection_px"] == pytest.approx(expected)
    assert found["far_ratio"] == pytest.approx(far)
    assert far > 0
    assert found["track_length"] == pytest.approx(float(seen[seen > 0].double().mean()))
    figures = run_metrics(run)
    assert figures["uncertain"] == 0
    assert summary(figures)["quality"].startswith(f"{expected:.2f} px")
    assert "quality" not in summary(figures | {"reprojection_px": None})
    assert quality(replace(run, submaps=())) == quality(replace(run, session=7))
    assert set(quality(replace(run, session=7)).values()) == {None}


@pytest.mark.parametrize(
    ("keyframes", "posed", "said"), [(12, 23, True), (11, 23, False), (9, 9, False), (5, 10, True)]
)
def test_half_of_the_frames_being_keyframes_is_reported(
    run: Run, keyframes: int, posed: int, said: bool
) -> None:
    found = result_warnings(run_metrics(run) | {"keyframes": keyframes, "posed": posed})
    assert [text.partition(":")[0] for text in found] == [
        f"{keyframes} of {posed} posed frames are keyframes"
    ] * said


def test_every_image_of_a_global_map_may_be_a_keyframe(run: Run) -> None:
    figures = run_metrics(run) | {"keyframes": 23, "posed": 23}
    assert len(result_warnings(figures)) == 1
    assert result_warnings(figures | {"mapping": "global"}) == []


def test_the_check_is_reported_in_numbers_and_in_a_sentence(run: Run) -> None:
    check = MapCheck(
        9, 4, 3, 10, 9, 0.8, 0.5, torch.zeros(4), (Break(3, 4, BreakKind.SCALE, 1.2),), (0, 1, 2), (4, 5)
    )
    mapped = MappedRun.of(run, Mapping.GLOBAL, check, "tracking was lost in 3 frames", run)
    found = check_metrics(mapped)
    assert found["mapping"] == "global"
    assert found["mapping_reason"] == "tracking was lost in 3 frames"
    counts = {"pairs": 4, "agreeing": 3, "triplets": 10, "consistent": 9}
    assert counts.items() <= found["check"].items()
    assert found["check"]["score"] == pytest.approx(0.8 * 0.9 * 3 / 9)
    assert found["check"]["breaks"] == ["between frames 3 and 4 the scale differs by 20%"]
    row = summary(run_metrics(run) | found)["check"]
    assert row.startswith("global mapping: 75% of 4 held-out image pairs agree, and 90% of 10")
    assert check_metrics(run) == check_metrics(MappedRun.of(run)) == {}
    assert check_metrics(MappedRun.of(run, Mapping.ONLINE))["check"] is None


def test_a_readout_is_a_row_of_the_summary(run: Run) -> None:
    known = replace(run, sensor=replace(run.sensor, readout=Readout.known(0.0, 0.1).updated(0.028, 0.001)))
    found = {"readout": readout_metrics(known)}
    assert summary(run_metrics(run) | found)["readout"].startswith(
        "28.0 ± 1.0 ms from the first row to the last (estimated)"
    )
    assert "readout" not in summary(run_metrics(run) | {"readout": readout_metrics(run)})


def test_a_shaking_camera_is_a_warning(run: Run) -> None:
    still = RollingShutter(0.0, 0.01, 0.03, 0.0, Gain(0.0, 1.0, 10), 0.03, 0.02)
    assert shake_remark(replace(run, shutter=still)) == ""
    said = shake_remark(replace(run, shutter=replace(still, by_row=0.31)))
    assert "the row explains 31% of the squared errors, the column 2%" in said
    figures = run_metrics(run) | {"rolling_shutter": "rows are exposed one after the other"}
    assert result_warnings(figures) == ["rows are exposed one after the other"]
    assert len(result_warnings(figures | {"keyframes": 12, "posed": 23})) == 2
    assert result_warnings(figures | {"rolling_shutter": ""}) == []


def test_counts_of_several_submaps_and_sessions(run: Run, submap: Submap) -> None:
    """Frames 10 to 14 uncertain in submap 0; from frame 22 in submap 3, which has as many frames of another session."""
    other = Submap(3, submap.tracking)
    other.map.add_keyframe(replace(submap.map.frame_features(0), session=2), submap.map.T_cw[0])
    for index in range(30):
        view = replace(submap.map.frame_features(0), index=index, session=int(index < 22))
        estimate = PoseEstimate(
            submap.map.T_cw[0], *[torch.zeros(0, dtype=torch.int64)] * 2, 0, torch.eye(6), 1.0
        )
        other.posed_frames.add(view, estimate, torch.eye(4, dtype=torch.float64), 0)
    results = [
        replace(
            result,
            state=State.UNCERTAIN if 10 <= result.index < 15 else result.state,
            submap=3 if result.index >= 22 else result.submap,
        )
        for result in run.results
    ]
    figures = run_metrics(replace(run, submaps=(submap, other), results=results))
    assert figures["submap"] == 0  # most frames of this session, not of all
    assert [counts["posed"] for counts in figures["submaps"]] == [23, 8]
    assert [counts["uncertain"] for counts in figures["submaps"]] == [5, 0]
    assert [counts["lost"] for counts in figures["submaps"]] == [4, 0]
    words = summary(figures)
    assert words["submap"] == "0, the main one of 2; submap 3: 8 frames posed, 1 keyframes"
    assert words["lost"] == "4 frames; 5 had an uncertain pose"
    again = run_metrics(replace(run, submaps=(submap, other), results=results, session=1))
    assert again["submap"] == 3
    assert summary(again)["session"] == "1, which made 0 of the keyframes"


def test_times(run: Run) -> None:
    figures = run_metrics(run)
    totals = torch.tensor([result.stage_ms["total"] for result in run.results], dtype=torch.float64)
    assert figures["ms_median"] == pytest.approx(float(totals.quantile(0.5)))
    assert figures["ms_p95"] == pytest.approx(float(totals.quantile(0.95)))
    assert figures["fps"] == pytest.approx(1e3 / float(totals.mean()))
    assert figures["stage_ms"]["mapping"] == {"median": 12.0, "mean": 12.0, "frames": 4}
    assert figures["stage_ms"]["tracking"]["frames"] == 30


def test_a_discarded_map_is_not_the_initialization(run: Run) -> None:
    given_up = [replace(run.results[0], state=State.TRACKING), *run.results[1:]]
    assert run_metrics(replace(run, results=given_up))["initialized_at"] == 3


def test_ground_truth_adds_errors(run: Run, trajectory: Trajectory) -> None:
    doubled = trajectory.T_wc.clone()
    doubled[:, :3, 3] *= 2
    figures = run_metrics(run, evaluate(run.trajectory, Trajectory(trajectory.timestamps, doubled)))
    assert figures["ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert figures["scale"] == pytest.approx(2.0)
    assert figures["ate_se3_m"] > 0.1
    assert figures["path_length_m"] > 0
    assert "online_ate_m" not in figures
    truth = Trajectory(trajectory.timestamps, doubled)
    both = run_metrics(run, evaluate(run.trajectory, truth), 1e-12)
    assert both == figures | {"online_ate_m": pytest.approx(0.0, abs=1e-9)}
    assert "online ATE" in summary(both)
    assert {"translation_m", "rotation_deg"} <= figures["rpe"].keys()
    assert json.loads(json.dumps(figures)) == figures
    words = table(summary(figures))
    for part in ("31, 1 of", "23 (74.2%)", "85.2% since initialization at frame 3", "2.0000 true meters"):
        assert part in words


def test_times_and_online_poses_are_of_the_run_frame_by_frame(run: Run) -> None:
    times = [{"total": 100.0 if result.index == 2 else float(result.index)} for result in run.results]
    timed = [replace(result, stage_ms=each) for result, each in zip(run.results, times, strict=True)]
    online = replace(run, results=timed[:20])
    whole = replace(run, results=[replace(result, stage_ms={}) for result in run.results])
    figures = run_metrics(MappedRun.of(whole, Mapping.GLOBAL, by_frame=online))
    assert figures["ms_longest"] == 19.0  # not of frame 2, which came before the map
    assert figures["ms_median"] == 10.5
    assert figures["online_posed"] == len(online.online) < run_metrics(run)["online_posed"]
    assert figures["frames"] == 31


def test_a_run_without_a_map(run: Run) -> None:
    failed = replace(run, submaps=(), results=run.results[:3], failure="the camera does not move")
    figures = run_metrics(failed)
    assert figures["initialized_at"] is None
    assert figures["posed"] == figures["points"] == figures["keyframes"] == 0
    assert figures["failure"] == "the camera does not move"
    assert summary(figures) == {"frames": "4, 1 of them unreadable and skipped", "map": "none"}
    figures = run_metrics(replace(run, results=[], skipped=[], failure="the sequence has no frames"))
    assert figures["fps"] == figures["ms_median"] == 0.0
    assert figures["stage_ms"] == {}


def test_the_summary_leaves_out_what_did_not_happen(run: Run) -> None:
    """No speed where no frame was processed by itself; and what nothing checked is named."""
    whole = replace(run, results=[replace(result, stage_ms={}) for result in run.results])
    assert "speed" not in summary(run_metrics(whole))
    timed = [replace(result, stage_ms={"total": 100.0}) for result in run.results]
    assert summary(run_metrics(replace(run, results=timed)))["speed"].startswith(
        "10.0 frames/s; 100 ms a frame"
    )
    check = MapCheck(9, 0, 0, 0, 0, 0.0, 0.0, torch.zeros(0), (), (), ())
    for mapped in (run, MappedRun.of(run, Mapping.ONLINE), MappedRun.of(run, Mapping.GLOBAL, check)):
        row = summary(run_metrics(mapped) | check_metrics(mapped))["check"]
        assert row.startswith("none: no image pairs tested this map")
