"""The configurations that come with torchslam, by name: the files of `configs/`.

A wheel carries them in the package (`setup.py`); in a checkout there is only the one folder beside it.
"""

from __future__ import annotations

from pathlib import Path

from torchslam.errors import ConfigError

HERE = Path(__file__).parents[1]
INSTALLED, CHECKOUT = HERE / "configs", HERE.parent / "configs"
FOLDER = INSTALLED if INSTALLED.is_dir() else CHECKOUT


def names() -> list[str]:
    """What `--config` takes beside files."""
    return sorted(file.stem for file in FOLDER.glob("*.toml"))


def find(file: str | Path) -> Path:
    """The file of a configuration; a word without a folder and an ending may be a name, and a name comes first.

    Raises ConfigError for a word that is neither a name nor a file.
    """
    if not isinstance(file, str) or not file or Path(file).suffix or Path(file).name != file:
        return Path(file)
    if file in names():
        return FOLDER / f"{file}.toml"
    if not Path(file).exists():
        raise ConfigError(
            f"configuration file {file} does not exist, nor a configuration of that name; "
            f"there are {', '.join(names())}"
        )
    return Path(file)
