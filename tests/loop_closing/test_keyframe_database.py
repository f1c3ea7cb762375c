"""Places: known scores, changes, storage, and the true place among rendered distractors."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchslam.data import open_sequence
from torchslam.features import ORB, hamming, pack_bits, unpack_bits
from torchslam.loop_closing import KeyframeDatabase
from torchslam.loop_closing.keyframe_database import binarize, code_similarity, default_vocabulary, quantize


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def image(seed: int, count: int = 60) -> tuple[Tensor, Tensor]:
    """Descriptors of an image of its own, and their mask."""
    return noise(count, 32, seed=seed), torch.ones(count, dtype=torch.bool)


def blurred(descriptors: Tensor, share: float, seed: int = 0) -> Tensor:
    """The descriptors with that share of their bits turned."""
    turned = torch.rand(*descriptors.shape[:-1], 256, generator=torch.Generator().manual_seed(seed)) < share
    return descriptors ^ pack_bits(turned)


def places_of(*keys: int) -> KeyframeDatabase:
    database = KeyframeDatabase()
    for key in keys:
        database.add(key, *image(key))
    return database


def answer_alike(left: KeyframeDatabase, right: KeyframeDatabase) -> bool:
    """Whether both know the same keyframes by the same words and codes."""
    answers = [[database.query(*image(key)) for key in range(5)] for database in (left, right)]
    return all(
        torch.equal(one[0], two[0]) and torch.equal(one[1], two[1]) for one, two in zip(*answers, strict=True)
    )


# --- words and codes -----------------------------------------------------------------------------------------


def test_the_bundled_visual_words_are_distinct() -> None:
    words = default_vocabulary(torch.device("cpu"))
    assert words.shape == (1024, 32)
    assert words.dtype == torch.uint8
    assert len(torch.unique(words, dim=0)) > 1000


def test_descriptors_choose_the_nearest_word_and_the_lower_of_equals() -> None:
    words = noise(40, 32)
    words[7] = words[3]
    used, _ = quantize(torch.stack([words[7], words[30], words[12]]), words)
    assert used.tolist() == [3, 12, 30]
    descriptors = noise(200, 32, seed=1)
    used, _ = quantize(descriptors, words)
    assert used.tolist() == sorted(set(hamming(descriptors, words).argmin(1).tolist()))


def test_codes_are_the_majority_bits_of_a_word() -> None:
    words = noise(2, 32)
    three = torch.stack([blurred(words[1], 0.2, seed) for seed in range(3)])
    used, codes = quantize(three, words)
    majority = pack_bits(unpack_bits(three).sum(0) >= 2)
    assert used.tolist() == [1]
    assert torch.equal(quantize(majority[None], words)[1], codes)
    assert not torch.equal(quantize(three[:1], words)[1], codes)


@pytest.mark.parametrize("distance", [0, 1, 9, 19, 20, 64])
def test_similarity_falls_with_distance_and_ends_at_zero(distance: int) -> None:
    code = torch.tensor([0x0123456789ABCDEF])
    bits = sum(1 << (3 * bit % 64) for bit in range(distance))  # 3 and 64 have no divisor in common
    other = code ^ torch.tensor([bits - (1 << 64) if bits >= 1 << 63 else bits])
    expected = math.exp(-((distance / 9) ** 2)) if distance <= 19 else 0.0
    assert float(code_similarity(code, other)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.usefixtures("without_shape_checks")
def test_binarized_floats_keep_their_angles(generator: torch.Generator) -> None:
    floats = torch.nn.functional.normalize(torch.randn(30, 64, generator=generator), dim=1)
    bits = binarize(floats)
    angles = torch.acos((floats @ floats.T).clamp(-1, 1))
    error = hamming(bits, bits) / 256 - angles / math.pi
    assert bits.shape == (30, 32)
    assert float(error.abs().max()) < 0.15
    assert torch.equal(binarize(bits), bits)
    with pytest.raises(ValueError, match="256 bits"):
        binarize(noise(3, 16))


# --- scores --------------------------------------------------------------------------------------------------


def test_scores_have_known_values() -> None:
    # One word each: rare ones, of one image in two, weigh log(3)^2, the common one log(3 / 2)^2.
    words = noise(3, 32)
    database = KeyframeDatabase(words)
    database.add(4, words[[0, 1]], torch.ones(2, dtype=torch.bool))
    database.add(2, words[[0, 2]], torch.ones(2, dtype=torch.bool))
    keys, scores = database.query(words[[0, 1]], torch.ones(2, dtype=torch.bool))
    rare, common = math.log(3) ** 2, math.log(3 / 2) ** 2
    assert keys.tolist() == [4, 2]
    assert scores.tolist() == pytest.approx([1.0, common / (rare + common)], rel=1e-5)


def test_masked_keypoints_are_ignored() -> None:
    descriptors, mask = image(1)
    mask[20:] = False
    first, second = KeyframeDatabase(), KeyframeDatabase()
    first.add(0, descriptors, mask)
    second.add(0, descriptors[:20], mask[:20])
    descriptors[20:] = 0
    assert answer_alike(first, second)
    assert float(first.query(descriptors, mask)[1]) == pytest.approx(1.0)


def test_only_the_strongest_keypoints_count() -> None:
    descriptors, mask = image(0, 700)
    first, second = KeyframeDatabase(), KeyframeDatabase()
    first.add(0, descriptors, mask)
    second.add(0, descriptors[:400], mask[:400])
    assert answer_alike(first, second)
    third = KeyframeDatabase()
    third.add(0, descriptors[:399], mask[:399])
    assert not answer_alike(first, third)


def test_capacity_grows_and_ties_are_ordered_by_key() -> None:
    database = KeyframeDatabase()
    for key in reversed(range(200)):
        database.add(key, *image(key % 100))
    keys, scores = database.query(*image(42))
    assert keys[:2].tolist() == [42, 142]
    assert scores[:2].tolist() == pytest.approx([1.0, 1.0])
    assert sorted(keys.tolist()) == list(range(200))
    assert bool((scores.diff() <= 0).all())


def test_empty_queries_and_empty_keyframes() -> None:
    nothing = torch.zeros(0, 32, dtype=torch.uint8), torch.zeros(0, dtype=torch.bool)
    keys, scores = KeyframeDatabase().query(*image(0))
    assert len(keys) == len(scores) == 0
    database = places_of(1)
    database.add(2, *nothing)
    assert database.query(*image(1))[0].tolist() == [1, 2]
    assert database.query(*image(1))[1].tolist() == pytest.approx([1.0, 0.0])
    assert database.query(*nothing)[1].tolist() == [0.0, 0.0]


# --- changes -------------------------------------------------------------------------------------------------


def test_removed_keyframes_leave_no_trace_and_free_their_slot() -> None:
    database = places_of(0, 1, 2, 3)
    database.remove(torch.tensor([1, 2]))
    assert answer_alike(database, places_of(0, 3))
    database.add(2, *image(2))
    assert answer_alike(database, places_of(0, 2, 3))
    assert (len(database), 1 in database, 2 in database) == (3, False, True)
    with pytest.raises(KeyError):
        database.remove([0, 8])
    assert len(database) == 3


@pytest.mark.parametrize("key", [-1, 0])
def test_a_duplicate_key_is_an_error(key: int) -> None:
    with pytest.raises(ValueError, match="key"):
        places_of(0).add(key, *image(1))


# --- other feature extractors and devices ----------------------------------------------------------------------------


def test_float_descriptors_fix_their_words_once(generator: torch.Generator) -> None:
    floats = torch.nn.functional.normalize(torch.randn(6, 100, 64, generator=generator), dim=-1)
    mask = torch.ones(100, dtype=torch.bool)
    database = KeyframeDatabase()
    database.add(0, floats[0, :63], mask[:63])  # too few to name the words
    assert database.query(floats[0], mask)[1].tolist() == [0.0]
    for key in range(1, 6):
        database.add(key, floats[key], mask)
    assert torch.equal(database._words, binarize(floats[1]))
    close = torch.nn.functional.normalize(
        floats + 0.02 * torch.randn(6, 100, 64, generator=generator), dim=-1
    )
    for key in range(1, 6):
        keys, scores = database.query(close[key], mask)
        assert int(keys[0]) == key
        assert float(scores[0]) > 3 * float(scores[1])


def test_queries_run_on_any_device(device: torch.device) -> None:
    database, expected = KeyframeDatabase(), places_of(0, 1, 2)
    for key in range(3):
        descriptors, mask = image(key)
        database.add(key, descriptors.to(device), mask.to(device))
    database.remove([0])
    expected.remove([0])
    descriptors, mask = image(1)
    answers = database.query(descriptors.to(device), mask.to(device))
    assert all(answer.device.type == device.type for answer in answers)
    for answer, known in zip(answers, expected.query(descriptors, mask), strict=True):
        torch.testing.assert_close(answer.cpu(), known)


# --- places --------------------------------------------------------------------------------------------------


def test_the_true_place_scores_highest_in_a_rendered_sequence() -> None:
    # Frames 160 on pass the places of the first round again, on another sway.
    orb, database = ORB(500), KeyframeDatabase()
    sequence = open_sequence("synthetic:room?frames=320")
    for index in range(0, 160, 3):
        features = orb(sequence[index].image)
        database.add(index, features.descriptors[0], features.mask[0])
    for index in (160, 205, 250, 295):
        features = orb(sequence[index].image)
        keys, scores = database.query(features.descriptors[0], features.mask[0])
        away = ((keys - index + 80) % 160 - 80).abs()
        assert len(keys) == 54
        assert int(away[0]) <= 6
        assert float(scores[0]) > 2 * float(scores[away > 40].max())


@pytest.mark.parametrize("floats", [False, True])
def test_a_query_by_key_equals_a_query_by_image(floats: bool) -> None:
    database = KeyframeDatabase()
    for key in range(4):
        descriptors, mask = image(key % 3, count=100)
        if floats:
            descriptors = torch.nn.functional.normalize(descriptors.float() - 127, dim=-1)
        database.add(key, descriptors, mask)
        for one, other in zip(database.query_by_key(key), database.query(descriptors, mask), strict=True):
            assert torch.equal(one, other)
    with pytest.raises(KeyError):
        database.query_by_key(7)
