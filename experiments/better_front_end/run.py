"""Do learned features, matched plainly through the hook, make better runs? See README.md."""

from __future__ import annotations

from pathlib import Path

from experiments.common import DATA_DIR, parser_of, write_between
from experiments.recordings import DEFAULT, KEPT_ORB, add_choices, outcomes_of, report

FRONT_ENDS = {"xfeat": ("XFeat", "xfeat.safetensors"), "aliked": ("ALIKED", "aliked-t16.safetensors")}
MATCHERS = {"": (), ", mutual": ("matching.matcher=experiments.better_front_end.parts:Mutual",)}
ARMS = (DEFAULT, *(name + words for name in FRONT_ENDS for words in MATCHERS))


def arms(folder: Path) -> dict[str, tuple[str, ...]]:
    """The settings of each arm; arms whose weights are not in the folder are skipped with a message."""
    found: dict[str, tuple[str, ...]] = {DEFAULT: KEPT_ORB}
    for name, (part, file) in FRONT_ENDS.items():
        weights = (folder / file).absolute()
        if not weights.is_file():
            print(f"{name}: no {weights}, left out")
            continue
        front_end = (f"features.kind=experiments.cached_features:{part}", f'features.weights="{weights}"')
        found |= {name + words: front_end + matcher for words, matcher in MATCHERS.items()}
    return found


def main() -> None:
    parser = parser_of(__doc__)
    add_choices(parser, ARMS)
    parser.add_argument("--weights", type=Path, default=DATA_DIR.parent / "weights")
    arguments = parser.parse_args()
    settings = arms(arguments.weights)
    arguments.arms = [arm for arm in arguments.arms if arm in settings]
    text = report(outcomes_of(arguments, lambda label, arm, seed: settings[arm]), arguments.arms)
    print(text)
    if not arguments.no_readme:
        write_between(Path(__file__).parent / "README.md", text)


if __name__ == "__main__":
    main()
