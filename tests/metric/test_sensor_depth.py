"""The unit of a map from depth images."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tests.map.simulated import CAMERA
from tests.metric.drives import measure, reason
from tests.metric.plane_world import PlaneWorld
from torchslam.data import open_sequence
from torchslam.data.formats import depth_images
from torchslam.data.formats.depth_images import find_depth_images
from torchslam.errors import CalibrationError, MeasurementError
from torchslam.evaluation import evaluate
from torchslam.geometry import Camera, transform
from torchslam.metric.sensor_depth import SensorDepth, from_options, nearest_times
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView
from torchslam.system.slam import SLAM

METERS_PER_UNIT = 0.4
FRAMES = 9


class NamedWorld(PlaneWorld):
    """Images with names."""

    def file_name(self, index: int) -> str:
        return f"rgb/frame-{index:06d}.color.png"


@pytest.fixture(scope="module")
def world() -> NamedWorld:
    return NamedWorld.slanted(FRAMES)


@pytest.fixture(scope="module")
def view(world: NamedWorld) -> SubmapView:
    return world.view(400)


def true_depth(world: PlaneWorld, index: int, camera: Camera = CAMERA) -> Tensor:
    """Meters, in a frame of a camera."""
    width, height = camera.size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = camera.to(torch.float64).unproject(torch.stack((x, y), dim=-1).reshape(-1, 2).double())
    shown, _ = CAMERA.to(torch.float64).project(rays)
    z = transform(world.T_cw[index], world.points_w(index, shown))[:, 2]
    return METERS_PER_UNIT * z.reshape(height, width)


def write(path: Path, depth: Tensor, units: float = 1000.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), (units * depth).round().clamp(0, 65535).numpy().astype(np.uint16))


def write_all(
    folder: Path, world: PlaneWorld, name: str = "frame-{:06d}.depth.png", units: float = 1000.0
) -> None:
    for index in range(FRAMES):
        write(folder / name.format(index), true_depth(world, index), units)


def error(found: ScaleMeasurement) -> float:
    return math.log(found.meters_per_unit / METERS_PER_UNIT)


def test_exact_depth_gives_the_unit(world: NamedWorld, view: SubmapView, tmp_path: Path) -> None:
    write_all(tmp_path, world)
    found = measure(SensorDepth(find_depth_images(tmp_path)), view)
    assert found.source is ScaleSource.DEPTH
    assert found.count >= FRAMES - 1
    assert abs(error(found)) < 0.002
    assert 0.015 <= found.relative_std < 0.02
    assert found.rejected == found.notes == ()


def test_the_scale_of_the_values_is_that_of_the_option(
    world: NamedWorld, view: SubmapView, tmp_path: Path
) -> None:
    write_all(tmp_path / "d:1", world, units=250.0)
    (source,) = from_options({"depth": ((f"{tmp_path / 'd:1'}:250",),)})
    assert isinstance(source, SensorDepth)
    assert abs(error(measure(source, view))) < 0.005
    write_all(tmp_path / "plain", world, "{:d}.png")
    (source,) = from_options({"depth": ((str(tmp_path / "plain"),),)})
    assert isinstance(source, SensorDepth)
    found = measure(source, view)
    assert abs(error(found)) < 0.002
    assert "assuming 1000 units per meter" in found.notes[0]


def test_a_list_is_matched_by_times(world: NamedWorld, view: SubmapView, tmp_path: Path) -> None:
    """A few milliseconds off; images between two frames are nobody's."""
    times = view.timestamps.tolist()
    step = times[1] - times[0]
    lines = []
    for index, time in enumerate(times):
        write(tmp_path / "depth" / f"{index}.png", true_depth(world, index), 5000.0)
        lines += [f"{time + 0.1 * step} depth/{index}.png", f"{time + 0.5 * step} depth/none.png"]
    (tmp_path / "depth.txt").write_text("# depth maps\n" + "\n".join(lines) + "\n")
    for path in (tmp_path, tmp_path / "depth", tmp_path / "depth.txt"):
        found = measure(SensorDepth(find_depth_images(path)), view)
        assert found.count >= FRAMES - 1
        assert found.rejected == ()
        assert abs(error(found)) < 0.002


def test_a_list_has_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_images, "MAX_FILES", 3)
    for count, message in ((3, None), (4, "depth.txt: more than 3 depth images")):
        (tmp_path / "depth.txt").write_text("".join(f"{index} depth/{index}.png\n" for index in range(count)))
        if message is None:
            assert len(find_depth_images(tmp_path).paths) == count
        else:
            with pytest.raises(MeasurementError, match=message):
                find_depth_images(tmp_path)


def test_values_without_depth_do_not_count(world: NamedWorld, view: SubmapView, tmp_path: Path) -> None:
    """0, 65535, and surfaces in front that the map does not have."""
    generator = torch.Generator().manual_seed(0)
    for index in range(FRAMES):
        depth = true_depth(world, index)
        height, width = depth.shape
        depth[: height // 3] = 0
        depth[:, : width // 4] = 65.535
        noise = 1.5e-3 * depth.square() * torch.randn(depth.shape, generator=generator, dtype=torch.float64)
        depth[:, : width // 4] -= noise[:, : width // 4]
        depth[height * 7 // 8 :] *= 0.9
        write(tmp_path / f"frame-{index:06d}.depth.png", depth)
    found = measure(SensorDepth(find_depth_images(tmp_path)), view)
    assert abs(error(found)) < 0.005


def test_depth_of_another_camera(world: NamedWorld, view: SubmapView, tmp_path: Path) -> None:
    camera = Camera.pinhole(260.0, 260.0, 150.0, 110.0, size=(300, 220))
    for index in range(FRAMES):
        write(tmp_path / f"{index}.png", true_depth(world, index, camera))
    own = SensorDepth(find_depth_images(tmp_path), "260,260,150,110")
    assert abs(error(measure(own, view))) < 0.003
    with pytest.raises(CalibrationError, match="--depth-camera"):
        from_options({"depth": ((str(tmp_path),),), "depth_camera": (("hello",),)})


def test_images_that_contradict_the_others_are_named(
    world: NamedWorld, view: SubmapView, tmp_path: Path
) -> None:
    for index in range(FRAMES):
        noise = 1 + 0.002 * math.sin(5 * index)
        write(tmp_path / f"{index}.png", true_depth(world, index) * (1.5 if index == 3 else noise))
    (tmp_path / "5.png").write_bytes(b"no image")
    found = measure(SensorDepth(find_depth_images(tmp_path)), view)
    assert abs(error(found)) < 0.005
    assert found.rejected == ("1 of 8 depth images, the first one that of frame 3, are +50% to +50% off",)
    assert "1 depth images cannot be read" in found.notes[-1]


def test_what_says_nothing_is_said(world: NamedWorld, view: SubmapView, tmp_path: Path) -> None:
    write_all(tmp_path / "a", world)
    images = find_depth_images(tmp_path / "a")
    assert "neither times nor those of the images" in reason(
        SensorDepth(images), replace(view, sequence=None)
    )
    late = replace(images, timestamps=view.timestamps + 100.0)
    assert "within half a frame" in reason(SensorDepth(late), replace(view, sequence=None))
    for index in range(FRAMES):
        write(tmp_path / "b" / f"{index}.png", 0 * true_depth(world, index))
    assert "have depth in 0 of 9 depth images" in reason(SensorDepth(find_depth_images(tmp_path / "b")), view)


def test_another_unit_is_an_error(world: NamedWorld, view: SubmapView, tmp_path: Path) -> None:
    write_all(tmp_path, world)
    with pytest.raises(MeasurementError, match=r"with 1 units per meter: give the right number"):
        SensorDepth(find_depth_images(tmp_path, 1.0)).measure(view)


def test_the_nearest_time_is_less_than_half_an_interval_away() -> None:
    times = torch.tensor([0.0, 1.0, 2.0, 3.0], dtype=torch.float64)
    others = torch.tensor([0.3, 0.9, 1.4, 2.05, 9.0], dtype=torch.float64)
    assert nearest_times(times, others).tolist() == [0, 1, 3, -1]
    assert nearest_times(times, others[1:2]).tolist() == [-1, 0, -1, -1]


@pytest.mark.slow
def test_a_sensor_beside_the_camera(data_dir: Path) -> None:
    """A Kinect's depth that is not registered to the color images. Poses by its fusion are 2 to 5 cm off, over half a
    meter: by them the unit of this map is from 1.79 to 2.04 m along the recording, by depth images 1.91 to 1.92."""
    folder = data_dir / "redkitchen"
    sequence = open_sequence(folder, limit=120)
    run = SLAM(sequence.camera).run(sequence)
    assert run.main is not None
    assert sequence.groundtruth is not None
    scale = evaluate(run.trajectory, sequence.groundtruth).scale
    source = SensorDepth(find_depth_images(folder / "depth"), "585,585,320,240")
    found = measure(source, SubmapView(run.main, run.camera, 0, sequence))
    assert found.count >= 10
    assert abs(math.log(found.meters_per_unit / scale)) < 0.08
    assert found.relative_std < 0.025
    assert found.apart is not None
    assert found.apart < 0.015
