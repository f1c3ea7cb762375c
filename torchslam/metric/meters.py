"""A submap goes into meters: all sources measure, their measurements are combined, a similarity changes the world."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.geometry import se3_inverse
from torchslam.geometry.transforms import level_rotation
from torchslam.map.unit import MetricUnit, UnitSource
from torchslam.metric.scale import CombinedScale, ScaleMeasurement, ScaleSource, combine_scales
from torchslam.metric.source import MetricSource, SubmapView, Unmeasured


@dataclass(frozen=True)
class Vertical:
    """The vertical from all measurements that know it.

    Attributes:
        up_w: unit vector against gravity.
        std: its standard error, radians.
    """

    up_w: Float[Tensor, " 3"]
    std: float


@torch.no_grad()
def bring_into_meters(
    view: SubmapView, sources: Iterable[MetricSource]
) -> tuple[Float[Tensor, "4 4"], tuple[Unmeasured, ...]]:
    """Measure the unit of a submap, and change its world by one similarity so that the unit is a meter.

    Where the vertical is known, z of the new world is up; where a source has a frame of its own, such as east, north
    and up, the new world is that. Otherwise its axes and origin stay. A submap that is in meters already stays so;
    the measurements are then compared with its unit.

    Returns:
        The similarity S_mw from the world before to the new one, and the sources that could not say anything.

    Raises:
        MeasurementError: measurements are wrong.
    """
    submap = view.submap
    answers = [source.measure(view) for source in sources]
    silent = tuple(answer for answer in answers if isinstance(answer, Unmeasured))
    measurements = [answer for answer in answers if not isinstance(answer, Unmeasured)]
    eye = torch.eye(4, dtype=torch.float64, device="cpu")
    if not measurements:
        return eye, silent
    if submap.metric is not None:
        before = ScaleMeasurement(ScaleSource.MAP, 1.0, submap.metric.relative_std, 1, "map in meters")
        contradictions = combine_scales([before, *measurements]).contradictions
        submap.metric = replace(
            submap.metric, contradictions=(*submap.metric.contradictions, *contradictions)
        )
        return eye, silent
    scale, vertical = combine_scales(measurements), combine_verticals(measurements)
    centers_w = se3_inverse(view.T_cw)[:, :3, 3].to(eye)
    S_mw = similarity_to_meters(scale, vertical, centers_w)
    submap.transform(S_mw.to(submap.map.T_cw))
    submap.metric = unit_record(scale, vertical, S_mw)
    return S_mw, silent


def combine_verticals(measurements: Sequence[ScaleMeasurement]) -> Vertical | None:
    """The mean direction against gravity, weighted by information; None if no measurement has one."""
    known = [(m.up_w.detach().cpu().double(), m.up_std**-2) for m in measurements if m.up_w is not None]
    if not known:
        return None
    ups, weights = zip(*known, strict=True)
    mean = torch.stack(ups).mul(torch.tensor(weights, dtype=torch.float64, device="cpu")[:, None]).sum(dim=0)
    return Vertical(mean / mean.norm(), 1 / math.sqrt(sum(weights)))


def similarity_to_meters(
    scale: CombinedScale, vertical: Vertical | None, centers_w: Float[Tensor, "K 3"]
) -> Float[Tensor, "4 4"]:
    """The similarity from the world of a submap to one in meters.

    Args:
        scale: of the submap.
        vertical: level the world by it, unless a measurement has a frame of its own.
        centers_w: of the cameras. Their mean keeps its place in the frame of a measurement, whatever the others say of
            the scale.
    """
    S_mw = torch.eye(4, dtype=torch.float64, device="cpu")
    framed = next((m.S_ew.detach().cpu().double() for m in scale.measurements if m.S_ew is not None), None)
    if framed is None:
        R_mw = S_mw[:3, :3].clone() if vertical is None else level_rotation(vertical.up_w)
        S_mw[:3, :3] = scale.meters_per_unit * R_mw
        return S_mw
    own = torch.linalg.det(framed[:3, :3]) ** (1 / 3)
    S_mw[:3, :3] = scale.meters_per_unit / own * framed[:3, :3]
    middle_w = centers_w.mean(dim=0)
    S_mw[:3, 3] = framed[:3, :3] @ middle_w + framed[:3, 3] - S_mw[:3, :3] @ middle_w
    return S_mw


def unit_record(scale: CombinedScale, vertical: Vertical | None, S_mw: Float[Tensor, "4 4"]) -> MetricUnit:
    """The record of a combined scale that a submap keeps."""
    measurements = scale.measurements
    framed = next((m for m in measurements if m.S_ew is not None), None)
    up_std = None if vertical is None else vertical.std
    if framed is not None:
        up_std = framed.up_std if math.isfinite(framed.up_std) else 0.0
    return MetricUnit(
        scale.relative_std,
        tuple(
            UnitSource(
                str(m.source),
                m.meters_per_unit,
                m.relative_std,
                m.count,
                m.unit,
                m.apart,
                tuple(m.rejected),
                tuple(m.notes),
            )
            for m in measurements
        ),
        tuple(scale.contradictions),
        tuple(map(tuple, S_mw.tolist())),
        up_std,
        None if framed is None else framed.origin,
    )
