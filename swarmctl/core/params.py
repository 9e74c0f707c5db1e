"""The base of every parameter class: frozen, no unknown keys, no NaN, no silent conversion from text.

Bounds and units are declared with the parameter, so that an error message can quote them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

OTHER_KEY = "other_key"  # type of the error of a value that does not go with another key's; its message has the range


class Params(BaseModel):
    """Base of a frozen section of the configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, values: Any) -> Any:
        """Take keys that a section's class has no default for, where they are left out, from the default section."""
        if not isinstance(values, dict):
            return values
        given = {name: values[name] for name in _sections_with_more(cls) if isinstance(values.get(name), dict)}
        more = {name: _sections_with_more(cls)[name] | section for name, section in given.items()}
        return values | more if more else values

    def section(self, model: type[P]) -> P:
        """Return the section of class `model`, one of those that `with_sections` has added."""
        return next(value for value in self.__dict__.values() if type(value) is model)


P = TypeVar("P", bound=Params)


@lru_cache(maxsize=1024)
def _sections_with_more(model: type[Params]) -> Mapping[str, Mapping[str, Any]]:
    """Return, by name of a section with a default, those of its values that its own class has no default for."""
    defaults = {name: field.default for name, field in model.model_fields.items()}
    found = {
        name: {key: getattr(default, key) for key, field in type(default).model_fields.items() if field.is_required()}
        for name, default in defaults.items()
        if isinstance(default, Params)
    }
    return {name: values for name, values in found.items() if values}


def with_sections(sections: Mapping[str, type[Params]]) -> Callable[[type[P]], type[P]]:
    """Return a decorator that adds sections with default values to a class of parameters, behind its own fields."""

    def extended(model: type[P]) -> type[P]:
        fields: dict[str, Any] = {name: (section, section()) for name, section in sections.items()}
        return create_model(
            model.__name__, __base__=model, __doc__=model.__doc__, __module__=model.__module__, **fields
        )

    return extended


def model_in(annotation: Any) -> type[Params] | None:
    """Return the class of parameters that the annotation of a field is or contains."""
    if isinstance(annotation, type) and issubclass(annotation, Params):
        return annotation
    return next((found for argument in get_args(annotation) if (found := model_in(argument))), None)


FARTHEST_M = 1e6  # of anything from the shared origin, along any axis
Vec2 = Annotated[tuple[float, float], Field(strict=False)]  # not strict: TOML arrays are lists
Vec3 = Annotated[tuple[float, float, float], Field(strict=False)]  # not strict: TOML arrays are lists
