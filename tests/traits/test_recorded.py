"""Windows of recorded drivers, training on them, and traits that are inferred from them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.drivers.recordings import population, simulated_pair, write_pair, write_pairs
from tint_sumo.config import NO_LEADER_GAP_M, TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.drivers.fitted import fit_drivers
from tint_sumo.drivers.models import MODELS
from tint_sumo.drivers.pairs import Pair, read_pairs
from tint_sumo.drivers.population import Noise, Population
from tint_sumo.traits.datasets import evaluate_traits
from tint_sumo.traits.evaluation import encode_windows
from tint_sumo.traits.inference import infer_recorded
from tint_sumo.traits.recorded import RECORDED_GAP_M, drawn_pairs, train_on_tracks, windows_of
from tint_sumo.traits.storage import load, read_card

ROWS = 90  # four windows of 20 steps, and one of 10
MODEL = MODELS["IDM"]


@dataclass(frozen=True)
class Recording:
    folder: Path
    pairs: tuple[Pair, ...]  # two of each of three drivers
    model: Path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, small: TraitSettings) -> Recording:
    folder = tmp_path_factory.mktemp("recorded")
    pairs = [
        simulated_pair(z, 2 * driver + number, ROWS, follower=str(driver), start_s=60.0 * (1 - number))
        for driver, z in enumerate(population(3, 1))
        for number in range(2)
    ]
    write_pairs(folder / "tracks", pairs)
    train_on_tracks(folder / "tracks", folder / "model", settings=small)
    return Recording(folder / "tracks", read_pairs(folder / "tracks").pairs, folder / "model")


def test_windows_are_offsets_and_gaps_by_driver_and_time(recording: Recording) -> None:
    windows, number = windows_of(recording.pairs)
    assert windows.length.tolist() == [20, 20, 20, 20, 10] * 6
    assert windows.driver.tolist() == [0] * 10 + [1] * 10 + [2] * 10
    starts = [(recording.pairs[one].driver, recording.pairs[one].start_s) for one in number.tolist()]
    assert starts == sorted(starts)
    pair, third = recording.pairs[number[0]], windows.states[2]
    np.testing.assert_allclose(third[:, 0], pair.front_m[40:60] - pair.front_m[40], atol=1e-3)
    np.testing.assert_allclose(third[:, 1], pair.gap_m[40:60], atol=1e-3)
    assert windows.has_leader.all()


def test_far_leaders_and_none_have_the_same_stand_in(recording: Recording) -> None:
    pair = recording.pairs[0]
    near = float(np.median(pair.gap_m))
    windows, _ = windows_of([pair], near)
    assert windows.states[..., 1].max() == pytest.approx(near)
    assert not windows.has_leader.all()
    free = replace(pair, leader="", leader_rear_m=np.full(pair.rows, np.inf))
    windows, _ = windows_of([free])
    assert (windows.states[windows.length == 20][..., 1] == RECORDED_GAP_M).all()
    assert not windows.has_leader.any()


def test_drawn_drivers_follow_recorded_leaders_and_keep_their_parameters(recording: Recording) -> None:
    spread = np.diag(np.full(5, 1e-12))
    known = Population(MODEL.usual, spread, spread, Noise(0.9, 1e-9))
    drawn = drawn_pairs(MODEL, known, recording.pairs, drivers=3, encounters=2, seed=4)
    assert [pair.follower for pair in drawn] == ["000000", "000000", "000001", "000001", "000002", "000002"]
    for pair in drawn:
        front_m, _ = MODEL.follow(
            pair.leader_rear_m, pair.leader_speed_mps, pair.front_m[0], pair.speed_mps[0], MODEL.usual, 0.1
        )
        np.testing.assert_allclose(pair.front_m, front_m, atol=0.01)
        assert pair.gap_m[0] == pytest.approx(2.5 + 1.2 * pair.speed_mps[0], abs=0.01)
    wide = replace(known, between=np.diag(np.full(5, 0.1)), noise=Noise(0.9, 2.0))
    first, again, other = (drawn_pairs(MODEL, wide, recording.pairs, 3, 2, seed) for seed in (4, 4, 5))
    assert all((one.front_m == two.front_m).all() for one, two in zip(first, again, strict=True))
    assert any(
        one.rows != two.rows or (one.front_m != two.front_m).any() for one, two in zip(first, other, strict=True)
    )


def test_a_model_of_recorded_drivers_keeps_its_gap_and_says_what_it_learnt_from(recording: Recording) -> None:
    card = read_card(recording.model)
    assert card.no_leader_gap_m == load(recording.model).no_leader_gap_m == RECORDED_GAP_M
    digests = card.entries["recorded"].pop("recordings")
    assert card.entries["recorded"] == {"tracks": "tracks", "pairs": 6, "drivers": 3} and len(digests) == 1
    assert load("cross_window").no_leader_gap_m == NO_LEADER_GAP_M  # shipped models are as before
    assert max(card.input_range.high_gap_m) > NO_LEADER_GAP_M


def test_a_model_learns_from_drivers_of_a_fit(recording: Recording, tmp_path: Path, small: TraitSettings) -> None:
    fit_drivers(recording.pairs[:2], MODEL, tmp_path / "fit")
    settings = replace(small, epochs=1)
    card = train_on_tracks(recording.folder, tmp_path / "model", settings=settings, fit=tmp_path / "fit")
    digests = read_card(recording.model).entries["recorded"]["recordings"]  # stretches without a leader do not count
    shape = {"tracks": "tracks", "recordings": digests, "pairs": 6, "drivers": 3}
    assert card["recorded"] == {**shape, "drawn": 400, "model": "IDM"}
    assert card["windows"] == 400 * 4 * 5


def test_the_latents_of_a_recording_are_those_of_its_windows(recording: Recording) -> None:
    table = infer_recorded(recording.folder, recording.model)
    windows, number = windows_of(recording.pairs)
    expected = encode_windows(load(recording.model), windows)
    np.testing.assert_allclose(table[["latent_1", "latent_2"]], expected.mean, atol=1e-6)
    assert table["vehicle"].tolist() == [recording.pairs[one].driver for one in number.tolist()]
    assert table["start_s"].iloc[:10].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0, 60.0, 62.0, 64.0, 66.0, 68.0]
    assert table["window"].iloc[:11].tolist() == [*range(10), 0]
    assert not table["outside"].any()


def test_floating_car_data_have_stretches_without_a_leader(tmp_path: Path, small: TraitSettings) -> None:
    steps = "".join(
        f'<timestep time="{row / 10:.1f}">'
        + "".join(
            f'<vehicle id="{name}" x="{start + 2.0 * row:.2f}" y="0" angle="90" type="car" speed="20" pos="{row}" '
            'lane="ab_0" slope="0"/>'
            for name, start in (("ahead", 40.0), ("behind", 0.0))
        )
        + "</timestep>"
        for row in range(41)
    )
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    assert [pair.leader for pair in read_pairs(tmp_path / "fcd.xml").pairs] == ["ahead"]
    train_on_tracks(tmp_path / "fcd.xml", tmp_path / "model", settings=replace(small, epochs=1))
    table = infer_recorded(tmp_path / "fcd.xml", tmp_path / "model")
    assert table.groupby("vehicle", observed=True)["has_leader"].all().tolist() == [False, True]
    assert table["steps"].tolist() == [20, 20] * 2


def test_other_scales_are_refused(recording: Recording) -> None:
    with pytest.raises(
        InputError, match=r"100\.0% of the windows .* lie outside what cross_window was trained on \(offset"
    ):
        infer_recorded(recording.folder, "cross_window")
    with pytest.raises(InputError, match="knows gaps up to 150 m, and scenes have gaps up to 20 m"):
        evaluate_traits(recording.folder, recording.model, other_scene=True)


def test_recordings_without_what_is_needed_are_refused(
    recording: Recording, tmp_path: Path, small: TraitSettings
) -> None:
    with pytest.raises(InputError, match="classifier learns with labels, which recorded tracks do not have"):
        train_on_tracks(recording.folder, tmp_path / "out", method="classifier", settings=small)
    write_pair(tmp_path / "short.csv", simulated_pair(MODEL.usual, rows=5))
    with pytest.raises(InputError, match=r"has no pair .* \(1 are shorter than 1 s\)"):
        train_on_tracks(tmp_path / "short.csv", tmp_path / "out", settings=small)
    assert not (tmp_path / "out").exists()


def test_distances_ahead_are_those_of_the_predictions_one_by_one(recording: Recording) -> None:
    model = load(recording.model)
    windows, _ = windows_of(recording.pairs)
    states = torch.from_numpy(windows.states[windows.length == 20][:4])
    latents = torch.tensor([[0.3, -1.0]]).expand(4, -1)
    expected_m = torch.zeros(4)
    leader_m, known = states.sum(dim=-1), states.clone()
    for step in range(10, 20):
        features = model.features(known, torch.full((4,), 20))
        followed, _ = model.follower(features[:, :step].transpose(0, 1))
        predicted = model.prediction((model.from_follower(followed[-1]) + model.from_latent(latents)).relu())[:, 0]
        moved_m = predicted * model.feature_scale[0] + model.feature_mean[0]
        expected_m += moved_m
        known[:, step, 0] = known[:, step - 1, 0] + moved_m
        known[:, step, 1] = known[:, step - 1, 1] + leader_m[:, step] - leader_m[:, step - 1] - moved_m
    torch.testing.assert_close(model.ahead_m(states, latents, 10), expected_m, atol=1e-3, rtol=1e-4)
