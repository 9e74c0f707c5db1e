"""`python -m swarmctl`, which the launcher itself uses to start agents."""

from swarmctl.cli import main

main()
