"""What is read, what is left out, and what is proposed where nothing is."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.data.mp4 import write_mp4
from torchslam.data import open_sequence
from torchslam.data.formats import image_file as image_files
from torchslam.errors import CalibrationError, FrameError, SequenceError

CAMERA = "60,60,32,24"
Write = Callable[..., np.ndarray]


def names(sequence) -> list[str]:
    return [Path(sequence.image_name(index)).name for index in range(len(sequence))]


@pytest.mark.parametrize("inner", ["images", "rgb"])
def test_images_in_a_folder_inside(tmp_path: Path, write_picture: Write, inner: str) -> None:
    for index in range(3):
        write_picture(tmp_path / inner / f"{index}.png", index)
        write_picture(tmp_path / "depth" / f"{index}.png", index)
    (tmp_path / "calibration.txt").write_text("60 61 32 24")
    sequence = open_sequence(tmp_path)
    assert names(sequence) == ["0.png", "1.png", "2.png"]
    assert inner in sequence.image_name(0)
    assert float(sequence.camera.fy) == 61.0
    assert sequence.name == tmp_path.name


def test_files_that_are_no_frames_are_skipped_with_a_note(tmp_path: Path, write_picture: Write) -> None:
    for index in range(2):
        for name in (f"{index:04d}.png", f"._{index:04d}.png", f"{index:04d}_depth.png"):
            write_picture(tmp_path / name, index)
    write_picture(tmp_path / "mask.png", 9)
    sequence = open_sequence(tmp_path, CAMERA)
    assert names(sequence) == ["0000.png", "0001.png"]
    (note,) = sequence.notes
    assert note.startswith("ignored: ")
    assert {"2 hidden files", "2 depth images", "1 masks"} == set(note.partition(": ")[2].split(", "))


def test_two_series_of_images_are_not_mixed(tmp_path: Path, write_picture: Write) -> None:
    for index in range(3):
        write_picture(tmp_path / f"left-{index}.png", index)
        write_picture(tmp_path / f"right-{index:02d}.png", index)
    with pytest.raises(SequenceError, match=r"several series .* '.*/left-\*\.png' or '.*/right-\*\.png'"):
        open_sequence(tmp_path, CAMERA)
    sequence = open_sequence(tmp_path / "left-*.png", CAMERA)
    assert names(sequence) == ["left-0.png", "left-1.png", "left-2.png"]
    with pytest.raises(SequenceError, match="does not exist"):
        open_sequence(tmp_path / "middle-*.png", CAMERA)


@pytest.mark.parametrize(
    "files",
    [
        ["a1.png", "a2.png", "b3.png", "b4.jpg"],  # series that follow each other
        ["depths2.png", "flower3.png", "masked_ball1.png"],  # kinds are whole words
    ],
)
def test_all_images_of_a_folder(tmp_path: Path, write_picture: Write, files: list[str]) -> None:
    for index, name in enumerate(files):
        write_picture(tmp_path / name, index)
    assert names(open_sequence(tmp_path, CAMERA)) == files


@pytest.mark.parametrize(
    ("stems", "times"),
    [
        (["9.95", "9.983", "10.02", "10.05"], [9.95, 9.983, 10.02, 10.05]),  # decimals
        (["0", "0.033", "0.07", "0.1"], [0.0, 0.033, 0.07, 0.1]),
        (["1305031102.0338", "1305031102.166", "1305031102.2"], None),
        (["rgb-1305031102.0338", "rgb-1305031102.166", "rgb-1305031103.0"], None),
        (["1_1305031102.0338", "2_1305031102.166", "3_1305031103.0"], None),
        (["1403636579763555584", "1403636579813555456", "1403636579863555584"], None),
        (["1403636579763", "1403636579813", "1403636579863"], None),
        (["cam_1403636579763555", "cam_1403636579813555", "cam_1403636579863555"], None),
    ],
)
def test_images_named_by_times(
    tmp_path: Path, write_picture: Write, stems: list[str], times: list[float] | None
) -> None:
    for index in torch.randperm(len(stems), generator=torch.Generator().manual_seed(0)).tolist():
        write_picture(tmp_path / f"{stems[index]}.png", index)
    if times is None:
        numbers = [stem.replace("_", "-").rpartition("-")[2] for stem in stems]
        units = {13: 1e3, 16: 1e6, 19: 1e9}
        times = [float(number) / units.get(len(number) if "." not in number else 0, 1) for number in numbers]
    sequence = open_sequence(tmp_path, CAMERA)
    assert names(sequence) == [f"{stem}.png" for stem in stems]
    torch.testing.assert_close(sequence.timestamps.tolist(), times, rtol=0, atol=1e-6)
    assert sequence.notes == ("the names of the images are their times",)
    assert len(open_sequence(tmp_path, CAMERA, fps=1)) < len(stems) or times[-1] - times[0] >= len(stems) - 1


@pytest.mark.parametrize(
    "stems",
    [
        ["shot1.8", "shot1.9", "shot1.10", "shot1.11"],  # counters behind a dot
        ["1.7", "1.9", "1.11", "1.13"],
        ["frame.0009", "frame.0010", "frame.0011"],
        ["1.0009", "1.0010", "1.0011"],
        ["2024.5.1", "2024.5.9", "2024.5.10", "2024.10.2"],  # dates
        ["v1.2.9", "v1.2.10"],
        ["a_9", "a_10", "a_1305031102"],
        ["a1", "a2.5", "b3"],
    ],
)
def test_names_that_are_no_times_keep_their_order(
    tmp_path: Path, write_picture: Write, stems: list[str]
) -> None:
    for index, stem in enumerate(stems):
        write_picture(tmp_path / "all" / f"{stem}.png", index)
        black = np.where(np.arange(64) <= index, 255, 0).astype(np.uint8)[None].repeat(48, 0)
        (tmp_path / "masks").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "masks" / f"{stem}.x.png"), black)
    sequence = open_sequence(tmp_path / "all", CAMERA)
    assert names(sequence) == [f"{stem}.png" for stem in stems]
    assert sequence.frame_rate == pytest.approx(30.0)
    masked = open_sequence(tmp_path / "all", CAMERA, mask=tmp_path / "masks")  # by order
    assert [int(masked.mask(i)[0, 0, 0].sum()) for i in range(len(stems))] == list(range(1, len(stems) + 1))


def test_times_whose_zeros_are_missing_are_refused(tmp_path: Path, write_picture: Write) -> None:
    """Seconds, a dot and a count of nanoseconds without its leading zeros."""
    for index, stem in enumerate(("1403636579.63555580", "1403636579.113555584")):
        write_picture(tmp_path / f"{stem}.png", index)
    with pytest.raises(SequenceError, match=r"\.63555580 and with .*\.113555584: .* one number of digits"):
        open_sequence(tmp_path, CAMERA)
    (tmp_path / "1403636579.63555580.png").rename(tmp_path / "1403636579.63555584.png")
    write_picture(tmp_path / "1403636579.163555584.png")
    with pytest.raises(SequenceError, match=r"\.63555584 and with .*\.163555584: .* one number of digits"):
        open_sequence(tmp_path, CAMERA)


def test_misspelled_names_get_suggestions(
    tmp_path: Path, tum_folder: Callable[..., Path], write_picture: Write
) -> None:
    folder = tum_folder()
    for wrong, message in (
        (folder.with_name("sequense"), f"does not exist; did you mean {folder}?"),
        (folder / "rgb.txt", f"neither a video nor a recording .*; did you mean {folder}?"),
        (folder.parent, f"did you mean {folder}?"),
    ):
        with pytest.raises(SequenceError, match=message.replace("?", r"\?")):
            open_sequence(wrong)
    write_picture(tmp_path / "other" / "depth" / "1.png")
    write_picture(tmp_path / "other" / "images" / "1.png")
    with pytest.raises(SequenceError, match=r"no frames, only 1 depth images; did you mean .*other\?"):
        open_sequence(tmp_path / "other" / "depth")
    shutil.copytree(folder, tmp_path / "second")
    with pytest.raises(
        SequenceError, match=r"3 folders with one; which of .*other, .*second or .*sequence\?"
    ):
        open_sequence(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SequenceError, match="folder is empty"):
        open_sequence(tmp_path / "empty")
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.txt").write_text("a")
    with pytest.raises(
        SequenceError, match=r"no images .*; looked for a video .*rgb\.txt \(ETH3D, TUM\).*TartanAir"
    ):
        open_sequence(tmp_path / "texts")


def test_zip(tmp_path: Path, tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder()
    archive = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", folder.parent, folder.name))
    sequence = open_sequence(archive)
    kept = Path(sequence.image_name(0))
    part = sequence.part(1, 3)
    expected = open_sequence(folder)
    assert (sequence.name, len(sequence)) == ("packed", 5)
    del sequence
    assert torch.equal(part[0].image, expected[1].image)
    assert kept.exists()
    del part
    assert not kept.exists()


def pack(archive: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(archive, "w") as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    return archive


def test_zip_of_a_video(tmp_path: Path) -> None:
    write_mp4(tmp_path / "clip.mp4", [np.full((48, 64, 3), 40 * index, np.uint8) for index in range(3)])
    video = (tmp_path / "clip.mp4").read_bytes()
    for files in (
        {"clip.mp4": video},
        {"clip.mp4": video, "__MACOSX/._clip.mp4": b"x", ".DS_Store": b"x", "notes.txt": b"x"},
        {"folder/clip.mp4": video, "folder/notes.txt": b"x"},
    ):
        sequence = open_sequence(pack(tmp_path / "a.zip", files), CAMERA, limit=2)
        assert (sequence.name, sequence.kind, len(sequence)) == ("clip", "video", 2)
        assert float(sequence.image(1).mean()) == pytest.approx(40 / 255, abs=0.02)


def test_zip_of_a_mac(tmp_path: Path, tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder()
    files = {
        f"desk/{path.relative_to(folder)}": path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }
    files |= {"__MACOSX/desk/rgb/._0.png": b"x", ".DS_Store": b"x"}
    assert len(open_sequence(pack(tmp_path / "a.zip", files))) == 5


@pytest.mark.parametrize("listed", ["../outside.png", "{}/outside.png", "rgb/../../../outside.png"])
def test_a_list_in_a_zip_that_names_an_image_outside_is_refused(
    tmp_path: Path, tum_folder: Callable[..., Path], listed: str
) -> None:
    folder = tum_folder()
    image = next((folder / "rgb").glob("*.png"))
    shutil.copy(image, tmp_path / "outside.png")
    lines = [f"1.0 rgb/{image.name}", f"2.0 {listed.format(tmp_path)}"]
    files = {"rgb.txt": "\n".join(lines).encode(), f"rgb/{image.name}": image.read_bytes()}
    with pytest.raises(SequenceError, match=r"a\.zip: image 1 is outside of the archive$"):
        open_sequence(pack(tmp_path / "a.zip", files), CAMERA)


def test_zips_without_one_sequence(tmp_path: Path) -> None:
    (tmp_path / "wrong.zip").write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(SequenceError, match=r"wrong\.zip: not a zip archive"):
        open_sequence(tmp_path / "wrong.zip")
    write_mp4(tmp_path / "clip.mp4", [np.full((48, 64, 3), 40 * index, np.uint8) for index in range(3)])
    video = (tmp_path / "clip.mp4").read_bytes()
    for files, message in (
        (
            {"a.mp4": video, "b.mp4": video},
            r"holds 2 sequences \(a\.mp4, b\.mp4\); unpack it and open one of them$",
        ),
        (
            {f"{side}{index}.png": b"x" for side in ("left-", "right-0") for index in range(3)},
            r"several series of images .* Give '.*left-\*\.png' or '.*right-\*\.png'; unpack it first$",
        ),
        ({"inner.zip": b"x"}, r"holds archives \(inner\.zip\); unpack it and open one$"),
        ({"depth/1.png": b"x", "a/b/c.mp4": video}, r"no images .*, no video and no other sequence in it$"),
        ({"clip.mp4": b"no video" * 100}, r"a\.zip/clip\.mp4: cannot be read as a video$"),
    ):
        with pytest.raises(SequenceError, match=message) as caught:
            open_sequence(pack(tmp_path / "a.zip", files), CAMERA)
        assert "did you mean" not in str(caught.value)
        assert "torchslam-" not in str(caught.value)


@pytest.mark.parametrize(("bits", "white"), [(10, 1023), (12, 4095), (14, 16383), (16, 65535)])
def test_sixteen_bit_images_are_scaled(tmp_path: Path, bits: int, white: int) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, white + 1, (3, 48, 64)).astype(np.uint16)
    images[1, 0, 0] = white
    for index, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{index}.png"), image)
    sequence = open_sequence(tmp_path, CAMERA)
    assert sequence.notes == (f"{bits} of 16 bits are used",)
    expected = (images[1] / white * 255)[..., None].repeat(3, axis=-1)
    assert np.abs(sequence.color(1).numpy() - expected).max() <= 0.5 + 1e-3
    for index, image in enumerate(images):
        expected = torch.from_numpy(image.astype(np.float32)) / white
        torch.testing.assert_close(sequence.image(index)[0, 0], expected)


def test_images_brighter_than_the_sampled_ones_are_clipped(tmp_path: Path, write_picture: Write) -> None:
    for index in range(60):
        cv2.imwrite(
            str(tmp_path / f"{index}.png"), np.full((48, 64), 8000 if index == 4 else 4000, np.uint16)
        )
    sequence = open_sequence(tmp_path, CAMERA)
    assert float(sequence.image(4).max()) == 1.0
    assert float(sequence.image(5).max()) == pytest.approx(4000 / 4095)


def test_every_read_is_bounded(tmp_path: Path, write_picture: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    for suffix in ("png", "jpg", "bmp", "tif", "webp", "pgm"):
        image = tmp_path / f"0.{suffix}"
        write_picture(image)
        assert image_files.read_gray(image, "here").shape == (1, 1, 48, 64)
        with monkeypatch.context() as patch:
            patch.setattr(image_files, "MAX_PIXELS", 48 * 64 - 1)
            with pytest.raises(FrameError, match=rf"0\.{suffix} is not an image"):
                image_files.read_gray(image, "here")
        if suffix != "png":
            image.unlink()
    monkeypatch.setattr(image_files, "MAX_BYTES", 100)
    with pytest.raises(FrameError, match="more than the 100 of an image"):
        image_files.read_gray(tmp_path / "0.png", "here")
    (tmp_path / "calibration.txt").write_text("60 60 32 24\n" * 20)
    monkeypatch.setattr("torchslam.data.text_file.MAX_BYTES", 100)
    with pytest.raises(CalibrationError, match="more than the 100 of a text"):
        open_sequence(tmp_path)


# --- the remedy, in one line ---------------------------------------------------------------------------------


def refused(path: Path | str, message: str, **options: object) -> None:
    with pytest.raises(SequenceError, match=message) as error:
        open_sequence(path, **options)  # type: ignore[arg-type]
    assert str(error.value).isprintable()


def test_patterns_with_counters_are_written_with_stars(tmp_path: Path, write_picture: Write) -> None:
    write_picture(tmp_path / "frame_000001.png")
    for name in ("frame_%06d.png", "frame_%d.png"):
        refused(tmp_path / name, r"does not exist; did you mean '.*/frame_\*\.png'\? In quotes")
        assert len(open_sequence(tmp_path / "frame_*.png")) == 1
    refused(tmp_path / "left_%06d.png", r"left_%06d\.png: does not exist")


def test_addresses_of_files_are_to_be_downloaded() -> None:
    refused(
        "http://me:secret@localhost/a.mp4", r"^http://localhost/a\.mp4: .* download it, and give the file$"
    )
    refused("http://localhost:1/a.html", r"cannot be opened as a stream; download a file")


@pytest.mark.parametrize("suffix", [".HEIC", ".avif", ".dng"])
def test_images_of_other_kinds_are_to_be_converted(tmp_path: Path, write_picture: Write, suffix: str) -> None:
    kind = f"{suffix[1:].upper()} images, which are not read .convert them"
    for index in range(3):
        (tmp_path / "mine" / "images").mkdir(parents=True, exist_ok=True)
        (tmp_path / "mine" / "images" / f"{index}{suffix}").write_bytes(b"ftypheic")
    for path, message in (
        (tmp_path / "mine" / "images", f"no frames, only 3 {kind}"),
        (tmp_path / "mine", f"no frames, only 3 {kind}.* below"),
        (tmp_path / "mine" / "images" / f"1{suffix}", f"1{suffix}: {kind}"),
        (tmp_path / "mine" / "images" / f"*{suffix}", f"{suffix}: {kind}"),
    ):
        refused(path, message)
    write_picture(tmp_path / "mine" / "images" / "3.jpg")
    assert open_sequence(tmp_path / "mine").notes[0].startswith(f"ignored: 3 {suffix[1:].upper()} images")


def test_a_stray_image_beside_a_folder_of_images(tmp_path: Path, write_picture: Write) -> None:
    for index in range(3):
        write_picture(tmp_path / "images" / f"{index}.png", index)
    write_picture(tmp_path / "preview.png", 9)
    sequence = open_sequence(tmp_path)
    assert names(sequence) == ["0.png", "1.png", "2.png"]
    assert sequence.notes == ("ignored: 1 images beside images/",)
    for index in range(4):
        write_picture(tmp_path / f"{index}.png", index)
    (tmp_path / "preview.png").unlink()
    assert names(open_sequence(tmp_path)) == ["0.png", "1.png", "2.png", "3.png"]
    assert open_sequence(tmp_path).notes == ("ignored: 3 images in images/",)


def test_masks_whose_black_is_not_black(tmp_path: Path, write_picture: Write) -> None:
    write_picture(tmp_path / "0.png")
    black = np.full((48, 64), 235, np.uint8)
    black[:24] = 16
    cv2.imwrite(str(tmp_path / "m.png"), black)
    refused(tmp_path / "0.png".replace("0", "*"), r"m\.png: the darkest .* are 16", mask=tmp_path / "m.png")
    cv2.imwrite(str(tmp_path / "m.jpg"), black)  # is never exactly black
    labels = np.where(black > 16, 3, 1).astype(np.uint8)  # whatever is not 0 is allowed
    cv2.imwrite(str(tmp_path / "l.png"), labels)
    for name, expected in (("m.jpg", black > 16), ("l.png", labels > 0)):
        mask = open_sequence(tmp_path / "0*.png", mask=tmp_path / name).mask(0)
        assert mask is not None
        np.testing.assert_array_equal(mask[0, 0].numpy(), expected)


def test_transparency(tmp_path: Path, write_picture: Write) -> None:
    picture = write_picture(tmp_path / "0.png")
    rgba = np.dstack([np.full((48, 64, 3), 255, np.uint8), picture])
    cv2.imwrite(str(tmp_path / "m.png"), rgba)
    refused(tmp_path / "0*.png", r"m\.png: the mask is in the alpha channel", mask=tmp_path / "m.png")
    cv2.imwrite(str(tmp_path / "0.png"), np.dstack([picture] * 4))
    assert open_sequence(tmp_path / "0*.png").notes == (
        "images have transparent pixels, which are used as any other; --mask masks them",
    )
    cv2.imwrite(str(tmp_path / "0.png"), np.dstack([picture] * 3 + [np.full_like(picture, 255)]))
    assert open_sequence(tmp_path / "0*.png").notes == ()
