"""The fallback of `torchslam run` with the real weights of XFeat and LightGlue."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from torchslam.cli.main import main
from torchslam.cli.run import FEW_POSED, LEARNED
from torchslam.features.weights import FOLDER, find_weights

WEIGHTS_DIR = Path(os.environ.get(FOLDER, Path(__file__).parents[3] / "shared" / "weights"))
PIECE = ["--start", "24", "--limit", "14"]
"""ORB loses the way here: views are far apart, and the windows look alike."""


@pytest.mark.data
@pytest.mark.usefixtures("without_pictures")
def test_learned_features_pose_what_orb_does_not(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(FOLDER, str(WEIGHTS_DIR))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    walk = data_dir / "courthouse"
    if not walk.is_dir() or find_weights(LEARNED) is None:
        pytest.skip(f"no sequence at {walk}, or no weights {LEARNED} in {WEIGHTS_DIR}")
    out = tmp_path / "out"
    assert main(["run", str(walk), "-o", str(out), *PIECE, "--processes", "1"]) == 0
    said = capsys.readouterr().err
    posed = re.search(r"(\d+)% of the frames are posed in one map: trying again with xfeat-lighterglue", said)
    assert posed is not None, said
    assert "keeping the run with xfeat-lighterglue" in said
    metrics = json.loads((out / "metrics.json").read_text())
    assert int(posed[1]) / 100 < FEW_POSED <= metrics["posed"] / metrics["frames"]
    assert metrics["reprojection_px"] < 3
    config = (out / "config.toml").read_text()
    assert 'kind = "xfeat"' in config
    assert 'matcher = "lightglue"' in config
