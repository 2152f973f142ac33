"""Representations of driver traits learnt from trajectories; each method is one module, imported here once."""

from tint_sumo.traits import classifier as classifier
from tint_sumo.traits import cross_window as cross_window
from tint_sumo.traits import morton as morton
from tint_sumo.traits import vae as vae
from tint_sumo.traits.model import TRAIT_METHODS, TraitModel
from tint_sumo.traits.storage import load

__all__ = ["TRAIT_METHODS", "TraitModel", "load"]
