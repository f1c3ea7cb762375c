"""Patches of one image found again in another: inverse-compositional alignment with gain and offset, batched.

Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004. Letters in shapes: B images, N patches, P pixels of a patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

RADIUS = 4  # pixels of a level from the middle of a patch to its edge
LEVELS = 3  # the coarsest patch covers four times as many pixels in width and height as the finest
ITERATIONS = 3  # on each level; the coarser ones leave less than a pixel to the finest
LEAST_CONTRAST = 1 / 255  # standard deviation of a patch: less is what the camera's steps of grey make
CONVERGED = 0.5  # pixels: the last of them that moves a patch by less has found it

Pyramid = tuple[Tensor, ...]


def pyramid(images: Tensor, levels: int = LEVELS) -> Pyramid:
    """Images (B, 1, H, W), and each of the other levels half as wide and high as the one before."""
    found = [images]
    for _ in range(levels - 1):
        found.append(F.avg_pool2d(found[-1], 2))
    return tuple(found)


@dataclass(frozen=True)
class Patches:
    """What is looked for: around pixels of an image, on every level.

    pixels:    (B, N, 2) in the image
    filters:   per level (B, N, 3, P): what says of the pixels of another patch by how much it is displaced, in x and
               in y, times its gain, and its gain
    template:  (B, N, P) of the finest level, of zero mean and unit length
    mask:      (B, N) bool, False where there is not texture enough to tell a displacement, or no image
    """

    pixels: Tensor
    filters: tuple[Tensor, ...]
    template: Tensor
    mask: Tensor


@dataclass(frozen=True)
class Aligned:
    """Where patches are in another image.

    pixels:     (B, N, 2), the start where `mask` is False
    similarity: (B, N) normalised cross-correlation with the template, 1 where they are the same
    mask:       (B, N) bool, True where the alignment has converged within the image
    """

    pixels: Tensor
    similarity: Tensor
    mask: Tensor


def offsets(radius: int, like: Tensor) -> Tensor:
    """(P, 2) the pixels of a patch around its middle, row by row."""
    steps = torch.arange(-radius, radius + 1, dtype=like.dtype, device=like.device)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=-1)


def sample(image: Tensor, pixels: Tensor) -> Tensor:
    """(B, N, P) an image (B, 1, H, W) at pixels (B, N, P, 2), between them bilinear, beyond its edge the edge's."""
    height, width = image.shape[-2:]
    size = pixels.new_tensor([width, height])
    return F.grid_sample(
        image, (2 * pixels + 1) / size - 1, mode="bilinear", padding_mode="border", align_corners=False
    )[:, 0]


def at_level(pixels: Tensor, level: int) -> Tensor:
    """Pixels of the image in those of a level: (0, 0) is the middle of the first pixel on both."""
    return (pixels + 0.5) / 2**level - 0.5


def cut(images: Pyramid, pixels: Tensor) -> Patches:
    """Patches around pixels (B, N, 2) of images."""
    around = offsets(RADIUS + 1, pixels)
    side = 2 * RADIUS + 3
    filters, usable = [], inside(pixels, images[0], RADIUS + 1)
    template = pixels
    for level, image in enumerate(images):
        large = sample(image, at_level(pixels, level)[:, :, None] + around)
        large = large.unflatten(-1, (side, side))
        middle = large[..., 1:-1, 1:-1].flatten(-2)
        basis = torch.stack(
            [
                (large[..., 1:-1, 2:] - large[..., 1:-1, :-2]).flatten(-2) / 2,
                (large[..., 2:, 1:-1] - large[..., :-2, 1:-1]).flatten(-2) / 2,
                middle,
            ],
            dim=-2,
        )
        basis = basis - basis.mean(-1, keepdim=True)
        is_flat = basis[..., 2, :].square().mean(-1) < LEAST_CONTRAST**2
        basis = torch.where(is_flat[..., None, None], 0.0, basis)
        normal = basis @ basis.mT
        unsolvable = torch.linalg.inv_ex(normal.detach()).info != 0
        eye = torch.eye(3, dtype=normal.dtype, device=normal.device)
        normal = torch.where(unsolvable[..., None, None], eye, normal)
        filters.append(torch.linalg.solve(normal, basis))
        if level == 0:
            template = F.normalize(basis[..., 2, :], dim=-1)
            usable = usable & ~unsolvable
    return Patches(pixels, tuple(filters), template, usable)


def align(
    patches: Patches, images: Pyramid, start: Tensor, warps: Tensor, iterations: int = ITERATIONS
) -> Aligned:
    """Find patches in other images, from a start (B, N, 2).

    warps: (B, N, 2, 2) from displacements in the image of the patches to displacements in these

    Where an alignment has converged, its pixels have the gradient of the place where the displacement is zero, with
    respect to both images; elsewhere none.
    """
    around = offsets(RADIUS, start) @ warps.mT
    with torch.no_grad():
        pixels, last = _descend(patches, images, start, warps, around, iterations)
        mask = patches.mask & inside(pixels, images[0], RADIUS) & (last < CONVERGED)
    if torch.is_grad_enabled() and (images[0].requires_grad or patches.template.requires_grad):
        pixels = _attached(patches, images[0], pixels, around, mask)
    found = sample(images[0], pixels[:, :, None] + around)
    found = F.normalize(found - found.mean(-1, keepdim=True), dim=-1)
    similarity = (found * patches.template).sum(-1)
    return Aligned(torch.where(mask[..., None], pixels, start), similarity, mask)


def _descend(
    patches: Patches, images: Pyramid, start: Tensor, warps: Tensor, around: Tensor, iterations: int
) -> tuple[Tensor, Tensor]:
    """(B, N, 2) where patches are in images, from the coarsest level to the finest; (B, N) size of the last step."""
    pixels, step = start, torch.zeros_like(start)
    for level in range(len(images) - 1, -1, -1):
        at = at_level(pixels, level)
        for _ in range(iterations):
            found = sample(images[level], at[:, :, None] + around)
            measured = (patches.filters[level] @ found[..., None])[..., 0]
            step = (measured[..., :2] / measured[..., 2:]).nan_to_num().clamp(-RADIUS, RADIUS)
            at = at - (warps @ step[..., None])[..., 0]
        pixels = (at + 0.5) * 2**level - 0.5
    return pixels, step.abs().amax(-1)


def _attached(patches: Patches, image: Tensor, pixels: Tensor, around: Tensor, mask: Tensor) -> Tensor:
    """The same pixels with the gradient of where the displacement that is measured is zero (implicit function)."""
    finest = patches.filters[0][..., :2, :]
    with torch.enable_grad():
        moved = pixels.detach().requires_grad_()
        there = sample(image.detach(), moved[:, :, None] + around)
        measured = (finest.detach() @ there[..., None])[..., 0]
        rows = [torch.autograd.grad(measured[..., k].sum(), moved, retain_graph=True)[0] for k in range(2)]
    inverse, failed = torch.linalg.inv_ex(torch.stack(rows, dim=-2))
    inverse = torch.where((mask & (failed == 0))[..., None, None], inverse, 0.0)
    measured = (finest @ sample(image, pixels.detach()[:, :, None] + around)[..., None])[..., 0]
    step = (inverse @ measured[..., None])[..., 0]
    return pixels - (step - step.detach())


def inside(pixels: Tensor, image: Tensor, margin: float) -> Tensor:
    """Which of the pixels (..., 2) are finite and that far inside an image."""
    height, width = image.shape[-2:]
    x, y = pixels.unbind(-1)
    return (x >= margin) & (x <= width - 1 - margin) & (y >= margin) & (y <= height - 1 - margin)
