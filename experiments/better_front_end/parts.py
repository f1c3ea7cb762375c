"""A matcher without a ratio test, as learned features are mostly matched. See README.md."""

from __future__ import annotations

from dataclasses import replace

from torchslam.config import MatchingConfig
from torchslam.features import match
from torchslam.tracking.matcher import DescriptorMatcher, max_distance
from torchslam.types import FrameFeatures, Matches, MatchPrior


class Mutual:
    """Each other's nearest descriptors, as learned ones are matched where they are published: no ratio test.

    Along epipolar lines torchslam's own matches are such already.
    """

    def __init__(self) -> None:
        self.settings = MatchingConfig()
        self.own = DescriptorMatcher(self.settings)

    def __call__(self, view_1: FrameFeatures, view_2: FrameFeatures, prior: MatchPrior | None) -> Matches:
        limit = max_distance(view_2.descriptors, self.settings)
        if prior is None:
            return match(view_1.features, view_2.features, ratio=None, mutual=True, max_distance=limit)
        without = prior if prior.radius_px is None else replace(prior, ratio=None)
        return self.own(view_1, view_2, without)
