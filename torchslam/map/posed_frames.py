"""Posed frames of a submap: poses relative to keyframes, observations of map points, and the graph of a run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry import CHI_SQUARE_95, KeypointNoise, SensorModel, passes_gate, se3_inverse, transform
from torchslam.geometry.camera import Camera
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.rolling_shutter import frame_velocities, global_shutter_pixels
from torchslam.geometry.zoom import Zoom
from torchslam.map.map import Map, key_of
from torchslam.map.table import FRAMES, OBSERVATIONS, Table
from torchslam.optim.observation_graph import RunGraph
from torchslam.optim.run_graph import GraphSolution
from torchslam.types import FrameFeatures, PoseEstimate, Trajectory


class PosedFrames:
    """All posed frames: poses relative to a keyframe, so that they follow the map; observations as flat rows.

    Attributes:
        frames: One row per frame, see `table.FRAMES`.
        observations: One row per observation of a frame, see `table.OBSERVATIONS`.
    """

    def __init__(self) -> None:
        self.frames = Table(FRAMES)
        self.observations = Table(OBSERVATIONS)

    def add(
        self, view: FrameFeatures, estimate: PoseEstimate, T_cr: Float[Tensor, "4 4"], reference: int
    ) -> None:
        """Add a frame with pose T_cr relative to keyframe `reference` and its inlier observations."""
        device, seen = T_cr.device, estimate.keypoints
        view = view.weighed(seen, estimate.weights)
        row = self.frames.append(
            frame_index=torch.tensor([view.index], device=device),
            session=torch.tensor([view.session], device=device),
            timestamp=torch.tensor([view.timestamp], dtype=torch.float64, device=device),
            T_cr=T_cr[None],
            reference_keyframe=torch.tensor([reference], device=device),
        )
        self.observations.append(
            frame_row=row.expand(estimate.inliers),
            point_ids=estimate.point_ids,
            keypoint_index=seen,
            pixels=view.detected[seen],
            scales=view.scales[seen],
            information=view.information[seen],
        )

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.frames)

    def count(self, session: int | None = None) -> int:
        """Return the number of posed frames of one session or of all."""
        if session is None or len(self) == 0:
            return len(self)
        return int((self.frames["session"] == session).sum())

    @property
    def keys(self) -> Int[Tensor, " F"]:
        """The keys of the frames: session and frame index, as for keyframes."""
        return key_of(self.frames["session"], self.frames["frame_index"])

    def T_cw(self, slam_map: Map) -> Float[Tensor, "F 4 4"]:
        """Return the current poses of the frames in the order they were added."""
        return self.frames["T_cr"] @ slam_map.T_cw[self.frames["reference_keyframe"]]

    def trajectory(self, slam_map: Map, session: int | None = None) -> Trajectory:
        """Return the poses, camera to world, ordered by time, of one session or of all."""
        if len(self) == 0:
            return Trajectory.empty()
        T_cw, timestamps = self.T_cw(slam_map), self.frames["timestamp"]
        if session is not None:
            rows = self.frames["session"] == session
            T_cw, timestamps = T_cw[rows], timestamps[rows]
        order = torch.argsort(timestamps, stable=True)
        return Trajectory(timestamps[order].clone(), se3_inverse(T_cw[order]))

    def remove(self, frames: Iterable[int]) -> None:
        """Remove frames, by their indices, and their observations."""
        gone = self.frames["frame_index"].new_tensor(sorted(frames))
        kept = ~torch.isin(self.frames["frame_index"], gone)
        rows = torch.cumsum(kept, 0) - 1
        self.observations.keep(torch.nonzero(kept[self.observations["frame_row"]])[:, 0])
        self.observations["frame_row"][:] = rows[self.observations["frame_row"]]
        self.frames.keep(torch.nonzero(kept)[:, 0])

    def rescale(self, factors: Float[Tensor, " K"]) -> None:
        """Scale the translations relative to each keyframe by its factor."""
        if len(self):
            self.frames["T_cr"][:, :3, 3] *= factors[self.frames["reference_keyframe"]][:, None]

    def append(self, other: PosedFrames, keyframes: int, points: int) -> None:
        """Append the frames of another submap, whose keyframe and point rows are shifted by these offsets."""
        if len(other) == 0:
            return
        frames, seen = other.frames.columns(), other.observations.columns()
        seen["frame_row"] = seen["frame_row"] + len(self)
        seen["point_ids"] = seen["point_ids"] + points
        frames["reference_keyframe"] = frames["reference_keyframe"] + keyframes
        self.frames.append(**frames)
        self.observations.append(**seen)

    def reassign_reference(self, replacement: Int[Tensor, " K"], slam_map: Map) -> None:
        """Change the reference of frames from keyframe i to replacement[i], without moving them."""
        old = self.frames["reference_keyframe"]
        moves = torch.nonzero(replacement[old] != old)[:, 0]
        new = replacement[old[moves]]
        T_rr = slam_map.T_cw[old[moves]] @ se3_inverse(slam_map.T_cw[new])
        self.frames["T_cr"][moves] = self.frames["T_cr"][moves] @ T_rr
        old[moves] = new

    def absorb_keyframes(self, slam_map: Map, keyframes: Int[Tensor, " R"]) -> None:
        """Replace pose and observations of the frames of keyframes by those of the keyframes.

        A keyframe without a frame gets one.
        """
        kept = slam_map.keyframes
        rows = torch.cat([self._frame_of(slam_map, keyframe) for keyframe in keyframes.tolist()])
        self.frames["T_cr"][rows] = kept["T_cw"][keyframes] @ se3_inverse(
            slam_map.T_cw[self.frames["reference_keyframe"][rows]]
        )
        is_kept = torch.zeros(len(self), dtype=torch.bool, device=rows.device).index_fill(0, rows, True)
        row_of = rows.new_full((len(kept),), -1).index_copy(0, keyframes, rows)
        seen = slam_map.observations(keyframes, as_detected=True)
        self._overwrite(
            torch.nonzero(is_kept[self.observations["frame_row"]])[:, 0],
            frame_row=row_of[seen.keyframe_index],
            point_ids=seen.point_index,
            keypoint_index=seen.keypoint_index,
            pixels=seen.pixels,
            scales=seen.scales,
            information=seen.information,
        )

    def _overwrite(self, stale: Int[Tensor, " N"], **fresh: Tensor) -> None:
        """Overwrite stale rows, ascending, with fresh observations, and copy the table only if they do not fit."""
        count = min(len(stale), len(fresh["frame_row"]))
        for name, values in fresh.items():
            self.observations[name][stale[:count]] = values[:count]
        if count < len(stale):
            is_left = torch.ones(len(self.observations), dtype=torch.bool, device=stale.device)
            self.observations.keep(torch.nonzero(is_left.index_fill(0, stale[count:], False))[:, 0])
        self.observations.append(**{name: values[count:] for name, values in fresh.items()})

    def _frame_of(self, slam_map: Map, keyframe: int) -> Int[Tensor, " 1"]:
        """Return the row of the frame that a keyframe was made of; add it if it is missing."""
        own = {
            name: slam_map.keyframes[name][keyframe][None] for name in ("frame_index", "session", "timestamp")
        }
        is_frame = self.frames["frame_index"] == own["frame_index"]
        row = torch.nonzero(is_frame & (self.frames["session"] == own["session"]))[:1, 0]
        if len(row):
            return row
        eye = torch.eye(4, dtype=slam_map.T_cw.dtype, device=slam_map.T_cw.device)[None]
        return self.frames.append(T_cr=eye, reference_keyframe=slam_map.index_tensor(keyframe), **own)

    def renumber_points(self, slam_map: Map, rows: Int[Tensor, " L"]) -> None:
        """Renumber points to new rows, negative if removed; merged points count as their replacements."""
        if len(self.observations) == 0:
            return
        renamed = rows[slam_map.follow_merges(self.observations["point_ids"])]
        self.observations["point_ids"][:] = renamed
        if bool((renamed < 0).any()):
            self.observations.keep(torch.nonzero(renamed >= 0)[:, 0])

    def remove_outliers(
        self,
        slam_map: Map,
        sensor: SensorModel,
        chi_square: float = 4.0 * CHI_SQUARE_95,
        least_ratio: float = 0.75,
    ) -> None:
        """Remove observations far from the current reprojection, since their point was merged or has moved.

        Args:
            chi_square: squared error, in units of the stated noise, from which on an observation is far. By default,
                twice the distance of the gate: the final adjustment moves frames by less.
            least_ratio: of its observations that must be near; else a frame keeps all, since its pose may be wrong.
        """
        T_cw, seen_by = self.T_cw(slam_map), self.observations["frame_row"]
        velocities = None if sensor.readout is None else self._velocities(T_cw)
        parts = torch.arange(len(seen_by), device=T_cw.device).split(1 << 16)  # bounds memory
        agrees = torch.cat(
            [self._agree(rows, T_cw, slam_map, sensor, chi_square, velocities) for rows in parts]
        )
        count = torch.bincount(seen_by, minlength=len(self))
        is_right = torch.bincount(seen_by[agrees], minlength=len(self)) >= least_ratio * count.float()
        kept = agrees | ~is_right[seen_by]
        if not bool(kept.all()):
            self.observations.keep(torch.nonzero(kept)[:, 0])

    def _velocities(
        self, T_cw: Float[Tensor, "F 4 4"], frames: Int[Tensor, " R"] | None = None
    ) -> Float[Tensor, "F 6"]:
        return frame_velocities(T_cw, self.frames["timestamp"], self.frames["session"], frames)[0]

    def _agree(
        self,
        rows: Int[Tensor, " O"],
        T_cw: Float[Tensor, "F 4 4"],
        slam_map: Map,
        sensor: SensorModel,
        chi_square: float,
        velocities: Float[Tensor, "F 6"] | None,
    ) -> Bool[Tensor, " O"]:
        seen = {name: values[rows] for name, values in self.observations.columns().items()}
        points_w = slam_map.positions_w[slam_map.follow_merges(seen["point_ids"])]
        frame, pixels = seen["frame_row"], seen["pixels"]
        points_c = transform(T_cw[frame], points_w[:, None])[:, 0]
        camera = sensor.camera
        if sensor.readout is not None and velocities is not None:
            seconds = sensor.readout.seconds.to(pixels)
            pixels = global_shutter_pixels(pixels, T_cw[frame], velocities[frame], points_w, camera, seconds)
        noise = KeypointNoise(seen["scales"], seen["information"])
        return passes_gate(noise.squared_reprojection(points_c, pixels, camera), chi_square)

    def correct_keyframes(
        self, slam_map: Map, sensor: SensorModel, keyframes: Int[Tensor, " R"] | None = None
    ) -> None:
        """Set the keypoints of keyframes, by default of all, to those of a global shutter, by their velocities.

        Keypoints without a point count as at the median depth of the others.
        """
        table = slam_map.keyframes
        rows = torch.arange(len(table), device=slam_map.T_cw.device) if keyframes is None else keyframes
        detected, ids = table["detected"][rows], table["point_ids"][rows]
        if sensor.readout is None:
            table["keypoints"][rows] = detected
            return
        keys, order = self.keys.sort()
        frame = order[torch.searchsorted(keys, slam_map.keys[rows]).clamp_max(len(keys) - 1)]
        velocities = self._velocities(self.T_cw(slam_map), frame)
        is_posed = self.keys[frame] == slam_map.keys[rows]
        velocities = torch.where(is_posed[:, None], velocities[frame], 0.0)
        depths = transform(slam_map.T_cw[rows], slam_map.positions_w[ids.clamp_min(0)])[..., 2]
        depths = torch.where((ids >= 0) & (depths > 0), depths, torch.nan)
        depths = torch.where(depths.isnan(), depths.nanmedian(dim=1, keepdim=True).values, depths)
        corrected = sensor.at_middle_row(detected, velocities, depths)
        table["keypoints"][rows] = torch.where(corrected.isfinite(), corrected, detected)

    def undo_zoom(self, slam_map: Map, zoom: Zoom, camera: Camera) -> None:
        """Undo a zoom in the keypoints of keyframes and frames, which are of one session."""
        table, seen = slam_map.keyframes, self.observations
        for name in ("detected", "keypoints"):
            table[name][:] = zoom.undone(table[name], table["frame_index"], camera)
        frames = self.frames["frame_index"][seen["frame_row"]]
        seen["pixels"][:] = zoom.undone(seen["pixels"], frames, camera)

    def at_middle_row(
        self, views: Sequence[FrameFeatures], slam_map: Map, sensor: SensorModel
    ) -> list[FrameFeatures]:
        """Views with the keypoints of a global shutter, at the median depth of what their frames see.

        Views of other frames stay as they are.
        """
        if sensor.readout is None:
            return list(views)
        T_cw = self.T_cw(slam_map)
        velocities = self._velocities(T_cw)
        points_w = slam_map.positions_w[slam_map.follow_merges(self.observations["point_ids"])]
        seen_by = self.observations["frame_row"]
        depths = transform(T_cw[seen_by], points_w[:, None])[:, 0, 2]
        row_of = {key: row for row, key in enumerate(self.keys.tolist())}
        corrected = []
        for view in views:
            row = row_of.get(key_of(view.session, view.index))
            own = depths[:0] if row is None else depths[seen_by == row]
            if row is not None and len(own):
                depth = own.median().expand(1, len(view.detected))
                pixels = sensor.at_middle_row(view.detected[None], velocities[row : row + 1], depth)[0]
                view = replace(view, keypoints=pixels)
            corrected.append(view)
        return corrected

    def graph(
        self,
        slam_map: Map,
        sensor: SensorModel,
        submap: int = 0,
        calibration: CameraMeasurement | None = None,
    ) -> RunGraph:
        """Build the observation graph: keyframes first, then the frames between them.

        Keyframes contribute all their observations, as `Map.observations` has them, other frames those of points that
        keyframes observe.

        Args:
            calibration: the given camera with its error; None: that of `sensor` is exact.
        """
        seen = slam_map.observations(as_detected=True)
        point_ids = torch.unique(seen.point_index)
        between = torch.nonzero(~torch.isin(self.keys, slam_map.keys))[:, 0]
        slot = torch.full((len(self),), -1, device=point_ids.device)
        slot[between] = slam_map.num_keyframes + torch.arange(len(between), device=point_ids.device)
        replacement = slam_map.follow_merges(self.observations["point_ids"])
        # A flag per point: `isin` would sort all that was ever seen.
        is_seen = torch.zeros(len(slam_map.points), dtype=torch.bool, device=point_ids.device)
        is_seen[point_ids] = True
        rows = torch.nonzero((slot[self.observations["frame_row"]] >= 0) & is_seen[replacement])[:, 0]
        keyframes = slam_map.keyframes

        def with_own(values: Tensor, name: str) -> Tensor:
            """A column at a time: the observations are most of what a long run holds in memory."""
            return torch.cat([values, self.observations[name][rows]])

        return RunGraph(
            timestamps=torch.cat([keyframes["timestamp"], self.frames["timestamp"][between]]),
            T_cw=torch.cat([slam_map.T_cw, self.T_cw(slam_map)[between]]),
            points_w=slam_map.positions_w[point_ids],
            frame_index=torch.cat([seen.keyframe_index, slot[self.observations["frame_row"][rows]]]),
            point_index=torch.searchsorted(point_ids, torch.cat([seen.point_index, replacement[rows]])),
            pixels=with_own(seen.pixels, "pixels"),
            weights=KeypointNoise(
                with_own(seen.scales, "scales"), with_own(seen.information, "information")
            ).weights
            / sensor.noise_variance,
            camera=sensor.camera,
            calibration=calibration,
            readout=sensor.readout,
            is_keyframe=torch.arange(slam_map.num_keyframes + len(between), device=point_ids.device)
            < slam_map.num_keyframes,
            frame_ids=torch.cat([keyframes["frame_index"], self.frames["frame_index"][between]]),
            submap=torch.full((slam_map.num_keyframes + len(between),), submap, device=point_ids.device),
            sessions=torch.cat([keyframes["session"], self.frames["session"][between]]),
            point_ids=point_ids,
            keypoint_index=with_own(seen.keypoint_index, "keypoint_index"),
        )

    def apply_solution(self, solution: GraphSolution, graph: RunGraph, slam_map: Map) -> None:
        """Move map and frames to the solution of their own graph.

        More frames may have been solved as keyframes, and further points that came after those of the graph.
        """
        count, own = slam_map.num_keyframes, range(len(graph.point_ids))
        slam_map.keyframes["T_cw"][:] = solution.T_cw[:count]
        slam_map.points["positions_w"][graph.point_ids] = solution.points_w[: len(own)]
        keys = key_of(graph.sessions, graph.frame_ids)
        order = torch.argsort(keys)
        solved = order[torch.searchsorted(keys[order], self.keys)]
        T_rw = slam_map.T_cw[self.frames["reference_keyframe"]]
        self.frames["T_cr"][:] = solution.T_cw[solved] @ se3_inverse(T_rw)
