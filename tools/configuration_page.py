"""Writes `docs/configuration.md` from the parameter classes: every key with its type, default, range and comment.

    python tools/configuration_page.py

A test compares the committed page with `page()`, so that the two can't differ.
"""

from __future__ import annotations

import inspect
from pathlib import Path

from swarmctl.configuration.keys import Key, Section, sections, value_text
from swarmctl.core.params import Params
from swarmctl.simulator_config import FAULTS

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "configuration.md"
_HEAD = """\
# Configuration

`tools/configuration_page.py` writes this page from the parameter classes: to correct it, change the comment beside the
field and run it again.

A configuration is a TOML file with these sections. Every key has its unit in its name and can be set on the command
line, `--set separation.radius_m=1.5`, items of lists by index, `--set vehicles.0.url=...`. Keys that are left out have
the default given here. A configuration is refused, not repaired: all problems at once, each with the key, the value,
the allowed range and the fix. The run folder gets the resolved configuration as `config.toml`; files to begin with are
in `configs/`.
"""
_TABLE_HEAD = "| key | type | default | allowed | meaning |\n|---|---|---|---|---|\n"


def page() -> str:
    """Return the whole page as Markdown."""
    return _HEAD + "".join(map(_section_text, sections())) + _faults()


def _section_text(section: Section) -> str:
    """Return the text of a section: what it is, and a table of its keys."""
    title = f"`{section.title}`{', one for each' if section.is_listed else ''}" if section.path else "Top level"
    about = f"{inspect.getdoc(section.model)} (`{_source(section.model)}`)"
    return f"\n## {title}\n\n{about}\n\n{_TABLE_HEAD}{''.join(map(_row, section.keys))}"


def _faults() -> str:
    """Return the table of fault kinds, whose values are checked by a rule of their own."""
    rows = ""
    for kind, rule in FAULTS.items():
        allowed = f">= {rule.low}, <= {rule.high}" if rule.high > rule.low else ""
        default = "required" if rule.default is None else f"`{rule.default}`" if allowed else ""
        rows += f"| `{kind}` | {default} | {allowed} | {rule.meaning} |\n"
    head = "| `kind` | default of `value` | allowed | meaning |\n|---|---|---|---|\n"
    return f"\n## Kinds of faults\n\nFor `[[sitl.faults]]` and `swarmctl fault`.\n\n{head}{rows}"


def _source(model: type[Params]) -> str:
    return Path(inspect.getfile(model)).relative_to(ROOT).as_posix()


def _row(key: Key) -> str:
    default = "not set" if key.default is None else f"`{value_text(key.default)}`"
    cells = (f"`{key.name}`", key.kind, "required" if key.is_required else default, key.allowed, key.meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE.relative_to(ROOT))
