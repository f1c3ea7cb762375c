"""RANSAC with local optimization, seeded and batched, as all robust estimators use it.

Samples, scores, the search over rounds, significance tests, and a small batched Levenberg-Marquardt for the local
optimization. Differentiable least squares are in `torchslam.optim`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchslam.geometry.camera import Camera
from torchslam.geometry.lie import cayley_rotation, identity
from torchslam.geometry.precision import check_positive

ModelState = tuple[Tensor, ...]
Problems = TypeVar("Problems")

CONFIDENCE = 0.9999
"""Default of searches: probability that some sample has no outlier. Tried at this value only."""
# Rows this many thresholds from a model support it: noise about as large as the threshold stays within.
SUPPORT_WIDTH = 2.0
_MAX_VALUES_AT_ONCE, _SAMPLES_AT_ONCE = 300_000, 1024
"""Residuals in memory, and minimal samples solved, at once: they bound the memory. Tried at these values only."""
# From this many residuals on, models are compared on some rows first, and some models then on all.
_PREVIEW_FROM, _PREVIEW_ROWS, _PREVIEW_MODELS = 100_000, 80, 32


_FEW_PLACES = 12
"""Distinct rows from which on repeated ones do not matter: as many are significant for every model here, unless nearly
all rows are wrong. Tried at this value only."""


def check_search(threshold: float, confidence: float, max_samples: int, min_samples: int = 1) -> None:
    """Raises ValueError for options of a search that make no sense."""
    check_positive(threshold=threshold, min_samples=min_samples, max_samples=max_samples)
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be a probability, above 0 and below 1, not {confidence}")


def levenberg_marquardt(
    state: ModelState,
    evaluate: Callable[..., tuple[Tensor, Tensor]],
    retract: Callable[[ModelState, Tensor], ModelState],
    iterations: int,
) -> tuple[ModelState, Float[Tensor, " B"]]:
    """Minimize many small problems (B) at once, each with its own damping; return the state and its cost.

    Stops once no problem can gain more than 1e-11 of its cost. Problems that become singular or NaN keep their last
    good state.

    Args:
        evaluate: state -> (A, cost): A (B, D + 1, D + 1) is [J r]^T W [J r], and cost (B,) what must not grow.
        retract: state, step (B, D) -> state.
    """
    A, cost = evaluate(*state)
    damping = torch.full_like(cost, 1e-4)[:, None, None]
    less, more = cost.new_tensor((0.1, 10.0), dtype=torch.float32).unbind()
    eye = identity(A.shape[-1] - 1, A.dtype, A.device)
    for iteration in range(iterations):
        H, g = A[:, :-1, :-1], A[:, :-1, -1]
        step = torch.linalg.solve_ex(torch.addcmul(H, H * eye, damping), g)[0].neg_()
        moved = retract(state, step)
        if iteration >= 2:
            gain = (g * step).sum(-1).abs()
            if bool((gain <= 1e-11 * cost).all()):  # too little to be worth a check
                return _select(gain < torch.inf, moved, state), cost
        A_moved, cost_moved = evaluate(*moved)
        better = cost_moved < cost
        A, cost, *rest = _select(better, (A_moved, cost_moved, *moved), (A, cost, *state))
        state = tuple(rest)
        damping = damping * torch.where(better, less, more)[:, None, None]
    return state, cost


def in_chunks(
    function: Callable[..., tuple[Tensor, ...]], numbers: int, *tensors: Shaped[Tensor, "B ..."]
) -> tuple[Tensor, ...]:
    """Call function(*tensors) for a few problems at a time, so that intermediate results stay in the cache.

    numbers: values of the function's largest intermediate result per problem
    """
    size = max(1, _MAX_VALUES_AT_ONCE // numbers)
    if len(tensors[0]) <= size:
        return function(*tensors)
    parts = [function(*part) for part in zip(*(x.split(size) for x in tensors), strict=True)]
    return tuple(torch.cat(x) for x in zip(*parts, strict=True))


def best_of(state: ModelState, cost: Float[Tensor, "B K"]) -> tuple[ModelState, Float[Tensor, " B"]]:
    """The candidate of least cost of each problem, and that cost; state: tensors (B, K, ...)."""
    cost, best = cost.nan_to_num(torch.inf).min(dim=1)
    index = torch.arange(len(best), device=best.device)
    return tuple(x[index, best] for x in state), cost


def _select(condition: Bool[Tensor, " B"], new: ModelState, old: ModelState) -> ModelState:
    """New values where the condition holds. All batched over the first dimension."""
    return tuple(
        torch.where(condition.view(-1, *(1,) * (x.dim() - 1)), x, y) for x, y in zip(new, old, strict=True)
    )


def retract_pose(pose: ModelState, step: Float[Tensor, "B D"]) -> ModelState:
    """Perturb [R t], or [sR t], (B, 3, 4), by [rho, omega] or [rho, omega, sigma] from the left."""
    turn = cayley_rotation(step[:, 3:6])
    if step.shape[-1] == 7:
        turn = turn * step[:, 6, None, None].exp()
    return (torch.baddbmm(torch.nn.functional.pad(step[:, :3, None], (3, 0)), turn, pose[0]),)


def pose_rows(
    J: Float[Tensor, "*batch R 3"], points: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch R 6"]:
    """Derivatives by [rho, omega] from the left of what depends on moved points by J."""
    return torch.cat((J, torch.linalg.cross(points[..., None, :].expand_as(J), J, dim=-1)), dim=-1)


def some_problems(problems: Problems, rows: Int[Tensor, " R"]) -> Problems:
    """Some of a dataclass of tensors and cameras with one leading dimension."""
    values: dict[str, Any] = {each.name: getattr(problems, each.name) for each in fields(problems)}  # type: ignore[arg-type]
    chosen = {name: x[rows] for name, x in values.items() if isinstance(x, Tensor | Camera)}
    return replace(problems, **chosen)  # type: ignore[type-var]


def sample_minimal(
    mask: Bool[Tensor, "B N"], size: int, count: int, generator: torch.Generator
) -> Int[Tensor, "B {count} {size}"]:
    """Row numbers of random minimal samples without repeated rows, but where the mask has fewer than `size`.

    Random permutations are cut into disjoint samples, which spreads the samples over all rows. The random numbers come
    from the CPU, so that every device draws the same ones.
    """
    B, N = mask.shape
    available = mask.sum(-1)
    per_permutation = (available // size).clamp_min(1)
    permutations = math.ceil(count / int(per_permutation.min()))
    # Many permutations of few rows are cheap; of many rows few are needed.
    keys = torch.rand(B, permutations, N, generator=generator, dtype=torch.float32, device="cpu")
    order = torch.where(mask[:, None], keys.to(mask.device), 2.0).argsort(-1).flatten(1)
    sample = torch.arange(count, device=mask.device)
    start = sample // per_permutation[:, None] * N + sample % per_permutation[:, None] * size
    place = torch.arange(size, device=mask.device) % available.clamp_min(1)[:, None, None]
    position = start[..., None] + place
    return order.gather(1, position.flatten(1)).unflatten(1, (count, size))


def sample_minimal_of_all(
    rows: int, size: int, count: int, generator: torch.Generator
) -> Int[Tensor, "{count} {size}"]:
    """The samples of `sample_minimal` for one problem whose mask has all rows, in few calls."""
    each = rows // size
    permutations = math.ceil(count / each)
    order = torch.rand(permutations, rows, generator=generator, dtype=torch.float32, device="cpu").argsort(1)
    return order[:, : size * each].reshape(-1, size)[:count]


def best_models(
    score: Callable[[Tensor, Tensor | None], Tensor],
    models: Float[Tensor, "B K D"],
    valid: Bool[Tensor, "B K"],
    mask: Bool[Tensor, "B N"],
    count: int,
    generator: torch.Generator,
) -> Int[Tensor, "B {count}"]:
    """Indices of the best of many models, which first have to do well on a random part of the rows.

    score: (models (B, K, D), row numbers (B, n) or None for all) -> (B, K)
    """
    few = min(mask.shape[1] // _PREVIEW_ROWS, models.shape[1] // _PREVIEW_MODELS) < 2
    if few or models.shape[0] * models.shape[1] * mask.shape[1] < _PREVIEW_FROM:
        return torch.where(valid, score(models, None), -1.0).topk(count, dim=1).indices
    rows = sample_minimal(mask, _PREVIEW_ROWS, 1, generator)[:, 0]
    preview = torch.where(valid, score(models, rows), -1.0).topk(_PREVIEW_MODELS, dim=1).indices
    final = torch.where(valid.gather(1, preview), score(gather_rows(models, preview), None), -1.0)
    return preview.gather(1, final.topk(count, dim=1).indices)


def samples_needed(
    inliers: Int[Tensor, " B"], available: Int[Tensor, " B"], size: int, confidence: float
) -> Float[Tensor, " B"]:
    """Number of samples that contain, with the given confidence, one without outliers; computed on the host."""
    ratios = [k / max(n, 1) for k, n in zip(inliers.tolist(), available.tolist(), strict=True)]
    clean = [min(max(ratio, 1e-6), 1 - 1e-6) ** size for ratio in ratios]
    needed = [math.log(1 - confidence) / math.log1p(-min(share, 1 - 1e-6)) for share in clean]
    return torch.tensor(needed, dtype=torch.float64, device="cpu")


def gather_rows(
    values: Shaped[Tensor, "B N D"], indices: Int[Tensor, "B *rows"]
) -> Shaped[Tensor, "B *rows D"]:
    """Rows of each element of a batch."""
    flat = indices.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).unflatten(1, indices.shape[1:])


def truncated_score(squared: Float[Tensor, "B K N"], mask: Bool[Tensor, "B N"]) -> Float[Tensor, "B K"]:
    """Sum of 1 - min(r^2, 1) over the rows in use (MSAC; Torr and Zisserman, "MLESAC", 2000), higher is better.

    squared: residuals in units of the threshold, which are overwritten; NaN counts as an outlier
    """
    weights = mask.to(squared.dtype)[..., None]
    cost = squared.clamp_max_(1.0).nan_to_num_(1.0) @ weights
    return (weights.sum(1, keepdim=True) - cost).squeeze(-1)


def truncated_rows(
    squared: Float[Tensor, "B K N"], mask: Bool[Tensor, "B N"], width: float
) -> tuple[Bool[Tensor, "B K N"], Float[Tensor, "B K"]]:
    """Rows in use, and the truncated cost, of squared residuals."""
    cost = torch.where(mask[:, None], squared.clamp_max(width * width), 0.0).sum(-1)
    return (squared < width * width) & mask[:, None], cost


def search(
    propose: Callable[[Tensor, int], tuple[ModelState, Tensor, Tensor]],
    available: Int[Tensor, " B"],
    size: int,
    confidence: float,
    first_round: int,
    max_samples: int,
    as_needed: bool = False,
) -> ModelState:
    """The best model of each problem over rounds of samples, until its support calls for no more of them.

    Args:
        propose: (rows (R,) of the problems still open, number of samples) -> their best new models (R, ...), scores
            (R,), the higher the better, and support (R,), the number of rows within SUPPORT_WIDTH thresholds.
        available: rows in use per problem.
        size: of a minimal sample.
        confidence: probability that some sample has no outlier.
        first_round: samples of the first round; every round draws twice as many as the one before.
        as_needed: draw no more than the support calls for, but at least as many as in the first round.
    """

    def propose_in_chunks(rows: Int[Tensor, " R"], count: int) -> tuple[ModelState, Tensor, Tensor]:
        """Few problems at a time, so that what they compute stays in the cache."""
        if len(rows) * count <= _SAMPLES_AT_ONCE:
            return propose(rows, count)
        parts = [propose(part, count) for part in rows.split(max(1, _SAMPLES_AT_ONCE // count))]
        models, scores, supports = zip(*parts, strict=True)
        return tuple(torch.cat(x) for x in zip(*models, strict=True)), torch.cat(scores), torch.cat(supports)

    rows = torch.arange(len(available), device=available.device)
    models, best, support = propose_in_chunks(rows, first_round)
    drawn, count = first_round, first_round
    while drawn < max_samples:
        needed = samples_needed(support, available, size, confidence)
        rows = (needed > drawn).nonzero().squeeze(-1).to(available.device)
        if len(rows) == 0:
            break
        count = min(2 * count, max_samples - drawn)
        if as_needed:
            count = min(count, max(first_round, math.ceil(float(needed.max())) - drawn))
        drawn += count
        new, score, new_support = propose_in_chunks(rows, count)
        better = score > best[rows]
        rows = rows[better]
        models = tuple(old.index_copy(0, rows, x[better]) for old, x in zip(models, new, strict=True))
        best = best.index_copy(0, rows, score[better])
        support = support.index_copy(0, rows, new_support[better])
    return models


def is_significant(
    inliers: Int[Tensor, " B"],
    available: Int[Tensor, " B"],
    size: int,
    chance: Float[Tensor, " B"],
    solutions: int,
) -> Bool[Tensor, " B"]:
    """Test whether inliers are significant: fewer than 0.001 false alarms expected among wrong matches.

    Source: Moisan and Stival, "A probabilistic criterion to detect rigid point matches between two images", 2004.

    available: rows in use; size: of a minimal sample; chance: that a wrong row fits a model; solutions: per sample
    """

    def log_false_alarms(inliers: int, available: int, chance: float) -> float:
        if inliers <= size:
            return math.inf
        # available over inliers times inliers over size, without what cancels
        rest, others = max(available - inliers, 0), inliers - size
        choices = math.lgamma(available + 1) - math.lgamma(rest + 1) - math.lgamma(others + 1)
        alarms = choices - math.lgamma(size + 1) + others * math.log(min(max(chance, 1e-12), 1.0))
        return alarms + math.log(solutions * max(available - size, 1))

    return _is_below(1e-3, log_false_alarms, inliers, available, chance)


def count_distinct(
    rows: Float[Tensor, "B N D"], inliers: Bool[Tensor, "B N"], available: Int[Tensor, " B"]
) -> tuple[Int[Tensor, " B"], Int[Tensor, " B"]]:
    """Count inliers and rows in use for `is_significant`, where rows that repeat a few places are not independent.

    Inliers at fewer than `_FEW_PLACES` places count as that many, and the rows in use by the same ratio.

    rows: in units of the distance from which on two rows are distinct; available: rows in use
    """
    count, (B, N) = inliers.sum(-1), inliers.shape
    far = torch.where(inliers, torch.inf, 0.0).to(rows.dtype)  # squared distance to the nearest place so far
    places, index = torch.zeros_like(count), torch.arange(B, device=rows.device)
    for _ in range(min(_FEW_PLACES, N)):
        farthest, row = far.max(-1)
        places += farthest > 1
        distance = (rows - rows[index, row][:, None]).square().sum(-1)
        far = torch.where(inliers, torch.minimum(far, distance), 0.0)
    few = places < _FEW_PLACES
    scaled = (available * places / count.clamp_min(1)).round().to(available.dtype)
    return torch.where(few, places, count), torch.where(few, scaled, available)


def _is_below(limit: float, log_alarms: Callable[..., float], *of_problems: Tensor) -> Bool[Tensor, " B"]:
    """Which problems have fewer false alarms. Computed on the host, where a number costs less than a call."""
    problems = zip(*(x.tolist() for x in of_problems), strict=True)
    found = [log_alarms(*each) < math.log(limit) for each in problems]
    return torch.tensor(found, dtype=torch.bool, device=of_problems[0].device)


def is_unlikely(
    count: Int[Tensor, " B"], available: Int[Tensor, " B"], size: int, chance: Float[Tensor, " B"]
) -> Bool[Tensor, " B"]:
    """Test whether rows support a richer model against a simpler one: fewer than 0.1 false alarms expected.

    As `is_significant`, for chances that need not be small: the tail of the binomial distribution over the rows
    beyond a sample is bounded by Chernoff's inequality.
    """

    def log_tail_alarms(count: int, available: int, chance: float) -> float:
        """The number of samples, times the chance of this many inliers among the other rows."""
        rest = available - size
        share = (count - size) / rest if rest > 0 else 0.0
        chance = max(chance, 1e-12)
        if share <= chance:
            return math.inf
        divergence = share * math.log(share / chance)
        if share < 1:
            divergence += (1 - share) * math.log((1 - share) / (1 - chance))
        return math.log(math.comb(available, size)) - rest * divergence

    return _is_below(0.1, log_tail_alarms, count, available, chance)


def leave_a_line(points: Float[Tensor, "B N 3"], inliers: Bool[Tensor, "B N"]) -> Bool[Tensor, " B"]:
    """Test whether the inliers are not all on one line: their second variance is more than rounding."""
    rows = inliers[..., None]
    mean = torch.where(rows, points, 0.0).sum(1, keepdim=True) / rows.sum(1, keepdim=True).clamp_min(1)
    centered = torch.where(rows, points - mean, 0.0)
    spread = torch.linalg.eigvalsh(centered.mT @ centered)
    return spread[:, 1] > 1e-6 * spread[:, 2]


def valid_first(valid: Bool[Tensor, "B N"]) -> Int[Tensor, "B R"]:
    """Row numbers with the valid rows first, cut to the largest count in the batch."""
    count = max(1, int(valid.sum(-1).max()))
    return valid.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[:, :count]


def pad_groups(
    values: Float[Tensor, "R D"], group: Int[Tensor, " R"], groups: int, least: int
) -> tuple[Float[Tensor, "{groups} K D"], Bool[Tensor, "{groups} K"]]:
    """Values in ascending order of their group as rows of a tensor, `least` or more, zero where padded; with a mask."""
    counts = torch.bincount(group, minlength=groups)
    size = max(least, int(counts.max()))
    start = counts.cumsum(0) - counts
    slot = group * size + torch.arange(len(group), device=group.device) - start[group]
    padded = values.new_zeros(groups * size, values.shape[-1]).index_copy(0, slot, values)
    valid = torch.arange(size, device=group.device) < counts[:, None]
    return padded.unflatten(0, (groups, size)), valid
