"""How exact poses are by the scatter of points: the formal covariance where errors are independent, more elsewhere."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.optim.conftest import only
from tests.optim.test_camera_evidence import OPTIONS, TRUTH, walk
from torchslam.geometry import se3_inverse, se3_log
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.optim import BundleProblem, pose_covariance, solve_bundle

FRAMES = 8


def still(seed: int, noise: float) -> BundleProblem:
    """A walk of a few frames whose first and last one are fixed, which leaves no gauge."""
    return replace(walk(seed, noise, FRAMES), fixed_frames=(0, FRAMES - 1))


def solved(problem: BundleProblem) -> BundleProblem:
    found = solve_bundle(problem, check=False, options=OPTIONS)
    return replace(problem, T_cw=found.T_cw, points_w=found.points_w)


def blocks(covariance: Tensor) -> Tensor:
    """The covariances (K, 6, 6) of single frames."""
    return covariance.unflatten(0, (-1, 6)).unflatten(-1, (-1, 6)).diagonal(dim1=0, dim2=2).movedim(-1, 0)


@pytest.mark.parametrize("noise", [0.2, 1.0])
def test_independent_errors_have_the_covariance_of_the_solver(noise: float) -> None:
    problem = walk(0, noise, FRAMES)
    problem = replace(problem, fixed_frames=(0,))
    found = solve_bundle(problem, check=False, options=OPTIONS)
    at = replace(problem, T_cw=found.T_cw, points_w=found.points_w)
    own, formal = blocks(pose_covariance(at, OPTIONS)), found.covariance().frames
    assert bool((own[0] == 0).all())
    ratios = own[1:].diagonal(dim1=-2, dim2=-1) / formal[1:].diagonal(dim1=-2, dim2=-1)
    assert 0.75 < float(ratios.mean()) < 1.25


def test_the_joint_covariance_is_symmetric_and_has_no_error_of_the_scale() -> None:
    problem = solved(replace(walk(1, 0.5, FRAMES), fixed_frames=(0,)))
    covariance = pose_covariance(problem, OPTIONS)
    torch.testing.assert_close(covariance, covariance.mT)
    assert float(torch.linalg.eigvalsh(covariance).min()) > -1e-12
    # Scaling the world about the center of the first frame moves each frame along its own translation.
    center = se3_inverse(problem.T_cw[0])[:3, 3]
    scale = torch.zeros(FRAMES, 6, dtype=torch.float64)
    scale[:, :3] = -(problem.T_cw[:, :3, :3] @ center + problem.T_cw[:, :3, 3])
    along = scale.flatten() / scale.norm()
    assert float(along @ covariance @ along) < 1e-6 * float(covariance.trace())


def test_points_that_err_alike_in_all_frames_are_believed_less() -> None:
    """Errors of a point are nearly the same in all frames, which the formal covariance takes for many measurements."""
    exact = still(2, 0.0)
    slow, steps = [], []
    generator = torch.Generator().manual_seed(3)
    for _ in range(12):
        # A keypoint that slides along its pattern as the frames go by: a bias that grows with the frame.
        slope = torch.randn(len(exact.points_w), 2, generator=generator, dtype=torch.float64)
        when = exact.frame_index.double() / FRAMES - 0.5
        pixels = exact.pixels + 1.5 * when.square()[:, None] * slope[exact.point_index]
        found = solve_bundle(replace(exact, pixels=pixels), check=False, options=OPTIONS)
        at = replace(exact, T_cw=found.T_cw, points_w=found.points_w, pixels=pixels)
        slow.append(torch.stack((blocks(pose_covariance(at, OPTIONS)), found.covariance().frames)))
        steps.append(se3_log(found.T_cw @ se3_inverse(exact.T_cw)))
    own, formal = (each[1:-1] for each in torch.stack(slow).mean(0))
    errors = torch.stack(steps)[:, 1:-1]
    nees = [
        float((errors * torch.linalg.solve(each, errors[..., None])[..., 0]).sum(-1).mean() / 6)
        for each in (own, formal)
    ]
    assert 0.6 < nees[0] < 1.6
    assert nees[1] > 1.5 * nees[0]


def test_the_errors_of_the_camera_move_the_poses() -> None:
    given = CameraMeasurement.of(TRUTH, 0.01)
    problem = solved(still(4, 0.2))
    alone, both = (pose_covariance(problem, OPTIONS, errors) for errors in (None, given.directions))
    follows = []
    for direction in given.directions.T:
        ends = [
            solve_bundle(
                replace(problem, camera=TRUTH.with_params(TRUTH.params + step * direction)),
                check=False,
                options=OPTIONS,
            ).T_cw
            for step in (0.01, -0.01)
        ]
        follows.append(se3_log(ends[0] @ se3_inverse(ends[1])).flatten() / 0.02)
    columns = torch.stack(follows, dim=-1)
    expected = (columns @ columns.mT).diagonal()
    torch.testing.assert_close(
        (both - alone).diagonal(), expected, rtol=0.1, atol=1e-3 * float(expected.max())
    )


def test_it_is_right_a_little_off_the_minimum_of_the_points() -> None:
    problem = solved(still(5, 0.5))
    generator = torch.Generator().manual_seed(0)
    off = 1e-4 * torch.randn(problem.points_w.shape, generator=generator, dtype=torch.float64)
    one = pose_covariance(problem, OPTIONS)
    other = pose_covariance(replace(problem, points_w=problem.points_w + off), OPTIONS)
    torch.testing.assert_close(one, other, rtol=0.02, atol=0.01 * float(one.diagonal().max()))


def test_undetermined_poses_have_no_covariance() -> None:
    problem = still(6, 0.5)
    few = problem.point_index < 2
    problem = only(problem, few)
    assert not bool(pose_covariance(problem, OPTIONS).any())
