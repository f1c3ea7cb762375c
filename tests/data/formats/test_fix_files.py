"""Files of positions: every layout by an example made by hand, and what may be wrong in them."""

from __future__ import annotations

import datetime
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchslam.data.formats.fix_files import Fixes, read_fixes
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
