from dataclasses import replace

import pytest
import torch

from torchslam.errors import TorchslamError
from torchslam.geometry import Camera, se3_exp, se3_inverse, se3_log, transform, umeyama
from torchslam.solvers.graph import ObservationGraph, solve

CONVERGED = {"iterations": 60, "tolerance": 0.0}


def simulated(noise=0.5, frames=10, points=50, seed=0):
    """Truth (F, 4, 4), and a graph near it: every third frame is a keyframe, the rows are shuffled."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera = Camera.radial_tangential(500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -1e-3, size=(640, 480))
    twists = 0.05 * normal(frames, 6)
    twists[:, 0] += torch.linspace(-1, 1, frames, dtype=torch.float64)
    T_cw = se3_exp(twists)
    points_w = torch.stack((1.2 * normal(points), normal(points), 5 + normal(points).clamp(-2, 2)), -1)
    frame_index, point_index = (torch.rand(frames, points, generator=generator) < 0.8).nonzero().unbind(-1)
    order = torch.randperm(len(frame_index), generator=generator)
    frame_index, point_index = frame_index[order], point_index[order]
    points_c = transform(T_cw[frame_index], points_w[point_index][:, None])[:, 0]
    perturbation = 0.005 * normal(frames, 6)
    perturbation[0] = 0
    return T_cw, ObservationGraph(
        torch.arange(frames, dtype=torch.float64) / 30,
        se3_exp(perturbation) @ T_cw,
        points_w + 0.01 * normal(points, 3),
        frame_index,
        point_index,
        camera.project(points_c)[0] + noise * normal(len(frame_index), 2),
        0.5 + torch.rand(len(frame_index), generator=generator, dtype=torch.float64),
        camera,
        torch.arange(frames) % 3 == 0,
    )


def aligned_error(solution, truth):
    """RMSE of the camera centres after the best similarity: independent of the gauge."""
    centres, target = solution.trajectory.positions_w, se3_inverse(truth)[:, :3, 3]
    s, R, t = umeyama(centres, target)
    return (s * centres @ R.mT + t - target).square().sum(-1).mean().sqrt()


def test_exact_data_gives_the_exact_trajectory():
    truth, graph = simulated(noise=0.0)
    solution = solve(graph)
    assert solution.success.all()
    assert aligned_error(solution, truth) < 1e-8


def test_noisy_data_improves_on_the_start():
    truth, graph = simulated()
    solution = solve(graph)
    before = se3_log(graph.T_cw @ se3_inverse(truth)).norm()
    assert aligned_error(solution, truth) < 0.3 * before


def test_gradient_of_the_trajectory_error_to_pixels_weights_and_camera():
    """Central differences along a random direction of each input, through keyframes and the frames in between."""
    truth, graph = simulated(noise=1.0)

    def loss(pixels, weights, params):
        camera = graph.camera.with_params(params)
        solution = solve(
            replace(graph, pixels=pixels, weights=weights, camera=camera), "cauchy", 2.0, **CONVERGED
        )
        return aligned_error(solution, truth)

    inputs = [graph.pixels, graph.weights, graph.camera.params]
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    loss(*leaves).backward()
    generator = torch.Generator().manual_seed(1)
    units = (1.0, 0.1, torch.tensor([1.0, 1, 1, 1, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3], dtype=torch.float64))
    for position, unit in enumerate(units):
        direction = unit * torch.randn(inputs[position].shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            ahead, behind = (
                loss(*(x + sign * 1e-4 * direction if i == position else x for i, x in enumerate(inputs)))
                for sign in (1, -1)
            )
        expected = (ahead - behind) / 2e-4
        torch.testing.assert_close((leaves[position].grad * direction).sum(), expected, rtol=1e-5, atol=0)


def test_every_observation_has_a_gradient_and_free_camera_ends_it():
    truth, graph = simulated()
    pixels, params = graph.pixels.clone().requires_grad_(), graph.camera.params.clone().requires_grad_()
    graph = replace(graph, pixels=pixels, camera=graph.camera.with_params(params))
    solution = solve(graph)
    aligned_error(solution, truth).backward()
    counted = solution.keyframes.moved_points[graph.point_index]  # points that at least two keyframes see
    assert counted.sum() > 0.7 * len(counted)
    assert torch.equal((pixels.grad != 0).any(-1), counted)
    assert (params.grad != 0).all()
    params.grad = None
    solution = solve(graph, free_camera=True)
    aligned_error(solution, truth).backward()
    assert params.grad is None or (params.grad == 0).all()
    assert not torch.equal(solution.camera.params, params)


def test_a_frame_that_sees_nothing_stays_and_is_flagged():
    _, graph = simulated()
    keep = graph.frame_index != 4
    pixels = graph.pixels[keep].requires_grad_()
    blind = replace(
        graph,
        frame_index=graph.frame_index[keep],
        point_index=graph.point_index[keep],
        pixels=pixels,
        weights=graph.weights[keep],
    )
    solution = solve(blind)
    assert solution.success.tolist() == [row != 4 for row in range(10)]
    assert torch.equal(solution.T_cw[4], graph.T_cw[4])
    solution.T_cw.sum().backward()
    assert pixels.grad.isfinite().all()


def test_keyframes_only_and_no_keyframe():
    _, graph = simulated()
    everyone = replace(graph, is_keyframe=torch.ones(10, dtype=torch.bool))
    assert solve(everyone).success.all()
    with pytest.raises(ValueError, match="no keyframe"):
        solve(replace(graph, is_keyframe=torch.zeros(10, dtype=torch.bool)))


def test_saved_and_loaded_graph_gives_the_same_bytes(tmp_path):
    _, graph = simulated()
    graph.save(tmp_path / "graph.safetensors")
    loaded = ObservationGraph.load(tmp_path / "graph.safetensors")
    assert loaded.camera.size == (640, 480)
    assert torch.equal(solve(loaded).T_cw, solve(graph).T_cw)


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "graph.safetensors"
    path.write_bytes(b"something else")
    with pytest.raises(TorchslamError, match=r"graph\.safetensors is not an observation graph"):
        ObservationGraph.load(path)
