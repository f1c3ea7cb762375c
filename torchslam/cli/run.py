"""Run SLAM on a sequence and write trajectory, map, metrics and plots.

Without a calibration, or with `--camera auto`, the intrinsics are estimated from the images and written to
calibration.txt in the results. The final adjustment refines a given camera as well, which is a measurement with an
error (--camera-std).

A recording is mapped frame by frame first. Image pairs that mapping did not use then tell whether the map is right; if
they contradict it, or frames were lost, the recording is mapped as a whole, and the map that the pairs prefer is kept
(--mapping).

Exit status: 0 done, 2 an error, 3 no map could be initialized or no frame could be localized; 130 and 143 ended by
Ctrl-C and by SIGTERM (the results so far are written, and --resume continues from the last checkpoint).
"""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import torch

from torchslam.calibration.find_camera import (
    NUM_KEYPOINTS,
    ROUGH_STD,
    camera_remark,
    find_camera,
    with_stated_std,
)
from torchslam.cli import arguments
from torchslam.cli.densify import LONG_SIDE, add_options, densify_results, map_size
from torchslam.cli.progress import ProgressBars, StopSignals
from torchslam.config import Config, load_config
from torchslam.data import Sequence
from torchslam.data.calibration import CALIBRATION, check_replaceable, is_found
from torchslam.data.readers.video import KIND
from torchslam.data.sequence import Calibrated
from torchslam.errors import ConfigError, ResultsError
from torchslam.geometry import Camera
from torchslam.geometry.camera_measurement import may_be_same
from torchslam.global_mapping.links import learned_config
from torchslam.global_mapping.mapper import features_to_keep, mapping_config
from torchslam.global_mapping.recording import Mapping, run_recording
from torchslam.io.export.mesh import import_open3d
from torchslam.io.export.recording import import_rerun
from torchslam.io.report import compute_metrics, result_warnings, summary
from torchslam.io.results import CHECKPOINT, CONFIG, LIVE, MAP, STAGES, delete_unfinished, prepare
from torchslam.io.viewer.frames import VIDEO, FrameViewer, FrameViewers, LiveView, film_of
from torchslam.io.viewer.live_map import LiveMap
from torchslam.io.viewer.page import VIEW
from torchslam.io.write_run import source_of, write_run
from torchslam.system.checkpoint import read_checkpoint, write_checkpoint
from torchslam.system.front_end import KeptFeatures, source
from torchslam.system.online_run import OnlineRun, RunProgress
from torchslam.system.slam import SLAM
from torchslam.types import StepResult
from torchslam.utils.console import say, table, warn
from torchslam.utils.timing import cpu_seconds, peak_memory_mb

DONE = 0
"""Exit status with a map."""
NO_MAP = 3
"""Exit status without a map."""
CHECKPOINT_EVERY = 20  # keyframes
GROWTH = 0.05
"""Minimum ratio of new keyframes between two checkpoints, so that all checkpoints together cost O(n)."""


class Checkpoints:
    """Writes a checkpoint every few keyframes, whenever the system state allows it.

    Args:
        every: minimum number of keyframes between checkpoints, which is at least 5 % of all; 0: no checkpoints.
    """

    def __init__(self, folder: Path, every: int, slam: SLAM, so_far: RunProgress, sequence: Sequence) -> None:
        self._path, self._every = folder / CHECKPOINT, every
        self._run = slam, so_far, sequence
        self._last = self._keyframes()

    def offer(self, at_once: bool = False) -> None:
        """Write a checkpoint after a frame if one is due, or `at_once` before the run ends."""
        slam, so_far, sequence = self._run
        if not self._every or not slam.mapping or not slam.can_checkpoint:
            return
        keyframes = self._keyframes()
        if at_once or keyframes - self._last >= max(self._every, GROWTH * keyframes):
            write_checkpoint(self._path, slam, so_far, sequence)
            self._last = keyframes

    def _keyframes(self) -> int:
        return sum(submap.map.num_keyframes for submap in self._run[0].atlas)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `torchslam run`: first those that most people need, then the others in groups."""
    parser.usage = f"{parser.prog} PATH --output DIR [options]"
    arguments.add_sequence(parser)
    arguments.add_output(parser)
    existing = parser.add_mutually_exclusive_group()
    existing.add_argument("--overwrite", action="store_true", help="replace the results in the folder")
    existing.add_argument(
        "--resume", action="store_true", help="continue from the checkpoint in the folder, if there is one"
    )
    parser.add_argument(
        "--mapping",
        choices=[each.value for each in Mapping],
        default=Mapping.AUTO.value,
        help="auto: frame by frame, and then as a whole if frames were lost or image pairs contradict the map; "
        "online: frame by frame alone; global: as a whole in any case (default: %(default)s)",
    )
    parser.add_argument(
        "--dense", action="store_true", help="compute dense depth after the run, as `torchslam densify` does"
    )
    parser.add_argument("--view", action="store_true", help="show the run live in rerun (extra `rerun`)")
    arguments.add_device(parser)
    arguments.add_settings(parser)
    sessions = parser.add_argument_group("further sessions in a map")
    sessions.add_argument(
        "--map",
        type=Path,
        metavar="DIR|FILE",
        help="continue a saved map: a map file, or a results folder, whose configuration is the default for --config",
    )
    sessions.add_argument(
        "--localize", action="store_true", help="with --map: only localize, without changing the map"
    )
    execution = parser.add_argument_group("execution")
    arguments.add_processes(execution)
    execution.add_argument(
        "--checkpoint",
        type=arguments.at_least(0),
        default=CHECKPOINT_EVERY,
        metavar="N",
        help="save the state at most every N keyframes, and what global mapping finds, for --resume; 0: never "
        "(default: %(default)s)",
    )
    execution.add_argument(
        "--video", action="store_true", help=f"write {VIDEO}: the frames with their tracked keypoints"
    )
    execution.add_argument(
        "--live",
        action="store_true",
        help=f"write {LIVE} during the run: the map so far, as `torchslam app` shows it",
    )
    arguments.add_named_settings(parser).add_argument(
        "--refine-camera",
        action="store_true",
        help=f"the given focal length and distortion may be wrong: as --camera-std {ROUGH_STD:g}",
    )
    add_options(parser.add_argument_group("dense depth", "with --dense"))
    arguments.add_metric(parser)


def execute(options: argparse.Namespace) -> int:
    """Execute `torchslam run`; returns the exit status."""
    if options.map is not None and options.refine_camera:
        raise ConfigError("--refine-camera cannot be combined with --map: a map keeps its camera")
    if options.localize and options.map is None:
        raise ConfigError("--localize requires --map")
    if options.dense and options.localize:
        raise ConfigError(
            "--dense cannot be combined with --localize: a run that only localizes has no keyframes"
        )
    if not options.dense and (options.mesh or options.every or options.resolution != str(LONG_SIDE)):
        raise ConfigError("--resolution, --every and --mesh require --dense")
    if options.mesh:
        import_open3d()
    if options.view:
        import_rerun()
    if options.map is not None and options.map.is_dir():
        own = options.map / CONFIG
        options.config = options.config or (own if own.is_file() else None)
        options.map = options.map / MAP
    opened, config = arguments.sequence(options), arguments.config(options)
    if opened.calibrated is Calibrated.MISSING and not opened.is_live:
        say("no calibration found; estimating intrinsics from the images (--camera auto)")
        opened = opened.with_guess()
    if options.map is not None:  # what was measured belongs to the frames of the session before
        config = replace(config, metric=load_config(None, arguments.overrides(options)).metric)
    if options.dense:
        map_size(options.resolution, opened.size)  # raises now rather than after the run
    if options.mapping == Mapping.GLOBAL.value and _mode(opened, options) is None:
        raise ConfigError("--mapping global needs a recording, and no --map")
    status = run(opened, config, options)
    if options.dense and status == DONE:
        print(f"\n{table(densify_results(options.output, options))}")
    return status


def _mode(sequence: Sequence, options: argparse.Namespace) -> Mapping | None:
    """Whether a recording is mapped as a whole as well; None if it is no whole recording."""
    return None if sequence.is_live or options.map is not None else Mapping(options.mapping)


def run(sequence: Sequence, config: Config, options: argparse.Namespace) -> int:
    """Run, evaluate, write, draw, report; returns the exit status."""
    before_s = cpu_seconds()
    sources = arguments.metric_sources(config.metric, sequence)
    if sources and options.localize:
        raise ConfigError(
            "measurements of the unit cannot be combined with --localize: a map that is not changed keeps its unit"
        )
    mode = _mode(sequence, options)
    may_map = mode not in (None, Mapping.ONLINE)
    if may_map:
        learned_config(mapping_config(config))  # raises now rather than after the online run
    prepare(options.output, options.overwrite, options.resume)
    check_replaceable(options.output / CALIBRATION)
    latencies = list[float]()  # milliseconds from capture to pose, of a live source
    with StopSignals() as stop_signals, ExitStack() as viewers:
        kept = features_to_keep(config, sequence.size, NUM_KEYPOINTS, options.device) if may_map else None
        sequence, camera = _with_camera(sequence, config, options, kept)
        if options.camera_std is None:
            config = with_stated_std(config, sequence)
        slam, so_far = _begin(sequence, config, options)
        # Others are read again for their pictures, which takes less time than a picture of each frame.
        sequence.sends_pictures = options.live and sequence.kind == KIND
        sequence = source(sequence, config, slam.camera)
        (options.output / VIDEO).unlink(missing_ok=True)  # of an earlier run
        screens: list[FrameViewer] = [LiveView.spawn(slam)] if options.view else []
        screens += [film_of(sequence, options.output)] if options.video else []
        watching = viewers.enter_context(FrameViewers(slam, sequence, screens))
        live = LiveMap(slam, sequence, options.output) if options.live else None
        checkpoints = Checkpoints(options.output, options.checkpoint, slam, so_far, sequence)

        def after_frame(result: StepResult, is_last: bool) -> None:
            if sequence.is_live:
                latencies.append(1e3 * (time.time() - result.timestamp))
            # Global mapping may follow the last frame, which is worth a checkpoint.
            checkpoints.offer(at_once=stop_signals.is_wanted or (may_map and is_last))
            watching.show(result)
            if live is not None:
                live.offer(result)

        bars = ProgressBars(stop_signals, sequence.known_length, lambda: slam.map.num_points, after_frame)
        processes = 1 if screens else options.processes  # with viewers this process needs the images
        online = OnlineRun(slam, watching.sequence, so_far, processes, bars)
        stages = options.output / STAGES if options.checkpoint else None
        finished = run_recording(
            online, sequence, mode, sources, options.device, stages, kept, all_frames=bool(screens)
        )
        if finished.why:
            say(f"ran global mapping because {finished.why}; kept the {finished.kept} map")
        stop_signals.begin("when the results are written")
        metrics = compute_metrics(finished, sequence, camera_remark(finished, camera), warn)
        metrics |= _latency(latencies) | _usage(before_s) | source_of(options.path, options.fps, sequence)
        write_run(finished, sequence, metrics, options.output)
        watching.end(finished)
        (options.output / LIVE).unlink(missing_ok=True)
    rows = summary(metrics) | {"results": str(options.output), "view": str(options.output / VIEW)}
    rows |= {"video": str(options.output / VIDEO)} if options.video else {}
    print(f"\n{sequence.name}\n{table(rows)}")
    for warning in result_warnings(metrics):
        warn(warning)
    if finished.interrupted:
        goes_on = any((options.output / name).exists() for name in (CHECKPOINT, STAGES))
        say("interrupted; the results so far were written" + ("; --resume goes on" if goes_on else ""))
        return stop_signals.status
    delete_unfinished(options.output)
    if finished.failure:
        say(finished.failure)
        return NO_MAP
    return DONE


def _with_camera(
    sequence: Sequence, config: Config, options: argparse.Namespace, extract: KeptFeatures | None
) -> tuple[Sequence, str]:
    """Return the sequence with the camera of the run, and a remark on the camera if it was estimated."""
    is_guess = sequence.calibrated is Calibrated.GUESSED and not sequence.is_live
    if options.map is not None or not (options.refine_camera or is_guess):
        if not options.resume and is_found(options.output / CALIBRATION):
            (options.output / CALIBRATION).unlink()
        return sequence, ""
    if not is_guess:
        return sequence.with_camera(sequence.camera, std=ROUGH_STD), ""
    goes_on = options.resume and (options.output / CHECKPOINT).exists()

    def log(words: str) -> None:
        say(f"camera: {words}")

    return find_camera(sequence, config, options.output, options.device, goes_on, log, extract)


def _begin(sequence: Sequence, config: Config, options: argparse.Namespace) -> tuple[SLAM, RunProgress]:
    """Return a new system, or one restored from a checkpoint or a saved map, with its progress."""
    checkpoint = options.output / CHECKPOINT
    if options.resume and checkpoint.exists():
        slam, so_far = read_checkpoint(checkpoint, sequence, config, options.device)
        say(f"resuming at frame {so_far.next} of {sequence.known_length}")
        return slam, so_far
    if options.resume:
        saved = "; global mapping goes on with what it saved" if (options.output / STAGES).is_dir() else ""
        say(f"no checkpoint to resume from; starting with the first frame{saved}")
    if options.map is None:
        return SLAM(sequence.camera.to(options.device), config), RunProgress()
    slam = SLAM.load(options.map, config, mapping=not options.localize, device=options.device)
    known, mine = slam.camera.to("cpu"), sequence.camera.to(torch.float64)
    is_given = sequence.calibrated is Calibrated.GIVEN  # else the map's is the camera
    if known.size != mine.size or (is_given and not may_be_same(known, mine, config.camera.std)):
        raise ResultsError(
            f"{options.map}: the map was built with the camera {_describe(known)}, but the sequence has "
            f"{_describe(mine)}"
        )
    return slam, RunProgress()


def _describe(camera: Camera) -> str:
    numbers = ",".join(f"{number:.9g}" for number in camera.params.tolist())
    return f"{camera.model} {numbers} of {camera.width} x {camera.height} pixels"


def _latency(milliseconds: list[float]) -> dict[str, dict[str, float]]:
    """The latency of a live source, for metrics.json; empty of a recording."""
    if not milliseconds:
        return {}
    found = torch.tensor(milliseconds, dtype=torch.float64, device="cpu")
    return {"latency_ms": {"median": float(found.median()), "p95": float(found.quantile(0.95))}}


def _usage(before_s: float | None) -> dict[str, float]:
    """CPU time since `before_s` and peak memory, for metrics.json; empty on Windows, which does not count them.

    The workers of the run have ended, so that their time is included; that of live viewers is not.
    """
    now_s, peak_mb = cpu_seconds(), peak_memory_mb()
    if before_s is None or now_s is None or peak_mb is None:
        return {}
    return {"cpu_s": now_s - before_s, "peak_memory_mb": peak_mb}
