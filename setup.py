"""Only what pyproject.toml cannot say: a wheel carries `configs/` in the package, so that there is but one of each."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

CONFIGS = sorted((Path(__file__).parent / "configs").glob("*.toml"))


class BuildWithConfigs(build_py):
    """Puts them where `torchslam.config` looks; an editable installation reads them where they are."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        folder = self._configs()
        folder.mkdir(parents=True, exist_ok=True)
        for file in CONFIGS:
            shutil.copyfile(file, folder / file.name)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        built = super().get_outputs(include_bytecode)
        return built if self.editable_mode else built + [str(self._configs() / file.name) for file in CONFIGS]

    def _configs(self) -> Path:
        return Path(self.build_lib) / "torchslam" / "configs"


setup(cmdclass={"build_py": BuildWithConfigs})
