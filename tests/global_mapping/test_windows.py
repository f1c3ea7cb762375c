"""Windows of a recording: which images they have, and whether their maps find a common world again."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Self

import pytest
import torch
from torch import Tensor

from tests.global_mapping.synthetic import CAMERA, Recording, apart, line, wall
from tests.parallel.test_pool import wait_until_ready
from tests.walks import Walk
from tests.walks import arc as walk_arc
from torchslam.config import load_config
from torchslam.geometry import se3_inverse, so3_exp, transform
from torchslam.geometry.transforms import without_scale
from torchslam.global_mapping.coarse import CoarseMap, CoarseMapper
from torchslam.global_mapping.mapper import GlobalMapper, Reconstructed
from torchslam.global_mapping.rounds import Reconstruction
from torchslam.global_mapping.saved_stages import SavedStages
from torchslam.global_mapping.view_graph import ViewPair
from torchslam.global_mapping.windows import (
    MIN_HOLDING,
    MIN_JOINING,
    KnownPoses,
    MappedWindow,
    join_windows,
    pairs_kept,
    pairs_that_hold,
    pairs_within,
    split,
)
from torchslam.parallel.pool import Call, SharedTasks
from torchslam.types import FrameFeatures

SCENE = Recording.of(line(40), wall(900, 10.0), noise_px=0.3)
EXACT = Recording.of(line(40), wall(900, 10.0))


def similarity(seed: int) -> Tensor:
    """A rotation of any size, a shift, and a scale between a half and two."""
    numbers = torch.randn(7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    S = torch.eye(4, dtype=torch.float64)
    S[:3, :3] = (2.0 ** float(numbers[6].clamp(-1, 1))) * so3_exp(numbers[:3])
    S[:3, 3] = numbers[3:6]
    return S


def mapped(scene: Recording, window: range, seed: int, seen: Tensor | None = None) -> MappedWindow:
    """The true map of a window in a world of its own; `seen`: which points are mapped."""
    own = Recording(
        scene.T_cw[window.start : window.stop],
        scene.points_w,
        scene.shows[window.start : window.stop],
        scene.views[window.start : window.stop],
    )
    S = similarity(seed)
    observed = own.observed
    shown = own.shows[observed.tracks.view, observed.tracks.keypoint]
    of_track = torch.zeros(observed.tracks.count, dtype=torch.int64)
    of_track[observed.tracks.track] = shown
    agrees = torch.ones(len(shown), dtype=torch.bool) if seen is None else seen[shown]
    T_ca = without_scale(own.T_cw @ torch.linalg.inv(S))
    points_a = transform(S, scene.points_w[of_track])
    return MappedWindow(observed, Reconstruction(T_ca, CAMERA, points_a, agrees), window.start)


@pytest.mark.parametrize(
    ("count", "size"), [(10, 10), (11, 10), (40, 15), (1000, 250), (7, 3), (301, 300), (1, 3)]
)
def test_windows_cover_all_images_and_overlap(count: int, size: int) -> None:
    windows = split(count, size)
    assert windows[0].start == 0
    assert windows[-1].stop == count
    assert all(len(window) == min(size, count) for window in windows)
    shared = [before.stop - after.start for before, after in pairwise(windows)]
    assert all(each >= int(0.2 * size) for each in shared)
    assert len(windows) <= 1 + -(-(count - 1) // max(round(0.75 * size), 1))


def test_windows_that_overlap_find_their_common_world() -> None:
    windows = split(40, 15)
    maps = [mapped(EXACT, window, seed) for seed, window in enumerate(windows)]
    T_cw, known = join_windows(maps, [], EXACT.views)
    assert bool(known.all())
    error, degrees = apart(T_cw, EXACT.T_cw)
    assert error < 1e-6
    assert degrees < 1e-4


def test_pairs_join_windows_that_share_no_image() -> None:
    """In either order of their images; windows that nothing ties are left out, the smaller part of them."""
    windows = [range(14), range(14, 24), range(24, 40)]
    maps = [mapped(EXACT, window, seed) for seed, window in enumerate(windows)]
    joining = [EXACT.pair(12, 15), EXACT.pair(11, 16)]
    T_cw, known = join_windows(maps, joining, EXACT.views)
    assert known.tolist() == [True] * 24 + [False] * 16
    assert apart(T_cw[:24], EXACT.T_cw[:24])[0] < 1e-6
    backwards = [
        replace(
            pair,
            first=pair.second,
            second=pair.first,
            keypoints_1=pair.keypoints_2,
            keypoints_2=pair.keypoints_1,
        )
        for pair in joining
    ]
    assert torch.allclose(join_windows(maps, backwards, EXACT.views)[0][:24], T_cw[:24], atol=1e-6)
    _, known = join_windows(maps, [], EXACT.views)
    assert known.tolist() == [False] * 24 + [True] * 16


def test_too_few_common_points_join_nothing() -> None:
    for count, joins in ((MIN_JOINING - 1, False), (MIN_JOINING + 3, True)):
        pair = EXACT.pair(18, 21)
        few = replace(pair, keypoints_1=pair.keypoints_1[:count], keypoints_2=pair.keypoints_2[:count])
        maps = [mapped(EXACT, range(20), 0), mapped(EXACT, range(20, 40), 1)]
        assert int(join_windows(maps, [few], EXACT.views)[1].sum()) == (40 if joins else 20)


def test_loops_correct_the_drift_of_windows() -> None:
    """Each window begins a little off; a similarity from the last to the first one spreads what is left."""
    windows = [range(12), range(9, 21), range(18, 30)]
    maps = [mapped(EXACT, window, seed) for seed, window in enumerate(windows)]
    bent = maps[1].found.T_cw.clone()
    turn = so3_exp(torch.tensor([0.0, 0.02, 0.0], dtype=torch.float64))
    bent[-3:, :3] = turn @ bent[-3:, :3]  # its last images say that the next window is turned
    maps[1] = maps[1]._replace(found=replace(maps[1].found, T_cw=bent))
    chain, _ = join_windows(maps, [], EXACT.views)
    loops = [EXACT.pair(8, 22), EXACT.pair(7, 22)]
    assert min(len(pair) for pair in loops) > 100
    closed, known = join_windows(maps, loops, EXACT.views)
    assert bool(known[:30].all())
    rest = [row for row in range(30) if not 18 <= row < 21]
    assert apart(closed[rest], EXACT.T_cw[rest])[0] < 0.7 * apart(chain[rest], EXACT.T_cw[rest])[0]


@pytest.mark.parametrize(("crossing", "parts"), [(MIN_HOLDING - 5, 2), (MIN_HOLDING + 5, 1)])
def test_a_window_is_cut_where_few_points_hold_it(crossing: int, parts: int) -> None:
    """Points that images on both sides of the tenth see are thinned out."""
    sees = torch.zeros(40, len(EXACT.points_w), dtype=torch.bool)
    for row, view in enumerate(EXACT.views):
        sees[row, EXACT.shows[row][view.mask]] = True
    across = (sees[:10].any(0) & sees[10:20].any(0)).nonzero()[:, 0]
    near = across[sees[9, across] & sees[10, across]]
    keep = torch.ones(len(EXACT.points_w), dtype=torch.bool)
    keep[across] = False
    keep[near[:crossing]] = True
    found = mapped(EXACT, range(20), 0, keep).parts()
    assert len(found) == parts
    rows = [torch.unique(part.observed.tracks.view[part.found.agrees]).tolist() for part in found]
    assert sorted(row for part in rows for row in part) == list(range(20))


def test_pairs_of_windows() -> None:
    """Those within have the rows of their window; those of which no window has both images are always kept."""
    pairs = SCENE.pairs(1, 12)
    windows = split(40, 15)
    within = [pairs_within(pairs, window) for window in windows]
    assert all(0 <= pair.first < pair.second < 15 for of_window in within for pair in of_window)
    inside = {
        (pair.first + window.start, pair.second + window.start)
        for of_window, window in zip(within, windows, strict=True)
        for pair in of_window
    }
    across = {(pair.first, pair.second) for pair in pairs_kept(pairs, windows, [])}
    assert across
    assert not across & inside
    assert across | inside == {(pair.first, pair.second) for pair in pairs}
    some = frozenset(sorted(inside)[::2])
    kept = {(pair.first, pair.second) for pair in pairs_kept(pairs, windows, [some, frozenset()])}
    assert kept == across | some


def test_pairs_that_poses_contradict_are_left_out() -> None:
    pairs = SCENE.pairs(1)
    T_21 = pairs[3].T_21.clone()
    T_21[:3, :3] = so3_exp(torch.tensor([0.11, 0.0, 0.0], dtype=torch.float64)) @ T_21[:3, :3]
    pairs[3] = replace(pairs[3], T_21=T_21)
    known = torch.ones(40, dtype=torch.bool)
    known[20] = False
    held = pairs_that_hold(pairs, SCENE.T_cw, known)
    assert [(pair.first, pair.second) for pair in held] == [
        (row, row + 1) for row in range(39) if row not in (3, 19, 20)
    ]
    assert pairs_that_hold([], SCENE.T_cw, known) == []


# --- the mapper -------------------------------------------------------------------------------------------------


def mapper(size: int) -> GlobalMapper:
    config = load_config(None, ["features.kind=simulated", f"global_mapping.window_images={size}"])
    return GlobalMapper(Walk(walk_arc(3)), CAMERA, config, None)


def reconstructed(size: int, pairs: list[ViewPair]) -> tuple[list[int], Tensor]:
    rows, _, found = reconstructed_by(mapper(size), pairs)
    return rows.tolist(), found.T_cw


def reconstructed_by(made: GlobalMapper, pairs: list[ViewPair] | None = None) -> Reconstructed:
    found = made.reconstruct(SCENE.views, pairs or SCENE.pairs(1, 2, 3))
    assert not isinstance(found, str)
    return found


def test_a_map_in_windows_is_the_map_of_the_whole() -> None:
    pairs = SCENE.pairs(1, 2, 3)
    rows, whole = reconstructed(40, pairs)
    assert rows == list(range(40))
    rows, windowed = reconstructed(15, pairs)
    assert rows == list(range(40))
    assert apart(windowed, whole)[0] < 1e-3 * float(se3_inverse(SCENE.T_cw)[:, 0, 3].max())
    assert apart(windowed, SCENE.T_cw)[0] < 5e-3


@pytest.mark.parametrize(
    ("doubtful", "off", "anew"),
    [([], 0.0, []), ([20], 0.0, [8, 17]), ([2, 3, 36], 0.0, [0, 25]), ([], 0.3, [0, 8, 17, 25])],
)
def test_windows_without_a_doubtful_image_enter_as_they_are(
    doubtful: list[int], off: float, anew: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless the images contradict the poses, here by rotations that are off by 0.3 radians."""
    begun, begin = list[int](), CoarseMapper.map

    def counted(self: CoarseMapper, views: list[FrameFeatures], *pairs: list[ViewPair]) -> CoarseMap | str:
        begun.append(views[0].index - SCENE.views[0].index)
        return begin(self, views, *pairs)

    monkeypatch.setattr(CoarseMapper, "map", counted)
    assert [window.start for window in split(40, 15)] == [0, 8, 17, 25]
    is_tied = torch.ones(40, dtype=torch.bool)
    is_tied[doubtful] = False
    S = similarity(3)
    T_ca = without_scale(SCENE.T_cw @ torch.linalg.inv(S))
    turns = off * torch.randn(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    T_ca[:, :3, :3] = so3_exp(turns) @ T_ca[:, :3, :3]
    T_ca[doubtful, :3, 3] = 7.0  # what is doubtful is not used
    found = mapper(15).reconstruct(SCENE.views, SCENE.pairs(1, 2, 3), known=KnownPoses(T_ca, is_tied, CAMERA))
    assert not isinstance(found, str)
    assert begun == anew
    assert found[0].tolist() == list(range(40))
    assert apart(found[2].T_cw, SCENE.T_cw)[0] < 5e-3


def test_an_image_that_only_other_windows_see_has_a_pose() -> None:
    """The last image is matched with none of its own window."""
    pairs = [pair for pair in SCENE.pairs(1, 2, 3) if pair.second < 39]
    far = [SCENE.pair(row, 39) for row in (24, 25)]
    assert min(len(pair) for pair in far) > 20
    rows, T_cw = reconstructed(14, pairs + far)
    assert rows == list(range(40))
    assert apart(T_cw, SCENE.T_cw)[0] < 1e-2


def test_a_run_that_was_killed_goes_on_at_its_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs, begun, begin = SCENE.pairs(1, 2, 3), list[int](), CoarseMapper.map

    def counted(self: CoarseMapper, views: list[FrameFeatures], *pairs: list[ViewPair]) -> CoarseMap | str:
        begun.append(views[0].index)
        return begin(self, views, *pairs)

    monkeypatch.setattr(CoarseMapper, "map", counted)

    def found(folder: Path | None, stop: int = -1) -> list[Tensor]:
        def progress(stage: str, done: int, most: int) -> None:
            if (stage, done) == ("windows", stop):
                raise KeyboardInterrupt

        begun.clear()
        made = mapper(15)
        made.progress, made.saved = progress, SavedStages(folder, made.sequence, made.config)
        found = made.reconstruct(SCENE.views, pairs)
        assert not isinstance(found, str)
        return [found[0], found[2].T_cw, found[2].points_w]

    whole, windows = found(None), list(begun)
    assert len(windows) > 2
    with pytest.raises(KeyboardInterrupt):
        found(tmp_path / "stages", 2)
    assert all(map(torch.equal, found(tmp_path / "stages"), whole))
    assert begun == windows[2:]


def test_windows_in_two_processes_give_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker saves its windows as well, so that a run that is ended can go on."""
    elsewhere = list[object]()

    class Counted(SharedTasks):
        def __enter__(self) -> Self:
            super().__enter__()
            if self.count:
                wait_until_ready(self)
            return self

        def result(self, call: Call) -> object:
            elsewhere.append(call)
            return super().result(call)

    monkeypatch.setattr("torchslam.parallel.pool.can_fork", lambda: sys.platform == "linux")
    monkeypatch.setattr("torchslam.global_mapping.mapper.SharedTasks", Counted)
    found = list[list[bytes]]()
    for processes in (1, 2):
        made = mapper(15)
        made.processes = processes
        made.saved = SavedStages(tmp_path / str(processes), made.sequence, made.config)
        rows, observed, whole = reconstructed_by(made)
        tensors = rows, observed.tracks.keypoint, whole.T_cw, whole.points_w, whole.camera.params
        found.append([tensor.numpy().tobytes() for tensor in tensors])
    assert found[0] == found[1]
    assert elsewhere
    one, two = ({path.name: path.read_bytes() for path in (tmp_path / each).iterdir()} for each in ("1", "2"))
    assert one == two
    assert len(one) == len(split(40, 15))


def test_without_a_map_of_any_window_the_first_reason_is_given() -> None:
    failure = mapper(15).reconstruct(SCENE.views, [])
    assert failure == "no map: no two of 15 images show the same scene"
