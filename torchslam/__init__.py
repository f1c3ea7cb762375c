"""Monocular visual SLAM as a PyTorch program.

sequence = torchslam.open_sequence(path)
run = torchslam.run(sequence)
torchslam.evaluate(run.trajectory, sequence.groundtruth).ate_m
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchslam.utils.console import with_install_hint

if TYPE_CHECKING:
    from torchslam import calibration as calibration
    from torchslam import data as data
    from torchslam import dense as dense
    from torchslam import errors as errors
    from torchslam import evaluation as evaluation
    from torchslam import features as features
    from torchslam import geometry as geometry
    from torchslam import learning as learning
    from torchslam import optim as optim
    from torchslam import refine as refine
    from torchslam import types as types
    from torchslam.config import Config, load_config
    from torchslam.data import open_sequence
    from torchslam.errors import TorchslamError
    from torchslam.evaluation import evaluate
    from torchslam.features import ALIKED, ORB, SIFT, OpenCVORB, XFeat, match, match_by_projection
    from torchslam.geometry import (
        Camera,
        estimate_absolute_pose,
        estimate_relative_pose,
        triangulate,
        umeyama,
    )
    from torchslam.learning.clip_slam import ClipGraph, ClipPoses, ClipSLAM, clip_loss
    from torchslam.optim import BundleProblem, SolverOptions, solve_bundle, solve_least_squares, solve_pose
    from torchslam.optim.observation_graph import ObservationGraph
    from torchslam.optim.run_graph import GraphSolution, solve_graph
    from torchslam.recording import run
    from torchslam.system.run import Run
    from torchslam.system.slam import SLAM
    from torchslam.types import Features, Frame, Matches, State, StepResult, Trajectory

    __version__: str

__all__ = [
    "ALIKED",
    "ORB",
    "SIFT",
    "SLAM",
    "BundleProblem",
    "Camera",
    "ClipGraph",
    "ClipPoses",
    "ClipSLAM",
    "Config",
    "Features",
    "Frame",
    "GraphSolution",
    "Matches",
    "ObservationGraph",
    "OpenCVORB",
    "Run",
    "SolverOptions",
    "State",
    "StepResult",
    "TorchslamError",
    "Trajectory",
    "XFeat",
    "clip_loss",
    "estimate_absolute_pose",
    "estimate_relative_pose",
    "evaluate",
    "load_config",
    "match",
    "match_by_projection",
    "open_sequence",
    "run",
    "solve_bundle",
    "solve_graph",
    "solve_least_squares",
    "solve_pose",
    "triangulate",
    "umeyama",
]

_HOMES = {
    "torchslam": "calibration data dense errors evaluation features geometry learning optim refine types",
    "torchslam.config": "Config load_config",
    "torchslam.data": "open_sequence",
    "torchslam.errors": "TorchslamError",
    "torchslam.evaluation": "evaluate",
    "torchslam.features": "ALIKED ORB OpenCVORB SIFT XFeat match match_by_projection",
    "torchslam.geometry": "Camera estimate_absolute_pose estimate_relative_pose triangulate umeyama",
    "torchslam.recording": "run",
    "torchslam.learning.clip_slam": "ClipGraph ClipPoses ClipSLAM clip_loss",
    "torchslam.system.run": "Run",
    "torchslam.system.slam": "SLAM",
    "torchslam.optim": "BundleProblem SolverOptions solve_bundle solve_least_squares solve_pose",
    "torchslam.optim.observation_graph": "ObservationGraph",
    "torchslam.optim.run_graph": "GraphSolution solve_graph",
    "torchslam.types": "Features Frame Matches State StepResult Trajectory",
}
"""Public names by the module that has them, and public packages and modules."""


def __getattr__(name: str) -> Any:
    """A public name or package, imported when it is first asked for: torch alone takes a second or two."""
    if name == "__version__":
        return _version()
    home = next((home for home, names in _HOMES.items() if name in names.split()), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(f"{home}.{name}" if home == __name__ else home)
    except ModuleNotFoundError as error:
        raise with_install_hint(error) from error
    value = globals()[name] = module if home == __name__ else getattr(module, name)
    return value


def _version() -> str:
    """That of the installed package, `0+unknown` for a source tree that is not installed."""
    from importlib import metadata

    try:
        return metadata.version("torchslam")
    except metadata.PackageNotFoundError:
        return "0+unknown"


def __dir__() -> list[str]:
    return sorted([*__all__, *_HOMES[__name__].split(), "__version__"])
