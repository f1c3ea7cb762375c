import warnings
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from tests.optim.conftest import solved_graph
from torchslam.errors import ConvergenceError, ConvergenceWarning, TorchslamError
from torchslam.evaluation import ate
from torchslam.geometry import Camera, se3_exp, se3_inverse, transform, umeyama
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.optim import GRAPH_OPTIONS, DepthPrior, Factors, log_distance_error
from torchslam.optim._core.levenberg_marquardt import SolverReason
from torchslam.optim.bundle._sparse import _newton_steps
from torchslam.optim.gradient_check import check_gradient
from torchslam.optim.observation_graph import ObservationGraph, RunGraph, concatenate_graphs
from torchslam.optim.run_graph import solve_graph, solve_graphs
from torchslam.utils.memory import available_memory

CONVERGED = {"iterations": 25, "tolerance": 0.0}


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
    """RMSE of the camera centers after the best similarity: independent of the gauge."""
    centers, target = solution.trajectory.positions_w, se3_inverse(truth)[:, :3, 3]
    s, R, t = umeyama(centers, target)
    return (s * centers @ R.mT + t - target).square().sum(-1).mean().sqrt()


def test_exact_data_gives_the_exact_trajectory():
    truth, graph = simulated(noise=0.0)
    solution = solve_graph(graph)
    assert solution.success.all()
    assert aligned_error(solution, truth) < 1e-8


def test_gradient_of_the_trajectory_error_to_pixels_weights_and_camera():
    """Central differences along a random direction of each input, through keyframes and the frames in between."""
    truth, graph = simulated(noise=1.0)

    def loss(pixels, weights, params):
        camera = graph.camera.with_params(params)
        solution = solved_graph(
            replace(graph, pixels=pixels, weights=weights, camera=camera),
            kernel="cauchy",
            scale=2.0,
            **CONVERGED,
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


def test_every_observation_has_a_gradient_until_the_camera_is_free():
    truth, graph = simulated()
    pixels, params = graph.pixels.clone().requires_grad_(), graph.camera.params.clone().requires_grad_()
    graph = replace(graph, pixels=pixels, camera=graph.camera.with_params(params))
    solution = solve_graph(graph)
    aligned_error(solution, truth).backward()
    counted = solution.moved_points[graph.point_index]  # points that at least two keyframes see
    assert counted.sum() > 0.7 * len(counted)
    assert torch.equal((pixels.grad != 0).any(-1), counted)
    assert (params.grad != 0).all()
    params.grad = None
    solution = solve_graph(graph, free_camera=True)
    aligned_error(solution, truth).backward()
    assert params.grad is None or (params.grad == 0).all()
    assert not torch.equal(solution.camera.params, params)


def test_a_frame_without_observations_stays_and_is_flagged():
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
    solution = solve_graph(blind)
    assert solution.success.tolist() == [row != 4 for row in range(10)]
    assert torch.equal(solution.T_cw[4], graph.T_cw[4])
    solution.T_cw.sum().backward()
    assert pixels.grad.isfinite().all()


def test_a_graph_without_observations_is_flagged_as_failed():
    _, graph = simulated()
    names = ("frame_index", "point_index", "pixels", "weights")
    solution = solve_graph(replace(graph, **{name: getattr(graph, name)[:0] for name in names}))
    assert not solution.success.any()
    assert torch.equal(solution.T_cw, graph.T_cw)
    assert torch.equal(solution.points_w, graph.points_w)
    (bundle,) = solution.keyframes
    assert bundle.covariance().points.shape == (0, 3, 3)


def test_frames_say_whether_they_are_at_a_minimum():
    _, graph = simulated()
    first = solved_graph(graph, iterations=1)
    assert not first.converged.any()  # without points there, no frame is where it belongs
    there = replace(graph, T_cw=solve_graph(graph).T_cw, points_w=solve_graph(graph).points_w)
    off = replace(there, T_cw=torch.where(graph.is_keyframe[:, None, None], there.T_cw, graph.T_cw))
    assert solved_graph(there, iterations=2).converged.all()
    assert torch.equal(solved_graph(off, iterations=2).converged, graph.is_keyframe)


def test_all_frames_may_be_keyframes():
    _, graph = simulated()
    assert solve_graph(replace(graph, is_keyframe=torch.ones(10, dtype=torch.bool))).success.all()


def run_graph(graph, start=0):
    """The graph with names of its rows."""
    columns = {name: getattr(graph, name) for name in graph.columns()}
    return RunGraph(
        **columns,
        camera=graph.camera,
        frame_ids=start + torch.arange(len(graph.T_cw)),
        sessions=torch.arange(len(graph.T_cw)) % 2,
        point_ids=2 * torch.arange(len(graph.points_w)),
        keypoint_index=7 + torch.arange(len(graph.pixels)),
    )


@pytest.mark.usefixtures("without_shape_checks")
def test_a_run_graph_keeps_its_row_numbers(tmp_path):
    path = tmp_path / "graph.safetensors"
    graph = run_graph(replace(simulated()[1], submap=torch.full((10,), 3)), start=5)
    graph.save(path)
    for kind in (RunGraph, ObservationGraph):
        loaded = kind.load(path)
        assert type(loaded) is RunGraph
        for name in graph.columns():
            assert torch.equal(getattr(loaded, name), getattr(graph, name)), name
    plain = replace(simulated()[1], submap=graph.submap)
    plain.save(path)
    assert type(ObservationGraph.load(path)) is ObservationGraph
    with pytest.raises(TorchslamError, match="is not an observation graph"):
        RunGraph.load(path)


def test_a_file_without_submap_indices_has_one_submap(tmp_path):
    _, graph = simulated()
    graph.save(tmp_path / "new")
    with safe_open(tmp_path / "new", framework="pt") as file:
        metadata, names = file.metadata(), set(file.keys()) - {"submap"}
        save_file({name: file.get_tensor(name) for name in names}, tmp_path / "old", metadata)
    assert torch.equal(ObservationGraph.load(tmp_path / "old").submap, torch.zeros(10, dtype=torch.int64))


def two_submaps():
    """Truths and graphs of two submaps that share a camera, and both as one graph with shuffled rows."""
    (truth_1, one), (truth_2, two) = simulated(seed=0), simulated(frames=7, points=30, seed=1)
    one, two = replace(one, submap=torch.full((10,), 4)), replace(two, submap=torch.full((7,), 1))
    return (truth_1, truth_2), (one, two), concatenate_graphs([one, two])


def close(found, expected):
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)


def test_a_window_is_a_graph_of_its_own(tmp_path):
    """With the rows that the definition names, in order, and gradients that reach the pixels of the whole."""
    _, graph = simulated(frames=20, points=60)
    first, last = float(graph.timestamps[5]), float(graph.timestamps[15])
    pixels = graph.pixels.clone().requires_grad_()
    window = replace(graph, pixels=pixels).window(first, last)
    assert torch.equal(window.T_cw, graph.T_cw[5:16])
    assert torch.equal(window.is_keyframe, graph.is_keyframe[5:16])
    keyframes = [frame for frame in range(5, 16) if graph.is_keyframe[frame]]
    sees = [set(graph.point_index[graph.frame_index == frame].tolist()) for frame in keyframes]
    points = [point for point in range(60) if sum(point in each for each in sees) >= 2]
    assert torch.equal(window.points_w, graph.points_w[points])
    ends = zip(graph.frame_index.tolist(), graph.point_index.tolist(), strict=True)
    rows = [row for row, (frame, point) in enumerate(ends) if 5 <= frame <= 15 and point in points]
    assert torch.equal(window.pixels, graph.pixels[rows])
    assert torch.equal(window.frame_index + 5, graph.frame_index[rows])
    assert torch.equal(torch.tensor(points)[window.point_index], graph.point_index[rows])
    (gradient,) = torch.autograd.grad(solved_graph(window).trajectory.positions_w[-1].sum(), pixels)
    assert gradient[rows].abs().sum() > 0
    gradient[rows] = 0
    assert gradient.abs().sum() == 0


def test_a_window_of_all_frames_has_the_same_solution():
    _, graph = simulated()
    whole = graph.window(-1.0, 100.0)
    torch.testing.assert_close(solved_graph(whole).T_cw, solved_graph(graph).T_cw, rtol=0.0, atol=1e-13)
    joined = concatenate_graphs(
        [graph, replace(graph, timestamps=graph.timestamps + 10, submap=graph.submap + 4)]
    )
    assert joined.window(0.0, 5.0).submaps == [0]
    with pytest.raises(ValueError, match="no two keyframes of a submap from 3 to 4 s"):
        graph.window(3.0, 4.0)


def test_a_graph_that_does_not_fit_into_memory_is_refused(monkeypatch):
    _, graph = simulated()
    count, of_keyframes = len(graph.pixels), int(graph.is_keyframe[graph.frame_index].sum())
    needed = 2000 * of_keyframes + 300 * (count - of_keyframes)
    monkeypatch.setattr("torchslam.optim.run_graph.available_memory", lambda: needed)
    assert solve_graph(graph).success.all()
    monkeypatch.setattr("torchslam.optim.run_graph.available_memory", lambda: needed - 1)
    with pytest.raises(
        MemoryError, match=rf"{count} observations needs about 0.0 GB.*graph.window\(first, last\)"
    ):
        solve_graph(graph)
    monkeypatch.setattr("torchslam.optim.run_graph.available_memory", lambda: None)
    assert solve_graph(graph).success.all()
    monkeypatch.undo()
    assert available_memory() is None or 1 << 20 < available_memory() < 1 << 50


def test_observations_in_runs_give_the_same_gradient(monkeypatch):
    """With a camera that is free and its prior, whose part comes with the first run alone."""
    truth, graph = simulated()
    given = CameraMeasurement.of(graph.camera, 0.02)

    def gradients():
        leaves = [
            each.clone().requires_grad_() for each in (graph.pixels, graph.weights, given.camera.params)
        ]
        prior = replace(given, camera=given.camera.with_params(leaves[2]))
        solution = solved_graph(replace(graph, pixels=leaves[0], weights=leaves[1], calibration=prior))
        return torch.autograd.grad(aligned_error(solution, truth), leaves)

    whole = gradients()
    for name in ("_sparse.AT_ONCE", "_sparse.EXACT_AT_ONCE", "_solve.AT_ONCE"):
        monkeypatch.setattr(f"torchslam.optim.bundle.{name}", 37)
    for part, of_all in zip(gradients(), whole, strict=True):
        assert float(of_all.norm()) > 0
        torch.testing.assert_close(part, of_all, rtol=1e-9, atol=1e-9 * float(of_all.abs().max()))


def test_submaps_are_solved_independently():
    _, (one, two), both = two_submaps()
    assert both.submaps == [1, 4]
    solution, first, second = solve_graph(both), solve_graph(one), solve_graph(two)
    # Frames in between are refined in one batch. That moves last digits, by which a last step, which gains less than
    # rounding, is taken or not.
    alone = torch.cat([first.T_cw, second.T_cw])
    torch.testing.assert_close(solution.T_cw, alone, rtol=0, atol=1e-8)
    keyframes = both.is_keyframe
    assert torch.equal(solution.T_cw[keyframes], alone[keyframes])
    assert torch.equal(solution.points_w, torch.cat([first.points_w, second.points_w]))
    assert torch.equal(solution.success, torch.cat([first.success, second.success]))
    assert torch.equal(solution.moved_points, torch.cat([first.moved_points, second.moved_points]))
    assert [len(bundle.T_cw) for bundle in solution.keyframes] == [3, 4]  # submap 1, submap 4
    assert torch.equal(solution.submap, both.submap)
    for submap, only in ((4, first), (1, second)):
        found = solution.trajectory_in(submap).T_wc
        torch.testing.assert_close(found, only.trajectory.T_wc, atol=1e-8, rtol=0)
    assert torch.equal(solution.trajectory.T_wc, solution.trajectory_in(4).T_wc)  # ten frames against seven
    assert torch.equal(solution.T_cw[0], both.T_cw[0])
    assert torch.equal(solution.T_cw[10], both.T_cw[10])  # the first keyframe of either
    assert torch.equal(solution.keyframes[1].covariance().frames, first.keyframes[0].covariance().frames)


def test_rows_of_submaps_may_be_interleaved():
    _, _, both = two_submaps()
    generator = torch.Generator().manual_seed(3)
    # Frames stay in order within their submap: the first keyframe is the one that is fixed.
    order = torch.cat([torch.arange(5), torch.arange(10, 14), torch.arange(5, 10), torch.arange(14, 17)])
    place, rows = torch.argsort(order), torch.randperm(len(both.pixels), generator=generator)
    shuffled = replace(
        both,
        timestamps=both.timestamps[order],
        T_cw=both.T_cw[order],
        submap=both.submap[order],
        is_keyframe=both.is_keyframe[order],
        frame_index=place[both.frame_index[rows]],
        **{name: getattr(both, name)[rows] for name in ("point_index", "pixels", "weights")},
    )
    solution, expected = solve_graph(shuffled), solve_graph(both)
    assert torch.allclose(solution.T_cw, expected.T_cw[order], atol=1e-9)
    assert torch.allclose(solution.points_w, expected.points_w, atol=1e-8)


def test_gradients_of_all_submaps_reach_pixels_and_the_shared_camera():
    (truth_1, truth_2), (one, two), both = two_submaps()

    def gradients(graph, loss):
        pixels, params = graph.pixels.clone().requires_grad_(), graph.camera.params.clone().requires_grad_()
        moved = replace(graph, pixels=pixels, camera=graph.camera.with_params(params))
        loss(solved_graph(moved, **CONVERGED).T_cw).backward()
        return pixels.grad, params.grad

    pixels, params = gradients(
        both,
        lambda T_cw: (
            ate(T_cw=T_cw[:10], T_cw_groundtruth=truth_1) + ate(T_cw=T_cw[10:], T_cw_groundtruth=truth_2)
        ),
    )
    pixels_1, params_1 = gradients(one, lambda T_cw: ate(T_cw=T_cw, T_cw_groundtruth=truth_1))
    pixels_2, params_2 = gradients(two, lambda T_cw: ate(T_cw=T_cw, T_cw_groundtruth=truth_2))
    torch.testing.assert_close(pixels, torch.cat([pixels_1, pixels_2]))
    torch.testing.assert_close(params, params_1 + params_2)
    assert (params_1 != 0).all()
    assert (params_2 != 0).all()


def damaged(graph, name, change):
    column = getattr(graph, name).clone()
    return replace(graph, **{name: change(column)})


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("is_keyframe", torch.zeros_like, "the graph has no keyframe"),
        (
            "submap",
            lambda submap: submap.index_fill(0, torch.tensor([4]), 9),
            "a submap of the graph has no keyf",
        ),
        ("point_index", torch.zeros_like, "a point is seen in two submaps"),
        ("points_w", torch.Tensor.float, "points_w is of type torch.float32, not torch.float64"),
        ("T_cw", torch.Tensor.half, "T_cw must be float32 or float64, not torch.float16"),
        ("weights", lambda weights: -weights, "a negative weight"),
    ],
)
@pytest.mark.usefixtures("without_shape_checks")
def test_a_file_that_cannot_be_solved_is_refused_when_it_is_read(tmp_path, name, change, message):
    path = tmp_path / "graph.safetensors"
    damaged(two_submaps()[2], name, change).save(path)
    with pytest.raises(TorchslamError, match=rf"graph\.safetensors is not an observation graph: .*{message}"):
        ObservationGraph.load(path)


def test_joined_run_graphs_keep_their_names():
    _, graph = simulated()
    both = concatenate_graphs(
        [run_graph(graph), replace(run_graph(graph, start=100), submap=torch.ones(10, dtype=torch.int64))]
    )
    assert type(both) is RunGraph
    assert both.frame_ids.tolist() == [*range(10), *range(100, 110)]
    assert torch.equal(both.point_ids, torch.cat([2 * torch.arange(50)] * 2))
    assert torch.equal(both.frame_index[len(graph.pixels) :], graph.frame_index + 10)
    assert torch.equal(both.point_index[len(graph.pixels) :], graph.point_index + 50)


def measured(graph, std=0.02, factor=1.02):
    """The graph with a calibration whose focal length is off by a factor, as where its camera starts."""
    params = graph.camera.params.clone()
    params[:2] *= factor
    given = CameraMeasurement.of(graph.camera.with_params(params), std)
    return replace(graph, camera=given.camera, calibration=given)


def test_a_calibration_with_an_error_is_corrected_by_the_images():
    truth, graph = simulated(noise=0.1, points=200)
    given = measured(graph, std=0.5)
    solution, held = solve_graph(given), solve_graph(given, free_camera=False)
    off = (solution.camera.params[:2] / graph.camera.params[:2] - 1).abs()
    assert off.max() < 0.01
    assert torch.equal(held.camera.params, given.camera.params)
    assert solution.camera.params[2:4].tolist() == graph.camera.params[2:4].tolist()  # exact, as given
    assert aligned_error(solution, truth) < aligned_error(held, truth)


def test_a_calibration_counts_as_much_as_observations_vary():
    """The noisier the observations, the nearer the camera stays to what was given."""
    _, graph = simulated(noise=0.5)
    given, focal = measured(graph), []
    for variance in (0.01, 1.0, 1e6):
        calibration = replace(given.calibration, observation_variance=variance)
        focal.append(float(solve_graph(replace(given, calibration=calibration)).camera.focal))
    assert focal == sorted(focal)
    assert focal[2] == pytest.approx(float(given.camera.focal), rel=1e-4)


def test_a_camera_of_which_nothing_is_free_is_held():
    _, graph = simulated(noise=0.5)
    given = measured(graph)
    held = replace(given.calibration, directions=given.calibration.directions[:, :0])
    solution = solve_graph(replace(given, calibration=held))
    assert torch.equal(solution.camera.params, given.camera.params)
    torch.testing.assert_close(solution.T_cw, solve_graph(replace(given, calibration=None)).T_cw)


def test_the_main_submap_determines_the_camera_of_all():
    _, (one, two), both = two_submaps()
    given = measured(both)
    solution, alone = solve_graph(given), solve_graph(measured(one))
    torch.testing.assert_close(solution.camera.params, alone.camera.params, rtol=1e-9, atol=1e-9)
    other = solve_graph(replace(two, camera=solution.camera))
    torch.testing.assert_close(solution.trajectory_in(1).T_wc, other.trajectory.T_wc, rtol=0, atol=1e-9)


def test_a_calibration_is_saved_with_the_graph(tmp_path):
    _, graph = simulated()
    given = measured(graph)
    given = replace(given, calibration=replace(given.calibration, observation_variance=0.3))
    given.save(tmp_path / "graph.safetensors")
    loaded = ObservationGraph.load(tmp_path / "graph.safetensors")
    assert loaded.calibration.observation_variance == 0.3
    assert torch.equal(loaded.calibration.directions, given.calibration.directions)
    assert torch.equal(loaded.calibration.camera.params, given.calibration.camera.params)
    assert torch.equal(solve_graph(loaded).T_cw, solve_graph(given).T_cw)
    graph.save(tmp_path / "exact.safetensors")
    assert ObservationGraph.load(tmp_path / "exact.safetensors").calibration is None


def test_graphs_with_calibrations_are_solved_as_alone():
    _, graph = simulated()
    given = measured(graph)
    together = solve_graphs([given, graph, given])
    for found, alone in zip(together, (given, graph, given), strict=True):
        torch.testing.assert_close(found.T_cw, solve_graph(alone).T_cw, rtol=0, atol=1e-9)


def test_strict_raises_where_a_frame_is_not_at_a_minimum():
    graph = simulated()[1]
    assert solved_graph(graph, strict=True).converged.all()
    for solve in (
        lambda: solved_graph(graph, iterations=1, strict=True),
        lambda: solve_graphs([graph, graph], options=GRAPH_OPTIONS.replace(iterations=1, strict=True)),
    ):
        with pytest.raises(ConvergenceError, match=r"frames: .* not converged"):
            solve()


def test_factors_and_depths_of_a_graph_determine_the_scale_of_every_submap():
    """Truth 1.2 times as large, said by distances in one submap and by depths in the other."""
    *_, graph = two_submaps()
    keyframes = [
        ((graph.submap == submap) & graph.is_keyframe).nonzero().squeeze(-1) for submap in graph.submaps
    ]
    frames = torch.stack((keyframes[0][:-1], keyframes[0][1:]), dim=-1)
    exact = solved_graph(graph, kernel="none", iterations=200, tolerance=1e-20)

    def centers(solution, rows):
        return se3_inverse(solution.T_cw)[rows, :3, 3]

    long = (centers(exact, frames[:, 1]) - centers(exact, frames[:, 0])).norm(dim=-1).detach()
    distances = (1.2 * long).requires_grad_()
    factors = (Factors.distances(frames, distances, torch.full((len(frames),), 1e8).double()),)
    seen = exact.T_cw[graph.frame_index, 2, :3] * exact.points_w[graph.point_index]
    depths = 1.2 * (seen.sum(-1) + exact.T_cw[graph.frame_index, 2, 3])
    information = torch.where(graph.submap[graph.frame_index] == graph.submaps[1], 1e4, 0.0).double()
    prior = DepthPrior(depths.detach(), information)
    solution = solved_graph(graph, factors=factors, depth_prior=prior, kernel="none", strict=True)
    for rows in keyframes:
        grown = centers(solution, rows) - centers(solution, rows[:1])
        before = centers(exact, rows) - centers(exact, rows[:1])
        torch.testing.assert_close(grown.norm(dim=-1), 1.2 * before.norm(dim=-1), rtol=2e-3, atol=1e-6)
    (gradient,) = torch.autograd.grad(centers(solution, frames[:, 1]).norm(dim=-1).sum(), distances)
    assert gradient.abs().max() > 0
    joined = torch.stack((keyframes[0][:1], keyframes[1][:1]), dim=-1)
    wrong = Factors.distances(joined, torch.ones(1).double(), torch.ones(1).double())
    with pytest.raises(ValueError, match="of one submap"):
        solve_graph(graph, factors=(wrong,))


def test_factors_of_frames_between_keyframes_and_of_points():
    """Heights, gravity and a length place and scale the map; their frames are solved with the keyframes."""
    _, graph = simulated(noise=0.0)
    exact = solve_graph(graph)
    up = torch.tensor((0.0, -1, 0)).double()
    frames, ones = torch.arange(10), torch.full((10,), 1e4).double()
    assert not graph.is_keyframe[frames].all()
    heights = (2.0 * se3_inverse(exact.T_cw)[:, :3, 3] @ up + 3).requires_grad_()
    down_c = (exact.T_cw[:, :3, :3] @ -up).detach()
    pair = torch.tensor([(0, 1)])
    length = 2 * (exact.points_w[1] - exact.points_w[0]).norm()[None].detach()
    factors = (
        Factors.heights(frames, heights, ones, up),
        Factors.directions(frames, down_c, -up, ones),
        Factors.lengths(pair, length, ones[:1]),
    )
    solution = solve_graph(graph, factors=factors)
    assert solution.success.all()
    assert solution.converged.all()
    found = se3_inverse(solution.T_cw)[:, :3, 3] @ up
    torch.testing.assert_close(found, heights, rtol=0, atol=1e-4)
    torch.testing.assert_close((solution.points_w[1] - solution.points_w[0]).norm()[None], length)
    (gradient,) = torch.autograd.grad(found.sum(), heights)
    torch.testing.assert_close(gradient.sum(), torch.tensor(10.0).double())  # all of them higher


@pytest.mark.parametrize("information", [1e4, 1e8])
@pytest.mark.parametrize("kind", ["rises", "heights", "points"])
def test_factors_that_shrink_the_map_without_limit_end_soon_with_a_reason(kind, information):
    """No extent is the best of a plane that the camera, or points, do not keep, as nothing determines the scale."""
    _, graph = simulated(noise=0.5)
    keyframes = graph.is_keyframe.nonzero().squeeze(-1)
    count, up = len(keyframes), torch.eye(4).double()[1]

    def rise(T_1w, T_2w, measured):
        return (se3_inverse(T_2w)[..., 1, 3] - se3_inverse(T_1w)[..., 1, 3] - measured)[..., None]

    pairs, zeros = torch.stack((keyframes[:-1], keyframes[1:]), dim=-1), torch.zeros(count).double()
    stated = torch.full((10,), information).double()
    level = {
        "rises": Factors(pairs, zeros[1:], stated[: count - 1, None, None], rise),
        "heights": Factors.heights(keyframes, zeros, stated[:count], up[:3]),
        "points": Factors.planes(torch.arange(10), up.expand(10, 4), stated),
    }
    solution = solve_graph(graph, factors=(level[kind],))
    assert not solution.success[graph.is_keyframe].any()
    assert solution.reasons[0] is SolverReason.UNDETERMINED
    assert solution.convergence.iterations[0] < 100


def test_a_solution_that_has_not_converged_warns_of_its_gradient_once():
    _, graph = simulated(noise=1.0)
    weights = graph.weights.clone().requires_grad_()
    solution = solved_graph(replace(graph, weights=weights), iterations=2)
    assert not solution.converged.any()
    assert {str(reason) for reason in solution.reasons} == {"not converged: allow more iterations"}
    with pytest.warns(ConvergenceWarning, match=r"of 10 of 10 frames .*\(10 not converged: allow more"):
        solution.T_cw.square().sum().backward(retain_graph=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution.T_cw.square().sum().backward()  # once is enough
        solve_graph(replace(graph, weights=weights)).T_cw.square().sum().backward()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_any_precision_is_computed_in_float64(dtype):
    _, graph = simulated()
    weights = graph.weights.to(dtype).requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        solution = solve_graph(replace(graph, weights=weights))
    exact = graph.weights.to(dtype).double().requires_grad_()
    expected = solve_graph(replace(graph, weights=exact))
    assert torch.equal(solution.T_cw, expected.T_cw)
    solution.T_cw.square().sum().backward()
    expected.T_cw.square().sum().backward()
    assert weights.grad.dtype == dtype
    torch.testing.assert_close(weights.grad, exact.grad.to(dtype))


def test_a_solution_travels_between_processes_without_its_graph():
    _, graph = simulated()
    pixels = graph.pixels.clone().requires_grad_()
    solution = solve_graph(replace(graph, pixels=pixels))
    factor = Factors.distances(torch.tensor([(0, 9)]), torch.ones(1).double(), torch.ones(1).double())
    own = solve_graph(graph, factors=(replace(factor, error=lambda *x: log_distance_error(*x)),))
    for each in (solution, own):
        copy = ForkingPickler.loads(ForkingPickler.dumps(each))
        assert torch.equal(copy.T_cw, each.T_cw)
        assert not copy.T_cw.requires_grad
        assert copy.reasons == each.reasons
        covariance = copy.keyframes[0].covariance([1], [2]), each.keyframes[0].covariance([1], [2])
        assert all(torch.equal(*pair) for pair in zip(*covariance, strict=True))


def test_a_graph_moves_to_a_dtype():
    _, graph = simulated()
    small = graph.to(dtype=torch.float32)
    assert small.pixels.dtype == small.camera.params.dtype == torch.float32
    assert small.frame_index.dtype == torch.int64
    assert small.timestamps.dtype == torch.float64
    torch.testing.assert_close(solve_graph(small).T_cw, solve_graph(graph).T_cw, rtol=0, atol=1e-5)
    assert torch.equal(graph.to("cpu").pixels, graph.pixels)


def test_a_warm_start_ends_soon_at_the_same_minimum():
    _, graph = simulated()
    before = solve_graph(graph)
    changed = replace(graph, weights=graph.weights * 1.01)
    cold, warm = solve_graph(changed), solve_graph(changed, start=before)
    torch.testing.assert_close(warm.T_cw, cold.T_cw, rtol=0, atol=1e-5)
    assert warm.keyframes[0].convergence.iterations < cold.keyframes[0].convergence.iterations
    with pytest.raises(ValueError, match=r"start\.T_cw must be"):
        solve_graph(graph, start=replace(before, T_cw=before.T_cw[1:]))


@pytest.mark.parametrize("seed", range(3))
def test_the_last_steps_from_a_warm_start_are_newtons(seed):
    """With gross errors, of which points may leave one minimum for another one: as exact, in fewer steps."""
    _, graph = simulated(noise=2.0, frames=12, points=120, seed=seed)
    graph = replace(graph, is_keyframe=torch.arange(12) % 2 == 0)
    generator = torch.Generator().manual_seed(seed)
    wrong = torch.rand(len(graph.pixels), generator=generator) < 0.1
    graph = replace(graph, pixels=graph.pixels + 12.0 * wrong[:, None])
    pairs = torch.tensor([(0, 2), (2, 4)])
    factors = [Factors.distances(pairs, torch.full((2,), 0.4).double(), torch.full((2,), 1e4).double())]
    before = solve_graph(graph, factors=factors)
    changed = replace(graph, weights=graph.weights * (1 + 0.1 * graph.pixels[:, 0] / 640))
    without, found = (
        solve_graph(changed, factors=factors, start=before, options=GRAPH_OPTIONS.replace(backward=backward))
        for backward in ("detached", "implicit")
    )
    steps, most = (each.keyframes[0].convergence.iterations for each in (found, without))
    assert found.converged.all()
    assert steps < most
    assert steps <= 12
    # The detached search ends where the cost hardly falls; Newton's at the minimum.
    assert found.keyframes[0].cost <= without.keyframes[0].cost * (1 + 1e-7)
    exact = solve_graph(changed, factors=factors, start=found, options=GRAPH_OPTIONS.replace(tolerance=1e-16))
    torch.testing.assert_close(found.T_cw, exact.T_cw, rtol=0, atol=1e-6)


def test_a_step_of_a_point_goes_down_where_the_cost_is_curved_downward():
    blocks = torch.diag(torch.tensor([4.0, 1.0, 2.0]).double())[None]
    curved = torch.diag(torch.tensor([2.0, -0.5, 0.0]).double())[None]
    gradient = torch.tensor([[1.0, 1.0, 1.0]]).double()
    step = _newton_steps(gradient, blocks, curved)
    torch.testing.assert_close(step, torch.tensor([[0.5, 2.0, 5.0]]).double())  # the last: a tenth of 2
    assert not _newton_steps(gradient, torch.zeros_like(blocks), curved).any()


def test_the_gradient_check_agrees_and_names_the_gauge():
    truth, graph = simulated(noise=1.0)
    check = check_gradient(graph, lambda found: ate(T_cw=found.T_cw, T_cw_groundtruth=truth), directions=1)
    assert check.names == ("pixels", "weights", "camera")
    assert check.errors.max() < 1e-5
    assert check.depends_on == ()
    check = check_gradient(
        graph, lambda found: found.T_cw[:, :3, 3].square().sum(), ("weights",), directions=1
    )
    assert "scale" in check.depends_on
    assert "align it" in str(check)
    with pytest.raises(ValueError, match="unknown input 'poses'"):
        check_gradient(graph, lambda found: found.T_cw.sum(), ("poses",))
