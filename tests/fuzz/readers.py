"""Everything that reads what a stranger wrote: good input, and how it is read."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path

import torch
from safetensors.torch import save

from tests.fuzz import conventions, meant_values, named_images, valid_inputs
from tests.fuzz.mutators import Files
from tests.fuzz.sample_files import CONFIG, OVERRIDES, WALK, sample_files
from tests.walks import T_cw
from torchslam import SLAM
from torchslam.batch import Row, Task, read_list
from torchslam.batch.result_store import RUNS
from torchslam.batch.results_table import collect_rows, read_times
from torchslam.batch.task import configuration
from torchslam.cli.main import main
from torchslam.config import Config, load_config, to_toml
from torchslam.data import open_sequence, parse_camera, read_calibration, read_trajectory
from torchslam.data.formats.depth_images import find_depth_images, read_depth
from torchslam.data.formats.fix_files import read_fixes
from torchslam.data.formats.given_poses import read_poses
from torchslam.data.formats.image_file import read_color, read_gray
from torchslam.data.formats.vehicle_files import read_speeds
from torchslam.data.inertial import InertialSamples, read_imu, read_inertial_calibration
from torchslam.data.sequence import Sequence
from torchslam.dense import DepthMaps
from torchslam.errors import CalibrationError, ConfigError, FrameError, InitializationError, ResultsError
from torchslam.features.learned import ALIKED, XFeat
from torchslam.geometry import Camera, SensorModel
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.nerfstudio import write_nerfstudio
from torchslam.io.export.ply import read_cloud, upright_from_map, write_map_cloud
from torchslam.io.export.scene import scene_of, undistorted
from torchslam.io.results import read_results
from torchslam.io.viewer.page import encoded, page, page_data
from torchslam.map.atlas import Submap
from torchslam.map.file import read_atlas, write_atlas
from torchslam.map.posed_frames import RunGraph
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import solve_graph
from torchslam.system.checkpoint import read_checkpoint
from torchslam.system.front_end import Simulated
from torchslam.system.online_run import OnlineRun
from torchslam.system.session import Session
from torchslam.tracking.learned_matchers import LightGlue

CAMERA = "60,61,31.5,23.5"
IMAGES = ("png", "jpg", "bmp", "tif", "webp", "pgm", "ppm", "color.png", "color.jpg", "1.png", "16.png")
WEIGHTS = {"a.b": torch.zeros(3), "c": torch.ones(2, 2)}
ALIKED_WEIGHTS = {"block1.conv1.weight": torch.ones(8, 1, 3, 3), "desc_head.agg_weights": torch.ones(16, 1)}
MATCHER_WEIGHTS = {
    "matcher.input_proj.weight": torch.ones(64, 32),
    "matcher.posenc.Wr.weight": torch.ones(32, 2),
    "matcher.self_attn.0.Wqkv.weight": torch.ones(192, 64),
}
RECORD_OF = "0123456789abcdef"
FRAMES = 4
"""Frames of a sequence that are read."""


@dataclass(frozen=True)
class Reader:
    """make: good input, by names in a folder; read: reads that folder; inputs: how many of 30,000 are for it; generate:
    makes an input that is valid and says what it means, in place of a damaged one"""

    name: str
    make: Callable[[], Files]
    read: Callable[[Path], object]
    inputs: int
    generate: Callable[[random.Random], Files] | None = None

    @cached_property
    def files(self) -> Files:
        return self.make()


@cache
def readers() -> dict[str, Reader]:
    """All of them by name."""
    found = [
        Reader("tum", valid_inputs.tum, _sequence, 2200),
        Reader("euroc", valid_inputs.euroc, _sequence, 1700),
        Reader("imu", valid_inputs.imu, _imu, 900),
        Reader("kitti", valid_inputs.kitti, _sequence, 1700),
        Reader("kitti raw", valid_inputs.kitti_raw, partial(_sequence, name="drive_sync"), 1700),
        Reader("7-scenes", valid_inputs.seven_scenes, partial(_sequence, camera=CAMERA), 1000),
        Reader("tartanair", valid_inputs.tartanair, partial(_sequence, camera=CAMERA), 1000),
        Reader("icl-nuim", valid_inputs.icl_nuim, partial(_sequence, camera=CAMERA), 800),
        Reader("folder", valid_inputs.folder, _sequence, 1000),
        Reader(
            "masks", valid_inputs.masked, partial(_sequence, name="frames", camera=CAMERA, mask="masks"), 700
        ),
        Reader("zip", valid_inputs.zipped, partial(_sequence, name="desk.zip"), 2500),
        Reader("camera argument", lambda: {"argument": b""}, _camera_argument, 700),
        Reader("frame arguments", valid_inputs.folder, _frame_arguments, 700),
        Reader("trajectory", lambda: {"t.txt": valid_inputs.trajectory_text(6).encode()}, _trajectory, 1000),
        Reader(
            "calibration conventions",
            lambda: conventions.example(random.Random("calibration conventions")),
            conventions.check,
            1500,
        ),
        Reader("zip of a video", valid_inputs.zipped_video, partial(_sequence, name="v.zip"), 300),
        Reader("colmap binary", partial(_some, "colmap", "cameras.bin", "images.bin"), read_poses, 600),
        Reader("colmap text", partial(_some, "colmap", "cameras.txt", "images.txt"), read_poses, 600),
        Reader("transforms.json", partial(_some, "transforms", "transforms.json"), read_poses, 900),
        Reader("map", partial(_some, "results", "map.safetensors"), _map, 2000),
        Reader("checkpoint", partial(_some, "checkpoint", "checkpoint.safetensors"), _checkpoint, 900),
        Reader("graph", lambda: sample_files()["graph"], _graph, 1200),
        Reader("results", lambda: sample_files()["results"], _results, 1700),
        Reader(
            "dense cloud", lambda: sample_files()["dense"], lambda root: read_cloud(root / "dense.ply"), 500
        ),
        Reader("depth maps", lambda: sample_files()["depths"], _depths, 600),
        Reader("weights", lambda: {"w.safetensors": save(WEIGHTS)}, _weights, 200),
        Reader("weights aliked", lambda: {"w.safetensors": save(ALIKED_WEIGHTS)}, _aliked, 200),
        Reader("weights lightglue", lambda: {"w.safetensors": save(MATCHER_WEIGHTS)}, _lightglue, 300),
        Reader("toml", lambda: {"c.toml": to_toml(Config()).encode()}, _toml, 1200),
        Reader("--set", lambda: {"argument": b""}, _override, 800),
        Reader("settings of a run", lambda: {"argument": b""}, _settings, 120),
        Reader("command line", valid_inputs.tum, _command, 300),
        Reader(
            "batch csv", lambda: {"l.csv": valid_inputs.BATCH_CSV.encode()}, partial(_list, name="l.csv"), 600
        ),
        Reader(
            "batch text",
            lambda: {"l.txt": valid_inputs.BATCH_TEXT.encode()},
            partial(_list, name="l.txt"),
            300,
        ),
        Reader("batch record", _row_and_times, _record, 400),
    ]
    found += [
        Reader(name, partial(generate, random.Random(0)), read, inputs, generate)
        for name, generate, read, inputs in (
            ("names of images", named_images.named_folder, named_images.read_named_folder, 1500),
            ("times of images", named_images.listed_images, named_images.read_listed_images, 600),
            ("images of results", named_images.changed_folder, named_images.read_changed_folder, 900),
        )
    ]
    found += [
        Reader(
            f"values {kind}",
            partial(make, random.Random(0)),
            partial(meant_values.check, kind=kind),
            inputs,
            make,
        )
        for kind, (make, _, inputs) in meant_values.VALUES.items()
    ]
    found += [
        Reader(f"image {kind}", partial(_kind, valid_inputs.images, kind), _image, 250) for kind in IMAGES
    ]
    found += [
        Reader(f"calibration {kind}", partial(valid_inputs.CALIBRATIONS.__getitem__, kind), _calibration, 300)
        for kind in valid_inputs.CALIBRATIONS
    ]
    for kind in valid_inputs.positions():
        make = partial(_kind, valid_inputs.positions, kind)
        name = "" if kind in ("exif", "oxts") else f"a.{kind.split()[0]}"
        found.append(Reader(f"positions {kind}", make, partial(_fixes, name=name), 200))
    speeds = {"v.csv": b"time_ms;speed_km_h\n0;3.6\n500;7.2\n1000;0\n"}
    found.append(Reader("speeds", lambda: speeds, lambda root: _speeds(root / "v.csv"), 200))
    found.append(Reader("depth", valid_inputs.depth_images, _depth, 300))
    for kind in ("mp4", "avi"):
        make = partial(_kind, valid_inputs.videos, kind)
        found.append(Reader(f"video {kind}", make, partial(_sequence, name=f"v.{kind}"), 900))
    for kind, name in (("ros1", "r.bag"), ("sqlite3", "r"), ("mcap", "r")):
        found.append(
            Reader(f"bag {kind}", partial(_kind, valid_inputs.bags, kind), partial(_sequence, name=name), 700)
        )
    return {reader.name: reader for reader in found}


def _fixes(root: Path, name: str) -> None:
    """All positions are on the Earth, and times rise."""
    fixes = read_fixes(root / name)
    assert len(fixes) > 0
    assert bool((fixes.geodetic[:, 0].abs() <= 90).all())
    assert bool(fixes.geodetic[:, 1].isfinite().all())
    assert fixes.timestamps is None or bool((fixes.timestamps.diff() > 0).all())
    assert fixes.timestamps is None or bool(fixes.timestamps.isfinite().all())


def _speeds(path: Path) -> None:
    speeds = read_speeds(path)
    assert bool(speeds.speeds.isfinite().all())
    assert bool((speeds.timestamps.diff() > 0).all())


def _depth(root: Path) -> None:
    """Times rise, and depths are numbers."""
    images = find_depth_images(root)
    assert images.timestamps is None or bool((images.timestamps.diff() > 0).all())
    for path in images.paths[:FRAMES]:
        assert bool(torch.from_numpy(read_depth(path, images.units_per_meter)).isfinite().all())


def _kind(make: Callable[[], dict[str, Files]], kind: str) -> Files:
    return make()[kind]


def _row_and_times() -> Files:
    record = {
        "name": "a",
        "configuration": RECORD_OF,
        "input": "2",
        "status": "done",
        "error": "",
        "posed": 3,
    }
    record |= {"frames": 4, "ate_m": 0.25, "path_length_m": 1.5, "camera": "as given", "initialized_at": None}
    times = {"cpu_s": 1.5, "fps": 12.0, "stage_ms": {"total": {"median": 2.0}}}
    files = {"row.json": record, "times.json": times}
    return {name: json.dumps(content, indent=2).encode() for name, content in files.items()}


def _some(kind: str, *names: str) -> Files:
    files = sample_files()[kind]
    return {name: files[name][:6000] if name == "images.txt" else files[name] for name in names}


def _sequence(root: Path, name: str = "", camera: str | None = None, mask: str | None = None) -> Sequence:
    sequence = open_sequence(root / name, camera, mask=None if mask is None else root / mask)
    return _frames(sequence)


def _imu(root: Path) -> InertialSamples:
    samples = read_imu(root / "imu.csv")
    calibration = read_inertial_calibration(root / "camera.yaml", root / "imu.csv")
    assert calibration.T_bc is not None
    assert bool(calibration.T_bc.isfinite().all())
    for part in (samples.timestamps, samples.gyroscope, samples.accelerometer):
        assert bool(part.isfinite().all())
    assert bool((samples.timestamps.diff() > 0).all())
    return samples


def _frames(sequence: Sequence) -> Sequence:
    """The sequence, of which some frames were read; the first error of a frame is raised in the end."""
    failure: FrameError | None = None
    assert len(sequence) > 0
    assert bool(sequence.timestamps.isfinite().all())
    assert bool((sequence.timestamps.diff() > 0).all())
    assert all("\n" not in line for line in (*sequence.describe().values(), *sequence.notes))
    with contextlib.suppress(CalibrationError):
        assert bool(sequence.camera.params.isfinite().all())
    for index in range(min(len(sequence), FRAMES)):
        try:
            frame = sequence[index]
            assert frame.image.shape[2:] == sequence.size[::-1]
            assert bool(frame.image.isfinite().all())
            assert frame.T_cw_groundtruth is None or bool(frame.T_cw_groundtruth.isfinite().all())
            assert sequence.color(index).shape[:2] == sequence.size[::-1]
        except FrameError as error:
            failure = failure or error
    if failure is not None:
        raise failure
    return sequence


def _argument(root: Path) -> str:
    """What stands in the file `argument`, as the command line would have it."""
    path = root / "argument"
    return os.fsdecode(path.read_bytes()) if path.is_file() and not path.is_symlink() else ""


def _camera_argument(root: Path) -> None:
    camera = parse_camera(_argument(root), (640, 480))
    assert bool(camera.params.isfinite().all())
    assert bool((camera.params[:2] > 0).all())


def _frame_arguments(root: Path) -> object:
    key, _, value = _argument(root).partition("=")
    options: dict[str, object] = {}
    if key in ("fps", "stride", "limit"):
        try:
            options[key] = float(value) if key == "fps" else max(1, int(value))
        except ValueError:  # argparse has said so
            return None
    else:
        options["resize_to" if key == "resize" else "stop" if key == "stop" else "start"] = value
    return _frames(open_sequence(root / "images", CAMERA, **options))  # type: ignore[arg-type]


def _trajectory(root: Path) -> None:
    trajectory = read_trajectory(root / "t.txt")
    assert bool(trajectory.T_wc.isfinite().all())
    assert bool((trajectory.timestamps.diff() > 0).all())


def _map(root: Path) -> None:
    saved = read_atlas(root / "map.safetensors")
    for submap in saved.atlas:
        assert bool(submap.trajectory().T_wc.isfinite().all())
        submap.posed_frames.graph(submap.map, SensorModel(saved.camera))
        with contextlib.suppress(ResultsError):  # of a submap without frames
            _export(submap, saved.camera, root / "export")
    session = Session.load(root / "map.safetensors")
    write_atlas(root / "again", session.atlas, session.camera, session.number)
    read_atlas(root / "again")


def _export(submap: Submap, camera: Camera, folder: Path) -> None:
    """Write a submap for other programs, which read nothing but numbers."""
    scene = scene_of(submap, camera, 0, keyframes_alone=False)
    write_colmap(folder, scene)
    read_poses(folder)
    R_up = upright_from_map(submap.map)
    write_nerfstudio(folder, scene, R_up)
    strict_json((folder / "transforms.json").read_text())
    write_map_cloud(folder / "map.ply", submap.map, 0)
    undistorted(scene)


def strict_json(text: str) -> object:
    """JSON as a browser reads it: without NaN."""
    return json.loads(text, parse_constant=_refuse)


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} in JSON")


def _checkpoint(root: Path) -> None:
    seen = Simulated(CONFIG, WALK.camera, T_cw(WALK)).of(WALK)
    slam, so_far = read_checkpoint(root / "checkpoint.safetensors", WALK, CONFIG)
    assert slam.last_frame is not None
    if so_far.next < len(WALK):
        slam.step(seen[so_far.next])


def _graph(root: Path) -> object:
    graph = RunGraph.load(root / "graph.safetensors")
    return solve_graph(graph, options=GRAPH_OPTIONS.replace(iterations=1))


def _results(root: Path) -> str:
    results = read_results(root)
    strict_json(json.dumps(page_data(results), default=encoded))
    return page(results)


def _depths(root: Path) -> None:
    path = root / "depths.safetensors"
    maps, blocks = DepthMaps.load(path), list(DepthMaps.blocks(path, 2))
    assert torch.equal(torch.cat([block.depth for block in blocks]), maps.depth) if blocks else not len(maps)
    maps.save(root / "again")
    assert torch.equal(DepthMaps.load(root / "again").normal, maps.normal)


def _weights(root: Path) -> object:
    return XFeat(root / "w.safetensors")


def _aliked(root: Path) -> object:
    return ALIKED(root / "w.safetensors")


def _lightglue(root: Path) -> object:
    return LightGlue(root / "w.safetensors")


def _toml(root: Path) -> None:
    _whole(load_config(root / "c.toml"))


def _override(root: Path) -> None:
    text = _argument(root)
    if "\0" not in text:
        _whole(load_config(None, [text]))


def _settings(root: Path) -> None:
    """A run ends whatever the numbers of its settings are."""
    config = load_config(None, [*OVERRIDES, _argument(root)])
    with contextlib.suppress(InitializationError):
        OnlineRun(SLAM(WALK.camera, config), WALK).run()


def _whole(config: Config) -> None:
    """A configuration can be written and read."""
    assert bool(to_toml(config))


def _list(root: Path, name: str) -> None:
    rows = read_list(root / name)
    names = [row.name for row in rows]
    assert len({name.casefold() for name in names}) == len(rows) > 0
    assert all(Path(name).name == name and name.isprintable() and not name.startswith(".") for name in names)
    for row in rows:
        assert Task.from_dict(json.loads(json.dumps(Task(row, "").as_dict()))) == Task(row, "")
        with contextlib.suppress(ConfigError):  # of settings, which is the row's error
            configuration(Task(row, ""))


def _record(root: Path) -> None:
    """Whatever a record is, the row of the table is there, and can be written."""
    place = root / RUNS / "a"
    for path in root.glob("*.json"):
        place.mkdir(parents=True, exist_ok=True)
        path.rename(place / path.name)
    (row,) = collect_rows([Task(Row("a", "missing"), str(root))], [RECORD_OF], root)
    assert isinstance(row["status"], str)
    assert json.dumps(row, ensure_ascii=False).encode()
    assert all(
        value is None or not isinstance(value, float) or abs(value) < math.inf for value in row.values()
    )
    read_times(place)


def _image(root: Path) -> None:
    path = next(root.iterdir(), root / "a")
    gray = read_gray(path, str(path))
    assert bool(gray.isfinite().all())
    assert 0 <= float(gray.min()) <= float(gray.max()) <= 1
    assert read_color(path, str(path)).shape[2] == 3


def _calibration(root: Path) -> None:
    named = [path for path in sorted(root.iterdir()) if path.name.startswith("c.")]
    calibration = read_calibration(next(iter(named), root / "c.txt"))
    camera = calibration.camera(calibration.size or (640, 480))
    assert bool(camera.params.isfinite().all())
    assert bool((camera.params[:2] > 0).all())


class CommandError(Exception):
    """What a command said before it ended with status 2."""


def _command(root: Path) -> None:
    said = io.StringIO()
    truth = str(root / "groundtruth.txt")
    for arguments in (["info", str(root)], ["eval", truth, truth]):
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            status = main(arguments)
        if status:
            assert status == 2
            (line,) = (line for line in said.getvalue().split("\n") if "error:" in line)
            assert root.name in line
            return
