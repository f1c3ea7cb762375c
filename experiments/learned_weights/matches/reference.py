"""Reference poses: those of a bundle adjustment over all frames of a sequence, in the meters of its ground truth.

Sensor poses are accurate to centimeters, which is the size of the measured errors; adjusted poses explain the images to
fractions of a pixel. Such a reference favors methods similar to the one that made it (Brachmann et al., "On the limits
of pseudo ground truth in visual camera re-localization", 2021), so the given poses are kept as well.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchslam import SLAM
from torchslam.data.sequence import Sequence
from torchslam.data.synthetic import SyntheticSequence
from torchslam.evaluation import evaluate
from torchslam.geometry import se3_inverse
from torchslam.system.front_end import true_poses


def reference_poses(sequence: Sequence, cache: Path) -> Tensor:
    """(N, 4, 4) T_cw of every frame, NaN for those that the system did not locate; read from the cache if it is there.

    Rendered sequences need no adjustment: theirs are the exact ones.
    Raises ValueError where the sequence has no ground truth to take the scale from.
    """
    if isinstance(sequence, SyntheticSequence):
        return true_poses(sequence)
    path = cache / f"reference_{sequence.name}.pt"
    if path.exists():
        return torch.load(path, weights_only=True)
    if sequence.groundtruth is None:
        raise ValueError(f"{sequence.name} has no ground truth")
    run = SLAM(sequence.camera).run(sequence)
    aligned = evaluate(run.trajectory, sequence.groundtruth).aligned
    T_cw = torch.full((len(sequence), 4, 4), torch.nan, dtype=torch.float64)
    rows = torch.searchsorted(sequence.timestamps, aligned.timestamps)
    T_cw[rows] = se3_inverse(aligned.T_wc)
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(T_cw, path)
    return T_cw
