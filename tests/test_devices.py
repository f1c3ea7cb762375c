"""The whole system on another device gives what it gives on the CPU."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import torchslam
from tests.accelerator import SimulatedTensor
from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc
from torchslam import ORB, SLAM, ClipSLAM, evaluate, load_config, open_sequence, solve_graph
from torchslam.cli.main import main
from torchslam.evaluation import ate

CPU = torch.device("cpu")
NOISY = ["features.kind=simulated", "simulated.noise_px=0.3", "simulated.outlier_ratio=0.1"]
NOISY += ["camera.readout_std=0"]
# Rounding differs between devices, and grows from keyframe to keyframe.
TOLERANCE = {"rtol": 1e-4, "atol": 1e-6}


@pytest.fixture
def device(device: torch.device) -> torch.device:
    """Another one than the CPU, which is compared with."""
    if device.type == "cpu":
        pytest.skip("other tests run on the CPU")
    return device


def gradients(walk: Walk, device: torch.device) -> dict[str, Tensor]:
    """What a run on a device finds, and the gradient of its error."""
    config = load_config(None, NOISY)
    run = SLAM(walk.camera.to(device), config).run(walk)
    assert run.trajectory.T_wc.device.type == device.type
    assert evaluate(run.trajectory, walk.groundtruth).ate_m < 0.01 * 3.0
    graph = run.graph
    pixels = graph.pixels.clone().requires_grad_()
    camera = graph.camera.with_params(graph.camera.params.clone().requires_grad_())
    solution = solve_graph(replace(graph, pixels=pixels, camera=camera))
    ate(T_cw=solution.T_cw, T_cw_groundtruth=true_T_cw(walk)[graph.frame_ids.cpu()].to(device)).backward()
    assert pixels.grad is not None
    assert camera.params.grad is not None
    covariances = solution.keyframes[0].covariance().frames
    found = {"T_wc": run.trajectory.T_wc, "camera": camera.params.grad, "covariances": covariances}
    return {name: tensor.detach().cpu() for name, tensor in found.items()}


def test_a_run_its_gradient_and_its_covariances(device: torch.device) -> None:
    walk = Walk(arc(8))
    expected = gradients(walk, CPU)
    for name, found in gradients(walk, device).items():
        torch.testing.assert_close(found, expected[name], **TOLERANCE)


def test_a_recording_that_is_mapped_as_a_whole(device: torch.device) -> None:
    """With a camera that is not exact, which its measurement moves."""
    walk, config = Walk(arc(8)), load_config(None, [*NOISY, "camera.std=0.01"])
    expected, found = (torchslam.run(walk, config, mapping="global", device=d) for d in (CPU, device))
    assert found.by_frame is not None or found.kept is expected.kept
    assert found.camera.params.device.type == device.type
    assert found.check is not None
    torch.testing.assert_close(found.trajectory.T_wc.cpu(), expected.trajectory.T_wc, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["orb", "opencv-orb"])
def test_images(device: torch.device, kind: str) -> None:
    sequence = open_sequence("synthetic:room").part(0, 12, 2)
    config = load_config(None, [f"features.kind={kind}", "features.num_keypoints=300"])
    expected, found = (SLAM(sequence.camera.to(d), config).run(sequence).trajectory for d in (CPU, device))
    assert len(expected) == 6
    torch.testing.assert_close(found.T_wc.cpu(), expected.T_wc, rtol=1e-2, atol=1e-2)


def test_a_clip_is_differentiated_on_its_device(device: torch.device) -> None:
    sequence = open_sequence("synthetic:room").part(0, 12, 2)
    images = torch.stack([frame.image[0] for frame in sequence]).to(device).requires_grad_()
    clip_slam = ClipSLAM(ORB(300, differentiable=True).to(device))
    poses = clip_slam(images, sequence.camera.to(device))
    assert poses.posed.all()
    poses.T_cw.sum().backward()
    assert images.grad is not None
    assert images.grad.device.type == device.type
    assert float(images.grad.abs().sum()) > 0


def test_results_of_a_run_elsewhere_are_written(device: torch.device, tmp_path: Path) -> None:
    arguments = [
        "run",
        "synthetic:room",
        "--limit",
        "7",
        "--features",
        "simulated",
        "--set",
        "simulated.noise_px=0.1",  # without any, the camera would be judged to the last bit
        "--device",
        str(device),
        "-o",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    assert (tmp_path / "map.safetensors").stat().st_size > 0
    assert (tmp_path / "plots" / "top_view.png").exists()


def test_the_command_names_unusable_devices(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("quark", "meta"):
        with pytest.raises(SystemExit):
            main(["run", "synthetic:room", "--device", name, "-o", str(tmp_path)])
        assert f"'{name}' cannot be used here" in capsys.readouterr().err


def test_the_simulated_accelerator_does_not_mix_devices(device: torch.device) -> None:
    """It is worth something only as far as it refuses what CUDA refuses."""
    there, here = torch.ones(3, device=device), torch.ones(3)
    assert device.type != "sim" or isinstance(there, SimulatedTensor)
    for mixed in (
        lambda: there + here,
        lambda: torch.cat([there, here]),
        lambda: there @ here,
        lambda: here[there > 0],
        lambda: torch.where(there > 0, there, here),
        lambda: torch.rand(3, generator=torch.Generator(), device=device),
    ):
        with pytest.raises(RuntimeError):
            mixed()
    assert (there * torch.tensor(2.0)).tolist() == [2, 2, 2]
    assert there[torch.tensor([0, 2])].tolist() == [1, 1]
    assert torch.equal(there.cpu(), here)
