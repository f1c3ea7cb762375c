"""Weights of matches by what the hook for matchers shows of them, learned as in `training`, and their matcher.

The hook shows less than `weighting.describe` knows: no covariance of the point, no parallax, no pose; but where points
of the map should appear. What is left of the distance to there after a smooth motion of the image is taken out, says
how much a match disagrees with the others.

    torchslam run IMAGES -o results --matcher experiments.match_weights.hook:Learned --set matching.weights=network.pt
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from experiments.match_weights.layers import InContext, crowd_and_support, masked_median
from experiments.match_weights.problems import Problems
from torchslam.config import MatchingConfig
from torchslam.errors import ConfigError
from torchslam.features import hamming
from torchslam.geometry import se3_exp, transform
from torchslam.optim import RefinedPose
from torchslam.tracking.matcher import DescriptorMatcher, Prior
from torchslam.types import Matches, View

NUM_CUES = 12
BOUND = 8.0
"""A match counts at most so many times as much as the median, and at least one so many-th: the gates of the system take
what is stated at its word, so that a match of a much greater weight would be put out by an error that is usual."""
NEIGHBOURHOOD = 0.06  # of the range of the matched keypoints, to either side
FAR_PX = 12.0  # `tracking.radius_px`: how far from where it should appear a point is looked for in tracking
MAX_GROWTH = 1.5  # `match_projected`: by what factor the scale may differ from the expected one
MAX_BITS = 64  # `matching.max_distance`
MIN_LEFT = 20  # matches of a problem; `tracking.min_matches`
SMOOTH_ROUNDS = 4  # of reweighting
PREDICTION = (0.01, 0.004)  # how wrong predicted poses are: depths of the scene, radians


@dataclass(frozen=True)
class Shown:
    """What the hook shows of P times N matches.

    pixels:   (P, N, 2) of the keypoints; offsets: (P, N, 2) from where they were expected, in units of their scale
    bits:     (P, N) between the descriptors; seconds_1, seconds_2: (P, N) to the second nearest of the first and of the
              second view
    scales:   (P, N) of the keypoints; growth: (P, N) logarithm of scale over expected scale
    turns:    (P, N) radians between the directions of the keypoints
    mask:     (P, N) bool
    """

    pixels: Tensor
    offsets: Tensor
    bits: Tensor
    seconds_1: Tensor
    seconds_2: Tensor
    scales: Tensor
    growth: Tensor
    turns: Tensor
    mask: Tensor

    def cues(self) -> Tensor:
        """(P, N, NUM_CUES) for the network, free of units and of about unit size."""
        mask = self.mask
        residuals = smooth_residuals(self.pixels, self.offsets, mask)
        inliers = (residuals < 3.0) & mask
        noise = masked_median(residuals, inliers).nan_to_num(3.0).clamp_min(0.1)
        turn = self.turns - masked_median(self.turns, mask).nan_to_num(0.0)
        inside = torch.where(mask[..., None], self.pixels, self.pixels[:, :1])
        size = (inside.amax(1) - inside.amin(1)).amax(-1).clamp_min(1.0)[:, None, None]
        crowd, support = crowd_and_support(self.pixels, NEIGHBOURHOOD * size, inliers, mask)
        columns = [
            self.bits / 32 - 1,
            4 * (self.bits / self.seconds_2.clamp_min(1)) - 3,
            4 * (self.bits / self.seconds_1.clamp_min(1)) - 3,
            2 * self.scales.log() - 1,
            4 * self.growth.abs().clamp_max(1) - 1,
            2 * turn.sin().square() + (1 - turn.cos()),
            (residuals + 0.05).log(),
            (residuals / noise + 0.05).log(),
            noise.log(),
            crowd,
            4 * support - 3,
            4 * inliers.sum(-1, keepdim=True) / mask.sum(-1, keepdim=True).clamp_min(1) - 3,
        ]
        stacked = torch.stack([column.expand_as(residuals) for column in columns], dim=-1)
        return torch.where(mask[..., None], stacked, 0.0).clamp(-6, 6)


def smooth_residuals(pixels: Tensor, offsets: Tensor, mask: Tensor) -> Tensor:
    """(P, N) lengths of what an affine motion of the image, fitted robustly, leaves of offsets (P, N, 2) at pixels."""
    centred = pixels - pixels[:, :1]
    spread = centred.abs().amax((1, 2), keepdim=True).clamp_min(1.0)
    A = torch.cat([centred / spread, torch.ones_like(centred[..., :1])], -1)
    weights, left = mask.to(A.dtype), offsets
    ridge = 1e-6 * torch.eye(3, dtype=A.dtype, device=A.device)
    for _ in range(SMOOTH_ROUNDS):
        W = weights[..., None] * A
        left = offsets - A @ torch.linalg.solve(A.mT @ W + ridge, W.mT @ offsets)
        lengths = torch.linalg.vector_norm(left, dim=-1)
        width = 2 * masked_median(lengths, mask).nan_to_num(1.0).clamp_min(0.2)
        weights = mask / (1 + (lengths / width).square())
    return torch.linalg.vector_norm(left, dim=-1)


class HookWeights(InContext):
    """Weights of matches from what the hook shows, relative to the median of their frame; all alike at first."""

    def __init__(self, width: int = 32, seed: int = 0) -> None:
        super().__init__(NUM_CUES, width, seed)

    def forward(self, cues: Tensor, mask: Tensor) -> Tensor:
        """(P, N, NUM_CUES), (P, N) -> (P, N) factors between 1 / BOUND and BOUND, one outside the mask."""
        raw = self.numbers(cues, mask)
        level = masked_median(raw.detach(), mask).nan_to_num(0.0)
        most = torch.tensor(BOUND, dtype=raw.dtype).log()
        return torch.where(mask, (most * torch.tanh((raw - level) / most)).exp(), 1.0)


# --- training ------------------------------------------------------------------------------------------------


def as_in_tracking(problems: Problems, seed: int = 0) -> Problems:
    """The problems as a search around predictions would pose them: matches far from there, of another scale or of
    descriptors too different are gone, and problems of which too little is left.
    """
    shown = shown_of(problems, seed)
    near = torch.linalg.vector_norm(shown.offsets, dim=-1) < FAR_PX
    alike = (shown.growth.exp() < MAX_GROWTH) & ((-shown.growth).exp() < MAX_GROWTH)
    mask = problems.mask & near & alike & (problems.cues.distances <= MAX_BITS)
    return replace(problems, mask=mask)[mask.sum(-1) >= MIN_LEFT]


def shown_of(problems: Problems, seed: int = 0) -> Shown:
    """What the hook would show of problems, whose poses were predicted about as wrongly as motion is not constant."""
    generator = torch.Generator().manual_seed(seed)
    wrong = torch.randn(len(problems), 6, generator=generator, dtype=torch.float64)
    by_depth = torch.where(torch.arange(6) < 3, PREDICTION[0] * problems.depths[:, None], PREDICTION[1])
    T = se3_exp(wrong * by_depth) @ problems.T_start
    points_q = transform(T, problems.points)
    projected, valid = problems.camera.project(points_q)
    cues = problems.cues
    expected = cues.scales_base * problems.points[..., 2] / points_q[..., 2].clamp_min(1e-3)
    offsets = (problems.pixels - projected) / cues.scales_query[..., None]
    return Shown(
        problems.pixels,
        torch.where(valid[..., None], offsets, 100.0),
        cues.distances,
        cues.seconds_base,
        cues.seconds_query,
        cues.scales_query,
        (cues.scales_query / expected.clamp_min(1e-3)).log(),
        cues.turns,
        problems.mask & valid,
    )


def refine_shown(network: nn.Module, problems: Problems) -> list[RefinedPose]:
    """As `weighting.refine_learned`, in one round: for `training.losses`."""
    from experiments.match_weights.weighting import refine

    shown = shown_of(problems)
    factors = network(shown.cues(), shown.mask)
    return [refine(problems, factors * shown.mask / problems.cues.scales_query.square())]


# --- tracking ------------------------------------------------------------------------------------------------


class Alike:
    """torchslam's own matches, stated to be worth the same: what it changes alone that weights are given."""

    weighs = True

    def __init__(self) -> None:
        self.own = DescriptorMatcher(MatchingConfig())

    def __call__(self, view_1: View, view_2: View, prior: Prior | None) -> Matches:
        found = self.own(view_1, view_2, prior)
        return replace(found, weights=self.weights(view_1, view_2, prior, found))

    def weights(self, view_1: View, view_2: View, prior: Prior | None, found: Matches) -> Tensor:
        """(1, M) positive."""
        return torch.ones_like(found.mask, dtype=torch.float64)


class Learned(Alike):
    """torchslam's own matches; where points of the map are looked for, they count as a network says.

    weights: file that `save` wrote. Raises ConfigError for another one.
    """

    def __init__(self, weights: str | Path) -> None:
        super().__init__()
        self.network = HookWeights()
        try:
            self.network.load_state_dict(torch.load(weights, weights_only=True))
        except Exception as error:  # of unpickling, or other tensors
            raise ConfigError(
                f"{weights}: not the weights of such a network ({type(error).__name__})"
            ) from error

    @torch.no_grad()
    def weights(self, view_1: View, view_2: View, prior: Prior | None, found: Matches) -> Tensor:
        alike = super().weights(view_1, view_2, prior, found)
        if prior is None or prior.radius_px is None or int(found.mask.sum()) < MIN_LEFT:
            return alike
        shown = between(view_1, view_2, found)
        return alike.masked_scatter(found.mask, self.network(shown.cues(), shown.mask))


def between(view_1: View, view_2: View, found: Matches) -> Shown:
    """What is shown of matches between an expected view and a view, those of the mask alone: P = 1."""
    row, column = found.indices_1[found.mask], found.indices_2[found.mask]
    bits = hamming(view_1.descriptors[row], view_2.descriptors).double()
    back = hamming(view_2.descriptors[column], view_1.descriptors).double()
    bits, back = bits.masked_fill(~view_2.mask, 256.0), back.masked_fill(~view_1.mask, 256.0)
    pixels, scales = view_2.keypoints[column].double(), view_2.scales[column].double()
    columns = (
        pixels,
        (pixels - view_1.keypoints[row]) / scales[:, None],
        bits.gather(1, column[:, None])[:, 0],
        _nearest_other(back, row),
        _nearest_other(bits, column),
        scales,
        (scales / view_1.scales[row]).log(),
        view_2.angles[column].double() - view_1.angles[row],
        torch.ones_like(row, dtype=torch.bool),
    )
    return Shown(*(values[None] for values in columns))


def _nearest_other(bits: Tensor, chosen: Tensor) -> Tensor:
    """(m,) the least of each row (m, N) beside the chosen column (m,), no less than what was chosen: near a prediction
    a match need not be the nearest of all, as those are that the network knows."""
    own = bits.gather(1, chosen[:, None])
    others = bits.scatter(1, chosen[:, None], 256.0)
    return torch.maximum(others.amin(1), own[:, 0])


def save(network: HookWeights, path: Path) -> None:
    """For `Learned`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(network.state_dict(), path)
