"""Values passed between the stages of the pipeline: small frozen dataclasses of tensors."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum, StrEnum
from functools import cache, partial
from string import Formatter
from typing import Any, Self

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from torchslam.errors import TrajectoryError
from torchslam.geometry.camera import Camera
from torchslam.geometry.gating import KeypointNoise, packed_information, unpacked_information
from torchslam.utils.by_value import ByValue
from torchslam.utils.torch_internals import default_collate_fn_map


@dataclass(frozen=True, eq=False)
class Frame(ByValue):
    """One image of a sequence. A `DataLoader` collates B of them to a dictionary of their columns.

    Attributes:
        index: position in the sequence, from 0.
        timestamp: seconds.
        image: gray, float32 in [0, 1].
        name: in messages (its path, or `video.mp4#17`).
        T_cw_groundtruth: float64. Read only by simulated features, by scale from ground truth and by evaluation.
        mask: True where features may be found; None: everywhere.
        features: a batch of one, if they were extracted already; then the image is not needed, and H and W may be 0.
        backlog: number of newer frames already queued (live sources only).
        picture: small RGB image, to be shown, where the image itself stays with a worker that read it.
    """

    index: int
    timestamp: float
    image: Float[Tensor, "1 1 H W"]
    name: str = ""
    T_cw_groundtruth: Float[Tensor, "4 4"] | None = None
    mask: Bool[Tensor, "1 1 H W"] | None = None
    features: Features | None = None
    backlog: int = 0
    picture: UInt8[Tensor, "h w 3"] | None = None


@dataclass(frozen=True, eq=False)
class Features(ByValue):
    """A batch of keypoints with descriptors. Invalid rows (`mask` False) are finite.

    Attributes:
        keypoints: pixels (x, y) of the full-resolution image; (0, 0) is the center of the top left pixel.
        scores: response of the detector, higher is better.
        scales: size of a pixel of the keypoint's pyramid level, in full-resolution pixels (1.0 at level 0, unless the
            image was reduced before).
        angles: radians, clockwise in the image (from x towards y).
        descriptors: 256 bits as 32 uint8, packed least significant first; or floats of unit length.
        mask: True where the row is a keypoint.
        information: inverse variances of the keypoints in each direction, px^-2, or inverse covariances, positive
            (definite) where `mask`; None: a keypoint is accurate to half its scale, (0.5 scales)^-2.
    """

    keypoints: Float[Tensor, "B N 2"]
    scores: Float[Tensor, "B N"]
    scales: Float[Tensor, "B N"]
    angles: Float[Tensor, "B N"]
    descriptors: UInt8[Tensor, "B N 32"] | Float[Tensor, "B N D"]
    mask: Bool[Tensor, "B N"]
    information: Float[Tensor, "B N"] | Float[Tensor, "B N 2 2"] | None = None

    def __getitem__(self, rows: slice) -> Features:
        """A part of the batch, by slice."""
        return self._each(lambda column: column[rows])

    def to(self, device: torch.device | str) -> Features:
        """The same features on a device."""
        return self._each(lambda column: column.to(device))

    def rows(self, rows: Int[Tensor, " R"] | slice) -> Features:
        """Some keypoints of each element, by slice or index."""
        return self._each(lambda column: column[:, rows])

    @classmethod
    def cat(cls, parts: Sequence[Features]) -> Features:
        """One batch of several, all with or all without information."""
        columns: Any = ([getattr(part, each.name) for part in parts] for each in fields(cls))
        joined: Any = (None if column[0] is None else torch.cat(column) for column in columns)
        return cls(*joined)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Features:
        changed: Any = (None if column is None else change(column) for column in vars(self).values())
        return Features(*changed)


def _collate(frames: Sequence[Frame], *, collate_fn_map: object = None) -> dict[str, Any]:
    """The columns of B frames: images and masks (B, 1, H, W), poses (B, 4, 4), numbers (B,), names as a list, features
    as one batch. What one of them lacks is left out."""
    columns: dict[str, Any] = {}
    for each in fields(Frame):
        column = [getattr(frame, each.name) for frame in frames]
        if any(value is None for value in column):
            continue
        if each.name == "features":
            columns[each.name] = Features.cat(column)
        elif each.name in ("image", "mask"):
            columns[each.name] = torch.cat(column)
        elif each.name == "T_cw_groundtruth":
            columns[each.name] = torch.stack(column)
        else:
            columns[each.name] = column if each.name == "name" else torch.tensor(column, device="cpu")
    return columns


default_collate_fn_map[Frame] = _collate  # of `DataLoader`


@dataclass(frozen=True, eq=False)
class Matches(ByValue):
    """A batch of matches between two sets of features. Invalid rows have index 0 and `mask` False.

    Attributes:
        indices_1: rows in the first set; `indices_2`: in the second one.
        distances: Hamming distance in bits, or 1 - cosine.
        mask: True where the row is a match.
        weights: matching weights, if the matcher gives some.
    """

    indices_1: Int[Tensor, "B M"]
    indices_2: Int[Tensor, "B M"]
    distances: Float[Tensor, "B M"]
    mask: Bool[Tensor, "B M"]
    weights: Float[Tensor, "B M"] | None = None


def _empty(*shape: int) -> Tensor:
    """What stands for a tensor that was left out."""
    return torch.zeros(shape, dtype=torch.float32, device="cpu")


@dataclass(frozen=True)
class FrameFeatures:
    """The features of one frame as the geometry uses them, unbatched; else as in `Frame` and `Features`.

    Attributes:
        keypoints: pixels, in the dtype of the geometry (float64 unless configured).
        scales: pixels: the standard deviation of a keypoint grows with the size of its pyramid level.
        session: number of the run over the same map, from 0.
        information: as in `KeypointNoise`, of the keypoints; (N, 0) if the feature extractor gives none.
        image: gray, if the matcher wants it.
        detected: pixels at which the extractor found the keypoints. They differ from `keypoints` where a rolling
            shutter was corrected, see `torchslam.geometry.SensorModel`; `keypoints` themselves if omitted.
    """

    index: int
    timestamp: float
    keypoints: Float[Tensor, "N 2"]
    scales: Float[Tensor, " N"]
    angles: Float[Tensor, " N"]
    descriptors: Shaped[Tensor, "N D"]
    mask: Bool[Tensor, " N"]
    T_cw_groundtruth: Float[Tensor, "4 4"] | None = None
    session: int = 0
    information: Float[Tensor, "N I"] = field(default_factory=partial(_empty, 0))
    image: Float[Tensor, "1 1 H W"] | None = None
    backlog: int = 0
    detected: Float[Tensor, "_ 2"] = field(default_factory=partial(_empty, 0, 2))

    def __post_init__(self) -> None:
        if self.information.ndim == 1:
            object.__setattr__(self, "information", packed_information(None, self.scales))
        if len(self.detected) == 0:
            object.__setattr__(self, "detected", self.keypoints)
        if (rows := len(self.detected)) != len(self.keypoints):
            raise ValueError(f"detected has {rows} rows, but keypoints has {len(self.keypoints)}")

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
        """Of the keypoints."""
        return KeypointNoise(self.scales, self.information)

    def weighed(self, keypoints: Int[Tensor, " M"], weights: Float[Tensor, " M"] | None) -> FrameFeatures:
        """The same view, the information of keypoints multiplied with the weights of their matches."""
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
        batch: Any = (*(column[None] for column in columns), unpacked_information(self.information[None]))
        return Features(*batch)


@dataclass(frozen=True)
class MatchPrior:
    """Prior knowledge about the matches of two views. A matcher may ignore it: all matches are tested later.

    Attributes:
        radius_px: search radii; the first view's keypoints are map points at their predicted pixels in the second.
        ratio: maximum ratio of the best to the second best distance, with a radius; None: no ratio test.
        T_21: from the first camera to the second; matches lie within `epipolar_px` of their epipolar lines.
        camera: of both views, with `T_21`.
        epipolar_px: largest distance from the epipolar line, pixels.
    """

    radius_px: Float[Tensor, " N"] | None = None
    ratio: float | None = None
    T_21: Float[Tensor, "4 4"] | None = None
    camera: Camera | None = None
    epipolar_px: float = 0.0


Matcher = Callable[[FrameFeatures, FrameFeatures, MatchPrior | None], Matches]
"""Two views and a prior to a batch of one of `Matches`. Only keypoints of `mask` may match, each of the second view
once.

A matcher whose attribute `weighs` is true gives `weights`, which multiply the information of the keypoints. One whose
attribute `wants_images` is true gets (1, 1, H, W) gray images in `FrameFeatures.image` for frames of this run, but not
for projected map points."""


@dataclass(frozen=True)
class MotionHistory:
    """The last poses in a submap, from which a motion model predicts the next one.

    Attributes:
        T_cw: pose of the last frame, world to camera, in the unit of the map.
        motions: T_c_previous of up to ten frames, the newest at the end; none after a start or a lost frame.
        intervals: seconds that each motion takes, negative backward in time; 0 if unknown.
        interval: seconds from the last frame to the next one; 0 if unknown.
    """

    T_cw: Float[Tensor, "4 4"]
    motions: Float[Tensor, "M 4 4"]
    intervals: Float[Tensor, " M"]
    interval: float


@dataclass(frozen=True)
class PosePrediction:
    """The pose that is expected of a frame.

    Attributes:
        T_cw: world to camera.
        covariance: of T_cw, left perturbation, translation first, in the unit of the map and radians: keypoints are
            searched for where it allows, and a pose that it excludes has to be confirmed; None: fixed limits.
    """

    T_cw: Float[Tensor, "4 4"]
    covariance: Float[Tensor, "6 6"] | None = None


MotionModel = Callable[[MotionHistory], PosePrediction]
"""Predicts a pose. It keeps no state: a checkpoint has the history, and tracking also goes backward in time."""


@dataclass(frozen=True)
class MatchIndices:
    """Rows of matches in two sets, and their weights; None: equal weights."""

    first: Int[Tensor, " M"]
    second: Int[Tensor, " M"]
    weights: Float[Tensor, " M"] | None = None


@dataclass(frozen=True)
class TwoViewMap:
    """A map of two views, the result of initialization: the second view, its pose, and points with their keypoints.

    The camera of the first view, the reference, is the world frame.
    """

    reference: FrameFeatures
    view: FrameFeatures
    T_cw: Float[Tensor, "4 4"]
    points_w: Float[Tensor, "M 3"]
    keypoints_1: Int[Tensor, " M"]
    keypoints_2: Int[Tensor, " M"]


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of a frame, with the inliers it was estimated from.

    Attributes:
        point_ids: map points of the inliers; `keypoints`: their keypoints.
        matches: number of matches from which the inliers were chosen.
        covariance: of the pose's left perturbation (translation, rotation), the points taken as exact.
        depth: median depth of the inliers.
        error: median squared error of the matches, in units of their variance; 1.39 for noise alone.
        coverage_ratio: ratio of image cells with expected points in which these are found.
        explained_ratio: ratio of image cells with keypoints in which some agree with the map.
        expected: points predicted to be visible; None: `point_ids`.
    """

    T_cw: Float[Tensor, "4 4"]
    point_ids: Int[Tensor, " M"]
    keypoints: Int[Tensor, " M"]
    matches: int
    covariance: Float[Tensor, "6 6"]
    depth: float
    error: float = 0.0
    coverage_ratio: float = 1.0
    explained_ratio: float = 1.0
    weights: Float[Tensor, " M"] | None = None
    expected: Int[Tensor, " N"] | None = None

    @property
    def inliers(self) -> int:
        """Number of inliers."""
        return len(self.point_ids)


@dataclass(frozen=True)
class Observations:
    """Observations of points in keyframes: flat index tensors, ordered by keyframe, then keypoint.

    Attributes:
        keyframe_index: rows of keyframes.
        keypoint_index: rows of keypoints in these keyframes.
        point_index: rows of points.
        pixels: where the keypoints are, whose noise is that of `scales` and `information`.
    """

    keyframe_index: Int[Tensor, " O"]
    keypoint_index: Int[Tensor, " O"]
    point_index: Int[Tensor, " O"]
    pixels: Float[Tensor, "O 2"]
    scales: Float[Tensor, " O"]
    information: Float[Tensor, "O I"]

    @property
    def noise(self) -> KeypointNoise:
        """Of the observed keypoints."""
        return KeypointNoise(self.scales, self.information)

    def __len__(self) -> int:
        return len(self.point_index)


@dataclass(frozen=True, eq=False)
class Trajectory(ByValue):
    """Camera poses over time, ordered by timestamp.

    Attributes:
        timestamps: float64 seconds, ascending; frames of several sessions may have the same.
        T_wc: camera to world.

    Raises:
        TrajectoryError: Another type, shape or order, or values that are not finite.
    """

    timestamps: Float[Tensor, " N"]
    T_wc: Float[Tensor, "N 4 4"]

    def __post_init__(self) -> None:
        times, T_wc = self.timestamps, self.T_wc
        for name, values, kinds in (
            ("timestamps", times, (torch.float64,)),  # others cannot tell apart frames of seconds since 1970
            ("T_wc", T_wc, (torch.float32, torch.float64)),
        ):
            found = values.dtype if isinstance(values, Tensor) else type(values).__name__
            if found not in kinds:
                wanted = " or ".join(map(str, kinds))
                raise TrajectoryError(f"{name} of a trajectory must be {wanted}, not {found}")
        if times.ndim != 1 or T_wc.shape != (len(times), 4, 4):
            shapes = f"(N,) and (N, 4, 4), not {tuple(times.shape)} and {tuple(T_wc.shape)}"
            raise TrajectoryError(f"timestamps and T_wc of a trajectory must be {shapes}")
        for name, finite in (("time", times.isfinite()), ("pose", T_wc.isfinite().flatten(1).all(1))):
            if not bool(finite.all()):
                raise TrajectoryError(f"{name} {int(finite.int().argmin())} of a trajectory is not finite")
        check_ascending(times, times.diff() < 0)

    @classmethod
    def empty(cls) -> Trajectory:
        """A trajectory without poses."""
        nothing = torch.zeros(0, 4, 4, dtype=torch.float64, device="cpu")
        return cls(nothing[:, 0, 0], nothing)

    def __len__(self) -> int:
        return int(self.timestamps.shape[0])

    @property
    def positions_w(self) -> Float[Tensor, "N 3"]:
        """Camera centers."""
        return self.T_wc[:, :3, 3]


def check_ascending(times: Float[Tensor, " N"], wrong: Bool[Tensor, " M"]) -> None:
    """Raise TrajectoryError where a step from one time to the next is wrong."""
    if bool(wrong.any()):
        row = int(wrong.int().argmax()) + 1
        late, early = float(times[row]), float(times[row - 1])
        raise TrajectoryError(
            f"times of a trajectory must increase: {late!r} s, row {row}, follows {early!r} s"
        )


class Reason(StrEnum):
    """Kinds of `StepResult.reasons`: why a frame has no pose, has an uncertain pose or became a keyframe.

    Texts with fields in braces belong to an `Explanation`, which has the numbers.
    """

    NEW_REFERENCE = "took a reference frame"
    STARTED = "map initialized"
    STARTED_ANEW = "later frames contradict the start: map initialized again"
    RELOCALIZED = "relocalized"
    LOST = "lost"
    LOST_AT_START = "lost right after the start: starting again"
    STATIC_OVERLAY = "static overlay masked out"
    INDEPENDENT_MOTION = "{count} independently moving keypoints masked out"
    UNCONFIRMED = "to be confirmed by {count} more frames"

    # keyframes
    MOVED = "moved by {ratio:.2f} of the scene depth"
    TURNED = "turned by {degrees:.1f} degrees"
    FEW_POINTS = "sees only {count} points of the map"
    LOW_OVERLAP = "sees {ratio:.0%} of the points of its reference keyframe"

    # initialization
    FEW_KEYPOINTS = "too little texture: {count} keypoints, {needed} are needed"
    FEW_MATCHES = (
        "too few matches with the reference frame: {count}, {needed} are needed; "
        "views may be too far apart, or blurred"
    )
    STATIC_AMBIGUOUS = "part of the image is static, and the motion of the rest is unclear"
    STATIC_REMAINDER = "only static parts of the image still match: took a new reference frame"
    STATIONARY = "the camera stands still: the image moved by {pixels:.1f} px"
    STATIONARY_IN_PART = "{ratio:.0%} of the image is static; the rest: {rejection}"
    MOVING_OBJECT = "possible moving object in front of a stationary camera: a {model} explains it"
    PURE_ROTATION = "the camera only turns: a rotation explains the matches"
    PURE_ROTATION_OTHER_FOCAL = (
        "the camera only turns: a rotation with a focal length of about {focal:.0f} px "
        "explains the matches as well"
    )
    PLANAR_SCENE = "the scene looks planar: a homography explains the matches"
    AMBIGUOUS_MOTION = "ambiguous motion: the {model} allows several"
    BEHIND_CAMERA = "matches behind a camera: only {ratio:.0%} lie in front of both"
    FEW_PARALLAX_POINTS = "too little parallax: {count} points have enough, {needed} are needed"
    LOW_MEAN_PARALLAX = "too little parallax: {mean:.1f} degrees on average, {needed} are needed"
    UNCERTAIN_DEPTHS = "depths too uncertain: {count} of {matches} are certain, {ratio:.0%} are needed"
    FEW_REFINED_POINTS = "too few points survive refinement: {count}, {needed} are needed"
    FRAMES_UNEXPLAINED = "bad start: it explains {count} of {frames} frames"

    # pose validation
    LOW_INLIER_RATIO = "only {ratio:.0%} of {matches} matches agree with the pose"
    UNCERTAIN_POSITION = "position uncertainty {std:.1%} of the scene depth"
    UNCERTAIN_ROTATION = "rotation uncertainty {degrees:.2f} degrees"
    JUMP = "jumped by {translation:.2f} of the scene depth and {degrees:.0f} degrees"
    LARGE_ERRORS = "the median error of the matches of the last frames is {sigma:.1f} times their noise"
    LOW_EXPLAINED_RATIO = "the map explains only {ratio:.0%} of the image"
    LOW_COVERAGE_RATIO = "only {ratio:.0%} of the image looks as the map predicts"
    MOVING_MAJORITY = "most of the image moves independently"
    WEAK_LINK = "weakly connected to the main map, or the check contradicts the connection"
    ZOOM = "the focal length changes, by {ratio:.0%} from the first frame to this one"
    MOVING_REMAINDER = "{count} matches in the rest of the image move against the map"

    # without an online map
    NOT_FOUND = "not found in the map"
    OTHER = "{text}"


@dataclass(frozen=True)
class Explanation:
    """A reason with the values of the fields of its text, by name; `str` gives the text."""

    reason: Reason
    values: dict[str, float | str | Explanation] = field(default_factory=dict)

    @classmethod
    def of(cls, reason: Reason, **values: float | str | Explanation) -> Self:
        """A reason with the values of the fields of its text."""
        return cls(reason, values)

    @staticmethod
    def parsed(text: str) -> tuple[Explanation, ...]:
        """The explanations that a file has as text, with values as rounded there; text of none of them is `OTHER`."""
        found = []
        while text:
            fitting = ((reason, match) for reason in Reason if (match := _pattern(reason).match(text)))
            reason, match = next(fitting, (Reason.OTHER, None))
            values = {"text": text} if match is None else match.groupdict()
            found.append(Explanation(reason, {name: _value(name, given) for name, given in values.items()}))
            text = "" if match is None else text[match.end() :].removeprefix("; ")
        return tuple(found)

    def __str__(self) -> str:
        return self.reason.value.format(**self.values)


_NUMBER = r"-?(?:\d{1,18}(?:\.\d{1,18})?|nan|inf)"


@cache
def _pattern(reason: Reason) -> re.Pattern[str]:
    """Of the text of a reason, up to the next one; the fields are groups."""
    pattern = ""
    for literal, name, form, _ in Formatter().parse(reason.value):
        pattern += re.escape(literal)
        if name == "rejection":  # goes on to the end
            pattern += f"(?P<{name}>.+)"
        elif name:
            pattern += f"(?P<{name}>{_NUMBER + '%' * form.endswith('%') if form else '(?:(?!; ).)+?'})"
    return re.compile(pattern + r"(?=; |\Z)", re.DOTALL)


def _value(name: str, text: str) -> float | str | Explanation:
    """The value of a field from its text."""
    if name == "rejection":
        return Explanation.parsed(text)[0]
    if not re.fullmatch(_NUMBER + "%?", text):
        return text
    number = float(text.removesuffix("%"))
    return number / 100 if text.endswith("%") else int(text) if text.lstrip("-").isdigit() else number


class Rejection(Explanation):
    """Why a pose or an initialization is rejected."""


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

    Attributes:
        timestamp: of the frame, seconds.
        state: after the frame.
        T_cw: pose of the frame, world to camera; None while initializing or lost.
        submap: number of the submap the pose is in; None without a pose.
        covariance: of the pose's left perturbation (translation, rotation); None if it was not estimated.
        matches: number of map points matched in this frame; `inliers`: of these that agree with the pose.
        reasons: why there is no pose, or an uncertain one, or why the frame is a keyframe.
        stage_ms: milliseconds per stage.
    """

    index: int
    timestamp: float
    state: State
    T_cw: Float[Tensor, "4 4"] | None
    submap: int | None = None
    covariance: Float[Tensor, "6 6"] | None = None
    is_keyframe: bool = False
    matches: int = 0
    inliers: int = 0
    reasons: tuple[Explanation, ...] = ()
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def reason(self) -> str:
        """The text of the reasons; empty where there are none."""
        return "; ".join(map(str, self.reasons))
