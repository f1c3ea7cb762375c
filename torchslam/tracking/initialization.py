"""The first map: two views, their relative pose, triangulated points, and whether they are worth a start."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchslam.config import Config, InitializationConfig
from torchslam.geometry import (
    Camera,
    KeypointNoise,
    RelativePose,
    Triangulation,
    epipolar_offsets,
    estimate_relative_pose,
    fits,
    transform,
    triangulate,
)
from torchslam.optim import BundleProblem, bundle_adjust
from torchslam.tracking.matcher import Matcher, make_matcher, run_matcher
from torchslam.types import FrameFeatures, Reason, TwoViewMap

TRIANGULATION_GATE_SIGMA = (
    3.0  # times the noise: how far a triangulated point may miss its pixels before it is refined
)
MIN_STATIC_RATIO = 0.1  # of the matches, from which on it is asked whether they belong to the scene
MIN_MATCHED_RATIO = 0.35  # of the keypoints that match where the camera stands still, at least
MIN_EXPLAINED_RATIO = 0.5  # of them that the motion of the others must explain


class Initializer:
    """Tries every frame against a reference frame until two of them make a map worth having."""

    def __init__(self, camera: Camera, config: Config, matcher: Matcher | None = None) -> None:
        self.camera = camera
        self.matcher = make_matcher(config.matching, matcher)
        self.config = config
        self.views: list[FrameFeatures] = []  # the reference and what came after it
        # pixels (n, 2) that the last view showed not to move with the scene
        self.still = camera.params.new_zeros(0, 2)
        self.planar_views = 0  # in which a plane explained the matches with the reference

    @property
    def reference(self) -> FrameFeatures:
        return self.views[0]

    def step(self, view: FrameFeatures) -> tuple[TwoViewMap | None, str]:
        """A start, or None and the reason in words."""
        self.still = self.still[:0]
        if not self.views or len(self.views) >= self.config.initialization.max_reference_age:
            self._refer_to(view)
            return None, Reason.NEW_REFERENCE
        self.views.append(view)
        pairs = run_matcher(self.matcher, self.reference, view)
        first, second = pairs.first, pairs.second
        view = view.weighed(second, pairs.weights)
        least = self.config.initialization.min_matches
        if len(first) < least:
            self._refer_to(view)
            return None, f"too few matches with the reference frame: {len(first)}, {least} are needed"
        return self._relate(view, first, second)

    def _refer_to(self, view: FrameFeatures) -> None:
        """Begin anew with another reference frame: what an earlier one said of planes is no reason to believe one."""
        self.views = [view]
        self.planar_views = 0

    def _relate(self, view: FrameFeatures, first: Tensor, second: Tensor) -> tuple[TwoViewMap | None, str]:
        """The relative pose of the two views, unless the image stands still."""
        settings = self.config.initialization
        motion = torch.linalg.vector_norm(view.keypoints[second] - self.reference.keypoints[first], dim=-1)
        moved = float(motion.median())
        if moved >= settings.min_motion_px:
            scene = self._scene(view, first, second, motion)
            if scene is None:
                return None, "some of the image stays in place, and it is not clear what moves"
            return self._relate_moving(view, first[scene], second[scene], scene_only=False)
        if len(first) < MIN_MATCHED_RATIO * int(self.reference.mask.sum()):
            self.still = view.keypoints[second[motion < settings.max_static_px]]
            self._refer_to(view)
            return None, "what still matches stays in place, the rest has gone: took a new reference frame"
        # Either the camera stands still, or most of what matches does not belong to the scene: a logo, a subtitle.
        moving = motion >= settings.min_motion_px
        if int(moving.sum()) < settings.min_matches:
            return None, f"the camera stands still: the image moved by {moved:.1f} px"
        start, reason = self._relate_moving(view, first[moving], second[moving], scene_only=True)
        share = 1 - float(moving.double().mean())
        return start, reason and f"{share:.0%} of the image stands still, and of the rest: {reason}"

    def _relate_moving(
        self, view: FrameFeatures, first: Tensor, second: Tensor, scene_only: bool
    ) -> tuple[TwoViewMap | None, str]:
        """The relative pose from matches that moved.

        scene_only: they are a part of all matches, and may be a thing that moves before a camera that stands
        still; only depth tells a scene apart from that.
        """
        settings = self.config.initialization
        relative = self._relative_pose(view, first, second)
        model = relative.model[0]
        if scene_only and model != "essential":
            return None, f"something may move before a camera that stands still: a {model} explains it"
        if model == "rotation":
            return None, "the camera only turns: a rotation explains the matches"
        self.planar_views += model == "homography"
        if model == "homography" and self.planar_views < settings.min_planar_frames:
            # Motion from a scene that is nearly a plane is far off; with more parallax its depth mostly shows.
            return None, "the scene looks planar: a homography explains the matches"
        if not bool(relative.success[0]):
            return None, f"ambiguous motion: the {model} allows several"
        inliers = torch.nonzero(relative.inliers[0])[:, 0]
        least_share = settings.min_planar_ratio if model == "homography" else settings.min_good_ratio
        return self._judge(view, relative.T_21[0], first[inliers], second[inliers], least_share)

    def _scene(self, view: FrameFeatures, first: Tensor, second: Tensor, motion: Tensor) -> Tensor | None:
        """(n,) bool, which matches belong to the scene: without those that stay in place, unless the motion of the
        others explains them too, as it does far points and what the camera turns around: on their epipolar lines, and
        not behind the camera. None where nobody can tell.
        """
        everyone = torch.ones_like(motion, dtype=torch.bool)
        still = motion < self.config.initialization.max_static_px
        if (
            int(still.sum()) < MIN_STATIC_RATIO * len(motion)
            or int((~still).sum()) < self.config.initialization.min_matches
        ):
            return everyone
        others = self._relative_pose(view, first[~still], second[~still])
        if others.model[0] != "essential":
            return None if self._relative_pose(view, first, second).model[0] == "essential" else everyone
        pixels_1, pixels_2 = self.reference.keypoints[first[still]], view.keypoints[second[still]]
        across, along = epipolar_offsets(others.T_21[0], pixels_1, pixels_2, self.camera, self.camera)
        threshold = self.config.initialization.threshold_px
        explained = (across.abs() < threshold) & (along > -threshold)
        if float(explained.double().mean()) >= MIN_EXPLAINED_RATIO:
            return everyone
        self.still = view.keypoints[second[still]]
        return ~still

    def _relative_pose(self, view: FrameFeatures, first: Tensor, second: Tensor) -> RelativePose:
        """The motion from the reference frame to a view by matching keypoints (n,), (n,) of the two."""
        return estimate_relative_pose(
            self.reference.keypoints[first][None],
            view.keypoints[second][None],
            self.camera,
            self.camera,
            threshold=self.config.initialization.threshold_px,
            seed=self.config.seed,
            kernel="truncated",
            min_samples=64,
        )

    def _judge(
        self, view: FrameFeatures, T_cw: Tensor, first: Tensor, second: Tensor, least_share: float
    ) -> tuple[TwoViewMap | None, str]:
        """Triangulate, refine both together, and count the points that are worth something."""
        settings = self.config.initialization
        T_1w = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
        pixels_1, pixels_2 = self.reference.keypoints[first], view.keypoints[second]
        noise = view.noise[second]
        known = self.reference.noise[first]
        noise = (known.stated() if noise.information.shape[-1] else known).worse(noise)
        seen = triangulate(T_1w, T_cw, pixels_1, pixels_2, self.camera, self.camera)
        points_c = transform(torch.stack([T_1w, T_cw]), seen.points_w)
        errors = noise.squared_reprojection(points_c, torch.stack([pixels_1, pixels_2]), self.camera)
        good = is_good(seen, errors.amax(0), noise.tolerance, self.camera, settings)
        reason = why_not(good, seen, len(first), settings, least_share)
        if reason:
            return None, reason
        keep = torch.nonzero(good)[:, 0]
        poses, points_w, accurate = refine_pair(
            T_cw, seen.points_w[keep], pixels_1[keep], pixels_2[keep], noise[keep], self.camera
        )
        if int(accurate.sum()) < settings.min_points:
            return (
                None,
                f"too few points survive refinement: {int(accurate.sum())}, {settings.min_points} are needed",
            )
        keep = keep[accurate]
        return TwoViewMap(self.reference, view, poses, points_w[accurate], first[keep], second[keep]), ""


def is_good(
    seen: Triangulation, errors: Tensor, sigmas: Tensor, camera: Camera, settings: InitializationConfig
) -> Tensor:
    """(n,) which triangulated points count for a start.

    errors: (n,) the larger of the two squared errors, in units of the noise; sigmas: (n,) px

    With the criterion "uncertainty": the standard deviation of a depth z seen under the parallax a is about
    z sigma / (f a) for a keypoint known to sigma pixels, so a point counts when sigma / (f a) is small.
    With "parallax": when the angle is large enough.
    """
    is_close = fits(errors, TRIANGULATION_GATE_SIGMA**2)
    if settings.criterion == "parallax":
        return seen.mask & is_close & (seen.angles >= math.radians(settings.min_parallax_deg))
    relative_std = sigmas / (camera.focal * seen.angles.clamp(min=1e-9))
    return seen.mask & is_close & (relative_std < settings.max_depth_std)


def why_not(
    good: Tensor, seen: Triangulation, matches: int, settings: InitializationConfig, least_share: float
) -> str:
    """Why these points are no start; empty when they are."""
    count = int(good.sum())
    in_front = float(seen.mask.float().mean())
    if in_front < 0.8:
        return f"matches behind a camera: only {in_front:.0%} lie in front of both"
    if count < settings.min_points:
        return f"too little parallax: {count} points have enough, {settings.min_points} are needed"
    if settings.criterion == "parallax":
        mean, least = math.degrees(float(seen.angles[seen.mask].mean())), settings.min_mean_parallax_deg
        return (
            f"too little parallax: {mean:.1f} degrees in the mean, {least} are needed" if mean < least else ""
        )
    if count < least_share * matches:
        return f"depths too uncertain: {count} of {matches} known well, {least_share:.0%} are needed"
    return ""


def refine_pair(
    T_cw: Tensor, points_w: Tensor, pixels_1: Tensor, pixels_2: Tensor, noise: KeypointNoise, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Bundle adjustment of two views with the first one fixed.

    Returns the second pose (4, 4), with the length of the baseline as it was, the points (n, 3) and which of them
    (n,) agree with both views.
    """
    n = len(points_w)
    device = points_w.device
    T = torch.stack([torch.eye(4, dtype=T_cw.dtype, device=device), T_cw])
    frame_index = torch.arange(2, device=device).repeat_interleave(n)
    point_index = torch.arange(n, device=device).repeat(2)
    pixels = torch.cat([pixels_1, pixels_2])
    weights = torch.cat([noise.weights] * 2)
    fixed = torch.tensor([True, False], device=device)
    problem = BundleProblem(
        T, points_w, frame_index, point_index, pixels, camera, weights=weights, fixed_frames=fixed
    )
    solution = bundle_adjust(problem, kernel="huber", scale=2.0, iterations=10, backward="detached")
    factor = torch.linalg.vector_norm(T_cw[:3, 3]) / torch.linalg.vector_norm(solution.T_cw[1, :3, 3])
    refined = solution.T_cw[1].clone()
    refined[:3, 3] *= factor
    points_w = solution.points_w * factor
    points_c = transform(torch.stack([T[0], refined]), points_w)
    errors = noise.squared_reprojection(points_c, torch.stack([pixels_1, pixels_2]), camera)
    return refined, points_w, fits(errors).all(0)
