"""The verbs of `swarmctl config`, which look up keys and begin files. Heavy modules are imported inside of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from swarmctl.errors import EXIT_OK

config_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Look up and begin configurations.")


@config_app.command("show")
def config_show(
    key: Annotated[str, typer.Argument(help="Key, section, or part of a key; default: all.")] = "",
    config: Annotated[Path | None, typer.Option("--config", metavar="FILE", help="TOML file; default: none.")] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key; repeatable.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> int:
    """Show keys with value, meaning, unit, range and default."""
    from swarmctl.config import load
    from swarmctl.ops import config_help

    keys = config_help.shown_keys(load(config, sets or ()), key)
    print(config_help.as_json(keys) if as_json else "\n".join(config_help.lines_of(keys)))
    return EXIT_OK


@config_app.command("schema")
def config_schema() -> int:
    """Print the JSON schema of configuration files, with which an editor completes and checks them."""
    from swarmctl.ops import config_help

    print(config_help.schema())
    return EXIT_OK


@config_app.command("init")
def config_init(
    name: Annotated[str, typer.Argument(help="Built-in one or example; defaults: every key; unknown: lists all.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE", help="File to create; default: NAME.toml here."),
    ] = None,
) -> int:
    """Write a commented configuration to begin with; of an example also the Python or CSV file that it flies."""
    from swarmctl.files import write_new
    from swarmctl.ops import config_help

    texts = config_help.initial_files(name, output)
    write_new(texts)
    for path in texts:
        print(path)
    return EXIT_OK
