"""A noise model from the residuals of whole runs, by likelihood; and from their trajectories, by their gradient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from experiments.learned_weights.noise.graphs import LEAST_KNOWN, Example
from experiments.learned_weights.noise.model import NoiseModel
from torchslam.evaluation import ate
from torchslam.geometry import transform
from torchslam.geometry.robust import robustify
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.run_graph import GraphSolution, solve_graph

BEND = 2.45
"""Of the Huber kernel, in standard deviations: 95 % of the norms of two standard normal numbers lie below it."""
LEAST_VIEWS = 4
"""Keyframes of a point whose residuals are learned from: points that fewer see follow the noise of each."""
USUAL = 8.0
"""Information times scale squared to start from: ORB is right to a third of a scale, see experiments/front_ends."""


@dataclass(frozen=True)
class Settings:
    """rounds: of solving all graphs and fitting their residuals; steps and rates: of Adam, in each of these rounds and
    along trajectories; observations: of each run, drawn by the seed; decay: what the squares of the model's weights
    cost, in units of the mean loss
    """

    rounds: int = 2
    likelihood_steps: int = 150
    likelihood_rate: float = 0.03
    trajectory_steps: int = 12
    trajectory_rate: float = 0.05
    observations: int = 2500
    decay: float = 3e-4
    seed: int = 0


@dataclass(frozen=True)
class Residuals:
    """Of n observations: errors (n, 2) in scales, corrected for the fitted points; their cues; shares (n,) by
    which they count in a mean; frames (n,), the keyframe of its run that each is in."""

    errors: Tensor
    values: Tensor
    directions: Tensor
    shares: Tensor
    frames: Tensor

    def drawn(self, count: int, seed: int) -> Residuals:
        """Some of them, at random."""
        order = torch.randperm(len(self.errors), generator=torch.Generator().manual_seed(seed))[:count]
        return self.at(order)

    def at(self, rows: Tensor) -> Residuals:
        """Those of some rows, by index or mask."""
        return Residuals(*(getattr(self, each.name)[rows] for each in fields(self)))

    @classmethod
    def cat(cls, parts: Sequence[Residuals]) -> Residuals:
        """Of several runs, which count alike."""
        columns = {each.name: torch.cat([getattr(part, each.name) for part in parts]) for each in fields(cls)}
        columns["shares"] = torch.cat([part.shares / part.shares.sum() for part in parts]) / len(parts)
        return cls(**columns)


def weighed(example: Example, model: NoiseModel) -> Example:
    """The run with the information of the model in place of that of the hand-set rule, scale^-2."""
    graph = example.graph
    weights = model(example.values, example.directions, 1 / graph.weights, graph.frame_index)
    return replace(example, graph=replace(graph, weights=weights))


def solved(example: Example) -> Example:
    """The run at the minimum of its graph."""
    solution = solve_graph(
        example.graph, options=GRAPH_OPTIONS.replace(kernel="huber", scale=BEND, backward="detached")
    )
    return replace(example, graph=replace(example.graph, T_cw=solution.T_cw, points_w=solution.points_w))


@torch.no_grad()
def residuals(example: Example, informed: Example) -> Residuals:
    """Of the keyframes of a solved run; informed: the same with the weights that it was solved with.

    An error is divided by the square root of one minus its leverage, the share of it that its own point follows.
    """
    graph, weights = informed.graph, informed.graph.weights
    frames, points_w = graph.T_cw[graph.frame_index], graph.points_w[graph.point_index]
    pixels, valid, J_c = graph.camera.project_with_point_jacobians(transform(frames, points_w[:, None])[:, 0])
    J = J_c @ frames[:, :3, :3]
    if weights.ndim == 1:
        weights = weights[:, None, None] * torch.eye(2, dtype=weights.dtype)
    H = weights.new_zeros(len(graph.points_w), 3, 3).index_add(0, graph.point_index, J.mT @ weights @ J)
    views = torch.bincount(graph.point_index, minlength=len(H))[graph.point_index]
    kept = valid & (views >= LEAST_VIEWS)
    J, weights, H = J[kept], weights[kept], H[graph.point_index[kept]]
    leverage = (weights * (J @ torch.linalg.solve(H, J.mT))).sum((-2, -1)) / 2
    inverse_scale = example.graph.weights[kept].sqrt()  # of the hand-set rule
    errors = (pixels - graph.pixels)[kept] * (inverse_scale / (1 - leverage).clamp_min(0.1).sqrt())[:, None]
    shares = torch.full_like(errors[:, 0], 1 / len(errors))
    return Residuals(errors, example.values[kept], example.directions[kept], shares, graph.frame_index[kept])


def losses(model: NoiseModel, found: Residuals) -> Tensor:
    """(n,) negative log-likelihoods but for a constant; the kernel is the logarithm of their density.

    Of models without a level of the image: these say nothing of how large errors are.
    """
    ones = found.errors.new_ones(len(found.errors))
    weights = model(found.values, found.directions, ones, torch.zeros_like(ones, dtype=torch.int64))
    if weights.ndim == 1:
        squared = weights * found.errors.square().sum(-1)
        log_determinant = 2 * weights.log()
    else:
        squared = (found.errors[:, None] @ weights @ found.errors[..., None])[:, 0, 0]
        log_determinant = 2 * model.log_factor(found.values)  # powers are of determinant one
    rho = robustify(squared, "huber", squared.new_tensor(BEND)).rho
    return 0.5 * (rho - log_determinant)


def negative_log_likelihood(model: NoiseModel, found: Residuals) -> Tensor:
    """The mean of `losses` over observations, by their shares."""
    return (found.shares / found.shares.sum() * losses(model, found)).sum()


def fit_residuals(model: NoiseModel, found: Residuals, settings: Settings) -> None:
    """Move a model to where residuals are most likely."""
    optimizer = torch.optim.Adam(model.parameters(), settings.likelihood_rate)
    for _ in range(settings.likelihood_steps):
        optimizer.zero_grad()
        decay = torch.stack([each.square().sum() for each in (model.line, model.outer, model.inner)]).sum()
        (negative_log_likelihood(model, found) + settings.decay * decay).backward()
        optimizer.step()


def fit_likelihood(examples: Sequence[Example], kind: str, settings: Settings) -> NoiseModel:
    """A model under which the residuals of whole runs are most likely, each run counted alike."""
    model = NoiseModel(kind, settings.seed)
    with torch.no_grad():
        model.level.fill_(math.log(USUAL))
    model.standardize(torch.cat([example.values for example in examples]))
    for _ in range(settings.rounds):
        with torch.no_grad():
            pairs = [(example, solved(weighed(example, model))) for example in examples]
        parts = [residuals(*pair).drawn(settings.observations, settings.seed) for pair in pairs]
        fit_residuals(model, Residuals.cat(parts), settings)
    return model


def at_level(model: NoiseModel, level: float) -> NoiseModel:
    """The same model, restricted to the relative accuracy of keypoints within an image."""
    found = NoiseModel(model.kind)
    found.load_state_dict(model.state_dict())
    found.level_of_image.fill_(level)
    return found


def position_error(example: Example, solution: GraphSolution) -> Tensor:
    """ATE in meters of the frames whose truth is known, differentiable. Raises ValueError for too few."""
    if int(example.known.sum()) < LEAST_KNOWN:
        raise ValueError(f"{int(example.known.sum())} keyframes with true poses: they teach no trajectory")
    return ate(T_cw=solution.T_cw[example.known], T_cw_groundtruth=example.T_cw[example.known])


def fit_trajectories(model: NoiseModel, examples: Sequence[Example], settings: Settings) -> NoiseModel:
    """The model moved on, along the gradient of the mean logarithm of the ATE through the solutions of the graphs."""
    found = NoiseModel(model.kind, settings.seed)
    found.load_state_dict(model.state_dict())
    optimizer = torch.optim.Adam(found.parameters(), settings.trajectory_rate)
    now = list(examples)
    for _ in range(settings.trajectory_steps):
        optimizer.zero_grad()
        for row, example in enumerate(now):
            informed = weighed(example, found)
            solution = solve_graph(
                informed.graph,
                options=GRAPH_OPTIONS.replace(kernel="huber", scale=BEND, iterations=10, tolerance=1e-8),
            )
            (position_error(example, solution).log() / len(now)).backward()
            # The next step starts where this one ended.
            graph = replace(example.graph, T_cw=solution.T_cw.detach(), points_w=solution.points_w.detach())
            now[row] = replace(example, graph=graph)
        optimizer.step()
    return found
