"""Run SLAM on a whole recording, as `torchslam run` does: nothing is printed, and no file is written."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from torchslam.calibration.find_camera import NUM_KEYPOINTS, find_camera, with_stated_std
from torchslam.config import Config
from torchslam.data.sequence import Calibrated, Sequence
from torchslam.global_mapping.links import learned_config
from torchslam.global_mapping.mapper import features_to_keep, mapping_config
from torchslam.global_mapping.recording import MappedRun, Mapping, run_recording
from torchslam.metric.options import given_options, sources_of
from torchslam.metric.source import MetricSource
from torchslam.system.online_run import Observer, OnlineRun
from torchslam.system.slam import SLAM


def run(
    sequence: Sequence,
    config: Config | None = None,
    *,
    mapping: Mapping | str = Mapping.AUTO,
    measurements: Iterable[MetricSource] = (),
    processes: int | None = None,
    observer: Observer | None = None,
    device: torch.device | str = "cpu",
) -> MappedRun:
    """Map a recording: its camera, its frames, the check, global mapping where needed, metric scale.

    Args:
        sequence: the recording, as of `open_sequence`. An unknown camera is estimated from pairs of its images.
        config: the configuration; the default one if None.
        mapping: "auto": frame by frame, and then as a whole if frames were lost or held-out image pairs contradict the
            map; "online": frame by frame alone; "global": as a whole in any case, and frame by frame
            before where the recording is long, or after where that map is not right.
        measurements: sources of meters, beside those of `config.metric` and those that the sequence brings along.
        processes: number of processes, this one included; None: the best number. The result is the same.
        observer: sees the progress, and ends the run by raising KeyboardInterrupt: what there is is returned.
        device: of torch.

    Returns:
        The run: `trajectory`, `map`, `camera`, `check`, `graph` and more.

    Raises:
        MeasurementError: A measurement is wrong; where a file is, before the first frame.
        ConfigError: Weights that the configuration asks for are missing.
    """
    config, mapping = config or Config(), Mapping(mapping)
    sources = [*sources_of(given_options(config.metric, sequence.measurements)), *measurements]
    features = None
    if mapping is not Mapping.ONLINE and not sequence.is_live:
        learned_config(mapping_config(config))  # raises now rather than after the online run
        features = features_to_keep(config, sequence.size, NUM_KEYPOINTS, device)
    if sequence.calibrated is not Calibrated.GIVEN and not sequence.is_live:
        sequence, _ = find_camera(sequence, config, None, device, extract=features)
    config = with_stated_std(config, sequence)
    online = OnlineRun(SLAM(sequence.camera.to(device), config), sequence, None, processes, observer)
    return run_recording(
        online, online.sequence, None if sequence.is_live else mapping, sources, device, features=features
    )
