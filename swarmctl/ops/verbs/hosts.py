"""The verbs of a swarm that flies from several computers; heavy modules load inside them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from swarmctl.errors import EXIT_OK, ConfigError

_ConfigOption = Annotated[Path, typer.Option("--config", help="Configuration of the whole swarm, with [[hosts]].")]
_RunDir = Annotated[Path | None, typer.Option("--run-dir", help="Run folder to create; default runs/<UTC>-<name>.")]
_Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a key, the same on every computer; repeatable."),
]


def add_host_verbs(to: typer.Typer) -> None:
    """Add `host` and `station` to a command line."""
    to.command()(host)
    to.command()(station)


def host(
    config: _ConfigOption,
    agents: Annotated[str, typer.Option("--agents", metavar="0,1,..", help="Agents of this computer.")],
    run_dir: _RunDir = None,
    sets: _Set = None,
    print_unit: Annotated[bool, typer.Option("--print-unit", help="Print a systemd unit instead of flying.")] = False,
) -> int:
    """Fly the agents of this computer, together with those of other hosts. Ctrl-C lands them; the others fly on."""
    from swarmctl.ops.flight.host import fly_host, load_host, systemd_unit
    from swarmctl.ops.flight.launch import LaunchOptions

    try:
        numbers = [int(number) for number in agents.split(",")]
    except ValueError as error:
        raise ConfigError("--agents", [f"{agents!r}: write numbers with commas between them, as 0,1"]) from error
    loaded, own = load_host(config, numbers, sets or ())
    if print_unit:
        if run_dir is not None:
            problem = "a unit is started more than once, and a second flight would find the folder taken; leave it out"
            raise ConfigError("--run-dir", [problem])
        print(systemd_unit(config, own, sets or ()), end="")
        return EXIT_OK
    return fly_host(loaded, own, LaunchOptions(run_dir))


def station(
    config: _ConfigOption,
    run_dir: _RunDir = None,
    sets: _Set = None,
    view: Annotated[
        bool | None, typer.Option("--view/--no-view", help="Open the viewer window, or none; recorded either way.")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve the view to browsers of this computer.")] = False,
) -> int:
    """Show, record, judge and steer a swarm of several hosts. Ctrl-C ends the station; the swarm flies on."""
    from swarmctl.config import load
    from swarmctl.ops.flight.launch import LaunchOptions
    from swarmctl.ops.flight.station import run_station
    from swarmctl.telemetry.view.recordings import wants_window

    options = LaunchOptions(run_dir, wants_window(view, web=web), web)
    return run_station(load(config, sets or (), only_agents=()), options)
