"""What a feature extractor says of its keypoints' errors, through whole runs, their files and their gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc
from torchslam import SLAM, ClipSLAM, Features, Run, evaluate, load_config, solve_graph
from torchslam.data.sequence import Sequence
from torchslam.errors import ConfigError
from torchslam.evaluation import ate
from torchslam.features import SimulatedFeatures
from torchslam.mapping.local_bundle import ApplyAt
from torchslam.system.checkpoint import read_checkpoint, write_checkpoint
from torchslam.system.front_end import Simulated, WithFeatures
from torchslam.system.online_run import OnlineRun, RunProgress
from torchslam.system.state_machine import StateMachine
from torchslam.types import Frame

CONFIG = load_config(
    None,
    [
        "features.kind=simulated",
        "features.num_keypoints=250",
        "simulated.points_per_view=150",
        "simulated.noise_px=0.3",
        "simulated.with_scales=true",
        "camera.std=0",
        "camera.readout_std=0",
    ],
)
WALK = Walk(arc(30)[:16])
Say = Callable[[Features], Tensor | None]


@pytest.fixture(autouse=True)
def adjusted_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Young or not, a submap grows alike."""
    monkeypatch.setattr(StateMachine, "_apply_at", lambda *_: ApplyAt.NOW)


def by_number(features: Features) -> Tensor:
    return features.scales**-2


def by_matrix(features: Features) -> Tensor:
    return features.scales[..., None, None] ** -2 * torch.eye(2, dtype=torch.float64)


def sequence_with_information(say: Say) -> Sequence:
    """Simulated features that say something of their errors."""
    seen = Simulated(CONFIG, WALK.camera, true_T_cw(WALK))

    def extract(frame: Frame) -> Features:
        features = seen(frame)
        return replace(features, information=say(features))

    return WithFeatures(WALK, extract)


@lru_cache(maxsize=2)
def run_with(say: Say) -> tuple[SLAM, Run]:
    slam = SLAM(WALK.camera, CONFIG)
    return slam, slam.run(sequence_with_information(say))


@pytest.fixture(scope="module", params=[by_number, by_matrix], ids=["number", "matrix"])
def informed(request: pytest.FixtureRequest) -> tuple[SLAM, Run, Say]:
    return *run_with(request.param), request.param


def test_information_of_half_the_scale_makes_the_run_of_none() -> None:
    (_, unstated), (_, stated) = (run_with(say) for say in (lambda _: None, lambda f: (0.5 * f.scales) ** -2))
    assert len(stated.trajectory) == len(unstated.trajectory) == len(WALK)
    assert stated.map.num_keyframes == unstated.map.num_keyframes
    counts = [len(run.graph.pixels) for run in (unstated, stated)]
    assert abs(counts[0] - counts[1]) < 0.02 * counts[0]


def test_a_run_uses_the_given_information(informed: tuple[SLAM, Run, Say]) -> None:
    _, run, say = informed
    assert len(run.trajectory) == len(WALK)
    assert evaluate(run.trajectory, WALK.groundtruth).ate_m < 0.003
    graph, kept = run.graph, run.map.keyframes
    of_keyframes = graph.frame_index < run.map.num_keyframes
    scales = kept["scales"][graph.frame_index[of_keyframes], graph.keypoint_index[of_keyframes]]
    wanted = scales**-2 / run.sensor.noise_variance
    if say is by_matrix:
        wanted = wanted[:, None, None] * torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(graph.weights[of_keyframes], wanted)
    assert solve_graph(graph).success.all()


def test_a_scalar_information_equals_its_matrix(informed: tuple[SLAM, Run, Say]) -> None:
    other = run_with(by_matrix if informed[2] is by_number else by_number)[1]
    torch.testing.assert_close(informed[1].trajectory.T_wc, other.trajectory.T_wc, atol=1e-6, rtol=0)


def test_a_map_stores_the_information(informed: tuple[SLAM, Run, Say], tmp_path: Path) -> None:
    slam, _, say = informed
    slam.save(tmp_path / "map")
    loaded = SLAM.load(tmp_path / "map", CONFIG, mapping=False)
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "map").read_bytes()
    assert len(loaded.run(sequence_with_information(say)).trajectory) > 10
    mute = SLAM.load(tmp_path / "map", CONFIG)
    with pytest.raises(ConfigError, match=r"its keypoints have .* as information, the frame's none"):
        mute.step(sequence_with_information(lambda features: None)[0])


SAID = sequence_with_information(by_matrix)


def test_a_resumed_run_with_information_ends_with_the_same_bytes(tmp_path: Path) -> None:
    whole = run_with(by_matrix)[1]
    slam, so_far = SLAM(WALK.camera, CONFIG), RunProgress()
    for index in range(12):
        so_far.results.append(slam.step(SAID[index]))
        so_far.next = index + 1
    slam.confirm_map()
    write_checkpoint(tmp_path / "checkpoint", slam, so_far, WALK)
    slam, so_far = read_checkpoint(tmp_path / "checkpoint", WALK, CONFIG)
    resumed = OnlineRun(slam, SAID, so_far).run()
    assert resumed.map.keyframes["information"].shape[-1] == 3
    torch.testing.assert_close(resumed.trajectory.T_wc, whole.trajectory.T_wc, atol=1e-3, rtol=0)


@pytest.mark.slow
def test_information_downweights_inaccurate_keypoints() -> None:
    """Every third keypoint is several times as far off as the others; who says so comes out twice as well.

    The errors are means over draws: those of whoever does not know vary by a factor of two from one to the next.
    """
    errors = {"informed": 0.0, "hidden": 0.0}
    for name, draw in product(errors, range(3)):

        def blurred(features: Features, informed: bool = name == "informed", draw: int = draw) -> Features:
            bad = features.descriptors[..., 0].remainder(3) == 0
            seed = draw + int(1e3 * float(features.keypoints.sum()) % 2**30)
            generator = torch.Generator().manual_seed(seed)
            shift = 2.0 * torch.randn(features.keypoints.shape, generator=generator, dtype=torch.float64)
            keypoints = torch.where(bad[..., None], features.keypoints + shift, features.keypoints)
            information = 1 / ((0.3 * features.scales) ** 2 + torch.where(bad, 4.0, 0.0))
            return replace(features, keypoints=keypoints, information=information if informed else None)

        seen = Simulated(CONFIG, WALK.camera, true_T_cw(WALK))
        run = SLAM(WALK.camera, CONFIG).run(
            WithFeatures(WALK, lambda frame, seen=seen, blurred=blurred: blurred(seen(frame)))
        )
        assert len(run.trajectory) == len(WALK), name
        errors[name] += evaluate(run.trajectory, WALK.groundtruth).ate_m / 3
    assert errors["informed"] < 0.6 * errors["hidden"]


class Doubtful(nn.Module):
    """An extractor that knows the scene, and believes the more in a keypoint the nearer it is to a place to learn."""

    def __init__(self, walk: Walk, kind: str) -> None:
        super().__init__()
        self.falloff = nn.Parameter(torch.tensor(1.0, dtype=torch.float64))
        self.kind = kind
        poses = true_T_cw(walk)
        scene = SimulatedFeatures(
            poses,
            walk.camera,
            num_keypoints=200,
            points_per_view=120,
            depth_near=1,
            depth_far=5,
            noise_px=0.3,
        )
        self.seen = Features.cat([scene(pose, index) for index, pose in enumerate(poses)])

    def forward(self, images: Tensor) -> Features:
        away = (self.seen.keypoints - self.seen.keypoints.new_tensor([159.5, 119.5])) / 200
        if self.kind == "number":
            return replace(self.seen, information=torch.exp(-self.falloff * away.square().sum(-1)))
        return replace(self.seen, information=torch.diag_embed(torch.exp(-self.falloff * away.square())))


@pytest.mark.parametrize("kind", ["number", "matrix"])
def test_gradients_reach_the_information(kind: str) -> None:
    walk = Walk(arc(6, length=1.0))
    images, truth = torch.cat([walk.image(index) for index in range(6)]), true_T_cw(walk)
    extractor = Doubtful(walk, kind)
    clip_slam = ClipSLAM(extractor)
    graph = clip_slam.build_graph(images, walk.camera)

    def loss(falloff: float) -> Tensor:
        with torch.no_grad():
            extractor.falloff.fill_(falloff)
        poses = clip_slam(images, walk.camera, graph)
        return ate(T_cw=poses.T_cw, T_cw_groundtruth=truth, mask=poses.posed)

    loss(1.0).backward()
    assert extractor.falloff.grad is not None
    with torch.no_grad():
        wanted = float(loss(1.02) - loss(0.98)) / 0.04
    assert float(extractor.falloff.grad) == pytest.approx(wanted, rel=0.01)
