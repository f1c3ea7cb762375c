"""Tables with a header: headings, units, quotes, and values that stand for an unknown one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from torchslam.data.fields import POSITION_COLUMNS, SPEED
from torchslam.data.tables import TIMES, read_cells, read_table
from torchslam.data.text_file import are_numbers, parse_floats, parse_known, parse_number, with_set_clock
from torchslam.errors import MeasurementError, SequenceError


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("-1.5e-05", -1.5e-5),
        ("59,302335", 59.302335),
        ("0,125", 0.125),
        (" +7. ", 7.0),
        (".5", 0.5),
        ("1,5E3", 1500),
    ],
)
def test_a_number_is_the_whole_text(text: str, number: float) -> None:
    assert parse_number(text, "here", SequenceError) == number


@pytest.mark.parametrize(
    "text", ["59,", "1.2.3", "1_0", "٣", "4 8", "4.5e", "", "1,2,3", "12,345", "nan", "1e999", "0x1"]
)
def test_anything_else_is_refused_with_its_place(text: str) -> None:
    with pytest.raises(SequenceError, match=r"^a.csv:7: `.*` is not a (finite )?number"):
        parse_number(text, "a.csv:7", SequenceError)
    assert not are_numbers([text])


def test_numbers_of_a_line_have_no_decimal_commas() -> None:
    assert parse_floats("1,2.5, 3\t4", "here", SequenceError) == [1, 2.5, 3, 4]
    with pytest.raises(SequenceError, match="`500,5`: a decimal comma, or two numbers"):
        parse_floats("500,5 500,5 320 240", "here", SequenceError)


@pytest.mark.parametrize("text", ["", " NaN ", "null", "N/A", "-", "-nan(ind)", "\\N"])
def test_words_for_an_unknown_number(text: str) -> None:
    assert math.isnan(parse_known(text, "here", SequenceError))


@pytest.mark.parametrize(
    ("kind", "heading", "unit"),
    [
        ("time", "%time", math.nan),
        ("time", "time(millisecond)", 1e-3),
        ("time", "Timestamp (UTC)", math.nan),
        ("latitude", "GPS (Lat.) [deg]", 1.0),
        ("latitude", "locationLatitude(WGS84)", 1.0),
        ("longitude", "field.longitude", math.nan),
        ("altitude", "altitude (feet)", 0.3048),
        ("altitude", "Altitude_m", 1.0),
        ("altitude", "altitude_msl_ft", 0.3048),
        ("altitude", "Alt (m AMSL)", 1.0),
        ("altitude", "altitude accuracy [m]", None),
        ("altitude", "home_altitude", None),
        ("std_horizontal", "horizontalAccuracy", math.nan),
    ],
)
def test_headings_of_phones_cameras_and_drones(kind: str, heading: str, unit: float | None) -> None:
    found = POSITION_COLUMNS[kind].unit(heading, "here", MeasurementError)
    assert found == unit or (
        unit is not None and math.isnan(unit) and found is not None and math.isnan(found)
    )


def test_an_unknown_unit_is_refused() -> None:
    with pytest.raises(MeasurementError, match=r"a.csv:1: column `Speed \[furlongs\]`: the unit `furl"):
        SPEED.unit("Speed [furlongs]", "a.csv:1", MeasurementError)


@pytest.mark.parametrize(
    "text",
    [
        'time,speed\n0,1.5\n2,"3"\n',
        '"","time","speed"\n"1",0,1.5\n"2",2,3\n',
        '"time" "speed"\n"1" 0 1.5\n"2" 2 3\n',
        '"time,speed"\n"0,1.5"\n"2,3"\n',
        'sep=;\n"time";"speed (km/h)"\n0;5,4\n2;"10,8"\n',
        "# a logger\n#time speed\n0 1.5\n2 3\n",
        "# a logger's file\n0,1.5\n2,3\n",
        "\n\nTime [s]\tSpeed [m/s]\n0\t1.5\n2\t3\t\n\n",  # Excel's Unicode text
        "\ufefftime,speed\n1970-01-01 00:00:00 UTC,1.5\n2,3\n",
    ],
)
def test_tables_of_many_programs(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-16" if "\t" in text else "utf-8")
    columns = TIMES | {"speed": SPEED}
    rows = list(read_table(tmp_path / "a.csv", columns, MeasurementError, unnamed=("time", "speed")))
    assert [(row.time(), pytest.approx(row.number("speed"))) for row in rows] == [(0.0, 1.5), (2.0, 3.0)]


def test_rows_with_a_cell_more_are_refused_unless_they_have_names(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,speed\n0,1,5\n")
    with pytest.raises(SequenceError, match=r"a.csv:2: 3 cells, the header has 2 columns"):
        list(read_cells(tmp_path / "a.csv", SequenceError))


@pytest.mark.parametrize(
    ("kind", "values", "unknown"),
    [
        ("altitude", [520.0, 0.0, 521.0, -9999.0, -32768.0], [1, 3, 4]),
        ("altitude", [0.0, 0.4, -1.0, -0.7, 999.0, 998.0], []),
        ("altitude", [0.0, 0.0], [0, 1]),
        ("altitude", [400.0, -9999 * 0.3048, 401.0], [1]),
        ("latitude", [48.1, 0.0, -180.0, 999.0, 91.0, 214.7483647, 48.2], [1, 2, 3, 4, 5]),
        ("latitude", [1e-5, 0.0, 2e-5], []),
        ("longitude", [99.98, 99.99, 99.985], []),
        ("altitude", [100.0, 100.0, 1000.0, 30.48], []),  # 10000 cm, 100000 cm, 10000 tenths of an inch
        ("std_horizontal", [4.0, 99.99, 9999.0], [1, 2]),
    ],
)
def test_numbers_for_an_unknown_value(kind: str, values: list[float], unknown: list[int]) -> None:
    """A number of the list counts if others are near it: at the sea, on the equator, in a fast car."""
    found, words = POSITION_COLUMNS[kind].known(values)
    assert np.flatnonzero(np.isnan(found)).tolist() == unknown
    assert bool(words) == bool(unknown)
    np.testing.assert_array_equal(found[~np.isnan(found)], np.delete(values, unknown))


def test_speeds_of_vehicles_that_back_up() -> None:
    assert np.isnan(SPEED.known([3.0, -1.0, -0.2, -1.0, 655.35])[0]).tolist() == [
        False,
        True,
        False,
        True,
        True,
    ]
    assert np.isnan(SPEED.known([3.0, -3.6 / 3.6, -1.2])[0]).sum() == 0
    assert np.isnan(SPEED.known([10.0, 98 / 3.6, 99 / 3.6, 100 / 3.6, 100.0])[0]).sum() == 0
    assert SPEED.known([30.0, -2.2369 * 0.44704])[1] == "-0.999984 (1 times)"
    assert SPEED.known([])[0].tolist() == []


def test_times_of_a_clock_that_was_not_set() -> None:
    assert np.isnan(with_set_clock(np.array([0.0, 315964800.0, 1.7e9]))).tolist() == [True, True, False]
    assert with_set_clock(np.array([0.0, 1.0])).tolist() == [0.0, 1.0]
