"""Shared by the studies of meters: the map of a run, its scale by a source, and the error of that scale."""

from __future__ import annotations

import math
from pathlib import Path

from torchslam import SLAM, Config, Run, evaluate
from torchslam.data import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.io.results import MAP, read_metrics
from torchslam.map.file import read_atlas
from torchslam.metric.source import MetricSource, ScaleMeasurement, SubmapView
from torchslam.types import Trajectory


def view_of_run(sequence: Sequence) -> tuple[Run, SubmapView]:
    """Run a sequence; return the run and a view of its largest map."""
    run = SLAM(sequence.camera, Config()).run(sequence)
    assert run.main is not None
    return run, SubmapView(run.main, run.camera, 0, sequence, run.readout)


def view_of_results(results: Path) -> tuple[Sequence, SubmapView]:
    """The recording of a results folder and a view of its largest map."""
    metrics, saved = read_metrics(results), read_atlas(results / MAP)
    submap = saved.atlas.main()
    assert submap is not None
    sequence = open_sequence(metrics["source"])
    return sequence, SubmapView(submap, saved.camera, int(metrics["session"]), sequence)


def scale_by(source: MetricSource, view: SubmapView) -> ScaleMeasurement:
    """The scale that a source determines."""
    found = source.measure(view)
    assert isinstance(found, ScaleMeasurement), found
    return found


def scale_error(found: ScaleMeasurement, trajectory: Trajectory, truth: Trajectory | None) -> float:
    """Error of the logarithm of the scale of a trajectory, whose true scale follows from alignment."""
    assert truth is not None
    return math.log(found.meters_per_unit / evaluate(trajectory, truth).scale)
