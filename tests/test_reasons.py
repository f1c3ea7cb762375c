"""Reasons are values, and files keep them as text."""

from __future__ import annotations

from string import Formatter

import pytest

from torchslam.types import Explanation, Reason, State, StepResult

WORDS = {"model": "homography", "text": "no image; nothing to see"}


def example(reason: Reason, number: float = 0.25) -> Explanation:
    """With a value for each field."""
    values: dict[str, float | str | Explanation] = {}
    for _, name, form, _ in Formatter().parse(reason.value):
        if name == "rejection":
            values[name] = example(Reason.FEW_MATCHES)
        elif name:
            values[name] = WORDS.get(name, number if form else 12)
    return Explanation(reason, values)


@pytest.mark.parametrize("number", [0.25, 17.0, float("nan")])
@pytest.mark.parametrize("reason", [each for each in Reason if each is not Reason.OTHER])
def test_the_text_of_every_reason_gives_it_back(reason: Reason, number: float) -> None:
    """Alone, and between others."""
    wanted = example(reason, number)
    (found,) = Explanation.parsed(str(wanted))
    assert (found.reason, str(found)) == (reason, str(wanted))
    for name, value in wanted.values.items():
        if isinstance(value, Explanation):
            assert found.values[name].reason is value.reason
        else:
            assert type(found.values[name]) in (type(value), int)
    if "rejection" in reason.value:
        return
    three = (example(Reason.MOVED), wanted, Explanation(Reason.STATIC_OVERLAY))
    again = Explanation.parsed("; ".join(map(str, three)))
    assert [each.reason for each in again] == [each.reason for each in three]


@pytest.mark.parametrize(
    "text", ["", "; ", "x; ", "moved by far of the scene depth", "turned by 1e400 degrees", "a\nb", "took a"]
)
def test_other_texts_stay_as_they_are(text: str) -> None:
    found = Explanation.parsed(text)
    assert all(each.reason is Reason.OTHER for each in found)
    assert "; ".join(map(str, found)).removesuffix("; ") == text.removesuffix("; ")


def test_a_result_has_the_values_and_their_text() -> None:
    turned = Explanation.of(Reason.TURNED, degrees=12.34)
    result = StepResult(0, 0.0, State.TRACKING, None, reasons=(turned, Explanation(Reason.STATIC_OVERLAY)))
    assert result.reasons[0].values["degrees"] == 12.34
    assert result.reason == ("turned by 12.3 degrees; static overlay masked out")
    assert StepResult(0, 0.0, State.LOST, None).reason == ""
