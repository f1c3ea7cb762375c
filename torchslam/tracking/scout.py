"""Goes before the map: follows frames by patches of an earlier one, as long as that will do.

It knows the map only by the anchors that it is told of, and of each a fixed number of frames after its own: whatever
else is done meanwhile, and wherever, the results are the same.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor

from torchslam.config import Config
from torchslam.features.patches import RADIUS, Aligned, Patches, Pyramid, align, cut, pyramid
from torchslam.geometry import Camera, fits, se3_inverse, transform
from torchslam.geometry.motion import apart
from torchslam.geometry.robust import Kernel
from torchslam.geometry.whitening import times
from torchslam.optim import RefinedPose, refine_pose
from torchslam.system.front_end import reduced
from torchslam.tracking.match_selection import voices
from torchslam.types import Anchor, Followed, Frame

ATTEMPTS = 2  # a pose from some of the patches leads to the others
LEAST = 20  # patches that a pose needs
NEGLIGIBLE = 1e-4  # share of the cost that a step promises: less moves the pose by hundredths of its noise
LEAST_ERROR = 0.05  # squared, in units of the variance of a keypoint: what the alignment of a patch adds


@dataclass(frozen=True)
class Held:
    """An anchor with its patches.

    unwarp: (n, 2, 2) from displacements in its image to those at the points' depth
    error:  median squared error of its keypoints, in units of their variance
    """

    anchor: Anchor
    patches: Patches
    unwarp: Tensor
    error: float


class Scout:
    """Follows one frame after the other; frames come in the order of their index."""

    def __init__(self, camera: Camera, config: Config) -> None:
        self.camera = camera
        self.settings = config.patches
        self.keyframes = config.keyframes
        self.chi_square = config.measurement.chi_square
        self.reduction = config.features.reduction(camera.size)
        self.forget()

    def forget(self) -> None:
        """Begin anew: there is nothing to follow."""
        self._news: deque[tuple[int, Anchor | None]] = deque()
        self._pyramids: dict[int, Pyramid] = {}  # of the last frames: one may become an anchor
        self._prepared: tuple[int, Pyramid] = (-1, ())
        self._leave()

    def _leave(self) -> None:
        self._held: Held | None = None
        self._poses: dict[int, Tensor] = {}  # T_ca of the last frames, where they are known
        self._found: list[int] = []  # frames since the anchor's that are found by their features

    def learn(self, index: int, anchor: Anchor | None) -> None:
        """A frame was found by its features: what to follow the next ones from, or that they are not to be followed."""
        self._news.append((index, anchor))

    def prepare(self, frame: Frame) -> None:
        """Do what can be done of a frame before its turn, while there is time."""
        self._prepared = frame.index, self._pyramid(frame)

    def _pyramid(self, frame: Frame) -> Pyramid:
        image, _ = reduced(frame.image.to(self.camera.params.device), None, self.reduction)
        return pyramid(image)

    def follow(self, frame: Frame) -> Followed:
        """Where the next frame is, and whether that will do."""
        while self._news and self._news[0][0] < frame.index - self.settings.delay:
            self._go_to(self._news.popleft()[1])
        images = self._pyramid(frame) if self._prepared[0] != frame.index else self._prepared[1]
        self._pyramids[frame.index] = images
        self._pyramids = dict(list(self._pyramids.items())[-(self.settings.delay + 2) :])
        if self._held is None:
            return Followed(-1, "nothing to follow it from")
        if len(self._held.anchor.points_a) < self.settings.min_agreeing:
            self._found.append(frame.index)
            return Followed(self._held.anchor.index, "there is too little to follow it by")
        followed = self._follow(self._held, frame.index, images)
        if followed.T_ca is not None:
            self._poses[frame.index] = followed.T_ca
            kept = {self._held.anchor.index, *self._pyramids, *self._found}
            self._poses = {index: T for index, T in self._poses.items() if index in kept}
        if followed.why_not:
            self._found.append(frame.index)
        return followed

    def _go_to(self, anchor: Anchor | None) -> None:
        """Follow from another anchor, or from none, what was followed so far."""
        if anchor is None or anchor.index not in self._pyramids:
            self._leave()
            return
        J = self.camera.project_with_point_jacobians(anchor.points_a)[2]
        inverse, failed = torch.linalg.inv_ex(J[..., :2])
        unwarp = torch.where((failed == 0)[:, None, None], inverse, 0.0)
        patches = cut(self._pyramids[anchor.index], self._reduced(anchor.pixels))
        errors = anchor.noise.squared_reprojection(anchor.points_a, anchor.pixels, self.camera)
        self._held = Held(anchor, patches, unwarp, float(errors.median()))
        T_ab = self._poses.get(anchor.index)
        eye = torch.eye(4, dtype=anchor.points_a.dtype, device=anchor.points_a.device)
        later = {index: T for index, T in self._poses.items() if index > anchor.index}
        self._poses = {anchor.index: eye}
        if T_ab is not None:
            T_ba = se3_inverse(T_ab)
            self._poses |= {index: T_cb @ T_ba for index, T_cb in later.items()}
        self._found = [index for index in self._found if index > anchor.index]

    def _expected(self, anchor: Anchor) -> Tensor:
        """(4, 4) where the newest frame should be, in the anchor's camera: constant velocity."""
        frames = list(self._pyramids)
        last = max(self._poses)
        row = frames.index(last) if last in frames else -1
        before = self._poses.get(frames[row - 1]) if row > 0 else None
        velocity = anchor.velocity if before is None else self._poses[last] @ se3_inverse(before)
        T_ca = self._poses[last]
        for _ in frames[row + 1 :]:
            T_ca = velocity @ T_ca
        return T_ca

    def _follow(self, held: Held, index: int, images: Pyramid) -> Followed:
        anchor, settings = held.anchor, self.settings
        T_ca = self._expected(anchor)
        for _ in range(ATTEMPTS):
            expected, aligned, pixels = self._align(held, images, T_ca)
            good = expected & aligned.mask[0] & (aligned.similarity[0] >= settings.min_similarity)
            count, least = int(expected.sum()), max(LEAST, settings.min_share * int(expected.sum()))
            if int(good.sum()) < LEAST:
                break
            refined, agrees = self._refine(anchor, T_ca, pixels, good)
            T_ca = refined.T_cw[0]
            if int(agrees.sum()) >= least:
                rows = torch.nonzero(agrees)[:, 0]
                return Followed(
                    anchor=anchor.index,
                    why_not=self._why_not(held, index, T_ca, rows, pixels),
                    T_ca=T_ca,
                    rows=rows,
                    pixels=pixels[rows],
                    expected=count,
                    covariance=refined.covariance[0],
                )
        return Followed(anchor.index, f"of {count} patches {int(good.sum())} were found again")

    def _align(self, held: Held, images: Pyramid, T_ca: Tensor) -> tuple[Tensor, Aligned, Tensor]:
        """(n,) which points should be in the image; where their patches are found from T_ca on; these pixels (n, 2)."""
        projected, valid, J = self.camera.project_with_point_jacobians(transform(T_ca, held.anchor.points_a))
        expected = valid & self.camera.in_image(projected, self.reduction * RADIUS)
        start = self._reduced(torch.where(expected[:, None], projected, 0.0))
        warps = (J @ T_ca[:3, :3])[..., :2] @ held.unwarp
        aligned = align(held.patches, images, start, warps.to(start)[None])
        pixels = (aligned.pixels[0].to(projected) + 0.5) * self.reduction - 0.5
        return expected, aligned, pixels

    def _reduced(self, pixels: Tensor) -> Tensor:
        """Pixels (n, 2) as those of the reduced image, (1, n, 2), in the type of images."""
        return ((pixels + 0.5) / self.reduction - 0.5).float()[None]

    def _refine(
        self, anchor: Anchor, T_ca: Tensor, pixels: Tensor, good: Tensor
    ) -> tuple[RefinedPose, Tensor]:
        """The pose by the good ones (n,) of the pixels (n, 2), and (n,) which of these agree with it.

        By points of age alone if there are enough of them, then by all that agrees with that.
        """
        weights = times(anchor.noise.weights, voices(anchor.pixels, self.camera.size))
        kernels: tuple[Kernel, ...] = ("cauchy", "huber")
        mask = good & anchor.senior
        if int(mask.sum()) < LEAST:
            mask = good
        for kernel in kernels:
            refined = _refine_one(T_ca, anchor.points_a, pixels, self.camera, weights, mask, kernel)
            T_ca = refined.T_cw[0]
            errors = anchor.noise.squared_reprojection(transform(T_ca, anchor.points_a), pixels, self.camera)
            mask = good & fits(errors, self.chi_square) & refined.success
            if int(mask.sum()) < LEAST:
                break
        return refined, mask

    def _why_not(self, held: Held, index: int, T_ca: Tensor, rows: Tensor, pixels: Tensor) -> str:
        """Why a frame with a pose should be found by its features all the same: it may be wrong, or worth keeping."""
        anchor = held.anchor
        points_c = transform(T_ca, anchor.points_a[rows])
        errors = anchor.noise[rows].squared_reprojection(points_c, pixels[rows], self.camera)
        if len(rows) < self.settings.min_agreeing:
            return f"only {len(rows)} patches agree with the pose"
        worse = float(errors.median()) / max(held.error, LEAST_ERROR)
        if worse > self.settings.max_error_growth:
            return f"patches miss the map by {worse**0.5:.1f} times what they did"
        around = [anchor.T_ka] + [self._poses[other][None] for other in self._found if other in self._poses]
        depth = transform(T_ca, anchor.points_a)[:, 2].median()
        moved, turned = apart(T_ca, torch.cat(around), depth)
        if bool(
            ((moved > self.keyframes.max_translation) | (turned > self.keyframes.max_rotation_deg)).all()
        ):
            return "no keyframe is near it"
        last = max([anchor.index, *self._found])
        if index - last > self.settings.max_frames:
            return f"{self.settings.max_frames} frames were followed without features"
        overlap = anchor.overlap * len(rows) / len(anchor.points_a)
        if not self._found and overlap < self.settings.overlap_share * self.keyframes.min_overlap:
            return f"sees {overlap:.0%} of the points of its reference keyframe"
        return ""


def _refine_one(
    T_cw: Tensor,
    points_w: Tensor,
    pixels: Tensor,
    camera: Camera,
    weights: Tensor,
    mask: Tensor,
    kernel: Kernel,
) -> RefinedPose:
    """The pose of one frame (4, 4) by points (n, 3) at pixels (n, 2), as exactly as its noise is worth."""
    return refine_pose(
        T_cw[None],
        points_w[None],
        pixels[None],
        camera,
        weights=weights[None],
        mask=mask[None],
        kernel=kernel,
        scale=2.0,
        backward="detached",
        iterations=10,
        tolerance=NEGLIGIBLE,
    )
