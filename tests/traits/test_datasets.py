import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes.networks import UserNetwork, write_config
from tests.simulation.scenes import T
from tint_sumo.cli import main
from tint_sumo.config import CONSERVATIVE_LABEL, TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.sumocfg_recorder import record_sumocfg
from tint_sumo.dataset.windows import Windows, load_labels, load_windows, split_by_episode
from tint_sumo.traits import TRAIT_METHODS, datasets
from tint_sumo.traits.datasets import evaluate_traits, plot_traits, train_traits
from tint_sumo.traits.evaluation import TEST_FRACTION
from tint_sumo.traits.storage import find, read_card

SMALL = TraitSettings(
    embedding_sizes=(8, 8), hidden_size=8, encoder_output_size=8, decoder_output_size=8, batch_size=64, epochs=1
)
SEED = 3


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "dataset"
    record(folder, 100, seed=5, workers=2, progress=False)  # in other processes: this one's libsumo stays free
    return folder


@pytest.fixture(scope="module")
def model(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model") / "run"
    train_traits(dataset, folder, settings=SMALL, seed=SEED)
    return folder


def test_training_sees_the_training_episodes_only(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Windows] = []
    original = datasets.train

    def train(windows: Windows, *args: Any, **kwargs: Any) -> Any:
        seen.append(windows)
        return original(windows, *args, **kwargs)

    monkeypatch.setattr(datasets, "train", train)
    card = train_traits(dataset, tmp_path / "run", settings=SMALL, seed=SEED)
    windows = load_windows(dataset)
    _, test = split_by_episode(windows, TEST_FRACTION, SEED)
    assert set(seen[0].episode).isdisjoint(windows.episode[test])
    assert card["windows"] == len(seen[0]) == len(windows) - len(test)
    assert card["data"] == {
        "scene": "t_intersection",
        "scene_digest": T.digest,
        "p_conservative": 0.5,
        "population": "traits",
        "seed": 5,
        "windows": len(windows),
    }


def test_a_method_with_labels_learns_from_the_conservative_drivers(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[tuple[Windows, np.ndarray]] = []
    original = datasets.train

    def train(windows: Windows, *args: Any, conservative: np.ndarray, **kwargs: Any) -> Any:
        taken.append((windows, conservative))
        return original(windows, *args, conservative=conservative, **kwargs)

    monkeypatch.setattr(datasets, "train", train)
    train_traits(dataset, tmp_path / "run", method="classifier", settings=SMALL, seed=SEED)
    ((windows, conservative),) = taken
    np.testing.assert_array_equal(conservative, load_labels(dataset, windows) == CONSERVATIVE_LABEL)


def test_evaluation_and_pictures_take_the_episodes_left_out_by_the_model_s_seed(
    dataset: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[np.ndarray, np.ndarray]] = []
    original = datasets.plot_latents

    def plot(model: Any, windows: Windows, labels: np.ndarray, *args: Any, **kwargs: Any) -> None:
        drawn.append((windows.episode, labels))
        original(model, windows, labels, *args, **kwargs)

    monkeypatch.setattr(datasets, "plot_latents", plot)
    files = plot_traits(dataset, model, tmp_path)
    assert [file.name for file in files] == ["latent.png", "reconstruction.png"]
    assert all(file.exists() for file in files)
    found = evaluate_traits(dataset, model)
    windows = load_windows(dataset)
    _, test = split_by_episode(windows, TEST_FRACTION, SEED)
    assert found["windows"] == len(test)
    ((episode, drawn_labels),) = drawn
    labels = load_labels(dataset, windows)[test]
    np.testing.assert_array_equal(episode, windows.episode[test])
    np.testing.assert_array_equal(drawn_labels, labels)
    assert max(labels.mean(), 1 - labels.mean()) - 0.05 <= found["accuracy"] <= 1.0


@pytest.mark.parametrize(
    ("name", "noise_m", "least"),
    [
        ("vae", 0.0, 0.985),
        ("cross_window", 0.0, 0.99),
        ("cross_window", 0.05, 0.98),
        ("morton", 0.0, 0.97),
        ("classifier", 0.0, 0.99),
    ],
)
def test_shipped_models_are_small_and_classify_unseen_drivers(
    dataset: Path, name: str, noise_m: float, least: float
) -> None:
    assert find(name).with_suffix(".safetensors").stat().st_size < 2_000_000
    assert evaluate_traits(dataset, name, noise_m=noise_m)["accuracy"] >= least
    assert read_card(name).entries["accuracy_by_noise"][f"{noise_m:g}"] >= least


def test_vtypes_are_traits_from_the_recording_to_the_picture(
    user_network: Callable[[str], UserNetwork], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The two vTypes of the merge, with a third one that nobody has."""
    folder = user_network("merge").sumocfg.parent
    text = (folder / "merge.rou.xml").read_text().replace("</routes>", '<vType id="nobody" length="9"/></routes>')
    (tmp_path / "three.rou.xml").write_text(text)
    net, step = str(folder / "merge.net.xml"), '<step-length value="0.1"/>'
    sumocfg = write_config(tmp_path / "three.sumocfg", net, "three.rou.xml", step)
    data, model = tmp_path / "data", tmp_path / "model"
    record_sumocfg(sumocfg, data, 400, progress=False)
    train_traits(data, model, settings=SMALL, seed=SEED)
    assert main(["traits", "evaluate", "--data", str(data), "--model", str(model), "--json"]) == 0
    *page, content = capsys.readouterr().out.splitlines()
    found = json.loads(content)
    confusion = found["confusion"]
    assert list(confusion) == ["calm", "hasty"]
    sizes = {name: sum(answers.values()) for name, answers in confusion.items()}
    assert sum(sizes.values()) == found["windows"]
    assert max(sizes.values()) / found["windows"] == found["majority_share"]
    right = [confusion[name][name] for name in confusion]
    assert sum(right) / found["windows"] == pytest.approx(found["accuracy"])
    assert found["balanced_accuracy"] == pytest.approx(right[0] / sizes["calm"] / 2 + right[1] / sizes["hasty"] / 2)
    assert sum(line.startswith(("calm ", "hasty ")) for line in page) == 2
    assert [file.name for file in plot_traits(data, model, tmp_path / "p")] == ["latent.png", "reconstruction.png"]


def test_noise_makes_evaluation_harder_and_is_repeatable(dataset: Path) -> None:
    clean, noisy, again = (evaluate_traits(dataset, "vae", noise_m=noise_m) for noise_m in (0.0, 0.3, 0.3))
    assert noisy == again
    assert noisy["accuracy"] < clean["accuracy"] - 0.1
    with pytest.raises(InputError, match="0 or more, not -1"):
        evaluate_traits(dataset, "vae", noise_m=-1.0)


@pytest.mark.parametrize("method", sorted(TRAIT_METHODS))
def test_every_method_trains_on_a_dataset_and_reports_its_errors(dataset: Path, tmp_path: Path, method: str) -> None:
    train_traits(dataset, tmp_path, method=method, settings=SMALL, seed=SEED)
    found = evaluate_traits(dataset, tmp_path)
    assert 0.4 < found["accuracy"] <= 1.0
    assert (found["error_m"] is None) == (method == "classifier")


def test_every_setting_of_a_training_is_used_or_refused(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def train(budget: dict[str, Any], *flags: str) -> int:
        (tmp_path / "train.yaml").write_text(json.dumps({"data": str(dataset), "budget": {"epochs": 1, **budget}}))
        return main(
            ["traits", "train", "--config", str(tmp_path / "train.yaml"), "--out", str(tmp_path / "run"), *flags]
        )

    assert train({"noise_m": 0.5}, "--noise", "0.1") == 2
    assert "noise is 0.1 m, and 0.5 m in the budget; give it once" in capsys.readouterr().err
    assert train({"kl_weight": 1.0}, "--method", "cross_window") == 2
    assert "method cross_window does not use kl_weight" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert train({"noise_m": 0.5, "kl_weight": 1.0}) == 0
    settings = read_card(tmp_path / "run").entries["settings"]
    assert (settings["noise_m"], settings["kl_weight"]) == (0.5, 1.0)


def test_a_negative_seed_is_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seed"):
        train_traits(dataset, tmp_path / "run", settings=SMALL, seed=-1)
    assert not (tmp_path / "run").exists()
