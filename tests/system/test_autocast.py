"""Autocast around the package changes no bit of any public differentiable function, nor of its gradient."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchslam
from tests.geometry.geometry_scenes import points_and_pixels, two_views
from tests.optim.conftest import camera_of
from tests.optim.test_pose_graph import make_scene
from tests.optim.test_run_graph import simulated
from torchslam import Features, evaluation, geometry
from torchslam import optim as solvers
from torchslam.geometry import Camera, rigid, se3_exp, sim3_exp, so3_exp
from torchslam.optim import (
    LEAST_SQUARES_OPTIONS,
    BundleProblem,
    PosePrior,
    displacement_error,
    log_distance_error,
    relative_pose_error,
    solve_bundle,
    solve_least_squares,
    solve_pose,
    solve_pose_graph,
    solve_rotations,
)
from torchslam.optim.run_graph import solve_graph

Case = tuple[Callable[..., Any], tuple[Tensor, ...]]

# They read files, or compare whole trajectories as float64 numbers without gradient; `clip_loss` is made of `ate`, and
# the evidence of a minimum is detached.
OTHERS = {"load_config", "open_sequence", "evaluate", "clip_loss", "camera_evidence", "pose_covariance"}
CAMERA_METHODS = (
    "normalize",
    "pixel_scale",
    "project",
    "project_with_jacobians",
    "project_with_point_jacobians",
    "unproject",
)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(*shape: int, seed: int = 0) -> Tensor:
    return torch.nn.functional.normalize(normal(*shape, seed=seed), dim=-1)


def spd(size: int) -> Tensor:
    A = normal(2, size, size)
    return A @ A.mT + torch.eye(size, dtype=torch.float64)


def features(descriptors: Tensor, keypoints: Tensor) -> Features:
    ones = torch.ones_like(keypoints[..., 0])
    return Features(keypoints, ones, ones, 0 * ones, descriptors, ones > 0)


def lie_cases() -> dict[str, Case]:
    xi, zeta, omega = 0.3 * normal(2, 6), 0.3 * normal(2, 7), 0.5 * normal(2, 3)
    T, S, R = se3_exp(xi), sim3_exp(zeta), so3_exp(omega)
    one = {"skew": omega, "vee": normal(2, 3, 3), "so3_exp": omega, "so3_left_jacobian": omega}
    one |= {"quaternion_from_matrix": R, "matrix_from_quaternion": normal(2, 4), "so3_log": R}
    one |= {"se3_exp": xi, "se3_log": T, "se3_inverse": T, "se3_adjoint": T, "sim3_exp": zeta}
    one |= dict.fromkeys(("sim3_scale", "sim3_log", "sim3_inverse", "sim3_adjoint"), S)
    one |= {"sim3_left_jacobian": zeta, "sim3_left_jacobian_inverse": zeta}
    cases: dict[str, Case] = {name: (getattr(geometry, name), (x,)) for name, x in one.items()}
    return cases | {
        "rigid": (geometry.rigid, (R, omega)),
        "transform": (geometry.transform, (T, normal(2, 5, 3))),
        "se3_interpolate": (lambda a, b: geometry.se3_interpolate(a, b, 0.3), (T, T.flip(0))),
    }


def estimator_cases() -> dict[str, Case]:
    points_w, pixels, T_cw = points_and_pixels(0, count=60)
    views, size = two_views(0, count=60), (640, 480)
    params = torch.tensor([525.0, 525.0, 319.5, 239.5], dtype=torch.float64)
    scale = rigid(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    points_c, E = (
        geometry.transform(T_cw, points_w),
        geometry.essential_from_pose(views.T_21[:, :3, :3], views.T_21[:, :3, 3]),
    )
    x = (views.pixels_1 - params[2:]) / params[:2], (views.pixels_2 - params[2:]) / params[:2]

    def with_camera(function: Callable[..., Any], *names: str) -> Callable[..., Any]:
        """Without names the camera comes last."""

        def of(*tensors: Tensor) -> Any:
            camera = Camera("pinhole", tensors[-1], size)
            if not names:
                return function(*tensors[:-1], camera)
            return function(*tensors[:-1], **dict.fromkeys(names, camera))

        return of

    both = "camera_1", "camera_2"

    def by_name(error: Callable[..., Any]) -> Callable[..., Any]:
        return lambda T_cw, truth: error(T_cw=T_cw, T_cw_groundtruth=truth)

    identity = scale[None]
    pair = (identity, views.T_21, views.pixels_1, views.pixels_2)
    many = torch.stack((views.pixels_1, views.pixels_2), dim=2), torch.cat((identity, views.T_21))[None]
    sigmas, J = torch.ones(1, 60, dtype=torch.float64), normal(2, 2, 6)
    return {
        "estimate_absolute_pose": (
            with_camera(geometry.estimate_absolute_pose, "camera"), (points_w, pixels, params)
        ),
        "estimate_relative_pose": (
            with_camera(geometry.estimate_relative_pose, *both), (views.pixels_1, views.pixels_2, params)
        ),
        "estimate_similarity": (
            with_camera(geometry.estimate_similarity, *both),
            (views.points_1, geometry.transform(views.T_21, views.points_1), *pair[2:], params),
        ),
        "start_pose": (
            with_camera(
                lambda points_w, pixels, camera: geometry.start_pose(
                    points_w[0], geometry.UndistortedKeypoints.of(pixels[0], camera), size, 2.0
                )
            ),
            (points_w, pixels, params),
        ),
        "triangulate": (
            with_camera(
                lambda T_1w, T_2w, pixels_1, pixels_2, camera: geometry.triangulate(
                    pixels_1, pixels_2, T_1w=T_1w, T_2w=T_2w, camera_1=camera, camera_2=camera
                )
            ),
            (*pair, params),
        ),
        "triangulate_many": (
            with_camera(lambda pixels, T, camera: geometry.triangulate_many(pixels, T_cw=T, camera=camera)),
            (*many, params),
        ),
        "triangulation_covariance": (
            with_camera(geometry.triangulation_covariance, *both),
            (identity, views.T_21, views.points_1, sigmas, sigmas, params),
        ),
        "correct_matches": (geometry.correct_matches, (E, *x)),
        "essential_from_pose": (geometry.essential_from_pose, (views.T_21[:, :3, :3], views.T_21[:, :3, 3])),
        "decompose_essential": (geometry.decompose_essential, (E,)),
        "sampson_errors": (geometry.sampson_errors, (E, *x)),
        "epipolar_offsets": (with_camera(geometry.epipolar_offsets, *both), (*pair[1:], params)),
        "five_point": (geometry.five_point, tuple(part[:, 25:30] for part in x)),
        "p3p": (geometry.p3p, (unit(4, 3, 3), normal(4, 3, 3, seed=1))),
        "homography_from_matches": (geometry.homography_from_matches, x),
        "rotation_from_matches": (geometry.rotation_from_matches, (unit(4, 2, 3), unit(4, 2, 3, seed=1))),
        "transfer_errors": (geometry.transfer_errors, (normal(1, 3, 3), *x)),
        "decompose_homography": (geometry.decompose_homography, (normal(2, 3, 3),)),
        "squared_reprojection_errors": (
            with_camera(geometry.squared_reprojection_errors), (points_c, pixels, params)
        ),
        "passes_gate": (geometry.passes_gate, (normal(9).square(), normal(9, seed=1))),
        "innovation_covariances": (geometry.innovation_covariances, (J, spd(6), torch.ones_like(J[:, 0, 0]))),
        "mahalanobis_squared": (geometry.mahalanobis_squared, (normal(2, 3), spd(3))),
        "ecef_from_geodetic": (geometry.ecef_from_geodetic, (30 * normal(4, 3),)),
        "geodetic_from_ecef": (geometry.geodetic_from_ecef, (4e6 + 1e5 * normal(4, 3),)),
        "ecef_from_local": (geometry.ecef_from_local, (30 * normal(4, 3),)),
        "enu_from_geodetic": (geometry.enu_from_geodetic, (30 * normal(4, 3), 30 * normal(3, seed=1))),
        "geodetic_from_enu": (geometry.geodetic_from_enu, (1e3 * normal(4, 3), 30 * normal(3, seed=1))),
        "umeyama": (geometry.umeyama, (normal(9, 3), normal(9, 3, seed=1))),
        "ate": (by_name(evaluation.ate), (se3_exp(normal(9, 6)), se3_exp(normal(9, 6, seed=1)))),
        "rpe": (by_name(evaluation.rpe), (se3_exp(normal(9, 6)), se3_exp(normal(9, 6, seed=1)))),
        "match": (
            lambda a, b: torchslam.match(features(a, a[..., :2]), features(b, b[..., :2]), temperature=0.1),
            (unit(1, 30, 64), unit(1, 30, 64, seed=1)),
        ),
        "match_by_projection": (
            lambda a, at: torchslam.match_by_projection(a, at, 9.0, features(a.flip(1), at.flip(1))),
            (unit(1, 30, 64), 50 * normal(1, 30, 2)),
        ),
    }  # fmt: skip


def inertial_cases() -> dict[str, Case]:
    gyroscope, accelerometer = normal(40, 3), 5 * normal(40, 3, seed=1)
    times, start = torch.arange(40, dtype=torch.float64) / 100, torch.tensor([0.02, 0.105]).double()
    bias, steps = (
        0.1 * normal(2, 6),
        geometry.inertial_steps(times, gyroscope, accelerometer, start, start + 0.2),
    )

    def integrate(durations: Tensor, gyroscope: Tensor, accelerometer: Tensor, bias: Tensor) -> Any:
        own = geometry.InertialSteps(durations, gyroscope, accelerometer)
        return geometry.preintegrate(own, bias, 1e-3, 2e-2)

    def composed(*increments: Tensor) -> Any:
        both = geometry.Increments(*increments)
        return geometry.compose_increments(both, both)

    def changed(bias: Tensor, *increments: Tensor) -> Any:
        return geometry.with_bias_change(geometry.Increments(*increments), bias)

    increments = tuple(integrate(*steps, bias))
    return {
        "inertial_steps": (geometry.inertial_steps, (times, gyroscope, accelerometer, start, start + 0.2)),
        "preintegrate": (integrate, (*steps, bias)),
        "compose_increments": (composed, increments),
        "with_bias_change": (changed, (bias, *increments)),
    }


def solver_cases() -> dict[str, Case]:
    points_w, pixels, T_cw = points_and_pixels(0, count=40, outliers=0.1)
    params = torch.tensor([525.0, 525.0, 319.5, 239.5], dtype=torch.float64)
    start = se3_exp(0.01 * normal(1, 6)) @ T_cw
    _, graph = simulated(frames=4, points=20)
    pose_graph = make_scene(nodes=5).graph

    def refine(start: Tensor, points: Tensor, pixels: Tensor, params: Tensor, information: Tensor) -> Any:
        camera, prior = Camera("pinhole", params, (640, 480)), PosePrior(start.detach(), information)
        return solve_pose(points, pixels, T_cw=start, camera=camera, prior=prior)

    def cast(graph: Any, like: Tensor) -> Any:
        tensors = {field.name: getattr(graph, field.name) for field in fields(graph)}
        floats = {
            n: x.to(like) for n, x in tensors.items() if isinstance(x, Tensor) and x.is_floating_point()
        }
        return replace(graph, **floats)

    def bundle(T_cw: Tensor, points: Tensor, pixels: Tensor, params: Tensor) -> Any:
        camera = replace(graph.camera, params=params)
        return solve_bundle(BundleProblem(T_cw, points, graph.frame_index, graph.point_index, pixels, camera))

    def solve(pixels: Tensor, params: Tensor) -> Any:
        camera = replace(graph.camera, params=params)
        return solve_graph(replace(cast(graph, pixels), pixels=pixels, camera=camera))

    def align(start: Tensor, points: Tensor, targets: Tensor) -> Any:
        def residual(T: Tensor, points: Tensor, targets: Tensor) -> Tensor:
            return geometry.transform(T, points) - targets

        return solve_least_squares(
            residual,
            start.detach(),
            (points, targets),
            "se3",
            options=LEAST_SQUARES_OPTIONS.replace(kernel="cauchy"),
        )

    return {
        "solve_least_squares": (align, (start, points_w, points_w + 0.1 * normal(*points_w.shape, seed=8))),
        "solve_pose": (refine, (start, points_w, pixels, params, spd(6)[:1])),
        "solve_bundle": (bundle, (graph.T_cw, graph.points_w, graph.pixels, graph.camera.params)),
        "relative_pose_error": (
            relative_pose_error, (se3_exp(0.3 * normal(2, 6)), start, se3_exp(0.3 * normal(2, 6, seed=3)))
        ),
        "log_distance_error": (
            log_distance_error, (se3_exp(0.3 * normal(2, 6)), se3_exp(normal(2, 6, seed=4)), 1 + normal(2).square())
        ),
        "displacement_error": (
            displacement_error, (se3_exp(0.3 * normal(2, 6)), se3_exp(normal(2, 6, seed=4)), normal(2, 2, 3))
        ),
        "solve_graph": (solve, (graph.pixels, graph.camera.params)),
        "solve_pose_graph": (
            lambda S: solve_pose_graph(replace(cast(pose_graph, S), S_ji=S)), (pose_graph.S_ji,)
        ),
        "solve_rotations": (
            lambda R: solve_rotations(torch.tensor(((0, 1), (1, 2), (0, 2))), R, 3), (so3_exp(0.1 * normal(3, 3)),)
        ),
    }  # fmt: skip


def camera_cases() -> dict[str, Case]:
    points, pixels = normal(6, 3) * 0.3 + torch.tensor([0.0, 0, 3]), 320 + 50 * normal(6, 2)
    cases: dict[str, Case] = {}
    for model in ("pinhole", "radial_tangential", "fisheye"):
        camera = camera_of(model)
        for name in CAMERA_METHODS:

            def method(x: Tensor, params: Tensor, camera: Camera = camera, name: str = name) -> Any:
                return getattr(replace(camera, params=params), name)(x)

            x = points if name.startswith("project") else pixels / (320 if name == "pixel_scale" else 1)
            cases[f"{model}.{name}"] = method, (x, camera.params)
    return cases


CASES = lie_cases() | estimator_cases() | inertial_cases() | solver_cases() | camera_cases()


def outputs(value: Any) -> list[Tensor]:
    """All tensors in what a function returned."""
    if isinstance(value, Tensor):
        return [value]
    if is_dataclass(value):
        value = [getattr(value, field.name) for field in fields(value) if not field.name.startswith("_")]
    return [tensor for part in value for tensor in outputs(part)] if isinstance(value, list | tuple) else []


def results(case: Case, autocast: bool) -> list[Tensor]:
    """The outputs of a function of float32 tensors, and the gradients of all that has one."""
    function, inputs = case
    leaves = [x.detach().float().requires_grad_() for x in inputs]
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        found = outputs(function(*leaves))
    attached = [x for x in found if x.requires_grad]
    total = (
        torch.stack([(x.nan_to_num(posinf=0.0) * 0.1).sin().sum() for x in attached]).sum()
        if attached
        else None
    )
    gradients = () if total is None else torch.autograd.grad(total, leaves, allow_unused=True)
    return found + [g for g in gradients if g is not None]


def test_every_public_function_is_covered() -> None:
    public = {
        name
        for module in (torchslam, geometry, solvers)
        for name in module.__all__
        if inspect.isfunction(getattr(module, name))
    }
    assert public - OTHERS <= set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_autocast_does_not_change_results(name: str) -> None:
    plain, cast = results(CASES[name], autocast=False), results(CASES[name], autocast=True)
    assert len(plain) == len(cast) > 0
    for expected, found in zip(plain, cast, strict=True):
        assert found.dtype == expected.dtype
        assert torch.equal(found.nan_to_num(), expected.nan_to_num())


@pytest.mark.parametrize(
    "name", ["solve_pose", "solve_bundle", "solve_graph", "solve_pose_graph", "solve_least_squares"]
)
def test_autocast_does_not_affect_the_backward_pass(name: str) -> None:
    function, inputs = CASES[name]
    gradients = []
    for enabled in (False, True):
        leaves = [x.detach().float().requires_grad_() for x in inputs]
        found = [x for x in outputs(function(*leaves)) if x.requires_grad]
        total = torch.stack([x.sin().sum() for x in found]).sum()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            gradients.append(torch.autograd.grad(total, leaves, allow_unused=True))
    for expected, found in zip(*gradients, strict=True):
        assert (expected is None) == (found is None)
        assert expected is None or torch.equal(expected, found)
