"""How the user describes markers and boards."""

from __future__ import annotations

import numpy as np
import pytest

from torchslam.errors import MeasurementError
from torchslam.metric.markers.detection import TargetKind, parse_target
from torchslam.metric.markers.source import from_options


def test_a_marker_has_its_size_and_others_have_theirs() -> None:
    target = parse_target("apriltag-25h9:0.05,7=0.1,9=0.2")
    assert target.kind is TargetKind.MARKER
    assert target.family == "apriltag-25h9"
    for identity, size in ((0, 0.05), (7, 0.1), (9, 0.2)):
        corners = target.corners(identity)
        assert np.allclose(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1), size)


def test_boards_have_the_corners_between_their_squares() -> None:
    target = parse_target("charuco-7x5:0.04:0.03")
    assert target.squares == (7, 5)
    assert target.corners(0).shape == (24, 2)
    assert np.allclose(target.corners(0)[1] - target.corners(0)[0], (0.04, 0))
    assert np.allclose(target.corners(0)[6] - target.corners(0)[0], (0, 0.04))
    assert parse_target("chessboard-9x6:0.025").corners(0).shape == (40, 2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("apriltag-25h9", "write FAMILY:METERS"),
        ("apriltag-99h1:0.05", "no family apriltag-99h1"),
        ("aruco-9x9:0.05", "no family aruco-9x9"),
        ("aruco-4x4:50mm", "no length in meters"),
        ("aruco-4x4:500", "sizes are in meters"),
        ("apriltag-25h9:80", "sizes are in meters, from 0.001 to 5; 80 mm are 0.08"),
        ("chessboard-7x5:40", "40 mm are 0.04"),
        ("aruco-4x4:-1", "sizes are in meters"),
        ("aruco-4x4:nan", "sizes are in meters"),
        ("aruco-4x4:0.1,7=0.2,7=0.3", "marker 7 has two sizes"),
        ("charuco-7x5:0.04", "of a square and of a marker"),
        ("charuco-7x5:0.03:0.04", "smaller than the square"),
        ("chessboard-2x5:0.04", "3 to 100 squares"),
        ("chessboard-7x5:0.04:0.03", "side of a square"),
    ],
)
def test_what_is_wrong_is_said(text: str, words: str) -> None:
    with pytest.raises(MeasurementError, match=words):
        parse_target(text)


def test_one_family_has_one_size() -> None:
    with pytest.raises(MeasurementError, match="the same markers with two sizes"):
        from_options({"marker": (("aruco-4x4:0.1",), ("aruco-4x4:0.2",))})
    from_options({"marker": (("aruco-4x4:0.1",), ("aruco-5x5:0.2",))})
