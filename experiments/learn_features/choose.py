"""Settings of the training, and another teacher, compared on the validation part. See README.md."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import table
from experiments.learn_features.front_end import SubPixel
from experiments.learn_features.run import HERE, KEYPOINTS, WEIGHTS, prepared
from experiments.learn_features.tracks import Tracks, residuals
from experiments.learn_features.training import Settings, moved, pose_loss, track_loss, train
from torchslam import XFeat

CHOSEN = Settings()
VARIANTS = {
    "as chosen": (CHOSEN, pose_loss),
    "reach 1 px": (replace(CHOSEN, reach=1.0), pose_loss),
    "reach 2 px": (replace(CHOSEN, reach=2.0), pose_loss),
    "64 tracks of a problem instead of 16": (replace(CHOSEN, tracks=64), pose_loss),
    "300 steps": (replace(CHOSEN, steps=300), pose_loss),
    "taught by reprojection error": (CHOSEN, track_loss),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="of XFeat, a safetensors file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    xfeat = XFeat(arguments.weights, KEYPOINTS).to(device)
    parts = prepared(xfeat, device)
    rows = [["untrained", *(_median(tracks, tracks.keypoints) for tracks in parts.values())]]
    for label, (settings, teacher) in VARIANTS.items():
        front_end = SubPixel(xfeat, settings.width, settings.reach).to(device)
        train(front_end, parts["training"], settings, teacher=teacher)
        rows.append([label, *(_median(tracks, moved(front_end, tracks)) for tracks in parts.values())])
        print(rows[-1], flush=True)
    text = table(["median residual of tracks (px)", *parts], rows)
    (HERE / "choices.md").write_text(text, encoding="utf-8")


def _median(tracks: Tracks, keypoints: Tensor) -> str:
    return f"{float(residuals(tracks, keypoints).median()):.3f}"


if __name__ == "__main__":
    main()
