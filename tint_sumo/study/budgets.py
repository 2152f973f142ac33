"""What a study runs: everything that sets its cost and its quality, in one place."""

from dataclasses import dataclass, field, replace

from tint_sumo.config import P_CONSERVATIVE, PolicySettings, PpoSettings, TraitSettings
from tint_sumo.errors import InputError


@dataclass(frozen=True)
class Budget:
    """Sizes of all stages of a study."""

    windows: int  # to record
    record_p_conservative: float = 0.5  # share of conservative drivers in the dataset
    traits: TraitSettings = field(default_factory=TraitSettings)
    ppo: PpoSettings = field(default_factory=PpoSettings)  # with the steps of every policy
    methods: tuple[str, ...] = ("always_go", "ttc", "no_labels", "vae", "oracle")
    p_conservative: tuple[float, ...] = P_CONSERVATIVE
    seeds: tuple[int, ...] = (0, 1, 2)
    episodes: int = 500  # per policy (paper IV-C)


# A small network is as accurate here as the paper's, trains in minutes and encodes 768 windows in less than 2 ms.
_FULL = TraitSettings(
    embedding_sizes=(),
    hidden_size=20,
    encoder_output_size=32,
    decoder_output_size=32,
    learning_rate=3e-3,
    batch_size=512,
    epochs=3,
)

TRAIT_BUDGETS = {
    "quick": replace(_FULL, batch_size=256, epochs=20),  # for some 30,000 windows
    "full": _FULL,  # for the paper's 696,000
    "paper": TraitSettings(),
}

BUDGETS = {
    "quick": Budget(
        windows=30_000,
        traits=TRAIT_BUDGETS["quick"],
        ppo=PpoSettings(
            n_envs=64,
            n_steps=64,
            n_epochs=6,
            n_minibatches=8,
            learning_rate=2e-3,
            gamma=0.993,  # of a decision of 0.4 s; with less, waiting for a gap does not pay
            ent_coef=0.003,
            total_steps=200_000,
            action_repeat=4,
            time_limit_s=25.0,  # an ego that is stuck teaches nothing more
            policy=PolicySettings(
                position_gain=6.0,
                embedding_sizes=(64, 64),
                score_sizes=(64,),
                context_size=64,
                joint_sizes=(64, 64),
                hidden_size=64,
                head_sizes=(64,),
            ),
        ),
        p_conservative=(0.4,),
        seeds=(0,),
        episodes=200,
    ),
    "paper": Budget(windows=696_000),  # the number of the paper's trajectories
}


def find_budget(name: str) -> Budget:
    """The budget called ``name``.

    Raises:
        InputError: there is none.
    """
    if name not in BUDGETS:
        raise InputError(f"unknown budget {name!r}; choose one of: {', '.join(BUDGETS)}")
    return BUDGETS[name]
