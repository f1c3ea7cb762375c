"""A custom motion model:

torchslam run IMAGES -o results --motion-model examples.own_motion_model:steady
"""

import torch

from torchslam.geometry import se3_exp, se3_log
from torchslam.types import MotionHistory, PosePrediction


def steady(history: MotionHistory) -> PosePrediction:
    """The mean of the last three motions, which may change by as much as all of them did."""
    if len(history.motions) < 3:
        last = history.motions[-1] if len(history.motions) else torch.eye(4).to(history.T_cw)
        return PosePrediction(last @ history.T_cw)
    motions = se3_log(history.motions)
    changes = motions.diff(dim=0)
    variances = 4 * changes.square().mean(0) + 1e-6  # 0.001 of the unit of the map, and radians
    return PosePrediction(se3_exp(motions[-3:].mean(0)) @ history.T_cw, variances.diag())
