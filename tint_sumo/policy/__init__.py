"""The navigation policy: attention and a GRU, trained with PPO on observations with driver traits."""

from tint_sumo.policy.network import AttentionExtractor, GruPolicy
from tint_sumo.policy.ppo import RecurrentPPO
from tint_sumo.policy.trait_sources import (
    ClassifierTraits,
    EncoderTraits,
    NeighbourTraits,
    NoTraits,
    OracleTraits,
    StreamingTraits,
    TraitSource,
    WithMotion,
)
from tint_sumo.policy.wrappers import ActionRepeat, TraitObservation

__all__ = [
    "ActionRepeat",
    "AttentionExtractor",
    "ClassifierTraits",
    "EncoderTraits",
    "GruPolicy",
    "NeighbourTraits",
    "NoTraits",
    "OracleTraits",
    "RecurrentPPO",
    "StreamingTraits",
    "TraitObservation",
    "TraitSource",
    "WithMotion",
]
