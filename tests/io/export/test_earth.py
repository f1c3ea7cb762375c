"""The path on the Earth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from torchslam.data.formats.fix_files import read_fixes
from torchslam.geometry import enu_from_geodetic, rigid
from torchslam.io.write_run import write_earth
from torchslam.map.unit import MetricUnit
from torchslam.types import Trajectory

ORIGIN = (48.98, 8.39, 112.0)


def unit(origin: tuple[float, float, float] | None) -> MetricUnit:
    eye = tuple(map(tuple, torch.eye(4).tolist()))
    return MetricUnit(0.01, (), (), eye, 0.02, origin)


def test_what_is_written_lies_where_the_camera_was(tmp_path: Path) -> None:
    """GPX is read again by our own reader; GeoJSON has longitude before latitude."""
    positions = torch.tensor([[0.0, 0, 0], [10, 20, 3], [-5, 1000, -2]], dtype=torch.float64)
    times = 1.7e9 + torch.tensor([0.0, 0.5, 2.0], dtype=torch.float64)
    T_wc = rigid(torch.eye(3, dtype=torch.float64).expand(3, 3, 3), positions)
    files = write_earth(tmp_path, Trajectory(times, T_wc), unit(ORIGIN))
    assert [file.name for file in files] == ["trajectory.geojson", "trajectory.gpx"]
    fixes = read_fixes(tmp_path / "trajectory.gpx")
    assert fixes.timestamps is not None
    assert fixes.timestamps.tolist() == pytest.approx(times.tolist(), abs=1e-5)
    origin = torch.tensor(ORIGIN, dtype=torch.float64)
    torch.testing.assert_close(enu_from_geodetic(fixes.geodetic, origin), positions, atol=1e-3, rtol=0)
    (feature,) = json.loads((tmp_path / "trajectory.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "LineString"
    places = torch.tensor(feature["geometry"]["coordinates"], dtype=torch.float64)[:, [1, 0, 2]]
    torch.testing.assert_close(enu_from_geodetic(places, origin), positions, atol=1e-3, rtol=0)
    assert feature["properties"]["timestamps"] == times.tolist()


def test_without_an_origin_nothing_is_written(tmp_path: Path) -> None:
    T_wc = torch.eye(4, dtype=torch.float64)[None]
    trajectory = Trajectory(torch.zeros(1, dtype=torch.float64), T_wc)
    assert write_earth(tmp_path, trajectory, unit(None)) == []
    assert list(tmp_path.iterdir()) == []
    write_earth(tmp_path, trajectory, unit(ORIGIN))
    assert "<time>" not in (tmp_path / "trajectory.gpx").read_text()  # seconds since the recording began
