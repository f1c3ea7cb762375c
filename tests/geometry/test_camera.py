"""Camera models."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck
from torch.func import grad, jacrev, vmap
from torch.utils._pytree import tree_flatten_with_path, tree_map
from torch.utils.data import DataLoader, default_collate

from torchslam.geometry import Camera, estimate_absolute_pose, rigid, transform
from torchslam.geometry.distortion import first_positive_root
from torchslam.optim import BundleProblem, solve_bundle, solve_pose

SIZE = (640, 480)
CAMERAS = {
    "pinhole": Camera.pinhole(500.0, 510.0, 320.0, 240.0, size=SIZE),
    "radial_tangential": Camera.radial_tangential(
        500.0, 510.0, 320.0, 240.0, -0.28, 0.07, 1e-3, -5e-4, 0.01, size=SIZE
    ),
    "barrel": Camera.radial_tangential(500.0, 510.0, 320.0, 240.0, -0.3, 0.0, 0.0, 0.0, size=SIZE),
    "rational": Camera.from_opencv(
        np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]),
        (0.5, -0.3, 1e-3, -5e-4, 0.05, 0.8, -0.1, 0.02),
        SIZE,
    ),
    "fisheye": Camera.fisheye(300.0, 305.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=SIZE),
}


@pytest.fixture(params=CAMERAS.values(), ids=CAMERAS.keys())
def camera(request: pytest.FixtureRequest) -> Camera:
    return request.param


def points(count: int = 20) -> Tensor:
    """In front of the camera, the first on its axis."""
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor((0.6, 0.5, 0.5), dtype=torch.float64)
    cloud = spread * (2 * torch.rand(2, count, 3, generator=generator, dtype=torch.float64) - 1)
    cloud[..., 2] += 2
    cloud[:, 0, :2] = 0
    return cloud


def with_bad_rows(cloud: Tensor) -> Tensor:
    cloud = cloud.clone()
    cloud[0, 1] = torch.tensor((0.1, 0.1, -2.0))
    cloud[0, 2] = torch.nan
    cloud[0, 3] = torch.inf
    cloud[0, 4] = 0.0
    return cloud


def test_project_agrees_with_opencv(camera: Camera) -> None:
    cloud = points()[0].numpy()
    K, coefficients, zero = camera.K.numpy(), camera.params[4:].numpy(), np.zeros(3)
    if camera.model == "fisheye":
        expected = cv2.fisheye.projectPoints(cloud[:, None], zero, zero, K, coefficients)[0]
    else:
        expected = cv2.projectPoints(cloud, zero, zero, K, coefficients if len(coefficients) else None)[0]
    pixels, valid = camera.project(torch.from_numpy(cloud))
    assert valid.all()
    torch.testing.assert_close(pixels, torch.from_numpy(expected).squeeze(1), atol=1e-10, rtol=0)


def test_unproject_inverts_project(camera: Camera) -> None:
    cloud = points()
    pixels, _ = camera.project(cloud)
    bearings = cloud / cloud.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(camera.unproject(pixels), bearings, atol=1e-12, rtol=0)
    torch.testing.assert_close(camera.normalize(pixels), cloud[..., :2] / cloud[..., 2:], atol=1e-12, rtol=0)


def test_bad_points_are_invalid_and_finite(camera: Camera) -> None:
    cloud = with_bad_rows(points()).requires_grad_()
    params = camera.params.clone().requires_grad_()
    pixels, valid, J_points, J_params = camera.with_params(params).project_with_jacobians(cloud)
    assert valid[0].tolist() == [True] + 4 * [False] + 15 * [True]
    assert all(torch.isfinite(x).all() for x in (pixels, J_points, J_params))
    assert (J_points[0, 1:5] == 0).all()
    camera.with_params(params).project(cloud)[0].sum().backward()
    assert torch.isfinite(cloud.grad).all()
    assert torch.isfinite(params.grad).all()


def test_analytic_jacobians_agree_with_autograd(camera: Camera) -> None:
    cloud = with_bad_rows(points())

    def project(cloud: Tensor, params: Tensor) -> Tensor:
        return camera.with_params(params).project(cloud)[0]

    by_points, by_params = torch.autograd.functional.jacobian(project, (cloud, camera.params))
    pixels, valid, J_points, J_params = camera.project_with_jacobians(cloud)
    torch.testing.assert_close(J_points, torch.einsum("bnibnj->bnij", by_points))
    torch.testing.assert_close(J_params, by_params)
    for one, other in zip(camera.project_with_point_jacobians(cloud), (pixels, valid, J_points), strict=True):
        assert torch.equal(one, other)


def test_gradients(camera: Camera) -> None:
    cloud, params = points(5).requires_grad_(), camera.params.clone().requires_grad_()
    pixels = camera.project(points(5))[0].detach().requires_grad_()
    assert gradcheck(lambda x, p: camera.with_params(p).project(x)[0], (cloud, params))
    assert gradcheck(lambda x, p: camera.with_params(p).normalize(x), (pixels, params))
    assert gradcheck(lambda x, p: camera.with_params(p).unproject(x), (pixels, params))
    for function in (camera.project_with_jacobians, camera.project_with_point_jacobians):
        assert gradcheck(
            lambda x, function=function: [y for y in function(x) if y.is_floating_point()], (cloud,)
        )


def test_points_beyond_the_monotone_radius_are_invalid() -> None:
    camera = CAMERAS["barrel"]
    limit = math.sqrt(1 / 0.9)  # where 1 + 3 k1 r^2 vanishes
    assert float(camera.limit) == pytest.approx(limit)
    x = torch.tensor(((0.99 * limit, 0.0, 1.0), (1.01 * limit, 0.0, 1.0)), dtype=torch.float64)
    assert camera.project(x)[1].tolist() == [True, False]
    assert math.isinf(CAMERAS["pinhole"].limit)
    # far outside the image the inverse is clamped to the edge, not wrapped
    far = camera.normalize(torch.tensor(((5000.0, 240.0),), dtype=torch.float64))
    assert 0.99 * limit < float(far[0, 0]) <= limit


def test_first_positive_root() -> None:
    coefficients = torch.tensor(((-3.0, 2.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, -8.0), (torch.nan, 0.0, 0.0)))
    expected = torch.tensor((0.5, torch.inf, 0.5, torch.inf))
    torch.testing.assert_close(first_positive_root(coefficients.double()), expected.double())


def test_float32_and_device(camera: Camera, device: torch.device, dtype: torch.dtype) -> None:
    camera = camera.to(device).to(dtype)
    cloud = points().to(device, dtype).requires_grad_()
    pixels, _ = camera.project(cloud)
    assert (pixels.dtype, pixels.device.type) == (dtype, device.type)
    camera.unproject(pixels).square().sum().backward()
    assert torch.isfinite(cloud.grad).all()
    torch.testing.assert_close(
        pixels.double().cpu(), camera.to("cpu").to(torch.float64).project(points())[0], atol=1e-3, rtol=0
    )


def test_image_border_properties_and_errors() -> None:
    camera = CAMERAS["pinhole"]
    pixels = torch.tensor(
        ((-0.5, 0.0), (-0.6, 0.0), (639.5, 479.5), (639.6, 479.5), (15.4, 100.0), (15.5, 100.0))
    )
    assert camera.in_image(pixels).tolist() == [True, False, True, False, True, True]
    assert camera.in_image(pixels, border=16).tolist() == [False] * 5 + [True]
    assert (camera.width, camera.height) == SIZE
    assert float(camera.focal) == pytest.approx(math.sqrt(500 * 510))
    with pytest.raises(ValueError, match="unknown camera model"):
        Camera("telescope", torch.ones(4), SIZE)
    with pytest.raises(ValueError, match="4 parameters"):
        Camera("pinhole", torch.ones(5), SIZE)


def test_pixel_scale_is_the_local_magnification(camera: Camera) -> None:
    x = points()[0, :, :2]
    step = 1e-6
    cloud = torch.cat((x, torch.ones_like(x[:, :1])), dim=-1)
    moved_x, moved_y = cloud.clone(), cloud.clone()
    moved_x[:, 0] += step
    moved_y[:, 1] += step
    base = camera.project(cloud)[0]
    d_x, d_y = (camera.project(moved_x)[0] - base) / step, (camera.project(moved_y)[0] - base) / step
    area = (d_x[:, 0] * d_y[:, 1] - d_x[:, 1] * d_y[:, 0]).abs()
    torch.testing.assert_close(camera.pixel_scale(x).prod(-1), area, rtol=1e-4, atol=0)


def pinhole(focal: float) -> Camera:
    return Camera.pinhole(focal, focal, 320.0, 240.0, size=SIZE)


def bent(k1: float) -> Camera:
    return Camera.radial_tangential(500.0, 510.0, 320.0, 240.0, k1, 0.02, 1e-3, -2e-3, size=SIZE)


POINTS = torch.tensor([[0.3, -0.2, 2.0], [-0.4, 0.1, 1.5]], dtype=torch.float64)


def test_torch_loads_a_camera_with_weights_only(tmp_path):
    camera = pinhole(500.0)
    torch.save({"camera": camera}, tmp_path / "camera.pt")
    loaded = torch.load(tmp_path / "camera.pt", weights_only=True)["camera"]
    assert isinstance(loaded, Camera)
    assert torch.equal(loaded.params, camera.params)
    assert (loaded.model, loaded.size) == (camera.model, camera.size)


def test_collate_and_a_loader_give_a_batch_of_cameras():
    samples = [{"camera": pinhole(500.0 + row), "frame": row} for row in range(4)]
    batch = default_collate(samples)["camera"]
    assert isinstance(batch, Camera)
    assert batch.params.shape == (4, 4)
    assert batch.size == SIZE
    assert torch.equal(batch.fx, torch.tensor([500.0, 501, 502, 503], dtype=torch.float64))
    (loaded,) = DataLoader(samples, batch_size=4, num_workers=1)
    assert torch.equal(loaded["camera"].params, batch.params)


@pytest.mark.parametrize("other", [bent(0.1), Camera.pinhole(500.0, 500.0, 320.0, 240.0, size=(320, 240))])
def test_a_batch_has_one_model_and_one_size(other):
    with pytest.raises(ValueError, match="one model and one size"):
        default_collate([pinhole(500.0), other])


def test_cameras_are_stacked_and_indexed(dtype, device):
    cameras = [bent(k1).to(device, dtype) for k1 in (-0.3, -0.1, 0.05)]
    stacked = Camera.stack(cameras)
    assert stacked.params.dtype == dtype
    assert stacked.params.device.type == device.type
    for row, camera in enumerate(cameras):
        assert torch.equal(stacked[row].params, camera.params)
        torch.testing.assert_close(stacked[row].limit, camera.limit)
    rows = torch.tensor([2, 0], device=device)
    assert torch.equal(stacked[rows].params, stacked.params[rows])
    assert torch.equal(stacked[rows].limit, stacked.limit[rows])
    assert torch.equal(stacked[1:].limit, stacked.limit[1:])
    with pytest.raises(IndexError, match="one camera"):
        cameras[0][0]


def test_a_pytree_of_its_parameters():
    camera = pinhole(500.0)
    doubled = tree_map(lambda tensor: 2 * tensor, camera)
    assert isinstance(doubled, Camera)
    assert torch.equal(doubled.params, 2 * camera.params)
    assert (doubled.model, doubled.size) == (camera.model, camera.size)
    ((path, leaf),), _ = tree_flatten_with_path(camera)
    assert str(path[0]) == ".params"
    assert leaf is camera.params


@pytest.mark.parametrize("make", [pinhole, bent])
def test_torch_func_takes_cameras(make):
    """Mapped over, and differentiated with respect to."""
    cameras = [make(value) for value in ((500.0, 520.0) if make is pinhole else (-0.2, 0.05))]

    def pixels(camera: Camera) -> Tensor:
        return camera.project(POINTS)[0]

    together = vmap(pixels)(Camera.stack(cameras))
    torch.testing.assert_close(together, torch.stack([pixels(camera) for camera in cameras]))
    gradient = grad(lambda camera: pixels(camera).sum())(cameras[0])
    assert isinstance(gradient, Camera)
    params = cameras[0].params.clone().requires_grad_()
    pixels(cameras[0].with_params(params)).sum().backward()
    torch.testing.assert_close(gradient.params, params.grad)
    assert jacrev(pixels)(cameras[0]).params.shape == (2, 2, cameras[0].params.shape[-1])


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("method", ["normalize", "unproject"])
def test_a_pixel_that_is_not_finite_leaves_the_gradient_of_the_others(camera, method, bad):
    pixels = camera.project(points())[0]
    gradients = []
    for worst in (False, True):
        if worst:
            pixels = torch.cat((pixels, torch.full_like(pixels[:, :1], bad)), dim=1)
        pixels = pixels.detach().requires_grad_()
        params = camera.params.clone().requires_grad_()
        found = getattr(camera.with_params(params), method)(pixels)
        assert found.isfinite().all()
        kept = found[:, : found.shape[1] - worst]
        gradients.append(torch.autograd.grad(kept.square().sum(), (params, pixels)))
    torch.testing.assert_close(gradients[0][0], gradients[1][0])
    torch.testing.assert_close(gradients[0][1], gradients[1][1][:, :-1])
    assert (gradients[1][1][:, -1] == 0).all()


def _inverse_by_newton(camera: Camera, pixel: Tensor) -> Tensor:
    """x/z, y/z of a pixel by Newton's method on autograd of `project` alone, in full."""
    xy = torch.zeros(2, dtype=torch.float64)
    for _ in range(60):

        def projected(xy: Tensor) -> Tensor:
            return camera.project(torch.cat((xy, xy.new_ones(1)))[None])[0][0]

        xy = xy - torch.linalg.solve(torch.func.jacrev(projected)(xy), projected(xy) - pixel)
    return xy


DISTORTED = ["rational", "radial_tangential", "fisheye"]


@pytest.mark.parametrize("camera", [CAMERAS[name] for name in DISTORTED], ids=DISTORTED)
def test_derivatives_of_the_inverse_up_to_the_third_order(camera: Camera) -> None:
    """Against central differences of the derivative of one order less."""
    pixel = torch.tensor([120.0, 400.0], dtype=torch.float64)
    start = torch.cat((pixel, camera.params))
    towards = torch.cat((torch.tensor([1.0, 0.5]), torch.tensor([2.0, 1.0, 0.3, 0.2]), 0.01 * torch.ones(9)))
    towards = towards[: len(start)].double()

    def at(step: Tensor) -> Tensor:
        moved = start + step * towards
        return camera.with_params(moved[2:]).normalize(moved[None, :2])[0]

    derivatives = [at]
    for _ in range(3):
        derivatives.append(torch.func.jacrev(derivatives[-1]))
    zero, h = torch.zeros((), dtype=torch.float64), 1e-2
    torch.testing.assert_close(at(zero), _inverse_by_newton(camera, pixel), rtol=0, atol=1e-12)
    for lower, higher in itertools.pairwise(derivatives):
        near, far = (lower(zero + step) - lower(zero - step) for step in (h, 2 * h))
        torch.testing.assert_close(higher(zero), (8 * near - far) / (12 * h), rtol=1e-5, atol=1e-13)


@pytest.mark.parametrize("ways", ["optimizer", "data", "inference"])
def test_the_limit_follows_parameters_that_an_optimizer_moves(ways: str) -> None:
    """k1 from 0 to -0.3: an undistorted image has no limit, this one ends at 1.05."""
    size = (640, 480)
    params = torch.tensor([300.0, 300.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    moved = params.clone()
    moved[4] = -0.3
    corners = torch.tensor([[0.0, 0.0], [639.0, 479.0], [320.0, 0.0]], dtype=torch.float64)
    with torch.inference_mode(ways == "inference"):
        params = params.clone()
        camera = Camera("radial_tangential", params, size)
        assert camera.limit.isinf()
        camera.normalize(corners)
        if ways == "data":
            params.data[4] = -0.3
        elif ways == "inference":
            params[4] = -0.3
        else:
            optimizer = torch.optim.Adam([params.requires_grad_()], 0.01)
            while float(params[4]) > -0.3:
                optimizer.zero_grad()
                params[4].backward()
                optimizer.step()
            moved = params.detach().clone()
    fresh = Camera("radial_tangential", moved.clone(), size)
    assert float(camera.limit) == pytest.approx((1 / (-3 * float(moved[4]))) ** 0.5)
    assert torch.equal(camera.normalize(corners), fresh.normalize(corners))
    points = torch.tensor([[0.9, 0.0, 1.0], [1.5, 0.0, 1.0]], dtype=torch.float64)
    assert camera.project(points)[1].tolist() == [True, False]
    assert camera.with_params(torch.stack((params, moved)))[0].limit == fresh.limit


KINECT = (0.46, -2.45, 6e-4, -2e-4, 1.42, 0.34, -2.28, 1.35)
"""k1 k2 p1 p2 k3 k4 k5 k6 of a depth camera's color lens: numerator and denominator nearly cancel."""


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
@pytest.mark.parametrize("shape", [(-1,), (1, -1), (-1, 1)])
def test_coefficients_of_opencv_project_and_undistort_as_there(count: int, shape: tuple[int, ...]) -> None:
    coefficients = np.array([*KINECT, *6 * [0.0]])[:count].reshape(shape)
    K = np.array([[607.0, 0.0, 638.5], [0.0, 606.5, 367.0], [0.0, 0.0, 1.0]])
    camera = Camera.from_opencv(K, coefficients if count else None, (1280, 720))
    assert camera.params.dtype == torch.float64
    model = {0: "pinhole", 4: "radial_tangential", 5: "radial_tangential"}.get(count, "rational")
    assert camera.model == model
    cloud, zero = points()[0].numpy(), np.zeros(3)
    expected = cv2.projectPoints(cloud, zero, zero, K, coefficients if count else None)[0]
    pixels, valid = camera.project(torch.from_numpy(cloud))
    assert valid.all()
    torch.testing.assert_close(pixels, torch.from_numpy(expected).squeeze(1), atol=1e-9, rtol=0)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # of one name from OpenCV 5 on
    undistorted = undistort(expected, K, coefficients if count else None, R=None, P=None, criteria=criteria)
    torch.testing.assert_close(
        camera.normalize(pixels), torch.from_numpy(undistorted).squeeze(1), atol=1e-8, rtol=0
    )


def test_a_fisheye_of_opencv() -> None:
    K, coefficients = np.diag((300.0, 305.0, 1.0)), np.array([[0.02], [-0.01], [0.003], [-0.001]])
    camera = Camera.from_opencv(K, coefficients, SIZE, fisheye=True)
    assert camera.model == "fisheye"
    assert camera.params.tolist() == [300, 305, 0, 0, 0.02, -0.01, 0.003, -0.001]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_matrices_of_many_cameras_keep_dtype_and_gradient(dtype: torch.dtype) -> None:
    params = torch.stack([CAMERAS["rational"].params, CAMERAS["rational"].params * 1.1]).to(dtype)
    cameras = CAMERAS["rational"].with_params(params.requires_grad_())
    again = Camera.from_opencv(cameras.K, params[:, 4:], SIZE)
    assert torch.equal(again.params, params)
    again.params.sum().backward()
    assert (params.grad == 1).all()


@pytest.mark.parametrize(
    ("K", "dist", "fisheye", "message"),
    [
        (np.eye(2), None, False, r"K must be \(..., 3, 3\), not \(2, 2\)"),
        (np.eye(3) + np.eye(3, k=1), None, False, "a skew"),
        (2 * np.eye(3), None, False, "last row of K must be 0, 0, 1"),
        (np.eye(3), [0.1, 0.2, 0.3], False, "0, 4, 5, 8, 12, 14 coefficients, not 3"),
        (np.eye(3), 5 * [0.1], True, "fisheye distortion has 0, 4 coefficients, not 5"),
        (np.eye(3), 12 * [0.1], False, "from the ninth on, of a thin prism"),
    ],
)
def test_what_no_model_holds_is_refused(K: np.ndarray, dist: list[float] | None, fisheye: bool, message: str):
    with pytest.raises(ValueError, match=message):
        Camera.from_opencv(K, dist, SIZE, fisheye=fisheye)


def test_a_rational_model_ends_where_it_turns_and_where_its_denominator_vanishes() -> None:
    def limit(*k: float) -> float:
        camera = Camera.from_opencv(np.eye(3), [*k[:2], 0.0, 0.0, *k[2:]], SIZE)
        return float(camera.limit)

    r = torch.linspace(1e-3, 5, 100_000, dtype=torch.float64)

    def turning(k1: float, k4: float, k5: float) -> float:
        grown = (r * (1 + k1 * r**2) / (1 + k4 * r**2 + k5 * r**4)).diff() > 0
        return float(r[int((~grown).nonzero()[0])])

    assert limit(-0.2, 0.0, 0.0, 0.1, 0.05, 0.0) == pytest.approx(turning(-0.2, 0.1, 0.05), abs=1e-3)
    assert limit(0.0, 0.0, 0.0, -0.25, 0.0, 0.0) == pytest.approx(2.0)  # grows to infinity there
    assert math.isinf(limit(0.1, 0.0, 0.0, 0.05, 0.0, 0.0))


def test_a_camera_of_numbers_goes_with_data_of_either_precision(camera: Camera, dtype: torch.dtype) -> None:
    """Its methods and whoever takes it compute in the dtype of the data."""
    params = camera.params.clone().requires_grad_()
    given, exact = camera.with_params(params), camera.to(dtype)
    cloud = points().to(dtype)
    for method in ("project", "project_with_jacobians", "project_with_point_jacobians"):
        for found, expected in zip(getattr(given, method)(cloud), getattr(exact, method)(cloud), strict=True):
            assert torch.equal(found, expected)
    pixels = given.project(points_c=cloud)[0]
    assert pixels.dtype == dtype
    assert torch.equal(given.normalize(pixels), exact.normalize(pixels))
    assert torch.equal(given.unproject(pixels), exact.unproject(pixels))
    pixels.sum().backward()
    assert params.grad.dtype == torch.float64
    assert bool(params.grad.any())
    pose = solve_pose(
        cloud, pixels.detach(), T_cw=torch.eye(4, dtype=dtype).expand(2, 4, 4), camera=given
    ).T_cw
    assert pose.dtype == dtype
    torch.testing.assert_close(pose, torch.eye(4, dtype=dtype).expand(2, 4, 4), atol=1e-4, rtol=0)


def test_a_camera_within_a_problem_follows_its_data(dtype: torch.dtype) -> None:
    cloud = points()[0].to(dtype)
    rows = torch.arange(len(cloud))
    frames, seen = torch.cat((0 * rows, 0 * rows + 1)), torch.cat((rows, rows))
    T_cw = rigid(torch.eye(3).expand(2, 3, 3), torch.tensor([[0.0, 0, 0], [0.3, 0, 0]])).to(dtype)
    camera = CAMERAS["pinhole"]
    pixels = camera.project(transform(T_cw, cloud))[0].flatten(0, 1)
    found = solve_bundle(BundleProblem(T_cw, cloud, frames, seen, pixels, camera))
    assert (found.T_cw.dtype, found.camera.params.dtype) == (dtype, dtype)
    assert camera.params.dtype == torch.float64


def test_data_of_two_precisions_are_refused_by_name() -> None:
    cloud, camera = points(), CAMERAS["pinhole"]
    pixels = camera.project(cloud)[0].float()
    with pytest.raises(ValueError, match=r"pixels is torch.float32, but points_w is torch.float64: all"):
        estimate_absolute_pose(cloud, pixels, camera=camera)
    with pytest.raises(ValueError, match=r"float32 or float64, not torch\.float16"):
        camera.project(cloud.half())


def test_parameters_of_numbers_and_tensors() -> None:
    one, two = torch.tensor(500.0), torch.tensor(500.0, dtype=torch.float64)
    for fx, fy, dtype in ((5.0, 5.0, torch.float64), (one, 5.0, torch.float32), (one, two, torch.float64)):
        assert Camera.pinhole(fx, fy, 320.0, 240.0, SIZE).params.dtype == dtype


@pytest.mark.parametrize("place", ["fx", "fy", "cx", "last"])
@pytest.mark.parametrize("bad", [0.0, -5.0, math.nan, math.inf])
def test_a_camera_without_finite_parameters_and_focal_lengths_above_zero_is_refused(
    camera: Camera, place: str, bad: float
) -> None:
    params = camera.params.repeat(2, 1)
    params[1, {"fx": 0, "fy": 1, "cx": 2, "last": -1}[place]] = bad
    degenerate = camera.with_params(params)  # as a step of an optimizer may leave it
    if math.isfinite(bad) and place not in ("fx", "fy"):
        return
    with pytest.raises(ValueError, match=r"finite parameters and focal lengths above zero, got \["):
        Camera(camera.model, params, SIZE)

    cloud = points().requires_grad_()
    (pixels, valid), (expected, valid_before) = degenerate.project(cloud), camera.project(points())
    rays = degenerate.unproject(expected)
    (pixels.sum() + rays.sum()).backward()
    assert cloud.grad is not None
    assert torch.equal(valid, torch.stack((valid_before[0], torch.zeros_like(valid_before[1]))))
    assert torch.equal(pixels[0], expected[0])
    assert torch.equal(rays[0], camera.unproject(expected)[0])
    assert torch.isfinite(pixels).all()
    assert torch.isfinite(rays).all()
    assert torch.isfinite(cloud.grad).all()
    assert not cloud.grad[1].any()
    projected = vmap(lambda params, cloud: camera.with_params(params).project(cloud))(params, points())
    assert torch.equal(projected[1], valid)


def test_cameras_are_values(camera: Camera) -> None:
    others = [camera.with_params(camera.params * 1.01), Camera(camera.model, camera.params, (641, 480))]
    same = [camera.with_params(camera.params.clone()), camera]
    assert all(camera == each and hash(camera) == hash(each) for each in same)
    assert not any(camera == each for each in [*others, camera.params, Camera.stack([camera])])
    assert len({camera, *same, *others}) == 3
    assert Camera.stack([camera, others[0]]) == Camera.stack([*same[:1], others[0]])


def test_a_step_that_leaves_a_camera_degenerate_is_noticed() -> None:
    """What is kept of the parameters is kept until they change in place."""
    camera = Camera.pinhole(500.0, 500.0, 320.0, 240.0, size=(640, 480))
    ahead = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64)
    assert camera.project(ahead)[1].all()
    camera.params[0] = torch.nan
    assert not camera.project(ahead)[1].any()
    camera.params[0] = 500.0
    assert camera.project(ahead)[1].all()
