"""Measurements from outside as factors of a run's graph: positions of an antenna, and lengths of parts of the path.

The errors of a receiver's positions are white noise and noise that wanders. With noise that forgets itself
exponentially, the inverse of the covariance V of all errors has no positive entry off its diagonal, and no negative
sum of a row. So the whitened error r^T V^-1 r is a sum of squares of the errors r_i, each weighed by the sum of its
row, and of differences r_i - r_j, weighed by -V^-1_ij, which vanish fast with the time between both: positions of
single frames and displacements between two are all that the noise needs.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchslam.geometry.lie import se3_inverse, transform
from torchslam.geometry.precision import full_precision
from torchslam.optim.bundle._factors import FrameFactors

LEAST_SHARE = 1e-3
"""Weight of a difference, in those of its two positions, below which it is left out: all of them together are less than
a hundredth of what a position says. Tried at this value only."""


@full_precision
def fixed_point_error(
    T_1w: Float[Tensor, "*#batch 4 4"],
    T_2w: Float[Tensor, "*#batch 4 4"],
    measured: Float[Tensor, "*#batch 4 3"],
) -> Float[Tensor, "*#batch 3"]:
    """Difference of the positions of two points that are fixed to cameras, less the measured one; or of one of them.

    Args:
        T_1w: first poses.
        T_2w: second poses.
        measured: the displacement in the world from the first point to the second one; both points in their cameras;
            and ones. With zeros in place of the ones it is the position of the second point, and the first does not
            count.
    """
    displacement_w, first_c, second_c, counts = measured.unbind(-2)
    first_w, second_w = (
        transform(se3_inverse(T_cw), point_c[..., None, :]).squeeze(-2)
        for T_cw, point_c in ((T_1w, first_c), (T_2w, second_c))
    )
    return second_w - counts * first_w - displacement_w


@dataclass(frozen=True)
class MeasuredPositions:
    """N measured positions of points that are fixed to keyframes; differentiable in all that is not a row.

    Attributes:
        frames: row of the keyframe of each, in the graph.
        points_c: where the point is in that camera: the lever arm, and the way from the keyframe to the moment of the
            measurement.
        positions_w: as measured, in the unit of the map. Their axes are those of the world.
        information: inverse covariances (3, N, N) of the errors along the axes of the world, in units of those of the
            observations' weights.
    """

    frames: Int[Tensor, " N"]
    points_c: Float[Tensor, "N 3"]
    positions_w: Float[Tensor, "N 3"]
    information: Float[Tensor, "3 N N"]

    def factors(self) -> FrameFactors:
        """Positions and displacements whose squared errors sum up to the whitened ones, up to `LEAST_SHARE`.

        A position is written as a pair with another frame, which does not count.
        """
        Q, frames = self.information, self.frames
        own = Q.sum(-1).mT.clamp_min(0.0)  # (N, 3)
        stiffness = Q.detach().diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
        near = (-Q.detach() > LEAST_SHARE * stiffness[:, :, None] * stiffness[:, None]).any(0)
        apart = frames[:, None] != frames
        first, second = torch.nonzero(torch.triu(near & apart, diagonal=1), as_tuple=True)
        between = (-Q[:, first, second]).mT.clamp_min(0.0)  # (F, 3)
        others = frames.roll(1)
        # A frame has a position alone only together with some other frame: any will do.
        others = torch.where(others == frames, frames.roll(-1), others)
        alone = torch.nonzero(others != frames)[:, 0]
        zero, one = (torch.full_like(self.positions_w[:1], value) for value in (0.0, 1.0))
        measured = torch.cat(
            (
                torch.stack(
                    (
                        self.positions_w[alone],
                        zero.expand(len(alone), 3),
                        self.points_c[alone],
                        zero.expand(len(alone), 3),
                    ),
                    dim=1,
                ),
                torch.stack(
                    (
                        self.positions_w[second] - self.positions_w[first],
                        self.points_c[first],
                        self.points_c[second],
                        one.expand(len(first), 3),
                    ),
                    dim=1,
                ),
            )
        )
        pairs = torch.cat(
            (
                torch.stack((others[alone], frames[alone]), dim=1),
                torch.stack((frames[first], frames[second]), dim=1),
            )
        )
        return FrameFactors(
            pairs, measured, torch.diag_embed(torch.cat((own[alone], between))), fixed_point_error
        )

    def select(self, kept: Bool[Tensor, " N"]) -> Self:
        """Some of them, whose covariances are those of the whole."""
        covariances = torch.linalg.inv(self.information)[:, kept][..., kept]
        return replace(
            self,
            frames=self.frames[kept],
            points_c=self.points_c[kept],
            positions_w=self.positions_w[kept],
            information=torch.linalg.inv(covariances),
        )

    def softened(self, T_cw: Float[Tensor, "K 4 4"]) -> Self:
        """The same with the squared errors at poses added to the variances: those that are far count little."""
        far = torch.diag_embed(self.errors(T_cw).square().mT)
        return replace(self, information=torch.linalg.inv(torch.linalg.inv(self.information) + far))

    def deviations(self, T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, " N"]:
        """The largest error along an axis of each, in its standard deviations."""
        stds = torch.linalg.inv(self.information).diagonal(dim1=-2, dim2=-1).sqrt()
        return (self.errors(T_cw).abs() / stds.mT).amax(-1)

    def cost(self, T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, ""]:
        """Half of the whitened squared errors."""
        errors = self.errors(T_cw)
        return 0.5 * torch.einsum("na,anm,ma->", errors, self.information, errors)

    def errors(self, T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, "N 3"]:
        """Positions of the points at poses of all frames of the graph, less the measured ones."""
        at_w = transform(se3_inverse(T_cw[self.frames]), self.points_c[:, None])[:, 0]
        return at_w - self.positions_w

    def moved(self, rows: int) -> Self:
        """The same in a graph in which its frames come so many rows later."""
        return replace(self, frames=self.frames + rows)

    def weighed(self, factor: float) -> Self:
        """The same with so many times the information."""
        return replace(self, information=factor * self.information)

    def to(self, like: Float[Tensor, "..."]) -> Self:
        """The same on the device and of the type of `like`."""
        values = {each.name: getattr(self, each.name).to(like) for each in fields(self)}
        return replace(self, **values | {"frames": self.frames.to(like.device)})


@dataclass(frozen=True)
class MeasuredLengths:
    """F measured distances between the centers of two keyframes; differentiable in lengths and information.

    Attributes:
        frames: rows of both keyframes in the graph.
        lengths: in the unit of the map.
        information: inverse variances of their logarithms, in units of those of the observations' weights.
    """

    frames: Int[Tensor, "F 2"]
    lengths: Float[Tensor, " F"]
    information: Float[Tensor, " F"]

    def factors(self) -> FrameFactors:
        """The factors of a bundle adjustment."""
        return FrameFactors.distances(self.frames, self.lengths, self.information)

    def select(self, kept: Bool[Tensor, " F"]) -> Self:
        """Some of them."""
        return replace(
            self,
            frames=self.frames[kept],
            lengths=self.lengths[kept],
            information=self.information[kept],
        )

    def softened(self, T_cw: Float[Tensor, "K 4 4"]) -> Self:
        """The same with the squared errors at poses added to the variances: those that are far count little."""
        return replace(self, information=1 / (1 / self.information + self.errors(T_cw).square()))

    def deviations(self, T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, " F"]:
        """The error of each in its standard deviations."""
        return self.errors(T_cw).abs() * self.information.sqrt()

    def cost(self, T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, ""]:
        """Half of the whitened squared errors."""
        return 0.5 * (self.information * self.errors(T_cw).square()).sum()

    def errors(self, T_cw: Float[Tensor, "K 4 4"]) -> Float[Tensor, " F"]:
        """Logarithms of the distances at poses of all frames of the graph, less those of the measured ones."""
        ends_w = se3_inverse(T_cw[self.frames])[..., :3, 3]
        return ((ends_w[:, 1] - ends_w[:, 0]).norm(dim=-1) / self.lengths).log()

    def moved(self, rows: int) -> Self:
        """The same in a graph in which its frames come so many rows later."""
        return replace(self, frames=self.frames + rows)

    def weighed(self, factor: float) -> Self:
        """The same with so many times the information."""
        return replace(self, information=factor * self.information)

    def to(self, like: Float[Tensor, "..."]) -> Self:
        """The same on the device and of the type of `like`."""
        values = {each.name: getattr(self, each.name).to(like) for each in fields(self)}
        return replace(self, **values | {"frames": self.frames.to(like.device)})


Measurement = MeasuredPositions | MeasuredLengths
_KINDS: dict[str, type[Measurement]] = {"positions": MeasuredPositions, "lengths": MeasuredLengths}
_PREFIX = "measured"


def measurement_tensors(measurements: tuple[Measurement, ...]) -> dict[str, Tensor]:
    """The tensors of measurements by their names in a file."""
    found = {}
    for number, each in enumerate(measurements):
        kind = next(name for name, known in _KINDS.items() if isinstance(each, known))
        for column in fields(each):
            value = getattr(each, column.name).detach().cpu().contiguous()
            found[f"{_PREFIX}.{number}.{kind}.{column.name}"] = value
    return found


def are_measurements(name: str) -> bool:
    """Whether a tensor of this name in a file belongs to measurements."""
    return name.startswith(f"{_PREFIX}.")


def measurements_of(tensors: dict[str, Tensor], num_frames: int) -> tuple[Measurement, ...]:
    """The measurements of a file. Raises ValueError or KeyError where they are damaged."""
    parts: dict[tuple[int, str], dict[str, Tensor]] = {}
    for name, value in tensors.items():
        _, number, kind, column = name.split(".")
        parts.setdefault((int(number), kind), {})[column] = value
    return tuple(
        _checked(_KINDS[kind](**columns), num_frames) for (_, kind), columns in sorted(parts.items())
    )


def _checked(measured: Measurement, num_frames: int) -> Measurement:
    count = len(measured.frames)
    shapes: dict[str, tuple[int, ...]] = {"frames": (count, 2), "lengths": (count,), "information": (count,)}
    if isinstance(measured, MeasuredPositions):
        shapes = {"frames": (count,), "points_c": (count, 3), "positions_w": (count, 3)}
        shapes["information"] = (3, count, count)
    for name, shape in shapes.items():
        column = getattr(measured, name)
        if tuple(column.shape) != shape or not bool(column.isfinite().all()):
            raise ValueError(f"{name} of measurements is {tuple(column.shape)}, not {shape}, or not finite")
    rows = measured.frames
    if rows.dtype != torch.int64 or (count and not 0 <= int(rows.min()) <= int(rows.max()) < num_frames):
        raise ValueError("measurements are of frames that the graph does not have")
    return measured
