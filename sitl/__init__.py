from swarmctl import kernels  # noqa: F401  (before numpy)
