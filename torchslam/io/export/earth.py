"""The camera's path on the Earth: GeoJSON for maps, and GPX, of a map in a frame of east, north, up."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import torch

from torchslam.geometry import geodetic_from_enu
from torchslam.map.unit import MetricUnit
from torchslam.types import Trajectory

GEOJSON = "trajectory.geojson"
GPX = "trajectory.gpx"
SINCE_1970 = 1e8
"""Seconds: times from here on (1973) are dates, smaller ones count from the start of a recording."""
DIGITS = 9
"""Decimals of degrees: a tenth of a millimeter."""


def write_earth(folder: Path, trajectory: Trajectory, unit: MetricUnit) -> list[Path]:
    """Write the path of a map whose origin is known as a GeoJSON line and as a GPX track; return the files.

    Sources: RFC 7946 (longitude before latitude); GPX 1.1. GPX has times if those of the images are dates.

    Args:
        folder: the results folder.
        trajectory: camera to world; x is east, y north, z up, in meters.
        unit: of the map; nothing is written if it has no origin on the Earth.
    """
    if unit.origin is None or not len(trajectory):
        return []
    origin = torch.tensor(unit.origin, dtype=torch.float64, device="cpu")
    places = geodetic_from_enu(trajectory.positions_w.detach().double().cpu(), origin).tolist()
    times = trajectory.timestamps.tolist()
    path = {
        "type": "Feature",
        "properties": {"timestamps": times, "meters_relative_std": unit.relative_std},
        "geometry": {
            "type": "LineString" if len(places) > 1 else "MultiPoint",
            "coordinates": [
                [round(longitude, DIGITS), round(latitude, DIGITS), round(altitude, 4)]
                for latitude, longitude, altitude in places
            ],
        },
    }
    content = json.dumps({"type": "FeatureCollection", "features": [path]})
    (folder / GEOJSON).write_text(content + "\n", encoding="utf-8")
    points = [
        f'<trkpt lat="{latitude:.{DIGITS}f}" lon="{longitude:.{DIGITS}f}">'
        f"<ele>{altitude:.4f}</ele>{_moment(time)}</trkpt>"
        for time, (latitude, longitude, altitude) in zip(times, places, strict=True)
    ]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="torchslam" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>',
        *points,
        "</trkseg></trk></gpx>",
    ]
    (folder / GPX).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [folder / GEOJSON, folder / GPX]


def _moment(time: float) -> str:
    """The element of a time that is a date; empty for others."""
    if time < SINCE_1970:
        return ""
    moment = datetime.datetime.fromtimestamp(time, tz=datetime.UTC)
    return f"<time>{moment:%Y-%m-%dT%H:%M:%S.%f}Z</time>"
