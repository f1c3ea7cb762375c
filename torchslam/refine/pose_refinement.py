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
from torch import Tensor

from torchslam.calibration.find_camera import contradiction
from torchslam.calibration.intrinsics import Refinement, estimate_intrinsics
from torchslam.calibration.rounds import MAX_ROUNDS, MIN_CHANGE, MIN_CHANGE_IN_STD
from torchslam.config import Config
from torchslam.data.formats.given_poses import TUM, GivenPoses, read_poses
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError, TrajectoryError
from torchslam.geometry import Camera, se3_inverse
from torchslam.map.atlas import Submap
from torchslam.map.map import Map
from torchslam.optim.run_graph import solve
from torchslam.refine.map_building import align_rotations, build_map
from torchslam.refine.non_keyframes import FramePoser, graph_of
from torchslam.refine.tracks import Pair, choose_keyframes, find_pairs, join_matches
from torchslam.system.front_end import Extractor, FrontEnd, check_size, image_extractor, source
from torchslam.system.run import Run
from torchslam.types import FrameFeatures, State, StepResult, Trajectory

MIN_KEYFRAMES = 2  # keyframes of a map


class CameraChoice(Enum):
    """What becomes of the given camera.

    JUDGED: another focal length is taken where the images contradict the given one
    FREE:   what the images say is taken wherever they determine it
    FIXED:  it stays as it is
    """

    IF_CONTRADICTED = "if_contradicted"
    FREE = "free"
    FIXED = "fixed"


@dataclass(frozen=True)
class Refined:
    """What refining came to.

    run:     as of a run: its worlds are in the frame and unit of the given poses, its camera the refined one, and the
             poses "as they were given" those of the other program
    given:   the poses it began with
    rows:    (F,) which of them each frame of the sequence has, -1 where none
    camera:  what the images say of the camera; None where it stayed fixed, or nothing came of it
    rounds:  how many cameras a map was made with
    """

    run: Run
    given: GivenPoses
    rows: Tensor
    camera: Refinement | None
    rounds: int

    @property
    def without_image(self) -> int:
        """How many poses are of no image."""
        return len(self.given) - int((self.rows >= 0).sum())

    @property
    def without_pose(self) -> int:
        """How many images have no pose, and were left out."""
        return int((self.rows < 0).sum())


def refine_poses(
    sequence: Sequence,
    poses: GivenPoses | Trajectory | str | Path,
    config: Config | None = None,
    choice: CameraChoice = CameraChoice.IF_CONTRADICTED,
    radial: int = 0,
    device: torch.device | str = "cpu",
    extractor: FrontEnd | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> Refined:
    """Make somebody else's poses of the images of a sequence better.

    poses:     as read, or what `read_poses` reads; the camera is that of the sequence
    radial:    how many coefficients of the distortion may be fitted beside the focal length, where the images ask
    extractor: front end, the configured one if None
    told:      of every step, in words

    Frames without a pose are left out, so are poses without an image. A run without a map says why (`Run.failure`).
    Raises TrajectoryError where no pose is that of an image, CalibrationError where there is no camera.
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
    scaled = config.for_size(camera.size)  # what is told to the steps, as in a run
    chosen, pairs, failure = _connected(views, T_cw, camera, scaled)
    if failure:
        return Refined(_run((), camera, config, views, [], skipped, failure), given, rows, None, 0)
    log(f"{len(chosen)} connected keyframes, {len(pairs)} pairs")
    keyframes = [views[row] for row in chosen]
    slam_map, camera, refined, rounds = _rounds(
        keyframes, T_cw[chosen], pairs, camera, scaled, choice, radial, log
    )
    submap = Submap.empty(0, camera.params)
    submap.map = slam_map
    results = FramePoser(camera, scaled).pose(submap, views, T_cw)
    _finalize(submap, camera, frames, T_cw)
    run = _run((submap,), camera, config, views, results, skipped, "")
    return Refined(run, given, rows, refined, rounds)


def _connected(
    views: list[FrameFeatures], T_cw: Tensor, camera: Camera, config: Config
) -> tuple[list[int], list[Pair], str]:
    """The rows of the keyframes, the pairs of these that see the same, and why there are none, in words."""
    if len(views) < MIN_KEYFRAMES:
        return [], [], f"no map: {len(views)} images with a pose are too few"
    chosen = choose_keyframes(views, camera.width, config)
    if len(chosen) < MIN_KEYFRAMES:
        return [], [], f"no map: nothing moves in the {len(views)} images"
    pairs = find_pairs([views[row] for row in chosen], T_cw[chosen], camera, config)
    if not pairs:
        return [], [], f"no map: no two of {len(chosen)} keyframes see the same"
    connected = largest_connected_part(pairs, len(chosen))
    return [chosen[row] for row in connected], _renumbered(pairs, connected), ""


def _finalize(submap: Submap, camera: Camera, frames: Tensor, T_cw: Tensor) -> None:
    """Everything once more as one graph, with covariances, and back to where the given poses T_cw of the frames are."""
    graph = submap.posed_frames.graph(submap.map, camera)
    submap.posed_frames.take(solve(graph, backward="detached"), graph, submap.map)
    row_of = {index: row for row, index in enumerate(frames.tolist())}
    posed = [row_of[index] for index in submap.posed_frames.frames["frame_index"].tolist()]
    submap.transform(align_to_input(submap.posed_frames.T_cw(submap.map), T_cw[posed]))


def _as_given(poses: GivenPoses | Trajectory | str | Path) -> GivenPoses:
    if isinstance(poses, Trajectory):
        if len(poses) == 0:
            raise TrajectoryError("a trajectory without poses")
        return GivenPoses(TUM, Path(), se3_inverse(poses.T_wc), poses.timestamps)
    return poses if isinstance(poses, GivenPoses) else read_poses(poses)


def _extract_features(
    sequence: Sequence, rows: Tensor, camera: Camera, extractor: Extractor | None
) -> tuple[list[FrameFeatures], list[str]]:
    """The views of the frames that have a pose, and those that could not be read, in words."""
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
) -> tuple[Map, Camera, Refinement | None, int]:
    """A map with the camera as known, the camera from the map, and again: a wrong one chooses its matches wrongly."""
    given, T_cw = camera, align_rotations(T_cw, pairs)
    tracks = join_matches(pairs, len(keyframes), len(keyframes[0].mask))
    rounds, refined = 0, None
    while True:
        is_free = choice is not CameraChoice.FIXED and camera is not given
        slam_map, camera = build_map(keyframes, T_cw, tracks, camera, config, free_focal=is_free)
        rounds += 1
        T_cw = slam_map.T_cw.clone()
        log(f"round {rounds}: {slam_map.num_points} points, focal length {float(camera.focal):.1f} px")
        if choice is CameraChoice.FIXED:
            return slam_map, camera, None, rounds
        refined = estimate_intrinsics(graph_of(slam_map, camera), given, radial)
        if not refined.is_determined or rounds == MAX_ROUNDS:
            return slam_map, camera, refined, rounds
        if choice is CameraChoice.IF_CONTRADICTED and not is_free and not contradiction(given, refined):
            return slam_map, camera, refined, rounds
        change = abs(math.log(float(refined.camera.focal) / float(camera.focal)))
        if is_free and change < max(MIN_CHANGE, MIN_CHANGE_IN_STD * refined.std):
            return slam_map, camera, refined, rounds
        camera = refined.camera


def largest_connected_part(pairs: list[Pair], count: int) -> list[int]:
    """The largest set of keyframes, ascending, that pairs connect; of equals the one with the first keyframe."""
    label = list(range(count))
    for _ in range(count):
        before = list(label)
        for pair in pairs:
            label[pair.first] = label[pair.second] = min(label[pair.first], label[pair.second])
        if label == before:
            break
    best = max(set(label), key=lambda part: (label.count(part), -part), default=0)
    return [row for row, part in enumerate(label) if part == best]


def _renumbered(pairs: list[Pair], kept: list[int]) -> list[Pair]:
    """The pairs among the keyframes that are kept, by their new rows."""
    row_of = {old: new for new, old in enumerate(kept)}
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


MAX_OUTLIER_RATIO = 4.0  # times the median: a given position so far off does not count


def align_to_input(T_cw: Tensor, given_cw: Tensor) -> Tensor:
    """S (4, 4) that leads from the world of poses T_cw (N, 4, 4) to that of the given ones (N, 4, 4).

    Centres and orientations count alike: centres on a line say nothing of the turn about it, and orientations nothing
    of the rest. Where the centres have no extent, the unit stays.
    """
    T_wc, given = se3_inverse(T_cw), se3_inverse(given_cw)
    counts = torch.ones(len(T_wc), dtype=torch.bool, device=T_wc.device)
    for _ in range(3):
        S = _similarity(T_wc[counts], given[counts])
        moved = T_wc[:, :3, 3] @ S[:3, :3].mT + S[:3, 3]
        off = torch.linalg.vector_norm(moved - given[:, :3, 3], dim=-1)
        counts = off <= MAX_OUTLIER_RATIO * off.median().clamp(min=1e-12)
    return S


def _similarity(T_wc: Tensor, given: Tensor) -> Tensor:
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
