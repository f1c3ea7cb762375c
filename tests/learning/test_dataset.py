"""Clips of a data set: enough parallax, the same for the same seed, in batches with a camera each."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from tests.learning.test_clip_slam import FRAMES, BentExtractor
from tests.walks import T_cw as true_T_cw
from tests.walks import Walk, arc, still, turn
from torchslam import ORB, Camera, ClipSLAM, Features, open_sequence
from torchslam.data.sequence import Sequence, Transformed
from torchslam.errors import ClipError, SequenceError
from torchslam.features import SimulatedFeatures
from torchslam.geometry import rigid, se3_inverse, so3_exp
from torchslam.learning import dataset
from torchslam.learning.dataset import (
    Batches,
    Clip,
    Clips,
    GraphCache,
    clips_with_a_map,
    collate,
    count_reasons,
    frames_in,
    parallax,
    stack_cameras,
)

RADIAL = Camera.radial_tangential(400.0, 400.0, 159.5, 119.5, 0.1, 0.0, 0.0, 0.0, size=(320, 240))
FISHEYE = Camera.fisheye(400.0, 400.0, 159.5, 119.5, 0.1, 0.0, 0.0, 0.0, size=(320, 240))


class WalkWithTruth(Walk):
    """A walk whose images say, in their first pixel, which frame they are; its true poses may be withheld."""

    def __init__(self, T_wc: Tensor, has_truth: bool = True) -> None:
        super().__init__(T_wc)
        self.has_truth = has_truth

    def image(self, index: int) -> Tensor:
        image = torch.zeros(1, 1, 240, 320)
        image[..., 0, 0] = index
        return image

    def pose(self, index: int) -> Tensor | None:
        return super().pose(index) if self.has_truth else None


class Knowing(nn.Module):
    """A feature extractor that reads the frame off the image and knows what is seen there."""

    walk: Walk

    def __init__(self, _: int = 0) -> None:
        super().__init__()
        self.scene = SimulatedFeatures(
            true_T_cw(self.walk), self.walk.camera, num_keypoints=300, points_per_view=150,
            depth_near=2.0, depth_far=4.0, noise_px=0.2,
        )  # fmt: skip

    def forward(self, image: Tensor) -> Features:
        index = int(image[0, 0, 0, 0])
        return self.scene(true_T_cw(self.walk)[index], index)


def chosen(
    monkeypatch: pytest.MonkeyPatch, walk: Walk, has_truth: bool = True, **options: object
) -> list[tuple[int, int, int]]:
    monkeypatch.setattr(dataset, "ORB", type("Eyes", (Knowing,), {"walk": walk}))
    walk_with_truth = WalkWithTruth(se3_inverse(true_T_cw(walk)), has_truth)
    return Clips([walk_with_truth], **options).chosen  # type: ignore[arg-type]


def simulated(poses: Tensor, near: float = 50.0, far: float = 70.0) -> Features:
    camera = Walk(still(2)).camera
    # Depths are in units of half the way.
    scene = SimulatedFeatures(
        poses, camera, num_keypoints=300, points_per_view=300, depth_near=near, depth_far=far, noise_px=0.0
    )
    frames = [scene(pose, index) for index, pose in enumerate(poses)]
    return Features.cat(frames)


@pytest.mark.parametrize("depths", [(50.0, 70.0), (30.0, 90.0)])
def test_parallax_is_the_angle_at_the_points(depths: tuple[float, float]) -> None:
    """A step of 0.1 before points at a depth z is an angle of about 0.1 / z, however the camera turns."""
    R = so3_exp(torch.tensor([0.0, 0.05, 0.02]).double())
    centers = torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]).double()
    T_cw = se3_inverse(rigid(torch.stack([torch.eye(3).double(), R]), centers))
    features, camera = simulated(T_cw, *depths), Walk(still(2)).camera
    found = parallax(features[:1], features[1:], camera, T_cw[1, :3, :3] @ T_cw[0, :3, :3].mT)
    assert found == pytest.approx(0.1 / math.sqrt(0.05**2 * depths[0] * depths[1]), rel=0.1)
    if depths[1] > 2 * depths[0]:  # a scene that is no plane tells the rotation itself
        assert parallax(features[:1], features[1:], camera) == pytest.approx(found, rel=0.05)


def test_frames_with_little_overlap_have_no_parallax() -> None:
    features = simulated(true_T_cw(Walk(arc(2, length=0.2))))
    few = replace(features, mask=features.mask & (torch.arange(300) < 40))
    assert parallax(few[:1], few[1:], Walk(still(2)).camera) == 0


def test_strides_grow_until_there_is_parallax(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three units in 120 frames before points at 3 to 6: seven steps of 1 are about 0.04 radians, of 2 twice that."""
    walk = Walk(arc(120, length=3.0))
    for least, stride in ((0.02, 1), (0.055, 2), (0.11, 4)):
        rows = chosen(monkeypatch, walk, per_sequence=6, min_parallax=least)
        assert [row[2] for row in rows] == [stride] * 6, least
        assert all(start + 7 * stride < 120 for _, start, _ in rows)
        assert [row[1] for row in rows] == sorted({row[1] for row in rows})
    assert chosen(monkeypatch, walk, per_sequence=6, min_parallax=0.08, max_stride=1) == []


@pytest.mark.parametrize("has_truth", [True, False])
def test_a_static_or_rotating_camera_gives_no_clips(monkeypatch: pytest.MonkeyPatch, has_truth: bool) -> None:
    for poses in (still(12), turn(12, math.radians(10))):
        assert chosen(monkeypatch, Walk(poses), has_truth, frames=4, supervised=False) == []


def test_supervision_needs_ground_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Walk(arc(40, length=2.0))
    options = {"frames": 4, "per_sequence": 3}
    assert chosen(monkeypatch, walk, has_truth=False, **options) == []
    assert len(chosen(monkeypatch, walk, has_truth=False, supervised=False, **options)) == 3


def test_the_same_seed_gives_the_same_clips(monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Walk(arc(60, length=3.0))
    first, again, other = (
        chosen(monkeypatch, walk, frames=4, per_sequence=5, seed=seed) for seed in (0, 0, 1)
    )
    assert first == again
    assert first != other


def test_a_clip_has_its_listed_frames() -> None:
    walk = WalkWithTruth(arc(20))
    clip = Clip.of(walk, 2, frames=5, stride=3, number=7)
    assert clip.images.shape == (5, 1, 240, 320)
    assert clip.images[:, 0, 0, 0].tolist() == [2, 5, 8, 11, 14]
    assert torch.equal(clip.T_cw, true_T_cw(walk)[2:15:3])
    assert clip.known.all()
    assert int(clip.number) == 7
    with pytest.raises(SequenceError, match="5 frames from 10, 3 apart, exceed its 20 frames"):
        Clip.of(walk, 10, frames=5, stride=3)
    assert int(Clip.of(walk, 7, frames=5, stride=3).images[-1, 0, 0, 0]) == 19
    blind = Clip.of(WalkWithTruth(arc(20), has_truth=False), 2, frames=5, stride=3)
    assert not blind.known.any()
    assert torch.equal(blind.T_cw, torch.eye(4, dtype=torch.float64).expand(5, 4, 4))
    with pytest.raises(SequenceError, match="the clip from 2 on has no true pose"):
        Clip.of(WalkWithTruth(arc(20), has_truth=False), 2, frames=5, stride=3, supervised=True)


def test_a_time_span_has_at_least_one_frame() -> None:
    assert [frames_in(seconds, Walk(arc(4))) for seconds in (0.01, 0.1, 0.34)] == [1, 1, 3]  # at 10 Hz


def test_images_move_to_the_device_and_geometry_stays(device: torch.device) -> None:
    clip = Clip.of(Walk(arc(4)), 0, frames=2, stride=1).to(device)
    assert clip.images.device.type == device.type
    assert clip.T_cw.device.type == clip.camera.params.device.type == "cpu"


def test_a_batch_has_a_camera_for_each_clip() -> None:
    walks: list[Sequence] = [Walk(arc(12)), Walk(arc(12, length=1.0)).with_camera(RADIAL)]
    batch = collate([Clip.of(walk, 0, frames=4, stride=2, number=row) for row, walk in enumerate(walks)])
    assert batch.images.shape == (2, 4, 1, 240, 320)
    assert batch.T_cw.shape == (2, 4, 4, 4)
    assert batch.number.tolist() == [0, 1]
    assert batch.camera.model == "radial_tangential"
    torch.testing.assert_close(batch.camera.params[1], RADIAL.params)
    points = torch.tensor([[0.3, -0.2, 2.0]]).double()
    for row, walk in enumerate(walks):
        alone, _ = walk.camera.project(points)
        torch.testing.assert_close(batch.camera.project(points.expand(2, 1, 3))[0][row], alone)
    with pytest.raises(ValueError, match=r"one model.*fisheye.*pinhole"):
        stack_cameras([walks[0].camera, FISHEYE])
    with pytest.raises(ValueError, match="same number and size"):
        collate([Clip.of(walks[0], 0, frames=frames, stride=2) for frames in (3, 4)])


def test_batches_contain_every_clip_once_per_epoch_and_can_be_resumed() -> None:
    def rows(first: int, count: int, **options: int) -> list[list[int]]:
        return list(itertools.islice(Batches(7, 3, first=first, **options), count))

    whole = rows(0, 14)
    order = list(itertools.chain(*whole))
    assert all(sorted(order[7 * epoch : 7 * epoch + 7]) == list(range(7)) for epoch in range(6))
    assert order[:7] != order[7:14]
    assert rows(5, 9) == whole[5:]
    assert rows(0, 14, seed=1) != whole
    shares = [rows(0, 7, rank=rank, ranks=2) for rank in range(2)]
    assert [row for pair in zip(*shares, strict=True) for row in pair] == whole
    with pytest.raises(ValueError, match="batch size 3, 0 clips"):
        Batches(0, 3)


def test_clips_work_with_a_data_loader(monkeypatch: pytest.MonkeyPatch) -> None:
    walk = Walk(arc(40, length=2.0))
    monkeypatch.setattr(dataset, "ORB", type("Eyes", (Knowing,), {"walk": walk}))
    clips = Clips([WalkWithTruth(se3_inverse(true_T_cw(walk)))], frames=4, per_sequence=3)
    batches = Batches(len(clips), 2)
    loader = DataLoader(clips, batch_sampler=batches, collate_fn=collate)
    for batch, rows in itertools.islice(zip(loader, batches, strict=False), 3):
        assert batch.number.tolist() == rows
        assert batch.images[:, 0, 0, 0, 0].tolist() == [clips.chosen[row][1] for row in rows]


def test_clip_graphs_are_computed_once() -> None:
    walk = Walk(arc(FRAMES, length=1.0))
    extractor = BentExtractor(walk, bend=0.01)
    clip_slam = ClipSLAM(extractor)
    looking = GraphCache(clip_slam)
    with torch.no_grad():
        extractor.bend.fill_(0.02)
    batch = collate([Clip.of(walk, 0, FRAMES, 1, number) for number in (3, 5)])
    graphs = looking(batch)
    before = ClipSLAM(BentExtractor(walk, bend=0.01)).build_graph(batch.images[0], walk.camera)
    for run in graphs.runs:
        assert run is not None
        assert before.runs[0] is not None
        assert torch.equal(run.pixels, before.runs[0].pixels)
    focal = walk.camera.with_params(1.01 * walk.camera.params)
    mixed = looking(
        collate([Clip.of(walk, 0, FRAMES, 1, 3), Clip.of(walk.with_camera(focal), 0, FRAMES, 1, 4)])
    )
    assert torch.equal(mixed.cameras[1].params, focal.params)
    again = looking(collate([Clip.of(walk, 0, FRAMES, 1, 5)]))
    assert again.runs[0] is graphs.runs[1]
    assert torch.equal(clip_slam(batch.images, batch.camera, graphs).posed, torch.ones(2, FRAMES).bool())


def test_reasons_that_differ_in_numbers_are_counted_together() -> None:
    few = [f"too little parallax: {count} points have enough, 60 are needed" for count in (4, 57)]
    planar = "the scene looks planar: a homography explains the matches"
    assert count_reasons((*few, "", planar)) == {"too little parallax": 2, planar: 1}


class StillRoom(Transformed):
    """One frame again and again."""

    def image(self, index: int) -> Tensor:
        return super().image(0)


def test_clips_without_a_map_are_left_out_with_the_reason() -> None:
    room = open_sequence("synthetic:room", resize_to="320x240", stride=3, limit=10)
    clips = Clips([room], frames=5, per_sequence=1)
    clips.sequences.append(StillRoom(room))
    clips.chosen.append((1, 0, 1))

    usable, left_out = clips_with_a_map(clips, GraphCache(ClipSLAM(ORB(400))))
    assert list(usable.indices) == [0]
    ((reason, count),) = left_out.items()
    assert (count, "no map was initialized" in reason) == (1, True)

    clips.chosen = clips.chosen[1:]
    with pytest.raises(ClipError, match=r"none of 1 clips .* larger min_parallax.* no map was initialized"):
        clips_with_a_map(clips, GraphCache(ClipSLAM(ORB(400))))
    with pytest.raises(ClipError, match=r"no clips: .*supervised=False"):
        clips_with_a_map(Clips([room.part(stop=1)]), GraphCache(ClipSLAM(ORB(400))))
