"""Two-view initialization of a map, and whether two frames contradict one.

Initialization is relative pose, triangulation, refinement, and the checks of the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import (
    Camera,
    KeypointNoise,
    RelativePose,
    SharedCamera,
    Triangulation,
    epipolar_offsets,
    estimate_relative_pose,
    passes_gate,
    se3_inverse,
    transform,
    triangulate,
)
from torchslam.geometry.robust import NORMAL_MEDIAN, Kernel
from torchslam.map.atlas import Submap
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, solve_bundle
from torchslam.tracking.matcher import make_matcher, run_matcher
from torchslam.tracking.turning_camera import THRESHOLD_PX, TurningCamera
from torchslam.types import FrameFeatures, Matcher, Reason, Rejection, TwoViewMap

MIN_MOTION_PX = 2.0
"""Median motion of the matches below which the camera stands still, pixels of reduced images. Tried at this value
only."""
MAX_STATIC_PX = 1.0
"""Largest motion of a match that stays in place, pixels of reduced images. Tried at this value only."""
MIN_POINTS_RATIO = 0.6
"""Points of the initial map, relative to `initialization.min_matches`: 60 for 100. Tried at this value only."""
MAX_DEPTH_STD = 0.1
"""Relative standard deviation of the depth up to which a point is good. Tried at this value only."""
MIN_GOOD_RATIO = 0.15
"""Ratio of good points to matches. Tried at 0.15 and 0.4."""
MIN_PLANAR_RATIO = 0.5
"""The same in a planar scene. Tried at this value only."""
MAX_REFERENCE_AGE = 300
"""Frames after which the reference frame is replaced. Tried at 60 and 300."""
PAPER_POINTS, PAPER_PARALLAX_DEG, PAPER_MEAN_PARALLAX_DEG = 40, 3.0, 5.0
"""With `paper.parallax`: good points of the initial map, the parallax of a good point, and the mean of all, degrees, as
in the paper's system."""
TRIANGULATION_GATE_SIGMA = 3.0
"""Largest error of a triangulated point before refinement, in units of the noise."""
MIN_IN_FRONT_RATIO = 0.8
"""Minimum ratio of the matches that are triangulated in front of both cameras."""
MIN_STATIC_RATIO = 0.1
"""Ratio of the matches that stay in place below which they count as part of the scene."""
MIN_MATCHED_RATIO = 0.35
"""Minimum ratio of the keypoints that match if the camera stands still."""
MIN_EXPLAINED_RATIO = 0.5
"""Ratio of the matches in place that the motion of the others must explain if they belong to the scene."""
MAX_LEFT_RATIO = 0.5
"""Ratio of the most matches of a reference below which the camera turns away from it: more parallax may not follow.
Tried from 0.33 to 0.5: rendered walks start the earlier the larger it is."""
LEAVING_INTERVAL = 3
"""Views of which one is tried while the camera turns away, since a try takes as long as a view. Tried at 1 and 3."""
LEAST_NOISE = 0.5
"""Smallest noise of a keypoint that two views may show, in units of what is assumed: what is smaller is less than the
errors of a camera model. Tried at this value, and without."""
NOISE_SIGMAS = 2.0
"""Threshold of a match that contradicts a rotation, in units of the noise. Tried at this value only."""

MIN_SUPPORT_RATIO = 0.5
"""Minimum support of the map's motion, relative to that of the motion that two frames alone give.

On 46 cuts of real sequences it is 0.83 or more for correct maps; for deliberately wrong ones, mostly below 0.4.
"""


@dataclass(frozen=True)
class ViewMatches:
    """Matches of the reference with a view: rows of keypoints of both, and where these are."""

    view: FrameFeatures
    first: Int[Tensor, " M"]
    second: Int[Tensor, " M"]
    pixels: tuple[Float[Tensor, "M 2"], Float[Tensor, "M 2"]]

    def of(self, rows: Bool[Tensor, " M"]) -> ViewMatches:
        """Some of the matches."""
        pixels_1, pixels_2 = self.pixels
        return ViewMatches(self.view, self.first[rows], self.second[rows], (pixels_1[rows], pixels_2[rows]))


class Initializer:
    """Matches every frame with a reference frame until two of them give a map."""

    def __init__(self, camera: SharedCamera, config: Config, matcher: Matcher | None = None) -> None:
        self.camera = camera
        self.matcher = make_matcher(config.matching, matcher, features=config.features.kind)
        self.config = config
        reduction = config.features.reduction(camera.current.size)
        self.threshold_px = THRESHOLD_PX * reduction
        self.min_motion_px, self.max_static_px = MIN_MOTION_PX * reduction, MAX_STATIC_PX * reduction
        self._reference: FrameFeatures | None = None
        self.turning = TurningCamera(camera, config, self.matcher)
        self._most_matches = 0  # of the reference with a view
        self.num_views = 0  # the reference and the frames after it
        # keypoints of the last view that do not belong to the scene
        self.static_pixels: Float[Tensor, "N 2"] = camera.current.params.new_zeros(0, 2)
        self.num_planar_views = 0  # whose matches with the reference a homography explained
        self.planar_reason: Rejection | None = None  # of the last such view that was tested for a rotation

    @property
    def reference(self) -> FrameFeatures:
        """The reference frame, once there is one."""
        assert self._reference is not None
        return self._reference

    def step(self, view: FrameFeatures) -> TwoViewMap | Rejection:
        """Try to initialize a map with the next frame."""
        self.static_pixels = self.static_pixels[:0]
        if self._reference is None or self.num_views >= MAX_REFERENCE_AGE:
            self._refer_to(view)
            return Rejection(Reason.NEW_REFERENCE)
        self.num_views += 1
        self.turning.add(view)
        pairs = run_matcher(self.matcher, self.reference, view)
        first, second = pairs.first, pairs.second
        self._most_matches = max(self._most_matches, len(first))
        view = view.weighed(second, pairs.weights)
        least = self.config.initialization.min_matches
        if len(first) < least:
            self._refer_to(view)
            keypoints = int(view.mask.sum())
            if keypoints < least:
                return Rejection.of(Reason.FEW_KEYPOINTS, count=keypoints, needed=least)
            return Rejection.of(Reason.FEW_MATCHES, count=len(first), needed=least)
        pixels = self.reference.keypoints[first], view.keypoints[second]
        return self._relate(ViewMatches(view, first, second, pixels))

    def _refer_to(self, view: FrameFeatures) -> None:
        """Start again with another reference frame."""
        self._reference, self.num_views = view, 1
        self.turning.refer_to(view)
        self._most_matches = 0
        self.num_planar_views = 0
        self.planar_reason = None

    def _relate(self, matches: ViewMatches) -> TwoViewMap | Rejection:
        """Initialize from matches with the reference, unless the camera stands still."""
        view = matches.view
        motion = torch.linalg.vector_norm(matches.pixels[1] - matches.pixels[0], dim=-1)
        moved = float(motion.median())
        if moved >= self.min_motion_px:
            scene = self._scene(matches, motion)
            if scene is None:
                return Rejection(Reason.STATIC_AMBIGUOUS)
            return self._relate_moving(matches.of(scene), scene_only=False)
        if len(motion) < MIN_MATCHED_RATIO * int(self.reference.mask.sum()):
            self.static_pixels = matches.pixels[1][motion < self.max_static_px]
            self._refer_to(view)
            return Rejection(Reason.STATIC_REMAINDER)
        # Either the camera stands still, or most of what matches does not belong to the scene: a logo, a subtitle.
        moving = motion >= self.min_motion_px
        if int(moving.sum()) < self.config.initialization.min_matches:
            return Rejection.of(Reason.STATIONARY, pixels=moved)
        result = self._relate_moving(matches.of(moving), scene_only=True)
        if isinstance(result, TwoViewMap):
            return result
        ratio = 1 - float(moving.double().mean())
        return Rejection.of(Reason.STATIONARY_IN_PART, ratio=ratio, rejection=result)

    def _relate_moving(self, matches: ViewMatches, scene_only: bool) -> TwoViewMap | Rejection:
        """Initialize from matches that moved.

        With `scene_only` the other matches stayed in place, so that these may be an object that moves in front of a
        standing camera: only an essential matrix, which needs depth, is accepted.
        """
        relative = self._relative_pose(matches)
        result = self._relate_by_threshold(matches, relative, scene_only)
        is_leaving = len(matches.first) < MAX_LEFT_RATIO * self._most_matches
        if isinstance(result, Rejection) and is_leaving and self.num_views % LEAVING_INTERVAL == 0:
            return self._relate_by_noise(matches, relative) or result
        return result

    def _relate_by_threshold(
        self, matches: ViewMatches, relative: RelativePose, scene_only: bool
    ) -> TwoViewMap | Rejection:
        """`_relate_moving` with the model that the threshold alone determines."""
        model = relative.model[0]
        if scene_only and model != "essential":
            return Rejection.of(Reason.MOVING_OBJECT, model=model)
        if model == "rotation":
            return Rejection(Reason.PURE_ROTATION)
        self.num_planar_views += model == "homography"
        if model == "homography" and self.num_planar_views < self.config.initialization.min_planar_frames:
            # Motion from a scene that is nearly a plane is far off; with more parallax its depth mostly shows.
            if self.num_planar_views.bit_count() == 1:  # the 1st, 2nd, 4th, ...: a test takes long
                self.planar_reason = self._turns_only(matches, relative)
            return self.planar_reason or Rejection(Reason.PLANAR_SCENE)
        if not bool(relative.success[0]):
            return Rejection.of(Reason.AMBIGUOUS_MOTION, model=model)
        min_good_ratio = MIN_PLANAR_RATIO if model == "homography" else MIN_GOOD_RATIO
        found = self._triangulate(matches.of(relative.inliers[0]), relative.T_21[0], min_good_ratio)
        if isinstance(found, Rejection):
            return found
        return self._turns_only(matches, relative) or found

    def _relate_by_noise(self, matches: ViewMatches, rough: RelativePose) -> TwoViewMap | None:
        """Initialize with a view that the camera turns away from, if the matches show more than a turn.

        What parallax there is has to exceed the noise that the matches show, instead of the threshold. Keypoints are
        those of the middle rows where the shutter rolls. `rough` is the relative pose by the threshold.
        """
        near = self._offsets(rough.T_21_essential[0], matches) < 2 * self.threshold_px
        turned, turns = self.turning.fit(*matches.pixels, near)
        matches = replace(matches, pixels=self.turning.at_middle_rows(matches.pixels, turns))
        relative = self._relative_pose(matches, kernel="cauchy")
        if relative.model[0] != "essential" or not bool(relative.success[0]):
            return None
        inliers = relative.inliers[0]
        # The noise of both views is in the distance from an epipolar line.
        across = self._offsets(relative.T_21[0], matches.of(inliers)).median()
        noise = min(max(float(across) / (math.sqrt(2) * NORMAL_MEDIAN), LEAST_NOISE), 1.0)
        if bool(turned.explains(inliers[None], NOISE_SIGMAS * noise)[0]):
            return None
        found = self._triangulate(matches.of(inliers), relative.T_21[0], MIN_GOOD_RATIO, noise)
        return found if isinstance(found, TwoViewMap) else None

    def _offsets(self, T_21: Float[Tensor, "4 4"], matches: ViewMatches) -> Float[Tensor, " M"]:
        """Distances of keypoints of the view from the epipolar lines of those of the reference, pixels."""
        return epipolar_offsets(T_21, *matches.pixels, self.camera.current, self.camera.current)[0].abs()

    def _turns_only(self, matches: ViewMatches, relative: RelativePose) -> Rejection | None:
        """A rejection if a rotation with another focal length explains the inliers of a relative pose as well.

        The focal length may be as wrong as the configuration says of the camera, not at all for an exact one.
        """
        inliers = relative.inliers[0]
        if self.turning.std == 0 or not bool(inliers.any()):
            return None
        turned, _ = self.turning.fit(*matches.pixels, inliers)
        if not bool(turned.explains(inliers[None], self.threshold_px)[0]):
            return None
        return Rejection.of(Reason.PURE_ROTATION_OTHER_FOCAL, focal=float(turned.camera.focal))

    def _scene(self, matches: ViewMatches, motion: Float[Tensor, " M"]) -> Bool[Tensor, " M"] | None:
        """Which matches belong to the scene; None if it cannot be decided.

        Matches that stay in place do not, unless the motion of the others explains them, as it does far points and
        what the camera turns around: they are on their epipolar lines and not behind the camera.
        """
        everything = torch.ones_like(motion, dtype=torch.bool)
        still = motion < self.max_static_px
        count = int(still.sum())
        least = self.config.initialization.min_matches
        if count < MIN_STATIC_RATIO * len(motion) or len(motion) - count < least:
            return everything
        others = self._relative_pose(matches.of(~still))
        if others.model[0] != "essential":
            return None if self._relative_pose(matches).model[0] == "essential" else everything
        static, camera = matches.of(still), self.camera.current
        across, along = epipolar_offsets(others.T_21_essential[0], *static.pixels, camera, camera)
        explained = (across.abs() < self.threshold_px) & (along > -self.threshold_px)
        if float(explained.double().mean()) >= MIN_EXPLAINED_RATIO:
            return everything
        self.static_pixels = static.pixels[1]
        return ~still

    def _relative_pose(self, matches: ViewMatches, kernel: Kernel = "truncated") -> RelativePose:
        """The relative pose of the view from matches with the reference."""
        pixels_1, pixels_2 = (pixels[None] for pixels in matches.pixels)
        return estimate_relative_pose(
            pixels_1,
            pixels_2,
            camera_1=self.camera.current,
            camera_2=self.camera.current,
            threshold=self.threshold_px,
            seed=self.config.seed,
            kernel=kernel,
            min_samples=64,
        )

    def _triangulate(
        self, matches: ViewMatches, T_cw: Tensor, min_good_ratio: float, noise_level: float = 1.0
    ) -> TwoViewMap | Rejection:
        """Triangulate, refine pose and points together, and check that enough points are accurate.

        The depth of a ratio of the matches must be known; `noise_level`: of the keypoints, in units of what is assumed.
        """
        T_1w = torch.eye(4, dtype=T_cw.dtype, device=T_cw.device)
        view, first, second, camera = matches.view, matches.first, matches.second, self.camera.current
        pixels_1, pixels_2 = matches.pixels
        noise, known = view.noise[second], self.reference.noise[first]
        known = known.with_explicit_information() if noise.information.shape[-1] else known
        noise = known.pairwise_max(noise)
        seen = triangulate(pixels_1, pixels_2, T_1w=T_1w, T_2w=T_cw, camera_1=camera, camera_2=camera)
        points_c = transform(torch.stack([T_1w, T_cw]), seen.points_w)
        errors = noise.squared_reprojection(points_c, torch.stack([pixels_1, pixels_2]), camera)
        good = is_good(seen, errors.amax(0), noise_level * noise.gate_sigma, camera, self.config)
        rejection = check_two_view_map(good, seen, len(first), self.config, min_good_ratio)
        if rejection:
            return rejection
        keep = torch.nonzero(good)[:, 0]
        pixels_1, pixels_2 = pixels_1[keep], pixels_2[keep]
        poses, points_w, accurate = refine_pair(
            T_cw, seen.points_w[keep], pixels_1, pixels_2, noise[keep], camera
        )
        if (count := int(accurate.sum())) < (least := min_points(self.config)):
            return Rejection.of(Reason.FEW_REFINED_POINTS, count=count, needed=least)
        keep = keep[accurate]
        return TwoViewMap(self.reference, view, poses, points_w[accurate], first[keep], second[keep])


def min_points(config: Config) -> int:
    """The number of points that an initial map needs."""
    if config.paper.parallax:
        return PAPER_POINTS
    return round(MIN_POINTS_RATIO * config.initialization.min_matches)


def is_good(
    seen: Triangulation,
    errors: Float[Tensor, " M"],
    sigmas: Float[Tensor, " M"],
    camera: Camera,
    config: Config,
) -> Bool[Tensor, " M"]:
    """Triangulated points that are known well enough for a map.

    The standard deviation of a depth z seen under the parallax a is about z sigma / (f a) for a keypoint known to sigma
    pixels, so a point counts when sigma / (f a) is small. With `paper.parallax`: when the angle is large enough.
    `errors` are the larger of the two squared errors, in units of the noise.
    """
    is_close = passes_gate(errors, TRIANGULATION_GATE_SIGMA**2)
    if config.paper.parallax:
        return seen.mask & is_close & (seen.angles >= math.radians(PAPER_PARALLAX_DEG))
    relative_std = sigmas / (camera.focal * seen.angles.clamp(min=1e-9))
    return seen.mask & is_close & (relative_std < MAX_DEPTH_STD)


def check_two_view_map(
    good: Bool[Tensor, " M"], seen: Triangulation, matches: int, config: Config, min_good_ratio: float
) -> Rejection | None:
    """Why triangulated points are not enough for a map; None if they are."""
    count = int(good.sum())
    in_front = float(seen.mask.float().mean())
    if in_front < MIN_IN_FRONT_RATIO:
        return Rejection.of(Reason.BEHIND_CAMERA, ratio=in_front)
    if count < min_points(config):
        return Rejection.of(Reason.FEW_PARALLAX_POINTS, count=count, needed=min_points(config))
    if config.paper.parallax:
        mean, least = math.degrees(float(seen.angles[seen.mask].mean())), PAPER_MEAN_PARALLAX_DEG
        return Rejection.of(Reason.LOW_MEAN_PARALLAX, mean=mean, needed=least) if mean < least else None
    if count < min_good_ratio * matches:
        return Rejection.of(Reason.UNCERTAIN_DEPTHS, count=count, matches=matches, ratio=min_good_ratio)
    return None


def refine_pair(
    T_cw: Float[Tensor, "4 4"],
    points_w: Float[Tensor, "M 3"],
    pixels_1: Float[Tensor, "M 2"],
    pixels_2: Float[Tensor, "M 2"],
    noise: KeypointNoise,
    camera: Camera,
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "M 3"], Bool[Tensor, " M"]]:
    """Bundle adjustment of two views with the first one fixed.

    Returns:
        The second pose with the length of the baseline unchanged, the points, and which of them are inliers of both
        views.
    """
    n, device = len(points_w), points_w.device
    T = torch.stack([torch.eye(4, dtype=T_cw.dtype, device=device), T_cw])
    problem = BundleProblem(
        T,
        points_w,
        torch.arange(2, device=device).repeat_interleave(n),
        torch.arange(n, device=device).repeat(2),
        torch.cat([pixels_1, pixels_2]),
        camera,
        weights=torch.cat([noise.weights] * 2),
        fixed_frames=torch.tensor([True, False], device=device),
    )
    options = BUNDLE_OPTIONS.replace(kernel="huber", scale=2.0, iterations=10, backward="detached")
    solution = solve_bundle(problem, options=options)
    factor = torch.linalg.vector_norm(T_cw[:3, 3]) / torch.linalg.vector_norm(solution.T_cw[1, :3, 3])
    refined = solution.T_cw[1].clone()
    refined[:3, 3] *= factor
    points_w = solution.points_w * factor
    points_c = transform(torch.stack([T[0], refined]), points_w)
    errors = noise.squared_reprojection(points_c, torch.stack([pixels_1, pixels_2]), camera)
    return refined, points_w, passes_gate(errors).all(0)


def contradicting_initialization(
    submap: Submap,
    first: FrameFeatures,
    last: FrameFeatures,
    camera: Camera,
    config: Config,
    matcher: Matcher | None = None,
) -> TwoViewMap | None:
    """Initialize from the first and last frame posed in a submap alone; return the result if it contradicts the map.

    The map's own observations agree with it by construction, so the two frames are matched again. The result
    contradicts the map if the motion in the map explains its matches much worse.
    """
    threshold_px = THRESHOLD_PX * config.features.reduction(camera.size)
    T_1w, T_2w = submap.posed_frames.T_cw(submap.map)[0], submap.T_cw
    T_21 = T_2w @ se3_inverse(T_1w)
    pairs = run_matcher(make_matcher(config.matching, matcher, features=config.features.kind), first, last)
    pixels = first.keypoints[pairs.first], last.keypoints[pairs.second]
    if support(*pixels, T_21, camera, threshold_px) >= MIN_SUPPORT_RATIO * len(pairs.first):
        return None  # no motion can have twice the support
    initializer = Initializer(SharedCamera(camera), config, matcher)
    initializer.step(first)
    start = initializer.step(last)
    if not isinstance(start, TwoViewMap):
        return None
    pixels = first.keypoints[start.keypoints_1], last.keypoints[start.keypoints_2]
    own, by_map = (support(*pixels, T, camera, threshold_px) for T in (start.T_cw, T_21))
    return start if by_map < MIN_SUPPORT_RATIO * own else None


def support(
    pixels_1: Float[Tensor, "M 2"],
    pixels_2: Float[Tensor, "M 2"],
    T_21: Float[Tensor, "4 4"],
    camera: Camera,
    threshold_px: float,
) -> float:
    """Support of a motion T_21 by matches: sum of 1 - (error / threshold)^2 where positive."""
    across, _ = epipolar_offsets(T_21, pixels_1, pixels_2, camera, camera)
    return float((1 - (across / threshold_px) ** 2).clamp_min(0.0).sum())
