"""Files of positions: CSV with a header, GPX, NMEA, DJI's .SRT, the images' own EXIF, KITTI's oxts."""

from __future__ import annotations

import math
import operator
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from jaxtyping import Float
from torch import Tensor

from torchslam.data.formats.frame_names import find_frames
from torchslam.data.formats.image_file import SUFFIXES, exif_block
from torchslam.data.formats.vehicle_files import oxts_folder, read_oxts
from torchslam.data.text_file import (
    MAX_LINE,
    TIMES,
    Column,
    float64,
    parse_moment,
    parse_number,
    read_table,
    read_text,
)
from torchslam.errors import FrameError, MeasurementError

LATITUDE, LONGITUDE, ALTITUDE = 2, 4, 6
"""Tags in that block; the hemisphere, or whether it is below the sea, is the tag before each."""
DEGREES, METERS = {"deg": 1.0, "degrees": 1.0, "°": 1.0}, {"m": 1.0, "meters": 1.0}
"""Units that headings may state."""
COLUMNS = {
    **TIMES,
    "name": Column(("name", "image", "filename", "file")),
    "latitude": Column(("latitude", "lat"), DEGREES),
    "longitude": Column(("longitude", "lon", "lng"), DEGREES),
    "altitude": Column(("altitude", "alt", "elevation", "ele"), METERS),
    "std_horizontal": Column(("stdhorizontal",), METERS),
    "std_vertical": Column(("stdvertical",), METERS),
}
MAX_FIXES = 1_000_000  # maximum number of positions of a file: more than a day at 10 Hz


class Fix(NamedTuple):
    """One position as a file has it, at a file and line, of a time in seconds or of the name of an image.

    Attributes:
        latitude, longitude: degrees; NaN where the receiver had no position.
        altitude: meters, above the sea or the ellipsoid or the start; NaN if unknown.
        std: standard deviations, horizontal along one axis and vertical, meters; NaN if unknown.
    """

    where: str
    latitude: float
    longitude: float
    altitude: float = math.nan
    time: float | None = None
    name: str = ""
    std: tuple[float, float] = (math.nan, math.nan)


@dataclass(frozen=True)
class Fixes:
    """N positions, each at a time, seconds, increasing, on the clock of the file, or of an image of some name.

    Attributes:
        geodetic: latitude, longitude and altitude, as in `Fix`.
        std: as in `Fix`.
        notes: remarks for the user, one line each.
    """

    path: Path
    geodetic: Float[Tensor, "N 3"]
    std: Float[Tensor, "N 2"]
    timestamps: Float[Tensor, " N"] | None = None
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.geodetic)


def checked_fixes(path: str | Path, rows: Iterable[Fix], notes: Sequence[str] = ()) -> Fixes:
    """The positions of a file in the order of time, without those that the receiver did not have.

    Rows without a position (empty, NaN or the zeros that receivers write) and second ones of one time are left out,
    with a note. Raises MeasurementError for coordinates or errors that cannot be, times out of order, and where nothing
    is left.
    """
    kept: list[Fix] = []
    empty = doubled = 0
    for count, row in enumerate(rows):
        if count >= MAX_FIXES:
            raise MeasurementError(f"{path}: more than the {MAX_FIXES} positions that are read")
        if math.isnan(row.latitude) or math.isnan(row.longitude) or row.latitude == row.longitude == 0:
            empty += 1
            continue
        _check(row)
        before = kept[-1].time if kept else None
        if row.time is not None and before is not None and row.time < before:
            raise MeasurementError(
                f"{row.where}: the time {row.time!r} is earlier than the one before, {before!r}: "
                "sort the file by its times"
            )
        if row.time is not None and row.time == before:
            doubled += 1
            continue
        kept.append(row)
    if not kept:
        raise MeasurementError(f"{path}: no position in it" + (f"; {empty} rows are empty" if empty else ""))
    said = [*notes]
    if empty:
        said.append(f"{path}: left out {empty} rows without a position")
    if doubled:
        said.append(f"{path}: skipped {doubled} positions with a duplicate time")
    times = [row.time for row in kept if row.time is not None]
    return Fixes(
        Path(path),
        float64([row[1:4] for row in kept]),
        float64([row.std for row in kept]),
        float64(times) if times else None,
        () if times else tuple(row.name for row in kept),
        tuple(said),
    )


def _check(row: Fix) -> None:
    """Raise MeasurementError for a position that is none of the Earth's, or an error that is none."""
    what = ""
    if not abs(row.latitude) <= 90:
        hint = ": are latitude and longitude swapped?" if abs(row.longitude) <= 90 else ""
        what = f"a latitude of {row.latitude:g} degrees is beyond the poles{hint}"
    elif not abs(row.longitude) <= 360:
        what = f"a longitude of {row.longitude:g} degrees is beyond 180"
    elif abs(row.altitude) > 1e5:  # NaN is not; balloons and rockets of amateurs stay below
        what = f"an altitude of {row.altitude:g} is no altitude in meters above the ground of the Earth"
    for std in row.std:
        if not (math.isnan(std) or 0 < std < math.inf):
            what = what or f"a standard deviation of {std:g} m is not above zero"
    if what:
        raise MeasurementError(f"{row.where}: {what}")


def read_fixes(path: str | Path) -> Fixes:
    """The positions of a file, by its suffix: .srt, .gpx, .nmea, .csv or .txt, a folder of images, or one of oxts.

    Raises MeasurementError naming file and line.
    """
    path = Path(path)
    if os.path.isdir(path):  # Path.is_dir raises for a name that is too long
        oxts = oxts_folder(path)
        return read_image_fixes(path) if oxts is None else checked_fixes(path, _oxts_rows(oxts))
    suffix = path.suffix.lower()
    if suffix == ".srt":
        return checked_fixes(path, _srt_rows(path))
    if suffix == ".gpx":
        return checked_fixes(path, _gpx_rows(path))
    if suffix in SUFFIXES:
        raise MeasurementError(
            f"{path}: one image; give the folder of all whose EXIF blocks have the positions"
        )
    text = read_text(path, MeasurementError)
    if suffix == ".nmea" or text.lstrip().startswith(("$G", "$B")):
        return _read_nmea(path, text)
    return checked_fixes(path, _csv_rows(path))


def _csv_rows(path: Path) -> Iterator[Fix]:
    for row in read_table(path, COLUMNS, MeasurementError):
        moment = row.time()
        if moment is None and "name" not in row.cells:
            raise MeasurementError(f"{row.where}: neither a `time` nor the `name` of an image")
        if "latitude" not in row.cells and "longitude" not in row.cells and "altitude" in row.cells:
            raise MeasurementError(f"{row.where}: no `latitude` and `longitude`, in degrees")
        yield Fix(
            row.where,
            row.number("latitude"),
            row.number("longitude"),
            row.number("altitude"),
            moment,
            row.cells.get("name", ""),
            (row.number("std_horizontal"), row.number("std_vertical")),
        )


_NUMBER = r"([-+]?\d{1,9}(?:\.\d{1,12})?)"
BRACKETS = [
    re.compile(rf"\b{word}\s*:\s*{_NUMBER}")  # some models write `longtitude`
    for word in ("latitude", "longt?itude", "abs_alt", "altitude", "rel_alt")
]
"""`[latitude: 59.30] [longitude: 18.20] [rel_alt: 1.3 abs_alt: 132.9]`, altitudes in the order in which they count."""
TUPLE = re.compile(rf"\bGPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(?:,\s*{_NUMBER}\s*(M)?\s*)?\)")
"""`GPS(longitude,latitude,satellites or altitude)`; the Matrice's has latitude first and its altitude ends with M."""
HEIGHT = re.compile(rf"\b(?:BAROMETER\s*:|H\s)\s*{_NUMBER}")  # height over the start in those lines


def _srt_rows(path: Path) -> Iterator[Fix]:
    """A position for each cue in which it is another one, at its beginning, on the clock of the video.

    A receiver has 1 to 10 positions a second, and each is repeated in the cues of all frames until the next.
    """
    before: tuple[float, ...] = ()
    for where, time, text in _cues(path):
        found = _srt_position(text)
        if found is None or found == before:
            continue
        before = found
        yield Fix(where, *found, time=time)


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


def _srt_position(text: str) -> tuple[float, float, float] | None:
    """Latitude, longitude and altitude of a cue; None where it has none."""
    matches = (pattern.search(text) for pattern in BRACKETS)
    latitude, longitude, *altitudes = (None if match is None else float(match[1]) for match in matches)
    if latitude is not None and longitude is not None:
        return latitude, longitude, next((each for each in altitudes if each is not None), math.nan)
    found = TUPLE.search(text)
    if found is None:
        return None
    first, second = float(found[1]), float(found[2])
    height = HEIGHT.search(text)
    if found[4]:
        return first, second, float(found[3])
    return second, first, float(height[1]) if height else float(found[3] or "nan")


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
    for number, point in enumerate(points, start=1):
        where = f"{path}: point {number}"
        children = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
        time = parse_moment(children.get("time", ""))
        if time is None:
            raise MeasurementError(f"{where}: no time; a planned route cannot be used")
        latitude, longitude, altitude = (
            math.nan if text == "nan" else parse_number(text, where, MeasurementError)
            for text in (point.get("lat", ""), point.get("lon", ""), children.get("ele", "nan"))
        )
        yield Fix(where, latitude, longitude, altitude, time=time)


def _read_nmea(path: Path, text: str) -> Fixes:
    """GGA, which has the altitude, with the date of the RMC of the same time. Source: NMEA 0183.

    Without RMC the times are seconds since midnight, UTC. Lines with a wrong checksum are skipped, with a note.
    """
    rows: dict[str, list[tuple[str, list[str]]]] = {"GGA": [], "RMC": []}
    damaged = 0
    for number, line in enumerate(text.split("\n"), start=1):
        line = line.strip()
        if not line.startswith("$") or line[3:6] not in rows:
            continue
        body, star, given = line[1:].partition("*")
        if star and given[:2].upper() != f"{reduce(operator.xor, body.encode()):02X}":
            damaged += 1
            continue
        rows[line[3:6]].append((f"{path}:{number}", body.split(",")))
    notes = [f"{path}: skipped {damaged} lines with a wrong checksum"] if damaged else []
    dates = {fields[1]: fields[9] for _, fields in rows["RMC"] if len(fields) > 9}
    return checked_fixes(path, _nmea_rows(rows["GGA"] or rows["RMC"], dates), notes)


def _nmea_rows(rows: list[tuple[str, list[str]]], dates: dict[str, str]) -> Iterator[Fix]:
    midnight, last = 0.0, -math.inf
    for where, fields in rows:
        if len(fields) < 10 or not re.fullmatch(r"\d{6}(\.\d{1,9})?", fields[1]):
            continue  # no fix yet, without a time
        clock = int(fields[1][:2]) * 3600 + int(fields[1][2:4]) * 60 + float(fields[1][4:])
        date = dates.get(fields[1], "")
        if re.fullmatch(r"\d{6}", date):
            moment = parse_moment(f"20{date[4:]}-{date[2:4]}-{date[:2]}")
            if moment is None:
                raise MeasurementError(f"{where}: `{date}` is not a date")
            midnight = moment
        elif midnight + clock < last:  # past midnight
            midnight += 86400.0
        last = midnight + clock
        is_gga = fields[0].endswith("GGA")
        latitude = longitude = altitude = math.nan
        if fields[6] not in ("", "0") if is_gga else fields[2] == "A":
            at = 2 if is_gga else 3
            latitude = _degrees(fields[at], fields[at + 1], "NS", where)
            longitude = _degrees(fields[at + 2], fields[at + 3], "EW", where)
        if is_gga and fields[9]:
            altitude = parse_number(fields[9], where, MeasurementError)
        yield Fix(where, latitude, longitude, altitude, time=last)


def _degrees(text: str, hemisphere: str, expected: str, where: str) -> float:
    """Degrees of `4807.038` and `N`: 48 degrees, 7.038 minutes."""
    found = re.fullmatch(r"(\d{1,3})(\d\d(?:\.\d{1,12})?)", text)
    if found is None or hemisphere not in tuple(expected):
        raise MeasurementError(f"{where}: `{text},{hemisphere}` is not a latitude or longitude of NMEA")
    degrees = int(found[1]) + float(found[2]) / 60
    return degrees if hemisphere == expected[0] else -degrees


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
    if not found:
        raise MeasurementError(f"{folder}: no image of {len(images)} has a position in its EXIF block")
    missing = len(images) - len(found)
    return checked_fixes(folder, found, [f"{folder}: {missing} images have no position"] if missing else [])


def _image_fix(path: Path) -> Fix | None:
    try:
        block = exif_block(path, 0x8825)  # of the position, EXIF 2.32
        if LATITUDE not in block or LONGITUDE not in block:
            return None
        latitude, longitude = (
            _exif_degrees(block[tag], block.get(tag - 1, "")) for tag in (LATITUDE, LONGITUDE)
        )
        below = block.get(ALTITUDE - 1, 0) in (1, b"\x01")
        altitude = float(block.get(ALTITUDE, math.nan)) * (-1 if below else 1)
        error = float(block.get(31, math.nan))  # horizontal, meters
    except FrameError as cause:
        raise MeasurementError(str(cause)) from cause
    except Exception as cause:  # values of a damaged block have any type
        raise MeasurementError(f"{path}: its EXIF block cannot be read: {cause}") from cause
    std = error if error > 0 else math.nan, math.nan
    return Fix(str(path), latitude, longitude, altitude, name=path.name, std=std)


def _exif_degrees(parts: tuple[float, ...], hemisphere: str) -> float:
    """Degrees of degrees, minutes and seconds."""
    degrees = sum(float(part) / 60**power for power, part in enumerate(parts))
    return -degrees if str(hemisphere).strip("\0 ").upper() in ("S", "W") else degrees


def _oxts_rows(folder: Path) -> Iterator[Fix]:
    """On the clock of KITTI's raw images, with the accuracy that the receiver states."""
    for packet in read_oxts(folder):
        accuracy = packet.numbers[23:24]  # `pos_accuracy` (dataformat.txt)
        std = accuracy[0] if accuracy and accuracy[0] > 0 else math.nan
        latitude, longitude, altitude = packet.numbers[:3]
        yield Fix(packet.where, latitude, longitude, altitude, packet.time, std=(std, std))
