"""Base of a table of fields that a file states: frozen, and refused in one line for its first wrong value."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationError

from phasemark import UsageError
from phasemark.inputs.truth_values import refuse_truth_values

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


class FieldTable(BaseModel):
    """A frozen model without further keys, whose first wrong value raises a :class:`~phasemark.UsageError`."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)

    def __init__(self, **data: Any) -> None:
        refuse_truth_values(data, type(self).model_fields)
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise self._refused(error) from None

    @classmethod
    def _refused(cls, error: ValidationError) -> UsageError:
        """Put what pydantic finds into a line."""
        first = error.errors()[0]
        if not first["loc"]:  # a finding about several fields names them itself
            return UsageError(first["msg"].removeprefix("Value error, "))
        return cls._refusal(first)

    @classmethod
    def _refusal(cls, first: ErrorDetails) -> UsageError:
        """Put the first finding about one field into a line."""
        return UsageError.of_field(first["loc"], first["type"], first["msg"], first["input"])
