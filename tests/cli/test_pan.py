"""Images of a camera that only turns, with a focal length that is uncertain and wrong: no map, and why."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchslam.cli.main import main
from torchslam.data.synthetic.renderer import Renderer
from torchslam.data.synthetic.scene import room
from torchslam.geometry import rigid, se3_inverse, so3_exp

SIZE, FOCAL, FRAMES = (480, 360), 264.0, 24  # 0.55 image widths
FAST = ["--features", "opencv-orb", "--set", "features.num_keypoints=500", "--processes", "1"]


@pytest.fixture(scope="module")
def pan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of rendered images of a camera that turns by 40 degrees."""
    K = np.array(((FOCAL, 0, (SIZE[0] - 1) / 2), (0, FOCAL, (SIZE[1] - 1) / 2), (0, 0, 1)))
    yaw = torch.linspace(0, math.radians(40), FRAMES, dtype=torch.float64)
    zero = torch.zeros_like(yaw)
    T_wc = rigid(so3_exp(torch.stack((zero, yaw, 0.1 * yaw), dim=-1)), zero[:, None].expand(-1, 3))
    renderer = Renderer(room(0), K, SIZE)
    folder = tmp_path_factory.mktemp("pan")
    for index, T_cw in enumerate(se3_inverse(T_wc).numpy()):
        image = renderer.render(T_cw).round().clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index:03d}.png"), image)
    return folder


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(("focal", "frames"), [(408, 24), pytest.param(576, 16, marks=pytest.mark.slow)])
def test_a_pan_with_an_uncertain_camera_gives_no_map_and_a_reason(
    pan: Path, focal: int, frames: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = ["--camera", f"{focal},{focal},239.5,179.5", "--limit", str(frames)]
    arguments = ["run", str(pan), *camera, *FAST]
    assert main([*arguments, "--camera-std", "0.3", "--output", str(tmp_path / "uncertain")]) == 3
    err = capsys.readouterr().err
    assert f"no map was initialized in {frames} frames: the camera only turns" in err
    assert json.loads((tmp_path / "uncertain" / "metrics.json").read_text())["posed"] == 0
