"""The verbs that are given run folders: replay, report, export, bundle."""

from __future__ import annotations

import dataclasses
import json
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from swarmctl.errors import EXIT_OK, ConfigError
from swarmctl.process_lifetime import StopRequest

Web = Annotated[bool, typer.Option("--web", help="Serve a page to browsers of this computer, until Ctrl-C.")]
Folder = Annotated[Path, typer.Argument(help="Run folder.")]
_LOOK_S = 0.5  # time between two looks whether the page is still served


def add_folder_verbs(app: typer.Typer) -> None:
    """Add the verbs to the command line."""
    for verb in (replay, report, export, bundle):
        app.command()(verb)


def show_in_browser(target: str) -> int:
    """Serve a recording or a live URL as a page until Ctrl-C, or until its server ends."""
    from swarmctl.telemetry.view.web_page import web_page

    with StopRequest(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as stop, web_page(target) as page:
        print(f"open in a browser: {page.url}\nCtrl-C ends it", flush=True)
        while page.process.poll() is None and not stop.is_set():
            stop.wait(_LOOK_S)
    return EXIT_OK


def replay(
    folder: Folder,
    web: Web = False,
    decide: Annotated[
        bool, typer.Option("--decide", help="Run agents again over what they received, and show where they differ.")
    ] = False,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="With --decide: override a key of the configuration flown."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="With --decide: print JSON.")] = False,
) -> int:
    """Open the recording of a run, or have its agents decide again."""
    from swarmctl.telemetry.recording.file_names import RECORDING
    from swarmctl.telemetry.recording.run_files import refuse_no_folder
    from swarmctl.telemetry.view.recordings import open_viewer

    if decide and web:
        raise ConfigError("replay", ["--decide prints what it finds; leave --web out"])
    if decide:
        return _decide(folder, sets or [], as_json)
    if sets or as_json:
        raise ConfigError("replay", ["--set and --json are for --decide"])
    refuse_no_folder(folder)
    if not (folder / RECORDING).is_file():
        raise ConfigError(str(folder), [f"holds no {RECORDING}: it is no run, or telemetry.enabled was false"])
    if web:
        return show_in_browser(str(folder / RECORDING))
    open_viewer(str(folder / RECORDING))
    return EXIT_OK


def _decide(folder: Path, sets: list[str], as_json: bool) -> int:
    from swarmctl.ops.decide.verb import decisions_of_run, lines_of, notes_of_run

    decisions = decisions_of_run(folder, sets)
    if as_json:
        print(json.dumps([dataclasses.asdict(agent) for agent in decisions], indent=2))
    else:
        print("\n".join(line for agent in decisions for line in lines_of(agent)))
    for note in notes_of_run(folder):
        print(note, file=sys.stderr)
    return EXIT_OK


def report(
    folders: Annotated[list[Path], typer.Argument(help="Run folder, or several to compare.")],
    figures: Annotated[
        bool, typer.Option("--figures", help="Also write every figure as an SVG file into figures/ of the folder.")
    ] = False,
    png: Annotated[
        bool, typer.Option("--png", help="The same, and as PNG, too. Needs, in the checkout: pip install '.[png]'")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", metavar="FILE", help="Page to write when runs are compared; default: beside the last."
        ),
    ] = None,
) -> int:
    """Write the report of a run again, and complete a run that was cut off; set several runs beside each other."""
    from swarmctl.ops.flight.summary import compare, rewrite_report, write_figures

    if len(folders) > 1:
        if figures or png:
            raise ConfigError("--figures", ["the figures of one run are written at a time; give one run folder"])
        print(compare(folders, output))
        return EXIT_OK
    if output is not None:
        raise ConfigError("--output", ["only a page that compares runs is written elsewhere; give several folders"])
    print(rewrite_report(folders[0]))
    if figures or png:
        print(write_figures(folders[0], png=png))
    return EXIT_OK


def export(
    folder: Folder,
    mcap: Annotated[bool, typer.Option("--mcap", help="As MCAP, which Foxglove opens.")] = False,
    output: Annotated[
        Path | None, typer.Option("--output", metavar="FILE", help="File to write; default: beside the folder.")
    ] = None,
) -> int:
    """Write a run in the format of another program."""
    from swarmctl.ops.export import export_mcap

    if not mcap:
        raise ConfigError("export", ["say as what: --mcap"])
    print(export_mcap(folder, output))
    return EXIT_OK


def bundle(
    folder: Folder,
    output: Annotated[
        Path | None, typer.Option("--output", metavar="FILE", help="Archive to write; default: beside the folder.")
    ] = None,
    logs: Annotated[int, typer.Option("--logs", min=0, help="Newest logs to download from each vehicle.")] = 1,
) -> int:
    """Pack a run for support: its folder, versions, and logs of the disarmed vehicles that are reached."""
    from swarmctl.ops import bundle as packing

    packed = packing.bundle(packing.BundleOptions(folder=folder, output=output, logs=logs))
    print("\n".join(packing.lines_of(packed)))
    return EXIT_OK
