"""What the page shows of results: the data of view.html, images, errors; and what is measured in it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cli.conftest import finished
from torchslam.app import reading
from torchslam.errors import ResultsError
from torchslam.io.results import TRAJECTORY, read_metrics, read_results

__all__ = ["finished"]


def test_a_result_has_the_data_of_the_page(finished: Path) -> None:
    data, metrics = reading.result(finished), read_metrics(finished)
    submap = data["submap"]
    assert submap["poses"].shape == (metrics["posed"], 3, 4)
    assert submap["keyframe_poses"].shape == (metrics["keyframes"], 3, 4)
    assert submap["points"].dtype == np.float32
    assert data["summary"]["check"].endswith(metrics["check"]["sentence"])
    assert data["timeline"].shape == (260, 500, 3)
    frames = submap["frames"].tolist()
    images = submap["images"]
    assert images.keys() == set(range(len(frames)))
    assert all(max(image.shape) == reading.THUMBNAIL_SIDE for image in images.values())
    drawn, words = reading.residuals(finished, frames[0])
    assert drawn.shape[2] == 3
    assert words.startswith(f"frame {frames[0]}: ")
    assert float(words.split("residual ")[1].split(" px")[0]) < 1.0


def test_a_path_is_the_same_as_itself_and_close_to_the_truth(finished: Path) -> None:
    submap = reading.result(finished)["submap"]
    positions, words = reading.compared(finished, finished / TRAJECTORY, False, submap["S_shown_map"])
    np.testing.assert_allclose(positions, submap["poses"][:, :, 3], atol=1e-4)
    assert float(words.split()[1]) < 1e-6
    _, words = reading.compared(finished, finished / "groundtruth.txt", True, submap["S_shown_map"])
    assert words.startswith(f"ATE {read_metrics(finished)['ate_m']:.4g} m RMSE")


def crash(folder: Path) -> None:
    os._exit(139)


def echo(folder: Path, value: int) -> int:
    return value


def test_a_file_that_ends_the_reading_process_is_an_error_and_the_next_one_is_read(tmp_path: Path) -> None:
    reader = reading.ReadingProcess()
    try:
        assert reader.call(echo, tmp_path, 3) == 3
        with pytest.raises(ResultsError, match="ended its process"):
            reader.call(crash, tmp_path)
        assert reader.call(echo, tmp_path, 4) == 4
        with pytest.raises(ResultsError, match=r"metrics\.json"):
            reader.call(reading.result, tmp_path)
    finally:
        reader.close()


class TestMeasures:
    """The ruler and the plane of scene.py."""

    @pytest.fixture(autouse=True)
    def scene(self) -> Any:
        pytest.importorskip("viser", reason="the page needs viser: pip install 'torchslam[app]'")
        from torchslam.app import scene

        self.code = scene
        return scene

    def test_the_length_of_two_points_has_their_errors(self, finished: Path) -> None:
        submap = reading.result(finished)["submap"]
        results = read_results(finished)
        slam_map = results.map
        ids = slam_map.valid_points()
        S = np.array(submap["S_shown_map"])
        scale = np.cbrt(np.linalg.det(S[:3, :3]))
        covariances = slam_map.points["covariances_w"][ids].double().numpy()
        known = [row for row in range(len(ids)) if np.linalg.eigvalsh(covariances[row])[0] > 0]
        rows = [known[0], known[-1]]
        positions = slam_map.positions_w[ids].double().numpy()[rows]
        between = positions[1] - positions[0]
        along = between / np.linalg.norm(between)
        expected_std = scale * np.sqrt(sum(along @ covariances[row] @ along for row in rows))
        length, std = self.code.length_between(submap, rows)
        assert length == pytest.approx(scale * np.linalg.norm(between), rel=1e-4)
        assert std == pytest.approx(expected_std, rel=0.02)
        unknown = submap | {"error_step": np.zeros_like(submap["error_step"])}
        assert np.isnan(self.code.length_between(unknown, rows)[1])
        click = self.code.click_of(submap, rows[0])
        assert click is not None
        frame, _, pixel = click.partition(":")
        assert int(frame) in range(16)
        x, y = map(float, pixel.split(","))
        assert 0 <= x < 640
        assert 0 <= y < 480

    def test_a_length_is_written_to_two_digits_of_its_error(self) -> None:
        assert self.code.length_words(1.23456, 0.0123, "m") == "1.235 ± 0.012 m"
        assert self.code.length_words(1.23456, float("nan"), "") == "1.235 map units"

    def test_a_click_means_the_nearest_point_along_its_ray(self) -> None:
        points = np.array([[0.0, 0, 5], [0.02, 0, 2], [0, 0, -1], [3, 0, 5]])
        eye, ahead = np.zeros(3), np.array([0.0, 0, 1])
        assert self.code.nearest_to_ray(points, eye, ahead, 1e-2) == 1  # in front of the other
        assert self.code.nearest_to_ray(points, eye, ahead, 1e-4) == 0  # the near one is 100 pixels away
        assert self.code.nearest_to_ray(points, eye, np.array([0.0, 1, 0]), 1e-3) == -1
        assert self.code.nearest_to_ray(points[:0], eye, ahead, 1e-3) == -1

    def test_a_click_into_a_frustum_takes_the_nearest_image(self) -> None:
        corners = np.array([[-1.0, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]])
        poses = np.stack([np.eye(3, 4)] * 3)
        poses[0, 2, 3], poses[2, :, :3] = (
            5.0,
            [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
        )  # behind the second, and turned
        eye = np.array([0.9, 0.9, -1.0])
        assert self.code.frustum_on_ray(poses, corners, eye, np.array([0.0, 0, 1])) == 1
        assert self.code.frustum_on_ray(poses, corners, eye, np.array([0.0, 0, -1])) == -1
        assert self.code.frustum_on_ray(poses, corners, np.array([5.0, 0.5, 0]), np.array([-1.0, 0, 0])) == 2
        assert self.code.frustum_on_ray(poses[:0], corners, eye, np.array([0.0, 0, 1])) == -1

    def test_the_plane_of_a_floor_faces_the_eye(self) -> None:
        rng = np.random.default_rng(0)
        floor = np.c_[rng.uniform(-1, 1, (200, 2)), rng.normal(0, 1e-3, 200)]
        normal = self.code.plane_normal(floor, 0, np.array([0.0, 0, 3]))
        assert normal @ [0, 0, 1] > np.cos(np.radians(1))
        assert self.code.plane_normal(floor, 0, np.array([0.0, 0, -3])) @ [0, 0, 1] < 0

    def test_a_path_is_drawn_by_points_along_its_steps_and_none_across_a_break(self) -> None:
        path = np.array([[0.0, 0, 0], [1, 0, 0], [5, 5, 5], [5, 5, 8]])
        points, ends = self.code.beads(path, np.array([True, False, True]))
        on_first, on_last = (points[:, 1:] == 0).all(axis=1), (points[:, :2] == 5).all(axis=1)
        assert (on_first | on_last).all()
        assert on_last.mean() == pytest.approx(0.75, abs=0.01)  # by length
        np.testing.assert_array_equal(ends[on_last], 3)
        for few in range(2):
            assert self.code.beads(path[:few], np.ones(0, bool))[0].shape == (few, 3)
