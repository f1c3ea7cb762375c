"""Every public function with arguments that do not fit: the right result, or one clear error."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.optim.conftest import camera_of
from tests.optim.test_run_graph import simulated
from tests.sweep.calls import B, Call, N, binary_features, calls, rand
from torchslam import evaluation, features, geometry, optim
from torchslam.errors import TorchslamError
from torchslam.geometry import Camera
from torchslam.optim.run_graph import solve_graph

pytestmark = pytest.mark.usefixtures("without_shape_checks")

CALLS = calls()
Path = tuple[Any, ...]
CLEAR = (ValueError, TypeError, TorchslamError)
OF_PROBLEMS = {"check_gradient", "marginalize"}
"""Take one whole graph or problem, and return no tensors of each element."""
NO_TENSORS = {"extractor"}
"""Public functions without tensors."""
WITH_WEIGHTS = {"XFeat", "ALIKED"}
"""Networks, whose weights are not at hand."""


ANY_KIND = {("bits",), ("inputs", 0), ("inputs", 1)}
"""Arguments that may be of any kind."""
OWN_SHAPE = {("inputs", 0), ("inputs", 1), ("start",), ("images",)}
"""Arguments of which another shape is another problem."""


def leaves(value: Any, path: Path = ()) -> Iterator[tuple[Path, Tensor]]:
    """The tensors in arguments or results, with their place."""
    if isinstance(value, Tensor):
        yield path, value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from leaves(each, (*path, key))
    elif isinstance(value, tuple | list):
        for key, each in enumerate(value):
            yield from leaves(each, (*path, key))
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            if not field.name.startswith("_"):
                yield from leaves(getattr(value, field.name), (*path, field.name))


def changed(value: Any, path: Path, tensor: Tensor) -> Any:
    """The arguments with another tensor in one place."""
    if not path:
        return tensor
    key, *rest = path
    if isinstance(value, dict):
        return {**value, key: changed(value[key], tuple(rest), tensor)}
    if isinstance(value, tuple | list):
        parts = [changed(each, tuple(rest), tensor) if i == key else each for i, each in enumerate(value)]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    return replace(value, **{key: changed(getattr(value, key), tuple(rest), tensor)})


def mapped(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    for path, tensor in list(leaves(value)):
        value = changed(value, path, change(tensor))
    return value


def flat(result: Any) -> list[Tensor]:
    return [tensor for _, tensor in leaves(result)]


def run(call: Call, arguments: dict[str, Any] | None = None) -> list[Tensor]:
    found = call.function(**(call.arguments if arguments is None else arguments))
    return flat(found)


def refused(call: Call, path: Path, tensor: Tensor, name: str) -> list[Tensor] | None:
    """The result with another tensor in one place, or None where one clear line names the argument."""
    try:
        return run(call, changed(call.arguments, path, tensor))
    except CLEAR as error:
        text = str(error)
        assert "\n" not in text, text
        own = [each for each in path if isinstance(each, str)][-1]
        assert name in text or own in text, f"{text!r} does not name {name!r}"
        return None


def assert_same(found: list[Tensor], expected: list[Tensor], exact: bool = True) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        if exact:
            assert a.dtype == b.dtype
            assert a.shape == b.shape
            torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)
        elif b.is_floating_point():
            torch.testing.assert_close(a.to(b.dtype), b, rtol=1e-3, atol=1e-3, equal_nan=True)


def last(path: Path) -> str:
    """The name that a message must have."""
    names = [each for each in path if isinstance(each, str)]
    other = {
        "inputs": "input",
        "start": "unknown",
        "descriptors_1": "descriptors",
        "descriptors_2": "descriptors",
    }
    return other.get(names[-1], names[-1])


@pytest.fixture(params=list(CALLS))
def call(request: pytest.FixtureRequest) -> Call:
    return CALLS[request.param]


def test_the_sweep_has_every_public_function() -> None:
    for module in (geometry, optim, features, evaluation):
        names = getattr(module, "__all__", None) or [
            name for name, x in vars(module).items() if getattr(x, "__module__", "") == module.__name__
        ]
        for name in names:
            value = getattr(module, name)
            is_function = inspect.isfunction(value) and not name.startswith("_")
            if is_function or (inspect.isclass(value) and issubclass(value, nn.Module)):
                known = CALLS.keys() | NO_TENSORS | WITH_WEIGHTS | OF_PROBLEMS
                assert name in known, f"{name} is not in the sweep"


WRONG_DTYPES = {
    torch.float64: (torch.float16, torch.int64),
    torch.float32: (torch.float16, torch.int64),
    torch.bool: (torch.uint8, torch.float64, torch.int64),
    torch.int64: (torch.float32, torch.bool),
    torch.uint8: (torch.int64,),
}


def test_a_wrong_dtype_is_refused(call: Call) -> None:
    for path, tensor in leaves(call.arguments):
        for dtype in WRONG_DTYPES[tensor.dtype]:
            if path in ANY_KIND:
                continue
            found = refused(call, path, tensor.to(dtype), last(path))
            if found is not None:
                assert tensor.dtype == torch.bool, f"{path} is accepted as {dtype}"
                assert_same(found, run(call))


def test_a_mixture_of_precisions_is_refused_or_right(call: Call) -> None:
    expected = run(call)
    for path, tensor in leaves(call.arguments):
        if tensor.is_floating_point() and path != ("images",):
            other = torch.float32 if tensor.dtype == torch.float64 else torch.float64
            found = refused(call, path, tensor.to(other), "")
            if (
                found is not None and call is not CALLS["SimulatedFeatures"]
            ):  # which draws in the dtype of its poses
                assert_same(found, expected, exact=False)


def test_int32_is_refused_or_right(call: Call) -> None:
    expected = run(call)
    for path, tensor in leaves(call.arguments):
        if tensor.dtype == torch.int64:
            found = refused(call, path, tensor.int(), last(path))
            if found is not None:
                assert_same(found, expected, exact=False)


def test_a_column_is_refused_or_right(call: Call) -> None:
    """As OpenCV returns masks: (N, 1)."""
    expected = run(call)
    for path, tensor in leaves(call.arguments):
        if path in OWN_SHAPE or path[-1] == "params":  # of which the camera itself refuses another shape
            continue
        variants = [tensor[..., None]]
        if tensor.ndim >= 2 and tensor.shape[-1] != tensor.shape[-2]:
            variants.append(tensor.mT.contiguous())
        for variant in variants:
            found = refused(call, path, variant, "")
            if found is not None:
                assert_same(found, expected, exact=False)


@pytest.mark.parametrize("name", [name for name in CALLS if name in (*geometry.__all__, "ate", "rpe")])
def test_results_have_the_dtype_and_device_of_the_data(
    name: str, device: torch.device, dtype: torch.dtype
) -> None:
    def moved(tensor: Tensor) -> Tensor:
        return tensor.to(device, dtype if tensor.is_floating_point() else tensor.dtype)

    expected = run(CALLS[name])
    found = run(CALLS[name], mapped(CALLS[name].arguments, moved))
    for one, other in zip(found, expected, strict=True):
        assert one.device.type == device.type
        assert one.dtype == (dtype if other.is_floating_point() else other.dtype)
        assert one.shape[1:] == other.shape[1:]  # five_point has as many as it finds


@pytest.mark.parametrize("size", [B, N], ids=["batch", "rows"])
def test_nothing_gives_nothing_or_is_refused(call: Call, size: int) -> None:
    def emptied(tensor: Tensor) -> Tensor:
        for dim, length in enumerate(tensor.shape):
            if length == size and not (size == B and dim > 0):
                tensor = tensor.narrow(dim, 0, 0)
        return tensor

    try:
        found, message = run(call, mapped(call.arguments, emptied)), ""
    except CLEAR as error:
        found, message = [], str(error)
    assert "\n" not in message
    for tensor in found:
        assert not tensor.is_floating_point() or not tensor.isnan().any() or tensor.ndim < 2


def test_nan_stays_where_it_is(call: Call) -> None:
    """Without an error, and without an effect on other elements of the batch."""
    expected = run(call)
    for path, tensor in leaves(call.arguments):
        if not tensor.is_floating_point() or path[-1] == "params":
            continue
        broken = tensor.contiguous().clone()
        broken.view(-1)[0] = torch.nan
        found = refused(call, path, broken, "")
        if found is None or tensor.ndim == 0 or len(tensor) != B or len(found) != len(expected):
            continue
        for a, b in zip(found, expected, strict=True):
            if a.ndim and len(a) == B and a.shape == b.shape:
                torch.testing.assert_close(a[1:], b[1:], rtol=1e-6, atol=1e-6, equal_nan=True)


def test_inference_mode_gives_the_same_bytes(call: Call) -> None:
    expected = run(call)
    with torch.inference_mode():
        inside = run(call)
        arguments = mapped(call.arguments, torch.clone)
    assert_same(inside, expected)
    assert_same(run(call, arguments), expected)


def with_gradient(call: Call, arguments: dict[str, Any]) -> tuple[list[Tensor], list[Tensor]]:
    """Results, and the tensors of floats among the arguments, which have a gradient."""
    to: list[Tensor] = []

    def leaf(tensor: Tensor) -> Tensor:
        if not tensor.is_floating_point():
            return tensor
        to.append(tensor.detach().clone().requires_grad_())
        return to[-1]

    return run(call, mapped(arguments, leaf)), to


def gradients_of(found: list[Tensor], to: list[Tensor]) -> tuple[Tensor | None, ...]:
    """The gradients of the sum of all results that have one."""
    attached = [x.nan_to_num(0, 0, 0).sum() for x in found if x.requires_grad]
    return torch.autograd.grad(sum(attached), to, allow_unused=True) if attached else ()


def test_gradients_under_detect_anomaly(call: Call) -> None:
    if not call.gradient:
        return
    expected = gradients_of(*with_gradient(call, call.arguments))
    assert expected
    with torch.autograd.set_detect_anomaly(True):
        gradients = gradients_of(*with_gradient(call, call.arguments))
    for a, b in zip(gradients, expected, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert a.isfinite().all()
            torch.testing.assert_close(a, b)


def assert_autocast_changes_no_byte(call: Call, in_backward: bool = False) -> None:
    """Of float32 results and gradients, with the forward pass within it; of solvers the backward pass as well."""

    def single(tensor: Tensor) -> Tensor:
        return tensor.float() if tensor.is_floating_point() else tensor

    expected: list[Tensor] = []
    for forward, backward in ((False, False), (True, False), (False, in_backward)):
        with torch.autocast("cpu", torch.bfloat16, enabled=forward):
            results, to = with_gradient(call, mapped(call.arguments, single))
        with torch.autocast("cpu", torch.bfloat16, enabled=backward):
            found = results + [x for x in gradients_of(results, to) if x is not None]
        expected = expected or found
        assert_same(found, expected)


def test_autocast_changes_no_byte(call: Call) -> None:
    # Trajectories are of float64, and keypoints of ORB move by a hundredth of a pixel.
    if all(call is not CALLS[name] for name in ("evaluate", "ate_apart", "ORB")):
        assert_autocast_changes_no_byte(call, in_backward=any(call is CALLS[name] for name in SOLVERS))


def test_autocast_changes_no_byte_of_other_cameras_graphs_and_soft_matches() -> None:
    points, pixels = (
        CALLS["Camera.project"].arguments["points_c"],
        CALLS["Camera.normalize"].arguments["pixels"],
    )
    for model in ("pinhole", "fisheye"):
        for name in ("project", "project_with_jacobians", "project_with_point_jacobians"):
            method = getattr(Camera, name)
            assert_autocast_changes_no_byte(Call(method, {"self": camera_of(model), "points_c": points}))
        for name in ("normalize", "unproject"):
            method = getattr(Camera, name)
            assert_autocast_changes_no_byte(Call(method, {"self": camera_of(model), "pixels": pixels}))
    _, graph = simulated(frames=4, points=20)
    assert_autocast_changes_no_byte(Call(solve_graph, {"graph": graph}), in_backward=True)
    bits = binary_features()
    soft = replace(bits, descriptors=torch.nn.functional.normalize(rand(1, N, 64).float(), dim=-1))
    other = replace(soft, descriptors=soft.descriptors.flip(2).contiguous())
    arguments = {"features_1": soft, "features_2": other, "temperature": 0.1}
    assert_autocast_changes_no_byte(Call(features.match, arguments))


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def test_defaults_change_no_byte(call: Call) -> None:
    """A device without values shows where one is made without saying where."""
    expected = run(call)
    with default_dtype(torch.float64):
        assert_same(run(call), expected)
    with torch.device("meta"):
        found = run(call)
    assert_same(found, expected)


def test_vmap(call: Call) -> None:
    """Over a further dimension of all floats: the element itself gives what it gives alone."""
    if not call.vmap or not call.gradient:
        return
    places = [(path, tensor) for path, tensor in leaves(call.arguments) if tensor.is_floating_point()]
    expected = run(call)

    def function(*tensors: Tensor) -> tuple[Tensor, ...]:
        arguments = call.arguments
        for (path, _), tensor in zip(places, tensors, strict=True):
            arguments = changed(arguments, path, tensor)
        return tuple(run(call, arguments))

    stacked = [torch.stack((tensor, tensor)) for _, tensor in places]
    found = torch.vmap(function, out_dims=0)(*stacked)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a[1], b, rtol=1e-6, atol=1e-8, equal_nan=True)


SOLVERS = ("solve_pose", "solve_bundle", "solve_pose_graph", "solve_rotations", "solve_least_squares")


@pytest.mark.parametrize("name", SOLVERS)
def test_what_a_solver_starts_from_may_come_from_inference_mode(name: str) -> None:
    """As poses of `SLAM.step` do: they have no part in the gradient, or are copied."""
    call = CALLS[name]
    with torch.inference_mode():
        arguments = mapped(call.arguments, torch.clone)
    for path, tensor in leaves(call.arguments):
        if tensor.is_floating_point():
            gradients = []
            for others in (call.arguments, arguments):
                leaf = tensor.clone().requires_grad_()
                found = [x for x in run(call, changed(others, path, leaf)) if x.requires_grad]
                total = sum(x.nan_to_num(0, 0, 0).square().sum() for x in found)
                gradients.append(torch.autograd.grad(total, leaf, allow_unused=True)[0] if found else None)
            assert (gradients[0] is None) == (gradients[1] is None)
            if gradients[0] is not None:
                torch.testing.assert_close(gradients[1], gradients[0])
