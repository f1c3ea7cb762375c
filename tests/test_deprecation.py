"""Names and arguments of 0.1.0 still work, and their warning names what replaces them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import torchslam
from tests.sweep.calls import CAMERA, bundle, calls, graph, views
from torchslam import evaluation, geometry, learning, optim
from torchslam.optim import BUNDLE_OPTIONS, LEAST_SQUARES_OPTIONS, POSE_GRAPH_OPTIONS, POSE_OPTIONS

V = views()
EYE = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
SEEN, FROM = (V["points_w"], V["pixels_2"]), V["T_cw"]
LINE = {name: value for name, value in calls()["solve_least_squares"].arguments.items() if name != "residual"}
BOTH = {"camera_1": CAMERA, "camera_2": CAMERA}


def line(c: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return c[:, :1] * x + c[:, 1:] - y


Case = tuple[Callable[[], Any], Callable[[], Any], str]
CASES: dict[str, Case] = {
    "refine_pose": (
        lambda: optim.refine_pose(FROM, *SEEN, CAMERA, None, V["mask"], "huber", 2.0, iterations=3).T_cw,
        lambda: (
            optim.solve_pose(
                *SEEN,
                T_cw=FROM,
                camera=CAMERA,
                mask=V["mask"],
                options=POSE_OPTIONS.replace(kernel="huber", scale=2.0, iterations=3),
            ).T_cw
        ),
        r"call solve_pose\(points_w, pixels, \*, T_cw, camera, weights, mask, prior, options\); options is a "
        "SolverOptions",
    ),
    "bundle_adjust": (
        lambda: torchslam.bundle_adjust(bundle(), "cauchy", 2.0, True, tolerance=1e-6).T_cw,
        lambda: (
            optim.solve_bundle(
                bundle(),
                free_camera=True,
                options=BUNDLE_OPTIONS.replace(kernel="cauchy", scale=2.0, tolerance=1e-6),
            ).T_cw
        ),
        r"call solve_bundle\(problem, \*, free_camera, options",
    ),
    "pose_graph_optimize": (
        lambda: optim.pose_graph_optimize(graph(), "none").S_cw,
        lambda: optim.solve_pose_graph(graph(), options=POSE_GRAPH_OPTIONS.replace(kernel="none")).S_cw,
        r"call solve_pose_graph\(graph, \*, options\)",
    ),
    "minimize": (
        lambda: torchslam.minimize(line, **LINE, kernel="cauchy").unknowns[0],
        lambda: optim.solve_least_squares(
            line, **LINE, options=LEAST_SQUARES_OPTIONS.replace(kernel="cauchy")
        ).unknowns[0],
        r"call solve_least_squares\(residual, start, ",
    ),
    "triangulate": (
        lambda: geometry.triangulate(EYE, FROM, V["pixels_1"], V["pixels_2"], CAMERA, CAMERA).points_w,
        lambda: geometry.triangulate(V["pixels_1"], V["pixels_2"], T_1w=EYE, T_2w=FROM, **BOTH).points_w,
        r"call triangulate\(pixels_1, pixels_2, \*, T_1w, T_2w, camera_1, camera_2, mask, normalized\)$",
    ),
    "estimate_absolute_pose": (
        lambda: geometry.estimate_absolute_pose(*SEEN, CAMERA, 3.0).T_cw,
        lambda: geometry.estimate_absolute_pose(*SEEN, camera=CAMERA, threshold=3.0).T_cw,
        r"call estimate_absolute_pose\(points_w, pixels, \*, camera, threshold,",
    ),
    "ate": (
        lambda: evaluation.ate(
            EYE.expand(5, 2, 4, 4).transpose(0, 1), FROM.expand(5, 2, 4, 4).transpose(0, 1)
        ),
        lambda: evaluation.ate(
            T_cw=EYE.expand(5, 2, 4, 4).transpose(0, 1),
            T_cw_groundtruth=FROM.expand(5, 2, 4, 4).transpose(0, 1),
        ),
        r"call ate\(\*, T_cw, T_cw_groundtruth, mask, with_scale\)",
    ),
    "pose_errors": (
        lambda: learning.pose_errors(EYE, FROM),
        lambda: learning.pose_errors(T_cw=EYE, T_cw_groundtruth=FROM),
        r"call pose_errors\(\*, T_cw, T_cw_groundtruth\)",
    ),
}


@pytest.mark.parametrize(("old", "new", "message"), CASES.values(), ids=CASES)
def test_a_former_call_gives_the_same_and_names_the_present_one(
    old: Callable[[], Any], new: Callable[[], Any], message: str
) -> None:
    with pytest.warns(DeprecationWarning, match=message):
        found = old()
    torch.testing.assert_close(found, new(), rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("call", ["of(turned, 'turn')(1)", "accepted(turned)(1)"])
def test_the_warning_is_at_the_place_of_the_call(call: str) -> None:
    """Without the checks of shapes, whose frames would be in between; Python shows it there by default."""
    code = f"""from torchslam.utils.deprecation import OldCall
def turned(*, angle): return angle
assert OldCall("angle").{call} == 1
"""
    ended = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stderr.startswith("<string>:3: DeprecationWarning: this call of turn")


def test_former_names_are_not_shown() -> None:
    for package, names in ((torchslam, torchslam.__all__), (optim, optim.__all__)):
        assert not {"refine_pose", "bundle_adjust", "minimize", "pose_graph_optimize"} & {*names}, package


@pytest.mark.usefixtures("without_shape_checks")
def test_an_argument_that_no_version_has_is_an_error_without_a_warning() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'pace'"):
        geometry.triangulate(V["pixels_1"], V["pixels_2"], T_1w=EYE, T_2w=FROM, **BOTH, pace=3)
    with pytest.raises(TypeError, match=r"refine_pose\(\) got T_cw"):
        optim.refine_pose(FROM, T_cw=FROM)
    with pytest.raises(TypeError, match=r"solve_graph\(\) got too many arguments, of \(graph kernel "):
        torchslam.solve_graph(*range(20))
