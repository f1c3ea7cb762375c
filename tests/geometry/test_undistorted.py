from __future__ import annotations

import pytest
import torch

from torchslam.geometry import Camera, KeypointNoise, UndistortedKeypoints, Undistortion

CAMERAS = (
    Camera.pinhole(500.0, 510.0, 320.0, 240.0, size=(640, 480)),
    Camera.radial_tangential(500.0, 510.0, 320.0, 240.0, -0.3, 0.1, 1e-3, -2e-3, size=(640, 480)),
    Camera.fisheye(300.0, 310.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001, size=(640, 480)),
)


def pixels(count: int = 50) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor([640.0, 480.0])


@pytest.mark.parametrize("camera", CAMERAS, ids=[camera.model for camera in CAMERAS])
def test_the_slope_is_the_derivative_of_undistorted_coordinates(camera):
    undistorted, step = UndistortedKeypoints.of(pixels(), camera), 1e-6
    ones = torch.ones(50, 1, dtype=torch.float64)
    torch.testing.assert_close(camera.project(torch.cat((undistorted.xy.mT, ones), 1))[0], pixels())
    for axis in (0, 1):
        ahead, behind = (
            camera.project(
                torch.cat((undistorted.xy.mT + sign * step * torch.eye(2).double()[axis], ones), 1)
            )[0]
            for sign in (1, -1)
        )
        slope = ((ahead - behind) / (2 * step)).mT
        torch.testing.assert_close(undistorted.slope[axis], slope, rtol=1e-5, atol=1e-3)
    rows = torch.tensor([3, 1])
    assert torch.equal(undistorted[rows].xy, undistorted.xy[:, rows])
    assert torch.equal(undistorted[rows].slope, undistorted.slope[:, :, rows])


@pytest.mark.parametrize("kind", ["scale", "variance", "covariance"])
def test_whitened_slopes_give_errors_in_units_of_the_noise(kind):
    camera, generator = CAMERAS[1], torch.Generator().manual_seed(1)
    scales = 1 + torch.rand(50, generator=generator, dtype=torch.float64)
    root = torch.randn(50, 2, 2, generator=generator, dtype=torch.float64)
    information = {"scale": None, "variance": scales**-1, "covariance": root @ root.mT + torch.eye(2)}[kind]
    noise = KeypointNoise.of(scales, information)
    undistorted, error = UndistortedKeypoints.of(pixels(), camera), torch.tensor([0.01, -0.02]).double()
    white = (undistorted.whitened(noise) * error[:, None, None]).sum(0)
    off_px = (undistorted.slope * error[:, None, None]).sum(0).mT
    torch.testing.assert_close(white.square().sum(0), noise.squared(off_px) * noise.gate_factor**2)


@pytest.mark.parametrize("camera", CAMERAS, ids=[camera.model for camera in CAMERAS])
def test_the_lookup_table_is_accurate_to_hundredths_of_a_pixel(camera):
    inside = torch.cat((pixels(2000), torch.tensor([[-0.5, -0.5], [639.5, 479.5], [0.0, 479.5]]).double()))
    exact, quick = UndistortedKeypoints.of(inside, camera), Undistortion(camera)(inside)
    ones = torch.ones(len(inside), 1, dtype=torch.float64)
    back = camera.project(torch.cat((quick.xy.mT, ones), 1))[0]
    assert (back - inside).norm(dim=1).max() < (0.02 if camera.model == "fisheye" else 0.01)
    torch.testing.assert_close(
        quick.slope, exact.slope, rtol=0.01, atol=0.01 * float(exact.slope.abs().max())
    )


def test_beyond_the_valid_radius_the_table_has_its_edge_value():
    camera = Camera.radial_tangential(300.0, 300.0, 320.0, 240.0, -0.4, 0.0, 0.0, 0.0, size=(640, 480))
    corner = torch.tensor([[1.0, 1.0], [320.0, 240.0]]).double()
    exact, quick = UndistortedKeypoints.of(corner, camera), Undistortion(camera)(corner)
    assert float(exact.xy[:, 0].norm()) == pytest.approx(
        0.999 * float(camera.limit)
    )  # it does not reach there
    torch.testing.assert_close(quick.xy, exact.xy, atol=0.01, rtol=0)


@pytest.mark.parametrize("camera", CAMERAS, ids=[camera.model for camera in CAMERAS])
def test_normalized_coordinates_equal_those_of_the_camera_in_any_shape(camera):
    batch, focal = pixels().view(2, 25, 2), camera.params[:2]
    found, exact = Undistortion(camera).normalize(batch), camera.normalize(batch)
    torch.testing.assert_close(found * focal, exact * focal, rtol=0, atol=0.02)
    assert torch.equal(found, exact) == (camera.model == "pinhole")
