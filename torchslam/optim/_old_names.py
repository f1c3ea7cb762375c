"""The names of solvers before 0.2.0, which go with 0.3.0."""

from torchslam.optim._core.options import (
    BUNDLE_OPTIONS,
    LEAST_SQUARES_OPTIONS,
    POSE_GRAPH_OPTIONS,
    POSE_OPTIONS,
)
from torchslam.optim._least_squares import solve_least_squares
from torchslam.optim.bundle._api import solve_bundle
from torchslam.optim.pose._refinement import solve_pose
from torchslam.optim.pose_graph._api import solve_pose_graph
from torchslam.utils.deprecation import OldCall

minimize = OldCall(
    "residual start inputs manifolds weights mask kernel scale backward iterations tolerance strict",
    LEAST_SQUARES_OPTIONS,
).of(solve_least_squares, "minimize")

refine_pose = OldCall(
    "T_cw points_w pixels camera weights mask kernel scale prior backward iterations tolerance strict",
    POSE_OPTIONS,
).of(solve_pose, "refine_pose")

bundle_adjust = OldCall(
    "problem kernel scale free_camera backward iterations tolerance progress check strict", BUNDLE_OPTIONS
).of(solve_bundle, "bundle_adjust")

pose_graph_optimize = OldCall(
    "graph kernel scale backward iterations tolerance strict", POSE_GRAPH_OPTIONS
).of(solve_pose_graph, "pose_graph_optimize")
