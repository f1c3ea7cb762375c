"""The scale, the level and the place of a map from the positions of a receiver."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.metric.drives import ORIGIN, drive, error, measure, reason, receiver, true_S_ew, view_of
from torchslam.data.fixes import Fixes
from torchslam.errors import MeasurementError
from torchslam.geometry import enu_from_geodetic, geodetic_from_enu, so3_exp, transform
from torchslam.metric.camera_path import Clock, clocks_of, parse_clock
from torchslam.metric.meters import vertical_contradictions
from torchslam.metric.positions import PositionSource, from_options
from torchslam.metric.source import ScaleSource

FILE = Path("track.csv")


def fixes_of(times: Tensor, positions_e: Tensor, **more: object) -> Fixes:
    geodetic = geodetic_from_enu(positions_e, torch.tensor(ORIGIN, dtype=torch.float64))
    unknown = torch.full((len(times), 2), math.nan, dtype=torch.float64)
    return Fixes(FILE, geodetic, unknown, times, **more)  # type: ignore[arg-type]


def test_exact_positions_give_the_similarity() -> None:
    times, T_ec = drive()
    at, positions_e, _ = receiver(times, T_ec, noise=0.0)
    fixes = fixes_of(at, positions_e)
    found = measure(PositionSource(fixes), view_of(times, T_ec))
    assert found.source is ScaleSource.POSITION
    assert found.unit.endswith("m from the path")
    assert abs(error(found)) < 1e-6
    assert found.S_ew is not None
    assert found.origin is not None
    # The frame of the result has its origin at the first position.
    first, origin = (torch.tensor(each, dtype=torch.float64) for each in (found.origin, ORIGIN))
    shift = enu_from_geodetic(first[None], origin)[0]
    T_wc = torch.linalg.inv(view_of(times, T_ec).T_cw)
    centers_e = transform(found.S_ew, T_wc[:, :3, 3])
    torch.testing.assert_close(centers_e + shift, T_ec[:, :3, 3], atol=1e-2, rtol=0)


@pytest.mark.parametrize(("noise", "limit"), [(1.5, 0.012), (0.3, 0.004)])
def test_noise_that_wanders_and_positions_that_are_wrong(noise: float, limit: float) -> None:
    """The stated error is that of the scale, and all wrong positions are named."""
    times, T_ec = drive()
    errors, stated = [], []
    for seed in range(5):
        at, positions_e, bad = receiver(times, T_ec, noise=noise, walk=noise, wrong=0.1, seed=seed)
        found = measure(PositionSource(fixes_of(at, positions_e)), view_of(times, T_ec))
        assert found.count == int((~bad).sum())
        assert bool(found.rejected) == bool(bad.any())
        errors.append(error(found))
        stated.append(found.relative_std)
        assert found.up_w is not None
        up = true_S_ew()[2, :3]
        assert math.acos(float(found.up_w @ up / up.norm())) < 4 * found.up_std
    rms = math.sqrt(sum(e * e for e in errors) / len(errors))
    assert rms < limit
    ratios = [abs(e) / s for e, s in zip(errors, stated, strict=True)]
    assert max(ratios) < 3
    assert 0.3 < rms / (sum(stated) / len(stated)) < 1.5


def test_clocks_that_differ() -> None:
    """Found with its error where the motion shows it, given in seconds, or as the moment of the first image."""
    times, T_ec = drive()
    at, positions_e, _ = receiver(times, T_ec, noise=0.3)
    view = view_of(times, T_ec)
    late = fixes_of(at + 1.3, positions_e)
    found = measure(PositionSource(late), view)
    assert abs(error(found)) < 0.005
    assert any(re.search(r"its clock is 1\.(2[5-9]|3[0-5]) ± 0\.\d\d s ahead", note) for note in found.notes)
    given = measure(PositionSource(late, Clock(seconds=-1.3)), view)
    assert error(given) == pytest.approx(error(found), abs=1e-3)
    dates = fixes_of(at + 1.7e9, positions_e)
    with pytest.raises(MeasurementError, match="give --gps-clock the date and time of the first image"):
        PositionSource(dates).measure(view)
    assert abs(error(measure(PositionSource(dates, Clock(start=1.7e9)), view))) < 0.005


def test_gps_time_is_recognized() -> None:
    times, T_ec = drive()
    at, positions_e, _ = receiver(times, T_ec, noise=0.1)
    view = view_of(times + 1.7e9, T_ec)
    gps = fixes_of(at + 1.7e9 - 315964800 + 18, positions_e)
    assert abs(error(measure(PositionSource(gps), view))) < 0.005


def test_positions_of_images() -> None:
    times, T_ec = drive()
    rows = torch.arange(0, len(times), 20)
    positions_e = T_ec[rows, :3, 3]
    names = tuple(f"a/{row}.jpg" for row in rows.tolist())
    known = fixes_of(times[rows], positions_e)
    fixes = Fixes(FILE, known.geodetic, known.std, None, names)
    images = [f"images/a/{row}.jpg" for row in range(len(times))]
    assert abs(error(measure(PositionSource(fixes), view_of(times, T_ec, images)))) < 1e-6
    with pytest.raises(MeasurementError, match=r"no image has one of its names, such as a/0\.jpg"):
        PositionSource(fixes).measure(view_of(times, T_ec, ["x"] * len(times)))
    assert "not available" in reason(PositionSource(fixes), view_of(times, T_ec))


def test_a_line_leaves_the_turn_about_it_open() -> None:
    times, T_ec = drive(kind="line")
    at, positions_e, _ = receiver(times, T_ec, noise=1.0)
    found = measure(PositionSource(fixes_of(at, positions_e)), view_of(times, T_ec))
    assert abs(error(found)) < 3 * found.relative_std < 0.05
    assert found.up_w is None
    assert any("lie on a line" in note for note in found.notes)
    assert found.S_ew is not None
    up = true_S_ew()[2, :3] / true_S_ew()[2, :3].norm()
    assert float(found.S_ew[2, :3] @ up) / found.meters_per_unit > 0.9  # the cameras are upright


def test_heights_that_are_missing() -> None:
    times, T_ec = drive()
    at, positions_e, _ = receiver(times, T_ec, noise=0.5)
    fixes = fixes_of(at, positions_e)
    fixes.geodetic[:, 2] = math.nan
    found = measure(PositionSource(fixes), view_of(times, T_ec))
    assert abs(error(found)) < 3 * found.relative_std
    assert found.notes == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("equal", "all 61 positions are the same"),
        ("noise", "do not have the shape|scatter by"),
        ("shape", "do not have the shape|scatter by"),
        ("few", "3 positions are at times with a pose, 4 are needed"),
        ("still", "the camera does not move"),
    ],
)
def test_positions_that_say_nothing(change: str, words: str) -> None:
    times, T_ec = drive()
    at, positions_e, _ = receiver(times, T_ec, noise=0.0)
    if change == "equal":
        positions_e = positions_e[:1].expand(len(at), 3)
    if change in ("noise", "shape"):
        size = 500.0 if change == "noise" else 20.0
        noise = torch.randn(len(at), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        positions_e = size * noise + (positions_e if change == "noise" else 0.0)
    if change == "few":
        at, positions_e = at[:3], positions_e[:3]
    if change == "still":
        T_ec = T_ec[:1].expand(len(times), 4, 4)
    assert re.search(words, reason(PositionSource(fixes_of(at, positions_e)), view_of(times, T_ec)))


def test_latitude_and_longitude_swapped() -> None:
    times, T_ec = drive()
    at, positions_e, _ = receiver(times, T_ec, noise=0.5)
    fixes = fixes_of(at, positions_e)
    swapped = Fixes(FILE, fixes.geodetic[:, [1, 0, 2]], fixes.std, at)
    with pytest.raises(MeasurementError, match="swapped in the file"):
        PositionSource(swapped).measure(view_of(times, T_ec))


def test_units_of_time_that_are_not_named() -> None:
    times, T_ec = drive()
    at, positions_e, _ = receiver(times, T_ec, noise=0.5)
    with pytest.raises(MeasurementError, match="call the column time_ms"):
        PositionSource(fixes_of(1e5 + 1000 * at, positions_e)).measure(view_of(times, T_ec))


def test_clocks_as_they_are_given() -> None:
    assert parse_clock("-0.3", "--gps-clock") == Clock(seconds=-0.3)
    assert parse_clock("2024-05-01T10:00:00Z", "--gps-clock") == Clock(start=1714557600.0)
    with pytest.raises(MeasurementError, match="`soon` is neither seconds"):
        parse_clock("soon", "--gps-clock")
    given = {"gps": (("a",), ("b",)), "gps_clock": (("1",),)}
    assert clocks_of(given, "gps") == [("a", Clock(seconds=1.0)), ("b", Clock(seconds=1.0))]
    with pytest.raises(MeasurementError, match="given 2 times, but --gps 1 times"):
        clocks_of({"gps": (("a",),), "gps_clock": (("1",), ("2",))}, "gps")


def test_options_read_their_files(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,lat,lon\n0,48,11\n1,48,11.001\n", encoding="utf-8")
    (source,) = from_options({"gps": ((str(tmp_path / "a.csv"),),)})
    assert isinstance(source, PositionSource)
    assert len(source.fixes) == 2
    with pytest.raises(MeasurementError, match="cannot be read"):
        from_options({"gps": ((str(tmp_path / "b.csv"),),)})


@pytest.mark.parametrize("down", [0.0, math.pi / 2])
def test_a_path_on_the_wrong_side_of_the_equator_is_reported(down: float) -> None:
    """Without hemispheres it is mirrored, and turns the map upside down; also of a camera that looks at the ground."""
    times, T_ec = drive()
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = so3_exp(torch.tensor((-down, 0.0, 0.0), dtype=torch.float64))
    at, positions_e, _ = receiver(times, T_ec, noise=0.1)
    fixes = fixes_of(at, positions_e * torch.tensor((1.0, -1.0, 1.0), dtype=torch.float64))
    view = view_of(times, T_ec @ turn)
    found = measure(PositionSource(fixes), view)
    (line,) = vertical_contradictions(view.T_cw[:, :3, :3], [found])
    assert "the vertical of position contradicts the images" in line
