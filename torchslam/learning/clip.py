"""SLAM of short clips as a module to train: images in, poses out, gradients back into whatever found the keypoints.

The system decides what is discrete (which keypoints match, which frames are keyframes) without gradient. What it
leaves behind is a least-squares problem whose pixels are read anew from the features, with their gradients; the poses
are its minimiser, differentiated by the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from torchslam.config import Config
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
    graphs:    one per clip: what the system saw, with differentiable pixels and weights; None where no map started
    solutions: one per clip: the minimiser of the graph, with points and covariances; None where no map started
    """

    T_cw: Tensor
    posed: Tensor
    graphs: tuple[RunGraph | None, ...]
    solutions: tuple[GraphSolution | None, ...]


class ClipSLAM(nn.Module):
    """Poses of clips, differentiable with respect to images, camera and the parameters of the front end:

        clip_slam = ClipSLAM(XFeat("xfeat.safetensors"))
        optimizer = torch.optim.Adam(clip_slam.parameters(), 1e-4)
        for images, T_cw_groundtruth in clips:
            optimizer.zero_grad()
            poses = clip_slam(images, camera)
            ate(poses.T_cw, T_cw_groundtruth, poses.posed).backward()
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
        arbitrary, and without gradient: take a loss that does not depend on them, as `evaluation.ate` and `rpe`. A
        clip in which no map starts has no posed frame and a gradient of zero. Raises ValueError for another shape,
        FrameError for images that have not the size that the camera has.
        """
        if images.ndim == 5:
            clips = [self._clip(clip, camera) for clip in images]
            return ClipPoses(
                torch.stack([clip.T_cw for clip in clips]),
                torch.stack([clip.posed for clip in clips]),
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
            return ClipPoses(T_cw, posed, (None,), (None,))
        keypoints = (seen.frame_ids[seen.frame_index], seen.keypoint_index)
        pixels, weights = features.keypoints[keypoints].double(), seen.weights * worth[keypoints]
        graph = replace(seen, pixels=pixels, weights=weights, camera=camera)
        solution = solve(graph)
        T_cw = T_cw.index_copy(0, graph.frame_ids, solution.T_cw)
        posed = posed.index_copy(0, graph.frame_ids, solution.success)
        return ClipPoses(T_cw, posed, (graph,), (solution,))

    @torch.no_grad()
    def _look(self, images: Tensor, features: Features, camera: Camera) -> RunGraph | None:
        """What the system makes of the features of a clip, without gradient; None where no map starts."""
        slam = SLAM(camera, self.config, lambda frame: features[frame.index : frame.index + 1])
        frames = [Frame(index, float(index), image[None]) for index, image in enumerate(images)]
        run = finish(slam, [slam.step(frame) for frame in frames], skipped=[], interrupted=False)
        return None if run.main is None else run.main.history.graph(run.map, run.camera)
