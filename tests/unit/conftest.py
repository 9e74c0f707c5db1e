"""Disables the deadlines of property tests, which would measure the load of a shared machine."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("unit", deadline=None)
settings.load_profile("unit")
