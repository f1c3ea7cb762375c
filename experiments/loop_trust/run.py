"""Do learned weights of loops give better trajectories than robust costs do? See README.md."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import write_between
from experiments.loop_trust.baselines import Method, Odometry, Oracle, candidates, choose, nodes_of
from experiments.loop_trust.graphs import Graphs, ate
from experiments.loop_trust.real import real_graphs
from experiments.loop_trust.report import LEARNED, ORACLE, Errors, error_table, failure_table
from experiments.loop_trust.simulation import NOISES, Noise, simulate
from experiments.loop_trust.training import Settings, train, warm_up
from experiments.loop_trust.trust import Cues, Learned, LoopTrust, describe
from experiments.loop_trust.walks import TRAINING, UNSEEN, Walk

HERE = Path(__file__).parent
CACHE = HERE / "results"
NODES = 60
SEEDS = (0, 1, 2)
WARM = "learned to classify only"
_CHUNK = 50


@dataclass(frozen=True)
class Sizes:
    """Numbers of graphs. training: of each family; choosing: of each family, for settings of the competitors, with
    each kind of noise; tested: of each unseen family with 40 % false loops; beside: with other shares
    """

    training: int = 700
    choosing: int = 2
    tested: int = 12
    beside: int = 0


def training_graphs(sizes: Sizes) -> Graphs:
    """Graphs of the training families with up to 60 % false loops."""
    walks = enumerate(TRAINING.values())
    return Graphs.cat([simulate(walk, NODES, (0.0, 0.6), sizes.training, seed=100 + k) for k, walk in walks])


def cues_of(graphs: Graphs) -> Cues:
    parts = [describe(graphs[start : start + _CHUNK]) for start in range(0, len(graphs), _CHUNK)]
    return Cues(*(torch.cat([getattr(part, name) for part in parts]) for name in ("alone", "paired", "mask")))


def oracle_errors(graphs: Graphs) -> Tensor:
    """(G,) what the trajectory loss is measured in."""
    return ate(nodes_of(Oracle(), graphs), graphs.S_cw_true)


def trained(
    graphs: Graphs, cues: Cues, solved: Tensor, bounds: Tensor, settings: Settings, folder: Path | None
) -> tuple[LoopTrust, LoopTrust]:
    """A network after the training through the solver, and after the classification alone; kept in a folder.

    The former sees graphs `solved` (n,) only, of which the oracle's errors are known: bounds (n,).
    """
    network, warm = (LoopTrust(cues.alone.shape[-1], cues.paired.shape[-1], settings.seed) for _ in range(2))
    network.eval()
    warm.eval()
    name = f"network_{settings.seed}_{settings.warm_steps}_{settings.steps}.pt"
    path = folder / name if folder else None
    if path and path.exists():
        states = torch.load(path, weights_only=True)
        network.load_state_dict(states[0])
        warm.load_state_dict(states[1])
        return network, warm
    losses = warm_up(network, graphs, cues, settings)
    _say(f"seed {settings.seed}: classification", losses)
    warm.load_state_dict(network.state_dict())
    losses = train(network, graphs[solved], cues[solved], bounds, settings)
    _say(f"seed {settings.seed}: trajectories", losses)
    if path:
        torch.save((network.state_dict(), warm.state_dict()), path)
    return network, warm


def _say(label: str, losses: list[float]) -> None:
    tenth = max(1, len(losses) // 10)
    first, last = sum(losses[:tenth]) / tenth, sum(losses[-tenth:]) / tenth
    print(f"{label}: mean loss {first:.4f} in the first tenth, {last:.4f} in the last", flush=True)


def chosen_methods(sizes: Sizes) -> dict[str, Method]:
    """The competitors, each with the setting that is best on the training families at 40 % false loops."""
    graphs = Graphs.cat(
        [
            simulate(walk, NODES, (0.4, 0.4), sizes.choosing, seed=900 + k, noise=noise)
            for k, walk in enumerate(TRAINING.values())
            for noise in NOISES.values()
        ]
    )
    return {label: choose(options, graphs) for label, options in candidates().items()}


def errors_of(methods: dict[str, list[Method]], graphs: Graphs) -> Errors:
    """The ATE of all methods, of each all seeds."""
    return {
        label: torch.stack([ate(nodes_of(method, graphs), graphs.S_cw_true) for method in seeds])
        for label, seeds in methods.items()
    }


def cells_of(
    methods: dict[str, list[Method]],
    walks: dict[str, Walk],
    share: float,
    count: int,
    noises: dict[str, Noise],
) -> dict[str, Errors]:
    """Errors by family and kind of noise."""
    cells = {}
    for label, noise in noises.items():
        for number, (name, walk) in enumerate(walks.items()):
            graphs = simulate(walk, NODES, (share, share), count, seed=5000 + number, noise=noise)
            cells[f"{name}, {label}"] = errors_of(methods, graphs)
            print(f"{share:.0%} false, {name}, {label}: done", flush=True)
    return cells


def evaluate(
    networks: list[tuple[LoopTrust, LoopTrust]],
    chosen: dict[str, Method],
    sizes: Sizes,
    walks: dict[str, Walk],
) -> str:
    """The tables on families of graphs."""
    methods: dict[str, list[Method]] = {"odometry": [Odometry()]}
    methods |= {label: [method] for label, method in chosen.items()}
    methods |= {
        WARM: [Learned(warm, rounds=1) for _, warm in networks],
        LEARNED: [Learned(network) for network, _ in networks],
        ORACLE: [Oracle()],
    }
    main = cells_of(methods, walks, 0.4, sizes.tested, NOISES)
    lines = [
        f"40 % false loops, {sizes.tested} graphs a row, ATE in steps:\n",
        *(
            f"{error_table({name: cell for name, cell in main.items() if name.endswith(f', {kind}')})}"
            for kind in NOISES
        ),
        "Graphs, per cent, whose ATE is more than twice the oracle's:\n",
        failure_table(main),
    ]
    middle = "unknown noise"
    beside = {
        f"{share:.0%} false": _pooled(cells_of(methods, walks, share, sizes.beside, {middle: NOISES[middle]}))
        for share in (0.0, 0.2, 0.6)
        if sizes.beside
    }
    if beside:
        lines += [
            f"Other shares of false loops, all families, {middle}, {len(walks) * sizes.beside} graphs a row:\n"
        ]
        lines += [error_table(beside)]
    lines += ["Settings, each the best of its kind on the training families:\n"]
    lines += [f"- {label}: {method}" for label, method in chosen.items()]
    return "\n".join(lines) + "\n"


def _pooled(cells: dict[str, Errors]) -> Errors:
    every = list(cells.values())
    return {method: torch.cat([cell[method] for cell in every], -1) for method in every[0]}


def evaluate_real(
    networks: list[tuple[LoopTrust, LoopTrust]], chosen: dict[str, Method], runs: list[Path], count: int
) -> str:
    """The table of real runs, with 40 % false loops."""
    methods: dict[str, list[Method]] = {"odometry": [Odometry()]}
    methods |= {label: [method] for label, method in chosen.items()}
    methods |= {LEARNED: [Learned(network) for network, _ in networks], ORACLE: [Oracle()]}
    cells, without = {}, []
    for run in runs:
        graphs = real_graphs(run, 0.4, count)
        if graphs is None:
            without.append(run.name)
        else:
            kind = f"{run.name}, {graphs.S_cw_true.shape[1]} nodes, {int(graphs.genuine[0].sum())} loops"
            cells[kind] = errors_of(methods, graphs)
    lines = [f"Real runs, false loops added to 40 %, {count} draws of them a row:\n"]
    if cells:
        lines += [error_table(cells), failure_table(cells)]
    if without:
        lines += [f"Without a loop between keyframes that lie apart in time: {', '.join(without)}.\n"]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--validate", action="store_true", help="test on other graphs of the training families"
    )
    parser.add_argument("--quick", action="store_true", help="a few steps and graphs: does it run?")
    parser.add_argument(
        "--runs", type=Path, nargs="*", default=[], help="folders of results of torchslam run"
    )
    parser.add_argument("--steps", type=int, help="of the training through the solver")
    parser.add_argument("--no-readme", action="store_true", help="print the tables, leave the README")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings, sizes = Settings(), Sizes()
    if arguments.quick:
        settings = replace(settings, warm_steps=20, steps=2, batch=4)
        sizes = Sizes(training=8, choosing=1, tested=1, beside=0)
    if arguments.steps:
        settings = replace(settings, steps=arguments.steps)
    folder = None if arguments.quick else CACHE
    if folder:
        folder.mkdir(exist_ok=True)
    graphs = training_graphs(sizes)
    cues = cues_of(graphs)
    print(f"{len(graphs)} graphs to train on", flush=True)
    # No more than are drawn in a training.
    solved = torch.arange(len(graphs))[:: max(1, len(graphs) // (settings.steps * settings.batch))]
    bounds = oracle_errors(graphs[solved])
    networks = [trained(graphs, cues, solved, bounds, replace(settings, seed=seed), folder) for seed in SEEDS]
    chosen = chosen_methods(sizes)
    print("\n".join(f"{label}: {method}" for label, method in chosen.items()), flush=True)
    text = evaluate(networks, chosen, sizes, TRAINING if arguments.validate else UNSEEN)
    if arguments.runs:
        text += "\n" + evaluate_real(networks, chosen, arguments.runs, sizes.tested)
    print(text)
    if not (arguments.no_readme or arguments.validate or arguments.quick):
        write_between(HERE / "README.md", text)


if __name__ == "__main__":
    main()
