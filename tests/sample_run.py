"""A small map, path and list of frames, as a run would leave them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.geometry import Camera, SensorModel, rigid, se3_inverse, so3_exp
from torchslam.map.atlas import Submap, TrackingState
from torchslam.map.map import Map
from torchslam.system.run import Run
from torchslam.types import Explanation, FrameFeatures, PoseEstimate, State, StepResult, Trajectory

KEYPOINTS = 40
FRAMES = 30
EVERY = 5  # frames from keyframe to keyframe


@pytest.fixture
def camera() -> Camera:
    return Camera.pinhole(100.0, 100.0, 79.5, 59.5, size=(160, 120))


@pytest.fixture
def trajectory() -> Trajectory:
    """An arc around the origin, cameras upright in a frame whose y points down, looking ahead."""
    angles = torch.linspace(0.0, 2.0, FRAMES, dtype=torch.float64)
    centers_w = torch.stack([2 * angles.cos(), 0.1 * angles, 2 * angles.sin()], dim=-1)
    R_wc = so3_exp(torch.stack([torch.zeros_like(angles), -angles, torch.zeros_like(angles)], dim=-1))
    return Trajectory(100.0 + torch.arange(FRAMES, dtype=torch.float64) / 30, rigid(R_wc, centers_w))


@pytest.fixture
def slam_map(trajectory: Trajectory, generator: torch.Generator) -> Map:
    """Keyframes with twenty points of their own and ten of the one before; one point is invalid."""
    made = Map()
    for index in range(0, FRAMES, EVERY):
        keyframe = made.add_keyframe(_view(index, trajectory, generator), se3_inverse(trajectory.T_wc[index]))
        offsets = torch.randn(20, 3, generator=generator, dtype=torch.float64)
        descriptors = torch.randint(0, 256, (20, 32), generator=generator, dtype=torch.uint8)
        covariances_w = 0.01 * torch.eye(3, dtype=torch.float64).repeat(20, 1, 1)
        ids = made.add_points(3 * offsets, descriptors, keyframe, covariances_w)
        made.add_observations(keyframe, torch.arange(20), ids)
        if keyframe:
            made.add_observations(keyframe, torch.arange(20, 30), ids[:10] - 20)
    made.update_appearance(torch.arange(made.num_keyframes))
    made.remove_points(torch.tensor([3]))
    return made


@pytest.fixture
def submap(slam_map: Map, trajectory: Trajectory, results: list[StepResult]) -> Submap:
    """The map and the frames that are tracked, on the trajectory."""
    made = Submap(0, TrackingState.empty(trajectory.T_wc), slam_map)
    nothing = torch.zeros(0, dtype=torch.int64)
    for result in results:
        if result.T_cw is not None:
            view = replace(slam_map.frame_features(0), index=result.index, timestamp=result.timestamp)
            T_cw = se3_inverse(trajectory.T_wc[result.index])
            seen = PoseEstimate(T_cw, nothing, nothing, 0, torch.eye(6, dtype=torch.float64), 1.0)
            made.posed_frames.add(view, seen, T_cw @ se3_inverse(slam_map.T_cw[0]), 0)
    return made


@pytest.fixture
def run(submap: Submap, camera: Camera, results: list[StepResult]) -> Run:
    """A run with one submap."""
    return Run(
        submaps=(submap,),
        sensor=SensorModel(camera),
        config=Config(),
        results=results,
        skipped=["image 31 is not an image"],
        interrupted=False,
        failure="",
    )


@pytest.fixture
def results() -> list[StepResult]:
    """Initializing, tracking with keyframes, lost for a while, tracking again."""
    states = [State.INITIALIZING] * 3 + [State.TRACKING] * 15 + [State.LOST] * 4 + [State.TRACKING] * 8
    return [_result(index, state) for index, state in enumerate(states)]


def _view(index: int, trajectory: Trajectory, generator: torch.Generator) -> FrameFeatures:
    size = torch.tensor([160.0, 120.0], dtype=torch.float64)
    return FrameFeatures(
        index=index,
        timestamp=float(trajectory.timestamps[index]),
        keypoints=torch.rand(KEYPOINTS, 2, generator=generator, dtype=torch.float64) * size,
        scales=torch.ones(KEYPOINTS, dtype=torch.float64),
        angles=torch.zeros(KEYPOINTS, dtype=torch.float64),
        descriptors=torch.randint(0, 256, (KEYPOINTS, 32), generator=generator, dtype=torch.uint8),
        mask=torch.arange(KEYPOINTS) < KEYPOINTS - 2,
    )


def _result(index: int, state: State) -> StepResult:
    is_tracking = state is State.TRACKING
    is_keyframe = is_tracking and index % EVERY == 0
    stage_ms = {"features": 20.0 + math.sin(index), "tracking": 5.0} | (
        {"mapping": 12.0} if is_keyframe else {}
    )
    T_cw: Tensor | None = torch.eye(4, dtype=torch.float64) if is_tracking else None
    return StepResult(
        index=index,
        timestamp=100.0 + index / 30,
        state=state,
        T_cw=T_cw,
        submap=0 if is_tracking else None,
        is_keyframe=is_keyframe,
        matches=100 + index if is_tracking else 8,
        inliers=90 + index if is_tracking else 0,
        reasons=() if is_tracking else Explanation.parsed('few matches: 8, "20" are needed'),
        stage_ms=stage_ms | {"total": sum(stage_ms.values())},
    )
