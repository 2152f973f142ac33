"""The navigation policy: attention and a GRU, trained with PPO on observations with driver traits."""

from tint_sumo.policy.action_repeat import ActionRepeat
from tint_sumo.policy.network import AttentionExtractor, GruPolicy
from tint_sumo.policy.ppo import RecurrentPPO
from tint_sumo.policy.trait_observation import TraitObservation
from tint_sumo.policy.trait_sources import (
    ClassifierTraits,
    EncoderTraits,
    NoTraits,
    OracleTraits,
    StreamingTraits,
    TraitSource,
)

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
