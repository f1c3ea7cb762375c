"""Gradients of a minimizer by the implicit function theorem, of any order and in both directions.

At a minimum theta* of a cost with inputs x the gradient g(theta*, x) is zero, so d theta* = -H^-1 (dg/dx) dx with the
exact Hessian H = dg/dtheta. For a loss with gradient v at theta* the gradient to the inputs is therefore
-d/dx [g(theta*, x) . lambda] with H lambda = v: one linear solve and one pass of autograd over a scalar, however many
iterations led to the minimum. The solve is differentiable in turn, by solves with the same H, so that gradients of
gradients are right. Source: Krantz and Parks, "The implicit function theorem", 2002; Gould et al., "Deep declarative
networks", 2021.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import Any, Literal, ParamSpec, Protocol, TypeVar

import torch
from torch import Tensor
from torch.func import grad, vjp, vmap
from torch.overrides import TorchFunctionMode

from torchslam.geometry.precision import full_precision
from torchslam.utils.torch_internals import forward_mode_depth, has_tangent, in_transform, is_transformed

P = ParamSpec("P")
R = TypeVar("R")

Backward = Literal["implicit", "unroll", "truncated", "detached"]
"""How gradients pass a minimization.

"implicit":  the exact gradient at the minimum; memory does not depend on the iterations
"unroll":    through every iteration, also to the start; memory grows with the iterations
"truncated": through one last Gauss-Newton step from the detached minimum; biased with a robust kernel
"detached":  none
"""

Tensors = tuple[Tensor, ...]
Ndims = tuple[int, ...]
InDims = Sequence[int | None]
"""The mapped dimension of each tensor under `vmap`; None where all elements share the tensor."""


def _alone(function: Callable[P, R]) -> Callable[P, R]:
    """The function in full precision, without anomaly detection inside, which `vmap` cannot do: autograd tests what it
    returns."""
    exact = full_precision(function)

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        if not torch.is_anomaly_enabled():
            return exact(*args, **kwargs)
        with torch.autograd.set_detect_anomaly(False):
            return exact(*args, **kwargs)

    return alone


class Minimization(Protocol):
    """A cost over unknowns theta and inputs x, and how it is minimized.

    inputs: the tensors x. found: what `minimize` returns, first the `num_unknowns` tensors of theta. A vector, such as
    a direction, is `num_vectors` tensors in the tangent space of theta. All but `minimize` and `factorized` must be
    differentiable, without decisions that depend on values.
    """

    num_unknowns: int
    num_vectors: int
    ndims: tuple[Ndims, Ndims, Ndims]
    """Dimensions of the tensors of a vector, of found and of inputs without that of a batch, which may lead each."""

    def minimize(self, inputs: Tensors) -> Tensors:
        """The minimum, followed by the other results, the last of which are `Convergence.tensors`."""
        ...

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        """The function v -> H^-1 v with the exact Hessian at the minimum; zero where that is not definite."""
        ...

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        """() the derivative g . direction of the cost."""
        ...

    def slopes(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Iterator[Tensor]:
        """Parts of `slope`, which sum to it and have no graph in common: one in memory at a time."""
        yield self.slope(found, inputs, direction)

    def retracted(self, found: Tensors, direction: Tensors) -> Tensors:
        """Return `found` with theta moved along a direction."""
        ...

    def push(self, found: Tensors, direction: Tensors) -> Tensors:
        """The change of the tensors of theta to first order in a direction."""
        ...

    def pull_back(self, found: Tensors, gradient: Tensors) -> Tensors:
        """The gradient in the tangent space of a loss with this gradient in the tensors of theta."""
        ...


def find_minimum(
    problem: Minimization, inputs: Sequence[Tensor], backward: Backward, closed_over: Sequence[Tensor] = ()
) -> Tensors:
    """What `problem.minimize` finds, with the gradients of `backward`; "truncated" here means detached.

    With "implicit", theta has its implicit derivatives to the inputs and to the tensors that functions of the problem
    close over, and the rest is detached. Raises RuntimeError for forward mode within forward mode, where PyTorch would
    silently drop a part.
    """
    if not torch.is_inference_mode_enabled():  # what was made under it can be no part of a graph
        inputs = [tensor.clone() if tensor.is_inference() else tensor for tensor in inputs]
    if backward == "unroll":
        return problem.minimize(tuple(inputs))
    if backward != "implicit":
        inputs = [tensor.detach() for tensor in inputs]
    elif closed_over:
        problem, inputs = _Closed(problem, tuple(closed_over)), [*inputs, *closed_over]
    if forward_mode_depth() > 1:
        raise RuntimeError(
            "forward mode within forward mode is not supported: take torch.func.jacfwd of torch.func.jacrev"
        )
    return _Minimum.apply(problem, *inputs)


class _Exchange(TorchFunctionMode):
    """Calls of PyTorch take other tensors in the place of some, as they are or in lists."""

    def __init__(self, exchanged: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.exchanged = exchanged

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = {name: self._of(value) for name, value in (kwargs or {}).items()}
        return self.returned(func(*map(self._of, args), **kwargs))

    def returned(self, value: Any) -> Any:
        """What a call returned."""
        return value

    def _of(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            return self.exchanged(value)
        return type(value)(map(self._of, value)) if type(value) in (list, tuple) else value


class _Listing(_Exchange):
    """Calls of PyTorch take detached tensors; lists those from outside that have derivatives."""

    def __init__(self) -> None:
        super().__init__(self._listed)
        self.inside: dict[int, Any] = {}  # kept, so that no number is used twice
        self.outside: dict[int, tuple[Tensor, Tensor]] = {}

    def returned(self, value: Any) -> Any:
        for each in value if isinstance(value, (list, tuple)) else (value,):
            self.inside[id(each)] = each
        return value

    def _listed(self, tensor: Tensor) -> Tensor:
        number = id(tensor)
        if number in self.inside or not tensor.is_floating_point():
            return tensor
        if number not in self.outside:
            if not (tensor.requires_grad or is_transformed(tensor) or has_tangent(tensor)):
                return tensor
            self.outside[number] = tensor, tensor.detach()
        return self.outside[number][1]


def tensors_closed_over(function: Callable[..., Tensor], *arguments: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The value, and the tensors with derivatives that a function uses beside its arguments, as of one call.

    Raises ValueError where the value has a gradient to another tensor, which is none of those that PyTorch was called
    with: one within `torch.jit.script` or an `autograd.Function`.
    """
    arguments = tuple(tensor.detach() for tensor in arguments)
    listing = _Listing()
    listing.inside = {id(tensor): tensor for tensor in arguments}
    with torch.enable_grad(), listing:
        value = function(*arguments)
    if value.requires_grad and not in_transform():
        raise ValueError(
            "the error depends on a tensor with gradient that cannot be found, as within torch.jit.script or an "
            "autograd.Function: make it an input"
        )
    return value, [tensor for tensor, _ in listing.outside.values()]


class _Closed:
    """A minimization whose last inputs are the tensors that its functions close over."""

    def __init__(self, problem: Minimization, tensors: Tensors) -> None:
        self.problem, self.tensors = problem, tensors
        self.num_unknowns, self.num_vectors = problem.num_unknowns, problem.num_vectors
        self.dims = tuple(tensor.ndim for tensor in tensors)
        self.ndims = *problem.ndims[:2], (*problem.ndims[2], *self.dims)
        self.retracted, self.push, self.pull_back = problem.retracted, problem.push, problem.pull_back

    def minimize(self, inputs: Tensors) -> Tensors:
        inputs, exchange = self._split(inputs)
        with exchange:
            return self.problem.minimize(inputs)

    def factorized(self, found: Tensors, inputs: Tensors) -> Callable[[Tensors], Tensors]:
        inputs, exchange = self._split(inputs)
        with exchange:
            return self.problem.factorized(found, inputs)

    def slope(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Tensor:
        inputs, exchange = self._split(inputs)
        with exchange:
            return self.problem.slope(found, inputs, direction)

    def slopes(self, found: Tensors, inputs: Tensors, direction: Tensors) -> Iterator[Tensor]:
        inputs, exchange = self._split(inputs)
        parts = self.problem.slopes(found, inputs, direction)
        while True:
            with exchange:  # not while the caller uses a part
                part = next(parts, None)
            if part is None:
                return
            yield part

    def _split(self, inputs: Tensors) -> tuple[Tensors, AbstractContextManager[Any]]:
        """The inputs of the problem itself, and the context in which the others stand in for what is closed over."""
        inputs, others = _split(inputs, len(inputs) - len(self.tensors))
        if any(tensor.ndim != dims for tensor, dims in zip(others, self.dims, strict=True)):
            raise RuntimeError(
                "vmap over a tensor that an error closes over is not supported: make it an input"
            )
        pairs = zip(self.tensors, others, strict=True)
        places = {id(own): (own, other) for own, other in pairs if own is not other}
        if not places:
            return inputs, nullcontext()
        return inputs, _Exchange(lambda tensor: places.get(id(tensor), (tensor, tensor))[1])


class _Minimum(torch.autograd.Function):
    """inputs -> found."""

    @staticmethod
    @_alone
    def forward(problem: Minimization, *inputs: Tensor) -> Tensors:
        return tuple(tensor.detach() for tensor in problem.minimize(inputs))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.problem, *tensors = inputs
        ctx.num_inputs = len(tensors)
        ctx.mark_non_differentiable(*output[ctx.problem.num_unknowns :])
        ctx.save_for_backward(*tensors, *output)
        ctx.save_for_forward(*tensors, *output)

    @staticmethod
    @_alone
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Any, ...]:
        problem, needed = ctx.problem, ctx.needs_input_grad[1:]
        inputs, found = _split(ctx.saved_tensors, ctx.num_inputs)
        if not torch.is_grad_enabled() and not in_transform():
            vector = problem.pull_back(found, tuple(gradient[: problem.num_unknowns]))
            direction = problem.factorized(found, inputs)(vector)
            opposite = tuple(-part for part in direction)
            return None, *_last_gradient(lambda x: problem.slopes(found, x, opposite), inputs, needed)
        right = problem.pull_back(found, gradient[: problem.num_unknowns])
        direction = _solve(problem, right, found, inputs)
        return None, *_gradient(lambda x: -problem.slope(found, x, direction), inputs, needed)

    @staticmethod
    @_alone
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> tuple[Tensor | None, ...]:
        problem = ctx.problem
        inputs, found = _split(ctx.saved_tensors, ctx.num_inputs)

        def change_of_slope(direction: Tensors) -> Tensor:
            return _along(lambda x: problem.slope(found, x, direction), inputs, changes)

        at_zero = _zeros(problem.pull_back(found, found[: problem.num_unknowns]))
        direction = _solve(problem, grad(change_of_slope)(at_zero), found, inputs)
        change = problem.push(found, tuple(-part for part in direction))
        return (*change, *(None for _ in found[problem.num_unknowns :]))

    @staticmethod
    def vmap(info: Any, in_dims: InDims, problem: Minimization, *inputs: Tensor) -> tuple[Tensors, Any]:
        def apply(*tensors: Tensor) -> Tensors:
            return _Minimum.apply(problem, *tensors)

        before = (0,) * len(inputs)
        found = _vmap_by_fold(apply, info.batch_size, in_dims[1:], inputs, problem.ndims[2], before)
        return found, (0,) * len(found)


class _Solve(torch.autograd.Function):
    """right, found, inputs -> H^-1 right; `many` dimensions of right sides of the same H lead `right`."""

    @staticmethod
    @_alone
    def forward(problem: Minimization, many: int, num_found: int, *tensors: Tensor) -> Tensors:
        right, found, inputs = _parts(problem, num_found, tensors)
        return tuple(_nested_vmap(problem.factorized(found, inputs), many)(right))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.problem, ctx.many, ctx.num_found, *tensors = inputs
        ctx.save_for_backward(*output, *tensors)
        ctx.save_for_forward(*output, *tensors)

    @staticmethod
    @_alone
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Any, ...]:
        problem, many = ctx.problem, ctx.many
        direction, tensors = _split(ctx.saved_tensors, problem.num_vectors)
        _, found, inputs = _parts(problem, ctx.num_found, tensors)
        adjoint = _solve(problem, gradient, found, inputs, many)
        curvature = _curvature_of(problem, len(found), direction, tuple(-part for part in adjoint), many)
        needed = ctx.needs_input_grad[3 + problem.num_vectors :]
        return (None, None, None, *adjoint, *_gradient(curvature, (*found, *inputs), needed))

    @staticmethod
    @_alone
    def jvp(ctx: Any, _: None, __: None, ___: None, *changes: Tensor | None) -> Tensors:
        problem, many = ctx.problem, ctx.many
        direction, tensors = _split(ctx.saved_tensors, problem.num_vectors)
        right, found, inputs = _parts(problem, ctx.num_found, tensors)

        def change_of_curvature(probe: Tensors) -> Tensor:
            curvature = _curvature_of(problem, len(found), direction, probe, many)
            return _along(curvature, (*found, *inputs), changes[len(right) :])

        hessian_product = grad(change_of_curvature)(_zeros(right))
        left = tuple(
            -part if change is None else change - part
            for change, part in zip(changes[: len(right)], hessian_product, strict=True)
        )
        return _solve(problem, left, found, inputs, many)

    @staticmethod
    def vmap(
        info: Any, in_dims: InDims, problem: Minimization, many: int, num_found: int, *tensors: Tensor
    ) -> tuple[Tensors, Any]:
        dims, count = in_dims[3:], problem.num_vectors
        if all(dim is None for dim in dims[count:]):
            right, found, inputs = _parts(problem, num_found, tensors)
            right = tuple(_leading(x, dim, info.batch_size) for x, dim in zip(right, dims, strict=False))
            return _solve(problem, right, found, inputs, many + 1), (0,) * count

        def apply(*tensors: Tensor) -> Tensors:
            return _Solve.apply(problem, many, num_found, *tensors)

        before = (many,) * count + (0,) * (len(tensors) - count)
        solved = _vmap_by_fold(apply, info.batch_size, dims, tensors, sum(problem.ndims, ()), before)
        return tuple(part.movedim(many, 0) for part in solved), (0,) * count


def _solve(
    problem: Minimization, right: Sequence[Tensor], found: Tensors, inputs: Tensors, many: int = 0
) -> Tensors:
    return _Solve.apply(problem, many, len(found), *right, *found, *inputs)


def _parts(
    problem: Minimization, num_found: int, tensors: Sequence[Tensor]
) -> tuple[Tensors, Tensors, Tensors]:
    """A vector, found and inputs."""
    right, rest = _split(tensors, problem.num_vectors)
    found, inputs = _split(rest, num_found)
    return right, found, inputs


def _split(tensors: Sequence[Tensor], count: int) -> tuple[Tensors, Tensors]:
    return tuple(tensors[:count]), tuple(tensors[count:])


def _zeros(tensors: Tensors) -> Tensors:
    return tuple(torch.zeros_like(tensor) for tensor in tensors)


def _curvature_of(
    problem: Minimization, num_found: int, direction: Tensors, probe: Tensors, many: int
) -> Callable[[Tensors], Tensor]:
    """The function (*found, *inputs) -> () probe . H direction, summed over `many` dimensions of both."""

    def curvature(tensors: Tensors) -> Tensor:
        found, inputs = _split(tensors, num_found)

        def of_one(ends: tuple[Tensors, Tensors]) -> Tensor:
            direction, probe = ends
            product = grad(lambda step: problem.slope(problem.retracted(found, step), inputs, probe))
            pairs = zip(product(_zeros(direction)), direction, strict=True)
            return torch.stack([(x * y).sum() for x, y in pairs]).sum()

        return _nested_vmap(of_one, many)((direction, probe)).sum()

    return curvature


def _last_gradient(
    parts: Callable[[Tensors], Iterable[Tensor]], tensors: Tensors, needed: Sequence[bool]
) -> list[Tensor | None]:
    """The gradient of a sum of parts to the tensors that need it, itself without graph: the cheap way."""
    leaves = tuple(x.detach().requires_grad_(need) for x, need in zip(tensors, needed, strict=True))
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    sums: list[Tensor | None] = [None] * len(wanted)
    with torch.enable_grad():
        for part in parts(leaves):
            grads = torch.autograd.grad(part, wanted, allow_unused=True) if part.requires_grad else ()
            for row, found in enumerate(grads):
                before = sums[row]
                # Not in place: gradients may share memory with each other.
                sums[row] = before if found is None else found if before is None else before + found
    each = iter(sums)
    return [next(each) if need else None for need in needed]


def _gradient(
    function: Callable[[Tensors], Tensor], tensors: Tensors, needed: Sequence[bool]
) -> list[Tensor | None]:
    """The gradient to the tensors that need it, differentiable, under any transform."""
    needed = [need and tensor.is_floating_point() for need, tensor in zip(needed, tensors, strict=True)]

    def of(*wanted: Tensor) -> Tensor:
        given = iter(wanted)
        return function(tuple(next(given) if need else x for x, need in zip(tensors, needed, strict=True)))

    value, pull = vjp(of, *(x for x, need in zip(tensors, needed, strict=True) if need))[:2]
    grads = iter(pull(torch.ones_like(value)))
    return [next(grads) if need else None for need in needed]


def _along(
    function: Callable[[Tensors], Tensor], tensors: Tensors, changes: Sequence[Tensor | None]
) -> Tensor:
    """() the derivative of a function along changes of its tensors, differentiable, by reverse mode alone."""
    gradient = _gradient(function, tensors, [change is not None for change in changes])
    products = [
        (slope * change).sum()
        for slope, change in zip(gradient, changes, strict=True)
        if slope is not None and change is not None
    ]
    return torch.stack(products).sum()


def _nested_vmap(function: Callable[[Any], Any], many: int) -> Callable[[Any], Any]:
    """Map a function over `many` additional leading dimensions of its tensors."""
    for _ in range(many):
        function = vmap(function)
    return function


def _leading(tensor: Tensor, dim: int | None, size: int) -> Tensor:
    """Move the mapped dimension to the front, or expand a shared tensor."""
    return tensor.expand(size, *tensor.shape) if dim is None else tensor.movedim(dim, 0)


def _vmap_by_fold(
    function: Callable[..., Tensors],
    size: int,
    dims: InDims,
    tensors: Sequence[Tensor],
    ndims: Sequence[int],
    before: Sequence[int],
) -> Tensors:
    """Fold the mapped dimension into the batch dimension of the function, which follows `before` dimensions."""
    batched = [
        x.ndim - (dim is not None) > ndim + skip
        for x, dim, ndim, skip in zip(tensors, dims, ndims, before, strict=True)
    ]
    batch = next(
        x.shape[skip + (dim is not None and dim <= skip)]
        for x, dim, skip, has in zip(tensors, dims, before, batched, strict=True)
        if has
    )
    rows = []
    for x, dim, skip, has in zip(tensors, dims, before, batched, strict=True):
        if dim is None and not has:
            rows.append(x)
            continue
        x = _leading(x, dim, size).movedim(0, skip)
        if not has:
            x = x.unsqueeze(skip + 1).expand(*x.shape[: skip + 1], batch, *x.shape[skip + 1 :])
        rows.append(x.flatten(skip, skip + 1))
    skip = before[0]
    return tuple(part.unflatten(skip, (size, batch)) for part in function(*rows))
