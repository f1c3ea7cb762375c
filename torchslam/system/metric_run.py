"""A finished run goes into meters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

from jaxtyping import Float
from torch import Tensor

from torchslam.errors import MeasurementError
from torchslam.geometry import sim3_inverse, sim3_scale
from torchslam.geometry.transforms import covariances_with_unit, without_scale
from torchslam.metric.meters import bring_into_meters
from torchslam.metric.source import Images, MetricSource, SubmapView
from torchslam.system.run import Run
from torchslam.types import StepResult

AnyRun = TypeVar("AnyRun", bound=Run)


def run_in_meters(run: AnyRun, sequence: Images | None, sources: Iterable[MetricSource]) -> AnyRun:
    """Bring every submap with measurements into meters; the others keep their unit.

    The submaps are changed in place, the poses that were returned frame by frame follow the submap that they are in. A
    measurement that is wrong leaves the run as it is, with the reason in `Run.unmeasured`.

    Args:
        run: a finished run.
        sequence: its images; None where they are not at hand.
        sources: what measures.
    """
    sources, results, unmeasured = list(sources), list(run.results), list[str]()
    if not sources:
        return run
    for submap in run.submaps:
        if not submap.posed_frames.count(run.session):
            continue
        try:
            view = SubmapView(submap, run.camera, run.session, sequence, run.readout)
            S_mw, silent = bring_into_meters(view, sources)
        except MeasurementError as error:
            return replace(run, results=results, unmeasured=(str(error),))
        if submap is run.main:
            unmeasured = [f"{each.source}: {each.reason}" for each in silent]
        for row, result in enumerate(results):
            if result.submap == submap.number and result.T_cw is not None:
                results[row] = _moved(result, S_mw)
    return replace(run, results=results, unmeasured=tuple(unmeasured))


def _moved(result: StepResult, S_mw: Float[Tensor, "4 4"]) -> StepResult:
    """A frame's result after a similarity of the world."""
    assert result.T_cw is not None  # the caller's condition
    S_cm = result.T_cw @ sim3_inverse(S_mw.to(result.T_cw))
    covariance = result.covariance
    if covariance is not None:
        covariance = covariances_with_unit(covariance, sim3_scale(S_cm).to(covariance))
    return replace(result, T_cw=without_scale(S_cm), covariance=covariance)
