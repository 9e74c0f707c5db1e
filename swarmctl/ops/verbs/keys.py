"""The verbs of `swarmctl keys`: signing keys of vehicles, identities of computers; heavy modules load inside them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from swarmctl.errors import EXIT_OK, ConfigError, StartError

_Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a configuration key; repeatable.")
]
keys_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Make signing keys of vehicles, and identities of computers."
)


@keys_app.command("new")
def keys_new(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Files to create, one for each vehicle.")],
) -> int:
    """Write new random keys, each to a new file that only you can read."""
    from swarmctl.mavlink.signing.key_file import write_new_key

    taken, unwritten = [], []
    for path in files:
        try:
            print(f"{path}: key {write_new_key(path).fingerprint}")
        except FileExistsError:
            taken.append(f"{path}: exists already, and a vehicle may have that key; give another name")
        except OSError as error:
            unwritten.append(f"{path}: can't be written: {error.strerror}. Give another name, or make its folder")
    if taken:
        raise ConfigError("keys new", [*taken, *unwritten])
    if unwritten:
        raise StartError("\n".join(unwritten))
    return EXIT_OK


@keys_app.command("install")
def keys_install(
    config: Annotated[Path, typer.Argument(help="Configuration with mavlink.signing_keys and vehicles.")],
    old: Annotated[
        list[Path] | None, typer.Option("--old", metavar="FILE", help="Key that a vehicle has now; repeatable.")
    ] = None,
    sets: _Set = None,
) -> int:
    """Give every disarmed vehicle its key, in clear text: over a cable or a network that nobody else is on."""
    from swarmctl.config import load
    from swarmctl.ops.vehicles.key_install import install

    return install(load(config, sets or ()), old or ())


@keys_app.command("init")
def keys_init(
    config: Annotated[Path, typer.Argument(help="Configuration with [[hosts]] and bus.identities.")],
    sets: _Set = None,
) -> int:
    """Make an authority, and an identity for every host and the station; again, for those that were added."""
    from swarmctl.ops.flight.host import make_host_identities

    folder, made = make_host_identities(config, sets or ())
    print(f"{folder}: made {', '.join(made) or 'nothing: every host has an identity'}")
    return EXIT_OK


@keys_app.command("add")
def keys_add(
    config: Annotated[Path, typer.Argument(help="Configuration with [[hosts]] and bus.identities.")],
    name: Annotated[str, typer.Argument(help="One of [[hosts]], or station.")],
    sets: _Set = None,
) -> int:
    """Make the identity of one computer: one that is new, or whose former one is revoked."""
    from swarmctl.ops.flight.host import add_host_identity

    folder = add_host_identity(config, name, sets or ())
    print(f"{folder}: made {name}. Copy {name}.pem to every computer, {name}.key to {name} alone")
    return EXIT_OK


@keys_app.command("revoke")
def keys_revoke(
    config: Annotated[Path, typer.Argument(help="Configuration with bus.identities.")],
    name: Annotated[str, typer.Argument(help="Computer whose identity counts no more.")],
    sets: _Set = None,
) -> int:
    """Revoke the identity of one computer. Others honour it from their next start on, once they have the list."""
    from swarmctl.ops.flight.host import revoke_host_identity

    revoked = revoke_host_identity(config, name, sets or ())
    print(f"{revoked}: {name} is revoked. Copy this file to every computer; it counts from the next start there on")
    return EXIT_OK
