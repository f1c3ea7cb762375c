"""Zooms: ratios between frames, composition, pixels, and what is read from files."""

from __future__ import annotations

import json

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.geometry import Camera
from torchslam.geometry.zoom import Zoom

CAMERA = Camera.pinhole(500, 510, 320, 240, size=(640, 480))


def zoom(ratios: dict[int, float]) -> Zoom:
    return Zoom(torch.tensor(list(ratios)), torch.tensor(list(ratios.values()), dtype=torch.float64))


def test_ratios_are_interpolated_in_the_logarithm() -> None:
    found = zoom({2: 1.0, 4: 4.0, 5: 2.0}).at(torch.tensor([0, 2, 3, 4, 5, 9]))
    torch.testing.assert_close(found, torch.tensor([1.0, 1.0, 2.0, 4.0, 2.0, 2.0], dtype=torch.float64))


def test_a_zoom_of_one_frame_is_constant() -> None:
    assert zoom({3: 1.5}).at(torch.tensor([0, 3, 8])).tolist() == [1.5] * 3


@given(
    st.lists(st.floats(0.5, 2.0), min_size=2, max_size=6),
    st.lists(st.floats(0.5, 2.0), min_size=2, max_size=6),
)
def test_zooms_compose_and_divide(first: list[float], second: list[float]) -> None:
    one, other = zoom(dict(enumerate(first))), zoom({2 * row: ratio for row, ratio in enumerate(second)})
    both, frames = one.then(other), torch.arange(12)
    torch.testing.assert_close(both.at(frames), one.at(frames) * other.at(frames))
    torch.testing.assert_close(both.beyond(other).at(frames), one.at(frames))
    assert one.beyond(None) == one


def test_undone_pixels_are_those_of_the_camera() -> None:
    """Projected with a longer focal length, then undone."""
    points = torch.tensor([[0.2, -0.1, 1.0], [0.0, 0.3, 2.0]], dtype=torch.float64)
    longer = CAMERA.with_params(CAMERA.params * torch.tensor([1.3, 1.3, 1.0, 1.0]))
    pixels, expected = longer.project(points)[0], CAMERA.project(points)[0]
    undone = zoom({0: 1.0, 7: 1.3}).undone(pixels, torch.tensor([7, 7]), CAMERA)
    torch.testing.assert_close(undone, expected)


def test_the_extent_is_of_the_largest_to_the_smallest() -> None:
    assert zoom({0: 1.0, 1: 0.5, 2: 1.5}).extent == pytest.approx(torch.tensor(3.0).log().item())


def test_files_give_back_what_was_written() -> None:
    some = zoom({0: 1.0, 9: 1.25})
    assert Zoom.from_plain(json.loads(json.dumps(some.plain))) == some


@pytest.mark.parametrize(
    "plain",
    [
        None,
        {"frames": [0]},
        {"frames": [], "ratios": []},
        {"frames": [1, 0], "ratios": [1.0, 1.0]},
        {"frames": [0, 1], "ratios": [1.0, float("nan")]},
        {"frames": [0, 1], "ratios": [1.0, -1.0]},
        {"frames": [0, 1], "ratios": [1.0]},
        {"frames": [[0]], "ratios": [[1.0]]},
        {"frames": [0], "ratios": [1e9]},
        {"frames": [1 << 70], "ratios": [1.0]},
        {"frames": ["a"], "ratios": [1.0]},
    ],
)
def test_what_is_no_zoom_is_refused(plain: object) -> None:
    with pytest.raises(ValueError, match=r"frames|ratios"):
        Zoom.from_plain(plain)
