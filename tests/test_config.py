"""Numbers of the study, and mixes of drivers."""

import pickle
from typing import Any

import numpy as np
import pytest

from tint_sumo.config import ALL_MIXES, Mix, PpoSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.structures import FieldError, Many, build, plain


@pytest.mark.parametrize(
    ("given", "mix", "text", "written"),
    [
        (0.4, Mix(0.4), "0.4", 0.4),
        (1, Mix(1.0, 1.0), "1", 1.0),
        (np.float32(0.5), Mix(0.5), "0.5", 0.5),
        ((0.1, 0.9), ALL_MIXES, "0.1 to 0.9", [0.1, 0.9]),
        ([0.25, 0.25], Mix(0.25), "0.25", 0.25),
        ((0.5,), Mix(0.5), "0.5", 0.5),  # as the values of a flag come
        (ALL_MIXES, ALL_MIXES, "0.1 to 0.9", [0.1, 0.9]),
    ],
)
def test_a_mix_is_one_probability_or_two(given: Any, mix: Mix, text: str, written: Any) -> None:
    assert Mix.parse(given) == mix == Mix.from_text(text)
    assert (mix.text, plain(mix)) == (text, written)
    assert build(Mix, written) == mix == pickle.loads(pickle.dumps(mix))
    assert type(mix.low) is type(mix.high) is float


@pytest.mark.parametrize("given", ["x", None, True, [], [0.1, 0.5, 0.9], [0.9, 0.1], 1.5, -0.1, float("nan"), 10**400])
def test_what_is_no_mix_is_refused_in_one_line(given: Any) -> None:
    with pytest.raises(InputError, match=r"^P\(conservative\) must be a probability in \[0, 1\], or two .*, not .+$"):
        Mix.parse(given)


def test_files_name_what_they_give_in_place_of_a_mix() -> None:
    with pytest.raises(FieldError, match=r"^mix: P\(conservative\) must be a probability .* not 'x'$"):
        build(Mix, "x", ("mix",))
    with pytest.raises(FieldError, match=r"^must be a list, each item a probability in \[0, 1\], or two of them"):
        build(Many[Mix], "x")
    assert build(Many[Mix], [0.1, [0.1, 0.9]]) == (Mix(0.1), ALL_MIXES)


def test_a_mix_has_a_mean_and_contains_the_mixes_between_its_ends() -> None:
    assert (ALL_MIXES.mean, Mix(0.4).mean) == (0.5, 0.4)
    assert Mix(0.4).is_single and not ALL_MIXES.is_single
    assert all(ALL_MIXES.contains(one) for one in (ALL_MIXES, Mix(0.1), Mix(0.2, 0.9)))
    assert not any(Mix(0.4).contains(one) for one in (ALL_MIXES, Mix(0.5), Mix(0.4, 0.5)))


@pytest.mark.parametrize(("least", "decisions"), [(1, 360), (360, 360), (361, 720), (32_768, 33_120)])
def test_decisions_are_rounded_up_to_whole_rollouts(least: int, decisions: int) -> None:
    assert PpoSettings(n_envs=12, n_steps=30).whole_rollouts(least) == decisions
