"""Local and global bundle adjustment of a map: the window, its solution, outlier removal, asynchronous adjustment.

Local bundle adjustment frees the newest keyframe, the most covisible ones and their points; other keyframes that
observe these points are fixed. `AsyncBundleAdjustment` requests it for one keyframe and applies the result some frames
later, so that another process can solve it meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchslam.geometry import CHI_SQUARE_95, Camera, SharedCamera, passes_gate, transform
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.robust import middle_variance
from torchslam.geometry.similarity import in_place_of
from torchslam.map.map import Map
from torchslam.map.observation_index import top_rows
from torchslam.optim import BUNDLE_OPTIONS, BundleProblem, Progress, solve_bundle
from torchslam.optim.bundle.dense_numpy import solve_bundle_numpy
from torchslam.optim.observation_graph import camera_prior
from torchslam.types import Observations
from torchslam.utils.indexing import distinct, is_among, ranks_among, true_indices

LOCAL_WINDOW = 8
"""Keyframes with free poses in a local adjustment. Tried at this value only."""
MAX_FIXED_KEYFRAMES = 12
"""Fixed keyframes of a local adjustment at most. Tried at this value only."""
LOCAL_ITERATIONS, GLOBAL_ITERATIONS = 6, 15
"""Iterations of a local and of a global adjustment at most. Tried at these values only."""
LOCAL_TOLERANCE = 1e-4
"""Predicted relative reduction of the cost that ends a local adjustment; the next keyframe moves the map by more."""
WHOLE_TOLERANCE = 1e-2
"""The same for the whole map by another camera, which the local adjustments refine. Of six such maps of redkitchen, 14
to 79 keyframes, the poses are then at 73 to 100 % of their way to those by 1e-4, in 40 to 70 % of the time."""
HUBER = CHI_SQUARE_95**0.5
"""Whitened residual at which the kernel leaves its quadratic part: the 95 % quantile for two dimensions, 2.45."""
MAP_OPTIONS = BUNDLE_OPTIONS.replace(kernel="huber", scale=HUBER, backward="detached")
"""Of adjustments of a whole map."""


@dataclass(frozen=True)
class BundleWindow:
    """A part of the map that is adjusted at once: ascending rows of keyframes and points, and their observations."""

    keyframes: Int[Tensor, " K"]
    point_ids: Int[Tensor, " N"]
    seen: Observations
    problem: BundleProblem


Solution = tuple[Float[Tensor, "K 4 4"], Float[Tensor, "N 3"]]
"""Poses and points of a solved window."""
Solver = Callable[..., Callable[[], Any]]
"""Starts a pure function of a module, given with its arguments; the result waits for what it returns."""


def select_window(slam_map: Map, keyframe: int, camera: Camera) -> BundleWindow | None:
    """Select a keyframe, the keyframes most covisible with it and their points; None if there is nothing to adjust.

    Other keyframes that observe these points are fixed, and so is the first keyframe of the map.
    """
    free = slam_map.neighborhood(keyframe, LOCAL_WINDOW - 1)
    free = free[free != 0]
    shared = slam_map.count_observed(slam_map.observed_points(free))
    shared[free] = 0
    fixed = top_rows(shared, MAX_FIXED_KEYFRAMES, least=1)
    return build_window(slam_map, free, fixed, camera)


def solve_local(problem: BundleProblem, iterations: int) -> Solution:
    """Solve a local bundle adjustment; fixed poses count as exact. A pure function that any process may call."""
    T_cw, points_w, _ = solve_bundle_numpy(problem, HUBER, iterations, LOCAL_TOLERANCE)
    return T_cw, points_w


def solve_whole(problem: BundleProblem, iterations: int) -> Solution:
    """Solve the adjustment of a whole map, in place and unit of the map as it was. A pure function as `solve_local`.

    With it go the frames in between, and the poses that follow.
    """
    options = MAP_OPTIONS.replace(iterations=iterations, tolerance=WHOLE_TOLERANCE)
    found = solve_bundle(problem, check=False, options=options)
    return in_place_of(problem.T_cw, found.T_cw, found.points_w)


def adjust_all(
    slam_map: Map,
    camera: Camera,
    progress: Progress | None = None,
    calibration: CameraMeasurement | None = None,
    tolerance: float = BUNDLE_OPTIONS.tolerance,
) -> Camera:
    """Run a global bundle adjustment with the first keyframe fixed; return the camera of the adjusted map.

    Args:
        progress: Called before each iteration; if it raises, the map stays as it was.
        calibration: The given camera with its error: the camera is adjusted as well; None: it is exact.
        tolerance: Predicted relative reduction of the cost that ends it.
    """
    window = whole_window(slam_map, camera)
    if window is None:
        return camera
    problem, free = window.problem, False if calibration is None else calibration.directions
    if calibration is not None:
        problem = replace(problem, camera_prior=camera_prior(calibration))
    options = MAP_OPTIONS.replace(iterations=GLOBAL_ITERATIONS, tolerance=tolerance)
    solution = solve_bundle(problem, free_camera=free, progress=progress, check=False, options=options)
    camera = camera if calibration is None else solution.camera
    apply_solution(slam_map, window, solution.T_cw, solution.points_w, camera)
    return camera


def whole_window(slam_map: Map, camera: Camera) -> BundleWindow | None:
    """The problem of all keyframes, with the first one fixed; None if nothing is observed."""
    everyone = torch.arange(slam_map.num_keyframes, device=slam_map.T_cw.device)
    return build_window(slam_map, everyone[1:], everyone[:1], camera)


def build_window(
    slam_map: Map, free: Int[Tensor, " K"], fixed: Int[Tensor, " R"], camera: Camera
) -> BundleWindow | None:
    """Build the problem of free keyframes, their points and the fixed keyframes; None if nothing is observed."""
    keyframes = torch.sort(torch.cat([free, fixed])).values
    seen = slam_map.observations(keyframes)
    rows = true_indices(is_among(seen.point_index, slam_map.observed_points(free)))
    ids = seen.point_index.index_select(0, rows)
    which = ranks_among(ids, distinct(ids))
    seen = select(seen, rows[torch.bincount(which)[which] >= 2])
    if len(seen) == 0:
        return None
    point_ids = distinct(seen.point_index)
    problem = BundleProblem(
        slam_map.T_cw[keyframes],
        slam_map.positions_w[point_ids],
        torch.searchsorted(keyframes, seen.keyframe_index),
        ranks_among(seen.point_index, point_ids),
        seen.pixels,
        camera,
        weights=seen.noise.weights,
        fixed_frames=torch.isin(keyframes, fixed),
    )
    return BundleWindow(keyframes, point_ids, seen, problem)


def apply_solution(
    slam_map: Map,
    window: BundleWindow,
    T_cw: Float[Tensor, "K 4 4"],
    points_w: Float[Tensor, "N 3"],
    camera: Camera,
) -> None:
    """Move a window of the map to its solution and remove outlier observations.

    Since the window was built, only the frame counters of the map may have changed.
    """
    slam_map.keyframes["T_cw"][window.keyframes] = T_cw
    slam_map.points["positions_w"][window.point_ids] = points_w
    remove_outliers(slam_map, window.seen, camera)
    slam_map.update_appearance(window.keyframes)


def remove_outliers(slam_map: Map, seen: Observations, camera: Camera) -> None:
    """Remove observations that fail the chi-square test, and points that fewer than two keyframes still observe.

    Update the noise of the map before.
    """
    squared = squared_errors(slam_map, seen, camera)
    slam_map.update_noise(squared)
    slam_map.remove_masked_observations(seen, ~passes_gate(squared))


def squared_errors(slam_map: Map, seen: Observations, camera: Camera) -> Float[Tensor, " O"]:
    """Squared reprojection errors in units of the stated noise."""
    points_c = transform(slam_map.T_cw[seen.keyframe_index], slam_map.positions_w[seen.point_index][:, None])
    return seen.noise.squared_reprojection(points_c[:, 0], seen.pixels, camera)


def noise_variance(slam_map: Map, camera: Camera) -> float:
    """Estimate the variance of the keypoints of an adjusted map, in units of the stated one, by all observations."""
    seen = slam_map.observations()
    squared = squared_errors(slam_map, seen, camera) * seen.noise.gate_factor**2
    unknowns = 6 * slam_map.num_keyframes + 3 * len(distinct(seen.point_index))
    redundancy = 1 - unknowns / max(2 * len(seen), 1)
    return middle_variance(squared, redundancy)


def select(seen: Observations, rows: Int[Tensor, " R"]) -> Observations:
    """Select observations by index."""
    columns = (getattr(seen, name) for name in Observations.__dataclass_fields__)
    return Observations(*(column.index_select(0, rows) for column in columns))


class ApplyAt(Enum):
    """When the result of a local bundle adjustment is applied to the map."""

    NOW = "now"
    BEFORE_NEXT_FRAME = "before the next frame is tracked"
    AFTER_DELAY = "after `mapper.DELAY_FRAMES` more frames"


@dataclass
class _Adjustment:
    """A requested adjustment; `on_applied` is called once the map is adjusted."""

    due: int | None  # the frame after which it is applied; None: before the next frame
    slam_map: Map
    keyframe: int | None  # around which to adjust; None: the whole map
    camera: Camera
    version: int  # of the map at the time of the request
    on_applied: Callable[[], None] = lambda: None
    window: BundleWindow | None = None  # once it was started; None as well if there is nothing to adjust
    solution: Callable[[], Solution] | None = None


class SolvedElsewhere:
    """What starts computations now and uses their results later."""

    solver: Solver = staticmethod(partial)
    """Where they are computed; default: in this process, when the result is requested."""

    @contextmanager
    def solved_by(self, solver: Solver) -> Iterator[None]:
        """Compute elsewhere while the context is entered."""
        before, self.solver = self.solver, solver
        try:
            yield
        finally:
            self.solver = before


class AsyncBundleAdjustment(SolvedElsewhere):
    """One local bundle adjustment at a time: requested, started, and applied later.

    Until it is applied, only the frame counters of the map may change; hence the result does not depend on when or
    where it is solved.
    """

    def __init__(self, camera: SharedCamera) -> None:
        self.camera = camera
        self._pending: _Adjustment | None = None

    @property
    def is_pending(self) -> bool:
        """Whether an adjustment is requested and not applied yet."""
        return self._pending is not None

    @property
    def is_whole(self) -> bool:
        """Whether an adjustment of the whole map is pending."""
        return self._pending is not None and self._pending.keyframe is None

    @property
    def is_due_before_next_frame(self) -> bool:
        """Whether the result must be applied before the next frame is tracked."""
        return self._pending is not None and self._pending.due is None

    @property
    def due(self) -> int | None:
        """The frame after which the result is applied; None if none is pending or it is due before the next frame."""
        return None if self._pending is None else self._pending.due

    def is_due(self, frame: int) -> bool:
        """Whether the result must be applied after this frame."""
        return self._pending is not None and (self._pending.due is None or frame >= self._pending.due)

    def set_deadline(self, frame: int) -> None:
        """Apply a pending result after this frame, since the map is about to change."""
        if self._pending is not None:
            self._pending.due = frame

    def request(self, slam_map: Map, keyframe: int, due: int | None) -> None:
        """Request an adjustment around a keyframe, applied after frame `due` or, if None, before the next frame."""
        assert self._pending is None, "an adjustment is pending"
        self._pending = _Adjustment(due, slam_map, keyframe, self.camera.current, slam_map.version)

    def request_whole(self, slam_map: Map, camera: Camera, due: int, on_applied: Callable[[], None]) -> None:
        """Request an adjustment of the whole map by another camera, applied after frame `due`, and start it."""
        assert self._pending is None, "an adjustment is pending"
        self._pending = _Adjustment(due, slam_map, None, camera, slam_map.version, on_applied)
        self.start()

    def start(self) -> None:
        """Start the requested adjustment if it is not running."""
        pending = self._pending
        if pending is None or pending.window is not None:
            return
        slam_map, camera = pending.slam_map, pending.camera
        if pending.keyframe is not None:
            window = select_window(slam_map, pending.keyframe, camera)
            solve, iterations = solve_local, LOCAL_ITERATIONS
        else:
            window = whole_window(slam_map, camera)
            solve, iterations = solve_whole, GLOBAL_ITERATIONS
        if window is not None:
            pending.window = window
            pending.solution = self.solver(solve, window.problem, iterations)

    def apply(self, slam_map: Map) -> None:
        """Wait for a requested adjustment and apply it to the map."""
        self.start()
        pending, self._pending = self._pending, None
        if pending is None or pending.window is None or pending.solution is None:
            return
        assert slam_map.version == pending.version, "rows were renumbered since the request"
        apply_solution(slam_map, pending.window, *pending.solution(), pending.camera)
        pending.on_applied()

    def drop(self) -> None:
        """Discard a pending adjustment, since its map is gone."""
        self._pending = None
