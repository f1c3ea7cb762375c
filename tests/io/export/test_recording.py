"""rerun reads its recording, and the points fall on the keypoints in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.box_room import box_cloud, box_depths
from tests.io.export.conftest import PointErrors, reprojection_error
from tests.walks import Walk, arc
from torchslam.geometry import Camera
from torchslam.geometry.transforms import upright_rotation
from torchslam.io.export.recording import write_recording
from torchslam.io.export.scene import ExportedScene, Images, undistorted

chunks = pytest.importorskip("rerun.chunk", reason="rerun is not installed: pip install 'torchslam[rerun]'")

Rows = dict[tuple[str, str], list[tuple[int | None, Any]]]


@pytest.fixture
def flat(scene: ExportedScene) -> ExportedScene:
    return undistorted(scene)


@pytest.fixture
def recorded(flat: ExportedScene, tmp_path: Path) -> Rows:
    sequence = Walk(arc(91))  # one image per frame
    images = Images(sequence, {index: index for index in range(91)}, flat.camera)
    write_recording(tmp_path / "it.rrd", flat, upright_rotation(flat.T_wc), images)
    return read(tmp_path / "it.rrd")


def read(path: Path) -> Rows:
    """Every value that was logged, by entity and component, with its frame; static ones with None."""
    rows: Rows = {}
    for chunk in chunks.RrdReader(path).store().stream():
        columns = chunk.to_record_batch().to_pydict()
        frames = columns.get("frame", [None] * chunk.num_rows)
        for name, values in columns.items():
            if ":" in name:
                logged = zip(frames, values, strict=True)
                rows.setdefault((chunk.entity_path, name), []).extend(logged)
    return {
        key: sorted(values, key=lambda row: -1 if row[0] is None else row[0]) for key, values in rows.items()
    }


def only(rows: Rows, entity: str, component: str) -> np.ndarray:
    ((frame, value),) = rows[entity, component]
    assert frame is None  # static
    return np.array(value)


def test_points_fall_on_their_keypoints(flat: ExportedScene, recorded: Rows) -> None:
    points = only(recorded, "/world/points", "Points3D:positions")
    K = only(recorded, "/world/keyframe", "Pinhole:image_from_camera").reshape(3, 3).T  # by columns
    rotations = dict(recorded["/world/keyframe", "Transform3D:mat3x3"])
    positions = dict(recorded["/world/keyframe", "Transform3D:translation"])
    errors = PointErrors(len(points))
    keyframes = flat.frame_ids[flat.is_keyframe].tolist()
    assert [frame for frame, _ in recorded["/world/keyframe/keypoints", "Points2D:positions"]] == keyframes
    for frame, keypoints in recorded["/world/keyframe/keypoints", "Points2D:positions"]:
        row = flat.frame_ids.tolist().index(frame)
        ids = flat.point_index[flat.frame_index == row].numpy()
        R_wc = np.array(rotations[frame]).reshape(3, 3).T
        in_camera = (points[ids] - np.array(positions[frame])) @ R_wc
        pixels = (in_camera / in_camera[:, 2:]) @ K.T
        errors.add(ids, pixels[:, :2], np.array(keypoints))
        centered = flat.pixels[flat.frame_index == row].numpy() + 0.5  # the corner of the image is the origin
        np.testing.assert_allclose(keypoints, centered, atol=1e-3)
    expected = reprojection_error(only_keyframes(flat))
    assert errors.mean() == pytest.approx(expected, abs=1e-3)


def only_keyframes(scene: ExportedScene) -> ExportedScene:
    kept = scene.is_keyframe[scene.frame_index]
    return replace(
        scene,
        frame_index=scene.frame_index[kept],
        point_index=scene.point_index[kept],
        pixels=scene.pixels[kept],
    )


def test_keypoints_have_the_colors_of_their_points(flat: ExportedScene, recorded: Rows) -> None:
    frame, colors = recorded["/world/keyframe/keypoints", "Points2D:colors"][-1]
    ids = flat.point_index[flat.frame_index == flat.frame_ids.tolist().index(frame)]
    red = np.array(colors, dtype=np.uint32) >> 24  # red, green, blue, opacity
    np.testing.assert_array_equal(red, flat.colors[ids, 0])


def test_every_frame_has_a_pose_and_a_time(flat: ExportedScene, recorded: Rows) -> None:
    frames = [frame for frame, _ in recorded["/world/camera", "Transform3D:translation"]]
    assert frames == flat.frame_ids.tolist()
    positions = np.array([value for _, value in recorded["/world/camera", "Transform3D:translation"]])
    upright = flat.turned(upright_rotation(flat.T_wc)).T_wc[:, :3, 3].numpy()
    np.testing.assert_allclose(positions.reshape(-1, 3), upright, atol=1e-6)


def test_the_path_is_broken_where_frames_are_missing(flat: ExportedScene, recorded: Rows) -> None:
    ((_, strips),) = recorded["/world/path", "LineStrips3D:strips"]
    assert [len(strip) for strip in strips] == [3, 1]  # frame 90 comes long after frame 6


def test_keyframes_have_their_image(flat: ExportedScene, recorded: Rows) -> None:
    logged = recorded["/world/keyframe", "EncodedImage:blob"]
    assert [frame for frame, _ in logged] == flat.frame_ids[flat.is_keyframe].tolist()
    content = np.array(logged[0][1], dtype=np.uint8).reshape(-1)
    assert cv2.imdecode(content, cv2.IMREAD_COLOR).shape == (240, 320, 3)


def test_depth_and_the_dense_cloud_are_recorded(flat: ExportedScene, tmp_path: Path) -> None:
    maps = box_depths(
        flat.T_cw[1:], flat.frame_ids[1:], Camera.pinhole(50.0, 52.5, 39.5, 29.5, size=(80, 60))
    )
    maps.save(tmp_path / "depths.safetensors")
    R_up, cloud = upright_rotation(flat.T_wc), box_cloud(maps)
    write_recording(tmp_path / "it.rrd", flat, R_up, None, cloud, tmp_path / "depths.safetensors")
    rows = read(tmp_path / "it.rrd")
    np.testing.assert_allclose(
        only(rows, "/world/dense", "Points3D:positions"), cloud.points_w @ R_up.float().mT, atol=1e-5
    )
    assert only(rows, "/world/depth", "Pinhole:resolution").flatten().tolist() == [80, 60]
    logged = rows["/world/depth", "EncodedDepthImage:blob"]
    assert [frame for frame, _ in logged] == [5, 6, 90]
    for depth, (_, blob) in zip(maps.depth, logged, strict=True):
        image = cv2.imdecode(np.array(blob, np.uint8).reshape(-1), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(image / 1000, depth, atol=5.1e-4)
    assert {np.array(value).item() for _, value in rows["/world/depth", "EncodedDepthImage:meter"]} == {
        1000.0
    }
    centers = np.array([value for _, value in rows["/world/depth", "Transform3D:translation"]]).reshape(-1, 3)
    np.testing.assert_allclose(centers, flat.T_wc[1:, :3, 3] @ R_up.mT, atol=1e-6)
