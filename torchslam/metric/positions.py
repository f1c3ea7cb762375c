"""Positions of the camera, as of a GPS receiver, that give a map its scale, its level and its place on the Earth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.fixes import Fixes
from torchslam.data.formats.fix_files import read_fixes
from torchslam.data.formats.given_poses import rows_by_name
from torchslam.errors import MeasurementError
from torchslam.geometry import enu_from_geodetic, sim3_scale
from torchslam.metric.camera_path import CameraPath, Clock, clock_notes, clocks_of, found_shift
from torchslam.metric.options import Given
from torchslam.metric.position_fit import (
    MIN_POSITIONS,
    PositionFit,
    PositionPairs,
    fit_positions,
    start_distance,
)
from torchslam.metric.slow_noise import MAX_RELATIVE_STD
from torchslam.metric.source import MetricSource, ScaleMeasurement, ScaleSource, SubmapView, Unmeasured

SWAPPED = 3.0
"""How much nearer a path must be to positions with latitude and longitude exchanged before a note is written."""
LINE_UP_STD = math.radians(15.0)
"""Standard error of up from which on positions do not constrain the rotation about their line."""
UPSIDE_DOWN = -0.5
"""Cosine between up and the cameras' up below which it is enough that they are nearer at all: a mirrored path that is
level fits if it is turned over."""
SEARCH_STEP = 0.25
"""Seconds between the clocks that are tried: less than the time in which a vehicle changes its motion."""
SEARCH_GAIN = 12.5
"""Logarithm of the likelihood ratio from which on another clock is believed, as for a difference of five standard
deviations."""
SECOND_PASS = 0.1
"""Seconds of a clock's error from which on the path is looked up again: it is straight for less."""


class _NoFit(Exception):
    """Positions do not determine a similarity, for a reason."""


@dataclass(frozen=True)
class PositionSource:
    """The positions of one file, and its clock as given by the user."""

    fixes: Fixes
    clock: Clock = field(default_factory=Clock)

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """The unit, the level and the place of a submap; see `MetricSource`."""
        path = CameraPath.of(view)
        try:
            if len(path.timestamps) < MIN_POSITIONS:
                raise _NoFit(f"only {len(path.timestamps)} frames have a pose")
            find = self._by_names if self.fixes.timestamps is None else self._by_times
            pairs, fit, shift = find(view, path)
        except _NoFit as error:
            return Unmeasured(ScaleSource.POSITION, "; ".join([str(error), *self.fixes.notes]))
        is_line = fit.up_std > LINE_UP_STD
        notes, offset = list(self.fixes.notes), shift + fit.offset
        if abs(offset) > 3 * fit.offset_std:
            notes += clock_notes(self.fixes.path, offset, fit.offset_std)
        if is_line:
            notes.append(
                f"{self.fixes.path}: the positions lie on a line; the rotation about it is chosen such that the images "
                "are upright"
            )
        return ScaleMeasurement(
            ScaleSource.POSITION,
            float(sim3_scale(fit.S_ew)),
            fit.relative_std,
            int(fit.inliers.sum()),
            f"positions, {fit.noise[0]:.2g} m from the path",
            tuple(_rejected(pairs, fit)),
            up_w=None if is_line else fit.up_w,
            up_std=fit.up_std,
            S_ew=fit.S_ew,
            origin=self.origin,
            notes=tuple(notes),
        )

    def _by_names(self, view: SubmapView, path: CameraPath) -> tuple[PositionPairs, PositionFit, float]:
        """Positions of named images, the fit to them, and a difference of clocks of zero."""
        if view.sequence is None:
            raise _NoFit(f"{self.fixes.path} has positions of images, which are not available")
        names = [view.sequence.file_name(index) for index in view.frame_index.tolist()]
        rows = rows_by_name(self.fixes.names, names)
        found = rows >= 0
        if not bool(found.any()):
            raise MeasurementError(
                f"{self.fixes.path}: no image has one of its names, such as {self.fixes.names[0]}"
            )
        positions_w = path.T_wc[found, :3, 3]
        still = torch.zeros_like(positions_w)
        pairs = PositionPairs(path.timestamps[found], positions_w, still, *self._local(rows[found]))
        return pairs, self._fitted(pairs, path), 0.0

    def _by_times(self, view: SubmapView, path: CameraPath) -> tuple[PositionPairs, PositionFit, float]:
        """Positions at times, the fit to them, and the seconds that the clock of the images is ahead."""
        assert self.fixes.timestamps is not None
        times = path.on_its_clock(self.fixes.timestamps, self.clock, self.fixes.path, "--gps-clock")
        geodetic = self.fixes.geodetic.nan_to_num()
        if bool((geodetic == geodetic[0]).all()):
            raise _NoFit(f"all {len(self.fixes)} positions are the same")
        moved = torch.ones_like(times, dtype=torch.bool)
        # Until it has a new position a receiver, or what writes its file, repeats the last one.
        moved[1:] = (self.fixes.geodetic.diff(dim=0).nan_to_num() != 0).any(-1)
        rows = torch.nonzero(moved)[:, 0]
        times, local = times[rows], self._local(rows)

        def fitted(shift: float) -> tuple[PositionPairs, PositionFit]:
            positions_w, velocities_w, known = path.at(times + shift)
            pairs = PositionPairs(times, positions_w, velocities_w, *local).select(known)
            return pairs, self._fitted(pairs, path)

        shift = self._search(path, times, local[0], local[2]) if self.clock.seconds is None else 0.0
        pairs, fit = fitted(shift)
        if abs(fit.offset) > SECOND_PASS:
            shift += fit.offset
            pairs, fit = fitted(shift)
        return pairs, fit, shift

    def _local(self, rows: Tensor) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 2"], Bool[Tensor, " M"]]:
        """Positions east, north and up of the origin, their standard deviations, and which have a height."""
        geodetic = self.fixes.geodetic[rows]
        has_height = ~geodetic[:, 2].isnan()
        origin = torch.tensor(self.origin, dtype=torch.float64, device="cpu")
        level = torch.where(has_height, geodetic[:, 2], origin[2])
        positions_e = enu_from_geodetic(torch.cat((geodetic[:, :2], level[:, None]), dim=1), origin)
        return positions_e, self.fixes.std[rows], has_height

    @property
    def origin(self) -> tuple[float, float, float]:
        """Latitude, longitude and altitude of the first position, the origin of east, north, up."""
        latitude, longitude, _ = self.fixes.geodetic[0].tolist()
        altitudes = self.fixes.geodetic[:, 2]
        known = altitudes[~altitudes.isnan()]
        return latitude, longitude, float(known[0]) if len(known) else 0.0

    def _search(
        self,
        path: CameraPath,
        times: Float[Tensor, " M"],
        positions_e: Float[Tensor, "M 3"],
        has_height: Bool[Tensor, " M"],
    ) -> float:
        """Seconds that the clock of the images is ahead; see `found_shift`."""
        inside = torch.nonzero(path.at(times)[2])[:, 0]
        if len(inside) < 2 * MIN_POSITIONS:
            return 0.0
        rows = inside[:: max(1, len(inside) // 100)]
        nan = torch.full((len(rows), 2), math.nan, dtype=torch.float64, device="cpu")

        def cost_at(shift: float) -> float | None:
            positions_w, velocities_w, known = path.at(times[rows] + shift)
            if int(known.sum()) < max(MIN_POSITIONS + 2, len(rows) // 2):
                return None
            pairs = PositionPairs(
                times[rows], positions_w, velocities_w, positions_e[rows], nan, has_height[rows]
            ).select(known)
            return 2 * len(rows) * math.log(max(start_distance(pairs), 1e-6))

        return found_shift(cost_at, path.duration, SEARCH_STEP, SEARCH_GAIN)

    def _fitted(self, pairs: PositionPairs, path: CameraPath) -> PositionFit:
        if len(pairs) < MIN_POSITIONS:
            raise _NoFit(f"{len(pairs)} positions are at times with a pose, {MIN_POSITIONS} are needed")
        extent = float((pairs.positions_e.amax(0) - pairs.positions_e.amin(0)).norm())
        if extent == 0:
            raise _NoFit(f"all {len(pairs)} positions are the same")
        if not bool(pairs.positions_w.std(0).norm() > 0):
            raise _NoFit("the camera does not move")
        fit = fit_positions(pairs, path.up_w)
        if fit is None or float(fit.inliers.double().mean()) < 0.5:
            self._check_swapped(pairs)
            raise _NoFit(f"the {len(pairs)} positions do not have the shape of the camera's path")
        if fit.relative_std > MAX_RELATIVE_STD:
            self._check_swapped(pairs)
            raise _NoFit(
                f"{len(pairs)} positions over {extent:.1f} m scatter by {fit.noise[0]:.1f} m about the camera's path: "
                f"the scale is uncertain by {fit.relative_std:.0%}"
            )
        if float(fit.up_w @ path.up_w) < UPSIDE_DOWN:
            self._check_swapped(pairs, better=1.0)
        return fit

    def _check_swapped(self, pairs: PositionPairs, better: float = SWAPPED) -> None:
        """Raise MeasurementError where the path fits so much better with latitude and longitude exchanged."""
        geodetic = self.fixes.geodetic
        if not bool((geodetic[:, 1].abs() <= 90).all()):
            return
        at, swapped_at = (math.cos(math.radians(angle)) for angle in self.origin[:2])
        east, north, up = pairs.positions_e.unbind(-1)
        exchanged = torch.stack((north * swapped_at, east / at, up), dim=-1)
        swapped = replace(pairs, positions_e=exchanged)
        if better * start_distance(swapped) < start_distance(pairs):
            raise MeasurementError(
                f"{self.fixes.path}: the camera's path has the shape of its positions with latitude and longitude "
                "exchanged: are they swapped in the file?"
            )


def _rejected(pairs: PositionPairs, fit: PositionFit) -> list[str]:
    """What does not agree, in a few lines."""
    wrong = torch.nonzero(~fit.inliers)[:, 0]
    if len(wrong) <= 3:
        return [
            f"the position at {float(pairs.times[row]):.1f} s is {float(fit.distances[row]):.1f} m from the path"
            for row in wrong.tolist()
        ]
    distances = fit.distances[wrong]
    return [
        f"{len(wrong)} of {len(pairs)} positions, the first one at {float(pairs.times[wrong[0]]):.1f} s, are "
        f"{float(distances.min()):.1f} to {float(distances.max()):.1f} m from the path"
    ]


def from_options(given: Given) -> list[MetricSource]:
    """The sources of `--gps FILE`, with `--gps-clock` for each file or for all."""
    return [PositionSource(read_fixes(file), clock) for file, clock in clocks_of(given, "gps")]
