from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, TraitSettings
from tint_sumo.traits.figures import plot_latents, plot_reconstructions
from tint_sumo.traits.vae import Vae


class MeanSpeed(Vae):
    """Its latents are a window's mean displacement and mean gap."""

    def encode(self, states, length):
        last = states[torch.arange(len(length)), length - 1, 0] / length
        return torch.stack((last, states[..., 1].sum(dim=1) / length), dim=1), torch.zeros(len(length), 2)


@pytest.fixture
def model() -> Vae:
    return MeanSpeed(TraitSettings((4, 4), hidden_size=4)).eval()


def test_each_trait_has_its_colour_where_its_latents_are(model, street, tmp_path: Path) -> None:
    windows, _ = street
    fast = encode_speed(windows) > np.median(encode_speed(windows))
    file = tmp_path / "figures" / "latent.png"
    plot_latents(model, windows, fast.astype(int), {"slow": CONSERVATIVE.rgb, "fast": AGGRESSIVE.rgb}, file)
    image = imread(file)
    height, width = image.shape[:2]
    drawn = image[int(0.1 * height) : int(0.8 * height), : width // 2, :3]  # the latent space without title and legend
    red, green, blue = np.moveaxis(drawn, 2, 0)
    slow_at = np.nonzero((blue - red > 0.1) & (blue - green > 0.05))[1]
    fast_at = np.nonzero((red - blue > 0.1) & (red - green > 0.1))[1]
    assert np.percentile(slow_at, 95) < np.percentile(fast_at, 5)
    assert [path.name for path in file.parent.iterdir()] == ["latent.png"]


def test_rare_kinds_are_grey_where_there_are_too_many(model, street, tmp_path: Path) -> None:
    windows, _ = street
    labels = np.arange(len(windows)) % 12
    labels[: len(windows) // 2] = 5
    plot_latents(model, windows, labels, {str(number): (1.0, 0.0, 0.0) for number in range(12)}, tmp_path / "all.png")
    image = imread(tmp_path / "all.png")
    height, width = image.shape[:2]
    red, green, blue = np.moveaxis(image[int(0.1 * height) : int(0.8 * height), : width // 2, :3], 2, 0)
    is_red, is_grey = (red - green > 0.2).sum(), ((red == green) & (green == blue) & (red > 0.4) & (red < 0.75)).sum()
    assert is_red > 500
    assert is_grey > 100


def encode_speed(windows) -> np.ndarray:
    return windows.states[np.arange(len(windows)), windows.length - 1, 0] / windows.length


def test_a_reconstruction_is_drawn_for_full_windows_however_few(model, street, tmp_path: Path) -> None:
    windows, _ = street
    full = np.flatnonzero(windows.length == 20)
    plot_reconstructions(model, windows[full[:2]], tmp_path / "two.png")
    plot_reconstructions(model, windows, tmp_path / "six.png")
    assert imread(tmp_path / "two.png").shape == imread(tmp_path / "six.png").shape
