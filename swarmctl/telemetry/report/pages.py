"""Renders pages from the Jinja2 templates of a package; pages need no script, font or request.

Everything put into a template is escaped unless it is `Markup`, and a name that nobody gave is an error.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

_SHARED = "swarmctl.telemetry.report"  # the package whose templates all others extend: page.html, chart.html, style.css


def render(package: str, template: str, /, **values: Any) -> Markup:
    """Return a template of `package`, or of those shared by all packages, filled with `values`.

    Raises:
        jinja2.UndefinedError: the template names a value that is not given.
    """
    return Markup(_environment(package).get_template(template).render(values))


@cache
def _environment(package: str) -> Environment:
    return Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in dict.fromkeys((package, _SHARED))]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
