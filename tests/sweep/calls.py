"""A valid call of every public function, small: what the sweep changes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchslam import evaluation, features, geometry, optim
from torchslam.features import SimulatedFeatures
from torchslam.geometry import Camera, se3_exp, se3_inverse, so3_exp, transform
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.types import Features, Trajectory

F64 = torch.float64
CAMERA = Camera.radial_tangential(500.0, 510.0, 319.5, 239.5, -0.2, 0.05, 1e-3, -5e-4, size=(640, 480))
B, N = 2, 40


class Call(NamedTuple):
    """A function, its arguments, and what it promises.

    Attributes:
        function: to call.
        arguments: by name.
        vmap: whether `torch.vmap` may map it over a further dimension of all its tensors of floats.
        gradient: whether results carry a gradient to arguments.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]
    vmap: bool = True
    gradient: bool = True


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


def rand(*shape: int) -> Tensor:
    return torch.rand(*shape, dtype=F64, generator=_generator())


def poses(*shape: int) -> Tensor:
    return se3_exp(0.2 * rand(*shape, 6))


@lru_cache(maxsize=1)
def views() -> dict[str, Tensor]:
    """Points (B, N, 3) in front of two cameras, and their pixels in both, with noise."""
    points_w = 2 * rand(B, N, 3) + torch.tensor([-1.0, -1.0, 3.0], dtype=F64)
    T_cw = se3_exp(torch.tensor([[-0.5, 0.1, 0.0, 0.02, 0.1, 0.03]], dtype=F64)).expand(B, 4, 4).contiguous()
    noise = 0.3 * torch.randn(2, B, N, 2, dtype=F64, generator=_generator())
    pixels_1 = CAMERA.project(points_w)[0] + noise[0]
    pixels_2 = CAMERA.project(transform(T_cw, points_w))[0] + noise[1]
    mask = torch.ones(B, N, dtype=torch.bool)
    mask[:, ::7] = False
    return {"points_w": points_w, "T_cw": T_cw, "pixels_1": pixels_1, "pixels_2": pixels_2, "mask": mask}


def binary_features() -> Features:
    ones = torch.ones(1, N, dtype=torch.float32)
    draws = torch.randint(0, 256, (1, N, 32), generator=_generator(), dtype=torch.uint8)
    return Features(
        400 * rand(1, N, 2).float(),
        ones,
        ones,
        0 * ones,
        draws,
        torch.arange(N, dtype=torch.int64)[None] < N - 3,
    )


def bundle() -> optim.BundleProblem:
    v = views()
    T_cw = torch.stack((torch.eye(4, dtype=F64), v["T_cw"][0], v["T_cw"][0] @ v["T_cw"][0]))
    points = v["points_w"][0]
    pixels = CAMERA.project(transform(T_cw, points))[0].flatten(0, 1)
    frames, rows = (
        index.flatten() for index in torch.meshgrid(torch.arange(3), torch.arange(N), indexing="ij")
    )
    return optim.BundleProblem(
        T_cw,
        points + 0.01,
        frames,
        rows,
        pixels + 0.2 * rand(len(pixels), 2),
        CAMERA,
        weights=torch.ones(len(pixels), dtype=F64),
        mask=torch.arange(len(pixels)) % 11 != 0,
    )


def graph() -> optim.PoseGraph:
    S_cw = poses(4)
    edges = torch.tensor([(0, 1), (1, 2), (2, 3), (3, 0)])
    S_ji = S_cw[edges[:, 1]] @ se3_inverse(S_cw[edges[:, 0]]) @ se3_exp(0.01 * rand(4, 6))
    return optim.PoseGraph(S_cw, edges, S_ji, torch.ones(4, dtype=F64), mask=torch.ones(4, dtype=torch.bool))


def trajectories() -> tuple[Trajectory, Trajectory]:
    times = torch.arange(20, dtype=F64) / 10
    T_wc = se3_exp(torch.cumsum(0.1 * rand(20, 6), 0))
    return Trajectory(times, T_wc @ se3_exp(0.01 * rand(20, 6))), Trajectory(times, T_wc)


def calls() -> dict[str, Call]:
    """The calls by name of the function."""
    v = views()
    xi, R, T, T_2 = 0.3 * rand(B, 6), so3_exp(0.4 * rand(B, 3)), poses(B), v["T_cw"]
    xi_7, x_1, x_2 = 0.3 * rand(B, 7), CAMERA.normalize(v["pixels_1"]), CAMERA.normalize(v["pixels_2"])
    E = geometry.essential_from_pose(T_2[:, :3, :3], T_2[:, :3, 3])
    S, points_c = geometry.sim3_exp(xi_7), transform(T_2, v["points_w"])
    ones = torch.ones(B, N, dtype=F64)
    rays = torch.nn.functional.normalize(points_c[:, :3], dim=-1)
    both = {"camera_1": CAMERA, "camera_2": CAMERA}
    pair = {"pixels_1": v["pixels_1"], "pixels_2": v["pixels_2"], **both}
    J = CAMERA.project_with_point_jacobians(points_c)[2][:, 0]
    covariance = torch.eye(3, dtype=F64).expand(B, 3, 3).contiguous()
    estimate, truth = trajectories()
    R_cw = so3_exp(0.4 * rand(4, 3))
    edges = torch.tensor([(0, 1), (1, 2), (2, 3), (3, 0)])
    bits = binary_features()
    g, o = geometry, optim

    def line(c: Tensor, x: Tensor, y: Tensor) -> Tensor:
        return c[:, :1] * x + c[:, 1:] - y

    def of(function: Callable[..., Any], **arguments: Any) -> Call:
        return Call(function, arguments)

    def alone(function: Callable[..., Any], **arguments: Any) -> Call:
        return Call(function, arguments, vmap=False)

    def decision(function: Callable[..., Any], **arguments: Any) -> Call:
        return Call(function, arguments, vmap=False, gradient=False)

    steps = g.InertialSteps(0.01 + 0.002 * rand(B, 7), rand(B, 7, 3), 9.8 * rand(B, 7, 3))
    increments = g.preintegrate(steps, 0.1 * rand(B, 6), 1e-3, 2e-2)
    undistorted = g.UndistortedKeypoints.of(v["pixels_2"][0], CAMERA)
    return {
        "inertial_steps": alone(
            g.inertial_steps,
            timestamps=torch.arange(N, dtype=F64) / 100,
            gyroscope=rand(N, 3),
            accelerometer=rand(N, 3),
            start=torch.tensor([0.012, 0.05], dtype=F64),
            end=torch.tensor([0.2, 0.31], dtype=F64),
        ),
        "preintegrate": of(
            g.preintegrate,
            steps=steps,
            bias=0.1 * rand(B, 6),
            gyroscope_density=1e-3,
            accelerometer_density=2e-2,
        ),
        "compose_increments": of(g.compose_increments, first=increments, second=increments),
        "with_bias_change": of(g.with_bias_change, increments=increments, change=0.01 * rand(B, 6)),
        "skew": of(g.skew, v=xi[:, :3]),
        "vee": of(g.vee, W=g.skew(xi[:, :3])),
        "rigid": of(g.rigid, R=R, t=xi[:, :3]),
        "transform": of(g.transform, T=T, points=v["points_w"]),
        "so3_exp": of(g.so3_exp, omega=xi[:, :3]),
        "so3_log": of(g.so3_log, R=R),
        "so3_left_jacobian": of(g.so3_left_jacobian, omega=xi[:, :3]),
        "se3_exp": of(g.se3_exp, xi=xi),
        "se3_log": of(g.se3_log, T=T),
        "se3_inverse": of(g.se3_inverse, T=T),
        "se3_adjoint": of(g.se3_adjoint, T=T),
        "se3_interpolate": of(g.se3_interpolate, T_0=T, T_1=T_2, fraction=rand(B)),
        "sim3_exp": of(g.sim3_exp, xi=xi_7),
        "sim3_log": of(g.sim3_log, T=S),
        "sim3_inverse": of(g.sim3_inverse, T=S),
        "sim3_adjoint": of(g.sim3_adjoint, T=S),
        "sim3_scale": of(g.sim3_scale, T=S),
        "sim3_left_jacobian": of(g.sim3_left_jacobian, xi=xi_7),
        "sim3_left_jacobian_inverse": of(g.sim3_left_jacobian_inverse, xi=xi_7),
        "ecef_from_geodetic": of(g.ecef_from_geodetic, geodetic=40 * rand(B, 3)),
        "geodetic_from_ecef": of(g.geodetic_from_ecef, ecef=4e6 + 1e5 * rand(B, 3)),
        "ecef_from_local": of(g.ecef_from_local, origin=40 * rand(B, 3)),
        "enu_from_geodetic": of(g.enu_from_geodetic, geodetic=40 * rand(B, N, 3), origin=40 * rand(B, 3)),
        "geodetic_from_enu": of(g.geodetic_from_enu, positions_e=1e3 * rand(B, N, 3), origin=40 * rand(B, 3)),
        "matrix_from_quaternion": of(g.matrix_from_quaternion, q_xyzw=g.quaternion_from_matrix(R)),
        "quaternion_from_matrix": of(g.quaternion_from_matrix, R=R),
        "Camera.project": of(CAMERA.project, points_c=points_c),
        "Camera.project_with_jacobians": of(CAMERA.project_with_jacobians, points_c=points_c),
        "Camera.normalize": of(CAMERA.normalize, pixels=v["pixels_1"]),
        "Camera.unproject": of(CAMERA.unproject, pixels=v["pixels_1"]),
        "Camera.pixel_scale": of(CAMERA.pixel_scale, normalized=x_1),
        "Camera.in_image": decision(CAMERA.in_image, pixels=v["pixels_1"]),
        "essential_from_pose": of(g.essential_from_pose, R_21=R, t_21=xi[:, :3]),
        "decompose_essential": of(g.decompose_essential, E=E),
        "sampson_errors": of(g.sampson_errors, E=E, x_1=x_1, x_2=x_2, variance_1=ones, variance_2=ones),
        "epipolar_offsets": of(g.epipolar_offsets, T_21=T_2, **pair),
        "five_point": decision(g.five_point, x_1=x_1[:, :5], x_2=x_2[:, :5]),
        "p3p": decision(g.p3p, rays=rays, points=v["points_w"][:, :3]),
        "homography_from_matches": of(g.homography_from_matches, x_1=x_1[:, :4], x_2=x_2[:, :4]),
        "rotation_from_matches": of(g.rotation_from_matches, rays_1=rays[:, :2], rays_2=rays[:, 1:3]),
        "transfer_errors": of(g.transfer_errors, H=R, x_1=x_1, x_2=x_2),
        "decompose_homography": decision(
            g.decompose_homography, H=R + 0.1 * xi[:, :3, None] * xi[:, None, 3:]
        ),
        "correct_matches": of(g.correct_matches, E=E, x_1=x_1, x_2=x_2),
        "triangulate": of(
            g.triangulate, T_1w=torch.eye(4, dtype=F64).expand(B, 4, 4), T_2w=T_2, **pair, mask=v["mask"]
        ),
        "triangulate_many": of(
            g.triangulate_many,
            T_cw=torch.stack((torch.eye(4, dtype=F64).expand(B, 4, 4), T_2), 1),
            pixels=torch.stack((v["pixels_1"], v["pixels_2"]), 2),
            camera=CAMERA,
            mask=v["mask"][..., None].expand(B, N, 2).clone(),
        ),
        "triangulation_covariance": of(
            g.triangulation_covariance,
            T_1w=torch.eye(4, dtype=F64).expand(B, 4, 4),
            T_2w=T_2,
            points_w=v["points_w"],
            sigmas_1=ones,
            sigmas_2=ones,
            **both,
        ),
        "umeyama": of(g.umeyama, source=v["points_w"], target=points_c, weights=v["mask"]),
        "estimate_absolute_pose": alone(
            g.estimate_absolute_pose,
            points_w=v["points_w"],
            pixels=v["pixels_2"],
            camera=CAMERA,
            mask=v["mask"],
        ),
        "estimate_relative_pose": alone(g.estimate_relative_pose, **pair, mask=v["mask"], weights=ones),
        "estimate_similarity": decision(
            g.estimate_similarity,
            points_1=v["points_w"],
            points_2=points_c,
            **pair,
            sigmas_1=ones,
            sigmas_2=ones,
            mask=v["mask"],
        ),
        "start_pose": decision(
            g.start_pose, points_w=v["points_w"][0], undistorted=undistorted, size=(640, 480), threshold=2.0
        ),
        "innovation_covariances": of(
            g.innovation_covariances, J=J, covariances=covariance, sigmas=ones[:, 0]
        ),
        "mahalanobis_squared": of(g.mahalanobis_squared, errors=xi[:, :3], covariances=covariance),
        "passes_gate": decision(g.passes_gate, squared=ones),
        "squared_reprojection_errors": of(
            g.squared_reprojection_errors, points_c=points_c, pixels=v["pixels_2"], camera=CAMERA
        ),
        "solve_pose": of(
            o.solve_pose,
            T_cw=T_2 @ se3_exp(0.01 * rand(B, 6)),
            points_w=v["points_w"],
            pixels=v["pixels_2"],
            camera=CAMERA,
            weights=ones,
            mask=v["mask"],
            prior=o.PosePrior(T_2, torch.eye(6, dtype=F64).repeat(B, 1, 1)),
        ),
        "solve_bundle": of(o.solve_bundle, problem=bundle()),
        "solve_pose_graph": of(o.solve_pose_graph, graph=graph()),
        "solve_rotations": alone(
            o.solve_rotations,
            edges=edges,
            R_ji=R_cw[edges[:, 1]] @ R_cw[edges[:, 0]].mT @ so3_exp(0.01 * rand(4, 3)),
            num_views=4,
            weights=torch.ones(4, dtype=F64),
        ),
        "solve_least_squares": of(
            o.solve_least_squares,
            residual=line,
            start=torch.zeros(B, 2, dtype=F64),
            inputs=(rand(B, N), ones),
            weights=ones,
            mask=v["mask"],
        ),
        "camera_evidence": decision(
            o.camera_evidence, problem=bundle(), given=CameraMeasurement.of(CAMERA, 0.02)
        ),
        "pose_covariance": decision(o.pose_covariance, problem=bundle()),
        "relative_pose_error": of(o.relative_pose_error, T_1w=T, T_2w=T_2, T_21=T),
        "log_distance_error": of(o.log_distance_error, T_1w=T, T_2w=T_2, distances=1 + rand(B)),
        "displacement_error": of(o.displacement_error, T_1w=T, T_2w=T_2, measured=rand(B, 2, 3)),
        "pose_error": of(o.pose_error, T_cw=T, prior=T_2),
        "direction_error": of(o.direction_error, T_cw=T, measured=rand(B, 2, 3)),
        "plane_error": of(o.plane_error, points_w=rand(B, 3), plane=rand(B, 4)),
        "center_error": of(o.center_error, T_cw=T, plane=rand(B, 4)),
        "log_length_error": of(
            o.log_length_error, first_w=rand(B, 3), second_w=2 + rand(B, 3), lengths=1 + rand(B)
        ),
        "bounds_error": of(
            o.bounds_error, values=rand(B, 3), bounds=torch.stack((0.1 + rand(B, 3), 0.2 + rand(B, 3)), 1)
        ),
        "evaluate": decision(evaluation.evaluate, estimate=estimate, groundtruth=truth),
        "ate_apart": decision(evaluation.ate_apart, parts=[estimate], groundtruth=truth),
        "ate": of(
            evaluation.ate,
            T_cw=poses(B, 9),
            T_cw_groundtruth=poses(B, 9) @ poses(B, 9),
            mask=torch.arange(9).expand(B, 9) != 2,
        ),
        "rpe": of(
            evaluation.rpe,
            T_cw=poses(B, 9),
            T_cw_groundtruth=poses(B, 9) @ poses(B, 9),
            mask=torch.arange(9).expand(B, 9) != 2,
        ),
        "match": decision(
            features.match, features_1=bits, features_2=bits, allowed=torch.ones(1, N, N, dtype=torch.bool)
        ),
        "match_pairs": decision(
            features.match_pairs,
            descriptors_1=bits.descriptors[0],
            descriptors_2=bits.descriptors[0],
            rows=torch.arange(N),
            columns=torch.arange(N),
            max_distance=64,
        ),
        "match_by_projection": decision(
            features.match_by_projection,
            descriptors=bits.descriptors,
            pixels=bits.keypoints,
            radius=20 * torch.ones(1, N),
            features=bits,
            mask=torch.arange(N)[None] % 7 != 0,
            scales=torch.ones(1, N),
            angles=torch.zeros(1, N),
        ),
        "hamming": decision(features.hamming, descriptors_1=bits.descriptors, descriptors_2=bits.descriptors),
        "pack_bits": decision(features.pack_bits, bits=torch.arange(64).view(2, 32) % 3 == 0),
        "unpack_bits": decision(features.unpack_bits, descriptors=bits.descriptors),
        "expand_runs": decision(
            features.expand_runs, starts=torch.tensor([0, 4, 5]), ends=torch.tensor([2, 4, 8])
        ),
        "ORB": decision(features.ORB(100), images=rand(1, 1, 96, 128).float()),
        "OpenCVORB": decision(features.OpenCVORB(100), images=rand(1, 1, 96, 128).float()),
        "SIFT": decision(features.SIFT(100), images=rand(1, 1, 96, 128).float()),
        "SimulatedFeatures": decision(
            lambda T_cw: SimulatedFeatures(T_cw, CAMERA, num_keypoints=50, noise_px=0.3)(T_cw[0], 1),
            T_cw=poses(4),
        ),
    }
