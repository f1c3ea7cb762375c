"""A whole run over a rendered room with boards: turned to the camera by 10 to 50 degrees, blurred and with noise."""

from __future__ import annotations

import copy
import math

import pytest

import experiments.meters.markers.scene  # noqa: F401  it adds the scene
from torchslam.data import Sequence, open_sequence
from torchslam.evaluation import evaluate
from torchslam.metric.markers.source import Markers
from torchslam.metric.markers.targets import parse_target
from torchslam.metric.scale import ScaleMeasurement
from torchslam.metric.source import SubmapView
from torchslam.system.run import Run
from torchslam.system.slam import SLAM


@pytest.fixture(scope="module")
def finished() -> tuple[Sequence, Run]:
    sequence = open_sequence("synthetic:marked?frames=40&blur=0.8&noise=3")
    return sequence, SLAM(sequence.camera).run(sequence)


@pytest.mark.parametrize("text", ["charuco-7x5:0.08:0.06", "chessboard-7x5:0.08"])
def test_a_board_gives_meters(finished: tuple[Sequence, Run], text: str) -> None:
    sequence, run = finished
    assert run.main is not None
    assert sequence.groundtruth is not None
    submap = copy.deepcopy(run.main)
    view = SubmapView(submap, run.camera, 0, sequence, run.readout)
    found = Markers([parse_target(text)]).measure(view)
    assert isinstance(found, ScaleMeasurement), found
    assert found.rejected == ()
    error = math.log(found.meters_per_unit / evaluate(submap.trajectory(0), sequence.groundtruth).scale)
    assert abs(error) < 0.005
    assert abs(error) < 3 * found.relative_std < 0.03
