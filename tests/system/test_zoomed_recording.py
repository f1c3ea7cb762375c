"""A zoom within a recording: found, undone, and stated; what cannot be undone is doubted."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch

import torchslam
from torchslam import State
from torchslam.data import write_trajectory
from torchslam.data.sequence import Sequence, unzoomed_image
from torchslam.errors import ResultsError
from torchslam.evaluation import evaluate
from torchslam.geometry.zoom import Zoom
from torchslam.global_mapping.recording import MappedRun, with_doubtful_zoom
from torchslam.io.report import compute_metrics, summary
from torchslam.io.results import open_run
from torchslam.io.write_run import source_of, write_run
from torchslam.system.checkpoint import read_checkpoint, write_checkpoint
from torchslam.system.online_run import RunProgress
from torchslam.system.slam import SLAM
from torchslam.types import Reason

FRAMES, JUMP, RATIO = 72, 40, 1.3
"""Of the recording, the first with another focal length, and its ratio."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images in the layout of TUM, enlarged from a frame on."""
    plain, folder = room(), tmp_path_factory.mktemp("zoomed")
    (folder / "rgb").mkdir()
    names = [f"rgb/{index:03d}.png" for index in range(FRAMES)]
    for index, name in enumerate(names):
        ratio = RATIO if index >= JUMP else 1.0
        image = unzoomed_image(plain.image(index)[0, 0], 1 / ratio, plain.camera)
        cv2.imwrite(str(folder / name), (255 * image).round().byte().numpy())
    lines = [f"{plain.timestamp(index):.6f} {name}\n" for index, name in enumerate(names)]
    (folder / "rgb.txt").write_text("".join(lines))
    (folder / "calibration.txt").write_text(" ".join(map(str, plain.camera.params.tolist())) + "\n")
    assert plain.groundtruth is not None
    write_trajectory(folder / "groundtruth.txt", plain.groundtruth)
    return folder


@pytest.fixture(scope="module")
def run(folder: Path) -> MappedRun:
    return torchslam.run(torchslam.open_sequence(folder), mapping="online", processes=1)


def room() -> Sequence:
    return torchslam.open_sequence("synthetic:room", resize_to="320x240", limit=FRAMES)


def test_a_zoom_is_undone(run: MappedRun) -> None:
    """The path is that of a camera with one focal length, and nothing is doubted."""
    sequence = room()
    assert run.zoom is not None
    assert run.zoom.extent == pytest.approx(math.log(RATIO), abs=0.02)
    before, after = run.zoom.at(torch.tensor([JUMP - 1, JUMP])).tolist()
    assert before == pytest.approx(1.0, abs=0.01)
    assert after == pytest.approx(RATIO, abs=0.01)
    assert sequence.groundtruth is not None
    found = evaluate(run.trajectory, sequence.groundtruth)
    assert found.posed == FRAMES
    assert found.ate_m < 0.003 * found.path_length_m
    assert run.check is not None
    assert run.check.is_right
    assert not any(result.state is State.UNCERTAIN for result in run.results)


def test_results_state_the_zoom_and_exports_have_images_without_it(
    run: MappedRun, folder: Path, tmp_path: Path
) -> None:
    sequence = torchslam.open_sequence(folder)
    metrics = compute_metrics(run, sequence, "") | source_of(str(folder), None, sequence)
    assert "times that of the first frame at frame" in summary(metrics)["zoom"]
    write_run(run, sequence, metrics, tmp_path, plots=False, viewer=False)
    saved = open_run(tmp_path)
    assert saved.zoom == run.zoom
    images = saved.images(saved.scene(saved.submaps[0], keyframes_alone=True))
    frame = int(saved.map.keyframes["frame_index"].max())
    inside = torchslam.open_sequence(folder).unzoomed(saved.zoom).mask(frame)
    assert inside is not None
    found, as_taken = (
        float((source.image(frame) - room().image(frame))[inside].abs().mean())
        for source in (images, sequence)
    )
    assert found < 0.4 * as_taken
    (tmp_path / "metrics.json").write_text((tmp_path / "metrics.json").read_text().replace('"ratios"', '"x"'))
    with pytest.raises(ResultsError, match="zoom"):
        open_run(tmp_path)


def test_a_large_zoom_that_was_not_undone_before_the_frames_is_doubted(run: MappedRun) -> None:
    """As where a recording cannot be processed again: frames with the focal length of the first one are certain."""
    doubted = [
        result
        for result in with_doubtful_zoom(replace(run, read_zoom=None))
        if result.state is State.UNCERTAIN
    ]
    assert [result.index for result in doubted] == list(range(JUMP, FRAMES))
    assert doubted[-1].reasons[0].reason is Reason.ZOOM
    assert doubted[-1].reasons[0].values["ratio"] == pytest.approx(RATIO - 1, abs=0.02)


def test_a_run_without_its_zoom_goes_on_from_a_checkpoint(tmp_path: Path) -> None:
    sequence = room()
    slam, so_far = SLAM(sequence.camera), RunProgress()
    slam.zoom = Zoom(torch.tensor([0, 9]), torch.tensor([1.0, 1.1], dtype=torch.float64))
    for frame in sequence:
        so_far.results.append(slam.step(frame))
        so_far.next = frame.index + 1
        if slam.can_checkpoint:
            break
    write_checkpoint(tmp_path / "checkpoint", slam, so_far, sequence)
    resumed, _ = read_checkpoint(tmp_path / "checkpoint", sequence, slam.config)
    assert resumed.zoom == slam.zoom


def test_images_without_their_zoom_are_those_of_the_camera(folder: Path) -> None:
    """Enlarged, then undone: the same image within the margin, which is masked."""
    zoom = Zoom(torch.tensor([JUMP]), torch.tensor([RATIO], dtype=torch.float64))
    sequence = torchslam.open_sequence(folder)
    undone = sequence.unzoomed(zoom)
    mask = undone.mask(JUMP)
    assert mask is not None
    assert float(mask.double().mean()) == pytest.approx(1 / RATIO**2, abs=0.01)
    assert float((undone.image(JUMP) - room().image(JUMP))[mask].abs().mean()) < 0.02
    assert undone.color(JUMP).shape == (240, 320, 3)
    assert undone.unzoomed(None).image(JUMP).equal(sequence.image(JUMP))
