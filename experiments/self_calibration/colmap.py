"""What COLMAP makes of a sequence when it refines the camera: the peer's focal length and radial distortion.

    python -m experiments.self_calibration.colmap SEQUENCE_FOLDER --stride 10

Writes results/colmap_NAME.json: per camera model, SIMPLE_PINHOLE (f) and RADIAL (f, k1, k2), what it found, with the
principal point fixed at the given one. Needs pycolmap, and nothing of torchslam but its reader of sequences.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import pycolmap

from torchslam.data import open_sequence

RESULTS = Path(__file__).parent / "results"
MODELS = {"SIMPLE_PINHOLE": 0, "RADIAL": 2}


def link_images(folder: Path, sequence_folder: Path, stride: int, count: int | None) -> None:
    """Every stride-th image of rgb.txt, named in order."""
    lines = [line for line in (sequence_folder / "rgb.txt").read_text().splitlines() if line.strip()]
    names = [line.split()[1] for line in lines if not line.startswith("#")][:count:stride]
    folder.mkdir()
    for index, name in enumerate(names):
        source = (sequence_folder / name).resolve()
        (folder / f"{index:06d}{source.suffix}").symlink_to(source)


def reconstruct(work: Path, model: str, focal: float, cx: float, cy: float, threads: int) -> dict:
    """Incremental mapping with `model`, started at `focal`; the features and matches are made once per `work`."""
    images, database = work / "images", work / f"{model}.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = model
    # COLMAP's pixel (0, 0) is the corner of the top left pixel.
    params = [focal, cx + 0.5, cy + 0.5, *[0.0] * MODELS[model]]
    reader.camera_params = ",".join(map(str, params))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = threads, False
    extraction.sift.max_num_features = 2000
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = threads, False
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap, pairing.loop_detection, pairing.quadratic_overlap = 10, False, True
    pycolmap.match_sequential(
        database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
    )
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.ba_refine_focal_length = options.ba_refine_extra_params = True
    options.ba_refine_principal_point = False
    maps = pycolmap.incremental_mapping(database, images, work / model, options=options)
    if not maps:
        return {"registered": 0, "focal": float("nan"), "distortion": [0.0] * MODELS[model]}
    best = max(maps.values(), key=lambda m: m.num_reg_images())
    (camera,) = best.cameras.values()
    focal, _, _, *distortion = camera.params.tolist()
    error = best.compute_mean_reprojection_error()
    return {"registered": best.num_reg_images(), "focal": focal, "distortion": distortion,
            "error_px": error}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--stride", type=int, default=10)
    parser.add_argument("--count", type=int, help="only the first so many images of the sequence")
    parser.add_argument(
        "--start", type=float, default=1.0, help="start at this share of the nominal focal length"
    )
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    camera = open_sequence(arguments.folder).camera
    focal, cx, cy = float(camera.focal), float(camera.cx), float(camera.cy)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        link_images(work / "images", arguments.folder, arguments.stride, arguments.count)
        found = {}
        for model in MODELS:
            found[model] = reconstruct(work, model, arguments.start * focal, cx, cy, arguments.threads)
            print(model, json.dumps(found[model]), flush=True)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"colmap_{arguments.folder.name}.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main()
