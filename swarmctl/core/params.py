"""The base of every parameter class: frozen, no unknown keys, no NaN, no silent conversion from text.

Bounds and units are declared with the parameter, so that an error message can quote them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, create_model

OTHER_KEY = "other_key"  # type of the error of a value that does not go with another key's; its message has the range


class Params(BaseModel):
    """Base of a frozen section of the configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def section(self, model: type[P]) -> P:
        """Return the section of class `model`, one of those that `with_sections` has added."""
        return next(value for value in self.__dict__.values() if type(value) is model)


P = TypeVar("P", bound=Params)


def with_sections(sections: Mapping[str, type[Params]]) -> Callable[[type[P]], type[P]]:
    """Return a decorator that adds sections with default values to a class of parameters, behind its own fields."""

    def extended(model: type[P]) -> type[P]:
        fields: dict[str, Any] = {name: (section, section()) for name, section in sections.items()}
        return create_model(
            model.__name__, __base__=model, __doc__=model.__doc__, __module__=model.__module__, **fields
        )

    return extended


FARTHEST_M = 1e6  # of anything from the shared origin, along any axis
Vec2 = Annotated[tuple[float, float], Field(strict=False)]  # not strict: TOML arrays are lists
Vec3 = Annotated[tuple[float, float, float], Field(strict=False)]  # not strict: TOML arrays are lists
