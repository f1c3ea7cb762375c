"""A whole run over a rendered room with boards: turned to the camera by 10 to 50 degrees, blurred and with noise."""

from __future__ import annotations

import math

import pytest

import experiments.meters.markers.scene  # noqa: F401  it adds scenes
from torchslam.data import open_sequence
from torchslam.evaluation import evaluate
from torchslam.metric.markers.detection import parse_target
from torchslam.metric.markers.source import Markers
from torchslam.metric.source import ScaleMeasurement, SubmapView
from torchslam.system.slam import SLAM


@pytest.mark.parametrize(
    ("scene", "text"),
    [
        ("charuco", "charuco-7x5:0.12:0.09"),
        pytest.param("chessboard", "chessboard-7x5:0.12", marks=pytest.mark.slow),
    ],
)
def test_a_board_gives_meters(scene: str, text: str) -> None:
    """OpenCV counts the chessboard from either end, as the camera goes past it."""
    sequence = open_sequence(f"synthetic:{scene}?frames=20&blur=0.8&noise=3")
    run = SLAM(sequence.camera).run(sequence)
    assert run.main is not None
    assert sequence.groundtruth is not None
    view = SubmapView(run.main, run.camera, 0, sequence, run.readout)
    found = Markers([parse_target(text)]).measure(view)
    assert isinstance(found, ScaleMeasurement), found
    assert found.rejected == ()
    error = math.log(found.meters_per_unit / evaluate(run.main.trajectory(0), sequence.groundtruth).scale)
    assert abs(error) < 0.005
    assert abs(error) < 3 * found.relative_std < 0.03
