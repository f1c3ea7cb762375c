"""Runs that are ended, by a signal or a power cut, and gone on with."""

from __future__ import annotations

import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests.walks import Walk, arc
from torchslam import SLAM, Config, Run, State, StepResult, load_config
from torchslam.cli import arguments
from torchslam.cli.main import main
from torchslam.data import read_trajectory
from torchslam.errors import ResultsError
from torchslam.io.results import read_frames
from torchslam.loop_closing.loop_detector import LoopClosureRecord
from torchslam.map.atlas import TrackingState
from torchslam.map.file import read_atlas, read_tensors, write_atlas, write_tensors
from torchslam.mapping import local_bundle, mapper
from torchslam.system import map_start, state_machine
from torchslam.system.checkpoint import read_checkpoint, write_checkpoint
from torchslam.system.online_run import Observer, OnlineRun, RunProgress
from torchslam.tracking.motion_model import constant_velocity
from torchslam.types import MotionHistory, PosePrediction

SETTINGS = ["features.kind=simulated", "features.num_keypoints=250", "simulated.points_per_view=150"]
# Without any noise, what a run says of its camera would be looked for to the last bit, in hundreds of iterations.
SETTINGS += ["simulated.noise_px=0.05", "camera.readout_std=0"]
SET = [part for setting in SETTINGS for part in ("--set", setting)]
CONFIG = load_config(None, SETTINGS)
FRAMES = 22
PATH = arc(45)[:FRAMES]
WALK = Walk(PATH)
STOP = 14  # frame after which a run ends early


@pytest.fixture(scope="module", autouse=True)
def soon_kept() -> Iterator[None]:
    """A system is settled once its submap is no longer to be taken back."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(map_start, "PROVISIONAL_FRAMES", 8)
        yield


class PowerCut(BaseException):
    """Ends a run wherever it is, as nothing else does."""


def half(config: Config = CONFIG) -> tuple[SLAM, RunProgress]:
    """A system in the middle of the walk."""
    slam, so_far = SLAM(WALK.camera, config), RunProgress()

    def cut(result: StepResult) -> None:
        if result.index >= STOP and slam.can_checkpoint:
            raise PowerCut

    with pytest.raises(PowerCut):
        OnlineRun(slam, WALK, so_far, observer=Observer(cut)).run()
    return slam, so_far


@pytest.fixture(scope="module")
def stopped() -> tuple[SLAM, RunProgress]:
    slam, so_far = half()
    slam.scene_filter.static_overlay.evidence[3, 4] = 1  # too little to matter
    slam.loop_closer.loop_closures.append(LoopClosureRecord(15, 3, 0, 0))
    return slam, so_far


@pytest.fixture(scope="module")
def checkpoint(stopped: tuple[SLAM, RunProgress], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    write_checkpoint(path, *stopped, WALK)
    return path


@pytest.fixture(scope="module")
def whole() -> Run:
    """A run without interruption."""
    return SLAM(WALK.camera, CONFIG).run(WALK)


# --- checkpoints ---------------------------------------------------------------------------------------------


def test_a_checkpoint_restores_the_state(checkpoint: Path, stopped: tuple[SLAM, RunProgress]) -> None:
    slam, so_far = stopped
    resumed, loaded = read_checkpoint(checkpoint, WALK, CONFIG)
    assert loaded.next == so_far.next > STOP  # once no estimate of the sensor is pending
    assert loaded.skipped == so_far.skipped
    for before, after in zip(so_far.results, loaded.results, strict=True):
        for name in ("T_cw", "covariance"):
            expected, found = getattr(before, name), getattr(after, name)
            assert found is None if expected is None else torch.equal(found, expected)
        times = {stage: pytest.approx(time, abs=1e3) for stage, time in before.stage_ms.items()}
        plain = {"T_cw": None, "covariance": None}
        assert replace(after, **plain) == replace(before, **plain, stage_ms=times)
    assert resumed.last_frame == slam.last_frame
    assert resumed.session.number == 0
    assert resumed.can_checkpoint
    assert resumed.submap is not None
    assert slam.submap is not None
    assert torch.equal(resumed.submap.T_cw, slam.submap.T_cw)
    assert resumed.state is State.TRACKING
    assert resumed.loop_closer.loop_closures == [LoopClosureRecord(15, 3, 0, 0)]
    for column in fields(TrackingState):
        before, after = (
            getattr(slam.submap.tracking, column.name),
            getattr(resumed.submap.tracking, column.name),
        )
        assert torch.equal(before, after) if isinstance(before, torch.Tensor) else before == after, (
            column.name
        )
    assert torch.nonzero(resumed.scene_filter.static_overlay.evidence).tolist() == [[3, 4]]


def test_a_resumed_run_equals_an_uninterrupted_one(checkpoint: Path, whole: Run, tmp_path: Path) -> None:
    slam, so_far = read_checkpoint(checkpoint, WALK, CONFIG)
    resumed = OnlineRun(slam, WALK, so_far).run()
    for name, run in (("whole", whole), ("resumed", resumed)):
        write_atlas(tmp_path / name, run.submaps, run.camera, run.sessions)
    assert (tmp_path / "whole").read_bytes() == (tmp_path / "resumed").read_bytes()
    assert [result.index for result in resumed.results] == list(range(FRAMES))
    assert torch.equal(resumed.trajectory.T_wc, whole.trajectory.T_wc)
    assert torch.equal(resumed.online.T_wc, whole.online.T_wc)


@pytest.mark.parametrize("window", [3, 1000])  # few keyframes are enough to wait, or none are
def test_a_pending_adjustment_is_finished_after_resuming(
    tmp_path: Path, window: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mapper, "DELAY_FRAMES", 3)
    for module in (local_bundle, state_machine):
        monkeypatch.setattr(module, "LOCAL_WINDOW", window)
    walk = Walk(PATH[:18])
    whole = SLAM(walk.camera, CONFIG).run(walk)
    slam, so_far = SLAM(walk.camera, CONFIG), RunProgress()

    def cut(result: StepResult) -> None:
        if slam.can_checkpoint and slam.mapper.adjustment.is_pending:
            raise PowerCut

    with pytest.raises(PowerCut):
        OnlineRun(slam, walk, so_far, observer=Observer(cut)).run()
    write_checkpoint(tmp_path / "checkpoint", slam, so_far, walk)
    resumed, loaded = read_checkpoint(tmp_path / "checkpoint", walk, CONFIG)
    assert resumed.mapper.adjustment.is_pending
    assert resumed.mapper.adjustment.due == slam.mapper.adjustment.due
    assert resumed.mapper.adjustment.is_due_before_next_frame is (window == 1000)
    run = OnlineRun(resumed, walk, loaded).run()
    assert torch.equal(run.trajectory.T_wc, whole.trajectory.T_wc)
    assert torch.equal(run.online.T_wc, whole.online.T_wc)


def test_the_same_state_gives_the_same_bytes(checkpoint: Path, tmp_path: Path) -> None:
    slam, so_far = read_checkpoint(checkpoint, WALK, CONFIG)
    write_checkpoint(tmp_path / "again", slam, so_far, WALK)
    assert (tmp_path / "again").read_bytes() == checkpoint.read_bytes()


class Files(Walk):
    """Frames that are files."""

    def file_name(self, index: int) -> str:
        return f"{index + 7}.png"


def test_a_checkpoint_of_other_images_is_refused(checkpoint: Path) -> None:
    """As many, with the same counted times: one was deleted, and one more is there at the end."""
    with pytest.raises(ResultsError, match=r"checkpoint\.safetensors: .* with another sequence"):
        read_checkpoint(checkpoint, Files(PATH), CONFIG)


def test_a_checkpoint_of_another_run_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    for other in (Walk(PATH[:-1]), Walk(PATH)):
        if len(other) == FRAMES:
            other.camera = other.camera.with_params(other.camera.params + 1)
        with pytest.raises(ResultsError, match=r"checkpoint\.safetensors: .* with another sequence"):
            read_checkpoint(checkpoint, other, CONFIG)
    with pytest.raises(ResultsError, match="with another configuration"):
        read_checkpoint(checkpoint, WALK, replace(CONFIG, seed=1))
    write_atlas(tmp_path / "map", [], WALK.camera)
    with pytest.raises(ResultsError, match="a map, but not a checkpoint"):
        read_checkpoint(tmp_path / "map", WALK, CONFIG)
    with pytest.raises(ResultsError, match="unknown tensors: run"):
        read_atlas(checkpoint)


DAMAGES: list[tuple[Callable[[dict[str, Any], dict[str, torch.Tensor]], object], str]] = [
    (lambda run, tensors: run.pop("next"), "'next'"),
    (lambda run, tensors: run.update(submap=5), "not enough values"),
    (lambda run, tensors: run["tracking"].update(reference=1000), "refers to rows outside"),
    (lambda run, tensors: run.update(last_frame=[3]), "not enough values"),
    (lambda run, tensors: run["reasons"].pop(), "out of range"),
    (lambda run, tensors: tensors.pop("run.T_cw"), r"run\.T_cw"),
    (lambda run, tensors: tensors.pop("run.tracking.last_inlier_points"), "last_inlier_points"),
    (lambda run, tensors: tensors.update({"run.evidence": torch.zeros(3)}), "evidence|size"),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_damaged_checkpoints_are_refused(
    checkpoint: Path, tmp_path: Path, damage: Callable[..., object], message: str
) -> None:
    tensors, about = read_tensors(checkpoint)
    damage(about["run"], tensors)
    write_tensors(tmp_path / "damaged", tensors, about)
    with pytest.raises(ResultsError, match=f"damaged: not a whole checkpoint: .*({message})"):
        read_checkpoint(tmp_path / "damaged", WALK, CONFIG)


def test_a_checkpoint_of_another_version_is_named(checkpoint: Path, tmp_path: Path) -> None:
    """With the last motion in the place of several, and without a number, as it was; or of a later version."""
    tensors, about = read_tensors(checkpoint)
    tensors["run.tracking.velocity"] = tensors.pop("run.tracking.motions")[-1]
    del tensors["run.tracking.intervals"]
    for found in (None, 3):
        about["run"].pop("format", None)
        about["run"] |= {} if found is None else {"format": found}
        write_tensors(tmp_path / "other", tensors, about)
        with pytest.raises(ResultsError, match=f"other: checkpoint format {found or 1}, .*: run again"):
            read_checkpoint(tmp_path / "other", WALK, CONFIG)


class Steady:
    """A motion model that is an object, with a state that is empty at first."""

    def __init__(self) -> None:
        self.seen: list[MotionHistory] = []

    def __len__(self) -> int:
        return len(self.seen)

    def __call__(self, history: MotionHistory) -> PosePrediction:
        self.seen.append(history)
        return constant_velocity(history)


def test_a_motion_model_that_is_an_object_goes_on(checkpoint: Path, whole: Run) -> None:
    model = Steady()
    slam, so_far = read_checkpoint(checkpoint, WALK, CONFIG, motion_model=model)
    resumed = OnlineRun(slam, WALK, so_far).run()
    assert len(model) >= FRAMES - so_far.next
    assert torch.equal(resumed.trajectory.T_wc, whole.trajectory.T_wc)


def test_a_checkpoint_needs_a_confirmed_map(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no pending frames"):
        write_checkpoint(tmp_path / "x", SLAM(WALK.camera, CONFIG), RunProgress(), WALK)


# --- the command ---------------------------------------------------------------------------------------------


class Cut(Walk):
    """Does something when frame `at` is read."""

    at: int = STOP
    do: Callable[[], object] = staticmethod(lambda: None)

    def image(self, index: int) -> torch.Tensor:
        if index == self.at:
            type(self).do()
        return super().image(index)


@pytest.fixture
def cut(monkeypatch: pytest.MonkeyPatch, without_pictures: None) -> Iterator[type[Cut]]:
    """The sequence that every command gets, and what it does in the middle."""
    monkeypatch.setattr(arguments, "sequence", lambda options: Cut(PATH))
    yield Cut
    Cut.do = staticmethod(lambda: None)
    Cut.at = STOP


def command(folder: Path, *more: str) -> int:
    return main(["run", "walk", "--output", str(folder), *SET, *more])


def power_cut() -> None:
    raise PowerCut


def send(number: int) -> Callable[[], None]:
    return lambda: os.kill(os.getpid(), number)


def test_a_crash_keeps_the_last_checkpoint(
    tmp_path: Path, cut: type[Cut], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cut"
    cut.do = staticmethod(power_cut)
    with pytest.raises(PowerCut):
        command(folder, "--checkpoint", "2")
    assert [path.name for path in folder.iterdir()] == ["checkpoint.safetensors"]
    assert command(folder) == 2  # neither resumed nor given up
    assert "--resume continues it" in capsys.readouterr().err
    cut.do = staticmethod(lambda: None)
    assert command(folder, "--resume", "--set", "seed=3") == 2
    assert "another configuration" in capsys.readouterr().err
    assert command(folder, "--resume") == 0
    assert "resuming at frame" in capsys.readouterr().err
    assert not (folder / "checkpoint.safetensors").exists()
    assert [frame.index for frame in read_frames(folder / "frames.csv")] == list(range(FRAMES))
    assert len(read_trajectory(folder / "trajectory.txt")) == FRAMES
    assert command(tmp_path / "whole", "--checkpoint", "0") == 0
    for name in ("map.safetensors", "trajectory.txt", "online.txt", "keyframes.txt"):
        assert (folder / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


def test_checkpoints_can_be_disabled(
    tmp_path: Path, cut: type[Cut], capsys: pytest.CaptureFixture[str]
) -> None:
    cut.do = staticmethod(power_cut)
    with pytest.raises(PowerCut):
        command(tmp_path, "--checkpoint", "0")
    assert list(tmp_path.iterdir()) == []
    cut.do = staticmethod(lambda: None)
    assert command(tmp_path, "--resume", "--checkpoint", "0") == 0
    assert "no checkpoint to resume from; starting with the first frame" in capsys.readouterr().err
    assert len(read_frames(tmp_path / "frames.csv")) == FRAMES


def test_results_are_not_overwritten_by_default(
    tmp_path: Path, cut: type[Cut], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.safetensors").write_bytes(b"the work of years")
    assert command(tmp_path) == 2
    assert "results of an earlier run, which would be lost" in capsys.readouterr().err
    assert command(tmp_path, "--resume") == 2
    assert "no checkpoint to resume" in capsys.readouterr().err
    assert (tmp_path / "map.safetensors").read_bytes() == b"the work of years"
    assert command(tmp_path, "--overwrite") == 0
    read_atlas(tmp_path / "map.safetensors")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_run_after_its_frame_and_it_can_be_resumed(
    tmp_path: Path, cut: type[Cut], number: int, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    cut.do = staticmethod(send(number))
    assert command(tmp_path) == status
    assert signal.getsignal(signal.SIGTERM) is before
    err = capsys.readouterr().err
    assert "stopping after this frame" in err
    assert "adjusting" in err
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["interrupted"]
    assert figures["frames"] == STOP + 1
    if number == signal.SIGINT:  # what is left to resume from is the same
        return
    cut.do = staticmethod(lambda: None)
    assert command(tmp_path, "--resume") == 0
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert not figures["interrupted"]
    assert figures["frames"] == figures["posed"] == FRAMES


def test_a_signal_ends_the_final_adjustment(
    tmp_path: Path, cut: type[Cut], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchslam.cli.progress import ProgressBars

    original, calls = ProgressBars.adjusting, []

    def adjusting(self: ProgressBars, iteration: int, iterations: int) -> None:
        calls.append(iteration)
        original(self, iteration, iterations)
        if len(calls) == 1:
            os.kill(os.getpid(), signal.SIGTERM)
            original(self, iteration, iterations)
            pytest.fail("the adjustment went on")

    monkeypatch.setattr(ProgressBars, "adjusting", adjusting)
    assert command(tmp_path) == 143
    assert "stopping the adjustment after this iteration" in capsys.readouterr().err
    assert calls == [0]
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["interrupted"]
    assert figures["frames"] == figures["posed"] == FRAMES
    assert figures["ate_m"] < 0.01


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_second_signal_ends_at_once(
    tmp_path: Path, cut: type[Cut], number: int, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(number)

    def twice() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), number)
        time.sleep(1)  # where the signal is taken note of, at the latest

    cut.do = staticmethod(twice)
    with pytest.raises(SystemExit) as ended:
        command(tmp_path, "--checkpoint", "2")
    assert ended.value.code == status
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.safetensors"]
    assert signal.getsignal(number) is before


def test_checkpoints_become_rarer_as_the_map_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from torchslam.cli import run

    taken: list[int] = []
    slam_map, state = SimpleNamespace(num_keyframes=0), SimpleNamespace(mapping=True, can_checkpoint=True)
    state.atlas = [SimpleNamespace(map=slam_map)]
    monkeypatch.setattr(run, "write_checkpoint", lambda *arguments: taken.append(slam_map.num_keyframes))
    checkpoints = run.Checkpoints(tmp_path, 10, state, RunProgress(), WALK)  # type: ignore[arg-type]
    for count in range(1, 1001):
        slam_map.num_keyframes = count
        state.can_checkpoint = count not in (30, 31)
        checkpoints.offer()
    assert taken[:4] == [10, 20, 32, 42]
    gaps = [after - before for before, after in itertools.pairwise(taken)]
    assert all(
        gap == max(10, math.ceil(0.05 * after)) for gap, after in zip(gaps[2:], taken[3:], strict=True)
    )
    state.mapping = False
    checkpoints.offer(at_once=True)
    assert taken[-1] < 1000


def test_a_saved_map_can_be_extended_and_localized_in(
    tmp_path: Path, cut: type[Cut], capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, third = (str(tmp_path / name) for name in ("first", "second", "third"))
    # What the simulated features are of depends on the camera: it has to be the same in all sessions.
    exact = [*SET, "--seed", "5", "--camera-std", "0"]
    assert main(["run", "walk", "-o", first, *exact]) == 0
    content = (tmp_path / "first" / "map.safetensors").read_bytes()
    assert main(["run", "walk", "-o", second, "--map", first]) == 0  # with the configuration next to the map
    assert "session" in capsys.readouterr().out
    grown = read_atlas(tmp_path / "second" / "map.safetensors")
    (submap,) = grown.atlas
    assert grown.sessions == 2
    assert len(submap.trajectory(0)) == len(submap.trajectory(1)) == FRAMES
    assert len(read_trajectory(tmp_path / "second" / "trajectory.txt")) == FRAMES
    assert json.loads((tmp_path / "second" / "metrics.json").read_text())["ate_m"] < 1e-3
    file = str(tmp_path / "first" / "map.safetensors")
    assert main(["run", "walk", "-o", third, *exact, "--map", file, "--localize"]) == 0
    assert (tmp_path / "third" / "map.safetensors").read_bytes() == content
    assert (tmp_path / "first" / "map.safetensors").read_bytes() == content
    figures = json.loads((tmp_path / "third" / "metrics.json").read_text())
    assert figures["posed"] == FRAMES
    assert figures["keyframes"] == 0
    assert figures["ate_m"] < 1e-3
    assert len(read_trajectory(tmp_path / "third" / "trajectory.txt")) == FRAMES


def test_unusable_maps_are_refused(
    tmp_path: Path, cut: type[Cut], capsys: pytest.CaptureFixture[str]
) -> None:
    cut.do, cut.at = staticmethod(power_cut), 0  # none reads a frame
    other = WALK.camera.with_params(WALK.camera.params + 1)
    write_atlas(tmp_path / "map", [], other)
    assert command(tmp_path / "out", "--map", str(tmp_path / "map")) == 2
    assert "built with the camera pinhole 401,401,160.5,120.5 of 320 x 240" in capsys.readouterr().err
    assert command(tmp_path / "out", "--map", str(tmp_path / "nowhere")) == 2
    assert "nowhere: no map file" in capsys.readouterr().err
    assert command(tmp_path / "out", "--map", str(tmp_path / "map"), "--localize") == 2
    assert "no submap in it to localize in" in capsys.readouterr().err
    assert command(tmp_path / "out", "--localize") == 2
    assert "--localize requires --map" in capsys.readouterr().err


def test_the_camera_of_a_map_equals_that_of_a_calibration_file(tmp_path: Path, cut: type[Cut]) -> None:
    """The first frame is read: the map has been accepted by then."""
    rounded = WALK.camera.with_params(WALK.camera.params * (1 + 4e-10))
    write_atlas(tmp_path / "map", [], rounded)
    cut.do, cut.at = staticmethod(power_cut), 0
    with pytest.raises(PowerCut):
        command(tmp_path / "out", "--map", str(tmp_path / "map"))


# --- a real power cut ----------------------------------------------------------------------------------------

CHILD = """
import sys, time
import torch
torch.set_num_threads(1)
from tests.system.test_resume import PATH
from tests.walks import Walk
from torchslam.cli.main import main
from torchslam.cli import arguments

class Slow(Walk):
    def image(self, index):
        time.sleep(float(sys.argv[1]))
        return super().image(index)

arguments.sequence = lambda options: Slow(PATH)
sys.exit(main(sys.argv[2:]))
"""


SIGNALED = CHILD.replace(
    "time.sleep(float(sys.argv[1]))", "os.kill(os.getpid(), number) if index == point else None"
)
SIGNALED = SIGNALED.replace(
    "import sys, time", "import os, sys\nnumber, point = map(int, sys.argv[1].split(':'))"
)
ENDS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -signal.SIGKILL}
POINTS = [(number, frame) for number in ENDS for frame in range(0, FRAMES, 2)]


@pytest.mark.slow
def test_a_run_that_is_ended_anywhere_can_be_resumed_to_the_same_bytes(tmp_path: Path) -> None:
    """At every second frame, by each signal: a documented status, and then the trajectory of a run in one piece."""
    env = os.environ | {"OMP_NUM_THREADS": "1"}

    def run(folder: str, number: int, frame: int, *more: str) -> subprocess.CompletedProcess[str]:
        line = ["run", "walk", "--output", str(tmp_path / folder), *SET, "--checkpoint", "1", *more]
        command = [sys.executable, "-c", SIGNALED, f"{number}:{frame}", *line]
        return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)

    assert run("whole", 0, -1).returncode == 0
    for number, frame in POINTS:
        folder = f"{number}-{frame}"
        ended = run(folder, number, frame)
        assert ended.returncode == ENDS[number], (number, frame, ended.stderr)
        # Without a checkpoint there is nothing to resume from: what was written is replaced.
        has_checkpoint = (tmp_path / folder / "checkpoint.safetensors").exists()
        done = run(folder, 0, -1, "--resume" if has_checkpoint else "--overwrite")
        assert done.returncode == 0, (number, frame, done.stderr)
        for name in ("trajectory.txt", "map.safetensors"):
            assert (tmp_path / folder / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), (
                number,
                frame,
            )


MAPPED = """
import os, signal, sys
import torch
torch.set_num_threads(1)
from tests.system.test_resume import PATH
from tests.walks import Walk
from torchslam.cli import arguments
from torchslam.cli.main import main
from torchslam.global_mapping.mapper import GlobalMapper
from torchslam.global_mapping.view_graph import PairMatcher

match, view, left = PairMatcher.match, GlobalMapper.view, int(sys.argv[1])

def counted(self, pairs):
    global left
    print("matching")
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return match(self, pairs)

def read(self, index):
    print("reading")
    return view(self, index)

PairMatcher.match, GlobalMapper.view = counted, read
arguments.sequence = lambda options: Walk(PATH)
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.slow
def test_a_run_that_is_killed_in_global_mapping_goes_on_there(tmp_path: Path) -> None:
    """After the features and two stages of image pairs, neither of which is computed again."""
    env = os.environ | {"OMP_NUM_THREADS": "1"}

    def run(folder: str, kill: int, *more: str) -> subprocess.CompletedProcess[str]:
        line = ["run", "walk", "--output", str(tmp_path / folder), *SET, "--mapping", "global", *more]
        command = [sys.executable, "-c", MAPPED, str(kill), *line]
        return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=False)

    whole = run("whole", 0)
    assert whole.returncode == 0, whole.stderr
    assert json.loads((tmp_path / "whole" / "metrics.json").read_text())["mapping"] == "global"
    assert run("cut", 3).returncode == -signal.SIGKILL
    folder = tmp_path / "cut"
    left = sorted(path.name[:5] for path in (folder / "global_mapping").iterdir())
    assert left == ["pairs", "pairs", "views"]
    refused = run("cut", 0)
    assert refused.returncode == 2
    assert "an unfinished run: --resume continues it" in refused.stderr
    done = run("cut", 0, "--resume")
    assert done.returncode == 0, done.stderr
    assert "starting with the first frame; global mapping goes on with what it saved" in done.stderr
    assert whole.stdout.count("reading") == FRAMES
    assert "reading" not in done.stdout
    assert done.stdout.count("matching") == whole.stdout.count("matching") - 2
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        path.name for path in (tmp_path / "whole").iterdir()
    )
    for name in ("trajectory.txt", "map.safetensors", "online.txt", "calibration.txt"):
        assert (folder / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
