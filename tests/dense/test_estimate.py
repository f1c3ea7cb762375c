"""Depth from views with known poses: a slanted plane of exact depth, gradients, batches and devices."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.dense.slanted_plane import FAR, NEAR, NORMAL, a_camera, depth_of, poses, scene
from torchslam.dense.consistency import (
    as_seen_by,
    confidence_alone,
    confidence_together,
    depth_normals,
    kept,
    merge,
    render,
)
from torchslam.dense.cost_volume import (
    STD_FACTOR,
    box_sum,
    correlation,
    find_minimum,
    matching_cost,
    position_std,
    semi_global,
    warp,
)
from torchslam.dense.estimate import (
    RADIUS,
    choose_neighbors,
    estimate_depth,
    halved,
    neighbor_scores,
    refine_depth,
)
from torchslam.geometry import Camera, se3_exp, se3_inverse

WIDTH, HEIGHT = 192, 144
BORDER = 36


def limits(count: int = 1, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    return torch.full((count,), NEAR, dtype=dtype), torch.full((count,), FAR, dtype=dtype)


def inside(values: Tensor) -> Tensor:
    return values[..., BORDER:-BORDER, BORDER:-BORDER]


def test_the_depth_of_a_slanted_plane(device: torch.device, dtype: torch.dtype) -> None:
    if device.type == "sim" and dtype == torch.float64:
        pytest.skip("tried in single precision")
    reference, sources, camera, T_sr, depth = scene(WIDTH, HEIGHT)
    near, far = limits(dtype=dtype)
    found = estimate_depth(
        reference[None].to(device, dtype),
        sources[None].to(device, dtype),
        camera.to(device),
        T_sr[None].to(device),
        near.to(device),
        far.to(device),
    )
    assert found.inverse_depth.dtype == dtype
    error = inside((1 / found.inverse_depth[0].cpu()) / depth - 1).abs()
    assert float(error.median()) < 4e-3
    assert float((error < 0.02).double().mean()) > 0.95
    confidence = inside(confidence_alone(found).cpu())
    assert float(confidence.median()) > 0.8


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_the_standard_deviation_of_depth_grows_with_the_noise_of_the_images(noise: float) -> None:
    reference, sources, camera, T_sr, depth = scene(WIDTH, HEIGHT)
    generator = torch.Generator().manual_seed(0)
    reference = reference + noise * torch.randn(reference.shape, generator=generator)
    sources = sources + noise * torch.randn(sources.shape, generator=generator)
    found = estimate_depth(reference[None].float(), sources[None].float(), camera, T_sr[None], *limits())
    assert bool((found.std > 0).all())
    ratio = inside((found.inverse_depth[0] - 1 / depth) / found.std[0]).abs()
    assert 0.4 < float(ratio.median()) / 0.6745 < 1.6  # the median of a Gaussian's absolute value


def test_the_standard_deviation_of_a_known_minimum() -> None:
    found = find_minimum(torch.tensor([0.5, 0.12, 0.04, 0.12, 0.5], dtype=torch.float64)[:, None, None])
    assert float(found.curvature) == pytest.approx(0.16)
    assert float(position_std(found)) == pytest.approx(STD_FACTOR * 0.5)  # the root of 0.04 over 0.16


def test_a_flat_cost_has_no_position() -> None:
    flat = find_minimum(torch.ones(5, 2, 2))
    assert bool(torch.isinf(position_std(flat)).all())


def test_samples_at_the_true_depth_are_the_reference(dtype: torch.dtype) -> None:
    reference, sources, camera, T_sr, depth = scene(WIDTH, HEIGHT)
    samples, is_seen = warp(sources.to(dtype), camera, T_sr, (1 / depth[None]).to(dtype))
    assert is_seen[:, 0].double().mean() > 0.7
    wrong = (samples[:, 0] - reference)[is_seen[:, 0]].abs()
    assert float(wrong.max()) < 0.03  # of linear interpolation
    true, wrong = matching_cost(
        reference, sources, camera, T_sr, torch.stack((1 / depth, 1.03 / depth)), 3, 2
    )
    assert float(inside(true).median()) < 0.02
    assert float(inside(true < wrong).double().mean()) > 0.95


def test_behind_a_camera_nothing_is_seen() -> None:
    _, sources, camera, T_sr, _ = scene(WIDTH, HEIGHT, 1)
    behind = T_sr.clone()
    behind[:, 2, 3] = -10.0
    samples, is_seen = warp(sources, camera, behind, torch.full((1, HEIGHT, WIDTH), 0.5, dtype=torch.float64))
    assert not is_seen.any()
    assert torch.isfinite(samples).all()


@given(radius=st.integers(0, 3), height=st.integers(4, 9), width=st.integers(4, 9), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_box_sums_are_those_of_a_convolution(radius: int, height: int, width: int, seed: int) -> None:
    images = torch.rand(2, height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    kernel = torch.ones(1, 1, 2 * radius + 1, 2 * radius + 1, dtype=torch.float64)
    expected = torch.nn.functional.conv2d(images[:, None], kernel, padding=radius)[:, 0]
    torch.testing.assert_close(box_sum(images, radius), expected)


@given(gain=st.floats(0.5, 3), offset=st.floats(-1, 1))
@settings(max_examples=20, deadline=None)
def test_correlation_does_not_see_a_change_of_light(gain: float, offset: float) -> None:
    image = torch.rand(12, 14, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = correlation(image, gain * image + offset, 2)
    assert float(found.min()) > 0.99
    assert float(found.max()) <= 1
    assert float(correlation(image, -image, 2).max()) < -0.99


@given(at=st.floats(1, 6), curvature=st.floats(0.1, 2))
@settings(max_examples=30, deadline=None)
def test_the_minimum_of_a_parabola_is_found_between_hypotheses(at: float, curvature: float) -> None:
    position = torch.arange(8, dtype=torch.float64)[:, None, None]
    found = find_minimum(0.5 * curvature * (position - at) ** 2)
    assert float(found.position) == pytest.approx(at)
    assert float(found.curvature) == pytest.approx(curvature)
    assert float(found.margin) > 0


def test_aggregation_fills_what_has_no_information() -> None:
    """A surface at plane 5 with a patch without texture: the cost there is that of no correlation."""
    cost = torch.ones(12, 20, 24)
    cost[5] = 0.1
    cost[:, 6:12, 8:14] = 1.0
    image = torch.full((20, 24), 0.5)
    assert (find_minimum(semi_global(cost, image)).position.round() == 5).all()


def test_an_edge_of_the_image_lets_depth_jump() -> None:
    cost = torch.ones(12, 20, 24)
    cost[3, :, :12] = cost[9, :, 12:] = 0.5
    image = torch.zeros(20, 24)
    image[:, 12:] = 1.0
    position = find_minimum(semi_global(cost, image)).position.round()
    assert (position[:, :12] == 3).all()
    assert (position[:, 12:] == 9).all()


def test_aggregation_does_not_depend_on_the_direction() -> None:
    cost = torch.rand(6, 9, 11, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    image = torch.rand(9, 11, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    found = semi_global(cost, image)
    for dims in ((-1,), (-2,), (-1, -2)):
        torch.testing.assert_close(semi_global(cost.flip(dims), image.flip(dims)).flip(dims), found)
    torch.testing.assert_close(semi_global(cost.mT, image.mT).mT, found, atol=0.2, rtol=0.2)


def test_a_batch_is_a_loop() -> None:
    reference, sources, camera, T_sr, _ = scene(48, 40, 3)
    references = torch.stack((reference, reference.flip(0)))
    others = torch.stack((sources, sources.flip(1)))
    flip = torch.diag(torch.tensor([1.0, -1, 1, 1], dtype=torch.float64))
    transforms = torch.stack((T_sr, flip @ T_sr @ flip))
    near, far = torch.tensor([1.0, 1.2]).double(), torch.tensor([5.0, 6.0]).double()
    found = estimate_depth(references, others, camera, transforms, near, far, planes=16)
    for row in range(2):
        one = slice(row, row + 1)
        single = estimate_depth(
            references[one], others[one], camera, transforms[one], near[one], far[one], planes=16
        )
        torch.testing.assert_close(found.inverse_depth[one], single.inverse_depth)
        torch.testing.assert_close(found.fine.margin[one], single.fine.margin)


def test_gradients_of_costs_to_images_poses_camera_and_hypotheses() -> None:
    reference, sources, camera, T_sr, depth = scene(14, 12, 2)

    def cost(reference: Tensor, sources: Tensor, T_sr: Tensor, params: Tensor, hypotheses: Tensor) -> Tensor:
        found = matching_cost(reference, sources, camera.with_params(params), T_sr, hypotheses, 2, 2)
        return found[:, 4:8, 4:8]

    tensors = (reference, sources, T_sr, camera.params, 1.003 / depth[None])
    inputs = tuple(each.clone().requires_grad_() for each in tensors)
    assert torch.autograd.gradcheck(cost, inputs, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


def minimum(
    reference: Tensor, sources: Tensor, camera: Camera, T_sr: Tensor, surface: Tensor, step: float
) -> Tensor:
    """Inverse depth of the least cost of the windows around each pixel, near a surface, without hypotheses far off."""
    moves = torch.tensor([-1.0, 0, 1]).double()[:, None, None] * step
    for _ in range(2):
        cost = box_sum(matching_cost(reference, sources, camera, T_sr, surface + moves, RADIUS, 2), RADIUS)
        surface = surface + step * (0.5 * (cost[0] - cost[2]) / (cost[0] - 2 * cost[1] + cost[2]))
    return surface


@pytest.mark.parametrize("direction", ["all baselines", "one baseline", "turn", "focal length", "image"])
def test_the_gradient_of_depth_is_the_slope_of_the_minimum(direction: str) -> None:
    """Between pixels the cost is as bent as the interpolation, so that finite differences need steps of a pixel."""
    # What moves the minima of two sources against each other leaves none between.
    reference, sources, camera, T_sr, depth = scene(WIDTH, HEIGHT, 2 if "baseline" in direction else 1)
    views, translation, focal = torch.zeros(len(sources)).double(), torch.zeros(4, 4).double(), torch.zeros(4)
    views[: 1 if direction == "one baseline" else None] = 1
    translation[:3, 3], focal[:2] = 1, 1
    turn = torch.tensor([0, 0, 0, 0, 0.2, 0]).double()

    def moved(s: Tensor) -> tuple[Tensor, Camera, Tensor]:
        poses, params, images = T_sr, camera.params, sources
        if "baseline" in direction:
            poses = T_sr * (1 + s * views[:, None, None] * translation)
        elif direction == "turn":
            poses = se3_exp(s * turn) @ T_sr
        elif direction == "focal length":
            params = params * (1 + s * focal)
        else:
            images = sources + 10 * s * (sources.roll(1, -1) - sources)
        return images, camera.with_params(params), poses

    s = torch.zeros((), dtype=torch.float64, requires_grad=True)
    surface, step, least = 1 / depth, torch.tensor([0.01]).double(), torch.tensor([0.1]).double()
    images, pinhole, poses = moved(s)
    found, _ = refine_depth(reference[None], images[None], pinhole, poses[None], surface[None], step, least)
    places = [(row, column) for row in range(40, 104, 20) for column in range(50, 142, 30)]
    slopes = torch.stack([torch.autograd.grad(found[0][at], s, retain_graph=True)[0] for at in places])
    ahead, behind = (
        minimum(reference, *moved(torch.tensor(x).double()), surface, 0.01) for x in (0.01, -0.01)
    )
    expected = torch.stack([((ahead - behind) / 0.02)[at] for at in places])
    torch.testing.assert_close(slopes, expected, rtol=0.15, atol=0.1 * float(expected.abs().median()))
    if direction == "all baselines":
        exact = -torch.stack([surface[at] for at in places])
        torch.testing.assert_close(slopes, exact, rtol=0.01, atol=0)


def test_brightness_and_contrast_do_not_move_depth() -> None:
    reference, sources, camera, T_sr, _ = scene(WIDTH, HEIGHT, 2)
    reference, sources = reference.requires_grad_(), sources.requires_grad_()
    found = estimate_depth(
        reference[None], sources[None], camera, T_sr[None], *limits(dtype=torch.float64), planes=16
    )
    for image, gradient in zip(
        (reference, sources),
        torch.autograd.grad(found.inverse_depth.sum(), (reference, sources)),
        strict=True,
    ):
        assert gradient.abs().max() > 0
        assert abs(float(gradient.sum())) < 1e-6 * float(gradient.abs().sum())
        assert abs(float((gradient * image.detach()).sum())) < 0.01 * float(
            (gradient * image.detach()).abs().sum()
        )


def test_the_gradient_of_depth_is_zero_without_texture_and_changes_no_value() -> None:
    reference, sources, camera, T_sr, _ = scene(48, 40, 2)
    T_sr = T_sr.requires_grad_()
    blank = torch.full_like(sources, 0.5)
    for images in (sources, blank):
        given = reference[None], images[None], camera
        near, far = limits(dtype=torch.float64)
        found = estimate_depth(*given, T_sr[None], near, far, planes=16)
        assert torch.equal(
            found.inverse_depth,
            estimate_depth(*given, T_sr.detach()[None], near, far, planes=16).inverse_depth,
        )
        (gradient,) = torch.autograd.grad(found.inverse_depth.sum(), T_sr)
        assert torch.isfinite(gradient).all()
        assert bool(gradient.any()) == (images is sources)


def test_parameters_of_the_aggregation_have_a_gradient_and_the_range_has_none() -> None:
    reference, sources, camera, T_sr, _ = scene(48, 40, 2)
    near, far = (each.requires_grad_() for each in limits(dtype=torch.float64))
    weight = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)

    def aggregate(cost: Tensor, image: Tensor) -> Tensor:
        return cost + weight * box_sum(cost, 1)

    found = estimate_depth(
        reference[None], sources[None], camera, T_sr[None], near, far, planes=16, aggregate=aggregate
    )
    found.inverse_depth.sum().backward()
    assert weight.grad is not None
    assert weight.grad != 0
    assert not found.coarse.cost.requires_grad
    assert near.grad is None


def test_depth_has_no_second_derivative() -> None:
    reference, sources, camera, T_sr, _ = scene(48, 40, 2)
    T_sr = T_sr.requires_grad_()
    near, far = limits(dtype=torch.float64)
    found = estimate_depth(reference[None], sources[None], camera, T_sr[None], near, far, planes=16)
    (first,) = torch.autograd.grad(found.inverse_depth.sum(), T_sr, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivative"):
        first.sum().backward()


def test_the_halved_camera_sees_the_same_rays() -> None:
    camera = a_camera(WIDTH, HEIGHT)
    # The middle of the pixels 2 and 3 is the pixel 1 of the smaller image.
    wide = camera.normalize(torch.tensor([[2.5, 4.5]]).double())
    small = halved(camera).normalize(torch.tensor([[1.0, 2.0]]).double())
    torch.testing.assert_close(wide, small)


def test_normals_of_a_plane(device: torch.device) -> None:
    camera = a_camera(WIDTH, HEIGHT)
    depth = depth_of(torch.eye(4, dtype=torch.float64)[None], camera)
    depth[:, 20:30, 20:30] = 0
    found = depth_normals(depth.to(device), camera.to(device)).cpu()
    expected = torch.nn.functional.normalize(torch.tensor(NORMAL, dtype=torch.float64), dim=0)
    assert not found[:, :, 20:30, 20:30].any()
    is_known = (found != 0).any(1)
    assert is_known[depth > 0].all()
    torch.testing.assert_close(found.movedim(1, -1)[is_known], expected.expand(int(is_known.sum()), 3))


def test_normals_do_not_bend_at_an_edge() -> None:
    camera = a_camera(WIDTH, HEIGHT)
    depth = torch.full((1, HEIGHT, WIDTH), 1.0, dtype=torch.float64)
    depth[..., WIDTH // 2 :] = 2.0
    found = depth_normals(depth, camera)
    expected = torch.tensor([0.0, 0, -1], dtype=torch.float64)
    torch.testing.assert_close(found.movedim(1, -1), expected.expand(1, HEIGHT, WIDTH, 3))


def test_gradients_of_normals() -> None:
    camera = a_camera(10, 9)
    depth = depth_of(torch.eye(4, dtype=torch.float64)[None], camera)
    noise = 1 + 1e-3 * torch.rand(depth.shape, dtype=depth.dtype, generator=torch.Generator().manual_seed(0))
    inputs = ((depth * noise).requires_grad_(), camera.params.clone().requires_grad_())
    assert torch.autograd.gradcheck(
        lambda d, p: depth_normals(d, camera.with_params(p)), inputs, fast_mode=True
    )


def test_rendered_depth_is_that_of_the_other_view(device: torch.device) -> None:
    camera, T_sr = a_camera(WIDTH, HEIGHT), poses()
    own = 1 / depth_of(torch.eye(4, dtype=torch.float64)[None], camera)
    others = 1 / depth_of(T_sr, camera)
    rendered = render(others.to(device), camera.to(device), se3_inverse(T_sr).to(device))
    seen = as_seen_by(rendered, others.to(device), camera.to(device), T_sr.to(device)).cpu()
    is_known = seen > 0
    assert float(is_known.double().mean()) > 0.7
    wrong = (seen / own - 1)[is_known].abs()
    assert float(wrong.max()) < 5e-4
    # Rendered depth is that of a place up to a pixel away.
    assert float((rendered.cpu() / own - 1)[is_known].abs().max()) > 2e-3


def one_plane() -> tuple[Tensor, Tensor, Camera, Tensor]:
    camera, T_sr = a_camera(WIDTH, HEIGHT), poses()
    return (
        1 / depth_of(torch.eye(4, dtype=torch.float64)[None], camera)[0],
        1 / depth_of(T_sr, camera),
        camera,
        T_sr,
    )


def test_views_that_agree_outvote_the_own_depth() -> None:
    own, others, camera, T_sr = one_plane()
    certain = torch.full_like(own, 0.9)
    wrong = own.clone()
    wrong[30:40, 40:50] *= 1.5
    found = merge(wrong, certain, others, certain.expand(4, -1, -1), camera, T_sr)
    assert float(inside(found.inverse_depth / own - 1).abs().max()) < 1e-3
    assert not found.agrees[30:40, 40:50].any()
    assert inside(found.agrees).mean() > 0.9
    assert float(found.support[35, 45]) < float(found.support[35, 60])
    probability = confidence_together(found, certain)
    assert float(probability[35, 45]) < float(probability[35, 60])
    assert kept(probability)[20:50, 20:70].all()


def test_a_surface_in_front_is_a_conflict_and_one_behind_is_none() -> None:
    own, others, camera, T_sr = one_plane()
    certain, uncertain = torch.full_like(own, 0.9), torch.full((4, HEIGHT, WIDTH), 0.01, dtype=torch.float64)
    for factor, least, most in ((1.5, 0.02, 0.05), (0.6, 0.0, 0.0)):
        found = merge(own, certain, factor * others, uncertain, camera, T_sr)
        assert least <= float(found.conflicts[36, 48]) <= most
        torch.testing.assert_close(found.inverse_depth[36, 48], own[36, 48])


def test_views_without_depth_give_none() -> None:
    own, others, camera, T_sr = one_plane()
    zero = torch.zeros_like(own)
    found = merge(zero, zero, torch.zeros_like(others), torch.zeros_like(others), camera, T_sr)
    assert not found.inverse_depth.any()
    assert not confidence_together(found, zero).any()


def test_specks_are_not_kept() -> None:
    confidence = torch.zeros(20, 20)
    confidence[3, 3] = 1.0
    confidence[8:16, 8:16] = 1.0
    found = kept(confidence)
    assert not found[3, 3]
    assert found[9:15, 9:15].all()


def test_neighbors_share_points_and_have_parallax() -> None:
    points_w = torch.tensor([0.0, 0, 10]).double() + torch.rand(
        20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    shared = torch.ones(4, 20, dtype=torch.bool)
    shared[3, 4:] = False
    # The same place, a parallax of about 5 degrees, one of 45, and one of 5 that shares too few points.
    centers_w = torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [10, 0, 0], [0.9, 0, 0]]).double()
    scores = neighbor_scores(points_w, shared, torch.zeros(3).double(), centers_w)
    assert float(scores[1]) > 15
    assert float(scores[[0, 2]].max()) < 0.1
    assert float(scores[3]) == 0
    order, is_there = choose_neighbors(torch.tensor([1.0, 3, 3, 0]), 4)
    assert order.tolist() == [1, 2, 0, 3]
    assert is_there.tolist() == [True, True, True, False]
