"""Tables of the documentation of gradients are those of the last run of their experiments."""

from __future__ import annotations

from experiments.gradients.compiled import GRADIENTS, HERE


def test_the_times_of_compiled_functions_are_those_of_the_experiment() -> None:
    _, _, measured = (HERE / "compiled.md").read_text().partition("| what |")
    _, _, shown = GRADIENTS.read_text().partition("<!-- table -->\n| what |")
    assert shown.partition("<!-- end -->")[0] == measured
