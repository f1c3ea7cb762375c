"""Learn the camera that recordings share from the poses of clips, with or without true poses.

    python -m examples.learn_camera path/to/recording ... --camera 700,700,620,190 --steps 60 --output camera.txt
    python -m examples.learn_camera path/to/recording ... --camera 700,700,620,190 --without-truth

Focal lengths, principal point, distortion, and what is left of the lens on a small grid over the image, are found by
the gradient of the trajectory error of clips (or, without truth, of their reprojection error) through `ClipSLAM`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from torchslam import ORB, Camera, ClipSLAM, Features, open_sequence
from torchslam.learning import (
    Batches,
    Clip,
    Clips,
    GraphCache,
    Log,
    Training,
    clip_loss,
    clip_mean,
    clip_reprojection,
    clips_with_a_map,
    collate,
    relative_ate,
)

GRID = (4, 6)  # rows and columns of what is left of the lens
FAILED = 0.1  # loss of a clip that loses its poses on the way, as a fraction of its path
PARTS = ("focal", "center", "distortion", "grid")
RATES = {"focal": 5e-3, "center": 2e-3, "distortion": 2e-3, "grid": 2e-4}
"""Of Adam, per step: the focal length changes by at most 0.5 %, the center by 0.2 px, the grid by 0.02 px."""
RESIDUAL_PRIOR = 1e-3  # per squared pixel of the grid: it takes what the parameters do not explain
_PIXELS = 100.0  # that one unit of a parameter of the grid or the principal point stands for


class LearnedCamera(nn.Module):
    """A camera, and a grid of offsets of the pixels (x, y), as deviations from a start."""

    def __init__(self, start: Camera) -> None:
        super().__init__()
        params = start.params.detach().double()
        if start.model == "pinhole":
            params = torch.nn.functional.pad(params, (0, 5))
        elif start.model != "radial_tangential":
            raise ValueError(f"the distortion that is learned is radial and tangential, not {start.model}")
        self.size = start.size
        self.register_buffer("start", params)
        self.focal = nn.Parameter(torch.zeros(2, dtype=torch.float64))  # logarithm of the factor
        self.center = nn.Parameter(torch.zeros(2, dtype=torch.float64))
        self.distortion = nn.Parameter(torch.zeros(4, dtype=torch.float64))
        self.grid = nn.Parameter(torch.zeros(2, *GRID, dtype=torch.float64))

    def camera(self) -> Camera:
        """The camera now, differentiable."""
        start = torch.as_tensor(self.start)
        focal, center = start[:2] * self.focal.exp(), start[2:4] + _PIXELS * self.center
        bend = start[4:8] + self.distortion
        return Camera("radial_tangential", torch.cat((focal, center, bend, start[8:])), self.size)

    def straightened(self, keypoints: Tensor) -> Tensor:
        """Keypoints (B, N, 2) moved to where the camera without the grid would have seen them."""
        places = 2 * keypoints.double() / (torch.tensor(self.size).double() - 1) - 1
        grid = _PIXELS * self.grid.expand(len(keypoints), *self.grid.shape)
        offset = torch.nn.functional.grid_sample(
            grid, places[:, None], padding_mode="border", align_corners=True
        )
        return keypoints + offset[:, :, 0].mT


class SeenThrough(nn.Module):
    """A front end whose keypoints are straightened by the learned lens."""

    def __init__(self, extractor: nn.Module, lens: LearnedCamera) -> None:
        super().__init__()
        self.extractor, self.lens = extractor, lens

    def forward(self, images: Tensor) -> Features:
        with torch.no_grad():
            found: Features = self.extractor(images)
        return replace(found, keypoints=self.lens.straightened(found.keypoints))


def learn(
    clips: Clips,
    start: Camera,
    steps: int,
    supervised: bool,
    parts: Sequence[str] = PARTS,
    batch: int = 4,
    seed: int = 0,
    log: Log | None = None,
) -> LearnedCamera:
    """The camera that explains clips best; `supervised` by their true poses, or by their own reprojection errors.

    parts: of `PARTS`, what is learned; the rest stays as at the start
    """
    lens = LearnedCamera(start)
    clip_slam = ClipSLAM(SeenThrough(ORB(600), lens))
    graphs = GraphCache(clip_slam)
    usable, left_out = clips_with_a_map(clips, graphs)
    for reason, count in left_out.most_common():
        print(f"{count} of {len(clips)} clips are left out: {reason}")
    optimizer = torch.optim.Adam([{"params": [getattr(lens, part)], "lr": RATES[part]} for part in parts])
    training = Training(clip_slam, optimizer, steps, seed=seed, log=log)
    batches = Batches(len(usable), min(batch, len(usable)), seed=seed)
    loader = DataLoader(usable, batch_sampler=batches, collate_fn=collate)
    for _, clip in zip(training, loader, strict=False):
        training.descend(loss_of(clip_slam, lens, clip, graphs, supervised))
    return lens


def loss_of(
    clip_slam: ClipSLAM, lens: LearnedCamera, clip: Clip, graphs: GraphCache, supervised: bool
) -> Tensor:
    """The loss of a batch of clips."""
    poses = clip_slam(clip.images, lens.camera(), graphs(clip))
    if supervised:
        loss, _ = clip_loss(poses, clip.T_cw, relative_ate, on_failure=FAILED)
    else:
        loss, _ = clip_mean(poses, clip_reprojection(poses), on_failure=FAILED)
    return loss + RESIDUAL_PRIOR * (_PIXELS * lens.grid).square().mean()


def describe(camera: Camera) -> str:
    """The parameters as `--camera` and calibration files have them."""
    return ",".join(f"{value:.6g}" for value in camera.params.tolist())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sequences", nargs="+", help="recordings of one camera")
    parser.add_argument("--camera", help="fx,fy,cx,cy to start from; the one of the recordings if omitted")
    parser.add_argument("--without-truth", action="store_true")
    parser.add_argument("--parts", default=",".join(PARTS), help="what is learned")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--clips", type=int, default=30, help="number of clips per recording")
    parser.add_argument("--resize-to")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    sequences = [open_sequence(name, resize_to=options.resize_to) for name in options.sequences]
    start = sequences[0].camera
    if options.camera is not None:
        fx, fy, cx, cy = map(float, options.camera.split(","))
        start = Camera.pinhole(fx, fy, cx, cy, size=start.size)
    supervised = not options.without_truth
    clips = Clips(sequences, per_sequence=options.clips, supervised=supervised)

    def log(name: str, value: float, step: int) -> None:
        print(f"{step:5d} {name} {value:.4g}", flush=True)

    lens = learn(clips, start, options.steps, supervised, options.parts.split(","), log=log)
    camera = lens.camera()
    print(f"camera {describe(camera)}, grid up to {float(_PIXELS * lens.grid.detach().abs().max()):.2f} px")
    if options.output is not None:
        options.output.write_text(describe(camera).replace(",", " ") + "\n")


if __name__ == "__main__":
    main()
