from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchslam.features.matching import hamming as bits
from torchslam.features.matching.hamming import hamming, hamming_between, pack_bits, unpack_bits


def random_descriptors(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def test_pack_puts_the_first_bit_lowest() -> None:
    first = torch.zeros(16, dtype=torch.bool)
    first[[0, 9]] = True
    assert pack_bits(first).tolist() == [1, 2]


@given(st.integers(1, 5), st.integers(0, 4), st.integers(0, 2**31))
def test_unpack_inverts_pack(rows: int, size: int, seed: int) -> None:
    descriptors = random_descriptors(rows, 8 * size, seed=seed)
    unpacked = unpack_bits(descriptors)
    assert torch.equal(pack_bits(unpacked), descriptors)
    assert np.array_equal(unpacked.numpy(), np.unpackbits(descriptors.numpy(), axis=-1, bitorder="little"))


@pytest.mark.usefixtures("without_shape_checks")
def test_pack_refuses_a_part_of_a_byte() -> None:
    with pytest.raises(ValueError, match="multiple of 8"):
        pack_bits(torch.zeros(7, dtype=torch.bool))


@pytest.mark.parametrize("fast", [True, False])
def test_hamming_equals_counting_bits(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if fast and not bits._fast_int8(torch.device("cpu")):
        pytest.skip("this processor has no fast int8 products")
    monkeypatch.setattr(bits, "_fast_int8", lambda device: fast)
    first, second = random_descriptors(2, 33, 32), random_descriptors(2, 47, 32, seed=1)
    second[0, :5] = first[0, :5]
    second[1, 0] = ~first[1, 0]
    differing = first.numpy()[:, :, None] ^ second.numpy()[:, None]
    expected = np.unpackbits(differing, axis=-1).sum(-1)
    distances = hamming(first, second)
    assert distances.dtype == torch.int32
    assert np.array_equal(distances.numpy(), expected)
    assert torch.equal(hamming(first[0], second[0]), distances[0])


@pytest.mark.parametrize("by_numpy", [True, False])
@pytest.mark.parametrize("size", [8, 32, 64, 248])
def test_hamming_between_rows(size: int, by_numpy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if by_numpy and not hasattr(np, "bitwise_count"):
        pytest.skip("numpy 1 counts no bits")
    if not by_numpy:
        monkeypatch.delattr(np, "bitwise_count", raising=False)
    first, second = random_descriptors(20, size), random_descriptors(30, size, seed=1)
    first[0], second[0] = 0, 255
    first[1], second[1] = 255, 255
    rows = torch.cat([torch.tensor([0, 0, 1, 1]), torch.arange(20)])
    columns = torch.cat([torch.tensor([0, 1, 0, 1]), torch.arange(20) + 10])
    distances = hamming_between(first, rows, second, columns)
    assert distances.dtype == torch.int64
    assert distances[:4].tolist() == [8 * size, 8 * size, 0, 0]
    assert torch.equal(distances, hamming(first, second)[rows, columns].long())


def test_hamming_distances_of_empty_sets() -> None:
    assert hamming(random_descriptors(0, 32), random_descriptors(4, 32)).shape == (0, 4)
