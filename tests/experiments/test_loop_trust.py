"""Loop trust: simulated graphs, the robust methods that learned weights compete with, training through the solver."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from experiments.loop_trust import run
from experiments.loop_trust.baselines import (
    CHI_SQUARE,
    Cauchy,
    DynamicCovarianceScaling,
    Everything,
    GraduatedNonConvexity,
    Method,
    Odometry,
    Oracle,
    PairwiseConsistency,
    agreement,
    largest_clique,
    nodes_of,
)
from experiments.loop_trust.graphs import Graphs, ate, chi_squares, dead_reckoning, solve
from experiments.loop_trust.report import ratio
from experiments.loop_trust.simulation import Noise, simulate
from experiments.loop_trust.training import Settings, train, warm_up
from experiments.loop_trust.trust import LoopTrust, describe, trusted
from experiments.loop_trust.walks import TRAINING, UNSEEN, ring
from torchslam.geometry import sim3_exp, sim3_inverse

EASY = Noise(
    odometry=((0.01, 0.02), (0.003, 0.005), (0.003, 0.005)),
    loop=((0.02, 0.03), (0.005, 0.01), (0.005, 0.01)),
    belief=1.0,
)


@pytest.fixture(scope="module")
def easy() -> Graphs:
    return simulate(ring, 40, (0.4, 0.4), 3, seed=1, noise=EASY)


@pytest.fixture(scope="module")
def bounds(easy: Graphs) -> tuple[Tensor, Tensor]:
    """Errors where the true loops alone are heard, and where all are."""
    best, all_heard = (ate(nodes_of(method, easy), easy.S_cw_true) for method in (Oracle(), Everything()))
    return best, all_heard


@pytest.mark.parametrize("name", sorted(TRAINING | UNSEEN))
def test_walks_come_back_and_false_loops_are_false(name: str) -> None:
    graphs = simulate((TRAINING | UNSEEN)[name], 60, (0.5, 0.5), 2, seed=0, noise=EASY)
    squared = chi_squares(graphs, graphs.S_cw_true)
    assert bool((squared[graphs.genuine] < 60).all())
    assert bool((squared[graphs.mask & ~graphs.genuine] > 60).all())
    shares = (graphs.mask & ~graphs.genuine).sum(-1) / graphs.mask.sum(-1)
    assert bool(((shares - 0.5).abs() < 0.05).all())
    assert bool((graphs.pairs[..., 0] < graphs.pairs[..., 1]).all())


def test_false_clusters_agree_with_themselves_as_well_as_genuine_loops_do(easy: Graphs) -> None:
    agree, false = agreement(easy).pairwise, easy.mask & ~easy.genuine
    mates = (agree < CHI_SQUARE) & false[:, :, None] & false[:, None]
    assert float((mates.sum(-1) > 1)[false].double().mean()) > 0.5


def test_distances_from_odometry_are_chi_square_where_beliefs_are_right() -> None:
    graphs = simulate(ring, 40, (0.0, 0.0), 20, seed=3, noise=EASY)
    own = agreement(graphs).own[graphs.mask]
    assert 4.0 < float(own.median()) < 12.0  # 6.35 without the bias of the odometry


def test_pairwise_distance_is_that_of_the_cycle(easy: Graphs) -> None:
    S, (i, j), L = dead_reckoning(easy)[0], easy.pairs[0].unbind(-1), easy.loops[0]
    cycle = L[0] @ S[i[0]] @ sim3_inverse(S[i[1]]) @ sim3_inverse(L[1]) @ S[j[1]] @ sim3_inverse(S[j[0]])
    noiseless = replace(easy, loops=easy.loops.clone())
    noiseless.loops[0, 0] = sim3_inverse(cycle) @ L[0]  # closes the cycle
    assert float(agreement(noiseless).pairwise[0, 0, 1]) < 1e-12
    assert float(agreement(easy).pairwise[0, 0, 1]) > 1e-3


@pytest.mark.parametrize(
    "method",
    [
        Cauchy(2.0),
        DynamicCovarianceScaling(20.0),
        GraduatedNonConvexity(4 * CHI_SQUARE),
        GraduatedNonConvexity(4 * CHI_SQUARE, truncated=False),
        PairwiseConsistency(4 * CHI_SQUARE),
        PairwiseConsistency(4 * CHI_SQUARE, gated=True),
    ],
    ids=str,
)
def test_the_competitors_recover_an_easy_graph(
    easy: Graphs, bounds: tuple[Tensor, Tensor], method: Method
) -> None:
    best, all_heard = bounds
    assert bool((ate(nodes_of(method, easy), easy.S_cw_true) < 2 * best).all())
    assert bool((all_heard > 4 * best).all())


def test_weights_of_gnc_end_at_zero_or_one_for_the_truncated_cost() -> None:
    squared = torch.tensor([0.1, 10.0, 30.0, 1000.0])
    rule = GraduatedNonConvexity(CHI_SQUARE)
    assert rule.weights(squared, torch.tensor(1e6)).tolist() == [1.0, 1.0, 0.0, 0.0]
    assert bool((rule.weights(squared, torch.tensor(1e-4)) > 0).all())


def test_the_largest_clique() -> None:
    fits = torch.zeros(5, 5, dtype=torch.bool)
    for a, b in ((0, 1), (1, 2), (0, 2), (3, 4), (2, 3)):
        fits[a, b] = fits[b, a] = True
    assert largest_clique(fits, torch.ones(5, dtype=torch.bool)) == [0, 1, 2]
    assert largest_clique(fits, torch.tensor([True, False, True, True, False])) in ([0, 2], [2, 3])


def test_graphs_solved_side_by_side_are_solved_as_alone(easy: Graphs) -> None:
    together = solve(easy, easy.genuine.double())
    alone = torch.cat([solve(easy[k : k + 1], easy[k : k + 1].genuine.double()) for k in range(len(easy))])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-5)
    assert bool((ate(together, easy.S_cw_true) < ate(nodes_of(Odometry(), easy), easy.S_cw_true)).all())


def test_the_gradient_of_the_trajectory_error_to_weights_is_that_of_differences(easy: Graphs) -> None:
    graphs = easy[:1]
    weights = torch.where(graphs.genuine, 0.8, 0.02).double().requires_grad_()

    def error(weights: Tensor) -> Tensor:
        return ate(solve(graphs, weights, backward="implicit"), graphs.S_cw_true).sum()

    (gradient,) = torch.autograd.grad(error(weights), weights)
    for row in (0, int((~graphs.genuine[0]).nonzero()[0])):
        step = torch.zeros_like(weights)
        step[0, row] = 1e-4
        with torch.no_grad():
            expected = (error(weights + step) - error(weights - step)) / 2e-4
        torch.testing.assert_close(gradient[0, row], expected, rtol=2e-3, atol=1e-7)


def test_cues_do_not_depend_on_the_world_its_unit_or_the_order_of_loops(easy: Graphs) -> None:
    cues = describe(easy)
    S = sim3_exp(torch.tensor([3.0, -2.0, 1.0, 0.4, 0.2, -0.3, 0.7], dtype=torch.float64))
    moved = describe(replace(easy, S_cw_true=easy.S_cw_true @ S))
    torch.testing.assert_close(moved.alone, cues.alone, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(moved.paired, cues.paired, atol=1e-3, rtol=1e-3)
    order = torch.randperm(easy.mask.shape[1], generator=torch.Generator().manual_seed(0))
    loops = {
        name: getattr(easy, name)[:, order] for name in ("pairs", "loops", "loop_sigmas", "genuine", "mask")
    }
    network = LoopTrust(cues.alone.shape[-1], cues.paired.shape[-1])
    network.first.measure(cues.alone, cues.paired, cues.mask)
    shuffled = network.logits(describe(replace(easy, **loops)))
    torch.testing.assert_close(shuffled, network.logits(cues)[:, order], atol=1e-4, rtol=1e-4)


def test_empty_rows_change_nothing(easy: Graphs) -> None:
    padded = easy.padded(easy.mask.shape[1] + 5)
    cues, more = describe(easy), describe(padded)
    network = LoopTrust(cues.alone.shape[-1], cues.paired.shape[-1])
    network.first.measure(cues.alone, cues.paired, cues.mask)
    logits = network.logits(more)[:, : easy.mask.shape[1]]
    torch.testing.assert_close(
        torch.where(easy.mask, logits, 0.0),
        torch.where(easy.mask, network.logits(cues), 0.0),
        atol=1e-4,
        rtol=1e-4,
    )


def test_training_learns_to_tell_loops_and_then_trajectories() -> None:
    graphs = simulate(ring, 30, (0.3, 0.5), 12, seed=5, noise=EASY)
    cues = describe(graphs)
    bounds = ate(nodes_of(Oracle(), graphs), graphs.S_cw_true)
    settings = Settings(warm_steps=60, warm_batch=8, steps=4, batch=3)
    network = LoopTrust(cues.alone.shape[-1], cues.paired.shape[-1])
    losses = warm_up(network, graphs, cues, settings)
    assert losses[-1] < 0.5 * losses[0]
    before = [p.clone() for p in network.second.parameters()]
    losses = train(network, graphs, cues, bounds, settings)
    assert len(losses) == 4
    assert any(not torch.equal(a, b) for a, b in zip(before, network.second.parameters(), strict=True))
    with torch.no_grad():
        weights, S_cw = trusted(network, graphs, cues)[-1]
    assert float(weights[graphs.genuine].mean()) > float(weights[graphs.mask & ~graphs.genuine].mean())
    everything = ate(nodes_of(Everything(), graphs), graphs.S_cw_true)
    assert bool((ate(S_cw, graphs.S_cw_true).log().mean() < everything.log().mean()).all())


def test_the_experiment_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    cheap: dict[str, list[Method]] = {
        "Cauchy": [Everything()],
        "DCS": [Everything(), Odometry()],
        "GNC": [Odometry()],
        "PCM": [PairwiseConsistency(CHI_SQUARE), PairwiseConsistency(4 * CHI_SQUARE)],
    }
    monkeypatch.setattr(run, "candidates", lambda: cheap)
    monkeypatch.setattr(run, "SEEDS", (0, 1))
    monkeypatch.setattr(run, "NODES", 30)
    monkeypatch.setattr(run, "TRAINING", {"ring": ring})
    monkeypatch.setattr(run, "UNSEEN", {"eight": UNSEEN["eight"]})
    monkeypatch.setattr("sys.argv", ["run", "--quick"])
    readme = (run.HERE / "README.md").read_bytes()
    run.main()
    told = capsys.readouterr().out
    assert "eight, strong drift" in told
    assert "- PCM: chi² " in told
    assert (run.HERE / "README.md").read_bytes() == readme


def test_ratios_are_of_geometric_means() -> None:
    cell = {
        "learned": torch.tensor([[1.0, 4.0], [2.0, 2.0]]).double(),
        "PCM": torch.tensor([[4.0, 4.0]]).double(),
    }
    found = ratio([cell], "learned", "PCM")
    assert found.mean == pytest.approx(0.5)
    assert found.deviation == pytest.approx(0.0)
    assert found.low <= found.mean <= found.high
