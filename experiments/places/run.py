"""Which score finds earlier keyframes of the same place, and what does it cost? See README.md."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from experiments.benchmarks.problems import match_pixels
from experiments.common import table, timed, write_between
from experiments.places import alternatives
from experiments.places.images import MEASURED, Collection, collect, lookalike_truth, sequence_truth
from experiments.places.train import DESCRIPTORS, k_majority, rendered_descriptors, sample
from torchslam.geometry import Camera, estimate_relative_pose
from torchslam.loop_closing import KeyframeDatabase
from torchslam.loop_closing.keyframe_database import default_vocabulary
from torchslam.types import Features

HEADER = ["", "lookalike: AP, recall at precision 1, recall@1"]
HEADER += [f"{name}: AP, recall@1, @5" for name in MEASURED]
SIZES = (500, 1000, 3000)
QUERIES = 30
COUNTS = (10, 12, 15, 20, 25, 30, 40, 60)
BEST = 3
SIZE = (512, 384)
FOCAL = 0.9 * SIZE[0]  # the camera is unknown: a guess
THRESHOLD = 2.0  # pixels, wide for a guessed camera
MIN_MATCHES = 10  # fewer are not verified by RANSAC
MAX_SAMPLES = 1000
WALK = 40  # images of one walk of lookalikes
LEAST_EXPECTED = 0.02  # the median score with the previous image is 0.05 to 0.16, by sequence


def main() -> None:
    torch.set_num_threads(1)
    collection = collect()
    features = collection.features
    rows = []
    for name, way in ways(features):
        rows.append([name, *quality(way(), collection)])
        print(*rows[-1], sep="\t", flush=True)
    scores = alternatives.places(features, 400)
    relative = relative_to_previous(scores, collection)
    rows.append(["taken, relative to the previous image", *quality(relative, collection)])
    cut = len(collection.ranges["lookalike"])
    check = checks(features[:cut], scores[:cut, :cut])
    text = "\n".join([table(HEADER, rows), costs(features), check])
    print(text)
    write_between(Path(__file__).parent / "README.md", text)


def relative_to_previous(scores: Tensor, collection: Collection) -> Tensor:
    """Each row of scores (N, N) as a share of the score with the image before it; zero for first images."""
    relative = torch.zeros_like(scores)
    keys = torch.arange(len(scores))
    for where in collection.ranges.values():
        for row in where[1:]:
            relative[row] = relative_scores(keys, scores[row], keys[row - 1 : row])
    return relative


def relative_scores(keys: Tensor, scores: Tensor, reference: Tensor) -> Tensor:
    """Scores (n,) of keyframes as a share of the best score among the reference keyframes (r,).

    The reference are keyframes that show the same place for certain, such as the previous one: their score says what
    to expect here, where an image is dark or its texture repeats (Galvez-Lopez and Tardos: DBoW2, 2012). Zero for all
    where no reference has a score of 0.02, since a share of next to nothing says nothing.
    """
    expected = torch.where(torch.isin(keys, reference), scores, 0.0).amax() if len(keys) > 0 else scores.sum()
    return torch.where(expected >= LEAST_EXPECTED, scores / expected.clamp(min=LEAST_EXPECTED), 0.0)


def ways(features: Features) -> list[tuple[str, Callable[[], Tensor]]]:
    """The candidates, by name."""
    rendered = sample(rendered_descriptors(), DESCRIPTORS)
    words = default_vocabulary(rendered.device)
    # The words of a single image of redkitchen.
    one = alternatives.first_words(features, len(lookalike_truth()[0]))
    return [
        ("1024 words, tf-idf", lambda: alternatives.bag_of_words(features, words)),
        ("4096 words, tf-idf", lambda: alternatives.bag_of_words(features, k_majority(rendered, 4096, 8))),
        ("32 hash tables of 14 bits", lambda: alternatives.hash_tables(features, 14, 32)),
        ("150 strongest matched", lambda: alternatives.direct(features, 150, 0.85, 64)),
        ("taken: 1024 words and codes, 400 strongest", lambda: alternatives.places(features, 400)),
        ("the same, 200 strongest", lambda: alternatives.places(features, 200)),
        (
            "the same, words of these very images",
            lambda: alternatives.places(features, 400, alternatives.own_words(features, 1024)),
        ),
        ("the same, words of one image", lambda: alternatives.places(features, 400, one)),
    ]


def quality(scores: Tensor, collection: Collection) -> list[str]:
    """The cells of a row, from scores (N, N) of all images with all."""
    same, is_pair = lookalike_truth()
    part = scores[: len(same), : len(same)]
    precision, recall = average_precision(part[is_pair], same[is_pair])
    hit = recall_at(part.masked_fill(~is_pair, -1.0), same, 1)
    cells = [f"{precision:.2f}, {recall:.2f}, {hit:.2f}"]
    for name in MEASURED:
        where = collection.ranges[name]
        rows = scores[where.start : where.stop].clone()
        near, far, neighbors = sequence_truth(collection.T_cw[name])
        true, counted = torch.zeros_like(rows, dtype=torch.bool), torch.ones_like(rows, dtype=torch.bool)
        true[:, where.start : where.stop] = near
        counted[:, where.start : where.stop] = near | far  # every image of another sequence is another place
        rows[:, where.start : where.stop][neighbors] = -1.0
        precision, _ = average_precision(rows[counted], true[counted])
        cells.append(f"{precision:.2f}, {recall_at(rows, true, 1):.2f}, {recall_at(rows, true, 5):.2f}")
    return cells


def average_precision(scores: Tensor, true: Tensor) -> tuple[float, float]:
    """Average precision of pairs (P,) in order of their scores, and the recall before the first false pair."""
    ordered = true[torch.sort(scores, descending=True, stable=True).indices].double()
    precision = ordered.cumsum(0) / torch.arange(1, len(ordered) + 1)
    before = ordered.cumprod(0).sum()
    return float((precision * ordered).sum() / ordered.sum()), float(before / ordered.sum())


def recall_at(scores: Tensor, true: Tensor, count: int) -> float:
    """How many of the images (rows) that have a true pair find one among their `count` best."""
    rows = true.any(1)
    best = scores[rows].topk(count, dim=1).indices
    return float(true[rows].gather(1, best).any(1).double().mean())


def costs(features: Features) -> str:
    """A table of processor time of the way that was taken, by the number of keyframes: images over and over, noisy."""
    generator, memory, rows = torch.Generator().manual_seed(0), KeyframeDatabase(), []
    adding = []
    for key in range(max(SIZES)):
        image = key % len(features.mask)
        shape = features.descriptors[image].shape
        noise = (1 << torch.randint(0, 8, shape, generator=generator)).to(torch.uint8)
        noise = noise * (torch.rand(shape, generator=generator) < 0.3)
        descriptors, mask = features.descriptors[image] ^ noise, features.mask[image]
        adding.append(timed(lambda k=key, d=descriptors, m=mask: memory.add(k, d, m))[1])  # type: ignore[misc]
        if len(memory) in SIZES:
            queries = [features[image : image + 1] for image in range(1, 10 * QUERIES, 10)]
            query_ms = [timed(lambda q=q: memory.query(q.descriptors[0], q.mask[0]))[1] for q in queries]  # type: ignore[misc]
            megabytes = sum(x.element_size() * x.nelement() for x in (memory._codes, memory._used)) / 1e6
            cells = (sorted(adding)[len(adding) // 2], min(query_ms), sorted(query_ms)[QUERIES // 2])
            rows.append([str(len(memory)), *(f"{cell:.1f}" for cell in cells), f"{megabytes:.0f}"])
    return table(["keyframes", "add (ms)", "query, quickest (ms)", "query, median (ms)", "memory (MB)"], rows)


def inliers_of_pairs(features: Features) -> Tensor:
    """(84, 84) int64: inliers of the relative pose of each evaluated pair, 0 without a pose."""
    _, is_pair = lookalike_truth()
    inliers = torch.zeros(is_pair.shape, dtype=torch.int64)
    center = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    params = torch.tensor((FOCAL, FOCAL, *center), dtype=torch.float64)
    camera = Camera("pinhole", params, SIZE)
    for later, earlier in is_pair.nonzero().tolist():
        first, second = features[later : later + 1], features[earlier : earlier + 1]
        pixels_1, pixels_2 = match_pixels(first, second)
        if len(pixels_1) < MIN_MATCHES:
            continue
        pose = estimate_relative_pose(
            pixels_1[None],
            pixels_2[None],
            camera_1=camera,
            camera_2=camera,
            threshold=THRESHOLD,
            max_samples=MAX_SAMPLES,
        )
        inliers[later, earlier] = int(pose.inliers.sum())
    return inliers


def checks(features: Features, scores: Tensor) -> str:
    """A table of lookalike pairs by the number of inliers of their relative pose."""
    inliers = inliers_of_pairs(features)
    same, is_pair = lookalike_truth()
    candidates = scores.masked_fill(~is_pair, -1.0).topk(BEST, dim=1).indices
    best = is_pair & torch.zeros_like(is_pair).scatter(1, candidates, True)
    # Each walk has 40 images. Pairs beyond those marked by two images more may still see the same stretch.
    number = torch.arange(len(same))
    away = ((number[:, None] - number + WALK // 2) % WALK - WALK // 2).abs()
    elsewhere = away > 4
    parts = (is_pair & same, is_pair & ~same, is_pair & ~same & elsewhere, best & same, best & ~same)
    rows = [["all", *(str(int(part.sum())) for part in parts)]]
    for count in COUNTS:
        cells = (str(int((part & (inliers >= count)).sum())) for part in parts)
        rows.append([f"{count} inliers", *cells])
    header = "at least | true | false | false, further away | true, of the 3 best | false, of the 3 best"
    return table(header, rows)


if __name__ == "__main__":
    main()
