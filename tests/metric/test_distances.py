"""A known length between two clicks."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from tests.map.simulated import CAMERA
from tests.metric.plane_world import PlaneWorld
from tests.scene import sideways
from torchslam.errors import MeasurementError
from torchslam.geometry import se3_inverse
from torchslam.metric.distances import Click, Distance, Distances, parse_distance
from torchslam.metric.image_depth import LocatedPixel, locate_pixel
from torchslam.metric.source import ScaleMeasurement, SubmapView, Unmeasured

CLICKS = Click(4, (90.0, 60.0)), Click(4, (220.0, 150.0))


@pytest.fixture(scope="module")
def world() -> PlaneWorld:
    return PlaneWorld.slanted()


@pytest.fixture(scope="module")
def view(world: PlaneWorld) -> SubmapView:
    return world.view()


def true_points(world: PlaneWorld, clicks: Sequence[Click] = CLICKS) -> torch.Tensor:
    pixels = torch.tensor([click.pixel for click in clicks], dtype=torch.float64)
    return world.points_w(clicks[0].frame, pixels)


def test_a_pixel_is_located_within_its_error(world: PlaneWorld, view: SubmapView) -> None:
    for click, true_w in zip(CLICKS, true_points(world), strict=True):
        found = locate_pixel(view, click.frame, click.pixel)
        assert isinstance(found, LocatedPixel)
        off_w = found.point_w - true_w
        assert float(off_w.norm()) < 0.03
        assert (
            float(off_w @ torch.linalg.solve(found.covariance_w, off_w)) < 12
        )  # 99 % of three normal numbers


class Step(PlaneWorld):
    """A wall, and on its left side another one in front of it."""

    FRONT = 0.85
    """Of the distance of the wall behind."""

    def points_w(self, index: int, pixels: torch.Tensor) -> torch.Tensor:
        behind_w = super().points_w(index, pixels)
        center_w = se3_inverse(self.T_cw[index])[:3, 3]
        front_w = center_w + (behind_w - center_w) * (
            (self.FRONT * self.offset - self.normal_w @ center_w)
            / ((behind_w - center_w) @ self.normal_w)[:, None]
        )
        return torch.where(front_w[:, :1] < 0, front_w, behind_w)


def test_the_error_at_an_edge_has_both_surfaces_in_it() -> None:
    world = Step(sideways(9), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 4.5)
    view, frame = world.view(), 4
    width, height = CAMERA.size
    y = torch.tensor([0.3, 0.4, 0.6]) * height
    across = torch.stack(torch.meshgrid(torch.arange(width).double(), y.double(), indexing="ij"), dim=-1)
    front = world.points_w(frame, across.flatten(0, 1))[:, 2].reshape(width, len(y)) < 4.2
    edge = front.sum(dim=0)  # the first column of the wall behind, of each row
    whitened, stated = [], {2: list[float](), 40: list[float]()}
    for off in (-40, -2, 2, 40):
        for row, column in enumerate(edge.tolist()):
            pixel = (float(column + off), float(y[row]))
            found = locate_pixel(view, frame, pixel)
            if not isinstance(found, LocatedPixel):
                continue
            true_w = world.points_w(frame, torch.tensor([pixel], dtype=torch.float64))[0]
            std = float(found.covariance_w[2, 2].sqrt())
            whitened.append(float((found.point_w - true_w)[2].abs()) / std)
            stated[abs(off)].append(std)
    assert len(stated[40]) >= 4
    assert len(stated[2]) >= 2
    assert max(whitened) < 4
    assert statistics.median(stated[2]) > 3 * max(stated[40])


def test_a_length_gives_the_unit(world: PlaneWorld, view: SubmapView) -> None:
    length = float(true_points(world).diff(dim=0).norm())
    found = Distances([Distance(*CLICKS, 0.3 * length)]).measure(view)
    assert isinstance(found, ScaleMeasurement)
    assert abs(math.log(found.meters_per_unit / 0.3)) < 2 * found.relative_std < 0.06
    both = Distances([Distance(*CLICKS, 0.3 * length), Distance(*CLICKS, 0.4 * length)]).measure(view)
    assert isinstance(both, ScaleMeasurement)
    assert len(both.rejected) == 2  # of two, none is right
    assert both.relative_std > 0.05


def test_what_is_not_found_is_said(world: PlaneWorld, view: SubmapView) -> None:
    def reason(*clicks: Click, view: SubmapView = view) -> str:
        found = Distances([Distance(clicks[0], clicks[1], 1.0)]).measure(view)
        assert isinstance(found, Unmeasured)
        return found.reason

    assert "frame 77 has no pose" in reason(Click(77, (9.0, 9.0)), CLICKS[1])
    assert "shorter than its error" in reason(CLICKS[0], Click(4, (90.5, 60.0)))
    assert "no images" in reason(*CLICKS, view=replace(view, sequence=None))
    flat = PlaneWorld(world.T_cw, world.normal_w, world.offset)
    flat.texture[:] = 0.5
    assert "looks different" in reason(*CLICKS, view=replace(view, sequence=flat))


def test_a_click_out_of_the_image_is_an_error(view: SubmapView) -> None:
    with pytest.raises(MeasurementError, match=f"outside of the image of {CAMERA.width} x {CAMERA.height}"):
        Distances([Distance(CLICKS[0], Click(4, (9999.0, 3.0)), 1.0)]).measure(view)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("1:2,3", "4:5", "1"), "write a point as FRAME:X,Y, not '4:5'"),
        (("x:2,3", "4:5,6", "1"), "write a point as FRAME:X,Y"),
        (("1:2,nan", "4:5,6", "1"), "is no point of an image"),
        (("-1:2,3", "4:5,6", "1"), "is no point of an image"),
        (("1:2,3", "4:5,6", "1m"), "no length in meters"),
        (("1:2,3", "4:5,6", "0"), "no length in meters"),
        (("1:2,3", "1:2,3", "1"), "both points are the same"),
    ],
)
def test_wrong_words_are_named(words: tuple[str, str, str], what: str) -> None:
    with pytest.raises(MeasurementError, match=what):
        parse_distance(words)
