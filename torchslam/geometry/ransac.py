"""RANSAC with local optimization, seeded and batched, as all robust estimators use it.

Samples, scores, the search over rounds, significance tests, and a small batched Levenberg-Marquardt for the local
optimization. Differentiable least squares are in `torchslam.optim`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchslam.geometry.lie import cayley_rotation, identity

ModelState = tuple[Tensor, ...]

_MAX_VALUES_AT_ONCE = 300_000
_MIN_ITERATIONS = 2  # before it may stop


def levenberg_marquardt(
    state: ModelState,
    evaluate: Callable[..., tuple[Tensor, Tensor]],
    retract: Callable[[ModelState, Tensor], ModelState],
    iterations: int,
) -> tuple[ModelState, Tensor]:
    """Minimize many small problems at once, each with its own damping.

    state:    tensors with one leading dimension (P), the problems
    evaluate: state -> (A, cost): A (P, D + 1, D + 1) is [J r]^T W [J r], and cost (P,) what must not grow
    retract:  state, step (P, D) -> state
    Stops once no problem can gain more than 1e-11 of its cost. Returns the state and its cost; problems that become
    singular or NaN keep their last good state.
    """
    A, cost = evaluate(*state)
    damping = torch.full_like(cost, 1e-4)[:, None, None]
    eye = identity(A.shape[-1] - 1, A.dtype, A.device)
    for iteration in range(iterations):
        H, g = A[:, :-1, :-1], A[:, :-1, -1]
        step = torch.linalg.solve_ex(torch.addcmul(H, H * eye, damping), g)[0].neg_()
        moved = retract(state, step)
        if iteration >= _MIN_ITERATIONS:
            gain = (g * step).sum(-1).abs()
            if bool((gain <= 1e-11 * cost).all()):  # too little to be worth a check
                return _select(gain < torch.inf, moved, state), cost
        A_moved, cost_moved = evaluate(*moved)
        better = cost_moved < cost
        A, cost, *rest = _select(better, (A_moved, cost_moved, *moved), (A, cost, *state))
        state = tuple(rest)
        damping = damping * torch.where(better, 0.1, 10.0)[:, None, None]
    return state, cost


def in_chunks(
    function: Callable[..., tuple[Tensor, ...]], numbers: int, *tensors: Tensor
) -> tuple[Tensor, ...]:
    """Call function(*tensors) for a few problems at a time, so that intermediate results stay in the cache.

    numbers: values of the function's largest intermediate result per problem
    """
    size = max(1, _MAX_VALUES_AT_ONCE // numbers)
    if len(tensors[0]) <= size:
        return function(*tensors)
    parts = [function(*part) for part in zip(*(x.split(size) for x in tensors), strict=True)]
    return tuple(torch.cat(x) for x in zip(*parts, strict=True))


def best_of(state: ModelState, cost: Tensor) -> tuple[ModelState, Tensor]:
    """The candidate of least cost of each problem. (B, K, ...), (B, K) -> (B, ...), (B,)."""
    cost, best = cost.nan_to_num(torch.inf).min(dim=1)
    index = torch.arange(len(best), device=best.device)
    return tuple(x[index, best] for x in state), cost


def _select(condition: Tensor, new: ModelState, old: ModelState) -> ModelState:
    """New values where the condition holds. All batched over the first dimension."""
    return tuple(
        torch.where(condition.view(-1, *(1,) * (x.dim() - 1)), x, y) for x, y in zip(new, old, strict=True)
    )


def retract_pose(pose: ModelState, step: Tensor) -> ModelState:
    """Perturb [R t] by [rho, omega] from the left. (P, 3, 4), (P, 6) -> (P, 3, 4)."""
    turn = cayley_rotation(step[:, 3:])
    return (torch.baddbmm(torch.nn.functional.pad(step[:, :3, None], (3, 0)), turn, pose[0]),)


# Rows this many thresholds from a model support it: noise about as large as the threshold stays within.
SUPPORT_WIDTH = 2.0
_SAMPLES_AT_ONCE = 1024
# From this many residuals on, models are compared on some rows first, and some models then on all.
_PREVIEW_FROM, _PREVIEW_ROWS, _PREVIEW_MODELS = 100_000, 80, 32


def sample_minimal(mask: Tensor, size: int, count: int, generator: torch.Generator) -> Tensor:
    """Random minimal samples without repeated rows, from the rows inside the mask.

    mask: (B, N). Returns (B, count, size) int64 row numbers. Problems with fewer than `size` rows get repeated
    ones. Random permutations are cut into disjoint samples, which also spreads the samples over all rows. The
    random numbers come from the CPU, so that every device draws the same ones.
    """
    B, N = mask.shape
    available = mask.sum(-1)
    per_permutation = (available // size).clamp_min(1)
    permutations = math.ceil(count / int(per_permutation.min()))
    # Many permutations of few rows are cheap; of many rows few are needed.
    keys = torch.rand(B, permutations, N, generator=generator).to(mask.device)
    order = torch.where(mask[:, None], keys, 2.0).argsort(-1).flatten(1)
    sample = torch.arange(count, device=mask.device)
    start = sample // per_permutation[:, None] * N + sample % per_permutation[:, None] * size
    position = (
        start[..., None] + torch.arange(size, device=mask.device) % available.clamp_min(1)[:, None, None]
    )
    return order.gather(1, position.flatten(1)).unflatten(1, (count, size))


def sample_minimal_of_all(rows: int, size: int, count: int, generator: torch.Generator) -> Tensor:
    """(count, size): the samples of `sample_minimal` for one problem whose mask has all rows, in few calls."""
    each = rows // size
    order = torch.rand(math.ceil(count / each), rows, generator=generator).argsort(1)
    return order[:, : size * each].reshape(-1, size)[:count]


def best_models(
    score: Callable[[Tensor, Tensor | None], Tensor],
    models: Tensor,
    valid: Tensor,
    mask: Tensor,
    count: int,
    generator: torch.Generator,
) -> Tensor:
    """Indices (B, count) of the best of many models, which first have to do well on a random part of the rows.

    score: (models (B, M, D), row numbers (B, n) or None for all) -> (B, M); valid: (B, M); mask: (B, N).
    """
    few = min(mask.shape[1] // _PREVIEW_ROWS, models.shape[1] // _PREVIEW_MODELS) < 2
    if few or models.shape[0] * models.shape[1] * mask.shape[1] < _PREVIEW_FROM:
        return torch.where(valid, score(models, None), -1.0).topk(count, dim=1).indices
    rows = sample_minimal(mask, _PREVIEW_ROWS, 1, generator)[:, 0]
    preview = torch.where(valid, score(models, rows), -1.0).topk(_PREVIEW_MODELS, dim=1).indices
    final = torch.where(valid.gather(1, preview), score(gather_rows(models, preview), None), -1.0)
    return preview.gather(1, final.topk(count, dim=1).indices)


def samples_needed(inliers: Tensor, available: Tensor, size: int, confidence: float) -> Tensor:
    """Number of samples that contain, with the given confidence, one without outliers. (B,), (B,) -> (B,) float64.

    Computed on the host, where a number costs less than a call.
    """
    ratios = [k / max(n, 1) for k, n in zip(inliers.tolist(), available.tolist(), strict=True)]
    clean = [min(max(ratio, 1e-6), 1 - 1e-6) ** size for ratio in ratios]
    needed = [math.log(1 - confidence) / math.log1p(-min(share, 1 - 1e-6)) for share in clean]
    return torch.tensor(needed, dtype=torch.float64)


def gather_rows(values: Tensor, indices: Tensor) -> Tensor:
    """Rows of a batch. (B, N, D), (B, ...) int64 -> (B, ..., D)."""
    flat = indices.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).unflatten(1, indices.shape[1:])


def truncated_score(squared: Tensor, mask: Tensor) -> Tensor:
    """Sum of 1 - min(r^2, 1) over the rows in use (MSAC); `squared` is overwritten.

    squared: (B, M, N) squared residuals in units of the threshold, NaN counted as outliers; mask: (B, N). Returns
    (B, M); higher is better. Source: Torr and Zisserman, "MLESAC", 2000.
    """
    weights = mask.to(squared.dtype)[..., None]
    cost = squared.clamp_max_(1.0).nan_to_num_(1.0) @ weights
    return (weights.sum(1, keepdim=True) - cost).squeeze(-1)


def truncated_rows(squared: Tensor, mask: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """Rows in use, (B, K, N), and the truncated cost, (B, K), of squared residuals (B, K, N)."""
    cost = torch.where(mask[:, None], squared.clamp_max(width * width), 0.0).sum(-1)
    return (squared < width * width) & mask[:, None], cost


def search(
    propose: Callable[[Tensor, int], tuple[ModelState, Tensor, Tensor]],
    available: Tensor,
    size: int,
    confidence: float,
    first_round: int,
    max_samples: int,
    as_needed: bool = False,
) -> ModelState:
    """The best model of each problem over rounds of samples, until its support calls for no more of them.

    propose: (rows (R,) of the problems still open, number of samples) -> their best new models (R, ...), scores (R,)
    the higher the better, and support (R,), the number of rows within SUPPORT_WIDTH thresholds; available: (B,)
    rows in use per problem; size: of a minimal sample. Every round draws twice as many samples as the one before, or,
    `as_needed`, no more than the support calls for, but as many as the first one.
    """

    def propose_in_chunks(rows: Tensor, count: int) -> tuple[ModelState, Tensor, Tensor]:
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


def is_significant(inliers: Tensor, available: Tensor, size: int, chance: Tensor, solutions: int) -> Tensor:
    """Test whether inliers are significant: fewer than 0.001 false alarms expected among wrong matches.

    inliers, available: (B,) counts; chance: (B,) probability that a wrong row fits a model; solutions: models per
    minimal sample of `size` rows. Source: Moisan and Stival, "A probabilistic criterion to detect rigid point
    matches between two images", 2004, eq. for the number of false alarms.
    """
    problems = zip(inliers.tolist(), available.tolist(), chance.tolist(), strict=True)
    logs = [_log_false_alarms(k, n, size, p, solutions) for k, n, p in problems]
    return torch.tensor([log < math.log(1e-3) for log in logs], dtype=torch.bool, device=inliers.device)


def _log_false_alarms(inliers: int, available: int, size: int, chance: float, solutions: int) -> float:
    """For one problem: on the host a number costs less than a call."""
    if inliers <= size:
        return math.inf
    # available over inliers times inliers over size, without what cancels
    rest, others = max(available - inliers, 0), inliers - size
    choices = math.lgamma(available + 1) - math.lgamma(rest + 1) - math.lgamma(others + 1)
    alarms = choices - math.lgamma(size + 1) + others * math.log(min(max(chance, 1e-12), 1.0))
    return alarms + math.log(solutions * max(available - size, 1))


def is_unlikely(count: Tensor, available: Tensor, size: int, chance: Tensor) -> Tensor:
    """Test whether rows support a richer model against a simpler one: fewer than 0.1 false alarms expected.

    As `is_significant`, for chances that need not be small: the tail of the binomial distribution over the rows
    beyond a sample is bounded by Chernoff's inequality.
    """
    problems = zip(count.tolist(), available.tolist(), chance.tolist(), strict=True)
    logs = [_log_tail_alarms(k, n, size, p) for k, n, p in problems]
    return torch.tensor([log < math.log(0.1) for log in logs], dtype=torch.bool, device=count.device)


def _log_tail_alarms(count: int, available: int, size: int, chance: float) -> float:
    """For one problem: the samples there are, times the chance of so many among the other rows."""
    rest = available - size
    share = (count - size) / rest if rest > 0 else 0.0
    chance = max(chance, 1e-12)
    if share <= chance:
        return math.inf
    divergence = share * math.log(share / chance)
    if share < 1:
        divergence += (1 - share) * math.log((1 - share) / (1 - chance))
    return math.log(math.comb(available, size)) - rest * divergence


def valid_first(valid: Tensor) -> Tensor:
    """Row numbers with the valid rows first, cut to the largest count in the batch. (B, M) -> (B, M')."""
    count = max(1, int(valid.sum(-1).max()))
    return valid.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[:, :count]


def pad_groups(values: Tensor, group: Tensor, groups: int, least: int) -> tuple[Tensor, Tensor]:
    """Values in ascending order of their group, as rows of a padded tensor with a mask.

    values: (R, D); group: (R,) ascending. Returns (groups, M, D), zero where padded, and (groups, M), with M the
    size of the largest group, but at least `least`.
    """
    counts = torch.bincount(group, minlength=groups)
    size = max(least, int(counts.max()))
    start = counts.cumsum(0) - counts
    slot = group * size + torch.arange(len(group), device=group.device) - start[group]
    padded = values.new_zeros(groups * size, values.shape[-1]).index_copy(0, slot, values)
    valid = torch.arange(size, device=group.device) < counts[:, None]
    return padded.unflatten(0, (groups, size)), valid
