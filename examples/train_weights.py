"""Learn the weight of each keypoint from the poses of clips.

    python -m examples.train_weights synthetic:room path/to/sequence --steps 300
    torchrun --nproc-per-node 2 -m examples.train_weights ...            # half of each batch per process

An interrupted training continues from its checkpoint and ends with the same bytes. ORB detects and matches keypoints; a
small network computes their weights from the detector response and the pyramid level.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from torchslam import ORB, ClipSLAM, Features, clip_loss, open_sequence
from torchslam.learning import Batches, Clips, GraphCache, Log, Training, collate, relative_ate

FAILED = 0.1  # loss of a clip without poses, as a fraction of its path


class Weigh(nn.Module):
    """Features to the weights (B, N) of their keypoints, with geometric mean 1; equal before the training."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.hidden, self.last = nn.Linear(2, width), nn.Linear(width, 1)
        nn.init.zeros_(self.last.weight)

    def forward(self, features: Features) -> Tensor:
        cues = torch.stack([features.scores.clamp_min(1e-6), features.scales], -1).log()
        logs = self.last(torch.tanh(self.hidden(cues - cues.mean(1, keepdim=True)))).squeeze(-1)
        return (logs - logs.mean(-1, keepdim=True)).exp()


def train(
    clips: Clips, steps: int, checkpoint: Path, batch: int = 4, save_every: int = 10, log: Log | None = None
) -> Training:
    """Train from the checkpoint, if there is one, on all processes of the group."""
    rank, ranks = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
    torch.manual_seed(0)
    clip_slam = ClipSLAM(ORB(600), Weigh())
    graphs = GraphCache(clip_slam)
    training = Training(clip_slam, torch.optim.Adam(clip_slam.parameters(), 3e-3), steps, log=log)
    training.resume(checkpoint)
    module = DistributedDataParallel(clip_slam) if ranks > 1 else clip_slam
    batches = Batches(len(clips), batch // ranks, first=training.step, rank=rank, ranks=ranks)
    loader = DataLoader(clips, batch_sampler=batches, collate_fn=collate)
    for step, clip in zip(training, loader, strict=False):
        poses = module(clip.images, clip.camera, graphs(clip))
        loss, failure_rate = clip_loss(poses, clip.T_cw, relative_ate, on_failure=FAILED)
        training.descend(loss)
        if log is not None:
            log("failure_rate", failure_rate, step)
        if rank == 0 and (training.step % save_every == 0 or training.step == steps):
            training.save(checkpoint)
    return training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sequences", nargs="+", help="sequences with ground truth, all of one size")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--clips", type=int, default=50, help="number of clips per sequence")
    parser.add_argument(
        "--checkpoint", type=Path, default=Path("weights.pt"), help="file to save to and to continue from"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if "WORLD_SIZE" in os.environ:
        dist.init_process_group("gloo")
    clips = Clips([open_sequence(name) for name in arguments.sequences], per_sequence=arguments.clips)
    is_main = not dist.is_initialized() or dist.get_rank() == 0  # a SummaryWriter's `add_scalar` does as well
    log = (lambda name, value, step: print(f"{step:5d} {name} {value:.4g}", flush=True)) if is_main else None
    train(clips, arguments.steps, arguments.checkpoint, log=log)
    if dist.is_initialized():
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
