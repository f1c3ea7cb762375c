"""What markers say of the unit of a submap."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from tests.map.simulated import CAMERA, simulated_submap
from torchslam.geometry import Camera, SensorModel, transform
from torchslam.metric.markers.detection import Detection, Target, parse_target
from torchslam.metric.markers.source import Markers, PlacedTarget, log_sizes
from torchslam.metric.source import ScaleMeasurement, SubmapView, Unmeasured

SIDE = 0.5
"""Of all markers, units of the map."""
UNIT = 0.2
"""Meters in a unit: a marker of .1 m."""
PLACES = ((-0.5, -0.3, 3.6), (0.4, 0.2, 4.2), (0.3, -0.5, 4.5), (-0.4, 0.5, 4.0))


class Numbers:
    """Images that say which frame they are."""

    brings_features = False

    def image(self, index: int) -> Tensor:
        return torch.full((1, 1, 1, 1), index / 255)

    def file_name(self, index: int) -> str:
        return ""


class Seer:
    """A detector that knows where markers are."""

    def __init__(self, T_cw: Tensor, identities: dict[int, float], noise_px: float = 0.05) -> None:
        self.T_cw, self.identities, self.noise_px = T_cw, identities, noise_px

    def detect(self, image: np.ndarray) -> list[Detection]:
        index = int(image[0, 0])
        rng = np.random.default_rng(index)
        found = []
        for place, (identity, scale) in zip(PLACES, self.identities.items(), strict=False):
            corners = 2.5 * SIDE * scale * parse_target("aruco-4x4:0.4").corners(0)
            corners_w = torch.from_numpy(np.append(corners, np.zeros((4, 1)), axis=1) + np.array(place))
            pixels, _ = CAMERA.to(torch.float64).project(transform(self.T_cw[index], corners_w))
            found.append(
                Detection(identity, np.arange(4), pixels.numpy() + rng.normal(0, self.noise_px, (4, 2)))
            )
        return found


def measured(
    text: str, identities: dict[int, float], twice: bool = False
) -> tuple[ScaleMeasurement | Unmeasured, SubmapView]:
    submap = simulated_submap(frames=25)
    frames = submap.posed_frames
    view = SubmapView(submap, CAMERA.to(torch.float64), 0, Numbers())
    seer = Seer(frames.T_cw(submap.map).clone(), identities)

    def make(target: Target, camera: Camera) -> Seer:
        return seer

    if twice:
        detect = seer.detect
        seer.detect = lambda image: [*detect(image), detect(image)[0]]  # type: ignore[method-assign]
    return Markers([parse_target(text)], make).measure(view), view


def error_of(found: ScaleMeasurement) -> float:
    return abs(math.log(found.meters_per_unit / UNIT))


def test_markers_give_the_unit_and_its_error() -> None:
    found, view = measured("aruco-4x4:0.1", dict.fromkeys(range(4), 1.0))
    assert isinstance(found, ScaleMeasurement)
    assert found.count == 4
    assert found.unit == "markers"
    assert found.rejected == ()
    assert error_of(found) < 3 * found.relative_std < 0.1
    # The adjustment, whose poses are kept, stays one of the images.
    graph = view.submap.posed_frames.graph(view.submap.map, SensorModel(view.camera))
    points_c = transform(graph.T_cw[graph.frame_index], graph.points_w[graph.point_index][:, None])[:, 0]
    assert float((view.camera.project(points_c)[0] - graph.pixels).norm(dim=-1).median()) < 1.0


def test_a_marker_of_another_size_is_named_and_does_not_count() -> None:
    found, _ = measured("aruco-4x4:0.1", {3: 1.0, 5: 1.2, 7: 1.0, 9: 1.0})
    assert isinstance(found, ScaleMeasurement)
    assert found.count == 3
    assert error_of(found) < 3 * found.relative_std
    assert len(found.rejected) == 1
    assert "aruco-4x4 5 is" in found.rejected[0]
    assert "larger than stated" in found.rejected[0]
    told, _ = measured("aruco-4x4:0.1,5=0.12", {3: 1.0, 5: 1.2, 7: 1.0, 9: 1.0})
    assert isinstance(told, ScaleMeasurement)
    assert told.count == 4
    assert told.rejected == ()


def test_of_two_markers_that_contradict_each_other_none_is_believed_alone() -> None:
    found, _ = measured("aruco-4x4:0.1", {3: 1.0, 5: 1.2})
    assert isinstance(found, ScaleMeasurement)
    assert found.count == 2
    assert "one of both is wrong" in found.rejected[0]
    assert found.relative_std > 0.05


def test_one_marker_is_enough() -> None:
    found, _ = measured("aruco-4x4:0.1", {3: 1.0})
    assert isinstance(found, ScaleMeasurement)
    assert found.unit == "marker"
    assert error_of(found) < 3 * found.relative_std


def test_a_marker_that_is_there_twice_is_named() -> None:
    found, _ = measured("aruco-4x4:0.1", {3: 1.0, 5: 1.0}, twice=True)
    assert isinstance(found, ScaleMeasurement)
    assert found.count == 1
    assert found.rejected == ("aruco-4x4 3 appears twice: not used",)


def test_without_markers_or_images_it_says_why() -> None:
    found, view = measured("aruco-4x4:0.1", {})
    assert isinstance(found, Unmeasured)
    assert "no image shows a marker (aruco-4x4)" in found.reason
    blind = SubmapView(view.submap, view.camera)
    answer = Markers([parse_target("aruco-4x4:0.1")]).measure(blind)
    assert isinstance(answer, Unmeasured)


def test_the_size_is_differentiable() -> None:
    generator = torch.Generator().manual_seed(0)
    points_w = torch.rand(8, 3, generator=generator, dtype=torch.float64).requires_grad_()
    sizes = torch.rand(2, 4, 2, generator=generator, dtype=torch.float64).requires_grad_()

    def logs(points_w: Tensor, sizes: Tensor) -> Tensor:
        none = (points_w[:4], torch.arange(0), torch.arange(0), sizes[0, :0], sizes[0, :0, 0])
        return log_sizes(
            [PlacedTarget("", torch.arange(4) + 4 * row, sizes[row], *none) for row in (0, 1)], points_w
        )

    assert torch.autograd.gradcheck(logs, (points_w, sizes))
    assert torch.allclose(logs(2 * points_w, sizes), logs(points_w, sizes) - math.log(2))
