"""Can the system find the focal length and the distortion of its camera? See README.md."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from experiments.common import sequences, table, write_between
from experiments.self_calibration.calibration import parameters, with_parameters
from experiments.self_calibration.rounds import Remembered, Round, one_round, rounds
from torchslam.config import Config, load_config
from torchslam.data.sequence import Sequence
from torchslam.front_end import image_extractor, simulated_extractor
from torchslam.geometry import Camera, se3_inverse
from torchslam.run import true_poses
from torchslam.values import Trajectory

HERE = Path(__file__).parent
RESULTS = HERE / "results"


@dataclass(frozen=True)
class Case:
    """A sequence to calibrate the camera on: its first frames, and how many radial coefficients are looked for."""

    label: str
    name: str
    frames: int
    num_radial: int
    overrides: tuple[str, ...] = ()

    @property
    def simulated(self) -> bool:
        return "features.kind=simulated" in self.overrides


SIMULATED = ("features.kind=simulated", "simulated.points_per_view=300")
CASES = [
    Case("simulated, exact", "synthetic:room", 60, 2, SIMULATED),
    Case("simulated, 0.5 px", "synthetic:room", 120, 2, (*SIMULATED, "simulated.noise_px=0.5")),
    Case("redkitchen", "redkitchen", 1000, 0),
    Case("redkitchen, distortion free", "redkitchen", 1000, 2),
    Case("kitti07", "kitti07", 160, 0),
    Case("kitti07, distortion free", "kitti07", 160, 2),
    Case("machine_hall", "machine_hall", 160, 2),
]
HEADER = [
    "sequence",
    "frames",
    "start: f (px), k1, k2",
    "found",
    "standard error of f",
    "given",
    "COLMAP",
    "f against COLMAP, else given",
    "rounds",
    "ATE before (m)",
    "ATE after (m)",
    "ATE, given camera (m)",
]


class PosesOnly(Sequence):
    """The true path of a sequence under another camera, its images blank: for simulated features."""

    def __init__(self, sequence: Sequence, camera: Camera) -> None:
        T_cw = true_poses(sequence)
        truth = Trajectory(sequence.timestamps, se3_inverse(T_cw))
        super().__init__(sequence.name, "path", camera, sequence.timestamps, truth)

    def image(self, index: int) -> Tensor:
        width, height = self.camera.size
        return torch.zeros(1, 1, height, width)

    def image_name(self, index: int) -> str:
        return f"pose {index}"


def wide_angle() -> Camera:
    """A camera with the distortion of a wide-angle lens, for the simulated cases."""
    return Camera.radial_tangential(460.0, 460.0, 319.5, 239.5, -0.28, 0.07, 0.0, 0.0, size=(640, 480))


def misjudged(camera: Camera, factor: float, num_radial: int) -> Camera:
    """Focal length and radial coefficients as `factor` times the true ones."""
    theta = factor * parameters(camera, num_radial)
    theta[0] = (factor * camera.focal).log()
    return with_parameters(camera, theta)


def prepare(case: Case, sequence: Sequence, frames: int) -> tuple[Sequence, Remembered, Config]:
    """The sequence as it is used, its features, the configuration."""
    config = load_config(None, case.overrides)
    part = sequence.part(stop=frames)
    if not case.simulated:
        return part, Remembered(image_extractor(config)), config
    path = PosesOnly(part, wide_angle())
    return path, Remembered(simulated_extractor(config, path.camera, true_poses(path))), config


def given_camera(case: Case, sequence: Sequence) -> Camera:
    """The camera as the sequence has it, with room for distortion where that is to be found."""
    camera = sequence.camera.to(torch.float64)
    if camera.model == "pinhole" and case.num_radial:
        return Camera(
            "radial_tangential", torch.cat([camera.params, camera.params.new_zeros(5)]), camera.size
        )
    return camera


def colmap_of(case: Case) -> Camera | None:
    """What `colmap.py` found, if it ran on this sequence."""
    file = RESULTS / f"colmap_{case.name}.json"
    if case.simulated or not file.exists():
        return None
    model = json.loads(file.read_text())["RADIAL" if case.num_radial else "SIMPLE_PINHOLE"]
    f, (k1, k2) = model["focal"], model["distortion"] or (0.0, 0.0)
    return Camera.radial_tangential(f, f, 0.0, 0.0, k1, k2, 0.0, 0.0, size=(0, 0))


def calibrated_in_rounds(case: Case, sequence: Sequence, factor: float, frames: int) -> list[str]:
    """Run a case, print every round, and return its row of the table."""
    part, extractor, config = prepare(case, sequence, frames)
    given = given_camera(case, part)
    done: list[Round] = []
    for result in rounds(part, misjudged(given, factor, case.num_radial), config, extractor, case.num_radial):
        done.append(result)
        before, after = describe(result.camera, case), describe(result.calibrated, case)
        print(f"{case.label}: {before} -> {after}; ATE {error_of(result)}", flush=True)
    reference = one_round(part, given, config, extractor, case.num_radial)
    print(f"{case.label}: given camera -> {describe(reference.calibrated, case)}; ATE {error_of(reference)}")
    first, last = done[0], done[-1]
    colmap = colmap_of(case)
    ratio = last.calibrated.focal / (colmap or given).focal
    return [
        case.label,
        str(len(part)),
        describe(first.camera, case),
        describe(last.calibrated, case),
        f"{100 * last.errors[0].item():.2g} %" if len(last.errors) else "no map",
        describe(given, case),
        describe(colmap, case) if colmap else "",
        f"{100 * (ratio.item() - 1):+.3f} %",
        str(len(done)),
        error_of(first),
        error_of(last),
        error_of(reference),
    ]


def describe(camera: Camera, case: Case) -> str:
    """Focal length, and the coefficients that are calibrated."""
    coefficients = camera.params[4 : 4 + case.num_radial].tolist()
    return ", ".join([f"{camera.focal.item():.2f}", *(f"{k:.4f}" for k in coefficients)])


def error_of(result: Round) -> str:
    """ATE, and how many frames were posed where some were not."""
    missing = "" if result.posed == result.frames else f" ({result.posed} of {result.frames} posed)"
    return f"{result.ate_m:.3g}{missing}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("labels", nargs="*", help="cases to run; all by default")
    parser.add_argument("--factor", type=float, default=0.8, help="start at this multiple of the true values")
    parser.add_argument("--frames", type=int, help="the first so many frames of every sequence")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    RESULTS.mkdir(exist_ok=True)
    for case in CASES:
        if arguments.labels and case.label not in arguments.labels:
            continue
        for sequence in sequences([case.name]):
            row = calibrated_in_rounds(case, sequence, arguments.factor, arguments.frames or case.frames)
            row_file(case).write_text(json.dumps(row))
    rows = [json.loads(row_file(case).read_text()) for case in CASES if row_file(case).exists()]
    write_between(HERE / "README.md", table(HEADER, rows))


def row_file(case: Case) -> Path:
    """Where the last row of a case is kept, so that cases can be run one by one."""
    return RESULTS / f"{case.label}.json"


if __name__ == "__main__":
    main()
