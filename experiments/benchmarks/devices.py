"""Batched operations on another device, compared with the CPU of the same machine.

    python -m experiments.benchmarks.devices [--device cuda] [--output FILE]

Elapsed time, since a GPU's is not CPU time, of one torch thread on the CPU. Prints a table and writes it to FILE.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from experiments.benchmarks.bundle import WINDOWS, batch_of, loss_of, ring, window
from experiments.common import parser_of, publish_page, table
from torchslam import ORB, SIFT, match, open_sequence, solve_bundle, solve_pose
from torchslam.dense import estimate_depth
from torchslam.geometry import Camera, estimate_absolute_pose, estimate_relative_pose, se3_exp, transform
from torchslam.optim import BUNDLE_OPTIONS, POSE_OPTIONS, BundleProblem

HERE = Path(__file__).parent
REPEATS = 3
IMAGES, PROBLEMS, POINTS, OUTLIERS = 16, 1024, 200, 0.4


class Case(NamedTuple):
    """What is timed; returns values that all devices agree on."""

    name: str
    task: Callable[[torch.device], Tensor]


def poses(count: int, generator: torch.Generator) -> Tensor:
    return se3_exp(0.1 * torch.randn(count, 6, generator=generator, dtype=torch.float64))


def wrong(pixels: Tensor, generator: torch.Generator) -> Tensor:
    """Noise of half a pixel, and a share of outliers."""
    noisy = pixels + 0.5 * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    count = int(OUTLIERS * pixels.shape[1])
    noisy[:, :count] = 480 * torch.rand(len(pixels), count, 2, generator=generator, dtype=torch.float64)
    return noisy


def cases() -> Iterator[Case]:
    generator = torch.Generator().manual_seed(0)
    room = open_sequence("synthetic:room")
    images = torch.cat([room.image(2 * index) for index in range(IMAGES)])
    camera = Camera.pinhole(525.0, 525.0, 319.5, 239.5, size=(640, 480))

    def kept(extractor: torch.nn.Module) -> Callable[[torch.device], Tensor]:
        return lambda device: extractor.to(device)(images.to(device)).keypoints

    yield Case(f"ORB, {IMAGES} images of 640x480", kept(ORB(1000)))
    yield Case("SIFT, the same images", kept(SIFT(1000)))
    features = ORB(1000)(images)
    first, second = features[:-1], features[1:]
    yield Case(
        f"match, {IMAGES - 1} pairs of 1000 ORB keypoints",
        lambda device: match(first.to(device), second.to(device)).indices_2.sum(),
    )
    points_w = torch.randn(PROBLEMS, POINTS, 3, generator=generator, dtype=torch.float64)
    points_w = points_w + torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64)
    T_cw = poses(PROBLEMS, generator)
    seen = camera.project(transform(T_cw, points_w))[0]
    pixels = wrong(seen, generator)

    def refined(device: torch.device) -> Tensor:
        points, moved = points_w.to(device).requires_grad_(), pixels.to(device)
        start = torch.eye(4, dtype=torch.float64, device=device).expand(PROBLEMS, 4, 4)
        options = POSE_OPTIONS.replace(kernel="huber", scale=1.0)
        found = solve_pose(points, moved, T_cw=start, camera=camera.to(device), options=options)
        found.T_cw.sum().backward()
        return found.T_cw

    yield Case(f"solve_pose with gradient, {PROBLEMS} problems of {POINTS} points", refined)
    yield Case(
        f"estimate_absolute_pose, {PROBLEMS // 8} problems, {OUTLIERS:.0%} outliers",
        lambda device: (
            estimate_absolute_pose(
                points_w[: PROBLEMS // 8].to(device),
                pixels[: PROBLEMS // 8].to(device),
                camera=camera.to(device),
                threshold=2.0,
            ).T_cw
        ),
    )
    still = wrong(camera.project(points_w)[0], generator)
    yield Case(
        f"estimate_relative_pose, {PROBLEMS // 8} problems, {OUTLIERS:.0%} outliers",
        lambda device: (
            estimate_relative_pose(
                still[: PROBLEMS // 8].to(device),
                pixels[: PROBLEMS // 8].to(device),
                camera_1=camera.to(device),
                camera_2=camera.to(device),
                threshold=1.0,
            ).T_21
        ),
    )

    def bundle(problem: BundleProblem, scale: float) -> Callable[[torch.device], Tensor]:
        def solved(device: torch.device) -> Tensor:
            there = {
                name: value.to(device)
                for name in ("T_cw", "points_w", "frame_index", "point_index", "mask", "camera")
                if (value := getattr(problem, name)) is not None
            }
            observed = problem.pixels.to(device).requires_grad_()
            options = BUNDLE_OPTIONS.replace(scale=scale)
            solution = solve_bundle(replace(problem, pixels=observed, **there), options=options)
            loss_of(solution).backward()
            return solution.T_cw

        return solved

    yield Case(
        f"solve_bundle with gradient, {WINDOWS} windows",
        bundle(batch_of([window(s) for s in range(WINDOWS)]), 2.45),
    )
    yield Case("solve_bundle with gradient, 100 cameras, 43,000 observations", bundle(ring(), 2.45))
    depth_camera = room.camera
    reference, sources = images[8:9, 0], images[[4, 6, 10, 12], 0][None]
    assert room.groundtruth is not None
    T_wc = room.groundtruth.T_wc[::2][:IMAGES]
    T_sr = (T_wc[[4, 6, 10, 12]].inverse() @ T_wc[8])[None].float()
    near, far = torch.tensor([0.5]), torch.tensor([10.0])
    yield Case(
        "estimate_depth, 1 image of 640x480, 4 others",
        lambda device: (
            estimate_depth(
                reference.to(device),
                sources.to(device),
                depth_camera.to(device),
                T_sr.to(device),
                near.to(device),
                far.to(device),
            ).inverse_depth
        ),
    )


def elapsed_ms(task: Callable[[torch.device], Tensor], device: torch.device) -> tuple[float, Tensor]:
    """Median elapsed milliseconds, without the first call; and the result on the CPU."""
    found = task(device)
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        found = task(device).detach().cpu()  # waits for the device
        times.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(times), found.detach().cpu()


def main() -> None:
    parser = parser_of(__doc__, HERE / "devices.md")
    parser.add_argument("--device", type=torch.device, default=torch.device("cuda"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name, task in cases():
        here, expected = elapsed_ms(task, torch.device("cpu"))
        there, found = elapsed_ms(task, arguments.device)
        same = (found - expected).abs().flatten(1 if found.ndim > 1 else 0)
        close = (same <= 1e-4 * (1 + expected.abs().flatten(1 if found.ndim > 1 else 0))).float().mean()
        rows.append(
            [name, f"{here:.0f}", f"{there:.0f}", f"{here / there:.1f}", f"{100 * float(close):.1f} %"]
        )
        print(rows[-1], flush=True)
    what = (
        torch.cuda.get_device_name(arguments.device)
        if arguments.device.type == "cuda"
        else str(arguments.device)
    )
    text = f"Elapsed milliseconds, medians of {REPEATS}, one torch thread on the CPU. Device: {what}.\n\n"
    text += "    python -m experiments.benchmarks.devices\n\n"
    text += table("operation | CPU, ms | device, ms | times faster | values within 1e-4", rows)
    publish_page("Operations on a GPU", text, arguments)


if __name__ == "__main__":
    main()
