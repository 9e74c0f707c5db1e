"""The base of every parameter class: frozen, no unknown keys, no NaN, no silent conversion from text.

Bounds and units are declared with the parameter, so that an error message can quote them.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    """Base of a frozen section of the configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


Vec3 = Annotated[tuple[float, float, float], Field(strict=False)]  # not strict: TOML arrays are lists
