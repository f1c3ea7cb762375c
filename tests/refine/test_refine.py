"""Refining as a whole, on simulated features and on real images."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc, still
from torchslam.config import Config, load_config
from torchslam.data import open_sequence
from torchslam.data.formats.given_poses import GivenPoses
from torchslam.data.sequence import Sequence
from torchslam.errors import TrajectoryError
from torchslam.evaluation import evaluate
from torchslam.geometry import se3_exp, se3_inverse
from torchslam.refine import CameraChoice, RefinementResult, refine_poses
from torchslam.system.front_end import Simulated
from torchslam.types import State, Trajectory

WALK = Walk(arc(14, 1.5))
TRUE = true_T_cw(WALK)


def config(*overrides: str) -> Config:
    features = ["features.kind=simulated", "features.num_keypoints=200", "simulated.points_per_view=120"]
    depths = ["simulated.depth_near=0.6", "simulated.depth_far=2"]
    # Without any noise, the focal length would be looked for to the last bit.
    return load_config(None, [*features, *depths, "simulated.noise_px=0.002", *overrides])


def seen(settings: Config, walk: Sequence | None = None) -> Sequence:
    return Simulated(settings, WALK.camera, TRUE).of(walk or WALK)


def disturbed(T_cw: Tensor, centimeters: float = 3.0, degrees: float = 2.0) -> Trajectory:
    """Poses that are off by so much in the root of the mean square, each by itself."""
    stds = torch.tensor(
        [centimeters / 100] * 3 + [math.radians(degrees)] * 3, dtype=torch.float64
    ) / math.sqrt(3)
    noise = torch.randn(len(T_cw), 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    times = torch.arange(len(T_cw), dtype=torch.float64) / 10
    return Trajectory(times, se3_inverse(se3_exp(stds * noise) @ T_cw))


def with_focal(sequence: Sequence, factor: float) -> Sequence:
    """The same images, the focal length of the camera wrong by a factor."""
    params = sequence.camera.params
    return sequence.with_camera(sequence.camera.with_params(torch.cat([factor * params[:2], params[2:]])))


def errors(refined: RefinementResult, truth: Trajectory) -> tuple[float, float]:
    """ATE in meters and the angle of the worst pose in degrees, both without any alignment but that to the given."""
    found = refined.run.trajectory
    off = se3_inverse(found.T_wc) @ truth.T_wc[: len(found)]
    trace = off[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.rad2deg(torch.arccos(((trace - 1) / 2).clamp(-1, 1)))
    return float(off[:, :3, 3].norm(dim=-1).square().mean().sqrt()), float(angle.max())


@pytest.fixture(scope="module")
def exact() -> RefinementResult:
    """All but exact features; poses 3 cm and 2 degrees off, the focal length 5 %."""
    settings = config()
    return refine_poses(with_focal(seen(settings), 1.05), disturbed(TRUE), settings)


def test_exact_features_give_the_true_poses(exact: RefinementResult) -> None:
    """In the frame and the unit of the given ones, as well as fourteen of these say what they are."""
    assert WALK.groundtruth is not None
    assert float(exact.run.camera.focal) == pytest.approx(400.0, rel=1e-4)
    assert len(exact.run.trajectory) == 14
    assert evaluate(exact.run.trajectory, WALK.groundtruth).ate_m < 2e-4
    ate, angle = errors(exact, WALK.groundtruth)
    assert ate < 0.02
    assert angle < 1.0
    assert all(result.state is State.TRACKING for result in exact.run.results)


def test_the_results_equal_those_of_a_run(exact: RefinementResult) -> None:
    """The given poses are what it calls online; the graph of the run has its poses as the minimum."""
    torch.testing.assert_close(exact.run.online.T_wc, disturbed(TRUE).T_wc)
    assert exact.run.map.num_keyframes == sum(result.is_keyframe for result in exact.run.results)
    covariances = exact.run.map.keyframes["covariances"].diagonal(dim1=-2, dim2=-1)
    assert bool((covariances[1:] > 0).all())
    assert (exact.without_pose, exact.without_image) == (0, 0)


def test_noise_is_averaged_and_reported() -> None:
    """A third of a pixel of noise, and every tenth match wrong: better by far, and twice the same."""
    assert WALK.groundtruth is not None
    settings = config("simulated.noise_px=0.3", "simulated.outlier_ratio=0.1")
    given = disturbed(TRUE)
    found = [
        refine_poses(with_focal(seen(settings), 0.95), given, settings, CameraChoice.FREE).run
        for _ in range(2)
    ]
    assert torch.equal(found[0].trajectory.T_wc, found[1].trajectory.T_wc)
    before = evaluate(given, WALK.groundtruth).ate_m
    assert evaluate(found[0].trajectory, WALK.groundtruth).ate_m < 0.4 * before
    assert float(found[0].camera.focal) == pytest.approx(400.0, rel=0.03)


def test_the_scale_of_the_given_poses_is_kept() -> None:
    """Poses in feet, in another frame: the answer is in feet and in that frame."""
    settings = config()
    S = se3_exp(torch.tensor([1.0, -2.0, 0.5, 0.3, -0.4, 0.2], dtype=torch.float64))
    T_wc = S @ WALK.groundtruth.T_wc if WALK.groundtruth is not None else S
    T_wc[:, :3, 3] *= 3.28
    given = Trajectory(WALK.timestamps, T_wc)
    found = refine_poses(seen(settings), given, settings, CameraChoice.FIXED)
    assert torch.equal(found.run.camera.params, WALK.camera.params.double())
    ate, angle = errors(found, given)
    assert ate < 2e-3
    assert angle < 0.02


def test_a_correct_camera_is_unchanged() -> None:
    """The images do not contradict it, so not a bit of it changes; freed, it comes out as good as the same."""
    settings = config("simulated.noise_px=0.3")
    judged = refine_poses(seen(settings), disturbed(TRUE), settings)
    assert torch.equal(judged.run.camera.params, WALK.camera.params.double())
    assert judged.rounds == 1
    freed = refine_poses(seen(settings), disturbed(TRUE), settings, CameraChoice.FREE)
    assert float(freed.run.camera.focal) == pytest.approx(400.0, rel=0.02)


def test_unmatched_frames_and_poses_are_reported() -> None:
    """Are left out and counted."""
    settings = config()
    T_wc = se3_inverse(TRUE)
    times = torch.cat([WALK.timestamps[:10], WALK.timestamps[-1:] + 5])
    given = Trajectory(times, torch.cat([T_wc[:10], T_wc[:1]]))
    found = refine_poses(seen(settings), given, settings, CameraChoice.FIXED)
    assert (found.without_pose, found.without_image) == (4, 1)
    assert len(found.run.trajectory) == 10
    torch.testing.assert_close(found.run.trajectory.timestamps, WALK.timestamps[:10])
    with pytest.raises(TrajectoryError, match="are not those of the images"):
        refine_poses(seen(settings), Trajectory(WALK.timestamps + 100, T_wc), settings)
    with pytest.raises(TrajectoryError, match="has no poses"):
        refine_poses(seen(settings), Trajectory.empty(), settings)


def test_images_without_a_map_are_reported() -> None:
    """The run says why, and has no poses."""
    settings, rest = config(), Walk(still(4))
    found = refine_poses(rest, disturbed(true_T_cw(rest)), settings)
    assert found.run.failure.startswith("no map: the camera stands still")
    assert len(found.run.trajectory) == 0
    assert [result.state for result in found.run.results] == [State.LOST] * 4
    one = GivenPoses("tum", Path("one.txt"), TRUE[:1], WALK.timestamps[:1])
    assert refine_poses(seen(settings), one, settings).run.failure.startswith("no map: 1 images")


def test_refinement_runs_on_the_device(device: torch.device) -> None:
    """Refinement on the simulated accelerator gives the result of the CPU."""
    settings = config()
    walk = WALK.part(0, 6)
    found = refine_poses(seen(settings, walk), _first(6), settings, device=device)
    assert found.run.map.T_cw.device.type == device.type
    assert len(found.run.trajectory) == 6


def _first(count: int) -> Trajectory:
    given = disturbed(TRUE)
    return Trajectory(given.timestamps[:count], given.T_wc[:count])


@pytest.mark.data
@pytest.mark.slow
def test_a_real_sequence_is_refined(data_dir: Path) -> None:
    """Twenty real images, one in eight: the true poses are right to 1 to 3 cm, the focal length is 540 to 1 %."""
    sequence = open_sequence(data_dir / "redkitchen", limit=20, stride=8)
    assert sequence.groundtruth is not None
    truth = torch.stack([pose for i in range(20) if (pose := sequence.pose(i)) is not None])
    given = disturbed(truth)
    given = Trajectory(sequence.timestamps, given.T_wc)
    found = refine_poses(with_focal(sequence, 0.95), given, choice=CameraChoice.FREE)
    assert len(found.run.trajectory) == 20
    evaluation = evaluate(found.run.trajectory, sequence.groundtruth)
    assert evaluation.ate_m < 0.05
    assert evaluation.scale == pytest.approx(1.0, abs=0.03)
    assert float(found.run.camera.focal) == pytest.approx(540, rel=0.03)
