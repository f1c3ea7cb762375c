"""Simulated problems with known answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.optim import (
    BUNDLE_OPTIONS,
    GRAPH_OPTIONS,
    LEAST_SQUARES_OPTIONS,
    POSE_GRAPH_OPTIONS,
    POSE_OPTIONS,
    BundleProblem,
    BundleSolution,
    DepthPrior,
    Factors,
    LeastSquaresSolution,
    PoseGraph,
    PoseGraphSolution,
    PosePrior,
    RefinedPose,
    solve_bundle,
    solve_least_squares,
    solve_pose,
    solve_pose_graph,
)
from torchslam.optim.bundle import _dense
from torchslam.optim.observation_graph import ObservationGraph
from torchslam.optim.run_graph import GraphSolution, solve_graph

MODELS = ("pinhole", "radial_tangential", "fisheye")


def camera_of(model: str = "pinhole") -> Camera:
    if model == "pinhole":
        return Camera.pinhole(500.0, 510.0, 320.0, 240.0, size=(640, 480))
    if model == "radial_tangential":
        return Camera.radial_tangential(
            500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, size=(640, 480)
        )
    return Camera.fisheye(300.0, 310.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=(640, 480))


@pytest.fixture
def make_camera() -> Callable[[str], Camera]:
    return camera_of


class PoseScene(NamedTuple):
    """Truth, a start near it, points and their noisy pixels in `batch` views."""

    T_cw: Tensor
    start: Tensor
    points_w: Tensor
    pixels: Tensor
    camera: Camera

    def solved(
        self,
        *,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
        prior: PosePrior | None = None,
        points_w: Tensor | None = None,
        pixels: Tensor | None = None,
        start: Tensor | None = None,
        camera: Camera | None = None,
        **options: Any,
    ) -> RefinedPose:
        """The pose with some inputs and options changed."""
        return solve_pose(
            self.points_w if points_w is None else points_w,
            self.pixels if pixels is None else pixels,
            T_cw=self.start if start is None else start,
            camera=self.camera if camera is None else camera,
            weights=weights,
            mask=mask,
            prior=prior,
            options=POSE_OPTIONS.replace(**options),
        )


def draw(seed: int, *shape: int) -> Tensor:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def only(problem: BundleProblem, rows: Tensor) -> BundleProblem:
    """The problem with some of its observations."""
    names = ("frame_index", "point_index", "pixels") + ("weights",) * (problem.weights is not None)
    return replace(problem, **{name: getattr(problem, name)[rows] for name in names})


def adjusted(
    problem: BundleProblem, *, free_camera: bool | Tensor = False, check: bool = True, **options: Any
) -> BundleSolution:
    """`solve_bundle` with some options changed."""
    changed = BUNDLE_OPTIONS.replace(**options)
    return solve_bundle(problem, free_camera=free_camera, check=check, options=changed)


def optimized(graph: PoseGraph, **options: Any) -> PoseGraphSolution:
    """`solve_pose_graph` with some options changed."""
    return solve_pose_graph(graph, options=POSE_GRAPH_OPTIONS.replace(**options))


def solved_graph(
    graph: ObservationGraph,
    *,
    factors: Sequence[Factors] = (),
    depth_prior: DepthPrior | None = None,
    **options: Any,
) -> GraphSolution:
    """`solve_graph` with some options changed."""
    more = {"factors": factors, "depth_prior": depth_prior}
    return solve_graph(graph, **more, options=GRAPH_OPTIONS.replace(**options))


def minimized(residual: Any, start: Any, *given: Any, **options: Any) -> LeastSquaresSolution:
    """`solve_least_squares` with some options changed."""
    return solve_least_squares(residual, start, *given, options=LEAST_SQUARES_OPTIONS.replace(**options))


@pytest.fixture(autouse=True)
def _single_problems_are_sparse(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that these tests, most of small problems that suit grids, are of both: batches are dense."""
    monkeypatch.setattr(_dense, "_CELLS_PER_OBSERVATION_ALONE", 0)


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def pose_scene() -> Callable[..., PoseScene]:
    def make(
        batch: int = 2,
        count: int = 40,
        noise: float = 0.5,
        outliers: float = 0.0,
        model: str = "pinhole",
        seed: int = 0,
        perturbation: float = 0.02,
    ) -> PoseScene:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        camera = camera_of(model)
        T_cw = se3_exp(0.3 * normal(batch, 6))
        points_c = torch.stack(
            (normal(batch, count), 0.7 * normal(batch, count), 4 + normal(batch, count)), -1
        )
        points_c[..., 2].clamp_(min=2.0)
        points_w = transform(torch.linalg.inv(T_cw), points_c)
        pixels = camera.project(points_c)[0] + noise * normal(batch, count, 2)
        bad = int(outliers * count)
        pixels[:, :bad] += 40 * normal(batch, bad, 2)
        start = se3_exp(perturbation * normal(batch, 6)) @ T_cw
        return PoseScene(T_cw, start, points_w, pixels, camera)

    return make


class BundleScene(NamedTuple):
    """Truth, and a problem that starts near it."""

    T_cw: Tensor
    points_w: Tensor
    problem: BundleProblem


@pytest.fixture
def bundle_scene() -> Callable[..., BundleScene]:
    def make(
        frames: int = 5,
        points: int = 30,
        noise: float = 0.5,
        model: str = "pinhole",
        seed: int = 0,
        perturbation: float = 0.01,
        visible: float = 0.8,
        **options: object,
    ) -> BundleScene:
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        camera = camera_of(model)
        twists = 0.05 * normal(frames, 6)
        twists[:, 0] += torch.linspace(-1, 1, frames, dtype=torch.float64)
        T_cw = se3_exp(twists)
        points_w = torch.stack((1.2 * normal(points), normal(points), 5 + normal(points)), -1)
        points_w[:, 2].clamp_(min=3.0)
        seen = torch.rand(frames, points, generator=generator) < visible
        seen[:3] = True  # every point can be triangulated
        frame_index, point_index = seen.nonzero().unbind(-1)
        points_c = transform(T_cw[frame_index], points_w[point_index][:, None])[:, 0]
        pixels = camera.project(points_c)[0] + noise * normal(len(frame_index), 2)
        fixed = torch.zeros(frames, 1, dtype=torch.float64)
        fixed[2:] = perturbation
        problem = BundleProblem(
            se3_exp(fixed * normal(frames, 6)) @ T_cw,
            points_w + 3 * perturbation * normal(points, 3),
            frame_index,
            point_index,
            pixels,
            camera,
            **({"fixed_frames": (0, 1)} | options),
        )
        return BundleScene(T_cw, points_w, problem)

    return make
