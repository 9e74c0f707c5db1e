"""A MAVLink-connected flight-stack bridge for quadrotor swarms."""

__version__ = "0.1.0"
