"""What is done to good files: bytes, words, structures and the entries of a folder, by a random generator."""

from __future__ import annotations

import io
import json
import os
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save


class Entry(Enum):
    """What may lie in a folder in place of a file."""

    FOLDER = "folder"
    PIPE = "pipe"
    ENDLESS = "endless"
    CIRCLE = "circle"
    GONE = "gone"


Files = dict[str, bytes]
Mutated = dict[str, bytes | Entry]
Change = Callable[[bytes, random.Random], bytes]

WORDS = [
    *(b"nan", b"inf", b"-inf", b"0", b"-1", b"1", b"2", b"1e300", b"-1e300", b"1e-320", b"1e999", b"0x10"),
    *(b"1_0", b"2147483648", b"9223372036854775808", b"18446744073709551616", b"9" * 5000, b"1" + b"0" * 400),
    *("٣".encode(), "²".encode(), b"", b"\0", b"\xff\xfe", b"\xed\xb2\x80", b"\x1b[31m", b"/dev/zero"),
    *(b"..", b"../../../etc/passwd", b"x" * 300, b"x/" * 3000, b"[", b"]", b"{", b"}", b"#", b",", b":"),
    *(b"true", b"null", b'""', b"[]", b"[[]]", b"{}", b"!!binary", b"&a *a", b"<a>", b"NaN", b"\r", b"\x85"),
    b"\xc2\x85",
    *("\u2028".encode(), "\u202e".encode(), b"a\0b.png", b"fisheye", b"-0.0", b"1e15", b"0.5", b"[" * 3000),
]
"""What may stand where a number or a name stood."""
INTEGERS = [0, 1, 2, 127, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1]
VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 0.5, 1e300, -1e300, 1e15, 10**30, 10**400, 2**31, 2**63, 2**64),
    *(float("nan"), float("inf"), "", "x", "nan", "\0", "\ud800", "/dev/zero", "x" * 300, [], {}, [[]], [0]),
    *({"a": 1}, [1, 2], [1, 2, 3], [0, 0], [-1, -1], [2**31, 2**31], [None, None], ["a", "b"], "fisheye"),
]
"""What may stand in JSON."""


def mutate(good: Files, rng: random.Random) -> Mutated:
    """The files with one to three changes."""
    files: Mutated = dict(good)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        # Texts first: there are many images, and they are all alike.
        texts = [name for name, content in good.items() if _is_text(content)]
        name = rng.choice(texts if texts and rng.random() < 0.7 else list(good))
        content = files.get(name)
        if not isinstance(content, bytes):
            continue
        if (len(good) > 1 and rng.random() < 0.12) or rng.random() < 0.02:
            _change_entry(files, name, rng)
        else:
            files[name] = rng.choice(changes_of(content))(content, rng)
    return files


def write(files: Mutated, root: Path) -> None:
    """Put files into a folder, as far as the system knows their names."""
    for name, content in files.items():
        path = Path(os.fsdecode(os.fsencode(str(root)) + b"/" + name.encode("utf-8", "surrogateescape")))
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content is Entry.FOLDER:
            path.mkdir()
        elif content is Entry.PIPE:
            os.mkfifo(path)
        elif content is Entry.ENDLESS:
            path.symlink_to("/dev/zero")
        elif content is Entry.CIRCLE:
            path.symlink_to(path.name)


def changes_of(content: bytes) -> list[Change]:
    """The changes that make sense for a content; those that know its structure most often."""
    if _is_text(content):
        texts: list[Change] = [*_BYTES[:4], *_TEXTS, *_TEXTS]
        return texts + ([change_json] * 16 if content.lstrip()[:1] == b"{" else [])
    if content.startswith(b"\x89PNG"):
        return [*_BYTES, *[change_png] * 3]
    if content.startswith(b"PK"):
        return [*_BYTES, *[change_zip] * 20]
    if content[4:8] == b"ftyp":
        return [*_BYTES, *[change_boxes] * 12]
    if content[8:9] == b"{":
        return [*_BYTES, *[change_tensors] * 30]
    return list(_BYTES)


def _is_text(content: bytes | Entry) -> bool:
    if not isinstance(content, bytes):
        return False
    try:
        return "\0" not in content.decode()
    except UnicodeDecodeError:
        return False


# --- entries of a folder -------------------------------------------------------------------------------------


def _change_entry(files: Mutated, name: str, rng: random.Random) -> None:
    kind = rng.choice([*Entry, *Entry, "name", "copy"])
    if isinstance(kind, Entry):
        files[name] = kind
        return
    content = files[name] if kind == "copy" else files.pop(name)
    folder, slash, last = name.rpartition("/")
    stem, dot, suffix = last.rpartition(".")
    names = (f"{stem}\udcff", "x" * 200, f"{stem}\n", f"\x1b[1m{stem}", f"{stem}²", f".{stem}", f"{stem}٣")
    files.setdefault(f"{folder}{slash}{rng.choice(names)}{dot}{suffix}", content)


# --- bytes ---------------------------------------------------------------------------------------------------


def _flip(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if changed:
            # Headers decide more than pixels do.
            end = min(len(changed), 256) if rng.random() < 0.5 else len(changed)
            changed[rng.randrange(end)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _truncate(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _insert(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.randbytes(rng.choice((1, 4, 100))) + content[at:]


def _replace(content: bytes, rng: random.Random) -> bytes:
    return rng.choice((b"", b"\0", b"\xff" * 10, rng.randbytes(200), b"\xef\xbb\xbf" + content, b" " * 1000))


def _remove(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    return content[:start] + content[start + rng.choice((1, 4, 16, 1000)) :]


def _repeat(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    block = content[start : start + rng.choice((1, 8, 100, 1000))]
    return content[:start] + block * rng.choice((2, 3, 50)) + content[start:]


def _set_integer(content: bytes, rng: random.Random) -> bytes:
    """A number of the header becomes an extreme one."""
    form = rng.choice("<>") + rng.choice("BHIQ")
    size = struct.calcsize(form)
    if len(content) < size:
        return content
    end = len(content) - size + 1
    at = rng.randrange(min(end, 400) if rng.random() < 0.6 else end)
    value = rng.choice(INTEGERS) & ((1 << 8 * size) - 1)
    return content[:at] + struct.pack(form, value) + content[at + size :]


_BYTES: list[Change] = [_flip, _truncate, _insert, _replace, _remove, _repeat, _set_integer, _set_integer]


# --- texts ---------------------------------------------------------------------------------------------------


def _pieces(content: bytes) -> list[bytes]:
    """Words and what is between them, by turns."""
    return re.split(rb"([^\w.+/\x80-\xff-]+)", content)


def _change_word(content: bytes, rng: random.Random) -> bytes:
    pieces = _pieces(content)
    for _ in range(rng.choice((1, 1, 2))):
        pieces[rng.randrange((len(pieces) + 1) // 2) * 2] = rng.choice(WORDS)
    return b"".join(pieces)


def _copy_word(content: bytes, rng: random.Random) -> bytes:
    pieces = _pieces(content)
    count = (len(pieces) + 1) // 2
    pieces[rng.randrange(count) * 2] = pieces[rng.randrange(count) * 2]
    return b"".join(pieces)


def _change_lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(6)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(other, lines[at])
    elif kind == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 3:
        lines[at] = rng.choice(WORDS) + b"\n"
    elif kind == 4:
        words = lines[at].split()
        lines[at] = b" ".join(words[:-1] if rng.random() < 0.5 else [*words, rng.choice(WORDS)]) + b"\n"
    else:
        lines = [line.replace(b"\n", b"\r\n") for line in lines]
    return b"".join(lines)


def _change_marks(content: bytes, rng: random.Random) -> bytes:
    marks = [at for at, byte in enumerate(content) if byte in b",:=[]{}\"'<>/ .\n"]
    if not marks:
        return content
    at = rng.choice(marks)
    mark = rng.choice((b"", b",", b" ", b"\t", b":", b"]", b"[", b'"', b"\n", b"="))
    return content[:at] + mark + content[at + 1 :]


def _nest(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    depth = rng.choice((50, 3000, 30000))
    pairs = ((b"[", b"]"), (b"{", b"}"), (b'{"a":', b"}"), (b"<a>", b"</a>"), (b"a.", b"a"), (b"- ", b""))
    start, end = rng.choice(pairs)
    return content[:at] + start * depth + rng.choice((b"", b"1")) + end * depth + content[at:]


_TEXTS: list[Change] = [*[_change_word] * 3, _copy_word, _change_lines, _change_lines, _change_marks, _nest]


def change_json(content: bytes, rng: random.Random) -> bytes:
    """Another value, key or depth somewhere in it."""
    try:
        root = json.loads(content)
    except (ValueError, RecursionError):
        return _change_word(content, rng)
    return dumped(_changed(root, rng))


def dumped(value: Any) -> bytes:
    try:
        return json.dumps(value).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):  # an integer of more digits than Python writes
        return b"{}"


def _changed(node: Any, rng: random.Random) -> Any:
    """A copy of a tree with one node changed, rather deep than high."""
    if not node or not isinstance(node, dict | list) or rng.random() < 0.12:
        return rng.choice(VALUES)
    copy: Any = dict(node) if isinstance(node, dict) else list(node)
    key = rng.choice(list(copy)) if isinstance(copy, dict) else rng.randrange(len(copy))
    kind = rng.random()
    if kind < 0.12:
        del copy[key]
    elif kind < 0.18 and isinstance(copy, dict):
        copy[rng.choice(("", "x", "\0", "x" * 1000))] = copy[key]
    elif kind < 0.24 and isinstance(copy, list):
        copy.append(copy[key])
    else:
        copy[key] = _changed(copy[key], rng)
    return copy


# --- images, videos ------------------------------------------------------------------------------------------


def change_png(content: bytes, rng: random.Random) -> bytes:
    """Another header, with a checksum that fits; or another length of a chunk."""
    chunks = [at - 4 for name in (b"IDAT", b"PLTE", b"IEND") if (at := content.find(name)) >= 4]
    if chunks and rng.random() < 0.25:
        at = rng.choice(chunks)
        return content[:at] + struct.pack(">I", rng.choice(INTEGERS) & 0xFFFFFFFF) + content[at + 4 :]
    width, height, *rest = struct.unpack(">II5B", content[16:29])
    width, height = rng.choice((width, 0, 1, 30000, 2**31 - 1)), rng.choice((height, 0, 1, 2000, 2**31 - 1))
    rest = [rng.choice((value, rng.randrange(17))) if rng.random() < 0.5 else value for value in rest]
    header = b"IHDR" + struct.pack(">II5B", width, height, *rest)
    return content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]


BOXES = (b"moov", b"trak", b"edts", b"mdia", b"minf", b"stbl", b"moof", b"traf")


def change_boxes(content: bytes, rng: random.Random) -> bytes:
    """A box of an MP4 that says something else, or that is gone."""
    spots = list(_boxes(content, 0, len(content)))
    if not spots:
        return _flip(content, rng)
    at, size = rng.choice(spots)
    kind = rng.random()
    if kind < 0.1:
        return content[:at] + content[at + size :]
    if kind < 0.2:
        return content[:at] + struct.pack(">I", rng.choice(INTEGERS) & 0xFFFFFFFF) + content[at + 4 :]
    if size < 16:
        return content
    end = min(size - 4, 80)
    inside = at + 8 + rng.randrange(0, max(1, end - 8), 2)
    form = rng.choice((">H", ">I", ">I"))
    value = rng.choice([*INTEGERS, 134_000_000]) & (0xFFFF if form == ">H" else 0xFFFFFFFF)
    return content[:inside] + struct.pack(form, value) + content[inside + struct.calcsize(form) :]


def _boxes(content: bytes, start: int, end: int):
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", content, start)
        if size < 8 or start + size > end:
            return
        if kind != b"mdat":
            yield start, size
        if kind in BOXES:
            yield from _boxes(content, start + 8, start + size)
        start += size


# --- archives ------------------------------------------------------------------------------------------------


def change_zip(content: bytes, rng: random.Random) -> bytes:
    """An archive with other entries, another compression, damaged in one of them or in its directory."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    except Exception:  # was changed before
        return _flip(content, rng)
    kind = rng.randrange(4)
    names = ("", "/", "a/", ".", "..", "../a", "/a", "a\\..\\b", "C:a", "a//b", "con\0.png", "\n")
    names = (*names, "\udcff.png", "x" * 300)
    if kind == 0:
        at = rng.randrange(len(entries))
        entries[at] = (rng.choice((*names, entries[at][0] + "/a", entries[0][0])), entries[at][1])
    elif kind == 1:
        entries.insert(0, (rng.choice(names), b"x"))
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    packed = _zipped(entries, method)
    if kind == 2:
        return _flip(packed, rng)
    if kind == 3:
        starts = [found.start() for found in re.finditer(rb"PK(\x01\x02|\x03\x04|\x05\x06)", packed)]
        at = min(rng.choice(starts) + rng.randrange(4, 30), len(packed) - 2)
        return packed[:at] + struct.pack("<H", rng.choice(INTEGERS) & 0xFFFF) + packed[at + 2 :]
    return packed


class _AnyName(zipfile.ZipInfo):
    """An entry whose name is written as it is."""

    def _encodeFilenameFlags(self) -> tuple[bytes, int]:
        return self.filename.encode("utf-8", "surrogateescape"), self.flag_bits | 0x800


def _zipped(entries: list[tuple[str, bytes]], method: int) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w") as archive:
        warnings.simplefilter("ignore")  # of names that there are twice
        for name, content in entries:
            entry = _AnyName("x")
            entry.filename, entry.compress_type = name, method
            archive.writestr(entry, content)
    return buffer.getvalue()


# --- tensors -------------------------------------------------------------------------------------------------


def change_tensors(content: bytes, rng: random.Random) -> bytes:
    """A safetensors file with a column that is shorter, missing, of another type or full of other numbers."""
    try:
        tensors = load(content)
        size = struct.unpack_from("<Q", content)[0]
        about = json.loads(content[8 : 8 + size]).get("__metadata__")
    except (SafetensorError, ValueError, RecursionError, struct.error, AttributeError):
        return _flip(content, rng)
    if about and rng.random() < 0.35:
        key = rng.choice(list(about))
        text = about[key].encode("utf-8", "surrogatepass")
        text = change_json(text, rng) if text[:1] == b"{" else _change_word(text, rng)
        about[key] = text.decode("utf-8", "replace")
        if rng.random() < 0.1:
            about = rng.choice((None, {"other": "1"}, {**about, "more": "1"}))
        return save(tensors, about)
    for _ in range(rng.choice((1, 1, 2))):
        if rng.random() < 0.15:
            _change_table(tensors, rng)
        else:
            _change_column(tensors, rng)
    return save({name: values.contiguous() for name, values in tensors.items()}, about)


def _change_table(tensors: dict[str, Any], rng: random.Random) -> None:
    """All columns of a table (names up to the last dot) lose the same rows, or all of them."""
    if not tensors:
        return
    table = rng.choice(sorted(tensors)).rpartition(".")[0]
    columns = [name for name, values in tensors.items() if name.rpartition(".")[0] == table and values.ndim]
    left = rng.choice((0, 1, min((len(tensors[name]) for name in columns), default=0) // 2))
    for name in columns:
        if rng.random() < 0.95:
            tensors[name] = tensors[name][:left].clone()


def _change_column(tensors: dict[str, Any], rng: random.Random) -> None:
    import torch

    if not tensors:
        return
    name = rng.choice(sorted(tensors))
    values = tensors[name]
    kind = rng.randrange(10)
    if kind == 9:
        tensors[name] = values.flatten()[0].clone() if values.numel() else values.new_zeros(())
    elif kind == 0:
        del tensors[name]
    elif kind == 1:
        tensors[rng.choice(("x", name + ".x", "submaps.9.points.x", "\u2028"))] = values.clone()
    elif kind == 2:
        tensors[name] = values[: rng.randrange(len(values) + 1)].clone() if values.ndim else values[None]
    elif kind == 3:
        types = (torch.float16, torch.float32, torch.int32, torch.int64, torch.bool)
        tensors[name] = values.to(rng.choice(types))
    elif kind == 4:
        shapes = (values[..., None], values.reshape(-1), values[None], values.new_zeros(0))
        tensors[name] = rng.choice(shapes).clone()
    elif kind == 5 and values.ndim:
        tensors[name] = torch.cat([values, values])
    elif values.numel() and (
        values.is_floating_point() or values.dtype in (torch.int64, torch.uint8, torch.bool)
    ):
        numbers: list[float] = [0, 1]
        if values.dtype == torch.int64:
            numbers = [-1, 0, 1, 2**31, 2**62, -(2**63), len(values) if values.ndim else 1]
        elif values.dtype == torch.float64:
            numbers = [float("nan"), float("inf"), -1.0, 0.0, 1e30, -1e30, 1e-30, 1e160, 1e300]
        elif values.dtype == torch.float32:
            numbers = [float("nan"), -1.0, 0.0, 1e30]
        values = values.clone()
        target = values.view(-1)
        target = target if rng.random() < 0.4 else target[rng.randrange(values.numel()) :][:1]
        target.fill_(rng.choice(numbers))
        tensors[name] = values
