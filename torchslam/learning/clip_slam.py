"""SLAM of short clips as a trainable module: images in, poses out, gradients back into the feature extractor.

The system makes the discrete decisions (which keypoints match, which frames are keyframes) once, without gradient. The
result is a graph: a least-squares problem whose pixels are read from the features, with their gradients, in every step.
The poses are its minimizer, differentiated by the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn

from torchslam.config import CameraConfig, Config
from torchslam.errors import ClipError
from torchslam.evaluation import MIN_POSES, ate
from torchslam.features.contract import FixedKeypoints, check_features, check_gray
from torchslam.features.kornia_modules import KorniaFeatures, is_kornia_module
from torchslam.geometry import Camera, KeypointNoise, SensorModel
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.observation_graph import RunGraph
from torchslam.optim.run_graph import GraphSolution, solve_graphs
from torchslam.system.online_run import finish
from torchslam.system.slam import SLAM
from torchslam.types import Features, Frame

OnFailure = Literal["raise", "skip"] | float

CLIP_OPTIONS = GRAPH_OPTIONS.replace(kernel="huber", scale=2.45)
"""95 % of the norms of two standard normal numbers lie below the scale. Not the tails of a finished run: while they
learn, keypoints may be off by many times the noise of those that the graph was built with."""

# Clips whose keypoints moved by 0.5 px need 5 to 70, by 1.5 px mostly below 200; 30 are too few for a third of them.
_ITERATIONS = 300
# Relative cost decrease that the last step predicts: gradients are then right to 2e-6; with 1e-10 to 1e-4. Rounding of
# the cost of 4000 keypoints is 1e-14: with that, one in nine clips of 16 frames never converges.
_TOLERANCE = 1e-12
_MAX_MOTION_PX = 16.0
"""Keypoints that learn move by a pixel or two, with noise by ten; another one in the same row is a hundred away."""


@dataclass(frozen=True)
class ClipGraph:
    """The discrete decisions of the system for a clip of T frames, or for B clips, without gradient.

    Attributes:
        runs: One per clip: keyframes, points and the observing keypoints; None where no map was initialized.
        cameras: One per clip, float64.
        frames: T.
        batched: Whether this holds B clips (B may be 1).
        reasons: One per clip: why no map was initialized, or empty.
        keypoints: One per clip: the pixels of all rows of its features.
        masks: One per clip: which of the rows are keypoints.
    """

    runs: tuple[RunGraph | None, ...]
    cameras: tuple[Camera, ...]
    frames: int
    batched: bool
    reasons: tuple[str, ...]
    keypoints: tuple[Float[Tensor, "T N 2"], ...]
    masks: tuple[Bool[Tensor, "T N"], ...]

    @staticmethod
    def stack(graphs: Sequence[ClipGraph]) -> ClipGraph:
        """Combine graphs of one clip each.

        Raises:
            ValueError: The graphs have different numbers of frames, or several clips.
        """
        if len({graph.frames for graph in graphs}) != 1 or any(graph.batched for graph in graphs):
            raise ValueError("stack needs graphs of one clip each with the same number of frames")

        names = ("runs", "cameras", "reasons", "keypoints", "masks")
        columns: dict[str, Any] = {name: tuple(getattr(graph, name)[0] for graph in graphs) for name in names}
        return ClipGraph(frames=graphs[0].frames, batched=True, **columns)

    def halves(self) -> tuple[ClipGraph, ClipGraph]:
        """The same clips with every other point: two problems that share no observation, for `clip_halves`."""

        def half(first: int) -> ClipGraph:
            runs = (run and _with_observations(run, run.point_index % 2 == first) for run in self.runs)
            return replace(self, runs=tuple(runs))

        return half(0), half(1)


@dataclass(frozen=True)
class ClipPoses:
    """The poses of a clip of T frames, or of B clips.

    Attributes:
        T_cw: World to camera, float64, the identity where there is no pose. The world is the camera of the clip's
            first keyframe, its unit of length the median depth of the first map.
        posed: Frames with a pose; only those of the main submap where a clip has several.
        success: Whether a map was initialized, enough frames are posed, and the solve converged, without which the
            gradient would be wrong.
        reasons: One per clip: why it failed, or empty.
        graphs: One per clip, with differentiable pixels and weights; None where no map was initialized.
        solutions: One per clip: minimum of the graph, with points and covariances; None where no map was initialized.
    """

    T_cw: Float[Tensor, "*batch T 4 4"]
    posed: Bool[Tensor, "*batch T"]
    success: Bool[Tensor, "*batch"]
    reasons: tuple[str, ...]
    graphs: tuple[RunGraph | None, ...]
    solutions: tuple[GraphSolution | None, ...]

    @property
    def failure_rate(self) -> float:
        """The fraction of clips that failed."""
        return float((~self.success).double().mean())


class ClipLoss(NamedTuple):
    """The differentiable loss over the clips, and the fraction of clips that failed."""

    loss: Float[Tensor, ""]
    failure_rate: float


def clip_loss(
    poses: ClipPoses,
    *,
    T_cw_groundtruth: Float[Tensor, "*batch T 4 4"],
    error: Callable[..., Tensor] = ate,
    on_failure: OnFailure = "raise",
) -> ClipLoss:
    """Average an error against the true poses over the clips.

    Args:
        poses: Of a clip, or of B clips.
        T_cw_groundtruth: Their true poses.
        error: Maps `T_cw`, `T_cw_groundtruth` and `mask`, by these names and shaped like those of `poses`, to () or
            (B,).
        on_failure: See `clip_mean`.

    Raises:
        ClipError: As `clip_mean`.
    """
    return clip_mean(
        poses, error(T_cw=poses.T_cw, T_cw_groundtruth=T_cw_groundtruth, mask=poses.posed), on_failure
    )


def clip_mean(poses: ClipPoses, errors: Float[Tensor, "*batch"], on_failure: OnFailure = "raise") -> ClipLoss:
    """Average errors over the clips; a failed clip never counts as error zero, since an extractor could learn to fail.

    Args:
        poses: Of a clip, or of B clips.
        errors: One per clip.
        on_failure: "raise" raises an error if a clip failed. "skip" omits failed clips. A number is the cost of each
            failed clip, without gradient.

    Raises:
        ClipError: Clips failed, with the reasons; with "skip": all failed.
        ValueError: `on_failure` is something else.
    """
    if isinstance(on_failure, str) and on_failure not in ("raise", "skip"):
        raise ValueError(f"on_failure must be 'raise', 'skip' or a number, not {on_failure!r}")
    reasons = [f"clip {index}: {reason}" for index, reason in enumerate(poses.reasons) if reason]
    if reasons and (on_failure == "raise" or (on_failure == "skip" and len(reasons) == len(poses.reasons))):
        raise ClipError(f"{len(reasons)} of {len(poses.reasons)} clips failed; {'; '.join(reasons)}")
    cost = 0.0 if isinstance(on_failure, str) else float(on_failure)
    errors = torch.where(poses.success, errors, cost)
    counted = torch.ones_like(poses.success) if not isinstance(on_failure, str) else poses.success
    return ClipLoss(errors.sum() / counted.sum(), poses.failure_rate)


def clip_halves(
    even: ClipPoses,
    odd: ClipPoses,
    error: Callable[..., Tensor] = ate,
    on_failure: OnFailure = "raise",
) -> ClipLoss:
    """Average an error between poses from two halves of the points over the clips; needs no ground truth.

        graph = clip_slam.build_graph(images, camera)
        features = clip_slam.extract(images, graph)
        even, odd = (clip_slam.pose(half, features, camera) for half in graph.halves())
        loss, failure_rate = clip_halves(even, odd, on_failure=0.1)

    Errors of keypoints are different ones in the two halves, so the loss falls with what they do to the poses. What
    both halves have in common, such as a wrong camera, does not count.

    Args:
        even: Of a clip, or of B clips, from the first of `ClipGraph.halves`.
        odd: From the second.
        error: As for `clip_loss`; lengths are in the unit of the clips, the median depth of their first maps.
        on_failure: See `clip_mean`; a clip fails if one of its halves does.

    Raises:
        ClipError: As `clip_mean`.
    """
    posed = even.posed & odd.posed
    reasons = tuple(one or other for one, other in zip(even.reasons, odd.reasons, strict=True))
    both = replace(even, posed=posed, success=even.success & odd.success, reasons=reasons)
    return clip_mean(both, error(T_cw=even.T_cw, T_cw_groundtruth=odd.T_cw, mask=posed), on_failure)


class ClipSLAM(nn.Module):
    """Poses of clips, differentiable with respect to images, camera and the parameters of the feature extractor.

    Train a feature extractor:

        clip_slam = ClipSLAM(XFeat("xfeat.safetensors"))
        optimizer = torch.optim.Adam(clip_slam.parameters(), 1e-4)
        for images, T_cw_groundtruth in clips:
            optimizer.zero_grad()
            poses = clip_slam(images, camera)
            clip_loss(poses, T_cw_groundtruth, on_failure=1.0).loss.backward()
            optimizer.step()

    A call builds the graph and solves it for the poses. If training only moves or reweights keypoints, build the graph
    once and reuse it; a step then takes about 0.1 s plus the feature extractor:

        graph = clip_slam.build_graph(images, camera)
        ...
        poses = clip_slam(images, camera, graph)  # or clip_slam.pose(graph, clip_slam.extract(images, graph))

    Args:
        extractor: Module from images (T, 1, H, W) to Features with differentiable keypoints, such as
            ORB(differentiable=True), XFeat, ALIKED or one of kornia's. Networks come in evaluation mode; in `train`
            mode their normalization statistics would follow the clip.
        keypoint_weight: Module or function from Features to weights (T, N) >= 0 that multiply the information of each
            keypoint (for example its score); 1 if None.
        config: Of the system; its features section is not read. Scenes that look planar are accepted after half of the
            frames of a clip at the latest.
    """

    def __init__(
        self,
        extractor: nn.Module,
        keypoint_weight: Callable[[Features], Float[Tensor, "T N"]] | None = None,
        config: Config | None = None,
    ) -> None:
        """Create a module with the parameters of the feature extractor."""
        super().__init__()
        self.extractor = KorniaFeatures(extractor) if is_kornia_module(extractor) else extractor
        self.keypoint_weight = keypoint_weight
        self.config = config or Config()

    def forward(
        self, images: Float[Tensor, "*batch T 1 H W"], camera: Camera, graph: ClipGraph | None = None
    ) -> ClipPoses:
        """Estimate the poses of a clip, or of each of several clips.

        The feature extractor runs on the device of the images, the rest on that of the camera. World frame and unit are
        arbitrary and have no gradient: use a loss that does not depend on them, such as `clip_loss`. A failed clip has
        no posed frame and a gradient of zero; see `success` and `reasons`.

        Args:
            images: Gray, in [0, 1]: of one clip, or of B clips.
            camera: Of all clips, or with params (B, K) one for each.
            graph: Of these images, by `build_graph`; built anew if None.

        Raises:
            ValueError: Images of another shape.
            FrameError: Images of another size than the camera.
        """
        features = self.extract(images, graph)
        graph = self.build_graph(images, camera, features) if graph is None else graph
        return self.pose(graph, features, camera)

    def extract(
        self, images: Float[Tensor, "*batch T 1 H W"], graph: ClipGraph | None = None
    ) -> Features | list[Features]:
        """Extract the features of a clip, or of each of B clips.

        Args:
            images: As in `forward`.
            graph: Of these images: an extractor with `read` (`features.contract.FixedKeypoints`) describes the
                keypoints of the graph, in their rows, whatever it would detect now.

        Raises:
            ValueError: Images of another shape.
            FrameError: Images that are not floats in [0, 1].
        """
        if images.ndim not in (4, 5) or images.shape[-3] != 1:
            raise ValueError(f"images must be (T, 1, H, W) or (B, T, 1, H, W), not {tuple(images.shape)}")
        check_gray(images, "images of a clip")
        clips, extractor = images if images.ndim == 5 else images[None], self.extractor
        if graph is not None and isinstance(extractor, FixedKeypoints):
            places = zip(clips, graph.keypoints, graph.masks, strict=True)
            features = [
                extractor.read(clip, *(each.to(clip.device) for each in place)) for clip, *place in places
            ]
        else:
            features = [extractor(clip) for clip in clips]
        return features if images.ndim == 5 else features[0]

    @torch.no_grad()
    def build_graph(
        self,
        images: Float[Tensor, "*batch T 1 H W"],
        camera: Camera,
        features: Features | Sequence[Features] | None = None,
    ) -> ClipGraph:
        """Run the system on a clip or on several, without gradient: matches, keyframes, correspondences.

        Args:
            images: As in `forward`.
            camera: As in `forward`.
            features: Results of `extract`, if already computed.

        Raises:
            ConfigError: Invalid features of the feature extractor, see `features.contract`.
        """
        seen = _per_clip(self.extract(images) if features is None else features)
        clips, batched = (images, True) if images.ndim == 5 else (images[None], False)
        # A copy: parameters may move in place while they learn.
        camera = camera.with_params(camera.params.detach().to(torch.float64, copy=True))
        cameras = _cameras(camera, len(clips))
        found = (self._build_graph(*one) for one in zip(clips, seen, cameras, strict=True))
        runs, reasons = zip(*found, strict=True)
        keypoints, masks = (
            tuple(getattr(each, name).detach().clone() for each in seen) for name in ("keypoints", "mask")
        )
        return ClipGraph(runs, cameras, clips.shape[1], batched, reasons, keypoints, masks)

    def pose(
        self, graph: ClipGraph, features: Features | Sequence[Features], camera: Camera | None = None
    ) -> ClipPoses:
        """Solve a graph for the poses, differentiable with respect to features and camera.

        Args:
            graph: Of `build_graph`.
            features: Of the clip, or one per clip, by `extract(images, graph)`: the same keypoints in the same rows as
                when the graph was built, possibly moved. Rows with a False mask do not count.
            camera: As in `forward`; that of the graph, without gradient, if None.

        Raises:
            ValueError: The features have other shapes than the graph, or other keypoints in their rows, or the weights
                of keypoints are not (T, N).
        """
        seen = _per_clip(features)
        cameras = graph.cameras if camera is None else _cameras(camera, len(graph.runs))
        if len(seen) != len(graph.runs) or any(len(each.mask) != graph.frames for each in seen):
            shapes = [tuple(each.mask.shape) for each in seen]
            raise ValueError(
                f"features of shapes {shapes} for {len(graph.runs)} clips of {graph.frames} frames"
            )
        cameras = tuple(camera.to(torch.float64) for camera in cameras)
        seen = [each.to(camera.params.device) for each, camera in zip(seen, cameras, strict=True)]
        keypoint_weights = [self._keypoint_weights(each) for each in seen]
        graphs = tuple(
            None if run is None else _as_seen(run, each, weights, own)
            for run, each, weights, own in zip(graph.runs, seen, keypoint_weights, cameras, strict=True)
        )
        solvable = [each for each in graphs if each is not None]
        found = iter(
            solve_graphs(solvable, options=CLIP_OPTIONS.replace(iterations=_ITERATIONS, tolerance=_TOLERANCE))
        )
        solutions = tuple(None if each is None else next(found) for each in graphs)
        clips = [_posed(*one) for one in zip(graphs, solutions, seen, keypoint_weights, cameras, strict=True)]
        T_cw, posed = (torch.stack(each) for each in zip(*clips, strict=True))
        settled = [each is not None and bool((each.converged | ~each.success).all()) for each in solutions]
        success = (posed.sum(-1) >= MIN_POSES) & torch.tensor(settled, device=posed.device)
        reasons = (
            "" if good else _reason(*one)
            for good, *one in zip(success.tolist(), graph.reasons, solutions, posed, strict=True)
        )
        row = slice(None) if graph.batched else 0
        return ClipPoses(T_cw[row], posed[row], success[row], tuple(reasons), graphs, solutions)

    def _keypoint_weights(self, features: Features) -> Float[Tensor, "T N"]:
        """Weights of the information of keypoints. Raises ValueError where they are not floats (T, N)."""
        if self.keypoint_weight is None:
            return torch.ones_like(features.scores)
        weights = self.keypoint_weight(features)
        if weights.shape != features.mask.shape or not weights.is_floating_point():
            raise ValueError(
                f"keypoint_weight must give floats (T, N) = {tuple(features.mask.shape)}, not {weights.dtype} "
                f"{tuple(weights.shape)}"
            )
        return weights

    def _build_graph(self, images: Tensor, features: Features, camera: Camera) -> tuple[RunGraph | None, str]:
        """The graph of one clip, or None and the reason why no map was initialized."""
        check_features(features, images, type(self.extractor).__name__)
        features = features.to(camera.params.device)
        # Poses are differentiated by this camera. A clip is too short for the patience of a run.
        start = self.config.initialization
        start = replace(start, min_planar_frames=min(start.min_planar_frames, len(images) // 2))
        config = replace(self.config, camera=CameraConfig(std=0.0, readout_std=0.0), initialization=start)
        slam = SLAM(camera, config, self.extractor)
        frames = [
            Frame(index, float(index), image[None], features=features[index : index + 1])
            for index, image in enumerate(images)
        ]
        run = finish(slam, [slam.step(frame) for frame in frames], skipped=[], interrupted=False)
        if run.main is None:
            return None, run.failure
        # With the stated noise: training moves the keypoints away from those whose noise was estimated.
        graph = run.main.posed_frames.graph(run.map, SensorModel(run.camera))
        return graph, run.failure


def _per_clip(features: Features | Sequence[Features]) -> Sequence[Features]:
    return [features] if isinstance(features, Features) else features


def _cameras(camera: Camera, clips: int) -> tuple[Camera, ...]:
    """One camera per clip, of one for all or of one with params (B, K)."""
    if camera.params.ndim == 1:
        return (camera,) * clips
    if camera.params.shape[:-1] != (clips,):
        raise ValueError(
            f"params of the camera must be (K,) or ({clips}, K), not {tuple(camera.params.shape)}"
        )
    return tuple(camera[row] for row in range(clips))


def _as_seen(
    run: RunGraph, features: Features, keypoint_weights: Shaped[Tensor, "T N"], camera: Camera
) -> RunGraph:
    """The graph of a clip with the current pixels of its features, weighted by keypoint_weights."""
    run = _with_observations(run, features.mask[run.frame_ids[run.frame_index], run.keypoint_index])
    rows = (run.frame_ids[run.frame_index], run.keypoint_index)
    weights = run.weights
    if features.information is not None:
        weights = KeypointNoise.of(features.scales[rows], features.information[rows]).weights.double()
    factors = keypoint_weights[rows]
    weights = weights * factors.view(*factors.shape, *(1,) * (weights.ndim - factors.ndim))
    pixels = features.keypoints[rows].double()
    moved = torch.linalg.vector_norm(pixels.detach() - run.pixels, dim=-1)
    jumped = int((moved > _MAX_MOTION_PX).sum())
    if jumped:
        raise ValueError(
            f"{jumped} of {len(moved)} keypoints are up to {float(moved.max()):.0f} px from where the graph has them: "
            "their rows hold other keypoints now. Use features of `extract(images, graph)`, of an extractor with "
            "`read`, or build the graph again"
        )
    return replace(run, pixels=pixels, weights=weights, camera=camera)


def _posed(
    graph: RunGraph | None,
    solution: GraphSolution | None,
    features: Features,
    keypoint_weights: Shaped[Tensor, "T N"],
    camera: Camera,
) -> tuple[Float[Tensor, "T 4 4"], Bool[Tensor, " T"]]:
    """The poses of a clip, and which frames have one."""
    # Zero times everything that poses depend on, so that the gradient exists without any pose.
    nothing = features.keypoints.sum() + keypoint_weights.sum() + camera.params.sum()
    nothing = 0 * (nothing if features.information is None else nothing + features.information.sum())
    frames, device = len(features.mask), nothing.device
    T_cw = torch.eye(4, dtype=torch.float64, device=device) + nothing.expand(frames, 1, 1)
    posed = torch.zeros(frames, dtype=torch.bool, device=device)
    if graph is None or solution is None:
        return T_cw, posed
    T_cw = T_cw.index_copy(0, graph.frame_ids, solution.T_cw)
    return T_cw, posed.index_copy(0, graph.frame_ids, solution.success)


def _with_observations(graph: RunGraph, kept: Bool[Tensor, " O"]) -> RunGraph:
    """The graph with some of its observations."""
    columns = ("frame_index", "point_index", "pixels", "weights", "keypoint_index")
    return replace(graph, **{name: getattr(graph, name)[kept] for name in columns})


def _reason(no_map: str, solution: GraphSolution | None, posed: Tensor) -> str:
    """Why a clip failed."""
    if solution is None:
        return no_map
    if not any(bundle.success for bundle in solution.keyframes):
        return "its keyframes and points are not determined"
    if int(posed.sum()) < MIN_POSES:
        return f"{int(posed.sum())} of {len(posed)} frames have a pose, {MIN_POSES} are needed"
    return f"its poses did not converge in {_ITERATIONS} iterations: their gradient would be wrong"
