"""JSON that is stored: text as it is, and bytes of a file's name that are not UTF-8 escaped."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticSerializationError


def json_text(value: Any, *, indent: int | None = None, sort_keys: bool = False, allow_nan: bool = True) -> str:
    r"""Return a pydantic model or plain data as JSON that can be encoded as UTF-8.

    Parameters
    ----------
    value : BaseModel or plain data
    indent : int, optional
    sort_keys, allow_nan : bool
        As :func:`json.dumps`, for plain data.

    Returns
    -------
    str
        A file's name that is not UTF-8 stands as ``\udcNN`` in it, from which :func:`json.loads` makes the name again.

    Examples
    --------
    >>> print(json_text({"sensor": "caf\udce9.toml"}), json_text({"sensor": "café.toml"}))
    {"sensor": "caf\udce9.toml"} {"sensor": "café.toml"}
    """
    if isinstance(value, BaseModel):
        try:
            return value.model_dump_json(indent=indent)
        except PydanticSerializationError:  # it knows of no names that are not UTF-8
            value = value.model_dump(mode="json")
    text = json.dumps(value, indent=indent, sort_keys=sort_keys, allow_nan=allow_nan, ensure_ascii=False)
    try:
        text.encode()
    except UnicodeEncodeError:
        return json.dumps(value, indent=indent, sort_keys=sort_keys, allow_nan=allow_nan)
    return text


def finite_or_none(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of plain data with None for the numbers that JSON does not have, in mappings and lists too."""
    return {key: _plain(value) for key, value in row.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return finite_or_none(value)
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
