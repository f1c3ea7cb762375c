"""What `torch.compile` saves: projection of points by many poses, and a pose solver.

    python -m experiments.gradients.compiled [--output FILE]

Needs a compiler of C++. Medians of CPU time of one thread, float64. Prints a table and writes it to FILE
and into docs/gradients.md, without --no-page.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import milliseconds, parser_of, publish_page, table, timed, write_between
from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim import solve_pose

HERE = Path(__file__).parent
GRADIENTS = HERE.parents[1] / "docs" / "gradients.md"
CAMERA = Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480))
POINTS, REPEATS = 1000, 15


def projected(tangent: Tensor, points_w: Tensor) -> Tensor:
    return CAMERA.project(transform(se3_exp(tangent), points_w))[0]


def posed(pixels: Tensor, points_w: Tensor) -> Tensor:
    start = torch.eye(4, dtype=torch.float64)[None]
    return solve_pose(points_w, pixels, T_cw=start, camera=CAMERA).T_cw


def row(what: str, function: Callable[..., Tensor], inputs: tuple[Tensor, ...], backward: bool) -> list[str]:
    """Milliseconds without and with the compiler, and seconds of the first call with it."""
    given = tuple(each.clone().requires_grad_(backward) for each in inputs)

    def call(function: Callable[..., Tensor]) -> None:
        found = function(*given)
        if backward:
            torch.autograd.grad(found.sum(), given)

    compiled = torch.compile(function, fullgraph=function is projected)
    _, first = timed(partial(call, compiled))
    plain, fast = milliseconds(partial(call, function), partial(call, compiled), repeats=REPEATS)
    return [what, f"{plain:.2f}", f"{fast:.2f}", f"{first / 1e3:.1f}"]


def main() -> None:
    parser = parser_of(__doc__, HERE / "compiled.md")
    parser.add_argument("--no-page", action="store_true", help="leave docs/gradients.md as it is")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    rows = []
    for poses in (1, 64):
        tangent = 0.1 * torch.randn(poses, 6, generator=generator, dtype=torch.float64)
        points_w = torch.randn(poses, POINTS, 3, generator=generator, dtype=torch.float64)
        points_w = points_w + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
        for backward in (False, True):
            what = f"project {poses} x {POINTS} points{', forward and backward' if backward else ''}"
            rows.append(row(what, projected, (tangent, points_w), backward))
    points_w = points_w[:1, :60]
    pixels = projected(tangent[:1], points_w) + torch.randn(
        1, 60, 2, generator=generator, dtype=torch.float64
    )
    rows.append(row("`solve_pose`, 60 points", posed, (pixels, points_w), False))
    text = (
        "CPU milliseconds, medians, one thread, float64.\n\n    python -m experiments.gradients.compiled\n\n"
    )
    found = table("what | plain | compiled | first call, s", rows)
    publish_page("What torch.compile saves", text + found, arguments)
    if not arguments.no_page:
        write_between(GRADIENTS, found)


if __name__ == "__main__":
    main()
