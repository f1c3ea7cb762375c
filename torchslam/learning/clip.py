"""SLAM of short clips as a module to train: images in, poses out, gradients back into whatever found the keypoints.

The system decides what is discrete (which keypoints match, which frames are keyframes) without gradient. What it
leaves behind is a least-squares problem whose pixels are read anew from the features, with their gradients; the poses
are its minimiser, differentiated by the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from torchslam.config import Config
from torchslam.errors import ClipError
from torchslam.evaluation import MIN_POSES, ate
from torchslam.geometry import Camera
from torchslam.run import finish
from torchslam.slam import SLAM
from torchslam.solvers.graph import GraphSolution, solve
from torchslam.values import Features, Frame
from torchslam.world.history import RunGraph


@dataclass(frozen=True)
class ClipPoses:
    """The poses of a clip of T frames, or of B clips.

    T_cw:      (T, 4, 4) or (B, T, 4, 4) world to camera, float64, the identity where there is no pose. The world is
               the camera of the clip's first keyframe, its unit of length the median depth of the first map.
    posed:     (T,) or (B, T) bool; where a clip falls apart into several worlds, the frames of the main one alone
    success:   () or (B,) bool: a map started, and enough frames are posed for an error to mean something
    reason:    one per clip: why there is no success, empty where there is
    graphs:    one per clip: what the system saw, with differentiable pixels and weights; None where no map started
    solutions: one per clip: the minimiser of the graph, with points and covariances; None where no map started
    """

    T_cw: Tensor
    posed: Tensor
    success: Tensor
    reason: tuple[str, ...]
    graphs: tuple[RunGraph | None, ...]
    solutions: tuple[GraphSolution | None, ...]

    @property
    def failures(self) -> float:
        """The share of the clips that failed."""
        return float((~self.success).double().mean())


class ClipLoss(NamedTuple):
    """The loss () over the clips, differentiable, and the share of the clips that failed."""

    loss: Tensor
    failures: float


def clip_loss(
    poses: ClipPoses,
    T_cw_groundtruth: Tensor,
    error: Callable[[Tensor, Tensor, Tensor], Tensor] = ate,
    on_failure: Literal["raise", "skip"] | float = "raise",
) -> ClipLoss:
    """The mean over the clips of an error, and what became of the clips that have none.

    T_cw_groundtruth: as `poses.T_cw`
    error:      function of poses, true poses and mask, each with the dimensions of `poses`, to () or (B,)
    on_failure: "raise" raises ClipError with the reasons; "skip" leaves failed clips out, and raises ClipError if none
                is left; with a number each of them costs that much, without gradient. A failed clip never counts as one
                without error: a front end could learn to fail.
    """
    if isinstance(on_failure, str) and on_failure not in ("raise", "skip"):
        raise ValueError(f"on_failure must be 'raise', 'skip' or a number, not {on_failure!r}")
    reasons = [f"clip {index}: {reason}" for index, reason in enumerate(poses.reason) if reason]
    if reasons and (on_failure == "raise" or (on_failure == "skip" and len(reasons) == len(poses.reason))):
        raise ClipError(f"{len(reasons)} of {len(poses.reason)} clips failed; {'; '.join(reasons)}")
    price = 0.0 if isinstance(on_failure, str) else float(on_failure)
    errors = torch.where(poses.success, error(poses.T_cw, T_cw_groundtruth, poses.posed), price)
    counted = torch.ones_like(poses.success) if not isinstance(on_failure, str) else poses.success
    return ClipLoss(errors.sum() / counted.sum(), poses.failures)


class ClipSLAM(nn.Module):
    """Poses of clips, differentiable with respect to images, camera and the parameters of the front end:

        clip_slam = ClipSLAM(XFeat("xfeat.safetensors"))
        optimizer = torch.optim.Adam(clip_slam.parameters(), 1e-4)
        for images, T_cw_groundtruth in clips:
            optimizer.zero_grad()
            poses = clip_slam(images, camera)
            clip_loss(poses, T_cw_groundtruth, on_failure=1.0).loss.backward()
            optimizer.step()

    extractor: module from images (B, 1, H, W) to Features with differentiable keypoints, such as
               ORB(differentiable=True), XFeat or ALIKED. Networks come in evaluation mode; `train` would have their
               normalisation follow the clip.
    weigh:     module or function from Features to (B, N), what each keypoint counts (its score, for instance), not
               negative: a factor of the inverse variance that its scale suggests. All count alike if None.
    config:    of the system; its section on features is not read
    """

    def __init__(
        self,
        extractor: nn.Module,
        weigh: Callable[[Features], Tensor] | None = None,
        config: Config | None = None,
    ) -> None:
        super().__init__()
        self.extractor = extractor
        self.weigh = weigh
        self.config = config or Config()

    def forward(self, images: Tensor, camera: Camera) -> ClipPoses:
        """Run the system on a clip (T, 1, H, W) or on each of several clips (B, T, 1, H, W), floats in [0, 1].

        The front end works where the images are, everything behind it where the camera is. World and unit are
        arbitrary, and without gradient: take a loss that does not depend on them, as `clip_loss`. A clip in which no
        map starts has no posed frame and a gradient of zero; `success` and `reason` tell. Raises ValueError for another
        shape, FrameError for images that have not the size that the camera has.
        """
        if images.ndim == 5:
            clips = [self._clip(clip, camera) for clip in images]
            return ClipPoses(
                torch.stack([clip.T_cw for clip in clips]),
                torch.stack([clip.posed for clip in clips]),
                torch.stack([clip.success for clip in clips]),
                tuple(reason for clip in clips for reason in clip.reason),
                tuple(graph for clip in clips for graph in clip.graphs),
                tuple(solution for clip in clips for solution in clip.solutions),
            )
        if images.ndim != 4:
            raise ValueError(f"images must be (T, 1, H, W) or (B, T, 1, H, W), not {tuple(images.shape)}")
        return self._clip(images, camera)

    def _clip(self, images: Tensor, camera: Camera) -> ClipPoses:
        """The poses of one clip (T, 1, H, W)."""
        camera = camera.to(torch.float64)
        features = self.extractor(images).to(camera.params.device)
        worth = torch.ones_like(features.scores) if self.weigh is None else self.weigh(features)
        # Zero times all that poses depend on: where there is no pose, there is a gradient all the same.
        nothing = 0 * (features.keypoints.sum() + worth.sum() + camera.params.sum())
        T_cw = torch.eye(4, dtype=torch.float64, device=nothing.device) + nothing.expand(len(images), 1, 1)
        posed = torch.zeros(len(images), dtype=torch.bool, device=nothing.device)
        seen = self._look(images, features, camera)
        if seen is None:
            return ClipPoses(T_cw, posed, posed.any(), ("no map started",), (None,), (None,))
        keypoints = (seen.frame_ids[seen.frame_index], seen.keypoint_index)
        pixels, weights = features.keypoints[keypoints].double(), seen.weights * worth[keypoints]
        graph = replace(seen, pixels=pixels, weights=weights, camera=camera)
        solution = solve(graph)
        T_cw = T_cw.index_copy(0, graph.frame_ids, solution.T_cw)
        posed = posed.index_copy(0, graph.frame_ids, solution.success)
        success = posed.sum() >= MIN_POSES
        reason = "" if success else _reason(solution, posed)
        return ClipPoses(T_cw, posed, success, (reason,), (graph,), (solution,))

    @torch.no_grad()
    def _look(self, images: Tensor, features: Features, camera: Camera) -> RunGraph | None:
        """What the system makes of the features of a clip, without gradient; None where no map starts."""
        slam = SLAM(camera, self.config, lambda frame: features[frame.index : frame.index + 1])
        frames = [Frame(index, float(index), image[None]) for index, image in enumerate(images)]
        run = finish(slam, [slam.step(frame) for frame in frames], skipped=[], interrupted=False)
        return None if run.main is None else run.main.history.graph(run.map, run.camera)


def _reason(solution: GraphSolution, posed: Tensor) -> str:
    """Why a clip with a map failed."""
    if not any(bundle.success for bundle in solution.keyframes):
        return "its keyframes and points are not determined"
    return f"{int(posed.sum())} of {len(posed)} frames have a pose, {MIN_POSES} are needed"
