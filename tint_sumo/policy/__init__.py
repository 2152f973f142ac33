"""The navigation policy: attention and a GRU, trained with PPO on observations with driver traits."""

from tint_sumo.policy.network import AttentionExtractor, GruPolicy
from tint_sumo.policy.ppo import RecurrentPPO
from tint_sumo.policy.trait_sources import (
    ClassifierTraits,
    EncoderTraits,
    NoTraits,
    OracleTraits,
    StreamingTraits,
    TraitSource,
)
from tint_sumo.policy.wrappers import ActionRepeat, TraitObservation

__all__ = [
    "ActionRepeat",
    "AttentionExtractor",
    "ClassifierTraits",
    "EncoderTraits",
    "GruPolicy",
    "NoTraits",
    "OracleTraits",
    "RecurrentPPO",
    "StreamingTraits",
    "TraitObservation",
    "TraitSource",
]
