"""Evaluation: known values, evo as the oracle, gradients, and estimates that cannot be compared."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev

from torchslam.data.trajectories import interpolate_poses
from torchslam.errors import TrajectoryError
from torchslam.evaluation import ate, ate_apart, evaluate, rpe
from torchslam.geometry.lie import quaternion_from_matrix, rigid, se3_exp, se3_inverse, so3_exp
from torchslam.types import Trajectory


def _poses(generator: torch.Generator, count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """(count, 4, 4) a random walk."""
    steps = 0.2 * torch.randn(count, 6, generator=generator, dtype=torch.float64)
    return se3_exp(steps.cumsum(0)).to(dtype)


def _times(count: int, rate: float = 10.0) -> Tensor:
    return torch.arange(count, dtype=torch.float64) / rate


def _moved(T_wc: Tensor, scale: float) -> Tensor:
    """The same path in another submap: scaled, turned and shifted."""
    R = so3_exp(torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64))
    t = torch.tensor([5.0, -3.0, 1.0], dtype=torch.float64)
    return rigid(R @ T_wc[:, :3, :3], scale * T_wc[:, :3, 3] @ R.T + t)


def test_a_path_that_differs_by_a_similarity_has_no_error(generator: torch.Generator) -> None:
    T_wc = _poses(generator, 40)
    groundtruth = Trajectory(_times(40), T_wc)
    evaluation = evaluate(Trajectory(_times(40), _moved(T_wc, 0.25)), groundtruth)
    assert evaluation.ate_m < 1e-12
    assert evaluation.rpe_translation_m < 1e-12
    assert evaluation.rpe_rotation_deg < 1e-6
    assert evaluation.scale == pytest.approx(4.0)
    assert evaluation.ate_se3_m > 0.1
    assert (evaluation.posed, evaluation.compared) == (40, 40)
    torch.testing.assert_close(evaluation.aligned.T_wc, T_wc)
    length = T_wc[:, :3, 3].diff(dim=0).norm(dim=-1).sum()
    assert evaluation.path_length_m == pytest.approx(float(length))
    S = evaluation.S_groundtruth_estimate
    torch.testing.assert_close(S[:3, :3] @ S[:3, :3].T, 16 * torch.eye(3, dtype=torch.float64))


def test_errors_have_known_values() -> None:
    # A square of side 2 with its corners moved out and in by 0.1: the best similarity is the identity.
    square = torch.tensor([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], dtype=torch.float64)
    signs = torch.tensor([1.0, -1, 1, -1], dtype=torch.float64)[:, None]
    identity = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    moved = square + 0.1 * signs * square / square.norm(dim=-1, keepdim=True)
    evaluation = evaluate(
        Trajectory(_times(4), rigid(identity, moved)), Trajectory(_times(4), rigid(identity, square))
    )
    assert evaluation.ate_m == pytest.approx(0.1, rel=1e-2)
    assert evaluation.ate_se3_m == pytest.approx(0.1)
    torch.testing.assert_close(evaluation.errors_m.square().mean().sqrt().item(), evaluation.ate_m)

    # A camera that turns 2 degrees too far at each step.
    angles = torch.arange(10, dtype=torch.float64)[:, None] * torch.tensor([0, 0, math.radians(2.0)])
    still = torch.zeros(10, 3, dtype=torch.float64)
    still[:, 0] = torch.arange(10)
    turning = se3_inverse(rigid(so3_exp(angles), still))
    straight = se3_inverse(rigid(torch.eye(3, dtype=torch.float64).expand(10, 3, 3), still))
    for delta in (1, 3):
        _, rotation = rpe(T_cw=turning, T_cw_groundtruth=straight, delta=delta)
        assert math.degrees(float(rotation)) == pytest.approx(2.0 * delta)


def test_groundtruth_at_another_rate_is_interpolated() -> None:
    def path(times: Tensor) -> Tensor:
        return se3_exp(times[:, None] * torch.tensor([0.5, 0.2, 0, 0, 0.3, 0], dtype=torch.float64))

    times, truth_times = _times(50, rate=10.0) + 0.013, _times(600, rate=97.0)
    estimate, groundtruth = Trajectory(times, path(times)), Trajectory(truth_times, path(truth_times))
    assert evaluate(estimate, groundtruth).ate_m < 1e-6
    assert evaluate(estimate, groundtruth, association="nearest").ate_m > 1e-4


def test_poses_without_truth_are_left_out(generator: torch.Generator) -> None:
    T_wc = _poses(generator, 30)
    groundtruth = Trajectory(_times(20), T_wc[:20])
    evaluation = evaluate(Trajectory(_times(30), T_wc), groundtruth)
    assert (evaluation.posed, evaluation.compared) == (30, 20)
    assert len(evaluation.aligned) == 30
    assert len(evaluation.matched) == len(evaluation.groundtruth) == len(evaluation.errors_m) == 20


def test_too_few_poses_in_common(generator: torch.Generator) -> None:
    T_wc = _poses(generator, 10)
    groundtruth = Trajectory(_times(10), T_wc)
    with pytest.raises(TrajectoryError, match=r"0 of 10 .* the estimate goes from 100.000 to 100.900 s"):
        evaluate(Trajectory(_times(10) + 100, T_wc), groundtruth)
    with pytest.raises(TrajectoryError, match="2 of 2 estimated poses"):
        evaluate(Trajectory(_times(2), T_wc[:2]), groundtruth)
    with pytest.raises(TrajectoryError, match="0 of 0 estimated poses"):
        evaluate(Trajectory(_times(0), T_wc[:0]), groundtruth)


def test_parts_with_their_own_frames_are_aligned_separately(generator: torch.Generator) -> None:
    truth = Trajectory(_times(40), _poses(generator, 40))
    first = Trajectory(truth.timestamps[:10], _moved(truth.T_wc[:10], 0.25))
    second = Trajectory(truth.timestamps[10:], truth.T_wc[10:])
    together = Trajectory(truth.timestamps, torch.cat([first.T_wc, second.T_wc]))
    assert ate_apart([first, second], truth) < 1e-12 < evaluate(together, truth).ate_m
    noisy = [Trajectory(part.timestamps, _noisy(part.T_wc, generator)) for part in (first, second)]
    errors = [evaluate(part, truth).ate_m for part in noisy]
    expected = math.sqrt((10 * errors[0] ** 2 + 30 * errors[1] ** 2) / 40)  # every pose counts alike
    assert ate_apart(noisy, truth) == pytest.approx(expected)
    assert ate_apart(noisy[:1], truth) == pytest.approx(errors[0])


def test_parts_that_fit_any_path_are_excluded(generator: torch.Generator) -> None:
    truth = Trajectory(_times(20), _poses(generator, 20))
    part = Trajectory(truth.timestamps[:10], _noisy(truth.T_wc[:10], generator))
    late = Trajectory(truth.timestamps[17:] + 0.2, truth.T_wc[17:])  # of its three poses, two have a true one
    late.timestamps[0] = 1.8
    assert ate_apart([part, late], truth) == pytest.approx(evaluate(part, truth).ate_m)
    with pytest.raises(TrajectoryError, match="no submap has 3 estimated poses"):
        ate_apart([late], truth)


def test_a_path_that_stands_still_is_finite() -> None:
    T_wc = torch.eye(4, dtype=torch.float64).expand(5, 4, 4)
    evaluation = evaluate(Trajectory(_times(5), T_wc), Trajectory(_times(5), T_wc))
    assert (evaluation.ate_m, evaluation.scale, evaluation.path_length_m) == (0.0, 1.0, 0.0)


def test_errors_are_differentiable(generator: torch.Generator) -> None:
    T_cw, truth = _poses(generator, 8), _poses(generator, 8)
    mask = torch.tensor([True] * 6 + [False, True])
    xi = torch.zeros(8, 6, dtype=torch.float64, requires_grad=True)
    for with_scale in (True, False):
        assert torch.autograd.gradcheck(
            lambda xi, s=with_scale: ate(
                T_cw=se3_exp(xi) @ T_cw, T_cw_groundtruth=truth, mask=mask, with_scale=s
            ),
            xi,
            atol=1e-6,
        )
        assert torch.autograd.gradcheck(
            lambda xi, s=with_scale: rpe(
                T_cw=se3_exp(xi) @ T_cw, T_cw_groundtruth=truth, delta=2, mask=mask, with_scale=s
            ),
            xi,
            atol=1e-6,
        )


def test_gradient_on_exact_data_is_zero(generator: torch.Generator, dtype: torch.dtype) -> None:
    truth = _poses(generator, 8, dtype)
    T_cw = truth.clone().requires_grad_()
    (ate(T_cw=T_cw, T_cw_groundtruth=truth) + sum(rpe(T_cw=T_cw, T_cw_groundtruth=truth))).backward()
    assert T_cw.grad is not None
    assert T_cw.grad.isfinite().all()


def test_delta_out_of_range(generator: torch.Generator) -> None:
    T_cw = _poses(generator, 4)
    for delta in (0, 4):
        with pytest.raises(ValueError, match="delta must be between 1 and 3"):
            rpe(T_cw=T_cw, T_cw_groundtruth=T_cw, delta=delta)


def _evo_figures(estimate: Trajectory, groundtruth: Trajectory, interpolate: bool) -> dict[str, float]:
    """The same figures from evo."""
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    def convert(trajectory: Trajectory) -> PoseTrajectory3D:
        wxyz = quaternion_from_matrix(trajectory.T_wc[:, :3, :3]).roll(1, dims=-1)
        return PoseTrajectory3D(trajectory.positions_w.numpy(), wxyz.numpy(), trajectory.timestamps.numpy())

    def rmse(metric: metrics.PE, reference: PoseTrajectory3D, other: PoseTrajectory3D) -> float:
        metric.process_data((reference, other))
        return float(metric.get_statistic(metrics.StatisticsType.rmse))

    truth, similar = convert(groundtruth), convert(estimate)
    if interpolate:
        truth = truth.interpolate(similar.timestamps)
    truth, similar = sync.associate_trajectories(truth, similar, max_diff=0.02)
    _, rigidly = sync.associate_trajectories(truth, convert(estimate), max_diff=0.02)
    similar.align(truth, correct_scale=True)
    rigidly.align(truth)
    relation = metrics.PoseRelation
    return {
        "ate_m": rmse(metrics.APE(relation.translation_part), truth, similar),
        "ate_se3_m": rmse(metrics.APE(relation.translation_part), truth, rigidly),
        "translation_m": rmse(
            metrics.RPE(relation.translation_part, delta=2, delta_unit=metrics.Unit.frames, all_pairs=True),
            truth,
            similar,
        ),
        "rotation_deg": rmse(
            metrics.RPE(relation.rotation_angle_deg, delta=2, delta_unit=metrics.Unit.frames, all_pairs=True),
            truth,
            similar,
        ),
    }


def _noisy(T_wc: Tensor, generator: torch.Generator) -> Tensor:
    """Poses with some noise, at a third of the scale, in another submap."""
    spread = torch.tensor([0.02] * 3 + [0.01] * 3, dtype=torch.float64)
    return _moved(T_wc @ se3_exp(spread * torch.randn(len(T_wc), 6, generator=generator).double()), 1 / 3)


@pytest.mark.parametrize("association", ["nearest", "interpolate"])
def test_agrees_with_evo(association: str, generator: torch.Generator) -> None:
    pytest.importorskip("evo")
    # Smooth, since evo interpolates position and rotation apart from each other, and a geodesic couples them.
    steps = 0.02 * torch.randn(400, 6, generator=generator, dtype=torch.float64)
    truth = Trajectory(_times(400, rate=97.0), se3_exp(steps.cumsum(0)))
    times = _times(40, rate=10.0) + 0.0123
    T_wc, _ = interpolate_poses(truth, times, 0.02)
    estimate = Trajectory(times, _noisy(T_wc, generator))
    expected = _evo_figures(estimate, truth, association == "interpolate")
    figures = evaluate(estimate, truth, association=association, delta=2).as_dict()
    tolerance = 1e-9 if association == "nearest" else 1e-3
    for name in ("ate_m", "ate_se3_m"):
        assert figures[name] == pytest.approx(expected[name], rel=tolerance)
    for name in ("translation_m", "rotation_deg"):
        assert figures["rpe"][name] == pytest.approx(expected[name], rel=tolerance)


def test_too_few_poses_have_no_error(generator: torch.Generator) -> None:
    poses = _poses(generator, 4).requires_grad_()
    truth = _poses(generator, 4)
    for count in range(5):
        mask = torch.arange(4) < count
        errors = torch.stack(
            (
                ate(T_cw=poses, T_cw_groundtruth=truth, mask=mask),
                *rpe(T_cw=poses, T_cw_groundtruth=truth, mask=mask),
            )
        )
        assert errors.isnan().all() == (count < 3)
        (gradient,) = torch.autograd.grad(errors.sum(), poses)
        assert gradient.isfinite().all()
        assert (gradient != 0).any() == (count >= 3)
    alone = rpe(
        T_cw=poses,
        T_cw_groundtruth=truth,
        delta=2,
        mask=torch.tensor([True, True, False, False]),
        with_scale=False,
    )
    assert torch.stack(alone).isnan().all()


def test_the_error_has_first_derivatives_in_both_modes(generator: torch.Generator) -> None:
    poses, truth = _poses(generator, 5), _poses(generator, 5)
    reverse, forward = (
        transform(lambda x: ate(T_cw=x, T_cw_groundtruth=truth))(poses) for transform in (jacrev, jacfwd)
    )
    torch.testing.assert_close(forward, reverse, rtol=0, atol=1e-12)
    assert (reverse != 0).any()


@pytest.mark.parametrize("planar", [False, True])
def test_the_error_has_second_derivatives(planar: bool, generator: torch.Generator) -> None:
    """Of a line that is bent out of a plane as well, whose smallest singular values are equal."""
    truth = _poses(generator, 5)
    if planar:
        truth[:, 2, 3] = 0
        truth[:, :3, :3] = torch.eye(3)
    noise = 0.1 * torch.randn(5, 6, generator=generator, dtype=torch.float64)

    def error(noise: Tensor) -> Tensor:
        return ate(T_cw=se3_exp(noise) @ truth, T_cw_groundtruth=truth)

    noise.requires_grad_()
    assert torch.autograd.gradgradcheck(error, noise, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
@pytest.mark.parametrize("counts", [True, False])
def test_a_pose_that_is_not_finite_fails_its_element_alone(
    bad: float, counts: bool, generator: torch.Generator
) -> None:
    truth = torch.stack([_poses(generator, 6) for _ in range(3)])
    estimate = se3_exp(0.1 * torch.randn(3, 6, 6, generator=generator, dtype=torch.float64)) @ truth
    mask = torch.ones(3, 6, dtype=torch.bool)
    mask[1, 2] = counts
    broken = estimate.clone()
    broken[1, 2] = bad
    broken.requires_grad_()
    for found, expected in (
        (
            ate(T_cw=broken, T_cw_groundtruth=truth, mask=mask),
            ate(T_cw=estimate, T_cw_groundtruth=truth, mask=mask),
        ),
        *zip(
            rpe(T_cw=broken, T_cw_groundtruth=truth, delta=1, mask=mask),
            rpe(T_cw=estimate, T_cw_groundtruth=truth, delta=1, mask=mask),
            strict=True,
        ),
    ):
        if bad == 0:  # no rotation, but finite: the numbers say so
            assert found.isfinite().all()
            continue
        assert torch.equal(found.isnan(), torch.tensor([False, counts, False]))
        torch.testing.assert_close(found[~found.isnan()], expected[~found.isnan()])
        (gradient,) = torch.autograd.grad(found.nansum(), broken, retain_graph=True)
        assert gradient.isfinite().all()
        assert (gradient[1].abs().max() > 0) != counts


@pytest.mark.usefixtures("without_shape_checks")
def test_trajectories_that_cannot_be_compared_are_refused(generator: torch.Generator) -> None:
    T_wc, unix = _poses(generator, 20), 1.6e9 + _times(20)
    other = Trajectory(unix, _poses(generator, 20))
    for times, poses, message in (
        (unix.float(), T_wc, "timestamps of a trajectory must be torch.float64, not torch.float32"),
        (unix.flip(0), T_wc, "times of a trajectory must increase"),
        (unix[:, None], T_wc, r"must be \(N,\) and \(N, 4, 4\), not \(20, 1\) and"),
        (unix[:5], T_wc, r"not \(5,\) and \(20, 4, 4\)"),
        (unix.long(), T_wc, "not torch.int64"),
        (unix.numpy(), T_wc, "not ndarray"),
        (unix, T_wc.half(), "T_wc of a trajectory must be torch.float32 or torch.float64, not torch.float16"),
        (unix, torch.where(torch.arange(20).view(-1, 1, 1) == 3, torch.nan, T_wc), "pose 3 .* is not finite"),
        (torch.where(torch.arange(20) == 4, torch.nan, unix), T_wc, "time 4 of a trajectory is not finite"),
    ):
        with pytest.raises(TrajectoryError, match=message):
            Trajectory(times, poses)
    rounded = Trajectory(unix.float().double(), T_wc)  # as of frames of several sessions
    for pair in ((rounded, other), (other, rounded)):
        with pytest.raises(
            TrajectoryError, match=r"times of a trajectory must increase: 16.* s, row 1, follows 16"
        ):
            evaluate(*pair)
    still = Trajectory(unix, T_wc[:1].expand(20, 4, 4))
    with pytest.raises(
        TrajectoryError, match="20 compared positions of the ground truth are the same, the others"
    ):
        evaluate(other, still)
    with pytest.raises(TrajectoryError, match="all 20 compared positions of the estimate are the same"):
        evaluate(still, other)


def test_unknown_options_are_refused(generator: torch.Generator) -> None:
    path = Trajectory(_times(20), _poses(generator, 20))
    for options, message in (
        ({"association": "linear"}, "unknown association 'linear'; known are interpolate, nearest"),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate(path, path, **options)


def test_a_truth_without_extent_has_no_ate(generator: torch.Generator) -> None:
    """A similarity would shrink any estimate to that place: an error of zero."""
    estimate = _poses(generator, 9).requires_grad_()
    still = _poses(generator, 1).expand(9, 4, 4)
    error = ate(T_cw=estimate, T_cw_groundtruth=still)
    (gradient,) = torch.autograd.grad(error, estimate)
    assert error.isnan()
    assert not gradient.any()
    assert ate(T_cw=estimate, T_cw_groundtruth=still, with_scale=False) > 0.1


def test_an_estimate_without_extent_has_no_ate(generator: torch.Generator) -> None:
    """Nothing fixes the scale; the centers differ by rounding, which gave a gradient of 1e14."""
    still = _poses(generator, 1).expand(9, 4, 4).clone().requires_grad_()
    truth = _poses(generator, 9)
    for errors in ([ate(T_cw=still, T_cw_groundtruth=truth)], rpe(T_cw=still, T_cw_groundtruth=truth)):
        for error in errors:
            (gradient,) = torch.autograd.grad(error, still, retain_graph=True)
            assert float(gradient.abs().max()) < 10
    assert ate(T_cw=still, T_cw_groundtruth=truth).isnan()
    assert not torch.autograd.grad(ate(T_cw=still, T_cw_groundtruth=truth), still)[0].any()
    assert ate(T_cw=still, T_cw_groundtruth=truth, with_scale=False) > 0.1
