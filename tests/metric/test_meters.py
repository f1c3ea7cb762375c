"""How measurements of the scale are combined, and how a submap goes into meters and keeps them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from tests.map.simulated import CAMERA, reprojection_errors, simulated_submap
from torchslam.config import Config
from torchslam.errors import MeasurementError
from torchslam.geometry import (
    SensorModel,
    se3_exp,
    se3_inverse,
    sim3_exp,
    sim3_inverse,
    sim3_scale,
    transform,
)
from torchslam.geometry.transforms import level_rotation
from torchslam.map.file import read_atlas, write_atlas
from torchslam.map.unit import MetricUnit
from torchslam.metric.meters import bring_into_meters, combine_scales, vertical_contradictions
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured
from torchslam.system.metric_run import run_in_meters
from torchslam.system.run import Run
from torchslam.types import State, StepResult


class Fixed:
    """A source that says the same of every submap."""

    def __init__(self, answer: ScaleMeasurement | Unmeasured) -> None:
        self.answer = answer

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        return self.answer


def scale_of(meters: float, std: float = 0.01, **more: object) -> Fixed:
    return Fixed(ScaleMeasurement(ScaleSource.MARKER, meters, std, 3, "markers", **more))  # type: ignore[arg-type]


def test_the_unit_of_a_submap_becomes_a_meter() -> None:
    submap = simulated_submap()
    path_w, errors = submap.trajectory().positions_w, reprojection_errors(submap)
    S_mw, silent = bring_into_meters(
        SubmapView(submap, CAMERA), [scale_of(2.5), Fixed(Unmeasured(ScaleSource.SPEED, "it stands still"))]
    )
    assert torch.allclose(submap.trajectory().positions_w, 2.5 * path_w)
    assert torch.allclose(reprojection_errors(submap), errors, atol=1e-9)
    assert torch.allclose(S_mw, torch.diag(torch.tensor((2.5, 2.5, 2.5, 1.0), dtype=torch.float64)))
    assert [each.reason for each in silent] == ["it stands still"]
    assert submap.metric is not None
    assert submap.metric.relative_std == pytest.approx(0.01)
    assert submap.metric.sentence == "scale 1.000 ± 0.010 (3 markers)"
    assert not submap.metric.is_level


def test_one_similarity_changes_all_poses_and_points() -> None:
    submap, same = simulated_submap(), simulated_submap()
    S_ew = sim3_exp(torch.tensor([5.0, -2.0, 1.0, 0.3, 0.2, -0.4, math.log(2.0)], dtype=torch.float64))
    positions = scale_of(2.0, 0.05, S_ew=S_ew, up_std=0.02, origin=(48.0, 11.0, 500.0))
    S_mw, _ = bring_into_meters(SubmapView(submap, CAMERA), [scale_of(2.1), positions])
    same.transform(S_mw)
    assert torch.equal(submap.map.T_cw, same.map.T_cw)
    assert torch.equal(submap.trajectory().T_wc, same.trajectory().T_wc)
    assert torch.equal(submap.map.points["positions_w"], same.map.points["positions_w"])


def test_without_measurements_nothing_changes() -> None:
    submap, same = simulated_submap(), simulated_submap()
    bring_into_meters(SubmapView(submap, CAMERA), [Fixed(Unmeasured(ScaleSource.SPEED, "none"))])
    assert submap.metric is None
    assert torch.equal(submap.trajectory().T_wc, same.trajectory().T_wc)


def test_z_is_up_where_gravity_is_known() -> None:
    submap = simulated_submap()
    up_w = torch.nn.functional.normalize(torch.tensor([0.1, -1.0, 0.2], dtype=torch.float64), dim=0)
    S_mw, _ = bring_into_meters(SubmapView(submap, CAMERA), [scale_of(2.0, up_w=up_w, up_std=0.01)])
    assert torch.allclose(S_mw[:3, :3] @ up_w, torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))
    assert float(torch.linalg.det(S_mw[:3, :3])) == pytest.approx(8.0)
    assert submap.metric is not None
    assert submap.metric.up_std == pytest.approx(0.01)


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-0.6, 0.0, 0.8)])
def test_level_rotations_are_proper(up: tuple[float, float, float]) -> None:
    up_w = torch.tensor(up, dtype=torch.float64)
    R = level_rotation(up_w)
    assert torch.allclose(R @ up_w, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(R)) == pytest.approx(1.0)


def test_the_frame_of_a_source_is_the_world_whatever_others_say_of_the_scale() -> None:
    submap = simulated_submap()
    middle_w = submap.trajectory().positions_w.mean(dim=0)
    S_ew = sim3_exp(torch.tensor([5.0, -2.0, 1.0, 0.3, 0.2, -0.4, math.log(2.0)], dtype=torch.float64))
    positions = scale_of(2.0, S_ew=S_ew, up_std=0.02, origin=(48.0, 11.0, 500.0))
    S_mw, _ = bring_into_meters(SubmapView(submap, CAMERA), [scale_of(2.02), positions])
    assert float(sim3_scale(S_mw)) == pytest.approx(math.sqrt(2.0 * 2.02))
    assert torch.allclose(transform(S_mw, middle_w[None]), transform(S_ew, middle_w[None]))
    assert submap.metric is not None
    assert submap.metric.origin == (48.0, 11.0, 500.0)
    assert submap.metric.is_level


def test_contradictions_and_rejected_markers_are_named() -> None:
    submap = simulated_submap()
    marker = scale_of(1.0, rejected=("marker 7 is too large",), apart=0.003)
    bring_into_meters(SubmapView(submap, CAMERA), [marker, scale_of(1.2)])
    assert submap.metric is not None
    assert len(submap.metric.remarks) == 2
    assert "contradict" in submap.metric.remarks[0]
    assert submap.metric.remarks[1] == "marker 7 is too large"
    assert "0.3% apart" in submap.metric.sentence


def test_the_map_file_keeps_the_unit(tmp_path: Path) -> None:
    submap = simulated_submap()
    bring_into_meters(SubmapView(submap, CAMERA), [scale_of(2.0, rejected=("one",))])
    write_atlas(
        tmp_path / "map",
        [submap, simulated_submap(number=3, session=1)],
        CAMERA.to(torch.float64),
        sessions=2,
    )
    first, second = read_atlas(tmp_path / "map").atlas
    assert first.metric == submap.metric
    assert second.metric is None


@pytest.mark.parametrize(
    "change",
    [{"relative_std": -1.0}, {"S_mw": [[1.0]]}, {"sources": 3}, {"origin": [1.0]}, {"up_std": "much"}],
)
def test_a_damaged_record_is_refused(change: dict[str, object]) -> None:
    submap = simulated_submap()
    bring_into_meters(SubmapView(submap, CAMERA), [scale_of(2.0)])
    assert submap.metric is not None
    record = submap.metric.as_dict()
    assert MetricUnit.from_dict(record) == submap.metric
    with pytest.raises((ValueError, TypeError, KeyError)):
        MetricUnit.from_dict(record | change)


def test_a_further_session_is_compared_with_a_map_in_meters() -> None:
    submap = simulated_submap()
    bring_into_meters(SubmapView(submap, CAMERA), [scale_of(2.0)])
    before = submap.trajectory().T_wc
    S_mw, _ = bring_into_meters(SubmapView(submap, CAMERA), [scale_of(1.3)])
    assert torch.equal(submap.trajectory().T_wc, before)
    assert torch.equal(S_mw, torch.eye(4, dtype=torch.float64))
    assert submap.metric is not None
    assert "map and marker contradict each other" in submap.metric.contradictions[0]


@pytest.mark.parametrize("metric_first", [True, False])
def test_merged_submaps_are_in_the_meters_of_the_one_that_has_them(metric_first: bool) -> None:
    one, other = simulated_submap(), simulated_submap(seed=1, number=1, session=1)
    metric, plain = (one, other) if metric_first else (other, one)
    bring_into_meters(SubmapView(metric, CAMERA), [scale_of(2.0)])
    S_mp = sim3_exp(
        torch.tensor([0.4, 0.1, -0.2, 0.1, 0.2, 0.3, 0.5], dtype=torch.float64)
    )  # plain to metric
    in_meters = metric.trajectory().positions_w
    moved = transform(S_mp, plain.trajectory().positions_w)
    merged = one
    one.merge(other, sim3_inverse(S_mp) if not metric_first else S_mp)
    assert merged.metric is not None
    session = 0 if metric_first else 1
    assert torch.allclose(merged.trajectory(session).positions_w, in_meters, atol=1e-9)
    assert torch.allclose(merged.trajectory(1 - session).positions_w, moved, atol=1e-9)


def test_what_was_returned_frame_by_frame_follows() -> None:
    submap = simulated_submap()
    T_cw = se3_exp(torch.tensor([0.1, 0.2, 0.3, 0.1, 0.0, 0.2], dtype=torch.float64))
    covariance = torch.eye(6, dtype=torch.float64)
    results = [
        StepResult(0, 0.0, State.TRACKING, T_cw, submap=0, covariance=covariance),
        StepResult(1, 0.1, State.TRACKING, T_cw, submap=9),
        StepResult(2, 0.2, State.LOST, None),
    ]
    run = Run((submap,), SensorModel(CAMERA), Config(), results, [], False, "")
    up_w = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    found = run_in_meters(run, None, [scale_of(2.0, up_w=up_w, up_std=0.1)])
    moved = found.results[0]
    assert moved.T_cw is not None
    assert moved.covariance is not None
    S_mw = torch.tensor(found.metric.S_mw if found.metric else [], dtype=torch.float64)
    center = transform(S_mw, se3_inverse(T_cw)[None, :3, 3])[0]
    assert torch.allclose(se3_inverse(moved.T_cw)[:3, 3], center)
    assert torch.allclose(
        moved.covariance.diagonal(), torch.tensor([4.0] * 3 + [1.0] * 3, dtype=torch.float64)
    )
    assert found.results[1] is results[1]  # of a submap that is no more
    assert run_in_meters(run, None, []) is run


def test_a_wrong_measurement_loses_nothing_of_a_run() -> None:
    class Wrong:
        def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
            raise MeasurementError("the clock runs backwards")

    submap = simulated_submap()
    before = submap.trajectory().T_wc
    found = run_in_meters(Run((submap,), SensorModel(CAMERA), Config(), [], [], False, ""), None, [Wrong()])
    assert found.unmeasured == ("the clock runs backwards",)
    assert found.metric is None
    assert torch.equal(found.trajectory.T_wc, before)


def measurement(scale: float, std: float, source: ScaleSource = ScaleSource.MARKER) -> ScaleMeasurement:
    return ScaleMeasurement(source, scale, std, 1, "markers")


def test_one_measurement_stays_as_it_is() -> None:
    combined = combine_scales([measurement(2.5, 0.01)])
    assert combined.meters_per_unit == pytest.approx(2.5, rel=1e-12)
    assert combined.relative_std == pytest.approx(0.01, rel=1e-12)
    assert combined.contradictions == ()


def test_the_mean_is_weighted_by_information() -> None:
    combined = combine_scales([measurement(1.0, 0.01), measurement(1.03, 0.02)])
    # information 10000 and 2500: a fifth of the way in the logarithm
    assert math.log(combined.meters_per_unit) == pytest.approx(math.log(1.03) / 5, rel=1e-12)
    chi_square = 10000 * (math.log(1.03) / 5) ** 2 + 2500 * (4 * math.log(1.03) / 5) ** 2
    assert combined.relative_std == pytest.approx(math.sqrt(chi_square / 12500), rel=1e-12)


def test_measurements_that_agree_do_not_lower_the_formal_error_further() -> None:
    combined = combine_scales([measurement(1.0, 0.01), measurement(1.0, 0.01)])
    assert combined.relative_std == pytest.approx(0.01 / math.sqrt(2), rel=1e-12)


def test_a_contradiction_names_both_with_their_errors() -> None:
    gps = measurement(1.2, 0.02, ScaleSource.POSITION)
    combined = combine_scales([measurement(1.0, 0.01), gps, measurement(1.01, 0.01, ScaleSource.DISTANCE)])
    assert len(combined.contradictions) == 2
    assert "marker and position" in combined.contradictions[0]
    assert "1.2 ± 2.0%" in combined.contradictions[0]


def test_no_measurement_is_an_error() -> None:
    with pytest.raises(MeasurementError, match="no measurement"):
        combine_scales([])


@pytest.mark.parametrize(
    ("scale", "std"), [(0.0, 0.1), (-1.0, 0.1), (1.0, 0.0), (math.nan, 0.1), (1.0, math.inf)]
)
def test_a_scale_must_be_positive_with_a_finite_error(scale: float, std: float) -> None:
    with pytest.raises(MeasurementError):
        measurement(scale, std)


@pytest.mark.parametrize(
    ("up", "std", "words"),
    [
        ((0.0, -1.0, 0.0), 0.01, ""),
        ((0.5, -0.8, 0.3), 0.01, ""),
        ((0.0, 1.0, 0.1), 0.01, "the images are rolled by 180 degrees"),
        ((1.0, 0.0, 0.0), 0.01, "the images are rolled by 90 degrees"),
        ((0.0, 0.1, 1.0), 0.01, "the camera looks up by 84 degrees"),
        ((0.0, 0.1, -1.0), 0.01, ""),  # at the ground
        ((0.0, 1.0, 0.1), 1.0, ""),  # hardly known
    ],
)
def test_a_vertical_that_contradicts_the_images(up: tuple[float, ...], std: float, words: str) -> None:
    """Of a mirrored path, or an inertial sensor with another mounting; most images decide."""
    up_w = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    R_cw = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    R_cw[0] = torch.diag(torch.tensor((-1.0, -1.0, 1.0), dtype=torch.float64))  # one is upside down
    measured = ScaleMeasurement(ScaleSource.MARKER, 2.0, 0.01, 3, "markers", up_w=up_w, up_std=std)
    lines = vertical_contradictions(R_cw, [measured])
    assert bool(lines) == bool(words)
    assert all(
        line.startswith("the vertical of marker contradicts the images") and words in line for line in lines
    )


def test_a_size_in_another_unit_is_named() -> None:
    one = ScaleMeasurement(ScaleSource.MARKER, 0.8, 0.01, 1, "marker", stated="apriltag-25h9:0.8")
    other = ScaleMeasurement(ScaleSource.SPEED, 0.08, 0.01, 9, "stretches")
    (line,) = combine_scales([one, other]).contradictions
    assert line.startswith("marker and speed contradict each other by a factor of 10: ")
    assert line.endswith("; stated: marker apriltag-25h9:0.8")
