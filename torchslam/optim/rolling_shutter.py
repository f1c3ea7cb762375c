"""Test whether the residuals of a run show a rolling shutter: rows of an image that are exposed one after the other.

A row v of an image of height H is exposed later than the middle by readout * (v / H - 1/2) frame intervals, so its
keypoints move on by as much of their image velocity, which the poses of the neighboring frames predict. The readout is
the coefficient of a linear regression of the residuals on these shifts. Poses, points and the camera have absorbed
a part of them, so the residuals and the shifts are first projected onto the complement of all their derivatives
(Frisch and Waugh, 1933).

A camera that shakes faster than frames follow each other moves within an image, but not visibly between images. Then
what is left of the residuals of each frame is a smooth function of the row, a different one in every frame. As other
errors depend on the row as well, the test is that the same functions of the column explain less.

Source of the model: Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry import transform
from torchslam.geometry.gating import whitening
from torchslam.geometry.lie import skew
from torchslam.geometry.precision import full_precision
from torchslam.geometry.robust import robustify
from torchslam.geometry.rolling_shutter import Readout, frame_velocities
from torchslam.optim._core.levenberg_marquardt import GRAPH_OPTIONS
from torchslam.optim.model_choice import Gain
from torchslam.optim.observation_graph import ObservationGraph

MIN_FRAMES, MAX_FRAMES = 12, 60
"""Frames of a test, evenly distributed over a run; more take longer without a clearer result."""
ONLINE_FRAMES = 30
"""Most frames of a test while a run goes on. Tried from 20 to 60: on four recordings the readout is the same within its
error, which is up to 1.6 times as large with 20. A test of 30 takes .08 CPU s."""
PARTS, PART_FRAMES = 10, 5
"""Stretches of a run whose disagreement gives the standard error, and the frames of one: errors of neighboring frames
are alike."""
ERROR_FACTOR = 1.8
"""By which errors of a readout exceed the scatter of stretches: without it, 45 and 76 % of 29 rendered readouts (the
tuning half of experiments/decisions) were within one and two stated errors."""
MIN_INFORMATION = 1.0
"""Of the readout: less is a formal standard error of more than one frame interval, as of a camera at rest."""
MIN_SHIFT = 0.05
"""Median shift worth naming, as a ratio of the median residual: in fast turns it is several times as large."""
MAX_RATIO = 1.2
"""Readout in frame intervals from which on it is none: the rows of an image are read before those of the next one. The
excess is for its error. Tried at this value only."""
MIN_MORE_EXPLAINED = 0.1
"""Ratio of the squared residuals by which functions of the row must explain more than those of the column: it is 0.04
or less on real sequences, 0.16 or more where the rows of their images are shifted by up to 6 px."""


class ShakingTest(Enum):
    """Whether smooth functions of the row are tested as well, which takes half of the time."""

    NEVER = "never"
    UNLESS_READ_OUT = "where the motion between frames shows no readout"
    ALWAYS = "always"


@dataclass(frozen=True)
class RollingShutter:
    """The exposure of the rows by the residuals of a run.

    Attributes:
        readout: Time from the first to the last row, seconds; negative from the last to the first.
        readout_std: Standard error of it; infinite, and the readout zero, if the camera hardly moves.
        interval: Frame interval, seconds.
        shift: Median shift by the readout, as a ratio of the median residual.
        gain: How much better stretches are predicted by the readout that all others find than by a global shutter.
        by_row: Ratio of the squared residuals without the readout that smooth functions of the row explain, one for
            each frame; NaN if that was not tested.
        by_column: The same for the column.
    """

    readout: float
    readout_std: float
    interval: float
    shift: float
    gain: Gain
    by_row: float = math.nan
    by_column: float = math.nan

    @property
    def is_read_out(self) -> bool:
        """Whether the motion of the camera shows a rolling shutter."""
        is_certain = self.gain.is_worth() and self.shift > MIN_SHIFT
        return is_certain and abs(self.readout) < MAX_RATIO * self.interval

    @property
    def is_shaken(self) -> bool:
        """Whether rows are shifted against each other in a way that the motion between frames does not show."""
        return self.by_row - self.by_column > MIN_MORE_EXPLAINED


@dataclass(frozen=True)
class _Block:
    """Derivatives of whitened residuals, orthonormal for each of the `count` variables that observations belong to."""

    derivatives: Float[Tensor, "O 2 n"]
    index: Int[Tensor, " O"]
    count: int

    @classmethod
    def of(cls, derivatives: Float[Tensor, "O 2 n"], index: Int[Tensor, " O"], count: int) -> _Block:
        """Make the derivatives of each variable orthonormal; those that are zero stay zero."""
        size = derivatives.shape[-1]
        squares = derivatives.square().sum(1)
        norms = squares.new_zeros(count, size).index_add(0, index, squares).sqrt()
        inverse = torch.where(norms > 0, 1 / norms.masked_fill(norms == 0, 1.0), 0.0)
        scaled = derivatives * inverse[index][:, None]
        gram = scaled.new_zeros(count, size, size).index_add(0, index, scaled.mT @ scaled)
        # The squares may be singular for a point seen along its ray.
        gram = gram + torch.diag_embed(torch.where(norms > 0, 1e-9, 1.0).float())
        factor = torch.linalg.cholesky(gram)
        orthonormal = torch.linalg.solve_triangular(factor[index], scaled.mT, upper=False).mT
        return cls(orthonormal, index, count)

    def gathered(self, values: Float[Tensor, "O 2 D"]) -> Float[Tensor, "V n D"]:
        """The products of the columns with the derivatives, summed over the observations of each variable."""
        if self.count == 1:  # a single product takes a quarter of the time
            return (self.derivatives.flatten(0, 1).mT @ values.flatten(0, 1))[None]
        products = self.derivatives.mT @ values
        return products.new_zeros(self.count, *products.shape[1:]).index_add(0, self.index, products)

    def spread(self, steps: Float[Tensor, "V n D"]) -> Float[Tensor, "O 2 D"]:
        """What steps of the variables change."""
        if self.count == 1:
            return (self.derivatives.flatten(0, 1) @ steps[0]).view(len(self.index), 2, -1)
        return self.derivatives @ steps[self.index]


def project_out(values: Float[Tensor, "O 2 D"], blocks: Sequence[_Block]) -> Float[Tensor, "O 2 D"]:
    """The part of each column that no step of the blocks' variables can produce, by conjugate gradients."""

    def dot(one: list[Tensor], other: list[Tensor]) -> Tensor:
        return torch.stack([(a * b).sum((0, 1)) for a, b in zip(one, other, strict=True)]).sum(0)

    def ratio(one: Tensor, other: Tensor) -> Tensor:
        return torch.where(other > 0, one / other.masked_fill(other <= 0, 1.0), 0.0)

    gradient = [block.gathered(values) for block in blocks]
    direction, squared = gradient, dot(gradient, gradient)
    enough = 1e-8 * squared
    for _ in range(30):
        if bool((squared <= enough).all()):
            break
        change = torch.stack([block.spread(d) for block, d in zip(blocks, direction, strict=True)]).sum(0)
        values = values - ratio(squared, change.square().sum((0, 1))) * change
        gradient = [block.gathered(values) for block in blocks]
        before, squared = squared, dot(gradient, gradient)
        slope = ratio(squared, before)
        direction = [g + slope * d for g, d in zip(gradient, direction, strict=True)]
    return values


@full_precision
@torch.no_grad()
def find_rolling_shutter(
    graph: ObservationGraph, max_frames: int = MAX_FRAMES, shaking: ShakingTest = ShakingTest.ALWAYS
) -> RollingShutter | None:
    """Test the residuals of a run at its solution, in the submap, and of its sessions in that, with most frames.

    A readout that the graph has already is the point of linearization, so that repeated tests are Gauss-Newton steps.

    Args:
        max_frames: most frames of the test, evenly distributed.
        shaking: whether functions of the row are tested as well.

    Returns:
        The result; None with too few frames, or too few observations of the same points.
    """
    largest = graph.recordings == torch.bincount(graph.recordings).argmax()
    velocities, is_central = frame_velocities(graph.T_cw, graph.timestamps, graph.recordings)
    frames = (is_central & largest).nonzero()[:, 0]
    if len(frames) < MIN_FRAMES:
        return None
    frames = frames[torch.argsort(graph.timestamps[frames], stable=True)]
    interval = float(graph.timestamps[largest].sort().values.diff().median())
    velocities = interval * velocities
    start = 0.0 if graph.readout is None else float(graph.readout.seconds)
    count = min(len(frames), max_frames)
    frames = frames[torch.arange(count, device=frames.device) * len(frames) // count]
    rank = torch.full_like(graph.submap, -1)
    rank[frames] = torch.arange(count, device=rank.device)
    # Of points that two of these frames see.
    rows = (rank[graph.frame_index] >= 0).nonzero()[:, 0]
    seen = torch.bincount(graph.point_index[rows], minlength=len(graph.points_w))
    rows = rows[seen[graph.point_index[rows]] > 1]
    frame = rank[graph.frame_index[rows]]
    points, point = torch.unique(graph.point_index[rows], return_inverse=True)
    T_cw = graph.T_cw[graph.frame_index[rows]]
    points_c = transform(T_cw, graph.points_w[graph.point_index[rows]][:, None])[:, 0]
    pixels, valid, J_points, J_camera = graph.camera.project_with_jacobians(points_c)
    if 2 * int(valid.sum()) <= 6 * count + 3 * len(points) + J_camera.shape[-1]:
        return None
    errors = graph.global_shutter_pixels(rows) - pixels
    W = _robust_whitening(graph.weights[rows], errors, valid)
    residuals = W @ errors[..., None]
    J_points = W @ J_points
    J_poses = torch.cat((J_points, -J_points @ skew(points_c)), dim=-1)
    size = pixels.new_tensor(graph.camera.size)
    column, row = ((graph.pixels[rows] + 0.5) / size - 0.5)[..., None, None].unbind(1)  # (O, 1, 1)
    flow = J_poses @ velocities[frames][frame][..., None]
    common = torch.cat((W @ J_camera, column * flow), dim=-1)
    others = [
        _Block.of(J_points @ T_cw[:, :3, :3], point, len(points)),
        _Block.of(common, torch.zeros_like(point), 1),
    ]
    poses = _Block.of(J_poses, frame, count)
    left, shift = project_out(torch.cat((residuals, row * flow), dim=-1), [poses, *others]).split(1, dim=-1)
    readout, std, gain = _regress(left[..., 0], shift[..., 0], frame, count, start / interval)
    left = left - readout * shift
    typical = (row * flow)[..., 0].norm(dim=-1).median() / residuals[..., 0].norm(dim=-1).median()
    readout += start / interval
    size_of_shift = abs(readout) * float(typical)
    found = RollingShutter(interval * readout, interval * std, interval, size_of_shift, gain)
    if shaking is ShakingTest.NEVER or (shaking is ShakingTest.UNLESS_READ_OUT and found.is_read_out):
        return found
    ratios = []
    for place in (row, column):
        # Legendre polynomials of the second and third degree on -1/2 ... 1/2, without that of the first: up to a
        # rotation, a shift along x that grows with the row is a shift along y that grows with the column.
        bends = [bend * J_poses[..., 3:5] for bend in (6 * place**2 - 0.5, 20 * place**3 - 3 * place)]
        bent = _Block.of(torch.cat((J_poses, *bends), dim=-1), frame, count)
        remaining = project_out(left, [bent, *others]).square().sum() / left.square().sum()
        ratios.append(1.0 - float(remaining))
    return replace(found, by_row=ratios[0], by_column=ratios[1])


def readout_by(found: RollingShutter | None, known: Readout) -> Readout | None:
    """The readout by what was known of it and what the residuals say.

    A given readout is improved; none is found where the residuals do not show a rolling shutter: then it is None.
    """
    if found is not None and (known.is_given or found.is_read_out):
        return known.updated(found.readout, found.readout_std)
    return known if known.is_given else None


def _robust_whitening(
    weights: Float[Tensor, "R *information"], errors: Float[Tensor, "R 2"], valid: Bool[Tensor, " R"]
) -> Float[Tensor, "R 2 2"]:
    """The square roots of the weights, smaller for large residuals as in the adjustment, zero where not `valid`."""
    if weights.ndim == 1:
        weights = weights[:, None, None] * torch.eye(2, dtype=weights.dtype, device=weights.device)
    W = whitening(weights)
    squared = (W @ errors[..., None]).square().sum((1, 2))
    scale = squared.new_tensor(GRAPH_OPTIONS.scale)
    factors = robustify(squared, GRAPH_OPTIONS.kernel, scale).weight.sqrt()
    return W * torch.where(valid, factors, 0.0)[:, None, None]


def _regress(
    left: Float[Tensor, "O 2"],
    shift: Float[Tensor, "O 2"],
    frame: Int[Tensor, " O"],
    frames: int,
    start: float,
) -> tuple[float, float, Gain]:
    """The coefficient of residuals on shifts, its standard error, and the gain over no readout.

    Errors count as independent between frames, which are in order of time, or between stretches of the run, whichever
    gives the larger standard error, times `ERROR_FACTOR`. The residuals are corrected already by `start` times the
    shifts, which are those by a readout of one.
    """
    information = shift.square().sum()
    if not bool(information > MIN_INFORMATION):
        return 0.0, math.inf, Gain(0.0, math.inf, 0)
    readout = (shift * left).sum() / information
    scores = (shift * (left - readout * shift)).sum(-1)
    parts = max(2, min(PARTS, frames // PART_FRAMES))

    def sums(values: Tensor, groups: int) -> Tensor:
        return values.new_zeros(groups).index_add(0, frame * groups // frames, values)

    stds = [
        sums(scores, groups).norm() * math.sqrt(groups / (groups - 1)) / information
        for groups in (frames, parts)
    ]
    corrected = left + start * shift
    products, squares = (sums((shift * each).sum(-1), parts) for each in (corrected, shift))
    others = (products.sum() - products) / (squares.sum() - squares).clamp_min(MIN_INFORMATION)
    # By the scatter where that is larger than the variance of the residuals: errors of neighbors are alike.
    variance = torch.maximum(
        (left - readout * shift).square().mean(), torch.stack(stds).max().square() * information
    )
    gain = Gain.of_stretches((others * products - 0.5 * others.square() * squares) / variance)
    return float(readout), ERROR_FACTOR * float(torch.stack(stds).max()), gain
