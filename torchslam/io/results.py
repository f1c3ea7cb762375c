"""The results folder of a run: the names of its files, and how they are read."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.formats.image_file import read_gray
from torchslam.data.tables import read_cells
from torchslam.data.text_file import read_object
from torchslam.data.trajectories import read_trajectory
from torchslam.dense.cloud import PointCloud
from torchslam.errors import ResultsError, TrajectoryError
from torchslam.evaluation import Evaluation, evaluate
from torchslam.geometry import Camera, rigid, transform
from torchslam.geometry.rolling_shutter import MAX_READOUT, Readout
from torchslam.geometry.zoom import Zoom
from torchslam.global_mapping.saved_stages import delete_stages
from torchslam.io.export.ply import read_cloud, upright_from_map
from torchslam.io.export.scene import (
    WITHOUT,
    ExampleFrame,
    ExportedScene,
    Images,
    ImageSource,
    open_images,
    scene_of,
)
from torchslam.io.file_names import (  # noqa: F401 -- the other modules find them here
    CHECKPOINT,
    CONFIG,
    DENSE_CLOUD,
    DEPTHS,
    EXAMPLE_IMAGE,
    FRAMES,
    GRAPH,
    GROUND_TRUTH,
    KEYFRAMES,
    LIVE,
    LOOPS,
    MAP,
    MESH,
    METRICS,
    ONLINE,
    OTHER_TRAJECTORY,
    PICTURE_NAMES,
    PICTURES,
    PLOTS,
    POINT_CLOUD,
    STAGE_SUFFIX,
    STAGES,
    TRAJECTORY,
)
from torchslam.loop_closing.records import LoopClosureRecord, read_closures
from torchslam.map.atlas import Submap
from torchslam.map.file import read_atlas
from torchslam.map.map import Map
from torchslam.optim.observation_graph import RunGraph
from torchslam.types import Explanation, State, StepResult, Trajectory
from torchslam.utils.console import is_unicode
from torchslam.utils.files import write_whole

MAX_COUNT = 1 << 31  # of indices, counts and numbers of submaps in files


@dataclass(frozen=True)
class SavedRun:
    """The content of metrics.json and the map of a results folder, read by `open_run`.

    `sessions` is the number of runs over the map that changed it.
    """

    directory: Path
    metrics: dict[str, Any]
    submaps: tuple[Submap, ...]
    camera: Camera
    sessions: int

    @property
    def session(self) -> int:
        """Number of the run on the map."""
        return int(self.metrics["session"])

    @property
    def main(self) -> Submap | None:
        """The main submap; None if there is none."""
        return next((each for each in self.submaps if each.number == self.metrics["submap"]), None)

    @property
    def map(self) -> Map:
        """Map of the main submap; empty if there is none."""
        return Map() if self.main is None else self.main.map

    @property
    def breaks(self) -> list[str]:
        """Where the check found the map broken, in words; empty without a check."""
        return list(map(str, (self.metrics.get("check") or {}).get("breaks", ())))

    @property
    def readout(self) -> Readout | None:
        """The readout of a rolling shutter; None for a global shutter."""
        return readout_of(self.metrics)

    @property
    def zoom(self) -> Zoom | None:
        """The zoom of the images, which is undone in all keypoints; None: one focal length."""
        plain = self.metrics.get("zoom")
        return None if plain is None else Zoom.from_plain(plain)

    @property
    def graph(self) -> RunGraph:
        """All observations as one differentiable problem, as `Run.graph`. Raises ResultsError if it is missing."""
        path = self.directory / GRAPH
        if not path.exists():
            raise ResultsError(
                f"{path}: no graph: there is no map, or an earlier version wrote it; run again"
            )
        return RunGraph.load(path)

    @property
    def loop_closures(self) -> tuple[LoopClosureRecord, ...]:
        """Closed loops and merges of submaps, with what was measured. Raises ResultsError if they are missing."""
        return tuple(read_closures(self.directory / LOOPS))

    def scene(self, submap: Submap, keyframes_alone: bool) -> ExportedScene:
        """The scene of the run in a submap, see `scene_of`. Raises ResultsError if there are no frames."""
        return scene_of(submap, self.camera, self.session, keyframes_alone, self.readout)

    def images(
        self,
        scene: ExportedScene,
        pinhole: Camera | None = None,
        elsewhere: str | None = None,
        otherwise: str = WITHOUT,
    ) -> Images:
        """Open the images of a scene, see `open_images`; `elsewhere` is their location if they were moved.

        Raises ResultsError if the images are missing or other ones, or frames.csv is missing or damaged.
        """
        path = elsewhere or self.metrics.get("source")
        if path is None:
            where = self.directory / METRICS
            raise ResultsError(f"{where}: the location of the images is unknown; {otherwise}")
        image, example = self.directory / EXAMPLE_IMAGE, None
        keyframe = example_keyframe(self.map, self.session)
        if keyframe is not None and image.exists():
            columns = self.map.keyframes
            frame, time = int(columns["frame_index"][keyframe]), float(columns["timestamp"][keyframe])
            example = ExampleFrame(frame, time, read_gray(image, str(image)))
        files = {result.index: file for result, file in _read_rows(self.directory / FRAMES) if file}
        as_stored = self.metrics.get("source_as_stored") is True
        source = ImageSource(path, self.metrics.get("source_fps"), files, example, as_stored, self.zoom)
        return open_images(source, scene, pinhole, otherwise)


@dataclass(frozen=True)
class Results(SavedRun):
    """All of a results folder, for plots and viewer.

    Attributes:
        trajectory, keyframes: camera to world in the main submap, in its units; possibly empty.
        groundtruth: in meters, if the sequence has it.
        others: trajectories in the other submaps, by submap number.
        frames: one result per frame, without poses.
        example_image: gray in [0, 1], of keyframe `example_keyframe(map, session)`, if readable.
        cloud: the dense cloud in the world of the main submap, if there is one.
    """

    trajectory: Trajectory
    keyframes: Trajectory
    groundtruth: Trajectory | None
    others: dict[int, Trajectory]
    frames: list[StepResult]
    example_image: Float[Tensor, "H W"] | None
    cloud: PointCloud | None = None

    def evaluation(self, path: Trajectory) -> Evaluation | None:
        """Return the errors of the poses in a submap; None without ground truth to compare with."""
        if self.groundtruth is None:
            return None
        try:
            return evaluate(path, self.groundtruth)
        except TrajectoryError:
            return None

    def truth(self, start: float, end: float) -> Trajectory:
        """Return the ground truth between two times; empty if there is none."""
        if self.groundtruth is None:
            return Trajectory.empty()
        times = self.groundtruth.timestamps
        during = (times >= start) & (times <= end)
        return Trajectory(times[during], self.groundtruth.T_wc[during])


def open_run(directory: Path) -> SavedRun:
    """Read metrics and map of a results folder. Raises ResultsError for missing or damaged files."""
    if not directory.is_dir():
        raise ResultsError(f"{directory}: no such results folder")
    metrics, saved = read_metrics(directory), read_atlas(directory / MAP)
    return SavedRun(directory, metrics, tuple(saved.atlas), saved.camera, saved.sessions)


def read_results(directory: Path) -> Results:
    """Read a results folder. Raises ResultsError, TrajectoryError or FrameError for missing or damaged files."""
    run = open_run(directory)
    main, metrics = run.main, run.metrics
    paths = {submap.number: directory / OTHER_TRAJECTORY.format(submap.number) for submap in run.submaps}
    truth, example, cloud = (directory / name for name in (GROUND_TRUTH, EXAMPLE_IMAGE, DENSE_CLOUD))
    return Results(
        **vars(run),
        trajectory=read_trajectory(directory / TRAJECTORY) if metrics["posed"] else Trajectory.empty(),
        keyframes=read_trajectory(directory / KEYFRAMES) if metrics["keyframes"] else Trajectory.empty(),
        groundtruth=read_trajectory(truth) if truth.exists() else None,
        others={number: read_trajectory(path) for number, path in paths.items() if path.exists()},
        frames=read_frames(directory / FRAMES),
        example_image=read_gray(example, str(example))[0, 0] if example.exists() else None,
        cloud=read_cloud(cloud, upright_from_map(main.map, main.metric)) if main and cloud.exists() else None,
    )


def aligned(trajectory: Trajectory, S: Float[Tensor, "4 4"]) -> Trajectory:
    """Return a trajectory after a similarity of the world."""
    return Trajectory(trajectory.timestamps, aligned_poses(trajectory.T_wc, S))


def aligned_poses(T_wc: Float[Tensor, "N 4 4"], S: Float[Tensor, "4 4"]) -> Float[Tensor, "N 4 4"]:
    """Return poses after a similarity of the world."""
    rotation = S[:3, :3] / torch.linalg.det(S[:3, :3]) ** (1 / 3)
    return rigid(rotation @ T_wc[:, :3, :3], transform(S, T_wc[:, :3, 3]))


def example_keyframe(slam_map: Map, session: int) -> int | None:
    """Return the keyframe in the middle of the session, for the example plot; None if there is none."""
    rows = slam_map.keyframe_rows(session)
    return int(rows[len(rows) // 2]) if len(rows) else None


def prepare(folder: Path, overwrite: bool, resume: bool) -> None:
    """Create the results folder and check that it can be written to, before the run.

    To overwrite deletes the checkpoint and the saved stages of existing results at once; to resume continues from them.
    Raises ResultsError if the folder has results that would be lost, or a name with which they could not be read again,
    OSError if it cannot be written to.
    """
    if not is_unicode(str(folder.absolute())):
        raise ResultsError(
            f"{folder}: its name is not UTF-8, so that maps in it could not be read: choose another one"
        )
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / ".torchslam-can-write"
    write_whole(probe, b"")
    probe.unlink()
    there = results_in(folder)
    unfinished = [path for path in (folder / CHECKPOINT, folder / STAGES) if path.exists()]
    if overwrite:
        delete_unfinished(folder)
    elif unfinished and not resume:
        raise ResultsError(
            f"{unfinished[0]}: an unfinished run: --resume continues it, --overwrite replaces it"
        )
    elif there and not unfinished:
        what = "but no checkpoint to resume from" if resume else "which would be lost"
        raise ResultsError(f"{there[0]}: results of an earlier run, {what}: --overwrite replaces them")


def results_in(directory: Path) -> list[Path]:
    """Return the files in a folder that a run would replace."""
    tables = (METRICS, TRAJECTORY, KEYFRAMES, ONLINE, GROUND_TRUTH, CONFIG, FRAMES)
    names = (*tables, MAP, GRAPH, LOOPS, POINT_CLOUD, EXAMPLE_IMAGE)
    return [directory / name for name in names if (directory / name).exists()]


def delete_unfinished(folder: Path) -> None:
    """Delete what an unfinished run would be resumed from."""
    (folder / CHECKPOINT).unlink(missing_ok=True)
    delete_stages(folder / STAGES)


def delete_dense(directory: Path) -> bool:
    """Delete dense depth and the mesh; return whether there was any."""
    found = [directory / name for name in (DENSE_CLOUD, DEPTHS, MESH) if (directory / name).exists()]
    for path in [*found, *(directory / PICTURES).glob(PICTURE_NAMES)]:
        path.unlink()
    return bool(found)


def read_metrics(directory: Path) -> dict[str, Any]:
    """Read metrics.json. Raises ResultsError if it is missing or invalid."""
    path = directory / METRICS
    metrics = read_object(path, ResultsError)
    if metrics is None:
        raise ResultsError(f"{path}: cannot be read: No such file or directory")
    needed = ("submap", "submaps", "session", "posed", "keyframes")  # to read and draw the rest
    missing = [name for name in needed if name not in metrics]
    if missing:
        raise ResultsError(f"{path}: not the metrics of a run: {', '.join(missing)} missing")
    for name, is_right in _METRIC_CHECKS.items():
        if name in metrics and not is_right(metrics[name]):
            raise ResultsError(f"{path}: not the metrics of a run: {name} is {repr(metrics[name])[:100]}")
    return metrics


def write_metrics(directory: Path, metrics: dict[str, Any]) -> None:
    """Write metrics.json, atomically."""
    write_whole(directory / METRICS, (json.dumps(metrics, indent=2) + "\n").encode())


def readout_of(metrics: dict[str, Any]) -> Readout | None:
    """The readout of a rolling shutter that a run found or was given; None for a global shutter."""
    entry = metrics.get("readout")
    return None if entry is None else Readout.known(1e-3 * entry["ms"], 1e-3 * entry["std_ms"])


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < MAX_COUNT


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def _is_readout(value: Any) -> bool:
    numbers: list[Any] = [value.get("ms"), value.get("std_ms")] if isinstance(value, dict) else [None]
    return value is None or all(_is_number(each) and abs(each) <= 1e3 * MAX_READOUT for each in numbers)


def _is_zoom(value: object) -> bool:
    try:
        return value is None or bool(Zoom.from_plain(value))
    except ValueError:
        return False


def _are_submaps(value: object) -> bool:
    submaps = value if isinstance(value, list) else [None]
    return all(isinstance(submap, dict) and _is_count(submap.get("submap")) for submap in submaps)


# Validation of the entries that are read from metrics.json.
_METRIC_CHECKS: dict[str, Callable[[Any], bool]] = {
    "submap": lambda value: value is None or _is_count(value),
    "submaps": _are_submaps,
    "ate_m": _is_number,
    "readout": _is_readout,
    "zoom": _is_zoom,
    **dict.fromkeys(("session", "posed", "keyframes"), _is_count),
    "failure": lambda value: isinstance(value, str),
    "source": lambda value: value is None or isinstance(value, str),
}


def read_frames(path: str | Path) -> list[StepResult]:
    """Read the rows of frames.csv, without poses. Raises ResultsError naming file and line."""
    return [result for result, _ in _read_rows(path)]


def _read_rows(path: str | Path) -> list[tuple[StepResult, str]]:
    """The frames and their files, empty if frames are no files."""
    rows = read_cells(path, ResultsError, 1 << 28, ",")  # enough for two million frames
    header = next(rows, ("", []))[1]
    cells = ((where, dict(zip(header, each, strict=True))) for where, each in rows)
    # Folders that earlier versions wrote have no files.
    return [(_frame_result(row, where), row.get("image") or "") for where, row in cells]


def _frame_result(row: dict[str, str], where: str) -> StepResult:
    try:
        return StepResult(
            index=_count(row["index"]),
            timestamp=_finite(row["timestamp"]),
            state=State(row["state"]),
            T_cw=None,
            submap=_count(row["submap"]) if row["submap"] else None,
            is_keyframe=bool(_count(row["keyframe"])),
            matches=_count(row["matches"]),
            inliers=_count(row["inliers"]),
            reasons=Explanation.parsed(row["reason"]),
            stage_ms={
                name.removesuffix(STAGE_SUFFIX): _finite(value)
                for name, value in row.items()
                if name.endswith(STAGE_SUFFIX) and value
            },
        )
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise ResultsError(f"{where}: not a row of frames.csv: {error}") from None


def _count(text: str) -> int:
    number = int(text)
    if not 0 <= number < MAX_COUNT:
        raise ValueError(f"`{text}` is not a count")
    return number


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"`{text}` is not a finite number")
    return number
