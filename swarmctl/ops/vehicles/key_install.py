"""`swarmctl keys install`: gives every vehicle of a configuration its signing key, and sees it sign with it.

SETUP_SIGNING carries the key in clear text: this is done once, over a cable or a network that nobody else is on. A
vehicle that signs already takes a new key only from who signs with its old one. Armed vehicles are left alone, as they
would refuse it.
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.check.scan.listener import NOWHERE, Address, Listener, open_listener
from swarmctl.check.scan.scanner import SCANNER_COMPID
from swarmctl.config import Config
from swarmctl.core.mavlink_values import ACTIVE, ARMED_FLAG, AUTOPILOT_COMPID, NO_AUTOPILOT, ONBOARD_CONTROLLER
from swarmctl.errors import EXIT_MISSION, EXIT_OK, EXIT_START, ConfigError
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.signing.channel import CHECK_LINK, SigningChannel
from swarmctl.mavlink.signing.key_file import read_key
from swarmctl.mavlink.signing.signature import SigningKey, is_authentic, is_signed, origin, sign, strip
from swarmctl.mavlink.signing.stamp_file import kept_channel
from swarmctl.process_lifetime import StopRequest
from swarmctl.signing_keys import KEY, read_keys
from swarmctl.wall_clock import WallClock, monotonic_us

_LONGEST_S = 10.0  # heartbeats come once a second, and a request may be lost
_REQUEST_US = 1_000_000
_POLL_S = 0.01


class Installation:
    """Gives one vehicle its key.

    Args:
        listener: link of the vehicle.
        there: address to send to before the vehicle is received.
        sysid: its system id.
        channel: signs and verifies with the new key.
        key: the new key.
        old_keys: keys that the vehicle may have.

    Attributes:
        done: the vehicle signs with the new key.
    """

    def __init__(
        self,
        listener: Listener,
        there: Address,
        sysid: int,
        *,
        channel: SigningChannel,
        key: SigningKey,
        old_keys: Sequence[SigningKey],
    ) -> None:
        self._listener, self._there, self._sysid = listener, there, sysid
        self._channel, self._key, self._old_keys = channel, key, old_keys
        self._codec = Codec(sysid, SCANNER_COMPID)
        self._armed: bool | None = None  # None: unknown, also of a vehicle whose key is
        self._signer: SigningKey | None = None  # key with which the vehicle signs now
        self._is_foreign = False  # it signs with a key that is not known here
        self._newest = 0  # its newest time stamp
        self._due_us = 0
        self._requests = 0
        self.done = False

    @property
    def problem(self) -> str:
        """Why the vehicle does not sign with its key yet, or ""."""
        if self.done:
            return ""
        if self._is_foreign:
            return "it signs with another key; name the file of that one with --old"
        if self._armed is None:
            return "no heartbeat of its autopilot is received"
        if self._armed:
            return "it is armed; disarm it first"
        return f"it does not sign after {self._requests} requests; does its firmware know SETUP_SIGNING?"

    @property
    def reached(self) -> bool:
        """Whether anything of the vehicle was received."""
        return self.done or self._is_foreign or self._armed is not None

    def step(self, now_us: int) -> None:
        """Take in what has arrived, and ask again when it is time."""
        for heard in self._listener.receive():
            for frame in frames(heard.data):
                if frame[5:7] == bytes((self._sysid, AUTOPILOT_COMPID)):
                    self._there = heard.sender
                    self._take(frame)
        if self.done or self._there == NOWHERE or now_us < self._due_us:
            return
        self._due_us = now_us + _REQUEST_US
        self._ask()

    def _take(self, frame: bytes) -> None:
        signed = is_signed(frame)
        if signed:
            self._signer = next((key for key in (self._key, *self._old_keys) if is_authentic(frame, key)), None)
            self._is_foreign = self._signer is None
            if self._is_foreign:
                self._armed = None
                return
            self._newest = max(self._newest, origin(frame)[1])
            self.done = self._signer is self._key and self._channel.take(frame) is not None
        message = self._codec.decode(strip(frame) if signed else frame)
        if message is not None and message.get_type() == "HEARTBEAT" and message.autopilot != NO_AUTOPILOT:
            self._armed = bool(message.base_mode & ARMED_FLAG)

    def _ask(self) -> None:
        """Send a heartbeat, and the key if the vehicle is disarmed and has not got it."""
        beat = mavlink.MAVLink_heartbeat_message(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, ACTIVE, 3)
        self._send(beat)
        if self._armed is not False or self._signer is self._key:
            return
        self._requests += 1
        stamp = max(self._channel.stamps().sent, self._newest)
        self._send(mavlink.MAVLink_setup_signing_message(self._sysid, AUTOPILOT_COMPID, self._key.secret, stamp))

    def _send(self, message: Any) -> None:
        frame = self._codec.encode(message)
        if self._signer is self._key:
            frame = self._channel.sign(frame)
        elif self._signer is not None:
            self._newest += 1
            frame = sign(frame, self._signer, CHECK_LINK, max(self._newest, self._channel.next_stamp()))
        self._listener.send(frame, self._there)


@dataclass(frozen=True, slots=True)
class _Vehicle:
    agent: int
    url: str
    installation: Installation


def install(config: Config, old_files: Sequence[Path]) -> int:
    """Give every vehicle its key and return the exit code.

    Raises:
        ConfigError: there is no key or no vehicle to give it to, or a file can't be used.
        StartError: a link can't be opened.
    """
    agents = config.swarm.agents
    keys = [key for key in read_keys(config.mavlink.signing_keys, agents) if key is not None]
    if not keys:
        raise ConfigError(KEY, ["no files are listed; make them with swarmctl keys new"])
    if config.sitl.enabled:
        raise ConfigError("sitl.enabled", ["the built-in simulator reads the keys itself; there is nothing to install"])
    old_keys = _read_old(old_files)
    ended_cleanly = StopRequest(signal.SIGTERM, signal.SIGHUP, raise_at=1)
    clock = WallClock()
    with ended_cleanly, contextlib.ExitStack() as kept:
        vehicles = []
        for agent, key in enumerate(keys):
            url, sysid = config.vehicles[agent].url, config.sysids()[agent]
            listener, there = open_listener(url)
            kept.callback(listener.close)
            channel = kept.enter_context(kept_channel(key, CHECK_LINK, clock.utc_us))
            made = Installation(listener, there, sysid, channel=channel, key=key, old_keys=old_keys)
            vehicles.append(_Vehicle(agent, url, made))
        _run(vehicles)
    return _report(vehicles, keys)


def _read_old(files: Sequence[Path]) -> list[SigningKey]:
    try:
        return [read_key(path) for path in files]
    except OSError as error:
        raise ConfigError("--old", [str(error)]) from error


def _run(vehicles: Sequence[_Vehicle]) -> None:
    until_s = time.monotonic() + _LONGEST_S
    while time.monotonic() < until_s and not all(vehicle.installation.done for vehicle in vehicles):
        for vehicle in vehicles:
            vehicle.installation.step(monotonic_us())
        time.sleep(_POLL_S)


def _report(vehicles: Sequence[_Vehicle], keys: Sequence[SigningKey]) -> int:
    for vehicle, key in zip(vehicles, keys, strict=True):
        problem = vehicle.installation.problem
        outcome = f"not installed: {problem}" if problem else f"signs with key {key.fingerprint}"
        print(f"agent-{vehicle.agent} {vehicle.url}: {outcome}")
    if all(vehicle.installation.done for vehicle in vehicles):
        return EXIT_OK
    return EXIT_MISSION if all(vehicle.installation.reached for vehicle in vehicles) else EXIT_START
