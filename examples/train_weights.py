"""Learn the information of each keypoint from the poses of clips, with or without true poses, and run with it.

    python -m examples.train_weights videos/*.mp4 --camera 700,700,620,190 --without-truth --tensorboard logs \\
        --held-back another.mp4 --output weights.safetensors
    python -m examples.train_weights synthetic:room path/to/sequence --steps 300
    torchrun --nproc-per-node 2 -m examples.train_weights ...            # half of each batch per process
    torchslam run another.mp4 ... --features examples.train_weights:Weighed --weights weights.safetensors

ORB detects and matches keypoints; a small network weighs them by their detector response and pyramid level. Without
true poses, the loss is the difference between the poses from two halves of the points. An interrupted training
continues from its checkpoint and ends with the same bytes.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from torchslam import ORB, ClipSLAM, Features, clip_loss, open_sequence
from torchslam.learning import (
    Batches,
    Clip,
    ClipGraph,
    ClipLoss,
    Clips,
    GraphCache,
    Log,
    Training,
    clip_halves,
    clips_with_a_map,
    collate,
    relative_ate,
)

FAILED = 5.0  # loss of a clip without poses
ERROR_UNIT = 0.001  # ATE relative to the path from which on the loss grows with its logarithm
KEYPOINTS = 600


class Weighed(nn.Module):
    """ORB with learned information of its keypoints: weights of geometric mean 1 in every image, equal before training.

    Args:
        num_keypoints: of ORB.
        weights: a file with the trained parameters, or None.
    """

    def __init__(self, num_keypoints: int = KEYPOINTS, weights: str | None = None) -> None:
        super().__init__()
        self.orb = ORB(num_keypoints)
        self.hidden, self.last = nn.Linear(2, 16), nn.Linear(16, 1)
        nn.init.zeros_(self.last.weight)
        if weights is not None:
            self.load_state_dict(load_file(weights))

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        features = self.orb(images, mask)
        found = features.mask[..., None]
        cues = torch.stack([features.scores.clamp_min(1e-6), features.scales], -1).log()
        logs = self.last(torch.tanh(self.hidden(cues - mean_of(cues, found)))) * found
        weights = (logs - mean_of(logs, found)).squeeze(-1).exp()
        return replace(features, information=weights / (0.5 * features.scales).square())


def mean_of(values: Float[Tensor, "B N C"], found: Bool[Tensor, "B N 1"]) -> Float[Tensor, "B 1 C"]:
    """Mean over the keypoints of each image, which has at least one."""
    return (values * found).sum(1, keepdim=True) / found.sum(1, keepdim=True).clamp_min(1)


def error(
    T_cw: Float[Tensor, "B T 4 4"], T_cw_groundtruth: Float[Tensor, "B T 4 4"], mask: Bool[Tensor, "B T"]
) -> Float[Tensor, " B"]:
    """Robust ATE relative to the path."""
    return (relative_ate(T_cw=T_cw, T_cw_groundtruth=T_cw_groundtruth, mask=mask) / ERROR_UNIT).log1p()


class Loss(nn.Module):
    """The loss of a batch of clips: error against the true poses, or between the poses of two halves of the points."""

    def __init__(self, clip_slam: ClipSLAM, supervised: bool) -> None:
        super().__init__()
        self.clip_slam, self.supervised = clip_slam, supervised

    def forward(self, clip: Clip, graph: ClipGraph) -> ClipLoss:
        features = self.clip_slam.extract(clip.images, graph)
        if self.supervised:
            poses = self.clip_slam.pose(graph, features, clip.camera)
            return clip_loss(poses, T_cw_groundtruth=clip.T_cw, error=error, on_failure=FAILED)
        even, odd = (self.clip_slam.pose(half, features, clip.camera) for half in graph.halves())
        return clip_halves(even, odd, error, on_failure=FAILED)


def is_main() -> bool:
    """Whether this process reports and saves."""
    return not dist.is_initialized() or dist.get_rank() == 0


class Data:
    """The clips that find a map, and their graphs by the feature extractor before the training."""

    def __init__(self, clips: Clips, clip_slam: ClipSLAM) -> None:
        self.graphs = GraphCache(clip_slam)
        self.usable, left_out = clips_with_a_map(clips, self.graphs)
        for reason, count in left_out.most_common() if is_main() else ():
            print(f"{count} of {len(clips)} clips are left out: {reason}")

    @torch.no_grad()
    def mean(self, loss: Loss) -> float:
        """The mean loss of the clips."""
        each = DataLoader(self.usable, collate_fn=collate)
        return float(torch.stack([loss(clip, self.graphs(clip)).loss for clip in each]).mean())


def train(
    clips: Clips,
    steps: int,
    checkpoint: Path,
    supervised: bool = True,
    held_back: Clips | None = None,
    batch: int = 4,
    save_every: int = 10,
    log: Log | None = None,
) -> Training:
    """Train from the checkpoint, if there is one, on all processes of the group; the module is the feature extractor.

    held_back: clips whose mean loss is logged, too, at the start and with every checkpoint
    """
    rank, ranks = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
    torch.manual_seed(0)
    extractor = Weighed()
    clip_slam = ClipSLAM(extractor)
    data, other = Data(clips, clip_slam), None if held_back is None else Data(held_back, clip_slam)
    loss = Loss(clip_slam, supervised)
    training = Training(extractor, torch.optim.Adam(extractor.parameters(), 3e-3), steps, log=log)
    training.resume(checkpoint)
    module = DistributedDataParallel(loss) if ranks > 1 else loss
    batches = Batches(len(data.usable), batch // ranks, first=training.step, rank=rank, ranks=ranks)
    loader = DataLoader(data.usable, batch_sampler=batches, collate_fn=collate)
    for step, clip in zip(training, loader, strict=False):
        if log is not None and other is not None and step % save_every == 0:
            log("held_back_loss", other.mean(loss), step)
        mean, failure_rate = module(clip, data.graphs(clip))
        training.descend(mean)
        if log is not None:
            log("failure_rate", failure_rate, step)
        if is_main() and (training.step % save_every == 0 or training.step == steps):
            training.save(checkpoint)
    if log is not None and other is not None:
        log("held_back_loss", other.mean(loss), steps)
    return training


@contextmanager
def scalars(folder: Path | None) -> Iterator[Log]:
    """What prints losses and, with a folder, writes them for TensorBoard."""
    if folder is None:
        yield _print
        return
    from torch.utils.tensorboard import SummaryWriter  # needs `pip install tensorboard`

    with SummaryWriter(str(folder)) as writer:

        def log(name: str, value: float, step: int) -> None:
            _print(name, value, step)
            writer.add_scalar(name, value, step)

        yield log


def _print(name: str, value: float, step: int) -> None:
    print(f"{step:5d} {name} {value:.4g}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sequences", nargs="+", help="videos, folders of images, data sets; all of one size")
    parser.add_argument("--held-back", nargs="+", default=[], metavar="SEQUENCE", help="to evaluate on")
    parser.add_argument("--camera", help="as for `torchslam run`; the one of the sequences if omitted")
    parser.add_argument("--resize-to", metavar="WxH")
    parser.add_argument("--without-truth", action="store_true", help="use no true poses")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--clips", type=int, default=50, help="number of clips per sequence")
    parser.add_argument(
        "--checkpoint", type=Path, default=Path("weights.pt"), help="file to save to and to continue from"
    )
    parser.add_argument("--tensorboard", type=Path, metavar="DIR", help="write the losses for TensorBoard")
    parser.add_argument("--output", type=Path, help="file for the trained parameters (.safetensors)")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if "WORLD_SIZE" in os.environ:
        dist.init_process_group("gloo")
    supervised = not options.without_truth

    def clips_of(names: list[str]) -> Clips:
        opened = [open_sequence(name, options.camera, resize_to=options.resize_to) for name in names]
        return Clips(opened, per_sequence=options.clips, supervised=supervised)

    clips = clips_of(options.sequences)
    held_back = clips_of(options.held_back) if options.held_back else None
    if is_main():
        with scalars(options.tensorboard) as log:
            training = train(clips, options.steps, options.checkpoint, supervised, held_back, log=log)
        if options.output is not None:
            save_file(training.module.state_dict(), options.output)
    else:
        train(clips, options.steps, options.checkpoint, supervised, held_back)
    if dist.is_initialized():
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
