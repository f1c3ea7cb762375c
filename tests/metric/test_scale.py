"""How measurements of the scale are combined."""

from __future__ import annotations

import math

import pytest

from torchslam.errors import TorchslamError
from torchslam.metric.meters import combine_scales
from torchslam.metric.source import ScaleMeasurement, ScaleSource


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
    with pytest.raises(TorchslamError, match="no measurement"):
        combine_scales([])


@pytest.mark.parametrize(
    ("scale", "std"), [(0.0, 0.1), (-1.0, 0.1), (1.0, 0.0), (math.nan, 0.1), (1.0, math.inf)]
)
def test_a_scale_must_be_positive_with_a_finite_error(scale: float, std: float) -> None:
    with pytest.raises(TorchslamError):
        measurement(scale, std)
