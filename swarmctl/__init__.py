"""A MAVLink-connected flight-stack bridge for quadrotor swarms.

What scripts use is here by name, and imported when it is first used, so that `import swarmctl` stays quick for the
command line. `__init__.pyi` declares the same names to type checkers.
"""

from importlib import import_module

from swarmctl import kernels  # noqa: F401  (before numpy)

__version__ = "0.1.0"
_OWNERS = {  # of the names for scripts, which no module of the bridge uses: its layers import each other only
    "Config": "swarmctl.api.configuration",
    "ConfigError": "swarmctl.errors",
    "MissionError": "swarmctl.errors",
    "Run": "swarmctl.api.run",
    "StartError": "swarmctl.errors",
    "Swarm": "swarmctl.api.flight",
    "SwarmError": "swarmctl.errors",
    "launch": "swarmctl.api.flight",
    "load": "swarmctl.api.configuration",
    "load_run": "swarmctl.api.run",
    "simulate": "swarmctl.api.flight",
}


def __getattr__(name: str) -> object:
    """Return a name for scripts from the module that defines it."""
    if name not in _OWNERS:
        raise AttributeError(f"module 'swarmctl' has no attribute {name!r}")
    value: object = getattr(import_module(_OWNERS[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names of the module, those for scripts included."""
    return sorted({*globals(), *_OWNERS})
