"""The storey of the experiments: a corridor with little texture around a room."""

from __future__ import annotations

import torch

from experiments.storey import storey
from tests.data.test_synthetic import _built, _degrees_between, _distance, _path


def test_the_building_walk_is_smooth_rotates_in_place_and_returns() -> None:
    positions, R_wc = _path("storey?frames=2400")
    steps = positions.diff(dim=0).norm(dim=-1)
    turns = _degrees_between(R_wc[:-1], R_wc[1:])
    assert 0.005 < float(steps.min()) < float(steps.max()) < 0.06
    assert 3.5 < float(turns.max()) < 4.5
    # At the far end of the room it turns by half a circle at arm's length.
    in_room = slice(405, 471)
    assert float(_degrees_between(R_wc[405], R_wc[470])) > 150
    assert float(torch.cdist(positions[in_room], positions[in_room]).max()) < 0.75
    assert float((positions[1160:1260] - positions[:100]).norm(dim=-1).max()) < 0.15
    assert float(_degrees_between(R_wc[1160:1260], R_wc[:100]).max()) < 25
    assert float((positions[:1100] - positions[0]).norm(dim=-1).max()) > 11


def test_the_walk_avoids_walls_and_furniture() -> None:
    positions = _path("storey")[0].numpy()
    assert len(positions) == 1260
    clearance = [_distance(positions, rectangle).min() for rectangle in _built(storey)]
    assert 0.4 < min(clearance) < 1.0
