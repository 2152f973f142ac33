"""Representations of driver traits learnt from trajectories; each method is one module, imported here once."""

from tint_sumo.traits import vae as vae
from tint_sumo.traits.model import METHODS, TraitModel
from tint_sumo.traits.storage import load

__all__ = ["METHODS", "TraitModel", "load"]
