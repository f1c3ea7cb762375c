"""Published cameras of datasets, by name. Only what the datasets themselves print; each with its source."""

from __future__ import annotations

from dataclasses import replace

from torchslam.data.calibration import Calibration, Preset, Size

VGA = (640, 480)


def _published(size: Size, *numbers: float) -> Calibration:
    return Calibration.from_numbers(list(numbers), "preset", size=size)


_CAMERAS: dict[str, tuple[Calibration, ...]] = {
    # https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, calibration of the color cameras;
    # the images of fr3 are undistorted already.
    "tum-fr1": (_published(VGA, 517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),),
    "tum-fr2": (_published(VGA, 520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),),
    "tum-fr3": (_published(VGA, 535.4, 539.2, 320.1, 247.6),),
    # sensor.yaml of cam0 in every sequence of https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
    "euroc": (
        _published(
            (752, 480),
            *(458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        ),
    ),
    # P0 in calib.txt of the odometry benchmark, by the size of its images: sequences 00-02 (and 13-21), 03, 04-12.
    "kitti": (
        _published((1241, 376), 718.856, 718.856, 607.1928, 185.2157),
        _published((1242, 375), 721.5377, 721.5377, 609.5593, 172.854),
        _published((1226, 370), 707.0912, 707.0912, 601.8873, 183.1104),
    ),
    # The dataset gives no calibration of the color camera: 525 is the Kinect's nominal focal length.
    "7-scenes": (replace(_published(VGA, 525.0, 525.0, 319.5, 239.5), guessed=True),),
    # https://github.com/castacks/tartanair_tools/blob/master/data_type.md (90 degrees over 640 pixels); the second
    # version of the dataset has the same angle over square images.
    "tartanair": (
        _published(VGA, 320.0, 320.0, 320.0, 240.0),
        _published((640, 640), 320.0, 320.0, 320.0, 320.0),
    ),
    # https://www.doc.ic.ac.uk/~ahanda/VaFRIC/codes.html; there fy is -480, as its camera's y axis points up.
    "icl": (_published(VGA, 481.2, 480.0, 319.5, 239.5),),
}

PRESETS = {name: Preset(name, cameras) for name, cameras in _CAMERAS.items()}
