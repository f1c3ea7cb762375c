"""Links that SIFT does not hold, tied by learned features where asked for: XFeat, matched by LightGlue.

Their keypoints are other points than those of SIFT. So images near such a link get them in addition, with the noise of
their own, and the points that they see have tracks of their own in the same map.

Sources: Potje et al., "XFeat: accelerated features for lightweight image matching", CVPR 2024; Lindenberger, Sarlin and
Pollefeys, "LightGlue: local feature matching at light speed", ICCV 2023.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import pad

from torchslam.config import Config
from torchslam.errors import ConfigError
from torchslam.features.weights import weights_file
from torchslam.global_mapping.rounds import ObservedTracks, Reconstruction
from torchslam.global_mapping.view_graph import FAR, ViewPair
from torchslam.global_mapping.weak_links import ACROSS
from torchslam.types import FrameFeatures

WEIGHTS = "xfeat-lighterglue"
"""Name of the weights of both networks, which were trained together."""
NUM_KEYPOINTS = 1000
"""Learned keypoints of an image, of which those with verified matches are kept. Neighbors then have 199 to 467 verified
matches between the bare walls of office_loop (every second image), where SIFT has 20 to 27 or none. Tried at this value
only."""
MIN_LEARNED_MATCHES = 80
"""Least number of verified matches of a pair. LightGlue finds some between images that share nothing as well, and they
verify each other: of pairs one to three images apart (courthouse, office_loop, every second image) with 20 to 79
verified matches 66 % have a rotation that is off by more than 5 degrees, of those with more 3 %. Tried at 50 and 80."""
HELD = 50
"""Points that images on both sides of a moment must agree on so that SIFT holds the link. On office_loop, whose every
image is posed, the fewest are 68. Tried at 30 and 50."""


@dataclass(frozen=True)
class LearnedPairs:
    """Images with learned keypoints, and the matches of these.

    Attributes:
        views: all images, some with more keypoints after those that they had.
        pairs: verified matches of the learned keypoints, by first, then second image.
    """

    views: list[FrameFeatures]
    pairs: list[ViewPair]


def learned_config(config: Config) -> Config | None:
    """The configuration of global mapping with learned features in place of SIFT; None if they are not asked for.

    Args:
        config: of global mapping, see `mapping_config`.

    Raises:
        ConfigError: the weights are not on this machine, or the features are not SIFT with its own matcher.
    """
    if not config.global_mapping.learned_links:
        return None
    if config.features.kind != "sift" or config.matching.matcher != "descriptors":
        raise ConfigError(
            "global_mapping.learned_links requires the default features and matcher, not "
            f"{config.features.kind} and {config.matching.matcher}"
        )
    try:
        weights_file(WEIGHTS)
    except ConfigError as error:
        raise ConfigError(f"global_mapping.learned_links: {error}") from None
    return replace(
        config,
        global_mapping=replace(config.global_mapping, learned_links=False),
        features=replace(config.features, kind="xfeat", weights=WEIGHTS, num_keypoints=NUM_KEYPOINTS),
        matching=replace(config.matching, matcher="lightglue", weights=WEIGHTS),
    )


def open_links(observed: ObservedTracks, found: Reconstruction) -> list[tuple[list[int], list[int]]]:
    """The links that a map does not hold: the images nearest before each, ascending, and after it."""
    rows = range(len(found.T_cw))
    few = torch.nonzero(points_across(observed, found) < HELD)[:, 0].tolist()
    return [
        (list(rows[max(at + 1 - ACROSS, 0) : at + 1]), list(rows[at + 1 : at + 1 + ACROSS])) for at in few
    ]


def points_across(observed: ObservedTracks, found: Reconstruction) -> Int[Tensor, " M"]:
    """The number of points that hold together what is before and after each moment between two images.

    A point counts if two images that agree on it, one on either side, are less than `FAR` apart and no image between
    them sees it: loops hold places together, not the moments between.
    """
    track, view = observed.tracks.track[found.agrees], observed.tracks.view[found.agrees]
    before, after = view[:-1], view[1:]
    near = (track[1:] == track[:-1]) & (after - before < FAR)
    begun, ended = (torch.bincount(rows[near], minlength=len(found.T_cw)) for rows in (before, after))
    return (begun - ended).cumsum(0)[:-1]


def with_learned(
    views: Sequence[FrameFeatures], learned: Mapping[int, FrameFeatures], pairs: Sequence[ViewPair]
) -> LearnedPairs:
    """Append those learned keypoints to images that are in pairs, in rows that are free, or else in more rows for all.

    Args:
        views: all images, with as many rows each.
        learned: learned features of some of them, by row.
        pairs: verified, of the learned features.
    """
    matched = {row: torch.zeros_like(view.mask) for row, view in learned.items()}
    for pair in pairs:
        matched[pair.first][pair.keypoints_1] = True
        matched[pair.second][pair.keypoints_2] = True
    begin = {
        row: 1 + int(torch.nonzero(views[row].mask).amax()) if views[row].mask.any() else 0 for row in learned
    }
    place = {row: begin[row] - 1 + chosen.cumsum(0) for row, chosen in matched.items()}
    count = max(
        [len(view.mask) for view in views] + [begin[row] + int(matched[row].sum()) for row in learned]
    )
    more = [_in_rows(view, count) for view in views]
    for row, own in learned.items():
        more[row] = _filled(more[row], own, matched[row], begin[row])
    moved = [
        replace(
            pair,
            keypoints_1=place[pair.first][pair.keypoints_1],
            keypoints_2=place[pair.second][pair.keypoints_2],
        )
        for pair in pairs
    ]
    return LearnedPairs(more, moved)


def _in_rows(view: FrameFeatures, count: int) -> FrameFeatures:
    """The view with rows that are no keypoints after its own, `count` in all."""
    new = count - len(view.mask)
    if new == 0:
        return view
    return replace(
        view,
        keypoints=pad(view.keypoints, (0, 0, 0, new)),
        detected=pad(view.detected, (0, 0, 0, new)),
        scales=pad(view.scales, (0, new), value=1.0),
        angles=pad(view.angles, (0, new)),
        descriptors=pad(view.descriptors, (0, 0, 0, new)),
        mask=pad(view.mask, (0, new)),
        information=pad(view.information, (0, 0, 0, new), value=1.0),
    )


def _filled(view: FrameFeatures, learned: FrameFeatures, chosen: Tensor, begin: int) -> FrameFeatures:
    """The view with chosen learned keypoints from a row on; what their descriptors lack in width is zero."""
    rows = slice(begin, begin + int(chosen.sum()))
    width = view.descriptors.shape[1] - learned.descriptors.shape[1]
    columns = {
        name: getattr(view, name).clone()
        for name in ("keypoints", "detected", "scales", "angles", "descriptors", "mask", "information")
    }
    for name, column in columns.items():
        new = getattr(learned, name)[chosen]
        column[rows] = (pad(new, (0, width)) if name == "descriptors" else new).to(column)
    return replace(view, **columns)
