"""The verbs of `swarmctl obstacle`, which change the obstacles of a running launch.

Heavy modules are imported inside of them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swarmctl.core.text import counted
from swarmctl.errors import EXIT_OK, MissionError
from swarmctl.ops.verbs.orders import AsJson, Run

if TYPE_CHECKING:
    from swarmctl.bus.messages.json_messages import ListedObstacle, ObstaclesMessage
    from swarmctl.ops.orders.obstacle_list import KeptList

obstacle_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Change the obstacles of a running launch."
)
Number = Annotated[int, typer.Argument(help="Number of the obstacle, as `obstacle list` shows it; it never changes.")]
File = Annotated[Path, typer.Argument(metavar="FILE", help="TOML file of [[obstacles]] tables, as in configurations.")]


@obstacle_app.command("list")
def obstacle_list(run: Run = None, as_json: AsJson = False) -> int:
    """List the obstacles that the agents know: number, place now, sizes, velocity."""
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders import obstacle_list

    launch = running_launches.find_launch(run)
    kept = obstacle_list.read_obstacles(launch)
    _show(launch.run, kept, as_json)
    return EXIT_OK


@obstacle_app.command("add")
def obstacle_add(
    center: Annotated[str, typer.Option("--center", metavar="N,E,D", help="Centre, shared NED [m].")],
    radius: Annotated[float, typer.Option("--radius", help="Physical radius [m].")] = 1.0,
    keep_out: Annotated[
        float | None, typer.Option("--keep-out", help="Keep-out [m], at least the radius; default: radius + 0.75.")
    ] = None,
    visibility: Annotated[
        float, typer.Option("--visibility", help="Range at which agents see it [m], over the keep-out.")
    ] = 3.0,
    velocity: Annotated[str, typer.Option("--velocity", metavar="N,E,D", help="Velocity, shared NED [m/s].")] = "0,0,0",
    column: Annotated[
        bool, typer.Option("--column", help="A vertical column of unlimited height, not a sphere.")
    ] = False,
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    """Add a sphere or a column to a running launch."""
    from swarmctl.ops.orders import obstacle_list

    keep_out_m = radius + 0.75 if keep_out is None else keep_out
    obstacle = obstacle_list.obstacle(center, radius, keep_out_m, visibility, velocity=velocity, column=column)
    return _change(run, as_json, lambda known: obstacle_list.added(known, [obstacle]))


@obstacle_app.command("move")
def obstacle_move(
    number: Number,
    center: Annotated[
        str | None, typer.Option("--center", metavar="N,E,D", help="New centre, shared NED [m]; default: where it is.")
    ] = None,
    velocity: Annotated[
        str | None, typer.Option("--velocity", metavar="N,E,D", help="New velocity [m/s]; default: as it moves.")
    ] = None,
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    """Put an obstacle elsewhere at once, or give it another velocity. Its number and sizes stay."""
    from swarmctl.ops.orders import obstacle_list

    return _change(run, as_json, lambda known: obstacle_list.moved(known, number, center, velocity))


@obstacle_app.command("remove")
def obstacle_remove(
    numbers: Annotated[list[int], typer.Argument(metavar="NUMBER...", help="Numbers in `obstacle list`.")],
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    """Remove obstacles from a running launch. The numbers of the others stay."""
    from swarmctl.ops.orders import obstacle_list

    return _change(run, as_json, lambda known: obstacle_list.removed(known, numbers))


@obstacle_app.command("load")
def obstacle_load(
    file: File,
    replace: Annotated[bool, typer.Option("--replace", help="Remove all others; default: add to them.")] = False,
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    """Add the obstacles of a file to a running launch, at the places that it says."""
    from swarmctl.ops.orders import obstacle_list

    obstacles = obstacle_list.read_file(file)

    def change(known: ObstaclesMessage) -> Sequence[ListedObstacle]:
        listed = obstacle_list.added(known, obstacles)
        return listed[len(known.obstacles) :] if replace else listed

    return _change(run, as_json, change)


@obstacle_app.command("save")
def obstacle_save(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="TOML file to create.")],
    run: Run = None,
    as_json: AsJson = False,
) -> int:
    """Write the obstacles of a running launch, as they are now, to a file that `load` and configurations take."""
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders import obstacle_list

    known = obstacle_list.read_obstacles(running_launches.find_launch(run)).listed
    obstacle_list.write_file(file, known)
    print(obstacle_list.as_json(known) if as_json else f"{counted(len(known.obstacles), 'obstacle')}: {file}")
    return EXIT_OK


def _change(run: str | None, as_json: bool, change: Callable[[ObstaclesMessage], Sequence[ListedObstacle]]) -> int:
    """Change the list, and show the new one.

    Raises:
        MissionError: somebody is heard and keeps another list.
    """
    from swarmctl.ops import running_launches
    from swarmctl.ops.orders import obstacle_list

    launch = running_launches.find_launch(run)
    kept = obstacle_list.change_obstacles(launch, change)
    _show(launch.run, kept, as_json)
    if kept.others:
        raise MissionError(f"obstacle: not taken by {', '.join(kept.others)}")  # who are heard
    return EXIT_OK


def _show(run: str, kept: KeptList, as_json: bool) -> None:
    from swarmctl.ops.orders import obstacle_list

    if as_json:
        print(obstacle_list.as_json(kept.listed))
    else:
        print("\n".join([f"obstacle: {run}", *obstacle_list.lines_of(kept.listed)]))
    if kept.others:
        print(f"obstacle: another list is kept by {', '.join(kept.others)}", file=sys.stderr)
    if kept.unheard:
        print(f"obstacle: nothing is heard from {', '.join(kept.unheard)}, which may keep another", file=sys.stderr)
