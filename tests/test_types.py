"""Values that pass through PyTorch's loaders."""

import torch
from torch.utils.data import DataLoader

from torchslam.types import Frame


def test_a_loader_collates_frames_to_their_columns() -> None:
    pose = torch.eye(4, dtype=torch.float64)
    frames = [
        Frame(index, index / 30, torch.full((1, 1, 4, 6), index / 10), f"{index}.png", pose)
        for index in range(4)
    ]
    first, second = DataLoader(frames, batch_size=2)  # type: ignore[arg-type]
    assert first["image"].shape == (2, 1, 4, 6)
    assert second["index"].tolist() == [2, 3]
    assert second["name"] == ["2.png", "3.png"]
    assert second["T_cw_groundtruth"].shape == (2, 4, 4)
    assert "mask" not in second
