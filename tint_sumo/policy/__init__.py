"""The navigation policy: attention and a GRU, trained with PPO on observations with driver traits."""

from tint_sumo.policy.network import AttentionExtractor, GruPolicy
from tint_sumo.policy.ppo import RecurrentPPO
from tint_sumo.policy.trait_observation import EncoderTraits, NoTraits, OracleTraits, TraitObservation, TraitSource

__all__ = [
    "AttentionExtractor",
    "EncoderTraits",
    "GruPolicy",
    "NoTraits",
    "OracleTraits",
    "RecurrentPPO",
    "TraitObservation",
    "TraitSource",
]
