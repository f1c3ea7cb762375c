"""A factor with learned parameters in the graph of a real run."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from torchslam import SLAM, GraphSolution, open_sequence, solve_graph
from torchslam.evaluation import ate
from torchslam.geometry import se3_inverse
from torchslam.optim import GRAPH_OPTIONS, Factors

STEP = 0.005
"""Of the parameters, along their gradient; twice and once it are extrapolated. Steps of a tenth of it are limited by
the searches, ten times larger ones by the extrapolation, both at some 1e-7."""


class Wheels(nn.Module):
    """An error of the distance between two frames, with a correction by the angle between them."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(2, 8), nn.Tanh(), nn.Linear(8, 1)).double()

    def forward(self, T_1w: Tensor, T_2w: Tensor, distances: Tensor) -> Tensor:
        first, second = (se3_inverse(T)[..., :3, 3] for T in (T_1w, T_2w))
        error = ((second - first).norm(dim=-1) / distances).log()
        turn = 3 - (T_2w[..., :3, :3] * T_1w[..., :3, :3]).sum((-1, -2))
        return error[..., None] + self.net(torch.stack((turn, error), dim=-1))


@pytest.mark.data
@pytest.mark.slow
def test_the_gradient_to_a_module_is_that_of_solving_again(data_dir: Path) -> None:
    """Of the ATE on shelf_bin, at the default tolerance, along the gradient."""
    sequence = open_sequence(data_dir / "shelf_bin")
    graph = SLAM(sequence.camera).run(sequence).graph
    keyframes = graph.is_keyframe.nonzero()[:, 0]
    pairs = torch.stack((keyframes[:-1], keyframes[1:]), dim=-1)
    generator = torch.Generator().manual_seed(0)
    noise = 0.02 * torch.randn(len(pairs), generator=generator, dtype=torch.float64)
    distances = se3_inverse(graph.T_cw)[keyframes, :3, 3].diff(dim=0).norm(dim=-1) * noise.exp()
    information = torch.full((len(pairs), 1, 1), 1e4, dtype=torch.float64)
    poses = [sequence.pose(index) for index in graph.frame_ids.tolist()]
    truth = torch.stack([pose for pose in poses if pose is not None])
    torch.manual_seed(0)
    module = Wheels()

    def solved(tolerance: float, start: GraphSolution | None = None) -> GraphSolution:
        options = GRAPH_OPTIONS.replace(tolerance=tolerance, strict=True)
        factors = [Factors(pairs, distances, information, module)]
        return solve_graph(graph, factors=factors, options=options, start=start)

    def loss(solution: GraphSolution) -> Tensor:
        return ate(T_cw=solution.T_cw, T_cw_groundtruth=truth)

    found = solved(GRAPH_OPTIONS.tolerance)
    gradient = torch.cat(
        [part.flatten() for part in torch.autograd.grad(loss(found), list(module.parameters()))]
    )
    direction = gradient / gradient.norm()
    center = nn.utils.parameters_to_vector(module.parameters()).detach()

    @torch.no_grad()
    def at(step: float) -> Tensor:
        nn.utils.vector_to_parameters(center + step * direction, module.parameters())
        return loss(solved(1e-20, found))

    near, far = ((at(step) - at(-step)) / (2 * step) for step in (STEP, 2 * STEP))
    torch.testing.assert_close(gradient.norm(), (4 * near - far) / 3, rtol=1e-5, atol=0)
