"""Makes numpy and OpenBLAS use the same kernels on every x86-64 processor. Imported first, for this effect.

Both libraries select kernels by processor when they load, and each kernel rounds differently. A flight depends on the
last bits, so results for one seed would repeat on one kind of processor only. The kernels selected here run on every
processor that numpy supports. User variables are overridden, unless `SWARMCTL_NATIVE_KERNELS=1` is set.

Linear algebra is limited to one thread, because the matrices here are small. SLSQP's library would otherwise distribute
them and wait for the other threads, which makes it up to ten times slower on a busy machine.
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
_DISPATCHED = b"part of the dispatched optimizations\n("  # precedes the feature names in a message in numpy's library
_SINE_ARGUMENT, _SINE = -0.16772018962520008, -0.1669349649711518  # last bit differs in a C library without FMA


def _dispatched_features(numpy_directory: Path) -> str:
    """Return the processor features this numpy dispatches on, read from its library; "" if they are not found.

    numpy reports them only after it has loaded. Guessing is no option: it warns of a name it does not know, and
    refuses to load when one of its baseline is disabled.
    """
    for library in (numpy_directory / "_core").glob("_multiarray_umath*.so"):
        with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            found = content.rfind(_DISPATCHED)
            if found >= 0:
                begin = found + len(_DISPATCHED)
                return content[begin : content.find(b")", begin)].decode("ascii", "replace")
    return ""


def _pin() -> str:
    """Set the environment for libraries that are not loaded yet; returns why that was impossible, or ""."""
    if "numpy" in sys.modules and os.environ.get("OPENBLAS_CORETYPE") != _CORE_TYPE:  # equal if a parent has set it
        return "numpy was loaded before swarmctl"
    for name in _THREADS:
        os.environ[name] = "1"
    if os.environ.get(NATIVE_ENV):
        return f"{NATIVE_ENV} is set"
    machine = os.uname().machine
    if machine != "x86_64":
        return f"this is {machine}, not x86-64"
    os.environ["OPENBLAS_CORETYPE"] = _CORE_TYPE
    os.environ.pop("NPY_ENABLE_CPU_FEATURES", None)  # numpy refuses to load with both variables
    spec = find_spec("numpy")
    if spec is not None and spec.origin is not None:
        os.environ["NPY_DISABLE_CPU_FEATURES"] = _dispatched_features(Path(spec.origin).parent)
    return ""


_NOT_PINNED = _pin()


def why_not_repeatable() -> str:
    """Return why a flight in this process may differ from the same one on another processor, or ""."""
    if _NOT_PINNED:
        return _NOT_PINNED
    loaded = import_module("numpy._core._multiarray_umath")
    chosen = [name for name in loaded.__cpu_dispatch__ if loaded.__cpu_features__[name]]
    if chosen:
        return f"numpy has chosen {' '.join(chosen)} by itself"
    if math.sin(_SINE_ARGUMENT) != _SINE:
        return "this C library rounds a sine differently: another one, or a processor without FMA"
    return ""
