"""What a run leaves behind, as one differentiable problem: the answer is differentiated, not the path to it.

The trajectory of a finished run minimises the reprojection errors of its observation graph. However many frames
and discrete choices led there, its gradient with respect to every pixel, weight and camera parameter is that of the
minimiser: one linear solve for the keyframes and the points, one small one for each frame in between.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchslam.errors import TorchslamError
from torchslam.geometry import Camera, se3_inverse
from torchslam.solvers import BundleProblem, BundleSolution, bundle_adjust, refine_pose
from torchslam.solvers.implicit import Backward
from torchslam.solvers.levenberg import Progress
from torchslam.solvers.robust import Kernel
from torchslam.values import Trajectory

_FRAMES_AT_ONCE = 64
_TENSORS = (
    "timestamps",
    "T_cw",
    "points_w",
    "frame_index",
    "point_index",
    "pixels",
    "weights",
    "is_keyframe",
)


@dataclass(frozen=True)
class ObservationGraph:
    """Who saw what where: O observations of P points by F frames, in any order.

    timestamps:  (F,) float64 seconds
    T_cw:        (F, 4, 4) world to camera, as the run left them
    points_w:    (P, 3)
    frame_index: (O,) int64 rows of T_cw; point_index: (O,) int64 rows of points_w
    pixels:      (O, 2)
    weights:     (O,) inverse variances in px^-2
    camera:      one for all frames
    is_keyframe: (F,) bool; keyframes and points are solved together, the other frames against the points
    """

    timestamps: Tensor
    T_cw: Tensor
    points_w: Tensor
    frame_index: Tensor
    point_index: Tensor
    pixels: Tensor
    weights: Tensor
    camera: Camera
    is_keyframe: Tensor

    def save(self, path: str | Path) -> None:
        """Write to a safetensors file."""
        tensors = {name: getattr(self, name).detach().cpu().contiguous() for name in _TENSORS}
        tensors["camera"] = self.camera.params.detach().cpu().contiguous()
        width, height = self.camera.size
        metadata = {"camera_model": self.camera.model, "camera_size": f"{width} {height}"}
        safetensors.torch.save_file(tensors, path, metadata)

    @staticmethod
    def load(path: str | Path) -> ObservationGraph:
        """Read what `save` wrote. Raises TorchslamError where the file is something else."""
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in (*_TENSORS, "camera")}
            width, height = metadata["camera_size"].split()
            camera = Camera(metadata["camera_model"], tensors["camera"], (int(width), int(height)))
            return ObservationGraph(camera=camera, **{name: tensors[name] for name in _TENSORS})
        except (SafetensorError, KeyError) as error:
            raise TorchslamError(f"{path} is not an observation graph: {error}") from error


@dataclass(frozen=True)
class GraphSolution:
    """The minimiser of a graph, differentiable with respect to its pixels, weights and camera.

    T_cw:      (F, 4, 4); points_w: (P, 3); camera
    success:   (F,) bool. A frame that its observations do not determine stays where it was, without gradient; if the
               keyframes together are not determined, none of them succeeds.
    keyframes: the bundle adjustment of keyframes and points, with its covariances
    """

    timestamps: Tensor
    T_cw: Tensor
    points_w: Tensor
    camera: Camera
    success: Tensor
    keyframes: BundleSolution

    @property
    def trajectory(self) -> Trajectory:
        """Camera to world, ordered by time, differentiable."""
        order = torch.argsort(self.timestamps, stable=True)
        return Trajectory(self.timestamps[order], se3_inverse(self.T_cw[order]))


def solve(
    graph: ObservationGraph,
    kernel: Kernel = "huber",
    scale: Tensor | float = 2.45,
    free_camera: bool = False,
    backward: Backward = "implicit",
    iterations: int = 30,
    tolerance: float = 1e-10,
    progress: Progress | None = None,
) -> GraphSolution:
    """Minimise the robust reprojection errors of a run's graph: keyframes and points, then the frames in between.

    The first keyframe stays where it is, and so does the scale; a loss should not depend on them, as aligned trajectory
    errors do not. Options as in `bundle_adjust`; the default kernel ends its quadratic part at 95 % of a Gaussian.
    Raises ValueError if there is no keyframe.
    """
    keyframes, others = graph.is_keyframe.nonzero().squeeze(-1), (~graph.is_keyframe).nonzero().squeeze(-1)
    if len(keyframes) == 0:
        raise ValueError("the graph has no keyframe")
    slots = torch.cumsum(graph.is_keyframe, 0) - 1
    rows = graph.is_keyframe[graph.frame_index].nonzero().squeeze(-1)
    problem = BundleProblem(
        graph.T_cw[keyframes],
        graph.points_w,
        slots[graph.frame_index[rows]],
        graph.point_index[rows],
        graph.pixels[rows],
        graph.camera,
        graph.weights[rows],
        fixed_frames=(0,),
    )
    bundle = bundle_adjust(problem, kernel, scale, free_camera, backward, iterations, tolerance, progress)

    T_cw = graph.T_cw.detach().index_copy(0, keyframes, bundle.T_cw)
    success = graph.is_keyframe & bundle.success
    in_rank = torch.argsort(graph.frame_index, stable=True)
    counts = torch.bincount(graph.frame_index, minlength=len(graph.T_cw))
    starts = counts.cumsum(0) - counts
    for frames in others.split(_FRAMES_AT_ONCE) if len(others) else ():
        slot = torch.arange(int(counts[frames].max()), device=frames.device)
        mask = slot < counts[frames, None]
        seen = in_rank[torch.where(mask, starts[frames, None] + slot, 0)]
        mask = mask & bundle.moved_points[graph.point_index[seen]]
        refined = refine_pose(
            graph.T_cw[frames],
            bundle.points_w[graph.point_index[seen]],
            graph.pixels[seen],
            bundle.camera,
            graph.weights[seen],
            mask,
            kernel,
            scale,
            backward=backward,
            iterations=iterations,
            tolerance=tolerance,
        )
        T_cw = T_cw.index_copy(0, frames, refined.T_cw)
        success = success.index_copy(0, frames, refined.success)
    return GraphSolution(graph.timestamps, T_cw, bundle.points_w, bundle.camera, success, bundle)
