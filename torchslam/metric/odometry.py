"""Speeds and odometry of a vehicle as sources of meters: lengths of the same stretches of time as the camera's path.

The pose of an odometry's sensor in the camera is not known. Its rotation and its lever arm are estimated with the
scale, from motions A of the sensor and B of the camera with A X = X B (hand-eye calibration; Tsai and Lenz, "A new
technique for fully autonomous and efficient 3D robotics hand/eye calibration", 1989). Where all turns are about one
axis, the lever arm along it stays open, which no length depends on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.formats.vehicle_files import Speeds, read_speeds
from torchslam.data.trajectories import read_trajectory
from torchslam.geometry import se3_inverse, so3_log, umeyama
from torchslam.geometry.robust import NORMAL_MEDIAN_3D, median_scale, robustify
from torchslam.metric.camera_path import CameraPath, Clock, clock_notes, clocks_of, found_shift
from torchslam.metric.options import Given
from torchslam.metric.slow_noise import GATE, scale_of_series
from torchslam.metric.source import MetricSource, ScaleMeasurement, ScaleSource, SubmapView, Unmeasured
from torchslam.types import Trajectory
from torchslam.utils.indexing import between_rows

STRETCH = 1.0
"""Seconds of a stretch: long enough that noise of single poses does not matter, short enough to separate slips from
drift."""
PARTS = 5
"""Straight parts of a stretch over which the path of the camera is measured: a car turns by less than 10 degrees in
one."""
MIN_STRETCHES = 4  # from fewer, their scatter cannot be estimated
STANDING = 0.15
"""Part of the typical length of a stretch below which it is not used: the vehicle stands, or nearly."""
SEARCH_STEP = 0.1  # seconds between the clocks that are tried
SEARCH_GAIN = 18.0
"""Logarithm of the likelihood ratio from which on another clock is believed, as for a difference of six standard
deviations. Of 20 trials over 15 s, 12.5 believed a wrong one with slipping wheels, and 25 missed one of .8 s."""
MAX_GAP = 2.5
"""Seconds between two speeds up to which the speed in between is known: a second or two is usual for cars, which change
theirs evenly by 3 m/s in one."""
LEVER_STD = 1.0
"""Meters that the sensor may be from the camera, as a prior: motion without turns leaves the lever arm open."""
ROUNDS = 30  # alternations between rotation with scale, and lever arm; they gain two digits in ten


@dataclass(frozen=True)
class SpeedSource:
    """The speeds of one file: their integral is the length of the camera's path. The clock is given by the user."""

    speeds: Speeds
    clock: Clock = field(default_factory=Clock)

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """The unit of a submap; see `MetricSource`."""
        path = CameraPath.of(view)
        if len(path.timestamps) < MIN_STRETCHES:
            return Unmeasured(ScaleSource.SPEED, f"only {len(path.timestamps)} frames have a pose")
        file = self.speeds.path
        times = path.on_its_clock(self.speeds.timestamps, self.clock, file, "--speed-clock")
        ends = _stretch_ends(path)
        lengths_w, seen = _camera_lengths(path, ends)

        def at(shift: float) -> Stretches:
            lengths, known = _driven(self.speeds.speeds, times + shift, ends)
            return Stretches(ends[:-1] + STRETCH / 2, lengths_w, lengths, known & seen)

        shift = _best_shift(at, path) if self.clock.seconds is None else 0.0
        return _measured(
            at(shift), ScaleSource.SPEED, "the speeds", [*self.speeds.notes, *clock_notes(file, shift)]
        )


@dataclass(frozen=True)
class OdometrySource:
    """The odometry of one file: poses of another sensor, in meters, rigidly mounted to the camera."""

    path: Path
    odometry: Trajectory
    clock: Clock = field(default_factory=Clock)

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """The unit of a submap; see `MetricSource`."""
        path = CameraPath.of(view)
        if len(path.timestamps) < MIN_STRETCHES:
            return Unmeasured(ScaleSource.ODOMETRY, f"only {len(path.timestamps)} frames have a pose")
        times = path.on_its_clock(self.odometry.timestamps, self.clock, self.path, "--odometry-clock")
        sensor = CameraPath(times, self.odometry.T_wc, path.first_image)
        ends = _stretch_ends(path)
        middles = ends[:-1] + STRETCH / 2
        camera_motions, seen = _motions(path, ends)
        lengths_w = camera_motions[:, :3, 3].norm(dim=-1)

        def at(shift: float) -> Stretches:
            motions, known = _motions(sensor, ends - shift)
            return Stretches(middles, lengths_w, motions[:, :3, 3].norm(dim=-1), known & seen)

        shift = _best_shift(at, path) if self.clock.seconds is None else 0.0
        motions, known = _motions(sensor, ends - shift)
        known = known & seen
        if int(known.sum()) < MIN_STRETCHES:
            return _too_few(known, ScaleSource.ODOMETRY, "the odometry")
        moved, lever, turned_alike = hand_eye(motions, camera_motions, known)
        # The camera's own motion in meters, along the direction in which the fit has it.
        direction = moved / moved.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        lengths = (direction * _camera_translations(motions, lever)).sum(-1)
        notes = []
        strange = known & ~turned_alike
        if bool(strange.any()):
            notes.append(
                f"{self.path}: {int(strange.sum())} of {int(known.sum())} stretches, the first one at "
                f"{float(middles[strange][0]):.1f} s, rotate differently from the camera and do not count"
            )
        notes += clock_notes(self.path, shift)
        notes.append(
            f"{self.path}: the camera is {float(lever.norm()):.2f} m from the sensor, estimated from rotations"
        )
        stretches = Stretches(middles, lengths_w, lengths, known & turned_alike)
        return _measured(stretches, ScaleSource.ODOMETRY, "the odometry", notes)


def speeds_from_options(given: Given) -> list[MetricSource]:
    """The sources of `--speed FILE`, with `--speed-clock` for each file or for all."""
    return [SpeedSource(read_speeds(file), clock) for file, clock in clocks_of(given, "speed")]


def from_options(given: Given) -> list[MetricSource]:
    """The sources of `--odometry FILE`, with `--odometry-clock` for each file or for all."""
    files = clocks_of(given, "odometry")
    return [OdometrySource(Path(file), read_trajectory(file), clock) for file, clock in files]


class Stretches(NamedTuple):
    """S stretches of time by their middles, seconds, and their lengths in units of the map and in meters."""

    times: Float[Tensor, " S"]
    lengths_w: Float[Tensor, " S"]
    lengths: Float[Tensor, " S"]
    known: Bool[Tensor, " S"]


def _stretch_ends(path: CameraPath) -> Float[Tensor, " E"]:
    """Times a stretch apart."""
    count = int(path.duration / STRETCH) + 1
    return path.timestamps[0] + STRETCH * torch.arange(count, dtype=torch.float64, device="cpu")


def _camera_lengths(
    path: CameraPath, ends: Float[Tensor, " E"]
) -> tuple[Float[Tensor, " S"], Bool[Tensor, " S"]]:
    """Lengths of the camera's path between successive times, and where it is known; arcs between the parts' ends."""
    fractions = torch.arange(PARTS + 1, dtype=torch.float64, device="cpu") / PARTS
    times = ends[:-1, None] + fractions * STRETCH
    T_wc, known = path.poses_at(times.flatten())
    T_wc, known = T_wc.unflatten(0, times.shape), known.unflatten(0, times.shape)
    chords = T_wc[..., :3, 3].diff(dim=1).norm(dim=-1)
    half = so3_log(T_wc[:, :-1, :3, :3].mT @ T_wc[:, 1:, :3, :3]).norm(dim=-1) / 2
    arcs = torch.where(half > 1e-6, half / half.clamp_min(1e-6).sin(), 1.0)
    return (chords * arcs).sum(1), known.all(1)


def _driven(
    speeds: Float[Tensor, " N"], times: Float[Tensor, " N"], ends: Float[Tensor, " E"]
) -> tuple[Float[Tensor, " S"], Bool[Tensor, " S"]]:
    """Meters between successive times by the trapezoidal rule, and where no gap is in it."""
    steps = times.diff()
    driven, gaps = torch.zeros_like(times), torch.zeros_like(times)
    driven[1:] = (steps * (speeds[1:] + speeds[:-1]) / 2).cumsum(0)
    gaps[1:] = (steps > MAX_GAP).cumsum(0)
    left, part = between_rows(times, ends)
    part = part.clamp(0, 1)
    gain = (speeds[left + 1] - speeds[left]) * part / 2
    at = driven[left] + part * steps[left] * (speeds[left] + gain)
    known = (gaps[left + 1][1:] == gaps[left][:-1]) & (ends[:-1] >= times[0]) & (ends[1:] <= times[-1])
    return at.diff(), known


def _motions(
    path: CameraPath, ends: Float[Tensor, " E"]
) -> tuple[Float[Tensor, "S 4 4"], Bool[Tensor, " S"]]:
    """Poses at the end of each stretch in the frame at its beginning, and where both are known."""
    T_wc, known = path.poses_at(ends)
    return se3_inverse(T_wc[:-1]) @ T_wc[1:], known[:-1] & known[1:]


def _camera_translations(motions: Float[Tensor, "S 4 4"], lever: Float[Tensor, " 3"]) -> Float[Tensor, "S 3"]:
    """Translations of a point of the sensor, in its frame at the beginning."""
    return motions[:, :3, 3] + motions[:, :3, :3] @ lever - lever


def hand_eye(
    motions: Float[Tensor, "S 4 4"], camera_motions: Float[Tensor, "S 4 4"], known: Bool[Tensor, " S"]
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, " 3"], Bool[Tensor, " S"]]:
    """Rotation with scale and lever arm between a sensor and a camera, from their motions, up to half of them wrong.

    Motions of the sensor are in meters, those of the camera in units of the map.

    Returns:
        The camera's translations in the frame of the sensor, meters; its center there; rows whose turns agree.
    """
    turns, camera_turns = so3_log(motions[:, :3, :3]), so3_log(camera_motions[:, :3, :3])
    turned = (turns.norm(dim=-1) - camera_turns.norm(dim=-1)).abs()
    least = math.radians(0.2)  # the rounding of files
    alike = turned <= GATE * median_scale(turned[known]).clamp_min(least)
    used = known & alike
    eye = torch.eye(3, dtype=torch.float64, device="cpu")
    lever, translations_c = torch.zeros_like(eye[0]), camera_motions[:, :3, 3]
    weights, moved = used.double(), translations_c
    for _ in range(ROUNDS):
        target = _camera_translations(motions, lever)
        # Turns and translations together fix the rotation, each in the unit of its own size.
        size = target[used].norm(dim=-1).mean()
        ratio = size / translations_c[used].norm(dim=-1).mean().clamp_min(1e-12)
        # Zero is a pair as well: a motion of one is the turned motion of the other, without an offset.
        source = torch.cat((ratio * translations_c, size * camera_turns))
        onto = torch.cat((target, size * turns))
        both = torch.cat((weights, weights, weights, weights))
        _, R, _ = umeyama(torch.cat((source, -source)), torch.cat((onto, -onto)), both, with_scale=False)
        rotated = translations_c @ R.mT
        scale = (weights[:, None] * rotated * target).sum() / (weights[:, None] * rotated.square()).sum()
        moved = scale * rotated
        residual = (moved - target).norm(dim=-1)
        spread = median_scale(residual[used], NORMAL_MEDIAN_3D).clamp_min(1e-9)
        weights = used * robustify(residual.square(), "geman_mcclure", 2.5 * spread).weight
        # t_sensor + (R - I) lever = translation of the camera, with a prior for what no turn determines.
        root = weights.sqrt()[:, None, None] / spread
        A = (root * (motions[:, :3, :3] - eye)).flatten(0, 1)
        b = (root[..., 0] * (moved - motions[:, :3, 3])).flatten()
        lever = torch.linalg.solve(A.mT @ A + eye / LEVER_STD**2, A.mT @ b)
    return moved, lever, alike


def _best_shift(stretches_at: Callable[[float], Stretches], path: CameraPath) -> float:
    """Seconds that the clock of the images is ahead; see `found_shift`."""

    def cost_at(shift: float) -> float | None:
        found = stretches_at(shift)
        lengths_w, lengths = found.lengths_w[found.known], found.lengths[found.known]
        if len(lengths) < 2 * MIN_STRETCHES or not bool((lengths_w > 0).any()):
            return None
        scale = lengths.sum() / lengths_w.sum()
        off = (lengths - scale * lengths_w).abs().median() / lengths.mean().clamp_min(1e-9)
        return len(lengths) * math.log(max(float(off), 1e-6))

    return found_shift(cost_at, path.duration, SEARCH_STEP, SEARCH_GAIN)


def _too_few(known: Bool[Tensor, " S"], source: ScaleSource, what: str) -> Unmeasured:
    return Unmeasured(
        source, f"{what} and the camera's path share {int(known.sum())} stretches of {STRETCH:g} s"
    )


def _measured(
    found: Stretches, source: ScaleSource, what: str, notes: list[str]
) -> ScaleMeasurement | Unmeasured:
    """The unit by the ratios of lengths, with the error that their disagreement shows; `what` is the instrument's."""
    if int(found.known.sum()) < MIN_STRETCHES:
        return _too_few(found.known, source, what)
    moving = found.known
    for lengths in (found.lengths_w, found.lengths):
        moving = moving & (lengths > STANDING * lengths[found.known].quantile(0.9)) & (lengths > 0)
    if int(moving.sum()) < MIN_STRETCHES:
        return Unmeasured(source, "the camera hardly moves, or not when the vehicle does")
    times, logs = found.times[moving], (found.lengths[moving] / found.lengths_w[moving]).log()
    relative = found.lengths[moving].mean() / found.lengths[moving]  # short ones are less sure
    return scale_of_series(
        source,
        times,
        logs,
        relative.clamp_min(1e-3),
        "stretches",
        lambda row: f"at {float(times[row]):.1f} s",
        disagreement=f"{what} and the camera's path differ by {{}} from stretch to stretch",
        cause=", as with wheels that slip",
        notes=tuple(notes),
    )
