"""Learn the camera that recordings share from clips of them, with or without true poses.

    python -m examples.learn_camera path/to/recording ... --camera 700,700,620,190 --output camera.txt
    python -m examples.learn_camera path/to/recording ... --camera 700,700,620,190 --without-truth
    torchslam run another/recording --camera camera.txt \\
        --features examples.learn_camera:Straightened --weights camera.safetensors

Focal lengths, principal point, distortion, and what is left of the lens on a small grid over the image, are found by
the gradient of the reprojection errors of clips: of points between true poses, or, without truth, of the poses and
points that `ClipSLAM` finds.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from torchslam import ORB, Camera, ClipSLAM, Features, open_sequence
from torchslam.errors import ClipError
from torchslam.learning import (
    Batches,
    ClipGraph,
    Clips,
    Log,
    Training,
    clip_mean,
    clip_reprojection,
    count_reasons,
    reprojection_loss,
)

GRID = (4, 6)  # rows and columns of what is left of the lens
PARAMETERS = {"focal": (0, 1), "center": (2, 3), "distortion": (4, 5, 6, 7)}
"""Places of fx, fy, cx, cy, k1, k2, p1, p2 among the parameters of a camera; k3 stays as it is."""
PARTS = (*PARAMETERS, "grid")
SAMPLES = (12, 16)  # rows and columns of pixels whose motion tells what a parameter does
KEYPOINTS = 1500  # per image: with fewer, many clips have too few points with parallax to start
FRAMES, MIN_PARALLAX = 16, 0.1  # of a clip, and radians between its ends: with less, scenes look planar
FAILED = 1.0  # loss of a clip that fails on the way, px^2: several times that of a good one
RESIDUAL_PRIOR = 1e-3  # per squared pixel of the grid: it takes what the parameters do not explain
ROUNDS = 2  # of matching with the camera so far
ITERATIONS, STEPS = 30, 80  # in a round: of L-BFGS with true poses, of Adam without
LEAST_CHANGE = 1e-7  # px^2, of the loss, and px, of a parameter: L-BFGS ends
RATE, GRID_RATE = 0.5, 0.05  # of Adam, pixels
BATCH = 4  # clips of a step, or in memory with their gradients


class LearnedCamera(nn.Module):
    """A camera near a start, and a grid of offsets of the pixels (x, y).

    A unit of each number of `change` moves pixels by 1 px, in the root mean square over the image, and in a pattern at
    right angles to those of the others. So focal lengths and distortion, which do much the same, are learned alike.
    The grid is in pixels.

    Args:
        start: A pinhole camera, or one with radial and tangential distortion.
        parts: Of `PARTS`, what is learned; the rest stays as at the start.

    Raises:
        ValueError: The start is of another model, or an unknown part.
    """

    def __init__(self, start: Camera, parts: Sequence[str] = PARTS) -> None:
        super().__init__()
        if not parts or not set(parts) <= set(PARTS):
            raise ValueError(
                f"what is learned of a camera must be of {', '.join(PARTS)}, not {', '.join(parts)}"
            )
        params = start.params.detach().double()
        if start.model == "pinhole":
            params = torch.nn.functional.pad(params, (0, 5))
        elif start.model != "radial_tangential":
            raise ValueError(f"the distortion that is learned is radial and tangential, not {start.model}")
        self.size = start.size
        self.register_buffer("start", params)
        self.register_buffer("patterns", _patterns(Camera("radial_tangential", params, self.size), parts))
        self.change = nn.Parameter(params.new_zeros(torch.as_tensor(self.patterns).shape[1]))
        self.grid = nn.Parameter(params.new_zeros(2, *GRID), requires_grad="grid" in parts)

    def camera(self) -> Camera:
        """The camera now, differentiable."""
        params = torch.as_tensor(self.start) + torch.as_tensor(self.patterns) @ self.change
        return Camera("radial_tangential", params, self.size)

    def straightened(self, keypoints: Float[Tensor, "B N 2"]) -> Float[Tensor, "B N 2"]:
        """Keypoints moved to where the camera without the grid would have seen them."""
        return straighten(keypoints, self.grid, keypoints.new_tensor(self.size, dtype=torch.float64))

    def seen(self, features: Features) -> Features:
        """Features with straightened keypoints."""
        return replace(features, keypoints=self.straightened(features.keypoints))

    def weights(self) -> dict[str, Tensor]:
        """What `Straightened` reads."""
        return {"grid": self.grid.detach(), "size": torch.tensor(self.size, dtype=torch.float64)}


class Straightened(nn.Module):
    """ORB with keypoints where the learned camera, which knows no grid, would have seen them.

    Args:
        num_keypoints: of ORB.
        weights: a file with the learned grid and the size of the images, or None for no grid.
    """

    def __init__(self, num_keypoints: int = KEYPOINTS, weights: str | None = None) -> None:
        super().__init__()
        self.orb = ORB(num_keypoints)
        self.register_buffer("grid", torch.zeros(2, *GRID, dtype=torch.float64))
        self.register_buffer("size", torch.ones(2, dtype=torch.float64))
        if weights is not None:
            self.load_state_dict(load_file(weights))

    def forward(
        self, images: Float[Tensor, "B 1 H W"], mask: Bool[Tensor, "B 1 H W"] | None = None
    ) -> Features:
        found = self.orb(images, mask)
        grid, size = torch.as_tensor(self.grid), torch.as_tensor(self.size)
        return replace(found, keypoints=straighten(found.keypoints, grid, size))


def straighten(
    keypoints: Float[Tensor, "B N 2"], grid: Float[Tensor, "2 rows columns"], size: Float[Tensor, "2"]
) -> Float[Tensor, "B N 2"]:
    """Keypoints of images of a size (width, height), moved by the offsets of a grid, bilinear between its nodes."""
    places = 2 * keypoints.double() / (size - 1) - 1
    offset = torch.nn.functional.grid_sample(
        grid.expand(len(keypoints), *grid.shape), places[:, None], padding_mode="border", align_corners=True
    )
    return keypoints + offset[:, :, 0].mT


class Example(NamedTuple):
    """A clip of T frames: its features as they were extracted, what they see, and the true poses."""

    features: Features
    graph: ClipGraph
    T_cw: Float[Tensor, "T 4 4"]


def learn(
    clips: Clips,
    start: Camera,
    supervised: bool,
    parts: Sequence[str] = PARTS,
    steps: int | None = None,
    seed: int = 0,
    log: Log | None = None,
) -> LearnedCamera:
    """The camera that explains clips best.

    Args:
        clips: Of recordings of the camera, with true poses if `supervised`.
        start: A camera to start from.
        supervised: Points are between the true poses; otherwise poses and points are those that fit best.
        parts: Of `PARTS`, what is learned; the rest stays as at the start.
        steps: In each of two rounds; matches of the second are found with the camera of the first. None: `ITERATIONS`
            or `STEPS`.
        seed: Of the order of the clips, without true poses.
        log: Receives the losses, px^2, and their numbers in the round.

    Raises:
        ClipError: No clip can be used.
    """
    lens, clip_slam = LearnedCamera(start, parts), ClipSLAM(ORB(KEYPOINTS))
    for _ in range(ROUNDS):
        examples, left_out = matched(clips, clip_slam, lens)
        for reason, count in left_out.most_common():
            print(f"{count} of {len(clips)} clips are left out: {reason}")
        if not examples:
            raise ClipError("no clip can be used: take longer clips, a larger parallax, or a better camera")
        if supervised:
            _minimize(lens, clip_slam, examples, steps or ITERATIONS, log)
        else:
            _descend(lens, clip_slam, examples, steps or STEPS, seed, log)
    return lens


def matched(clips: Clips, clip_slam: ClipSLAM, lens: LearnedCamera) -> tuple[list[Example], Counter[str]]:
    """Clips whose frames all find poses with the camera so far, and how many of the others do not, by reason."""
    examples, reasons = [], []
    with torch.no_grad():
        for number in range(len(clips)):
            clip = clips[number]
            features = clip_slam.extract(clip.images)
            assert isinstance(features, Features)
            graph = clip_slam.build_graph(clip.images, lens.camera(), lens.seen(features))
            poses = clip_slam.pose(graph, lens.seen(features))
            lost = "" if poses.posed.all() else "frames without a pose"
            reasons.append(poses.reasons[0] or lost)
            if not reasons[-1]:
                examples.append(Example(features, graph, clip.T_cw))
    return examples, count_reasons(reasons)


def loss_of(
    clip_slam: ClipSLAM, lens: LearnedCamera, examples: Sequence[Example], supervised: bool
) -> Float[Tensor, ""]:
    """The mean loss of clips, px^2."""
    seen = [lens.seen(each.features) for each in examples]
    if supervised:
        each = zip(examples, seen, strict=True)
        loss = torch.stack([_between_true_poses(*one, lens.camera()) for one in each]).mean()
    else:
        graph = ClipGraph.stack([each.graph for each in examples])
        poses = clip_slam.pose(graph, seen, lens.camera())
        loss, _ = clip_mean(poses, clip_reprojection(poses), on_failure=FAILED)
    return loss + RESIDUAL_PRIOR * lens.grid.square().mean()


def describe(camera: Camera) -> str:
    """The parameters as `--camera` and calibration files have them."""
    return ",".join(f"{value:.6g}" for value in camera.params.tolist())


def _minimize(
    lens: LearnedCamera, clip_slam: ClipSLAM, examples: Sequence[Example], iterations: int, log: Log | None
) -> None:
    """Minimize the loss with true poses: it is smooth, so that L-BFGS over all clips finds the minimum."""
    learned = [each for each in lens.parameters() if each.requires_grad and each.numel()]
    optimizer = torch.optim.LBFGS(
        learned, max_iter=iterations, tolerance_change=LEAST_CHANGE, line_search_fn="strong_wolfe"
    )
    losses: list[float] = []

    def evaluate() -> float:
        optimizer.zero_grad()
        losses.append(0.0)
        for row in range(0, len(examples), BATCH):
            batch = examples[row : row + BATCH]
            loss = loss_of(clip_slam, lens, batch, supervised=True) * len(batch) / len(examples)
            loss.backward()
            losses[-1] += float(loss.detach())
        if log is not None:
            log("loss", losses[-1], len(losses))
        return losses[-1]

    optimizer.step(evaluate)


def _descend(
    lens: LearnedCamera,
    clip_slam: ClipSLAM,
    examples: Sequence[Example],
    steps: int,
    seed: int,
    log: Log | None,
) -> None:
    """Descend the loss from the images alone: it jumps where a clip finds another minimum, which many steps average."""
    rates = [(lens.change, RATE), (lens.grid, GRID_RATE)]
    groups = [{"params": [each], "lr": rate} for each, rate in rates if each.requires_grad and each.numel()]
    training = Training(lens, torch.optim.Adam(groups), steps, seed, log)
    batches = Batches(len(examples), min(BATCH, len(examples)), seed)
    for _, rows in zip(training, batches, strict=False):
        training.descend(loss_of(clip_slam, lens, [examples[row] for row in rows], supervised=False))


def _between_true_poses(example: Example, seen: Features, camera: Camera) -> Float[Tensor, ""]:
    """The reprojection errors of the points of a clip, triangulated between its true poses."""
    graph = example.graph.runs[0]
    assert graph is not None
    frames = graph.frame_ids[graph.frame_index]
    at = graph.point_index, frames
    mask = torch.zeros(len(graph.points_w), len(example.T_cw), dtype=torch.bool)
    pixels = seen.keypoints.new_zeros(*mask.shape, 2)
    pixels = pixels.index_put(at, seen.keypoints[frames, graph.keypoint_index])
    return reprojection_loss(example.T_cw, pixels, camera, mask.index_put(at, torch.tensor(True)))


def _patterns(camera: Camera, parts: Iterable[str]) -> Float[Tensor, "P K"]:
    """Changes of the parameters of a camera, each of which moves the pixels in another pattern, by 1 px each."""
    columns = [column for part in parts for column in PARAMETERS.get(part, ())]
    y, x = (
        (torch.arange(count, dtype=torch.float64) + 0.5) / count * side - 0.5
        for count, side in zip(SAMPLES, reversed(camera.size), strict=True)
    )
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    rays = camera.unproject(pixels)
    J = torch.func.jacfwd(lambda params: camera.with_params(params).project(rays)[0])(camera.params)
    _, S, Vt = torch.linalg.svd(J[..., columns].flatten(0, 1), full_matrices=False)
    patterns = J.new_zeros(len(camera.params), len(columns))
    patterns[columns] = Vt.mT / S * len(pixels) ** 0.5
    return patterns


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sequences", nargs="+", help="recordings of one camera")
    parser.add_argument("--camera", help="fx,fy,cx,cy to start from; the one of the recordings if omitted")
    parser.add_argument("--without-truth", action="store_true")
    parser.add_argument("--parts", default=",".join(PARTS), help="what is learned")
    parser.add_argument("--clips", type=int, default=30, help="number of clips per recording")
    parser.add_argument("--frames", type=int, default=FRAMES, help="of a clip; fewer for a car")
    parser.add_argument(
        "--min-parallax", type=float, default=MIN_PARALLAX, help="of a clip, radians; less for a car"
    )
    parser.add_argument("--steps", type=int, help=f"in each round; {ITERATIONS}, or {STEPS} without truth")
    parser.add_argument("--resize-to")
    parser.add_argument("--output", type=Path, help="of the camera; its grid goes beside it, as .safetensors")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    sequences = [open_sequence(name, resize_to=options.resize_to) for name in options.sequences]
    start = sequences[0].camera
    if options.camera is not None:
        fx, fy, cx, cy = map(float, options.camera.split(","))
        start = Camera.pinhole(fx, fy, cx, cy, size=start.size)
    supervised = not options.without_truth
    clips = Clips(sequences, options.frames, options.clips, options.min_parallax, supervised=supervised)

    def log(name: str, value: float, step: int) -> None:
        print(f"{step:5d} {name} {value:.5g}", flush=True)

    lens = learn(clips, start, supervised, options.parts.split(","), options.steps, log=log)
    camera = lens.camera()
    print(f"camera {describe(camera)}, grid up to {float(lens.grid.detach().abs().max()):.2f} px")
    if options.output is not None:
        options.output.write_text(describe(camera).replace(",", " ") + "\n")
        save_file(lens.weights(), options.output.with_suffix(".safetensors"))


if __name__ == "__main__":
    main()
