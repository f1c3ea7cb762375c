"""The names of the files in a results folder; imports no torch."""

from __future__ import annotations

from pathlib import Path

TRAJECTORY = "trajectory.txt"
OTHER_TRAJECTORY = "trajectory_{}.txt"  # of the submap of that number
ONLINE = "online.txt"
KEYFRAMES = "keyframes.txt"
GROUND_TRUTH = "groundtruth.txt"
MAP = "map.safetensors"
GRAPH = "graph.safetensors"  # all observations
LOOPS = "loops.safetensors"  # the loops that were closed, and their pose graphs
CHECKPOINT = "checkpoint.safetensors"  # while a run is going on
STAGES = "global_mapping"  # folder of the saved stages of global mapping, during a run
LIVE = "live.npz"  # the map so far, during a run
POINT_CLOUD = "map.ply"
DENSE_CLOUD = "dense.ply"  # of the main submap, z up as in POINT_CLOUD
MESH = "mesh.ply"  # of the main submap, z up as in POINT_CLOUD
DEPTHS = Path("dense") / "depths.safetensors"  # of keyframes of the main submap
PICTURES = Path("dense") / "pictures"
PICTURE_NAMES = "[0-9]" * 6 + ".png"  # pattern of depth pictures: the digits of the frame
CONFIG = "config.toml"
METRICS = "metrics.json"
FRAMES = "frames.csv"
EXAMPLE_IMAGE = "example.png"
PLOTS = "plots"
STAGE_SUFFIX = "_ms"  # of the columns of frames.csv that have times
