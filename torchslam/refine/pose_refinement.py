"""Refine the poses of another program with the images: better poses, a map and a better camera, in the same frame.

given poses -> keyframes -> verified pairs -> rotations and points, adjusted -> camera; repeated until it is stable
            -> the other frames -> one graph of all frames, with covariances -> frame and unit of the given poses
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.calibration.find_camera import contradiction
from torchslam.calibration.intrinsics import IntrinsicsEstimate, estimate_intrinsics
from torchslam.calibration.rounds import MAX_ROUNDS, MIN_CHANGE, MIN_CHANGE_IN_STD
from torchslam.config import Config
from torchslam.data.formats.given_poses import TUM, GivenPoses, read_poses
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError, TrajectoryError
from torchslam.geometry import Camera, se3_inverse
from torchslam.map.atlas import Submap
from torchslam.map.map import Map
from torchslam.optim.run_graph import POSE_ITERATIONS, solve_graph
from torchslam.refine.map_building import align_rotations, build_map
from torchslam.refine.non_keyframes import FramePoser, graph_of
from torchslam.refine.tracks import Pair, choose_keyframes, find_pairs, join_matches
from torchslam.system.front_end import Extractor, FrontEnd, check_size, image_extractor, source
from torchslam.system.run import Run
from torchslam.types import FrameFeatures, State, StepResult, Trajectory

MIN_KEYFRAMES = 2  # keyframes of a map


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
        intrinsics: Estimate of the camera; None if it was fixed or no map was built.
        rounds: Number of cameras with which a map was built.
    """

    run: Run
    given: GivenPoses
    pose_rows: Int[Tensor, " F"]
    intrinsics: IntrinsicsEstimate | None
    rounds: int

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
    extractor: FrontEnd | None = None,
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
        extractor: Front end; the configured one if None.
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
    camera = sequence.camera.to(device).to(torch.float64)
    source_frames = source(sequence, config, camera)
    extract = None if source_frames.brings_features else image_extractor(config, device, extractor)
    views, skipped = _extract_features(source_frames, rows, camera, extract)
    frames = torch.tensor([view.index for view in views], dtype=torch.int64)
    T_cw = given.T_cw[rows[frames]].to(camera.params)
    log(f"{len(views)} images with poses")
    scaled = config.for_size(camera.size)  # for the image size, as in a run
    chosen, pairs, failure = _connected(views, T_cw, camera, scaled)
    if failure:
        return RefinementResult(_run((), camera, config, views, [], skipped, failure), given, rows, None, 0)
    log(f"{len(chosen)} connected keyframes, {len(pairs)} pairs")
    keyframes = [views[row] for row in chosen]
    slam_map, camera, estimate, rounds = _rounds(
        keyframes, T_cw[chosen], pairs, camera, scaled, choice, radial, log
    )
    submap = Submap.empty(0, camera.params)
    submap.map = slam_map
    results = FramePoser(camera, scaled).pose(submap, views, T_cw)
    _finalize(submap, camera, frames, T_cw)
    run = _run((submap,), camera, config, views, results, skipped, "")
    return RefinementResult(run, given, rows, estimate, rounds)


def _connected(
    views: list[FrameFeatures], T_cw: Tensor, camera: Camera, config: Config
) -> tuple[list[int], list[Pair], str]:
    """The rows of the keyframes, their verified pairs, and the reason if there are none."""
    if len(views) < MIN_KEYFRAMES:
        return [], [], f"no map: {len(views)} images with a pose are not enough"
    chosen = choose_keyframes(views, camera.width, config)
    if len(chosen) < MIN_KEYFRAMES:
        return [], [], f"no map: no motion in the {len(views)} images"
    pairs = find_pairs([views[row] for row in chosen], T_cw[chosen], camera, config)
    if not pairs:
        return [], [], f"no map: no two of {len(chosen)} keyframes overlap"
    connected = largest_connected_part(pairs, len(chosen))
    return [chosen[row] for row in connected], _renumbered(pairs, connected), ""


def _finalize(submap: Submap, camera: Camera, frames: Tensor, T_cw: Tensor) -> None:
    """Solve one graph of all frames, with covariances, and align it to the given poses T_cw of the frames."""
    graph = submap.posed_frames.graph(submap.map, camera)
    solution = solve_graph(graph, backward="detached", iterations=POSE_ITERATIONS)
    submap.posed_frames.apply_solution(solution, graph, submap.map)
    row_of = {index: row for row, index in enumerate(frames.tolist())}
    posed = [row_of[index] for index in submap.posed_frames.frames["frame_index"].tolist()]
    submap.transform(align_to_input(submap.posed_frames.T_cw(submap.map), T_cw[posed]))


def _as_given(poses: GivenPoses | Trajectory | str | Path) -> GivenPoses:
    if isinstance(poses, Trajectory):
        if len(poses) == 0:
            raise TrajectoryError("the trajectory has no poses")
        return GivenPoses(TUM, Path(), se3_inverse(poses.T_wc), poses.timestamps)
    return poses if isinstance(poses, GivenPoses) else read_poses(poses)


def _extract_features(
    sequence: Sequence, rows: Tensor, camera: Camera, extractor: Extractor | None
) -> tuple[list[FrameFeatures], list[str]]:
    """Features of the frames that have a pose, and messages for the unreadable ones."""
    views, skipped = [], []
    for index in torch.nonzero(rows >= 0)[:, 0].tolist():
        try:
            frame = sequence[index]
            check_size(frame, camera)
        except FrameError as error:
            warnings.warn(f"skipped a frame: {error}", stacklevel=3)
            skipped.append(str(error))
            continue
        with torch.inference_mode():
            features = frame.features if extractor is None else extractor(frame)
            assert features is not None
        views.append(FrameFeatures.of(frame, features, camera.params))
    return views, skipped


def _rounds(
    keyframes: list[FrameFeatures],
    T_cw: Tensor,
    pairs: list[Pair],
    camera: Camera,
    config: Config,
    choice: CameraChoice,
    radial: int,
    log: Callable[[str], None],
) -> tuple[Map, Camera, IntrinsicsEstimate | None, int]:
    """Alternate building the map and estimating the camera, since a wrong camera leads to wrong matches."""
    given, T_cw = camera, align_rotations(T_cw, pairs)
    tracks = join_matches(pairs, len(keyframes), len(keyframes[0].mask))
    rounds, estimate = 0, None
    while True:
        is_free = choice is not CameraChoice.FIXED and camera is not given
        slam_map, camera = build_map(keyframes, T_cw, tracks, camera, config, free_focal=is_free)
        rounds += 1
        T_cw = slam_map.T_cw.clone()
        log(f"round {rounds}: {slam_map.num_points} points, focal length {float(camera.focal):.1f} px")
        if choice is CameraChoice.FIXED:
            return slam_map, camera, None, rounds
        estimate = estimate_intrinsics(graph_of(slam_map, camera), given, radial)
        if not estimate.is_determined or rounds == MAX_ROUNDS:
            return slam_map, camera, estimate, rounds
        if choice is CameraChoice.IF_CONTRADICTED and not is_free and not contradiction(given, estimate):
            return slam_map, camera, estimate, rounds
        change = abs(math.log(float(estimate.camera.focal) / float(camera.focal)))
        if is_free and change < max(MIN_CHANGE, MIN_CHANGE_IN_STD * estimate.focal_std):
            return slam_map, camera, estimate, rounds
        camera = estimate.camera


def largest_connected_part(pairs: list[Pair], count: int) -> list[int]:
    """Return the largest connected set of `count` keyframes, ascending; among equal ones that with the lowest."""
    label = list(range(count))
    for _ in range(count):
        before = list(label)
        for pair in pairs:
            label[pair.first] = label[pair.second] = min(label[pair.first], label[pair.second])
        if label == before:
            break
    best = max(set(label), key=lambda part: (label.count(part), -part), default=0)
    return [row for row, part in enumerate(label) if part == best]


def _renumbered(pairs: list[Pair], connected: list[int]) -> list[Pair]:
    """The pairs among the connected keyframes, with new rows."""
    row_of = {old: new for new, old in enumerate(connected)}
    return [
        replace(pair, first=row_of[pair.first], second=row_of[pair.second])
        for pair in pairs
        if pair.first in row_of and pair.second in row_of
    ]


def _run(
    submaps: tuple[Submap, ...],
    camera: Camera,
    config: Config,
    views: list[FrameFeatures],
    results: list[StepResult],
    skipped: list[str],
    failure: str,
) -> Run:
    if failure:
        results = [StepResult(view.index, view.timestamp, State.LOST, None, reason=failure) for view in views]
    return Run(submaps, camera, config, results, skipped, False, failure)


MAX_OUTLIER_RATIO = 4.0  # times the median error: given positions further off are ignored


def align_to_input(T_cw: Float[Tensor, "F 4 4"], given_cw: Float[Tensor, "F 4 4"]) -> Float[Tensor, "4 4"]:
    """Compute the similarity from the world of the poses to that of the given poses.

    Centers and orientations count equally: centers on a line do not determine the rotation about it. Without any extent
    of the centers the scale is one.
    """
    T_wc, given = se3_inverse(T_cw), se3_inverse(given_cw)
    is_inlier = torch.ones(len(T_wc), dtype=torch.bool, device=T_wc.device)
    for _ in range(3):
        S = _similarity(T_wc[is_inlier], given[is_inlier])
        moved = T_wc[:, :3, 3] @ S[:3, :3].mT + S[:3, 3]
        off = torch.linalg.vector_norm(moved - given[:, :3, 3], dim=-1)
        is_inlier = off <= MAX_OUTLIER_RATIO * off.median().clamp(min=1e-12)
    return S


def _similarity(T_wc: Float[Tensor, "F 4 4"], given: Float[Tensor, "F 4 4"]) -> Float[Tensor, "4 4"]:
    """The similarity that aligns centers and orientations in the least-squares sense."""
    source, target = T_wc[:, :3, 3], given[:, :3, 3]
    x, y = source - source.mean(0), target - target.mean(0)
    extent = (x.square().sum() * y.square().sum()).sqrt()
    M = (given[:, :3, :3] @ T_wc[:, :3, :3].mT).mean(0) + (y.mT @ x) / extent.clamp(min=1e-300)
    U, _, Vh = torch.linalg.svd(M)
    U[:, 2] *= torch.linalg.det(U @ Vh).sign()
    R = U @ Vh
    scale = (y * (x @ R.mT)).sum() / x.square().sum() if float(extent) > 0 else x.new_ones(())
    S = torch.eye(4, dtype=x.dtype, device=x.device)
    S[:3, :3] = scale * R
    S[:3, 3] = target.mean(0) - scale * (R @ source.mean(0))
    return S
