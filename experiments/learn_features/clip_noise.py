"""How much the error of a clip says: keypoints shaken a little, and other assumptions on their noise. See README.md."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn

from experiments.common import sequences, table
from experiments.learn_features.clips import clip_from, position_error
from experiments.learn_features.front_end import Remembering, SubPixel
from experiments.learn_features.report import ratio
from experiments.learn_features.run import HERE, KEYPOINTS, TRAINING, WEIGHTS, Part
from experiments.learn_features.training import Settings
from torchslam import ClipSLAM, Features, XFeat

SHAKE_PX = 0.05
SCALES_PX = (1.4, 1.0)  # XFeat's keypoints are given 2


class Changed(nn.Module):
    """A front end whose keypoints are shaken, or given another standard deviation."""

    def __init__(
        self, front_end: nn.Module, shake: float = 0.0, scale: float | None = None, seed: int = 0
    ) -> None:
        super().__init__()
        self.front_end = front_end
        self.shake, self.scale, self.seed = shake, scale, seed

    def forward(self, images: Tensor) -> Features:
        features = self.front_end(images)
        generator = torch.Generator().manual_seed(self.seed)
        noise = torch.randn(features.keypoints.shape, generator=generator).to(features.keypoints)
        scales = features.scales if self.scale is None else torch.full_like(features.scales, self.scale)
        return replace(features, keypoints=features.keypoints + self.shake * noise, scales=scales)


def candidates_of(front_ends: dict[str, nn.Module]) -> dict[str, nn.Module]:
    """The front ends, the first of them shaken, and all with other assumptions."""
    candidates = dict(front_ends)
    first, *_ = front_ends
    for seed in range(3):
        label = f"{first}, shaken by {SHAKE_PX} px, draw {seed}"
        candidates[label] = Changed(front_ends[first], SHAKE_PX, seed=seed)
    for label, front_end in front_ends.items():
        for scale in SCALES_PX:
            candidates[f"{label}, noise taken for {scale} px"] = Changed(front_end, scale=scale)
    return candidates


@torch.no_grad()
def positions_of(candidates: dict[str, nn.Module], part: Part, device: torch.device) -> dict[str, Tensor]:
    """(C,) ATE as a share of the path of every clip, NaN where too few frames are posed."""
    positions: dict[str, list[float]] = {label: [] for label in candidates}
    for start in part.clips:
        clip = clip_from(part.sequence, start, device)
        for label, front_end in candidates.items():
            positions[label].append(position_error(ClipSLAM(front_end), clip))
    return {label: torch.tensor(found) for label, found in positions.items()}


def report(positions: dict[str, Tensor]) -> str:
    """A table of the errors, and of their changes against the first row."""
    first = next(iter(positions.values()))
    rows = []
    for label, found in positions.items():
        changes = (found / first).log()
        size = float(changes.abs().nanmedian().exp())
        posed = f"{int((~found.isnan()).sum())} of {len(found)}"
        median = f"{100 * float(found.nanmedian()):.2f} %"
        rows.append([label, posed, median, f"{size:.2f}", ratio([changes], 1)])
    header = ["clips to learn from", "posed", "ATE / path", "median change, as a factor", "mean factor"]
    return table(header, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="of XFeat, a safetensors file")
    parser.add_argument("--trained", type=Path, help="file written by run --save")
    parser.add_argument("--clips", type=int, default=8)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    xfeat = Remembering(XFeat(arguments.weights, KEYPOINTS)).to(device)
    front_ends: dict[str, nn.Module] = {"XFeat": xfeat}
    if arguments.trained:
        trained = SubPixel(xfeat, Settings().width, Settings().reach).to(device)
        trained.network.load_state_dict(torch.load(arguments.trained, weights_only=True))
        front_ends["XFeat, trained"] = trained
    name, share = TRAINING
    for sequence in sequences([name]):
        part = Part.of(sequence, share, 0, arguments.clips)
        text = report(positions_of(candidates_of(front_ends), part, device))
        print(text)
        (HERE / "clip_noise.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
