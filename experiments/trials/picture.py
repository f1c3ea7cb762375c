"""What the faults do to an image, shown on a rendered room: writes faults.png."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from experiments.trials.edited import fitted
from experiments.trials.faults import FAULTS
from torchslam.data import open_sequence

FRAME = 50
COLUMNS = 4
SIZE = (240, 180)
LEFT_OUT = ("kidnap", "drop3", "halfres")  # they leave images as they are, or only smaller
BAR = 24  # pixels under an image, for its name
GREYS = 16  # levels that are told apart: with all 256 the noise alone would fill the file


def main() -> None:
    whole, other = open_sequence("synthetic:room"), open_sequence("synthetic:planar")
    tiles = []
    for name, fault in FAULTS.items():
        if name in LEFT_OUT:
            continue
        grey = np.rint(255 * fault(whole, other).image(FRAME)[0, 0].numpy()).astype(np.uint8)
        tile = np.full((SIZE[1] + BAR, SIZE[0]), 255, np.uint8)
        tile[: SIZE[1]] = fitted(grey, SIZE)
        cv2.putText(tile, name, (6, SIZE[1] + 17), cv2.FONT_HERSHEY_SIMPLEX, 0.55, 0, 1, cv2.LINE_AA)
        tiles.append(tile)
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[start : start + COLUMNS]) for start in range(0, len(tiles), COLUMNS)]
    step = 255 / (GREYS - 1)
    picture = np.rint(np.rint(np.vstack(rows) / step) * step).astype(np.uint8)
    cv2.imwrite(str(Path(__file__).parent / "faults.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
