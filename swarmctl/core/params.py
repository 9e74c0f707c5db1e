"""The parent of every parameter class: frozen, unknown keys refused, no NaN, no silent conversion from text.

Bounds and units are written where the parameter is declared, so that a refusal can quote them.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    """Frozen configuration section."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


Vec3 = Annotated[tuple[float, float, float], Field(strict=False)]  # TOML arrays are lists
