"""Training of the network of dense depth on rooms of exact depth."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.nn.functional import avg_pool2d, pixel_shuffle, pixel_unshuffle

from examples.train_depth import Example, crop, example, loss_of, of_room, train
from experiments.dense.rooms import Sample, samples
from tests.dense.slanted_plane import FAR, NEAR, scene
from torchslam.dense.cost_volume import matching_cost
from torchslam.dense.estimate import estimate_depth
from torchslam.dense.learned import RatingNet

SEED = 3


@pytest.fixture(scope="module")
def room() -> list[Example]:
    return of_room(SEED, 2)


@pytest.fixture(scope="module")
def sample() -> Sample:
    return next(samples(SEED, 1))


def test_rendered_rooms_have_exact_depth(sample: Sample) -> None:
    assert sample.sources.shape[1:] == sample.reference.shape == sample.depth.shape
    inverse = 1 / sample.depth
    hypotheses = torch.stack((inverse, 1.1 * inverse, inverse / 1.1))
    right, *wrong = matching_cost(
        sample.reference, sample.sources, sample.camera, sample.T_sr, hypotheses, 3, 3
    )
    is_textured = right < 0.5
    assert is_textured.double().mean() > 0.1
    assert all(float(each[is_textured].mean()) > 1.5 * float(right[is_textured].mean()) for each in wrong)


def test_rooms_are_the_same_again(sample: Sample) -> None:
    again = next(samples(SEED, 1))
    assert torch.equal(sample.sources, again.sources)
    assert torch.equal(sample.T_sr, again.T_sr)


def test_a_crop_is_a_part_mirrored_or_not(room: list[Example]) -> None:
    height, width = room[0].is_right.shape
    column, row = (
        torch.arange(width).expand(height, -1).float(),
        torch.arange(height)[:, None].expand(-1, width).float(),
    )
    inputs = room[0].inputs.float()
    inputs[0] = avg_pool2d(column[None], 2)[0]
    inputs[7:15] = pixel_unshuffle(torch.stack((column, row)), 2)
    # Marks of columns and rows that are not the same from the other side.
    view = Example(inputs, column % 3 == 0, row % 3 == 0)
    generator = torch.Generator().manual_seed(0)
    found = set()
    for _ in range(20):
        part = crop(view, generator, (40, 50))
        assert part.inputs.shape[-2:] == (40, 50)
        columns, rows = pixel_shuffle(part.inputs[7:15], 2)
        assert torch.equal(part.is_right, columns % 3 == 0)
        assert torch.equal(part.is_rated, rows % 3 == 0)
        assert torch.equal(avg_pool2d(columns[None], 2)[0], part.inputs[0])
        steps = columns.diff(dim=1).unique().tolist(), rows.diff(dim=0).unique().tolist()
        assert all(each in ([-1], [1]) for each in steps)
        found.add((steps[0][0], steps[1][0]))
    assert len(found) == 4


def test_a_small_view_is_padded_with_what_does_not_count(room: list[Example]) -> None:
    part = crop(room[0], torch.Generator().manual_seed(0), (200, 200))
    assert part.inputs.shape[-2:] == (200, 200)
    assert int(part.is_rated.sum()) == int(room[0].is_rated.sum())
    assert int(part.is_right.sum()) == int(room[0].is_right.sum())


def test_depth_is_right_within_5_percent_and_wrong_where_nothing_confirms_it() -> None:
    reference, sources, camera, T_sr, depth = scene(48, 40)
    limits = torch.tensor([NEAR]), torch.tensor([FAR])
    found = estimate_depth(reference[None], sources[None], camera, T_sr[None], *limits)
    found = found._replace(inverse_depth=(1 / depth)[None].float())
    target = 1 / depth.float() * torch.where(torch.arange(48) < 24, 1.04, 1.06)
    target[:9] = 0
    view = example(found, reference[None], *limits, target, torch.ones_like(target, dtype=torch.bool))
    assert not view.is_right[:9].any()
    assert view.is_right[9:, :24].all()
    assert not view.is_right[9:, 24:].any()


def test_the_loss_falls_and_training_gives_the_same_bytes_again(room: list[Example], tmp_path: Path) -> None:
    net, again = (train([room], 12, tmp_path / f"{name}.pt") for name in ("first", "again"))
    for name, weight in net.state_dict().items():
        assert torch.equal(weight, again.state_dict()[name]), name
    views = [each._replace(inputs=each.inputs.float()) for each in room]
    batch = Example(*(torch.stack(each) for each in zip(*views, strict=True)))
    with torch.no_grad():
        before, after = (loss_of(each, batch) for each in (RatingNet(), net))
    assert float(after) < float(before)
