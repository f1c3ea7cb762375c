from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchslam.optim import POSITION_OPTIONS, GlobalPositions, solve_positions

CONVERGED = {"iterations": 300, "tolerance": 1e-26}


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@dataclass
class Recording:
    """True positions, rays, and which of these are wrong."""

    centers_w: Tensor
    points_w: Tensor
    view: Tensor
    point: Tensor
    rays_w: Tensor
    is_wrong: Tensor

    def positions(
        self,
        rays_w: Tensor | None = None,
        weights: Any = None,
        start: Any = None,
        seed: int = 0,
        **options: Any,
    ) -> GlobalPositions:
        rays_w = self.rays_w if rays_w is None else rays_w
        counts = len(self.centers_w), len(self.points_w)
        options = POSITION_OPTIONS.replace(**options)
        return solve_positions(
            self.view, self.point, rays_w, *counts, weights, start, seed=seed, options=options
        )


def record(
    centers_w: Tensor, points_w: Tensor, noise: float = 0.0, wrong: float = 0.0, seed: int = 0
) -> Recording:
    """Views that look along z see points before them, and one in two of these."""
    u = points_w - centers_w[:, None]
    in_sight = (u[..., 2] > 0.5 * u.norm(dim=-1)) & (draw(seed, *u.shape[:2]) > 0)
    view, point = in_sight.nonzero().unbind(-1)
    rays_w = normalize(u[view, point], dim=-1) + noise * draw(seed + 1, len(view), 3)
    is_wrong = torch.rand(len(view), generator=torch.Generator().manual_seed(seed)) < wrong
    anything = draw(seed + 2, len(view), 3)
    anything[:, 2] = anything[:, 2].abs() + 0.5
    return Recording(
        centers_w, points_w, view, point, torch.where(is_wrong[:, None], anything, rays_w), is_wrong
    )


def make_recording(views: int = 30, points: int = 200, seed: int = 0, **options: Any) -> Recording:
    """A walk past a cloud of points."""
    along = torch.linspace(-3, 3, views, dtype=torch.float64)[:, None]
    centers_w = torch.cat((along, torch.sin(2 * along), 0.2 * along.cos()), dim=-1)
    points_w = draw(seed, points, 3) * torch.tensor([3.0, 1.5, 1.0]) + torch.tensor([0.0, 0.0, 5.0])
    return record(centers_w + 0.05 * draw(seed + 5, views, 3), points_w, seed=seed, **options)


def small_recording(noise: float = 0.05) -> Recording:
    return make_recording(views=5, points=16, noise=noise)


def aligned(positions: GlobalPositions, truth: Recording) -> tuple[Tensor, Tensor]:
    """Centers and points after the translation and scale that fit true centers best. Rotations are known."""
    centers_w, points_w = positions.centers_w.detach().double(), positions.points_w.detach().double()
    mean, true_mean = centers_w.mean(0), truth.centers_w.mean(0)
    deviation, expected = centers_w - mean, truth.centers_w - true_mean
    scale = (deviation * expected).sum() / deviation.square().sum()
    return scale * deviation + true_mean, scale * (points_w - mean) + true_mean


def error(positions: GlobalPositions, truth: Recording) -> float:
    """Root mean square error of the centers as a share of their extent."""
    difference = aligned(positions, truth)[0] - truth.centers_w
    spread = truth.centers_w - truth.centers_w.mean(0)
    return float(difference.norm() / spread.norm())


@pytest.mark.parametrize("seed", range(3))
def test_exact_rays_give_exact_positions_from_any_random_start(seed: int) -> None:
    truth = make_recording(seed=seed)
    found = truth.positions(truth.rays_w * (1 + draw(9, len(truth.rays_w), 1).abs()), seed=seed)
    centers_w, points_w = aligned(found, truth)
    torch.testing.assert_close(centers_w, truth.centers_w, rtol=0, atol=1e-9)
    seen = torch.bincount(truth.point, minlength=len(points_w)) > 1
    torch.testing.assert_close(points_w[seen], truth.points_w[seen], rtol=0, atol=1e-8)
    assert seen.sum() > 190
    assert (found.points_w[~seen] == 0).all()
    assert torch.equal(torch.isinf(found.angles), ~seen[truth.point])
    assert found.success
    assert found.determined.all()
    assert (found.component == 0).all()
    assert found.angles[seen[truth.point]].max() < 1e-9
    assert found.convergence.converged.all()


def test_gauge_is_the_first_view_and_the_extent_of_the_centers() -> None:
    found = make_recording().positions()
    spread = found.centers_w - found.centers_w.mean(0)
    assert torch.equal(found.centers_w[0], torch.zeros(3, dtype=torch.float64))
    assert float(spread.square().sum(-1).mean()) == pytest.approx(1.0, abs=1e-12)


def test_gauge_of_a_start_is_kept() -> None:
    truth = make_recording(noise=1e-3)
    start = 3 * truth.centers_w + 7, 3 * truth.points_w + 7
    found = truth.positions(start=start, **CONVERGED)
    assert torch.equal(found.centers_w[0], start[0][0])
    spreads = [centers - centers.mean(0) for centers in (found.centers_w, start[0])]
    assert float(spreads[0].norm()) == pytest.approx(float(spreads[1].norm()), rel=1e-12)
    # The minimum is that of the search.
    torch.testing.assert_close(
        aligned(found, truth)[0], aligned(truth.positions(**CONVERGED), truth)[0], rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_wrong_rays_does_little_harm_and_a_narrow_kernel_none(seed: int) -> None:
    truth = make_recording(seed=seed, wrong=0.2)
    found = truth.positions(seed=seed)
    assert found.success
    assert error(found, truth) < 0.05
    assert found.angles[~truth.is_wrong].median() < 0.02
    assert found.angles[truth.is_wrong].median() > 0.2
    narrow = truth.positions(seed=seed, kernel="geman_mcclure", scale=0.02)
    assert error(narrow, truth) < 1e-3


def test_weights_are_inverse_variances() -> None:
    """Half of the rays are ten times as noisy: weights that say so help, and the scale is in their unit."""
    truth = make_recording()
    is_noisy = draw(7, len(truth.view)) > 0
    sigma = torch.where(is_noisy, 1e-2, 1e-3).double()
    rays_w = normalize(truth.rays_w, dim=-1) + sigma[:, None] * draw(8, len(truth.view), 3)
    weighted = truth.positions(rays_w, weights=sigma**-2, scale=3.0)
    assert error(weighted, truth) < 0.5 * error(truth.positions(rays_w), truth)


def test_the_minimum_equals_that_of_colmap() -> None:
    """Its cost is the same one, with the distances as unknowns up to the end, and found by Ceres."""
    pycolmap = pytest.importorskip("pycolmap")
    truth = make_recording(noise=3e-3, wrong=0.1, seed=1)
    model, graph = pycolmap.Reconstruction(), pycolmap.PoseGraph()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=9999, height=9999, params=[500, 500, 0, 0])
    camera.has_prior_focal_length = True
    model.add_camera_with_trivial_rig(camera)
    views = range(len(truth.centers_w))
    pose = pycolmap.Rigid3d()
    rays = truth.rays_w / truth.rays_w[:, 2:]
    seen = [(truth.view == view).nonzero().squeeze(-1) for view in views]
    for view in views:
        pixels = (500 * rays[seen[view], :2]).numpy()
        image = pycolmap.Image(f"{view}", pixels, camera_id=1, image_id=view + 1)
        model.add_image_with_trivial_frame(image, pose)
        if view:
            graph.add_edge(view, view + 1, pycolmap.PoseGraphEdge(pose))
    tracks = [pycolmap.Track() for _ in truth.points_w]
    for view in views:
        for row, point in enumerate(truth.point[seen[view]].tolist()):
            tracks[point].add_element(view + 1, row)
    for point, track in enumerate(tracks):
        model.add_point3D_with_id(point + 1, pycolmap.Point3D(xyz=[0, 0, 1], track=track))
    options = pycolmap.GlobalPositionerOptions(
        random_seed=0, use_gpu=False, min_num_view_per_track=1, loss_function_scale=0.1
    )
    assert pycolmap.run_global_positioning(options, graph, model)
    centers_w = torch.stack([torch.from_numpy(model.image(view + 1).projection_center()) for view in views])
    points_w = torch.stack([torch.from_numpy(model.point3D(k + 1).xyz) for k in range(len(tracks))])
    found = truth.positions(iterations=300, tolerance=1e-9)
    at_theirs = truth.positions(start=(centers_w, points_w), iterations=0)
    cost, theirs = float(found.convergence.cost), float(at_theirs.convergence.cost)
    assert cost - 1e-6 < theirs < 1.001 * cost
    assert error(found, replace(truth, centers_w=centers_w)) < 5e-3
    assert error(found, truth) > 0.01  # of both


@pytest.mark.parametrize("kernel", ["huber", "geman_mcclure", "none"])
@pytest.mark.parametrize("has_start", [False, True])
def test_gradcheck(kernel: str, has_start: bool) -> None:
    """Of rays, weights and scale, with a wrong ray and large residuals."""
    truth = small_recording()
    truth.rays_w[3] = draw(9, 3)
    start = (truth.centers_w, truth.points_w) if has_start else None

    def positions(rays_w: Tensor, weights: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        options = {"weights": weights, "scale": scale, "kernel": kernel, "start": start}
        found = truth.positions(rays_w, **options, **CONVERGED)
        assert found.success
        return found.centers_w, found.points_w

    inputs = truth.rays_w, (0.3 * draw(6, len(truth.view))).exp(), torch.tensor(0.1).double()
    leaves = [x.clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(positions, leaves, eps=1e-6, atol=1e-6, rtol=1e-4, fast_mode=True)


def test_gradient_of_the_gradient() -> None:
    truth = small_recording(noise=0.02)

    def center(rays_w: Tensor) -> Tensor:
        return truth.positions(rays_w, **CONVERGED).centers_w[3]

    leaf = truth.rays_w.clone().requires_grad_()
    assert torch.autograd.gradgradcheck(center, leaf, eps=1e-6, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_other_backward_modes_are_near_the_exact_gradient() -> None:
    truth = small_recording(noise=1e-3)

    def gradient(backward: str) -> Tensor:
        leaf = truth.rays_w.clone().requires_grad_()
        found = truth.positions(leaf, kernel="none", backward=backward, **CONVERGED)
        return torch.autograd.grad(found.centers_w[3, 0], leaf)[0]

    exact = gradient("implicit")
    for backward in ("truncated", "unroll"):
        assert (gradient(backward) - exact).norm() < 0.05 * exact.norm()
    assert not truth.positions(truth.rays_w.requires_grad_(), backward="detached").centers_w.requires_grad


def test_wrong_rays_have_nearly_no_gradient() -> None:
    truth = make_recording(noise=1e-3, wrong=0.2)
    leaf = truth.rays_w.clone().requires_grad_()
    found = truth.positions(leaf, kernel="geman_mcclure", scale=0.01, iterations=300, tolerance=1e-12)
    (found.centers_w * draw(7, *found.centers_w.shape)).sum().backward()
    sizes = leaf.grad.norm(dim=-1)
    is_wrong = truth.is_wrong & (found.angles > 0.2)
    assert sizes[is_wrong].median() < 1e-3 * sizes[~truth.is_wrong].median()


def test_order_of_rays_does_not_change_a_bit() -> None:
    """Also of two rays from one view to one point."""
    truth = make_recording(noise=1e-3, wrong=0.2)
    twice = torch.cat((torch.arange(len(truth.view)), torch.tensor([0, 0, 7])))
    rays_w = truth.rays_w[twice]
    rays_w[-3:] += 0.01 * draw(4, 3, 3)
    order = torch.randperm(len(twice), generator=torch.Generator().manual_seed(3))
    counts = len(truth.centers_w), len(truth.points_w)
    plain = solve_positions(truth.view[twice], truth.point[twice], rays_w, *counts)
    other = solve_positions(truth.view[twice][order], truth.point[twice][order], rays_w[order], *counts)
    assert torch.equal(other.centers_w, plain.centers_w)
    assert torch.equal(other.points_w, plain.points_w)
    assert torch.equal(other.angles, plain.angles[order])


def test_turning_the_world_turns_the_result() -> None:
    truth = make_recording(noise=1e-3, wrong=0.1)
    turn = torch.linalg.qr(draw(3, 3, 3))[0]
    start = truth.centers_w, truth.points_w
    plain = truth.positions(start=start, **CONVERGED)
    turned = truth.positions(truth.rays_w @ turn, start=(start[0] @ turn, start[1] @ turn), **CONVERGED)
    torch.testing.assert_close(turned.centers_w, plain.centers_w @ turn, rtol=0, atol=1e-7)


def test_only_the_largest_component_is_positioned() -> None:
    """Views 0 ... 4 see points of their own; view 35 sees one point, and view 36 nothing."""
    small, large = make_recording(views=5, points=50), make_recording(seed=1)
    view = torch.cat((small.view, large.view + 5, torch.tensor([35])))
    point = torch.cat((small.point, large.point + 50, torch.tensor([50 + int(large.point[0])])))
    rays_w = torch.cat((small.rays_w, large.rays_w, draw(0, 1, 3))).requires_grad_()
    found = solve_positions(view, point, rays_w, 37, 250)
    assert found.success
    assert found.component.tolist() == [0] * 5 + [5] * 31 + [36]
    assert found.determined.tolist() == [False] * 5 + [True] * 30 + [False] * 2
    assert (found.centers_w[~found.determined] == 0).all()
    assert torch.isinf(found.angles[: len(small.view)]).all()
    assert torch.isinf(found.angles[-1])
    torch.testing.assert_close(found.centers_w[5:35], large.positions().centers_w, rtol=0, atol=1e-9)
    (found.centers_w * draw(2, 37, 3)).sum().backward()
    assert torch.isfinite(rays_w.grad).all()
    assert (rays_w.grad[: len(small.view)] == 0).all()
    assert rays_w.grad[len(small.view) : -1].any()


def straight_walk() -> Recording:
    """Views on a line; each two in turn see points that no other view sees, which tell no ratio of distances."""
    centers_w = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2.5, 0, 0], [3, 0, 0]]).double()
    points_w = draw(0, 24, 3) + torch.tensor([1.5, 0.0, 6.0])
    point = torch.arange(24).repeat(2)
    view = point // 8 + torch.arange(2).repeat_interleave(24)
    rays_w = points_w[point] - centers_w[view]
    return Recording(centers_w, points_w, view, point, rays_w, torch.zeros(48, dtype=torch.bool))


def camera_that_turns() -> Recording:
    return record(draw(0, 1, 3).expand(8, 3), draw(1, 40, 3) + torch.tensor([0.0, 0.0, 5.0]))


@pytest.mark.parametrize(
    ("make", "has_start"), [(straight_walk, False), (straight_walk, True), (camera_that_turns, False)]
)
def test_what_rays_do_not_determine_is_flagged_and_stays(make: Any, has_start: bool) -> None:
    truth = make()
    start = (truth.centers_w + 0.01 * draw(5, *truth.centers_w.shape), truth.points_w) if has_start else None
    rays_w = truth.rays_w.clone().requires_grad_()
    found = truth.positions(rays_w, start=start)
    assert not found.success
    assert not found.determined.any()
    assert (found.component == 0).all()
    assert torch.isinf(found.angles).all()
    for positions, before in zip((found.centers_w, found.points_w), start or (0.0, 0.0), strict=True):
        assert (positions == before).all()
    (found.centers_w.sum() + found.points_w.sum()).backward()
    assert (rays_w.grad == 0).all()


@pytest.mark.parametrize("backward", ["implicit", "unroll", "truncated", "detached"])
def test_no_rays_determine_nothing(backward: str) -> None:
    none = torch.zeros(0, dtype=torch.int64)
    rays_w = torch.zeros(0, 3, dtype=torch.float64, requires_grad=True)
    found = solve_positions(none, none, rays_w, 2, 3, options=POSITION_OPTIONS.replace(backward=backward))
    assert torch.equal(found.centers_w, torch.zeros(2, 3, dtype=torch.float64))
    assert found.component.tolist() == [0, 1]
    assert not found.success


def test_rays_that_do_not_count_change_nothing() -> None:
    truth = make_recording(noise=1e-3)
    plain = truth.positions()
    bad = torch.zeros(4, 3, dtype=torch.float64)
    bad[0, 0], bad[2:] = torch.nan, 1.0
    rays_w = torch.cat((truth.rays_w, bad)).requires_grad_()
    weights = torch.ones(len(rays_w), dtype=torch.float64)
    weights[-2:] = torch.tensor([0.0, torch.inf])
    found = solve_positions(
        torch.cat((truth.view, torch.zeros(4).long())),
        torch.cat((truth.point, torch.zeros(4).long())),
        rays_w,
        30,
        200,
        weights.requires_grad_(),
    )
    assert torch.equal(found.centers_w, plain.centers_w)
    assert torch.isinf(found.angles[-4:]).all()
    found.centers_w[5, 0].backward()
    for gradient in (rays_w.grad, weights.grad):
        assert torch.isfinite(gradient).all()
        assert (gradient[-4:] == 0).all()


def test_what_has_no_finite_start_is_left_out() -> None:
    truth = make_recording()
    start = truth.centers_w.clone(), truth.points_w
    start[0][4] = torch.nan
    found = truth.positions(start=start)
    assert found.success
    assert found.component.tolist() == [0] * 4 + [4] + [0] * 25
    assert found.determined.tolist() == [view != 4 for view in range(30)]
    assert torch.isinf(found.angles[truth.view == 4]).all()


def test_dtype_and_device_come_from_the_inputs(dtype: torch.dtype, device: torch.device) -> None:
    """The result for the rays of float32 is that of float64."""
    truth = make_recording(noise=1e-3, wrong=0.1)
    rays_w, counts = truth.rays_w.to(device, dtype), (30, 200)
    found = solve_positions(truth.view.to(device), truth.point.to(device), rays_w, *counts)
    for tensor in (found.centers_w, found.points_w, found.angles):
        assert tensor.dtype == dtype
        assert tensor.device.type == device.type
    expected = truth.positions(truth.rays_w.to(dtype).double())
    tolerance = {"rtol": 1e-6, "atol": 1e-6} if device.type == "cpu" else {"rtol": 1e-3, "atol": 1e-3}
    torch.testing.assert_close(found.centers_w.cpu().double(), expected.centers_w, **tolerance)


@pytest.mark.usefixtures("without_shape_checks")
def test_invalid_input_is_rejected_by_name() -> None:
    truth = small_recording()
    view, point, rays_w, counts = truth.view, truth.point, truth.rays_w, (5, 16)
    start = truth.centers_w, truth.points_w
    with pytest.raises(ValueError, match=r"^rays_w must be \(O, 3\)"):
        solve_positions(view, point, rays_w[:, :2], *counts)
    with pytest.raises(ValueError, match=r"_index must be \(O,\)"):
        solve_positions(view[1:], point, rays_w, *counts)
    with pytest.raises(ValueError, match=r"^point_index must be"):
        solve_positions(view, point[:, None], rays_w, *counts)
    with pytest.raises(ValueError, match=r"^weights must be"):
        truth.positions(weights=torch.ones(3).double())
    with pytest.raises(ValueError, match=r"^start centers must be"):
        truth.positions(start=(start[0][1:], start[1]))
    with pytest.raises(ValueError, match=r"^start points must be"):
        truth.positions(start=(start[0], start[1][1:]))
    with pytest.raises(ValueError, match=r"^view_index must lie in 0 \.\.\. 3$"):
        solve_positions(view, point, rays_w, 4, 16)
    with pytest.raises(ValueError, match=r"^point_index must lie in 0 \.\.\. 15$"):
        solve_positions(view, point - 1, rays_w, *counts)
    with pytest.raises(ValueError, match=r"^num_points must be positive"):
        solve_positions(view[:0], point[:0], rays_w[:0], 5, 0)
    with pytest.raises(ValueError, match="float32"):
        truth.positions(weights=torch.ones(len(view)))
    with pytest.raises(ValueError, match=r"^scale must be positive"):
        truth.positions(scale=0.0)
    with pytest.raises(ValueError, match="'exact'"):
        truth.positions(backward="exact")
    with pytest.raises(ValueError, match="'l2'"):
        truth.positions(kernel="l2")
