from swarmctl.api.configuration import Config as Config
from swarmctl.api.configuration import load as load
from swarmctl.api.flight import Swarm as Swarm
from swarmctl.api.flight import launch as launch
from swarmctl.api.flight import simulate as simulate
from swarmctl.api.run import Run as Run
from swarmctl.api.run import load_run as load_run
from swarmctl.errors import ConfigError as ConfigError
from swarmctl.errors import MissionError as MissionError
from swarmctl.errors import StartError as StartError
from swarmctl.errors import SwarmError as SwarmError

__version__: str
