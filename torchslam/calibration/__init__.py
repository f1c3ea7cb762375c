"""The camera from images: its focal length from pairs of them, its intrinsics from the graph of a run."""

from torchslam.calibration.find_camera import search_focal
from torchslam.optim.sensor_estimate import keyframe_evidence

__all__ = ["keyframe_evidence", "search_focal"]
