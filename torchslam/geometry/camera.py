"""Camera models: pinhole, radial-tangential (Brown-Conrady), rational (OpenCV) and fisheye (Kannala-Brandt).

Camera frame: x right, y down, z forward. Pixel (0, 0) is the center of the top left pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import InitVar, dataclass
from functools import reduce, wraps
from typing import Any, ClassVar, Concatenate, ParamSpec, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchslam.geometry import distortion
from torchslam.geometry.lie import homogeneous
from torchslam.geometry.precision import without_autocast
from torchslam.utils.by_value import ByValue
from torchslam.utils.torch_internals import default_collate_fn_map, in_transform, register_pytree

Scalar = float | Tensor
Numbers = Tensor | np.ndarray | Sequence[Any]
P = ParamSpec("P")
R = TypeVar("R")


def _in_dtype_of_data(method: Callable[Concatenate[Camera, P], R]) -> Callable[Concatenate[Camera, P], R]:
    """The method, without autocast, of the camera with parameters in the dtype of its argument."""

    @without_autocast
    @wraps(method)
    def following(self: Camera, *args: P.args, **kwargs: P.kwargs) -> R:
        data: Any = args[0] if args else next(iter(kwargs.values()))
        camera = self if data.dtype == self.params.dtype else self.to(data.dtype)
        return method(camera._without_degenerate(), *args, **kwargs)

    return following


@dataclass(frozen=True, eq=False)
class Camera(ByValue):
    """A calibrated camera, or many of one model and size. Without batch dimensions it broadcasts over any points.

    Parameters that are not finite, or focal lengths not above zero, raise ValueError. `with_params` alone takes them,
    as of an optimizer; that camera of a batch then sees nothing: no point is valid, and it has no gradient. Cameras of
    equal model, size and parameters are equal.

    Parameters given as Python numbers are float64. Whoever takes a camera and tensors computes in the dtype of the
    tensors, the methods as well. Every method is differentiable with respect to points, pixels and `params`, up to the
    third order where it undoes a distortion. A camera is a pytree with `params` as its only leaf, so that `torch.func`
    and `torch.utils.data.default_collate` accept it.

    Attributes:
        model: "pinhole", "radial_tangential", "rational" or "fisheye".
        params: fx, fy, cx, cy in pixels, then the distortion as OpenCV orders and defines it: none for a
            pinhole, k1, k2, p1, p2, k3 for radial_tangential, these and k4, k5, k6 for rational, k1, k2, k3, k4 for
            fisheye.
        size: (width, height) in pixels.
        check_values: whether the values of `params` are checked, which waits for a GPU.
    """

    model: str
    params: Float[Tensor, "*batch P"]
    size: tuple[int, int]
    check_values: InitVar[bool] = True

    follows_data: ClassVar[bool] = True
    """`full_precision` lets it have another dtype, and converts it."""

    def __post_init__(self, check_values: bool) -> None:
        if self.model not in distortion.MODELS:
            raise ValueError(f"unknown camera model {self.model!r}; known are {', '.join(distortion.MODELS)}")
        if not isinstance(self.params, Tensor):
            raise TypeError(f"params of a camera must be a tensor, not {type(self.params).__name__}")
        if len(self.size) != 2 or not all(side > 0 and side == int(side) for side in self.size):
            raise ValueError(f"size of a camera must be (width, height) in pixels, not {self.size}")
        if self.params.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"params of a camera must be float32 or float64, not {self.params.dtype}")
        expected = 4 + len(distortion.MODELS[self.model].coefficients)
        if self.params.shape[-1:] != (expected,):
            shape = tuple(self.params.shape)
            raise ValueError(f"a {self.model} camera has {expected} parameters, but params has shape {shape}")
        if check_values and not (self._is_traced or self._are_all_proper()):
            wrong = self.params.detach()[~self.is_proper][0].tolist()
            raise ValueError(f"a camera needs finite parameters and focal lengths above zero, got {wrong}")

    @property
    def _is_traced(self) -> bool:
        """Whether no decision may depend on values."""
        return torch.compiler.is_compiling() or in_transform() or self.params.is_meta

    @property
    def is_proper(self) -> Bool[Tensor, "*batch"]:
        """Which cameras have finite parameters and focal lengths above zero."""
        params = self.params.detach()
        return torch.isfinite(params).all(-1) & (params[..., :2] > 0).all(-1)

    def _are_all_proper(self) -> bool:
        """`is_proper` of all cameras, kept until the parameters change in place: it takes a fifth of a projection."""
        version = None if self.params.is_inference() else self.params._version
        known = self.__dict__.get("_proper")
        if version is None or known is None or known[0] != version:
            known = self.__dict__["_proper"] = version, bool(self.is_proper.all())
        are_proper: bool = known[1]
        return are_proper

    def _without_degenerate(self) -> Camera:
        """The camera, with harmless parameters and a mark where it is not proper, in which nothing is valid."""
        if "_usable" in self.__dict__ or (not self._is_traced and self._are_all_proper()):
            return self
        proper = self.is_proper
        harmless = self.params.new_tensor((1.0, 1.0, *(0.0,) * (self.params.shape[-1] - 2)))
        camera = self.with_params(torch.where(proper[..., None], self.params, harmless))
        camera.__dict__["_usable"] = proper
        return camera

    def __getstate__(self) -> dict[str, Any]:
        return {"model": self.model, "params": self.params, "size": self.size}

    @staticmethod
    def pinhole(fx: Scalar, fy: Scalar, cx: Scalar, cy: Scalar, size: tuple[int, int]) -> Camera:
        """A camera without distortion."""
        return Camera("pinhole", _stack(fx, fy, cx, cy), size)

    @staticmethod
    def radial_tangential(
        fx: Scalar,
        fy: Scalar,
        cx: Scalar,
        cy: Scalar,
        k1: Scalar,
        k2: Scalar,
        p1: Scalar,
        p2: Scalar,
        k3: Scalar = 0.0,
        *,
        size: tuple[int, int],
    ) -> Camera:
        """A camera with radial and tangential distortion, as OpenCV's default model."""
        return Camera("radial_tangential", _stack(fx, fy, cx, cy, k1, k2, p1, p2, k3), size)

    @staticmethod
    def fisheye(
        fx: Scalar,
        fy: Scalar,
        cx: Scalar,
        cy: Scalar,
        k1: Scalar,
        k2: Scalar,
        k3: Scalar,
        k4: Scalar,
        *,
        size: tuple[int, int],
    ) -> Camera:
        """An equidistant fisheye camera with a polynomial in the angle, as OpenCV's fisheye model."""
        return Camera("fisheye", _stack(fx, fy, cx, cy, k1, k2, k3, k4), size)

    @staticmethod
    def from_opencv(
        K: Numbers, dist: Numbers | None, size: tuple[int, int], *, fisheye: bool = False
    ) -> Camera:
        """The camera of a matrix and distortion coefficients, as `cv2.calibrateCamera` returns them.

        Args:
            K: camera matrix (..., 3, 3), without skew.
            dist: none, or 4, 5 or 8 coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]] in any of OpenCV's shapes,
                or (..., n) for (..., 3, 3); more, of a thin prism and a tilted sensor, must be zero. None is no
                distortion. Eight make the model "rational".
            size: (width, height) in pixels.
            fisheye: the four coefficients are those of `cv2.fisheye`.

        Raises:
            ValueError: The matrix is not (..., 3, 3), has a skew or another last row than 0, 0, 1, or the coefficients
                are of another number or not zero from the ninth on.
        """
        K = K if isinstance(K, Tensor) else torch.as_tensor(np.asarray(K), device="cpu")
        K = K if K.is_floating_point() else K.double()
        if K.shape[-2:] != (3, 3):
            raise ValueError(f"K must be (..., 3, 3), not {tuple(K.shape)}")
        if bool((K[..., 0, 1] != 0).any()) or bool((K[..., 1:, 0] != 0).any()):
            raise ValueError("K has a skew, or entries below its diagonal, which no camera model here has")
        if bool((K[..., 2, :] != K.new_tensor((0.0, 0.0, 1.0))).any()):
            raise ValueError("the last row of K must be 0, 0, 1")
        pinhole = torch.stack((K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]), dim=-1)
        k = torch.as_tensor([] if dist is None else dist, dtype=K.dtype, device=K.device)
        k = k.flatten() if K.ndim == 2 else k
        allowed = (0, 4) if fisheye else (0, 4, 5, 8, 12, 14)
        if k.shape[-1] not in allowed:
            raise ValueError(
                f"OpenCV's {'fisheye ' * fisheye}distortion has {', '.join(map(str, allowed))} coefficients, "
                f"not {k.shape[-1]}"
            )
        if bool((k[..., 8:] != 0).any()):
            raise ValueError(
                "coefficients from the ninth on, of a thin prism and a tilted sensor, are not modeled: calibrate "
                "without them, or undistort the images"
            )
        by_count = {0: "pinhole", 4: "radial_tangential", 5: "radial_tangential"}
        model = "fisheye" if fisheye else by_count.get(k.shape[-1], "rational")
        count = len(distortion.MODELS[model].coefficients)
        k = torch.nn.functional.pad(k[..., :count], (0, max(0, count - k.shape[-1])))
        return Camera(model, torch.cat((pinhole, k.expand(*pinhole.shape[:-1], count)), dim=-1), size)

    @property
    def fx(self) -> Float[Tensor, "*batch"]:
        """Focal length along x, pixels."""
        return self.params[..., 0]

    @property
    def fy(self) -> Float[Tensor, "*batch"]:
        """Focal length along y, pixels."""
        return self.params[..., 1]

    @property
    def cx(self) -> Float[Tensor, "*batch"]:
        """x of the principal point, pixels."""
        return self.params[..., 2]

    @property
    def cy(self) -> Float[Tensor, "*batch"]:
        """y of the principal point, pixels."""
        return self.params[..., 3]

    @property
    def focal(self) -> Float[Tensor, "*batch"]:
        """Geometric mean of fx and fy, pixels."""
        return (self.fx * self.fy).sqrt()

    @property
    def width(self) -> int:
        """Width of the images, pixels."""
        return self.size[0]

    @property
    def height(self) -> int:
        """Height of the images, pixels."""
        return self.size[1]

    @property
    def K(self) -> Float[Tensor, "*batch 3 3"]:
        """Calibration matrix, without the distortion."""
        zero, one = torch.zeros_like(self.fx), torch.ones_like(self.fx)
        entries = (self.fx, zero, self.cx, zero, self.fy, self.cy, zero, zero, one)
        return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))

    @property
    def limit(self) -> Float[Tensor, "*batch"]:
        """Extent of the monotone distortion: a radius in x/z, y/z, or an angle for a fisheye; may be infinite."""
        k = self.params.detach()[..., 4:]
        if self._is_traced:
            return self._distortion.limit(k)
        # Kept, since it takes longer than the distortion itself, until an optimizer changes the parameters in place.
        known = self.__dict__.get("_limit")
        if known is None or not torch.equal(known[0], k):
            known = self.__dict__["_limit"] = k.clone(), self._distortion.limit(k)
        limit: Tensor = known[1]
        return limit

    @property
    def _distortion(self) -> distortion.Distortion:
        return distortion.MODELS[self.model]

    def with_params(self, params: Float[Tensor, "*batch P"]) -> Camera:
        """Replace the parameters, whose values are not checked, keeping model and size."""
        # Not `replace`: compiled graphs of torch 2.5 do not take it.
        return Camera(self.model, params, self.size, check_values=False)

    def __getitem__(self, index: Any) -> Camera:
        """Index the leading dimensions of many cameras, as for a tensor."""
        if self.params.ndim == 1:
            raise IndexError("this is one camera: its parameters have no leading dimension")
        index = index if isinstance(index, tuple) else (index,)
        chosen = self.with_params(self.params[(*index, ..., slice(None))])
        if self.model != "pinhole":  # found once for each camera, not for each time that it is chosen
            chosen.__dict__["_limit"] = chosen.params.detach()[..., 4:].clone(), self.limit[index]
        return chosen

    @staticmethod
    def stack(cameras: Sequence[Camera]) -> Camera:
        """Stack cameras along a leading dimension. Raises ValueError if they differ in model or size."""
        kinds = sorted({(camera.model, tuple(camera.size)) for camera in cameras})
        if len(kinds) != 1:
            raise ValueError(f"cameras of a batch must have one model and one size, not {kinds}")
        return cameras[0].with_params(torch.stack([camera.params for camera in cameras]))

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """Move the camera to another device or dtype; arguments as of `Tensor.to`."""
        return self.with_params(self.params.to(*args, **kwargs))

    @_in_dtype_of_data
    def project(
        self, points_c: Float[Tensor, "*#batch N 3"]
    ) -> tuple[Float[Tensor, "*#batch N 2"], Bool[Tensor, "*#batch N"]]:
        """Project points in the camera frame.

        Returns:
            Pixels, always finite, and valid: in front of the camera and within the monotone part of the distortion.
            Invalid points get the center of the image and no gradient.
        """
        normalized, valid = self._normalize_points(points_c)
        distorted = self._distortion.distort(normalized, self.params[..., None, 4:])
        return self._to_pixels(distorted, valid), valid

    @_in_dtype_of_data
    def project_with_point_jacobians(
        self, points_c: Float[Tensor, "*#batch N 3"]
    ) -> tuple[Float[Tensor, "*#batch N 2"], Bool[Tensor, "*#batch N"], Float[Tensor, "*#batch N 2 3"]]:
        """Project points; also return the analytic derivatives by the points, zero where invalid."""
        normalized, valid = self._normalize_points(points_c)
        coefficients, focal = self.params[..., None, 4:], self.params[..., None, :2]
        distorted = self._distortion.distort(normalized, coefficients)
        inverse_depth = torch.where(valid, 1 / points_c[..., 2].masked_fill(~valid, 1.0), 0.0)
        scale = focal * inverse_depth[..., None]
        slope = self._distortion.slope(normalized, coefficients) * scale[..., None]
        a, b, c, d, x, y = *slope.flatten(-2).unbind(-1), *normalized.unbind(-1)
        rows = torch.stack((a, b, -(a * x + b * y), c, d, -(c * x + d * y)))
        J = rows.unflatten(0, (2, 3)).movedim((0, 1), (-2, -1))
        return self._to_pixels(distorted, valid), valid, J

    @_in_dtype_of_data
    def project_with_jacobians(
        self, points_c: Float[Tensor, "*#batch N 3"]
    ) -> tuple[
        Float[Tensor, "*#batch N 2"],
        Bool[Tensor, "*#batch N"],
        Float[Tensor, "*#batch N 2 3"],
        Float[Tensor, "*#batch N 2 P"],
    ]:
        """Project points; also return the analytic derivatives by points and `params`, zero where invalid."""
        pixels, valid, J_points = self.project_with_point_jacobians(points_c)
        normalized, _ = self._normalize_points(points_c)
        coefficients, focal = self.params[..., None, 4:], self.params[..., None, :2, None]
        distorted = self._distortion.distort(normalized, coefficients)
        J_center = torch.eye(2, dtype=pixels.dtype, device=pixels.device).expand(*pixels.shape, 2)
        J_coefficients = focal * self._distortion.coefficient_slope(normalized, coefficients)
        J_params = torch.cat((torch.diag_embed(distorted), J_center, J_coefficients), dim=-1)
        return pixels, valid, J_points, torch.where(valid[..., None, None], J_params, 0.0)

    @_in_dtype_of_data
    def normalize(self, pixels: Float[Tensor, "*#batch N 2"]) -> Float[Tensor, "*#batch N 2"]:
        """Compute x/z, y/z of pixels, clamped to the edge of the monotone distortion; NaN gives the center."""
        # Replaced before the parameters see it: zero times NaN would be their gradient.
        finite = torch.isfinite(pixels)
        if (usable := self.__dict__.get("_usable")) is not None:
            finite = finite & usable[..., None, None]
        pixels = torch.where(finite, pixels, self.params.detach()[..., None, 2:4])
        distorted = (pixels - self.params[..., None, 2:4]) / self.params[..., None, :2]
        distorted = torch.where(torch.isfinite(distorted), distorted, 0.0)
        return self._distortion.undistort(distorted, self.params[..., None, 4:], self.limit[..., None])

    @_in_dtype_of_data
    def unproject(self, pixels: Float[Tensor, "*#batch N 2"]) -> Float[Tensor, "*#batch N 3"]:
        """Compute bearings of unit length of pixels."""
        ray = homogeneous(self.normalize(pixels))
        return ray / ray.norm(dim=-1, keepdim=True)

    @without_autocast
    def in_image(self, pixels: Float[Tensor, "*batch 2"], border: float = 0.0) -> Bool[Tensor, "*batch"]:
        """Test whether pixels lie inside the image, `border` pixels away from its edge."""
        x, y = pixels.unbind(-1)
        # The image reaches half a pixel beyond the centers of its outermost pixels.
        low = border - 0.5
        return (x >= low) & (x <= self.width - 1 - low) & (y >= low) & (y <= self.height - 1 - low)

    @_in_dtype_of_data
    def pixel_scale(self, normalized: Float[Tensor, "*#batch N 2"]) -> Float[Tensor, "*#batch N 2"]:
        """Pixels per unit of x/z and y/z, locally; with distortion, the mean over all directions."""
        scale = self.params[..., None, :2].expand(normalized.shape)
        if self.model == "pinhole":
            return scale
        J = self._distortion.slope(normalized, self.params[..., None, 4:])
        return scale * torch.linalg.det(J).abs().sqrt()[..., None]

    def _to_pixels(self, distorted: Tensor, valid: Tensor) -> Tensor:
        pixels = distorted * self.params[..., None, :2] + self.params[..., None, 2:4]
        middle = pixels.new_tensor((0.5 * (self.width - 1), 0.5 * (self.height - 1)))
        return torch.where(valid[..., None], pixels, middle)

    def _normalize_points(self, points_c: Tensor) -> tuple[Tensor, Tensor]:
        """x/z, y/z, zero where invalid, and validity."""
        depth = points_c[..., 2]
        tiny = torch.finfo(depth.dtype).eps
        valid = (depth > tiny) & torch.isfinite(points_c).all(-1)
        if (usable := self.__dict__.get("_usable")) is not None:
            valid = valid & usable[..., None]
        safe = torch.where(valid[..., None], points_c, 1.0)
        normalized = safe[..., :2] / safe[..., 2:]
        if self.model != "pinhole":
            radius = distortion.length(normalized.detach())
            valid = valid & (self._distortion.coordinate(radius) < self.limit[..., None])
        return torch.where(valid[..., None], normalized, 0.0), valid


def _stack(*values: Scalar) -> Float[Tensor, "*batch P"]:
    tensors = [value for value in values if isinstance(value, Tensor)]
    dtype = reduce(torch.promote_types, [tensor.dtype for tensor in tensors]) if tensors else torch.float64
    device = tensors[0].device if tensors else "cpu"
    columns = [torch.as_tensor(value, dtype=dtype, device=device) for value in values]
    return torch.stack(torch.broadcast_tensors(*columns), dim=-1)


def _flatten(camera: Camera) -> tuple[list[Any], tuple[str, tuple[int, int]]]:
    return [camera.params], (camera.model, camera.size)


def _unflatten(leaves: Iterable[Any], structure: tuple[str, tuple[int, int]]) -> Camera:
    """Unchecked: trees hold other things than tensors, too, such as dimensions."""
    camera = object.__new__(Camera)
    model, size = structure
    (params,) = leaves
    camera.__dict__.update(model=model, params=params, size=size)
    return camera


def _collate(cameras: Sequence[Camera], *, collate_fn_map: object = None) -> Camera:
    return Camera.stack(cameras)


# A camera is a pytree of its parameters for `torch.func` and `default_collate`. Model and size are structure: they must
# agree where trees are compared, and in a batch.
register_pytree(Camera, "params", _flatten, _unflatten)
default_collate_fn_map[Camera] = _collate
torch.serialization.add_safe_globals([Camera])  # `torch.load` with weights_only reads it
