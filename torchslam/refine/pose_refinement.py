"""Refine the poses of another program with the images: better poses, a map and a better camera, in the same frame.

given poses -> images -> view graph -> rounds from the given poses, or anew where the images contradict them -> camera
            -> the other frames -> one graph of all frames, with covariances -> frame and unit of the given poses

The held-out pairs of images decide between the given and the refined poses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.calibration.find_camera import better_camera
from torchslam.config import Config
from torchslam.data.formats.given_poses import NERFSTUDIO, TUM, GivenPoses, read_poses
from torchslam.data.sequence import Sequence
from torchslam.errors import TrajectoryError
from torchslam.geometry import Camera, SensorModel, se3_inverse, transform
from torchslam.geometry.camera_measurement import (
    FOCAL,
    K1,
    K2,
    CameraMeasurement,
    intrinsics_directions,
    with_radial_terms,
)
from torchslam.geometry.lie import rigid, sim3_scale
from torchslam.geometry.robust import fit_inliers
from torchslam.geometry.similarity import align_poses
from torchslam.geometry.transforms import opengl, rotation_angle
from torchslam.global_mapping.check import MapCheck, check_map
from torchslam.global_mapping.image_choice import choose_images
from torchslam.global_mapping.mapper import GlobalMapper, choose_held_back
from torchslam.global_mapping.rounds import GATE, MIN_VIEWS, ObservedTracks, Reconstruction, adjust_in_rounds
from torchslam.global_mapping.view_graph import (
    PairMatcher,
    Relation,
    ViewPair,
    build_view_graph,
    connected_views,
)
from torchslam.refine.conventions import MATCHES, MAX_PAIRS, fitting_reading
from torchslam.system.front_end import FeatureExtractor
from torchslam.system.run import Run
from torchslam.types import Explanation, Reason, State, StepResult, Trajectory

GOOD_POSES = 0.9
"""Share of image pairs that agree with the given poses, from which on the rounds start with them."""
FREE_STD = 1.0
"""Relative standard deviation of a camera that the images decide."""
IMPROVED = 0.9
"""Distance of the matches of unused pairs from where the poses allow them, refined to given, up to which the images
improve on the given poses; two maps of one recording by different features differ by 5 %."""
MORE_AGREE = 0.05
"""By how much the share of pairs that agree must grow to count as improved, whatever their distance."""
NAMED = 3
"""Conventions that a message names at most, of those that fit equally. Tried at this value only."""
MAX_TURNED = 30.0
"""Median angle, degrees, between given and refined orientations from which on nothing relates the frames of both.
Tried at this value only."""


class CameraChoice(Enum):
    """How the given camera is treated.

    Attributes:
        IF_CONTRADICTED: Replace its focal length if the images contradict it.
        FREE: Replace it if the images determine it.
        FIXED: Keep it.
    """

    IF_CONTRADICTED = "if_contradicted"
    FREE = "free"
    FIXED = "fixed"


@dataclass(frozen=True)
class RefinementResult:
    """Refined poses with their map.

    Attributes:
        run: Its submap is in the frame and unit of the given poses, its camera is the refined one, and its online
            poses are the given ones.
        given: The given poses.
        pose_rows: Row of the given pose of each frame of the sequence, -1 for none.
        rounds: Number of cameras with which a map was built.
        kept: Whether the given poses were kept, since the images do not improve on them.
        agreeing: Share of the image pairs that agree with the given poses.
        check: The check of the refined poses in a sentence.
    """

    run: Run
    given: GivenPoses
    pose_rows: Int[Tensor, " F"]
    rounds: int
    kept: bool = False
    agreeing: float = 1.0
    check: str = ""

    @property
    def without_image(self) -> int:
        """The number of poses without an image."""
        return len(self.given) - int((self.pose_rows >= 0).sum())

    @property
    def without_pose(self) -> int:
        """The number of images without a pose, which were ignored."""
        return int((self.pose_rows < 0).sum())


def refine_poses(
    sequence: Sequence,
    poses: GivenPoses | Trajectory | str | Path,
    config: Config | None = None,
    choice: CameraChoice = CameraChoice.IF_CONTRADICTED,
    radial: int = 0,
    device: torch.device | str = "cpu",
    extractor: FeatureExtractor | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> RefinementResult:
    """Refine given poses of the images of a sequence.

    Frames without a pose and poses without an image are ignored. `Run.failure` has the reason if no map was built.

    Args:
        sequence: Images with a camera.
        poses: Poses, or a path for `read_poses`.
        config: The default if None.
        choice: How the given camera is treated.
        radial: Maximum number of distortion coefficients that may be estimated.
        device: Of torch.
        extractor: Feature extractor; SIFT if None and the configured one is the default.
        on_progress: Receives messages.

    Returns:
        The run in the frame and unit of the given poses.

    Raises:
        TrajectoryError: No pose belongs to an image.
        CalibrationError: The sequence has no camera.
    """
    config, log = config or Config(), on_progress or (lambda words: None)
    given = _as_given(poses)
    rows = given.rows(sequence)
    frames = torch.nonzero(rows >= 0)[:, 0].tolist()
    camera = sequence.camera.to(device).to(torch.float64)
    free = _measurement(camera, radial) if choice is CameraChoice.FREE else None
    mapper = GlobalMapper(sequence, camera, config, free, device, extractor)
    chosen = [
        frames[row] for row in choose_images(len(frames), (), mapper.config.global_mapping.window_images)
    ]
    refinement = _Refinement(mapper, frames, chosen, given.T_cw[rows].to(camera.params))
    failure = refinement.failure
    if not failure:
        refinement.check_convention(given)
        counts = f"{len(refinement.views)} images, {len(refinement.pairs)} pairs"
        log(f"{counts}; given: {refinement.before.sentence()}")
        failure = refinement.map()
    if failure:
        why = (Explanation.of(Reason.OTHER, text=failure),)
        lost = [
            StepResult(view.index, view.timestamp, State.LOST, None, reasons=why) for view in refinement.views
        ]
        run = Run((), SensorModel(camera), config, lost, mapper.skipped, False, failure)
        return RefinementResult(run, given, rows, 0)
    rounds = 1
    if choice is CameraChoice.IF_CONTRADICTED:
        better = better_camera(refinement.run.graph, camera)
        if better is not None:
            mapper.given = _measurement(better.camera, radial)
            refinement.map()
            rounds = 2
    kept = refinement.keep_given_unless_improved(is_free=mapper.given is not None)
    log(f"refined: {refinement.after.sentence()}" + ("; the given poses are kept" if kept else ""))
    agreeing, check = refinement.before.used_agreeing, refinement.after.sentence()
    return RefinementResult(refinement.run, given, rows, rounds, kept, agreeing, check)


def _measurement(camera: Camera, radial: int) -> CameraMeasurement:
    """The given camera as a guess of its focal length and of up to `radial` coefficients of distortion."""
    camera = with_radial_terms(camera)
    return CameraMeasurement(camera, FREE_STD * intrinsics_directions(camera, [FOCAL, K1, K2][: 1 + radial]))


class _Refinement:
    """The images with given poses, and the map that is made of them.

    Attributes:
        failure: why no map can be made; empty if one can.
        before, after: the check of the given and of the refined poses.
        run: in the frame and unit of the given poses, once it is mapped.
    """

    run: Run
    after: MapCheck

    def __init__(
        self, mapper: GlobalMapper, frames: list[int], chosen: list[int], given_cw: Float[Tensor, "N 4 4"]
    ) -> None:
        """given_cw: by frame of the sequence; of frames without a pose, any."""
        self.mapper, self.frames, self.given_cw = mapper, frames, given_cw
        self.given = {frame: given_cw[frame] for frame in frames}
        self.views = [view for view in map(mapper.view, chosen) if view is not None]
        self.pairs: list[ViewPair] = []
        self.failure = ""
        if len(self.views) < MIN_VIEWS:
            self.failure = f"no map: {len(self.views)} images with a pose are not enough"
            return
        self.pairs = build_view_graph(PairMatcher(self.views, mapper.camera, mapper.matcher, mapper.config))
        self.held_back = choose_held_back(self.pairs)
        self.used = [pair for row, pair in enumerate(self.pairs) if row not in self.held_back]
        if not self.used:
            self.failure = f"no map: no two of {len(self.views)} images overlap"
            return
        self.T_cw = given_cw[torch.tensor([view.index for view in self.views], device="cpu")]
        everything = torch.ones(len(self.views), dtype=torch.bool, device="cpu")
        self.before = self._check(self.T_cw, everything, mapper.camera)

    def check_convention(self, given: GivenPoses) -> None:
        """Raise TrajectoryError, naming what fits, for poses that image pairs contradict as the format defines them."""
        if not self.pairs:
            return
        poses = self.T_cw if given.is_world_to_camera else se3_inverse(self.T_cw)
        pairs = self.pairs[:: 1 + len(self.pairs) // MAX_PAIRS]

        def pixels(view: int, rows: Int[Tensor, " M"]) -> Float[Tensor, "N 2"]:
            return self.views[view].keypoints[rows[:: len(rows) // MATCHES][:MATCHES]]

        pixels_1 = torch.stack([pixels(pair.first, pair.keypoints_1) for pair in pairs])
        pixels_2 = torch.stack([pixels(pair.second, pair.keypoints_2) for pair in pairs])
        ends = torch.tensor([(pair.first, pair.second) for pair in pairs], device=poses.device)
        share, others = fitting_reading(
            poses, given.is_world_to_camera, ends, pixels_1.to(poses), pixels_2.to(poses), self.mapper.camera
        )
        if not others:
            return
        of_format = "world to camera" if given.is_world_to_camera else "camera to world"
        axes = torch.eye(3, dtype=poses.dtype, device=poses.device)
        axes = opengl(rigid(axes, axes[0]))[:3, :3] if given.kind == NERFSTUDIO else axes
        fitting = "; or ".join(
            f"{each.share:.0%} as {each.sentence(of_format, axes)}" for each in others[:NAMED]
        )
        hint = "convert them"
        if len(others) > 1:
            more = f" or {len(others) - NAMED} more" if len(others) > NAMED else ""
            hint = f"these{more} fit equally, which more images may decide; convert the poses as they were written"
        raise TrajectoryError(
            f"{given.path}: {share:.0%} of {len(pairs)} image pairs agree with the poses as {of_format}, but "
            f"{fitting}: {hint}"
        )

    @torch.no_grad()
    def map(self) -> str:
        """Map the images, and pose the other frames; returns why that failed, or nothing."""
        found = self._from_given() if self.before.used_agreeing >= GOOD_POSES else None
        made = self.mapper.reconstruct(self.views, self.used) if found is None else found
        if isinstance(made, str):
            # Small motions in front of planes leave two-view geometry ambiguous, but not the given poses.
            moves = any(pair.relation is Relation.GENERAL for pair in self.used)
            found = self._from_given(coarse=True) if moves else None
            if found is None:
                return made
            made = found
        rows, _, reconstruction = made
        known = torch.zeros(len(self.views), dtype=torch.bool, device="cpu")
        known[rows.cpu()] = True
        self.after = self._check(reconstruction.T_cw, known, reconstruction.camera)
        self.run = self.mapper.adjusted(*self.mapper.posed(self.views, *made, self.frames, self.given))
        submap = self.run.submaps[0]
        T_cw = submap.posed_frames.T_cw(submap.map)
        given = self.given_cw[submap.posed_frames.frames["frame_index"]]
        S = align_to_input(T_cw, given)
        submap.transform(S)
        R_S = S[:3, :3] / sim3_scale(S)
        off = float(torch.rad2deg(rotation_angle(given[:, :3, :3].mT @ T_cw[:, :3, :3] @ R_S.T)).median())
        if off > MAX_TURNED:
            return (
                f"the orientations of the given poses are {off:.0f} degrees off those that the images determine, and "
                "no other convention of the poses fits; map the images without them (torchslam run)"
            )
        return ""

    @torch.no_grad()
    def keep_given_unless_improved(self, is_free: bool) -> bool:
        """Whether the given poses are kept, by held-out pairs; a better camera counts as improved."""
        before, after = self.before, self.after
        improved = after.distance_px < IMPROVED * before.distance_px
        improved = improved or after.used_agreeing > before.used_agreeing + MORE_AGREE
        if improved or is_free or before.pairs == 0:
            return False
        observed = self._tracks()
        found = observed.triangulate(self.T_cw, self.mapper.camera, GATE)
        rows = torch.unique(observed.tracks.view[found.agrees])
        posed = self.mapper.posed(self.views, rows, observed, found, self.frames, self.given)
        self.run = self.mapper.adjusted(*posed, keep=True)
        submap = self.run.submaps[0]
        frames = submap.posed_frames.frames
        T_rw = submap.map.T_cw[frames["reference_keyframe"]]
        frames["T_cr"][:] = self.given_cw[frames["frame_index"]] @ se3_inverse(T_rw)
        self.after = self.before
        return True

    def _check(self, T_cw: Tensor, known: Tensor, camera: Camera) -> MapCheck:
        reduction = self.mapper.config.features.reduction(camera.size)
        return check_map(T_cw, known, self.views, self.pairs, camera, self.held_back, reduction)

    def _tracks(self) -> ObservedTracks:
        connected = set(connected_views(self.used, len(self.views)).tolist())
        pairs = [pair for pair in self.used if pair.first in connected]
        return ObservedTracks.join(pairs, self.views)

    def _from_given(
        self, coarse: bool = False
    ) -> tuple[Int[Tensor, " K"], ObservedTracks, Reconstruction] | None:
        """The rounds from the given poses; None if no points agree with them."""
        observed = self._tracks()
        measured = self.mapper.given
        camera = self.mapper.camera if measured is None else measured.camera
        found = adjust_in_rounds(observed, self.T_cw, measured, camera, coarse)
        rows = torch.unique(observed.tracks.view[found.agrees])
        return (rows, observed, found) if len(rows) >= MIN_VIEWS else None


def _as_given(poses: GivenPoses | Trajectory | str | Path) -> GivenPoses:
    if isinstance(poses, Trajectory):
        if len(poses) == 0:
            raise TrajectoryError("the trajectory has no poses")
        return GivenPoses(TUM, Path(), se3_inverse(poses.T_wc), poses.timestamps)
    return poses if isinstance(poses, GivenPoses) else read_poses(poses)


MAX_OUTLIER_RATIO = 4.0  # times the median error: given positions further off are ignored


def align_to_input(T_cw: Float[Tensor, "F 4 4"], given_cw: Float[Tensor, "F 4 4"]) -> Float[Tensor, "4 4"]:
    """Compute the similarity from the world of the poses to that of the given poses.

    Centers and orientations count equally: centers on a line do not determine the rotation about it. Without any extent
    of the centers the scale is one.
    """
    T_wc, given = se3_inverse(T_cw), se3_inverse(given_cw)

    def similarity(_: Tensor, counted: Bool[Tensor, " F"]) -> Float[Tensor, "4 4"]:
        return align_poses(T_wc[counted], given[counted], use_centers=True)

    def are_near(S: Float[Tensor, "4 4"]) -> Bool[Tensor, " F"]:
        off = torch.linalg.vector_norm(transform(S, T_wc[:, :3, 3]) - given[:, :3, 3], dim=-1)
        return off <= MAX_OUTLIER_RATIO * off.median().clamp(min=1e-12)

    everything = torch.ones(len(T_wc), dtype=torch.bool, device=T_wc.device)
    found = fit_inliers(similarity(T_wc, everything), are_near, similarity, rounds=2)
    assert found is not None  # poses always determine a similarity
    return found[0]
