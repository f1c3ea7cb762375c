"""Where no features are wanted: the car's bonnet, a logo, people; a picture for all frames, or one for each."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from torchslam.data.calibration import size_text
from torchslam.data.formats.frame_names import natural
from torchslam.data.formats.image_file import SUFFIXES, read_gray
from torchslam.data.sequence import Sequence, Transformed
from torchslam.errors import FrameError, SequenceError


class Masked(Transformed):
    """A sequence with masks: black is left out, everything else may have features.

    path: an image of the frames' size for all of them, or a folder with one per frame, by its name (`7.png`, or
          `7.jpg.png` for `7.jpg`) or, where there are as many as frames, by their order; a frame without is used whole

    Raises SequenceError where there is no mask, or one of another size.
    """

    def __init__(self, whole: Sequence, path: str | Path) -> None:
        path = Path(path)
        self._mask: Tensor | None = None
        self._files: dict[int, Path] = {}
        if path.is_dir():
            self._files = _by_frame(path, whole)
            with_mask = len(self._files)
            notes = [f"masks for {with_mask} of {len(whole)} frames"] if with_mask < len(whole) else []
            super().__init__(whole, notes=notes)
            self._read(next(iter(self._files.values())))
        else:
            super().__init__(whole)
            self._mask = self._read(path)

    def mask(self, index: int) -> Tensor | None:
        """Raises FrameError for a mask of this frame that cannot be read."""
        if index not in self._files:
            return self._mask
        try:
            return self._read(self._files[index])
        except SequenceError as error:
            raise FrameError(str(error)) from error

    def _read(self, path: Path) -> Tensor:
        try:
            gray = read_gray(path, "--mask")
        except FrameError as error:
            raise SequenceError(str(error)) from error
        size = (gray.shape[-1], gray.shape[-2])
        if size != self.size:
            raise SequenceError(
                f"{path}: the mask is {size_text(size)}, the images are {size_text(self.size)}"
            )
        return gray > 0


def _by_frame(folder: Path, sequence: Sequence) -> dict[int, Path]:
    """Which file is the mask of which frame."""
    if sequence.known_length is None:
        raise SequenceError(f"{folder}: a live source takes one mask for all frames")
    files = sorted(
        (
            file
            for file in folder.iterdir()
            if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
        ),
        key=lambda file: natural(file.name),
    )
    by_name = {file.stem: file for file in files}
    names = [Path(sequence.image_name(index)) for index in range(len(sequence))]
    found = {
        index: by_name.get(name.name, by_name.get(name.stem))
        for index, name in enumerate(names)
        if name.name in by_name or name.stem in by_name
    }
    if not found and len(files) == len(sequence):
        return dict(enumerate(files))
    if not found:
        raise SequenceError(f"{folder}: none of its {len(files)} images is the mask of a frame by its name")
    return {index: file for index, file in found.items() if file is not None}
