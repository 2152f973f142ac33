"""Shared by all tests."""

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from tests.s3 import empty_bucket, s3_server
from tests.scenes.networks import USER_NETWORKS, UserNetwork
from tint_sumo import traits
from tint_sumo.config import PolicySettings, PpoSettings, TraitSettings
from tint_sumo.traits.storage import save

settings.register_profile("tint_sumo", deadline=None)  # no test fails because the machine is busy
settings.load_profile("tint_sumo")


# Processes that a script starts in the background ignore Ctrl-C, and so would all that tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Tests run in parallel; torch's own threads would only get in each other's way."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def _logs_in_a_folder_of_the_tests(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Stable-Baselines3 makes one for every training that is given none."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))


@pytest.fixture(scope="session")
def user_network(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], UserNetwork]:
    """Return a function that makes a user's network by its name, once."""
    made: dict[str, UserNetwork] = {}

    def make(name: str) -> UserNetwork:
        if name not in made:
            made[name] = USER_NETWORKS[name](tmp_path_factory.mktemp(name))
        return made[name]

    return make


@pytest.fixture(scope="session")
def s3_endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of an S3 server on this machine."""
    with s3_server(tmp_path_factory.mktemp("s3") / "log.txt") as endpoint:
        yield endpoint


@pytest.fixture
def s3_url(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A folder in an empty bucket; the environment says where the server is and who asks."""
    empty_bucket(s3_endpoint, "bucket")
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_endpoint)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "tester")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    return "s3://bucket/folder"


@pytest.fixture(scope="session")
def tiny() -> PpoSettings:
    """A policy and a training of a moment."""
    network = PolicySettings(
        embedding_sizes=(8,), score_sizes=(8,), context_size=8, joint_sizes=(8,), hidden_size=8, head_sizes=(8,)
    )
    return PpoSettings(n_envs=4, n_steps=16, n_epochs=1, n_minibatches=1, total_steps=128, policy=network)


@pytest.fixture(scope="session")
def brief(tiny: PpoSettings) -> PpoSettings:
    """The same with episodes so short that some end in every rollout."""
    return replace(tiny, time_limit_s=0.8)


@pytest.fixture(scope="session")
def encoders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a trait model of each method, which nobody trained; do not write there."""
    folder = tmp_path_factory.mktemp("encoders")
    small = TraitSettings(embedding_sizes=(), hidden_size=4, encoder_output_size=4, decoder_output_size=4)
    torch.manual_seed(0)
    for name, method in traits.TRAIT_METHODS.items():
        save(method(small), folder / name, {"seed": 0})
    return folder
