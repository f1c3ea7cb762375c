"""Is the gradient of depth its slope? Baselines of recordings are scaled, and all depths must follow.

    torchslam run 'synthetic:room?frames=100' -o results/room
    torchslam run ../shared/data/redkitchen -o results/redkitchen
    python -m experiments.gradients.depth results/room results/redkitchen

Writes depth.md next to this file. One thread.
"""

from __future__ import annotations

import math
import statistics
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import parser_of, publish_page, table, timed
from torchslam.cli.densify import LONG_SIDE, map_size
from torchslam.dense.consistency import confidence_alone, kept
from torchslam.dense.estimate import Estimate, estimate_depth
from torchslam.densify.views import SWEPT, ViewImages, views_of
from torchslam.geometry import Camera
from torchslam.io.export.scene import pinhole_within
from torchslam.io.results import open_run

VIEWS, PIXELS = 6, 150
"""Views of each recording, and confident pixels of each, whose gradients are compared."""
STEPS = (0.01, 0.03)
"""Relative change of the baselines in the finite differences."""
NEAR = 0.1
"""Relative difference that counts as equal."""
SEED = 0


def scaled_depth(
    gray: Tensor, sources: Tensor, camera: Camera, T_sr: Tensor, limits: tuple[Tensor, Tensor], x: Tensor
) -> Estimate:
    """Depth of one view with all baselines times exp(x)."""
    moved = torch.cat((T_sr[..., :3, 3:] * x.exp(), T_sr[..., 3:, 3:]), dim=-2)
    return estimate_depth(gray, sources, camera, torch.cat((T_sr[..., :3], moved), dim=-1), *limits)


def share(found: Tensor, expected: Tensor | float) -> str:
    """Ratio of the slopes that agree, in percent."""
    return f"{100 * float(((found / expected - 1).abs() < NEAR).double().mean()):.1f} %"


def measure(folder: Path) -> list[str]:
    """A row of the table: a recording."""
    run = open_run(folder)
    if run.main is None:
        raise SystemExit(f"{folder}: no map")
    scene = run.scene(run.main, keyframes_alone=True)
    views = views_of(scene, map_size(str(LONG_SIDE), pinhole_within(scene.camera).size))
    images = ViewImages(views, run.images(scene, views.camera))
    generator = torch.Generator().manual_seed(SEED)
    slopes: list[Tensor] = []
    differences: dict[float, list[Tensor]] = {step: [] for step in STEPS}
    costs, confident = [], []
    for view in torch.linspace(0, len(views) - 1, VIEWS).round().long().tolist():
        gray = images.gray(view)[None]
        sources = torch.stack([images.gray(other) for other in views.neighbors[view][:SWEPT]])[None]
        T_sr, limits = views.T_sr(view)[None, :SWEPT], (views.near[view, None], views.far[view, None])

        depth = partial(scaled_depth, gray, sources, views.camera, T_sr, limits)
        zero = torch.zeros((), dtype=T_sr.dtype)
        plain, forward = timed(partial(depth, zero))
        leaf = zero.clone().requires_grad_()
        found, recorded = timed(partial(depth, leaf))
        assert torch.equal(found.inverse_depth, plain.inverse_depth)
        is_confident = kept(confidence_alone(plain)[0]).flatten()
        confident.append(float(is_confident.double().mean()))
        rows = is_confident.nonzero()[:, 0]
        rows = rows[torch.randperm(len(rows), generator=generator)[:PIXELS]]
        logs = found.inverse_depth.log().flatten()
        slopes += [torch.autograd.grad(logs[row], leaf, retain_graph=True)[0] for row in rows]
        _, backward = timed(partial(torch.autograd.grad, logs.sum(), leaf))
        costs.append((recorded + backward) / forward)
        for step in STEPS:
            x = math.log1p(step)
            ahead, behind = (depth(zero + each).inverse_depth.log().flatten() for each in (x, -x))
            differences[step].append(((ahead - behind) / (2 * x))[rows])
    gradient = torch.stack(slopes)
    row = [folder.name, f"{100 * statistics.mean(confident):.0f} %", f"{float(gradient.median()):.3f}"]
    row.append(share(gradient, -1.0))
    for step in STEPS:
        difference = torch.cat(differences[step])
        row += [share(gradient, difference), share(difference, -1.0)]
    return [*row, f"{statistics.median(costs):.2f}"]


def main() -> None:
    parser = parser_of(__doc__, Path(__file__).parent / "depth.md")
    parser.add_argument("results", type=Path, nargs="+", help="results folders")
    options = parser.parse_args()
    torch.set_num_threads(1)
    titles = "recording | confident | gradient, median | near the slope of -1"
    for step in STEPS:
        titles += f" | near differences of {100 * step:.0f} % | these near -1"
    rows = [measure(folder) for folder in options.results]
    text = (
        "Slope of log(1 / z) over the logarithm of all baselines, which is -1, by the gradient of `estimate_depth` "
        f"and by central differences: share of {VIEWS} x {PIXELS} confident pixels (`kept`) where two agree within "
        f"{100 * NEAR:.0f} %. Time with the gradient, forward and backward, over that of depth alone.\n\n"
        "    python -m experiments.gradients.depth results/room results/redkitchen\n\n"
        + table(titles + " | time", rows)
    )
    publish_page("Gradient of depth", text, options)


if __name__ == "__main__":
    main()
