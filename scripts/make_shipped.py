"""Remake what data/ ships: trait models and their tables, the policy, pictures. Resumes where it was interrupted.

    .venv/bin/python scripts/make_shipped.py WORK_FOLDER

Takes about an hour and a half on two cores. The commands it runs are those of data/README.md.
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
from tint_sumo.study.trait_models import evaluate_traits
from tint_sumo.study.trait_study import TraitStudy
from tint_sumo.traits.storage import add_to_card

DATA = Path(__file__).resolve().parents[1] / "data"
QUICK = BUDGETS["quick"].ppo
SHIPPED_TRAITS = {"vae": 0.0, "cross_window": 0.05, "morton": 0.0, "classifier": 0.0}  # and the noise in training, m
POLICY_STEPS = 1_200_000
POLICY_SETTINGS = replace(QUICK, n_epochs=4, n_minibatches=4, learning_rate=1e-3, ent_coef=0.005, time_limit_s=50.0)


def run(*arguments: str) -> None:
    print("tint-sumo", *arguments, file=sys.stderr)
    if code := tint_sumo(arguments):
        sys.exit(code)


def make_traits(work: Path) -> None:
    """The comparison of trait methods: its tables, and one model of each method with its pictures."""
    study, dataset = work / "traits", str(work / "traits" / "dataset")
    run("traits", "study", "--out", str(study))
    for name in ("traits.csv", "traits.md", "traits_seeds.csv", "traits_continuous.csv"):
        copy(study / name, DATA / "results" / name)
    copy(study / "traits.png", DATA / "images" / "traits.png")
    for method, noise_m in SHIPPED_TRAITS.items():
        model = DATA / "models" / f"{method}.safetensors"
        trained = study / "models" / f"{method}-noise{noise_m:g}-seed0"
        for suffix in (".safetensors", ".json"):
            copy(trained / f"model{suffix}", model.with_suffix(suffix))
        noises = TraitStudy().noises_m
        accuracy = {f"{noise:g}": evaluate_traits(Path(dataset), model, noise_m=noise)["accuracy"] for noise in noises}
        add_to_card(model, {"accuracy_by_noise": accuracy})  # in m; the linear classifier is fitted to each noise
        run("traits", "plot", "--data", dataset, "--model", str(model), "--noise", f"{noise_m}", "--out", str(work))
        copy(work / "latent.png", DATA / "images" / f"latent_{method}.png")
    run("traits", "plot", "--data", dataset, "--model", "vae", "--out", str(work))
    copy(work / "reconstruction.png", DATA / "images" / "reconstruction.png")


def make_policy(work: Path) -> None:
    policy = work / "vae04"
    with progress_bar("policy vae", "step") as report:
        train_policy("vae", 0.4, POLICY_STEPS, 0, policy, settings=POLICY_SETTINGS, traits="vae", report=report)
    for name in ("policy.zip", "policy.json", "traits.safetensors", "traits.json"):
        copy(policy / name, DATA / "models" / name)


def copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


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
    make_traits(Path(sys.argv[1]))
    make_policy(Path(sys.argv[1]))
