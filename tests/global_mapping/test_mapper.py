"""The global mapper: which frames it takes, what it says where there is no map, and whole recordings."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.global_mapping.synthetic import CAMERA, Recording, apart, arc, ball, rand, randn, view_pair
from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, still, turn
from tests.walks import arc as walk_arc
from torchslam import SLAM, open_sequence
from torchslam.config import Config, load_config
from torchslam.data.sequence import Sequence
from torchslam.errors import FrameError, InitializationError
from torchslam.evaluation import evaluate
from torchslam.geometry import se3_inverse, so3_exp
from torchslam.geometry.camera_measurement import CameraMeasurement
from torchslam.global_mapping.check import check_map
from torchslam.global_mapping.coarse import CoarseMap, CoarseMapper
from torchslam.global_mapping.image_choice import choose_images, needs_keyframes
from torchslam.global_mapping.mapper import (
    GlobalMap,
    GlobalMapper,
    choose_held_back,
    mapping_config,
    poses_of,
)
from torchslam.global_mapping.rounds import COARSE
from torchslam.global_mapping.view_graph import PairMatcher, Relation, ViewPair
from torchslam.optim.sensor_estimate import CONTRADICTED
from torchslam.system.front_end import Simulated
from torchslam.system.online_run import OnlineRun
from torchslam.types import FrameFeatures, State, StepResult

WALK = Walk(walk_arc(30))


def config(*overrides: str) -> Config:
    return load_config(
        None,
        [
            "features.kind=simulated",
            "features.num_keypoints=300",
            "simulated.points_per_view=280",
            "simulated.depth_near=0.6",
            "simulated.depth_far=2",
            "simulated.noise_px=0.1",
            "global_mapping.window_images=15",
            "camera.readout_std=0",
            *overrides,
        ],
    )


def map_whole(sequence: Sequence, *overrides: str, results: Iterable[StepResult] = ()) -> GlobalMap:
    settings = config(*overrides)
    return GlobalMapper(sequence, sequence.camera, settings, None).run(list(results))


def result(index: int, state: State, is_keyframe: bool = False) -> StepResult:
    return StepResult(index, 0.1 * index, state, None, is_keyframe=is_keyframe)


# --- which frames ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "most", "chosen"),
    [
        (10, 10, list(range(10))),
        (10, 300, list(range(10))),
        (10, 9, [0, 2, 4, 6, 8]),
        (10, 5, [0, 2, 4, 6, 8]),
        (9, 3, [0, 3, 6]),
        (10, 3, [0, 4, 8]),
        (1, 3, [0]),
    ],
)
def test_images_are_spread_evenly(count: int, most: int, chosen: list[int]) -> None:
    assert choose_images(count, [], most) == chosen


def test_long_recordings_need_keyframes() -> None:
    """Of up to four times as many frames as are spread evenly, those between neighbors are tried down to every one."""
    assert not needs_keyframes(1200, 300)
    assert needs_keyframes(1201, 300)


def test_images_of_long_recordings_are_keyframes_and_doubtful_frames() -> None:
    """Doubtful frames twice as close as keyframes; with fewer than three keyframes the overlap is not known."""
    keyframes = (0, 4, 8, 30)
    results = [result(index, State.TRACKING, index in keyframes) for index in range(31)]
    assert choose_images(31, results, 30) == [0, 4, 8, 30]
    assert choose_images(31, results, 31) == list(range(31))
    for index in range(15, 23):
        results[index] = result(index, State.LOST if index < 18 else State.UNCERTAIN)
    assert choose_images(31, results, 30) == [0, 4, 8, 15, 17, 19, 21, 30]
    few = [result(index, State.TRACKING, index in (0, 4)) for index in range(31)]
    assert choose_images(31, few, 11) == list(range(0, 31, 3))


def test_one_in_ten_pairs_that_are_no_neighbors_is_held_back() -> None:
    pairs = [view_pair(row, row + distance, (0, 0)) for row in range(40) for distance in (1, 2, 3)]
    held = choose_held_back(pairs)
    far = [row for row, pair in enumerate(pairs) if pair.second - pair.first > 1]
    assert sorted(held) == [far[place] for place in range(5, 80, 10)]
    assert choose_held_back(pairs[:8]) == choose_held_back([]) == frozenset()
    assert choose_held_back(pairs[:9]) == frozenset({8})
    assert choose_held_back([pair for pair in pairs if pair.second - pair.first == 1]) == frozenset()


def test_sift_takes_the_place_of_the_default_features() -> None:
    """With its own numbers; other features were chosen, and stay with theirs."""
    settings = ["global_mapping.num_keypoints=1234", "global_mapping.max_image_pixels=567000", "seed=3"]
    given = load_config(None, settings)
    made = mapping_config(given)
    assert (made.features.kind, made.features.num_keypoints, made.features.max_image_pixels) == (
        "sift",
        1234,
        567000,
    )
    assert (made.matching.max_ratio, made.matching.max_cosine_distance) == (0.64, 0.245)
    unchanged = replace(made, features=given.features, matching=given.matching)
    assert unchanged == given
    for kind in ("sift", "simulated", "xfeat"):
        other = load_config(None, [*settings, f"features.kind={kind}"])
        assert mapping_config(other) is other


# --- simulated recordings --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mapped() -> GlobalMap:
    """Thirty frames, every other one mapped."""
    return map_whole(WALK)


def test_a_recording_is_mapped_as_a_whole(mapped: GlobalMap) -> None:
    """All frames have a pose; those that were mapped are keyframes; it is a run like any other."""
    run = mapped.run
    assert (run.failure, run.interrupted, run.skipped) == ("", False, [])
    assert WALK.groundtruth is not None
    assert evaluate(run.trajectory, WALK.groundtruth).ate_m < 2e-3
    assert len(run.trajectory) == len(run.results) == 30
    assert [each.index for each in run.results] == list(range(30))
    assert [each.index for each in run.results if each.is_keyframe] == list(range(0, 30, 2))
    assert [view.index for view in mapped.views] == list(range(0, 30, 2))
    assert run.map.num_keyframes == 15
    assert sorted(run.graph.frame_ids.tolist()) == list(range(30))
    assert bool((run.map.keyframes["covariances"].diagonal(dim1=-2, dim2=-1)[1:] > 0).all())
    assert torch.equal(run.camera.params, WALK.camera.params.double())
    assert (run.given, run.calibration) == (None, None)
    assert run.config.features.kind == "simulated"


def test_poses_of_images_are_those_of_the_run(mapped: GlobalMap) -> None:
    """Of any views: frames in between have them as well, and other frames, or other sessions, none."""
    T_cw, known = poses_of(mapped.run, mapped.views)
    torch.testing.assert_close(se3_inverse(T_cw), mapped.run.trajectory.T_wc[::2])
    others = [replace(mapped.views[0], index=index) for index in (7, 99, 3)]
    T_cw, known = poses_of(mapped.run, others)
    assert known.tolist() == [True, False, True]
    torch.testing.assert_close(se3_inverse(T_cw[known]), mapped.run.trajectory.T_wc[[7, 3]])
    assert torch.equal(T_cw[1], torch.eye(4, dtype=torch.float64))
    assert not bool(poses_of(replace(mapped.run, session=1), others)[1].any())
    assert not bool(poses_of(replace(mapped.run, submaps=()), others)[1].any())


@pytest.mark.parametrize(
    ("enough", "chosen"), [(20, [0, 8, 16, 24]), (1000, [*range(0, 25, 2)])], ids=["enough", "too few"]
)
def test_frames_between_keyframes_that_share_too_little_are_mapped(
    monkeypatch: pytest.MonkeyPatch, enough: int, chosen: list[int]
) -> None:
    """Twice as close, and twice again; images have 200 keypoints."""
    monkeypatch.setattr("torchslam.global_mapping.image_choice.LEAST_SHARED", enough)
    results = [result(index, State.TRACKING, index in (0, 8, 16, 24)) for index in range(30)]
    assert [view.index for view in map_whole(WALK, results=results).views] == chosen


@pytest.mark.parametrize(
    ("enough", "chosen"),
    [(20, [*range(0, 30, 4), 29]), (1000, list(range(30)))],
    ids=["enough", "too few"],
)
def test_frames_of_short_recordings_are_mapped_where_fewer_share_too_little(
    monkeypatch: pytest.MonkeyPatch, enough: int, chosen: list[int]
) -> None:
    """Every fourth, or else every second, or else every one; all of very few."""
    monkeypatch.setattr("torchslam.global_mapping.image_choice.ENOUGH_SHARED", enough)
    whole = "global_mapping.window_images=30"
    assert [view.index for view in map_whole(WALK, whole).views] == list(range(30))
    monkeypatch.setattr("torchslam.global_mapping.image_choice.FEW_IMAGES", 29)
    tried, match = list[int](), PairMatcher.match

    def counted(self: PairMatcher, pairs: Iterable[tuple[int, int]]) -> list[ViewPair]:
        pairs = list(pairs)
        tried.append(len(pairs))
        return match(self, pairs)

    monkeypatch.setattr(PairMatcher, "match", counted)
    monkeypatch.setattr("torchslam.global_mapping.image_choice.SAMPLE", 3)
    found = map_whole(WALK, whole)
    assert [view.index for view in found.views] == chosen
    assert len(found.run.trajectory) == 30
    # Of seven pairs, as 29 follows 28, the sample and then the others; or samples of seven and of fourteen.
    assert tried[:2] == ([4, 3] if enough < 1000 else [4, 4])


@pytest.mark.parametrize(
    ("enough", "chosen"),
    [(20, [0, 12, 24]), (1000, [0, 1, 2, *range(3, 24), 24])],
    ids=["enough", "too few"],
)
def test_keyframes_that_others_overlap_are_left_out(
    monkeypatch: pytest.MonkeyPatch, enough: int, chosen: list[int]
) -> None:
    """And frames between them where even they share too little."""
    monkeypatch.setattr("torchslam.global_mapping.image_choice.LEAST_SHARED", enough)
    monkeypatch.setattr("torchslam.global_mapping.image_choice.ENOUGH_SHARED", enough)
    monkeypatch.setattr("torchslam.global_mapping.image_choice.FEW_IMAGES", 8)
    results = [result(index, State.TRACKING, index % 3 == 0 and index < 25) for index in range(30)]
    assert [view.index for view in map_whole(WALK, results=results).views] == chosen


def test_frames_that_cannot_be_read_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    class Damaged(Walk):
        def image(self, index: int) -> Tensor:
            if index in (2, 8, 15):
                raise FrameError(f"image {index} is damaged")
            return super().image(index)

    monkeypatch.setattr("torchslam.global_mapping.image_choice.ENOUGH_SHARED", 1000)
    monkeypatch.setattr("torchslam.global_mapping.image_choice.FEW_IMAGES", 29)
    with pytest.warns(UserWarning, match="damaged"):
        made = map_whole(Damaged(walk_arc(30)), "global_mapping.window_images=30")
    assert [view.index for view in made.views] == [index for index in range(30) if index not in (2, 8, 15)]
    assert len(made.run.skipped) == 3


def test_doubtful_frames_of_an_online_run_are_mapped() -> None:
    """And each frame is read and its features are extracted once."""

    class Counting(Walk):
        read: list[int] = []  # noqa: RUF012

        def image(self, index: int) -> Tensor:
            self.read.append(index)
            return super().image(index)

    made = map_whole(Counting(walk_arc(30)), results=[result(7, State.LOST), result(8, State.TRACKING)])
    assert [view.index for view in made.views] == [0, 2, 4, 6, 7, *range(8, 30, 2)]
    assert sorted(Counting.read) == list(range(30))


def test_pairs_that_the_choice_of_images_matched_are_not_matched_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = list[tuple[int, int]]()
    match = PairMatcher.match

    def counted(matcher: PairMatcher, pairs: Iterable[tuple[int, int]]) -> list[ViewPair]:
        ends = list(pairs)
        tried.extend((matcher.views[one].index, matcher.views[other].index) for one, other in ends)
        return match(matcher, ends)

    monkeypatch.setattr(PairMatcher, "match", counted)
    made = map_whole(WALK)
    assert len(tried) == len(set(tried))
    frames = [view.index for view in made.views]
    assert set(pairwise(frames)) <= set(tried)
    ends = [(frames[pair.first], frames[pair.second]) for pair in made.pairs]
    assert len(ends) == len(set(ends))


def test_progress_names_the_stages() -> None:
    calls: list[tuple[str, int, int]] = []
    settings = config()
    GlobalMapper(
        WALK,
        WALK.camera,
        settings,
        None,
        progress=lambda stage, done, most: calls.append((stage, done, most)),
    ).run()
    stages = list(dict.fromkeys(stage for stage, _, _ in calls if "agree" not in stage))
    assert stages == [
        "features",
        "matches",
        "rotations",
        "positions",
        "adjustment",
        "weak links",
        "frames between",
        "final adjustment",
    ]
    assert [call[1:] for call in calls if call[0] == "features"] == [(done, 15) for done in range(15)]
    assert {call[1:] for call in calls if call[0] == "matches"} == {(done, 2) for done in range(2)}
    assert {done for stage, done, _ in calls if stage == "frames between"} == set(range(30))
    assert sum("agree" in stage for stage, _, _ in calls) > len(COARSE)


def map_with_error(std: float, off: float = 0.03) -> tuple[CameraMeasurement, GlobalMap]:
    """A walk around something, by a camera whose focal length is too long, by `off`, known with an error."""
    around = Walk(se3_inverse(arc(12, 120.0, 2.5)))
    settings = config("simulated.depth_near=0.9", "simulated.depth_far=1.3")
    sequence = Simulated(settings, around.camera, true_T_cw(around)).of(around)
    params = around.camera.params.double()
    measured = CameraMeasurement.of(
        around.camera.with_params(torch.cat([(1 + off) * params[:2], params[2:]])), std
    )
    return measured, GlobalMapper(sequence, measured.camera, settings, measured).run()


@pytest.mark.usefixtures("without_shape_checks")
def test_a_camera_that_is_known_with_an_error_is_measured() -> None:
    """It is found where it is off by three percent, and the run says what was given, and by which error it counts."""
    measured, made = map_with_error(0.03, off=0.03)
    run = made.run
    assert float(run.camera.focal) == pytest.approx(400, rel=0.01)
    assert run.given is not None
    assert run.given.camera is measured.camera
    # The focal length is free, by the error of a calibration that the images contradict.
    assert torch.equal(run.given.directions[:, 0], CONTRADICTED * measured.directions[:, 0])
    assert run.calibration is not None
    assert torch.equal(run.calibration.camera.params, run.camera.params)
    assert run.calibration.focal_std < 0.005


@pytest.mark.usefixtures("without_shape_checks")
def test_a_camera_that_is_known_with_an_error_is_held_where_it_predicts_as_well() -> None:
    """Off by a thousandth, as far as its error by the images: they do not predict each other better by another one."""
    measured, made = map_with_error(0.03, off=0.001)
    run = made.run
    assert torch.equal(run.camera.params, measured.camera.params)
    assert run.given is not None
    assert run.given.camera is measured.camera
    assert run.given.directions.shape[1] == 0  # nothing is free
    assert run.calibration is not None
    assert torch.equal(run.calibration.camera.params, run.camera.params)
    assert 0 < run.calibration.focal_std < 0.005


@pytest.mark.usefixtures("without_shape_checks")
def test_a_camera_without_an_error_stays() -> None:
    """As good as none, or none at all; the configuration, which has an error, does not count."""
    _, made = map_with_error(1e-6)
    assert float(made.run.camera.focal) == pytest.approx(412, rel=1e-5)
    settings = config("camera.std=0.03")
    run = GlobalMapper(WALK, WALK.camera, settings, None).run().run
    assert torch.equal(run.camera.params, WALK.camera.params.double())
    assert (run.given, run.calibration) == (None, None)


def test_some_frames_can_be_posed_and_kept_as_given(mapped: GlobalMap) -> None:
    """Poses of another program: keyframes keep those of the map, frames in between are results as given."""
    mapper = GlobalMapper(WALK, WALK.camera, config(), None)
    pairs = [pair for row, pair in enumerate(mapped.pairs) if row not in mapped.held_back]
    views = [view for each in mapped.views if (view := mapper.view(each.index)) is not None]
    found = mapper.reconstruct(views, pairs)
    assert not isinstance(found, str)
    frames = [0, 1, 2, 3, 6, 9]
    given_cw = true_T_cw(WALK)[frames] @ so3_rigid(0.3)
    by_frame = dict(zip(frames, given_cw, strict=True))
    run = mapper.adjusted(*mapper.posed(views, *found, frames=frames, given_cw=by_frame), keep=True)
    assert [each.index for each in run.results] == frames
    torch.testing.assert_close(
        torch.stack([each.T_cw for each in run.results if each.T_cw is not None]), given_cw
    )
    assert len(run.trajectory) == 6
    assert run.map.num_keyframes == 15
    torch.testing.assert_close(run.map.T_cw, found[2].T_cw[found[0]], atol=0, rtol=0)
    assert (run.given, run.calibration) == (None, None)
    adjusted = mapper.adjusted(*mapper.posed(views, *found, frames=frames))
    assert not torch.equal(adjusted.map.T_cw, found[2].T_cw[found[0]])


# --- from pairs to poses ---------------------------------------------------------------------------------------

SCENE = Recording.of(arc(20, 120.0, 2.5), ball(120), noise_px=0.3, first=0)


def reconstructing() -> GlobalMapper:
    return GlobalMapper(WALK, CAMERA, config("global_mapping.window_images=20"), None)


def rotated(pair: ViewPair, rotvec: Tensor) -> ViewPair:
    """The pair with another rotation."""
    T_21 = pair.T_21.clone()
    T_21[:3, :3] = so3_exp(rotvec) @ T_21[:3, :3]
    return replace(pair, T_21=T_21)


def test_wrong_pairs_do_not_change_the_poses() -> None:
    """A fifth of them, wrong in rotation and matches: they do not fit to the others, and leave with all they say."""
    pairs = SCENE.pairs(1, 2, 3, 5, 8)
    wrong = rand(0, len(pairs)) < 0.2
    given = [rotated(pair, 0.003 * randn(row, 3)) for row, pair in enumerate(pairs)]
    for row in wrong.nonzero()[:, 0].tolist():
        turned = rotated(pairs[row], 0.3 + 0.3 * rand(row, 3))
        given[row] = replace(turned, keypoints_2=turned.keypoints_2.roll(1))
    found = reconstructing().reconstruct(SCENE.views, given)
    assert not isinstance(found, str)
    rows, observed, reconstruction = found
    assert rows.tolist() == list(range(20))
    assert (observed.tracks.count, len(observed.tracks)) == (120, 2400)
    assert bool(reconstruction.agrees.all())
    assert apart(reconstruction.T_cw, SCENE.T_cw)[0] < 3e-3


@pytest.mark.parametrize(("angle", "tracks"), [(0.09, 120), (0.11, 100)])
def test_a_rotation_may_differ_by_a_tenth(angle: float, tracks: int) -> None:
    """Twenty points are matched by two pairs only; without the one whose rotation is off, too few images see them."""
    point = SCENE.shows[:, :]
    few = [rotated(SCENE.pair(0, 6), torch.tensor([0.0, 0, angle], dtype=torch.float64)), SCENE.pair(6, 12)]
    pairs = [
        replace(
            pair,
            keypoints_1=pair.keypoints_1[(point[pair.first][pair.keypoints_1] >= 100) == is_few],
            keypoints_2=pair.keypoints_2[(point[pair.first][pair.keypoints_1] >= 100) == is_few],
        )
        for is_few, part in ((False, SCENE.pairs(1, 2, 3)), (True, few))
        for pair in part
    ]
    found = reconstructing().reconstruct(SCENE.views, pairs)
    assert not isinstance(found, str)
    assert found[1].tracks.count == tracks


def test_the_largest_connected_part_is_mapped() -> None:
    """Its rows are those of the images; matches of the other part are not even tried."""
    pairs = [pair for pair in SCENE.pairs(1, 2, 3) if pair.second < 8 or pair.first >= 8]
    found = reconstructing().reconstruct(SCENE.views, pairs)
    assert not isinstance(found, str)
    rows, observed, reconstruction = found
    assert rows.tolist() == list(range(8, 20))
    assert set(observed.tracks.view.tolist()) == set(range(8, 20))
    assert apart(reconstruction.T_cw[8:], SCENE.T_cw[8:])[0] < 3e-3


@pytest.mark.parametrize(("general", "is_mapped"), [(12, True), (11, False)])
def test_a_fifth_of_the_pairs_must_determine_a_direction(general: int, is_mapped: bool) -> None:
    """Of sixty; others are those of a camera that turns, or of a plane."""
    relations = [Relation.GENERAL] * general + [Relation.ROTATION, Relation.PLANE] * 30
    chosen = [pair for row, pair in enumerate(SCENE.pairs(1, 2, 3, 5, 8)) if row % 4 != 3][:60]
    pairs = [replace(pair, relation=relation) for pair, relation in zip(chosen, relations, strict=False)]
    found = reconstructing().reconstruct(SCENE.views, pairs)
    if is_mapped:
        assert not isinstance(found, str)
    else:
        assert isinstance(found, str)
        assert found.startswith("no map: the camera")
        assert "49 of 60 pairs" in found


def test_images_that_agree_on_no_points_have_no_map() -> None:
    """As those of a camera that only turns, of which the pairs claim a direction."""
    turning = Recording.of(torch.stack([so3_rigid(0.01 * row) for row in range(12)]) @ arc(1)[0], ball(80))
    x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    pairs = turning.pairs(1, 2, 3)
    for pair in pairs:
        pair.T_21[:3, 3] = x
    found = reconstructing().reconstruct(turning.views, pairs)
    assert found == "no map: 12 images agree on no points; the camera may only turn"


def so3_rigid(angle: float) -> Tensor:
    """(4, 4) a turn to the right."""
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = so3_exp(torch.tensor([0, angle, 0], dtype=torch.float64))
    return T


def test_points_of_three_images_are_needed() -> None:
    pairs = [SCENE.pair(0, 1), SCENE.pair(2, 3)]
    assert reconstructing().reconstruct(SCENE.views, pairs) == "no map: no point is seen by 3 of 20 images"
    assert reconstructing().reconstruct(SCENE.views, []) == "no map: no two of 20 images show the same scene"
    three = [
        replace(pair, keypoints_1=pair.keypoints_1[:40], keypoints_2=pair.keypoints_2[:40])
        for pair in (SCENE.pair(0, 3), SCENE.pair(3, 6))
    ]
    found = reconstructing().reconstruct(SCENE.views, three)
    assert not isinstance(found, str)
    assert found[0].tolist() == [0, 3, 6]


# --- no map ----------------------------------------------------------------------------------------------------


def at(*x: float) -> Walk:
    """A camera at these places along a line."""
    T_wc = torch.eye(4, dtype=torch.float64).repeat(len(x), 1, 1)
    T_wc[:, 0, 3] = torch.tensor(x, dtype=torch.float64)
    return Walk(T_wc)


def assert_failed(made: GlobalMap, reason: str, images: int) -> None:
    """A run without a map, whose images are lost for a reason."""
    run = made.run
    assert run.failure == reason
    assert (run.submaps, len(run.trajectory), len(made.views), made.held_back) == ((), 0, images, frozenset())
    assert [each.state for each in run.results] == [State.LOST] * images
    assert {each.reason for each in run.results} <= {reason}
    with pytest.raises(InitializationError, match="no map"):
        _ = run.graph


def test_two_images_are_too_few() -> None:
    assert_failed(map_whole(WALK.part(0, 2)), "no map: 2 images are too few", 2)


@pytest.mark.parametrize("noise", ["0", "0.3"])
@pytest.mark.parametrize("walk", [still(12), turn(12)], ids=["still", "turn"])
def test_without_motion_there_is_no_map(walk: Tensor, noise: str) -> None:
    made = map_whole(Walk(walk), f"simulated.noise_px={noise}")
    assert made.run.failure.startswith("no map: the camera")
    assert_failed(made, made.run.failure, 12)


def test_a_part_that_nothing_ties_to_the_map_is_lost() -> None:
    """The frames there are lost, keyframes or not, and the others are mapped as if these were not."""
    T_wc = torch.cat([walk_arc(20, 2.0), at(*(5000 + 0.1 * torch.arange(6.0)).tolist()).groundtruth.T_wc])  # type: ignore[union-attr]
    walk = Walk(T_wc)
    settings = config("global_mapping.window_images=13")
    # A scene around the walk only, not around the distance between both parts.
    scene = Simulated(settings, walk.camera, se3_inverse(T_wc[:20]))
    made = GlobalMapper(scene.of(walk), walk.camera, settings, None).run()
    # All where they do not overlap.
    assert [view.index for view in made.views] == [*range(0, 20, 2), *range(19, 25)]
    assert len(made.run.trajectory) == 20
    assert made.run.map.num_keyframes == 11
    assert [each.state for each in made.run.results] == [State.TRACKING] * 20 + [State.LOST] * 6
    assert poses_of(made.run, made.views)[1].tolist() == [True] * 11 + [False] * 5
    assert walk.groundtruth is not None
    assert evaluate(made.run.trajectory, walk.groundtruth).ate_m < 2e-3


class Damaged(Walk):
    """Some of the images cannot be read, or are of another size."""

    def __init__(self, T_wc: Tensor, damaged: set[int], other_size: int = -1) -> None:
        super().__init__(T_wc)
        self.damaged, self.other_size = damaged, other_size

    def image(self, index: int) -> Tensor:
        if index in self.damaged:
            raise FrameError(f"pose {index} is damaged")
        if index == self.other_size:
            return torch.zeros(1, 1, 120, 160)
        return super().image(index)


def test_unreadable_frames_are_skipped_and_counted_once() -> None:
    """Frame 4 would be mapped, 7 is in between, 8 has another size: one warning each, and no result."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = map_whole(Damaged(walk_arc(30), {4, 7}, 8))
    size = "pose 8 has 160 x 120 pixels, the camera 320 x 240"
    assert [str(each.message) for each in caught] == [
        "skipped a frame: pose 4 is damaged",
        f"skipped a frame: {size}",
        "skipped a frame: pose 7 is damaged",
    ]
    assert made.run.skipped == ["pose 4 is damaged", size, "pose 7 is damaged"]
    assert [each.index for each in made.run.results] == [
        index for index in range(30) if index not in (4, 7, 8)
    ]
    assert len(made.run.trajectory) == 27
    assert [view.index for view in made.views] == [index for index in range(0, 30, 2) if index not in (4, 8)]


# --- images ----------------------------------------------------------------------------------------------------


def map_room(stop: int) -> GlobalMap:
    """Every fourth frame; every other one of these is mapped."""
    sequence = open_sequence("synthetic:room").part(0, stop, 4)
    settings = load_config(
        None, [f"global_mapping.window_images={stop // 8}", "global_mapping.num_keypoints=600"]
    )
    given = CameraMeasurement.of(sequence.camera.to(torch.float64), settings.camera.std)
    return GlobalMapper(sequence, sequence.camera, settings, given).run()


@pytest.mark.usefixtures("without_shape_checks")
def test_a_rendered_room_is_mapped() -> None:
    """By SIFT; the camera comes out as it is."""
    made = map_room(96)
    run = made.run
    truth = open_sequence("synthetic:room").groundtruth
    assert truth is not None
    assert (run.failure, len(run.trajectory), run.map.num_keyframes) == ("", 24, 12)
    assert run.config.features.kind == "sift"
    assert evaluate(run.trajectory, truth).ate_m < 2e-3
    assert float(run.camera.focal) == pytest.approx(500, rel=5e-3)
    assert sorted(run.graph.frame_ids.tolist()) == list(range(24))
    assert bool((run.map.keyframes["covariances"].diagonal(dim1=-2, dim2=-1)[1:] > 0).all())
    T_cw, known = poses_of(run, made.views)
    assert check_map(T_cw, known, made.views, made.pairs, run.camera, made.held_back).is_right


@pytest.mark.usefixtures("without_shape_checks")
def test_the_same_images_give_the_same_bytes() -> None:
    one, other = (map_room(32).run for _ in range(2))
    assert len(one.trajectory) == 8
    assert torch.equal(one.trajectory.T_wc, other.trajectory.T_wc)
    assert torch.equal(one.map.positions_w, other.map.positions_w)
    assert torch.equal(one.camera.params, other.camera.params)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.usefixtures("without_shape_checks")
def test_a_phone_walk_is_mapped(data_dir: Path) -> None:
    """Quick turns, leaves and weak links: live tracking loses half of it. COLMAP's poses are the truth."""
    sequence = open_sequence(data_dir / "garden")
    settings = Config()
    given = CameraMeasurement.of(sequence.camera.to(torch.float64), settings.camera.std)
    run = GlobalMapper(sequence, sequence.camera, settings, given).run().run
    assert sequence.groundtruth is not None
    assert len(run.trajectory) == 152
    assert evaluate(run.trajectory, sequence.groundtruth).ate_m <= 0.010


# --- what does not hold yet ------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:skipped a frame")
def test_frames_that_bring_features_need_no_image() -> None:
    class WithoutImages(Walk):
        def image(self, index: int) -> Tensor:
            return torch.zeros(1, 1, 0, 0)

    assert map_whole(WithoutImages(walk_arc(30))).run.failure == ""


@pytest.mark.filterwarnings("ignore:skipped a frame")
def test_given_poses_are_those_of_their_frames() -> None:
    """Also after a frame that cannot be read."""
    mapper = GlobalMapper(Damaged(walk_arc(30), {3}), WALK.camera, config(), None)
    made = mapper.run()
    views = [view for each in made.views if (view := mapper.view(each.index)) is not None]
    found = mapper.reconstruct(views, made.pairs)
    assert not isinstance(found, str)
    given_cw = dict(enumerate(true_T_cw(WALK)))
    run = mapper.adjusted(*mapper.posed(views, *found, frames=[2, 3, 4], given_cw=given_cw))
    assert [each.index for each in run.results] == [2, 4]
    torch.testing.assert_close(run.results[1].T_cw, true_T_cw(WALK)[4])


@pytest.mark.parametrize(("doubted", "anew"), [pytest.param(-1, 0, marks=pytest.mark.slow), (20, 2)])
def test_windows_keep_the_poses_of_an_online_run(
    doubted: int, anew: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three windows of fifteen images, two have the doubted frame."""
    settings, begun, begin = config(), list[int](), CoarseMapper.map

    def counted(self: CoarseMapper, views: list[FrameFeatures], *pairs: list[ViewPair]) -> CoarseMap | str:
        begun.append(views[0].index)
        return begin(self, views, *pairs)

    monkeypatch.setattr(CoarseMapper, "map", counted)
    online = OnlineRun(SLAM(WALK.camera, settings), WALK).run()
    certain = set(range(30)) - {doubted}
    results = [result(row, State.TRACKING, is_keyframe=True) for row in range(30)]
    made = GlobalMapper(WALK, WALK.camera, settings, None).run(results, online, certain)
    assert len(begun) == anew
    assert len(made.run.trajectory) == 30
    assert evaluate(made.run.trajectory, WALK.groundtruth).ate_m < 0.01
