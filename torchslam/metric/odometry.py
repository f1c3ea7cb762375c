"""Odometry of another sensor in meters, rigidly mounted to the camera: motions over the same stretches of time.

The sensor's pose in the camera is not known. Its rotation and its lever arm are estimated with the scale, from motions
A of the sensor and B of the camera with A X = X B (hand-eye calibration; Tsai and Lenz, "A new technique for fully
autonomous and efficient 3D robotics hand/eye calibration", 1989). Where all turns are about one axis, the lever arm
along it stays open, which no length depends on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.data.trajectories import read_trajectory
from torchslam.geometry import se3_inverse, so3_log, umeyama
from torchslam.geometry.robust import NORMAL_MEDIAN_3D, median_scale
from torchslam.metric.camera_path import CameraPath, Clock, clock_notes, clocks_of, on_clock_of_images
from torchslam.metric.options import Given
from torchslam.metric.path_lengths import (
    MIN_STRETCHES,
    STRETCH,
    Stretches,
    best_shift,
    measured,
    stretch_ends,
)
from torchslam.metric.slow_noise import GATE
from torchslam.metric.source import MetricSource, ScaleMeasurement, ScaleSource, SubmapView, Unmeasured
from torchslam.types import Trajectory

LEVER_STD = 1.0
"""Meters that the sensor may be from the camera, as a prior: motion without turns leaves the lever arm open."""
ROUNDS = 30
"""Alternations between rotation with scale, and lever arm; they gain two digits in ten."""
MIN_TURN_NOISE = math.radians(0.2)
"""Radians: the least noise of turns over a stretch that is assumed, the rounding of files."""


@dataclass(frozen=True)
class OdometrySource:
    """The odometry of one file.

    Attributes:
        path: of the file.
        odometry: poses of the sensor, in meters.
        clock: the clock of the file as given by the user.
    """

    path: Path
    odometry: Trajectory
    clock: Clock = field(default_factory=Clock)

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        """The unit of a submap; see `MetricSource`."""
        path = CameraPath.of(view)
        if len(path.timestamps) < MIN_STRETCHES:
            return Unmeasured(ScaleSource.ODOMETRY, f"only {len(path.timestamps)} frames have a pose")
        times = on_clock_of_images(self.odometry.timestamps, path, self.clock, self.path, "--odometry-clock")
        sensor = CameraPath(times, self.odometry.T_wc, path.first_image)
        ends = stretch_ends(float(path.timestamps[0]), float(path.timestamps[-1]))
        middles = ends[:-1] + STRETCH / 2
        camera_motions, seen = _motions(path, ends)

        def at(shift: float) -> Stretches:
            motions, known = _motions(sensor, ends - shift)
            lengths_w, lengths = (T[:, :3, 3].norm(dim=-1) for T in (camera_motions, motions))
            return Stretches(middles, lengths_w, lengths, known & seen)

        shift = best_shift(at, path) if self.clock.seconds is None else 0.0
        motions, known = _motions(sensor, ends - shift)
        known = known & seen
        if int(known.sum()) < MIN_STRETCHES:
            return Unmeasured(
                ScaleSource.ODOMETRY, f"only {int(known.sum())} stretches of {STRETCH:g} s are in both"
            )
        moved, lever, turned_alike = hand_eye(motions, camera_motions, known)
        lengths_w = camera_motions[:, :3, 3].norm(dim=-1)
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
        return measured(stretches, ScaleSource.ODOMETRY, "the odometry", tuple(notes))


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

    Args:
        motions: of the sensor, meters.
        camera_motions: of the camera, in the unit of the map.
        known: rows that count.

    Returns:
        The camera's translations in the frame of the sensor, meters; its center there; rows whose turns agree.
    """
    turns, camera_turns = so3_log(motions[:, :3, :3]), so3_log(camera_motions[:, :3, :3])
    turned = (turns.norm(dim=-1) - camera_turns.norm(dim=-1)).abs()
    noise = median_scale(turned[known]).clamp_min(MIN_TURN_NOISE)
    alike = turned <= GATE * noise
    used = known & alike
    lever = torch.zeros(3, dtype=torch.float64, device="cpu")
    translations_c = camera_motions[:, :3, 3]
    # Turns and translations together fix the rotation, each in the unit of its own size.
    arm = motions[:, :3, :3] - torch.eye(3, dtype=torch.float64, device="cpu")
    weights = used.double()
    moved = translations_c
    for _ in range(ROUNDS):
        target = _camera_translations(motions, lever)
        ratio = target[used].norm(dim=-1).mean() / translations_c[used].norm(dim=-1).mean().clamp_min(1e-12)
        size = target[used].norm(dim=-1).mean()
        # Zero is a pair as well: a motion of one is the turned motion of the other, without an offset.
        source = torch.cat((ratio * translations_c, size * camera_turns))
        onto = torch.cat((target, size * turns))
        both = torch.cat((weights, weights))
        _, R, _ = umeyama(
            torch.cat((source, -source)), torch.cat((onto, -onto)), torch.cat((both, both)), with_scale=False
        )
        rotated = translations_c @ R.mT
        scale = (weights[:, None] * rotated * target).sum() / (weights[:, None] * rotated.square()).sum()
        moved = scale * rotated
        residual = (moved - target).norm(dim=-1)
        spread = median_scale(residual[used], NORMAL_MEDIAN_3D).clamp_min(1e-9)
        weights = used / (1 + (residual / (2.5 * spread)).square()).square()  # Geman and McClure
        # t_sensor + (R - I) lever = translation of the camera, with a prior for what no turn determines.
        root = weights.sqrt()[:, None, None] / spread
        A, b = (root * arm).flatten(0, 1), (root[..., 0] * (moved - motions[:, :3, 3])).flatten()
        eye = torch.eye(3, dtype=torch.float64, device="cpu") / LEVER_STD**2
        lever = torch.linalg.solve(A.mT @ A + eye, A.mT @ b)
    return moved, lever, alike


def from_options(given: Given) -> list[MetricSource]:
    """The sources of `--odometry FILE`, with `--odometry-clock` for each file or for all.

    Raises TrajectoryError for a file that is wrong.
    """
    return [
        OdometrySource(Path(file), read_trajectory(file), clock)
        for file, clock in clocks_of(given, "odometry")
    ]
