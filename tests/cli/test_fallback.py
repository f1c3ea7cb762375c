"""The fallback of `torchslam run`: when it is tried, what it runs with, which run is kept."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from torchslam.cli import run as command
from torchslam.cli.main import main
from torchslam.cli.progress import StopSignals
from torchslam.cli.run import Attempt, RunPlan
from torchslam.config import Config
from torchslam.data import Sequence
from torchslam.features.weights import FOLDER

ROOM = "synthetic:room?frames=16"
FAST = ["--processes", "1"]


@pytest.fixture(autouse=True)
def everything_is_too_few(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whatever is posed, another front end is tried; its weights are not there."""
    monkeypatch.setattr(command, "FEW_POSED", 1.1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(FOLDER, raising=False)


@pytest.mark.usefixtures("without_pictures")
def test_missing_weights_are_named_with_their_license(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", ROOM, "-o", str(tmp_path / "out"), *FAST]) == 0
    said = capsys.readouterr().err
    assert "of the frames are posed in one map; learned features may pose more" in said
    assert "`torchslam download xfeat-lighterglue`" in said
    assert "Apache-2.0" in said


@pytest.mark.usefixtures("without_pictures")
def test_named_features_are_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", ROOM, "-o", str(tmp_path / "out"), *FAST, "--features", "orb"]) == 0
    assert "learned features" not in capsys.readouterr().err


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(("without_map", "kept"), [(0, "xfeat-lighterglue"), (1, "orb"), (None, "orb")])
def test_the_run_with_more_poses_is_kept(
    without_map: int | None,
    kept: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of runs with equally many poses, the first one."""
    attempt, tried = command._attempt, list[Config]()

    def attempted(
        sequence: Sequence, config: Config, plan: RunPlan, signals: StopSignals, viewers: ExitStack
    ) -> Attempt:
        tried.append(config)
        made = attempt(sequence, Config(), plan, signals, viewers)
        if len(tried) - 1 != without_map:
            return made
        return replace(made, finished=replace(made.finished, submaps=()))

    monkeypatch.setattr(command, "_attempt", attempted)
    monkeypatch.setattr(command, "find_weights", lambda name: Path(name))
    assert main(["run", ROOM, "-o", str(tmp_path / "out"), *FAST]) == 0
    assert [config.features.kind for config in tried] == ["orb", "xfeat"]
    assert tried[1].features.weights == tried[1].matching.weights == "xfeat-lighterglue"
    assert tried[1].matching.matcher == "lightglue"
    assert f"keeping the run with {kept}" in capsys.readouterr().err
