"""True and false, which pydantic takes for the numbers 1 and 0."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from phasemark import UsageError


def refuse_truth_values(data: Mapping[str, Any], fields: Mapping[str, Any]) -> None:
    """Refuse true and false where a field of a pydantic model is a number: pydantic would read them as 1 and 0.

    Parameters
    ----------
    data : mapping
        What a model is about to be made of.
    fields : mapping of str to FieldInfo
        The ``model_fields`` of the model.

    Raises
    ------
    UsageError
        With one line that names the key and its value.
    """
    for key, field in fields.items():
        kind = repr(field.annotation)
        if ("int" in kind or "float" in kind) and "bool" not in kind and "Any" not in kind:
            for value in _scalars(data.get(key)):
                if isinstance(value, bool):
                    raise UsageError(f"'{key}' must be a number, got {str(value).lower()}")


def _scalars(value: Any) -> Iterable[Any]:
    """Yield a value, or those of a list, however nested; tables are models of their own."""
    if isinstance(value, list | tuple):
        for one in value:
            yield from _scalars(one)
    else:
        yield value
