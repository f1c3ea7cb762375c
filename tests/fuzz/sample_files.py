"""What a small run leaves behind: its results, its checkpoint, its graph, and its poses for other programs."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import torch

from tests.box_room import box_depths
from tests.fuzz.mutators import Files
from tests.fuzz.valid_inputs import content_of
from tests.walks import Walk, arc
from torchslam import SLAM, load_config
from torchslam.dense.cloud import PointCloud
from torchslam.geometry import Camera
from torchslam.io.export.colmap import write_colmap
from torchslam.io.export.nerfstudio import write_nerfstudio
from torchslam.io.export.ply import write_cloud
from torchslam.io.export.scene import scene_of
from torchslam.io.report import run_metrics
from torchslam.io.write_run import write_results
from torchslam.system.checkpoint import write_checkpoint
from torchslam.system.online_run import Observer, OnlineRun, RunProgress

OVERRIDES = (
    *("features.kind=simulated", "features.num_keypoints=120", "simulated.points_per_view=120"),
    "initialization.min_matches=40",
)
CONFIG = load_config(None, OVERRIDES)
WALK = Walk(arc(30))
SMALL_CAMERA = Camera.pinhole(8.0, 8.0, 5.5, 3.5, size=(12, 8))


@cache
def sample_files() -> dict[str, Files]:
    """By kind: `results`, `checkpoint`, `graph`, `colmap`, `transforms`, `dense`, `depths`."""
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        slam, so_far = SLAM(WALK.camera, CONFIG), RunProgress()

        def settled(result: object) -> None:
            if slam.can_checkpoint and not (root / "checkpoint").exists():
                (root / "checkpoint").mkdir()
                write_checkpoint(root / "checkpoint" / "checkpoint.safetensors", slam, so_far, WALK)

        run = OnlineRun(slam, WALK, so_far, observer=Observer(settled)).run()
        assert run.main is not None
        assert (root / "checkpoint").exists()
        write_results(run, WALK, run_metrics(run) | {"source": "walk", "camera": ""}, root / "results")
        (root / "graph").mkdir()
        run.graph.save(root / "graph" / "graph.safetensors")
        scene = scene_of(run.main, run.camera, 0, keyframes_alone=False)
        write_colmap(root / "colmap", scene)
        (root / "transforms").mkdir()
        write_nerfstudio(root / "transforms", scene, torch.eye(3, dtype=torch.float64))
        (root / "dense").mkdir()
        ones = torch.ones(20, 3)
        cloud = PointCloud(ones, ones / 3**0.5, ones.byte(), ones[:, 0])
        write_cloud(root / "dense" / "dense.ply", cloud)
        (root / "depths").mkdir()
        eyes = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
        box_depths(eyes, torch.tensor([0, 4, 9]), SMALL_CAMERA).save(root / "depths" / "depths.safetensors")
        return {kind.name: content_of(kind) for kind in root.iterdir()}
