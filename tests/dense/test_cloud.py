from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchslam.dense import PointCloud
from torchslam.geometry import so3_exp


@pytest.fixture
def cloud(generator: torch.Generator) -> PointCloud:
    """A square of 30 x 30 points, 0.1 apart, which faces z; row by row."""
    grid = 0.1 * torch.arange(30.0)
    points_w = torch.nn.functional.pad(torch.cartesian_prod(grid, grid), (0, 1))
    normals_w = torch.tensor([0.0, 0.0, 1.0]).expand(900, 3).contiguous()
    colors = torch.randint(0, 256, (900, 3), generator=generator, dtype=torch.uint8)
    return PointCloud(points_w, normals_w, colors, torch.rand(900, generator=generator))


def test_a_thinned_cloud_has_rows_of_the_cloud_in_their_order(cloud: PointCloud) -> None:
    few = cloud.thinned(100)
    assert len(few) == 100
    rows = (few.points_w * torch.tensor([300.0, 10.0, 0.0])).sum(dim=-1).round().long()
    assert bool((rows.diff() > 0).all())
    for name in ("points_w", "normals_w", "colors", "confidence"):
        assert torch.equal(getattr(few, name), getattr(cloud, name)[rows]), name
    assert torch.equal(cloud.thinned(100).points_w, few.points_w)
    assert cloud.thinned(900) is cloud
    columns = rows % 30
    assert len(columns.unique()) > 25, "every n-th row would leave stripes"


def test_points_and_normals_turn_together(cloud: PointCloud) -> None:
    R = so3_exp(torch.tensor([0.4, 1.0, -2.0], dtype=torch.float64))
    turned = cloud.turned(R)
    torch.testing.assert_close(turned.points_w, cloud.points_w @ R.float().mT)
    torch.testing.assert_close(turned.normals_w[0], R[:, 2].float())
    torch.testing.assert_close(turned.turned(R.mT).points_w, cloud.points_w, atol=1e-6, rtol=0)


def test_the_spacing_is_that_of_the_grid(cloud: PointCloud) -> None:
    assert cloud.spacing() == pytest.approx(0.1, rel=1e-3)
    assert replace(cloud, points_w=7 * cloud.points_w).spacing() == pytest.approx(0.7, rel=1e-3)
    assert cloud[torch.arange(3)].spacing() == 0.0
