"""Learned keypoints come after those that an image has, and tie what nothing else holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.global_mapping.synthetic import CAMERA, Recording, line, wall
from torchslam.cli.main import main
from torchslam.config import Config, load_config
from torchslam.data import open_sequence
from torchslam.errors import ConfigError
from torchslam.global_mapping.links import (
    HELD,
    LearnedPairs,
    learned_config,
    open_links,
    points_across,
    with_learned,
)
from torchslam.global_mapping.mapper import GlobalMapper, mapping_config
from torchslam.global_mapping.rounds import ObservedTracks, Reconstruction
from torchslam.global_mapping.tracks import Tracks, join_matches
from torchslam.types import FrameFeatures

COUNT = 10
BREAK = 5  # nothing but learned features goes from the images before this one to those from it on


def explicit(recording: Recording, weight: float) -> list[FrameFeatures]:
    """Views with the weight of each keypoint, and keypoints that a rolling shutter has shifted by a pixel."""
    return [
        replace(
            view,
            information=torch.full((len(view.mask), 1), weight, dtype=torch.float64),
            detected=view.keypoints + 1.0,
        )
        for view in recording.views
    ]


WALK = Recording.of(line(COUNT), wall(300, 2.5), noise_px=0.3, first=0)
OTHER = Recording.of(line(COUNT), wall(120, 2.5, seed=9), noise_px=0.3, seed=1, first=0)
VIEWS, LEARNED = explicit(WALK, 4.0), explicit(OTHER, 1.0)
NEAR = range(BREAK - 3, BREAK + 3)
PAIRS = [pair for pair in WALK.pairs(1, 2, 3) if (pair.first < BREAK) == (pair.second < BREAK)]
ACROSS = [pair for pair in OTHER.pairs(1, 2, 3) if pair.first in NEAR and pair.second in NEAR]
TIED = with_learned(VIEWS, {row: LEARNED[row] for row in NEAR}, ACROSS)


def tracks_of(*pairs: LearnedPairs) -> Tracks:
    every = [pair for each in pairs for pair in each.pairs]
    return join_matches(every, COUNT, max(len(view.mask) for view in pairs[0].views))


def test_keypoints_are_appended_and_pairs_point_to_them() -> None:
    for before, after in zip(ACROSS, TIED.pairs, strict=True):
        assert len(before) == len(after)
        for row, old, new in (
            (before.first, before.keypoints_1, after.keypoints_1),
            (before.second, before.keypoints_2, after.keypoints_2),
        ):
            view, own = TIED.views[row], LEARNED[row]
            torch.testing.assert_close(view.keypoints[new], own.keypoints[old], rtol=0, atol=0)
            torch.testing.assert_close(view.detected[new], own.detected[old], rtol=0, atol=0)
            assert bool(view.mask[new].all())
            assert bool((view.information[new] == 1.0).all())
            assert not bool(VIEWS[row].mask[new[new < len(VIEWS[row].mask)]].any())


def test_keypoints_of_an_image_stay() -> None:
    for row, (before, after) in enumerate(zip(VIEWS, TIED.views, strict=True)):
        was = before.mask
        for name in ("keypoints", "detected", "scales", "angles", "descriptors", "information"):
            old, new = getattr(before, name), getattr(after, name)
            assert torch.equal(new[: len(was)][was], old[was]), name
        added = int(after.mask.sum() - was.sum())
        assert (added > 0) == (row in NEAR)
        assert len(after.mask) == max(len(was), int(was.nonzero().amax()) + 1 + added)
        matched = {
            int(at)
            for pair in ACROSS
            for end, found in ((pair.first, pair.keypoints_1), (pair.second, pair.keypoints_2))
            if end == row
            for at in found
        }
        assert added == len(matched)


def test_descriptors_of_another_width_are_filled_with_zeros() -> None:
    narrow = {row: replace(LEARNED[row], descriptors=LEARNED[row].descriptors[:, :16]) for row in NEAR}
    tied = with_learned(VIEWS, narrow, ACROSS)
    pair = tied.pairs[0]
    found = tied.views[pair.first].descriptors[pair.keypoints_1]
    assert found.shape[1] == 64
    assert bool((found[:, 16:] == 0).all())
    assert bool((found[:, :16] != 0).any())


def reconstruction(tracks: Tracks) -> tuple[ObservedTracks, Reconstruction]:
    """The true map, which all observations agree with."""
    observed = ObservedTracks.of(tracks, TIED.views)
    points_w = torch.zeros(tracks.count, 3, dtype=torch.float64)
    agrees = torch.ones_like(tracks.track, dtype=torch.bool)
    return observed, Reconstruction(WALK.T_cw, CAMERA, points_w, agrees)


def test_a_link_is_open_where_few_points_go_across() -> None:
    observed, found = reconstruction(tracks_of(LearnedPairs(TIED.views, PAIRS)))
    across = points_across(observed, found)
    assert len(across) == COUNT - 1
    assert int(across[BREAK - 1]) == 0
    assert int(across[torch.arange(COUNT - 1) != BREAK - 1].min()) >= HELD
    assert open_links(observed, found) == [([2, 3, 4], [5, 6, 7])]
    few = replace(found, agrees=found.agrees & (observed.tracks.view != 8))  # image 8 agrees on nothing
    assert int(points_across(observed, few)[7]) > 0  # others see past it
    tied, found = reconstruction(tracks_of(LearnedPairs(TIED.views, PAIRS), TIED))
    assert open_links(tied, found) == []


def test_learned_pairs_hold_a_map_together() -> None:
    sequence = open_sequence("synthetic:room?frames=10")
    mapper = GlobalMapper(sequence, CAMERA, Config(), None)
    apart = mapper.reconstruct(VIEWS, PAIRS)
    assert not isinstance(apart, str)
    assert len(apart[0]) == COUNT - BREAK
    tied = mapper.reconstruct(VIEWS, PAIRS, TIED)
    assert not isinstance(tied, str)
    assert tied[0].tolist() == list(range(COUNT))
    steps = tied[2].T_cw[:, :3, 3].diff(dim=0).norm(dim=-1)
    assert float((steps / steps.mean() - 1).abs().max()) < 0.05


ASKED = "global_mapping.learned_links=true"


def test_no_weights_are_looked_for_unless_links_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_for: list[str] = []
    monkeypatch.setattr("torchslam.features.weights.find_weights", looked_for.append)
    assert learned_config(mapping_config(Config())) is None
    assert looked_for == []
    with pytest.raises(ConfigError):
        learned_config(mapping_config(load_config(None, [ASKED])))
    assert looked_for == ["xfeat-lighterglue"]


def test_learned_links_that_are_asked_for_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "xfeat-lighterglue.safetensors").touch()
    monkeypatch.setenv("TORCHSLAM_WEIGHTS", str(tmp_path))
    found = learned_config(mapping_config(load_config(None, [ASKED])))
    assert found is not None
    assert (found.features.kind, found.matching.matcher) == ("xfeat", "lightglue")
    assert learned_config(found) is None  # the mapper of the learned features has none of its own


def test_learned_links_without_weights_or_sift_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TORCHSLAM_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = load_config(None, [ASKED])
    mapper = GlobalMapper(open_sequence("synthetic:room?frames=10"), CAMERA, config, None)
    with pytest.raises(ConfigError, match="torchslam download xfeat-lighterglue"):
        mapper.run()
    output = tmp_path / "results"
    assert main(["run", "synthetic:room?frames=10", "--output", str(output), "--set", ASKED]) == 2
    assert "learned_links: the weights xfeat-lighterglue are not on this machine" in capsys.readouterr().err
    assert not output.exists()
    with pytest.raises(ConfigError, match="not orb and descriptors"):
        learned_config(load_config(None, ["features.kind=orb", ASKED]))


@pytest.mark.parametrize(
    ("gains", "is_right", "views", "doubtful"),
    [
        ([10.0, 11.0, 12.0, 11.0], True, TIED.views, set()),
        ([10.0, 11.0, 12.0, 11.0], False, TIED.views, {5, 6, 7, 8, 9}),
        ([-10.0, -11.0, -12.0, -11.0], True, VIEWS, set()),
        ([40.0, 0.0, 0.0, 0.0], True, VIEWS, set()),
        ([0.0, 0.0, 0.0, 0.0], True, VIEWS, set()),
    ],
)
def test_learned_links_are_kept_where_pairs_prefer_the_map(
    gains: list[float],
    is_right: bool,
    views: list[FrameFeatures],
    doubtful: set[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By all of them, not by one alone. Images that only links hold are doubted where pairs contradict that map.

    gains: by how much the log likelihood of each pair that was held back is higher with learned links.
    """
    mapper = GlobalMapper(open_sequence("synthetic:room?frames=10"), CAMERA, Config(), None)
    none = torch.zeros(0, dtype=torch.int64)
    maps = iter([(torch.arange(BREAK), none, none), (torch.arange(COUNT), none, none)])
    gained = torch.tensor(gains, dtype=torch.float64)
    without = torch.full_like(gained, -5.0)
    checks = iter(
        SimpleNamespace(evidence=evidence, is_right=is_right) for evidence in (without, without + gained)
    )
    monkeypatch.setattr("torchslam.global_mapping.mapper.build_view_graph", lambda *_: PAIRS)
    # Two of the pairs of the images' own features, and two of the learned ones.
    monkeypatch.setattr(
        "torchslam.global_mapping.mapper.choose_held_back", lambda pairs: frozenset({0, len(pairs) - 1})
    )
    monkeypatch.setattr("torchslam.global_mapping.mapper.open_links", lambda *_: [([4], [5])])
    monkeypatch.setattr(mapper, "_saved_views", lambda _: VIEWS)
    monkeypatch.setattr(mapper, "_learned", lambda *_: TIED)
    monkeypatch.setattr(mapper, "reconstruct", lambda *_, **__: next(maps))
    monkeypatch.setattr(mapper, "_check", lambda *_: next(checks))
    monkeypatch.setattr(mapper, "posed", lambda *_: (None, None, None))
    monkeypatch.setattr(mapper, "adjusted", lambda *_: None)
    made = mapper.run()
    for one, other in zip(made.views, views, strict=True):
        assert one.keypoints is other.keypoints
        assert one.descriptors.shape == (len(other.mask), 0)  # they are not needed any longer
    assert made.doubtful == doubtful
