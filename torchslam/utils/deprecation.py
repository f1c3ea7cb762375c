"""Calls as an earlier version took them: they work for one more version and name what replaces them."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class OldCall:
    """How an earlier version took the arguments of a function.

    Attributes:
        order: the names of its parameters, in their order, separated by spaces.
        options: default of the parameter `options`, a dataclass that took over the parameters with names of its fields.
    """

    order: str
    options: Any = None

    def of(self, function: Callable[..., R], name: str) -> Callable[..., R]:
        """The function by a former name, with the former arguments alone."""

        def former(*args: Any, **kwargs: Any) -> R:
            converted = self._converted(name, args, kwargs)
            self._warn(name, function)
            return function(**converted)

        former.__name__ = former.__qualname__ = name
        former.__doc__ = f"Deprecated: use `{function.__name__}`."
        return former

    def accepted(self, function: Callable[P, R]) -> Callable[P, R]:
        """The function, which takes its former arguments as well."""
        parameters = inspect.signature(function).parameters
        most = sum(each.kind is not inspect.Parameter.KEYWORD_ONLY for each in parameters.values())
        former = {*self.order.split()} - parameters.keys()

        @wraps(function)
        def accepting(*args: P.args, **kwargs: P.kwargs) -> R:
            if len(args) <= most and not kwargs.keys() & former:
                return function(*args, **kwargs)
            call: Callable[..., R] = function
            converted = self._converted(function.__name__, args, kwargs)
            self._warn(function.__name__, function)
            return call(**converted)

        return accepting

    def _converted(self, name: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """The arguments of a former call by their present names."""
        names = self.order.split()
        doubled = [each for each in names[: len(args)] if each in kwargs]
        if len(args) > len(names) or doubled:
            raise TypeError(
                f"{name}() got {doubled[0] if doubled else 'too many arguments'}, of ({self.order})"
            )
        given = dict(zip(names, args, strict=False)) | dict(kwargs)
        if self.options is None:
            return given
        changes = {each.name: given.pop(each.name) for each in fields(self.options) if each.name in given}
        return given | {"options": replace(given.get("options", self.options), **changes)}

    def _warn(self, name: str, function: Callable[..., Any]) -> None:
        """Warn at the place of the call, which is two calls further up."""
        shown = _names(inspect.signature(function))
        moved = "" if self.options is None else f"; options is a {type(self.options).__name__}"
        warnings.warn(
            f"this call of {name} is deprecated: call {function.__name__}({', '.join(shown)}){moved}",
            DeprecationWarning,
            stacklevel=3,
        )


def _names(signature: inspect.Signature) -> list[str]:
    """Names of parameters, with a star before the first that is given by name."""
    names: list[str] = []
    for name, parameter in signature.parameters.items():
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and "*" not in names:
            names.append("*")
        names.append(name)
    return names
