"""A run with the positions of a receiver: its map is in meters, and its results lie on the Earth."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchslam import SLAM, Config, evaluate, open_sequence
from torchslam.config import load_config
from torchslam.data.formats.fix_files import read_fixes
from torchslam.errors import TorchslamError
from torchslam.geometry import enu_from_geodetic, geodetic_from_enu
from torchslam.io.report import compute_metrics
from torchslam.io.write_run import write_results
from torchslam.metric.options import given_options, sources_of
from torchslam.types import Trajectory

ORIGIN = torch.tensor((48.98, 8.39, 112.0), dtype=torch.float64)


def test_a_map_on_the_earth(tmp_path: Path) -> None:
    sequence = open_sequence("synthetic:room").part(0, 40)
    truth = sequence.groundtruth
    assert truth is not None
    rows = torch.arange(0, 40, 2)
    noise = 0.005 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    positions_e = truth.positions_w[rows].double() + noise
    lines = ["time,latitude,longitude,altitude"]
    places = geodetic_from_enu(positions_e, ORIGIN).tolist()
    for time, (latitude, longitude, altitude) in zip(truth.timestamps[rows].tolist(), places, strict=True):
        lines.append(f"{time!r},{latitude:.12f},{longitude:.12f},{altitude:.6f}")
    (tmp_path / "gps.csv").write_text("\n".join(lines), encoding="utf-8")
    config = load_config(None, [f"metric.gps='{tmp_path / 'gps.csv'}'"])
    sources = sources_of(given_options(config.metric))
    run = SLAM(sequence.camera, Config()).run(sequence, measurements=sources)
    assert run.metric is not None
    assert run.metric.origin is not None
    found = evaluate(run.trajectory, truth)
    assert abs(found.scale - 1) < 3 * run.metric.relative_std < 0.05
    # In the frame of the receiver without any alignment; the origin is the first position.
    origin = torch.tensor(run.metric.origin, dtype=torch.float64)
    shift = enu_from_geodetic(origin[None], ORIGIN)[0]
    at = torch.searchsorted(truth.timestamps, run.trajectory.timestamps)
    off = run.trajectory.positions_w + shift - truth.positions_w[at]
    assert float(off.norm(dim=-1).mean()) < 0.02
    metrics = compute_metrics(run, sequence, "")
    write_results(run, sequence, metrics, tmp_path / "results")
    path = read_fixes_of(tmp_path / "results" / "trajectory.gpx", run.trajectory)
    torch.testing.assert_close(
        enu_from_geodetic(path, origin), run.trajectory.positions_w.double(), atol=1e-3, rtol=0
    )


def read_fixes_of(file: Path, trajectory: Trajectory) -> torch.Tensor:
    """Latitude, longitude and altitude of a track without times, which the reader of positions would refuse."""
    text = file.read_text(encoding="utf-8")
    assert text.count("<trkpt") == len(trajectory)
    dated = text.replace("</ele>", "</ele><time>2024-05-01T10:00:{:02d}Z</time>").format(
        *range(len(trajectory))
    )
    file.with_name("dated.gpx").write_text(dated, encoding="utf-8")
    return read_fixes(file.with_name("dated.gpx")).geodetic


@pytest.mark.parametrize("option", ["gps", "speed", "odometry"])
def test_a_file_that_is_missing_is_said_before_the_run(option: str) -> None:
    config = load_config(None, [f"metric.{option}='missing.csv'"])
    with pytest.raises(TorchslamError, match=r"missing\.csv"):
        sources_of(given_options(config.metric))
