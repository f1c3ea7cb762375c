"""`torchslam align` on a run over a few rendered frames, and `torchslam run` with measurements."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from tests.cli.conftest import FAST, ROOM
from torchslam.cli import align, arguments
from torchslam.cli.main import main
from torchslam.data import read_trajectory
from torchslam.map.file import read_atlas
from torchslam.metric.source import ScaleMeasurement, ScaleSource, SubmapView, Unmeasured

pytestmark = pytest.mark.usefixtures("without_pictures")
MARKER = ["--marker", "apriltag-36h11:0.2"]  # there is none in the room


class Known:
    """A source that knows the unit and the vertical."""

    def __init__(self, meters_per_unit: float) -> None:
        self.meters_per_unit = meters_per_unit

    def measure(self, view: SubmapView) -> ScaleMeasurement | Unmeasured:
        assert view.sequence is not None
        assert view.sequence.image(int(view.frame_index[0])).shape[-1] == view.camera.width
        up_w = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
        return ScaleMeasurement(
            ScaleSource.DISTANCE, self.meters_per_unit, 0.01, 1, "known length", up_w=up_w, up_std=0.01
        )


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("torchslam.io.write_run.draw", lambda results, output: [])
        assert main(["run", ROOM, "--output", str(directory), *FAST, *MARKER]) == 0
    return directory


def test_a_run_without_a_marker_in_view_says_so(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["metric"] is None
    assert metrics["unmeasured"] == ["marker: no image shows a marker (apriltag-36h11)"]


def test_a_finished_run_gets_meters(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = read_trajectory(copy / "trajectory.txt").positions_w
    monkeypatch.setattr(align, "sources_of", lambda given: [Known(3.0)])
    assert main(["align", str(copy), *MARKER]) == 0
    assert "scale 1.000 ± 0.010 (1 known length)" in capsys.readouterr().out
    after = read_trajectory(copy / "trajectory.txt").positions_w
    R = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    torch.testing.assert_close(after, 3 * before @ R.mT, atol=1e-6, rtol=0)
    (submap,) = read_atlas(copy / "map.safetensors").atlas
    torch.testing.assert_close(submap.trajectory(0).positions_w, after, atol=1e-8, rtol=0)
    metrics = json.loads((copy / "metrics.json").read_text())
    assert metrics["metric"]["relative_std"] == pytest.approx(0.01)
    assert main(["export", str(copy), "--to", "tum", "--output", str(copy / "path.txt")]) == 0
    torch.testing.assert_close(read_trajectory(copy / "path.txt").positions_w, after, atol=1e-6, rtol=0)
    # What is in meters stays so, and is compared.
    monkeypatch.setattr(align, "sources_of", lambda given: [Known(1.5)])
    assert main(["align", str(copy), *MARKER]) == 0
    assert "map and distance contradict each other" in capsys.readouterr().err
    assert torch.equal(read_trajectory(copy / "trajectory.txt").positions_w, after)


def test_align_gives_what_the_run_gives(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(align, "sources_of", lambda given: [Known(3.0)])
    assert main(["align", str(copy), *MARKER]) == 0
    monkeypatch.setattr(arguments, "metric_sources", lambda config, sequence: [Known(3.0)])
    direct = tmp_path / "direct"
    assert main(["run", ROOM, "--output", str(direct), *FAST, *MARKER]) == 0
    for name in ("trajectory.txt", "keyframes.txt"):
        later, at_once = (read_trajectory(folder / name).T_wc for folder in (copy, direct))
        torch.testing.assert_close(later, at_once, atol=1e-8, rtol=0)
    later, at_once = (json.loads((folder / "metrics.json").read_text()) for folder in (copy, direct))
    assert later["metric"] == at_once["metric"]


def test_where_nothing_measures_nothing_is_changed(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    assert main(["align", str(copy), *MARKER]) == 3
    assert "nothing was changed" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ([], "no source of scale: give one of --marker"),
        (["--marker", "apriltag-1h1:0.1"], "no family apriltag-1h1"),
        (["--distance", "1:2,3", "1:2,4", "long"], "no length in meters"),
        (["--distance", "1:2,3", "1:9999,4", "2"], "outside of the image"),
    ],
)
def test_wrong_measurements_are_one_line(
    copy: Path, words: list[str], what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["align", str(copy), *words]) == 2
    assert what in capsys.readouterr().err


def test_a_click_outside_of_the_image_stops_a_run_before_its_first_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "new"
    assert main(["run", ROOM, "--output", str(output), "--distance", "1:2,3", "1:9999,4", "2"]) == 2
    assert "--distance 1:9999,4: outside of the image" in capsys.readouterr().err
    assert not output.exists()


def test_a_map_that_is_only_localized_in_keeps_its_unit(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", ROOM, "--output", str(tmp_path / "again"), "--map", str(copy), "--localize", *MARKER]
    assert main(words) == 2
    assert "keeps its unit" in capsys.readouterr().err


def test_a_further_session_goes_on_in_meters(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(align, "sources_of", lambda given: [Known(3.0)])
    assert main(["align", str(copy), *MARKER]) == 0
    first = read_trajectory(copy / "trajectory.txt").positions_w
    further = tmp_path / "further"
    for more in (["--localize"], ["--overwrite"]):
        assert main(["run", ROOM, "--output", str(further), "--map", str(copy), *FAST, *more]) == 0
        metrics = json.loads((further / "metrics.json").read_text())
        assert metrics["metric"]["relative_std"] == pytest.approx(0.01)
        second = read_trajectory(further / "trajectory.txt").positions_w
        lengths = [float((path[-1] - path[0]).norm()) for path in (first, second)]
        assert lengths[1] == pytest.approx(lengths[0], rel=0.02)
