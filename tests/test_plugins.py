"""Parts of others by name: on the command line, by entry point, and what is said where something is wrong."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchslam import ORB, SLAM, ClipSLAM, Config, Features, load_config, open_sequence, plugins
from torchslam.cli.main import main
from torchslam.errors import ConfigError
from torchslam.map.atlas import MAX_MOTIONS
from torchslam.system.front_end import image_extractor
from torchslam.tracking.learned_matchers import LightGlue
from torchslam.tracking.matcher import make_matcher
from torchslam.tracking.motion_model import constant_velocity, run_motion_model
from torchslam.types import Frame, FrameFeatures, MotionHistory, PosePrediction

EXAMPLE = Path(__file__).parent.parent / "examples" / "own_front_end.py"
EYE = torch.eye(4)
ROOM = "synthetic:room?frames=14"
HERE = "tests.test_plugins"


def answer(images: Tensor) -> Features:
    rows = images.new_ones(len(images), 20)
    keypoints = torch.rand(len(images), 20, 2) * 100
    described = torch.zeros(len(images), 20, 32, dtype=torch.uint8)
    return Features(keypoints, rows, rows, rows, described, rows > 0)


class Broken:
    """A feature extractor with configured outputs."""

    changes: dict[str, Any] = {}  # noqa: RUF012 - set by a test

    def __call__(self, images: Tensor) -> object:
        return (
            SimpleNamespace()
            if self.changes == {"": 0}
            else Features(**{**vars(answer(images)), **self.changes})
        )


class Failing:
    def __init__(self) -> None:
        raise RuntimeError("no licence")


number = 7


@pytest.mark.usefixtures("without_pictures")
def test_the_example_is_short_and_runs(tmp_path: Path) -> None:
    """From the command line, both parts its own."""
    body = EXAMPLE.read_text().split('"""', 2)[2].splitlines()
    assert len([line for line in body if line.strip()]) <= 30
    names = ["--features", "examples.own_front_end:Patches", "--matcher", "examples.own_front_end:nearest"]
    status = main(["run", ROOM, "-o", str(tmp_path), *names, "--set", "features.num_keypoints=500"])
    assert status == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["posed"] >= 12
    assert metrics["ate"]["rmse_m"] if "ate" in metrics else metrics["ate_m"] < 0.05
    assert "own_front_end:Patches" in (tmp_path / "config.toml").read_text()


def test_the_same_object_serves_slam_and_clips() -> None:
    room = open_sequence(ROOM)
    extractor = ORB(500)
    run = SLAM(room.camera, extractor=extractor).run(room)
    own = SLAM(room.camera, load_config(None, ["features.num_keypoints=500"])).run(room)
    assert torch.equal(run.trajectory.T_wc, own.trajectory.T_wc)
    images = torch.cat([room.image(index) for index in range(0, 14, 2)])
    assert int(ClipSLAM(extractor)(images, room.camera).posed.sum()) == 7


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("orbb", "must be one of .*, or PACKAGE:NAME, not 'orbb'"),
        (":x", "must be one of"),
        ("nowhere_at_all:x", "no package 'nowhere_at_all' can be imported"),
        ("torchslam.nowhere:x", "no package 'torchslam.nowhere' can be imported"),
        (f"{HERE}:nothing", f"'{HERE}' has no 'nothing'"),
        (f"{HERE}:number", "int cannot be called"),
        (f"{HERE}:Failing", "cannot be instantiated: RuntimeError: no licence"),
    ],
)
def test_a_wrong_name_is_one_line_and_status_2(
    name: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option in ("--features", "--matcher"):
        assert main(["run", ROOM, "-o", str(tmp_path / option), option, name]) == 2
        (line,) = (
            line for line in capsys.readouterr().err.splitlines() if line.startswith("torchslam: error")
        )
        assert re.search(words, line), line


rows = torch.ones(1, 20)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"": 0}, "must return torchslam.Features, not SimpleNamespace"),
        ({"keypoints": rows}, r"keypoints must be \(1, N, 2\), not \(1, 20\)"),
        ({"scales": torch.ones(1, 19)}, r"scales must be \(1, 20\), not \(1, 19\)"),
        ({"mask": rows}, "mask must be bool, not torch.float32"),
        ({"angles": rows.long()}, "angles must be floats, not torch.int64"),
        ({"descriptors": torch.zeros(1, 20)}, "descriptors must be"),
        (
            {"descriptors": torch.zeros(1, 20, 32).int()},
            "descriptors must be uint8, bits, or floats, not torch.int32",
        ),
        (
            {"descriptors": torch.zeros(1, 20, 64, dtype=torch.uint8)},
            r"descriptors of bits must be \(1, 20, 32\), 256 bits, not \(1, 20, 64\)",
        ),
        (
            {"descriptors": torch.full((1, 20, 64), 0.5)},
            r"descriptors of floats .* must have length one, .* not 4 to 4; .*normalize\(descriptors, dim=-1\)",
        ),
        ({"descriptors": torch.full((1, 20, 64), torch.nan)}, "descriptors .* must have length one"),
        ({"scales": 0 * rows}, "scales must be positive"),
        ({"scales": torch.nan * rows}, "scales must be finite"),
        (
            {"information": torch.ones(1, 20, 3)},
            r"information must be \(1, 20\) or \(1, 20, 2, 2\), not \(1, 20, 3\)",
        ),
        ({"information": rows.long()}, "information must be floats"),
        ({"information": -rows}, "information must be positive"),
        (
            {"information": torch.ones(1, 20, 2, 2)},
            "information must be positive, a matrix positive definite",
        ),
        ({"information": torch.nan * rows}, "information must be positive"),
    ],
)
@pytest.mark.usefixtures("without_shape_checks")
def test_an_invalid_output_of_a_feature_extractor_is_named(changes: dict[str, Any], words: str) -> None:
    Broken.changes = changes
    extract = image_extractor(load_config(None, [f"features.kind={HERE}:Broken"]))
    with pytest.raises(ConfigError, match=f"feature extractor {HERE}:Broken: {words}"):
        extract(Frame(0, 0.0, torch.zeros(1, 1, 100, 100)))


def test_a_registered_plugin_is_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = EntryPoint("mine", f"{HERE}:answer", plugins.FEATURE_EXTRACTORS)
    monkeypatch.setattr(
        plugins, "registered", lambda group: {"mine": mine} if group == plugins.FEATURE_EXTRACTORS else {}
    )
    config = load_config(None, ["features.kind=mine"])
    assert image_extractor(config)(Frame(0, 0.0, torch.zeros(1, 1, 100, 100))).mask.sum() == 20
    with pytest.raises(
        ConfigError, match=r"matching.matcher must be one of descriptors, lightglue, or PACKAGE:NAME"
    ):
        load_config(None, ["matching.matcher=mine"])


def test_information_is_scaled_with_reduced_images() -> None:
    """Stated for the reduced image, where a pixel is two of the large one."""

    def says(images: Tensor) -> Features:
        return Features(**{**vars(answer(images)), "information": torch.full((1, 20), 4.0)})

    found = image_extractor(Config(), extractor=says)(Frame(0, 0.0, torch.zeros(1, 1, 960, 1280)))
    assert found.information is not None
    torch.testing.assert_close(found.information, torch.full((1, 20), 1.0))


def lightglue_file(path: Path) -> Path:
    from kornia.feature import LightGlue as Network

    torch.manual_seed(0)
    network = Network(features=None, input_dim=64, descriptor_dim=96, n_layers=2, num_heads=1)
    save_file({f"matcher.{name}": tensor for name, tensor in network.state_dict().items()}, path)
    return path


def view(dim: int, seed: int) -> FrameFeatures:
    generator = torch.Generator().manual_seed(seed)
    described = torch.nn.functional.normalize(torch.randn(30, dim, generator=generator), dim=-1)
    keypoints = 100 * torch.rand(30, 2, generator=generator, dtype=torch.float64)
    ones = torch.ones(30, dtype=torch.float64)
    return FrameFeatures(seed, 0.0, keypoints, ones, 0 * ones, described, torch.arange(30) < 25)


@pytest.mark.parametrize(
    ("name", "tensor"),
    [
        ("posenc.Wr.weight", torch.tensor(1.0)),
        ("posenc.Wr.weight", torch.ones(3)),
        ("input_proj.weight", torch.tensor(1.0)),
        ("input_proj.weight", torch.ones(200_000, 1)),  # of a network of 10^12 floats
    ],
)
def test_weights_of_no_lightglue_are_refused(tmp_path: Path, name: str, tensor: torch.Tensor) -> None:
    path = lightglue_file(tmp_path / "lightglue.safetensors")
    save_file(load_file(path) | {f"matcher.{name}": tensor}, path)
    with pytest.raises(ConfigError, match=r"lightglue\.safetensors: not the weights of a LightGlue network"):
        LightGlue(path)


def test_lightglue_works_as_a_matcher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With weights of chance: what it says is nothing, how it says it is what is tested."""
    from torchslam.tracking.matcher import run_matcher

    file = lightglue_file(tmp_path / "lightglue.safetensors")
    matcher = make_matcher(
        load_config(None, ["matching.matcher=lightglue", f'matching.weights="{file}"']).matching
    )
    assert isinstance(matcher, LightGlue)
    matcher.network.conf.filter_threshold = 0.0
    one = view(64, 1)
    pairs = run_matcher(matcher, one, one)
    assert len(pairs.first) > 0
    assert pairs.weights is not None
    assert bool((pairs.weights > 0).all())
    for size in (
        None,
        (110, 120),
    ):  # keypoints reach half a pixel beyond the centers of the pixels at the border
        matcher.image_size = size
        low = torch.full((2,), -0.5, dtype=torch.float64)
        high = one.keypoints.amax(0) + 0.5 if size is None else torch.tensor(size, dtype=torch.float64) - 0.5
        for corner in (low, high, torch.stack([low[0], high[1]])):
            at_the_border = replace(
                one, keypoints=one.keypoints.index_copy(0, torch.tensor([3]), corner[None])
            )
            for pair in ((at_the_border, one), (one, at_the_border), (at_the_border, at_the_border)):
                assert len(run_matcher(matcher, *pair).first) > 0
    matcher.image_size = None
    with pytest.raises(ConfigError, match="its weights are for descriptors of 64 floats, these are 32"):
        matcher(view(32, 1), view(32, 2), None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("TORCHSLAM_WEIGHTS", raising=False)
    with pytest.raises(ConfigError, match="torchslam download xfeat-lighterglue"):
        make_matcher(load_config(None, ["matching.matcher=lightglue"]).matching)
    with pytest.raises(ConfigError, match="torchslam download aliked-lightglue"):
        make_matcher(load_config(None, ["matching.matcher=lightglue"]).matching, features="aliked")
    (tmp_path / "other.pt").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="cannot read the weights"):
        LightGlue(tmp_path / "other.pt")


@pytest.mark.usefixtures("without_pictures")
def test_an_optical_flow_matcher_runs_with_its_own_samples(tmp_path: Path) -> None:
    """A dense matcher from end to end, as the example's docstring has it."""
    names = ["--features", "examples.optical_flow:Samples", "--matcher", "examples.optical_flow:same"]
    assert main(["run", ROOM, "-o", str(tmp_path), *names, "--set", "features.num_keypoints=500"]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["posed"] >= 12
    assert metrics["ate_m"] < 0.05


def test_samples_keep_their_identity_along_the_flow() -> None:
    from examples.optical_flow import Samples, same

    room, samples = open_sequence(ROOM), Samples(300)
    one, other = (
        FrameFeatures.of(room[index], samples(room.image(index)), torch.zeros(0).double()) for index in (0, 1)
    )
    found = same(one, other, None)
    assert int(found.mask.sum()) > 200
    moved = other.keypoints[found.indices_2[found.mask]] - one.keypoints[found.indices_1[found.mask]]
    assert 0 < float(moved.norm(dim=-1).median()) < 20
    assert len(torch.unique(found.indices_2[found.mask])) == int(found.mask.sum())


@pytest.mark.usefixtures("without_pictures")
def test_a_motion_model_runs_from_the_command_line(tmp_path: Path) -> None:
    names = ["--motion-model", "examples.own_motion_model:steady", "--set", "features.num_keypoints=500"]
    assert main(["run", ROOM, "-o", str(tmp_path), *names]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["posed"] == 14
    assert metrics["ate_m"] < 0.05
    assert "own_motion_model:steady" in (tmp_path / "config.toml").read_text()


def test_the_default_motion_model_as_a_plugin_gives_the_same_bytes() -> None:
    room, config = open_sequence(ROOM), load_config(None, ["features.num_keypoints=500"])
    histories: list[MotionHistory] = []

    def own(history: MotionHistory) -> PosePrediction:
        histories.append(history)
        return constant_velocity(history)

    found = SLAM(room.camera, config, motion_model=own).run(room)
    assert torch.equal(found.trajectory.T_wc, SLAM(room.camera, config).run(room).trajectory.T_wc)
    longest = max(histories, key=lambda history: len(history.motions))
    assert 5 < len(longest.motions) == len(longest.intervals) <= MAX_MOTIONS
    assert longest.interval == pytest.approx(room.timestamp(1) - room.timestamp(0), abs=1e-6)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (None, "must return PosePrediction, not NoneType"),
        ([EYE[:3, :3]], r"T_cw must be a \(4, 4\) rigid transform"),
        ([2 * EYE], r"T_cw must be a \(4, 4\) rigid transform"),
        ([torch.nan * EYE], r"T_cw must be a \(4, 4\) rigid transform"),
        ([EYE, EYE], "covariance must be a finite, symmetric"),
        ([EYE, torch.full((6, 6), torch.inf)], "covariance must be a finite, symmetric"),
        ([EYE, torch.eye(6) - torch.ones(6, 6)], "covariance must be positive semi-definite"),
    ],
)
@pytest.mark.usefixtures("without_shape_checks")
def test_an_invalid_prediction_is_named(found: Any, words: str) -> None:
    eye, found = EYE.double(), None if found is None else PosePrediction(*found)
    with pytest.raises(ConfigError, match=f"motion model <lambda>: .*{words}"):
        run_motion_model(lambda _: found, MotionHistory(eye, eye[None], torch.ones(1).double(), 1.0))
