"""Model cards in the form of Hugging Face: a head in YAML, and a page for people.

Both follow from a model's .json card.
"""

from collections.abc import Mapping
from typing import Any

import yaml

from tint_sumo import __version__
from tint_sumo.config import WORLDS, Mix, TraitSettings
from tint_sumo.core.percentages import percent
from tint_sumo.core.structures import build
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.registry import find_learned

_ENVIRONMENT, _STRANGERS = "tint_sumo/TIntersection-v1", "tint_sumo/Strangers-v0"
_LICENCE = "MIT, as the package."
_P_OF_RESULTS = {
    False: "P is the share of conservative drivers.",
    True: "Each case has its own share of conservative drivers between 0.1 and 0.9.",
}
_TAGS = ["tint_sumo", "sumo", "autonomous-driving", "driver-traits"]


def policy_page(name: str, card: Mapping[str, Any]) -> str:
    """Return README.md of a policy with this .json card."""
    learned = find_learned(card["method"])
    results = card.get("results", {})
    index = [
        _result(
            "reinforcement-learning",
            _tested_in(key),
            {f"{outcome}_rate": found[outcome] for outcome in BUILT_IN_OUTCOMES},
        )
        for key, found in results.items()
    ]
    head = _head(name, "reinforcement-learning", [*_TAGS, "reinforcement-learning", "ppo"], index)
    mix = "the drivers of a SUMO configuration"
    if card["p_conservative"] is not None:
        mix = f"drivers that are conservative with probability {Mix.parse(card['p_conservative']).text}"
    network = card["network"]
    sees = "None of it shows who is conservative."
    if learned.encoder is not None:
        sees = f"It also sees {network['trait_size']} numbers of each, which a trait model ({learned.encoder}) infers."
    elif network["trait_size"] and learned.sees_true_traits:
        sees = "It also sees the true trait of each, which no car on a road could know."
    elif learned.infers_traits:
        sees = "It also sees how likely each is to yield, by its gaps compared with those of the other drivers."
    if card["settings"].get("motion"):
        sees = f"It sees the speed of each and the gap to its leader. {sees}"
    rows = [
        f"| {_drivers(key)} | {' | '.join(percent(found[outcome]) for outcome in BUILT_IN_OUTCOMES)} | "
        f"{len(found['seeds'])} x {found['episodes']} |"
        for key, found in results.items()
    ]
    measured = "This policy has not been measured yet: `tint-sumo policy evaluate --model .` does that."
    if rows:
        measured = "\n".join(
            [
                "| drivers | success % | timeout % | collision % | trainings x cases |",
                "| --- | --: | --: | --: | --: |",
                *rows,
                "",
                f"{_P_OF_RESULTS[next(iter(results)) in WORLDS]} Rates are means over trainings with other seeds, of "
                f"which this is number {card['seed']}. All cases are unseen ones of the scene that it was trained in.",
            ]
        )
    return f"""{head}
# {name}: {learned.title}

A policy that drives a car across and into the traffic of conservative and aggressive drivers in Eclipse SUMO, whose
traits it cannot see. It is the method `{learned.name}` of tint_sumo.

## Inputs and output

Position and velocity of the ego, and the positions of up to {network["max_vehicles"]} vehicles around it. {sees}
Every {card["settings"]["action_repeat"]} simulation steps it chooses one of {network["actions"]} desired speeds; a
controller with a safety check follows it.

## Training

PPO, {card["steps"]:,} decisions in the scene {card["scene"]}, among {mix}; seed {card["seed"]}. Nothing but simulation
was used. `policy.json` has all settings and versions.

## Measured

{measured}

## Limits

* It knows simulated drivers alone, and the gaps, headways and sensor of its training. In other scenes, among other
  drivers or with noise it can do much worse: measure it there first.
* It is for research. It must not control a real car.
* It chooses a speed on a fixed way, and relies on the controller's safety check.

## How to use it

```python
from tint_sumo.methods.loading import load_policy

policy = load_policy("FOLDER")  # of these files
```

`tint-sumo policy evaluate --model FOLDER` measures it, `tint-sumo render --model FOLDER --out film.gif` shows it.

## Licence

{_LICENCE}
"""


def _tested_in(key: str) -> dict[str, str]:
    """Return the environment of a result: a share of conservative drivers, or a world."""
    if key in WORLDS:
        return {"type": _STRANGERS, "name": f"{_STRANGERS}, world {key} ({WORLDS[key].title})"}
    return {"type": _ENVIRONMENT, "name": f"{_ENVIRONMENT}, {key} (share of conservative drivers)"}


def _drivers(key: str) -> str:
    return WORLDS[key].title if key in WORLDS else key


def traits_page(name: str, card: Mapping[str, Any]) -> str:
    """Return README.md of a trait model with this .json card."""
    data, settings = card.get("data") or {}, build(TraitSettings, card["settings"])
    accuracy = card.get("accuracy_by_noise", {})
    index = [
        _result(
            "feature-extraction",
            {"type": "tint_sumo", "name": f"recorded windows of {data.get('scene')}, noise {noise} m"},
            {"accuracy": share},
        )
        for noise, share in accuracy.items()
    ]
    head = _head(name, "feature-extraction", [*_TAGS, "representation-learning"], index)
    rows = [f"| {noise} | {percent(share)} |" for noise, share in accuracy.items()]
    measured = "This model has not been measured yet: `tint-sumo traits evaluate --model .` does that."
    if rows:
        measured = "\n".join(
            [
                "| noise on positions, m | accuracy % |",
                "| --: | --: |",
                *rows,
                "",
                "Accuracy is that of a linear classifier on the latents, in windows of episodes that the training left "
                "out.",
            ]
        )
    labels = "with the true traits" if card["method"] == "classifier" else "without labels"
    mix = data.get("p_conservative")
    drivers = "" if mix is None else f", whose drivers are conservative with probability {Mix.parse(mix).text}"
    windows = f"{card['windows']:,} windows" if "windows" in card else "Windows"
    source = f"the scene {data.get('scene', '(not noted)')} in Eclipse SUMO{drivers}"
    if recorded := card.get("recorded"):
        source = f"recorded traffic, {recorded['tracks']}"
        if "drawn" in recorded:
            source = f"{recorded['drawn']} drivers drawn from the {recorded['model']} fit of {source}"
    return f"""{head}
# {name}: a model of driver traits

It makes {card["latent_size"]} numbers of 2 s of a driver's way, which show what kind of driver that is. It is the trait
method `{card["method"]}` of tint_sumo, trained {labels}.

## Inputs and output

Up to 20 steps of 0.1 s: positions along the lane, and gaps to the leader, in metres. Mean and variance of the latents
come out.

## Training

{windows} of {source}; {settings.epochs} epochs, with
noise of {settings.noise_m:g} m on positions, seed {card.get("seed", 0)}. `model.json` has all settings.

## Measured

{measured}

## Limits

* It knows the drivers of its training. `tint-sumo traits infer` says which windows lie outside of that.
* Noise on positions makes it worse, as the table shows.
* Latents say how a driver drives, not who it is; with recorded people they must not be used to judge persons.

## How to use it

```python
from tint_sumo import traits

model = traits.load("FOLDER")  # of these files
```

`tint-sumo traits infer --fcd FILE --model FOLDER --out table.csv` infers traits in any SUMO run.

## Licence

{_LICENCE}
"""


def _head(name: str, task: str, tags: list[str], results: list[dict[str, Any]]) -> str:
    head: dict[str, Any] = {
        "license": "mit",
        "library_name": "tint_sumo",
        "pipeline_tag": task,
        "tags": tags,
        "tint_sumo_version": __version__,
    }
    if results:
        head["metrics"] = list(dict.fromkeys(metric["type"] for one in results for metric in one["metrics"]))
        head["model-index"] = [{"name": name, "results": results}]
    return f"---\n{yaml.safe_dump(head, sort_keys=False, allow_unicode=True)}---\n"


def _result(task: str, dataset: dict[str, str], metrics: Mapping[str, float]) -> dict[str, Any]:
    found = [
        {"type": kind, "value": round(float(value), 6), "name": kind.replace("_", " ")}
        for kind, value in metrics.items()
    ]
    return {"task": {"type": task, "name": task.replace("-", " ")}, "dataset": dataset, "metrics": found}
