"""Train the network that rates depth (`dense.aggregation = "learned"`).

    python -m examples.train_depth --rooms 141                           # rendered rooms with exact depth
    python -m examples.train_depth results/office results/courthouse     # runs without truth
    python -m examples.train_depth results/office --rooms 141            # both, half of each batch

Without truth, the depth that several keyframes of a run agree on is what the depth of each alone is compared with: it
comes from the poses and images of the run and nothing else. A depth that no other view confirms counts as wrong. An
interrupted training continues from its checkpoint. Every room takes about 7 seconds and every keyframe one, before the
training, which takes 9 minutes on one thread.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from safetensors.torch import save_file
from torch import Tensor

from experiments.dense.rooms import samples
from torchslam.cli.densify import LONG_SIDE, map_size
from torchslam.dense.consistency import confidence_alone, confidence_together, kept, merge
from torchslam.dense.estimate import Estimate, estimate_depth
from torchslam.dense.learned import HALF_INPUTS, RatingNet, net_inputs
from torchslam.densify.views import SWEPT, ViewImages, views_of
from torchslam.io.export.scene import pinhole_within
from torchslam.io.results import open_run
from torchslam.learning import Log, Training

PER_ROOM = 8
CROP = (72, 88)  # rows and columns at half size
BATCH = 4
RATE = 3e-3
RIGHT = 0.05
UNCONFIRMED = 0.3  # confidence of all views together below which a depth counts as wrong


class Example(NamedTuple):
    """A view: what the network reads, and which of its depths are right.

    Attributes:
        inputs: by `net_inputs`, of half precision for the sake of memory.
        is_right: whether the depth by `estimate_depth` is right within 5 %.
        is_rated: whether that is known.
    """

    inputs: Float[Tensor, "C h w"]
    is_right: Bool[Tensor, "H W"]
    is_rated: Bool[Tensor, "H W"]


def example(
    found: Estimate, gray: Tensor, near: Tensor, far: Tensor, target: Tensor, is_rated: Tensor
) -> Example:
    """One view, as a batch of one, and its inverse depth (H, W); a rated depth is wrong where that is 0."""
    known = target > 0
    error = (found.inverse_depth[0] / torch.where(known, target, 1.0) - 1).abs()
    return Example(net_inputs(found, gray, near, far)[0].half(), known & (error < RIGHT), is_rated)


@torch.no_grad()
def of_room(seed: int, count: int = PER_ROOM) -> list[Example]:
    """Views of a rendered room, whose exact depth is the target."""
    examples = []
    for each in samples(seed, count):
        limits = each.near[None], each.far[None]
        gray = each.reference[None]
        found = estimate_depth(gray, each.sources[None], each.camera, each.T_sr[None], *limits)
        known = each.depth > 0
        target = torch.where(known, 1 / torch.where(known, each.depth, 1.0), 0.0)
        examples.append(example(found, gray, *limits, target, known))
    return examples


@torch.no_grad()
def of_run(folder: Path, resolution: str = str(LONG_SIDE)) -> list[Example]:
    """Keyframes of a run, at a resolution of `torchslam densify`; the target is what they agree on."""
    run = open_run(folder)
    assert run.main is not None, f"{folder}: no map"
    scene = run.scene(run.main, keyframes_alone=True)
    views = views_of(scene, map_size(resolution, pinhole_within(scene.camera).size))
    images = ViewImages(views, run.images(scene, views.camera))
    found = []
    for view in range(len(views)):
        sources = torch.stack([images.gray(other) for other in views.neighbors[view][:SWEPT]])
        limits = views.near[view, None], views.far[view, None]
        poses = views.T_sr(view)[None, :SWEPT]
        found.append(estimate_depth(images.gray(view)[None], sources[None], views.camera, poses, *limits))
    depths = torch.cat([each.inverse_depth for each in found])
    alone = torch.cat([confidence_alone(each) for each in found])
    examples = []
    for view, each in enumerate(found):
        others = list(views.neighbors[view])
        poses = views.T_sr(view)
        merged = merge(depths[view], alone[view], depths[others], alone[others], views.camera, poses)
        confidence = confidence_together(merged, alone[view])
        agreed = kept(confidence)
        target = torch.where(agreed, merged.inverse_depth, 0.0)
        limits = views.near[view, None], views.far[view, None]
        rated = agreed | (confidence < UNCONFIRMED)
        examples.append(example(each, images.gray(view)[None], *limits, target, rated))
    return examples


def crop(view: Example, generator: torch.Generator, size: tuple[int, int] = CROP) -> Example:
    """A random part, mirrored at random; padded with pixels that do not count where the view is smaller."""
    height, width = view.inputs.shape[-2:]
    top, left = (
        _below(max(side - part, 0) + 1, generator) for side, part in zip((height, width), size, strict=True)
    )
    inputs = view.inputs[:, top : top + size[0], left : left + size[1]].float()
    maps = [
        each[2 * top : 2 * (top + size[0]), 2 * left : 2 * (left + size[1])]
        for each in (view.is_right, view.is_rated)
    ]
    for dim in (-1, -2):
        if _below(2, generator):
            # The inputs of full size are four to a pixel of half size.
            full = F.pixel_unshuffle(F.pixel_shuffle(inputs[HALF_INPUTS:], 2).flip(dim), 2)
            inputs = torch.cat((inputs[:HALF_INPUTS].flip(dim), full))
            maps = [each.flip(dim) for each in maps]
    missing = (0, size[1] - inputs.shape[-1], 0, size[0] - inputs.shape[-2])
    right, rated = (F.pad(each, tuple(2 * side for side in missing)) for each in maps)
    return Example(F.pad(inputs, missing), right, rated)


def loss_of(net: RatingNet, batch: Example) -> Float[Tensor, ""]:
    """Mean negative log-likelihood, in nats, of which depths are right."""
    odds = F.pixel_shuffle(net(batch.inputs), 2)[:, 0][batch.is_rated]
    is_right = batch.is_right[batch.is_rated].to(odds.dtype)
    return F.binary_cross_entropy_with_logits(odds, is_right, reduction="sum") / max(len(odds), 1)


def train(
    sets: Sequence[Sequence[Example]], steps: int, checkpoint: Path, seed: int = 0, log: Log | None = None
) -> RatingNet:
    """Train on sets of views, which take equal parts of each batch."""
    torch.manual_seed(seed)
    net = RatingNet()
    optimizer = torch.optim.AdamW(net.parameters(), RATE, weight_decay=1e-3)
    training = Training(net, optimizer, steps, seed, log)
    training.resume(checkpoint)
    for _ in training:
        views = []
        for number in range(BATCH):
            some = sets[number % len(sets)]
            views.append(crop(some[_below(len(some), training.generator)], training.generator))
        training.descend(loss_of(net, Example(*(torch.stack(each) for each in zip(*views, strict=True)))))
        if training.step % 100 == 0 or training.step == steps:
            training.save(checkpoint)
    return net


def _below(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("results", nargs="*", type=Path, help="folders that `torchslam run` wrote")
    parser.add_argument("--rooms", type=int, default=0, help="number of rendered rooms")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--checkpoint", type=Path, default=Path("depth.pt"), help="to continue from")
    parser.add_argument("--output", type=Path, default=Path("depth.safetensors"), help="the weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rooms = [each for seed in range(arguments.rooms) for each in of_room(seed)]
    runs = [each for folder in arguments.results for each in of_run(folder)]
    sets = [each for each in (rooms, runs) if each]
    if not sets:
        parser.error("nothing to train on: give results folders or --rooms")

    def log(name: str, value: float, step: int) -> None:
        if step % 100 == 99:
            print(f"{step + 1:5d} {name} {value:.4g}", flush=True)

    net = train(sets, arguments.steps, arguments.checkpoint, arguments.seed, log)
    save_file(net.state_dict(), arguments.output)


if __name__ == "__main__":
    main()
