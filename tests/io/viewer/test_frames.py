"""Frames are shown during a run: in a rerun recording, and in a video."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from tests.walks import Walk, arc
from torchslam import SLAM, Run, load_config
from torchslam.app import reading
from torchslam.cli.main import main
from torchslam.data.transforms import SHOWN_SIDE
from torchslam.errors import ResultsError
from torchslam.geometry import Camera, se3_inverse, transform
from torchslam.io.export.scene import pinhole_within
from torchslam.io.viewer import live_map
from torchslam.io.viewer.frames import (
    BAR,
    FrameSnapshot,
    FrameViewers,
    LiveView,
    VideoRecorder,
    film_of,
    tracked_pixels,
)
from torchslam.io.viewer.live_map import LiveMap
from torchslam.types import State, StepResult

SIMULATED = ["features.kind=simulated", "features.num_keypoints=300", "simulated.points_per_view=200"]
SIMULATED += ["camera.std=0", "camera.readout_std=0"]
FRAMES = 12
GRAY = 90


class Pictured(Walk):
    """A walk with images, which counts how often each is read."""

    def __init__(self) -> None:
        super().__init__(arc(FRAMES))
        self.reads = [0] * FRAMES

    def image(self, index: int) -> torch.Tensor:
        self.reads[index] += 1
        width, height = self.size
        return torch.full((1, 1, height, width), GRAY / 255)


class Kept:
    """A screen that keeps what it is shown, with the pose of the frame and its pixels by the map of then."""

    def __init__(self) -> None:
        self.snapshots: list[FrameSnapshot] = []
        self.runs: list[Run] = []
        self.closed = 0

    def show(self, snapshot: FrameSnapshot) -> None:
        self.snapshots.append(snapshot)

    def end(self, run: Run) -> None:
        self.runs.append(run)

    def close(self) -> None:
        self.closed += 1


def watched(slam: SLAM, walk: Walk, *screens: Kept | LiveView | VideoRecorder) -> Run:
    with FrameViewers(slam, walk, list(screens)) as watching:
        run = slam.run(watching.sequence, watching.show)
        watching.end(run)
    return run


def test_viewers_see_every_frame_once() -> None:
    walk, kept = Pictured(), Kept()
    slam = SLAM(walk.camera, load_config(None, SIMULATED))
    run = watched(slam, walk, kept)
    assert walk.reads == [1] * FRAMES
    assert [snapshot.result for snapshot in kept.snapshots] == run.results
    assert all((snapshot.image == GRAY).all() for snapshot in kept.snapshots)
    assert (kept.runs, kept.closed) == ([run], 1)
    for snapshot in kept.snapshots:
        count = snapshot.result.inliers
        assert len(snapshot.tracked) == count or snapshot.result.state is not State.TRACKING or count == 0
        ours = (snapshot.tracked[:, None] == snapshot.keypoints).all(dim=-1).any(dim=-1)
        assert ours.all()
    assert len(kept.snapshots[-1].tracked) > 50
    assert len(tracked_pixels(slam, FRAMES)) == 0


def test_watching_does_not_change_the_run() -> None:
    runs = []
    for screens in ([], [Kept()]):
        walk = Pictured()
        runs.append(watched(SLAM(walk.camera, load_config(None, SIMULATED)), walk, *screens))
    assert torch.equal(runs[0].trajectory.T_wc, runs[1].trajectory.T_wc)
    assert torch.equal(runs[0].map.positions_w, runs[1].map.positions_w)


@pytest.mark.parametrize("distortion", [pytest.param(0.0, marks=pytest.mark.slow), -0.2])
def test_a_live_view_shows_points_where_their_keypoints_are(tmp_path: Path, distortion: float) -> None:
    rr = pytest.importorskip("rerun")
    from tests.io.export.test_recording import read

    walk = Pictured()
    camera = walk.camera
    if distortion:
        walk.camera = Camera.radial_tangential(*camera.params, distortion, 0.02, 0, 0, size=camera.size)
    slam = SLAM(walk.camera, load_config(None, SIMULATED))
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "live.rrd")
    run = watched(slam, walk, LiveView(slam, recording))
    rows = read(tmp_path / "live.rrd")
    pinhole = pinhole_within(slam.camera)
    images = rows["/world/camera", "EncodedImage:blob"]
    assert [frame for frame, _ in images] == list(range(FRAMES))
    image = cv2.imdecode(np.array(images[-1][1], np.uint8).reshape(-1), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (pinhole.height, pinhole.width)
    posed = [result for result in run.results if result.T_cw is not None]
    translations = rows["/world/camera", "Transform3D:translation"]
    assert [frame for frame, _ in translations] == [result.index for result in posed]
    centers = np.array([value for _, value in translations]).reshape(-1, 3)
    given = torch.stack([result.T_cw for result in posed if result.T_cw is not None])
    np.testing.assert_allclose(centers, se3_inverse(given)[:, :3, 3].numpy(), atol=1e-6)
    ((_, points),) = rows["/world/points", "Points3D:positions"][-1:]
    ids = run.map.valid_points()
    np.testing.assert_allclose(np.array(points), run.map.positions_w[ids].numpy(), atol=1e-5)
    frame, keypoints = rows["/world/camera/keypoints", "Points2D:positions"][-1]
    T_cw = run.results[frame].T_cw
    assert T_cw is not None
    pixels = pinhole.project(transform(T_cw, run.map.positions_w[ids]))[0].numpy() + 0.5
    apart = np.linalg.norm(np.array(keypoints)[:, None] - pixels, axis=-1).min(axis=1)
    assert np.median(apart) < 1.0
    assert rows["/state", "TextLog:text"]


def test_a_camera_without_pinhole_equivalent_is_refused() -> None:
    pytest.importorskip("rerun")
    wide = Camera.fisheye(90.0, 90.0, 600.0, 119.5, 0.0, 0.0, 0.0, 0.0, size=(320, 240))
    with pytest.raises(ResultsError, match="too wide"):
        LiveView(SLAM(wide, load_config(None, SIMULATED)), None)


def test_a_closed_window_does_not_stop_the_run() -> None:
    class Gone:
        def log(self, *what: object, **more: object) -> None: ...

        def flush(self, timeout_sec: float) -> None:
            raise RuntimeError("no connection")

        def disconnect(self) -> None: ...

    pytest.importorskip("rerun")
    view = LiveView(SLAM(Walk(arc(3)).camera, load_config(None, SIMULATED)), Gone())
    with pytest.warns(UserWarning, match="did not get everything: no connection"):
        view.close()


def test_a_viewer_that_does_not_start_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    rr = pytest.importorskip("rerun")

    def fail(**options: object) -> None:
        raise RuntimeError("no such program")

    monkeypatch.setattr(rr, "spawn", fail)
    with pytest.raises(ResultsError, match="does not start: no such program"):
        LiveView.spawn(SLAM(Walk(arc(3)).camera, load_config(None, SIMULATED)))


def test_without_rerun_the_run_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["run", "synthetic:room?frames=3", "-o", str(tmp_path / "new"), "--view"]) == 2
    assert "pip install 'torchslam[rerun]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def frames_of(path: Path) -> list[np.ndarray]:
    video = cv2.VideoCapture(str(path))
    images = []
    while (read := video.read())[0]:
        images.append(read[1])
    return images


def test_a_video_has_every_frame_and_marks_tracked_points(tmp_path: Path) -> None:
    gray = np.full((120, 1920), GRAY, np.uint8)
    result = StepResult(7, 0.0, State.TRACKING, None, inliers=1)
    snapshot = FrameSnapshot(result, gray, torch.tensor([[200.0, 60.0]]), torch.tensor([[1000.0, 60.0]]))
    video = VideoRecorder(tmp_path / "it.mp4", (1920, 120), 10.0)
    for shown in (snapshot, snapshot._replace(tracked=torch.zeros(0, 2))):
        video.show(shown)
    video.close()
    first, second = (image.astype(int) for image in frames_of(tmp_path / "it.mp4"))
    assert first.shape == (60 + BAR, 960, 3)  # half of it
    marked, unmarked = first[24:37, 494:507], second[24:37, 494:507]
    green = marked[..., 1] - marked[..., 2]
    assert green.max() > 30
    assert abs(unmarked - GRAY).max() < 15
    assert (first[60:] > 120).any()  # the words


def test_a_video_has_the_frame_rate_of_its_sequence(tmp_path: Path) -> None:
    walk = Pictured()
    film_of(walk, tmp_path).close()
    video = film_of(SimpleNamespace(known_length=None, timestamps=[], size=(64, 48)), tmp_path)  # type: ignore[arg-type]
    video.close()
    slam = SLAM(walk.camera, load_config(None, SIMULATED))
    watched(slam, walk, film_of(walk, tmp_path))
    written = cv2.VideoCapture(str(tmp_path / "tracked.mp4"))
    assert written.get(cv2.CAP_PROP_FPS) == pytest.approx(walk.frame_rate, rel=0.01)
    assert len(frames_of(tmp_path / "tracked.mp4")) == FRAMES


def test_a_video_in_a_folder_whose_name_has_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = Path("2024-05-01T12:30:05")
    folder.mkdir()
    VideoRecorder(folder / "it.mp4", (64, 48), 10.0).close()
    assert (folder / "it.mp4").exists()


def test_a_video_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="cannot write it"):
        VideoRecorder(tmp_path / "nowhere" / "it.mp4", (64, 48), 10.0)


def test_a_live_map_is_the_map_so_far_and_does_not_change_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_map, "EVERY_S", 0.0)
    monkeypatch.setattr(live_map, "SHARE", 1e9)
    assert reading.live(tmp_path) is None
    walk = Pictured()
    slam = SLAM(walk.camera, load_config(None, SIMULATED))
    live, found = LiveMap(slam, walk, tmp_path), dict[int, dict[str, np.ndarray]]()

    def show(result: StepResult) -> None:
        live.offer(result)
        content = reading.live(tmp_path)
        if result.is_keyframe and content is not None:
            found[result.index] = content
            assert int(content["frame"]) == result.index
            assert len(content["points"]) == len(slam.map.valid_points())
            last = slam.posed_frames.trajectory(slam.map).T_wc[-1, :3]
            np.testing.assert_allclose(content["poses"][-1], last, rtol=1e-5, atol=1e-6)

    run = slam.run(walk, show)
    first, last = (found[index] for index in (min(found), max(found)))
    assert len(first["poses"]) < len(last["poses"])
    # Each point is seen in a keyframe that was shown, and has the color of its image, not of the circles in it.
    assert (last["colors"] == GRAY).all()
    assert max(last["image"].shape) == min(max(walk.size), SHOWN_SIDE)
    again = slam_of(walk).run(walk, lambda result: None)
    assert torch.equal(run.trajectory.T_wc, again.trajectory.T_wc)


def slam_of(walk: Walk) -> SLAM:
    return SLAM(walk.camera, load_config(None, SIMULATED))


def test_frames_that_are_no_keyframes_are_shown_after_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(live_map.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(live_map, "SHARE", 1e9)
    walk = Pictured()
    live = LiveMap(slam_of(walk), walk, tmp_path)
    lost = StepResult(0, 0.0, State.LOST, None)
    live.offer(lost)
    shown = reading.live(tmp_path)
    assert shown is not None
    assert len(shown["points"]) == len(shown["poses"]) == 0
    for seconds, frame in ((1.0, 0), (live_map.EVERY_S + live_map.PATIENCE_S, 2)):
        now[0] = 100.0 + seconds
        live.offer(StepResult(2, 0.1, State.LOST, None))
        content = reading.live(tmp_path)
        assert content is not None
        assert int(content["frame"]) == frame


@pytest.mark.parametrize("content", [b"", b"PK", b"x" * 1000])
def test_a_damaged_live_map_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "live.npz").write_bytes(content)
    with pytest.raises(ResultsError, match=r"live\.npz"):
        reading.live(tmp_path)
