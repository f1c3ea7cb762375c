"""Figures in docs/gradients.md and docs/coming_from.md are those of the last run of their experiments."""

from __future__ import annotations

from experiments.benchmarks import bundle
from experiments.gradients import training
from experiments.gradients.compiled import GRADIENTS, HERE


def test_the_times_of_compiled_functions_are_those_of_the_experiment() -> None:
    _, _, measured = (HERE / "compiled.md").read_text().partition("| what |")
    _, _, shown = GRADIENTS.read_text().partition("<!-- table -->\n| what |")
    assert shown.partition("<!-- end -->")[0] == measured


def test_the_times_of_training_are_those_of_the_experiment() -> None:
    _, _, measured = (HERE / "training.md").read_text().partition("| what is learned |")
    _, _, shown = GRADIENTS.read_text().partition(f"{training.START}| what is learned |")
    assert shown.partition(training.END)[0] == measured


def test_the_figures_of_bundle_adjustments_are_those_of_the_benchmark() -> None:
    page = bundle.COMING_FROM.read_text()
    found = bundle.cells((bundle.HERE / "bundle.md").read_text())
    assert len(found) == page.count("<!-- end -->") == 3
    for mark, text in found.items():
        assert f"{mark}{text}<!-- end -->" in page
