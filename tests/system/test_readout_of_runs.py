"""Runs on a rolling shutter: the readout is found, or given, and the poses, the report and the export follow it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.walks import Walk, arc
from torchslam import SLAM, Config, Run, evaluate, load_config, solve_graph
from torchslam.config import CameraConfig
from torchslam.data import open_sequence
from torchslam.io.export.scene import scene_of
from torchslam.io.report import readout_metrics, readout_words, run_metrics
from torchslam.io.results import readout_of
from torchslam.optim import GRAPH_OPTIONS

SEQUENCE = open_sequence("synthetic:room?frames=30&readout=30")


@pytest.fixture(scope="module")
def found() -> Run:
    return SLAM(SEQUENCE.camera).run(SEQUENCE)


def test_the_readout_and_the_poses_are_found(found: Run) -> None:
    assert found.readout is not None
    assert float(found.readout.seconds) == pytest.approx(0.03, abs=0.001)
    assert found.readout.std < 0.001
    assert SEQUENCE.groundtruth is not None
    final, online = (evaluate(each, SEQUENCE.groundtruth).ate_m for each in (found.trajectory, found.online))
    assert final < 0.4 * online


def test_the_trajectory_is_the_minimum_of_the_graph(found: Run) -> None:
    solution = solve_graph(found.graph, options=GRAPH_OPTIONS.replace(backward="detached"))
    torch.testing.assert_close(solution.trajectory.T_wc, found.trajectory.T_wc, rtol=0.0, atol=1e-4)
    corrected = found.graph.global_shutter()
    assert float((corrected.pixels - found.graph.pixels).norm(dim=-1).max()) > 3.0


def test_report_and_export_follow(found: Run) -> None:
    metrics = {"readout": readout_metrics(found)}
    assert metrics["readout"] is not None
    assert "± 0." in readout_words(metrics["readout"])
    known = readout_of(metrics)
    assert known is not None
    assert found.main is not None
    corrected, raw = (scene_of(found.main, found.camera, 0, False, each) for each in (known, None))
    assert float(corrected.errors().median()) < 0.6 * float(raw.errors().median())
    expected = run_metrics(replace(found, sensor=replace(found.sensor, readout=None)))["reprojection_px"]
    assert run_metrics(found)["reprojection_px"] < 0.6 * expected


def test_a_given_readout_is_a_prior() -> None:
    part = SEQUENCE.part(stop=16)
    run = SLAM(part.camera, Config(camera=CameraConfig(readout=30.0, readout_std=1.0))).run(part)
    assert run.readout is not None
    assert (run.readout.prior, run.readout.prior_std) == (0.03, 0.001)
    assert run.graph.readout == run.readout
    assert "given: 30 ms" in readout_words(readout_metrics(run) or {})


def test_a_global_shutter_has_none() -> None:
    walk = Walk(arc(60)[:20])
    settings = ["features.kind=simulated", "features.num_keypoints=250", "simulated.points_per_view=150"]
    settings += ["simulated.noise_px=0.5"]
    looked, told = (
        SLAM(walk.camera, load_config(None, [*settings, f"camera.readout_std={std}"])).run(walk)
        for std in (1000, 0)
    )
    assert looked.shutter is not None
    assert (looked.readout, told.readout, told.shutter) == (None, None, None)
    assert torch.equal(looked.trajectory.T_wc, told.trajectory.T_wc)
    assert readout_metrics(looked) is None
