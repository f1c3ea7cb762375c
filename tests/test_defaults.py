"""Results are the same bytes whatever PyTorch's defaults of dtype and device are."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

import torchslam
from tests.sweep.test_sweep import default_dtype

PACKAGE = Path(torchslam.__file__).parent
FLOATS = {"rand", "randn", "normal", "linspace", "logspace", "zeros", "ones", "empty", "eye"}
"""Functions that make tensors of the default dtype."""
BY_VALUE = {"tensor", "full", "arange"}
"""Functions that do so for values that are floats."""
ON_DEVICE = {
    *FLOATS,
    *BY_VALUE,
    "as_tensor",
    "asarray",
    "randint",
    "randperm",
    "tril_indices",
    "triu_indices",
}
"""Functions that make tensors on the default device."""


def _defaults() -> Iterator[str]:
    """Calls that leave dtype or device to PyTorch's default."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
            if not is_call or ast.unparse(node.func.value) != "torch" or node.func.attr not in ON_DEVICE:
                continue
            named = {keyword.arg for keyword in node.keywords}
            values = [
                each.value for arg in node.args for each in ast.walk(arg) if isinstance(each, ast.Constant)
            ]
            is_float = node.func.attr in FLOATS or any(isinstance(value, float) for value in values)
            if "device" not in named or (is_float and "dtype" not in named):
                yield f"{path.relative_to(PACKAGE)}:{node.lineno}: {ast.unparse(node)}"


def test_every_new_tensor_says_its_dtype_and_device() -> None:
    assert not list(_defaults())


def _bytes() -> list[bytes]:
    sequence = torchslam.open_sequence("synthetic:room", resize_to="320x240", stride=2, limit=9)
    run = torchslam.SLAM(sequence.camera).run(sequence)
    assert len(run.trajectory) > 6
    graph = run.graph
    solution = torchslam.solve_graph(graph)
    tensors = (run.trajectory.T_wc, run.trajectory.timestamps, graph.pixels, solution.T_cw, solution.points_w)
    return [tensor.numpy().tobytes() for tensor in tensors]


@pytest.fixture(scope="module")
def kept() -> list[list[bytes]]:
    return []


@pytest.fixture
def expected(kept: list[list[bytes]]) -> list[bytes]:
    """Computed once, in the first test: without checks of shapes, too."""
    if not kept:
        kept.append(_bytes())
    return kept[0]


def test_a_run_does_not_depend_on_the_default_dtype(expected: list[bytes]) -> None:
    with default_dtype(torch.float64):
        assert _bytes() == expected


def test_a_run_does_not_depend_on_the_default_device(expected: list[bytes]) -> None:
    with torch.device("meta"):  # which has no values
        assert _bytes() == expected


def test_a_camera_does_not_depend_on_the_defaults() -> None:
    with default_dtype(torch.float16), torch.device("meta"):
        camera = torchslam.Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))
    assert camera.params.dtype == torch.float64
    assert camera.params.device.type == "cpu"


@pytest.mark.parametrize("name", ["XFeat", "ALIKED"])
def test_a_network_does_not_depend_on_the_defaults(name: str, tmp_path: Path) -> None:
    kornia = pytest.importorskip("kornia")
    torch.manual_seed(0)
    network = kornia.feature.XFeat() if name == "XFeat" else kornia.feature.ALIKED("aliked-t16", 50)
    state = {key: value.contiguous() for key, value in network.state_dict().items()}
    save_file(state, tmp_path / "weights.safetensors")
    images = torch.rand(1, 1, 96, 128)

    def results() -> list[torch.Tensor]:
        found = getattr(torchslam, name)(tmp_path / "weights.safetensors", 50)(images)
        return [found.keypoints, found.scores, found.descriptors]

    expected = results()
    with default_dtype(torch.float64):
        assert all(map(torch.equal, results(), expected))
    with torch.device("meta"):
        assert all(map(torch.equal, results(), expected))
