"""Lists of sequences: what they may say, what is wrong with them, and what the rows are called."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchslam.batch import Row, Shard, assign_names, read_list
from torchslam.batch.engines import parse_shard
from torchslam.batch.rows import COLUMNS, MAX_NAME
from torchslam.errors import ConfigError, SequenceError


def test_a_text_list_has_one_path_per_line(tmp_path: Path) -> None:
    (tmp_path / "l.txt").write_text(
        "# mine\n\nmonday/rgb\ntuesday.mp4  # the second\nsynthetic:room?frames=3\n"
    )
    rows = read_list(tmp_path / "l.txt")
    assert [row.sequence for row in rows] == ["monday/rgb", "tuesday.mp4", "synthetic:room?frames=3"]
    assert [row.name for row in rows] == ["rgb", "tuesday", "synthetic-room-frames=3"]
    assert rows[0].resolve("monday/rgb") == str(tmp_path / "monday/rgb")
    assert rows[2].resolve(rows[2].sequence) == "synthetic:room?frames=3"


def test_a_csv_list_has_a_column_per_option(tmp_path: Path) -> None:
    texts = {"name": "first", "sequence": "a,b", "camera": "525,525,319.5,239.5", "config": "c.toml"}
    texts |= {"groundtruth": "t.txt", "start": "1:30", "stop": "200", "resize": "0.5", "mask": "m.png"}
    numbers = {"stride": 2, "fps": 12.5, "limit": 9}
    cells = texts | numbers | {"overrides": "seed=3; features.num_keypoints=500;"}
    assert set(cells) == set(COLUMNS)
    line = ",".join(f'"{cell}"' for cell in cells.values())
    (tmp_path / "l.csv").write_text(f"{','.join(cells)}\n{line}\n\n", encoding="utf-8-sig")
    (row,) = read_list(tmp_path / "l.csv")
    settings = ("seed=3", "features.num_keypoints=500")
    assert row == Row(**texts, **numbers, overrides=settings, folder=str(tmp_path))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("l.csv", "sequence,cemera\na,b\n", "l.csv:1: unknown column `cemera`; did you mean camera?"),
        ("l.csv", "name\na\n", "l.csv:1: the header must have"),
        ("l.csv", "sequence,sequence\na,b\n", "l.csv:1: the header must have"),
        ("l.csv", "sequence,limit\na\n", "l.csv:2: 1 cells, the header has 2"),
        ("l.csv", "sequence,limit\na,0\n", "l.csv:2: limit must be a positive integer, not `0`"),
        ("l.csv", "sequence,stride\na,1.5\n", "l.csv:2: stride must be a positive integer"),
        ("l.csv", "sequence,fps\na,0\n", "l.csv:2: fps must be a positive number"),
        ("l.csv", "sequence,limit\n,3\n", "l.csv:2: no sequence"),
        ("l.csv", "sequence,name\na,../b\n", "l.csv:2: name `../b`: it names a folder"),
        ("l.csv", f"sequence,name\na,{'b' * (MAX_NAME + 1)}\n", "l.csv:2: name"),
        ("l.csv", "sequence,name\na,x\nb,X\n", "l.csv: 2 rows are named x"),
        ("l.csv", 'sequence\n"a\n', "l.csv:2: not CSV"),
        ("l.csv", "sequence\na\0b\n", "l.csv:2"),
        ("l.csv", "sequence\n", "l.csv: no sequences in the list"),
        ("l.txt", "# nothing\n", "l.txt: no sequences in the list"),
        ("l.txt", "a\nb\na\n", "l.txt:3: the same as "),
        ("l.txt", "a" * 70_000, "l.txt:1: sequence"),
    ],
)
def test_errors_are_named_by_file_and_line(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(SequenceError) as caught:
        read_list(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path}/{message}")


def test_missing_lists_and_endless_ones(tmp_path: Path) -> None:
    for path in (tmp_path / "none.txt", tmp_path, Path("/dev/zero")):
        with pytest.raises(SequenceError, match="cannot be read"):
            read_list(path)


def test_unnamed_rows_get_unique_names() -> None:
    rows = assign_names(
        [Row("", "a/rgb"), Row("rgb-2", "b"), Row("", "c/RGB/"), Row("", "..."), Row("", "d/ä ö.mp4")]
    )
    assert [row.name for row in rows] == ["rgb", "rgb-2", "RGB-3", "sequence", "sequence-2"]


def test_row_options_override_defaults() -> None:
    row = Row("a", "a", overrides=("seed=2",), limit=3)
    done = row.with_defaults({"limit": 9, "stride": 2, "overrides": ("seed=1",), "camera": None})
    assert (done.limit, done.stride, done.overrides, done.camera) == (3, 2, ("seed=1", "seed=2"), None)


# --- shards --------------------------------------------------------------------------------------------------


def slurm(mine: int, first: int, last: int, count: int) -> dict[str, str]:
    names = {"ID": mine, "MIN": first, "MAX": last, "COUNT": count}
    return {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in names.items()}


@pytest.mark.parametrize(
    ("text", "environment", "expected"),
    [
        ("0/1", {}, Shard(0, 1)),
        ("2/3", slurm(0, 0, 1, 2), Shard(2, 3)),
        ("auto", slurm(0, 0, 7, 8), Shard(0, 8)),
        ("auto", slurm(8, 1, 8, 8), Shard(7, 8)),
        ("auto", slurm(9, 3, 15, 5), Shard(2, 5)),
        ("auto", slurm(4, 4, 4, 1), Shard(0, 1)),
        ("auto", {"JOB_COMPLETION_INDEX": "3", "JOB_COMPLETIONS": "4"}, Shard(3, 4)),
    ],
)
def test_shards(text: str, environment: dict[str, str], expected: Shard) -> None:
    assert parse_shard(text, environment) == expected


@pytest.mark.parametrize(
    ("text", "environment", "message"),
    [
        ("3/3", {}, "shards count from 0/3 to 2/3"),
        ("1", {}, "expected i/n"),
        ("-1/3", {}, "expected i/n"),
        ("0/0", {}, "expected i/n"),
        ("auto", {}, "not a job of an array"),
        ("auto", slurm(2, 0, 7, 3), "not evenly spaced"),
        ("auto", slurm(3, 0, 4, 3), "not evenly spaced"),
        ("auto", {"JOB_COMPLETION_INDEX": "3"}, "JOB_COMPLETIONS is not set"),
    ],
)
def test_invalid_shards_are_refused(text: str, environment: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_shard(text, environment)
