"""Positions on the Earth."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from torchslam.geometry import (
    ecef_from_geodetic,
    ecef_from_local,
    enu_from_geodetic,
    geodetic_from_ecef,
    geodetic_from_enu,
    so3_log,
)

SEMI_MINOR = 6356752.314245179
"""Meters, NIMA TR8350.2."""


def places(count: int = 50) -> Tensor:
    """From pole to pole, around the Earth, from 5 km below the sea to low orbits."""
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    low, high = torch.tensor([-89.99, -180.0, -5e3]).double(), torch.tensor([89.99, 180.0, 5e5]).double()
    return low + unit * (high - low)


@pytest.mark.parametrize(
    ("geodetic", "ecef"),
    [
        ((0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0)),
        ((0.0, 90.0, 100.0), (0.0, 6378237.0, 0.0)),
        ((90.0, 0.0, 0.0), (0.0, 0.0, SEMI_MINOR)),
        ((-90.0, 0.0, 10.0), (0.0, 0.0, -SEMI_MINOR - 10.0)),
    ],
)
def test_places_that_are_known(geodetic: tuple[float, ...], ecef: tuple[float, ...]) -> None:
    found = ecef_from_geodetic(torch.tensor(geodetic, dtype=torch.float64))
    torch.testing.assert_close(found, torch.tensor(ecef, dtype=torch.float64), atol=1e-8, rtol=0)


def test_the_altitude_is_along_the_normal_of_the_ellipsoid() -> None:
    """Which is how geodetic positions are defined: the foot lies on the ellipse, and the gradient of that points up."""
    geodetic = places()
    foot = ecef_from_geodetic(geodetic * torch.tensor((1.0, 1.0, 0.0), dtype=torch.float64))
    axes = torch.tensor((6378137.0, 6378137.0, SEMI_MINOR), dtype=torch.float64)
    torch.testing.assert_close((foot / axes).square().sum(-1), torch.ones(50).double(), atol=1e-14, rtol=0)
    normal = foot / axes.square()
    normal = normal / normal.norm(dim=-1, keepdim=True)
    expected = foot + geodetic[:, 2:] * normal
    torch.testing.assert_close(ecef_from_geodetic(geodetic), expected, atol=1e-7, rtol=0)
    torch.testing.assert_close(ecef_from_local(geodetic)[:, :3, 2], normal, atol=1e-14, rtol=0)


def test_there_and_back() -> None:
    geodetic = places()
    back = geodetic_from_ecef(ecef_from_geodetic(geodetic))
    torch.testing.assert_close(back[:, :2], geodetic[:, :2], atol=1e-12, rtol=0)  # a tenth of a micrometer
    torch.testing.assert_close(back[:, 2], geodetic[:, 2], atol=1e-7, rtol=0)
    origin = torch.tensor((48.98, 8.39, 112.8), dtype=torch.float64)
    positions_e = 1e4 * torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = enu_from_geodetic(geodetic_from_enu(positions_e, origin), origin)
    torch.testing.assert_close(found, positions_e, atol=1e-7, rtol=0)


def test_a_local_frame_is_east_north_up() -> None:
    origin = torch.tensor((48.98, 8.39, 112.8), dtype=torch.float64)
    T = ecef_from_local(origin)
    assert float(so3_log(T[:3, :3] @ T[:3, :3].mT).norm()) < 1e-12
    assert float(torch.linalg.det(T[:3, :3])) == pytest.approx(1)
    steps = torch.tensor(((0, 0, 0), (0, 1e-6, 0), (1e-6, 0, 0), (0, 0, 1)), dtype=torch.float64)
    found = enu_from_geodetic(origin + steps, origin)
    # A microdegree of latitude is 0.11 m, of longitude the cosine of the latitude less.
    expected = torch.tensor(((0, 0, 0), (0.07319, 0, 0), (0, 0.11121, 0), (0, 0, 1)), dtype=torch.float64)
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=0)


def test_gradients() -> None:
    geodetic = places(4).requires_grad_()
    origin = torch.tensor((48.98, 8.39, 112.8), dtype=torch.float64, requires_grad=True)
    positions_e = torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    assert gradcheck(lambda x: ecef_from_geodetic(x) / 1e6, (geodetic,), eps=1e-5)
    scale = torch.tensor((1e6, 1e6, 1.0), dtype=torch.float64)
    ecef = (ecef_from_geodetic(geodetic.detach()) / 1e6).requires_grad_()
    assert gradcheck(lambda x: geodetic_from_ecef(x * 1e6) / scale, (ecef,), eps=1e-7, atol=1e-4)
    near = (origin.detach() + 1e-3 * positions_e).requires_grad_()
    assert gradcheck(lambda x, o: enu_from_geodetic(x, o) / 1e5, (near, origin), eps=1e-6, atol=1e-6)
    far = (100 * positions_e).requires_grad_()
    assert gradcheck(lambda x: geodetic_from_enu(x, origin.detach()), (far,), eps=10.0, atol=1e-8)
    assert gradcheck(lambda o: geodetic_from_enu(far.detach(), o), (origin,), eps=1e-3, atol=1e-5)
