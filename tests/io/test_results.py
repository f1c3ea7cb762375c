from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.box_room import box_cloud, box_depths
from tests.walks import Walk, arc
from torchslam.data import read_trajectory
from torchslam.errors import ResultsError
from torchslam.io.export.ply import upright_from_map, write_cloud
from torchslam.io.report import run_metrics
from torchslam.io.results import (
    DENSE_CLOUD,
    DEPTHS,
    GRAPH,
    LOOPS,
    MESH,
    PICTURES,
    open_run,
    prepare,
    read_metrics,
    read_results,
    readout_of,
    results_in,
)
from torchslam.io.write_run import draw, write_results
from torchslam.loop_closing.records import LoopClosureRecord, LoopEdge, LoopMatches
from torchslam.map.atlas import Submap
from torchslam.map.file import read_atlas
from torchslam.system.run import Run
from torchslam.types import PoseEstimate

WALK = Walk(arc(30))


def write(run: Run, directory: Path) -> None:
    write_results(run, WALK, run_metrics(run), directory)


@pytest.fixture
def two(run: Run, submap: Submap) -> Run:
    """A second submap with two frames."""
    other = Submap(3, submap.tracking)
    other.map.add_keyframe(
        replace(submap.map.frame_features(0), index=18, timestamp=100.6), submap.map.T_cw[0]
    )
    for index in (18, 19):
        view = replace(submap.map.frame_features(0), index=index, timestamp=100 + index / 30)
        seen = PoseEstimate(
            submap.map.T_cw[0], *[torch.zeros(0, dtype=torch.int64)] * 2, 0, torch.eye(6), 1.0
        )
        other.posed_frames.add(view, seen, torch.eye(4, dtype=torch.float64), 0)
    return replace(run, submaps=(other, submap))


def test_results_round_trip(tmp_path: Path, run: Run) -> None:
    assert results_in(tmp_path / "new") == []
    write(run, tmp_path / "new")
    assert {path.name for path in results_in(tmp_path / "new")} == {
        path.name for path in (tmp_path / "new").iterdir()
    }
    results = read_results(tmp_path / "new")
    torch.testing.assert_close(results.trajectory.T_wc, run.trajectory.T_wc, rtol=0, atol=1e-8)
    assert len(results.keyframes) == 6
    assert [frame.submap for frame in results.frames] == [result.submap for result in run.results]
    assert results.session == 0


def test_a_run_leaves_its_graph_and_its_loops(tmp_path: Path, run: Run) -> None:
    edge = LoopEdge(
        LoopMatches(
            torch.zeros(0, dtype=torch.int64), torch.zeros(0, 2), torch.zeros(0, 3), torch.zeros(0, 3)
        ),
        *(run.map.T_cw[:2], torch.tensor([[0, 1]]), run.map.T_cw[2:3]),
        *(run.map.keyframes[name][:2] for name in ("frame_index", "session")),
    )
    closed = replace(
        run, loop_closures=(LoopClosureRecord(20, 3, 0, 0, edge), LoopClosureRecord(21, 4, 0, 0))
    )
    write(closed, tmp_path)
    saved = open_run(tmp_path)
    for name in ("pixels", "weights", "T_cw", "point_ids", "keypoint_index"):
        assert torch.equal(getattr(saved.graph, name), getattr(run.graph, name))
    first, second = saved.loop_closures
    assert (first, second.edge) == (closed.loop_closures[0], None)
    assert first.edge is not None
    assert torch.equal(first.edge.graph.S_ji, edge.S_ji)
    content = [(tmp_path / name).read_bytes() for name in (GRAPH, LOOPS)]
    write(closed, tmp_path)
    assert [(tmp_path / name).read_bytes() for name in (GRAPH, LOOPS)] == content
    (tmp_path / GRAPH).unlink()
    (tmp_path / LOOPS).write_bytes(b"no loops")
    with pytest.raises(ResultsError, match="no graph"):
        _ = saved.graph
    with pytest.raises(ResultsError, match="not the loops"):
        _ = saved.loop_closures


def test_the_dense_cloud_is_read_into_the_world_of_the_map(tmp_path: Path, run: Run) -> None:
    write(run, tmp_path)
    assert read_results(tmp_path).cloud is None
    cloud = box_cloud(box_depths(run.map.T_cw[:1], torch.tensor([0]), run.camera))
    write_cloud(tmp_path / DENSE_CLOUD, cloud, upright_from_map(run.map))
    found = read_results(tmp_path).cloud
    assert found is not None
    torch.testing.assert_close(found.points_w, cloud.points_w, atol=1e-5, rtol=0)


def test_a_new_run_deletes_the_dense_results_of_the_old_one(tmp_path: Path, run: Run) -> None:
    write(run, tmp_path)
    (tmp_path / PICTURES).mkdir(parents=True)
    stale = [tmp_path / name for name in (DENSE_CLOUD, DEPTHS, MESH, PICTURES / "000012.png")]
    mine = tmp_path / PICTURES / "mine.png"
    for path in (*stale, mine):
        path.write_bytes(b"")
    write(run, tmp_path)
    assert not any(path.exists() for path in stale)
    assert mine.exists()


def test_online_poses_have_a_file(tmp_path: Path, run: Run) -> None:
    write(run, tmp_path)
    online = read_trajectory(tmp_path / "online.txt")
    assert len(online) == 23
    assert torch.equal(online.T_wc, torch.eye(4, dtype=torch.float64).expand(23, 4, 4))


def test_online_poses_of_merged_submaps_stay_separate(run: Run) -> None:
    """Frames 3 to 9 given in submap 5, 10 to 17 in 4; those became submap 0. Submap 7, of 22 to 24, is another one."""
    submaps = {index: 5 if index < 10 else 4 for index in range(3, 18)} | dict.fromkeys(range(22, 25), 7)
    results = [replace(one, submap=submaps.get(one.index, one.submap)) for one in run.results]
    loop_closures = (
        LoopClosureRecord(30, 9, 5, 4),
        LoopClosureRecord(40, 30, 0, 0),
        LoopClosureRecord(41, 20, 4, 0),
        LoopClosureRecord(42, 2, 7, 6),
    )
    joined = replace(run, results=results, loop_closures=loop_closures)
    assert len(joined.online) == 5
    assert [len(part) for part in joined.online_parts] == [5, 8, 7]
    assert joined.online_parts[2].timestamps[0] == run.results[3].timestamp
    assert [len(part) for part in replace(joined, loop_closures=()).online_parts] == [5]
    assert replace(joined, submaps=()).online_parts == []


def test_other_submaps_have_their_own_trajectories(tmp_path: Path, two: Run, run: Run) -> None:
    write(two, tmp_path)
    assert len(read_trajectory(tmp_path / "trajectory.txt")) == 23
    assert len(read_trajectory(tmp_path / "trajectory_3.txt")) == 2
    assert json.loads((tmp_path / "metrics.json").read_text())["submap"] == 0
    assert [submap.number for submap in read_atlas(tmp_path / "map.safetensors").atlas] == [3, 0]
    assert read_results(tmp_path).map.num_keyframes == 6
    write(run, tmp_path)
    assert not (tmp_path / "trajectory_3.txt").exists()


def test_plots_name_their_submap(tmp_path: Path, two: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from torchslam.io import plots

    titles = {}
    monkeypatch.setattr(
        plots, "save", lambda figure, path: titles.__setitem__(path.stem, figure.get_suptitle())
    )
    write(two, tmp_path)
    draw(read_results(tmp_path), tmp_path)
    assert "submap 0, the main one of 2" in titles["top_view"].replace("\n", " ")
    write(replace(two, submaps=two.submaps[1:]), tmp_path)
    draw(read_results(tmp_path), tmp_path)
    assert "submap" not in titles["top_view"]


def test_a_localization_run_is_plotted(tmp_path: Path, run: Run, submap: Submap) -> None:
    submap.posed_frames.frames["session"][:] = 1
    localized = replace(run, session=1, sessions=1)
    write(localized, tmp_path)
    assert read_atlas(tmp_path / "map.safetensors").sessions == 1
    results = read_results(tmp_path)
    assert len(results.keyframes) == 0
    assert len(results.trajectory) == 23
    names = {path.stem for path in draw(results, tmp_path)}
    assert names == {"tracking", "scene", "top_view"}


def test_ellipses_are_drawn_at_the_keyframes(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of the map are not in order of time: those found on the way back come later."""
    from torchslam.io import plots

    keyframes = run.map.keyframes
    keyframes.keep(torch.tensor([2, 0, 1, 3, 4, 5]))
    keyframes["covariances"][:] = torch.eye(6, dtype=torch.float64) * keyframes["timestamp"][:, None, None]
    drawn: list[Any] = []
    monkeypatch.setattr(plots, "save", lambda figure, path: None)
    monkeypatch.setattr(plots, "plot_top_view", lambda *arguments: drawn.extend(arguments))
    write(run, tmp_path)
    draw(read_results(tmp_path), tmp_path)
    _, _, _, keyframes, _, _, covariances_w, _ = drawn
    assert torch.allclose(covariances_w[:, 0, 0], keyframes.timestamps)


def test_unknown_metrics_are_refused(tmp_path: Path, run: Run) -> None:
    write(run, tmp_path)
    for content in ("{}", '{"frames": 3}'):
        (tmp_path / "metrics.json").write_text(content)
        with pytest.raises(ResultsError, match=r"metrics\.json: not the metrics of a run: .*submap"):
            read_results(tmp_path)


def test_a_folder_whose_maps_could_not_be_read_is_refused_before_the_run(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xe9t\xe9"))
    with pytest.raises(ResultsError, match="its name is not UTF-8"):
        prepare(folder, overwrite=False, resume=False)
    assert not folder.exists()
    prepare(tmp_path / "été", overwrite=False, resume=False)
    assert (tmp_path / "été").is_dir()


@pytest.mark.parametrize(
    "entry", [{"ms": 28.0}, {"ms": "28", "std_ms": 1.0}, {"ms": 1e9, "std_ms": 1.0}, 28.0]
)
def test_an_unknown_readout_is_refused(tmp_path: Path, run: Run, entry: object) -> None:
    write(run, tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    (tmp_path / "metrics.json").write_text(json.dumps(metrics | {"readout": entry}))
    with pytest.raises(ResultsError, match="not the metrics of a run: readout is"):
        read_metrics(tmp_path)


def test_the_readout_is_read() -> None:
    known = readout_of({"readout": {"ms": 28.0, "std_ms": 1.0, "given_ms": 0.0}})
    assert known is not None
    assert (float(known.seconds), known.std) == pytest.approx((0.028, 0.001))
    assert readout_of({"readout": None}) is None
    assert readout_of({}) is None
