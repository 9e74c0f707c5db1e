"""MAVSDK for vehicles on the ground: sets parameters, uploads a geofence, reads arming checks, downloads logs.

It runs over `raw://`, fed by the scans of the vehicles, so that one socket serves both and every kind of link works. No
process that flies uses it: its blocking calls, each with a timeout, run in threads. Nothing here arms, changes modes or
sends setpoints. Its Offboard plugin is never created, because it repeats the last setpoint without end.
"""

from __future__ import annotations

import contextlib
import os
import queue
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from mavsdk import Configuration, Mavsdk
from mavsdk.autopilot import Autopilot
from mavsdk.exceptions import MavsdkError
from mavsdk.logging import log_subscribe, log_unsubscribe
from mavsdk.plugins.events import Events, LogLevel
from mavsdk.plugins.geofence import FenceType, Geofence, GeofenceData, Point, Polygon
from mavsdk.plugins.log_files import Entry, LogFiles, LogFilesError, LogFilesResult
from mavsdk.plugins.param import Param

from swarmctl.check.scan.link_facts import ArmingProblem, FenceFacts, LatLon, VehicleLog
from swarmctl.check.scan.scanner import SCANNER_COMPID, VehicleScan
from swarmctl.errors import StartError
from swarmctl.mavlink.codec import Codec
from swarmctl.wall_clock import monotonic_us

T = TypeVar("T")
_SERVED = (Autopilot.PX4, Autopilot.ARDUPILOT)  # before it knows which, MAVSDK packs integers as PX4 does
_OWN_SYSID = 255  # a ground station's; the scans speak as companions
_DISCOVERY_S = 4.0  # a heartbeat comes once a second
_CHECKS_S = 8.0  # to download what the numbers of the checks mean, the first time
_POLL_S = 0.05
_PUMP_S = 0.002


class GroundVehicle:
    """One vehicle that MAVSDK has discovered. Its methods block, each for a bounded time.

    Args:
        system: MAVSDK's vehicle.
        may_change: returns whether the vehicle is known to be disarmed now.
        stop: ends what takes long.
    """

    def __init__(self, system: Any, may_change: Callable[[], bool], stop: threading.Event) -> None:
        self._system, self._may_change, self._stop = system, may_change, stop
        self._log_files = LogFiles(system)  # one, because it downloads only what it has listed itself

    def set_parameters(self, values: Mapping[str, float | int]) -> bool:
        """Set parameters one after the other, integers as `int`; what is stored has to be read back.

        Returns:
            Whether the vehicle was disarmed all the time; False ends it before the next parameter.
        """
        plugin = Param(self._system)
        for name, value in values.items():
            if self._stop.is_set() or not self._may_change():
                return False
            with contextlib.suppress(MavsdkError):
                if isinstance(value, int):
                    plugin.set_param_int(name, value)
                else:
                    plugin.set_param_float(name, value)
        return True

    def arming_checks(self) -> tuple[ArmingProblem, ...] | None:
        """Return the autopilot's own list of problems in its current mode; None when it tells none."""
        events, until_s = Events(self._system), time.monotonic() + _CHECKS_S
        while time.monotonic() < until_s and not self._stop.is_set():
            with contextlib.suppress(MavsdkError):
                mode = events.get_health_and_arming_checks_report().current_mode_intention
                return tuple(ArmingProblem(p.message, p.log_level <= LogLevel.ERROR) for p in mode.problems)
            time.sleep(_POLL_S)
        return None

    def fence(self) -> FenceFacts:
        """Return the geofence that the vehicle stores."""
        try:
            told = Geofence(self._system).download_geofence()
        except MavsdkError as error:
            return FenceFacts(problem=_in_words(error))
        kept = [area for area in told.polygons if area.fence_type == FenceType.INCLUSION]
        corners = tuple((p.latitude_deg, p.longitude_deg) for p in kept[0].points) if kept else ()
        others = len(told.polygons) + len(told.circles) - len(kept[:1])
        return FenceFacts(corners_deg=corners, others=others)

    def upload_fence(self, corners_deg: Sequence[LatLon]) -> FenceFacts:
        """Replace the geofence by one polygon to stay in, and return what the vehicle then stores."""
        if not self._may_change():
            return FenceFacts(problem="it was armed, or fell silent, meanwhile")
        area = Polygon([Point(lat, lon) for lat, lon in corners_deg], FenceType.INCLUSION)
        try:
            Geofence(self._system).upload_geofence(GeofenceData(polygons=[area], circles=[]))
        except MavsdkError as error:
            return FenceFacts(problem=_in_words(error))
        return self.fence()

    def logs(self) -> tuple[VehicleLog, ...] | None:
        """Return the vehicle's logs, the oldest first; None when it does not answer, after 8 s."""
        try:
            told = self._log_files.get_entries()
        except LogFilesError as error:
            return () if error.result is LogFilesResult.NO_LOGFILES else None
        return tuple(VehicleLog(number=e.id, date=e.date, size_bytes=e.size_bytes) for e in told)

    def download(self, log: VehicleLog, path: Path, longest_s: float) -> str:
        """Write one log to a file that does not exist yet; return why it is not complete, or ""."""
        plugin, done, last = self._log_files, threading.Event(), [LogFilesResult.TIMEOUT]
        until_s = time.monotonic() + longest_s

        def take(result: LogFilesResult, progress: object, _: object = None) -> None:
            last[0] = result
            if result is not LogFilesResult.NEXT:
                done.set()

        plugin.download_log_file_async(Entry(log.number, log.date, log.size_bytes), str(path), take)
        while not done.wait(_POLL_S):
            if time.monotonic() > until_s or self._stop.is_set() or not self._may_change():
                with contextlib.suppress(MavsdkError):
                    plugin.cancel_download_log_file()
                return f"given up after {longest_s:.0f} s, or because it was armed or fell silent"
        return "" if last[0] is LogFilesResult.SUCCESS else last[0].name.lower().replace("_", " ")


class GroundServices:
    """One MAVSDK for all vehicles of a check; a process must not have many. Use `open_services`."""

    def __init__(self, scans: Mapping[int, VehicleScan]) -> None:
        self._scans = dict(scans)
        self._codec = Codec(_OWN_SYSID, SCANNER_COMPID)
        self._stop = threading.Event()
        self._vehicles: dict[int, GroundVehicle] = {}  # agent -> its discovered vehicle
        self._out: queue.SimpleQueue[bytes] = queue.SimpleQueue()  # MAVSDK's threads do not write to a link
        self._sdk = Mavsdk(Configuration.create_manual(_OWN_SYSID, SCANNER_COMPID, False))
        self._raw = self._sdk.subscribe_raw_bytes_to_be_sent(self._out.put)
        self._sdk.add_any_connection("raw://")
        for scan in self._scans.values():
            scan.tap = self._sdk.pass_received_raw_bytes

    def ask(self, jobs: Mapping[int, Callable[[GroundVehicle], T]]) -> dict[int, T]:
        """Run one job for each of these agents' vehicles, all at once, and return the results of those discovered."""
        found = {agent: vehicle for agent, vehicle in self._discovered(jobs).items() if vehicle is not None}
        with ThreadPoolExecutor(max(1, len(found)), "mavsdk") as pool:
            running = {agent: pool.submit(jobs[agent], vehicle) for agent, vehicle in found.items()}
            try:
                while not all(future.done() for future in running.values()):
                    self._pump()
            except BaseException:  # interrupted: the pool waits for its threads
                self._stop.set()
                raise
        return {agent: future.result() for agent, future in running.items()}

    def close(self) -> None:
        """End MAVSDK; no job may be running."""
        for scan in self._scans.values():
            scan.tap = None
        self._sdk.unsubscribe_raw_bytes_to_be_sent(self._raw)
        self._sdk.destroy()

    def _discovered(self, agents: Collection[int]) -> dict[int, GroundVehicle | None]:
        """Wait until MAVSDK knows these agents' vehicles, and return them; None for one that stays unknown."""
        until_s = time.monotonic() + _DISCOVERY_S
        while time.monotonic() < until_s and not all(self._vehicles.get(agent) for agent in agents):
            self._pump()
            known = [system for system in self._sdk.get_systems() if system.autopilot_type() in _SERVED]
            systems = {system.get_system_id(): system for system in known}
            for agent in agents:
                scan = self._scans[agent]
                if agent not in self._vehicles and scan.sysid in systems:
                    self._vehicles[agent] = GroundVehicle(systems[scan.sysid], partial(_is_disarmed, scan), self._stop)
        return {agent: self._vehicles.get(agent) for agent in agents}

    def _pump(self) -> None:
        """Send what MAVSDK has to say, each frame to whom it names, and feed it what has arrived."""
        while not self._out.empty():
            frame = self._out.get_nowait()
            target = getattr(self._codec.decode(frame), "target_system", 0)
            for scan in self._scans.values():
                if target in (0, scan.sysid):
                    scan.forward(frame)
        now_us = monotonic_us()
        for scan in self._scans.values():
            scan.step(now_us)
        time.sleep(_PUMP_S)


@contextlib.contextmanager
def open_services(scans: Mapping[int, VehicleScan]) -> Iterator[GroundServices]:
    """Start MAVSDK for these vehicles, with different system ids; end it and remove its files afterwards.

    Raises:
        StartError: there is no place for temporary files.
    """
    before = os.environ.get("TMPDIR")
    try:
        scratch = tempfile.TemporaryDirectory(prefix="swarm-mavsdk-", ignore_cleanup_errors=True)
    except OSError as error:
        raise StartError(f"no temporary folder can be made: {error}. Set TMPDIR to one") from error
    with scratch as folder:
        os.environ["TMPDIR"] = folder  # MAVSDK leaves what it downloads in the temporary folder
        log_subscribe(lambda *_: True)  # its own lines would mix with the table
        try:
            services = GroundServices(scans)
            try:
                yield services
            finally:
                services.close()
        finally:
            log_unsubscribe()
            os.environ.pop("TMPDIR")
            if before is not None:
                os.environ["TMPDIR"] = before


def _is_disarmed(scan: VehicleScan) -> bool:
    return scan.may_change(monotonic_us())


def _in_words(error: MavsdkError) -> str:
    return str(error).partition(";")[0].lower().replace("_", " ")
