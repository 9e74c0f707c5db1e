"""The base of every parameter class: frozen, no unknown keys, no NaN, no silent conversion from text.

Bounds and units are declared with the parameter, so that an error message can quote them.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError


class Params(BaseModel):
    """Base of a frozen section of the configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def explained(refused: ValidationError) -> list[str]:
    """Return one line for each wrong value: key, value and what is allowed."""
    return [
        f"{'.'.join(map(str, error['loc'])) or refused.title} = {error.get('input')!r}: {error['msg'].lower()}"
        for error in refused.errors(include_url=False)
    ]


Vec2 = Annotated[tuple[float, float], Field(strict=False)]  # not strict: TOML arrays are lists
Vec3 = Annotated[tuple[float, float, float], Field(strict=False)]  # not strict: TOML arrays are lists
