"""Public sequences from their servers: fetched with resume, unpacked without trust, put in place at once.

Source of the archives: https://www.eth3d.net/slam_datasets
"""

from __future__ import annotations

import http.client
import re
import shutil
import stat
import urllib.error
import urllib.request
import zipfile
from pathlib import Path, PurePosixPath

from tqdm import tqdm

from torchslam.errors import DownloadError

ETH3D_URL = "https://www.eth3d.net/data/slam/datasets"
CHUNK = 1 << 20
TIMEOUT = 60.0
"""Seconds without a byte before a transfer is given up."""
ATTEMPTS = 5
"""How often a transfer that breaks off is taken up again, as long as it gets further each time."""


def download(name: str, directory: str | Path, base_url: str = ETH3D_URL, progress: bool = True) -> Path:
    """Fetch `eth3d/NAME` (its monocular archive) into `directory`; returns the folder of the sequence.

    A transfer that breaks off is taken up where it stopped, in this call or the next one; a sequence that is there
    already is not fetched again. The folder appears whole or not at all.
    Raises DownloadError.
    """
    found = re.fullmatch(r"eth3d/([A-Za-z0-9_]+)", name)
    if found is None:
        raise DownloadError(f"unknown sequence `{name}`; known are eth3d/NAME, for example eth3d/plant_1")
    target = Path(directory) / found[1]
    if target.exists():
        return target
    archive = Path(directory) / f"{found[1]}_mono.zip"
    url = f"{base_url}/{archive.name}"
    archive.parent.mkdir(parents=True, exist_ok=True)
    if not archive.exists():
        _fetch(url, archive, progress)
    unpack(archive, target)
    archive.unlink()
    return target


def unpack(archive: Path, target: Path) -> None:
    """Unpack a zip archive of one sequence so that `target` appears whole or not at all.

    A single folder at the top of the archive is left out of the path. Raises DownloadError for a damaged archive and
    for entries that are absolute, climb out of the folder or are links.
    """
    staging = target.with_name(target.name + ".unpacking")
    shutil.rmtree(staging, ignore_errors=True)
    try:
        with zipfile.ZipFile(archive) as contents:
            for entry in contents.infolist():
                _check_entry(archive, entry)
            contents.extractall(staging)
        entries = list(staging.iterdir())
        single = len(entries) == 1 and entries[0].is_dir()
        (entries[0] if single else staging).rename(target)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, OSError) as cause:
        raise DownloadError(
            f"{archive}: cannot be unpacked into {target}: {cause}; delete it and try again"
        ) from cause
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _check_entry(archive: Path, entry: zipfile.ZipInfo) -> None:
    """Raises DownloadError for an entry that could write outside of the folder it is unpacked into."""
    # Backslashes and drive letters are ordinary characters here, but not where Windows unpacks.
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or re.match(r"[A-Za-z]:", entry.filename):
        raise DownloadError(
            f"{archive}: entry `{entry.filename}` climbs out of the folder; nothing was unpacked"
        )
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise DownloadError(f"{archive}: entry `{entry.filename}` is a link; nothing was unpacked")


def _fetch(url: str, path: Path, progress: bool) -> None:
    """Fetch a file; what has arrived waits in `NAME.part` for the next attempt."""
    part = path.with_name(path.name + ".part")
    for attempt in range(1, ATTEMPTS + 1):
        before = part.stat().st_size if part.exists() else 0
        try:
            total = _transfer(url, part, progress)
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
            raise DownloadError(f"{url}: {failure}; run the same command again to go on from there")


def _transfer(url: str, part: Path, progress: bool) -> int | None:
    """Append to `part` what is missing; returns the size the whole file should have, where the server says."""
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
            return _transfer(url, part, progress)
        return start
    with response:
        resumed = response.status == http.HTTPStatus.PARTIAL_CONTENT
        length = response.headers.get("Content-Length")
        start = start if resumed else 0
        total = None if length is None else start + int(length)
        bar = tqdm(
            total=total,
            initial=start,
            unit="B",
            unit_scale=True,
            desc=url.rsplit("/", 1)[-1],
            disable=not progress,
        )
        with bar, part.open("ab" if resumed else "wb") as file:
            while chunk := response.read(CHUNK):
                file.write(chunk)
                bar.update(len(chunk))
    return total
