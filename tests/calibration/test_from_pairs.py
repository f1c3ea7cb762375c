"""The focal length by pairs of images whose pixels are not square."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from torchslam.calibration import find_camera
from torchslam.calibration.find_camera import _fundamental, _solve
from torchslam.config import Config
from torchslam.data.transforms import scale_camera
from torchslam.geometry import Camera, rigid, so3_exp


@pytest.mark.parametrize("size", [(640, 480), (480, 480), (640, 360)])
def test_the_given_ratio_of_the_focal_lengths_is_kept(
    size: tuple[int, int], generator: torch.Generator
) -> None:
    true = scale_camera(Camera.pinhole(500.0, 500.0, 319.5, 239.5, size=(640, 480)), size)
    points_w = torch.rand(200, 3, generator=generator, dtype=torch.float64) * 4 + torch.tensor([-2.0, -2, 3])
    pairs = []
    for _ in range(8):
        turn, move = torch.randn(2, 3, generator=generator, dtype=torch.float64) * torch.tensor(
            [[0.1], [0.5]]
        )
        T_21 = rigid(so3_exp(turn), move)
        pixels_1, pixels_2 = (
            true.project(points)[0] + 0.1 * torch.randn(200, 2, generator=generator, dtype=torch.float64)
            for points in (points_w, points_w @ T_21[:3, :3].mT + T_21[:3, 3])
        )
        cross = torch.linalg.cross(move.expand(3, 3), T_21[:3, :3].mT).mT
        inverse = torch.linalg.inv(true.K)
        pairs.append((inverse.mT @ cross @ inverse, pixels_1.float(), pixels_2.float()))
    guess = true.with_params(torch.cat([1.3 * true.params[:2], true.params[2:]]))
    found = _solve(pairs, guess, 1.0)
    assert bool(found.success)
    assert float(found.focal) == pytest.approx(float(true.fx), rel=0.01)


# Of two images of the rendered room, rounded: OpenCV 5.0 raises its assertion `!model.empty()`.
NO_MODEL = """
403 314 409 310 254 110 254 102 126 427 124 430 230 248 231 245 133 392 131 394 365 436 370 436 72 398 71 399 334 91
337 82 144 184 144 180 225 447 225 451 463 152 471 142 149 139 148 134 98 260 97 258 358 249 362 244 218 232 218 228
44 68 37 62 232 397 232 400 444 298 452 294 383 235 388 229 452 409 460 408 296 374 298 375 259 243 260 239 200 221
200 218 55 23 48 15 256 74 257 66 141 115 154 31 366 95 370 84 437 150 444 141 392 151 398 143 168 264 168 261 192 222
192 219 353 405 358 404 450 368 458 365 363 86 367 75 111 218 109 215 298 171 213 117 268 164 269 158 276 42 277 33
251 465 251 471 186 62 185 55 217 468 216 474 153 166 152 162 201 14 199 4 431 347 438 345 168 339 166 339 149 285 149
283 327 460 330 462 446 291 454 286 439 67 447 53 456 313 464 309 207 137 206 132 304 250 306 245 387 55 391 42 192
217 192 214 234 388 234 391 149 312 150 310 281 207 283 202 10 372 5 375 439 107 447 95 263 170 264 164 405 427 411
427 150 45 148 38 361 48 365 34 336 51 338 40 182 272 182 270 389 335 395 332 364 79 368 68 191 306 189 305 122 284
121 282 250 80 251 72 456 242 464 236 80 381 79 382 277 232 279 228 216 319 215 318 396 253 402 247 95 253 93 251 128
341 126 342 62 152 58 149 377 338 382 336 312 166 314 160 127 436 125 440 436 75 444 61 160 340 158 340 369 225 374
219 78 430 77 432 429 104 436 92 407 264 413 260 392 209 398 203 135 249 134 247 131 424 129 427 437 220 445 213 270
285 272 282 447 239 455 232 189 208 189 204 392 151 398 143 220 436 219 441 214 442 213 447 320 177 323 171 26 99 19
94 211 47 210 38
"""


def test_matches_without_a_matrix_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    matches = torch.tensor(list(map(float, NO_MODEL.split()))).view(-1, 4)
    one, other = (SimpleNamespace(keypoints=matches[:, side]) for side in (slice(0, 2), slice(2, 4)))
    every = torch.arange(len(matches))
    monkeypatch.setattr(find_camera, "match_views", lambda *_: (every, every))
    assert _fundamental(one, other, Config(), 1.0) is None

    def raises(*arguments: np.ndarray) -> None:
        raise cv2.error("no model")

    monkeypatch.setattr(cv2, "findFundamentalMat", raises)
    assert _fundamental(one, other, Config(), 1.0) is None
