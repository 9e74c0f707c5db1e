"""Imported first, for its effect: numpy and OpenBLAS use the same kernels on every x86-64 processor.

Both choose by processor when they load, and every choice rounds differently. A flight follows from its last bits, so
"the same for the same seed" would hold on one kind of processor only. What is chosen here has every processor that
numpy itself runs on. The user's variables are overridden; with `SWARMCTL_NATIVE_KERNELS=1` they and the processor rule.

Linear algebra has one thread: matrices here are far too small to share out. SLSQP's library shares them out all the
same and waits for the other processor, which makes it up to ten times slower on a busy machine.
"""

from __future__ import annotations

import math
import mmap
import os
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

NATIVE_ENV = "SWARMCTL_NATIVE_KERNELS"
_CORE_TYPE = "Prescott"  # 2004: SSE3 and no FMA; costs 0 to 3 % of a tick, Nehalem 6 to 11 %
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_DISPATCHED = b"part of the dispatched optimizations\n("  # before the names, in a message that numpy's library contains
_SINE_ARGUMENT, _SINE = -0.16772018962520008, -0.1669349649711518  # last bit differs in a C library without FMA


def _dispatched_features(numpy_directory: Path) -> str:
    """Names of what this numpy chooses between, which it tells only once it has chosen; none if they are not found.

    A name that it doesn't know it warns of, and one of its baseline it refuses to load with: they are not guessed.
    """
    for library in (numpy_directory / "_core").glob("_multiarray_umath*.so"):
        with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            found = content.rfind(_DISPATCHED)
            if found >= 0:
                begin = found + len(_DISPATCHED)
                return content[begin : content.find(b")", begin)].decode("ascii", "replace")
    return ""


def _pin() -> str:
    """Choose for libraries that are not loaded yet; returns why they were not chosen for, or nothing."""
    if "numpy" in sys.modules and os.environ.get("OPENBLAS_CORETYPE") != _CORE_TYPE:  # else by a parent's environment
        return "numpy was loaded before swarmctl"
    for name in _THREADS:
        os.environ[name] = "1"
    if os.environ.get(NATIVE_ENV):
        return f"{NATIVE_ENV} is set"
    machine = os.uname().machine
    if machine != "x86_64":
        return f"this is {machine}, not x86-64"
    os.environ["OPENBLAS_CORETYPE"] = _CORE_TYPE
    os.environ.pop("NPY_ENABLE_CPU_FEATURES", None)  # the two exclude each other
    spec = find_spec("numpy")
    if spec is not None and spec.origin is not None:
        os.environ["NPY_DISABLE_CPU_FEATURES"] = _dispatched_features(Path(spec.origin).parent)
    return ""


_NOT_PINNED = _pin()


def why_not_repeatable() -> str:
    """Why a flight in this process may differ from the same one on another processor; empty when it does not."""
    if _NOT_PINNED:
        return _NOT_PINNED
    loaded = import_module("numpy._core._multiarray_umath")
    chosen = [name for name in loaded.__cpu_dispatch__ if loaded.__cpu_features__[name]]
    if chosen:
        return f"numpy has chosen {' '.join(chosen)} by itself"
    if math.sin(_SINE_ARGUMENT) != _SINE:
        return "this C library rounds a sine differently: another one, or a processor without FMA"
    return ""
