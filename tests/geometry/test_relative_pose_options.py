"""Threshold, model, kernel and weights of `estimate_relative_pose`."""

from dataclasses import replace

import pytest
import torch
from geometry_scenes import CAMERA, Scene, direction_error, rotation_error, two_views

from torchslam.geometry import RelativePose, estimate_relative_pose, so3_exp
from torchslam.geometry.motion_models import Fits, PlaneMotions, goes_both_ways, plane_holds
from torchslam.geometry.robust import Kernel
from torchslam.geometry.two_view import TwoViews, ahead_and_parallax, best_in_front, possible_matches, twisted

THRESHOLDS = (0.5, 1.0, 2.0, 4.0, 8.0)


def estimate(scene: Scene, threshold: float = 1.0, **options: object) -> RelativePose:
    return estimate_relative_pose(
        scene.pixels_1, scene.pixels_2, camera_1=CAMERA, camera_2=CAMERA, threshold=threshold, **options
    )


def errors(result: RelativePose, scene: Scene) -> tuple[float, float]:
    """Degrees."""
    T, T_true = result.T_21, scene.T_21
    return (
        float(rotation_error(T[:, :3, :3], T_true[:, :3, :3])),
        float(direction_error(T[:, :3, 3], T_true[:, :3, 3])),
    )


@pytest.mark.parametrize("threshold", THRESHOLDS)
def test_the_threshold_hardly_matters(threshold: float) -> None:
    for seed in range(3):
        scene = two_views(seed, noise=0.4)
        result, usual = estimate(scene, threshold), estimate(scene)
        assert result.success.all()
        assert result.model == ("essential",)
        rotation, direction = errors(result, scene)
        assert rotation < 0.5
        assert direction < 3
        # The minimum goes by the level of the noise, not by the threshold.
        torch.testing.assert_close(result.T_21, usual.T_21, atol=1e-2, rtol=0)


@pytest.mark.parametrize("threshold", [2.0, 4.0])
def test_little_parallax_is_neither_plane_nor_rotation_under_a_large_threshold(threshold: float) -> None:
    by_threshold = []
    for seed in range(3):
        scene = two_views(seed, noise=0.2, baseline=0.06)
        result = estimate(scene, threshold)
        assert result.success.all()
        assert result.model == ("essential",)
        assert errors(result, scene)[1] < 12
        by_threshold += estimate(scene, threshold, kernel="truncated").model
    assert by_threshold.count("essential") < 3


@pytest.mark.parametrize("threshold", [0.5, 2.0, 4.0])
def test_planes_and_rotations_are_known_under_any_threshold(threshold: float) -> None:
    for seed in range(4):
        assert estimate(two_views(seed, plane=True), threshold).model == ("homography",)
        rotation = estimate(two_views(seed, baseline=0.0), threshold)
        assert rotation.model == ("rotation",)
        assert not rotation.success.any()


def test_few_matches_do_not_hide_a_plane_or_a_rotation() -> None:
    """Of few, an essential matrix fits many by accident: what it gains has to be more than that."""
    planes: list[str] = []
    rotations: list[str] = []
    for threshold in (0.5, 4.0):
        for seed in range(6):
            planes += estimate(two_views(seed, plane=True, count=30), threshold).model
            rotations += estimate(two_views(seed, baseline=0.0, count=30), threshold).model
    # Nine of the thirty are wrong: once in a while the others do not tell.
    assert planes.count("homography") >= 8
    assert planes.count("essential") <= 1
    assert rotations.count("rotation") >= 11


def test_heavy_tailed_noise_is_no_parallax() -> None:
    """Matches a few pixels off a pure rotation lie near some epipolar line by accident, wherever it is put."""
    for count in (100, 400):
        for seed in range(6):
            turned = two_views(seed, count=count, baseline=0.0, noise=0.4, outliers=0.1)
            generator = torch.Generator().manual_seed(seed)
            wide = torch.rand(1, count, 1, generator=generator, dtype=torch.float64) < 0.25
            tail = 2.5 * wide * torch.randn(1, count, 2, generator=generator, dtype=torch.float64)
            result = estimate(replace(turned, pixels_2=turned.pixels_2 + tail))
            assert result.model == ("rotation",)
            assert not result.success.any()


def along_edges(scene: Scene, seed: int, deviation: float) -> Scene:
    """The same with more noise along horizontal edges, so many deviations, pixels, of it in either image."""
    generator = torch.Generator().manual_seed(seed)
    sides = deviation * torch.randn(2, *scene.mask.shape, generator=generator, dtype=torch.float64)
    level = torch.tensor([1.0, 0.0], dtype=torch.float64)
    pixels = (side[..., None] * level for side in sides)
    return replace(scene, pixels_1=scene.pixels_1 + next(pixels), pixels_2=scene.pixels_2 + next(pixels))


def test_noise_along_edges_is_no_parallax() -> None:
    """It lies along epipolar lines by its size, but on both sides of where a match without parallax is."""
    for count, deviation in ((400, 1.0), (800, 0.75)):
        for seed in range(6):
            turned = two_views(seed, count=count, baseline=0.0, outliers=0.1)
            result = estimate(along_edges(turned, seed, deviation))
            assert result.model == ("rotation",)
            assert not result.success.any()


def test_parallax_under_noise_along_edges_counts() -> None:
    """Where all of it is on one side, as large as the noise or not, it is a motion."""
    for seed in range(6):
        scene = two_views(seed, count=400, outliers=0.1, baseline=0.1)
        result = estimate(along_edges(scene, seed, 1.0))
        assert result.model == ("essential",)
        assert result.success.all()


@pytest.mark.parametrize(
    ("moved", "behind", "pixels", "expected"),
    [(0.4, 0.2, 5.0, True), (0.4, 0.05, 5.0, False), (0.6, 0.2, 5.0, False), (0.4, 0.2, 3.5, False)],
)
def test_clear_parallax_on_both_sides_of_a_rotation_is_noise(
    moved: float, behind: float, pixels: float, expected: bool
) -> None:
    """A tenth may lie behind the cameras; all may, where no rotation explains most matches, or within the noise."""
    generator = torch.Generator().manual_seed(0)
    pixels_1 = torch.rand(1, 200, 2, generator=generator, dtype=torch.float64) * 160 + 160
    count = round(200 * moved)
    side = torch.zeros(200, dtype=torch.float64)
    side[:count] = torch.where(torch.arange(count) < behind * count, -1.0, 1.0)
    pixels_2 = pixels_1 + pixels * side[:, None] * torch.tensor([1.0, 0.0], dtype=torch.float64)
    views = TwoViews.of(pixels_1, pixels_2, CAMERA, CAMERA, 1.0, side.new_ones(1, 200).bool(), None)
    R, t = torch.eye(3, dtype=torch.float64)[None], torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    fits = Fits(R, t, R, R, side.new_zeros(3, 1, 200)).with_mappings(views)
    assert bool(goes_both_ways(views, fits, side.new_ones(1))) == expected


def test_two_motions_of_a_plane_are_distinguished_beyond_noise() -> None:
    """Of eighty matches: a success is right, but for an essential matrix now and then."""
    right, wrong = 0, 0
    for seed in range(24):
        scene = two_views(seed, plane=True, count=80, noise=0.8)
        result = estimate(scene)
        if result.success.all():
            is_right = errors(result, scene)[1] < 20
            assert is_right or result.model == ("essential",)
            right, wrong = right + is_right, wrong + (not is_right)
        else:
            assert result.ambiguous.all()
    assert right >= 14
    assert wrong <= 1


@pytest.mark.parametrize("seed", range(4))
def test_cheirality_by_ray_products_equals_cheirality_by_depth(seed: int) -> None:
    scene = two_views(seed)
    views = TwoViews.of(scene.pixels_1, scene.pixels_2, CAMERA, CAMERA, 1.0, scene.mask, None)
    generator = torch.Generator().manual_seed(seed)
    R = so3_exp(0.2 * torch.randn(1, 3, 3, generator=generator, dtype=torch.float64))
    t = torch.nn.functional.normalize(torch.randn(1, 3, 3, generator=generator, dtype=torch.float64), dim=-1)
    found = possible_matches(views, R, t)
    for row in range(3):
        ahead, parallax = ahead_and_parallax(views, *twisted(R[:, row], t[:, row]))
        assert torch.equal(found[:, row], ahead | (parallax < 1))


@pytest.mark.parametrize("threshold", [0.5, 2.0, 4.0])
def test_parallax_that_no_match_shows_alone_counts(threshold: float) -> None:
    """A pixel of noise, and one to two of parallax: hardly a match is clearly off, but all of them together are."""
    off = []
    for seed in range(4):
        scene = two_views(seed, noise=1.0, baseline=0.06)
        result = estimate(scene, threshold)
        assert result.model == ("essential",)
        assert result.success.all()
        off.append(errors(result, scene)[1])
    assert sorted(off)[2] < 12


@pytest.mark.parametrize(("num_outside", "holds"), [(2, True), (3, False)])
def test_few_matches_far_from_the_motions_of_a_plane_contradict_it(num_outside: int, holds: bool) -> None:
    """Of forty. Each counts as much as three deviations, so three of them are more than the gain of a fit."""
    scene = two_views(0, count=40)
    everything = torch.ones(1, 40, dtype=torch.bool)
    views = TwoViews.of(scene.pixels_1, scene.pixels_2, CAMERA, CAMERA, 1.0, everything, None)
    R, t = scene.T_21[:, :3, :3], scene.T_21[:, :3, 3]
    # Medians of the squares of Gaussian noise of variance one, in one coordinate and, in units of 1.5, in two.
    level = torch.tensor([0.6745**2, 1.3863 / 2.25, 100.0], dtype=torch.float64)
    fits = Fits(R, t, R, R, level[:, None, None].expand(3, 1, 40))
    of_motion = torch.where(torch.arange(40) < num_outside, 100.0, level[0]).expand(1, 4, 40)
    possible = torch.ones(1, 4, dtype=torch.bool)
    four = R[:, None].expand(1, 4, 3, 3), t[:, None].expand(1, 4, 3), t[:, None].expand(1, 4, 3)
    assert bool(plane_holds(views, fits, PlaneMotions(*four, of_motion, possible))) == holds


def test_few_exact_matches_are_significant_under_a_wide_threshold() -> None:
    """A dozen matches of twenty within four pixels may be chance; within the hundredth that they show, they are not."""
    for seed in range(3):
        scene = two_views(seed, count=20, outliers=0.4, noise=0.02)
        assert not estimate(scene, 4.0, kernel="truncated").success.any()
        result = estimate(scene, 4.0)
        assert result.success.all()
        assert result.model == ("essential",)
        assert max(errors(result, scene)) < 2


def test_the_other_elements_of_a_batch_do_not_matter() -> None:
    """A scene with depth keeps its pose and scores next to a plane, for which a homography is fitted."""

    def estimate_in_batch(other: Scene) -> RelativePose:
        sides = [(two_views(0).pixels_1, other.pixels_1), (two_views(0).pixels_2, other.pixels_2)]
        pixels = [torch.cat(side) for side in sides]
        return estimate_relative_pose(
            *pixels, camera_1=CAMERA, camera_2=CAMERA, min_samples=512, max_samples=512
        )

    plane, depth = estimate_in_batch(two_views(1, plane=True)), estimate_in_batch(two_views(3))
    assert plane.model == ("essential", "homography")
    assert depth.model == ("essential", "essential")
    for name in ("T_21", "score_essential", "score_homography", "score_rotation"):
        torch.testing.assert_close(getattr(plane, name)[0], getattr(depth, name)[0], rtol=1e-9, atol=1e-9)


def test_the_essential_matrix_of_a_plane_has_its_pose() -> None:
    """Where the matches in front of the cameras leave one of the two motions that explain a plane."""
    off = []
    for seed in range(8):
        scene = two_views(seed, plane=True, noise=0.05)
        if not estimate(scene).success.all():
            continue
        result = estimate(scene, model="essential")
        assert result.success.all()
        assert result.model == ("essential",)
        assert not result.ambiguous.any()
        off.append(max(errors(result, scene)))
    assert len(off) >= 3
    assert sum(error < 2 for error in off) >= len(off) - 1


def test_only_the_requested_model_is_fitted() -> None:
    scene = two_views(0)
    essential_only, free = estimate(scene, model="essential"), estimate(scene)
    assert torch.equal(essential_only.score_essential, free.score_essential)
    assert not essential_only.score_homography.any()
    assert not essential_only.score_rotation.any()
    assert torch.equal(essential_only.inliers, free.inliers)
    torch.testing.assert_close(essential_only.T_21, free.T_21)
    turned = two_views(0, baseline=0.0)
    result = estimate(turned, model="essential")
    assert errors(result, turned)[0] < 0.5
    torch.testing.assert_close(result.T_21[:, :3, 3].norm(dim=-1), torch.ones(1).double())


@pytest.mark.parametrize("kernel", ["cauchy", "geman_mcclure", "huber", "truncated"])
def test_every_kernel_finds_the_pose(kernel: Kernel) -> None:
    scene = two_views(0, outliers=0.1 if kernel == "huber" else 0.4)
    rotation, direction = errors(estimate(scene, kernel=kernel), scene)
    assert rotation < 0.5
    assert direction < 4


def test_a_match_of_zero_weight_is_ignored() -> None:
    scene = two_views(2)
    mask = torch.rand(1, 200, generator=torch.Generator().manual_seed(0)) < 0.7
    weights = mask.double()
    weights[0, (~mask[0]).nonzero()[0]] = torch.nan
    masked, weighted = estimate(scene, mask=mask), estimate(scene, weights=weights)
    assert torch.equal(masked.T_21, weighted.T_21)
    assert torch.equal(masked.inliers, weighted.inliers)


def test_weights_act_as_thresholds() -> None:
    scene = two_views(2)
    weights = torch.full((1, 200), 0.25, dtype=torch.float64)
    twice, weighted = estimate(scene, 2.0), estimate(scene, 1.0, weights=weights)
    torch.testing.assert_close(twice.T_21, weighted.T_21)
    torch.testing.assert_close(twice.score_essential, weighted.score_essential)
    assert torch.equal(twice.inliers, weighted.inliers)


def test_match_information_improves_the_pose() -> None:
    given, without = [], []
    for seed in range(8):
        scene = two_views(seed, noise=0.0)
        generator = torch.Generator().manual_seed(seed)
        sigmas = torch.where(torch.arange(200) % 4 == 0, 0.1, 2.0).double()[None]
        noisy = (
            pixels + sigmas[..., None] * torch.randn(1, 200, 2, generator=generator, dtype=torch.float64)
            for pixels in (scene.pixels_1, scene.pixels_2)
        )
        noisy_scene = Scene(*noisy, scene.points_1, scene.T_21, scene.mask)
        given.append(errors(estimate(noisy_scene, weights=sigmas**-2), scene)[1])
        without.append(errors(estimate(noisy_scene), scene)[1])
    assert sum(given) < 0.6 * sum(without)


def test_points_behind_a_camera_are_no_inliers() -> None:
    scene = two_views(0, noise=0.0, outliers=0.0)
    views = TwoViews.of(scene.pixels_1, scene.pixels_2, CAMERA, CAMERA, 1.0, scene.mask, None)
    R, t = scene.T_21[:, :3, :3], scene.T_21[:, :3, 3] / scene.T_21[:, :3, 3].norm()
    wrong = twisted(R, t)
    for row in range(4):
        R_best, t_best, cost = best_in_front(views, wrong[0][:, row : row + 1], wrong[1][:, row : row + 1])
        torch.testing.assert_close(R_best[:, 0], R)
        torch.testing.assert_close(t_best[:, 0], t)
        assert float(cost) < 1e-6
    half = torch.arange(200) % 2 == 0
    # On the epipolar lines of a pure translation, half of them displaced to the wrong side.
    sideways = torch.eye(3, dtype=torch.float64)[None, None], torch.tensor([[[1.0, 0.0, 0.0]]]).double()
    level = TwoViews(
        views.x_1,
        views.x_1 + torch.where(half[:, None], 0.1, -0.1) * torch.tensor([1.0, 0.0], dtype=torch.float64),
        views.scale_1,
        views.scale_2,
        views.mask,
    )
    assert float(best_in_front(level, *sideways)[2]) == pytest.approx(100, abs=1e-6)


@pytest.mark.usefixtures("without_shape_checks")
def test_invalid_options_are_rejected_by_name() -> None:
    scene = two_views(0)
    with pytest.raises(ValueError, match="unknown model 'plane'; known are auto, essential"):
        estimate(scene, model="plane")
    with pytest.raises(ValueError, match="unknown kernel 'tukey'"):
        estimate(scene, kernel="tukey")
    with pytest.raises(ValueError, match=r"weights must be \(B, N\) = \(1, 200\), not \(200,\)"):
        estimate(scene, weights=torch.ones(200).double())


def test_a_rejected_model_keeps_its_essential_matrix() -> None:
    """On a plane, too, whose two motions are the reason to refuse it: one of them."""
    for seed in range(4):
        scene = two_views(seed, plane=True)
        result, essential_only = estimate(scene), estimate(scene, model="essential")
        assert result.model == ("homography",)
        torch.testing.assert_close(result.T_21_essential, essential_only.T_21, rtol=0.0, atol=1e-6)
        assert torch.equal(essential_only.T_21_essential, essential_only.T_21)
    turned = estimate(two_views(0, baseline=0.0))
    assert not turned.T_21[0, :3, 3].any()
    assert turned.T_21_essential[0, :3, 3].norm().item() == pytest.approx(1)
