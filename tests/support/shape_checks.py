"""Check the shapes in type annotations while tests run: of every function and dataclass that is annotated with arrays.

All other types are the type checker's. To check them here too would triple the time of the tests.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, get_args, get_origin

import jaxtyping
import numpy as np

_check = jaxtyping.jaxtyped


def install(packages: Sequence[str]) -> None:
    """Check the shapes in modules of these packages that are imported later; an int counts as a float."""
    # the hook decorates everything with jaxtyping.jaxtyped
    jaxtyping.jaxtyped = _check_if_annotated_with_arrays
    jaxtyping.install_import_hook(packages, "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")


def _check_if_annotated_with_arrays(target: Any = None, *, typechecker: Callable[..., Any]) -> Any:
    if target is None:
        return partial(_check_if_annotated_with_arrays, typechecker=typechecker)
    function = target.__init__ if isinstance(target, type) else target
    annotations, names = getattr(function, "__annotations__", {}), vars(sys.modules[target.__module__])
    is_annotated = any(has_array(annotation, names) for annotation in annotations.values())
    return _check(target, typechecker=typechecker) if is_annotated else target


def has_array(annotation: Any, names: Mapping[str, Any]) -> bool:
    """Return True if an annotation, or a name in its text, is or contains an array. names: those of its module."""
    if isinstance(annotation, str):
        named = (names.get(word) for word in re.findall(r"[^\W\d]\w*", annotation))
        return any(has_array(value, names) for value in named if not isinstance(value, str))
    if isinstance(annotation, type) and issubclass(annotation, np.ndarray | jaxtyping.AbstractArray):
        return True
    if getattr(annotation, "__name__", "") == "Tensor" or get_origin(annotation) is np.ndarray:
        return True
    return any(has_array(part, names) for part in get_args(annotation))
