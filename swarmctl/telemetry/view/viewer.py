"""The only process that uses rerun: reads ticks from the bus, serves a live view and writes `telemetry.rrd`.

`python -m swarmctl.telemetry.view.viewer --run R --bus ENDPOINT --flight JSON --run-dir DIR`. It only serves, and has
the processor time that others leave, so it can't delay an agent; if it freezes or is killed, only the view is lost. The
launcher ends it by SIGTERM (SIGHUP works as well when it was started by hand); it ignores Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import psutil

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.text import counted
from swarmctl.errors import EXIT_OK, EXIT_USAGE, StartError, SwarmError
from swarmctl.files import replace_text
from swarmctl.process_lifetime import StopRequest, die_with_parent
from swarmctl.process_priority import give_way
from swarmctl.telemetry.recording.file_names import RECORDING
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight
from swarmctl.telemetry.view.recordings import APPLICATION, has_display, open_viewer
from swarmctl.telemetry.view.view_ports import HOST, PORTS_TRIED, held_view_port
from swarmctl.wall_clock import WallClock

URL_FILE = "viewer.url"
_EXIT_TIMEOUT_S = 4.0  # longest time from the last drawing to the exit, whatever hangs
_FLUSH_TIMEOUT_S = 2.0
_PAGE_LOOK_S = 0.2  # time between two looks whether the page is still served
_PLOT_PERIOD_S = 0.4  # period of curves; poses are sent at --rate-hz
_REDRAW_PERIOD_S = 5.0  # period of obstacles at rest, because the server's history drops rare data first


def main(arguments: list[str] | None = None) -> int:
    """Run until SIGTERM; returns the exit code of what could not begin."""
    options = _parser().parse_args(arguments)
    give_way()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    stop = StopRequest(signal.SIGTERM, signal.SIGHUP)
    if options.die_with_parent:
        die_with_parent(signal.SIGTERM)
    try:
        flight = ViewedFlight.model_validate_json(options.flight)
    except ValueError as error:
        print(f"viewer: --flight: {error}", file=sys.stderr)
        return EXIT_USAGE
    try:
        _run(options, flight, stop)
    except SwarmError as error:
        print(f"viewer: {error}", file=sys.stderr)
        return error.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="swarmctl.telemetry.view.viewer", description=__doc__.split("\n", maxsplit=1)[0]
    )
    parser.add_argument("--run", required=True, help="name of the run on the bus")
    parser.add_argument("--bus", required=True, help="Zenoh endpoint of the launcher's router")
    parser.add_argument("--flight", required=True, help="what is shown: a `ViewedFlight` as JSON")
    parser.add_argument("--run-dir", type=Path, required=True, help="folder for telemetry.rrd and viewer.url")
    parser.add_argument("--port", type=int, default=9876, help="loopback; the next free one when it is taken")
    parser.add_argument("--rate-hz", type=float, default=10.0, help="batches a second")
    parser.add_argument("--history-mb", type=int, default=32, help="memory for who opens the view late")
    parser.add_argument("--view", action="store_true", help="open the native viewer when there is a display")
    parser.add_argument("--web", action="store_true", help="serve a page to browsers of this computer, too")
    parser.add_argument("--identity", metavar="JSON", help="as which it listens on a bus of several computers")
    parser.add_argument("--die-with-parent", action="store_true")
    return parser


def _run(options: argparse.Namespace, flight: ViewedFlight, stop: StopRequest) -> NoReturn:
    from swarmctl.bus.network.joining import join_bus
    from swarmctl.bus.network.roster import identity_of_json
    from swarmctl.bus.network.sealed_bus import FOR_OPERATORS_US
    from swarmctl.bus.topics import OPERATOR
    from swarmctl.telemetry.scene.scene import Scene
    from swarmctl.telemetry.view.feed import Feed, listens_to

    agents = len(flight.agents)
    identity = None if options.identity is None else identity_of_json(options.identity)
    listen = listens_to(agents, (OPERATOR,) if identity is None else identity.roster.hosts)

    def join() -> Any:
        return join_bus(
            options.bus,
            options.run,
            "viewer",
            listen,
            identity=identity,
            max_age_us=FOR_OPERATORS_US,
            utc_us=WallClock().utc_us,
        )

    bus = _interruptible(join, stop)
    if bus is None:
        os._exit(EXIT_OK)  # an orderly end aborts if the bus opens amid it, in the thread that waits for that
    rec, url = _serve(options.run, options.run_dir, options.port, options.history_mb)
    scene = Scene(rec, flight)
    scene.begin()
    feed = Feed(bus, agents)
    _announce(options, url)
    if options.web:
        threading.Thread(target=_serve_page, args=(url, options.run_dir / "web.log", stop), daemon=True).start()
    Pump(feed, scene, flight.obstacles).run(1.0 / options.rate_hz, stop)
    _end(rec, bus, f"telemetry lost={feed.lost} received={feed.received} malformed={feed.malformed}")


class Pump:
    """Draws everything that has arrived, at a fixed rate."""

    def __init__(self, feed: Any, scene: Any, obstacles: Sequence[Obstacle]) -> None:
        self._feed = feed
        self._scene = scene
        self._obstacles = obstacles
        self._newest_us = 0
        self._set_us = 0  # when the obstacles were set
        self._drawn_us: int | None = None

    def run(self, period_s: float, stop: StopRequest) -> None:
        """Draw until `stop`, and once more for what arrived meanwhile."""
        next_s = time.monotonic()
        next_plots_s = next_s
        while not stop.is_set():
            self.step()
            if time.monotonic() >= next_plots_s:
                self._scene.plots()
                next_plots_s = time.monotonic() + _PLOT_PERIOD_S - period_s / 2
            next_s = max(next_s + period_s, time.monotonic())  # missed periods after a freeze are not caught up
            stop.wait(next_s - time.monotonic())
        self.step()
        self._scene.plots()

    def step(self) -> None:
        for batch in self._feed.take():
            clock = {"ahead_us": batch.ahead_us, "is_anew": batch.is_anew}
            self._scene.ticks(batch.agent, batch.t_us, batch.rows, batch.plan_ned_m, **clock)
            self._newest_us = max(self._newest_us, int(batch.t_us[-1]))
        newer = self._feed.take_obstacles()
        if newer is not None:
            self._obstacles, self._set_us, self._drawn_us = newer, self._newest_us, None
            self._scene.log("operator", self._newest_us, "INFO", counted(len(newer), "obstacle"))
        self._draw_obstacles()

    def _draw_obstacles(self) -> None:
        since_s = None if self._drawn_us is None else (self._newest_us - self._drawn_us) / 1e6
        due_s = 0.0 if any(obstacle.moves for obstacle in self._obstacles) else _REDRAW_PERIOD_S
        if since_s is None or since_s > due_s:
            self._scene.obstacles(self._obstacles, self._newest_us, (self._newest_us - self._set_us) / 1e6)
            self._drawn_us = self._newest_us


def _interruptible(connect: Callable[[], Any], stop: StopRequest) -> Any:
    """Return the result of a blocking connect, or None if `stop` comes first; native code handles no signals."""
    answer: list[Any] = []

    def attempt() -> None:
        try:
            answer.append(connect())
        except Exception as error:
            answer.append(error)

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    while thread.is_alive() and not stop.is_set():
        thread.join(0.05)
    if not answer:
        return None
    if isinstance(answer[0], Exception):
        raise StartError(f"bus: {answer[0]}") from answer[0]
    return answer[0]


def _serve(run: str, directory: Path, port: int, history_mb: int) -> tuple[Any, str]:
    """Return a stream that serves on loopback and, if the disk allows, writes the recording; and its URL."""
    import rerun as rr

    rec = rr.RecordingStream(APPLICATION, recording_id=run, batcher_config=rr.ChunkBatcherConfig(flush_tick=0.25))
    rec.set_log_time_enabled(False)
    path = directory / RECORDING
    writable = _takes_data(path)
    begins, ends = port, port + PORTS_TRIED
    while begins < ends:
        with held_view_port(begins, ends - begins) as candidate:  # or a viewer that looks might bind it meanwhile
            if not candidate:
                break
            server = rr.GrpcServerSink(HOST, candidate, server_memory_limit=f"{history_mb}MB", newest_first=True)
            rec.set_sinks(server, *([rr.FileSink(str(path), write_footer=False)] if writable else []))
            if _is_ours(candidate):
                return rec, f"rerun+http://{HOST}:{candidate}/proxy"
        begins = candidate + 1
    raise StartError(f"no free port in {port}..{port + PORTS_TRIED - 1} on {HOST}. Set telemetry.port")


def _takes_data(path: Path) -> bool:
    try:
        with path.open("wb") as file:
            file.write(bytes(4096))
            file.flush()
        return True
    except OSError as error:
        print(f"viewer: no recording, live view only: {error}", file=sys.stderr, flush=True)
        return False


def _is_ours(port: int, timeout_s: float = 2.0) -> bool:
    """Return whether this process listens on the port; the server binds later and only logs a lost race."""
    until_s = time.monotonic() + timeout_s
    while time.monotonic() < until_s:
        for connection in psutil.Process().net_connections("tcp4"):
            if connection.status == psutil.CONN_LISTEN and connection.laddr.port == port:
                return True
        time.sleep(0.02)
    return False


def _announce(options: argparse.Namespace, url: str) -> None:
    try:
        replace_text(options.run_dir / URL_FILE, url + "\n")
        if options.view and has_display():
            open_viewer(url, options.run_dir / "rerun.log")
    except (OSError, SwarmError) as error:
        print(f"viewer: {error}", file=sys.stderr)
    print(f"viewer {url}", flush=True)


def _serve_page(url: str, log: Path, stop: StopRequest) -> None:
    """Serve the page and print its address; it ends with the request, with this process, or by itself."""
    from swarmctl.telemetry.view.web_page import web_page

    try:
        with web_page(url, log) as page:
            print(f"page {page.url}", flush=True)
            while page.process.poll() is None and not stop.is_set():
                time.sleep(_PAGE_LOOK_S)
    except (OSError, SwarmError) as error:
        print(f"viewer: {error}", file=sys.stderr, flush=True)


def _end(rec: Any, bus: Any, last_line: str) -> NoReturn:
    """Close stream and bus within a bounded time, because flush and disconnect hang while a viewer is frozen.

    Then end the process at once: a thread of theirs that is about to call Python would abort it as Python ends.
    """
    watchdog = threading.Timer(_EXIT_TIMEOUT_S, os._exit, [EXIT_OK])
    watchdog.daemon = True
    watchdog.start()
    print(last_line, flush=True)
    try:
        rec.flush(timeout_sec=_FLUSH_TIMEOUT_S)
    except Exception as error:
        print(f"viewer: flush: {error}", file=sys.stderr, flush=True)
    rec.disconnect()
    bus.close()
    os._exit(EXIT_OK)


if __name__ == "__main__":
    sys.exit(main())
