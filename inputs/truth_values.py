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
        value = next((one for one in _scalars(data.get(key)) if isinstance(one, bool)), None)
        if value is not None and _is_number(field):
            raise UsageError(f"'{key}' must be a number, got {str(value).lower()}")


def _is_number(field: Any) -> bool:
    """Return whether a field takes numbers alone; writing its type out takes longer than all else here."""
    kind = repr(field.annotation)
    return ("int" in kind or "float" in kind) and "bool" not in kind and "Any" not in kind


def _scalars(value: Any) -> Iterable[Any]:
    """Yield a value, or those of a list, however nested; tables are models of their own."""
    if isinstance(value, list | tuple):
        for one in value:
            yield from _scalars(one)
    else:
        yield value
