"""What a session is: its number, its submaps, and what it leaves in a file."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.map.simulated import CAMERA, simulated_submap
from torchslam.errors import ResultsError
from torchslam.map.atlas import Atlas
from torchslam.map.file import read_atlas
from torchslam.system.session import Session


def session_with_map() -> Session:
    submap = simulated_submap()
    submap.map.points["last_seen_frame"][:] = 7
    return Session(CAMERA, Atlas(CAMERA.params, [submap], 1))


def test_each_session_has_the_next_number(tmp_path: Path) -> None:
    path = tmp_path / "map"
    session_with_map().save(path)
    for number in (1, 2):
        session = Session.load(path)
        assert (session.number, session.count, session.mapping) == (number, number + 1, True)
        assert torch.equal(session.camera.params, CAMERA.params)
        session.save(path)


def test_a_localization_session_is_not_counted_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "map"
    session_with_map().save(path)
    session = Session.load(path, mapping=False)
    assert (session.number, session.count) == (1, 1)
    (submap,) = session.atlas
    assert (submap.map.points["last_seen_frame"] == 7).all()
    session.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == path.read_bytes()


def test_frames_are_renumbered_when_the_map_may_change(tmp_path: Path) -> None:
    session_with_map().save(tmp_path / "map")
    (submap,) = Session.load(tmp_path / "map").atlas
    assert (submap.map.points["last_seen_frame"] == -1).all()


def test_localization_needs_a_map(tmp_path: Path) -> None:
    Session(CAMERA, Atlas(CAMERA.params)).save(tmp_path / "empty")
    assert read_atlas(tmp_path / "empty").sessions == 1
    assert len(Session.load(tmp_path / "empty").atlas) == 0
    with pytest.raises(ResultsError, match="no submap in it to localize in"):
        Session.load(tmp_path / "empty", mapping=False)
