"""The verb with which launches start the process of an agent, or of several; heavy modules load inside it."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path
from typing import Annotated

import typer

from swarmctl.errors import ConfigError


def add_agent_verb(to: typer.Typer) -> None:
    """Add `agent` to a command line."""
    to.command()(agent)


def agent(
    config: Annotated[Path, typer.Option("--config", help="Resolved configuration, a TOML file.")],
    ids: Annotated[list[int], typer.Option("--id", help="Index of this agent, from 0; of several, again.")],
    run: Annotated[str, typer.Option("--run", help="Name of the run on the bus.")],
    bus: Annotated[str, typer.Option("--bus", help="Endpoint of the bus router.")],
    run_dir: Annotated[Path, typer.Option("--run-dir", help="Folder to record into.")],
    fds: Annotated[
        list[int] | None, typer.Option("--fd", help="Inherited, bound UDP socket to the vehicle; for each agent.")
    ] = None,
    vehicle_ports: Annotated[
        list[int] | None, typer.Option("--vehicle-port", help="Loopback port of the vehicle on that link.")
    ] = None,
    ends_fd: Annotated[
        int | None, typer.Option("--ends-fd", help="Inherited pipe that is told of each end, of several agents.")
    ] = None,
    only_land: Annotated[bool, typer.Option("--only-land", help="Land and disarm the vehicle, then exit.")] = False,
    originals: Annotated[
        str, typer.Option("--originals", metavar="JSON", help="Parameters to set back that an ended agent has changed.")
    ] = "{}",
    realtime: Annotated[
        bool, typer.Option(help="Be scheduled before other programs once it is ready, where that is permitted.")
    ] = False,
    identity: Annotated[str, typer.Option("--identity", help="Host it speaks for, one of [[hosts]].")] = "",
) -> int:
    """Run one agent, whose vehicle and bus are there already. `launch` and `host` start agents."""
    gc.disable()  # a tenth of the start-up is spent on looking for garbage among modules; `runner` enables it again
    from swarmctl.agent.runner import AgentProcess, run_agent
    from swarmctl.process_lifetime import PARENT_ENV, die_with_parent
    from swarmctl.telemetry.recording.changed_parameters import decode_originals

    try:
        were = decode_originals(originals)
    except ValueError as error:
        raise ConfigError("--originals", [str(error)]) from error
    if len(set(ids)) < len(ids):
        raise ConfigError("--id", [f"{', '.join(map(str, ids))}: give each agent once"])
    if len(ids) > 1 and (only_land or were):
        raise ConfigError("--id", ["several agents neither only land nor set parameters back; start one for each"])
    if PARENT_ENV in os.environ:
        die_with_parent(signal.SIGTERM)
    processes = [
        AgentProcess(
            config_path=config,
            agent=number,
            run=run,
            bus=bus,
            run_dir=run_dir,
            fd=fd,
            vehicle_port=vehicle_port,
            only_land=only_land,
            originals=were,
            realtime=realtime,
            identity=identity,
        )
        for number, fd, vehicle_port in zip(
            ids, _of_each(ids, "--fd", fds), _of_each(ids, "--vehicle-port", vehicle_ports), strict=True
        )
    ]
    if len(processes) == 1:
        return run_agent(processes[0])
    from swarmctl.agent.shared_process import run_agents

    return run_agents(processes, ends_fd)


def _of_each(ids: list[int], option: str, values: list[int] | None) -> list[int | None]:
    """Return the value of an option for each agent; it is given for all of them or for none."""
    if values and len(values) != len(ids):
        raise ConfigError(option, [f"{len(values)} values for {len(ids)} agents; give one for each --id"])
    return list(values) if values else [None] * len(ids)
