"""From a recording to a result: frame by frame, the check, the recording as a whole where it fails, meters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path

import torch

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.global_mapping.check import MapCheck, check_map
from torchslam.global_mapping.image_choice import needs_keyframes
from torchslam.global_mapping.mapper import GlobalMapper, Progress, poses_of
from torchslam.global_mapping.saved_stages import SavedStages
from torchslam.global_mapping.view_graph import FAR, PairMatcher, ViewPair, similar_places
from torchslam.metric.source import MetricSource
from torchslam.optim.model_choice import SURE, predictive_gain
from torchslam.optim.scale_links import scale_links
from torchslam.system.front_end import KeptFeatures
from torchslam.system.metric_run import run_in_meters
from torchslam.system.online_run import OnlineRun
from torchslam.system.run import Run
from torchslam.tracking.matcher import make_matcher
from torchslam.types import Explanation, FrameFeatures, Reason, State, StepResult, Trajectory

FEW_POSED = 0.98
"""Share of the frames with a pose in the main submap below which a recording is mapped as a whole as well."""
CHECKED_DISTANCES = 1, 2, 4
"""Distances, in keyframes, of the pairs that check an online run."""
LOOP_MATCHES = 40
"""Verified matches of a pair of similar places that counts. On kitti07, which visits no place twice, three have 22 to
30; where places are visited again, most have more than 40 (machine_hall, office_loop)."""

LARGE_ZOOM = 0.03
"""Change of the logarithm of the focal length from which on a recording is processed again without it, or its frames
are doubtful: by less, the map is the same, and is adjusted to corrected keypoints. Tried at this value only."""
MOST_AGAIN = 2
"""Most times that it is processed again: after one, six of eleven rendered zooms by 1.4 are still off by more than 3 %.
Tried at 1 and 2."""
UNMEASURED = "interrupted; `torchslam align` measures later"
"""Why an interrupted run has an arbitrary unit."""
ASKED_FOR = "it was asked for"
"""Why a recording is mapped as a whole of which nothing was lost."""
KeyframePairs = tuple[list[FrameFeatures], list[ViewPair]]
"""Features of keyframes, and their verified pairs."""


class Mapping(StrEnum):
    """How a recording is mapped."""

    AUTO = "auto"
    """Online; then as a whole if frames were lost, or if the check contradicts the map."""
    ONLINE = "online"
    """Frame by frame, in the order of time."""
    GLOBAL = "global"
    """As a whole, and online before where the recording is long, or after where that map is not right."""


@dataclass(frozen=True)
class MappedRun(Run):
    """The run of a recording, and how its map was chosen.

    Attributes:
        kept: the mapping that the map is from; None: without a choice, as of a live source or an interrupted run.
        check: the check of the map; None without a map, or without image pairs.
        why: why the recording was mapped as a whole; empty if it was not.
        by_frame: the run frame by frame, where the map is of the recording as a whole; shorter if it stopped when
            tracking was lost.
    """

    kept: Mapping | None = None
    check: MapCheck | None = None
    why: str = ""
    by_frame: Run | None = None

    @classmethod
    def of(
        cls,
        run: Run,
        kept: Mapping | None = None,
        check: MapCheck | None = None,
        why: str = "",
        by_frame: Run | None = None,
    ) -> MappedRun:
        """The same run, with the frames that the check doubts called uncertain."""
        columns = {column.name: getattr(run, column.name) for column in fields(Run)}
        return cls(
            **columns | {"results": with_doubts(run.results, check)},
            kept=kept,
            check=check,
            why=why,
            by_frame=by_frame,
        )

    @property
    def online(self) -> Trajectory:
        """The poses that were returned frame by frame."""
        return super().online if self.by_frame is None else self.by_frame.online

    @property
    def online_parts(self) -> list[Trajectory]:
        """As of the run frame by frame, see `Run.online_parts`."""
        return super().online_parts if self.by_frame is None else self.by_frame.online_parts


def run_recording(
    online: OnlineRun,
    sequence: Sequence,
    mapping: Mapping | None = Mapping.AUTO,
    sources: Iterable[MetricSource] = (),
    device: torch.device | str = "cpu",
    stages: Path | None = None,
    features: KeptFeatures | None = None,
    all_frames: bool = False,
) -> MappedRun:
    """Process the frames of a recording, check the map, map the recording as a whole where needed, measure its unit.

    An interrupt keeps what there is: the run of the frames so far, or the online map, or a map in an arbitrary unit.

    Args:
        online: the run of its frames, which may have begun; its observer sees all stages.
        sequence: the recording, with its camera.
        mapping: when to map as a whole; None: never, without a check, as of a live source or a known map.
        sources: of meters.
        device: of torch.
        stages, features: as in `map_recording`.
        all_frames: whether all frames are processed online, even after tracking was lost.
    """
    sources, original = list(sources), sequence
    sequence = original.unzoomed(online.slam.zoom)
    for again in range(MOST_AGAIN, -1, -1):
        run = _mapped(online, sequence, mapping, device, stages, features, all_frames, may_end=again > 0)
        if mapping is None or run.interrupted or run.zoom is None or not _is_zoomed(run) or not again:
            break
        # Maps that were made with one focal length are wrong; features of zoomed images are elsewhere.
        online, sequence, features = online.anew(run.zoom), original.unzoomed(run.zoom), None
    if run.interrupted:
        return replace(run, unmeasured=(UNMEASURED,) if sources else ())
    if _is_zoomed(run):
        run = replace(run, results=with_doubtful_zoom(run))
    try:
        return run_in_meters(run, original.unzoomed(run.zoom), sources)
    except KeyboardInterrupt:
        return replace(run, interrupted=True, unmeasured=(UNMEASURED,) if sources else ())


def _mapped(
    online: OnlineRun,
    sequence: Sequence,
    mapping: Mapping | None,
    device: torch.device | str,
    stages: Path | None,
    features: KeptFeatures | None,
    all_frames: bool,
    may_end: bool,
) -> MappedRun:
    """Process the frames, check their map, and map the recording as a whole where needed; see `run_recording`.

    may_end: whether a zoom that is found in the frames ends it
    """
    config, observer = online.slam.config, online.observer
    known, most = sequence.known_length, config.global_mapping.window_images
    length = math.inf if known is None or all_frames else known  # of frames that may be left out
    if mapping is Mapping.GLOBAL and not needs_keyframes(length, most):
        run = MappedRun.of(online.begun)
    else:
        run = MappedRun.of(online.run(until_lost=mapping is Mapping.AUTO and length <= most))
    if mapping is None or run.interrupted or (may_end and _is_zoomed(run)):
        return run
    go_on = None if online.is_finished else online.run
    try:
        with observer.whole():
            camera = sequence.camera
            return map_recording(
                sequence,
                run,
                config,
                camera,
                mapping,
                device,
                observer.stage,
                stages,
                go_on,
                features,
                online.processes,
            )
    except KeyboardInterrupt:
        return replace(MappedRun.of(online.end()), interrupted=True)


def _is_zoomed(run: Run) -> bool:
    """Whether the focal length changed so much in the images of a run that its map is doubtful."""
    return run.found_zoom is not None and run.found_zoom.extent > LARGE_ZOOM


def with_doubtful_zoom(run: Run) -> list[StepResult]:
    """The results with frames whose focal length is another one than the map was made with called uncertain."""
    assert run.found_zoom is not None
    frames = torch.tensor([result.index for result in run.results], device="cpu")
    results = list[StepResult]()
    for result, ratio in zip(run.results, run.found_zoom.at(frames).tolist(), strict=True):
        if abs(math.log(ratio)) > LARGE_ZOOM and result.state is State.TRACKING:
            reasons = (Explanation(Reason.ZOOM, {"ratio": ratio - 1}),)
            result = replace(result, state=State.UNCERTAIN, reasons=reasons)
        results.append(result)
    return results


def map_recording(
    sequence: Sequence,
    online: Run,
    config: Config,
    camera: Camera,
    mapping: Mapping = Mapping.AUTO,
    device: torch.device | str = "cpu",
    progress: Progress = lambda stage, done, most: None,
    stages: Path | None = None,
    go_on: Callable[[], Run] | None = None,
    features: KeptFeatures | None = None,
    processes: int | None = 1,
) -> MappedRun:
    """Check an online run, and map its recording as a whole where that is wanted or needed.

    Args:
        sequence: the recording.
        online: a finished first session over it, or one that stopped when tracking was lost.
        config: of the run.
        camera: the given camera, with the error `config.camera.std`.
        mapping: when to map as a whole.
        device: of torch.
        progress: receives the stages.
        stages: folder in which features and pairs of images are saved, so that a run that is ended can go on; None:
            they are not saved.
        go_on: processes the other frames and returns the finished run, where `online` stopped; None: it is finished.
            It is called only where the map of the whole is not right: no run that was lost is better than a right one.
        features: those that were extracted before, by `features_to_keep`; None: there are none.
        processes: number of processes, this one included; None: the best number. The result is the same.
    """
    if mapping is Mapping.AUTO and stands_still(online.results):
        return MappedRun.of(online, Mapping.ONLINE)
    check, camera = None, camera.to(device)
    if go_on is None:
        why = _loss(online)
    else:
        is_lost = mapping is not Mapping.GLOBAL
        why = f"tracking was lost at frame {online.results[-1].index}" if is_lost else ASKED_FOR
    is_long = len(online.results) > config.global_mapping.window_images
    if not why or mapping is Mapping.ONLINE or is_long:
        progress("check", 0, 1)
        check = check_run(online)
        if not why and check is not None and not check.is_right:
            why = f"the check of the online map failed: {check.sentence()}"
    if mapping is Mapping.ONLINE or (mapping is Mapping.AUTO and not why):
        return MappedRun.of(online, Mapping.ONLINE, check)
    given = CameraMeasurement.of(camera.to(torch.float64), config.camera.std) if config.camera.std else None
    saved = SavedStages(stages, sequence, config, device)
    mapper = GlobalMapper(
        sequence,
        camera,
        config,
        given,
        device,
        progress=progress,
        saved=saved,
        kept=features,
        processes=processes,
    )
    made = mapper.run(online.results, online, _certain(online, check))
    reduction = mapper.config.features.reduction(camera.size)

    def checked(run: Run) -> MapCheck:
        own = run.camera.to(camera.params)
        poses = poses_of(run, made.views)
        links = None if run.failure else scale_links(run.graph, run.session)
        views = run.at_middle_row(made.views)
        return check_map(*poses, views, made.pairs, own, made.held_back, reduction, links)

    whole = None if made.run.failure else checked(made.run).doubting(made.doubtful)
    if go_on is not None:
        is_whole = len(made.run.trajectory) == len(made.run.results)
        if whole is not None and whole.is_right and is_whole:
            return MappedRun.of(made.run, Mapping.GLOBAL, whole, why, online)
        online = go_on()
        why = _loss(online) or why
    if whole is None:
        check = check_run(online) if check is None else check
        return MappedRun.of(online, Mapping.ONLINE, check, why)
    before = checked(online)
    if online.failure and not whole.is_right:
        # A camera that only turns, with a wrong focal length, makes maps that contradict themselves.
        return MappedRun.of(online, Mapping.ONLINE, None, why)
    gain = predictive_gain(whole.evidence, before.evidence, made.held_back_times)
    posed, before_posed = len(made.run.trajectory), len(online.trajectory)
    is_better = posed >= before_posed
    if abs(gain.sigmas) > SURE:
        is_better = gain.total > 0
    elif whole.is_right and not before.is_right:
        is_better = posed >= FEW_POSED * before_posed
    why = why or ASKED_FOR
    if is_better:
        return MappedRun.of(made.run, Mapping.GLOBAL, whole, why, online)
    return MappedRun.of(online, Mapping.ONLINE, before, why)


def stands_still(results: list[StepResult]) -> bool:
    """Whether every frame shows the same as the first one, so that no way of mapping has a baseline to map from."""
    reasons = [each.reason for result in results for each in result.reasons]
    return len(reasons) > 1 and reasons == [Reason.NEW_REFERENCE] + [Reason.STATIONARY] * (len(results) - 1)


def _loss(run: Run) -> str:
    """What was lost in a run; empty if nothing was."""
    if run.failure:
        return run.failure
    posed, frames = len(run.trajectory), len(run.results)
    if posed < FEW_POSED * frames:
        return f"{posed} of {frames} frames are posed in one map"
    lost = sum(result.state is State.LOST for result in run.results)
    return f"tracking was lost in {lost} frames" if lost else ""


def _certain(run: Run, check: MapCheck | None) -> frozenset[int]:
    """The frames that neither a run nor its check doubts; none without a check."""
    if check is None:
        return frozenset()
    return frozenset(each.index for each in with_doubts(run.results, check) if each.state is State.TRACKING)


def check_run(run: Run, matched: KeyframePairs | None = None) -> MapCheck | None:
    """Check the main submap of a run by pairs of its keyframes; None if there is nothing to check.

    matched: `keyframe_pairs` of the run, whatever its poses were then; None: the keyframes are matched now.
    """
    found = keyframe_pairs(run) if matched is None else matched
    if found is None:
        return None
    T_cw = run.map.T_cw[run.map.keyframe_rows(run.session)]
    known = torch.ones(len(T_cw), dtype=torch.bool, device="cpu")
    reduction = run.config.features.reduction(run.camera.size)
    return check_map(T_cw, known, *found, run.camera, None, reduction, scale_links(run.graph, run.session))


@torch.no_grad()
def keyframe_pairs(run: Run) -> KeyframePairs | None:
    """Features of the keyframes of the main submap, and their verified pairs; None for fewer than three."""
    rows = run.map.keyframe_rows(run.session).tolist()
    if len(rows) < 3 or run.config.features.kind == "simulated":
        return None
    views = [run.map.frame_features(row) for row in rows]
    config, count = run.config, len(rows)
    matcher = make_matcher(config.matching, None, run.camera.size, config.features.kind)
    near = [(row, row + step) for row in range(count) for step in CHECKED_DISTANCES if row + step < count]
    found = PairMatcher(views, run.camera, matcher, config).match(near + similar_places(views))
    pairs = [pair for pair in found if pair.second - pair.first < FAR or len(pair) >= LOOP_MATCHES]
    return views, pairs


def with_doubts(results: list[StepResult], check: MapCheck | None) -> list[StepResult]:
    """The results with the frames that the check doubts, and those up to the next checked one, called uncertain."""
    if check is None or not check.uncertain:
        return results
    doubted, found = False, list[StepResult]()
    uncertain = set(check.uncertain)
    certain = set(check.certain)
    for result in results:
        if result.index in uncertain or result.index in certain:
            doubted = result.index in uncertain
        if doubted and result.state is State.TRACKING:
            result = replace(result, state=State.UNCERTAIN, reasons=(Explanation(Reason.WEAK_LINK),))
        found.append(result)
    return found
