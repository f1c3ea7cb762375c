"""Learn through SLAM on rendered scenes: weights and offsets of keypoints, and a factor of odometry.

    python -m examples.research --output results/research               # to a curve of held-out errors in minutes
    python -m examples.research --output results/research --steps 300   # goes on from its checkpoint
    python -m examples.research --options "noise=6&blur=1&readout=20"   # other scenes, kept beside these

Rooms are rendered and mapped once, each by one run; their graphs are kept in the output folder. Two things are wrong
with them on purpose: keypoints are moved as by a lens that the camera model lacks, and noisier toward the right edge;
wheels measure the distances between keyframes too long in turns. The module learns to undo both from true poses of the
training rooms. The curve is the ATE of rooms that it has never seen.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchslam import SLAM, GraphSolution, open_sequence, solve_graph
from torchslam.evaluation import ate
from torchslam.geometry import se3_inverse
from torchslam.learning import Training
from torchslam.optim import GRAPH_OPTIONS, Factors
from torchslam.optim.observation_graph import RunGraph

TRAIN, TEST = (1, 2, 3), (101, 102)  # seeds of the rooms
OPTIONS = "noise=3&blur=0.7"
FRAMES, STRIDE, SIZE = 24, 3, "320x240"
LENS_PX, NOISE_PX = 1.0, 1.5  # of the keypoints at the edge of the image
SLIP = 4.0  # how much too long wheels measure, per radian squared of a turn
WHEEL_STD = 0.02  # relative error of a distance otherwise
RATE = 0.02
EVERY = 5  # steps between two measurements on the test rooms
PRECISE = GRAPH_OPTIONS.replace(tolerance=1e-14, iterations=300)  # of finite differences


@dataclass(frozen=True)
class Example:
    """A room: its graph with wrong keypoints, true poses of its frames, and distances by the wheels."""

    graph: RunGraph
    T_cw: Float[Tensor, "K 4 4"]
    pairs: Tensor
    distances: Tensor


def turn(T_1w: Tensor, T_2w: Tensor) -> Tensor:
    """Squared angle between two poses, radians, to second order; differentiable at the identity."""
    return 3 - (T_2w[..., :3, :3] * T_1w[..., :3, :3]).sum((-1, -2))


class Corrections(nn.Module):
    """Learned corrections; none before the training."""

    def __init__(self) -> None:
        super().__init__()
        self.weigh = nn.Sequential(nn.Linear(2, 16), nn.Tanh(), nn.Linear(16, 1)).double()
        self.move = nn.Sequential(nn.Linear(2, 16), nn.Tanh(), nn.Linear(16, 2)).double()
        for last in (*self.weigh[2].parameters(), *self.move[2].parameters()):
            nn.init.zeros_(last)
        self.slip = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def wheels(self, T_1w: Tensor, T_2w: Tensor, distances: Tensor) -> Tensor:
        """The learned factor: an error of the distance between two frames."""
        centers = (se3_inverse(T)[..., :3, 3] for T in (T_1w, T_2w))
        length = (next(centers) - next(centers)).norm(dim=-1)
        return ((length / distances).log() + self.slip * turn(T_1w, T_2w))[..., None]

    def forward(self, example: Example) -> RunGraph:
        """The graph with corrected keypoints and weights."""
        graph = example.graph
        size = graph.pixels.new_tensor(graph.camera.size)
        places = 2 * graph.pixels / size - 1
        logs = self.weigh(places)[:, 0]
        weights = graph.weights * (logs - logs.mean()).exp()  # of geometric mean 1: only ratios are learned
        return replace(graph, pixels=graph.pixels + self.move(places), weights=weights)

    def solve(
        self,
        example: Example,
        precise: bool = False,
        start: GraphSolution | None = None,
        has_factor: bool = True,
    ) -> GraphSolution:
        """All poses of a room; start: the solution of a step before, from which few iterations are left."""
        count = len(example.pairs)
        information = torch.full((count, 1, 1), 1 / WHEEL_STD**2, dtype=torch.float64)
        factor = Factors(example.pairs, example.distances, information, self.wheels)
        factors = [factor] if has_factor else []
        options = PRECISE if precise else GRAPH_OPTIONS
        return solve_graph(self(example), factors=factors, options=options, start=start)


def error(module: Corrections, example: Example, precise: bool = False) -> Tensor:
    """ATE in meters, after alignment by a similarity."""
    return ate(T_cw=module.solve(example, precise).T_cw, T_cw_groundtruth=example.T_cw)


def prepared(seed: int, options: str, folder: Path) -> Example:
    """A room, from the folder if it was rendered and mapped before."""
    file = folder / f"room-{seed}-{options}.safetensors"
    name = f"synthetic:room?seed={seed}&{options}"
    sequence = open_sequence(name, resize_to=SIZE, stride=STRIDE, limit=FRAMES)
    if not file.exists():
        # The camera is exact: a free one would take up what is learned.
        replace(SLAM(sequence.camera).run(sequence).graph, calibration=None).save(file)
    graph = RunGraph.load(file)
    truth = [sequence.pose(index) for index in graph.frame_ids.tolist()]
    T_cw = torch.stack([pose for pose in truth if pose is not None])  # a rendered frame has one
    generator = torch.Generator().manual_seed(seed)
    size = graph.pixels.new_tensor(graph.camera.size)
    places = 2 * graph.pixels / size - 1
    lens = LENS_PX * places * places.square().sum(-1, keepdim=True)
    noise = torch.randn(graph.pixels.shape, generator=generator, dtype=torch.float64)
    noise = NOISE_PX * noise * places[:, :1].clamp(min=0)
    keyframes = graph.is_keyframe.nonzero()[:, 0]
    pairs = torch.stack((keyframes[:-1], keyframes[1:]), dim=-1)
    T_1w, T_2w = T_cw[pairs[:, 0]], T_cw[pairs[:, 1]]
    length, mapped = (se3_inverse(T)[keyframes, :3, 3].diff(dim=0).norm(dim=-1) for T in (T_cw, graph.T_cw))
    slipped = mapped.sum() / length.sum() * length * (SLIP * turn(T_1w, T_2w)).exp()  # in the unit of the map
    return Example(replace(graph, pixels=graph.pixels + lens + noise), T_cw, pairs, slipped)


def check_gradient(module: Corrections, example: Example) -> float:
    """Relative difference of the gradient from a central difference along it, of solves to the last digits."""
    parameters = list(module.parameters())
    gradients = torch.autograd.grad(error(module, example, precise=True), parameters, allow_unused=True)
    found = [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, gradients, strict=True)]
    length = torch.stack([each.square().sum() for each in found]).sum().sqrt()
    losses = []
    with torch.no_grad():
        for step in (1e-4, -2e-4):  # to one side, and on to the other one
            for parameter, gradient in zip(parameters, found, strict=True):
                parameter.add_(gradient / length, alpha=step)
            losses.append(float(error(module, example, precise=True)))
        for parameter, gradient in zip(parameters, found, strict=True):
            parameter.add_(gradient / length, alpha=1e-4)
    return abs((losses[0] - losses[1]) / 2e-4 / float(length) - 1)


def draw(curve: list[tuple[int, float, float]], path: Path) -> None:
    """Errors over steps."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    steps, train, test = zip(*curve, strict=True)
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    axes.semilogy(steps, [1e3 * each for each in train], label="training rooms")
    axes.semilogy(steps, [1e3 * each for each in test], label="held-out rooms")
    axes.set(xlabel="step", ylabel="ATE [mm]")
    axes.legend()
    figure.savefig(path)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=Path("results/research"))
    parser.add_argument("--options", default=OPTIONS, help="of the rendered rooms (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument(
        "--rooms", type=int, nargs=2, default=(len(TRAIN), len(TEST)), metavar=("TRAIN", "TEST")
    )
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    module = Corrections()
    training = Training(module, torch.optim.Adam(module.parameters(), RATE), steps=options.steps)
    checkpoint, csv_file = options.output / "checkpoint.pt", options.output / "curve.csv"
    options.output.mkdir(parents=True, exist_ok=True)
    curve: list[tuple[int, float, float]] = []
    if training.resume(checkpoint):
        with csv_file.open(newline="") as file:
            curve = [(int(a), float(b), float(c)) for a, b, c in list(csv.reader(file))[1:]]
    seeds = TRAIN[: options.rooms[0]], TEST[: options.rooms[1]]
    first = prepared(seeds[0][0], options.options, options.output)
    error(module, first).backward()
    print(f"first gradient after {time.perf_counter() - start:.1f} s")
    print(f"gradient off a central difference by {check_gradient(module, first):.1e} of its length")
    train, test = ([prepared(seed, options.options, options.output) for seed in part] for part in seeds)

    def measure() -> None:
        with torch.no_grad():
            means = [
                float(torch.stack([error(module, each) for each in part]).mean()) for part in (train, test)
            ]
        curve.append((training.step, means[0], means[1]))
        print(
            f"step {training.step}: ATE {1e3 * means[0]:.2f} mm, held out {1e3 * means[1]:.2f} mm", flush=True
        )
        with csv_file.open("w", newline="") as file:
            csv.writer(file).writerows([("step", "train_m", "held_out_m"), *curve])
        draw(curve, options.output / "curve.png")

    if not curve:
        measure()
    last: dict[int, GraphSolution] = {}  # of each room, from which its next search starts
    for step in training:
        row = step % len(train)
        last[row] = module.solve(train[row], start=last.get(row))
        training.descend(ate(T_cw=last[row].T_cw, T_cw_groundtruth=train[row].T_cw).log())
        if training.step % EVERY == 0 or training.step == options.steps:
            measure()
            training.save(checkpoint)
    print(f"{time.perf_counter() - start:.0f} s; {options.output / 'curve.png'}")


if __name__ == "__main__":
    main()
