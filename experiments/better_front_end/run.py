"""Do learned features, matched plainly through the hook, make better runs? See README.md."""

from __future__ import annotations

from pathlib import Path

from experiments.common import add_weights, parser_of, publish, weights_of
from experiments.recordings import DEFAULT, KEPT_ORB, add_choices, outcomes_of, report

FRONT_ENDS = {"xfeat": "XFeat", "aliked": "ALIKED"}
MATCHERS = {"": (), ", mutual": ("matching.matcher=experiments.better_front_end.parts:Mutual",)}
ARMS = (DEFAULT, *(name + words for name in FRONT_ENDS for words in MATCHERS))


def arms(folder: Path) -> dict[str, tuple[str, ...]]:
    """The settings of each arm; arms whose weights are not in the folder are skipped with a message."""
    found: dict[str, tuple[str, ...]] = {DEFAULT: KEPT_ORB}
    for name, part in FRONT_ENDS.items():
        weights = weights_of(name, folder)
        if weights is None:
            continue
        front_end = (f"features.kind=experiments.cached_features:{part}", f'features.weights="{weights}"')
        found |= {name + words: front_end + matcher for words, matcher in MATCHERS.items()}
    return found


def main() -> None:
    parser = parser_of(__doc__)
    add_choices(parser, ARMS)
    add_weights(parser)
    arguments = parser.parse_args()
    settings = arms(arguments.weights)
    arguments.arms = [arm for arm in arguments.arms if arm in settings]
    text = report(outcomes_of(arguments, lambda label, arm, seed: settings[arm]), arguments.arms)
    publish(text, arguments, __file__)


if __name__ == "__main__":
    main()
