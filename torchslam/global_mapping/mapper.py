"""The global mapper: from a recording and its online run to a run like any other."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from collections.abc import Sequence as Rows
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.config import Config
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError, FrameError
from torchslam.geometry import Camera, SensorModel
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.rolling_shutter import Readout
from torchslam.global_mapping.check import MapCheck, check_map
from torchslam.global_mapping.coarse import CoarseMap, CoarseMapper
from torchslam.global_mapping.frames_between import FollowedViews, pose_frames
from torchslam.global_mapping.image_choice import choose_images, overlapping_views
from torchslam.global_mapping.links import (
    MIN_LEARNED_MATCHES,
    LearnedPairs,
    Links,
    learned_config,
    open_links,
    pairs_around,
    strengthen,
    with_learned,
)
from torchslam.global_mapping.rounds import (
    MIN_VIEWS,
    ObservedTracks,
    Reconstruction,
    adjust_in_rounds,
)
from torchslam.global_mapping.saved_stages import SavedStages
from torchslam.global_mapping.tracks import keypoints_of_tracks, make_map, without_empty_rows
from torchslam.global_mapping.view_graph import PairMatcher, ViewPair, build_view_graph
from torchslam.global_mapping.windows import (
    KnownPoses,
    MappedWindow,
    join_windows,
    pairs_kept,
    pairs_that_hold,
    pairs_within,
    split,
)
from torchslam.map.atlas import Atlas
from torchslam.map.map import Map
from torchslam.mapping.local_bundle import squared_errors
from torchslam.optim.model_choice import predictive_gain
from torchslam.parallel.pool import SharedTasks
from torchslam.parallel.workers import busy_elsewhere, processors
from torchslam.system.final_adjustment import FinalAdjustment
from torchslam.system.front_end import (
    Extractor,
    FeatureExtractor,
    KeptFeatures,
    check_size,
    image_extractor,
    source,
)
from torchslam.system.run import Run, joined_zoom
from torchslam.tracking.matcher import DescriptorMatcher, make_matcher, prepare_view
from torchslam.types import Explanation, Frame, FrameFeatures, Reason, State, StepResult
from torchslam.utils.memory import return_freed_memory

SIFT_RATIO, SIFT_DISTANCE = 0.64, 0.245
"""Ratio test and largest distance of SIFT's descriptors, as 1 - cosine: COLMAP's 0.8 and 0.7 between unit vectors."""
HELD_BACK = 10
"""One in this many verified pairs is held out from mapping, for the check of the map."""
HELD_BACK_DISTANCE = 2
"""Least distance in images of pairs that are held back: pairs of neighbors keep the images together."""
SAVED_TOGETHER = 50
"""Images whose features are saved in one file of up to 80 MB. As many, some seconds of work, are lost if a run is
killed. Tried at this value only."""

Tried = dict[tuple[int, int], ViewPair | None]
"""The pairs of frames that were matched, None for those that do not hold."""
Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, what is done of it, and all that is to be done."""


@dataclass(frozen=True)
class GlobalMap:
    """The result of global mapping.

    Attributes:
        run: a run like any other; without a submap where `run.failure` has the reason.
        views: features of the images that were mapped, by row, learned ones included; without descriptors.
        pairs: all verified pairs of them.
        held_back: rows of the held-out pairs.
        doubtful: frames of images that only learned features hold, in a map that pairs contradict somewhere.
    """

    run: Run
    views: list[FrameFeatures]
    pairs: list[ViewPair]
    held_back: frozenset[int]
    doubtful: frozenset[int] = frozenset()

    @property
    def held_back_times(self) -> Float[Tensor, " U"]:
        """The middle of the two images of each held-out pair, seconds."""
        return middle_times(self.views, self.pairs, self.held_back)


def middle_times(
    views: Rows[FrameFeatures], pairs: Rows[ViewPair], chosen: Collection[int]
) -> Float[Tensor, " U"]:
    """The middle between the times of the two images of chosen pairs, seconds, in the order of their rows."""
    times = [
        0.5 * (views[pairs[row].first].timestamp + views[pairs[row].second].timestamp)
        for row in sorted(chosen)
    ]
    return torch.tensor(times, dtype=torch.float64, device="cpu")


Reconstructed = tuple[Int[Tensor, " K"], ObservedTracks, Reconstruction]
"""Rows of the views that have a pose, the tracks in all views, and the reconstruction."""


def mapping_config(config: Config) -> Config:
    """The configuration of global mapping: SIFT in place of the default features, unless others were chosen."""
    settings = config.global_mapping
    if config.features.kind != Config().features.kind:
        return config
    features = replace(
        config.features,
        kind="sift",
        num_keypoints=settings.num_keypoints,
        max_image_pixels=settings.max_image_pixels,
    )
    return replace(
        config,
        features=features,
        matching=replace(config.matching, max_ratio=SIFT_RATIO, max_cosine_distance=SIFT_DISTANCE),
    )


def features_to_keep(
    config: Config, size: tuple[int, int], least: int, device: torch.device | str = "cpu"
) -> KeptFeatures | None:
    """The features of global mapping for images of a size, where the search for a camera can use them as well.

    None where features are not SIFT's, fewer than `least`, or of reduced images, which both reduce to different sizes.
    """
    mapping = mapping_config(config)
    reductions = {settings.features.reduction(size) for settings in (config, mapping)}
    if mapping.features.kind != "sift" or mapping.features.num_keypoints < least or reductions != {1.0}:
        return None
    return KeptFeatures(image_extractor(mapping, device))


class GlobalMapper:
    """Maps the frames of a recording, all at once.

    Args:
        sequence: the recording.
        camera: of all frames.
        config: the configuration of the run.
        given: the camera with its error; None: it is exact.
        device: of torch.
        extractor: feature extractor; the configured one if None.
        progress: receives stages.
        saved: the costly stages of a run that was ended, and of this one; None: they are not saved.
        kept: features that were extracted before, by `features_to_keep`; None: there are none.
        processes: number of processes, this one included; None: the best number. The result is the same.
    """

    def __init__(
        self,
        sequence: Sequence,
        camera: Camera,
        config: Config,
        given: CameraMeasurement | None,
        device: torch.device | str = "cpu",
        extractor: FeatureExtractor | None = None,
        progress: Progress = lambda stage, done, most: None,
        saved: SavedStages | None = None,
        kept: KeptFeatures | None = None,
        processes: int | None = 1,
    ) -> None:
        self.camera = camera.to(device).to(torch.float64)
        self.config = mapping_config(config)
        self.given = given
        self.sequence = source(sequence, self.config, self.camera)
        self.extract: Extractor | None = None
        if not self.sequence.brings_features:
            self.extract = kept.taken if kept else image_extractor(self.config, device, extractor)
        self.matcher = make_matcher(self.config.matching, None, camera.size, self.config.features.kind)
        self.progress = progress
        self.saved = saved or SavedStages(None, self.sequence, config)
        self.processes = processes
        self.skipped: list[str] = []
        self.readout: Readout | None = None  # by which the keypoints of images are corrected

    @torch.no_grad()
    def run(
        self,
        results: Rows[StepResult] = (),
        before: Run | None = None,
        certain: Collection[int] = frozenset(),
    ) -> GlobalMap:
        """Map the recording.

        Args:
            results: of an online run over it, whose doubtful frames are mapped as well.
            before: that run, whose readout and velocities correct keypoints for a rolling shutter.
            certain: frames that nothing casts doubt on: of a long recording, windows of these alone keep their poses.
        """
        if learned_config(self.config) is not None and self.extract is None:
            raise ConfigError(
                "global_mapping.learned_links requires images; the recording has precomputed features"
            )
        images = choose_images(len(self.sequence), results, self.config.global_mapping.window_images)
        tried: Tried = {}
        views = overlapping_views(images, self._saved_views, partial(self._neighbors, tried))
        if before is not None:
            views, self.readout = before.at_middle_row(views), before.readout
        if self.readout is not None:  # keypoints are elsewhere now
            tried.clear()
        if len(views) < MIN_VIEWS:
            return self._failed(f"no map: {len(views)} images are too few", views, [])
        matcher = PairMatcher(views, self.camera, self.matcher, self.config)
        pairs = build_view_graph(matcher, partial(self.progress, "matches"), partial(self._matched, tried))
        return_freed_memory()
        held_back = choose_held_back(pairs)
        used = [pair for row, pair in enumerate(pairs) if row not in held_back]
        known = None if before is None else known_poses(before, certain, views)
        found = self.reconstruct(views, used, known=known)
        if isinstance(found, str):
            return self._failed(found, views, pairs)
        doubtful: frozenset[int] = frozenset()
        learned = self._learned(views, open_links(*found[1:]), before)
        if learned is not None:
            every, left_out = pairs + learned.pairs, choose_held_back(learned.pairs)
            kept = [pair for row, pair in enumerate(learned.pairs) if row not in left_out]
            left_out = held_back | {len(pairs) + row for row in left_out}
            tied = self.reconstruct(views, used, LearnedPairs(learned.views, kept), known)
            if not isinstance(tied, str):
                first, after = (self._check(made, learned.views, every, left_out) for made in (found, tied))
                times = middle_times(learned.views, every, left_out)
                if predictive_gain(after.evidence, first.evidence, times).is_sure:
                    added = set(tied[0].tolist()) - set(found[0].tolist())
                    doubtful = frozenset() if after.is_right else frozenset(views[row].index for row in added)
                    found, views, pairs, held_back = tied, learned.views, every, left_out
        return_freed_memory()
        posed = self.posed(views, *found)
        # Nothing is matched from here on, and descriptors are most of the memory.
        views = [replace(view, descriptors=view.descriptors.new_empty(len(view.mask), 0)) for view in views]
        del matcher, found, learned
        run = self.adjusted(*posed)
        return GlobalMap(run, views, pairs, held_back, doubtful)

    def _check(
        self,
        made: Reconstructed,
        views: list[FrameFeatures],
        pairs: list[ViewPair],
        held_back: frozenset[int],
    ) -> MapCheck:
        rows, _, found = made
        known = torch.zeros(len(views), dtype=torch.bool, device=rows.device).index_fill(0, rows, True)
        reduction = self.config.features.reduction(self.camera.size)
        return check_map(found.T_cw, known, views, pairs, found.camera, held_back, reduction)

    def _learned(self, views: list[FrameFeatures], links: Links, before: Run | None) -> LearnedPairs | None:
        """Views and pairs with learned features around links; None if not asked for, or if nothing holds."""
        config = learned_config(self.config)
        if config is None or not links:
            return None
        own = GlobalMapper(self.sequence, self.camera, config, self.given, self.camera.params.device)
        ends = pairs_around(links)
        found: dict[int, FrameFeatures] = {}
        for row in sorted({row for pair in ends for row in pair}):
            self.progress("learned features", len(found), len(views))
            view = own.view(views[row].index)
            if view is not None:
                found[row] = view if before is None else before.at_middle_row([view])[0]
        matcher = PairMatcher(
            [found.get(row, view) for row, view in enumerate(views)], self.camera, own.matcher, own.config
        )
        self.progress("learned matches", 0, 1)
        pairs = matcher.match((one, other) for one, other in ends if one in found and other in found)
        pairs = [pair for pair in pairs if len(pair) >= MIN_LEARNED_MATCHES]
        return with_learned(views, found, pairs) if pairs else None

    def reconstruct(
        self,
        views: list[FrameFeatures],
        pairs: list[ViewPair],
        learned: LearnedPairs | None = None,
        known: KnownPoses | None = None,
    ) -> Reconstructed | str:
        """Map the largest set of views that pairs connect: coarsely, together or in windows, then all exactly.

        Args:
            views: images.
            pairs: verified pairs of them.
            learned: more keypoints of the same images, with verified pairs.
            known: poses that windows without a doubtful image keep until all are adjusted; None: there are none.

        Returns:
            The rows of the views that have a pose, the tracks in all views, and the reconstruction; or the reason why
            there is no map.
        """
        matcher, more = PairMatcher(views, self.camera, self.matcher, self.config), list[ViewPair]()
        if learned is not None:
            views, more = learned
        windows = split(len(views), self.config.global_mapping.window_images)
        coarse = CoarseMapper(self.camera, self.given, matcher.threshold_px, self.progress)
        begun = (
            coarse.map(views, pairs, more)
            if len(windows) == 1
            else self._map_in_windows(coarse, windows, views, pairs, more, known)
        )
        if isinstance(begun, str):
            return begun
        T_cw, camera = begun.found.T_cw, begun.found.camera
        self.progress("weak links", 0, 1)
        used = strengthen(matcher, begun.pairs, T_cw, camera) + begun.learned + begun.unposed
        observed = ObservedTracks.join(used, views)
        found = adjust_in_rounds(observed, T_cw, self.given, camera, False, self._log)
        seen = torch.unique(observed.tracks.view[found.agrees])
        if len(seen) < MIN_VIEWS:
            return f"no map: {len(views)} images agree on no points; the camera may only turn"
        return seen, observed, found

    def _map_in_windows(
        self,
        coarse: CoarseMapper,
        windows: list[range],
        views: list[FrameFeatures],
        pairs: list[ViewPair],
        learned: list[ViewPair],
        known: KnownPoses | None,
    ) -> CoarseMap | str:
        """Map windows of views, each in one of the processes, and give them a common world."""
        slim = [replace(view, descriptors=view.descriptors[:, :0]) for view in views]
        tasks = [
            (
                window,
                slim[window.start : window.stop],
                pairs_within(pairs, window),
                pairs_within(learned, window),
                None if known is None else known.of(window),
            )
            for window in windows
        ]
        parts = self.saved, CoarseMapper(self.camera, self.given, coarse.threshold_px)
        found = dict[int, MappedWindow | str]()
        with SharedTasks(map_window, parts, min(self._processes(), len(windows)), ahead=1) as shared:
            self.progress("windows", 0, len(windows))
            for number, made in shared.run(tasks):
                found[number] = made
                self.progress("windows", len(found), len(windows))
        ordered = [found[number] for number in range(len(windows))]
        mapped = [made for made in ordered if isinstance(made, MappedWindow)]
        if not mapped:
            return next(made for made in ordered if isinstance(made, str))
        self.progress("joining", 0, 1)
        T_cw, is_posed = join_windows(mapped, pairs + learned, views)
        own, more = (
            pairs_that_hold(pairs_kept(every, windows, (made.kept[at] for made in mapped)), T_cw, is_posed)
            for at, every in enumerate((pairs, learned))
        )
        camera = max(mapped, key=lambda part: int(part.found.agrees.sum())).found.camera
        posed = set(is_posed.nonzero()[:, 0].tolist())
        unposed = [pair for pair in pairs + learned if not {pair.first, pair.second} <= posed]
        return coarse.adjust(views, own, more, T_cw, camera, unposed)

    def _processes(self) -> int:
        """The number of processes that map windows, this one included."""
        if self.camera.params.device.type != "cpu":
            return 1
        return self.processes or max(1, processors() - busy_elsewhere())

    def _log(self, words: str) -> None:
        self.progress(words, 0, 1)

    def posed(
        self,
        views: list[FrameFeatures],
        rows: Int[Tensor, " K"],
        observed: ObservedTracks,
        found: Reconstruction,
        frames: Rows[int] | None = None,
        given_cw: dict[int, Float[Tensor, "4 4"]] | None = None,
    ) -> tuple[Atlas, SensorModel, list[StepResult]]:
        """The map of the posed views, and the other frames in it, before the final adjustment.

        Args:
            views: of the mapped images.
            rows: of the views that have a pose.
            observed, found: the tracks, and poses, camera and points.
            frames: to be posed, all if None.
            given_cw: poses of these frames by another program, by frame.
        """
        atlas = Atlas(self.camera.params)
        submap = atlas.create()
        tracks, former = observed.tracks.select(found.agrees)
        row_of = torch.full((len(views),), -1, device=rows.device)
        row_of[rows] = torch.arange(len(rows), device=rows.device)
        tracks = replace(tracks, view=row_of[tracks.view])
        own, tracks = keypoints_of_tracks([views[row] for row in rows.tolist()], tracks)
        submap.map = make_map(own, found.T_cw[rows], tracks, found.points_w[former])
        submap.map.set_noise(squared_errors(submap.map, submap.map.observations(), found.camera))
        sensor = SensorModel(found.camera, self.readout)
        views = own + [view for view, row in zip(views, row_of.tolist(), strict=True) if row < 0]
        followed = self._followed(views, submap.map)
        every = self._all_views(range(len(self.sequence)) if frames is None else frames, views, followed)
        again = None if followed is None else followed.again
        return atlas, sensor, pose_frames(submap, every, sensor, self.config, given_cw, again)

    def adjusted(
        self, atlas: Atlas, sensor: SensorModel, results: list[StepResult], keep: bool = False
    ) -> Run:
        """The run of posed frames after the final adjustment; `keep`: with poses and camera as they are, instead."""
        final = FinalAdjustment(sensor, self.config, self.given, self.sequence.zoom)
        if not keep:
            final.adjust(atlas, 0, partial(self.progress, "final adjustment"), settled=True)
        return Run(
            tuple(atlas),
            final.sensor,
            self.config,
            results,
            self.skipped,
            False,
            "",
            given=final.given,
            calibration=final.calibration,
            shutter=final.shutter,
            zoom=joined_zoom(self.sequence.zoom, final.zoom),
            read_zoom=self.sequence.zoom,
        )

    def _neighbors(self, tried: Tried, views: list[FrameFeatures], rows: list[int]) -> list[ViewPair]:
        """The pairs of views and the next ones that hold, of some rows."""
        matcher = PairMatcher(views, self.camera, self.matcher, self.config)
        return self._matched(tried, matcher, [(row, row + 1) for row in rows])

    def _matched(
        self, tried: Tried, matcher: PairMatcher, pairs: Iterable[tuple[int, int]]
    ) -> list[ViewPair]:
        """The pairs that hold, in the given order; those that were tried before are not matched again."""
        frames = {ends: (matcher.views[ends[0]].index, matcher.views[ends[1]].index) for ends in pairs}
        new = {ends: key for ends, key in frames.items() if key not in tried}
        held = {(pair.first, pair.second): pair for pair in self.saved.pairs(matcher, new)}
        tried |= {key: held.get(ends) for ends, key in new.items()}
        found = ((ends, tried[key]) for ends, key in frames.items())
        return [replace(pair, first=ends[0], second=ends[1]) for ends, pair in found if pair is not None]

    def _saved_views(self, images: list[int]) -> list[FrameFeatures]:
        """The features of the images that can be read, saved in groups."""
        views: list[FrameFeatures | None] = []

        def find(own: list[int]) -> list[FrameFeatures | None]:
            found: list[FrameFeatures | None] = []
            for done, index in enumerate(own, len(views)):
                self.progress("features", done, len(images))
                found.append(self.view(index))
            return found

        for start in range(0, len(images), SAVED_TOGETHER):
            own = images[start : start + SAVED_TOGETHER]
            views += self.saved.views(own, partial(find, own))
        return [view for view in views if view is not None]

    def view(self, index: int) -> FrameFeatures | None:
        """The features of a frame; None if it cannot be read, which is counted once."""
        frame = self._frame(index)
        if frame is None:
            return None
        features = frame.features
        if self.extract is not None:
            with torch.inference_mode():
                features = self.extract(frame)
        assert features is not None
        view = prepare_view(FrameFeatures.of(frame, features, self.camera.params), frame, self.matcher)
        return without_empty_rows(view)

    def _frame(self, index: int) -> Frame | None:
        """A frame; None if it cannot be read, which is counted once."""
        try:
            frame = self.sequence[index]
            if frame.features is None or frame.image.numel():
                check_size(frame, self.camera)
        except FrameError as error:
            if str(error) not in self.skipped:
                warnings.warn(f"skipped a frame: {error}", stacklevel=2)
                self.skipped.append(str(error))
            return None
        return frame

    def _all_views(
        self, frames: Rows[int], views: list[FrameFeatures], followed: FollowedViews | None
    ) -> Iterator[FrameFeatures]:
        """Frames in order: those that were mapped, and those between them."""
        mapped = {view.index: view for view in views}
        found: Iterable[FrameFeatures | None] = (mapped.get(index) or self.view(index) for index in frames)
        if followed is not None:
            found = followed.of(frames)
        for done, view in enumerate(found):
            self.progress("frames between", done, len(frames))
            if view is not None:
                yield view

    def _followed(self, views: list[FrameFeatures], slam_map: Map) -> FollowedViews | None:
        """The views between keyframes; None without images, or where the matcher needs more than descriptors."""
        if self.extract is None or not isinstance(self.matcher, DescriptorMatcher):
            return None
        keyframes = slam_map.keyframes
        points = zip(keyframes["frame_index"].tolist(), keyframes["point_ids"], strict=True)
        with_point = {index: ids >= 0 for index, ids in points if bool((ids >= 0).any())}
        reduction = self.config.features.reduction(self.camera.size)
        mapped = {view.index: view for view in views}
        return FollowedViews(self._frame, self.view, mapped, with_point, reduction)

    def _failed(self, reason: str, views: list[FrameFeatures], pairs: list[ViewPair]) -> GlobalMap:
        reasons = (Explanation.of(Reason.OTHER, text=reason),)
        results = [
            StepResult(view.index, view.timestamp, State.LOST, None, reasons=reasons) for view in views
        ]
        run = Run((), SensorModel(self.camera), self.config, results, self.skipped, False, reason)
        return GlobalMap(run, views, pairs, frozenset())


def map_window(
    saved: SavedStages,
    coarse: CoarseMapper,
    window: range,
    views: list[FrameFeatures],
    pairs: list[ViewPair],
    learned: list[ViewPair],
    known: KnownPoses | None,
) -> MappedWindow | str:
    """Map a window of images, or read the map that an earlier run saved; the reason where there is none.

    With known poses it enters as it is, unless the images do not agree with them.
    """
    made: CoarseMap | str | None = None if known is None else coarse.keep(known, views, pairs, learned)
    if made is None:
        made = saved.window(views, pairs, learned, coarse.camera, coarse.map)
    if isinstance(made, str):
        return made
    kept = tuple(
        frozenset((pair.first + window.start, pair.second + window.start) for pair in every)
        for every in (made.pairs, made.learned)
    )
    return MappedWindow(made.observed, made.found, window.start, kept)


def known_poses(run: Run, certain: Collection[int], views: list[FrameFeatures]) -> KnownPoses:
    """The poses of views in the main submap of a run; `certain`: frames that nothing casts doubt on."""
    T_cw, is_posed = poses_of(run, views)
    is_certain = torch.tensor([view.index in certain for view in views], dtype=torch.bool, device="cpu")
    return KnownPoses(T_cw, is_posed & is_certain, run.camera)


def choose_held_back(pairs: list[ViewPair]) -> frozenset[int]:
    """Rows of the pairs that mapping does not use: one in ten of those that are no direct neighbors in time."""
    far = [row for row, pair in enumerate(pairs) if pair.second - pair.first >= HELD_BACK_DISTANCE]
    return frozenset(far[HELD_BACK // 2 :: HELD_BACK])


def poses_of(run: Run, views: list[FrameFeatures]) -> tuple[Float[Tensor, "K 4 4"], Tensor]:
    """The poses of views in the main submap of a run, and which have one."""
    T_cw = torch.eye(4, dtype=torch.float64, device=run.camera.params.device).repeat(len(views), 1, 1)
    known = torch.zeros(len(views), dtype=torch.bool, device="cpu")
    if run.main is None:
        return T_cw, known
    frames = run.posed_frames
    own = frames.frames["session"] == run.session
    posed = dict(zip(frames.frames["frame_index"][own].tolist(), frames.T_cw(run.map)[own], strict=True))
    for row, view in enumerate(views):
        if view.index in posed:
            T_cw[row], known[row] = posed[view.index], True
    return T_cw, known
