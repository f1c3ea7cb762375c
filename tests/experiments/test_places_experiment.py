"""Places: scores as a share of what the previous image has."""

from __future__ import annotations

import pytest
import torch

from experiments.places.run import relative_scores


def test_scores_are_relative_to_the_best() -> None:
    keys, scores = torch.tensor([7, 3, 5]), torch.tensor([0.6, 0.4, 0.2])
    assert relative_scores(keys, scores, torch.tensor([5, 3])).tolist() == pytest.approx([1.5, 1.0, 0.5])
    assert relative_scores(keys, scores, torch.tensor([8])).tolist() == [0.0, 0.0, 0.0]
    assert relative_scores(keys, scores / 9, torch.tensor([5])).tolist() == pytest.approx([3.0, 2.0, 1.0])
    assert relative_scores(keys, scores / 11, torch.tensor([5])).tolist() == [0.0, 0.0, 0.0]
    assert relative_scores(keys[:0], scores[:0], torch.tensor([8])).tolist() == []
