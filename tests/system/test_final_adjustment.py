"""The final adjustment: which observations leave the map."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch

from tests.walks import Walk, arc
from torchslam import SLAM, Run, evaluate, load_config
from torchslam.map.atlas import Atlas
from torchslam.system import final_adjustment as final
from torchslam.system.final_adjustment import FinalAdjustment

SETTINGS = ["features.kind=simulated", "features.num_keypoints=400", "simulated.points_per_view=250"]
WALK = Walk(arc(60)[:30])


@pytest.fixture(scope="module")
def unadjusted() -> Run:
    config = load_config(None, [*SETTINGS, "simulated.noise_px=0.5"])
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(FinalAdjustment, "adjust", lambda *_, **__: None)
        return SLAM(WALK.camera, config).run(WALK)


def adjusted(run: Run, settled: bool) -> Atlas:
    atlas = Atlas(run.camera.params, deepcopy(run.submaps))
    FinalAdjustment(run.sensor, load_config(None, SETTINGS), None).adjust(atlas, 0, settled=settled)
    return atlas


@pytest.mark.parametrize("settled", [False, True])
def test_only_a_map_that_is_not_settled_loses_observations(unadjusted: Run, settled: bool) -> None:
    (submap,) = adjusted(unadjusted, settled)
    before, after = (len(each.observations()) for each in (unadjusted.map, submap.map))
    assert (after == before) is settled
    assert after > 0.5 * before
    assert evaluate(submap.trajectory(), WALK.groundtruth).ate_m < 0.01


def test_observations_leave_from_one_and_a_half_deviations_on(
    unadjusted: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the errors told apart by hand: the ones just below the threshold stay."""
    errors, removed = torch.tensor([1.49**2, 1.51**2], dtype=torch.float64), []
    remove = type(unadjusted.map).remove_masked_observations

    def record(slam_map: object, seen: object, mask: torch.Tensor) -> None:
        removed.append(mask)
        remove(slam_map, seen, mask)  # type: ignore[arg-type]

    def told(_: object, seen: list[object], __: object) -> torch.Tensor:
        return errors[torch.arange(len(seen)) % 2]

    monkeypatch.setattr(final, "adjust_all", lambda _, camera, *__: camera)
    monkeypatch.setattr(final, "squared_errors", told)
    monkeypatch.setattr(type(unadjusted.map), "remove_masked_observations", record)
    adjusted(unadjusted, settled=False)
    (mask,) = removed
    assert torch.equal(mask, torch.arange(len(mask)) % 2 == 1)
