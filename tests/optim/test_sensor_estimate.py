"""The sensor by a graph: an exact one is kept, a wrong camera and a readout are found."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from rolling_scene import CAMERA, FRAME_RATE, recording

from torchslam.geometry import Camera, SensorModel
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.geometry.rolling_shutter import Readout
from torchslam.optim import GRAPH_OPTIONS
from torchslam.optim.observation_graph import RunGraph
from torchslam.optim.run_graph import solve_graph
from torchslam.optim.sensor_estimate import SensorEstimate, SensorPrior, estimate_sensor, keyframe_evidence

OPTIONS = GRAPH_OPTIONS.replace(backward="detached", tolerance=1e-8)
SOUGHT, EXCLUDED = Readout.known(0.0, 0.03), Readout.known(0.0, 0.0)
FRAMES = 40


def off_by(factor: float) -> Camera:
    params = CAMERA.params.clone()
    params[:2] *= factor
    return CAMERA.with_params(params)


def graph(readout: float = 0.0, factor: float = 1.0, seed: int = 0, frames: int = FRAMES) -> RunGraph:
    """A recording as a run leaves it: adjusted with the camera in use and a global shutter."""
    plain = recording(readout, seed, frames=frames)
    plain = replace(plain, camera=off_by(factor), is_keyframe=torch.arange(frames) % 2 == 0)
    solution = solve_graph(plain, options=OPTIONS)
    columns = {name: getattr(plain, name) for name in plain.columns()}
    return RunGraph(
        **columns | {"T_cw": solution.T_cw, "points_w": solution.points_w},
        camera=plain.camera,
        frame_ids=torch.arange(frames),
        sessions=torch.zeros(frames, dtype=torch.int64),
        point_ids=torch.arange(len(plain.points_w)),
        keypoint_index=torch.arange(len(plain.pixels)),
    )


def prior(factor: float = 1.0, readout: Readout = EXCLUDED, std: float = 0.03) -> SensorPrior:
    return SensorPrior(CameraMeasurement.of(off_by(factor), std), readout)


def estimate(run: RunGraph, known: SensorPrior) -> SensorEstimate:
    return estimate_sensor(run, known, OPTIONS, FRAMES)


def focal_error(camera: Camera) -> float:
    return abs(float(camera.focal) / float(CAMERA.focal) - 1)


def test_an_exact_sensor_is_kept() -> None:
    """The very model that was in use."""
    for seed in range(3):
        run = graph(seed=seed)
        found = estimate(run, prior(readout=SOUGHT))
        assert not found.is_change
        assert found.sensor == SensorModel(run.camera)
        assert found.sensor.camera is run.camera


def test_a_camera_that_is_off_is_found() -> None:
    run = graph(factor=1.04)
    found = estimate(run, prior(1.04, SOUGHT))
    assert found.is_change
    assert (found.has_other_camera, found.has_other_readout) == (True, False)
    assert found.sensor.readout is None
    assert focal_error(found.sensor.camera) < 0.01
    assert found.departure > 2


def test_what_was_found_is_in_use_and_not_found_again() -> None:
    """The prior stays the given camera, so that no evidence counts twice."""
    known = prior(1.04, SOUGHT)
    first = estimate(graph(factor=1.04), known)
    factor = float(first.sensor.camera.params[0] / CAMERA.params[0])
    second = estimate(replace(graph(factor=factor), camera=first.sensor.camera), known)
    assert not second.has_other_camera
    assert second.departure < first.departure


@pytest.mark.parametrize("readout", [0.3, 0.9])
def test_a_readout_is_found_within_its_error(readout: float) -> None:
    found = estimate(graph(readout), prior(readout=SOUGHT))
    assert (found.has_other_camera, found.has_other_readout) == (False, True)
    shutter = found.sensor.readout
    assert shutter is not None
    error = float(shutter.seconds) - readout / FRAME_RATE
    assert abs(error) < 3 * shutter.std + 0.02 * readout / FRAME_RATE
    assert shutter.std < 0.05 / FRAME_RATE


def test_a_readout_is_taken_for_no_lens() -> None:
    """Where both are off, the readout is found first, and the camera by keypoints that it corrects."""
    run = graph(0.9, factor=1.04)
    first = estimate(run, prior(1.04, SOUGHT))
    assert (first.has_other_camera, first.has_other_readout) == (False, True)
    found = estimate(replace(run, readout=first.sensor.readout), prior(1.04, SOUGHT))
    assert found.has_other_camera
    assert focal_error(found.sensor.camera) < 0.015
    assert found.sensor.readout is not None
    assert float(found.sensor.readout.seconds) * FRAME_RATE == pytest.approx(0.9, abs=0.1)


@pytest.mark.parametrize("readout", [0.0, 0.9])
def test_an_excluded_readout_is_never_found(readout: float) -> None:
    found = estimate(graph(readout), prior())
    assert not found.has_other_readout
    assert found.sensor.readout is None


def test_a_given_readout_is_improved_by_any_evidence() -> None:
    known = Readout.known(0.6 / FRAME_RATE, 0.2 / FRAME_RATE)
    run = replace(graph(0.9), readout=known)
    found = estimate(run, prior(readout=known))
    assert found.has_other_readout
    shutter = found.sensor.readout
    assert shutter is not None
    assert float(shutter.seconds) * FRAME_RATE == pytest.approx(0.9, abs=0.05)
    assert shutter.prior == known.prior
    assert shutter.std < known.std


def test_a_readout_in_use_stays_where_the_residuals_determine_none() -> None:
    run, used = graph(frames=8), Readout.known(0.0, 0.03).updated(0.02, 0.001)
    found = estimate(replace(run, readout=used), prior(1.0, SOUGHT))
    assert found.shutter is None
    assert found.sensor.readout is used
    assert not found.has_other_readout


def test_an_exact_camera_is_not_estimated() -> None:
    """Only its readout is."""
    found = estimate(graph(0.9, factor=1.04), SensorPrior(None, SOUGHT))
    assert (found.has_other_camera, found.has_other_readout, found.departure) == (False, True, 0.0)
    assert focal_error(found.sensor.camera) == pytest.approx(0.04)


def test_keyframes_that_do_not_determine_the_camera_keep_it() -> None:
    run = graph(frames=12)
    blind = replace(run, pixels=torch.full_like(run.pixels, float("nan")))
    found = estimate(blind, prior())
    assert (found.is_change, found.departure) == (False, 0.0)
    assert found.sensor.camera is run.camera


def test_evidence_is_of_the_keyframes_at_their_own_minimum() -> None:
    """The adjustment moves frames and points with the camera, and what it returns has no prior left."""
    run, known = graph(factor=1.04), prior(1.04)
    assert known.camera is not None
    evidence = keyframe_evidence(run, known.camera, OPTIONS)
    assert evidence is not None
    assert evidence.is_better_than(run.camera)
    assert focal_error(evidence.estimate().camera) < 0.01
    # The same from a start with the right camera: the minimum does not depend on it.
    other = keyframe_evidence(replace(run, camera=CAMERA), known.camera, OPTIONS)
    assert other is not None
    torch.testing.assert_close(
        other.estimate().camera.params[:2], evidence.estimate().camera.params[:2], rtol=1e-3, atol=0.0
    )
