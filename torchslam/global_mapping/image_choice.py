"""Which images of a recording are mapped: those that overlap by so much that others between them add little."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from collections.abc import Sequence as Rows
from itertools import pairwise
from statistics import median

from torchslam.global_mapping.rounds import MIN_VIEWS
from torchslam.global_mapping.view_graph import ViewPair
from torchslam.types import FrameFeatures, State, StepResult

LEAST_SHARED, HALVINGS = 200, 2
"""Verified matches that neighbors must have, or else a frame between them is mapped as well, and how often the distance
is halved so at most. Keyframes of machine_hall have 637 in the median, those of office_loop, mapped alone, lose its
loop."""
ENOUGH_SHARED = 400
"""Verified matches of neighbors from which on frames or keyframes between them are left out. With 200 the error of
garden doubles; tried at these two values."""
FEW_IMAGES = 40
"""Frames or keyframes up to which all are mapped; of more, those that overlap by so much. Tried at this value only."""
SAMPLE, LEAST_OVERLAP = 12, 0.25
"""Pairs of neighbors that are matched first, and the share of them that must have so many matches: else all neighbors
count as too far apart, and no more of them are matched. Tried at these values only."""
Neighbors = Callable[[list[FrameFeatures], list[int]], list[ViewPair]]
"""Finds, of some rows of views, the pairs with the next view that hold."""


def needs_keyframes(count: float, most: int) -> bool:
    """Whether a recording has so many frames that `most` of them, spread evenly, may be too far apart to overlap.

    In a shorter one `overlapping_views` can add every frame between them.
    """
    return count > most << HALVINGS


def choose_images(count: int, results: Rows[StepResult], most: int) -> list[int]:
    """The frames that may be mapped: all of a short recording, else by what they have in common.

    The keyframes of an online run overlap as they should; without any, frames are spread evenly. Where the run was lost
    or uncertain, frames follow each other twice as fast as these do.

    Args:
        count: the number of frames.
        results: of an online run.
        most: frames of a recording that is short, or that are spread evenly.
    """
    keyframes = sorted({result.index for result in results if result.is_keyframe})
    if count <= most or len(keyframes) < MIN_VIEWS:
        keyframes = list(range(0, count, -(-count // most)))
    gap = median(after - before for before, after in pairwise([*keyframes, count]))
    chosen, last = set(keyframes), -count
    for result in results:
        is_doubtful = result.state in (State.LOST, State.UNCERTAIN)
        if is_doubtful and gap / 2 <= result.index - last and result.index < count:
            chosen.add(result.index)
            last = result.index
    return sorted(chosen)


def overlapping_views(
    images: list[int], read: Callable[[list[int]], list[FrameFeatures]], match: Neighbors
) -> list[FrameFeatures]:
    """The views of every few of the images, and those between neighbors that have too few verified matches.

    Args:
        images: frames, ascending.
        read: returns the views of those of some frames that can be read.
        match: matches neighbors.
    """
    halvings = 0 if len(images) <= FEW_IMAGES else HALVINGS
    views, tried = read(sorted({*images[:: 2**halvings], *images[-1:]})), set[tuple[int, int]]()
    for _ in range(halvings + HALVINGS):
        gaps = [(before.index, after.index) for before, after in pairwise(views)]
        middles = {
            row: middle
            for row, gap in enumerate(gaps)
            if gap not in tried and (middle := _middle(images, *gap)) is not None
        }
        if not middles:
            break
        least = {row: ENOUGH_SHARED if middle in images else LEAST_SHARED for row, middle in middles.items()}
        overlap = _overlap(views, least, match)
        more = [middle for row, middle in middles.items() if row not in overlap]
        found = read(more)
        views = sorted(views + found, key=lambda view: view.index)
        # In place of an image that cannot be read, the next ones are tried.
        unread = set(images) & (set(more) - {view.index for view in found})
        images = [image for image in images if image not in unread]
        tried |= {gaps[row] for row, middle in middles.items() if middle not in unread}
    return views


def _middle(images: list[int], before: int, after: int) -> int | None:
    """The middle one of the images between two frames, else the frame in the middle, if there is one."""
    between = images[bisect_right(images, before) : bisect_left(images, after)]
    if between:
        return between[len(between) // 2]
    return (before + after) // 2 if after - before > 1 else None


def _overlap(views: list[FrameFeatures], least: dict[int, int], match: Neighbors) -> set[int]:
    """The rows of views that have at least so many verified matches with the next one; none where hardly any of a
    sample of them do."""
    rows = sorted(least)
    sample = rows[:: max(1, len(rows) // SAMPLE)]

    def among(some: list[int]) -> set[int]:
        return {pair.first for pair in match(views, some) if len(pair) >= least[pair.first]}

    found = among(sample)
    if len(found) < LEAST_OVERLAP * len(sample):
        return set()
    return found | among(sorted(set(rows) - set(sample)))
