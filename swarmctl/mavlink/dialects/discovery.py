"""The dialects that this program speaks: one for each autopilot that a module of this package describes.

A module is found by being there, so that a new autopilot is one new file.
"""

from __future__ import annotations

from collections.abc import Mapping

from swarmctl.core.discovery.declared import declared
from swarmctl.mavlink import dialects
from swarmctl.mavlink.dialects.dialect import Dialect

DIALECTS: Mapping[int, Dialect] = {found.number: found for found in declared(dialects, Dialect)}  # HEARTBEAT.autopilot
