"""Nearest float descriptors, chosen by descriptors that are rounded to bytes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchslam.features.matching import hamming


def many_units(rows: int, seed: int, dims: int = 128) -> Tensor:
    """Unit vectors without negative numbers, as SIFT has them."""
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.rand(1, rows, dims, generator=generator) ** 3, dim=-1)


@pytest.mark.parametrize("signed", [False, True])
def test_columns_chosen_by_bytes_are_the_nearest(monkeypatch: pytest.MonkeyPatch, signed: bool) -> None:
    """Whatever passes a ratio test passes it with both, at exact distances, also with masks and forbidden pairs."""
    if not hamming._fast_int8(torch.device("cpu")) or hamming.int8_matmul is None:
        pytest.skip("bytes are not used on this processor")
    rows, columns, same = 700, 600, 400
    one, other = many_units(rows, 0), many_units(columns, 1)
    if signed:
        one, other = (torch.nn.functional.normalize(x - x.mean(), dim=-1) for x in (one, other))
    noise = 0.1 * many_units(same, 2)
    other[:, :same] = torch.nn.functional.normalize(one[:, :same] + noise, dim=-1)
    masks = torch.ones(1, rows, dtype=torch.bool), torch.ones(1, columns, dtype=torch.bool)
    masks[0][0, 5:9], masks[1][0, 17:20], masks[1][0, 590:] = False, False, False
    allowed = torch.ones(1, rows, columns, dtype=torch.bool)
    allowed[0, 30] = False  # nothing may match it
    allowed[0, 31] = False
    allowed[0, 31, 50] = True  # nothing else
    for given in (None, allowed):
        exact = hamming.nearest_by_cosine(one, other, *masks, given, with_second=True)
        with monkeypatch.context() as patch:
            patch.setattr(hamming, "_BYTES_FROM", 1)
            found = hamming.nearest_by_cosine(one, other, *masks, given, with_second=True)
            unasked = hamming.nearest_by_cosine(one, other, *masks, given, with_second=False)
        assert unasked.second is None
        assert found.second is not None
        assert exact.second is not None
        assert torch.equal(found.found, exact.found)
        sure = exact.distance < 0.8 * exact.second
        assert int(sure.sum()) > 0.9 * same
        assert torch.equal(found.column[sure], exact.column[sure])
        assert torch.equal(found.mutual[sure], exact.mutual[sure])
        for ours, true in ((found.distance, exact.distance), (found.second, exact.second)):
            used = exact.found & true.isfinite()
            assert torch.equal(ours[exact.found].isfinite(), true[exact.found].isfinite())
            assert float((ours - true)[used].abs().max()) < 0.006
        torch.testing.assert_close(found.distance[sure], exact.distance[sure])


def test_bytes_are_not_used_where_gradients_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hamming, "_BYTES_FROM", 1)
    one, other = many_units(20, 0).requires_grad_(), many_units(30, 1)
    masks = torch.ones(1, 20, dtype=torch.bool), torch.ones(1, 30, dtype=torch.bool)
    nearest = hamming.nearest_by_cosine(one, other, *masks, None, with_second=True)
    assert nearest.distance.requires_grad
