"""A submap goes into meters: all sources measure, their measurements are combined, a similarity changes the world.

The logarithms of the scales are Gaussian, so that they are combined by their information.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchslam.data.text_file import float64
from torchslam.errors import MeasurementError
from torchslam.geometry import se3_inverse, sim3_scale
from torchslam.geometry.transforms import level_rotation
from torchslam.map.unit import MetricUnit, UnitSource
from torchslam.metric.source import MetricSource, ScaleMeasurement, ScaleSource, SubmapView, Unmeasured

MAX_ROLL_DEG = 60.0
"""Roll of most images, or elevation of their optical axes, from which on a vertical contradicts them: people hold a
camera upright, on its side at most for a part, and hardly ever film the zenith. Verticals are known to 5."""
MAX_DISAGREEMENT = 3.0
"""Standard errors by which two measurements may differ before they count as a contradiction: .3 % of right pairs do."""


@dataclass(frozen=True)
class CombinedScale:
    """The unit of a submap from all its measurements.

    Attributes:
        meters_per_unit: length of a map unit, meters.
        relative_std: its relative standard error.
        measurements: those it is made of.
        contradictions: one line for each two measurements that differ by more than their errors allow.
    """

    meters_per_unit: float
    relative_std: float
    measurements: tuple[ScaleMeasurement, ...]
    contradictions: tuple[str, ...] = ()


def combine_scales(measurements: Sequence[ScaleMeasurement]) -> CombinedScale:
    """Average the logarithms of the scales, weighted by their information.

    Where measurements contradict each other, the error grows by their disagreement (the Birge ratio, 1932), and each
    contradiction is listed. Raises MeasurementError if there is no measurement.
    """
    if not measurements:
        raise MeasurementError("there is no measurement of the scale")
    logs = float64([math.log(m.meters_per_unit) for m in measurements])
    information = float64([m.relative_std**-2 for m in measurements])
    mean = (information * logs).sum() / information.sum()
    birge = 1.0
    if len(measurements) > 1:
        chi_square = float((information * (logs - mean).square()).sum())
        birge = max(1.0, math.sqrt(chi_square / (len(measurements) - 1)))
    contradictions = []
    for one, other in itertools.combinations(measurements, 2):
        off = math.log(one.meters_per_unit / other.meters_per_unit)
        if abs(off) > MAX_DISAGREEMENT * math.hypot(one.relative_std, other.relative_std):
            stated = "".join(f"; stated: {each.source} {each.stated}" for each in (one, other) if each.stated)
            contradictions.append(
                f"{one.source} and {other.source} contradict each other by a factor of {math.exp(abs(off)):.3g}: "
                f"{one.meters_per_unit:.4g} ± {one.relative_std:.1%} and "
                f"{other.meters_per_unit:.4g} ± {other.relative_std:.1%} meters per unit{stated}"
            )
    return CombinedScale(
        math.exp(float(mean)),
        birge / math.sqrt(float(information.sum())),
        tuple(measurements),
        tuple(contradictions),
    )


def vertical_contradictions(
    R_cw: Float[Tensor, "K 3 3"], measurements: Iterable[ScaleMeasurement]
) -> tuple[str, ...]:
    """One line for each measurement by whose vertical most images are upside down, on their side, or of the zenith.

    `R_cw` are the rotations of the images, world to camera. Images of the nadir or the zenith have no roll.
    """
    lines = []
    for each in measurements:
        if each.up_w is None or each.up_std > math.radians(MAX_ROLL_DEG) / MAX_DISAGREEMENT:
            continue
        x, y, z = (R_cw.double().cpu() @ each.up_w.double().cpu()).unbind(-1)
        elevation, rolled = torch.asin(z.clamp(-1, 1)).rad2deg(), torch.atan2(x, -y).abs().rad2deg()
        has_roll = elevation.abs() < MAX_ROLL_DEG
        what = ""
        if float((elevation >= MAX_ROLL_DEG).double().mean()) > 0.5:
            what = f"the camera looks up by {float(elevation.median()):.0f} degrees"
        elif float((rolled[has_roll] > MAX_ROLL_DEG).sum()) > 0.5 * len(z):
            what = f"the images are rolled by {float(rolled[has_roll].median()):.0f} degrees"
        if what:
            lines.append(
                f"the vertical of {each.source} contradicts the images: by it, in most of them {what}"
            )
    return tuple(lines)


@torch.no_grad()
def bring_into_meters(
    view: SubmapView, sources: Iterable[MetricSource]
) -> tuple[Float[Tensor, "4 4"], tuple[Unmeasured, ...]]:
    """Measure the unit of a submap, and change its world by one similarity so that the unit is a meter.

    Where the vertical is known, z of the new world is up; where a source has a frame of its own, such as east, north
    and up, the new world is that. Otherwise its axes and origin stay. A submap that is in meters already stays so;
    the measurements are then compared with its unit.

    Returns:
        The similarity S_mw from the world before to the new one, and the sources without a result.

    Raises:
        MeasurementError: measurements are wrong.
    """
    submap = view.submap
    answers = [source.measure(view) for source in sources]
    silent = tuple(answer for answer in answers if isinstance(answer, Unmeasured))
    measurements = [answer for answer in answers if not isinstance(answer, Unmeasured)]
    tilted = vertical_contradictions(view.T_cw[:, :3, :3], measurements)
    S_mw = torch.eye(4, dtype=torch.float64, device="cpu")
    if measurements and submap.metric is not None:
        before = ScaleMeasurement(ScaleSource.MAP, 1.0, submap.metric.relative_std, 1, "map in meters")
        contradictions = combine_scales([before, *measurements]).contradictions
        contradictions = (*submap.metric.contradictions, *contradictions, *tilted)
        submap.metric = replace(submap.metric, contradictions=contradictions)
    elif measurements:
        scale = combine_scales(measurements)
        scale = replace(scale, contradictions=(*scale.contradictions, *tilted))
        S_mw, submap.metric = _similarity_to_meters(view, scale)
        submap.transform(S_mw.to(submap.map.T_cw))
    return S_mw, silent


def _similarity_to_meters(view: SubmapView, scale: CombinedScale) -> tuple[Float[Tensor, "4 4"], MetricUnit]:
    """The similarity from the world of a submap to one in meters, and the record of its unit.

    In the frame of a measurement, the mean of the cameras keeps its place, whatever the others say of the scale.
    """
    S_mw = torch.eye(4, dtype=torch.float64, device="cpu")
    framed = next((m for m in scale.measurements if m.S_ew is not None), None)
    ups = [(m.up_w.to(S_mw), m.up_std**-2) for m in scale.measurements if m.up_w is not None]
    up_std = 1 / math.sqrt(sum(weight for _, weight in ups)) if ups else None
    if framed is not None and framed.S_ew is not None:
        S_ew = framed.S_ew.to(S_mw)
        S_mw[:3, :3] = scale.meters_per_unit / sim3_scale(S_ew) * S_ew[:3, :3]
        middle_w = se3_inverse(view.T_cw)[:, :3, 3].to(S_mw).mean(dim=0)
        S_mw[:3, 3] = S_ew[:3, :3] @ middle_w + S_ew[:3, 3] - S_mw[:3, :3] @ middle_w
        up_std = framed.up_std if math.isfinite(framed.up_std) else 0.0
    else:
        if ups:
            mean = torch.stack([weight * up_w for up_w, weight in ups]).sum(dim=0)
            S_mw[:3, :3] = level_rotation(mean / mean.norm())
        S_mw[:3, :3] *= scale.meters_per_unit
    names = [field.name for field in fields(UnitSource)]
    unit = MetricUnit(
        scale.relative_std,
        tuple(UnitSource(*(getattr(m, name) for name in names)) for m in scale.measurements),
        scale.contradictions,
        tuple(map(tuple, S_mw.tolist())),
        up_std,
        None if framed is None else framed.origin,
    )
    return S_mw, unit
