"""Files of positions: CSV with a header, GPX, NMEA, DJI's .SRT, the images' own EXIF, KITTI's oxts."""

from __future__ import annotations

import math
import operator
import os
import re
from collections.abc import Iterator
from functools import partial, reduce
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from torchslam.data.fields import POSITION_COLUMNS
from torchslam.data.fixes import NUMBERS, Fix, Fixes, checked_fixes, signed_degrees
from torchslam.data.formats.frame_names import find_frames
from torchslam.data.formats.image_file import SUFFIXES, exif_block
from torchslam.data.formats.vehicle_files import oxts_folder, read_oxts
from torchslam.data.tables import read_table
from torchslam.data.text_file import CLOCK_SET, MAX_LINE, parse_known, parse_moment, read_text
from torchslam.errors import FrameError, MeasurementError


def read_fixes(path: str | Path) -> Fixes:
    """The positions of a file, by its suffix: .srt, .gpx, .nmea, .csv or .txt, a folder of images, or one of oxts.

    Raises MeasurementError naming file and line.
    """
    path = Path(path)
    if os.path.isdir(path):  # Path.is_dir raises for a name that is too long
        oxts = oxts_folder(path)
        return read_image_fixes(path) if oxts is None else checked_fixes(path, _oxts_rows(oxts))
    suffix = path.suffix.lower()
    if suffix in (".srt", ".gpx"):
        return checked_fixes(path, _srt_rows(path) if suffix == ".srt" else _gpx_rows(path))
    if suffix in SUFFIXES:
        raise MeasurementError(f"{path}: one image; give the folder of all, whose EXIF has the positions")
    text = read_text(path, MeasurementError)
    if suffix == ".nmea" or text.lstrip().startswith(("$G", "$B")):
        return _read_nmea(path, text)
    return checked_fixes(path, _csv_rows(path))


def _csv_rows(path: Path) -> Iterator[Fix]:
    for row in read_table(path, POSITION_COLUMNS, MeasurementError):
        moment = row.time()
        if moment is None and "name" not in row.cells:
            raise MeasurementError(f"{row.where}: neither a `time` nor the `name` of an image")
        if "latitude" not in row.units and "longitude" not in row.units and "altitude" in row.units:
            raise MeasurementError(f"{row.where}: no `latitude` and `longitude`, in degrees")
        texts = [row.cells.get(name, "") for name in NUMBERS[:2]]
        sides = [row.cells.get(side, "") if side in row.units else None for side in ("north", "east")]
        if texts[0][-1:] in ("N", "S") and texts[1][-1:] in ("E", "W"):  # E alone may be that of an exponent
            texts, sides = [text[:-1] for text in texts], [text[-1] for text in texts]
        latitude, longitude = (
            degrees if side is None else signed_degrees(degrees, side, letters)
            for degrees, side, letters in zip(
                map(row.number, NUMBERS, texts), sides, ("NS", "EW"), strict=True
            )
        )
        std = row.number("std_horizontal"), row.number("std_vertical")
        name, altitude = row.cells.get("name", ""), row.number("altitude")
        yield Fix(row.where, latitude, longitude, altitude, moment, name, std)


_TOKEN = r"[ \t]*([^\s\[\]();]+?)[mM]?,?(?=[\s\[\]();]|$)"
BRACKETS = [re.compile(rf"\b{word}[ \t]*:{_TOKEN}") for word in ("[Ll]atitude", "[Ll]ongt?itude")]
"""`[latitude: 59.30] [longitude: 18.20] [rel_alt: 1.3 abs_alt: 132.9]`; some models write `longtitude`."""
TUPLE = re.compile(r"\bGPS[ \t]*\(([^)]*)\)")
"""`GPS(longitude,latitude,satellites or altitude)`; the Matrice's has latitude first and its altitude ends with M."""
HEIGHTS = [
    re.compile(rf"\b{word}{_TOKEN}")
    for word in ("abs_alt[ \t]*:", "altitude[ \t]*:", "rel_alt[ \t]*:", "BAROMETER[ \t]*:", "H[ \t]")
]
"""In the order in which they count if they move with the drone; the last ones are over the start."""
MOST_SATELLITES = 60.0  # that a receiver may count; a whole number below in place of an altitude is one


def _srt_rows(path: Path) -> Iterator[Fix]:
    """A position for each cue in which it is another one, at its beginning, on the clock of the video.

    A receiver has 1 to 10 positions a second, and each is repeated in the cues of all frames until the next. Of several
    heights that one counts which changes most often.
    """
    cues = [
        (where, time, *found) for where, time, text in _cues(path) if (found := _srt_position(text, where))
    ]
    known = POSITION_COLUMNS["altitude"].known
    columns = [known(column)[0] for column in zip(*(cue[4] for cue in cues), strict=True)]
    changes = [len(np.unique(column[~np.isnan(column)])) - 1 for column in columns]
    best = next((row for row, count in enumerate(changes) if count >= max(changes) / 2 and count >= 0), 0)
    before: tuple[float, float, float] | None = None
    for where, time, latitude, longitude, heights in cues:
        place = latitude, longitude, heights[best]
        if place != before:
            yield Fix(where, *place, time=time)
        before = place


def _cues(path: Path) -> Iterator[tuple[str, float, str]]:
    """Place, beginning in seconds and text of each subtitle."""
    where, begin, text = "", 0.0, ""
    for number, line in enumerate(read_text(path, MeasurementError).split("\n"), start=1):
        if "-->" not in line:
            text += line + "\n"
            if len(text) > MAX_LINE:
                raise MeasurementError(f"{path}:{number}: a subtitle of more than {MAX_LINE} characters")
            continue
        time = re.search(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->", line)
        if time is None:
            raise MeasurementError(
                f"{path}:{number}: expected `00:00:01,000 --> 00:00:02,000`, got `{line[:100]}`"
            )
        if where:
            yield where, begin, text
        hours, minutes, seconds, parts = time.groups()
        begin = int(hours) * 3600 + int(minutes) * 60 + int(seconds) + float(f"0.{parts}")
        where, text = f"{path}:{number}", ""
    if where:
        yield where, begin, text


def _srt_position(text: str, where: str) -> tuple[float, float, list[float]] | None:
    """Latitude, longitude and all heights of a cue, NaN for unknown ones; None where it has no position."""

    number = partial(parse_known, where=where, error=MeasurementError)
    heights = [number(match[1]) if (match := each.search(text)) else math.nan for each in HEIGHTS]
    latitude, longitude = (each.search(text) for each in BRACKETS)
    if latitude is not None and longitude is not None:
        return number(latitude[1]), number(longitude[1]), [*heights, math.nan]
    found = TUPLE.search(text)
    if found is None:
        return None
    words = [word.strip() for word in found[1].split(",")]
    if len(words) not in (2, 3):
        raise MeasurementError(f"{where}: `{found[0][:100]}` is not GPS(longitude,latitude,altitude)")
    first, second, third = (number(word.rstrip("mM")) for word in (*words, "")[:3])
    if words[-1][-1:] in ("M", "m"):
        return first, second, [*heights, third]
    is_height = "." in words[-1] or third > MOST_SATELLITES
    return second, first, [*heights, third if is_height else math.nan]


def _gpx_rows(path: Path) -> Iterator[Fix]:
    """The points of all tracks, with their times. Source: GPX 1.1, www.topografix.com/GPX/1/1."""
    # Half a million points, of which the parser makes objects of ten times the size.
    text = read_text(path, MeasurementError, 1 << 26)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities may expand to any size
        raise MeasurementError(f"{path}: a GPX file has no DOCTYPE")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as cause:
        raise MeasurementError(f"{path}: not GPX: {cause}") from cause
    points = list(root.iterfind(".//{*}trkpt"))
    if not points:
        raise MeasurementError(
            f"{path}: no points of a track (trkpt) in it; routes and waypoints have no times"
        )
    moments = [parse_moment(point.findtext("{*}time") or "") for point in points]
    if all(moment is None for moment in moments):
        raise MeasurementError(f"{path}: point 1: no time, as of all; a planned route cannot be used")
    for number, (point, moment) in enumerate(zip(points, moments, strict=True), start=1):
        where = f"{path}: point {number}"
        each = {child.tag.rpartition("}")[2]: child.text or "" for child in point} | point.attrib
        is_void = each.get("fix", "").strip() == "none"
        latitude, longitude, altitude = (
            math.nan if is_void else parse_known(each.get(name, ""), f"{where}: {name}", MeasurementError)
            for name in ("lat", "lon", "ele")
        )
        yield Fix(where, latitude, longitude, altitude, math.nan if moment is None else moment)


SENTENCES = {"GGA": 10, "RMC": 10, "ZDA": 5}
"""Of NMEA 0183, with the fewest fields: positions with altitudes, positions with dates, dates alone."""
HALF_DAY = 43200.0  # seconds by which a clock is set back at midnight at least, and never otherwise


def _read_nmea(path: Path, text: str) -> Fixes:
    """GGA, which has the altitude, or else RMC, with the date of the RMC or ZDA before, or of the first one.

    Without a date the times are seconds since midnight, UTC. Lines with a wrong checksum are skipped, with a note.
    Source: NMEA 0183.
    """
    rows: list[tuple[str, float, list[str]]] = []
    damaged = 0
    for number, line in enumerate(text.split("\n"), start=1):
        body, star, given = line.strip()[1:].partition("*")
        fields = [field.strip() for field in body.split(",")]
        kind = fields[0][2:]
        if line.lstrip()[:1] != "$" or len(fields) < SENTENCES.get(kind, math.inf) or not fields[1]:
            continue  # another one, or no fix yet, without a time
        if star and given[:2].upper() != f"{reduce(operator.xor, body.encode(), 0):02X}":
            damaged += 1
            continue
        clock = re.fullmatch(r"([01]\d|2[0-3])([0-5]\d)([0-5]\d|60)(\.\d{1,9})?", fields[1], re.ASCII)
        if clock is None:
            raise MeasurementError(f"{path}:{number}: `{fields[1][:100]}` is not a time of NMEA")
        hours, minutes, seconds, parts = clock.groups()
        time = int(hours) * 3600 + int(minutes) * 60 + int(seconds) + float(parts or 0)
        rows.append((f"{path}:{number}", time, [kind, *fields[1:]]))
    notes = [f"{path}: skipped {damaged} lines with a wrong checksum"] if damaged else []
    return checked_fixes(path, _nmea_rows(rows), notes)


def _nmea_rows(rows: list[tuple[str, float, list[str]]]) -> Iterator[Fix]:
    days, void, dates, doubtful = list[float](), set[int](), dict[int, float](), dict[int, float]()
    epochs = list[int]()  # of sentences that follow each other and have one time
    for where, clock, fields in rows:
        before = rows[len(epochs) - 1][1] if epochs else clock
        epochs.append(epochs[-1] + (clock != before) if epochs else 0)
        if clock != before or not days:
            days.append((days[-1] if days else 0.0) + 2 * HALF_DAY * (clock < before - HALF_DAY))
        is_void = fields[0] == "RMC" and fields[2] != "A"
        void |= {epochs[-1]} if is_void else set()
        if (date := _nmea_date(fields, where)) is not None:
            (doubtful if is_void else dates)[epochs[-1]] = date - days[-1]
    dates = dates or doubtful
    start = next(iter(dates.values()), 0.0)
    kind = "GGA" if any(fields[0] == "GGA" for _, _, fields in rows) else "RMC"
    for epoch, (where, clock, fields) in zip(epochs, rows, strict=True):
        start = dates.get(epoch, start)
        if fields[0] != kind:
            continue
        at, latitude, longitude = (2 if kind == "GGA" else 3), math.nan, math.nan
        if epoch not in void and (kind == "RMC" or fields[6] not in ("", "0")):
            latitude = _degrees(fields[at], fields[at + 1], "NS", where)
            longitude = _degrees(fields[at + 2], fields[at + 3], "EW", where)
        altitude = parse_known(fields[9], where, MeasurementError) if kind == "GGA" else math.nan
        if kind == "GGA" and "".join(fields[10:11]) not in ("", "M"):
            raise MeasurementError(f"{where}: the unit of the altitude is `{fields[10][:100]}`, not M")
        yield Fix(where, latitude, longitude, altitude, start + days[epoch] + clock)


def _nmea_date(fields: list[str], where: str) -> float | None:
    """Midnight of the date of an RMC or ZDA, seconds since 1970; None without one."""
    text = "".join(fields[2:5]) if fields[0] == "ZDA" else fields[9] if fields[0] == "RMC" else ""
    if not text.strip("0"):
        return None
    found = re.fullmatch(r"(\d\d)(\d\d)(\d\d|\d{4})", text, re.ASCII)
    century = "" if len(text) == 8 else "19" if text[4:] >= "80" else "20"
    moment = None if found is None else parse_moment(f"{century}{found[3]}-{found[2]}-{found[1]}")
    if moment is None:
        raise MeasurementError(f"{where}: `{text[:100]}` is not a date")
    return moment if moment >= CLOCK_SET else None


def _degrees(text: str, hemisphere: str, letters: str, where: str) -> float:
    """Degrees of `4807.038` and `N`: 48 degrees, 7.038 minutes; NaN where one of both is missing."""
    number = parse_known(text, where, MeasurementError)
    whole, minutes = divmod(number, 100)
    is_right = math.isnan(number) or (re.match(r"\d{3}", text) and minutes < 60)
    if not is_right or hemisphere not in ("", *letters):
        raise MeasurementError(f"{where}: `{text},{hemisphere}` is not a latitude or longitude of NMEA")
    return signed_degrees(whole + minutes / 60, hemisphere, letters)


def read_image_fixes(folder: Path) -> Fixes:
    """The positions in the EXIF blocks of the images of a folder, by their names; others have none.

    Raises MeasurementError where no image has one.
    """
    images = find_frames(folder).frames
    if not images:
        raise MeasurementError(
            f"{folder}: neither images nor oxts/ of KITTI in it; positions are read from .srt, .gpx, .nmea and .csv"
        )
    found = [row for row in map(_image_fix, images) if row is not None]
    missing, incomplete = (
        len(images) - len(found),
        sum(math.isnan(row.latitude * row.longitude) for row in found),
    )
    notes = [f"{folder}: {missing} images have no position"] if missing else []
    if incomplete:
        notes.append(f"{folder}: {incomplete} images have a position without a hemisphere (GPSLatitudeRef)")
    if missing == len(images):
        raise MeasurementError(f"{folder}: no image of {missing} has a position in its EXIF block")
    return checked_fixes(folder, found, notes)


def _image_fix(path: Path) -> Fix | None:
    try:
        block = exif_block(path, 0x8825)  # of the position, by the tags of EXIF 2.32
        if 2 not in block or 4 not in block:
            return None
        sides = [(tuple(block[tag]), str(block.get(tag - 1, ""))) for tag in (2, 4)]
        if any(float(part) >= 60 for parts, _ in sides for part in parts[1:]):
            raise ValueError("minutes or seconds of a position above 60")
        latitude, longitude = (
            signed_degrees(sum(float(part) / 60**power for power, part in enumerate(parts)), side, letters)
            for (parts, side), letters in zip(sides, ("NS", "EW"), strict=True)
        )
        below = block.get(5, 0) in (1, b"\x01", 3, b"\x03")  # 3 in EXIF 3.0, above sea level
        altitude = float(block.get(6, math.nan)) * (-1 if below else 1)
        error = float(block.get(31, math.nan))  # horizontal, meters
    except FrameError as cause:
        raise MeasurementError(str(cause)) from cause
    except Exception as cause:  # values of a damaged block have any type
        raise MeasurementError(f"{path}: its EXIF block cannot be read: {cause}") from cause
    return Fix(str(path), latitude, longitude, altitude, name=path.name, std=(error, math.nan))


def _oxts_rows(folder: Path) -> Iterator[Fix]:
    """On the clock of KITTI's raw images, with the accuracy that the receiver states."""
    for packet in read_oxts(folder):
        std = (
            abs(packet.numbers[23]) if len(packet.numbers) > 23 else math.nan
        )  # `pos_accuracy` (dataformat.txt)
        latitude, longitude, altitude = packet.numbers[:3]
        yield Fix(packet.where, latitude, longitude, altitude, packet.time, std=(std, std))
