"""What stretches of a recording say about its camera: slopes of the cost, errors at their rate, agreement."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchslam.geometry import Camera, se3_exp, transform
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.optim import GRAPH_OPTIONS, BundleProblem, solve_bundle
from torchslam.optim.bundle._scores import camera_scores
from torchslam.optim.model_choice import LEAST_GAIN, LEAST_UPDATE
from torchslam.optim.sensor_estimate import (
    STRETCH_FRAMES,
    USUAL_FACTOR,
    USUAL_STRETCHES,
    CameraEvidence,
    camera_evidence,
)

TRUTH = Camera.radial_tangential(400.0, 404.0, 320.0, 240.0, -0.05, 0.02, 0.0, 0.0, size=(640, 480))
OPTIONS = GRAPH_OPTIONS.replace(backward="detached", tolerance=1e-12)


def walk(seed: int, noise: float = 0.5, frames: int = 24, camera: Camera = TRUTH) -> BundleProblem:
    """Frames that pass by points, of which each is seen by a few in a row, at the true poses and points."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    twists = 0.05 * normal(frames, 6)
    twists[:, 0] -= torch.linspace(0, 8, frames, dtype=torch.float64)
    T_cw = se3_exp(twists)
    points_w = torch.stack((4 + 3.5 * normal(300), 1.5 * normal(300), 4 + normal(300).clamp(-2, 2)), -1)
    frame, point = torch.ones(frames, len(points_w)).nonzero().unbind(-1)
    points_c = transform(T_cw[frame], points_w[point][:, None])
    pixels, valid = (part[:, 0] for part in camera.project(points_c))
    seen = valid & camera.in_image(pixels) & (points_c[:, 0, 2] > 0.5)
    pixels = pixels + noise * normal(*pixels.shape)
    return BundleProblem(T_cw, points_w, frame[seen], point[seen], pixels[seen], camera)


def solved(problem: BundleProblem, given: CameraMeasurement | None = None) -> BundleProblem:
    """The problem at its minimum, the camera free along the directions of a given one, without a prior."""
    free = False if given is None else given.directions
    found = solve_bundle(problem, free_camera=free, check=False, options=OPTIONS)
    return replace(problem, T_cw=found.T_cw, points_w=found.points_w, camera=found.camera)


def off_by(factor: float, std: float = 0.02) -> CameraMeasurement:
    params = TRUTH.params.clone()
    params[:2] *= factor
    return CameraMeasurement.of(TRUTH.with_params(params), std)


def evidence_of(problem: BundleProblem, given: CameraMeasurement) -> CameraEvidence:
    evidence = camera_evidence(solved(problem, given), given, OPTIONS)
    assert evidence is not None
    return evidence


def test_scores_are_the_slope_of_the_cost_where_frames_and_points_follow() -> None:
    given = off_by(1.0)
    problem = solved(walk(0, frames=8))  # with the true camera, which is not that of the minimum
    found = camera_scores(problem, given.directions, OPTIONS)
    assert found is not None

    def cost(step: Tensor) -> float:
        params = problem.camera.params + given.directions @ step
        moved = replace(problem, camera=problem.camera.with_params(params))
        return float(solve_bundle(moved, check=False, options=OPTIONS).cost)

    eps = 0.02 * torch.eye(3, dtype=torch.float64)
    slopes = torch.tensor([(cost(step) - cost(-step)) / 0.04 for step in eps], dtype=torch.float64)
    torch.testing.assert_close(found.scores.sum(0), -slopes, rtol=1e-3, atol=1e-3)
    curvatures = torch.tensor([(cost(s) - 2 * cost(0 * s) + cost(-s)) / 0.02**2 for s in eps]).double()
    torch.testing.assert_close(found.information.sum(0).diagonal(), curvatures, rtol=0.05, atol=0.0)


def test_steps_of_frames_and_points_change_no_score() -> None:
    """Points 0.1 px from their minimum change the camera's own slope, but not the scores."""
    given = off_by(1.0)
    problem = solved(walk(1, frames=8), given)
    generator = torch.Generator().manual_seed(0)
    off = 1e-3 * torch.randn(problem.points_w.shape, generator=generator, dtype=torch.float64)
    nudged = replace(problem, points_w=problem.points_w + off)
    one, other = (camera_scores(each, given.directions, OPTIONS) for each in (problem, nudged))
    assert one is not None
    assert other is not None
    error = one.information.sum(0).diagonal().sqrt()  # standard deviation of a score
    assert bool((one.scores - other.scores).norm(dim=0).max() > 0.01 * error.min())  # they did move
    assert float(((one.scores - other.scores).sum(0).abs() / error).max()) < 0.02


def whitened_errors(seeds: range, factor: float, shifted: float = 0.0) -> Tensor:
    """Errors of cameras over their stated ones; `shifted`: each quarter of a walk has another focal length."""
    given, found = off_by(factor), []
    for seed in seeds:
        problem = walk(seed)
        if shifted:
            generator = torch.Generator().manual_seed(seed)
            zoom = 1 + shifted * torch.randn(4, generator=generator, dtype=torch.float64)
            center = TRUTH.params[2:4]
            frames = len(problem.T_cw)
            zoom = (zoom - zoom.mean() + 1)[problem.frame_index * 4 // frames][:, None]
            problem = replace(problem, pixels=center + zoom * (problem.pixels - center))
        evidence = evidence_of(problem, given)
        estimate = evidence.estimate(3)
        off = torch.linalg.pinv(evidence.given.directions) @ (TRUTH.params - given.camera.params)
        found.append((estimate.step - off) / estimate.covariance.diagonal().sqrt())
    return torch.stack(found)


def test_errors_are_stated_at_their_rate_and_what_is_usual() -> None:
    """Independent errors of 24 frames: 8 stretches, and 3 that scatter by 4 times the formal error."""
    off = whitened_errors(range(30), 1.02)
    stretches = 24 // STRETCH_FRAMES
    usual = (USUAL_STRETCHES * USUAL_FACTOR**2 + stretches - 1) / (USUAL_STRETCHES + stretches - 1)
    size = usual**0.5 * off.square().mean(0).sqrt()
    torch.testing.assert_close(size, torch.ones_like(size), rtol=0.0, atol=0.25)  # of 30 errors each
    assert float(off.abs().max()) < 2


def test_errors_that_stretches_have_in_common_are_stated() -> None:
    """More than what the residuals grow by, which formal errors follow."""
    off = whitened_errors(range(12), 1.0, shifted=0.01).abs()
    assert float((off[:, 0] < 2).double().mean()) > 0.85
    given = off_by(1.0)
    plain = evidence_of(walk(0), given)
    problem = walk(0)
    zoom = 1 + 0.04 * torch.sin(problem.frame_index / 4)[:, None]
    wavy = replace(problem, pixels=TRUTH.params[2:4] + zoom * (problem.pixels - TRUTH.params[2:4]))
    wavy = evidence_of(wavy, given)
    ratio = wavy.estimate(3).covariance[0, 0] / plain.estimate(3).covariance[0, 0]
    assert float(ratio) > 2 * wavy.variance / plain.variance


def test_prior_and_evidence_are_weighed_by_their_errors() -> None:
    given = off_by(1.02)
    evidence = evidence_of(walk(3), given)
    loose, tight = (
        replace(
            evidence,
            given=replace(given, directions=given.directions * factor),
            scores=evidence.scores * factor,
            information=evidence.information * factor**2,
        ).estimate()
        for factor in (10.0, 0.001)
    )
    step = evidence.estimate(3).step
    expected = given.camera.params + given.directions @ step
    assert float(loose.camera.params[0]) == pytest.approx(float(expected[0]), rel=1e-3)
    assert loose.departure > 3
    assert float(tight.camera.params[0]) == pytest.approx(float(given.camera.params[0]), rel=1e-4)
    assert tight.measured.focal_std <= 1.01 * 0.001 * given.focal_std
    assert tight.departure == pytest.approx(loose.departure, rel=1e-6)


def of_stretches(steps: list[float], information: float = 100.0) -> CameraEvidence:
    """Stretches that each find a focal length so many standard deviations off, and nothing else."""
    given = CameraMeasurement(TRUTH, off_by(1.0).directions[:, :1])
    weights = torch.full((len(steps), 1, 1), information, dtype=torch.float64)
    scores = weights[..., 0] * torch.tensor(steps).double()[:, None]
    return CameraEvidence(given, scores, weights, 1.0, is_calibration=True)


def test_what_stretches_agree_on_is_free() -> None:
    assert of_stretches([1.0, 1.1, 0.9, 1.0]).agreed == 1
    assert of_stretches([0.01, -0.02, 0.02, 0.0]).agreed == 1  # the prior holds it where it was


def test_what_stretches_contradict_is_held_with_the_given_error() -> None:
    held = of_stretches([3.0, -3.0], information=10000.0)
    assert held.agreed == 0
    estimate = held.estimate()
    assert torch.equal(estimate.camera.params, TRUTH.params)
    assert estimate.measured.focal_std == pytest.approx(0.02)
    assert estimate.departure == 0.0


def test_a_camera_that_nothing_determines_has_no_evidence() -> None:
    still = walk(0, frames=2)
    empty = replace(still, pixels=torch.full_like(still.pixels, float("nan")))
    assert camera_evidence(empty, off_by(1.0), OPTIONS) is None


def test_the_order_of_the_rows_does_not_matter() -> None:
    given = off_by(1.01)
    problem = solved(walk(3), given)
    order = torch.randperm(len(problem.T_cw), generator=torch.Generator().manual_seed(1))
    rank = torch.argsort(order)
    (first,) = problem.fixed_frames
    shuffled = replace(
        problem,
        T_cw=problem.T_cw[order],
        frame_index=rank[problem.frame_index],
        fixed_frames=[int(rank[first])],
    )
    plain = camera_evidence(problem, given, OPTIONS)
    ordered = camera_evidence(shuffled, given, OPTIONS, when=2.5 * order)
    mixed = camera_evidence(shuffled, given, OPTIONS)
    assert plain is not None
    assert ordered is not None
    assert mixed is not None
    torch.testing.assert_close(ordered.scores, plain.scores, rtol=1e-5, atol=1e-5)
    assert not torch.allclose(mixed.scores, plain.scores, rtol=1e-2)


def test_a_departure_is_from_the_camera_that_is_asked_for() -> None:
    given = off_by(1.02)
    evidence = evidence_of(walk(3), given)
    estimate = evidence.estimate(3)
    assert estimate.departure == estimate.departure_from(given.camera)
    directions = evidence.given.directions
    found = given.camera.with_params(given.camera.params + directions @ estimate.step)
    assert estimate.departure_from(found) < 1e-6
    # One direction, by one standard error of the images.
    alone = evidence.estimate(1)
    step = alone.step + alone.covariance[0].sqrt()
    moved = given.camera.with_params(given.camera.params + directions[:, :1] @ step)
    assert alone.departure_from(moved) == pytest.approx(1.0, rel=1e-6)


def test_a_better_camera_replaces_a_given_one_and_a_right_one_stays() -> None:
    """One that is 4 % off is replaced by one that is right; what was found is not replaced again."""
    given = off_by(1.04)
    evidence = evidence_of(walk(3), given)
    assert evidence.is_better_than(given.camera)
    assert evidence.gain(given.camera).total > LEAST_GAIN
    found = evidence.estimate().camera
    assert not evidence.is_better_than(found)
    assert not evidence.is_better_than(TRUTH)
    for seed in range(8):
        assert not evidence_of(walk(seed), off_by(1.0)).is_better_than(TRUTH)


def test_the_gain_is_a_difference_of_log_likelihoods() -> None:
    """Of a stretch at the camera that the others find and at the one in use: here by hand, for one parameter."""
    steps, information = [1.0, 1.1, 0.9, 1.0], 100.0
    evidence = of_stretches(steps, information)
    prior = float(evidence._scatter(1))

    def camera(step: float) -> Camera:
        return TRUTH.with_params(TRUTH.params + evidence.given.directions[:, 0] * step)

    for now in (0.0, 0.3, 1.0, -2.0):
        expected = 0.0
        for own in steps:
            others = information * (sum(steps) - own) / (information * (len(steps) - 1) + prior)
            expected += 0.5 * information * ((now - own) ** 2 - (others - own) ** 2)
        assert evidence.gain(camera(now)).total == pytest.approx(expected, rel=1e-9, abs=1e-6)
    assert evidence.gain(camera(0.0)).stretches == 4
    assert replace(evidence, variance=1.0).gain(camera(0.0)).total > 0


def test_a_calibrated_camera_is_harder_to_replace_than_a_guess() -> None:
    """A gain between both limits: enough for a guess or an estimate, too little for a given calibration."""
    calibrated = of_stretches([1.0, 1.1, 0.9, 1.0], information=10.0)
    total = calibrated.gain(TRUTH).total
    assert LEAST_UPDATE < total < LEAST_GAIN
    assert not calibrated.is_better_than(TRUTH)
    guess = replace(calibrated, is_calibration=False)
    assert guess.gain(TRUTH).total == pytest.approx(total)
    assert guess.is_better_than(TRUTH)
    # An estimate from before, which was as far off on the other side of the given camera.
    estimate = TRUTH.with_params(TRUTH.params - 0.01 * calibrated.given.directions[:, 0])
    assert calibrated.is_better_than(estimate)
