"""Files of positions, speeds, inertial samples and depth with changes of known meaning: read rightly, or refused.

Each is a table of true values, written by the habits of one kind of device, with some cells that are unknown, cut, in
another unit or country's notation. `truth.json` says which rows must come out, and whether a refusal is right as well.
"""

from __future__ import annotations

import datetime
import io
import json
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from tests.data.formats.test_fix_files import with_sums
from tests.fuzz.mutators import Files
from torchslam.data.formats.depth_images import find_depth_images, read_depth
from torchslam.data.formats.fix_files import read_fixes
from torchslam.data.formats.vehicle_files import read_speeds
from torchslam.data.inertial import read_imu
from torchslam.errors import TorchslamError

TRUTH = "truth.json"
WORDS = ["", "nan", "NaN", "null", "NA", "-", "N/A", "None", "-nan(ind)", "unknown"]
"""For an unknown number, in files whose cells may be empty."""
CUT = ["4.5e", "48.1.2", "48..1", "1_0", "4 8", "x", "--3", "0x10", "1,2,3", "٣", "5e+", "12,345"]
"""What no number is, or none that is clear."""
UNKNOWN_PLACES = [
    (0.0, 0.0),
    (-180.0, -180.0),
    (999.0, 999.0),
    (-9999.0, -9999.0),
    (91.0, 181.0),
    (214.7483647,) * 2,
]
UNKNOWN_HEIGHTS = [-9999.0, -32768.0, 9999.9, 99999.0, -1e38, 65535.0]
"""Also where the height is known to be far from 0."""
UNKNOWN_SPEEDS = [-1.0, -9999.0, 999.99, -999.0, 655.35]
SPEED_UNITS = {
    "": 1.0,
    " [m/s]": 1.0,
    "_km_h": 1 / 3.6,
    " (km/h)": 1 / 3.6,
    " (mph)": 0.44704,
    " [kn]": 1852 / 3600,
}


class Track:
    """Rows of time, latitude, longitude and altitude; NaN where a device does not know one."""

    def __init__(self, rng: random.Random, absolute: bool | None = None) -> None:
        self.rng, count = rng, rng.randrange(5, 25)
        absolute = rng.random() < 0.5 if absolute is None else absolute
        self.start = rng.randrange(1_500_000_000, 1_790_000_000) if absolute else rng.choice((0, 100))
        latitude, longitude = rng.uniform(-80, 80), rng.uniform(-179, 179)
        height = rng.choice((rng.uniform(30, 3000), rng.uniform(-300, -30)))
        self.rows: list[list[float]] = []
        for row in range(count):
            latitude += rng.choice((1, -1)) * rng.uniform(2e-5, 2e-4)
            longitude += rng.choice((1, -1)) * rng.uniform(2e-5, 2e-4)
            height += rng.uniform(-0.4, 0.4)
            self.rows.append([self.start + row, round(latitude, 6), round(longitude, 6), round(height, 2)])
        self.verdict = "read"
        self.lost: set[int] = set()

    def pick(self, share: float = 0.3) -> list[int]:
        """Some of the rows, never all."""
        return self.rng.sample(
            range(1, len(self.rows)), self.rng.randrange(0, max(2, int(share * len(self.rows))))
        )

    def expected(self, columns: int = 4) -> list[list[float | None]]:
        """The rows that must come out."""
        rows = [row[:columns] for at, row in enumerate(self.rows) if at not in self.lost]
        return [[None if math.isnan(value) else value for value in row] for row in rows]


def _number(value: float, rng: random.Random, comma: bool = False) -> str:
    """A number in one of the ways in which programs write it."""
    text = rng.choice([f"{value:.7f}", repr(value), f"{value:.9e}", f"{value:+.7f}"])
    return text.replace(".", ",") if comma else text


def _with_truth(name: str, text: str | bytes, track: Track, rows: list[Any]) -> Files:
    truth = {"verdict": track.verdict, "rows": rows}
    content = text if isinstance(text, bytes) else text.encode()
    return {name: content, TRUTH: json.dumps(truth).encode()}


def _iso(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat().replace("+00:00", "Z")


def _table(header: list[str], rows: list[list[str]], rng: random.Random, comma: bool = False) -> str:
    """A table as spreadsheets, R, ROS or a hand write it."""
    order = rng.sample(range(len(header)), len(header))
    header, rows = [header[at] for at in order], [[row[at] for at in order] for row in rows]
    mark = rng.choice(";\t" if comma else ",,;\t")
    style = rng.choice(
        ["plain", "quoted", "all", "names", "named rows", "lines", "comment", "excel", "spaced"]
    )
    if style in ("quoted", "all", "names", "named rows"):
        header = [f'"{name}"' for name in header]
    if style == "all" or comma:
        rows = [[f'"{cell}"' for cell in row] for row in rows]
    if style in ("names", "named rows"):
        rows = [[f'"{at + 1}"', *row] for at, row in enumerate(rows)]
        header = header if style == "named rows" else ['""', *header]
    lines = [mark.join(cells) for cells in (header, *rows)]
    if style == "lines" and not comma:
        lines = [f'"{line}"' for line in lines]
    if style == "comment":
        lines = ["# of a logger", rng.choice(("#", "# ", "")) + lines[0], *lines[1:]]
    if style == "excel":
        lines.insert(0, f"sep={mark}")
    if style == "spaced":
        lines = ["", *(line + rng.choice(("", mark)) for line in lines), ""]
        lines[1] = lines[1].rstrip(mark)
    return rng.choice(("", "\ufeff")) + rng.choice(("\n", "\r\n")).join(lines) + "\n"


def _damage(rows: list[list[str]], column: int, track: Track) -> None:
    """One cell that is no number: the file must be refused."""
    rows[track.rng.randrange(len(rows))][column] = track.rng.choice(CUT)
    track.verdict = "refused"


def csv(rng: random.Random) -> Files:
    """A table of positions."""
    track, comma = Track(rng), rng.random() < 0.15
    unit, factor = rng.choice(
        [("", 1.0), (" [m]", 1.0), ("_ft", 0.3048), (" (feet)", 0.3048), (" [km]", 1000.0)]
    )
    clock = rng.choice(["seconds", "ms", "iso"] if track.start > 1e8 else ["seconds", "ms"])
    start = rng.choice(["", "", "location", "GPS ", "field."])
    degrees = rng.choice(["", " (deg)", " [°]"])
    names = rng.choice([("latitude", "longitude"), ("Lat", "Lon"), ("LATITUDE", "LONGITUDE")])
    header = [rng.choice(["time", "Timestamp"]) + {"seconds": "", "ms": " [ms]", "iso": ""}[clock]]
    header += [f"{start}{names[0]}{degrees}", f"{start}{names[1]}{degrees}", f"{start}altitude{unit}"]
    accuracy, refs = rng.random() < 0.4, rng.random() < 0.25
    header += ["horizontalAccuracy", "verticalAccuracy"] if accuracy else []
    header += rng.choice([["N/S", "E/W"], ["GPSLatitudeRef", "GPSLongitudeRef"]]) if refs else []
    written = [[*row, 4.0, 6.0] for row in track.rows]
    texts: dict[tuple[int, int], str] = {}
    for at in track.pick():
        kind = rng.randrange(6)
        if kind == 0:
            written[at][1:3] = rng.choice(UNKNOWN_PLACES)
            track.lost.add(at)
        elif kind == 1:
            texts[at, rng.choice((0, 1, 2))] = rng.choice(WORDS)
            track.lost.add(at)
        elif kind == 2:
            written[at][3] = rng.choice([*UNKNOWN_HEIGHTS, 0.0, -1.0 if track.rows[0][3] > 0 else 0.0])
            written[at][3] *= factor if rng.random() < 0.5 else 1.0
            track.rows[at][3] = math.nan
        elif kind == 3:
            texts[at, 3] = rng.choice(WORDS)
            track.rows[at][3] = math.nan
        elif kind == 4 and accuracy:
            written[at][rng.choice((4, 4, 5))] = -1.0
            track.lost |= {at} if written[at][4] < 0 else set()
            track.rows[at][3] = math.nan
        elif kind == 5 and refs:
            texts[at, rng.choice((6, 7))] = ""
            track.lost.add(at)
    if track.start > 1e8 and rng.random() < 0.2:
        written[0][0] = rng.choice((0.0, 315964800.0))
        track.lost.add(0)
    cells = []
    for at, row in enumerate(written):
        time = {"seconds": repr(row[0]), "ms": f"{1000 * row[0]:.3f}", "iso": _iso(row[0])}[clock]
        time = time.replace(".", ",") if comma else time
        sides = ["NS"[row[1] < 0], "EW"[row[2] < 0]]
        place = [abs(value) if refs else value for value in row[1:3]]
        numbers = [_number(value, rng, comma) for value in (*place, row[3] / factor)]
        extra = [f"{value:g}" for value in row[4:6]] if accuracy else []
        line = [time, *numbers, *extra, *(sides if refs else [])]
        for (row_at, column), text in texts.items():
            if row_at == at:
                line[column if column < 6 else column - 8 + len(line)] = text
        cells.append(line)
    if comma:
        track.verdict = "either"  # three decimals after a comma may be a thousand
    elif rng.random() < 0.1:
        _damage(cells, rng.choice((1, 2)), track)
    elif rng.random() < 0.05 and abs(track.rows[0][2]) > 91:
        for line in cells:
            line[1], line[2] = line[2], line[1]
        track.verdict = "refused"
    elif rng.random() < 0.05:
        header[3], track.verdict = f"{start}altitude [furlong]", "refused"
    return _with_truth("a.csv", _table(header, cells, rng, comma), track, track.expected())


def gpx(rng: random.Random) -> Files:
    """Points of a track."""
    track, points = Track(rng, absolute=True), []
    track.lost = set(track.pick(0.2))
    heights = set(track.pick(0.2))
    damaged = rng.randrange(len(track.rows)) if rng.random() < 0.1 else -1
    for at, (time, latitude, longitude, height) in enumerate(track.rows):
        lat, lon, more = _number(latitude, rng), _number(longitude, rng), ""
        moment = f"<time>{_iso(time)}</time>"
        if at in track.lost and at != damaged:
            kind = rng.randrange(4)
            moment = rng.choice(("", "<time/>", "<time>1970-01-01T00:00:00Z</time>")) if kind == 0 else moment
            lat = rng.choice(("", "nan")) if kind == 1 else lat
            more = "<fix>none</fix>" if kind == 2 else ""
            lat, lon = map(str, rng.choice(UNKNOWN_PLACES)) if kind == 3 else (lat, lon)
        ele = f"<ele>{_number(height, rng)}</ele>"
        if at in heights:
            ele = rng.choice(
                ("", "<ele/>", "<ele></ele>", "<ele>-32768</ele>", "<ele>NaN</ele>", "<ele>0.0</ele>")
            )
            track.rows[at][3] = math.nan
        lat = rng.choice(CUT) if at == damaged else lat
        points.append(f'<trkpt lat="{lat}" lon="{lon}">{ele}{moment}{more}</trkpt>')
    track.verdict = "refused" if damaged >= 0 else "read"
    names = rng.choice(("", ' xmlns="http://www.topografix.com/GPX/1/1"'))
    text = f"<gpx{names}><trk><trkseg>{rng.choice(('', chr(10))).join(points)}</trkseg></trk></gpx>"
    return _with_truth("a.gpx", text, track, track.expected())


def nmea(rng: random.Random) -> Files:
    """Sentences of GGA with RMC or ZDA; over midnight, over several days, dates from the middle on, or none."""
    track, lines = Track(rng, absolute=True), list[str]()
    midnight = track.start - track.start % 86400
    track.start = midnight + rng.choice((36000, 86400 - rng.randrange(1, 6)))
    dated = rng.choice(["all", "late", "none", "rare"])
    gap = rng.choice((0, 0, 86400, 3 * 86400 + 5000)) if dated == "all" else 0
    kinds = rng.choice((("GGA", "RMC"), ("RMC", "GGA"), ("GGA", "ZDA"), ("RMC",)))
    if kinds == ("RMC",):
        dated, gap = "all", 0
    first_date = rng.randrange(1, len(track.rows))
    track.lost = set(track.pick(0.2))
    damaged = rng.randrange(len(track.rows)) if rng.random() < 0.1 else -1
    for at, row in enumerate(track.rows):
        row[0] = track.start + at + (gap if at > len(track.rows) // 2 else 0)
        moment = datetime.datetime.fromtimestamp(row[0], datetime.UTC)
        clock = moment.strftime("%H%M%S") + rng.choice(("", ".00", ".000"))
        has_date = dated == "all" or (
            dated != "none" and (at == first_date or (dated == "late" and at > first_date))
        )
        sides = ["NS"[row[1] < 0], "EW"[row[2] < 0]]
        places = [
            f"{int(abs(v)):0{n}d}{abs(v) % 1 * 60:09.6f}" for v, n in zip(row[1:3], (2, 3), strict=True)
        ]
        if any(place[-9:].startswith("60") for place in places):
            track.lost.add(at)
        quality, status, talker = "1", "A", rng.choice(("GP", "GN"))
        kind = rng.randrange(4) if at in track.lost else -1
        if kind == 0:
            sides[rng.randrange(2)] = ""
        elif kind == 1:
            places = ["", ""]
        elif kind >= 2:
            quality, status = "0", "V"
        places[0] = rng.choice(("48.1x", "4890.0", "1_0", "48,1", "4807.0.1")) if at == damaged else places[0]
        if at == damaged:
            quality, status, sides[0] = "1", "A", "N"
        place = f"{places[0]},{sides[0]},{places[1]},{sides[1]}"
        height = f"{row[3]:.2f}"
        if at not in track.lost and rng.random() < 0.1:
            height = rng.choice(("", "-9999.0", "99999.0", "0.0"))
            row[3] = math.nan
        date = moment.strftime("%d%m%y") if has_date else ""
        sentence = {
            "GGA": f"${talker}GGA,{clock},{place},{quality},08,0.9,{height},M,46.9,M,,*%s",
            "RMC": f"${talker}RMC,{clock},{status},{place},0.4,84.4,{date},,,A*%s",
            "ZDA": f"${talker}ZDA,{clock},{moment.strftime('%d,%m,%Y') if has_date else ',,'},00,00*%s",
        }
        lines += [sentence[kind] for kind in kinds] + ["$GPGSV,1,1,01,01,40,083,46*%s"]
        if kinds == ("RMC",):
            row[3] = math.nan
    rows = track.expected()
    if dated == "none":  # seconds since midnight
        rows = [[row[0] - midnight, *row[1:]] for row in rows if row[0] is not None]
    track.verdict = "refused" if damaged >= 0 else "read"
    return _with_truth("a.nmea", with_sums("\n".join(lines)), track, rows)


def subtitles(rng: random.Random) -> Files:
    """Cues in the layouts of drones."""
    track, cues = Track(rng, absolute=False), []
    layout = rng.choice(["two heights", "still height", "one height", "tuple", "mini", "matrice"])
    comma = rng.random() < 0.2 and layout in ("two heights", "one height")
    ground = rng.uniform(100, 500)
    late = rng.randrange(0, 4)
    for at, row in enumerate(track.rows):
        row[0] = float(at)
        latitude, longitude, height = row[1:]
        if at < late:
            latitude = longitude = 0.0
            track.lost.add(at)
        lat, lon, high = (_number(value, rng, comma) for value in (latitude, longitude, height))
        over = f"{height - ground:.3f}"
        body = {
            "two heights": f"[latitude: {lat}] [longitude: {lon}] [rel_alt: {over} abs_alt: {high}]",
            "still height": f"[latitude : {lat}] [longtitude : {lon}] [rel_alt: {high} abs_alt: {ground:.3f}]",
            "one height": f"[latitude: {lat}] [longitude: {lon}] [altitude: {high}]",
            "tuple": f"HOME(1.0,2.0)\nGPS({lon},{lat},{rng.randrange(5, 25)}) BAROMETER:{high}",
            "mini": f"F/2.8, GPS ({lon}, {lat}, 18), D 2.80m, H {height:.2f}m, H.S 0.00m/s, V.S 0.00m/s",
            "matrice": f"GPS({lat}, {lon}, {high}M)",
        }[layout]
        cues.append(f"{at + 1}\n00:00:{at:02d},000 --> 00:00:{at + 1:02d},000\n[iso : 100] {body}\n")
    if comma:
        track.verdict = "either"
    elif rng.random() < 0.1:
        at = rng.randrange(late, len(cues))
        cues[at] = cues[at].replace(
            _first_number(cues[at], layout), rng.choice(["4.5e", "48.1.2", "1_0", "x"]), 1
        )
        track.verdict = "refused"
    return _with_truth("a.srt", "\n".join(cues), track, track.expected())


def _first_number(cue: str, layout: str) -> str:
    begin = cue.index("GPS") + 3 if "GPS" in cue else cue.index(":", cue.index("latitude")) + 1
    text = cue[begin:].lstrip(" (")
    return text[: min(text.find(mark) for mark in ",]" if mark in text)]


def exif(rng: random.Random) -> Files:
    """Images with positions, by their names."""
    track, files = Track(rng), dict[str, bytes]()
    names = [f"{at:03d}.jpg" for at in range(len(track.rows))]
    track.lost = set(track.pick(0.4))
    for at, (_, latitude, longitude, height) in enumerate(track.rows):
        image, content = Image.fromarray(np.zeros((8, 8), np.uint8)), io.BytesIO()
        values = [
            (int(v), int(v % 1 * 60), round(v * 60 % 1 * 60, 5)) for v in (abs(latitude), abs(longitude))
        ]
        block: dict[int, Any] = {1: "NS"[latitude < 0], 2: values[0], 3: "EW"[longitude < 0], 4: values[1]}
        block |= {5: bytes([height < 0]), 6: abs(height)}
        if rng.random() < 0.3:
            block[1], block[3] = block[1].lower(), block[3] + "\0"
        if at in track.lost:
            kind = rng.randrange(5)
            tag = rng.choice((1, 3))
            if kind == 0:
                del block[tag]
            elif kind == 1:
                block[tag] = rng.choice(("", " ", "x", "?"))
            elif kind == 2:
                block[2] = block[4] = (0.0, 0.0, 0.0)
            elif kind == 3:
                block[2] = (IFDRational(0, 0),) * 3
            else:
                del block[rng.choice((2, 4))]
        elif rng.random() < 0.1:
            block[6] = rng.choice((0.0, IFDRational(0, 0), 65535.0 if height > 0 else 0.0))
            track.rows[at][3] = math.nan
        exif_data = image.getexif()
        exif_data.get_ifd(0x8825).update(block)
        image.save(content, "JPEG", exif=exif_data)
        files[names[at]] = content.getvalue()
    rows = list[Any]()
    for at, row in enumerate(track.rows):
        if at not in track.lost:
            rows.append([names[at], *(None if math.isnan(value) else value for value in row[1:])])
    return files | {TRUTH: json.dumps({"verdict": "read", "rows": rows}).encode()}


def speeds(rng: random.Random) -> Files:
    """A table of speeds, or two numbers a line."""
    track, (unit, factor) = Track(rng), rng.choice(list(SPEED_UNITS.items()))
    comma = rng.random() < 0.1
    driven = [rng.uniform(2, 12) for _ in track.rows]
    if rng.random() < 0.2:  # backs up
        driven[: len(driven) // 3] = [-rng.uniform(1.1, 1.9) for _ in driven[: len(driven) // 3]]
    driven = [round(value, 5) for value in driven]
    lines = []
    lost = set(track.pick())
    for at, (row, speed) in enumerate(zip(track.rows, driven, strict=True)):
        text = _number(speed / factor, rng, comma)
        row[1] = abs(speed)
        if at in lost:
            track.lost.add(at)
            missing = rng.choice(
                UNKNOWN_SPEEDS if min(driven) > 0 else UNKNOWN_SPEEDS[1:]
            )  # -1 is one that backs up
            text = rng.choice([*WORDS, *[f"{missing:g}", f"{missing / factor:.4f}"] * 5])
        lines.append([f"{row[0]:g}" if row[0] < 1e6 else repr(row[0]), text])
    header = ["time", rng.choice(("speed", "GPS speed", "Velocity")) + unit]
    if rng.random() < 0.1:
        _damage(lines, 1, track)
    if comma and track.verdict == "read":
        track.verdict = "either"
    if unit == "" and not comma and track.verdict == "read" and rng.random() < 0.3 and "" not in lines[0]:
        text = "\n".join(",".join(line) for line in lines) + "\n"
    else:
        text = _table(header, lines, rng, comma)
    return _with_truth("v.csv", text, track, track.expected(2))


def inertial(rng: random.Random) -> Files:
    """A table of an inertial sensor."""
    track = Track(rng)
    turn, turn_factor = rng.choice(
        [("", 1.0), (" [rad/s]", 1.0), (" [deg/s]", math.pi / 180), ("_dps", math.pi / 180)]
    )
    force, force_factor = rng.choice([("", 1.0), (" (m/s²)", 1.0), (" [g]", 9.80665), (" [mg]", 9.80665e-3)])
    time, per_second = rng.choice(
        [("time [s]", 1.0), ("time_ms", 1e3), ("timestamp (us)", 1e6), ("#timestamp [ns]", 1e9)]
    )
    header = [time, *(f"gyro_{axis}{turn}" for axis in "xyz"), *(f"acc_{axis}{force}" for axis in "xyz")]
    rows, lines = list[list[float]](), list[list[str]]()
    track.lost = set(track.pick())
    for at in range(len(track.rows)):
        rates = [round(rng.uniform(-1, 1), 4) for _ in range(3)]
        forces = [
            round(value, 4) for value in (rng.gauss(0, 0.3), 9.8 + rng.gauss(0, 0.3), rng.gauss(0, 0.3))
        ]
        seconds = round(track.start + 0.01 * at, 2)
        cells = [
            f"{round(seconds * 1e9) / (1e9 / per_second):.10g}"
            if per_second < 1e6
            else str(round(seconds * per_second))
        ]
        cells[0] = repr(round(seconds * per_second, 3)) if per_second < 1e6 else cells[0]
        cells += [repr(value / turn_factor) for value in rates] + [
            repr(value / force_factor) for value in forces
        ]
        if at in track.lost:
            if rng.random() < 0.3:
                cells[4:] = ["0", "0.0", "0"]
            else:
                cells[rng.randrange(1, 7)] = rng.choice([*WORDS, "-9999", "99999", "-32768"])
        rows.append([seconds, *rates, *forces])
        lines.append(cells)
    if rng.random() < 0.1:
        _damage(lines, rng.randrange(1, 7), track)
    if header[0].startswith("#"):
        text = "\n".join(",".join(line) for line in (header, *lines)) + "\n"
    else:
        text = _table(header, lines, rng)
    kept = [row for at, row in enumerate(rows) if at not in track.lost]
    return _with_truth("imu.csv", text, track, kept)


def depth(rng: random.Random) -> Files:
    """A folder with a depth image."""
    values = np.random.default_rng(rng.randrange(1 << 30)).uniform(0.5, 8, (6, 8)).round(3)
    unknown = np.random.default_rng(rng.randrange(1 << 30)).random((6, 8)) < 0.2
    kind = rng.choice(
        ["u16.png", "u16.tif", "u16.npy", "f32.tif", "f32.npy", "f64.npy", "f32.pfm", "u8.png", "mm.npy"]
    )
    truth = np.where(unknown, 0, values)
    if kind.startswith("u16"):
        written: Any = np.where(unknown, rng.choice((0, 65535)), 1000 * values).round().astype(np.uint16)
    elif kind == "u8.png":
        written = (10 * values).astype(np.uint8)
    else:
        written = np.where(unknown, rng.choice((0.0, -1.0, np.nan, np.inf, 65504.0, 1e10)), values)
        written = (1000 if kind == "mm.npy" else 1) * written.astype(
            np.float64 if kind == "f64.npy" else np.float32
        )
    name, content = f"0.{kind.split('.')[1]}", io.BytesIO()
    if name.endswith(".npy"):
        np.save(content, written)
    else:
        content.write(cv2.imencode(f".{kind.split('.')[1]}", written)[1].tobytes())
    verdict = "refused" if kind in ("u8.png", "mm.npy") else "read"
    return {
        name: content.getvalue(),
        TRUTH: json.dumps({"verdict": verdict, "rows": truth.tolist()}).encode(),
    }


def _fixes(root: Path) -> list[list[Any]]:
    path = next((path for path in root.iterdir() if path.suffix in (".csv", ".gpx", ".nmea", ".srt")), root)
    fixes = read_fixes(path)
    keys = fixes.names if fixes.timestamps is None else fixes.timestamps.tolist()
    return [[key, *row] for key, row in zip(keys, fixes.geodetic.tolist(), strict=True)]


def _speeds(root: Path) -> list[list[Any]]:
    found = read_speeds(root / "v.csv")
    return [list(row) for row in zip(found.timestamps.tolist(), found.speeds.tolist(), strict=True)]


def _inertial(root: Path) -> list[list[Any]]:
    found = read_imu(root / "imu.csv")
    columns = (found.timestamps[:, None].numpy(), found.gyroscope.numpy(), found.accelerometer.numpy())
    return np.concatenate(columns, axis=1).tolist()


def _depth(root: Path) -> list[list[Any]]:
    images = find_depth_images(root)
    return read_depth(images.paths[0], images.units_per_meter).tolist()


VALUES: dict[str, tuple[Callable[[random.Random], Files], Callable[[Path], list[list[Any]]], int]] = {
    "csv": (csv, _fixes, 5500),
    "gpx": (gpx, _fixes, 3000),
    "nmea": (nmea, _fixes, 3500),
    "srt": (subtitles, _fixes, 2500),
    "exif": (exif, _fixes, 500),
    "speeds": (speeds, _speeds, 3000),
    "imu": (inertial, _inertial, 1500),
    "depth": (depth, _depth, 500),
}
"""What makes a file of each kind, what reads it, and how many of 30,000 inputs it gets."""


def check(root: Path, kind: str) -> None:
    """Raise AssertionError for a value that is not the right one, a missing row, or a file that must be refused."""
    truth = json.loads((root / TRUTH).read_text())
    (root / TRUTH).unlink()
    try:
        found = VALUES[kind][1](root)
    except TorchslamError as error:
        if truth["verdict"] == "read":
            raise AssertionError(f"is right, but refused: {error}") from error
        raise
    assert truth["verdict"] != "refused", f"read as {found[:3]}"
    rows = truth["rows"]
    assert len(found) == len(rows), f"{len(found)} rows, not {len(rows)}"
    for row, right in zip(found, rows, strict=True):
        for value, expected in zip(row, right, strict=True):
            if expected is None or isinstance(expected, str):
                assert value == expected or (expected is None and math.isnan(value)), f"{row}, not {right}"
            else:
                assert math.isclose(value, expected, rel_tol=3e-9, abs_tol=2e-5), f"{row}, not {right}"
