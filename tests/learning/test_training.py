"""Training: a stopped one goes on to the same bytes; what is reported; the example on one and two processes."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor, nn

from examples.train_weights import Weighed, train
from torchslam import ORB, open_sequence
from torchslam.errors import ResultsError
from torchslam.geometry import KeypointNoise
from torchslam.learning.dataset import Clips
from torchslam.learning.training import MAX_NORM, Training

ROOT = Path(__file__).parents[2]


def training(steps: int = 8, seed: int = 0, log: object = None) -> Training:
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(3, 4), nn.Dropout(0.3), nn.Tanh(), nn.Linear(4, 1))
    return Training(module, torch.optim.Adam(module.parameters(), 0.1), steps, seed, log)  # type: ignore[arg-type]


def loss_of(one: Training) -> Tensor:
    x = torch.randn(5, 3, generator=one.generator)
    return (one.module(x) - x.sum(-1, keepdim=True)).square().mean()


def state_bytes(one: Training, folder: Path) -> bytes:
    one.save(folder / "state.pt")
    return (folder / "state.pt").read_bytes()


def test_a_resumed_training_ends_with_the_same_bytes(tmp_path: Path) -> None:
    whole = training()
    for _ in whole:
        whole.descend(loss_of(whole))
    stopped = training()
    for _ in stopped:
        stopped.descend(loss_of(stopped))
        if stopped.step == 3:
            stopped.save(tmp_path / "part.pt")
            break
    torch.randn(7)  # what else the program draws
    resumed = training()
    assert not resumed.resume(tmp_path / "nothing.pt")
    assert resumed.resume(tmp_path / "part.pt")
    assert (resumed.step, resumed.losses) == (3, whole.losses[:3])
    for _ in resumed:
        resumed.descend(loss_of(resumed))
    assert resumed.losses == whole.losses
    assert state_bytes(resumed, tmp_path) == state_bytes(whole, tmp_path)
    assert list(resumed) == []


def test_a_step_is_clipped_scheduled_and_logged() -> None:
    logged: list[tuple[str, float, int]] = []
    one = training(steps=4, log=lambda *values: logged.append(values))
    rates = []
    for step in one:
        rates.append(one.optimizer.param_groups[0]["lr"])
        one.descend(1e3 * loss_of(one))
        norm = torch.stack([p.grad.norm() for p in one.module.parameters() if p.grad is not None]).norm()
        assert float(norm) == pytest.approx(MAX_NORM, rel=1e-4)
        assert logged[-2] == ("loss", one.losses[step], step)
        assert logged[-1][0] == "gradient_norm"
        assert logged[-1][1] > MAX_NORM
    assert rates == pytest.approx([0.1, 0.1 * 0.853553, 0.05, 0.1 * 0.146447], rel=1e-5)
    assert len(logged) == 8


def test_schedule_and_gradient_norm_are_configurable() -> None:
    module = nn.Linear(3, 1)
    optimizer = torch.optim.SGD(module.parameters(), 0.5)
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, 2, gamma=0.1)
    one = Training(module, optimizer, 4, schedule=schedule, max_norm=0.2)
    lengths = []
    for _ in one:
        before = torch.cat([parameter.detach().flatten() for parameter in module.parameters()])
        one.descend(1e3 * loss_of(one))
        after = torch.cat([parameter.detach().flatten() for parameter in module.parameters()])
        lengths.append(float((after - before).norm()))
    assert lengths == pytest.approx([0.1, 0.1, 0.01, 0.01], rel=1e-3)


def test_a_non_finite_gradient_changes_nothing() -> None:
    one = training()
    before = [parameter.clone() for parameter in one.module.parameters()]
    with pytest.raises(RuntimeError, match="non-finite"):
        one.descend(loss_of(one) * torch.nan)
    assert all(torch.equal(*pair) for pair in zip(before, one.module.parameters(), strict=True))
    assert (one.step, one.losses) == (0, [])


def test_an_invalid_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.pt").write_text("no")
    torch.save({"module": 1}, tmp_path / "other.pt")
    training(steps=9).save(tmp_path / "nine.pt")
    for name, reason in (
        ("text", "not a checkpoint"),
        ("other", "not a checkpoint"),
        ("nine", "9 steps, not 8"),
    ):
        with pytest.raises(ResultsError, match=reason):
            training().resume(tmp_path / f"{name}.pt")


def test_a_summary_writer_fits() -> None:
    tensorboard = pytest.importorskip("torch.utils.tensorboard", exc_type=ImportError)
    inspect.signature(tensorboard.SummaryWriter.add_scalar).bind(None, "loss", 1.0, 0)


def test_the_weights_of_keypoints_start_equal_and_keep_mean_one() -> None:
    images = torch.rand(2, 1, 96, 128, generator=torch.Generator().manual_seed(0))
    images[1] = 0.5  # nothing to be seen
    weighed, plain = Weighed(50), ORB(50)(images)

    def weights() -> Tensor:
        found = weighed(images)
        usual = KeypointNoise.of(found.scales, None).with_explicit_information().weights
        return KeypointNoise.of(found.scales, found.information).weights / usual

    torch.testing.assert_close(weights(), torch.ones(2, 50))
    nn.init.normal_(weighed.last.weight, generator=torch.Generator().manual_seed(0))
    assert float(weights()[0].std().detach()) > 0.1
    assert bool(weights().isfinite().all())
    mean = weights()[0, plain.mask[0]].log().mean()
    torch.testing.assert_close(mean, torch.tensor(0.0), atol=1e-5, rtol=0)


class Stopped(Exception):
    """Somebody pulled the plug."""


def stop(name: str, value: float, step: int) -> None:
    if step == 2 and name == "failure_rate":
        raise Stopped


@pytest.fixture(scope="module")
def clips() -> Clips:
    room = open_sequence("synthetic:room", resize_to="320x240", stride=3, limit=20)
    return Clips([room], frames=5, per_sequence=2)


def test_the_example_resumes_to_the_same_bytes(clips: Clips, tmp_path: Path) -> None:
    whole = train(clips, 3, tmp_path / "whole.pt", batch=1, save_every=2)
    with pytest.raises(Stopped):
        train(clips, 3, tmp_path / "part.pt", batch=1, save_every=2, log=stop)
    resumed = train(clips, 3, tmp_path / "part.pt", batch=1, save_every=2)
    assert resumed.losses == whole.losses
    assert (tmp_path / "part.pt").read_bytes() == (tmp_path / "whole.pt").read_bytes()
    assert whole.module.last.weight.abs().max() > 0  # zero before


def _train_as(rank: int, ranks: int, store: str, clips: Clips, folder: Path) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=ranks)
    train(clips, 4, folder / "whole.pt", batch=2, save_every=2)
    with pytest.raises(Stopped):
        train(clips, 4, folder / "part.pt", batch=2, save_every=2, log=stop)
    train(clips, 4, folder / "part.pt", batch=2, save_every=2)
    dist.destroy_process_group()


@pytest.mark.slow
def test_two_processes_resume_to_the_same_bytes(clips: Clips, tmp_path: Path) -> None:
    arguments = (2, str(tmp_path / "store"), clips, tmp_path)
    mp.start_processes(_train_as, arguments, nprocs=2, start_method="spawn")
    assert (tmp_path / "part.pt").read_bytes() == (tmp_path / "whole.pt").read_bytes()


@pytest.mark.slow
def test_the_example_runs_under_torchrun(tmp_path: Path) -> None:
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    example = [
        "-m",
        "examples.train_weights",
        "synthetic:room",
        "--clips",
        "2",
        "--steps",
        "1",
        "--checkpoint",
    ]
    result = subprocess.run(
        [sys.executable, *launcher, *example, str(tmp_path / "weights.pt")],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.stdout.count(" loss ") == 1
    assert (tmp_path / "weights.pt").exists()
