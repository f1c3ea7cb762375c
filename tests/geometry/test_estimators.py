"""What the three estimators by RANSAC have in common: repeatability, failures, gradients, dtypes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from geometry_scenes import CAMERA, RADIAL, make_pairs, points_and_pixels, two_views
from torch import Tensor

from torchslam.geometry import Camera, estimate_absolute_pose, estimate_relative_pose, estimate_similarity

Inputs = dict[str, Tensor]
SIMILARITY = ("points_1", "points_2", "pixels_1", "pixels_2")


def absolute_inputs(seed: int, **options: Any) -> Inputs:
    points_w, pixels, _ = points_and_pixels(seed, **options)
    return {"points_w": points_w, "pixels": pixels}


def relative_inputs(seed: int, **options: Any) -> Inputs:
    scene = two_views(seed, **options)
    return {"pixels_1": scene.pixels_1, "pixels_2": scene.pixels_2}


def similarity_inputs(seed: int, **options: Any) -> Inputs:
    return dict(zip(SIMILARITY, make_pairs(seed, **options).inputs(), strict=True))


class Estimator(NamedTuple):
    """An estimator, the name of its pose, what makes its inputs, and how far samples may move the pose."""

    function: Callable[..., Any]
    pose: str
    inputs: Callable[..., Inputs]
    tolerance: float

    def __call__(self, inputs: Inputs, camera: Camera = CAMERA, **options: Any) -> Any:
        names = ("camera",) if self.pose == "T_cw" else ("camera_1", "camera_2")
        return self.function(**inputs, **dict.fromkeys(names, camera), **options)


ESTIMATORS = {
    "absolute_pose": Estimator(estimate_absolute_pose, "T_cw", absolute_inputs, 5e-3),
    "relative_pose": Estimator(estimate_relative_pose, "T_21", relative_inputs, 0.05),
    "similarity": Estimator(estimate_similarity, "S_21", similarity_inputs, 5e-3),
}


@pytest.fixture(params=list(ESTIMATORS))
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def test_same_seed_same_bytes_and_batch_agrees_with_loop(name: str) -> None:
    estimate = ESTIMATORS[name]
    problems = [estimate.inputs(seed, outliers=0.2) for seed in range(3)]
    inputs = {key: torch.cat([problem[key] for problem in problems]) for key in problems[0]}
    batch, again = (getattr(estimate(inputs, seed=7), estimate.pose) for _ in range(2))
    assert torch.equal(batch, again)
    single = torch.cat([getattr(estimate(problem), estimate.pose) for problem in problems])
    # other samples, nearly the same inliers
    torch.testing.assert_close(batch, single, atol=estimate.tolerance, rtol=0)
    cameras = CAMERA.with_params(CAMERA.params.expand(3, -1))
    assert torch.equal(getattr(estimate(inputs, cameras, seed=7), estimate.pose), batch)


@pytest.mark.parametrize(("count", "threshold"), [(100, 2.0), (20, 4.0), (60, 4.0)])
def test_pure_noise_is_never_a_success(name: str, count: int, threshold: float) -> None:
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor((640.0, 480.0), dtype=torch.float64)
    pixels = torch.rand(2, 12, count, 2, generator=generator, dtype=torch.float64) * size
    depths = 2 + 4 * torch.rand(2, 12, count, 1, generator=generator, dtype=torch.float64)
    points = CAMERA.unproject(pixels) * depths
    inputs = {
        "absolute_pose": {"points_w": points[0], "pixels": pixels[1]},
        "relative_pose": {"pixels_1": pixels[0], "pixels_2": pixels[1]},
        "similarity": dict(zip(SIMILARITY, (*points, *pixels), strict=True)),
    }[name]
    assert not ESTIMATORS[name](inputs, threshold=threshold, max_samples=500).success.any()


@pytest.mark.parametrize(("batch", "count"), [(0, 10), (2, 0), (2, 2)])
def test_too_few_rows_have_no_pose_and_a_gradient_of_zero(name: str, batch: int, count: int) -> None:
    estimate = ESTIMATORS[name]
    inputs = {key: x[:, :count].repeat(batch, 1, 1) for key, x in estimate.inputs(0).items()}
    leaves = [x.requires_grad_() for x in inputs.values()]
    found = estimate(inputs)
    pose = getattr(found, estimate.pose)
    torch.testing.assert_close(pose.detach(), torch.eye(4).double().expand(batch, 4, 4))
    assert found.inliers.shape == (batch, count)
    assert not found.success.any()
    if name != "similarity":  # which is detached
        assert not any(x.any() for x in torch.autograd.grad(pose.sum(), leaves))


@pytest.mark.parametrize("name", ["absolute_pose", "relative_pose"])
def test_gradients_are_finite_in_float32_also_of_exact_data_and_failures(name: str) -> None:
    estimate = ESTIMATORS[name]
    scenes = [estimate.inputs(1, outliers=0.1), estimate.inputs(1, outliers=0.1, noise=0.0)]
    inputs = {key: torch.cat([scene[key] for scene in (*scenes, scenes[0])]).float() for key in scenes[0]}
    next(iter(inputs.values()))[2, 3:] = torch.nan
    leaves = [x.requires_grad_() for x in inputs.values()]
    found = estimate(inputs, CAMERA.to(torch.float32))
    assert found.success.tolist() == [True, True, False]
    gradients = torch.autograd.grad(getattr(found, estimate.pose).sum(), leaves)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert float(gradients[1][0].abs().max()) > 0


RELATIVE: dict[str, dict[str, Any]] = {
    "essential": {},
    "homography": {"plane": True},
    "rotation": {"baseline": 0.0},
}


@pytest.mark.parametrize("camera", [CAMERA, RADIAL], ids=["pinhole", "radial_tangential"])
@pytest.mark.parametrize("kind", ["absolute", *RELATIVE, "geman_mcclure", "truncated"])
def test_the_gradient_is_that_of_the_estimate(camera: Camera, kind: str) -> None:
    """Against central differences of the whole estimator; inliers and level of the noise stay the same."""
    estimate = ESTIMATORS["absolute_pose" if kind == "absolute" else "relative_pose"]
    options: dict[str, Any] = {"threshold": 3.0}
    if kind == "absolute":
        inputs = estimate.inputs(2, count=40, outliers=0.2, noise=0.3, camera=camera)
    else:
        inputs = estimate.inputs(
            7, count=80, outliers=0.1, noise=0.1, camera=camera, **RELATIVE.get(kind, {})
        )
        options = {"threshold": 2.0, "kernel": "cauchy" if kind in RELATIVE else kind}
    inputs["params"] = camera.params
    generator = torch.Generator().manual_seed(1)
    if kind not in (*RELATIVE, "absolute"):
        inputs["weights"] = 0.5 + torch.rand(1, 80, generator=generator, dtype=torch.float64)
        inputs["weights"][0, 20] = 0.0

    def run(given: Inputs) -> Tensor:
        given = dict(given)
        found = estimate(given, camera.with_params(given.pop("params")), **options)
        assert kind not in RELATIVE or found.model == (kind,)
        return getattr(found, estimate.pose)[0, :3]

    leaves = {key: x.clone().requires_grad_() for key, x in inputs.items()}
    factors = torch.linspace(-1, 1, 12, dtype=torch.float64).view(3, 4)
    (run(leaves) * factors).sum().backward()
    torch.testing.assert_close(run(leaves).detach(), run(inputs))
    for key, x in inputs.items():
        direction = torch.randn(x.shape, generator=generator, dtype=torch.float64)
        if key == "params":
            direction[4:] *= 0.01
        elif key == "weights":
            direction[0, 20] = 0.0
            assert float(leaves[key].grad[0, 20]) == 0
        high, low = (run({**inputs, key: x + sign * direction}) for sign in (5e-4, -5e-4))
        expected = ((high - low) * factors).sum() / 1e-3
        found = (leaves[key].grad * direction).sum()
        torch.testing.assert_close(found, expected, rtol=2e-3, atol=1e-7)


@pytest.mark.parametrize("transform_of", [torch.func.jacrev, torch.func.jacfwd, torch.func.vmap])
def test_torch_func_is_refused_in_words(name: str, transform_of: Callable[..., Any]) -> None:
    estimate = ESTIMATORS[name]
    (key, first), *others = estimate.inputs(0, count=30).items()
    given = first[None] if transform_of is torch.func.vmap else first
    with pytest.raises(RuntimeError, match=f"estimate_{name} chooses among random samples"):
        transform_of(lambda x: getattr(estimate({key: x, **dict(others)}), estimate.pose))(given)
