"""Draw a finished run as an animation: the image with its tracked keypoints, and the map with the growing path.

torchslam demo --output results/demo
python -m experiments.report.animation results/demo synthetic:room docs/images/run.webp
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from experiments.common import parser_of
from torchslam import open_sequence
from torchslam.data.sequence import Sequence
from torchslam.geometry.transforms import upright_rotation
from torchslam.io.plots.charts import ACCENT, ESTIMATE, house_style, new_figure, robust_box
from torchslam.io.results import read_results

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE = (7.6, 2.9)  # inches
DPI = 85
TURN_DEG = 40.0  # by which the view of the map turns during the animation
ELEVATION_DEG = 40.0


class RunScene:
    """The arrays of a run that the animation draws, z up.

    path:      (F, 3) camera centers of the posed frames
    frames:    (F,) their indices in the sequence
    pixels:    keypoints (m, 2) tracked in each posed frame
    points:    (P, 3) map points; created: (P,) index of the frame in which each was triangulated
    """

    def __init__(self, directory: Path) -> None:
        results = read_results(directory)
        submap = next(each for each in results.submaps if each.number == results.metrics["submap"])
        ids = submap.map.valid_points()
        R = upright_rotation(results.trajectory.T_wc)
        rows, observations = submap.posed_frames.frames, submap.posed_frames.observations
        self.path = (results.trajectory.positions_w @ R.mT).numpy()
        self.points = (submap.map.positions_w[ids] @ R.mT).numpy()
        keyframe_frames = submap.map.keyframes["frame_index"]
        self.created = keyframe_frames[submap.map.points["first_keyframe"][ids]].numpy()
        order = rows["timestamp"].argsort()
        self.frames = rows["frame_index"][order].tolist()
        seen, pixels = observations["frame_row"].numpy(), observations["pixels"].numpy()
        self.pixels = [pixels[seen == row] for row in order.tolist()]
        self.limits = robust_box(self.path, self.points)


def draw_frame(scene: RunScene, sequence: Sequence, number: int) -> Figure:
    """The figure of one posed frame, by its number among them."""
    index = scene.frames[number]
    with house_style():
        figure = new_figure(*SIZE)
        left = figure.add_subplot(1, 2, 1)
        left.imshow(sequence.image(index)[0, 0].numpy(), cmap="gray", vmin=0, vmax=1.4)
        left.plot(*scene.pixels[number].T, ".", color="#40e07a", markersize=3.5)
        left.set_axis_off()
        _draw_map(figure.add_subplot(1, 2, 2, projection="3d"), scene, number)
    return figure


def _draw_map(axes: Any, scene: RunScene, number: int) -> None:
    """The points triangulated so far, and the path up to the frame."""
    points, path = scene.points[scene.created <= scene.frames[number]], scene.path[: number + 1]
    axes.scatter(*points.T, s=3.0, color="#6b6b6b", alpha=0.8, linewidths=0)
    axes.plot(*path.T, color=ESTIMATE, linewidth=1.6)
    axes.plot(*path[-1:].T, "o", color=ACCENT, markersize=5)
    axes.set(**dict(zip(("xlim", "ylim", "zlim"), scene.limits, strict=True)))
    axes.set_box_aspect(np.diff(scene.limits)[:, 0], zoom=1.55)
    axes.view_init(ELEVATION_DEG, -70 + TURN_DEG * number / len(scene.path))
    axes.set_axis_off()


def picture(figure: Figure) -> Image.Image:
    """A figure as an image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(DPI)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def save_animation(pictures: list[Image.Image], path: Path, rate: float) -> None:
    """Write pictures as an animation of `rate` pictures per second, and say how large it is."""
    times = [round(1000 / rate)] * (len(pictures) - 1) + [1500]  # the last one stays longer
    pictures[0].save(
        path,
        save_all=True,
        append_images=pictures[1:],
        duration=times,
        loop=0,
        quality=35,
        method=6,
    )
    print(f"{path}: {len(pictures)} pictures, {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("results", type=Path, help="results folder of a run")
    parser.add_argument("sequence", help="the sequence that the run read")
    parser.add_argument("output", type=Path, help="a .webp or .gif file")
    parser.add_argument("--stride", type=int, default=3, help="draw every n-th posed frame")
    parser.add_argument("--rate", type=float, default=10.0, help="pictures per second")
    arguments = parser.parse_args()
    scene, sequence = RunScene(arguments.results), open_sequence(arguments.sequence)
    numbers = range(0, len(scene.frames), arguments.stride)
    pictures = [picture(draw_frame(scene, sequence, number)) for number in numbers]
    save_animation(pictures, arguments.output, arguments.rate)


if __name__ == "__main__":
    main()
