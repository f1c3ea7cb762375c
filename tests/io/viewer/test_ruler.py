"""The ruler of view.html: an image point and an error of each point, and what a browser measures between two."""

from __future__ import annotations

import html
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.io.viewer.test_page import array, browse, data_of, decoded, kept
from torchslam.geometry import se3_exp
from torchslam.io.results import Results
from torchslam.io.viewer.page import (
    FACTOR_STEPS,
    STEPS,
    clearest_observations,
    error_factors,
    page,
    write_view,
)
from torchslam.map.map import Map
from torchslam.map.unit import MetricUnit, UnitSource
from torchslam.metric.distances import parse_distance
from torchslam.types import Trajectory

__all__ = ["kept"]

SIZE = (160, 120)
UNIT = MetricUnit(
    0.02,
    (UnitSource("known lengths", 1.5, 0.02, 2, "known lengths", None, ()),),
    (),
    tuple(map(tuple, torch.eye(4).tolist())),
)


def pixels_of(submap: dict[str, Any]) -> np.ndarray:
    return array(submap["seen_pixel"], 2) / STEPS * (np.array(SIZE) - 1)


def spread(submap: dict[str, Any], row: int, direction: np.ndarray) -> float:
    """Variance of a point along a direction, as the page holds it."""
    (step,) = (decoded(submap["error_step"])[row : row + 1].astype(np.uint32) << 16).view(np.float32)
    L = np.zeros((3, 3))
    L[np.tril_indices(3)] = step * array(submap["error_factor"], 6)[row]
    return float(((direction @ L) ** 2).sum())


def test_every_point_has_an_image_point_that_shows_it(kept: Results) -> None:
    (submap,) = data_of(page(kept))["submaps"]
    frames, pixels = decoded(submap["seen_frame"]), pixels_of(submap)
    table, ids = kept.map.keyframes, kept.map.valid_points()
    assert len(frames) == len(pixels) == len(ids)
    for frame, pixel, point in zip(frames, pixels, ids, strict=True):
        (row,) = torch.nonzero(table["frame_index"] == int(frame))[:, 0]
        (keypoint,) = torch.nonzero(table["point_ids"][row] == point)[:, 0]
        expected = table["keypoints"][row, keypoint].clamp(max=torch.tensor(SIZE) - 1)
        np.testing.assert_allclose(pixel, expected, atol=2e-3)


def test_points_are_seen_at_a_fine_scale_far_from_the_border(slam_map: Map) -> None:
    twice = torch.arange(10)  # the first keyframe's points that the second one observes as well
    twice = twice[twice != 3]
    slam_map.keyframes["keypoints"][:2] = torch.tensor([79.5, 59.5], dtype=torch.float64)
    slam_map.keyframes["scales"][0, :20] = 2.0
    assert clearest_observations(slam_map, twice, slam_map.keyframe_rows(0), SIZE)[0].tolist() == [5] * 9
    slam_map.keyframes["scales"][0, :20] = 1.0
    slam_map.keyframes["keypoints"][1] = torch.tensor([158.0, 2.0], dtype=torch.float64)
    frames, pixels = clearest_observations(slam_map, twice, slam_map.keyframe_rows(0), SIZE)
    assert frames.tolist() == [0] * 9
    assert pixels.tolist() == [[79.5, 59.5]] * 9


def test_points_that_only_another_session_observed_have_no_image_point(slam_map: Map) -> None:
    slam_map.keyframes["session"][1:] = 1
    frames, _ = clearest_observations(slam_map, slam_map.valid_points(), slam_map.keyframe_rows(1), SIZE)
    alone = slam_map.valid_points() < 20
    assert (frames[alone] == torch.where(slam_map.valid_points()[alone] < 10, 5, -1)).all()
    assert (frames[~alone] >= 5).all()


def test_covariances_round_trip(generator: torch.Generator) -> None:
    """Also of a point whose depth alone is uncertain."""
    A = torch.randn(50, 3, 3, generator=generator, dtype=torch.float64)
    depth = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)
    covariances = torch.cat([4.0 * A @ A.mT, (depth[:, None] * depth)[None], torch.zeros(1, 3, 3)])
    step, entries = error_factors(covariances)
    assert step[-1] == 0
    assert entries.abs().max() <= FACTOR_STEPS
    L = torch.zeros_like(covariances)
    row, column = torch.tril_indices(3, 3)
    L[:, row, column] = step[:, None] * entries
    largest = covariances.diagonal(dim1=-2, dim2=-1).amax(-1)[:-1, None, None]
    assert ((L @ L.mT - covariances)[:-1].abs() < 0.02 * largest).all()


def test_unknown_covariances_have_no_error() -> None:
    wrong = torch.stack([torch.full((3, 3), torch.nan), torch.diag(torch.tensor([1.0, -1.0, 1.0]))]).double()
    assert error_factors(wrong)[0].tolist() == [0.0, 0.0]


def test_the_error_of_the_unit_is_that_of_a_map_in_meters(kept: Results) -> None:
    (before,) = data_of(page(kept))["submaps"]
    assert (before["unit"], before["unit_std"], before["level"]) == ("", 0.0, False)
    kept.submaps[0].metric = UNIT
    (submap,) = data_of(page(kept))["submaps"]
    assert (submap["unit"], submap["unit_std"]) == ("m", UNIT.relative_std)
    truth = replace(kept, groundtruth=kept.trajectory)
    (submap,) = data_of(page(truth))["submaps"]
    assert (submap["unit"], submap["unit_std"]) == ("m", 0.0)  # the scale is that of the ground truth


def test_up_is_up_with_ground_truth_in_other_axes(kept: Results) -> None:
    kept.submaps[0].metric = replace(UNIT, up_std=0.01)
    turn = se3_exp(torch.tensor([1.0, 2, 3, 0.5, -0.4, 0.8], dtype=torch.float64))
    truth = Trajectory(kept.trajectory.timestamps, turn @ kept.trajectory.T_wc)
    (submap,) = data_of(page(replace(kept, groundtruth=truth)))["submaps"]
    assert submap["level"]
    np.testing.assert_allclose(np.array(submap["S_shown_map"])[:3, :3], np.eye(3), atol=1e-6)
    assert len(array(submap["truth"], 3)) == len(truth)


# --- in a browser --------------------------------------------------------------------------------------------------

HANDS = """
const canvas = $("scene"), said = {};
canvas.setPointerCapture = () => {}; // there is no pointer
function press(name, x, y, type = "mouse", id = 1) {
  const where = {pointerId: id, clientX: x, clientY: y, pointerType: type, bubbles: true};
  canvas.dispatchEvent(new PointerEvent(name, where));
}
function tap(x, y, type) { press("pointerdown", x, y, type); press("pointerup", x, y, type); }
function key(name, target = document.body, more = {}) {
  target.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true, ...more}));
}
function pixel(row) {
  const m = eye.projection().matrix, p = shown.submap.points.subarray(3 * row, 3 * row + 3);
  const [x, y, w] = [0, 1, 3].map((i) => m[i] * p[0] + m[4 + i] * p[1] + m[8 + i] * p[2] + m[12 + i]);
  return [(x / w + 1) * canvas.clientWidth / 2, (1 - y / w) * canvas.clientHeight / 2];
}
const words = () => $("ruler-words").textContent;
"""


def handled(path: Path, script: str) -> dict[str, Any]:
    """What a script that moves mouse and keys leaves in `said`."""
    text = path.read_text()
    hands = f"<script>{HANDS}{script}; document.documentElement.dataset.said = JSON.stringify(said);</script>"
    path.write_text(text.replace("</body>", hands + "</body>"))
    (said,) = re.findall(r'data-said="([^"]*)"', browse(path, "--dump-dom"))
    return json.loads(html.unescape(said))


TWO_CLICKS = """
said.before = $("ruler").hidden;
$("measure").click();
said.asked = words();
tap(...pixel(7));
said.first = words();
tap(...pixel(60));
said.rows = ruler.rows;
said.words = words();
$("ruler-meters").value = "1,35";
$("ruler-meters").dispatchEvent(new Event("input"));
said.command = $("ruler-command").textContent;
said.line = layers.ruler.count;
"""


def test_a_browser_measures_between_two_clicks(tmp_path: Path, kept: Results) -> None:
    kept.submaps[0].metric = UNIT
    folder = tmp_path / "it's here"
    folder.mkdir()
    path = write_view(kept, folder)
    (submap,) = data_of(path.read_text())["submaps"]
    said = handled(path, TWO_CLICKS)
    assert said["before"]
    assert (said["asked"], said["first"]) == ("Click a point of the map.", "Click the second point.")
    a, b = said["rows"]
    points, frames, pixels = array(submap["points"], 3), decoded(submap["seen_frame"]), pixels_of(submap)
    between = (points[b] - points[a]).astype(float)
    meters = float(np.linalg.norm(between))
    variance = sum(spread(submap, row, between / meters) for row in (a, b)) + (0.02 * meters) ** 2
    assert variance == pytest.approx(2 * 0.01 + (0.02 * meters) ** 2, rel=0.02)
    assert said["words"] == f"{meters:.2f} ± {variance**0.5:.2f} m"
    assert said["line"] == 1
    program, command, where, option, *given = shlex.split(said["command"])
    assert [program, command, where, option] == ["torchslam", "align", str(folder), "--distance"]
    distance = parse_distance(given)
    assert distance.meters == 1.35
    for click, row in ((distance.first, a), (distance.second, b)):
        assert click.frame == frames[row]
        np.testing.assert_allclose(click.pixel, pixels[row], atol=0.051)


def test_a_browser_says_map_units_where_the_unit_is_arbitrary(tmp_path: Path, kept: Results) -> None:
    said = handled(write_view(kept, tmp_path), TWO_CLICKS + 'said.grid = $("count-grid").textContent;')
    assert re.fullmatch(r"\d+\.\d+ ± 0\.14 map units", said["words"])
    assert said["grid"].endswith(" map units")


def test_a_browser_measures_with_the_keyboard(tmp_path: Path, kept: Results) -> None:
    script = """
    const center = (row) => { eye.look({target: [...shown.submap.points.subarray(3 * row, 3 * row + 3)]}); };
    key("m");
    said.focused = document.activeElement.id;
    center(7); key("Enter", canvas); center(60); key("Enter", canvas);
    said.rows = ruler.rows;
    key("Escape", canvas);
    said.dropped = [ruler.rows.length, ruler.isOn, layers.ruler, $("ruler-option").hidden];
    key("Escape", canvas);
    said.off = [ruler.isOn, $("measure").checked, $("ruler").hidden];
    const x = eye.target[0], yaw = eye.yaw;
    key("D", canvas, {shiftKey: true});
    said.moved = [eye.target[0] !== x, eye.yaw === yaw];
    """
    said = handled(write_view(kept, tmp_path), script)
    assert said["focused"] == "scene"
    assert len(said["rows"]) == 2
    assert said["dropped"] == [0, True, None, True]
    assert said["off"] == [False, False, True]
    assert said["moved"] == [True, True]


def test_a_browser_takes_fingers_that_do_not_move(tmp_path: Path, kept: Results) -> None:
    """A drag turns the view, two fingers zoom: neither takes a point."""
    script = """
    key("m");
    const [x, y] = pixel(7), yaw = eye.yaw;
    const drag = (x, y, pixels) => {
      press("pointerdown", x, y, "touch");
      press("pointermove", x + pixels, y, "touch");
      press("pointerup", x + pixels, y, "touch");
    };
    drag(x, y, 60);
    said.dragged = [ruler.rows.length, eye.yaw !== yaw];
    press("pointerdown", x, y, "touch", 1); press("pointerdown", x + 60, y, "touch", 2);
    press("pointerup", x + 60, y, "touch", 2); press("pointerup", x, y, "touch", 1);
    said.pinched = ruler.rows.length;
    drag(...pixel(7), 5);
    said.tapped = ruler.rows.length;
    tap(3, 300, "touch");
    said.missed = [words(), ruler.rows.length];
    """
    said = handled(write_view(kept, tmp_path), script)
    assert said == {"dragged": [0, True], "pinched": 0, "tapped": 1, "missed": ["There is no point.", 1]}


def test_a_browser_gives_no_option_for_points_of_another_session(tmp_path: Path, kept: Results) -> None:
    kept.map.keyframes["session"][:] = 1
    said = handled(write_view(kept, tmp_path), TWO_CLICKS + 'said.option = $("ruler-option").hidden;')
    assert said["words"].endswith("No frame of this run shows both points.")
    assert said["option"]
