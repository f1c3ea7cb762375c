"""Arguments of geometry have the shapes and kinds of the signature, and are computed in their own precision.

No autocast inside, no half precision, no mixture. A mask of shape (N, 1) would broadcast to a batch of N problems, ones
and zeros of integers would be taken for row numbers: results that look like any other.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from functools import cache, wraps
from types import NoneType, UnionType
from typing import Any, NamedTuple, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import torch
from jaxtyping import AbstractArray
from torch import Tensor

from torchslam.utils.torch_internals import is_any_autocast_enabled

P = ParamSpec("P")
R = TypeVar("R")

_FLOATS = (torch.float32, torch.float64)
_KINDS: dict[str, tuple[tuple[torch.dtype, ...], str]] = {
    "Float": (_FLOATS, "float32 or float64"),
    "Bool": ((torch.bool,), "bool"),
    "Int": ((torch.int64,), "int64"),
    "UInt8": ((torch.uint8,), "uint8"),
}


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with the same bits under `torch.autocast` as without, for tensors that its signature allows.

    Autocast would multiply matrices in bfloat16: rotations wrong in the third digit that look like any other. All
    tensors of floats must have one dtype, which cameras follow. A wrong type raises TypeError, a wrong dtype or shape
    ValueError, with the name of the argument.
    """
    return _precise(function, one_dtype=True)


def without_autocast(function: Callable[P, R]) -> Callable[P, R]:
    """As `full_precision`, for tensors of floats that may be of several dtypes."""
    return _precise(function, one_dtype=False)


def _precise(function: Callable[P, R], one_dtype: bool) -> Callable[P, R]:
    @wraps(function)
    def precise(*args: P.args, **kwargs: P.kwargs) -> R:
        if not (torch.compiler.is_compiling() or torch.jit.is_tracing()):
            dtype = _check_arguments(function, args, kwargs, one_dtype)
            if one_dtype and dtype is not None:
                args = tuple(_following(value, dtype) for value in args)  # type: ignore[assignment]
                kwargs = {name: _following(value, dtype) for name, value in kwargs.items()}  # type: ignore[assignment]
        if not is_any_autocast_enabled():
            return function(*args, **kwargs)
        for device_type in ("cpu", "cuda", "mps", "xpu"):
            if torch.is_autocast_enabled(device_type):
                with torch.autocast(device_type, enabled=False):  # and so on with the other kinds of device
                    return precise(*args, **kwargs)
        return function(*args, **kwargs)

    return precise


def in_widest_precision(function: Callable[P, R]) -> Callable[P, R]:
    """The function, all tensors of floats in the widest precision of any of them, float64 where none is float32 or
    float64; gradients come back in the precision of each. Cameras follow, numbers stay as they are."""

    @wraps(function)
    def widened(*args: P.args, **kwargs: P.kwargs) -> R:
        found = set(_dtypes_in((*args, *kwargs.values())))
        if len(found) < 2 and found <= set(_FLOATS):
            return function(*args, **kwargs)
        dtype = torch.float32 if torch.float32 in found and torch.float64 not in found else torch.float64
        args = tuple(in_dtype(value, dtype) for value in args)  # type: ignore[assignment]
        kwargs = {name: in_dtype(value, dtype) for name, value in kwargs.items()}  # type: ignore[assignment]
        return function(*args, **kwargs)

    return widened


def _dtypes_in(value: Any) -> Iterator[torch.dtype]:
    """The types of the tensors of floats in a value, its fields and its elements."""
    if isinstance(value, Tensor):
        if value.is_floating_point() and value.ndim:
            yield value.dtype
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _dtypes_in(each)
    elif is_dataclass(value) and not getattr(value, "follows_data", False):
        for each in fields(value):
            yield from _dtypes_in(getattr(value, each.name))


def in_dtype(value: Any, dtype: torch.dtype) -> Any:
    """A value with the tensors of floats in it, its fields and its elements in another type; cameras follow."""
    if isinstance(value, Tensor):
        return value.to(dtype) if value.is_floating_point() and value.ndim else value
    if type(value) in (list, tuple):
        return type(value)(in_dtype(each, dtype) for each in value)
    if getattr(value, "follows_data", False):
        return _following(value, dtype)
    if not is_dataclass(value) or isinstance(value, type) or not any(_dtypes_in(value)):
        return value
    changed = {each.name: in_dtype(getattr(value, each.name), dtype) for each in fields(value)}
    return replace(value, **changed)


def check_dtypes(**tensors: Tensor | None) -> None:
    """Raises ValueError unless all tensors are float32, or all float64; names the first that is not."""
    call = _Call(one_dtype=True)
    for name, tensor in tensors.items():
        if tensor is not None:
            if tensor.dtype not in _FLOATS:
                raise ValueError(f"{name} must be float32 or float64, not {tensor.dtype}")
            call.agree_on_dtype(name, tensor.dtype)


def check_positive(**numbers: float | None) -> None:
    """Raises ValueError unless all numbers that are given are above zero; names the first that is not."""
    for name, number in numbers.items():
        if number is not None and not number > 0:
            raise ValueError(f"{name} must be above zero, not {number}")


class _Form(NamedTuple):
    """One kind and shape that a tensor may have.

    dtypes: none for any; kind: these in words; before: dimensions in front of those of any number, each a size, a name,
    or None for any size; variadic: name of the dimensions of any number, None where there are none; after: those behind
    them; text: the shape as messages show it
    """

    dtypes: tuple[torch.dtype, ...]
    kind: str
    before: tuple[int | str | None, ...]
    variadic: str | None
    after: tuple[int | str | None, ...]
    broadcasts: bool
    text: str

    @classmethod
    def of(cls, annotation: Any) -> _Form:
        tokens = annotation.dim_str.split()
        place = next((i for i, token in enumerate(tokens) if "*" in token[:2] or token == "..."), None)
        shown = ["..." if i == place else token.strip("#") for i, token in enumerate(tokens)]
        dtypes, kind = _KINDS.get(annotation.__name__.split("[")[0], ((), ""))
        text = f"({', '.join(shown)}{',' * (len(shown) == 1)})"
        dims = tuple(_dimension(token) for token in tokens)
        if place is None:
            return cls(dtypes, kind, dims, None, (), False, text)
        variadic = tokens[place]
        return cls(
            dtypes, kind, dims[:place], variadic.strip("*#."), dims[place + 1 :], "#" in variadic, text
        )


def _dimension(token: str) -> int | str | None:
    """The size or the name of a dimension; None for a pattern such as `*batch`, or for an expression."""
    if token.isdigit():
        return int(token)
    name = token.strip("#")
    return token if name.isidentifier() and name != "_" else None


class _Argument(NamedTuple):
    """What one argument may be: a tensor of some form, an object with tensors, or, if open, something else as well."""

    name: str
    forms: tuple[_Form, ...]
    classes: tuple[type, ...]
    holds: tuple[_Argument, ...]
    is_open: bool

    @classmethod
    def of(cls, name: str, hint: Any) -> _Argument | None:
        """The requirements of a type hint on tensors; None where it has none."""
        alternatives = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        options = [each for each in alternatives if each is not NoneType]
        arrays = [each for each in options if isinstance(each, type) and issubclass(each, AbstractArray)]
        classes = tuple(each for each in options if isinstance(each, type) and _is_record(each))
        holds = tuple(_fields(classes[0], name)) if classes else ()
        if not (arrays or holds):
            return None
        is_open = len(options) > len(arrays) + len(classes)
        return cls(name, tuple(_Form.of(each) for each in arrays), classes, holds, is_open)


def _is_record(cls: type) -> bool:
    return is_dataclass(cls) or (issubclass(cls, tuple) and hasattr(cls, "_fields"))


def _fields(cls: type, name: str) -> Iterator[_Argument]:
    """The fields of a dataclass or named tuple that have requirements."""
    hints = get_type_hints(cls)
    names = [field.name for field in fields(cls)] if is_dataclass(cls) else cls._fields  # type: ignore[attr-defined]
    for field in names:
        argument = _Argument.of(f"{name}.{field}", hints[field])
        if argument is not None and not field.startswith("_"):
            yield argument


class _Call:
    """The sizes and the dtype that the arguments of one call, or the fields of one object, agree on."""

    def __init__(self, one_dtype: bool) -> None:
        self.one_dtype = one_dtype
        self.sizes: dict[str, tuple[int, str]] = {}
        self.batches: dict[str, tuple[tuple[int, ...], str]] = {}
        self.floats: tuple[torch.dtype, str] | None = None

    def check(self, argument: _Argument, value: Any) -> None:
        name = argument.name
        if not isinstance(value, Tensor):
            self._check_object(argument, value)
            return
        if not argument.forms:
            raise TypeError(f"{name} must be {_listed(argument.classes)}, not a tensor")
        fitting = [form for form in argument.forms if not form.dtypes or value.dtype in form.dtypes]
        if not fitting:
            kinds = " or ".join(dict.fromkeys(form.kind for form in argument.forms))
            raise ValueError(f"{name} must be {kinds}, not {value.dtype}")
        misfits = [self._misfit(form, name, tuple(value.shape)) for form in fitting]
        if None not in misfits:
            shapes = " or ".join(form.text + self._sizes_of(form) for form in fitting)
            raise ValueError(f"{name} must be {shapes}, not {tuple(value.shape)}{misfits[0]}")
        # A number takes any dtype, as in PyTorch.
        if fitting[0].dtypes and value.dtype in _FLOATS and value.ndim > 0:
            self.agree_on_dtype(name, value.dtype)

    def agree_on_dtype(self, name: str, dtype: torch.dtype) -> None:
        if self.floats is None:
            self.floats = dtype, name
        elif self.one_dtype and dtype != self.floats[0]:
            raise ValueError(
                f"{name} is {dtype}, but {self.floats[1]} is {self.floats[0]}: all must be the same"
            )

    def _check_object(self, argument: _Argument, value: Any) -> None:
        name = argument.name
        if not isinstance(value, argument.classes):
            if not argument.is_open:
                wanted = _listed(argument.classes) if argument.classes else "a tensor: see torch.as_tensor"
                raise TypeError(f"{name} is of type {type(value).__name__}, but must be {wanted}")
            return
        follows = getattr(value, "follows_data", False)
        inner = _Call(self.one_dtype and not follows)
        inner.floats = self.floats
        for field in argument.holds:
            content = getattr(value, field.name.rpartition(".")[2])
            if content is not None:
                inner.check(field, content)
        self.floats = self.floats if follows else inner.floats
        if "batch" not in inner.batches:
            return
        lead, field_name = inner.batches["batch"]
        if "B" in self.sizes:
            size, where = self.sizes["B"]
            if lead not in ((), (1,), (size,)):
                raise ValueError(
                    f"{field_name} must lead with B = {size} of {where} or not at all, not with {lead}"
                )
        elif "." not in name and "batch" in self.batches:
            batch, where = self.batches["batch"]
            if _broadcast(lead, batch) is None:
                raise ValueError(f"{field_name} leads with {lead}, which does not go with {batch} of {where}")

    def _sizes_of(self, form: _Form) -> str:
        """The shape in numbers where the arguments before have determined all of it."""
        names = [str(each).strip("#") for each in form.before]
        sizes = [each if each.isdigit() else self.sizes.get(each, ("", ""))[0] for each in names]
        if form.variadic is not None or "" in sizes or all(each.isdigit() for each in names):
            return ""
        return f" = ({', '.join(map(str, sizes))}{',' * (len(sizes) == 1)})"

    def _misfit(self, form: _Form, name: str, shape: tuple[int, ...]) -> str | None:
        """Why a shape does not fit; None where it fits, and then its sizes are those of the call."""
        before, after = form.before, form.after
        more = len(shape) - len(before) - len(after)
        if more < 0 or (more > 0 and form.variadic is None):
            return ""
        found: dict[str, tuple[int, str]] = {}
        sizes = shape[: len(before)] + shape[len(before) + more :]
        for dimension, size in zip(before + after, sizes, strict=True):
            if dimension is None or dimension == size:
                continue
            if isinstance(dimension, int):
                return ""
            if dimension[0] == "#":
                if size == 1:
                    continue
                dimension = dimension[1:]
            known = self.sizes.get(dimension) or found.get(dimension)
            if known is None:
                found[dimension] = size, name
            elif known[0] != size:
                return f": {dimension} is {known[0]} in {known[1]}" if form.variadic else ""
        if form.variadic:
            batch = shape[len(before) : len(before) + more]
            known_batch = self.batches.get(form.variadic)
            if known_batch is not None and known_batch[0] != batch:
                both = _broadcast(known_batch[0], batch) if form.broadcasts else None
                if both is None:
                    return f": ... is {known_batch[0]} in {known_batch[1]}"
                batch = both
            self.batches[form.variadic] = batch, name
        self.sizes.update(found)
        return None


def _broadcast(first: tuple[int, ...], second: tuple[int, ...]) -> tuple[int, ...] | None:
    """The shape of both together; None where they do not fit, or where a column and a row would make a table."""
    if len(first) < len(second):
        first, second = second, first
    if len(first) > len(second) > 0 and first[-1] == 1 and first[-2] == second[-1] > 1:
        return None
    second = (1,) * (len(first) - len(second)) + second
    if any(a != b and a != 1 and b != 1 for a, b in zip(first, second, strict=True)):
        return None
    return tuple(b if a == 1 else a for a, b in zip(first, second, strict=True))


def _listed(classes: tuple[type, ...]) -> str:
    return " or ".join(each.__name__ for each in classes)


@cache
def _arguments(function: Callable[..., Any]) -> tuple[list[_Argument | None], dict[str, _Argument]]:
    """What the arguments of a function may be: by position, and by name."""
    hints = get_type_hints(function)
    names = list(inspect.signature(function).parameters)
    by_position = [_Argument.of(name, hints[name]) if name in hints else None for name in names]
    return by_position, {each.name: each for each in by_position if each is not None}


def _check_arguments(
    function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any], one_dtype: bool
) -> torch.dtype | None:
    """Check the tensors of a call; return the dtype of those of floats, None if there are none."""
    by_position, by_name = _arguments(function)
    call = _Call(one_dtype)
    for argument, value in zip(by_position, args, strict=False):
        if argument is not None and value is not None:
            call.check(argument, value)
    for name, value in kwargs.items():
        if value is not None and name in by_name:
            call.check(by_name[name], value)
    return call.floats[0] if call.floats else None


def _following(value: Any, dtype: torch.dtype) -> Any:
    """An argument whose camera, if it is or has one, is in a dtype."""
    if isinstance(value, Tensor):
        return value
    if getattr(value, "follows_data", False):
        return value if value.params.dtype == dtype else value.to(dtype)
    camera = getattr(value, "camera", None) if is_dataclass(value) else None
    found = None if camera is None else _following(camera, dtype)
    return value if found is camera else replace(value, camera=found)
