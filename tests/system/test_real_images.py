"""Runs over real images: tracked, not made worse at the end, and what is reported of their sensor."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import pytest
import torch

from experiments.trials.edited import Edited, shots
from experiments.trials.edits import rolling
from torchslam import SLAM, Run, evaluate, open_sequence
from torchslam.data.sequence import Sequence
from torchslam.io.report import shake_remark
from torchslam.types import Trajectory


@lru_cache(maxsize=5)
def real_run(path: Path, frames: int) -> tuple[Sequence, Run]:
    """The first frames of a recording, and their run, which is not to be changed."""
    sequence = open_sequence(path).part(0, frames)
    return sequence, SLAM(sequence.camera).run(sequence)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "frames", "ate_m"),
    [("shelf_bin", 50, 0.02), pytest.param("machine_hall", 40, 0.02, marks=pytest.mark.slow)],
)
def test_real_images_are_tracked(data_dir: Path, name: str, frames: int, ate_m: float) -> None:
    sequence, run = real_run(data_dir / name, frames)
    assert len(run.trajectory) >= 0.9 * frames
    assert evaluate(run.trajectory, sequence.groundtruth).ate_m < ate_m


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "frames", "precision_m"),
    [
        ("shelf_bin", 50, 0.0005),
        pytest.param("machine_hall", 320, 0.0005, marks=pytest.mark.slow),
        ("fr2_desk_20", 20, 0.0005),
        pytest.param("kitti07", 160, 0.02, marks=pytest.mark.slow),
        pytest.param("redkitchen", 300, 0.01, marks=pytest.mark.slow),
    ],
)
def test_the_final_trajectory_is_not_worse_than_the_online_one(
    data_dir: Path, name: str, frames: int, precision_m: float
) -> None:
    """By more than a twentieth and what the ground truth tells, whose errors are up to 3 cm in redkitchen."""
    sequence, run = real_run(data_dir / name, frames)
    assert len(run.online) > 0.5 * frames
    both = torch.isin(run.trajectory.timestamps, run.online.timestamps)
    posed_online = Trajectory(run.trajectory.timestamps[both], run.trajectory.T_wc[both])
    online, final = (
        evaluate(trajectory, sequence.groundtruth).ate_m for trajectory in (run.online, posed_online)
    )
    assert final <= 1.05 * online + precision_m


@pytest.mark.data
def test_a_real_static_camera_initializes_no_map(data_dir: Path) -> None:
    _, run = real_run(data_dir / "standstill", 12)
    assert run.map.num_keyframes == 0
    assert "stands still" in run.failure


@pytest.mark.data
def test_the_rolling_shutter_of_a_kinect_is_found(data_dir: Path) -> None:
    """Its color camera reads an image in about 30 ms, of the 100 ms between two frames of this sequence."""
    _, finished = real_run(data_dir / "fr2_desk_20", 20)
    assert finished.readout is not None
    assert 0.025 < float(finished.readout.seconds) < 0.033
    assert shake_remark(finished) == ""


@pytest.mark.data
def test_images_without_waves_are_not_named(data_dir: Path) -> None:
    assert shake_remark(real_run(data_dir / "shelf_bin", 50)[1]) == ""


@pytest.mark.data
@pytest.mark.slow
def test_waves_in_real_images_are_named(data_dir: Path) -> None:
    """A sine along the rows shifts the images."""
    whole = open_sequence(data_dir / "shelf_bin")
    edited = Edited("shelf_bin", whole.camera, shots(whole, range(len(whole)), rolling(6.0)))
    assert "the camera shakes" in shake_remark(SLAM(whole.camera).run(edited))
