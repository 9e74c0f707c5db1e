"""A MAVLink-connected flight-stack bridge for quadrotor swarms."""

from swarmctl import kernels  # noqa: F401  (before numpy)

__version__ = "0.1.0"
