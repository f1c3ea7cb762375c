"""The check of shapes: of functions and of functions within them, in the first calls of every test."""

from __future__ import annotations

from collections.abc import Callable

import jaxtyping
import pytest
import torch
from jaxtyping import Float, jaxtyped
from torch import Tensor

from tests import shapes


@jaxtyped(typechecker=shapes.check)
def halved(x: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    return x[:, 0] / 2 if len(x) < 5 else x / 2


@jaxtyped(typechecker=shapes.check)
def counted(number: int) -> int:
    return number


def nested() -> Callable[[Tensor], Tensor]:
    @jaxtyped(typechecker=shapes.check)
    def inner(x: Float[Tensor, " N"]) -> Tensor:
        return x

    return inner


INNER = nested()


@pytest.mark.parametrize("again", [False, True])
def test_the_first_calls_in_every_test_are_checked(again: bool) -> None:
    for function in (INNER, halved):
        with pytest.raises(jaxtyping.TypeCheckError):
            function(torch.ones(2, 2))
    with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
        halved(torch.ones(5, 3))
    for _ in range(shapes.CHECKS):
        halved(torch.ones(2, 3))
        INNER(torch.ones(2))
    assert halved(torch.ones(5, 3)).shape == (5, 3)  # no longer
    assert INNER(torch.ones(2, 2)).shape == (2, 2)
    assert nested()(torch.ones(2, 2)).shape == (2, 2)  # nor where it is made again
    assert counted(3) == counted(4) - 1
