"""The camera that was found, as a calibration file that every command reads again."""

from __future__ import annotations

from pathlib import Path

from torchslam.errors import ResultsError
from torchslam.geometry import Camera
from torchslam.utils.atomic_write import write_whole

HEADER = "# torchslam: a camera found by the images"
NAMES = {
    "pinhole": "fx fy cx cy",
    "radial_tangential": "fx fy cx cy k1 k2 p1 p2 k3",
    "fisheye": "fx fy cx cy k1 k2 k3 k4",
}


def is_found(path: Path) -> bool:
    """Whether there is a file that `write_calibration` wrote."""
    return path.exists() and path.read_text(encoding="utf-8", errors="replace").startswith(HEADER)


def check_replaceable(path: Path) -> None:
    """Raises ResultsError where a file is in the way that `write_calibration` did not write."""
    if path.exists() and not is_found(path):
        raise ResultsError(f"{path}: a calibration that is not of an earlier run: it is not replaced")


def write_calibration(path: Path, camera: Camera, remarks: list[str]) -> None:
    """Write the camera below its remarks."""
    model = "" if camera.model != "fisheye" else "fisheye "
    numbers = " ".join(f"{number:.9g}" for number in camera.params.tolist())
    lines = [HEADER, *(f"# {remark}" for remark in remarks), f"# {NAMES[camera.model]}", model + numbers]
    write_whole(path, ("\n".join(lines) + "\n").encode())
