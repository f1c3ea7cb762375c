"""Error message for a required library that was deliberately not installed."""

from __future__ import annotations

OPENCV = (
    "OpenCV is not installed (module cv2): pip install opencv-python-headless, or opencv-python where something else "
    "needs its windows; either will do, but not both, as each writes over the other's files"
)


def explained(error: ModuleNotFoundError) -> ModuleNotFoundError:
    """The error with what to do about it, where OpenCV is missing; any other as it is."""
    return ModuleNotFoundError(OPENCV, name="cv2") if error.name == "cv2" else error
