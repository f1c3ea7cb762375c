"""Training through short clips: right gradients to the feature extractor, and an ordinary loop that learns."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc, still
from torchslam import ORB, Camera, ClipPoses, ClipSLAM, Features, clip_loss, open_sequence
from torchslam.errors import ClipError, FrameError
from torchslam.evaluation import ate, rpe
from torchslam.features import SimulatedFeatures
from torchslam.geometry import se3_exp
from torchslam.system import map_start, state_machine

FRAMES = 7


class BentExtractor(nn.Module):
    """An extractor that knows the scene, and sees it through a lens it does not know: a bend of 0 would be right."""

    def __init__(self, walk: Walk, bend: float, noise_px: float = 0.2) -> None:
        super().__init__()
        self.bend = nn.Parameter(torch.tensor(bend, dtype=torch.float64))
        poses = true_T_cw(walk)
        scene = SimulatedFeatures(
            poses,
            walk.camera,
            num_keypoints=300,
            points_per_view=150,
            depth_near=1.0,
            depth_far=5.0,
            noise_px=noise_px,
        )
        frames = [scene(pose, index) for index, pose in enumerate(poses)]
        self.exact = Features.cat(frames)

    def forward(self, images: Tensor) -> Features:
        away = self.exact.keypoints - self.exact.keypoints.new_tensor([159.5, 119.5])
        squared_radius = (away / 200).square().sum(-1, keepdim=True)
        return replace(self.exact, keypoints=self.exact.keypoints + self.bend * squared_radius * away)


def clip_of(walk: Walk) -> tuple[Tensor, Tensor]:
    """Images (T, 1, H, W) and true poses (T, 4, 4)."""
    return torch.cat([walk.image(index) for index in range(len(walk))]), true_T_cw(walk)


def derivative(loss: object, value: float, h: float) -> float:
    """Central difference of a function of one number."""
    assert callable(loss)
    with torch.no_grad():
        return float(loss(value + h) - loss(value - h)) / (2 * h)


def test_the_gradient_to_a_feature_extractor_agrees_with_finite_differences() -> None:
    walk = Walk(arc(FRAMES, length=1.0))
    images, truth = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.01)
    clip_slam = ClipSLAM(extractor)

    def loss(bend: float) -> Tensor:
        with torch.no_grad():
            extractor.bend.fill_(bend)
        poses = clip_slam(images, walk.camera)
        return (
            ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed)
            + rpe(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed)[1]
        )

    loss(0.01).backward()
    assert extractor.bend.grad is not None
    assert float(extractor.bend.grad) == pytest.approx(derivative(loss, 0.01, 1e-5), rel=1e-3)


def test_the_gradient_to_weights_and_camera_agrees_with_finite_differences() -> None:
    walk = Walk(arc(FRAMES, length=1.0))
    images, truth = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.01)

    def loss(falloff: Tensor | float, focal: Tensor | float) -> Tensor:
        def keypoint_weight(features: Features) -> Tensor:
            away = features.keypoints.detach() - features.keypoints.new_tensor([159.5, 119.5])
            return torch.exp(-falloff * (away / 200).square().sum(-1))

        camera = Camera.pinhole(focal, focal, 159.5, 119.5, size=(320, 240))
        poses = ClipSLAM(extractor, keypoint_weight)(images, camera)
        return ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed)

    falloff = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    focal = torch.tensor(400.0, dtype=torch.float64, requires_grad=True)
    loss(falloff, focal).backward()
    assert falloff.grad is not None
    assert focal.grad is not None
    assert float(falloff.grad) == pytest.approx(derivative(lambda x: loss(x, 400.0), 1.0, 1e-3), rel=1e-3)
    assert float(focal.grad) == pytest.approx(derivative(lambda x: loss(1.0, x), 400.0, 1e-2), rel=1e-2)


def test_a_training_loop_estimates_the_distortion() -> None:
    walk = Walk(arc(FRAMES, length=1.0))
    images, truth = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.02, noise_px=0.05)
    clip_slam = ClipSLAM(extractor)
    optimizer = torch.optim.Adam(clip_slam.parameters(), 0.004)
    losses = []
    for _ in range(6):
        optimizer.zero_grad()
        poses = clip_slam(images, walk.camera)
        assert poses.posed.all()
        loss = ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.3 * losses[0]
    assert abs(float(extractor.bend.detach())) < 0.01


def test_the_gradient_reaches_the_images() -> None:
    room = open_sequence("synthetic:room").part(0, 40, 8)
    images = torch.cat([room.image(index) for index in range(len(room))]).requires_grad_()
    truth = torch.stack([pose for index in range(len(room)) if (pose := room.pose(index)) is not None])
    poses = ClipSLAM(ORB(400, differentiable=True))(images, room.camera)
    assert poses.posed.all()
    error = ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed)
    assert float(error.detach()) < 0.05 * float((truth[1:] - truth[:-1])[:, :3, 3].norm(dim=-1).sum())
    error.backward()
    assert images.grad is not None
    assert torch.isfinite(images.grad).all()
    assert (images.grad.abs().sum((1, 2, 3)) > 0).all()


def test_a_clip_without_a_map_has_no_pose_and_zero_gradient() -> None:
    walk = Walk(still(4))
    images, truth = clip_of(walk)
    extractor = BentExtractor(walk, bend=0.02)
    poses = ClipSLAM(extractor)(images, walk.camera)
    assert not poses.posed.any()
    assert not poses.success
    (reason,) = poses.reasons
    assert reason.startswith(
        "no map was initialized in 4 frames: the camera stands still"
    )  # as a run says it
    assert poses.failure_rate == 1.0
    assert poses.graphs == poses.solutions == (None,)
    assert torch.equal(poses.T_cw, torch.eye(4, dtype=torch.float64).expand(4, 4, 4))
    assert ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed).isnan()
    for choice in ("raise", "skip"):
        with pytest.raises(
            ClipError, match="1 of 1 clips failed; clip 0: no map was initialized in 4 frames"
        ):
            clip_loss(poses, T_cw_groundtruth=truth, on_failure=choice)
    loss, failure_rate = clip_loss(poses, T_cw_groundtruth=truth, on_failure=2.5)
    assert (float(loss.detach()), failure_rate) == (2.5, 1.0)
    loss.backward()
    assert extractor.bend.grad == 0


def test_a_failed_clip_does_not_count_as_zero_error() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = se3_exp(torch.randn(3, 5, 6, generator=generator, dtype=torch.float64))
    T_cw = se3_exp(torch.randn(3, 5, 6, generator=generator, dtype=torch.float64)).requires_grad_()
    posed = torch.ones(3, 5, dtype=torch.bool)
    posed[1] = False
    success, reason = torch.tensor([True, False, True]), ("", "no map started", "")
    poses = ClipPoses(T_cw, posed, success, reason, (None,) * 3, (None,) * 3)
    errors = ate(T_cw=T_cw, T_cw_groundtruth=truth, mask=posed)[[0, 2]]
    loss, failure_rate = clip_loss(poses, T_cw_groundtruth=truth, on_failure="skip")
    torch.testing.assert_close(loss, errors.mean())
    assert failure_rate == pytest.approx(1 / 3)
    torch.testing.assert_close(
        clip_loss(poses, T_cw_groundtruth=truth, on_failure=3.0).loss, (errors.sum() + 3) / 3
    )
    (gradient,) = torch.autograd.grad(loss, T_cw)
    assert gradient.isfinite().all()
    assert (gradient[1] == 0).all()
    with pytest.raises(ClipError, match="1 of 3 clips failed; clip 1: no map started"):
        clip_loss(poses, T_cw_groundtruth=truth)
    with pytest.raises(ValueError, match="'ignore'"):
        clip_loss(poses, T_cw_groundtruth=truth, on_failure="ignore")  # type: ignore[arg-type]


@pytest.mark.usefixtures("without_shape_checks")
def test_images_have_the_dimensions_of_clips() -> None:
    walk = Walk(arc(2, length=1.0))
    with pytest.raises(ValueError, match="images must be"):
        ClipSLAM(BentExtractor(walk, bend=0.0))(clip_of(walk)[0][0], walk.camera)


def test_a_split_clip_has_the_poses_of_its_main_submap(monkeypatch: pytest.MonkeyPatch) -> None:
    """It looks ahead in most frames, and back in the others: what cannot be compared is not posed."""
    poses = torch.cat([arc(22, length=1.0), arc(10, length=1.0)])
    poses[22:, :3, :3] *= torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)  # half a turn about y
    walk = Walk(poses)
    images, truth = clip_of(walk)
    monkeypatch.setattr(state_machine, "FRAMES_BEFORE_NEW_SUBMAP", 1)
    monkeypatch.setattr(map_start, "PROVISIONAL_FRAMES", 2)
    poses_found = ClipSLAM(BentExtractor(walk, bend=0.0))(images, walk.camera)
    assert poses_found.posed.tolist() == [True] * 22 + [False] * 10
    assert float(ate(T_cw=poses_found.T_cw, T_cw_groundtruth=truth, mask=poses_found.posed).detach()) < 0.01


def test_a_short_clip_of_a_wall_starts() -> None:
    """A run waits for ten frames before it believes in a plane; a clip of eight has poses all the same."""
    sequence = open_sequence("synthetic:planar", resize_to="320x240", stride=3, limit=8)
    images = torch.cat([sequence.image(index) for index in range(8)])
    poses = ClipSLAM(ORB(600))(images, sequence.camera)
    assert poses.success, poses.reasons
    assert poses.posed.all()
    truth = torch.stack([sequence.pose(index) for index in range(8)])
    path = (truth[-1, :3, 3] - truth[0, :3, 3]).norm()
    assert ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed) < 0.05 * path


def test_the_gradient_is_the_same_under_detect_anomaly() -> None:
    walk, gradients = Walk(arc(FRAMES, length=1.0)), []
    images, truth = clip_of(walk)
    for is_detected in (False, True):
        extractor = BentExtractor(walk, bend=0.02)
        camera = walk.camera.with_params(walk.camera.params.clone().requires_grad_())
        with torch.autograd.set_detect_anomaly(is_detected):
            ate(T_cw=ClipSLAM(extractor)(images, camera).T_cw, T_cw_groundtruth=truth).backward()
        gradients.append((extractor.bend.grad, camera.params.grad))
    torch.testing.assert_close(*gradients)
    assert float(gradients[1][0]) != 0


@pytest.mark.usefixtures("without_shape_checks")
def test_weights_of_keypoints_of_another_shape_are_refused() -> None:
    """As a network with one output gives them: (T, N, 1)."""
    walk = Walk(arc(FRAMES, length=1.0))
    for change in (lambda x: x[..., None], lambda x: x[0], lambda x: x.long()):
        extractor = BentExtractor(walk, bend=0.02)
        clip_slam = ClipSLAM(extractor, lambda features, change=change: change(features.scores))
        with pytest.raises(ValueError, match=r"keypoint_weight must give floats \(T, N\) = \(7, 300\), not"):
            clip_slam(clip_of(walk)[0], walk.camera)


@pytest.mark.usefixtures("without_shape_checks")
def test_images_that_are_not_gray_are_refused() -> None:
    walk = Walk(arc(FRAMES, length=1.0))
    images, _ = clip_of(walk)
    clip_slam = ClipSLAM(BentExtractor(walk, bend=0.02))
    with pytest.raises(FrameError, match=r"images of a clip must be in \[0, 1\], these are from .* to 255"):
        clip_slam(torch.full_like(images, 255.0), walk.camera)
    with pytest.raises(ValueError, match=r"images must be \(T, 1, H, W\)"):
        clip_slam(images.expand(-1, 3, -1, -1), walk.camera)
