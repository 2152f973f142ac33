"""Remake what data/ ships: the trait model, the policy and the pictures. Resumes where it was interrupted.

    .venv/bin/python scripts/make_shipped.py WORK_FOLDER

Takes about half an hour on two cores. The commands it runs are those of data/README.md.
"""

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import torch
from PIL import Image

from tint_sumo import ENV_ID
from tint_sumo.cli import main as tint_sumo
from tint_sumo.study.budgets import BUDGETS
from tint_sumo.study.progress import progress_bar
from tint_sumo.study.training import train_policy

DATA = Path(__file__).resolve().parents[1] / "data"
QUICK = BUDGETS["quick"].ppo
POLICY_STEPS = 1_200_000
POLICY_SETTINGS = replace(QUICK, n_epochs=4, n_minibatches=4, learning_rate=1e-3, ent_coef=0.005, time_limit_s=50.0)


def run(*arguments: str) -> None:
    print("tint-sumo", *arguments, file=sys.stderr)
    if code := tint_sumo(arguments):
        sys.exit(code)


def make_models(work: Path) -> None:
    dataset, traits, policy = (str(work / name) for name in ("dataset", "ours", "ours04"))
    run("record", "--out", dataset, "--windows", "60000")
    run("traits", "train", "--data", dataset, "--out", traits)
    with progress_bar("policy ours", "step") as report:
        train_policy("ours", 0.4, POLICY_STEPS, 0, Path(policy), settings=POLICY_SETTINGS, traits=traits, report=report)
    copies = {
        f"{traits}/model.safetensors": "ours.safetensors",
        f"{traits}/model.json": "ours.json",
        f"{policy}/policy.zip": "policy.zip",
        f"{policy}/policy.json": "policy.json",
        f"{policy}/traits.safetensors": "traits.safetensors",
        f"{policy}/traits.json": "traits.json",
    }
    for source, name in copies.items():
        shutil.copyfile(source, DATA / "models" / name)


def make_pictures() -> None:
    env = gymnasium.make(ENV_ID, render_mode="rgb_array")
    env.reset(seed=1)
    for step in range(41):
        env.step(np.int64(2 if step > 5 else 0))
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    Image.fromarray(picture).save(DATA / "images" / "scene.png", optimize=True)
    env.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    torch.set_num_threads(1)  # the networks are small
    make_pictures()
    make_models(Path(sys.argv[1]))
