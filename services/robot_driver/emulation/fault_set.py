"""What faults of emulated robots have in common: named values, changed while they run."""

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shared.errors import first_problem


class FaultSet(BaseModel):
    """What is wrong with a robot or with the way to it. Frozen; the defaults are a sound one."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    battery_low: bool = False
    scale: float = Field(default=1.0, ge=0.5, le=2.0)
    """Part of a command that the wheels make of it."""

    def changed(self, changes: object) -> Self:
        """These with some values replaced; an empty text mends. Raises ValueError in one line."""
        if not isinstance(changes, dict):
            raise ValueError("expected an object of faults")
        try:
            return type(self).model_validate({**self.model_dump(), **self._mended(changes)})
        except ValidationError as error:
            raise ValueError(first_problem(error)) from error

    def with_texts(self, items: list[str]) -> Self:
        """These with `name=value` texts applied. Raises ValueError in one line."""
        return self.changed(texts(items))

    def _mended(self, changes: dict[Any, Any]) -> dict[Any, Any]:
        fields = type(self).model_fields
        return {
            name: fields[name].default if value == "" and name in fields else value
            for name, value in changes.items()
        }


def texts(items: list[str]) -> dict[str, str]:
    """`name=value` texts by name. Raises ValueError in one line."""
    changes = {}
    for item in items:
        name, equals, value = item.partition("=")
        if not equals:
            raise ValueError(f"expected NAME=VALUE, got {item!r}")
        changes[name] = value
    return changes
