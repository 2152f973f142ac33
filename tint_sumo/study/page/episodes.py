"""The page's sections on single episodes: the player, and the list of failures."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from tint_sumo.core.errors import InputError
from tint_sumo.jobs import Workers
from tint_sumo.methods.registry import METHODS, look_of
from tint_sumo.scenes import Scene
from tint_sumo.study.page.choosing import FAILURES, Choice, Shown
from tint_sumo.study.page.html import bullets, folded, json_data, packed, paragraph
from tint_sumo.study.page.recording import MISSING, UNITS, Recording, read_episodes, record_all
from tint_sumo.study.page.roads import scene_shapes


@dataclass(frozen=True)
class Recorded:
    """The episodes of one policy."""

    policy: Shown
    episodes: dict[int, dict[str, Any]]  # by the number of the case


@dataclass(frozen=True)
class Recordings:
    """Policies and episodes that the player can show."""

    scene: Scene
    choice: Choice
    policies: tuple[Recorded, ...]
    refusals: tuple[str, ...]  # why policies are not among them


def record_episodes(out: Path, scene: Scene, choice: Choice, *, workers: Workers, progress: bool) -> Recordings:
    """Record the chosen cases of all policies that can be loaded, as far as they are not there already.

    Raises:
        InputError: a file of recorded episodes is damaged.
    """
    ready: list[tuple[Shown, Recording]] = []
    refusals = []
    for shown in choice.policies:
        recording = Recording(shown.method, shown.mix, shown.seed, choice.conditions, choice.cases, out, scene)
        try:
            recording.require_policy()
        except InputError as error:
            refusals.append(f"{shown.title}: {error}")
        else:
            ready.append((shown, recording))
    record_all([recording for _, recording in ready], out, workers, progress)
    recorded = tuple(Recorded(shown, read_episodes(recording.file)) for shown, recording in ready)
    return Recordings(scene, choice, recorded, tuple(refusals))


def player_data(recordings: Recordings) -> str:
    """Return the data for the player's script: a table of contents, and each episode by itself."""
    contents = {
        "units": UNITS,
        "missing": MISSING,
        "opening": _opening(recordings.policies).label,
        "scene": scene_shapes(recordings.scene),
        "policies": [
            {
                "label": recorded.policy.label,
                "title": recorded.policy.title,
                "colour": look_of(recorded.policy.method).colour,
                "outcomes": {str(case): episode["outcome"] for case, episode in recorded.episodes.items()},
            }
            for recorded in recordings.policies
        ],
    }
    episodes = [
        packed(f"episode-{recorded.policy.label}-{case}", json.dumps(episode, separators=(",", ":")))
        for recorded in recordings.policies
        for case, episode in recorded.episodes.items()
    ]
    return json_data("player-data", contents) + "".join(episodes)


def _opening(policies: Sequence[Recorded]) -> Shown:
    """Return the policy that is shown first: the most successful one of those that infer traits, or else of all."""
    shown = [recorded.policy for recorded in policies]
    inferring = [policy for policy in shown if getattr(METHODS.get(policy.method), "infers_traits", False)]
    return max(inferring or shown, key=lambda policy: policy.evaluation.rate("success").value)


def player_notes(recordings: Recordings) -> str:
    """Return notes for readers about the recorded episodes."""
    choice = recordings.choice
    parts = [
        paragraph(
            f"Each method is shown with its policy of the first seed, in the same {len(choice.cases)} of the study's "
            f"cases (P(conservative) {choice.conditions.p_conservative.text}): failures of every method, and a "
            "few successes. The policies take their likeliest actions, as they did in the tests."
        )
    ]
    return "".join([*parts, *(paragraph(f"Left out: {refusal}") for refusal in recordings.refusals)])


def failure_lists(recordings: Recordings) -> str:
    """Return how often each policy failed, with its recorded failures, folded, as buttons that open the player."""
    return "".join(_failures(recorded) for recorded in recordings.policies)


def _failures(recorded: Recorded) -> str:
    cases = recorded.policy.evaluation.cases
    counts = {outcome: sum(case.outcome == outcome for case in cases) for outcome in FAILURES}
    failed = {case: episode for case, episode in recorded.episodes.items() if episode["outcome"] in FAILURES}
    if not failed and not any(counts.values()):
        return ""
    counted = " and ".join(_count(number, outcome) for outcome, number in counts.items())
    buttons = [
        f'<button type="button" data-policy="{escape(recorded.policy.label)}" data-case="{case}">'
        f"{escape(_failure(case, episode))}</button>"
        for case, episode in failed.items()
    ]
    summary = f"{recorded.policy.title}: {counted} in {len(cases)} cases; {len(failed)} of them recorded"
    return folded(summary, bullets(buttons)) if buttons else paragraph(summary)


def _failure(case: int, episode: dict[str, Any]) -> str:
    text = f"Case {case}: {episode['outcome']} after {episode['time_s']:.1f} s"
    return text + (f" ({', '.join(episode['hit'])})" if episode["hit"] else "")


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")
