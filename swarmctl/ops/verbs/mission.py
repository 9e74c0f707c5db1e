"""The verb of the command line that changes the mission of a running launch. Heavy modules are imported inside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from swarmctl.core.operator_verbs import MISSION
from swarmctl.ops.verbs.orders import AsJson, MoreAgents, Run, told

mission_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Change the mission of a running launch.")


@mission_app.callback()
def _mission() -> None:
    return


@mission_app.command("set")
def mission_set(
    file: Annotated[Path, typer.Argument(help="TOML file that holds [mission] alone, as a configuration does.")],
    agent: MoreAgents = None,
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    """Fly the mission of a file from now on: at once where one is flown, all at the same time; else when all are ready.

    Exit code 0: every agent asked has accepted; 4: one has refused, or has not answered in time, and is named.
    """
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders.mission_file import set_mission

    launch = running_launches.find_launch(run)
    return told(MISSION, launch.run, lambda: set_mission(launch, file, agent or []), as_json=as_json)
