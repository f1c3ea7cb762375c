"""Files of positions: every layout by an example made by hand, and what may be wrong in them."""

from __future__ import annotations

import datetime
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchslam.data.fixes import Fixes
from torchslam.data.formats.fix_files import read_fixes
from torchslam.data.text_file import utc_from_gps
from torchslam.errors import MeasurementError, TorchslamError

MAVIC_3 = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
2023-05-01 10:00:00.123
[iso: 100] [shutter: 1/1000.0] [latitude: 59.302335] [longitude: 18.203059] [rel_alt: 1.300 abs_alt: 132.860] </font>

2
00:00:00,033 --> 00:00:00,066
<font size="28">FrameCnt: 2, DiffTime: 33ms
2023-05-01 10:00:00.156
[iso: 100] [shutter: 1/1000.0] [latitude: 59.302335] [longitude: 18.203059] [rel_alt: 1.300 abs_alt: 132.860] </font>

3
00:00:00,066 --> 00:00:00,100
<font size="28">FrameCnt: 3, DiffTime: 34ms
[iso: 100] [latitude: 59.302336] [longitude: 18.203060] [rel_alt: 1.400 abs_alt: 132.960] </font>
"""
MAVIC_PRO = """1
00:00:00,000 --> 00:00:01,000
HOME(149.0251,-20.2532) 2017.08.05 14:11:51
GPS(149.0251,-20.2533,16) BAROMETER:1.9
ISO:100 Shutter:60 EV: Fnum:2.2

2
00:00:01,000 --> 00:00:02,000
HOME(149.0251,-20.2532) 2017.08.05 14:11:52
GPS(149.0252,-20.2533,16) BAROMETER:2.1
"""
MINI_2 = """1
00:00:01,500 --> 00:00:02,500
F/2.8, SS 206.14, ISO 150, EV 0, GPS (-82.6669, 27.7731, 18), D 2.80m, H 3.20m, H.S 0.00m/s, V.S 0.00m/s
"""
MATRICE = """1
00:00:00,000 --> 00:00:01,000
GPS(48.1234, 11.5678, 512.3M)
"""
MAVIC_2 = "1\n00:00:00,000 --> 00:00:01,000\n[latitude : 0.6] [longtitude : 1.5] [altitude: 12.5]\n"
GPX = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="x" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="48.1" lon="-11.5"><ele>520.5</ele><time>2024-05-01T10:00:00Z</time></trkpt>
<trkpt lat="48.2" lon="-11.5"><time>2024-05-01T10:00:01.500Z</time></trkpt>
</trkseg></trk></gpx>
"""
NMEA = """$GPGGA,235958.50,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*%s
$GPRMC,235958.50,A,4807.038,N,01131.000,E,022.4,084.4,230324,003.1,W*%s
$GPGSV,2,1,08,01,40,083,46*75
$GNGGA,000000.50,4807.038,S,01131.000,W,1,08,0.9,545.4,M,46.9,M,,*%s
$GPGGA,000001.50,,,,,0,00,,,M,,M,,*%s
"""


def with_sums(text: str) -> str:
    lines = []
    for line in text.splitlines():
        total = 0
        for byte in line[1:].partition("*")[0].encode():
            total ^= byte
        lines.append(line.replace("%s", f"{total:02X}"))
    return "\n".join(lines) + "\n"


def read(folder: Path, name: str, content: str) -> Fixes:
    path = folder / name
    path.write_text(content)
    return read_fixes(path)


def utc(*parts: float) -> float:
    return datetime.datetime(*map(int, parts), tzinfo=datetime.UTC).timestamp()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("content", "times", "geodetic"),
    [
        (MAVIC_3, [0.0, 0.066], [[59.302335, 18.203059, 132.86], [59.302336, 18.20306, 132.96]]),
        (MAVIC_PRO, [0.0, 1.0], [[-20.2533, 149.0251, 1.9], [-20.2533, 149.0252, 2.1]]),
        (MINI_2, [1.5], [[27.7731, -82.6669, 3.2]]),
        (MATRICE, [0.0], [[48.1234, 11.5678, 512.3]]),
        (MAVIC_2, [0.0], [[0.6, 1.5, 12.5]]),
    ],
)
def test_subtitles_of_drones(
    tmp_path: Path, content: str, times: list[float], geodetic: list[list[float]]
) -> None:
    """At the beginning of each cue with another position."""
    for ends in ("\n", "\r\n"):
        fixes = read(tmp_path, "DJI_0001.SRT", content.replace("\n", ends))
        assert fixes.timestamps is not None
        assert fixes.timestamps.tolist() == times
        torch.testing.assert_close(fixes.geodetic, torch.tensor(geodetic, dtype=torch.float64))


def test_gpx(tmp_path: Path) -> None:
    fixes = read(tmp_path, "walk.gpx", GPX)
    assert fixes.timestamps is not None
    assert fixes.timestamps.tolist() == [utc(2024, 5, 1, 10), utc(2024, 5, 1, 10) + 1.5]
    assert fixes.geodetic[0].tolist() == [48.1, -11.5, 520.5]
    assert math.isnan(float(fixes.geodetic[1, 2]))


def test_nmea_past_midnight(tmp_path: Path) -> None:
    fixes = read(tmp_path, "log.txt", with_sums(NMEA))
    assert fixes.timestamps is not None
    assert fixes.timestamps.tolist() == [utc(2024, 3, 23, 23, 59, 58) + 0.5, utc(2024, 3, 24) + 0.5]
    place = [48 + 7.038 / 60, 11 + 31 / 60, 545.4]
    torch.testing.assert_close(fixes.geodetic[0], torch.tensor(place, dtype=torch.float64))
    torch.testing.assert_close(fixes.geodetic[1, :2], -torch.tensor(place[:2], dtype=torch.float64))
    assert "left out 1 rows without a position" in fixes.notes[0]
    damaged = read(tmp_path, "log.nmea", with_sums(NMEA).replace("48", "49", 1))
    assert len(damaged) == 1
    assert "1 lines with a wrong checksum" in damaged.notes[0]


def test_csv_by_times_and_by_names(tmp_path: Path) -> None:
    fixes = read(
        tmp_path,
        "a.csv",
        "time,latitude,longitude,altitude,std_horizontal,std_vertical,fix\n0,48,11,500,0.5,1,3\n1,,,,,,0\n2,48,11,,,,3\n",
    )
    assert fixes.timestamps is not None
    assert fixes.timestamps.tolist() == [0.0, 2.0]
    assert fixes.std[0].tolist() == [0.5, 1.0]
    assert bool(fixes.std[1].isnan().all())
    assert len(fixes.notes) == 1
    named = read(tmp_path, "b.csv", "Name;Latitude;Longitude\nb/1.jpg;48;11\nb/2.jpg;48.5;11\n")
    assert named.timestamps is None
    assert named.names == ("b/1.jpg", "b/2.jpg")


@pytest.mark.parametrize(
    ("column", "text", "seconds"),
    [
        ("time", "12.5", 12.5),
        ("time", "1700000000500", 1700000000.5),
        ("timestamp [ns]", "1700000000500000000", 1700000000.5),
        ("#timestamp [ns]", "500000000", 0.5),
        ("time_ms", "12500", 12.5),
        ("time", "2024-05-01T10:00:00.25Z", utc(2024, 5, 1, 10) + 0.25),
        ("time", "2024-05-01 12:00:00+02:00", utc(2024, 5, 1, 10)),
        ("gps_time", "1398592818", utc(2024, 5, 1, 10)),
        ("gps_time_ms", "1398592818000", utc(2024, 5, 1, 10)),
    ],
)
def test_units_of_time(tmp_path: Path, column: str, text: str, seconds: float) -> None:
    fixes = read(tmp_path, "a.csv", f"{column},lat,lon\n{text},48,11\n")
    assert fixes.timestamps is not None
    assert fixes.timestamps.tolist() == pytest.approx([seconds], abs=1e-6)


def test_leap_seconds_of_gps_time() -> None:
    """GPS time was ahead of UTC by 0 in 1980, 16 s in 2014, and is by 18 s since 2017."""
    assert utc_from_gps(0.0) == utc(1980, 1, 6)
    assert utc_from_gps(1072915200.0 + 16) - utc(2014, 1, 5) == pytest.approx(0)
    assert utc_from_gps(1167264018.0) == utc(2017, 1, 1)
    assert utc_from_gps(1167264016.0) == utc(2016, 12, 31, 23, 59, 59)


def test_exif_of_images(tmp_path: Path) -> None:
    for index, place in enumerate([(48.5, "N", 11.25, "W"), (10.0, "S", 20.0, "E"), None]):
        image = Image.fromarray(np.zeros((8, 8, 3), np.uint8))
        exif = image.getexif()
        if place is not None:
            latitude, north, longitude, east = place
            degrees = (int(latitude), (latitude % 1) * 60, 0.0), (int(longitude), (longitude % 1) * 60, 0.0)
            block = {1: north, 2: degrees[0], 3: east, 4: degrees[1], 5: b"\x00", 6: 100.5, 31: 3.0}
            exif.get_ifd(0x8825).update(block)
        image.save(tmp_path / f"{index}.jpg", exif=exif)
    fixes = read_fixes(tmp_path)
    assert fixes.names == ("0.jpg", "1.jpg")
    expected = torch.tensor([[48.5, -11.25, 100.5], [-10.0, 20.0, 100.5]], dtype=torch.float64)
    torch.testing.assert_close(fixes.geodetic, expected)
    assert fixes.std[0, 0] == 3.0
    assert "1 images have no position" in fixes.notes[0]
    with pytest.raises(MeasurementError, match="give the folder"):
        read_fixes(tmp_path / "0.jpg")
    for file in ("0.jpg", "1.jpg"):
        (tmp_path / file).unlink()
    with pytest.raises(MeasurementError, match="no image of 1 has a position"):
        read_fixes(tmp_path)


def test_minutes_above_60_are_refused(tmp_path: Path) -> None:
    image = Image.new("L", (8, 8))
    exif = image.getexif()
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 700.0, 0.0), 3: "E", 4: (11.0, 0.0, 0.0)})
    image.save(tmp_path / "0.jpg", exif=exif)
    with pytest.raises(MeasurementError, match=r"0.jpg: .*minutes or seconds of a position above 60"):
        read_fixes(tmp_path)


def test_packets_of_kitti(tmp_path: Path) -> None:
    (tmp_path / "oxts" / "data").mkdir(parents=True)
    (tmp_path / "oxts" / "timestamps.txt").write_text(
        "2011-09-26 13:02:25.5\n2011-09-26 13:02:25.6\n", encoding="utf-8"
    )
    for index in range(2):
        numbers = [49.0 + index, 8.4, 112.8, *[0.0] * 20, 0.25 * index, *[4.0] * 6]
        text = " ".join(map(str, numbers))
        (tmp_path / "oxts" / "data" / f"{index:010d}.txt").write_text(text, encoding="utf-8")
    for folder in (tmp_path, tmp_path / "oxts"):
        fixes = read_fixes(folder)
        assert fixes.timestamps is not None
        assert fixes.timestamps.tolist() == [46945.5, 46945.6]
        assert fixes.geodetic[1].tolist() == [50.0, 8.4, 112.8]
        assert fixes.std[1].tolist() == [0.25, 0.25]
        assert bool(fixes.std[0].isnan().all())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "0,48,11\n1,48,11\n", "the first line must name the columns `time`, .*`latitude`"),
        ("a.csv", "time,x,y\n0,1,2\n", "no position in it; 1 rows are empty"),
        ("a.csv", "latitude,longitude\n48,11\n", "a.csv:2: neither a `time` nor the `name`"),
        ("a.csv", "time,lat,latitude,lon\n0,1,1,1\n", "two columns of the kind `latitude`"),
        ("a.csv", "time,lat,lon\n0,48\n", "a.csv:2: 2 cells, the header has 3"),
        ("a.csv", "time,lat,lon\n0,north,11\n", "a.csv:2: column latitude: `north`"),
        ("a.csv", "time,lat,lon\n0,48,inf\n", "a.csv:2: column longitude: `inf`"),
        ("a.csv", "time,lat,lon\n,48,11\n", "a.csv:2: the time is missing"),
        ("a.csv", "time,lat,lon\n0,149,-20\n", "a latitude of 149 .* swapped"),
        ("a.csv", "time,lat,lon\n0,4800,1100\n", "beyond the poles$"),
        ("a.csv", "time,lat,lon\n1,48,11\n0,48,11\n", "a.csv:3: the time 0.0 is earlier"),
        ("a.csv", "time,lat,lon,alt\n1,48,11,1e6\n", "no altitude in meters"),
        ("a.csv", "time,lat,lon\n123456789012,48,11\n", "times are seconds, or milli"),
        ("a.csv", "", "the first line must name"),
        ("a.srt", "1\n00:00:00,000 --> 00:00:01,000\nHello\n", "no position in it"),
        ("a.srt", "1\n0:0 --> 1\nGPS(1,2,3)\n", "a.srt:2: expected `00:00:01,000"),
        ("a.gpx", "<gpx>", "not GPX"),
        ("a.gpx", "<!DOCTYPE gpx><gpx/>", "no DOCTYPE"),
        ("a.gpx", "<gpx><wpt lat='1' lon='2'/></gpx>", "routes and waypoints"),
        ("a.gpx", "<gpx><trkpt lat='1' lon='2'/></gpx>", "point 1: no time"),
        ("a.gpx", "<gpx><trkpt lat='x' lon='2'><time>2024-05-01</time></trkpt></gpx>", "`x` is not a number"),
        ("a.nmea", "$GPGGA,000001,4800.0,X,01100.0,E,1,8,1,5,M,4,M,,\n", "`4800.0,X` is not a latitude"),
        (
            "a.nmea",
            "$GPGGA,000001,4800.0,N,01100.0,E,1,8,1,5,F,4,M,,\n",
            "unit of the altitude is `F`, not M",
        ),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    with pytest.raises(MeasurementError, match=message):
        read(tmp_path, name, content)


def test_a_folder_of_something_else(tmp_path: Path) -> None:
    with pytest.raises(TorchslamError, match="neither images nor oxts"):
        read_fixes(tmp_path)
    with pytest.raises(TorchslamError, match="cannot be read"):
        read_fixes(tmp_path / "missing.csv")


def test_zeros_and_second_positions_of_a_time_are_left_out(tmp_path: Path) -> None:
    fixes = read(tmp_path, "a.csv", "time,lat,lon\n0,0,0\n1,48,11\n1,48,11\n2,48,11\n")
    assert len(fixes) == 2
    assert len(fixes.notes) == 2


def rows(fixes: Fixes) -> list[list[float]]:
    """Latitude, longitude and altitude, -1 if unknown."""
    return fixes.geodetic.nan_to_num(-1.0).tolist()


def test_values_for_unknown_ones_are_left_out_and_counted(tmp_path: Path) -> None:
    text = (
        "time,lat,lon,alt,horizontalAccuracy,verticalAccuracy\n0,-180,-180,0,-1,-1\n1,48,11,500,5,4\n"
        "2,48,11.1,-9999,5,0\n3,48,11.2,7,5,-1\n4,49,12,500,-1,4\n,48,11.3,501,5,3\n6,0.0,0.0,,,\n7,48,11.1,0,0,3\n"
    )
    fixes = read(tmp_path, "a.csv", text)
    assert rows(fixes) == [[48, 11, 500], [48, 11.1, -1], [48, 11.2, -1], [48, 11.1, -1]]
    assert [row[0] for row in fixes.std.nan_to_num(-1.0).tolist()] == [5, 5, 5, -1]
    places, times, heights = fixes.notes
    assert "left out 3 rows without a position: latitude 0 (1 times)" in places
    assert "left out 1 positions without a time" in times
    assert "3 altitudes are unknown: -9999 (1 times), 0 (1 times)" in heights
    late = read(tmp_path, "a.csv", "time,lat,lon\n1970-01-01T00:00:09Z,48,11\n2024-05-01T10:00:00Z,48,11\n")
    assert len(late) == 1


def test_a_side_of_the_equator_is_never_assumed(tmp_path: Path) -> None:
    text = "time,LATITUDE,N/S,LONGITUDE,E/W\n0,33.9,S,18.4,E\n1,33.9,,18.4,E\n2,-33.9,N,18.4,E\n3,33.8,s,18.4,W\n"
    fixes = read(tmp_path, "a.csv", text)
    assert rows(fixes) == [[-33.9, 18.4, -1], [-33.8, -18.4, -1]]
    assert "left out 2 rows" in fixes.notes[0]
    assert rows(read(tmp_path, "a.csv", "time,lat,lon\n0,33.9S,18.4E\n")) == [[-33.9, 18.4, -1]]
    for wrong in ("33.9,4.5E", "33.9S,18.4"):
        with pytest.raises(MeasurementError, match=r"a.csv:2: column l"):
            read(tmp_path, "a.csv", f"time,lat,lon\n0,{wrong}\n")
    no_side = NMEA.replace("4807.038,N", "4807.038,", 1)
    assert len(read(tmp_path, "a.nmea", with_sums(no_side))) == 1


def test_images_without_a_hemisphere_are_left_out(tmp_path: Path) -> None:
    for index, (north, east) in enumerate([("S", "E"), (None, "E"), ("S", "?"), (b"s\x00", "W\0")]):
        image = Image.fromarray(np.zeros((8, 8), np.uint8))
        exif = image.getexif()
        block = {1: north, 2: (33.0, 30.0, 0.0), 3: east, 4: (18.0, 0.0, 0.0), 5: 1, 6: 20.0}
        exif.get_ifd(0x8825).update({tag: value for tag, value in block.items() if value is not None})
        image.save(tmp_path / f"{index}.jpg", exif=exif)
    fixes = read_fixes(tmp_path)
    assert (fixes.names, rows(fixes)) == (("0.jpg", "3.jpg"), [[-33.5, 18, -20], [-33.5, -18, -20]])
    assert "2 images have a position without a hemisphere (GPSLatitudeRef)" in fixes.notes[0]
    for name in fixes.names:
        (tmp_path / name).unlink()
    with pytest.raises(MeasurementError, match=r"no position in it.*without a hemisphere"):
        read_fixes(tmp_path)


def test_the_height_that_moves_with_the_drone_counts(tmp_path: Path) -> None:
    cue = "{0}\n00:00:0{0},000 --> 00:00:0{0},900\n[latitude: 59.{0}] [longitude: 18,{0}] [rel_alt: {1} abs_alt: {2}]\n"
    for heights, expected in (
        ([("1.5", "130.0"), ("2.5", "130.0"), ("3.5", "130.0")], [1.5, 2.5, 3.5]),
        ([("1.5", "131.5"), ("2.5", "132.5"), ("3.5", "133.5")], [131.5, 132.5, 133.5]),
        ([("0.0", "131.5"), ("0.0", "132.5"), ("0.0", "133.5")], [131.5, 132.5, 133.5]),
        ([("1.5", "0.000"), ("1.5", "0.000"), ("1.6", "0.000")], [1.5, 1.5, 1.6]),
    ):
        text = "\n".join(cue.format(row, *pair) for row, pair in enumerate(heights))
        assert read(tmp_path, "a.srt", text).geodetic[:, 2].tolist() == expected


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("[latitude: 59,302335] [longitude: -1.5e-05] [altitude: 3]", [59.302335, -1.5e-5, 3]),
        ("GPS(-1.5e-05,59.3,16) BAROMETER:-2.5", [59.3, -1.5e-5, -2.5]),
        ("GPS(18.1,59.3,16)", [59.3, 18.1, -1]),
        ("GPS (18.1, 59.3, 132.5)", [59.3, 18.1, 132.5]),
    ],
)
def test_numbers_of_subtitles_are_read_whole(tmp_path: Path, text: str, place: list[float]) -> None:
    assert rows(read(tmp_path, "a.srt", f"1\n00:00:00,000 --> 00:00:01,000\n{text}\n")) == [place]


@pytest.mark.parametrize(
    "text", ["[latitude: 4.5e] [longitude: 1]", "GPS(18,1,59,3,16)", "GPS(W: 1, N: 2, 3)"]
)
def test_numbers_of_subtitles_are_refused_with_their_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(MeasurementError, match=r"a.srt:2: "):
        read(tmp_path, "a.srt", f"1\n00:00:00,000 --> 00:00:01,000\n{text}\n")


def test_points_without_a_time_or_an_altitude(tmp_path: Path) -> None:
    point = '<trkpt lat="{}" lon="-11.5">{}</trkpt>'
    time = "<time>2024-05-01T10:00:0{}Z</time>"
    bodies = (
        "<time/>",
        "",
        "<ele/>" + time.format(2),
        "<ele>-32768</ele>" + time.format(3),
        "<ele>5</ele>" + time.format(4),
    )
    text = "".join(point.format(f"48.{row}", body) for row, body in enumerate(bodies))
    text += point.format("", time.format(5)) + point.format("48.6", "<fix>none</fix>" + time.format(6))
    fixes = read(tmp_path, "a.gpx", f"<gpx>{text}</gpx>")
    assert rows(fixes) == [[48.2, -11.5, -1], [48.3, -11.5, -1], [48.4, -11.5, 5]]
    assert "left out 2 rows without a position" in fixes.notes[0]
    assert "left out 2 positions without a time" in fixes.notes[1]


GGA = "$GPGGA,{},4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*%s\n"
RMC = "$GPRMC,{},A,4807.038,N,01131.000,E,022.4,084.4,{},003.1,W*%s\n"


@pytest.mark.parametrize(
    ("lines", "times"),
    [
        (
            ["G235958", "G000001", "R000002 240324", "G000002"],
            [(23, 23, 59, 58), (24, 0, 0, 1), (24, 0, 0, 2)],
        ),
        (["G100000", "R100000 230324", "G100000.5", "G100000", "R100000 260324"], None),
        (
            ["G100000", "R100000 230324", "G120000", "G100000.2", "R100000.2 260324"],
            [(23, 10, 0, 0), (23, 12, 0, 0), (26, 10, 0, 0.2)],
        ),
        (["G100000", "Z100000 23,03,2024", "G100001"], [(23, 10, 0, 0), (23, 10, 0, 1)]),
        (["G100000", "R100000 060180", "G100001", "R100001 230324"], [(23, 10, 0, 0), (23, 10, 0, 1)]),
    ],
)
def test_dates_of_nmea(tmp_path: Path, lines: list[str], times: list[tuple[float, ...]] | None) -> None:
    """They count backwards, over midnight, and anew after a pause of days."""
    text = ""
    for line in lines:
        clock, _, date = line[1:].partition(" ")
        zda = f"$GPZDA,{clock},{date},00,00*%s\n"
        text += {"G": GGA.format(clock), "R": RMC.format(clock, date), "Z": zda}[line[0]]
    if times is None:  # a clock that is set back within a day
        times = [(23, 10, 0, 0), (23, 10, 0, 0.5), (26, 10, 0, 0)]
    found = read(tmp_path, "a.nmea", with_sums(text)).timestamps
    assert found is not None
    assert found.tolist() == pytest.approx([utc(2024, 3, *each[:3]) + each[3] for each in times])


def test_sentences_of_a_receiver_without_a_fix_are_left_out(tmp_path: Path) -> None:
    text = GGA.format("100000") + RMC.format("100000", "230324").replace(",A,", ",V,") + GGA.format("100001")
    assert len(read(tmp_path, "a.nmea", with_sums(text))) == 1
    for wrong, words in (("246100", "not a time"), ("100000", "not a latitude")):
        line = GGA.format(wrong).replace("4807", "4890" if wrong == "100000" else "4807")
        with pytest.raises(MeasurementError, match=rf"a.nmea:1: `.*` is {words}"):
            read(tmp_path, "a.nmea", with_sums(line))
