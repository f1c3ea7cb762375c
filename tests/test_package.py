"""The wheel and what is in it: everything, once, and usable outside of the repository."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import torchslam
from torchslam import config
from torchslam.cli.main import main
from torchslam.utils.console import OPENCV

ROOT = Path(__file__).parents[1]
SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "configs", "torchslam")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy of the sources by the setuptools that are here, without a network."""
    pytest.importorskip("setuptools", minversion="77")
    sources, out = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("dist")
    for name in SOURCES:
        path = ROOT / name
        copy = shutil.copytree if path.is_dir() else shutil.copy
        copy(
            path,
            sources / name,
            **({"ignore": shutil.ignore_patterns("__pycache__")} if path.is_dir() else {}),
        )
    code = f"from setuptools.build_meta import build_wheel; build_wheel({str(out)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=sources, check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    return built


def test_the_recipe_for_an_opencv_of_ones_own_names_all_else_that_is_required() -> None:
    page = (ROOT / "docs" / "install.md").read_text()
    (recipe,) = re.findall(r"^pip install --no-deps \.\npip install (.+)$", page, re.MULTILINE)
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {re.match(r"[A-Za-z0-9-]+", each)[0] for each in required}
    assert set(recipe.split()) == names - {"opencv-python-headless"}


@pytest.fixture(scope="module")
def unpacked(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


def test_every_file_of_the_package_and_every_configuration_is_in_the_wheel_unchanged(unpacked: Path) -> None:
    inside = {
        path.relative_to(unpacked).as_posix(): path.read_bytes()
        for path in unpacked.rglob("*")
        if path.is_file() and path.relative_to(unpacked).parts[0] == "torchslam"
    }
    expected = {
        path.relative_to(ROOT).as_posix(): path.read_bytes()
        for path in (ROOT / "torchslam").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    expected |= {f"torchslam/configs/{p.name}": p.read_bytes() for p in (ROOT / "configs").glob("*.toml")}
    assert inside.keys() == expected.keys()
    assert inside == expected
    assert "torchslam/py.typed" in inside


def test_configurations_are_found_by_name_outside_of_the_repository(unpacked: Path, tmp_path: Path) -> None:
    def config(name: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "torchslam.cli.main", "config", "--config", name]
        environment = os.environ | {"PYTHONPATH": str(unpacked)}
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)

    paper = config("paper")
    assert paper.returncode == 0, paper.stderr
    assert tomllib.loads(paper.stdout)["scale"] == "groundtruth"
    wrong = config("papper")
    assert wrong.returncode == 2
    assert "there are default, paper" in wrong.stderr


def test_a_checkout_has_no_copy_of_the_configurations() -> None:
    assert not (ROOT / "torchslam" / "configs").exists()
    assert config.FOLDER == ROOT / "configs"


def test_the_version_is_that_of_the_metadata(capsys: pytest.CaptureFixture[str]) -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert torchslam.__version__ in (
        declared,
        "0+unknown",
    )  # the latter where the tests run from the sources alone
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"torchslam {torchslam.__version__}\n"


def test_no_window_of_opencv_is_ever_opened() -> None:
    """Else the headless build would not do; and what either build lacks must not be needed to import the package."""
    windows = re.compile(
        r"cv2\.(imshow|waitKey\w*|namedWindow|destroy\w+|selectROI\w*|createTrackbar|setMouseCallback|startWindowThread)\b"
    )
    for file in (ROOT / "torchslam").rglob("*.py"):
        assert not windows.search(file.read_text(encoding="utf-8")), file


@pytest.mark.parametrize(
    "code",
    [
        "from torchslam.cli.main import main; raise SystemExit(main(['info', 'synthetic:room']))",
        "import torchslam; torchslam.SLAM",
    ],
    ids=["command line", "library"],
)
def test_without_opencv_both_builds_of_it_are_named(code: str) -> None:
    without = f"import sys; sys.modules['cv2'] = None; {code}"
    ended = subprocess.run([sys.executable, "-c", without], capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == (2 if "cli" in code else 1)
    assert OPENCV in ended.stderr
    assert ("Traceback" in ended.stderr) == ("cli" not in code)


def test_the_lock_file_has_a_hash_for_everything_and_leaves_torch_to_the_user() -> None:
    blocks = re.split(r"\n(?=[a-z0-9])", (ROOT / "requirements-test.lock").read_text(encoding="utf-8"))[1:]
    names = {block.partition("==")[0] for block in blocks}
    assert all("--hash=sha256:" in block for block in blocks)
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    groups = declared["dependency-groups"]
    wanted = {
        re.split(r"[^\w-]", each)[0]
        for each in (*declared["project"]["dependencies"], *groups["test"], *groups["lint"])
    }
    assert names >= wanted - {"torch"}, "make lock"
    assert not any(name == "torch" or name.startswith(("nvidia-", "cuda-", "triton")) for name in names)
