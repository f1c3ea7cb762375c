"""Trials: who is wrong, what edits do to images, sequences of edited frames, the table of all trials."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from experiments.trials import edits, outcome
from experiments.trials.edited import Edited, Shot, fitted, shots, strangers
from experiments.trials.faults import FAULTS, halved
from experiments.trials.gradient import SETTINGS, Round
from experiments.trials.judging import FAR, TURNED_DEG, extent, moves, robust_similarity, wrong
from experiments.trials.outcome import HEADER, cells, furthest, misled, online_poses
from experiments.trials.run import NOT_RUN, chosen, rows_in, write
from experiments.trials.trials import TRIALS, Trial, drone, turning
from tests.sample_run import *  # noqa: F403  fixtures of a run that tracked, lost itself and came back
from tests.walks import Walk, arc
from torchslam.data import open_sequence
from torchslam.geometry import rigid, se3_inverse, so3_exp, transform
from torchslam.loop_closing.loop_detector import LoopClosureRecord
from torchslam.system.run import Run
from torchslam.types import State, StepResult, Trajectory

N = 40
SIZE = (64, 48)
RNG = np.random.default_rng(0)
GRAY = RNG.integers(0, 256, (SIZE[1], SIZE[0]), dtype=np.uint8)


def similar(T_wc: Tensor) -> Tensor:
    """The path in another frame and unit."""
    R, t = so3_exp(torch.tensor([0.3, -1.2, 0.5], dtype=torch.float64)), torch.tensor([3.0, -1.0, 2.0])
    return rigid(R @ T_wc[:, :3, :3], 2.5 * T_wc[:, :3, 3] @ R.mT + t)


def shifted(T_wc: Tensor, rows: slice, by: float) -> Tensor:
    moved = T_wc.clone()
    moved[rows, 1, 3] += by
    return moved


def rolled(T_wc: Tensor, row: int, degrees: float) -> Tensor:
    R = so3_exp(torch.tensor([0.0, 0.0, math.radians(degrees)], dtype=torch.float64))
    moved = T_wc.clone()
    moved[row, :3, :3] = moved[row, :3, :3] @ R
    return moved


# --- judging -------------------------------------------------------------------------------------------------


def test_extent_of_known_points() -> None:
    assert extent(torch.tensor([[1.0, 0, 0], [-1, 0, 0], [1, 0, 0], [-1, 0, 0]])) == pytest.approx(1.0)
    assert extent(torch.tensor([[2.0, 5, 0], [2, -1, 0]])) == pytest.approx(3.0)


@pytest.mark.parametrize("share", [0, 5, 16])
def test_the_alignment_follows_the_majority(share: int) -> None:
    truth = arc(N)
    given = similar(truth)[:, :3, 3]
    given[:share] += 5 * torch.randn(
        share, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    s, R, t = robust_similarity(given, truth[:, :3, 3])
    assert float(s) == pytest.approx(1 / 2.5, rel=1e-9)
    torch.testing.assert_close(s * given[share:] @ R.mT + t, truth[share:, :3, 3])


def test_a_path_that_differs_by_a_similarity_has_no_wrong_pose() -> None:
    truth = arc(N)
    assert not wrong(similar(truth), truth, extent(truth[:, :3, 3])).any()


@pytest.mark.parametrize(("share", "is_wrong"), [(0.9 * FAR, False), (1.1 * FAR, True)])
def test_a_pose_is_wrong_beyond_three_tenths_of_the_extent(share: float, is_wrong: bool) -> None:
    truth = arc(N)
    path = extent(truth[:, :3, 3])
    bad = wrong(shifted(truth, slice(7, 9), share * path), truth, path)
    assert bad.nonzero()[:, 0].tolist() == ([7, 8] if is_wrong else [])


@pytest.mark.parametrize(("degrees", "is_wrong"), [(TURNED_DEG - 0.5, False), (TURNED_DEG + 0.5, True)])
def test_a_pose_is_wrong_ten_degrees_beyond_the_median(degrees: float, is_wrong: bool) -> None:
    truth = arc(N)
    bad = wrong(similar(rolled(truth, 5, degrees)), truth, 1.0)
    assert bad.nonzero()[:, 0].tolist() == ([5] if is_wrong else [])


def test_a_rotation_common_to_all_poses_is_no_error() -> None:
    truth = arc(N)
    given = truth.clone()
    given[:, :3, :3] = truth[:, :3, :3] @ so3_exp(torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64))
    assert not wrong(given, truth, 1.0).any()


def test_a_camera_at_rest_is_evaluated_by_its_motion() -> None:
    truth = torch.cat([arc(1).expand(3 * N, 4, 4), arc(N)])
    path = extent(truth[:, :3, 3])
    given = similar(truth)
    given[: 3 * N, :3, 3] += 1e-3 * torch.randn(
        3 * N, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    assert not wrong(given, truth, path).any()
    assert moves(truth[:, :3, 3], 1e-3 * path).tolist() == [0, *range(3 * N + 1, 4 * N)]


def test_drift_is_distributed_over_the_whole_path() -> None:
    """The second half has another scale: fitted to one half alone, the other one's end is off by half the extent."""
    truth = arc(2 * N)
    path = extent(truth[:, :3, 3])
    given = truth.clone()
    given[N:, :3, 3] += 0.35 * (truth[N:, :3, 3] - truth[N, :3, 3])
    assert not wrong(similar(given), truth, path).any()
    s, R, t = robust_similarity(given[:, :3, 3], truth[:, :3, 3])
    alone = (s * given[:, :3, 3] @ R.mT + t - truth[:, :3, 3]).norm(dim=-1)
    assert float(alone.max()) > FAR * path


def walk_with(bad: range) -> tuple[Edited, dict[int, Tensor]]:
    """A walk whose last five frames show something else, and poses of all of it, some of them wrong."""
    walk = Walk(arc(N))
    sequence = Edited("walk", walk.camera, shots(walk, range(N - 5)) + strangers(walk, range(N - 5, N)))
    T_wc = arc(N)
    T_wc[list(bad), 1, 3] += 10
    return sequence, dict(enumerate(se3_inverse(similar(T_wc))))


def test_wrong_frames_are_listed_by_index_and_inserted_ones_have_no_pose() -> None:
    sequence, poses = walk_with(range(3, 6))
    assert outcome.wrong_frames(poses, sequence) == {3, 4, 5, *range(N - 5, N)}
    few = {index: poses[index] for index in (30, 10, 12, 25, 20, 4, 15)}
    assert outcome.wrong_frames(few, sequence) == {4}
    assert outcome.wrong_frames({}, sequence) == set()


def test_only_tracking_frames_of_the_main_submap_can_be_wrong(
    monkeypatch: pytest.MonkeyPatch, run: Run, results: list[StepResult]
) -> None:
    """Frames 0 to 2 are initializing, 3 to 17 tracking, 18 to 21 lost, 22 to 29 tracking."""
    sequence, poses = walk_with(range(2, 5))
    _, given = walk_with(range(17, 20))
    monkeypatch.setattr(outcome, "final_poses", lambda _: {i: poses[i] for i in range(30)})
    with monkeypatch.context() as patch:
        patch.setattr(outcome, "online_poses", lambda _: {i: given[i] for i in range(30)})
        assert misled(run, sequence) == [3, 4, 17]
    other = [replace(result, submap=1 if result.index == 10 else result.submap) for result in results]
    assert 10 in online_poses(run)
    assert 10 not in online_poses(replace(run, results=other))
    doubtful = [replace(result, state=State.UNCERTAIN) for result in results]
    assert online_poses(replace(run, results=doubtful)) == {}


def test_final_poses_are_those_of_the_session(run: Run, trajectory: Trajectory) -> None:
    poses = outcome.final_poses(run)
    assert list(poses) == [*range(3, 18), *range(22, 30)]
    torch.testing.assert_close(poses[25], se3_inverse(trajectory.T_wc)[25])
    assert outcome.final_poses(replace(run, session=1)) == {}


def test_the_distance_of_detected_loops() -> None:
    T_wc = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    T_wc[2, :3, 3] = torch.tensor([0.3, 0.0, 0.4])
    T_wc[3, :3, :3] = so3_exp(torch.tensor([0.0, math.radians(20), 0.0], dtype=torch.float64))
    walk = Walk(T_wc)
    sequence = Edited("walk", walk.camera, [*shots(walk, range(4)), *strangers(walk, [0])])
    found = furthest(
        [LoopClosureRecord(2, 0, 0, 0), LoopClosureRecord(3, 1, 0, 0), LoopClosureRecord(4, 0, 1, 0)],
        sequence,
    )
    assert found == pytest.approx((0.5, 20.0))
    assert furthest([LoopClosureRecord(4, 0, 1, 0)], sequence) is None


# --- edits ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FAULTS)
def test_faults_change_neither_image_size_nor_poses(name: str) -> None:
    whole, other = (
        open_sequence("synthetic:planar").part(0, 6),
        open_sequence("synthetic:rotation").part(0, 40),
    )
    made = FAULTS[name](whole, other)
    image = made.image(1)
    assert image.shape[-2:] == (made.camera.height, made.camera.width)
    assert torch.equal(image, made.image(1))
    source = 3 if name == "drop3" else 1
    assert torch.equal(made.pose(1), whole.pose(source))
    same = made.size == whole.size and torch.equal(image, whole.image(source))
    assert same is (name in ("none", "kidnap", "drop3", "exposure_step"))


def test_kidnapped_frames_have_no_pose() -> None:
    walk = Walk(arc(10))
    made = FAULTS["kidnap"](walk, Walk(arc(50)))
    assert made.belongs.tolist() == [True] * 5 + [False] * 40 + [True] * 5
    assert made.pose(5) is None
    assert torch.equal(made.pose(45), walk.pose(5))
    assert len(made.groundtruth) == 10


def test_halved_cameras_see_points_at_the_middle_of_four_pixels() -> None:
    camera = Walk(arc(2)).camera
    point = torch.tensor([[0.2, -0.1, 1.0]], dtype=torch.float64)
    (whole, _), (half, _) = camera.project(point), halved(camera).project(point)
    torch.testing.assert_close(half, (whole + 0.5) / 2 - 0.5)
    assert halved(camera).size == (160, 120)
    assert (fitted(np.kron(GRAY, np.ones((2, 2), np.uint8)), SIZE) == GRAY).all()


def test_a_rotated_image_is_that_of_the_rotated_camera() -> None:
    room = open_sequence("synthetic:room?noise=0&blur=0")
    camera, first = room.camera, room.pose(0)
    assert first is not None
    angle = math.radians(5.0)
    R = so3_exp(torch.tensor([0.0, angle, 0.0], dtype=torch.float64))
    T_cw = rigid(R, torch.zeros(3, dtype=torch.float64)) @ first
    shot = Shot(room, 0, edits.turned(camera, angle), T_cw)
    image = Edited("turned", camera, [shot]).image(0)[0, 0]
    # A scene point in the first image, and its projection by the pose in the second one.
    pixels = torch.tensor([[300.0, 200.0], [340.0, 260.0], [320.0, 300.0]], dtype=torch.float64)
    points_w = transform(se3_inverse(first), 3 * camera.unproject(pixels))
    moved, _ = camera.project(transform(T_cw, points_w))
    assert ((moved - pixels)[:, 0] > 40).all()
    grid = 2 * moved / torch.tensor([639.0, 479.0]) - 1
    seen = torch.nn.functional.grid_sample(image[None, None], grid[None, None].float(), align_corners=True)
    there = room.image(0)[0, 0][pixels[:, 1].long(), pixels[:, 0].long()]
    torch.testing.assert_close(seen[0, 0, 0], there, atol=0.04, rtol=0)
    assert (image[:, :5] == 0).all()


# --- trials --------------------------------------------------------------------------------------------------


def test_a_round_trip_ends_at_its_start() -> None:
    whole = Round.shots()
    first, again = whole.pose(0), whole.pose(120)
    assert first is not None
    assert again is not None
    assert float((first - again).abs().max()) < 0.25
    forward = se3_inverse(first)[:3, 2]
    torch.testing.assert_close(forward, torch.tensor([1.0, 0, 0], dtype=torch.float64))  # outwards


def test_patterns_select_trials_in_order() -> None:
    assert chosen([]) == list(TRIALS)
    assert chosen(["plain/shelf_bin", "plain/kitti07"]) == ["plain/kitti07", "plain/shelf_bin"]
    assert len(chosen(["*/machine_hall"])) == 3 + len(FAULTS)
    with pytest.raises(SystemExit, match="nothing/here"):
        chosen(["nothing/here"])


def test_the_table_keeps_earlier_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("above\n<!-- table -->\n<!-- end -->\nbelow\n")
    monkeypatch.setattr("experiments.trials.run.README", readme)
    result = outcome.Outcome(
        90, 100, 2, [92, 8], 0.5, 2.0, [4], [State.TRACKING] * 92 + [State.LOST] * 8, [], None, 3.0, 21.0, ""
    )  # fmt: skip
    write({"loop/open": cells("loop/open", result, "m")})
    write(rows_in(readme.read_text()) | {"loop/closed": cells("loop/closed", result, "")})
    rows = rows_in(readme.read_text())
    columns = ["90 of 100, and 2 strays", "92 + 8", "0.5000 m", "1 (1.0%)", "T92 L8", "none", "3, 21"]
    assert rows["loop/open"] == ["loop/open", *columns]
    assert rows["loop/closed"][3] == "25.00% of the extent"
    assert NOT_RUN in readme.read_text()
    assert readme.read_text().startswith("above\n")
    assert len(HEADER) == 8


def test_a_rotating_start_has_the_poses_of_the_rotation(data_dir: Path) -> None:
    made = turning("shelf_bin")
    assert len(made) == 110
    start, furthest_turn = made.pose(0), made.pose(15)
    angle = (furthest_turn @ se3_inverse(start))[:3, :3]
    torch.testing.assert_close(angle, so3_exp(torch.tensor([0.0, math.radians(8), 0.0], dtype=torch.float64)))
    assert torch.equal(made.image(0), made.image(60))


def test_the_drone_sequence_has_the_available_poses(data_dir: Path) -> None:
    made = drone()
    known = [index for index in range(len(made)) if made.pose(index) is not None]
    assert known == list(range(0, 567, 14))
    assert made.belongs.all()


def short_round() -> Edited:
    whole = Round(30)
    return Edited("round", whole.camera, shots(whole, range(len(whole))))


def test_a_killed_run_resumes_from_its_last_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outcome, "after_the_cut", partial(outcome.after_the_cut, every=1))
    few = (*SETTINGS, "features.num_keypoints=250", "simulated.points_per_view=150")
    few = (*few, "camera.std=0", "camera.readout_std=0")
    whole, undisturbed = outcome.perform(Trial(short_round, few))
    cut, run = outcome.perform(Trial(short_round, few, cut_at=0.9))
    assert torch.equal(run.trajectory.T_wc, undisturbed.trajectory.T_wc)
    assert (cut.posed, cut.states, cut.ate) == (whole.posed, whole.states, whole.ate)
    assert len(run.results) == 30


def test_a_trial_without_ground_truth_has_no_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Edited("round", Round(3).camera, [Shot(Round(3), index) for index in range(3)])
    result, _ = outcome.perform(Trial(lambda: made))
    assert (result.ate, result.misled, result.loop_closures, result.posed, result.possible) == (
        None,
        [],
        [],
        0,
        3,
    )
    assert "no map was initialized" in cells("x", result, "m")[3]
