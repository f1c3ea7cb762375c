"""Values passed between the stages of the pipeline: small frozen dataclasses of tensors.

Letters in shapes: B batch, N keypoints, M matches, L points; H, W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum, StrEnum
from typing import Any

import torch
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.gating import KeypointNoise, packed_information, unpacked_information


@dataclass(frozen=True)
class Frame:
    """One image of a sequence.

    index:     position in the sequence, from 0
    timestamp: seconds
    image:     (1, 1, H, W) float32 in [0, 1], gray
    name:      of the image in messages (its path, or `video.mp4#17`)
    T_cw_groundtruth: (4, 4) float64 world to camera, if the sequence has it. Read only by simulated features,
               by scale from ground truth and by evaluation.
    mask:      (1, 1, H, W) bool, True where features may be found; None: everywhere
    features:  a batch of one, if they were extracted already; then the image is not needed, and H and W may be 0
    backlog:   number of newer frames already queued (live sources only)
    """

    index: int
    timestamp: float
    image: Tensor
    name: str = ""
    T_cw_groundtruth: Tensor | None = None
    mask: Tensor | None = None
    features: Features | None = None
    backlog: int = 0


@dataclass(frozen=True)
class Features:
    """A batch of keypoints with descriptors. Invalid rows (`mask` False) are finite.

    keypoints:   (B, N, 2) pixels (x, y) of the full-resolution image; (0, 0) is the center of the top left pixel
    scores:      (B, N) response of the detector, higher is better
    scales:      (B, N) size of a pixel of the keypoint's pyramid level, in full-resolution pixels (1.0 at level 0,
                 unless the image was reduced before)
    angles:      (B, N) radians, clockwise in the image (from x towards y)
    descriptors: (B, N, 32) uint8, 256 bits packed least significant first; or (B, N, D) floats of unit length
    mask:        (B, N) bool, True where the row is a keypoint
    information: (B, N) inverse variances of the keypoints in each direction, px^-2, or (B, N, 2, 2) inverse
                 covariances, positive (definite) where `mask`; None: a keypoint is known to its scale
    """

    keypoints: Tensor
    scores: Tensor
    scales: Tensor
    angles: Tensor
    descriptors: Tensor
    mask: Tensor
    information: Tensor | None = None

    def __getitem__(self, rows: slice) -> Features:
        """A part of the batch, by slice."""
        return self._each(lambda column: column[rows])

    def to(self, device: torch.device | str) -> Features:
        return self._each(lambda column: column.to(device))

    def rows(self, rows: Tensor | slice) -> Features:
        """Some keypoints of each element, by slice or index (n,)."""
        return self._each(lambda column: column[:, rows])

    @classmethod
    def cat(cls, parts: Sequence[Features]) -> Features:
        """One batch of several, all with or all without information."""
        columns: Any = ([getattr(part, each.name) for part in parts] for each in fields(cls))
        joined: Any = (None if column[0] is None else torch.cat(column) for column in columns)
        return cls(*joined)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Features:
        columns: Any = (getattr(self, each.name) for each in fields(self))
        changed: Any = (None if column is None else change(column) for column in columns)
        return Features(*changed)


@dataclass(frozen=True)
class Matches:
    """A batch of matches between two sets of features. Invalid rows have index 0 and `mask` False.

    indices_1: (B, M) int64 rows in the first set
    indices_2: (B, M) int64 rows in the second set
    distances: (B, M) float32: Hamming distance in bits, or 1 - cosine
    mask:      (B, M) bool
    weights:   (B, M) matching weights, if the matcher gives some
    """

    indices_1: Tensor
    indices_2: Tensor
    distances: Tensor
    mask: Tensor
    weights: Tensor | None = None


@dataclass(frozen=True)
class FrameFeatures:
    """The features of one frame as the geometry uses them, unbatched.

    keypoints:   (N, 2) pixels, in the dtype of the geometry (float64 unless configured)
    scales:      (N,) pixels: the standard deviation of a keypoint grows with the size of its pyramid level
    angles:      (N,) radians
    descriptors: (N, D)
    mask:        (N,) bool
    session:     number of the run over the same map, from 0
    information: (N, I) as in `KeypointNoise`, of the keypoints; (N, 0) if the front end gives none
    image:       (1, 1, H, W) gray, if the matcher wants it
    backlog:     as in `Frame`
    """

    index: int
    timestamp: float
    keypoints: Tensor
    scales: Tensor
    angles: Tensor
    descriptors: Tensor
    mask: Tensor
    T_cw_groundtruth: Tensor | None = None
    session: int = 0
    information: Tensor = field(default_factory=lambda: torch.zeros(0))
    image: Tensor | None = None
    backlog: int = 0

    def __post_init__(self) -> None:
        _fill_information(self)

    @classmethod
    def of(cls, frame: Frame, features: Features, like: Tensor) -> FrameFeatures:
        """The first element of a batch of features, with the device and the floating-point dtype of `like`."""
        features, truth = features.to(like.device), frame.T_cw_groundtruth
        scales, information = features.scales[:1], features.information
        information = None if information is None else information[:1]
        return cls(
            frame.index,
            frame.timestamp,
            features.keypoints[0].to(like.dtype),
            features.scales[0].to(like.dtype),
            features.angles[0].to(like.dtype),
            features.descriptors[0],
            features.mask[0],
            None if truth is None else truth.to(like),
            information=packed_information(information, scales)[0].to(like.dtype),
            backlog=frame.backlog,
        )

    @property
    def noise(self) -> KeypointNoise:
        """Of the keypoints (N,)."""
        return KeypointNoise(self.scales, self.information)

    def weighed(self, keypoints: Tensor, weights: Tensor | None) -> FrameFeatures:
        """The same view, the information of keypoints (n,) multiplied with the weights (n,) of their matches."""
        if weights is None:
            return self
        factors = torch.ones_like(self.scales).index_put((keypoints,), weights)
        return replace(self, information=self.noise.with_explicit_information().scaled(factors).information)

    @property
    def scale_range(self) -> tuple[float, float]:
        """The finest and the coarsest scale among the keypoints; the same for a detector with a single scale."""
        used = self.scales[self.mask]
        return (float(used.min()), float(used.max())) if len(used) else (1.0, 1.0)

    @property
    def features(self) -> Features:
        """The keypoints as a batch of one, for matching."""
        scores = torch.ones_like(self.scales)
        columns = (self.keypoints, scores, self.scales, self.angles, self.descriptors, self.mask)
        information = unpacked_information(self.information[None])
        keypoints, scores, scales, angles, descriptors, mask = (column[None] for column in columns)
        return Features(keypoints, scores, scales, angles, descriptors, mask, information)


@dataclass(frozen=True)
class MatchPrior:
    """Prior knowledge about the matches of two views. A matcher may ignore it: all matches are tested later.

    radius_px:   (N,) search radii; the first view's keypoints are map points at their predicted pixels in the second
    ratio:       maximum ratio of the best to the second best distance, with a radius; None: no ratio test
    T_21:        (4, 4) from the first camera to the second; matches lie within `epipolar_px` of their epipolar lines
    camera:      of both views, with `T_21`
    """

    radius_px: Tensor | None = None
    ratio: float | None = None
    T_21: Tensor | None = None
    camera: Camera | None = None
    epipolar_px: float = 0.0


Matcher = Callable[[FrameFeatures, FrameFeatures, MatchPrior | None], Matches]
"""Two views and a prior to a batch of one of `Matches`. Only keypoints of `mask` may match, each of the second view
once.

A matcher whose attribute `weighs` is true gives `weights`, which multiply the information of the keypoints. One whose
attribute `wants_images` is true gets (1, 1, H, W) gray images in `FrameFeatures.image` for frames of this run, but not
for projected map points."""


@dataclass(frozen=True)
class MatchIndices:
    """Rows (m,), (m,) of matches, and their weights (m,); None: equal weights."""

    first: Tensor
    second: Tensor
    weights: Tensor | None = None


@dataclass(frozen=True)
class TwoViewMap:
    """A map of two views, the result of initialization.

    reference, view: the two views; the camera of the reference is the world frame
    T_cw:      (4, 4) pose of the second view
    points_w:  (n, 3); keypoints_1, keypoints_2: (n,) their keypoints in the two views
    """

    reference: FrameFeatures
    view: FrameFeatures
    T_cw: Tensor
    points_w: Tensor
    keypoints_1: Tensor
    keypoints_2: Tensor


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of a frame, with the inliers it was estimated from.

    T_cw:        (4, 4)
    point_ids:   (m,) map points of the inliers; keypoints: (m,) their keypoints
    matches:     number of matches from which the inliers were chosen
    covariance:  (6, 6) of the pose's left perturbation (translation, rotation), the points taken as exact
    weights:     (m,) of the inliers, if the matcher gives some
    expected:    (n,) points predicted to be visible; None: `point_ids`
    depth:       median depth of the inliers
    error:       median squared error of the matches, in units of their variance: 1.39 if noise is all there is
    coverage_ratio: ratio of image cells with expected points in which these are found
    explained_ratio: ratio of image cells with keypoints in which some agree with the map
    """

    T_cw: Tensor
    point_ids: Tensor
    keypoints: Tensor
    matches: int
    covariance: Tensor
    depth: float
    error: float = 0.0
    coverage_ratio: float = 1.0
    explained_ratio: float = 1.0
    weights: Tensor | None = None
    expected: Tensor | None = None

    @property
    def inliers(self) -> int:
        return len(self.point_ids)


def _fill_information(features: FrameFeatures) -> None:
    """Replace information that was left out by an empty tensor (n, 0)."""
    if features.information.ndim == 1:
        object.__setattr__(features, "information", packed_information(None, features.scales))


@dataclass(frozen=True)
class Observations:
    """Observations of points in keyframes: flat index tensors, ordered by keyframe, then keypoint.

    keyframe_index, keypoint_index, point_index: (O,) int64
    pixels: (O, 2); scales: (O,) pixels; information: (O, I) as in `KeypointNoise`
    """

    keyframe_index: Tensor
    keypoint_index: Tensor
    point_index: Tensor
    pixels: Tensor
    scales: Tensor
    information: Tensor

    @property
    def noise(self) -> KeypointNoise:
        return KeypointNoise(self.scales, self.information)

    def __len__(self) -> int:
        return len(self.point_index)


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time, ordered by timestamp.

    timestamps: (N,) float64 seconds
    T_wc:       (N, 4, 4) camera to world
    """

    timestamps: Tensor
    T_wc: Tensor

    @classmethod
    def empty(cls) -> Trajectory:
        """A trajectory without poses."""
        return cls(torch.zeros(0, dtype=torch.float64), torch.zeros(0, 4, 4, dtype=torch.float64))

    def __len__(self) -> int:
        return int(self.timestamps.shape[0])

    @property
    def positions_w(self) -> Tensor:
        """(N, 3) camera centers."""
        return self.T_wc[:, :3, 3]


class Reason(StrEnum):
    """Why a frame has no pose, an uncertain one or became a keyframe: the text of `StepResult.reason`.

    Texts with fields in braces belong to a `Rejection`, which has the numbers.
    """

    NEW_REFERENCE = "took a reference frame"
    STARTED = "started the map"
    STARTED_ANEW = "later frames contradict the start: started the map anew"
    FOUND_AGAIN = "found again"
    LOST = "lost"
    LOST_AT_START = "lost right after the start: starting anew"
    STATIC_OVERLAY = "some of the image does not move with the scene and is left out"

    # initialization
    FEW_MATCHES = "too few matches with the reference frame: {count}, {needed} are needed"
    STATIC_AMBIGUOUS = "some of the image stays in place, and it is not clear what moves"
    STATIC_REMAINDER = "what still matches stays in place, the rest has gone: took a new reference frame"
    STANDSTILL = "the camera stands still: the image moved by {pixels:.1f} px"
    STANDSTILL_IN_PART = "{ratio:.0%} of the image stands still, and of the rest: {rejection}"
    MOVING_OBJECT = "something may move before a camera that stands still: a {model} explains it"
    PURE_ROTATION = "the camera only turns: a rotation explains the matches"
    PLANAR_SCENE = "the scene looks planar: a homography explains the matches"
    AMBIGUOUS_MOTION = "ambiguous motion: the {model} allows several"
    BEHIND_CAMERA = "matches behind a camera: only {ratio:.0%} lie in front of both"
    FEW_PARALLAX_POINTS = "too little parallax: {count} points have enough, {needed} are needed"
    LOW_MEAN_PARALLAX = "too little parallax: {mean:.1f} degrees in the mean, {needed} are needed"
    UNCERTAIN_DEPTHS = "depths too uncertain: {count} of {matches} known well, {ratio:.0%} are needed"
    FEW_REFINED_POINTS = "too few points survive refinement: {count}, {needed} are needed"
    FRAMES_UNEXPLAINED = "bad start: it explains {count} of {frames} frames"

    # pose validation
    LOW_INLIER_RATIO = "only {ratio:.0%} of {matches} matches agree with the pose"
    UNCERTAIN_POSITION = "the position is known to {std:.3f} of the scene's depth"
    UNCERTAIN_ROTATION = "the rotation is known to {degrees:.2f} degrees"
    JUMP = "jumped by {translation:.2f} of the scene's depth and {degrees:.0f} degrees"
    LARGE_ERRORS = "the matches of the last frames are off by {sigma:.1f} times their noise in the median"
    LOW_EXPLAINED_RATIO = "the map explains only {ratio:.0%} of the image"
    LOW_COVERAGE_RATIO = "only {ratio:.0%} of the image shows what the map expects there"
    MOVING_MAJORITY = "most of the image moves by itself"
    MOVING_REMAINDER = "{count} matches in the rest of the image move against the map"


@dataclass(frozen=True)
class Rejection:
    """Why a pose or an initialization is rejected; as text, the reason with its numbers."""

    reason: Reason
    values: dict[str, float | str | Rejection] = field(default_factory=dict)

    @classmethod
    def of(cls, reason: Reason, **values: float | str | Rejection) -> Rejection:
        """A reason with the values of the fields of its text."""
        return cls(reason, values)

    def __str__(self) -> str:
        return self.reason.value.format(**self.values)


class State(Enum):
    """State of the system after a frame."""

    INITIALIZING = "initializing"
    """There is no map yet."""
    TRACKING = "tracking"
    """There is a pose, and it is certain."""
    UNCERTAIN = "uncertain"
    """There is a pose that later frames have to confirm: it is doubtful, or the camera was just relocalized."""
    LOST = "lost"
    """There is a map, and no pose."""


@dataclass(frozen=True)
class StepResult:
    """The result of one frame.

    state:       after the frame. Uncertain: there is a pose, which later frames have to confirm
    T_cw:        (4, 4) pose of the frame, world to camera; None while initializing or lost
    submap:       number of the submap the pose is in; None without a pose
    covariance:  (6, 6) of the pose's left perturbation (translation, rotation); None if it was not estimated
    is_keyframe: whether the frame became a keyframe
    matches:     map points matched in this frame
    inliers:     number of these that agree with the pose
    reason:      why there is no pose or why the frame is a keyframe, as text; empty otherwise
    stage_ms:    milliseconds per stage
    """

    index: int
    timestamp: float
    state: State
    T_cw: Tensor | None
    submap: int | None = None
    covariance: Tensor | None = None
    is_keyframe: bool = False
    matches: int = 0
    inliers: int = 0
    reason: str = ""
    stage_ms: dict[str, float] = field(default_factory=dict)
