"""Run as a program: a training that keeps a checkpoint of every rollout, to be killed."""

import sys
from pathlib import Path

from tint_sumo.config import Mix, PolicySettings, PpoSettings
from tint_sumo.methods import training

METHOD, STEPS, SEED = "no_labels", 64 * 40, 0
SETTINGS = PpoSettings(
    n_envs=4,
    n_steps=16,
    n_epochs=1,
    n_minibatches=1,
    time_limit_s=0.8,
    policy=PolicySettings((8,), (8,), 8, (8,), 8, (8,)),
)

if __name__ == "__main__":
    training.CHECKPOINT_INTERVAL_S = training.STATE_INTERVAL_S = 0.0
    training.train_policy(METHOD, Mix(0.4), STEPS, SEED, Path(sys.argv[1]), settings=SETTINGS)
