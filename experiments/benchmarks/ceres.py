"""A bundle adjustment by pycolmap, that is Ceres, without a robust loss, on one thread."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchslam.optim import BundleProblem


class Solved(NamedTuple):
    """Poses, points and pycolmap's cameras by frame, number of iterations and processor seconds."""

    T_cw: Tensor
    points_w: Tensor
    cameras: list[Any]
    iterations: int
    seconds: float


def solve_by_ceres(
    problem: BundleProblem, cameras: Sequence[Any], fixed_frames: Sequence[int], options: Any
) -> Solved:
    """Solve a problem.

    Args:
        problem: its poses, points and observations.
        cameras: pycolmap's camera of each frame; one for all frames is held.
        fixed_frames: whose poses are held.
        options: pycolmap's; the number of threads and its summary are set here.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, start=1):
        camera.camera_id = number
        model.add_camera_with_trivial_rig(camera)
    rows: list[list[int]] = [[] for _ in problem.T_cw]
    for row, frame in enumerate(problem.frame_index.tolist()):
        rows[frame].append(row)
    place: dict[int, tuple[int, int]] = {}
    for frame, T_cw in enumerate(problem.T_cw):
        number = frame + 1
        image = pycolmap.Image(
            name=str(frame),
            keypoints=problem.pixels[rows[frame]].numpy(),
            camera_id=number if len(cameras) > 1 else 1,
            image_id=number,
        )
        place |= {row: (number, position) for position, row in enumerate(rows[frame])}
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T_cw[:3].numpy()))
    tracks = [pycolmap.Track() for _ in problem.points_w]
    for row, point in enumerate(problem.point_index.tolist()):
        tracks[point].add_element(*place[row])
    for point, track in zip(problem.points_w, tracks, strict=True):
        model.add_point3D(point.numpy(), track)
    config = pycolmap.BundleAdjustmentConfig()
    for frame in range(len(problem.T_cw)):
        config.add_image(frame + 1)
    for frame in fixed_frames:
        config.set_constant_rig_from_world_pose(frame + 1)
    if len(cameras) == 1:
        config.set_constant_cam_intrinsics(1)
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    began = time.process_time()
    solved: Any = pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    seconds = time.process_time() - began
    summary = solved.ceres_summary
    frames = range(1, len(problem.T_cw) + 1)
    T_cw = torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1)
    for number in frames:
        T_cw[number - 1, :3] = torch.from_numpy(model.images[number].cam_from_world().matrix())
    points = [model.points3D[point + 1].xyz.tolist() for point in range(len(problem.points_w))]
    return Solved(
        T_cw,
        torch.tensor(points, dtype=torch.float64),
        [model.cameras[model.images[number].camera_id] for number in frames],
        summary.num_successful_steps + summary.num_unsuccessful_steps,
        seconds,
    )
