"""The errors that torchslam raises. A message states what is wrong, where, and what to do."""

from torchslam.utils.console import printable, without_credentials

LONGEST = 2000
"""Largest number of characters of a message; what it quotes from a file may be of any length."""


class TorchslamError(Exception):
    """Base of every error that torchslam raises.

    Its text is one printable line: control characters are escaped, and a long message is shortened in the middle. The
    credentials of addresses are left out.
    """

    def __str__(self) -> str:
        return _shortened(printable(_shortened(without_credentials(super().__str__()))))


def _shortened(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} [...] {text[-LONGEST // 2 :]}"


class ConfigError(TorchslamError):
    """A configuration file or a `--set` value is unknown, of the wrong type or out of range."""


class SequenceError(TorchslamError):
    """A sequence as a whole cannot be read: missing lists, doubled timestamps, no images."""


class CalibrationError(SequenceError):
    """A camera calibration is missing or wrong: NaN, negative focal length, too few numbers."""


class FrameError(TorchslamError):
    """One image of a sequence cannot be read or has another size. A run skips the frame and counts it."""


class TrajectoryError(TorchslamError):
    """A trajectory file or object is malformed, or two of them have nothing in common."""


class MeasurementError(TorchslamError):
    """A measurement from outside of the images, or a file of them, is malformed or cannot be right."""


class ResultsError(TorchslamError):
    """A results folder or a map file is missing, incomplete or not written by torchslam."""


class DownloadError(TorchslamError):
    """A download or an archive is incomplete, unsafe or not what it should be."""


class InitializationError(TorchslamError):
    """No map could be initialized; the message has the reason (standstill, pure rotation, too few matches)."""


class ConvergenceError(TorchslamError):
    """A least-squares problem that was solved with `strict=True` has no minimum, or the search for it did not end."""


class ConvergenceWarning(UserWarning):
    """A gradient passes a solution that is not at a minimum. With `strict=True` a `ConvergenceError` comes before."""


class ClipError(TorchslamError):
    """A clip to learn from has no poses to compare."""
