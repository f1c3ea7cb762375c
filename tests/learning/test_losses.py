"""Losses: known values, what they do not depend on, masks, gradients."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from tests.learning.test_clip_slam import FRAMES, BentExtractor, clip_of, derivative
from tests.walks import Walk, arc, still
from torchslam import Camera, ClipSLAM, clip_loss
from torchslam.errors import ClipError
from torchslam.evaluation import ate, rpe
from torchslam.geometry import rigid, se3_exp, se3_inverse, sim3_exp, so3_exp, transform
from torchslam.learning.clip_slam import clip_mean
from torchslam.learning.losses import (
    clip_reprojection,
    epipolar_loss,
    motion_difference,
    path_length,
    pose_errors,
    pose_nll,
    relative_ate,
    reprojection_loss,
)

CAMERA = Camera.radial_tangential(400.0, 410.0, 159.5, 119.5, -0.05, 0.02, 1e-3, -1e-3, size=(320, 240))


def normal(*shape: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def poses(*shape: int, seed: int = 0, scale: float = 0.5) -> Tensor:
    return se3_exp(normal(*shape, 6, seed=seed, scale=scale))


def scene(views: int = 3, points: int = 7, batch: int = 2) -> tuple[Tensor, Tensor]:
    """Poses (B, V, 4, 4) and exact pixels (B, N, V, 2) of points before them."""
    steps = torch.arange(views, dtype=torch.float64)[:, None] * torch.tensor([0.4, 0.05, 0.02]).double()
    T_cw = rigid(so3_exp(normal(batch, views, 3, scale=0.02)), -steps)
    points_w = normal(batch, points, 3, seed=1).clamp(-2, 2) + torch.tensor([0.0, 0.0, 6.0])
    seen = [CAMERA.project(transform(T_cw[:, view], points_w))[0] for view in range(views)]
    return T_cw, torch.stack(seen, -2)


def test_the_path_length_is_that_of_the_camera() -> None:
    centers = torch.tensor([[0.0, 0, 0], [3, 4, 0], [3, 4, 2]], dtype=torch.float64)
    T_wc = rigid(so3_exp(normal(3, 3)), centers)
    assert float(path_length(se3_inverse(T_wc))) == pytest.approx(7.0)


@settings(deadline=None, max_examples=20)
@given(st.floats(0.1, 10.0), st.integers(0, 5))
def test_scale_free_losses_do_not_depend_on_the_frame(scale: float, seed: int) -> None:
    T_cw, truth = poses(6, seed=seed), poses(6, seed=seed + 100)
    S = sim3_exp(torch.cat([normal(6, seed=seed + 7), torch.tensor([math.log(scale)]).double()]))
    T_wc = S @ se3_inverse(T_cw)
    moved = se3_inverse(rigid(T_wc[:, :3, :3] / scale, T_wc[:, :3, 3]))
    for loss in (ate, relative_ate, lambda **pair: torch.stack(rpe(**pair))):
        expected = loss(T_cw=T_cw, T_cw_groundtruth=truth)
        torch.testing.assert_close(loss(T_cw=moved, T_cw_groundtruth=truth), expected)
    longer = rigid(truth[:, :3, :3], scale * truth[:, :3, 3])
    torch.testing.assert_close(
        relative_ate(T_cw=T_cw, T_cw_groundtruth=longer), relative_ate(T_cw=T_cw, T_cw_groundtruth=truth)
    )


def test_the_relative_error_is_the_ate_over_the_path_length() -> None:
    T_cw, truth = poses(2, 6), poses(2, 6, seed=1)
    mask = torch.tensor([[True] * 6, [True] * 2 + [False] * 4])
    shares = relative_ate(T_cw=T_cw, T_cw_groundtruth=truth, mask=mask)
    torch.testing.assert_close(
        shares[0] * path_length(truth[0]), ate(T_cw=T_cw[0], T_cw_groundtruth=truth[0])
    )
    assert shares[1].isnan()
    standing = torch.eye(4, dtype=torch.float64).expand(2, 6, 4, 4)
    T_cw.requires_grad_()
    shares = relative_ate(T_cw=T_cw, T_cw_groundtruth=standing)
    assert shares.isnan().all()
    (gradient,) = torch.autograd.grad(shares.sum(), T_cw)
    assert (gradient == 0).all()


def test_pose_errors_are_distance_and_angle() -> None:
    truth = poses(5)
    turned = se3_exp(torch.tensor([0, 0, 0, 0, 0.3, 0]).double()) @ truth
    moved = truth @ se3_exp(torch.tensor([0, 0.2, 0, 0, 0, 0]).double())
    torch.testing.assert_close(
        pose_errors(T_cw=turned, T_cw_groundtruth=truth)[:, 1], torch.full((5,), 0.3).double()
    )
    torch.testing.assert_close(
        pose_errors(T_cw=moved, T_cw_groundtruth=truth)[:, 0], torch.full((5,), 0.2).double()
    )
    exact = truth.clone().requires_grad_()
    pose_errors(T_cw=exact, T_cw_groundtruth=truth).sum().backward()
    assert exact.grad is not None
    assert exact.grad.isfinite().all()


def test_motion_errors_are_rotation_and_direction_angles() -> None:
    turn = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    T_21 = rigid(torch.eye(3).double(), torch.tensor([0.0, 0.0, 2.0]).double())
    other = rigid(so3_exp(turn), torch.tensor([0.0, math.sin(0.1), math.cos(0.1)]).double())
    rotation, direction = motion_difference(other, T_21)
    torch.testing.assert_close(rotation, turn)
    torch.testing.assert_close(direction, torch.tensor([-0.1, 0.0, 0.0]).double())
    assert (motion_difference(T_21, T_21) == 0).all()
    opposite = rigid(torch.eye(3).double(), torch.tensor([0.0, 1e-3, -5.0]).double())
    assert float(motion_difference(opposite, T_21)[1].norm()) == pytest.approx(math.pi, abs=1e-3)


def test_the_likelihood_is_that_of_a_gaussian() -> None:
    xi, A = normal(4, 6, scale=0.1), normal(4, 6, 6, seed=1)
    covariance = A @ A.mT + 0.1 * torch.eye(6)
    T_cw = poses(4)
    expected = [
        -torch.distributions.MultivariateNormal(torch.zeros(6).double(), S).log_prob(x)
        for x, S in zip(xi, covariance, strict=True)
    ]
    truth = se3_exp(xi) @ T_cw
    torch.testing.assert_close(
        pose_nll(T_cw=T_cw, T_cw_groundtruth=truth, covariance=covariance), torch.stack(expected).mean()
    )
    covariance[1], covariance[2] = 0.0, torch.nan
    mask = torch.tensor([True, True, True, False])
    covariance.requires_grad_()
    loss = pose_nll(T_cw=T_cw, T_cw_groundtruth=truth, covariance=covariance, mask=mask)
    torch.testing.assert_close(loss, expected[0])
    (gradient,) = torch.autograd.grad(loss, covariance)
    assert (gradient[1:] == 0).all()
    assert (gradient[0] != 0).all()
    assert pose_nll(
        T_cw=T_cw, T_cw_groundtruth=truth, covariance=covariance, mask=~mask & (mask > mask)
    ).isnan()


def test_the_epipolar_loss_is_the_distance_from_the_line() -> None:
    """Sideways, the lines are the rows: a match that is off by y pixels is y / sqrt(2) off in both images together."""
    camera = Camera.pinhole(400.0, 400.0, 159.5, 119.5, size=(320, 240))
    T_21 = rigid(torch.eye(3).double(), torch.tensor([-0.5, 0.0, 0.0]).double())
    pixels = 100 + normal(6, 2, scale=20.0)
    other = pixels + torch.tensor([-9.0, 0.6], dtype=torch.float64)
    losses = [epipolar_loss(T_21, pixels, other, camera, camera, kernel="none") for _ in range(2)]
    torch.testing.assert_close(losses[0], torch.tensor(0.18).double())
    robust = epipolar_loss(T_21, pixels, other, camera, camera, scale=0.5)
    torch.testing.assert_close(robust, torch.tensor(0.25 * math.log1p(0.18 / 0.25)).double())
    # An image of twice the focal length has half the share of the same number of pixels in an angle.
    large = Camera.pinhole(800.0, 800.0, 319.5, 239.5, size=(640, 480))
    twice = epipolar_loss(T_21, pixels, 2 * other + 0.5, camera, large, kernel="none")
    torch.testing.assert_close(twice, torch.tensor(0.6**2 / (1 + 0.25)).double())


def test_masked_matches_may_be_anything() -> None:
    T_cw, pixels = scene(2)
    T_21 = T_cw[:, 1] @ se3_inverse(T_cw[:, 0])
    pixels = pixels + normal(*pixels.shape)
    mask = torch.ones(2, 7, dtype=torch.bool)
    mask[0, 4:], mask[1] = False, False
    spoilt = pixels.clone()
    spoilt[0, 4:], spoilt[1] = torch.nan, 1e9
    params = CAMERA.params.clone().requires_grad_()
    camera = CAMERA.with_params(params)
    for loss, expected in (
        (
            epipolar_loss(T_21, *spoilt.unbind(-2), camera, camera, mask),
            epipolar_loss(T_21[0], *pixels[0, :4].unbind(-2), CAMERA, CAMERA),
        ),
        (
            reprojection_loss(T_cw, spoilt, camera, mask[..., None].expand(-1, -1, 2)),
            reprojection_loss(T_cw[0], pixels[0, :4], CAMERA),
        ),
    ):
        torch.testing.assert_close(loss[0], expected)
        assert loss[1].isnan()
        (gradient,) = torch.autograd.grad(loss[0], params)
        assert gradient.isfinite().all()


def test_exact_matches_and_tracks_cost_nothing() -> None:
    T_cw, pixels = scene()
    T_21 = T_cw[:, 1] @ se3_inverse(T_cw[:, 0])
    assert float(epipolar_loss(T_21, *pixels[..., :2, :].unbind(-2), CAMERA, CAMERA).max()) < 1e-16
    assert float(reprojection_loss(T_cw, pixels, CAMERA).max()) < 1e-12


def test_tracks_are_charged_their_smallest_errors() -> None:
    """Sideways, two views that are a pixel apart in y meet half a pixel from both."""
    camera = Camera.pinhole(400.0, 400.0, 159.5, 119.5, size=(320, 240))
    T_cw = rigid(torch.eye(3).double(), torch.tensor([[0.0, 0, 0], [-1.0, 0, 0]]).double())
    pixels = torch.tensor([[[150.0, 100.0], [100.0, 101.0]]]).double()
    loss = reprojection_loss(T_cw, pixels, camera, kernel="none")
    assert float(loss) == pytest.approx(0.5, abs=1e-3)
    assert reprojection_loss(T_cw, pixels, camera, torch.tensor([[True, False]])).isnan()
    assert reprojection_loss(T_cw, pixels.flip(-2), camera).isnan()  # they meet behind
    beyond = rigid(torch.eye(3).double(), torch.tensor([0.0, 0.0, -20.0]).double())
    three = torch.cat([T_cw, beyond[None]])  # 8 away is the point: the third view has passed it
    assert reprojection_loss(three, torch.cat([pixels, pixels[:, :1]], 1), camera).isnan()


@pytest.mark.parametrize(
    "loss",
    [
        lambda T: relative_ate(
            T_cw=T,
            T_cw_groundtruth=poses(2, 4, seed=1),
            mask=torch.tensor([[True] * 4, [True] * 3 + [False]]),
        ),
        lambda T: pose_errors(T_cw=T, T_cw_groundtruth=poses(2, 4, seed=1)),
        lambda T: pose_errors(
            T_cw=T,
            T_cw_groundtruth=se3_exp(torch.tensor([0, 0.1, 0, math.pi - 0.01, 0, 0]).double()) @ poses(2, 4),
        ),
        lambda T: motion_difference(T, poses(2, 4, seed=1)),
    ],
    ids=["relative_ate", "pose_errors", "pose_errors near pi", "motion_difference"],
)
def test_gradients_of_pose_losses(loss: Callable[[Tensor], Tensor]) -> None:
    xi = torch.zeros(2, 4, 6, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda xi: loss(se3_exp(xi) @ poses(2, 4)), (xi,))


@pytest.mark.parametrize("exact", [False, True])
def test_gradients_of_the_likelihood(exact: bool) -> None:
    T_cw, A = poses(2, 3), normal(2, 3, 6, 6, seed=1)
    truth = T_cw if exact else poses(2, 3, seed=2)
    mask = torch.tensor([[True] * 3, [True, False, True]])
    xi = torch.zeros(2, 3, 6, dtype=torch.float64, requires_grad=True)

    def loss(xi: Tensor, A: Tensor) -> Tensor:
        return pose_nll(
            T_cw=se3_exp(xi) @ T_cw, T_cw_groundtruth=truth, covariance=A @ A.mT + torch.eye(6), mask=mask
        )

    assert gradcheck(loss, (xi, A.requires_grad_()))


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("name", ["epipolar", "reprojection"])
def test_gradients_of_losses_of_matches(name: str, noise: float) -> None:
    T_cw, pixels = scene(views=2 if name == "epipolar" else 3, points=4)
    pixels = (pixels + normal(*pixels.shape, seed=3, scale=noise)).requires_grad_()
    xi = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    params = CAMERA.params.clone().requires_grad_()

    def loss(xi: Tensor, pixels: Tensor, params: Tensor) -> Tensor:
        camera = CAMERA.with_params(params)
        last = se3_exp(xi) @ T_cw[:, -1]
        if name == "reprojection":
            mask = torch.ones(2, 4, 3, dtype=torch.bool)
            mask[0, 0, 0] = mask[1, 2, 1] = False
            return reprojection_loss(torch.cat([T_cw[:, :-1], last[:, None]], 1), pixels, camera, mask)
        return epipolar_loss(last @ se3_inverse(T_cw[:, 0]), *pixels.unbind(-2), camera, camera)

    # Points are at the minimum up to Gauss-Newton's last step.
    assert gradcheck(loss, (xi, pixels, params), atol=1e-5, rtol=1e-3)


def test_a_batch_equals_its_elements() -> None:
    T_cw, pixels = scene()
    pixels = pixels + normal(*pixels.shape)
    truth = poses(2, 3, seed=1)
    covariance = torch.eye(6).double().expand(2, 3, 6, 6)
    for together, alone in (
        (
            reprojection_loss(T_cw, pixels, CAMERA),
            [reprojection_loss(T_cw[b], pixels[b], CAMERA) for b in range(2)],
        ),
        (
            pose_nll(T_cw=T_cw, T_cw_groundtruth=truth, covariance=covariance),
            [pose_nll(T_cw=T_cw[b], T_cw_groundtruth=truth[b], covariance=covariance[b]) for b in range(2)],
        ),
        (
            relative_ate(T_cw=T_cw, T_cw_groundtruth=truth),
            [relative_ate(T_cw=T_cw[b], T_cw_groundtruth=truth[b]) for b in range(2)],
        ),
    ):
        torch.testing.assert_close(together, torch.stack(alone))


def test_the_loss_of_a_clip_can_use_its_own_observations() -> None:
    walk = Walk(arc(FRAMES, length=1.0))
    images, _ = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.02, noise_px=0.1)
    clip_slam = ClipSLAM(extractor)
    graph = clip_slam.build_graph(images, walk.camera)

    def loss(bend: float) -> Tensor:
        with torch.no_grad():
            extractor.bend.fill_(bend)
        return clip_reprojection(clip_slam.pose(graph, clip_slam.extract(images)))

    loss(0.02).backward()
    assert extractor.bend.grad is not None
    assert float(extractor.bend.grad) == pytest.approx(derivative(loss, 0.02, 1e-5), rel=1e-2)
    values = [float(loss(bend).detach()) for bend in (0.05, 0.02, 0.0)]
    assert values == sorted(values, reverse=True)
    # Two coordinates of 0.1 px each, less what points and poses take up of it.
    assert 0.5 * 0.02 < values[-1] < 0.02


def test_failed_frames_and_unconverged_points_are_excluded_from_the_loss() -> None:
    walk = Walk(arc(FRAMES, length=1.0))
    poses = ClipSLAM(BentExtractor(walk, bend=0.02))(clip_of(walk)[0], walk.camera)
    (graph,), (solution,) = poses.graphs, poses.solutions
    assert graph is not None
    assert solution is not None
    lost, stuck = torch.zeros_like(solution.success), torch.zeros_like(solution.moved_points)
    lost[2], stuck[::3] = True, True
    spoilt = replace(
        solution,
        T_cw=torch.where(lost[:, None, None], torch.eye(4).double(), solution.T_cw),
        points_w=torch.where(stuck[:, None], solution.points_w + 0.5, solution.points_w),
        success=~lost,
        moved_points=~stuck,
    )
    kept = ~lost[graph.frame_index] & ~stuck[graph.point_index]
    columns = ("frame_index", "point_index", "pixels", "weights", "keypoint_index")
    part = replace(graph, **{name: getattr(graph, name)[kept] for name in columns})
    expected = clip_reprojection(replace(poses, graphs=(part,)))
    torch.testing.assert_close(clip_reprojection(replace(poses, solutions=(spoilt,))), expected)


def test_clips_have_separate_losses_and_failures_a_penalty() -> None:
    walk, standing = Walk(arc(FRAMES, length=1.0)), Walk(still(FRAMES))
    seen, unseen = (ClipSLAM(BentExtractor(each, bend=0.02)) for each in (walk, standing))
    good = seen(clip_of(walk)[0][None], walk.camera)
    assert clip_reprojection(good).shape == (1,)
    poses = unseen(clip_of(standing)[0][None], standing.camera)
    errors = clip_reprojection(poses)
    assert errors.isnan().all()
    with pytest.raises(ClipError):
        clip_mean(poses, errors)
    loss, failure_rate = clip_mean(poses, errors, on_failure=3.0)
    assert (float(loss.detach()), failure_rate) == (3.0, 1.0)
    loss.backward()
    truth = clip_of(walk)[1][None]
    whole = clip_loss(good, T_cw_groundtruth=truth, error=relative_ate)
    torch.testing.assert_close(whole.loss, relative_ate(T_cw=good.T_cw, T_cw_groundtruth=truth)[0])


def problem(like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Camera]:
    """Poses, true ones, motions, noisy pixels and a camera, where `like` is and in its dtype."""
    T_cw, pixels = scene()
    truth = se3_exp(normal(2, 3, 6, seed=4, scale=0.1)) @ T_cw
    T_21 = T_cw[:, 1] @ se3_inverse(T_cw[:, 0])
    tensors = (T_cw, truth, T_21, pixels + normal(*pixels.shape))
    return *(x.to(like) for x in tensors), CAMERA.with_params(CAMERA.params.to(like))


def every_loss(
    T_cw: Tensor, truth: Tensor, T_21: Tensor, pixels: Tensor, camera: Camera
) -> dict[str, Tensor]:
    covariance = 0.1 * torch.eye(6, dtype=T_cw.dtype, device=T_cw.device).expand(2, 3, 6, 6)
    return {
        "path_length": path_length(T_cw),
        "relative_ate": relative_ate(T_cw=T_cw, T_cw_groundtruth=truth),
        "pose_errors": pose_errors(T_cw=T_cw, T_cw_groundtruth=truth),
        "motion_difference": motion_difference(T_21, truth[:, 1]),
        "pose_nll": pose_nll(T_cw=T_cw, T_cw_groundtruth=truth, covariance=covariance),
        "epipolar_loss": epipolar_loss(T_21, *pixels[..., :2, :].unbind(-2), camera, camera),
        "reprojection_loss": reprojection_loss(T_cw, pixels, camera),
    }


def test_losses_keep_device_and_dtype(device: torch.device, dtype: torch.dtype) -> None:
    expected = every_loss(*problem(torch.zeros(1, dtype=torch.float64)))
    for name, loss in every_loss(*problem(torch.zeros(1, dtype=dtype, device=device))).items():
        assert loss.dtype == dtype, name
        assert loss.device.type == device.type, name
        torch.testing.assert_close(loss.cpu().double(), expected[name], rtol=1e-3, atol=1e-4)


def test_autocast_does_not_change_results() -> None:
    given = problem(torch.zeros(1))
    plain = every_loss(*given)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = every_loss(*given)
    assert all(torch.equal(plain[name], cast[name]) for name in plain)
