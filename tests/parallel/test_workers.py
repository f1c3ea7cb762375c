"""How many processes a run has, and what each of them does."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from torchslam import load_config, open_sequence
from torchslam.data.sequence import Sequence
from torchslam.features import OpenCVORB
from torchslam.geometry import Camera
from torchslam.parallel.prefetch import FeaturePrefetcher, LivePrefetcher
from torchslam.parallel.workers import (
    WORTH,
    WORTH_FORKED,
    SolverWorker,
    best_number,
    busy_elsewhere,
    prefetch_obstacle,
    processors,
    with_workers,
)
from torchslam.system.slam import SLAM

CONFIG = load_config(None, ["features.kind=opencv-orb"])


def room(frames: int) -> Sequence:
    return open_sequence(f"synthetic:room?frames={frames}&blank=1")


@pytest.fixture
def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is started: only who would be is looked at."""
    for kind in (FeaturePrefetcher, LivePrefetcher, SolverWorker):
        monkeypatch.setattr(kind, "__enter__", lambda self: self)
        monkeypatch.setattr(kind, "__exit__", lambda self, *error: None)


def who(sequence: Sequence, slam: SLAM, processes: int | None, start: int = 0) -> tuple[str, bool]:
    """The source of the frames, and whether one worker does bundle adjustment and another one estimates the sensor."""
    with with_workers(sequence, slam, processes, start) as frames:
        adjusting, estimating = slam.mapper.adjustment.solver, slam.online_camera.solver
        is_beside = isinstance(adjusting, SolverWorker)
        assert isinstance(estimating, SolverWorker) == is_beside
        assert not is_beside or adjusting is not estimating  # an adjustment would wait for an estimate
    assert slam.mapper.adjustment.solver is slam.online_camera.solver is partial
    return type(frames).__name__, is_beside


@pytest.mark.usefixtures("no_processes")
def test_work_is_assigned_to_workers(capsys: pytest.CaptureFixture[str]) -> None:
    sequence = room(20)
    slam = SLAM(sequence.camera, CONFIG)
    here = type(sequence).__name__
    assert who(sequence, slam, 1) == (here, False)
    assert who(sequence, slam, 2) == ("FeaturePrefetcher", False)
    assert who(sequence, slam, 3) == ("FeaturePrefetcher", True)
    for processes, readers in ((2, 1), (3, 1), (4, 2), (6, 4)):
        with with_workers(sequence, slam, processes) as frames:
            assert isinstance(frames, FeaturePrefetcher)
            assert frames.count == readers
    slam.mapping = False
    assert who(sequence, slam, 3) == ("FeaturePrefetcher", False)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("no_processes")
def test_without_prefetching_the_second_process_does_bundle_adjustment(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = room(20)
    here = type(sequence).__name__
    simulated = SLAM(sequence.camera, load_config(None, ["features.kind=simulated"]))
    assert who(sequence, simulated, 2) == (here, True)
    assert "frames are read in the main process: simulated features need no images" in capsys.readouterr().err
    slam = SLAM(sequence.camera)
    sequence.timestamps = sequence.timestamps[:0]
    monkeypatch.setattr("torchslam.parallel.workers.best_number", lambda *arguments: 3)
    assert who(sequence, slam, None) == ("LivePrefetcher", True)
    assert prefetch_obstacle(sequence, slam) == ""
    assert capsys.readouterr().err == ""  # no message unless requested


@pytest.mark.usefixtures("no_processes")
def test_accelerators_use_no_workers(capsys: pytest.CaptureFixture[str]) -> None:
    sequence = room(20)
    slam = SLAM(sequence.camera, CONFIG)
    camera = sequence.camera
    slam.camera = Camera(camera.model, camera.params.to("meta"), camera.size)
    assert who(sequence, slam, 3) == (type(sequence).__name__, False)
    assert "one process is used, since the camera is on meta" in capsys.readouterr().err


@pytest.mark.parametrize("is_forked", [True, False])
def test_the_default_number_of_processes(monkeypatch: pytest.MonkeyPatch, is_forked: bool) -> None:
    monkeypatch.setattr("torchslam.parallel.workers.can_fork", lambda: is_forked)
    worth = WORTH_FORKED if is_forked else WORTH
    long, short = room(worth), room(worth - 1)
    monkeypatch.setattr("torchslam.parallel.workers.busy_elsewhere", lambda: 0)
    for count, several in ((1, 1), (2, 3), (8, 3)):
        monkeypatch.setattr("torchslam.parallel.workers.processors", lambda known=count: known)
        assert best_number(long, 0) == several
        assert best_number(long, 1) == 1
        assert best_number(short, 0) == 1
    assert processors() >= 1


def test_one_process_where_others_compute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    load = tmp_path / "loadavg"
    monkeypatch.setattr("torchslam.parallel.workers.LOAD", load)
    monkeypatch.setattr("torchslam.parallel.workers.processors", lambda: 2)
    sequence = room(WORTH)
    assert best_number(sequence, 0) == 3  # unknown
    for running, expected in ((1, 3), (2, 1), (3, 1)):
        load.write_text(f"0.00 0.00 0.00 {running}/345 6789\n")
        assert busy_elsewhere() == running - 1
        assert best_number(sequence, 0) == expected


@pytest.mark.usefixtures("no_processes")
def test_custom_components_stay_in_the_main_process() -> None:
    sequence = room(20)
    slam = SLAM(sequence.camera, CONFIG, extractor=OpenCVORB(300))
    assert who(sequence, slam, 3) == (type(sequence).__name__, True)
    assert "custom feature extractor" in prefetch_obstacle(sequence, slam)


@pytest.mark.usefixtures("no_processes")
def test_the_first_frame_does_not_wait_for_lazy_initialization() -> None:
    sequence = room(20)
    slam = SLAM(sequence.camera, load_config(None, ["features.kind=orb"]))
    extract, seen = slam.extractor, []
    assert extract is not None
    slam.extractor = lambda frame: (seen.append(frame.image), extract(frame))[1]
    with with_workers(sequence, slam, 1):
        (image,) = seen
        assert image.shape[-2:] == (sequence.camera.height, sequence.camera.width)
        assert not image.any()
    other = SLAM(sequence.camera, CONFIG)
    other.extractor = lambda frame: pytest.fail("other front ends are shown frames alone")
    with with_workers(sequence, other, 1):
        pass
    own = SLAM(sequence.camera, load_config(None, ["features.kind=orb"]), extractor=OpenCVORB(100))
    own.extractor = lambda frame: pytest.fail("what somebody else made is shown frames alone")
    with with_workers(sequence, own, 1):
        pass
    assert slam.last_frame is None


@pytest.mark.usefixtures("no_processes")
def test_the_first_tracked_frame_does_not_wait_for_the_undistortion_table() -> None:
    sequence = room(20)
    width, height = sequence.camera.size
    slam = SLAM(
        Camera.fisheye(150, 150, width / 2, height / 2, 0.02, -0.01, 0, 0, size=(width, height)), CONFIG
    )
    undistorted = slam.shared_camera.undistortion
    assert "_table" not in vars(undistorted)
    with with_workers(sequence, slam, 1):
        assert "_table" in vars(undistorted)
