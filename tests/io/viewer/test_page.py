"""view.html holds the run it was made of, needs nothing else, and draws it in a browser."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tests.box_room import box_cloud, box_depths
from tests.io.test_results import two, write
from torchslam.dense import PointCloud
from torchslam.geometry import Camera, transform
from torchslam.io.results import Results, read_results
from torchslam.io.viewer import page as view_data
from torchslam.io.viewer.page import encoded, numbers, page, write_view
from torchslam.system.run import Run
from torchslam.types import State, Trajectory

__all__ = ["two"]

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
MAX_BYTES = 15_000_000


@pytest.fixture
def kept(tmp_path: Path, run: Run, generator: torch.Generator) -> Results:
    """As read from a folder; the points have colors."""
    colors = run.map.points["colors"]
    colors[:] = torch.randint(1, 256, colors.shape, generator=generator, dtype=torch.uint8)
    write(run, tmp_path)
    return read_results(tmp_path)


@pytest.fixture
def dense(kept: Results, camera: Camera) -> PointCloud:
    """A room around the cameras, in green."""
    cloud = box_cloud(box_depths(kept.map.T_cw[:2], torch.arange(2), camera))
    cloud.colors[:] = torch.tensor([0, 255, 0], dtype=torch.uint8)
    return cloud


def data_of(text: str) -> dict[str, Any]:
    """What a page holds."""
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found)


def decoded(packed: dict[str, str]) -> np.ndarray:
    """A flat array of the page."""
    kind = np.dtype(packed["type"]).newbyteorder("<")
    return np.frombuffer(base64.b64decode(packed["data"]), kind)


def array(packed: dict[str, str], *shape: int) -> np.ndarray:
    return decoded(packed).reshape(-1, *shape)


def test_numbers_of_the_page_round_trip() -> None:
    for values, kind in (([1, -2], "int32"), ([255], "uint8"), ([0.1, np.nan], "float32"), ([], "float64")):
        packed = json.loads(json.dumps(numbers(values, kind), default=encoded))
        np.testing.assert_array_equal(decoded(packed), np.array(values, dtype=kind))


def test_the_page_loads_nothing(kept: Results) -> None:
    text = page(kept)
    assert "default-src 'none'" in text
    for external in ("http://", "https://", "src=", "@import", "url(", "fetch(", "import(", "{{"):
        assert external not in text, external
    assert page(kept) == text


def test_the_page_holds_the_map_and_the_path(kept: Results) -> None:
    data = data_of(page(kept))
    (submap,) = data["submaps"]
    S = torch.tensor(submap["S_shown_map"], dtype=torch.float64)
    assert torch.linalg.det(S[:3, :3]) == pytest.approx(1.0)
    ids = kept.map.valid_points()
    points = transform(S, kept.map.positions_w[ids]).numpy()
    np.testing.assert_allclose(array(submap["points"], 3), points, atol=1e-5)
    np.testing.assert_array_equal(array(submap["colors"], 3), kept.map.points["colors"][ids].numpy())
    poses = array(submap["poses"], 3, 4)
    expected = (S @ kept.trajectory.T_wc).numpy()[:, :3]
    np.testing.assert_allclose(poses, expected, atol=1e-5)
    assert (poses[:, 2, 1] < -0.99).all()  # y of the cameras, down, against z of the page, up
    assert decoded(submap["frame"]).tolist() == [*range(3, 18), *range(22, 30)]
    assert decoded(submap["keyframe"]).tolist() == [0, 5, 10, 15, 20, 25]
    keyframes = (S @ kept.keyframes.T_wc).numpy()[:, :3]
    np.testing.assert_allclose(array(submap["keyframe_poses"], 3, 4), keyframes, atol=1e-5)
    box = np.array(submap["box"])
    np.testing.assert_allclose(box.mean(axis=0), 0.0, atol=1e-9)
    assert (poses[:, :, 3] > box[0]).all()
    assert (poses[:, :, 3] < box[1]).all()


def test_the_page_holds_the_state_of_every_frame(kept: Results) -> None:
    data = data_of(page(kept))
    frames = data["frames"]
    assert decoded(frames["index"]).tolist() == list(range(30))
    np.testing.assert_allclose(decoded(frames["seconds"]), np.arange(30) / 30, atol=1e-9)
    states = [list(State)[code] for code in decoded(frames["state"])]
    assert states == [result.state for result in kept.frames]
    reasons = [data["reasons"][number] for number in decoded(frames["reason"])]
    assert reasons == [result.reason for result in kept.frames]
    assert decoded(frames["inliers"]).tolist() == [result.inliers for result in kept.frames]
    corners = np.array(data["corners"])
    np.testing.assert_allclose(corners[2], [79.5 / 100, 59.5 / 100, 1.0])
    np.testing.assert_allclose(corners[[0, 1, 3], :2] / corners[2, :2], [[-1, -1], [1, -1], [-1, 1]])


def test_with_ground_truth_the_page_has_meters_and_errors(kept: Results) -> None:
    T_wc = kept.trajectory.T_wc.clone()
    T_wc[:, :3, 3] = 2 * T_wc[:, :3, 3] + 1e6  # far away, as in a map of a country
    T_wc[4, 1, 3] += 0.1
    aligned = replace(kept, groundtruth=Trajectory(kept.trajectory.timestamps, T_wc))
    (submap,) = data_of(page(aligned))["submaps"]
    assert submap["unit"] == "m"
    S = torch.tensor(submap["S_shown_map"], dtype=torch.float64)
    assert torch.linalg.det(S[:3, :3]) == pytest.approx(8.0, rel=0.05)
    errors, poses, truth = decoded(submap["errors"]), array(submap["poses"], 3, 4), array(submap["truth"], 3)
    np.testing.assert_allclose(np.linalg.norm(poses[:, :, 3] - truth, axis=1), errors, atol=2e-5)
    assert errors.argmax() == 4
    assert errors[4] == pytest.approx(0.1, rel=0.15)


def test_without_ground_truth_there_are_no_errors(kept: Results) -> None:
    (submap,) = data_of(page(kept))["submaps"]
    assert np.isnan(decoded(submap["errors"])).all()
    assert submap["unit"] == ""
    assert len(decoded(submap["truth"])) == 0


def test_the_path_is_broken_where_poses_are_missing(kept: Results) -> None:
    keep = torch.ones(len(kept.trajectory), dtype=torch.bool)
    keep[3:9] = False
    path = Trajectory(kept.trajectory.timestamps[keep], kept.trajectory.T_wc[keep])
    (submap,) = data_of(page(replace(kept, trajectory=path)))["submaps"]
    assert submap["breaks"] == [3]
    steps = path.positions_w.diff(dim=0).norm(dim=-1)
    assert submap["path_length"] == pytest.approx(float(steps.sum() - steps[2]), rel=1e-6)


def test_a_map_without_images_has_no_colors(kept: Results) -> None:
    kept.map.points["colors"][:] = 0
    (submap,) = data_of(page(kept))["submaps"]
    assert submap["colors"]["data"] == ""


def test_large_maps_and_long_runs_are_thinned(kept: Results, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_data, "MAX_POINTS", 50)
    monkeypatch.setattr(view_data, "MAX_FRAMES", 10)
    data = data_of(page(kept))
    (submap,) = data["submaps"]
    assert len(array(submap["points"], 3)) == len(array(submap["colors"], 3)) == 50
    assert submap["points_total"] == kept.map.num_points
    index = decoded(data["frames"]["index"])
    assert len(index) == 10
    assert index[[0, -1]].tolist() == [0, 29]
    S = torch.tensor(submap["S_shown_map"], dtype=torch.float64)
    times = (100 + index[decoded(submap["frame"])] / 30).tolist()
    rows = [int((kept.trajectory.timestamps - time).abs().argmin()) for time in times]
    poses = (S @ kept.trajectory.T_wc[rows]).numpy()[:, :3]
    np.testing.assert_allclose(array(submap["poses"], 3, 4), poses, atol=1e-5)


def test_the_page_holds_the_dense_cloud(kept: Results, dense: PointCloud) -> None:
    (submap,) = data_of(page(replace(kept, cloud=dense)))["submaps"]
    packed = submap["dense"]
    S = torch.tensor(submap["S_shown_map"], dtype=torch.float64)
    shown = np.array(packed["low"]) + array(packed["points"], 3) * np.array(packed["step"])
    assert array(packed["points"], 3).dtype == np.uint16
    np.testing.assert_allclose(shown, transform(S, dense.points_w.double()), atol=1e-4)
    np.testing.assert_array_equal(array(packed["colors"], 3), dense.colors)
    assert packed["total"] == len(dense)


def test_points_of_the_dense_cloud_that_are_far_off_are_not_shown(kept: Results, dense: PointCloud) -> None:
    """They would leave few steps for the others."""
    dense.points_w[7] = 1e6
    (submap,) = data_of(page(replace(kept, cloud=dense)))["submaps"]
    assert len(array(submap["dense"]["points"], 3)) == len(dense) - 1
    assert max(submap["dense"]["step"]) < 1e-3
    dense.points_w[:] = 1e6
    (submap,) = data_of(page(replace(kept, cloud=dense)))["submaps"]
    assert submap["dense"]["points"]["data"] == ""


def test_a_large_dense_cloud_is_thinned(
    kept: Results, dense: PointCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_data, "MAX_DENSE_POINTS", 60)
    text = page(replace(kept, cloud=dense))
    assert page(replace(kept, cloud=dense)) == text
    (submap,) = data_of(text)["submaps"]
    assert len(array(submap["dense"]["points"], 3)) == len(array(submap["dense"]["colors"], 3)) == 60
    assert submap["dense"]["total"] == len(dense)


def test_the_size_of_a_page_is_bounded(kept: Results, dense: PointCloud) -> None:
    """Any number of points and of frames fits."""
    count, frames = 200_000, 40_000
    many = kept.map.points
    repeat = {name: column[torch.arange(count) % len(many)] for name, column in many.columns().items()}
    many.append(**repeat)
    times = torch.arange(frames, dtype=torch.float64) / 30
    path = Trajectory(times, kept.trajectory.T_wc[torch.arange(frames) % len(kept.trajectory)])
    steps = [replace(kept.frames[3], index=i, timestamp=i / 30) for i in range(frames)]
    cloud = dense[torch.arange(view_data.MAX_DENSE_POINTS + 1000) % len(dense)]
    long = replace(kept, trajectory=path, groundtruth=path, frames=steps, cloud=cloud)
    assert len(page(long).encode()) < MAX_BYTES


def test_every_submap_with_poses_is_shown_the_main_one_first(tmp_path: Path, two: Run) -> None:
    write(two, tmp_path)
    submaps = data_of(page(read_results(tmp_path)))["submaps"]
    assert [submap["name"] for submap in submaps] == ["0, the main one", "3"]
    assert decoded(submaps[1]["frame"]).tolist() == [18, 19]
    assert decoded(submaps[1]["keyframe"]).tolist() == [18]


def test_without_a_map_the_page_gives_the_reason(tmp_path: Path, run: Run) -> None:
    why = "no map was initialized: </script> & <b>"
    write(replace(run, submaps=(), failure=why), tmp_path)
    text = write_view(read_results(tmp_path), tmp_path).read_text()
    data = data_of(text)
    assert (data["submaps"], data["failure"]) == ([], why)


# --- in a browser --------------------------------------------------------------------------------------------------


def browse(path: Path, *arguments: str, at: str = "") -> str:
    """What a browser without a network, started anew, says about a page."""
    if BROWSER is None:
        pytest.skip("no chromium here: the page is not tried in a browser")
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ]
    offline = ("--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={path.parent / 'profile'}")
    command += [*offline, "--window-size=1000,700", "--virtual-time-budget=2000", *arguments]
    done = subprocess.run(
        [*command, path.as_uri() + at], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout


def test_a_browser_shows_the_selected_frame(tmp_path: Path, kept: Results) -> None:
    dom = browse(write_view(kept, tmp_path), "--dump-dom", at="#frame=19")
    (ready,) = re.findall(r'data-ready="([^"]*)"', dom)
    assert ready == "frame 19 · 0.63 s · lost · no pose here · few matches: 8, &quot;20&quot; are needed"
    assert f'id="count-points">{kept.map.num_points}<' in dom
    assert 'id="count-keyframes">6<' in dom
    assert re.search(r'id="trouble"[^>]* hidden', dom)


def test_a_browser_draws_the_points_in_their_colors(tmp_path: Path, kept: Results) -> None:
    kept.map.points["colors"][:] = torch.tensor([0, 255, 0], dtype=torch.uint8)
    picture = tmp_path / "picture.png"
    browse(write_view(kept, tmp_path), f"--screenshot={picture}")
    blue, green, red = cv2.imread(str(picture)).astype(int).transpose(2, 0, 1)
    rows, _ = np.nonzero((green > 180) & (red < 80) & (blue < 80))
    assert len(rows) > 300
    middle = (rows.min() + rows.max()) / 2
    assert middle < 0.47 * len(green), "what the strip of frames leaves has another middle than the window"


def test_a_browser_shows_the_reason_for_no_map(tmp_path: Path, run: Run) -> None:
    write(replace(run, submaps=(), failure="the camera <i>stands</i> still"), tmp_path)
    dom = browse(write_view(read_results(tmp_path), tmp_path), "--dump-dom")
    assert 'role="alert">the camera &lt;i&gt;stands&lt;/i&gt; still<' in dom


def test_a_browser_draws_the_dense_cloud_as_closed_surfaces(
    tmp_path: Path, kept: Results, dense: PointCloud
) -> None:
    path = write_view(replace(kept, cloud=dense), tmp_path)
    dom = browse(path, "--dump-dom")
    assert f'id="count-dense">{len(dense):,}<' in dom
    picture = tmp_path / "picture.png"
    browse(path, f"--screenshot={picture}")
    blue, green, red = cv2.imread(str(picture)).astype(int).transpose(2, 0, 1)
    is_green = ((green > 180) & (red < 80) & (blue < 80)).astype(np.uint8)
    closed = cv2.morphologyEx(is_green, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    assert is_green.sum() > 8_000
    assert is_green.sum() > 0.85 * closed.sum(), "there are holes between the points"
