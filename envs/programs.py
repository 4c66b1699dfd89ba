"""Earlier names of `envs.exported_networks`, for scripts that import them."""

from envs.exported_networks import ExportedNetwork as Program
from envs.exported_networks import NetworkError as ProgramError
from envs.exported_networks import halve_network as halve_program
from envs.exported_networks import load_network as load_program
from envs.exported_networks import save_network as save_program

__all__ = ["Program", "ProgramError", "halve_program", "load_program", "save_program"]
