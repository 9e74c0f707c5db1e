"""Tests that a flight is the same bit for bit on every x86-64 processor, whatever kernels numpy would select."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from swarmctl.kernels import NATIVE_ENV, why_not_repeatable

ROOT = Path(__file__).parents[2]
FLIGHT = """
import {first}
import hashlib
from sitl.lockstep import Lockstep
from swarmctl.config import load
flight = Lockstep(load(None, ["sitl.start=air", "sitl.physics_hz=100"]))
while flight.clock.now_us() < {until_us}:
    flight.step()
print(hashlib.sha256(flight.truth.tobytes()).hexdigest())
"""
CORE_TYPES = {"Prescott": "pni", "Haswell": "fma", "Zen": "fma", "SkylakeX": "avx512dq"}  # with the flag required
_VARIABLES = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "NPY_ENABLE_CPU_FEATURES", NATIVE_ENV)


def processor_flags() -> set[str]:
    """Return the feature flags of this processor."""
    lines = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines()
    return {flag for line in lines if line.startswith("flags") for flag in line.split(":")[1].split()}


RUN_HERE = [name for name, flag in CORE_TYPES.items() if flag in processor_flags()]
pytestmark = pytest.mark.skipif(not RUN_HERE, reason="not an x86-64 processor: nothing is pinned there")


UNDER_WAY_US = 7_000_000  # includes seconds of planning by three agents after their estimators have settled


def fly(variables: dict[str, str], first: str = "sitl", until_us: int = UNDER_WAY_US) -> tuple[str, str]:
    """Return hash of the truth and standard error of a flight in a separate process that loads `first` first."""
    kept = {name: value for name, value in os.environ.items() if name not in _VARIABLES}
    command = [sys.executable, "-c", FLIGHT.format(first=first, until_us=until_us)]
    done = subprocess.run(command, env=kept | variables, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip(), done.stderr


@cache
def plain() -> tuple[str, str]:
    return fly({})


@pytest.mark.parametrize("core_type", RUN_HERE)
def test_core_types_do_not_matter(core_type: str) -> None:
    assert fly({"OPENBLAS_CORETYPE": core_type}) == plain()


def test_user_settings_of_numpy_do_not_matter() -> None:
    assert fly({"NPY_ENABLE_CPU_FEATURES": "X86_V3", "OPENBLAS_NUM_THREADS": "2"}) == plain()
    assert fly({"NPY_DISABLE_CPU_FEATURES": "X86_V3"}) == plain()
    assert plain()[1] == "", "and nothing is warned of"


def test_negative_control_left_to_themselves_processors_differ_and_it_is_said() -> None:
    native = [fly({"OPENBLAS_CORETYPE": name, NATIVE_ENV: "1"}) for name in (RUN_HERE[0], RUN_HERE[-1])]
    assert all(f"{NATIVE_ENV} is set" in said for _, said in native)
    if len(RUN_HERE) > 1:
        assert native[0][0] != native[1][0]


def test_numpy_loaded_first_is_reported() -> None:
    _, said = fly({}, "numpy", until_us=20_000)
    assert "numpy was loaded before swarmctl" in said


def test_these_tests_fly_repeatably() -> None:
    assert os.environ.get(NATIVE_ENV) or why_not_repeatable() == ""
