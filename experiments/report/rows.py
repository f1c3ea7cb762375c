"""One row of the report: run the default command on a recording, read its results folder, judge the poses."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from experiments.benchmarks.slam.run import OURS, PEER, RECORDINGS, Metrics, measured
from experiments.benchmarks.slam.run import Recording as Timed
from experiments.common import DATA_DIR, DRONE_TRUTH, Usage, run_command
from experiments.report.record import ROOT
from experiments.trials.judging import extent, wrong
from torchslam.cli.run import NO_MAP
from torchslam.data.trajectories import nearest, read_trajectory
from torchslam.errors import TrajectoryError
from torchslam.evaluation import Evaluation, evaluate
from torchslam.io.results import FRAMES, ONLINE, TRAJECTORY, read_frames, read_metrics
from torchslam.types import State, Trajectory

Row = dict[str, Any]
TRUTH = "groundtruth.txt"
PEERS_SCRIPTS = DATA_DIR.parent / "peers"
CACHE = Path("results/peers")
"""Trajectories of pycolmap's global mapper, NAME/trajectory.txt; computed once."""
SAME_FRAME = 1e-4
"""Seconds within which a pose belongs to a frame; files have six decimals or more."""


@dataclass(frozen=True)
class Recording:
    """A recording of the report.

    Attributes:
        name: file or folder in the data.
        title: its name in tables.
        unit: of the ground truth; empty if it is arbitrary.
        truth: file with the true poses in the data; None: groundtruth.txt in the folder, if it is there.
        has_peer: whether pycolmap's global mapper is compared with.
        timed: the frames that ORB-SLAM3 processes in turn.
    """

    name: str
    title: str
    unit: str = "m"
    truth: str | None = None
    has_peer: bool = False
    timed: Timed | None = None

    @property
    def truth_file(self) -> Path:
        return DATA_DIR / (self.truth or f"{self.name}/{TRUTH}")


_TIMED = {each.name: each for each in (*RECORDINGS, Timed("tsukuba", 150, 30))}
ALL = {
    each.name: each
    for each in (
        Recording("redkitchen", "redkitchen (7-Scenes)", timed=_TIMED["redkitchen"]),
        Recording("machine_hall", "machine_hall (EuRoC MH_01)", timed=_TIMED["machine_hall"]),
        Recording("kitti07", "kitti07 (KITTI odometry 07)", timed=_TIMED["kitti07"]),
        Recording("tsukuba", "tsukuba (New Tsukuba)", unit="cm", timed=_TIMED["tsukuba"]),
        Recording("shelf_bin", "shelf_bin (robot arm)"),
        Recording("fr2_desk_20", "fr2_desk_20 (TUM RGB-D)"),
        Recording("standstill", "standstill (EuRoC V1_01, camera at rest)"),
        Recording("garden", "garden (phone)", unit="", has_peer=True),
        Recording("office_loop", "office_loop (uncalibrated)", has_peer=True),
        Recording("courthouse", "courthouse (uncalibrated)", has_peer=True),
        Recording("drone.mp4", "drone.mp4 (video, uncalibrated)", unit="", truth=DRONE_TRUTH),
    )
}
"""By name, in the order of the tables. The true poses of garden and drone.mp4 are COLMAP's: their unit is arbitrary."""


def run_row(recording: Recording, folder: Path, peers: Path | None = None, with_online: bool = False) -> Row:
    """Run the default command on a recording and measure it from outside.

    Args:
        recording: what to run on.
        folder: receives the results folder and the log.
        peers: environment of the peers; None: nothing is compared with them.
        with_online: whether to run `--mapping online` as well, for the ratio of the CPU times.
    """
    status, used = run_default(recording, folder)
    row: Row = {
        "exit_status": status,
        "cpu_s": round(used.cpu_s, 1),
        "wall_s": round(used.wall_s, 1),
        "peak_mb": round(used.peak_mb),
    }
    if status not in (0, NO_MAP):
        return row
    peer = peer_trajectory(recording, peers) if recording.has_peer else None
    row |= read_row(folder / recording.name, recording.truth_file, None if peer is None else peer.parent)
    if with_online:
        _, online = run_default(recording, folder / "online", "--mapping", "online")
        row["cpu_to_online"] = round(used.cpu_s / online.cpu_s, 2)
    if peers is not None and recording.timed is not None:
        row["timed"] = frame_times(recording.timed, peers)
    return row


def run_default(recording: Recording, folder: Path, *options: str) -> tuple[int, Usage]:
    """Run the command of a user with this checkout; returns exit status and usage."""
    output, log = folder / recording.name, folder / f"{recording.name}.log"
    shutil.rmtree(output, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    line = [sys.executable, "-m", "torchslam", "run", str(DATA_DIR / recording.name), "-o", str(output)]
    with log.open("w") as file:
        return run_command([*line, *options], file, file, os.environ | {"PYTHONPATH": str(ROOT)})


def read_row(results: Path, truth_file: Path, peer: Path | None = None) -> Row:
    """The figures of a results folder.

    Args:
        results: the folder.
        truth_file: the true poses; need not exist.
        peer: folder with the trajectory of another program and its figures; None: there is none.
    """
    metrics = read_metrics(results)
    names = ("frames", "posed", "online_posed", "uncertain", "lost", "keyframes")
    row: Row = {name: metrics[name] for name in names}
    row |= {"kept": metrics.get("mapping"), "why_global": metrics.get("mapping_reason", "")}
    row |= {name: round(metrics[name], 1) for name in ("ms_median", "ms_p95", "ms_longest")}
    truth = read_trajectory(truth_file) if truth_file.is_file() else None
    if truth is not None:
        row["extent"] = significant(extent(truth.positions_w))
        online, final = (evaluated(results / name, truth) for name in (ONLINE, TRAJECTORY))
        row["online_ate"] = None if online is None else significant(online.ate_m)
        row["ate"] = None if final is None else significant(final.ate_m)
    if peer is not None:
        row["peer"] = json.loads((peer / "peer.json").read_text())
        row["peer"] |= compare_poses(peer / TRAJECTORY, results / TRAJECTORY) if row["posed"] else {}
        if truth is not None and (found := evaluated(peer / TRAJECTORY, truth)) is not None:
            row["peer"]["ate"] = significant(found.ate_m)
    reference = read_trajectory(peer / TRAJECTORY) if truth is None and peer is not None else truth
    if reference is not None:
        row |= {"judged_by": "truth" if truth is not None else "pycolmap"} | judged(results, reference)
    return row


def evaluated(path: Path, truth: Trajectory) -> Evaluation | None:
    """Compare a trajectory file with the truth; None without poses, or with too few of them."""
    try:
        return evaluate(read_trajectory(path), truth)
    except TrajectoryError:
        return None


def judged(results: Path, reference: Trajectory) -> Row:
    """How many frames with a final pose are right and wrong, and which of them are called uncertain.

    A pose is wrong as in `trials.judging.wrong`. Only frames with a reference pose are judged.
    """
    found = evaluated(results / TRAJECTORY, reference)
    if found is None:
        return dict.fromkeys(("judged", "uncertain_right", "uncertain_wrong", "certain_wrong"), 0)
    bad = wrong(found.matched.T_wc, found.groundtruth.T_wc, extent(reference.positions_w))
    frames = read_frames(results / FRAMES)
    times = torch.tensor([frame.timestamp for frame in frames], dtype=torch.float64)
    index, apart = nearest(found.matched.timestamps, times)
    if bool((apart > SAME_FRAME).any()):
        raise SystemExit(f"{results}: {TRAJECTORY} has poses at times that are not in {FRAMES}")
    doubted = torch.tensor([frame.state is State.UNCERTAIN for frame in frames])[index]
    return {
        "judged": len(bad),
        "uncertain_right": int((doubted & ~bad).sum()),
        "uncertain_wrong": int((doubted & bad).sum()),
        "certain_wrong": int((~doubted & bad).sum()),
    }


def peer_trajectory(recording: Recording, peers: Path | None, cache: Path = CACHE) -> Path | None:
    """The trajectory of pycolmap's global mapper on the same images, from the cache or else computed.

    Args:
        recording: whose images.
        peers: environment of the peers; None: only the cache is read.
        cache: folder of the trajectories.
    """
    folder = cache / recording.name
    if (folder / "peer.json").is_file():
        return folder / TRAJECTORY
    if peers is None:
        return None
    line = [str(peers / "bin" / "python"), str(PEERS_SCRIPTS / "run_global.py")]
    done = subprocess.run(
        [*line, str(DATA_DIR / recording.name), str(folder.absolute())],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    figures = json.loads(done.stdout.splitlines()[-1])
    kept = {"system": figures["system"], "posed": figures["registered"], "cpu_s": figures["cpu_total"]}
    (folder / "peer.json").write_text(json.dumps(kept) + "\n")
    return folder / TRAJECTORY


_AGREEMENT = re.compile(
    r"(\d+) of \d+ in common, median ([\d.]+), within 2, 5, 10 %: ([\d.]+), ([\d.]+), ([\d.]+),"
)


def compare_poses(reference: Path, estimate: Path) -> Row:
    """The agreement of two trajectories as `compare_poses.py` of the peers measures it."""
    line = [sys.executable, str(PEERS_SCRIPTS / "compare_poses.py"), str(reference), str(estimate)]
    return parse_agreement(subprocess.run(line, stdout=subprocess.PIPE, text=True, check=True).stdout)


def parse_agreement(text: str) -> Row:
    """The figures in the line of `compare_poses.py`: median and shares of errors, relative to the extent."""
    found = _AGREEMENT.match(text)
    if found is None:
        raise SystemExit(f"compare_poses.py: unexpected output: {text!r}")
    common, median, *shares = found.groups()
    return {"common": int(common), "median": float(median), "within": [float(share) for share in shares]}


def frame_times(timed: Timed, peers: Path) -> Row:
    """Times of frames of the online stage and of ORB-SLAM3 on the same frames, one after the other."""
    command = [str(peers / "bin" / "python"), str(PEERS_SCRIPTS / "run_orbslam.py")]
    found = {"ours": measured(OURS, timed, command), "orb_slam3": measured(PEER, timed, command)}
    return {"frames": timed.frames} | {system: _times(metrics) for system, metrics in found.items()}


def _times(metrics: Metrics) -> Row:
    return {
        "ms_median": round(metrics.median, 1),
        "ms_p95": round(metrics.p95, 1),
        "ate": None if metrics.ate is None else significant(metrics.ate),
        "posed": metrics.posed,
    }


def significant(value: float) -> float:
    """Four significant digits."""
    return float(f"{value:.4g}")
