"""`python -m swarmctl`, which the launcher itself uses to start agents."""

from swarmctl.ops.cli import main

main()
