"""Fixtures that every test may use: device, dtype, the real sequences, one torch thread."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import hypothesis
import jaxtyping
import numpy as np
import pytest
import torch

from tests import accelerator, shapes

# What is imported and collected stays: looking for garbage in it takes seconds.
gc.disable()

# Two torch threads on two busy cores wait for each other at barriers.
torch.set_num_threads(1)

# Before the first backward pass, at which torch counts its devices. Not beside a GPU: torch would look for the
# gradients of its tensors on the simulated device.
HAS_SIMULATED_ACCELERATOR = not torch.cuda.is_available() and accelerator.register()

WHOLE_RUNS = ("batch", "calibration", "cli", "docs", "experiments", "io", "parallel", "refine", "system")
WHOLE_RUNS += ("test_defaults.py", "test_devices.py", "test_plugins.py", "test_recording.py")
"""Folders and files of tests that run the whole system many times."""

DATA_DIR = Path(os.environ.get("TORCHSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))


MAX_RENDERED = 300
"""Rendered images that are kept, of 0.3 MB each."""

hypothesis.settings.register_profile("short", max_examples=40)  # others in each run
hypothesis.settings.load_profile("short")


def pytest_sessionstart() -> None:
    from torchslam.utils.memory import keep_freed_memory  # not before jaxtyping adds its checks

    keep_freed_memory()


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    gc.freeze()
    gc.enable()


def pytest_runtest_setup() -> None:
    shapes.start_test()


@pytest.fixture(params=["cpu", "sim", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """The CPU, a simulated accelerator that finds out where devices are mixed, and a GPU where there is one."""
    if request.param == "sim":
        if not HAS_SIMULATED_ACCELERATOR:
            pytest.skip("a GPU is there, or this torch has no devices written in Python")
        with accelerator.simulated_accelerator() as simulated:
            yield simulated
        return
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    yield torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    return request.param


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def without_shape_checks() -> Iterator[None]:
    """Turn off the check of shapes, for tests of the errors that a user gets for wrong ones."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True)
def _check_shapes(request: pytest.FixtureRequest) -> Iterator[None]:
    """Check shapes in the tests of the parts, not in the whole runs of others: there it doubles the time."""
    area = request.path.relative_to(Path(__file__).parent).parts[0]
    jaxtyping.config.update("jaxtyping_disable", area in WHOLE_RUNS)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session", autouse=True)
def rendered_images() -> Iterator[dict[object, np.ndarray]]:
    """Keep rendered images: many tests see the first frames of the same room, and rendering takes half their time."""
    from torchslam.data.formats.image_file import gray_to_tensor  # not before jaxtyping adds its checks
    from torchslam.data.synthetic.sequence import SyntheticSequence

    kept: dict[object, np.ndarray] = {}
    render = SyntheticSequence.image

    def image(sequence: SyntheticSequence, index: int) -> torch.Tensor:
        if sequence._options.blank:
            return render(sequence, index)
        key = (sequence.name, replace(sequence._options, frames=0), index)
        if key not in kept:
            if len(kept) == MAX_RENDERED:
                kept.pop(next(iter(kept)))
            kept[key] = (255 * render(sequence, index)).round().to(torch.uint8)[0, 0].numpy()
        return gray_to_tensor(kept[key])

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(SyntheticSequence, "image", image)
        yield kept


@pytest.fixture
def data_dir() -> Path:
    """The folder of real sequences; the test is skipped where it is missing."""
    if not DATA_DIR.is_dir():
        pytest.skip(f"no real sequences at {DATA_DIR}; set TORCHSLAM_DATA to the folder that has them")
    return DATA_DIR


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """`torchslam run` draws nothing: that takes as long as a short run."""
    monkeypatch.setattr("torchslam.io.write_run.draw", lambda results, output: [])
